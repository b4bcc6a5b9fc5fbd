"""The cell that ends its process is found: blocks are cut until one scene, and a part, is left."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import local_fault
from sweep.evaluation.block import run_cells, warm_up
from sweep.evaluation.machine_faults import machine_faults_raised
from sweep.evaluation.results import CellsResult, Failure
from sweep.evaluation.variables import WITHOUT_DETECTION
from sweep.experiment.pipeline import Pipeline
from sweep.isolation.child_process import GRACE_S, Child, ChildDiedError, ChildError
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.store.blocks import selected
from sweep.typing import Masks

# --------------------------------------------------------------------------------------------------
# Scenes that crash their process or never return, isolated in child processes.
#
# The rest of the block is computed all the same. Of a block's time limit, its worker has a quarter,
# before that ends itself (:data:`WHOLE`). Then each call in a child has a share of what is left
# (:data:`SHARE`), so that isolating a scene that never returns keeps within the limit; and not less
# than a share of it all (:data:`LEAST`), since there are other scenes after some that never return.
# No limit runs while a child starts, or code is compiled or loaded.

WHOLE, SHARE, LEAST = 1 / 4, 1 / 6, 1 / 32

#: How many fresh processes a part of a scene must end, one after another, to be flagged.
DEATHS = 3

#: Least time limit of a call.
MIN_S = 1.0

#: Into how many pieces scenes are cut that crashed a process together.
PIECES = 64


def _run(pipeline: Pipeline, *arguments: Any) -> CellsResult:
    return run_cells(pipeline.experiment, *arguments)


@machine_faults_raised()
def run_cells_isolated(
    pipeline: Pipeline,
    indices: Sequence[NDArray[np.intp]],
    need: NDArray[np.bool_],
    limit_s: float,
) -> CellsResult:
    """Compute cells as `sweep.evaluation.block.run_cells` does, also if they crash their process.

    A detection or estimate that ends each of :data:`DEATHS` child processes is flagged ``crashed``,
    one that raises as a whole ``failed``. A signal from outside, such as the system sends to a
    process that uses too much memory, is the machine's fault. All others have the same values as in
    one call, bit for bit: what worked alone does not depend on what else its scene has.

    Parameters
    ----------
    pipeline
        The experiment.
    indices
        (N,) indices of the scenes along each scene axis.
    need
        (N, detector settings, estimators): the cells that are computed.
    limit_s
        Time limit of the block in seconds, shared as the comment above says.

    Raises
    ------
    MachineFaultError
        If no child process can be started, one raises what no scene's data can cause, or one that
        computes a part of a single scene is ended by a signal from outside.
    """
    end = time.monotonic() + (1 - WHOLE) * limit_s
    result = CellsResult.not_run(pipeline.experiment, len(need))
    flags, nothing = result.columns, np.zeros_like(need[:1])

    def start() -> None:
        """Start a child and load code there."""
        try:
            child.call(warm_up, pipeline, limit_s=GRACE_S)
        except ChildError as error:
            raise local_fault(f"a child process computed nothing: {error.line}") from None

    def run(rows: NDArray[np.intp], *masks: Masks) -> None:
        """Call ``run_cells`` for scenes ``rows`` (n,) and masks of them; take over the results."""
        share_s = max(SHARE * (end - time.monotonic()), LEAST * limit_s, MIN_S)
        try:
            part = child.call(
                _run, pipeline, [index[rows] for index in indices], *masks, limit_s=share_s)
        except ChildDiedError:
            start()
            raise
        result.take(pipeline.experiment, part, rows)

    def compute(scenes: NDArray[np.intp]) -> None:
        """Compute scenes in pieces; those that end the process in smaller ones."""
        for piece in np.array_split(scenes, min(PIECES, len(scenes))):
            try:
                run(piece, need[piece])
            except ChildError:
                if len(piece) > 1:
                    compute(piece)
                else:
                    compute_parts(int(piece[0]))

    def compute_parts(row: int) -> None:
        """Compute a scene: its parameters and truth, each search, each estimate."""
        unmade = lost(Failure(row, "scene", ""), nothing)
        for k in np.flatnonzero(need[row].any(axis=1)).tolist():
            search = np.arange(need.shape[1])[None] == k
            unseen = unmade or lost(Failure(row, "detection", "", k), nothing, search)
            if unseen:
                flags["detection"][k][row] = DetectionStatus[unseen]
            for j in np.flatnonzero(need[row, k]).tolist():
                number, only = k * need.shape[2] + j, nothing.copy()
                only[0, k, j] = True
                unsolved = unseen or lost(Failure(row, "estimation", "", k, j), only, search)
                if unsolved:
                    for name, flag in WITHOUT_DETECTION.items():
                        flags[name][number][row] = flag
                if unsolved and not unseen:
                    flags["estimate"][number][row] = EstimateStatus[unsolved]

    def lost(part: Failure, *masks: Masks) -> str:
        """Compute a part of a scene, named as its failure would be.

        Returns
        -------
        "crashed" or "failed" if there are no results, which is noted; nothing otherwise.
        """
        for _ in range(DEATHS):
            try:
                run(np.array([part.scene]), *masks)
            except ChildError as error:
                if error.from_outside:
                    at = selected(pipeline, [int(i[part.scene]) for i in indices], part)
                    raise local_fault(f"{error.line}; the scene is --at {at}") from None
                failure = dataclasses.replace(
                    part, text=str(error), crashed=isinstance(error, ChildDiedError))
                if not failure.crashed:
                    break
            else:
                return ""
        result.failures.append(failure)
        return "crashed" if failure.crashed else "failed"

    with Child() as child:
        start()
        compute(np.arange(len(need)))
    # Parts that were computed apart tell the same of what they share.
    result.failures = list({
        dataclasses.replace(each, text=""): each for each in result.failures}.values())
    return result


# --------------------------------------------------------------------------------------------------
# Scenes that raised are repeated in a fresh process: what it does not raise again is no result.

def check_repeatable(
    pipeline: Pipeline,
    indices: Sequence[NDArray[np.intp]],
    need: NDArray[np.bool_],
    cells: CellsResult,
    limit_s: float,
) -> None:
    """Repeat the scenes that raised, all together, in a child process that was started for it.

    Scenes that ended their process are not repeated for that: :data:`DEATHS` processes were ended.

    Parameters
    ----------
    pipeline
        The computed cells.
    indices, need
        (N,) indices of the scenes along each scene axis, and which of their cells were computed,
        as in `sweep.evaluation.block.run_cells`.
    cells
        Their results.
    limit_s
        Time limit of the repetition in seconds.

    Raises
    ------
    MachineFaultError
        If a scene does not fail again in the same parts, or the machine fails meanwhile.
    """
    scenes = sorted({each.scene for each in cells.failures if not each.crashed})
    if scenes:
        again = run_cells_isolated(
            pipeline, [index[scenes] for index in indices], need[scenes], limit_s).failures
        repeated = {dataclasses.replace(each, scene=scenes[each.scene], text="") for each in again}
        for each in cells.failures:
            if not each.crashed and dataclasses.replace(each, text="") not in repeated:
                raise local_fault("raised in a scene, but not when that was repeated in another "
                                  f"process: {each.text.strip().splitlines()[-1]}")
