"""Cells of a store computed again: all of it verified and repaired, and a cell reproduced."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sweep import errors
from sweep.evaluation import results
from sweep.evaluation.inspection import SceneInspection, inspect_scene, scene_image
from sweep.evaluation.results import CellsResult, Failure, compare, is_same, to_dataset_layout
from sweep.execution import TIME_LIMIT_S
from sweep.execution.runner import execute
from sweep.execution.status import close
from sweep.execution.waves import InWaves
from sweep.experiment.grid import Block
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline, cell, parse_selection, selection_text
from sweep.isolation.child_process import Child, ChildError
from sweep.isolation.crash_isolation import run_cells_isolated
from sweep.measure.detectors import OPENCV, PluginSetting
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.messages import nearest, plain
from sweep.sampling.rules import scenes_needed
from sweep.store import blocks, files, lifecycle
from sweep.store.blocks import Receipt, RunStore
from sweep.store.provenance import differences, excerpt

# --------------------------------------------------------------------------------------------------
# Values as a store holds them, and the pipeline with which they are recomputed.

StoredValues = dict[str, NDArray[Any]]


def values_at(
    store: RunStore, array_of: Callable[[str], Any], index: Mapping[str, int | slice]
) -> StoredValues:
    """Return every variable's array at an index along axes; axes that it does not name are whole.

    ``array_of`` gives the array of a variable, in its own dimensions.
    """
    return {
        variable.name: np.asarray(array_of(variable.name)[tuple(
            index.get(name, slice(None)) for name in variable.dimensions(store.pipeline))])
        for variable in store.variables
    }


def current_pipeline(store: RunStore) -> tuple[Pipeline, list[str]]:
    """Return a store's pipeline with the files and versions of this machine, and what changed.

    Raises
    ------
    PipelineError
        If it cannot be computed at all, for want of a file, say.
    """
    pipeline = lifecycle.read_pipeline(store.pipeline)
    return pipeline, differences(pipeline, store.pipeline, store.fingerprint)


# --------------------------------------------------------------------------------------------------
# Findings of a verification, in one record that each check adds to.


@dataclass(frozen=True, slots=True)
class Damage:
    """A damage of a store.

    Attributes
    ----------
    where
        A key, an array, a block's name, a scene as ``sweep repro`` takes it, or a part's name.
    what
        The fault.
    block
        Number of the block that is damaged, None if none is.
    """

    where: str
    what: str
    block: int | None = None


@dataclass(slots=True)
class IntegrityReport:
    """The result of a verification.

    Attributes
    ----------
    store
        The store's URL.
    finished
        Whether the store is finished.
    blocks, blocks_done
        Blocks of the grid, and how many are committed.
    files, bytes
        Files that were read, and the size of the blocks' chunks.
    sampled
        Scenes that were recomputed.
    not_sampled
        Why none was, if none was.
    damage
        Damages; none in a sound store.
    unstable
        The name of a plug-in or setting that gives other answers from call to call, or with the
        other scenes of a call, if recomputed scenes differ for that reason: no block is damaged.
    repaired
        Damages that have been repaired.
    processors
        Features of the processors that computed the blocks -> how many blocks.
    """

    store: str
    finished: bool
    blocks: int
    blocks_done: int
    files: int = 0
    bytes: int = 0
    sampled: int = 0
    not_sampled: str = ""
    damage: list[Damage] = field(default_factory=list)
    unstable: str = ""
    repaired: list[Damage] = field(default_factory=list)
    processors: dict[str, int] = field(default_factory=dict)


# --------------------------------------------------------------------------------------------------
# Blocks: every chunk fits the checksum at its end, and the receipt lists the same.

def check_blocks(
    store: RunStore, numbers: Sequence[int], report: IntegrityReport
) -> dict[int, Receipt]:
    """Check every file of blocks; return the receipts of those without damage, by number."""
    sound: dict[int, Receipt] = {}
    for number, receipt in blocks.receipts_or_faults(store, numbers):
        names = {store.chunk_key(variable.name, number): variable.name
                 for variable in store.variables}
        faults = {}
        if isinstance(receipt, str):
            faults[blocks.receipt_key(number)] = receipt
        for key, content in zip(names, files.read_files(store.storage, list(names)), strict=True):
            if content is None:
                faults[key] = "missing"
            elif not files.is_sound(content) or (not isinstance(receipt, str) and (
                    files.checksum_of(content) != receipt.checksums.get(names[key]))):
                faults[key] = files.CHANGED
            report.bytes += len(content or b"")
        report.files += 1 + len(names)
        report.damage += [Damage(key, what, number) for key, what in faults.items()]
        if not isinstance(receipt, str) and not faults:
            sound[number] = receipt
    report.processors = dict(Counter(
        name for receipt in sound.values() for name in receipt.processors))
    return sound


def check_needed(store: RunStore, sound: Mapping[int, Receipt], report: IntegrityReport) -> None:
    """Find blocks of a finished store that follow from other results of earlier waves than it has.

    Which of their scenes were needed is not what the rule says.
    """
    if store.pipeline.stopping is None or len(sound) < len(store.blocks):
        return
    current = InWaves(store).current
    report.damage += [
        Damage(f"block {store.blocks[number]}", "was computed for other results of earlier trials",
               number)
        for number in sound if number not in current
    ]


# --------------------------------------------------------------------------------------------------
# Scenes of sound blocks that are recomputed and compared.

#: Largest share of the scenes recomputed on another processor that may differ.
MAX_OUTSIDE = 0.1

#: That many scenes may differ however few were recomputed on another processor.
MIN_OUTSIDE = 2

#: Scenes that are recomputed, in turns, where a recomputed one differs. They are searched and
#: solved in calls of several scenes, where the first time each scene has calls of its own.
REPEATED = 128


class Scene(NamedTuple):
    """A stored scene: its block, its indices along the scene axes, its values.

    Every bit has to agree (``exact``) if a processor with the features of this one computed it.
    """

    block: int
    cell: tuple[int, ...]
    stored: StoredValues
    exact: bool


def check_scenes(
    store: RunStore, sample: int, sound: Mapping[int, Receipt], report: IntegrityReport
) -> None:
    """Recompute up to ``sample`` scenes of sound blocks.

    Raises
    ------
    MachineFaultError
        If this machine cannot compute them.
    """
    unreadable = {f"{variable.name}/zarr.json" for variable in store.variables}.intersection(
        each.where for each in report.damage)
    if unreadable or not sample or not sound:
        report.not_sampled = f"{min(unreadable)} is damaged" if unreadable else (
            "there is no sound block" if sample else "a sample of 0 scenes was asked for")
        return
    try:
        pipeline, changes = current_pipeline(store)
    except errors.SweepError as error:
        changes = str(error).splitlines()
    scenes = [] if changes else _drawn(store, sample, sound)
    if not scenes:
        report.not_sampled = changes[-1].strip() if changes else (
            "every scene that was drawn had crashed")
        return
    report.sampled = len(scenes)
    computed = _recomputed(pipeline, [scene.cell for scene in scenes])
    damage = _compared(store, scenes, computed)
    report.unstable = _changing(pipeline, scenes, computed) if damage else ""
    report.damage += [] if report.unstable else damage


def _drawn(store: RunStore, count: int, sound: Mapping[int, Receipt]) -> list[Scene]:
    """Draw needed scenes, each with the same probability, without repetitions, or all.

    Those that ended their process are left out.
    """
    generator = np.random.default_rng()
    sizes = np.array([receipt.scenes_needed for receipt in sound.values()])
    everything = count >= sizes.sum()
    numbers = list(sound) if everything else generator.choice(
        np.array(list(sound)), size=count, p=sizes / sizes.sum()).tolist()
    drawn = set()
    for number in numbers:
        block = store.blocks[number]
        needed = np.flatnonzero(scenes_needed(store, block))
        rows = needed if everything else [generator.choice(needed)]
        drawn |= {(number, block.cell(int(row))) for row in rows}
    names = [axis.name for axis in store.pipeline.experiment.scene_axes]
    scenes = [
        Scene(number, cell, values_at(
            store, store.array,
            {name: slice(k, k + 1) for name, k in zip(names, cell, strict=True)}),
            tuple(sound[number].processors) == (results.processor(),))
        for number, cell in sorted(drawn)
    ]
    return [scene for scene in scenes
            if DetectionStatus.crashed not in scene.stored["detection"]
            and EstimateStatus.crashed not in scene.stored["estimate"]]


def _recomputed(
    pipeline: Pipeline, cells: Sequence[Sequence[int]], limit_s: float = TIME_LIMIT_S,
    only: tuple[int, int] | None = None,
) -> CellsResult:
    """Recompute scenes in child processes, all configurations or ``only`` setting and estimator."""
    shape = (len(cells), pipeline.size(Stage.detection), pipeline.size(Stage.estimation))
    need = np.full(shape, only is None)
    if only is not None:
        need[:, *only] = True
    return run_cells_isolated(pipeline, list(np.array(cells, dtype=np.intp).T), need, limit_s)


def _scene_values(store: RunStore, computed: CellsResult, row: int) -> StoredValues:
    """Return every variable of a recomputed scene as the store lays it out, scene axes of 1."""
    axes = len(store.pipeline.experiment.scene_axes)
    one = Block((0,) * axes, (1,) * axes)
    return {
        variable.name: to_dataset_layout(
            variable, store.pipeline, one, computed.columns[variable.name][:, row : row + 1])
        for variable in store.variables
    }


def _compared(store: RunStore, scenes: Sequence[Scene], computed: CellsResult) -> list[Damage]:
    """Return the recomputed scenes that differ from the stored ones.

    On another processor few of them may.
    """
    names = [axis.name for axis in store.pipeline.experiment.scene_axes]
    found: list[tuple[bool, Damage]] = []
    for row, scene in enumerate(scenes):
        values = _scene_values(store, computed, row)
        if difference := compare(
                values, scene.stored, store.variables, same_processor=scene.exact):
            at = selection_text(store.pipeline, dict(zip(names, scene.cell, strict=True)))
            found.append((scene.exact, Damage(
                f"--at {at}", f"recomputed, it differs: {difference}", scene.block)))
    elsewhere = sum(not scene.exact for scene in scenes)
    few = sum(not exact for exact, _ in found) <= max(MIN_OUTSIDE, MAX_OUTSIDE * elsewhere)
    return [damage for exact, damage in found if exact or not few]


def _changing(pipeline: Pipeline, scenes: Sequence[Scene], computed: CellsResult) -> str:
    """Recompute scenes again and again; return the first part whose answers change, if one does.

    A detector or solver may change from call to call, or with the other scenes of a call; what
    comes after it changes, too.
    """
    rows = np.resize(np.arange(len(scenes)), REPEATED)
    again = _recomputed(pipeline, [scenes[row].cell for row in rows.tolist()])
    experiment = pipeline.experiment
    for variable in sorted(experiment.variables, key=lambda variable: variable.stage):
        first, second = computed.columns[variable.name][:, rows], again.columns[variable.name]
        changed = np.argwhere(~is_same(first, second))
        if not len(changed):
            continue
        number = int(changed[0][0])
        if variable.stage is Stage.estimation:
            return experiment.estimators[number % len(experiment.estimators)].solver
        setting = experiment.detectors[number] if variable.stage is Stage.detection else None
        if isinstance(setting, PluginSetting):
            return setting.plugin.name
        drawing = [each.name for each in pipeline.plugins if each.kind in {"effect", "renderer"}]
        return " or ".join(drawing) or OPENCV
    return ""


# --------------------------------------------------------------------------------------------------
# Verification of a store: its files, its blocks, and a sample.

#: Scenes that are recomputed by default.
SAMPLE = 20


def verify(url: str, sample: int = SAMPLE) -> IntegrityReport:
    """Check every file by its checksum, metadata by the pipeline, and recompute a sample.

    Parameters
    ----------
    url
        The store.
    sample
        Scenes that are drawn at random and recomputed; none with a sample of 0.

    Raises
    ------
    StoreError
        If there is no store, or so little of one that its pipeline is lost.
    """
    if sample < 0:
        raise errors.ArgumentError("sample", sample, "expected at least 0")
    store = lifecycle.open_unchecked(url)
    done = blocks.committed(store)
    report = IntegrityReport(store.url, store.finished, len(store.blocks), len(done))
    report.files = 1 + len(store.run_metadata["files"])
    report.damage = [Damage(key, fault) for key, fault
                     in lifecycle.damaged_files(store, tables=True).items()]
    if not lifecycle.is_root_sound(store):
        report.damage.append(Damage("zarr.json", files.CHANGED))
    numbers: Sequence[int] = range(len(store.blocks)) if report.finished else sorted(done)
    sound = check_blocks(store, numbers, report)
    if report.finished:
        check_needed(store, sound, report)
    check_scenes(store, sample, sound, report)
    return report


# --------------------------------------------------------------------------------------------------
# Repair: damaged blocks are dropped, all other files written again, and a run does the rest.

def repair(url: str, sample: int = SAMPLE, *, workers: int | None = None) -> IntegrityReport:
    """Verify a store and repair it: exactly the damaged blocks are dropped, and run again.

    Those of an unfinished store are left to the run that continues it.

    Parameters
    ----------
    url
        The store.
    sample
        Scenes that are recomputed and compared before the repair.
    workers
        Processes that recompute blocks; by default, one a processor.

    Returns
    -------
    IntegrityReport
        The state after the repair; ``repaired`` lists the damage before it.

    Raises
    ------
    ArgumentError
        If an argument is out of its range; nothing is dropped.
    StoreError
        If there is no store, it cannot be written, or its blocks would be different here.
    RunError
        If blocks failed.
    """
    errors.check_positive("workers", workers)
    before = verify(url, sample)
    if not before.damage:
        return before
    numbers = sorted({damage.block for damage in before.damage if damage.block is not None})
    store = lifecycle.open_unchecked(url, "r+")
    pipeline, changes = current_pipeline(store) if numbers else (store.pipeline, [])
    if changes:
        raise errors.StoreError(
            "\n".join([f"{store.url}: cannot be recomputed on this machine:", *changes]))
    store = lifecycle.reopen(store, drop=numbers)
    if before.finished and numbers:
        execute(pipeline, url, workers=workers, yes=True)
    elif before.finished:
        close(store)
    after = replace(verify(url, 0), sampled=before.sampled, not_sampled=before.not_sampled,
                    unstable=before.unstable)
    remaining = {damage.where for damage in after.damage}
    after.repaired = [damage for damage in before.damage if damage.where not in remaining]
    return after


# --------------------------------------------------------------------------------------------------
# One cell of a store: recomputed, compared with the stored one, and drawn.

@dataclass(frozen=True, slots=True)
class Reproduction:
    """A cell that was recomputed.

    Attributes
    ----------
    at
        Its value of every axis, as text.
    recomputed, stored
        Variable -> value, of the dimensions that are no axes; ``stored`` is None if the block is
        not committed.
    difference
        How the two differ; empty if they do not, or nothing is stored.
    exact
        Whether every bit had to agree: on a processor with the same features, and without
        ``changes``. Else the tolerances apply.
    seconds
        Stage -> seconds that it took.
    failures
        Exceptions that were raised, and deaths of the process.
    changes
        Versions and files that have changed since the store was created.
    pipeline
        The store's.
    inspection
        The inspected scene; None if its inspection raises or ends its process.
    image
        (h, w) grey levels; None if rendering raises or ends its process.
    unneeded
        Whether the block is committed and the trial was not needed: nothing of it is stored.
    """

    at: str
    recomputed: StoredValues
    stored: StoredValues | None
    difference: str
    exact: bool
    seconds: dict[str, float]
    failures: list[Failure]
    changes: list[str]
    pipeline: Pipeline
    inspection: SceneInspection | None
    image: NDArray[np.uint8] | None
    unneeded: bool = False


def reproduce(
    url: str, chosen: Sequence[str], *, whole_frame: bool = False, time_limit_s: float = 60.0
) -> list[Reproduction]:
    """Recompute cells of a store in child processes, and compare them with the stored ones.

    Parameters
    ----------
    url
        The store.
    chosen
        For each cell a value of each axis, such as "distance_m=0.3,solver=ippe"; the first one of
        axes that it does not name.
    whole_frame
        Whether the image shows the whole frame, not the marker's surroundings alone.
    time_limit_s
        Timeout in seconds for each cell.

    Raises
    ------
    PipelineError
        If one is not on the store's grid; no cell is computed.
    StoreError
        If there is no store.
    """
    store = lifecycle.open_store(url)
    pipeline, changes = current_pipeline(store)
    done = blocks.check_whole(store)
    return [
        _reproduced(store, pipeline, changes, index, done, whole_frame, time_limit_s)
        for index in [_index(pipeline, at) for at in chosen]
    ]


def _reproduced(
    store: RunStore, pipeline: Pipeline, changes: list[str], index: dict[str, int],
    done: Container[int], whole_frame: bool, time_limit_s: float,
) -> Reproduction:
    """Recompute the cell at an index along the axes; ``done`` has the committed blocks."""
    corner = tuple(index[axis.name] for axis in pipeline.experiment.scene_axes)
    setting, estimator = (
        int(np.ravel_multi_index([index[axis.name] for axis in axes], [*map(len, axes)]))
        if axes else 0
        for axes in map(pipeline.axes_of, (Stage.detection, Stage.estimation))
    )
    cells = _recomputed(pipeline, [corner], time_limit_s, (setting, estimator))
    within = index | {axis.name: 0 for axis in pipeline.experiment.scene_axes}
    recomputed = values_at(store, _scene_values(store, cells, 0).__getitem__, within)
    number, stored, exact, unneeded = store.blocks.number(Block(corner, corner)), None, False, False
    if number in done:
        _, receipt = next(blocks.receipts(store, [number]))
        values = values_at(store, store.array, index)
        unneeded = bool(values["detection"] == DetectionStatus.not_needed)
        stored = None if unneeded else values
        exact = not (unneeded or changes) and tuple(receipt.processors) == (results.processor(),)
    difference = "" if stored is None else compare(
        recomputed, stored, store.variables, same_processor=exact
    )
    full_at = selection_text(pipeline, index)
    inspected, image = _inspected(cell(pipeline, full_at), whole_frame, time_limit_s)
    return Reproduction(
        full_at, recomputed, stored, difference, exact,
        {stage: sum(seconds) for stage, seconds in cells.seconds.items()},
        cells.failures, changes, pipeline, inspected, image, unneeded,
    )


def _index(pipeline: Pipeline, at: str) -> dict[str, int]:
    """Return the index of a cell along each axis."""
    index = {axis.name: 0 for axis in pipeline.axes}
    faults = []
    named = parse_selection(at, pipeline)
    for name, value in named.items():
        axis = pipeline.axis_of(name)
        if axis is None:
            names = [name for other in pipeline.axes for name in other.columns]
            advice = nearest(name, names) or f"; its axes are {', '.join(names) or 'none'}"
            faults.append(f"--at {name}: not an axis of the store{advice}")
        elif (row := axis.index_of(named)) is not None:
            index[axis.name] = row
        else:
            faults.append(f"--at {name}={plain(value)}: not on the grid; its values are "
                          f"{excerpt(axis.values)}")
    if faults:
        raise errors.PipelineError(faults)
    return index


def _inspected(
    cell_pipeline: Pipeline, whole_frame: bool, limit_s: float
) -> tuple[SceneInspection | None, NDArray[np.uint8] | None]:
    """Return the inspected scene and its image; None for one that raises or ends its process."""
    for function in (inspect_scene, scene_image):
        with contextlib.suppress(ChildError, errors.RunError), Child() as child:
            found: Any = child.call(
                partial(function, cell_pipeline, whole_frame=whole_frame), limit_s=limit_s)
            return (found, found.image) if function is inspect_scene else (None, found)
    return None, None
