"""Scenes that raised are repeated in a fresh process: what it does not raise again is no result."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sweep.evaluation.machine_faults import local_fault
from sweep.evaluation.results import CellsResult, Failure
from sweep.isolation.crash_isolation import run_cells_isolated
from sweep.plan.experiment import Pipeline

Part = tuple[int, str, int | None, int | None, bool]


def check_repeatable(
    pipeline: Pipeline,
    indices: Sequence[NDArray[np.intp]],
    need: NDArray[np.bool_],
    cells: CellsResult,
    limit_s: float,
) -> None:
    """Repeat the scenes that raised, all together, in a child process that was started for it.

    Scenes that ended their process are not repeated for that: they did so in two processes.

    Parameters
    ----------
    pipeline
        What was computed.
    indices, need
        (N,) indices of the scenes along each scene axis, and which of their cells were computed,
        as in `sweep.evaluation.cells.run_cells`.
    cells
        Their results.
    limit_s
        Time limit of the repetition in seconds.

    Raises
    ------
    MachineFaultError
        If a scene does not fail again in the same parts, or the machine fails meanwhile.
    """
    scenes = sorted({failure.scene for failure in cells.failures if not failure.crashed})
    if not scenes:
        return
    rows = np.array(scenes)
    again = run_cells_isolated(pipeline, [index[rows] for index in indices], need[rows], limit_s)
    repeated = {_part(failure, scenes[failure.scene]) for failure in again.failures}
    for failure in cells.failures:
        if failure.scene in scenes and _part(failure, failure.scene) not in repeated:
            raise local_fault(
                "raised in a scene, but not when that was repeated in another process: "
                + failure.text.strip().rpartition("\n")[2]
            )


def _part(failure: Failure, scene: int) -> Part:
    return scene, failure.stage, failure.setting, failure.estimator, failure.crashed
