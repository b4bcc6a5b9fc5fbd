"""Numbers of trials at which waves end: after each, it is decided what else is needed."""

from __future__ import annotations

import math

GROWTH = 4
"""A wave has about one trial for so many of those before it, at least one unit."""


def wave_ends(max_trials: int, unit: int) -> tuple[int, ...]:
    """Return the numbers of trials at which waves end: multiples of a unit, and ``max_trials``.

    Examples
    --------
    >>> wave_ends(600, 50)
    (50, 100, 150, 200, 250, 350, 450, 600)
    >>> wave_ends(30, 50), wave_ends(120, 50)
    ((30,), (50, 100, 120))
    """
    ends: list[int] = []
    end = unit
    while end < max_trials:
        ends.append(end)
        end += unit * max(1, math.ceil(end / unit / GROWTH))
    return (*ends, max_trials)
