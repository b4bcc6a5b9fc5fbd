"""Exact order statistics of values that arrive in chunks, in two passes and little memory.

Non-negative floats are ordered as their bits are, read as whole numbers. The first pass counts the
upper 16 bits of each value, which tells in which of these bins a rank lies; the second counts the
lower 16 bits of the values in those bins. This is a radix selection, with the counts in place of
the values: Knuth, "The Art of Computer Programming", vol. 3, sections 5.2.5 and 5.3.3.

Values are rounded to float32, the precision in which errors are stored: 6e-8 of themselves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sweep.typing import Floats

Integers = NDArray[np.int64]
Masks = NDArray[np.bool_]

UPPER, LOWER = 1 << 16, 1 << 16
"""How many values the upper and the lower half of the 32 bits can have."""


@dataclass(frozen=True, slots=True, eq=False)
class Tally:
    """How often each key occurs: ``keys`` (n,) increasing, ``counts`` (n,)."""

    keys: Integers
    counts: Integers

    @classmethod
    def of(cls, keys: Integers) -> Tally:
        """Return the tally of keys (m,), in any order."""
        return cls(*np.unique(keys, return_counts=True))

    def merged(self, other: Tally) -> Tally:
        """Return the tally of both together."""
        keys, where = np.unique(np.concatenate([self.keys, other.keys]), return_inverse=True)
        counts = np.zeros(len(keys), dtype=np.int64)
        np.add.at(counts, where, np.concatenate([self.counts, other.counts]))
        return Tally(keys, counts)

    def moved(self, stride: int, offset: int, unit: int) -> Tally:
        """Return the tally with group g (the key over ``unit``) as group g * stride + offset."""
        group, rest = np.divmod(self.keys, unit)
        return Tally((group * stride + offset) * unit + rest, self.counts)


def bits(values: Floats) -> Integers:
    """Return the bits of non-negative values, rounded to float32, as whole numbers."""
    with np.errstate(over="ignore"):  # above 3.4e38: infinite
        return np.abs(values).astype(np.float32).view(np.uint32).astype(np.int64)


def upper_tally(groups: Integers, values: Floats) -> Tally:
    """Return the first pass: tally of group * UPPER + upper bits; groups and values are (m,)."""
    return Tally.of(groups * UPPER + bits(values) // LOWER)


def bins_of(upper: Tally, groups: Integers, ranks: Integers) -> tuple[Integers, Integers]:
    """Return the bins (upper bits) in which ranks lie, and their ranks within the bins.

    All are of one shape. ``ranks`` count from 1 within a group, in increasing order of values; a
    rank that its group does not have gives the bin -1.
    """
    before = np.concatenate([[0], np.cumsum(upper.counts)])
    first = np.searchsorted(upper.keys, groups * UPPER)
    size = before[np.searchsorted(upper.keys, (groups + 1) * UPPER)] - before[first]
    there = (ranks >= 1) & (ranks <= size)
    target = before[first] + np.where(there, ranks, 0)
    place = np.searchsorted(before, target) - 1
    bins = upper.keys[np.maximum(place, 0)] if len(upper.keys) else np.zeros_like(ranks)
    within = target - before[np.maximum(place, 0)]
    return np.where(there, bins % UPPER, -1), np.where(there, within, 0)


def lower_tally(groups: Integers, values: Floats, bins: Integers) -> Tally:
    """Return the second pass: tally of all bits of those values that lie in a group's bins.

    ``groups`` and ``values`` are (m,), ``bins`` (groups, ...) as `bins_of` gives them.
    """
    every = np.arange(len(bins)).reshape(-1, *[1] * (bins.ndim - 1)) * UPPER + bins
    wanted = np.unique(every[bins >= 0])
    whole = bits(values)
    upper = groups * UPPER + whole // LOWER
    place = np.minimum(np.searchsorted(wanted, upper), len(wanted) - 1)
    inside = wanted[place] == upper if len(wanted) else np.zeros(len(upper), dtype=bool)
    return Tally.of(upper[inside] * LOWER + whole[inside] % LOWER)


def values_at(lower: Tally, groups: Integers, bins: Integers, ranks: Integers) -> Floats:
    """Return the values at ranks within bins, as `bins_of` gives them; NaN for the bin -1."""
    before = np.concatenate([[0], np.cumsum(lower.counts)])
    first = (groups * UPPER + np.maximum(bins, 0)) * LOWER
    target = before[np.searchsorted(lower.keys, first)] + ranks
    place = np.maximum(np.searchsorted(before, target) - 1, 0)
    keys = lower.keys[place] if len(lower.keys) else np.zeros_like(bins)
    whole = (keys % (UPPER * LOWER)).astype(np.uint32)
    return np.where(bins >= 0, whole.view(np.float32).astype(np.float64), np.nan)
