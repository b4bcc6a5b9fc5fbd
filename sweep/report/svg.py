"""Panels of figures as inline SVG, whose colours the page chooses, and as files.

A panel is drawn once, in the colours of light paper. On a page these are replaced by the page's
CSS variables, so that one drawing serves light, dark and print; files keep them.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sweep.report.theme import MATPLOTLIB_STYLE, THEME

WIDTH, HEIGHT = 4.4, 3.2
"""Inches of a panel; a wide panel has twice the width."""

COLUMNS = 2
DOTS_PER_INCH = 150

_VARIABLES = {light.lower(): f"var(--{name})" for name, (light, _) in THEME.items()}


@dataclass(frozen=True, slots=True)
class Panel:
    """One panel of a figure.

    Attributes
    ----------
    title
        Stands above it.
    alt
        Its content in words, for readers who cannot see it.
    draw
        Draws it on empty axes.
    wide
        Whether it takes the whole width of the page.
    height
        In inches.
    """

    title: str
    alt: str
    draw: Callable[[Axes], None]
    wide: bool = False
    height: float = HEIGHT


def panel_svg(panel: Panel, prefix: str) -> Markup:
    """Return a panel as inline SVG; ``prefix`` makes its identifiers unique on the page."""
    with mpl.rc_context(MATPLOTLIB_STYLE):
        figure = Figure((2 * WIDTH if panel.wide else WIDTH, panel.height))
        _draw(panel, figure.add_subplot())
        return inline_svg(_svg(figure), panel.alt, prefix)


def write_panels(panels: Sequence[Panel], stem: Path) -> None:
    """Write a figure of all panels as ``stem``.svg and ``stem``.png."""
    columns = 1 if any(panel.wide for panel in panels) else min(len(panels), COLUMNS)
    rows = math.ceil(len(panels) / columns)
    heights = [
        max(panel.height for panel in panels[row * columns : (row + 1) * columns])
        for row in range(rows)
    ]
    width = columns * WIDTH * (2 if any(panel.wide for panel in panels) else 1)
    with mpl.rc_context(MATPLOTLIB_STYLE):
        figure = Figure((width, sum(heights)))
        grid = figure.add_gridspec(rows, columns, height_ratios=heights)
        for k, panel in enumerate(panels):
            _draw(panel, figure.add_subplot(grid[k // columns, k % columns]))
        figure.savefig(stem.with_suffix(".svg"), metadata={"Date": None})
        figure.savefig(stem.with_suffix(".png"), dpi=DOTS_PER_INCH)


def _draw(panel: Panel, axes: Axes) -> None:
    panel.draw(axes)
    axes.set_title(panel.title, pad=6 + _legend_height(axes))


def _legend_height(axes: Axes) -> float:
    """Return the height in points of a legend between the axes and the title."""
    legend = axes.get_legend()
    if legend is None:
        return 0.0
    entries, columns = len(legend.get_texts()), int(getattr(legend, "_ncols", 1))
    return 8 + 12.5 * math.ceil(entries / columns)


def _svg(figure: Figure) -> str:
    encoded = io.StringIO()
    metadata = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    figure.savefig(encoded, format="svg", transparent=True, metadata=metadata)
    return encoded.getvalue()


def inline_svg(svg: str, alt: str, prefix: str, *, clipped: bool = False) -> Markup:
    """Return matplotlib's SVG as a self-contained part of a page.

    Parameters
    ----------
    svg
        What matplotlib wrote.
    alt
        The drawing in words.
    prefix
        Makes its identifiers unique on the page.
    clipped
        Whether parts that leave their axes must be cut off there; clip paths are large.
    """
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", svg, flags=re.DOTALL)
    svg = svg.replace("xlink:href", "href")
    if not clipped:
        svg = re.sub(r'\s*clip-path="url\(#[^"]*\)"', "", svg)
        svg = re.sub(r"<defs>\s*<clipPath.*?</defs>", "", svg, flags=re.DOTALL)
    svg = _with_theme(_with_prefix(svg, prefix))
    # Hundredths of a point are enough.
    svg = re.sub(
        r'\bd="[^"]*"', lambda match: re.sub(r"(\.\d\d)\d+", r"\1", match[0]), svg)
    svg = re.sub(r"\n\s*", "\n", svg)
    box = re.search(r'viewBox="[^"]*"', svg)
    opening = Markup(
        '<svg role="img" aria-label="{}" {} preserveAspectRatio="xMidYMid meet">'
    ).format(alt, Markup(box[0] if box else ""))  # noqa: S704  (matplotlib's)
    return opening + Markup(svg[svg.index(">") + 1 :])  # noqa: S704


def _with_prefix(svg: str, prefix: str) -> str:
    """Return SVG whose identifiers, and the references to them, begin with ``prefix``."""
    svg = re.sub(r'\bid="([^"]*)"', rf'id="{prefix}-\1"', svg)
    svg = re.sub(r'href="#([^"]*)"', rf'href="#{prefix}-\1"', svg)
    return re.sub(r"url\(#([^)]*)\)", rf"url(#{prefix}-\1)", svg)


def _with_theme(svg: str) -> str:
    """Return SVG with the page's font and CSS variables in place of matplotlib's."""
    svg = re.sub(r"font: ([\d.a-z ]*?)'[^;\"]*", r"font: \1var(--sans)", svg)
    svg = re.sub(r"font-family: [^;\"]*", "font-family: var(--sans)", svg)
    return re.sub(
        r"((?:fill|stroke|stop-color):\s*)(#[0-9a-fA-F]{6})",
        lambda match: match[1] + _VARIABLES.get(match[2].lower(), match[2]), svg,
    )
