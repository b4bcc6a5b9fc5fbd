"""The cell that ends its process is found: blocks are cut until one scene is left."""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sweep.errors import PluginError
from sweep.evaluation.block import run_cells
from sweep.evaluation.machine_faults import machine_faults_raised
from sweep.evaluation.opencv_threads import single_threaded
from sweep.evaluation.results import CellsResult, Failure
from sweep.experiment.pipeline import Pipeline
from sweep.isolation.child_process import Child, ChildDiedError, ChildError, ChildRaisedError
from sweep.measure.detectors import PluginSetting, make_detector
from sweep.measure.estimators import build
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped
from sweep.messages import local_fault
from sweep.store.blocks import selected
from sweep.typing import Masks

# --------------------------------------------------------------------------------------------------
# Scenes that crash their process or never return, isolated in child processes.
#
# The rest of the block is computed all the same. Of a block's time limit, its worker has a quarter,
# before that ends itself (:data:`WHOLE`). Then each call in a child has a share of what is left
# (:data:`SHARE`), so that isolating a scene that never returns keeps within the limit; and not less
# than a share of it all (:data:`LEAST`), since there are other scenes after some that never return.
# No limit runs while code is compiled or loaded.

WHOLE, SHARE, LEAST = 1 / 4, 1 / 6, 1 / 32

#: How many fresh processes a part of a scene must end, one after another, to be flagged.
DEATHS = 3

#: Least time limit of a call.
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
    """Computes cells of a pipeline in a child process, which begins again after a crash.

    ``cells`` are what has been computed so far; the other arguments are as in
    :func:`run_cells_isolated`.
    """

    def __init__(
        self, child: Child, pipeline: Pipeline, indices: Sequence[NDArray[np.intp]], need: Masks,
        limit_s: float,
    ) -> None:
        self._child, self._pipeline, self._indices, self._need = child, pipeline, indices, need
        self._limit_s, self._end = limit_s, time.monotonic() + (1 - WHOLE) * limit_s
        self.cells = CellsResult.not_run(pipeline.experiment, len(need))
        self._begin()

    def _begin(self) -> None:
        """Give a fresh child the pipeline; MachineFaultError if it ends meanwhile."""
        try:
            self._child.call(_hold, self._pipeline, limit_s=HOLD_S)
        except ChildError as error:
            raise local_fault(f"a child process computed nothing: {error.line}") from None

    def compute(self, rows: NDArray[np.intp]) -> None:
        """Compute scenes ``rows`` (n,) in pieces; those that end the process in smaller ones."""
        for piece in np.array_split(rows, min(PIECES, len(rows))):
            try:
                self._take(piece, self._run(piece, self._need[piece]))
            except ChildError:
                if len(piece) > 1:
                    self.compute(piece)
                else:
                    self._compute_scene(int(piece[0]))

    def _run(self, rows: NDArray[np.intp], *masks: Masks) -> CellsResult:
        """Call ``run_cells`` for some scenes.

        Raises
        ------
        ChildDiedError, ChildRaisedError
            If the child crashed, ran out of time, or raised.
        MachineFaultError
            If a child cannot be started, or raises what no scene's data can cause.
        """
        limit_s = max(SHARE * (self._end - time.monotonic()), LEAST * self._limit_s, MIN_S)
        try:
            return self._child.call(
                _run_held, [index[rows] for index in self._indices], *masks, limit_s=limit_s)
        except ChildDiedError:
            self._begin()
            raise

    def _take(
        self, rows: NDArray[np.intp], part: CellsResult, stage: str = "",
        number: int | slice = slice(None),
    ) -> None:
        """Take over the results of scenes: all, or those of one configuration of a stage."""
        for variable in self._pipeline.experiment.variables:
            if stage in ("", variable.stage.name):
                self.cells.columns[variable.name][number, rows] = (
                    part.columns[variable.name][number])
        for name, seconds in part.seconds.items():
            if stage in ("", name):
                self.cells.seconds[name] = np.add(self.cells.seconds[name], seconds).tolist()
        self.cells.failures += [
            dataclasses.replace(each, scene=int(rows[each.scene])) for each in part.failures
            if stage in ("", each.stage)]

    def _compute_scene(self, row: int) -> None:
        """Compute a scene that crashes its process, never returns, or raises.

        Its parts are computed one after another, each in addition to those that it depends on:
        rendering, each detector setting, each estimator. The results of those that work are taken
        over, the others are flagged.
        """
        flags, need = self.cells.columns, self._need[row]
        unseen = self._lost(Failure(row, "scene", ""))
        for k in np.flatnonzero(need.any(axis=1)).tolist():
            lost = unseen or self._lost(Failure(row, "detection", "", k), k)
            if lost:
                flags["detection"][k][row] = DetectionStatus[lost]
            for j in np.flatnonzero(need[k]).tolist():
                number = k * need.shape[1] + j
                unsolved = "no_detection" if lost else self._lost(
                    Failure(row, "estimation", "", k, j), number)
                if unsolved:
                    flags["estimate"][number][row] = EstimateStatus[unsolved]
                    flags["flipped"][number][row] = Flipped.no_estimate

    def _lost(self, part: Failure, number: int = 0) -> str:
        """Compute a part of a scene, named as its failure would be; take over its results.

        Returns
        -------
        "crashed" or "failed" if there are none, which is noted; nothing otherwise.

        Raises
        ------
        MachineFaultError
            If a process is ended by a signal from outside.
        """
        need = np.zeros_like(self._need[:1])
        search = np.zeros_like(need[..., 0])
        if part.estimator is not None:
            need[0, part.setting, part.estimator] = True
        elif part.setting is not None:
            search[0, part.setting] = True
        row, lost = np.array([part.scene]), part
        for _ in range(DEATHS):
            try:
                self._take(row, self._run(row, need, search), part.stage, number)
            except ChildRaisedError as error:
                lost = dataclasses.replace(part, text=str(error))
                break
            except ChildDiedError as death:
                if death.from_outside:
                    at = selected(self._pipeline, [int(i[part.scene]) for i in self._indices], part)
                    raise local_fault(f"{death.line}; the scene is --at {at}") from None
                lost = dataclasses.replace(part, text=death.line, crashed=True)
            else:
                return ""
        self.cells.failures.append(lost)
        return "crashed" if lost.crashed else "failed"


