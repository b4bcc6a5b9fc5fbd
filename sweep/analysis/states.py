"""States: what a statistic keeps of a block of poses, and how those of several blocks merge.

A state is a frozen dataclass whose first axis runs over the groups. That of a block may also hold
values of each cell, (groups, cells): it is merged over the blocks that share the cells (other
draws), then folded to a state of the groups alone, and that is merged over the other blocks.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np

from sweep.analysis.groups import interleaved, scattered, sum_of_settings
from sweep.analysis.moments import Moments
from sweep.typing import Floats, Integers, Masks

F_co = TypeVar("F_co", bound="State", covariant=True)


class Part(Protocol):
    """A value of a state that is not an array of sums: `Moments`, a `Tally`, another state."""

    def merge(self, other: Self) -> Self:
        """Return the value of the poses of both."""
        ...

    @staticmethod
    def interleave(parts: Sequence[Any]) -> Any:
        """Return the value of the groups of all, those of the last index fastest."""
        ...


@dataclass(frozen=True)
class State:
    """Base of all states: fields are arrays (groups, ...) that add up, or a `Part`."""

    def merge(self, other: Self) -> Self:
        """Return the state of the poses of both, of the same groups."""
        return type(self)(*map(_merge, self._values(), other._values()))

    @classmethod
    def interleave(cls, states: Sequence[Self]) -> Self:
        """Return n states of as many groups each as one; the n of a group stand together."""
        if len(states) == 1:
            return states[0]
        return cls(*map(_interleave, zip(*map(cls._values, states), strict=True)))

    def every_nth(self, n: int, first: int) -> Self:
        """Return the state of the groups ``first``, ``first + n`` and so on."""
        if n == 1:
            return self
        return type(self)(*(
            value[first::n] if isinstance(value, np.ndarray) else value.every_nth(n, first)
            for value in self._values()))

    def scatter(self, where: Masks) -> Self:
        """Return the state of some cells as that of all; ``where`` (cells,) marks those."""
        return type(self)(*(
            value.scatter(where) if isinstance(value, State) else value
            for value in self._values()))

    def _values(self) -> list[Any]:
        # The names of the fields; `dataclasses.fields` takes longer than to merge a small state.
        names: tuple[str, ...] = self.__match_args__
        return [getattr(self, name) for name in names]


def _merge(a: Any, b: Any) -> Any:
    return a + b if isinstance(a, np.ndarray) else a.merge(b)


def _interleave(values: Sequence[Any]) -> Any:
    first = values[0]
    return interleaved(values) if isinstance(first, np.ndarray) else type(first).interleave(values)


@dataclass(frozen=True)
class BlockState(State, Generic[F_co]):
    """State of a block, whose values of cells are still apart."""

    @abstractmethod
    def fold(self) -> F_co:
        """Return the state of the groups, the values of their cells put together."""


@dataclass(frozen=True)
class Nothing(BlockState["Nothing"]):
    """State of a pass that is not needed."""

    def fold(self) -> Nothing:
        """Return itself."""
        return self


# Draws.

@dataclass(frozen=True)
class CellDraws(State):
    """How many draws of each cell have a pose that counts."""

    draws: Integers  # (groups, cells)

    @classmethod
    def of(cls, settings: Integers) -> Self:
        """Return that of the number of settings that count, (groups, cells, draws)."""
        return cls((settings > 0).sum(axis=2))

    def scatter(self, where: Masks) -> Self:
        """Return the state of some cells as that of all."""
        return type(self)(scattered(self.draws, where))

    def freedom(self) -> Integers:
        """Return the degrees of freedom (groups,): the draws beyond the first of each cell."""
        return np.asarray(np.maximum(self.draws - 1, 0).sum(axis=1))


@dataclass(frozen=True)
class Sample(State):
    """The poses that count, and the draws that they are of; each (groups,)."""

    n: Integers  # poses, times pooled settings
    squares: Floats  # sum over the draws of the squared number of settings that count
    freedom: Integers  # draws beyond the first of each cell

    @property
    def draws(self) -> Integers:
        """Number of draws that the poses are worth.

        That is the number of draws with a pose that counts if each has equally many of them; else
        it is less, for those with more of them count more: the effective sample size,
        (Σ m)² / Σ m² of m poses a draw, rounded down (Kish, "Survey Sampling", 1965, section 11.7).
        """
        worth = self.n.astype(np.float64)**2 / np.maximum(self.squares, 1.0)
        return np.asarray(np.floor(worth * (1.0 + 1e-12)), dtype=np.int64)

    @property
    def drawn(self) -> Masks:
        """Whether any cell has two draws, so that intervals exist."""
        return np.asarray(self.freedom > 0)


@dataclass(frozen=True)
class BlockSample(BlockState[Sample]):
    """The poses of a block that count, and the draws of each cell that they are of."""

    n: Integers
    squares: Floats
    cells: CellDraws

    @classmethod
    def of(cls, used: Masks) -> Self:
        """Return that of the poses that count, (groups, cells, draws, settings)."""
        settings = sum_of_settings(used)
        squares = np.square(settings, dtype=np.float64).sum(axis=(1, 2))
        return cls(settings.sum(axis=(1, 2)), squares, CellDraws.of(settings))

    def fold(self) -> Sample:
        """Return the sample of all cells."""
        return Sample(self.n, self.squares, self.cells.freedom())


# Spread of draws within cells.

@dataclass(frozen=True)
class Spread(State):
    """Sums over cells from which the error of a mean follows; each (groups,).

    `sweep.analysis.mean_intervals.estimate_mean` uses them.
    """

    variance: Floats  # sum over the cells of n_c s_c², s_c² being the variance within the cell
    squares: Floats  # sum of its terms' squares over their degrees of freedom + 2
    single: Integers  # cells with a single draw
    m2: Floats  # sum of squared deviations from the cells' means
    freedom: Floats  # its degrees of freedom


@dataclass(frozen=True)
class CellDeviations(BlockState[Spread]):
    """Moments (groups, cells) of the draws' deviations from the mean of all."""

    within: Moments

    def scatter(self, where: Masks) -> Self:
        """Return the state of some cells as that of all."""
        w = self.within
        return type(self)(Moments(
            scattered(w.count, where), scattered(w.mean, where, np.nan),
            scattered(w.mean_tail, where), scattered(w.m2, where)))

    def fold(self) -> Spread:
        """Return the sums over the cells."""
        repeated = self.within.count > 1
        freedom = np.where(repeated, self.within.count - 1.0, 0.0)
        m2 = np.where(repeated, self.within.m2, 0.0)
        with np.errstate(all="ignore"):
            terms = (freedom + 1.0) * m2 / np.maximum(freedom, 1.0)
            return Spread(
                terms.sum(axis=1), (terms**2 / (freedom + 2.0)).sum(axis=1),
                (self.within.count == 1).sum(axis=1), m2.sum(axis=1), freedom.sum(axis=1))
