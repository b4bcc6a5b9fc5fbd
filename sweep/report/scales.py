"""Scales of charts: whether logarithmic, between which ends, with which ticks and colours."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axis import Axis
from matplotlib.colors import Colormap, LogNorm, Normalize
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from sweep.report.theme import INK
from sweep.typing import Floats

LOGARITHMIC_FROM = 6
"""Values that span a larger ratio are drawn on a logarithmic scale."""


FLOOR_RATIO = 1e-6
"""Values below this part of the largest are drawn at the lower edge of a logarithmic axis: errors
of rounding would compress all others."""

FLOOR_NOTE = "Errors below a millionth of the largest are drawn at the lower edge."


class Series(NamedTuple):
    """Values (n,) of a line, or of rows of dots, with the ends of their intervals or NaN."""

    label: str
    x: Floats
    y: Floats
    low: Floats
    high: Floats


# Values.

def spans(values: Floats, ratio: float) -> bool:
    """Return whether no value is below 0 and the positive ones span more than a ratio."""
    finite = values[np.isfinite(values)]
    positive = finite[finite > 0]
    return bool(positive.size and finite.min() >= 0 and positive.max() > ratio * positive.min())


def below_floor(values: Floats) -> bool:
    """Return whether any value is too small, or 0, to be drawn at its place beside the largest."""
    finite = values[np.isfinite(values)]
    return bool(finite.size and finite.min() < FLOOR_RATIO * finite.max())


def grow_by_factors(values: Floats) -> bool:
    """Return whether distinct positive values lie more evenly on a logarithmic scale."""
    steps, factors = (np.diff(each) for each in (np.unique(values), np.log(np.unique(values))))
    return bool(np.std(factors) / np.mean(factors) <= np.std(steps) / np.mean(steps))


def value_limits(values: Floats, *, logarithmic: bool, margin: float) -> tuple[float, float]:
    """Return the ends of an axis with the finite values on it, and a margin (share of its length).

    On a logarithmic axis, values that are not positive are left out.
    """
    finite = values[np.isfinite(values) & ((values > 0) | (not logarithmic))]
    if not finite.size:
        return 0.0, 1.0
    if logarithmic:
        low, high = np.log10(finite.min()), np.log10(finite.max())
        spare = margin * max(high - low, 0.3)
        return 10.0 ** (low - spare), 10.0 ** (high + spare)
    low, high = float(finite.min()), float(finite.max())
    spare = margin * (high - low) or 0.5 * abs(high) or 0.5
    return low - spare, high + spare


def value_scale(
    series: Sequence[Series], *, share: bool, level: float | None = None
) -> tuple[bool, tuple[float, float]]:
    """Return whether the axis of a chart's values is logarithmic, and its ends.

    Parameters
    ----------
    series
        Values with their intervals.
    share
        Whether the values are shares in percent, whose axis is always the same.
    level
        A reference that must lie on the axis, too; with 0 the axis is linear.
    """
    if share:
        return False, (-3.0, 103.0)
    values = np.concatenate([line.y for line in series])
    ends = np.concatenate([line.low for line in series] + [line.high for line in series])
    if level is not None:
        values = np.append(values, level)
    positive = values[np.isfinite(values) & (values > 0)]
    logarithmic = spans(values, LOGARITHMIC_FROM) and (level is None or level > 0)
    if logarithmic:
        values = values[values >= FLOOR_RATIO * positive.max()]
        # Long intervals are cut off, so that they do not compress everything else.
        lowest = max(positive.min(), FLOOR_RATIO * positive.max())
        held = ends[(ends > lowest / 10) & (ends < positive.max() * 10)]
    else:
        held = ends
    everything = np.concatenate([values, held])
    low, high = value_limits(everything, logarithmic=logarithmic, margin=0.08)
    if not logarithmic and everything[np.isfinite(everything)].min(initial=0) >= 0:
        low = 0.0
    return logarithmic, (low, high)


def clipped_intervals(line: Series, limits: tuple[float, float]) -> tuple[Floats, Floats]:
    """Return the ends (n,) and (n,) of intervals, clipped to the ends of the axis.

    If only one end is known, the other lies beyond all draws: it is clipped, too.
    """
    low = np.where(np.isnan(line.low) & ~np.isnan(line.high), -np.inf, line.low)
    high = np.where(np.isnan(line.high) & ~np.isnan(line.low), np.inf, line.high)
    return np.clip(low, *limits), np.clip(high, *limits)


def plain_ticks(axis: Axis, *, logarithmic: bool, share: bool = False) -> None:
    """Give an axis few ticks at round values, written without powers of ten."""
    if share:
        axis.set_ticks([0, 25, 50, 75, 100])
    if not logarithmic:
        return
    low, high = axis.get_view_interval()
    subs = (1, 2, 5) if high < 60 * low else (1, 3) if high < 1000 * low else (1,)
    axis.set_major_locator(LogLocator(subs=subs))
    axis.set_minor_locator(NullLocator())
    formatter: Callable[[float, Any], str] = lambda value, _: f"{value:g}"  # noqa: E731
    axis.set_major_formatter(FuncFormatter(formatter))


# Colours of maps.

def colour_scale(values: Floats, *, share: bool) -> Normalize:
    """Return the scale of a map's colours; ``share``: values are shown from 0 to 100 %."""
    if share:
        return Normalize(0, 100)
    finite = values[np.isfinite(values)]
    if spans(finite, LOGARITHMIC_FROM):
        return LogNorm(finite[finite > 0].min(), finite.max(), clip=True)
    low, high = (finite.min(), finite.max()) if finite.size else (0.0, 1.0)
    return Normalize(min(low, 0.0), high if high > low else low + 1.0)


def colour_ends(norm: Normalize) -> tuple[float, float]:
    """Return the values at the two ends of a colour scale."""
    return float(norm.vmin or 0.0), float(norm.vmax or 1.0)


def readable_on(colours: Colormap, norm: Normalize, value: float) -> str:
    """Return black or white, whichever has more contrast with a cell; ink on an empty cell.

    The luminance is that of sRGB (IEC 61966-2-1).
    """
    if not np.isfinite(value):
        return INK
    red, green, blue = colours(float(norm(value)))[:3]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4
              for c in (red, green, blue)]
    luminance = 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
    # Near black and near white: black and white themselves are replaced on a page.
    return "#050505" if luminance > 0.18 else "#fefefe"
