"""The check of a sample: scenes of sound blocks are recomputed and compared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import processor
from sweep.errors import SweepError
from sweep.evaluation.results import to_dataset_layout
from sweep.execution.limits import TIME_LIMIT_S
from sweep.integrity.damage import Damage, SampleDamage, SceneDamage
from sweep.integrity.stored_values import Values, computable, stored_scene
from sweep.integrity.tolerances import MAX_OUTSIDE, MIN_OUTSIDE, compare
from sweep.isolation.crash_isolation import run_cells_isolated
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.plan.cell_selection import selection_text
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import Block, scene_axes
from sweep.plan.parameters import Stage
from sweep.sampling.deciding import scenes_needed
from sweep.store.run_store import RunStore


@dataclass(slots=True)
class SampleFindings:
    """The result of the check.

    Attributes
    ----------
    count
        Scenes that were recomputed.
    reason
        Why none was, if none was.
    damage
        What is damaged.
    """

    count: int = 0
    reason: str = ""
    damage: list[Damage] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class _Scene:
    """A scene of the sample: number of its block, number within it, and its stored values."""

    block: int
    number: int
    stored: Values

    @property
    def crashed(self) -> bool:
        """Whether it ended its process when the store was made."""
        return bool(
            (self.stored["detection"] == DetectionStatus.crashed).any()
            or (self.stored["estimate"] == EstimateStatus.crashed).any()
        )


class SampleCheck:
    """Recomputes scenes of a store that are drawn at random."""

    def __init__(self, store: RunStore) -> None:
        self._store = store

    def run(
        self, count: int, sound: Mapping[int, str], needed: Mapping[int, int] | None = None
    ) -> SampleFindings:
        """Recompute up to ``count`` scenes, none of them one that was not needed.

        Parameters
        ----------
        count
            Scenes that are drawn, with replacement.
        sound
            Number of each sound block -> features of the processor that computed it.
        needed
            Number of each -> how many of its scenes were needed; all by default.
        """
        if not count:
            return SampleFindings(reason="a sample of 0 scenes was asked for")
        if not sound:
            return SampleFindings(reason="there is no sound block")
        try:
            pipeline = computable(self._store)
        except SweepError as error:
            return SampleFindings(reason=str(error).splitlines()[-1].strip())
        # Scenes whose process died are not tried again.
        sizes = needed or {number: len(self._store.blocks[number]) for number in sound}
        scenes = [scene for scene in self._drawn(count, sizes) if not scene.crashed]
        if not scenes:
            return SampleFindings(reason="every scene that was drawn had crashed")
        return self._compare(scenes, self._recomputed(pipeline, scenes), sound)

    def _drawn(self, count: int, needed: Mapping[int, int]) -> list[_Scene]:
        """Draw needed scenes, each with the same probability, without repetitions."""
        blocks = self._store.blocks
        generator = np.random.default_rng()
        sizes = np.array(list(needed.values()))
        numbers = generator.choice(np.array(list(needed)), size=count, p=sizes / sizes.sum())
        drawn = {
            (number, int(generator.choice(self._needed(number))) if needed[number] < len(
                blocks[number]) else int(generator.integers(len(blocks[number]))))
            for number in numbers.tolist()
        }
        return [_Scene(*each, stored_scene(self._store, *each)) for each in sorted(drawn)]

    def _needed(self, number: int) -> NDArray[np.intp]:
        """Return the numbers of a block's scenes that were needed."""
        return np.flatnonzero(scenes_needed(self._store, self._store.blocks[number]))

    def _recomputed(self, pipeline: Pipeline, scenes: list[_Scene]) -> list[Values]:
        """Recompute scenes; return their values with scene axes of length 1."""
        blocks = self._store.blocks
        cells = [blocks[scene.block].cell(scene.number) for scene in scenes]
        indices = [np.array(index, dtype=np.intp) for index in zip(*cells, strict=True)]
        shape = (len(scenes), pipeline.size(Stage.detection), pipeline.size(Stage.estimation))
        computed = run_cells_isolated(pipeline, indices, np.ones(shape, dtype=bool), TIME_LIMIT_S)
        axes = scene_axes(pipeline)
        block = Block((0,) * len(axes), (1,) * len(axes))
        return [
            {
                variable.name: to_dataset_layout(
                    variable, pipeline, block,
                    [column[row : row + 1] for column in computed.columns[variable.name]],
                )
                for variable in self._store.variables
            }
            for row in range(len(scenes))
        ]

    def _compare(
        self, scenes: list[_Scene], recomputed: list[Values], sound: Mapping[int, str]
    ) -> SampleFindings:
        findings = SampleFindings(count=len(scenes))
        other_processor = 0
        outside: list[str] = []
        for scene, values in zip(scenes, recomputed, strict=True):
            same_processor = sound[scene.block] == processor()
            other_processor += not same_processor
            comparison = compare(
                values, scene.stored, self._store.variables, same_processor=same_processor
            )
            at = self._at(scene)
            if comparison.departure:
                findings.damage.append(SceneDamage(
                    at, f"recomputed, it differs: {comparison.departure}", scene.block
                ))
            if comparison.outside:
                outside.append(f"--at {at}: {comparison.outside}")
        if len(outside) > max(MIN_OUTSIDE, MAX_OUTSIDE * other_processor):
            findings.damage.append(SampleDamage(
                f"{len(outside)} of {other_processor} scenes that another processor computed "
                f"differ beyond the tolerances, such as {outside[0]}"
            ))
        return findings

    def _at(self, scene: _Scene) -> str:
        index = self._store.blocks[scene.block].cell(scene.number)
        return selection_text({
            axis.name: axis.values[k]
            for axis, k in zip(scene_axes(self._store.pipeline), index, strict=True)
        })
