"""What a dip of the detection rate is: for predicted and for measured rates.

- The rate at a side is the mean over the IDs.
- A *dip* is a local minimum of that rate over the sides with a prominence of at least 0.06
  (``scipy.signal.find_peaks``): three standard deviations of a difference of two rates that were
  measured with 1,200 poses each.
- It reaches over the sides at which the rate is in the lower half of its prominence. Its place is
  the centre of mass of what lies below the half: an area, side² · cos tilt.
- A predicted and a measured dip are the same where their places are nearest to each other, and
  less than 10 % apart.
- An ID *has* a dip where its rate, averaged over a side and its two neighbours, is below 0.97 at
  any side of the range (of 300 poses 290 have a Wilson interval that ends at 0.984).

:func:`half_read` tells where cells read half of their neighbours, whatever the bits are.
"""  # noqa: INP001  (a folder of a page, not a package)

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from bit_reading import Reading, cell_mixing
from numpy.typing import NDArray
from scipy.signal import find_peaks, peak_widths

PROMINENCE = 0.06
SAME_PLACE = 0.10
AFFECTED_BELOW = 0.97
HALF_READ_SIDES = (2.1, 5.0)
"""Sides in px a module over which :func:`half_read` looks: below, most cells read neighbours."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Rates:
    """Detection rates (S, M) of M IDs (M,) at S sides (S,) of a tilt, and the areas (S,) in px²."""

    sides_px: Floats
    areas_px2: Floats
    ids: NDArray[np.int64]
    rates: Floats

    @property
    def mean(self) -> Floats:
        """The rate (S,) at each side, mean of the IDs."""
        return np.asarray(self.rates.mean(axis=1))

    def having(self, low_px: float, high_px: float) -> frozenset[int]:
        """Return the IDs that are affected at any side of a range."""
        three = np.full_like(self.rates, np.nan)
        three[1:-1] = (self.rates[:-2] + self.rates[1:-1] + self.rates[2:]) / 3
        within = (self.sides_px > low_px - 1e-9) & (self.sides_px < high_px + 1e-9)
        return frozenset(self.ids[(three[within] < AFFECTED_BELOW - 1e-9).any(axis=0)].tolist())


@dataclass(frozen=True, slots=True)
class Dip:
    """A range of sides, its place, the lowest rate in it (mean of the IDs), its prominence."""

    low_px: float
    high_px: float
    area_px2: float
    lowest: float
    prominence: float


def dips(found: Rates) -> list[Dip]:
    """Return the dips, small sides first."""
    loss = 1.0 - found.mean
    peaks, properties = find_peaks(loss, prominence=PROMINENCE)
    _, heights, low, high = peak_widths(loss, peaks, rel_height=0.5, prominence_data=(
        properties["prominences"], properties["left_bases"], properties["right_bases"]))
    index = np.arange(len(loss))
    out = []
    prominences = properties["prominences"]
    for peak, height, left, right, above in zip(
        peaks, heights, low, high, prominences, strict=True
    ):
        within = (index >= left) & (index <= right)
        area = np.average(found.areas_px2[within], weights=loss[within] - height + 1e-9)
        ends = np.interp([left, right], index, found.sides_px)
        out.append(Dip(
            float(ends[0]), float(ends[1]), float(area), float(1.0 - loss[peak]), float(above)))
    return out


def pairs(predicted: Rates, measured: Rates) -> list[tuple[Dip | None, Dip | None]]:
    """Return each dip as predicted and as measured, None where it has no partner."""
    mine, its = dips(predicted), dips(measured)

    def nearest(dip: Dip, others: list[Dip]) -> Dip | None:
        close = [other for other in others
                 if abs(other.area_px2 / dip.area_px2 - 1.0) < SAME_PLACE]
        return min(close, key=lambda other: abs(other.area_px2 - dip.area_px2), default=None)

    same = [(a, b) for a in mine if (b := nearest(a, its)) and nearest(b, mine) is a]
    alone = [(a, None) for a in mine if all(a is not pair[0] for pair in same)]
    missed = [(None, b) for b in its if all(b is not pair[1] for pair in same)]
    found: list[tuple[Dip | None, Dip | None]] = [*same, *alone, *missed]
    return sorted(found, key=lambda pair: next(dip.area_px2 for dip in pair if dip))


def half_read(modules: int, reading: Reading) -> dict[int, tuple[float, float]]:
    """Return for each cell along an axis the sides at which it may read half of its neighbours.

    The first half of the cells: the others mirror them. Sides in steps of 0.01 px, 200 offsets.
    """
    edges = -(np.arange(200) + 0.5) / 200
    low, high = HALF_READ_SIDES
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
