"""The cell that ends its process is found: blocks are cut until one scene is left."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import PluginError
from sweep.evaluation.block import run_cells
from sweep.evaluation.machine_faults import local_fault, machine_faults_raised
from sweep.evaluation.opencv_threads import single_threaded
from sweep.evaluation.results import CellsResult, Failure, concatenate
from sweep.experiment.cell_selection import selection_text
from sweep.experiment.experiment import scene_plugins
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.isolation.child_process import Child, ChildDiedError, ChildRaisedError, last_line
from sweep.isolation.machine import explained
from sweep.measure.detectors import make_detector
from sweep.measure.estimators import PluggedEstimatorSetting, build
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped
from sweep.plugins.declared import PluginSetting

# --------------------------------------------------------------------------------------------------
# Scenes that crash their process or never return, isolated in child processes.
#
# The rest of the block is computed all the same. A block has a time limit T; isolating one scene
# that never returns keeps within it:
#
# - T/4: the block in its worker, before that ends itself (:data:`WHOLE`);
# - 3 T/16: pieces of the block in a child, cut in 64 up to three times, T/16 each
# (:data:`PIECE`);
# - T/8 + T/16 + ... : the parts of the scene that remains, one by one (:data:`PART`): rendering,
# each
#   detector setting, each estimator; the limit is halved each time one runs out, and such a part
# is
#   tried once more;
# - the rest: the first call in each child has more time (:data:`LOADING`); no limit runs while
# code
#   is compiled or loaded.

WHOLE, PIECE, PART = 1 / 4, 1 / 16, 1 / 8
"""Shares of a block's time limit: for the block, for a piece of it, for a part of a scene."""

LOADING, LOADING_S = 1 / 16, 15.0
"""Additional time of the first call in a child: a share of the limit, at most so many seconds."""

DEATHS = 3
"""How many fresh processes a part of a scene must end, one after another, to be flagged."""

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
    return run_cells(_held[0].experiment, *arguments)


class _IsolatedCells:
    """Computes cells of a pipeline in a child process; starts another after a crash."""

    def __init__(self, pipeline: Pipeline, limit_s: float) -> None:
        self._pipeline = pipeline
        self.limit_s = limit_s
        self._child: Child | None = None
        self.chances: list[str] = []
        """Deaths that did not come again when the same part of a scene was repeated."""

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
                how = explained(last_line(error))
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
        return local_fault(
            f"two processes that computed one scene were ended by {explained(death)}; "
            f"it is --at {self.selected(indices)}"
        )

    def selected(
        self, indices: Sequence[NDArray[np.intp]], setting: int | None = None,
        estimator: int | None = None,
    ) -> str:
        """Return a scene, and what of it is computed, in the form that `--at` takes."""
        pipeline = self._pipeline
        values = [
            axis.values[int(index[0])]
            for axis, index in zip(pipeline.experiment.scene_axes, indices, strict=True)
        ]
        names = (axis.name for axis in pipeline.experiment.scene_axes)
        named = dict(zip(names, values, strict=True))
        for stage, number in ((Stage.detection, setting), (Stage.estimation, estimator)):
            axes = pipeline.axes_of(stage)
            if number is not None and axes:
                steps = np.unravel_index(number, [len(axis) for axis in axes])
                named |= {
                    axis.name: axis.values[int(i)] for axis, i in zip(axes, steps, strict=True)
                }
        return selection_text(named)

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
    """Compute cells as `sweep.evaluation.block.run_cells` does, also if they crash their process.

    A detection or estimate that ends each of :data:`DEATHS` child processes is flagged ``crashed``,
    one that raises ``failed``. A signal from outside, such as the system sends to a process that
    uses too much memory, is the machine's fault. All others have the same values as in one call,
    bit for bit: what worked alone does not depend on what else its scene has.

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
        computes a single scene is ended twice by a signal from outside; if something would be
        flagged ``crashed``, but processes also died by chance.
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
    cells = concatenate([done[start] for start in sorted(done)])
    crashed = sum(failure.crashed for failure in cells.failures)
    if isolated.chances and crashed:
        raise local_fault(
            f"not deterministic: {isolated.chances[0]}; so {crashed} that ended {DEATHS} processes "
            "may have done so by chance, too"
        )
    return cells


def _pieces(rows: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    return list(np.array_split(rows, min(PIECES, len(rows))))


class _Scene:
    """One scene that crashes its process, never returns, or raises as a whole.

    Its parts are computed one after another, each in addition to those that it depends on:
    rendering, each detector setting, each estimator. The results of those that work are joined.
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
        self._result = CellsResult.not_run(pipeline.experiment, 1)

    def compute(self) -> CellsResult:
        """Return the scene's cells; those that do not work are flagged."""
        estimators = self._need.shape[2]
        rendered = self._works(Stage.scene)
        for k in np.flatnonzero(self._need[0].any(axis=1)).tolist():
            searched = rendered and self._works(Stage.detection, k)
            if not searched:
                self._flag("detection", k, DetectionStatus, k if rendered else None)
            for j in np.flatnonzero(self._need[0, k]).tolist():
                number = k * estimators + j
                if not searched:
                    self._set("estimate", number, EstimateStatus.no_detection)
                elif not self._works(Stage.estimation, k, j):
                    self._flag("estimate", number, EstimateStatus, k, j)
                else:
                    continue
                self._set("flipped", number, Flipped.no_estimate)
        self._result.failures = self._failures
        return self._result

    def _works(
        self, stage: Stage, setting: int | None = None, estimator: int | None = None
    ) -> bool:
        """Compute a part of the scene and take its results; else note why it does not work."""
        solve, search = np.zeros_like(self._need), np.zeros_like(self._need[..., 0])
        if estimator is not None:
            solve[0, setting, estimator] = True
        elif setting is not None:
            search[0, setting] = True
        deaths: list[str] = []
        while True:
            try:
                part = self._undisturbed(solve, search)
            except ChildRaisedError as error:
                self._failures.append(Failure(0, stage.name, str(error), setting, estimator))
                return False
            except ChildDiedError as death:
                deaths.append(str(death))
                if death.timed_out:
                    self._share = max(self._share / 2, MIN_S / self._isolated.limit_s)
                if len(deaths) == (DEATHS - 1 if death.timed_out else DEATHS):
                    self._failures.append(
                        Failure(0, stage.name, deaths[0], setting, estimator, crashed=True)
                    )
                    return False
            else:
                break
        if deaths:
            at = self._isolated.selected(self._indices, setting, estimator)
            self._isolated.chances.append(
                f"--at {at} ended a process by {deaths[0]}, and not when it was repeated"
            )
        self._take(part, stage, setting, estimator)
        return True

    def _undisturbed(
        self, solved: NDArray[np.bool_], searched: NDArray[np.bool_]
    ) -> CellsResult:
        """Compute parts of the scene, again if a signal from outside ends it.

        Raises
        ------
        MachineFaultError
            If one does so again, which is no chance.
        """
        for last in (False, True):
            try:
                return self._isolated.run(self._share, self._indices, solved, searched)
            except ChildDiedError as death:
                if not death.from_outside:
                    raise
                if last:
                    raise self._isolated.fault(death, self._indices) from None
        raise AssertionError(solved)

    def _take(
        self, part: CellsResult, stage: Stage, setting: int | None, estimator: int | None
    ) -> None:
        """Take the columns, seconds and failures of a part that was computed alone."""
        if stage is Stage.scene:  # of the other stages nothing was run
            self._result = part
        else:
            number = (setting or 0) * (1 if estimator is None else self._need.shape[2])
            number += estimator or 0
            for variable in self._pipeline.experiment.variables:
                if variable.stage is stage:
                    column = part.columns[variable.name][number]
                    self._result.columns[variable.name][number] = column
            self._result.seconds[stage.name][number] = part.seconds[stage.name][number]
            self._result.row_seconds += part.row_seconds
        noted = {(failure.stage, failure.setting, failure.estimator) for failure in self._failures}
        self._failures += [
            failure for failure in part.failures
            if (failure.stage, failure.setting, failure.estimator) not in noted
        ]

    def _flag(
        self, name: str, number: int, flags: type[DetectionStatus | EstimateStatus],
        setting: int | None, estimator: int | None = None,
    ) -> None:
        """Flag a cell as the failure of the part that it lacks says."""
        crashed = any(
            failure.crashed for failure in self._failures
            if (failure.setting, failure.estimator) == (setting, estimator)
        )
        self._set(name, number, flags["crashed" if crashed else "failed"])

    def _set(self, name: str, number: int, flag: int) -> None:
        self._result.columns[name][number][:] = flag


