"""The colours, shapes and matplotlib settings of all figures, and the colours of the page."""

from __future__ import annotations

from typing import Any

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
"""The palette of Okabe and Ito, distinguishable by the colour-blind; without its yellow, which is
too faint for a line."""

SHAPES = ("o", "s", "^", "D", "v", "P", "X", "<", ">")
INK, FAINT, RULE, STRIP, PAPER = "#282828", "#7a7a7a", "#e6e6e6", "#f3f3f3", "#ffffff"
"""Text; secondary text and lines; grid lines; shaded areas; background."""

REFERENCE_DASHES = (0, (5, 3))
"""Of lines that mark a reference, such as a bound."""

DASHES: tuple[Any, ...] = (
    "-", (0, (5, 2)), (0, (1.5, 1.5)), (0, (6, 2, 1.5, 2)), (0, (8, 3)), (0, (3, 1.5)), "-",
)
"""Of the lines of a figure; the last stands with black."""

MATPLOTLIB_STYLE: Any = {
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
"""Settings of matplotlib in which every panel is drawn."""

THEME: dict[str, tuple[str, str]] = {
    "ink": (INK, "#e4e2dd"), "faint": (FAINT, "#99968f"), "rule": (RULE, "#34363a"),
    "strip": (STRIP, "#26282c"), "paper": (PAPER, "#17181b"),
    "c1": (COLOURS[0], "#4ba3e3"), "c2": (COLOURS[1], "#f08a45"), "c3": (COLOURS[2], "#2fc196"),
    "c4": (COLOURS[3], "#e0a3c6"), "c5": (COLOURS[4], "#8ed0f7"), "c6": (COLOURS[5], "#f2bd4c"),
    "c7": (COLOURS[6], "#ffffff"),
}
"""CSS variable -> its colour on light paper and in dark mode."""


def css_variables(*, dark: bool) -> str:
    """Return the CSS declarations of the colours, on light paper or in dark mode.

    >>> css_variables(dark=False)[:29]
    '--ink: #282828; --faint: #7a7'
    """
    return " ".join(f"--{name}: {colours[dark]};" for name, colours in THEME.items())
