"""What a chart of lines draws of an analysis."""

from __future__ import annotations

from typing import NamedTuple


class Curve(NamedTuple):
    """A variable of an analysis that is drawn along an axis.

    Attributes
    ----------
    variable
        Its name.
    title, unit
        As they stand on the chart.
    scale
        What it is multiplied by.
    share
        Whether it is drawn from 0 to 100 %.
    signed
        Whether a line is drawn at 0.
    """

    variable: str
    title: str
    unit: str
    scale: float = 1.0
    share: bool = False
    signed: bool = False
