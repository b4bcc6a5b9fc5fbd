"""Which trials are needed, decided from committed results: waves and their rules."""

from __future__ import annotations

import dataclasses
import importlib
import math
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from sweep.errors import StoreError
from sweep.experiment.grid import TRIAL, Axis, Block, Blocks
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.sampling import StoppingRule
from sweep.experiment.schema import VARIABLES, Variable
from sweep.measure.flags import DetectionStatus
from sweep.store.blocks import RunStore, region
from sweep.typing import Masks

# --------------------------------------------------------------------------------------------------
# A rule of stopping is a pure function of the results of the trials of earlier waves.
#
# Trials come in waves that end at fixed numbers, ``ends``. Before each wave but the first, which
# is computed whole, a rule says for every scene of a group whether the wave's trials of it are
# needed. All configurations of a needed scene are computed, so that they stay paired.
#
# A group is decided as one: all cells along the ``coupled`` axes, and for the sake of
# speed some values of the others, which must not influence each other. A part of a group of which
# no cell is needed in a wave is settled for good.

def block_unit(ends: Sequence[int]) -> int:
    """Return the largest number of trials that divides the ends of all waves but the last.

    >>> block_unit((50, 100, 120)), block_unit((30,))
    (50, 30)
    """
    return math.gcd(*ends[:-1]) if len(ends) > 1 else ends[0]


def condition_axes(pipeline: Pipeline) -> tuple[Axis, ...]:
    """Return the axes of the scene except ``trial``, in the pipeline's order."""
    return tuple(axis for axis in pipeline.experiment.scene_axes if axis.name != TRIAL)


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


@dataclass(frozen=True, slots=True)
class Stopping:
    """A rule of stopping for one pipeline.

    Attributes
    ----------
    ends
        Numbers of trials at which waves end, increasing; the last one is ``max_trials``.
    variables
        The dataset's variables that it reads.
    coupled
        Names of the scene axes, not ``trial``, along which cells are decided together: those that
        are pooled, or searched along.
    needed
        Returns for each scene of a group, shape ``results.shape``, whether it is needed. It must be
        a function of the results alone, the same in every process, and of one value along an axis
        that is not coupled whatever the group's others are.
    """

    ends: tuple[int, ...]
    variables: tuple[str, ...]
    coupled: tuple[str, ...]
    needed: Callable[[GroupResults], Masks]


# --------------------------------------------------------------------------------------------------
# How the blocks of a store make groups and waves.

