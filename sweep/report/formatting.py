"""Numbers and values as text: in tables, figures, sentences and on the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from sweep.tradeoff.pareto import digits

MAX_SHORT = 5
"""Characters of a number that needs no rounding to be short."""


def number(value: float) -> str:
    """Return a number with three significant digits and typographic signs; a dash for NaN.

    >>> number(0.31), number(-1234.0), number(float("inf")), number(float("nan"))
    ('0.310', '\u22121230', '\u221e', '\u2013')
    """
    if math.isnan(value):
        return "\u2013"
    if math.isinf(value):
        return "\u221e" if value > 0 else "\u2212\u221e"
    return digits(value).replace("-", "\u2212") if value < 0 else digits(value)


def brief_number(value: float) -> str:
    """Return a number with two significant digits, as it fits into a cell of a map.

    >>> brief_number(0.312), brief_number(1234.0), brief_number(float("inf"))
    ('0.31', '1234', '\u221e')
    """
    if not math.isfinite(value):
        return number(value)
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.2g}"


def degrees(value: float) -> str:
    """Return an angle with its unit, or the word "infinite".

    >>> degrees(1.5), degrees(float("inf"))
    ('1.50\u00b0', 'infinite')
    """
    return f"{number(value)}\u00b0" if math.isfinite(value) else "infinite"


def interval_text(low: float, high: float, unit: str = "") -> str:
    """Return the ends of an interval: ``0.5 to 1.5``.

    >>> interval_text(1.0, float("inf"), "\u00b0")
    '1.00 to \u221e\u00b0'
    """
    return f"{number(low)} to {number(high)}{unit}"


def coordinate(value: Any) -> str:
    """Return a coordinate as text: of a number at most six significant digits.

    >>> coordinate(0.30000000000000004), coordinate("exact")
    ('0.3', 'exact')
    """
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def coordinates(values: Sequence[Any]) -> list[str]:
    """Return coordinates as text: long numbers with as few digits as keep them distinct.

    >>> coordinates([0.15, 0.208424, 1.5]), coordinates([12.25, 12.5])
    (['0.15', '0.208', '1.5'], ['12.25', '12.5'])
    >>> coordinates(["exact", "warp"])
    ['exact', 'warp']
    """
    texts = [coordinate(value) for value in values]
    short = max(map(len, texts), default=0) <= MAX_SHORT
    if short or not all(isinstance(value, float) for value in values):
        return texts
    for figures in range(3, 6):
        shorter = [f"{value:.{figures}g}" for value in values]
        if len(set(shorter)) == len(shorter):
            return shorter
    return texts


def short_coordinate(value: float, values: Sequence[float]) -> str:
    """Return a coordinate with as few digits as keep it apart from the others of its axis.

    >>> short_coordinate(0.208424, [0.15, 0.208424, 1.5]), short_coordinate(0.3, [])
    ('0.208', '0.3')
    """
    given = [float(each) for each in values]
    return dict(zip(given, coordinates(given), strict=True)).get(value, coordinate(value))


def bin_text(low: float, high: float) -> str:
    """Return the ends of a bin.

    >>> bin_text(0.12345, 12345.6)
    '0.123\u201312346'
    """
    return "\u2013".join(
        f"{end:.3g}" if abs(end) < 1000 else f"{end:.0f}" for end in (low, high))


def plural(count: int, noun: str, plural_noun: str = "") -> str:
    """Return a count with its noun.

    >>> plural(1, "pose"), plural(2000, "pose"), plural(2, "axis", "axes")
    ('1 pose', '2,000 poses', '2 axes')
    """
    return f"{count:,} {noun if count == 1 else plural_noun or f'{noun}s'}"


def shortened(text: str, most: int) -> str:
    """Return text with at most ``most`` characters, the last an ellipsis if it was cut.

    >>> shortened("distance", 5)
    'dist\u2026'
    """
    return text if len(text) <= most else text[: most - 1] + "\u2026"
