"""Scenes that end their process or never return, found by bisection in a child process.

What is left of a block is computed all the same. A block has a time limit T; the search for one
scene that never returns keeps within it:

- T/4: the block in its worker, before it is taken for endless (:data:`WHOLE`);
- 3 T/16: pieces of it in a child, cut in 64 up to three times, T/16 each (:data:`PIECE`);
- T/8 + T/16 + ... : the parts of the scene that is left, searched and solved one by one
  (:data:`PART`), each limit half of that before it once one has run out;
- the rest: the first call in each child has more (:data:`LOADING`); while code is compiled or
  loaded, no limit runs.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import RunError
from sweep.evaluation.cells import CellsResult, Failure, joined, run_cells
from sweep.isolation.child_process import Child, DiedError, RaisedError
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped
from sweep.plan.experiment import Pipeline
from sweep.plan.parameters import Stage
from sweep.plan.schema import SCHEMA

WHOLE, PIECE, PART = 1 / 4, 1 / 16, 1 / 8
"""Shares of a block's time limit: for itself, for a piece of it, for a part of a scene."""

LOADING, LOADING_S = 1 / 16, 15.0
"""What the first call in a child has more: this share of the limit, or so many seconds."""

MIN_S = 1.0
"""What a part of a scene has in any case."""

HOLD_S = 300.0
"""How long a child may take to start and to take the pipeline."""

PIECES = 64
"""Into how many pieces what ended a process is cut."""

_held: list[Pipeline] = []
"""In the child: the pipeline whose cells are asked for."""


def _hold(pipeline: Pipeline) -> None:
    _held[:] = [pipeline]


def _run_held(*arguments: Any) -> CellsResult:
    return run_cells(_held[0], *arguments)


class _Careful:
    """Computes cells of one pipeline in a child, and starts another where one died."""

    def __init__(self, pipeline: Pipeline, limit_s: float) -> None:
        self._pipeline = pipeline
        self.limit_s = limit_s
        self._child: Child | None = None

    def __call__(self, share: float, *arguments: Any) -> CellsResult:
        limit_s = share * self.limit_s
        if self._child is None:
            child = Child()
            try:
                child.call(_hold, self._pipeline, limit_s=HOLD_S)
            except (DiedError, RaisedError) as error:
                child.close()
                raise RunError(
                    f"a child process ended before it computed anything: {error}"
                ) from None
            self._child = child
            limit_s += min(LOADING * self.limit_s, LOADING_S)
        try:
            result: CellsResult = self._child.call(_run_held, *arguments, limit_s=limit_s)
        except DiedError:
            self._child = None
            raise
        return result

    def close(self) -> None:
        if self._child is not None:
            self._child.close()


def run_cells_isolated(
    pipeline: Pipeline,
    indices: Sequence[NDArray[np.intp]],
    need: NDArray[np.bool_],
    limit_s: float,
) -> CellsResult:
    """Compute cells as `sweep.evaluation.cells.run_cells` does, whatever they do to their process.

    What ends a child process is flagged ``crashed``, what raises for all its scenes ``failed``: the
    search with a setting, or what an estimator makes of it. Everything else keeps its values, to
    the bit.
    """
    careful = _Careful(pipeline, limit_s)
    done: dict[int, CellsResult] = {}
    todo = deque(_cut(np.arange(len(need))))
    try:
        while todo:
            rows = todo.popleft()
            chosen = [index[rows] for index in indices]
            try:
                done[int(rows[0])] = careful(PIECE, chosen, need[rows])
            except (DiedError, RaisedError):
                if len(rows) > 1:
                    todo.extendleft(reversed(_cut(rows)))
                else:
                    done[int(rows[0])] = _one(careful, pipeline, chosen, need[rows])
    finally:
        careful.close()
    return joined([done[start] for start in sorted(done)])


def _cut(rows: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    return list(np.array_split(rows, min(PIECES, len(rows))))


def _one(
    careful: _Careful,
    pipeline: Pipeline,
    chosen: Sequence[NDArray[np.intp]],
    need: NDArray[np.bool_],
) -> CellsResult:
    """Compute what can be computed of a scene that ends its process, or raises as a whole."""
    _, settings, estimators = need.shape
    share = PART
    lost: list[Failure] = []

    def works(stage: str, setting: int | None = None, estimator: int | None = None) -> bool:
        nonlocal share
        solve, search = np.zeros_like(need), np.zeros((1, settings), dtype=bool)
        if estimator is not None:
            solve[0, setting, estimator] = True
        elif setting is not None:
            search[0, setting] = True
        for last in (False, True):
            try:
                careful(share, chosen, solve, search)
            except RaisedError as error:
                lost.append(Failure(0, stage, str(error), setting, estimator))
                return False
            except DiedError as death:
                endless = str(death).startswith("time")
                share = max(share / 2, MIN_S / careful.limit_s) if endless else share
                # A process may also be killed from outside; twice is no chance.
                if endless or last:
                    lost.append(Failure(0, stage, str(death), setting, estimator, crashed=True))
                    return False
            else:
                return True
        raise AssertionError(stage)

    asked = np.flatnonzero(need[0].any(axis=1)).tolist()
    whole = works("scene")
    searched = np.zeros((1, settings), dtype=bool)
    solved = np.zeros_like(need)
    for k in asked if whole else ():
        searched[0, k] = works("detection", k)
        for j in np.flatnonzero(need[0, k]).tolist() if searched[0, k] else ():
            solved[0, k, j] = works("estimation", k, j)
    try:
        # None of what is asked here is endless: it has all the time.
        result = careful(1.0, chosen, solved, searched) if whole else _nothing(pipeline)
    except (DiedError, RaisedError) as error:
        # Each part is harmless alone, but not all of them together.
        died = isinstance(error, DiedError)
        lost.append(Failure(0, "scene", str(error), crashed=died))
        whole, searched[:], solved[:] = False, False, False
        result = _nothing(pipeline)
    crashed = {(one.setting, one.estimator): one.crashed for one in lost}
    for k in asked:
        if not searched[0, k]:
            died = crashed[k, None] if whole else crashed[None, None]
            result.columns["detection"][k][:] = (
                DetectionStatus.crashed if died else DetectionStatus.failed
            )
        for j in np.flatnonzero(need[0, k] & ~solved[0, k]).tolist():
            flag = EstimateStatus.no_detection
            if searched[0, k]:
                flag = EstimateStatus.crashed if crashed[k, j] else EstimateStatus.failed
            result.columns["estimate"][k * estimators + j][:] = flag
            result.columns["flipped"][k * estimators + j][:] = Flipped.no_estimate
    result.failures += lost
    return result


def _nothing(pipeline: Pipeline) -> CellsResult:
    """Return the result of a scene of which nothing is known."""
    columns: dict[str, list[NDArray[Any]]] = {}
    sizes: dict[Stage, int] = {}
    for variable in SCHEMA:
        sizes[variable.stage] = variable.treatments(pipeline)
        columns[variable.name] = [
            np.full((1, *variable.inner_shape), variable.fill, dtype=variable.dtype)
            for _ in range(sizes[variable.stage])
        ]
    seconds = {
        "scene": [0.0],
        "detection": [0.0] * sizes[Stage.detection],
        "estimation": [0.0] * sizes[Stage.estimation],
    }
    return CellsResult(columns, seconds, np.zeros(1))
