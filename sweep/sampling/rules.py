"""Which trials are needed, decided from committed results: waves and their rules."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from sweep.errors import StoreError
from sweep.experiment.grid import TRIAL, Block, Blocks
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.sampling import StoppingRule
from sweep.experiment.schema import VARIABLES
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

@dataclass(frozen=True, slots=True)
class Stopping:
    """A rule of stopping for one pipeline.

    Attributes
    ----------
    ends
        Numbers of trials at which waves end, increasing, multiples of the first; but the last one
        is ``max_trials``.
    variables
        The dataset's variables that it reads.
    coupled
        Names of the scene axes, not ``trial``, along which cells are decided together: those that
        are pooled, or searched along.
    needed
        Returns for each scene of a group whether it is needed, along the scene axes, of which
        ``trial`` has the length 1. It takes the group of the trials of earlier waves, and the
        values of `variables` there, in their own dimensions; trials of a scene that were not needed
        are flagged ``not_needed``, and NaN. It must be a function of the results alone, the same
        in every process, and of one value along an axis that is not coupled whatever the group's
        others are.
    """

    ends: tuple[int, ...]
    variables: tuple[str, ...]
    coupled: tuple[str, ...]
    needed: Callable[[Block, Mapping[str, NDArray[Any]]], Masks]


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
# How the blocks of a store make groups and waves.

@dataclass(frozen=True, slots=True)
class Waves:
    """The groups of a grid of blocks, and the waves of each.

    Attributes
    ----------
    blocks
        The grid, cut along ``trial`` so that every end but the last is an end of blocks.
    groups
        The same grid, cut as the blocks are, but neither along coupled axes nor along ``trial``:
        a box is a group.
    trial
        Position of ``trial`` among the scene axes.
    ends
        Numbers of trials at which waves end.
    """

    blocks: Blocks
    groups: Blocks
    trial: int
    ends: tuple[int, ...]

    @staticmethod
    def of(pipeline: Pipeline, rule: Stopping, blocks: Blocks) -> Waves:
        """Return the groups and waves of a pipeline's blocks; ValueError if they do not fit."""
        names = [axis.name for axis in pipeline.experiment.scene_axes]
        trial = names.index(TRIAL)
        if any(end % blocks.extents[trial] for end in rule.ends[:-1]):
            raise ValueError(f"blocks of {blocks.extents[trial]} trials, waves at {rule.ends}")
        extents = tuple(
            length if name == TRIAL or name in rule.coupled else extent
            for name, length, extent in zip(names, blocks.lengths, blocks.extents, strict=True))
        return Waves(blocks, Blocks(blocks.lengths, extents), trial, rule.ends)

    def numbers(self, group: int, first: int, last: int | None = None) -> list[int]:
        """Return the numbers of a group's blocks in the waves ``first`` to ``last``, from 0.

        ``last`` is ``first`` if it is left out; earlier trials come first.
        """
        start = self.ends[first - 1] if first else 0
        box = self.trials(self.groups[group], start, self.ends[first if last is None else last])
        places = np.ix_(*(np.arange(start // extent, -(-stop // extent)) for start, stop, extent in
                          zip(box.starts, box.stops, self.blocks.extents, strict=True)))
        numbers = np.moveaxis(np.ravel_multi_index(places, self.blocks.counts), self.trial, 0)
        return [int(number) for number in numbers.flat]

    def trials(self, box: Block, start: int, stop: int) -> Block:
        """Return a box with other trials."""
        starts, stops = [*box.starts], [*box.stops]
        starts[self.trial], stops[self.trial] = start, stop
        return Block(tuple(starts), tuple(stops))


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
    store
        The store.
    rule, waves
        The rule, and the waves of the store's blocks.
    """

    store: RunStore
    rule: Stopping
    waves: Waves
    #: The bases of each group's last decision, and its mask: other blocks of a wave ask, too.
    _decided: dict[int, tuple[tuple[int, ...], Masks]] = field(default_factory=dict)

    @staticmethod
    def of(store: RunStore, rule: StoppingRule) -> Decider:
        """Return the decider by a rule on the blocks of a store."""
        pipeline = replace(store.pipeline, stopping=rule)
        sampling = make_rule(pipeline)
        assert sampling is not None  # noqa: S101  (there is a rule)
        return Decider(store, sampling, Waves.of(pipeline, sampling, store.blocks))

    def needed(self, block: Block, decision: Decision) -> Masks:
        """Return for each of a block's scenes (N,) whether it is needed.

        Raises
        ------
        StoreError
            If results of an earlier wave are missing.
        """
        if decision.settled:
            return np.zeros(len(block), dtype=bool)
        group = self.waves.groups.number(block)
        mask = self.of_group(group, decision)
        within = self.waves.trials(block, 0, 1)
        part = mask[tuple(map(slice, *(
            np.subtract(ends, self.waves.groups[group].starts).tolist()
            for ends in (within.starts, within.stops))))]
        return np.broadcast_to(part, block.shape).reshape(-1)

    def of_group(self, group: int, decision: Decision) -> Masks:
        """Return for each scene of a group whether a wave needs it; ``trial`` has the length 1."""
        bases, mask = self._decided.get(group, ((), np.empty(0, dtype=bool)))
        if bases == decision.bases:
            return mask
        box = self.waves.trials(self.waves.groups[group], 0, self.waves.ends[decision.wave - 1])
        flags = _values(self.store, "detection", box)
        if (flags == DetectionStatus.not_run).any():
            raise StoreError(f"{self.store.url}: trials of group {box} are not committed")
        mask = np.array(self.rule.needed(
            box, {name: _values(self.store, name, box) for name in self.rule.variables}))
        # A part of which nothing was needed before is settled.
        before = _any_setting(self.store, flags != DetectionStatus.not_needed).take(
            [-1], axis=self.waves.trial)
        coupled = tuple(k for k, axis in enumerate(self.store.pipeline.experiment.scene_axes)
                        if axis.name in self.rule.coupled)
        mask &= before.any(axis=coupled, keepdims=True)
        self._decided[group] = decision.bases, mask
        return mask


def _values(store: RunStore, name: str, box: Block) -> NDArray[Any]:
    """Return a variable's values in a box of scenes, in its own dimensions."""
    variable = next(each for each in store.variables if each.name == name)
    return np.asarray(store.array(name)[region(variable, store.pipeline, box)])


def _any_setting(store: RunStore, masks: Masks) -> Masks:
    """Return where a mask of detections holds at any setting, along the scene axes."""
    scene = {axis.name for axis in store.pipeline.experiment.scene_axes}
    names = VARIABLES["detection"].dimensions(store.pipeline)
    return np.asarray(masks.any(axis=tuple(
        k for k, name in enumerate(names) if name not in scene)))


def scenes_needed(store: RunStore, block: Block) -> Masks:
    """Return which of a committed block's scenes (N,) were needed, as its flags say."""
    flags = _values(store, "detection", block)
    return _any_setting(store, flags != DetectionStatus.not_needed).reshape(-1)
