"""Exact order statistics of values that arrive in chunks, in two passes and little memory.

Non-negative floats are ordered as their bits are, read as whole numbers. The first pass counts the
upper 16 bits of each value, from which follows the bin in which a rank lies; the second counts the
lower 16 bits of the values in those bins. This is a radix selection, with the counts in place of
the values: Knuth, "The Art of Computer Programming", vol. 3, sections 5.2.5 and 5.3.3.

Values are rounded to float32, the precision in which errors are stored: 6e-8 of themselves.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from sweep.typing import Floats, Integers

UPPER, LOWER = 1 << 16, 1 << 16
"""How many values the upper and the lower half of the 32 bits can have."""


@dataclass(frozen=True, slots=True, eq=False)
class Tally:
    """How often each key occurs: ``keys`` (n,) increasing, ``counts`` (n,).

    A key is that of a value plus the value's group times ``GROUP_STRIDE``.
    """

    keys: Integers
    counts: Integers

    GROUP_STRIDE: ClassVar[int]

    @classmethod
    def of_keys(cls, keys: Integers) -> Self:
        """Return the tally of keys (m,), in any order."""
        return cls(*np.unique(keys, return_counts=True))

    def merge(self, other: Tally) -> Self:
        """Return the tally of both together."""
        keys, where = np.unique(np.concatenate([self.keys, other.keys]), return_inverse=True)
        counts = np.zeros(len(keys), dtype=np.int64)
        np.add.at(counts, where, np.concatenate([self.counts, other.counts]))
        return type(self)(keys, counts)

    @classmethod
    def interleave(cls, parts: Sequence[Self]) -> Self:
        """Return n tallies as one of n times as many groups: g of the k-th becomes g * n + k."""
        moved = []
        for k, part in enumerate(parts):
            group, rest = np.divmod(part.keys, cls.GROUP_STRIDE)
            moved.append(cls((group * len(parts) + k) * cls.GROUP_STRIDE + rest, part.counts))
        return functools.reduce(cls.merge, moved)


@dataclass(frozen=True, slots=True, eq=False)
class UpperTally(Tally):
    """The first pass: values by their upper 16 bits."""

    GROUP_STRIDE = UPPER

    @classmethod
    def of(cls, groups: Integers, values: Floats) -> Self:
        """Return the tally of non-negative values (m,) of groups (m,)."""
        return cls.of_keys(groups * UPPER + bits(values) // LOWER)

    def bins_of(self, groups: Integers, ranks: Integers) -> tuple[Integers, Integers]:
        """Return the bins (upper bits) in which ranks lie, and their ranks within the bins.

        All are of one shape. ``ranks`` count from 1 within a group, in increasing order of values;
        a rank that its group does not have gives the bin -1.
        """
        before = np.concatenate([[0], np.cumsum(self.counts)])
        first = np.searchsorted(self.keys, groups * UPPER)
        size = before[np.searchsorted(self.keys, (groups + 1) * UPPER)] - before[first]
        exists = (ranks >= 1) & (ranks <= size)
        target = before[first] + np.where(exists, ranks, 0)
        index = np.maximum(np.searchsorted(before, target) - 1, 0)
        bins = self.keys[index] if len(self.keys) else np.zeros_like(ranks)
        return np.where(exists, bins % UPPER, -1), np.where(exists, target - before[index], 0)


@dataclass(frozen=True, slots=True, eq=False)
class LowerTally(Tally):
    """The second pass: values in chosen bins, by all their bits."""

    GROUP_STRIDE = UPPER * LOWER

    @classmethod
    def of(cls, groups: Integers, values: Floats, bins: Integers) -> Self:
        """Return the tally of those values (m,) of groups (m,) that lie in their group's bins.

        ``bins`` are (groups, ...) as `UpperTally.bins_of` gives them.
        """
        by_group = np.arange(len(bins)).reshape(-1, *[1] * (bins.ndim - 1)) * UPPER + bins
        wanted = np.unique(by_group[bins >= 0])
        whole = bits(values)
        upper = groups * UPPER + whole // LOWER
        index = np.minimum(np.searchsorted(wanted, upper), len(wanted) - 1)
        inside = wanted[index] == upper if len(wanted) else np.zeros(len(upper), dtype=bool)
        return cls.of_keys(upper[inside] * LOWER + whole[inside] % LOWER)

    def values_at(self, groups: Integers, bins: Integers, ranks: Integers) -> Floats:
        """Return the values at ranks within bins, as `UpperTally.bins_of` gives both.

        NaN for the bin -1.
        """
        before = np.concatenate([[0], np.cumsum(self.counts)])
        first = (groups * UPPER + np.maximum(bins, 0)) * LOWER
        target = before[np.searchsorted(self.keys, first)] + ranks
        index = np.maximum(np.searchsorted(before, target) - 1, 0)
        keys = self.keys[index] if len(self.keys) else np.zeros_like(bins)
        whole = (keys % (UPPER * LOWER)).astype(np.uint32)
        return np.where(bins >= 0, whole.view(np.float32).astype(np.float64), np.nan)


def bits(values: Floats) -> Integers:
    """Return the bits of non-negative values, rounded to float32, as whole numbers."""
    with np.errstate(over="ignore"):  # above 3.4e38: infinite
        return np.abs(values).astype(np.float32).view(np.uint32).astype(np.int64)
