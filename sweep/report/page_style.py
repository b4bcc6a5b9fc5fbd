"""The look of a report's page: on screens wide and narrow, in the dark, and in print."""

from __future__ import annotations

from sweep.report.theme import css_variables

STYLE = f"""
:root {{ color-scheme: light dark; {css_variables(dark=False)}
  --sans: system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", "Liberation Sans",
    Arial, sans-serif;
  --mono: ui-monospace, "SF Mono", Menlo, Consolas, "Liberation Mono", monospace;
  --link: #0b5c99; }}
@media (prefers-color-scheme: dark) {{
  :root {{ {css_variables(dark=True)} --link: #7cc0f2; }}
}}
@media print {{
  :root {{ color-scheme: light; {css_variables(dark=False)} --link: inherit; }}
}}
""" + """
*, *::before, *::after { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; scroll-behavior: smooth; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.55 var(--sans); font-variant-numeric: lining-nums; }
main, header.page, footer { max-width: 68rem; margin: 0 auto; padding: 0 1.5rem; }
header.page { padding-top: 3rem; }
a { color: var(--link); text-underline-offset: 2px; }
a:focus-visible, summary:focus-visible, [tabindex]:focus-visible {
  outline: 2px solid var(--link); outline-offset: 2px; }
.skip { position: absolute; left: -100vw; }
.skip:focus { left: 1rem; top: 1rem; background: var(--paper); padding: .5rem; z-index: 1; }
p, figcaption, dd, li { overflow-wrap: break-word; }
p.kicker { margin: 0; color: var(--faint); font-size: .82rem; letter-spacing: .07em;
  text-transform: uppercase; }
h1 { font-size: clamp(1.6rem, 1.1rem + 2.1vw, 2.4rem); line-height: 1.18; margin: .35rem 0 1rem;
  font-weight: 650; letter-spacing: -.015em; text-wrap: balance; overflow-wrap: anywhere; }
h2 { font-size: 1.4rem; line-height: 1.25; margin: 3.5rem 0 1rem; padding-top: 1rem;
  border-top: 1px solid var(--rule); font-weight: 650; letter-spacing: -.01em; }
h3 { font-size: 1.08rem; line-height: 1.3; margin: 0 0 .6rem; font-weight: 620;
  overflow-wrap: anywhere; }
.answer { font-size: 1.13rem; max-width: 46rem; margin: 0 0 1.5rem; }
dl.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(9.2rem, 1fr));
  gap: 1px; margin: 1.5rem 0; border: 1px solid var(--rule); border-radius: 8px;
  overflow: hidden; }
dl.tiles > div { box-shadow: 0 0 0 1px var(--rule); padding: .8rem 1rem; }
dl.tiles dt { color: var(--faint); font-size: .8rem; }
dl.tiles dd { margin: .15rem 0 0; }
dl.tiles .value { font-size: 1.5rem; font-weight: 640; letter-spacing: -.01em; line-height: 1.2; }
dl.tiles .detail { display: block; color: var(--faint); font-size: .8rem; }
nav.contents { font-size: .92rem; margin: 1.25rem 0; }
nav.contents ol { margin: 0; padding: 0; list-style: none; columns: 18rem auto;
  column-gap: 2rem; }
nav.contents li { break-inside: avoid; padding: .1rem 0; }
figure.shown { margin: 0 0 3.2rem; scroll-margin-top: 1rem; }
.panels { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 25rem), 1fr));
  gap: 1.1rem 1.6rem; align-items: start; }
.panels > svg, .whole > svg { display: block; width: 100%; height: auto; }
.panels > svg { max-width: 36rem; }
.panels > .wide { grid-column: 1 / -1; }
.wide, .whole { overflow-x: auto; }
.wide > svg { display: block; width: 100%; min-width: 33rem; height: auto; }
.whole > svg { min-width: 44rem; }
figcaption { max-width: 46rem; margin: .7rem 0 .4rem; font-size: .93rem; color: var(--ink); }
.note, .told { color: var(--faint); font-size: .88rem; }
details { margin: .5rem 0; font-size: .93rem; }
summary { cursor: pointer; color: var(--link); width: fit-content; }
.scroll { overflow-x: auto; max-width: 100%; margin: .6rem 0; }
table { border-collapse: collapse; font-size: .85rem; line-height: 1.4;
  font-variant-numeric: tabular-nums lining-nums; }
caption { text-align: left; color: var(--faint); padding: 0 0 .4rem; }
th, td { padding: .28rem .8rem .28rem 0; text-align: left; white-space: nowrap;
  border-bottom: 1px solid var(--rule); vertical-align: top; font-weight: 400; }
thead th { font-weight: 620; border-bottom: 1px solid var(--faint); }
.n { text-align: right; }
td.text { white-space: normal; min-width: 14rem; }
pre { font: .82rem/1.5 var(--mono); background: var(--strip); border-radius: 6px;
  padding: .8rem 1rem; margin: .5rem 0; overflow-x: auto; max-width: 100%; }
code { font-family: var(--mono); font-size: .86em; overflow-wrap: anywhere; }
pre code { font-size: inherit; overflow-wrap: normal; }
.gallery { display: grid; gap: 2.2rem 1.6rem;
  grid-template-columns: repeat(auto-fill, minmax(min(100%, 19rem), 1fr)); }
.gallery figure { margin: 0; min-width: 0; }
.gallery img { display: block; width: 100%; height: 17rem; object-fit: contain;
  image-rendering: pixelated; background: var(--strip); border-radius: 6px; }
.gallery .none { display: grid; place-items: center; height: 17rem; padding: 1.5rem;
  background: var(--strip); border-radius: 6px; color: var(--faint); font-size: .9rem;
  overflow: auto; overflow-wrap: anywhere; }
.gallery figcaption { font-size: .88rem; margin-top: .5rem; }
.gallery figcaption strong { display: block; font-weight: 620; }
.gallery pre { font-size: .74rem; padding: .5rem .7rem; }
.gallery .differs { border-left: 3px solid var(--c2); padding-left: .6rem; }
ul.legend { list-style: none; display: flex; flex-wrap: wrap; gap: .3rem 1.2rem; padding: 0;
  font-size: .88rem; margin: 0 0 1.3rem; }
ul.legend li::before { content: ""; display: inline-block; width: .95em; height: .95em;
  margin-right: .45em; border-radius: 2px; background: var(--swatch); vertical-align: -.1em; }
dl.facts { display: grid; grid-template-columns: max-content minmax(0, 1fr); gap: .2rem 1.2rem;
  font-size: .92rem; margin: 1rem 0; }
dl.facts dt { color: var(--faint); }
dl.facts dd { margin: 0; overflow-wrap: anywhere; }
footer { color: var(--faint); font-size: .85rem; padding-top: 2rem; padding-bottom: 3rem; }
@media (max-width: 34rem) {
  main, header.page, footer { padding-left: 1rem; padding-right: 1rem; }
  header.page { padding-top: 1.6rem; }
  dl.tiles { grid-template-columns: 1fr 1fr; }
  h2 { margin-top: 2.4rem; }
}
@media print {
  @page { margin: 16mm 14mm; }
  body { font-size: 10pt; }
  main, header.page, footer { max-width: none; padding: 0; }
  h2 { break-after: avoid; margin-top: 1.5rem; }
  figure.shown, .gallery figure, .panels > *, tr, dl.tiles { break-inside: avoid; }
  .panels { grid-template-columns: 1fr 1fr; }
  h3, caption { break-after: avoid; }
  figure.shown:has(.panels > :nth-child(5)) { break-inside: auto; }
  p { break-inside: avoid; }
  dl.tiles { grid-template-columns: repeat(6, 1fr); }
  dl.tiles > div { padding: .5rem .6rem; }
  dl.tiles .value { font-size: 1.2rem; }
  section > p, ul.legend { break-after: avoid; }
  .gallery { grid-template-columns: 1fr 1fr 1fr; gap: 1rem; }
  .gallery img, .gallery .none { height: 42mm; }
  .wide, .whole, .scroll, pre { overflow: visible; }
  .wide > svg, .whole > svg { min-width: 0; }
  pre { white-space: pre-wrap; overflow-wrap: anywhere; border: 1px solid var(--rule); }
  pre code { overflow-wrap: anywhere; }
  details.pipeline::details-content { content-visibility: visible; block-size: auto; }
  nav.contents, .skip, details.data { display: none; }
  a { color: inherit; text-decoration: none; }
}
"""
