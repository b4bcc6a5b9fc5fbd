"""The cell that ends its process is found: blocks are cut until one scene is left."""

from __future__ import annotations

import dataclasses
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
from sweep.experiment.pipeline import Pipeline
from sweep.isolation import child_process
from sweep.isolation.child_process import Child
from sweep.measure.detectors import make_detector
from sweep.measure.estimators import PluggedEstimatorSetting, build
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped
from sweep.plugins.declared import PluginSetting
from sweep.store.blocks import selected
from sweep.typing import Masks

# --------------------------------------------------------------------------------------------------
# Scenes that crash their process or never return, isolated in child processes.
#
# The rest of the block is computed all the same. A block has a time limit T; isolating one scene
# that never returns keeps within it:
#
# - T/4: the block in its worker, before that ends itself (:data:`WHOLE`);
# - 3 T/16: pieces of the block in a child, cut in 64 up to three times, T/16 each (:data:`PIECE`);
# - T/8 + T/16 + ... : the parts of the scene that remains, one by one (:data:`PART`): rendering,
#   each detector setting, each estimator; the limit is halved each time one runs out, and such a
#   part is tried once more;
# - the rest: the first call in each child has more time (:data:`LOADING`); no limit runs while code
#   is compiled or loaded.

#: Shares of a block's time limit: for the block, for a piece of it, for a part of a scene.
WHOLE, PIECE, PART = 1 / 4, 1 / 16, 1 / 8

#: Additional time of the first call in a child: a share of the limit, at most so many seconds.
LOADING, LOADING_S = 1 / 16, 15.0

#: How many fresh processes a part of a scene must end, one after another, to be flagged; one that
#: never returns counts for two.
DEATHS = 3

#: Least time limit of a part of a scene.
MIN_S = 1.0

#: How long a child may take to start and to unpickle the pipeline.
HOLD_S = 300.0

#: Into how many pieces a group of scenes is cut that crashed a process.
PIECES = 64

#: In the child: the pipeline whose cells are computed.
_held: list[Pipeline] = []


def _hold(pipeline: Pipeline) -> None:
    _held[:] = [pipeline]


def _run_held(
    indices: Sequence[NDArray[np.intp]], need: Masks, search_too: Masks | None = None
) -> CellsResult:
    return run_cells(_held[0].experiment, indices, need, search_too)