@machine_faults_raised()
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
        Time limit of the block in seconds, shared as the comment above says.

    Raises
    ------
    MachineFaultError
        If no child process can be started, one raises what no scene's data can cause, or one that
        computes a single scene is ended by a signal from outside.
    """
    with Child() as child:
        isolated = _IsolatedCells(child, pipeline, indices, need, limit_s)
        isolated.compute(np.arange(len(need)))
        return isolated.cells


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


# --------------------------------------------------------------------------------------------------
# Plug-ins are used once before a run: one that cannot work refuses it, and costs no pose.

#: Seconds that a plug-in may take to be made, and to search one blank frame.
LIMIT_S = 60.0

#: Settings that are tried, of all plug-ins.
MAX_SETTINGS = 64


def check_plugins(child: Child, pipeline: Pipeline) -> None:
    """Use a pipeline's plug-ins in a child process, which goes on to work.

    Raises
    ------
    PluginError
        If one cannot be imported or made, raises on a blank frame, ends its process, or does not
        return; in one line.
    """
    if not pipeline.plugins:
        return
    try:
        child.call(use, pipeline, limit_s=LIMIT_S * len(pipeline.plugins))
    except ChildError as error:
        names = " or ".join(f"{plugin.kind} {plugin.name}" for plugin in pipeline.plugins)
        raise PluginError(f"{names}: {error.line}") from None


@single_threaded()
def use(pipeline: Pipeline) -> None:
    """Import plug-ins and make them with each of their settings; detectors search a blank frame.

    Raises
    ------
    PluginError
        If that cannot be done.
    """
    experiment = pipeline.experiment
    _ = experiment.scene_plugins
    width, height = (min(pipeline.values_of(side)) for side in ("width_px", "height_px"))
    blank = np.full((height, width), 128, dtype=np.uint8)
    searches = itertools.product(pipeline.values_of("dictionary"), (
        each for each in dict.fromkeys(experiment.detectors) if isinstance(each, PluginSetting)))
    for dictionary, setting in itertools.islice(searches, MAX_SETTINGS):
        make_detector(setting)(blank, dictionary, max(width, height))
    for solver in itertools.islice(dict.fromkeys(experiment.estimators), MAX_SETTINGS):
        build(solver)
