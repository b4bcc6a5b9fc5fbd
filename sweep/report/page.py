"""The report as one HTML page that needs nothing else: no network, no script, no other file."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape

from sweep.report.answer import Answer
from sweep.report.figure import RenderedFigure
from sweep.report.gallery import Scene
from sweep.report.page_style import STYLE
from sweep.report.provenance_facts import Provenance
from sweep.report.scene_drawing import AXES, FOUND, OTHER, REJECTED, TRUTH, Colour
from sweep.report.theme import panel_svg

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
"""A browser refuses, and tells on its console, whatever the page would ask of a network."""

LEGEND: tuple[tuple[str, Colour], ...] = (
    ("truth", TRUTH), ("found (dot: first corner)", FOUND), ("other ID or place", OTHER),
    ("rejected candidate", REJECTED), ("x", AXES[0]), ("y", AXES[1]), ("z", AXES[2]),
)
"""What the colours of drawn scenes mean; blue, green, red."""


def page(
    title: str, found: Answer, made: Provenance, figures: Sequence[RenderedFigure],
    scenes: Iterable[Scene],
) -> str:
    """Return the report as HTML."""
    shown = "\n".join(_figure(figure) for figure in figures)
    gallery = "\n".join(_scene(scene) for scene in scenes)
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{escape(title)}</title>
<style>{STYLE}</style>
</head>
<body>
<a class="skip" href="#figures">Skip to the figures</a>
<header class="page">
<p class="kicker">sweep report</p>
<h1>{escape(title)}</h1>
<p class="answer">{escape(found.paragraph)}</p>
{_tiles(found)}
{_contents(figures, scenes=bool(gallery))}
</header>
<main>
<section aria-labelledby="source"><h2 id="source">Where the numbers come from</h2>
{_provenance(found, made)}
</section>
<section aria-labelledby="figures"><h2 id="figures">Figures</h2>
{shown}
</section>
{_gallery(gallery)}
</main>
<footer>Made by sweep from <code>{escape(made.facts["Store"])}</code>,
{escape(made.facts["Report"])}. This page asks nothing of the network.</footer>
</body>
</html>
"""


def _tiles(found: Answer) -> str:
    tiles = "\n".join(
        f'<div><dt>{escape(tile.heading)}</dt><dd><span class="value">{escape(tile.value)}</span>'
        f'<span class="detail">{escape(tile.detail)}</span></dd></div>'
        for tile in found.tiles
    )
    return f'<dl class="tiles">\n{tiles}\n</dl>'


def _contents(figures: Sequence[RenderedFigure], *, scenes: bool) -> str:
    links = [(figure.name, figure.title) for figure in figures]
    links = [("source", "Where the numbers come from"), *links]
    if scenes:
        links.append(("scenes", "Scenes"))
    items = "\n".join(
        f'<li><a href="#{escape(name)}">{escape(text)}</a></li>' for name, text in links
    )
    return f'<nav class="contents" aria-label="Contents"><ol>\n{items}\n</ol></nav>'


def _provenance(found: Answer, made: Provenance) -> str:
    facts = "\n".join(
        f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in made.facts.items()
    )
    commands = escape("\n".join(made.commands))
    file = base64.b64encode(made.pipeline.encode()).decode()
    drawn = f'<p class="note">Drawn per trial: {escape(made.drawn)}.</p>' if made.drawn else ""
    return f"""<dl class="facts">
{facts}
</dl>
<p>Store and report are made again by</p>
<pre tabindex="0"><code>{commands}</code></pre>
<details class="pipeline"><summary>The pipeline, {escape(made.file)}</summary>
<p class="note">Save it as <a download="{escape(made.file)}"
href="data:application/toml;base64,{file}">{escape(made.file)}</a>.</p>
<pre tabindex="0"><code>{escape(made.pipeline)}</code></pre></details>
{made.axes.html() if made.axes is not None else "<p>The grid has no axes: one pose.</p>"}
{drawn}
{"".join(table.html() for table in found.tables)}"""


def _figure(shown: RenderedFigure) -> str:
    if shown.svg is not None:
        drawing = (f'<div class="whole" tabindex="0" role="group" '
                   f'aria-label="{escape(shown.title)}">{shown.svg(shown.name)}</div>')
    else:
        drawings = []
        for k, panel in enumerate(shown.panels):
            svg = panel_svg(panel, f"{shown.name}-{k}")
            if panel.wide:
                svg = (f'<div class="wide" tabindex="0" role="group" '
                       f'aria-label="{escape(panel.title)}">{svg}</div>')
            drawings.append(svg)
        drawing = f'<div class="panels">{"".join(drawings)}</div>'
    return f"""<figure class="shown" id="{escape(shown.name)}">
<h3>{escape(shown.title)}</h3>
{drawing}
<figcaption>{escape(shown.caption)}</figcaption>
<details class="data"><summary>The numbers behind it</summary>
{shown.table.html()}
</details>
</figure>"""


def _gallery(scenes: str) -> str:
    if not scenes:
        return ""
    legend = "\n".join(
        f'<li style="--swatch: #{red:02x}{green:02x}{blue:02x}">{escape(text)}</li>'
        for text, (blue, green, red) in LEGEND
    )
    return f"""<section aria-labelledby="scenes"><h2 id="scenes">Scenes</h2>
<p>Poses of this store, rendered again and searched again, with what was found drawn in. Of each
failure the one with the largest marker is shown.</p>
<ul class="legend">
{legend}
</ul>
<div class="gallery">
{scenes}
</div></section>"""


def _scene(scene: Scene) -> str:
    if scene.picture is None:
        drawing = f'<div class="none">{escape(scene.problem)}</div>'
    else:
        encoded = base64.b64encode(scene.picture).decode()
        width, height = scene.size
        drawing = (f'<img alt="{escape(scene.alt)}" width="{width}" height="{height}" '
                   f'src="data:image/png;base64,{encoded}">')
    titles = "".join(f"<strong>{escape(title.capitalize())}</strong>" for title in scene.titles)
    problem = f'<p class="differs">{escape(scene.problem)}</p>' if (
        scene.problem and scene.picture is not None) else ""
    return f"""<figure>
{drawing}
<figcaption>{titles}<span class="told">{escape(scene.told)}</span><br>
{escape(scene.coordinates)}{problem}
<pre tabindex="0"><code>{escape(scene.command)}</code></pre></figcaption>
</figure>"""