class _IsolatedCells:
    """Computes cells of a pipeline in a child process; starts another after a crash."""

    def __init__(self, pipeline: Pipeline, limit_s: float) -> None:
        self._pipeline = pipeline
        self._limit_s = limit_s
        self._child: Child | None = None
        self._share = PART
        #: Deaths that did not come again when the same part of a scene was repeated.
        self.chances: list[str] = []

    def run(self, share: float, *arguments: Any) -> CellsResult:
        """Call ``run_cells`` with a share of the time limit.

        Raises
        ------
        ChildDiedError, ChildRaisedError
            If the child crashed, ran out of time, or raised.
        MachineFaultError
            If a child cannot be started, or raises what no scene's data can cause.
        """
        limit_s = max(share * self._limit_s, MIN_S)
        if self._child is None:
            with machine_faults_raised():
                self._child = Child()
            try:
                self._child.call(_hold, self._pipeline, limit_s=HOLD_S)
            except child_process.ChildError as error:
                how = child_process.explained(child_process.last_line(error))
                raise local_fault(
                    f"a child process ended before it computed anything: {how}") from None
            limit_s += min(LOADING * self._limit_s, LOADING_S)
        try:
            return self._child.call(_run_held, *arguments, limit_s=limit_s)
        except child_process.ChildDiedError:
            self._child = None
            raise

    def scene(self, indices: Sequence[NDArray[np.intp]], need: NDArray[np.bool_]) -> CellsResult:
        """Return the cells of a scene that crashes its process, never returns, or raises.

        Its parts are computed one after another, each in addition to those that it depends on:
        rendering, each detector setting, each estimator. The results of those that work are
        joined, the others are flagged.
        """
        joined = CellsResult.not_run(self._pipeline.experiment, 1)
        flags = joined.columns
        failures: list[Failure] = []

        def works(
            stage: str, number: int = 0, setting: int | None = None, estimator: int | None = None
        ) -> bool:
            """Compute a part; take what it gives of its stage, or note why there is nothing."""
            part = self._part(Failure(0, stage, "", setting, estimator), indices, need)
            if isinstance(part, Failure):
                failures.append(part)
                return False
            for variable in self._pipeline.experiment.variables:
                if variable.stage.name == stage:
                    joined.columns[variable.name][number] = part.columns[variable.name][number]
            joined.seconds[stage][number] = part.seconds[stage][number]
            joined.row_seconds += part.row_seconds
            known = {(each.stage, each.setting, each.estimator) for each in failures}
            failures.extend(each for each in part.failures
                            if (each.stage, each.setting, each.estimator) not in known)
            return True

        def lost() -> str:
            return "crashed" if failures[-1].crashed else "failed"

        rendered = works("scene")
        for k in np.flatnonzero(need[0].any(axis=1)).tolist():
            searched = rendered and works("detection", k, k)
            if not searched:
                flags["detection"][k][:] = DetectionStatus[lost()]
            for j in np.flatnonzero(need[0, k]).tolist():
                number = k * need.shape[2] + j
                if not searched:
                    flags["estimate"][number][:] = EstimateStatus.no_detection
                    flags["flipped"][number][:] = Flipped.no_estimate
                elif not works("estimation", number, k, j):
                    flags["estimate"][number][:] = EstimateStatus[lost()]
                    flags["flipped"][number][:] = Flipped.no_estimate
        joined.failures = failures
        return joined

    def _part(
        self, part: Failure, indices: Sequence[NDArray[np.intp]], need: NDArray[np.bool_]
    ) -> CellsResult | Failure:
        """Compute a part of a scene, named as its failure would be; else return why not.

        Raises
        ------
        MachineFaultError
            If two processes are ended by signals from outside, which is no chance.
        """
        solve, search = np.zeros_like(need), np.zeros_like(need[..., 0])
        if part.estimator is not None:
            solve[0, part.setting, part.estimator] = True
        elif part.setting is not None:
            search[0, part.setting] = True
        deaths: list[child_process.ChildDiedError] = []
        outside = 0
        while len(deaths) + sum(death.timed_out for death in deaths) < DEATHS:
            try:
                result = self.run(self._share, indices, solve, search)
            except child_process.ChildRaisedError as error:
                return dataclasses.replace(part, text=str(error))
            except child_process.ChildDiedError as death:
                outside += death.from_outside
                if outside > 1:
                    how = child_process.explained(death)
                    raise local_fault(
                        "two processes that computed one scene were ended by "
                        f"{how}; it is --at {self._selected(part, indices)}") from None
                if death.timed_out:
                    self._share /= 2
                if not death.from_outside:
                    deaths.append(death)
            else:
                if deaths:
                    self.chances.append(f"--at {self._selected(part, indices)} ended a process by "
                                        f"{deaths[0]}, and not when it was repeated")
                return result
        return dataclasses.replace(part, text=str(deaths[0]), crashed=True)

    def _selected(self, part: Failure, indices: Sequence[NDArray[np.intp]]) -> str:
        """Return a part of a scene in the form that `--at` takes."""
        return selected(self._pipeline, [int(index[0]) for index in indices], part)

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
        The experiment.
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
            except child_process.ChildError:
                if len(rows) > 1:
                    waiting.extendleft(reversed(_pieces(rows)))
                else:
                    done[int(rows[0])] = isolated.scene(chosen, need[rows])
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

    Scenes that ended their process are not repeated for that: they did so in two processes.

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
    scenes = sorted({failure.scene for failure in cells.failures if not failure.crashed})
    if not scenes:
        return
    rows = np.array(scenes)
    again = run_cells_isolated(pipeline, [index[rows] for index in indices], need[rows], limit_s)
    repeated = {dataclasses.replace(each, scene=scenes[each.scene], text="")
                for each in again.failures}
    for failure in cells.failures:
        if failure.scene in scenes and dataclasses.replace(failure, text="") not in repeated:
            raise local_fault(
                "raised in a scene, but not when that was repeated in another process: "
                + failure.text.strip().rpartition("\n")[2]
            )


# --------------------------------------------------------------------------------------------------
# Plug-ins are used once before a run: one that cannot work refuses it, and costs no pose.

#: Seconds that a plug-in may take to be made, and to search one blank frame.
LIMIT_S = 60.0

#: Settings of a plug-in that are tried.
MAX_SETTINGS = 16


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
        except child_process.ChildDiedError as error:
            child.restart()
            raise PluginError(f"{name}: ends its process before the first pose: {error}") from None
        except child_process.ChildRaisedError as error:
            raise PluginError(f"{name}: {child_process.last_line(error)}") from None


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
        _ = pipeline.experiment.scene_plugins


def _first(values: Iterable[object]) -> list[Any]:
    return list(dict.fromkeys(values))[:MAX_SETTINGS]
