"""The check of failures: scenes that failed are recomputed, since a machine may have been at fault.

A scene that ended its process is recomputed only if a signal from outside did so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sweep.errors import SweepError
from sweep.execution.limits import TIME_LIMIT_S
from sweep.integrity.damage import BlockDamage, Damage
from sweep.integrity.stored_values import computable
from sweep.isolation.crash_isolation import run_cells_isolated
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.plan.cell_selection import selection_text
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import Block, block_indices, scene_axes
from sweep.plan.parameters import Stage
from sweep.plan.variable import Variable
from sweep.processes import OUTSIDE_SIGNALS
from sweep.store.blocks import receipts, region
from sweep.store.receipt import Receipt
from sweep.store.run_store import RunStore

FLAGS = {
    "detection": (DetectionStatus.failed, DetectionStatus.crashed),
    "estimate": (EstimateStatus.failed, EstimateStatus.crashed),
}
"""Variable -> its flags of scenes that raised, and of those that ended their process."""


@dataclass(slots=True)
class FailureFindings:
    """How many scenes were recomputed, and the blocks of those that succeed now."""

    count: int = 0
    damage: list[Damage] = field(default_factory=list)


def is_doubtful(receipt: Receipt) -> bool:
    """Return whether a block has scenes that this check recomputes."""
    return bool(_killed(receipt)) or any(
        len(counts) > failed and counts[failed]
        for counts, (failed, _) in zip(
            (receipt.detection, receipt.estimate), FLAGS.values(), strict=True
        )
    )


class FailureCheck:
    """Recomputes all scenes of blocks that failed, in child processes."""

    def __init__(self, store: RunStore) -> None:
        self._store = store

    def run(self, numbers: Sequence[int]) -> FailureFindings:
        """Recompute the failed scenes of blocks; none if this machine would give other numbers.

        Raises
        ------
        MachineFaultError
            If this machine cannot compute them.
        """
        findings = FailureFindings()
        if not numbers:
            return findings
        try:
            pipeline = computable(self._store)
        except SweepError:
            return findings  # as the report says of the sample
        for number, receipt in receipts(self._store, numbers):
            self._check(pipeline, number, receipt, findings)
        return findings

    def _check(
        self, pipeline: Pipeline, number: int, receipt: Receipt, findings: FailureFindings
    ) -> None:
        block = self._store.blocks[number]
        killed = np.zeros(len(block), dtype=bool)
        killed[_killed(receipt)] = True
        doubtful = {}
        for name, (failed, crashed) in FLAGS.items():
            flags = self._flags(name, block)
            doubtful[name] = (flags == failed) | ((flags == crashed) & killed[:, None])
        rows = np.flatnonzero(np.any([each.any(axis=1) for each in doubtful.values()], axis=0))
        if not len(rows):
            return
        findings.count += len(rows)
        shape = (len(rows), pipeline.size(Stage.detection), pipeline.size(Stage.estimation))
        cells = run_cells_isolated(
            pipeline, [index[rows] for index in block_indices(block)],
            np.ones(shape, dtype=bool), TIME_LIMIT_S,
        )
        succeed = np.zeros(len(rows), dtype=bool)
        for name, failures in FLAGS.items():
            again = np.stack(cells.columns[name], axis=1)
            succeed |= (doubtful[name][rows] & ~np.isin(again, failures)).any(axis=1)
        if succeed.any():
            example = self._at(block, int(rows[np.argmax(succeed)]))
            findings.damage.append(BlockDamage(
                number, str(block),
                f"scenes that had failed and succeed when recomputed: {int(succeed.sum())}, such "
                f"as --at {example}",
            ))

    def _flags(self, name: str, block: Block) -> NDArray[np.uint8]:
        """Return a flag variable of a block: (scenes, configurations)."""
        pipeline = self._store.pipeline
        variable: Variable = next(v for v in self._store.variables if v.name == name)
        values = np.asarray(self._store.array(name)[region(variable, pipeline, block)])
        scene = [axis.name for axis in scene_axes(pipeline)]
        names = list(variable.dimensions(pipeline))
        configurations = [axis.name for axis in variable.configuration_axes(pipeline)]
        order = [names.index(each) for each in (*scene, *configurations)]
        return values.transpose(order).reshape(len(block), -1)

    def _at(self, block: Block, scene: int) -> str:
        axes = scene_axes(self._store.pipeline)
        return selection_text({
            axis.name: axis.values[index]
            for axis, index in zip(axes, block.cell(scene), strict=True)
        })


def _killed(receipt: Receipt) -> list[int]:
    """Return the scenes of a block that a signal from outside ended, as far as recorded."""
    return sorted({
        failure.scene for failure in receipt.failures
        if failure.kind == "crashed" and failure.text.strip() in OUTSIDE_SIGNALS
    })
