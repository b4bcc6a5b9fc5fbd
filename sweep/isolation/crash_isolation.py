"""Scenes that crash their process or never return, isolated in child processes.

The rest of the block is computed all the same. A block has a time limit T; isolating one scene that
never returns keeps within it:

- T/4: the block in its worker, before that ends itself (:data:`WHOLE`);
- 3 T/16: pieces of the block in a child, cut in 64 up to three times, T/16 each (:data:`PIECE`);
- T/8 + T/16 + ... : the parts of the scene that remains, one by one (:data:`PART`): rendering, each
  detector setting, each estimator; the limit is halved each time one runs out;
- the rest: the first call in each child has more time (:data:`LOADING`); no limit runs while code
  is compiled or loaded.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.evaluation.cells import run_cells
from sweep.evaluation.machine_faults import local_fault, machine_faults_raised
from sweep.evaluation.results import CellsResult, Failure, concatenate
from sweep.isolation.child_process import Child, ChildDiedError, ChildRaisedError, last_line
from sweep.isolation.machine_memory import explained, memory_kills
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped
from sweep.plan.cell_selection import selection_text
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import scene_axes

WHOLE, PIECE, PART = 1 / 4, 1 / 16, 1 / 8
"""Shares of a block's time limit: for the block, for a piece of it, for a part of a scene."""

LOADING, LOADING_S = 1 / 16, 15.0
"""Additional time of the first call in a child: a share of the limit, at most so many seconds."""

MIN_S = 1.0
"""Least time limit of a part of a scene."""

HOLD_S = 300.0
"""How long a child may take to start and to unpickle the pipeline."""

PIECES = 64
"""Into how many pieces a group of scenes is cut that crashed a process."""

_held: list[Pipeline] = []
"""In the child: the pipeline whose cells are computed."""


def _hold(pipeline: Pipeline) -> None:
    _held[:] = [pipeline]


def _run_held(*arguments: Any) -> CellsResult:
    return run_cells(_held[0], *arguments)


class _IsolatedCells:
    """Computes cells of a pipeline in a child process; starts another after a crash."""

    def __init__(self, pipeline: Pipeline, limit_s: float) -> None:
        self._pipeline = pipeline
        self.limit_s = limit_s
        self._child: Child | None = None
        self._kills = memory_kills()

    def run(self, share: float, *arguments: Any) -> CellsResult:
        """Call ``run_cells`` with a share of the time limit.

        Raises
        ------
        ChildDiedError, ChildRaisedError
            If the child crashed, ran out of time, or raised.
        MachineFaultError
            If a child cannot be started, or raises what no scene's data can cause.
        """
        limit_s = share * self.limit_s
        if self._child is None:
            with machine_faults_raised():
                child = Child()
            try:
                child.call(_hold, self._pipeline, limit_s=HOLD_S)
            except (ChildDiedError, ChildRaisedError) as error:
                child.close()
                how = explained(last_line(error), self._kills)
                raise local_fault(
                    f"a child process ended before it computed anything: {how}"
                ) from None
            self._child = child
            limit_s += min(LOADING * self.limit_s, LOADING_S)
        try:
            result: CellsResult = self._child.call(_run_held, *arguments, limit_s=limit_s)
        except ChildDiedError:
            self._child = None
            raise
        return result

    def fault(self, death: ChildDiedError, indices: Sequence[NDArray[np.intp]]) -> Exception:
        """Return the machine's fault that ended the child again while it computed one scene."""
        scene = selection_text({
            axis.name: axis.values[int(index[0])]
            for axis, index in zip(scene_axes(self._pipeline), indices, strict=True)
        })
        return local_fault(
            f"two processes that computed one scene were ended by {explained(death, self._kills)}; "
            f"it is --at {scene}"
        )

    def close(self) -> None:
        """End the child process."""
        if self._child is not None:
            self._child.close()


def run_cells_isolated(
    pipeline: Pipeline,
    indices: Sequence[NDArray[np.intp]],
    need: NDArray[np.bool_],
    limit_s: float,
) -> CellsResult:
    """Compute cells as `sweep.evaluation.cells.run_cells` does, also if they crash their process.

    A detection or estimate that crashes a child process is flagged ``crashed``, one that raises
    ``failed``. A signal from outside, such as the system sends to a process that uses too much
    memory, is the machine's fault. All others have the same values as in one call, bit for bit.

    Parameters
    ----------
    pipeline
        What is computed.
    indices
        (N,) indices of the scenes along each scene axis.
    need
        (N, detector settings, estimators): the cells that are computed.
    limit_s
        Time limit of the block in seconds, divided as the module's docstring says.

    Raises
    ------
    MachineFaultError
        If no child process can be started, one raises what no scene's data can cause, or one that
        computes a single scene is ended twice by a signal from outside.
    """
    isolated = _IsolatedCells(pipeline, limit_s)
    done: dict[int, CellsResult] = {}
    waiting = deque(_pieces(np.arange(len(need))))
    try:
        while waiting:
            rows = waiting.popleft()
            chosen = [index[rows] for index in indices]
            try:
                done[int(rows[0])] = isolated.run(PIECE, chosen, need[rows])
            except (ChildDiedError, ChildRaisedError):
                if len(rows) > 1:
                    waiting.extendleft(reversed(_pieces(rows)))
                else:
                    scene = _Scene(isolated, pipeline, chosen, need[rows])
                    done[int(rows[0])] = scene.compute()
    finally:
        isolated.close()
    return concatenate([done[start] for start in sorted(done)])