@dataclass(frozen=True, slots=True)
class Waves:
    """The groups of a grid of blocks, and the waves of each.

    A group is all blocks that share their cut of the axes that are neither coupled nor ``trial``.

    Attributes
    ----------
    blocks
        The grid, cut along ``trial`` so that every end but the last is an end of blocks.
    trial
        Position of ``trial`` among the scene axes.
    coupled
        Positions of the coupled axes.
    ends
        Numbers of trials at which waves end.
    """

    blocks: Blocks
    trial: int
    coupled: tuple[int, ...]
    ends: tuple[int, ...]

    @staticmethod
    def of(pipeline: Pipeline, rule: Stopping, blocks: Blocks) -> Waves:
        """Return the groups and waves of a pipeline's blocks; ValueError if they do not fit."""
        names = [axis.name for axis in pipeline.experiment.scene_axes]
        trial = names.index(TRIAL)
        if any(end % blocks.extents[trial] for end in rule.ends[:-1]):
            raise ValueError(f"blocks of {blocks.extents[trial]} trials, waves at {rule.ends}")
        coupled = tuple(k for k, name in enumerate(names) if name in rule.coupled)
        return Waves(blocks, trial, coupled, rule.ends)

    @property
    def free(self) -> tuple[int, ...]:
        """Positions of the axes that are neither coupled nor ``trial``."""
        return tuple(
            k for k in range(len(self.blocks.lengths)) if k not in self.coupled and k != self.trial
        )

    @property
    def groups(self) -> int:
        """The number of groups."""
        counts = self.blocks.counts
        return math.prod(counts[k] for k in self.free)

    def index(self, number: int) -> tuple[int, ...]:
        """Return a block's index along each scene axis."""
        return tuple(map(int, np.unravel_index(number, self.blocks.counts)))

    def group(self, number: int) -> int:
        """Return the number of the group that a block belongs to."""
        index, counts = self.index(number), self.blocks.counts
        return int(np.ravel_multi_index([index[k] for k in self.free] or [0],
                                        [counts[k] for k in self.free] or [1]))

    def wave(self, number: int) -> int:
        """Return the number of the wave that a block belongs to, from 0."""
        start = self.index(number)[self.trial] * self.blocks.extents[self.trial]
        return bisect_right(self.ends, start)

    def numbers(self, group: int, first: int, last: int | None = None) -> Iterator[int]:
        """Yield the numbers of a group's blocks in the waves ``first`` to ``last``.

        ``last`` is ``first`` if it is left out; earlier trials come first.
        """
        counts, extent = self.blocks.counts, self.blocks.extents[self.trial]
        at = np.unravel_index(group, [counts[k] for k in self.free] or [1])
        start = self.ends[first - 1] // extent if first else 0
        stop = -(-self.ends[first if last is None else last] // extent)
        ranges = {k: range(counts[k]) for k in self.coupled} | {
            k: range(int(position), int(position) + 1)
            for k, position in zip(self.free, at, strict=False)}
        for trial in range(start, stop):
            whole = ranges | {self.trial: range(trial, trial + 1)}
            for index in product(*(whole[k] for k in range(len(counts)))):
                yield int(np.ravel_multi_index(index, counts))

    def span(self, block: Block) -> Block:
        """Return the box of a block's group, of all its trials."""
        whole = {*self.coupled, self.trial}
        lengths = self.blocks.lengths
        return Block(
            tuple(0 if k in whole else start for k, start in enumerate(block.starts)),
            tuple(lengths[k] if k in whole else stop for k, stop in enumerate(block.stops)),
        )


# --------------------------------------------------------------------------------------------------
# The rule that samples, by what the pipeline says.

def make_rule(pipeline: Pipeline) -> Stopping | None:
    """Return the rule by which a pipeline's sampling stops; None if every trial is computed.

    Raises
    ------
    PipelineError
        One line for each fault of the section that only the rule knows.
    """
    if pipeline.stopping is None:
        return None
    # Imported here: runs of fixed trials need no SciPy.
    searches = importlib.import_module("sweep.sampling.searches")
    return cast("Stopping", searches.search_rule(pipeline, pipeline.stopping))


# --------------------------------------------------------------------------------------------------
# Which scenes of a block are needed: a rule applied to the committed blocks of earlier waves.

@dataclass(frozen=True, slots=True)
class Decision:
    """Inputs that determine a block's scenes.

    Attributes
    ----------
    rule
        The content of the pipeline's section.
    wave
        The number of the block's wave, from 1.
    bases
        For each wave from 1 to the block's own, a digest of the rule and of the results before
        it: two decisions on the same bases are the same.
    settled
        Whether nothing was needed in an earlier wave, so that nothing is.
    """

    rule: StoppingRule
    wave: int
    bases: tuple[int, ...]
    settled: bool = False

    @property
    def basis(self) -> int:
        """The digest of the rule and of all results that the decision follows from."""
        return self.bases[-1]


@dataclass(slots=True)
class Decider:
    """Applies a rule to a store's committed results.

    Attributes
    ----------
    store, pipeline
        The store, and its pipeline with the section of the rule.
    rule, waves
        The rule, and the waves of the store's blocks.
    """

    store: RunStore
    pipeline: Pipeline
    rule: Stopping
    waves: Waves
    #: The bases of each group's last decision, and its mask: other blocks of a wave ask, too.
    _decided: dict[Block, tuple[tuple[int, ...], Masks]] = field(default_factory=dict)

    @staticmethod
    def of(store: RunStore, rule: StoppingRule) -> Decider:
        """Return the decider by a rule on the blocks of a store."""
        pipeline = dataclasses.replace(store.pipeline, stopping=rule)
        sampling = make_rule(pipeline)
        if sampling is None:
            raise TypeError(rule)
        return Decider(store, pipeline, sampling, Waves.of(pipeline, sampling, store.blocks))

    def needed(self, block: Block, decision: Decision) -> Masks:
        """Return for each of a block's scenes (N,) whether it is needed.

        Raises
        ------
        StoreError
            If results of an earlier wave are missing.
        """
        if decision.settled:
            return np.zeros(len(block), dtype=bool)
        whole = self.of_group(self.waves.span(block), decision)
        trial = self.waves.trial
        part = tuple(
            slice(start - first, stop - first)
            for k, (start, stop, first) in enumerate(zip(
                block.starts, block.stops, self.waves.span(block).starts, strict=True
            )) if k != trial
        )
        mask = np.expand_dims(whole[part], trial)
        return np.broadcast_to(mask, block.shape).reshape(-1)

    def of_group(self, span: Block, decision: Decision) -> Masks:
        """Return for each scene of a group, along the condition axes, whether a wave needs it."""
        bases, mask = self._decided.get(span, ((), np.empty(0, dtype=bool)))
        if bases == decision.bases:
            return mask
        last = self.waves.ends[decision.wave - 1]
        values = {name: self._read(name, span, last)
                  for name in dict.fromkeys(("detection", *self.rule.variables))}
        if (values["detection"] == DetectionStatus.not_run).any():
            raise StoreError(
                f"{self.store.url}: trials below {last} of group {span} are not committed")
        kept = [k for k in range(len(span.starts)) if k != self.waves.trial]
        results = GroupResults(
            self.pipeline,
            tuple(span.starts[k] for k in kept), tuple(span.stops[k] for k in kept),
            decision.wave, last, {name: values[name] for name in self.rule.variables},
        )
        mask = np.array(self.rule.needed(results), dtype=bool)
        if mask.shape != results.shape:
            raise ValueError(f"a rule gave {mask.shape} for scenes {results.shape}")
        mask &= ~self._settled(values["detection"], kept)
        self._decided[span] = decision.bases, mask
        return mask

    def _settled(self, detection: NDArray[Any], kept: list[int]) -> Masks:
        """Return which scenes are settled: nothing along the coupled axes was needed before."""
        last = np.take(detection, -1, axis=len(kept))
        unneeded = (last == DetectionStatus.not_needed).reshape((*last.shape[: len(kept)], -1))
        coupled = tuple(at for at, k in enumerate(kept) if k in self.waves.coupled)
        settled = unneeded.all(axis=-1).all(axis=coupled, keepdims=True)
        return np.asarray(settled)

    def _read(self, name: str, span: Block, last: int) -> NDArray[Any]:
        """Return a variable's values of the trials below ``last``, as `GroupResults` has them."""
        pipeline, trial = self.pipeline, self.waves.trial
        variable = next(each for each in self.store.variables if each.name == name)
        stops = tuple(last if k == trial else stop for k, stop in enumerate(span.stops))
        part = region(variable, pipeline, Block(span.starts, stops))
        names, order = variable.dimensions(pipeline), result_dimensions(pipeline, variable)
        return np.asarray(self.store.array(name)[part]).transpose(
            [names.index(each) for each in order])


def result_dimensions(pipeline: Pipeline, variable: Variable) -> list[str]:
    """Return the dimensions of a variable's values in `GroupResults`, in their order."""
    names = variable.dimensions(pipeline)
    order = [
        *(axis.name for axis in condition_axes(pipeline)), TRIAL,
        *(axis.name for stage in (Stage.detection, Stage.estimation)
          for axis in pipeline.axes_of(stage)), *variable.inner,
    ]
    return [name for name in order if name in names]


def scenes_needed(store: RunStore, block: Block) -> Masks:
    """Return which of a committed block's scenes (N,) were needed, as its flags say."""
    variable, pipeline = VARIABLES["detection"], store.pipeline
    values = np.asarray(store.array(variable.name)[region(variable, pipeline, block)])
    names = variable.dimensions(pipeline)
    scene = [names.index(axis.name) for axis in pipeline.experiment.scene_axes]
    needed = values != DetectionStatus.not_needed
    settings = tuple(k for k in range(len(names)) if k not in scene)
    whole = needed.all(axis=settings, keepdims=True)
    return np.asarray(whole.transpose([*scene, *settings]).reshape(-1))
