"""A statistic of poses as a record: two passes over every block, and the variables they give.

Poses come in blocks, arrays (groups, cells, draws, settings): the settings of a draw see the same
images, so that together they count as one draw. A statistic passes over every block twice; it
keeps states of a block, which merge (`sweep.analysis.states`).

All intervals are at 95 %, over the random draws, conditional on the grid; NaN if no cell has two
draws that count.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Generic, TypeVar

from numpy.typing import NDArray

from sweep.analysis.states import BlockState, Nothing, State
from sweep.plan.variable import cf_attributes

ViewT = TypeVar("ViewT")
FirstT = TypeVar("FirstT", bound=State)
KnownT = TypeVar("KnownT", bound=State)
SecondT = TypeVar("SecondT", bound=State)

Variables = dict[str, NDArray[Any]]
"""Values of variables (groups,), by name."""

OVER_ALL = (1, 2, 3)
"""Axes of cells, draws and settings."""


@dataclass(frozen=True)
class Output:
    """A variable that a statistic gives."""

    name: str
    meaning: str
    units: str
    dtype: str = "f8"
    flags: type[IntEnum] | None = None

    def attributes(self) -> dict[str, Any]:
        """Return its attributes."""
        return cf_attributes(self.meaning, self.units, self.flags)


def with_interval(name: str, meaning: str, units: str) -> list[Output]:
    """Return a variable and the ends of its interval."""
    return [
        Output(name, meaning, units),
        Output(f"{name}_low", f"lower end of the 95 % interval: {meaning}", units),
        Output(f"{name}_high", f"upper end of the 95 % interval: {meaning}", units),
    ]


def interval_variables(name: str, interval: Sequence[NDArray[Any]]) -> Variables:
    """Return a value and the ends of its interval, (value, low, high), by name."""
    return dict(zip((name, f"{name}_low", f"{name}_high"), interval, strict=True))


class Statistic(ABC, Generic[ViewT, FirstT, KnownT, SecondT]):
    """What is computed of poses, in two passes over every block.

    Generic over the view of a block's poses, over the merged states of the first and second pass,
    and over what the second pass must know of the first.
    """

    @abstractmethod
    def outputs(self) -> Sequence[Output]:
        """Return the variables that it gives."""

    @abstractmethod
    def first_pass(self, poses: ViewT) -> BlockState[FirstT]:
        """Return the state of a block."""

    @abstractmethod
    def prepare_second(self, first: FirstT) -> KnownT:
        """Return what the second pass needs, from the state of all blocks."""

    @abstractmethod
    def second_pass(self, poses: ViewT, known: KnownT) -> BlockState[SecondT]:
        """Return the state of a block, whose groups ``known`` has."""

    @abstractmethod
    def finish(self, known: KnownT, second: SecondT) -> Variables:
        """Return the variables, each (groups,)."""


class SinglePass(Statistic[ViewT, FirstT, FirstT, Nothing]):
    """A statistic of a single pass; if all are so the second pass is left out."""

    @abstractmethod
    def result(self, state: FirstT) -> Variables:
        """Return the variables, each (groups,)."""

    def prepare_second(self, first: FirstT) -> FirstT:
        """Return the state of all blocks."""
        return first

    def second_pass(self, poses: ViewT, known: FirstT) -> Nothing:  # noqa: ARG002
        """Return nothing."""
        return Nothing()

    def finish(self, known: FirstT, second: Nothing) -> Variables:  # noqa: ARG002
        """Return the variables, each (groups,)."""
        return self.result(known)