def _pieces(rows: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    return list(np.array_split(rows, min(PIECES, len(rows))))


class _Scene:
    """One scene that crashes its process, never returns, or raises as a whole.

    Its parts are tried one after another, each in addition to those that it depends on: rendering,
    each detector setting, each estimator. Those that work are then computed together.
    """

    def __init__(
        self, isolated: _IsolatedCells, pipeline: Pipeline, indices: Sequence[NDArray[np.intp]],
        need: NDArray[np.bool_],
    ) -> None:
        self._isolated = isolated
        self._pipeline = pipeline
        self._indices = indices
        self._need = need
        self._share = PART
        self._failures: list[Failure] = []

    def compute(self) -> CellsResult:
        """Return the scene's cells; those that do not work are flagged."""
        need = self._need
        searched, solved = np.zeros_like(need[..., 0]), np.zeros_like(need)
        rendered = self._works("scene")
        for k in np.flatnonzero(need[0].any(axis=1)).tolist() if rendered else ():
            searched[0, k] = self._works("detection", k)
            for j in np.flatnonzero(need[0, k]).tolist() if searched[0, k] else ():
                solved[0, k, j] = self._works("estimation", k, j)
        result = None
        if rendered:
            try:
                # Each part returns, so that together they have all the time.
                result = self._undisturbed(1.0, solved, searched)
            except (ChildDiedError, ChildRaisedError) as error:
                # Each part works alone, but not all of them together.
                died = isinstance(error, ChildDiedError)
                self._failures.append(Failure(0, "scene", str(error), crashed=died))
                rendered, searched[:], solved[:] = False, False, False
        if result is None:
            result = CellsResult.not_run(self._pipeline, 1)
        self._flag(result, searched, solved, rendered=rendered)
        result.failures += self._failures
        return result

    def _undisturbed(
        self, share: float, solved: NDArray[np.bool_], searched: NDArray[np.bool_]
    ) -> CellsResult:
        """Compute parts of the scene, again if a signal from outside ends it.

        Raises
        ------
        MachineFaultError
            If one does so again, which is no chance.
        """
        for last in (False, True):
            try:
                return self._isolated.run(share, self._indices, solved, searched)
            except ChildDiedError as death:
                if not death.from_outside:
                    raise
                if last:
                    raise self._isolated.fault(death, self._indices) from None
        raise AssertionError(share)

    def _works(self, stage: str, setting: int | None = None, estimator: int | None = None) -> bool:
        """Return whether a part of the scene can be computed; note why if it cannot."""
        solve, search = np.zeros_like(self._need), np.zeros_like(self._need[..., 0])
        if estimator is not None:
            solve[0, setting, estimator] = True
        elif setting is not None:
            search[0, setting] = True
        for last in (False, True):
            try:
                self._undisturbed(self._share, solve, search)
            except ChildRaisedError as error:
                self._failures.append(Failure(0, stage, str(error), setting, estimator))
                return False
            except ChildDiedError as death:
                if death.timed_out:
                    self._share = max(self._share / 2, MIN_S / self._isolated.limit_s)
                if death.timed_out or last:
                    self._failures.append(
                        Failure(0, stage, str(death), setting, estimator, crashed=True)
                    )
                    return False
            else:
                return True
        raise AssertionError(stage)

    def _flag(
        self, result: CellsResult, searched: NDArray[np.bool_], solved: NDArray[np.bool_], *,
        rendered: bool,
    ) -> None:
        """Flag the needed cells that were not ``searched`` or not ``solved``."""
        _, _, estimators = self._need.shape
        crashed = {
            (failure.setting, failure.estimator): failure.crashed for failure in self._failures
        }
        for k in np.flatnonzero(self._need[0].any(axis=1)).tolist():
            if not searched[0, k]:
                died = crashed[k, None] if rendered else crashed[None, None]
                result.columns["detection"][k][:] = (
                    DetectionStatus.crashed if died else DetectionStatus.failed
                )
            for j in np.flatnonzero(self._need[0, k] & ~solved[0, k]).tolist():
                status = EstimateStatus.no_detection
                if searched[0, k]:
                    status = EstimateStatus.crashed if crashed[k, j] else EstimateStatus.failed
                result.columns["estimate"][k * estimators + j][:] = status
                result.columns["flipped"][k * estimators + j][:] = Flipped.no_estimate