# --------------------------------------------------------------------------------------------------
# Scenes that raised are repeated in a fresh process: what it does not raise again is no result.

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


# --------------------------------------------------------------------------------------------------
# Plug-ins are used once before a run: one that cannot work refuses it, and costs no pose.

LIMIT_S = 60.0
"""Seconds that a plug-in may take to be made, and to search one blank frame."""

MAX_SETTINGS = 16
"""Settings of a plug-in that are tried."""


def check_plugins(child: Child, pipeline: Pipeline, limit_s: float = LIMIT_S) -> None:
    """Use each of a pipeline's plug-ins in a child process, which goes on to work.

    Raises
    ------
    PluginError
        If one cannot be imported or made, raises on a blank frame, ends its process, or does not
        return; in one line.
    """
    for plugin in pipeline.plugins:
        name = f"{plugin.kind} {plugin.name}"
        try:
            child.call(use, pipeline, plugin.kind, plugin.name, limit_s=limit_s)
        except ChildDiedError as error:
            child.restart()
            raise PluginError(f"{name}: ends its process before the first pose: {error}") from None
        except ChildRaisedError as error:
            raise PluginError(f"{name}: {last_line(error)}") from None


@single_threaded()
def use(pipeline: Pipeline, kind: str, name: str) -> None:
    """Import a plug-in and make it with each of its settings; a detector searches a blank frame.

    Raises
    ------
    PluginError
        If that cannot be done.
    """
    if kind == "detector":
        width, height = (min(pipeline.values_of(side)) for side in ("width_px", "height_px"))
        blank = np.full((height, width), 128, dtype=np.uint8)
        settings = [
            setting for setting in pipeline.experiment.detectors
            if isinstance(setting, PluginSetting) and setting.plugin.name == name
        ]
        for setting in _first(settings):
            search = make_detector(setting)
            for dictionary in _first(pipeline.values_of("dictionary")):
                search(blank, dictionary, max(width, height))
    elif kind == "estimator":
        for estimator in _first(
            each for each in pipeline.experiment.estimators
            if isinstance(each, PluggedEstimatorSetting) and each.solver == name
        ):
            build(estimator)
    else:
        scene_plugins(pipeline)


def _first(values: Iterable[object]) -> list[Any]:
    return list(dict.fromkeys(values))[:MAX_SETTINGS]
