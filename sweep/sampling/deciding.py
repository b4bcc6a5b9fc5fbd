"""Which scenes of a block are needed: a rule applied to what is committed of earlier waves."""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import StoreError
from sweep.measure.flags import DetectionStatus
from sweep.plan.axes import TRIAL
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import Block, scene_axes
from sweep.plan.parameters import Stage
from sweep.plan.schema import VARIABLES
from sweep.plan.stopping import StoppingRule
from sweep.plan.variable import Variable
from sweep.sampling.rules import make_rule
from sweep.sampling.stopping import GroupResults, Stopping
from sweep.sampling.waves import Waves
from sweep.store.blocks import region
from sweep.store.chunk_reading import read_part
from sweep.store.run_store import RunStore
from sweep.typing import Masks

HELD_BYTES = 200_000_000
"""Results of groups that a process keeps, so that each wave reads only the one before it."""


@dataclass(frozen=True, slots=True)
class Decision:
    """What the scenes of a block follow from.

    Attributes
    ----------
    rule
        What the pipeline's section says.
    wave
        The number of the block's wave, from 1.
    bases
        For each wave from 1 to that of the block, a digest of the rule and of the results before
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
class _Held:
    """Values of a group: those of the waves before the last of ``bases``, and what they decide."""

    bases: tuple[int, ...]
    values: dict[str, NDArray[Any]]
    needed: Masks | None = None

    @property
    def bytes(self) -> int:
        return sum(values.nbytes for values in self.values.values())


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
    _held: OrderedDict[tuple[int, ...], _Held] = field(default_factory=OrderedDict)

    @staticmethod
    def of(store: RunStore, rule: StoppingRule) -> Decider:
        """Return what decides by a rule on the blocks of a store."""
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
        held = self._held.get(span.starts)
        if held is not None and held.bases == decision.bases and held.needed is not None:
            return held.needed  # of another block of the wave
        values = self._values(span, decision)
        kept = [k for k in range(len(span.starts)) if k != self.waves.trial]
        results = GroupResults(
            self.pipeline,
            tuple(span.starts[k] for k in kept), tuple(span.stops[k] for k in kept),
            decision.wave, self.waves.ends[decision.wave - 1],
            {name: values[name] for name in self.rule.variables},
        )
        mask = np.array(self.rule.needed(results), dtype=bool)
        if mask.shape != results.shape:
            raise ValueError(f"a rule gave {mask.shape} for scenes {results.shape}")
        mask &= ~self._settled(values["detection"], kept)
        if span.starts in self._held:
            self._held[span.starts].needed = mask
        return mask

    def _settled(self, detection: NDArray[Any], kept: list[int]) -> Masks:
        """Return which scenes are settled: nothing along the coupled axes was needed before."""
        last = np.take(detection, -1, axis=len(kept))
        unneeded = (last == DetectionStatus.not_needed).reshape((*last.shape[: len(kept)], -1))
        coupled = tuple(at for at, k in enumerate(kept) if k in self.waves.coupled)
        settled = unneeded.all(axis=-1).all(axis=coupled, keepdims=True)
        return np.asarray(settled)

    def _values(self, span: Block, decision: Decision) -> Mapping[str, NDArray[Any]]:
        """Return the values of a group before a wave, of the rule's variables and of detection."""
        held = self._held.pop(span.starts, None)
        at = 0 if held is None else len(held.bases)
        if held is None or held.bases != decision.bases[:at]:
            held, at = _Held((), {}), 0
        names = dict.fromkeys(("detection", *self.rule.variables))
        first = self.waves.ends[at - 1] if at else 0
        last = self.waves.ends[decision.wave - 1]
        if first < last:
            axis = len(span.starts) - 1
            for name in names:
                new = self._read(name, span, first, last)
                held.values[name] = (
                    np.concatenate([held.values[name], new], axis=axis) if at else new
                )
            if (held.values["detection"] == DetectionStatus.not_run).any():
                raise StoreError(
                    f"{self.store.url}: trials below {last} of group {span} are not committed"
                )
        held.bases, held.needed = decision.bases, None
        self._held[span.starts] = held
        while len(self._held) > 1 and sum(e.bytes for e in self._held.values()) > HELD_BYTES:
            self._held.popitem(last=False)
        return held.values

    def _read(self, name: str, span: Block, first: int, last: int) -> NDArray[Any]:
        """Return a variable's values of trials [first, last) in the dimensions of the results."""
        pipeline, trial = self.pipeline, self.waves.trial
        variable = next(each for each in self.store.variables if each.name == name)
        starts = tuple(first if k == trial else start for k, start in enumerate(span.starts))
        stops = tuple(last if k == trial else stop for k, stop in enumerate(span.stops))
        part = region(variable, pipeline, Block(starts, stops))
        return in_order_of_results(pipeline, variable, read_part(self.store, name, part))


def in_order_of_results(
    pipeline: Pipeline, variable: Variable, values: NDArray[Any]
) -> NDArray[Any]:
    """Return values in the dataset's dimensions in those of `GroupResults`."""
    names = variable.dimensions(pipeline)
    scene = [axis.name for axis in scene_axes(pipeline) if axis.name != TRIAL]
    order = [
        *scene, TRIAL,
        *(axis.name for axis in pipeline.axes_of(Stage.detection)),
        *(axis.name for axis in pipeline.axes_of(Stage.estimation)), *variable.inner,
    ]
    return values.transpose([names.index(each) for each in order if each in names])


def by_scene(
    variable: Variable, pipeline: Pipeline, block: Block, values: NDArray[Any]
) -> NDArray[Any]:
    """Return a block's values of a variable in the dimensions (N, configurations)."""
    names = variable.dimensions(pipeline)
    scene = [axis.name for axis in scene_axes(pipeline)]
    order = [*(names.index(name) for name in scene),
             *(k for k, name in enumerate(names) if name not in scene)]
    return values.transpose(order).reshape(len(block), -1)


def scenes_needed(store: RunStore, block: Block) -> Masks:
    """Return which of a committed block's scenes (N,) were needed, as its flags say."""
    variable, pipeline = VARIABLES["detection"], store.pipeline
    values = np.asarray(store.array(variable.name)[region(variable, pipeline, block)])
    flags = by_scene(variable, pipeline, block, values)
    return np.asarray((flags != DetectionStatus.not_needed).all(axis=1))
