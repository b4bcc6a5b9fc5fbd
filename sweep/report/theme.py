"""Figures as ink on the reader's paper: SVG whose colours the page chooses, and files of them.

A figure is drawn once, in the colours of light paper. On a page these are replaced by the page's
CSS variables, so that the same drawing is right in the dark and in print; files keep them.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sweep.report.trade_figure import COLOURS, FAINT, INK, RULE, STRIP_COLOUR

PAPER = "#ffffff"
STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "sweep",
    "text.parse_math": False,
    "axes.edgecolor": FAINT, "axes.labelcolor": INK, "axes.titlecolor": INK,
    "axes.titlesize": 9.5, "axes.titlelocation": "left", "axes.titleweight": "bold",
    "axes.labelsize": 8.5, "axes.linewidth": 0.7, "axes.axisbelow": True,
    "axes.spines.top": False, "axes.spines.right": False,
    "xtick.labelsize": 8.5, "ytick.labelsize": 8.5, "xtick.color": FAINT, "ytick.color": FAINT,
    "xtick.labelcolor": INK, "ytick.labelcolor": INK,
    "grid.color": RULE, "grid.linewidth": 0.7, "text.color": INK,
    "legend.frameon": False, "legend.fontsize": 8.5, "legend.labelcolor": INK,
    "font.size": 8.5, "lines.linewidth": 1.5, "figure.constrained_layout.use": True,
}
"""Settings of matplotlib."""

WIDTH, HEIGHT = 4.4, 3.2
"""Inches of a panel; a wide one takes the room of two."""

COLUMNS = 2
DOTS_PER_INCH = 150

THEME: dict[str, tuple[str, str]] = {
    "ink": (INK, "#e4e2dd"), "faint": (FAINT, "#99968f"), "rule": (RULE, "#34363a"),
    "strip": (STRIP_COLOUR, "#26282c"), "paper": (PAPER, "#17181b"),
    "c1": (COLOURS[0], "#4ba3e3"), "c2": (COLOURS[1], "#f08a45"), "c3": (COLOURS[2], "#2fc196"),
    "c4": (COLOURS[3], "#e0a3c6"), "c5": (COLOURS[4], "#8ed0f7"), "c6": (COLOURS[5], "#f2bd4c"),
    "c7": (COLOURS[6], "#ffffff"),
}
"""Name of each colour, as it is on light paper and in the dark."""

_VARIABLES = {light.lower(): f"var(--{name})" for name, (light, _) in THEME.items()}


@dataclass(frozen=True, slots=True)
class Panel:
    """One drawing of a figure.

    ``draw`` draws it on empty axes; ``alt`` says in words what is drawn, for those who cannot see
    it. ``height`` is in inches.
    """

    title: str
    alt: str
    draw: Callable[[Axes], None]
    wide: bool = False
    height: float = HEIGHT


def panel_svg(panel: Panel, prefix: str) -> str:
    """Return a panel as inline SVG; ``prefix`` makes its identifiers unique on the page."""
    with mpl.rc_context(STYLE):
        figure = Figure((2 * WIDTH if panel.wide else WIDTH, panel.height))
        axes = figure.add_subplot()
        panel.draw(axes)
        axes.set_title(panel.title, pad=6 + _legend_height(axes))
        return inline(_svg(figure), panel.alt, prefix)


def write_panels(panels: Sequence[Panel], stem: Path) -> None:
    """Write a figure of all panels as ``stem``.svg and ``stem``.png."""
    columns = 1 if any(panel.wide for panel in panels) else min(len(panels), COLUMNS)
    rows = math.ceil(len(panels) / columns)
    heights = [
        max(panel.height for panel in panels[row * columns : (row + 1) * columns])
        for row in range(rows)
    ]
    width = columns * WIDTH * (2 if any(panel.wide for panel in panels) else 1)
    with mpl.rc_context(STYLE):
        figure = Figure((width, sum(heights)))
        grid = figure.add_gridspec(rows, columns, height_ratios=heights)
        for k, panel in enumerate(panels):
            axes = figure.add_subplot(grid[k // columns, k % columns])
            panel.draw(axes)
            axes.set_title(panel.title, pad=6 + _legend_height(axes))
        figure.savefig(stem.with_suffix(".svg"), metadata={"Date": None})
        figure.savefig(stem.with_suffix(".png"), dpi=DOTS_PER_INCH)


def _legend_height(axes: Axes) -> float:
    """Return the points that a legend above the axes takes, between them and the title."""
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


def inline(svg: str, alt: str, prefix: str, *, clipped: bool = False) -> str:
    """Return matplotlib's SVG as part of a page: named, themed, without anything from outside.

    ``clipped``: something may leave its axes and has to be cut off there.
    """
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r"<!--.*?-->", "", svg, flags=re.DOTALL)
    svg = svg.replace("xlink:href", "href")
    if not clipped:
        svg = re.sub(r'\s*clip-path="url\(#[^"]*\)"', "", svg)
        svg = re.sub(r"<defs>\s*<clipPath.*?</defs>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'\bid="([^"]*)"', rf'id="{prefix}-\1"', svg)
    svg = re.sub(r'href="#([^"]*)"', rf'href="#{prefix}-\1"', svg)
    svg = re.sub(r"url\(#([^)]*)\)", rf"url(#{prefix}-\1)", svg)
    svg = re.sub(r"font: ([\d.a-z ]*?)'[^;\"]*", r"font: \1var(--sans)", svg)
    svg = re.sub(r"font-family: [^;\"]*", "font-family: var(--sans)", svg)
    svg = re.sub(
        r"((?:fill|stroke|stop-color):\s*)(#[0-9a-fA-F]{6})",
        lambda match: match[1] + _VARIABLES.get(match[2].lower(), match[2]), svg,
    )
    # Hundredths of a point are enough.
    svg = re.sub(
        r'\bd="[^"]*"', lambda match: re.sub(r"(\.\d\d)\d+", r"\1", match[0]), svg)
    svg = re.sub(r"\n\s*", "\n", svg)
    box = re.search(r'viewBox="[^"]*"', svg)
    opening = (
        f'<svg role="img" aria-label="{escape(alt)}" {box[0] if box else ""} '
        'preserveAspectRatio="xMidYMid meet">'
    )
    return opening + svg[svg.index(">") + 1 :]


def css_variables(*, dark: bool) -> str:
    """Return the CSS declarations of the colours."""
    return " ".join(f"--{name}: {colours[dark]};" for name, colours in THEME.items())
