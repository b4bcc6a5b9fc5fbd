"""What a rule of stopping is: a pure function of the results of the trials of earlier waves.

Trials come in waves that end at fixed numbers, ``ends``. Before each wave but the first, which is
computed whole, a rule says for every scene of a group whether the wave's trials of it are needed.
All configurations of a needed scene are computed, so that they stay paired.

A group is what is decided together: all cells along the ``coupled`` axes, and for the sake of
speed some values of the others, which must not influence each other. A part of a group of which no
cell is needed in a wave is settled for good.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from numpy.typing import NDArray

from sweep.plan.axes import TRIAL, Axis
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import scene_axes
from sweep.plan.wave_ends import wave_ends
from sweep.typing import Masks

__all__ = ["GroupResults", "Stopping", "block_unit", "condition_axes", "unit_of", "wave_ends"]

FIRST_DRAWS = 50
"""Draws of a condition in the first wave, about: all pooled cells together."""


def unit_of(pooled: int) -> int:
    """Return the trials in the unit of waves where a condition pools so many cells.

    >>> unit_of(1), unit_of(12), unit_of(500)
    (50, 5, 1)
    """
    return max(1, math.ceil(FIRST_DRAWS / pooled))


def block_unit(ends: Sequence[int]) -> int:
    """Return the largest number of trials that divides the ends of all waves but the last.

    >>> block_unit((50, 100, 120)), block_unit((30,))
    (50, 30)
    """
    return math.gcd(*ends[:-1]) if len(ends) > 1 else ends[0]


def condition_axes(pipeline: Pipeline) -> tuple[Axis, ...]:
    """Return the axes of the scene except ``trial``, in the pipeline's order."""
    return tuple(axis for axis in scene_axes(pipeline) if axis.name != TRIAL)


@dataclass(frozen=True, slots=True)
class GroupResults:
    """The results of a group of scenes, of all trials of earlier waves.

    Attributes
    ----------
    pipeline
        The experiment.
    starts, stops
        The group's half-open ranges of indices along `condition_axes`: whole along coupled ones.
    wave
        Number of the wave that is decided, from 1.
    trials
        Trials of the earlier waves: ``ends[wave - 1]``.
    values
        Variable -> values in the dimensions (condition axes, trial, detection axes, estimation
        axes, inner), as far as the variable has them. Trials of a scene that were not needed are
        flagged ``not_needed``, and NaN.
    """

    pipeline: Pipeline
    starts: tuple[int, ...]
    stops: tuple[int, ...]
    wave: int
    trials: int
    values: Mapping[str, NDArray[Any]]

    @property
    def shape(self) -> tuple[int, ...]:
        """Lengths of the group along `condition_axes`."""
        return tuple(b - a for a, b in zip(self.starts, self.stops, strict=True))


class Stopping(Protocol):
    """A rule of stopping for one pipeline; a frozen dataclass may have the properties as fields.

    Modules of rules are imported when a run starts: what is slow to import is imported in `needed`.
    """

    @property
    def ends(self) -> tuple[int, ...]:
        """Numbers of trials at which waves end, increasing; the last one is ``max_trials``."""

    @property
    def variables(self) -> tuple[str, ...]:
        """The dataset's variables that it reads."""

    @property
    def coupled(self) -> tuple[str, ...]:
        """Names of the scene axes, not ``trial``, along which cells are decided together.

        Those that are pooled, or searched along.
        """

    def needed(self, results: GroupResults) -> Masks:
        """Return for each scene of a group, shape ``results.shape``, whether it is needed.

        It must be a function of the results alone, the same in every process, and of one value
        along an axis that is not coupled whatever the group's others are.
        """
