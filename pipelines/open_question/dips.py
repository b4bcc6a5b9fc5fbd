"""What a dip of the detection rate is, and which IDs have it: for predicted and measured rates.

- Sides from 2.1 to 5 px a module, in steps of 0.1 px; below, nothing is read well.
- An ID is *affected* at a side where its rate, averaged over that side and its two neighbours, is
  below 0.97 (of 300 poses 290 have a Wilson interval that ends at 0.984).
- A *dip* is a range of sides at which at least 10 % of the IDs are affected. Ranges less than
  0.35 px apart are one.
- Its area is the centre of mass of the loss, over all IDs and its range.
- An ID *has* the dip where it is affected at any side of the range. Of two dips that are compared
  the range is their union.
- A predicted and a measured dip are the same where their ranges overlap.

:func:`half_read` tells where the model puts dips, whatever the bits are.
"""  # noqa: INP001  (a folder of a page, not a package)

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sweep.measure.bit_reading import Reading, cell_mixing

AFFECTED_BELOW = 0.97
SHARE_OF_IDS = 0.10
JOINED_PX = 0.35
SIDES_PER_MODULE = (2.1, 5.0)
ROUNDING = 1e-9

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Rates:
    """Detection rates (S, M) of M IDs (M,) at S sides (S,), of markers of n modules."""

    sides_px: Floats
    ids: NDArray[np.int64]
    rates: Floats
    modules: int

    def affected(self) -> NDArray[np.bool_]:
        """Tell (S, M) which IDs are affected at which sides."""
        three = np.full_like(self.rates, np.nan)
        three[1:-1] = (self.rates[:-2] + self.rates[1:-1] + self.rates[2:]) / 3
        low, high = (per_module * self.modules for per_module in SIDES_PER_MODULE)
        looked_at = (self.sides_px >= low - ROUNDING) & (self.sides_px <= high + ROUNDING)
        return (three < AFFECTED_BELOW - ROUNDING) & looked_at[:, None]

    def having(self, low_px: float, high_px: float) -> frozenset[int]:
        """Return the IDs that are affected at any side of a range."""
        within = (self.sides_px >= low_px - ROUNDING) & (self.sides_px <= high_px + ROUNDING)
        return frozenset(self.ids[self.affected()[within].any(axis=0)].tolist())


@dataclass(frozen=True, slots=True)
class Dip:
    """A range of sides, its area, the lowest rate in it (mean of the IDs), the IDs that have it."""

    low_px: float
    high_px: float
    area_px2: float
    lowest: float
    ids: frozenset[int]

    @property
    def sides(self) -> str:
        """The range as text."""
        return f"{self.low_px:.1f}-{self.high_px:.1f}"


@dataclass(frozen=True, slots=True)
class Pair:
    """A dip as predicted and as measured, and the IDs that have it in the union of the ranges."""

    predicted: Dip | None
    measured: Dip | None
    predicted_ids: frozenset[int]
    measured_ids: frozenset[int]

    @property
    def off(self) -> float:
        """Predicted area over the measured one, minus 1; NaN where one is missing."""
        if self.predicted is None or self.measured is None:
            return float("nan")
        return self.predicted.area_px2 / self.measured.area_px2 - 1.0

    @property
    def differing(self) -> frozenset[int]:
        """IDs that have the dip in one of the two only."""
        return self.predicted_ids ^ self.measured_ids

    def cells(self, count: int) -> list[str]:
        """Return sides, area, off, IDs of ``count``, IDs that differ, lowest rate, as text."""
        def both(text: str, *values: object) -> str:
            return " / ".join("-" if value is None else text.format(value) for value in values)

        mine, its = self.predicted, self.measured
        return [
            both("{}", mine and mine.sides, its and its.sides),
            both("{:.0f}", mine and mine.area_px2, its and its.area_px2),
            "-" if mine is None or its is None else f"{100 * self.off:+.1f} %",
            f"{len(self.predicted_ids)} / {len(self.measured_ids)} of {count}",
            f"{len(self.differing)} ({100 * len(self.differing) / count:.0f} %)",
            both("{:.3f}", mine and mine.lowest, its and its.lowest),
        ]


def dips(found: Rates) -> list[Dip]:
    """Return the dips, small sides first."""
    sides = found.sides_px
    ranges: list[list[int]] = []
    for k in np.flatnonzero(found.affected().mean(axis=1) >= SHARE_OF_IDS).tolist():
        if ranges and sides[k] - sides[ranges[-1][1]] < JOINED_PX:
            ranges[-1][1] = k
        else:
            ranges.append([k, k])
    out = []
    for first, last in ranges:
        # What is averaged at a side reaches one step to both sides.
        reach = slice(max(first - 1, 0), last + 2)
        rate = found.rates[reach].mean(axis=1)
        area = float(np.average(sides[reach] ** 2, weights=1.0 - rate))
        low, high = float(sides[first]), float(sides[last])
        out.append(Dip(low, high, area, float(rate.min()), found.having(low, high)))
    return out


def pairs(predicted: Rates, measured: Rates) -> Iterator[Pair]:
    """Yield each dip as predicted and as measured, then those that were measured only."""
    others = dips(measured)
    taken: set[Dip] = set()
    for mine in dips(predicted):
        same = [its for its in others if _overlap(mine, its)]
        taken.update(same)
        for its in same:
            low, high = min(mine.low_px, its.low_px), max(mine.high_px, its.high_px)
            yield Pair(mine, its, predicted.having(low, high), measured.having(low, high))
        if not same:
            yield Pair(mine, None, mine.ids, measured.having(mine.low_px, mine.high_px))
    for its in others:
        if its not in taken:
            yield Pair(None, its, predicted.having(its.low_px, its.high_px), its.ids)


def _overlap(a: Dip, b: Dip) -> bool:
    return a.low_px <= b.high_px + ROUNDING and b.low_px <= a.high_px + ROUNDING


def half_read(modules: int, reading: Reading) -> dict[int, tuple[float, float]]:
    """Return for each cell along an axis the sides at which it may read half of its neighbours.

    The first half of the cells: the others mirror them. Sides in steps of 0.01 px, 200 offsets.
    """
    edges = -(np.arange(200) + 0.5) / 200
    low, high = SIDES_PER_MODULE
    sides = np.arange(round(100 * low * modules), 100 * high * modules + 1) / 100
    amiss = np.array([
        (np.diagonal(cell_mixing(side, modules, edges, reading)[0], axis1=1, axis2=2)
         < 1 - reading.valid_share).any(axis=0)
        for side in sides
    ])
    return {
        cell: (float(sides[amiss[:, cell]][0]), float(sides[amiss[:, cell]][-1]))
        for cell in range((modules + 1) // 2) if amiss[:, cell].any()
    }
