"""Verification of a store: every file checked, a sample of scenes recomputed; and its repair."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Container, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import ArgumentError, SweepError
from sweep.evaluation.results import CellsResult, to_dataset_layout
from sweep.execution import TIME_LIMIT_S
from sweep.execution.runner import recompute
from sweep.execution.status import close
from sweep.execution.waves import InWaves
from sweep.experiment.grid import Block
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline, selection_text
from sweep.integrity.reproduction import StoredValues, compare, computable, is_same, stored_values
from sweep.isolation.crash_isolation import run_cells_isolated
from sweep.measure.detectors import OPENCV
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.plugins.declared import PluginSetting
from sweep.processor import processor
from sweep.sampling.rules import scenes_needed
from sweep.store import blocks, files, lifecycle, lock
from sweep.store.blocks import Receipt, RunStore
from sweep.store.locations import translate_errors
from sweep.typing import Integers

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
        Stored files that belong to the store, and their size.
    sampled
        Scenes that were recomputed.
    not_sampled
        Why none was, if none was.
    damage
        Damages; none in a sound store.
    unstable
        The name of a plug-in or setting that gives other answers from call to call, or with the
        other scenes of a call, if recomputed scenes differ for that reason: no block is damaged. It
        is last in ``damage``.
    repaired
        Damages that have been repaired.
    left_over
        Files that do not belong to the store, such as those that a killed process was writing.
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
    left_over: list[str] = field(default_factory=list)
    processors: dict[str, int] = field(default_factory=dict)


# --------------------------------------------------------------------------------------------------
# Blocks: every chunk fits the checksum at its end, and the receipt lists the same.

#: Blocks that are read and checked at a time, and that are submitted at a time.
THREADS, WINDOW = 4, 256


def check_blocks(
    store: RunStore, numbers: Sequence[int], report: IntegrityReport
) -> dict[int, Receipt]:
    """Check blocks in several threads; return the receipts of those without damage, by number."""
    sound: dict[int, Receipt] = {}
    with ThreadPoolExecutor(THREADS) as pool:
        # A window at a time: there may be very many.
        for start in range(0, len(numbers), WINDOW):
            some = numbers[start : start + WINDOW]
            for size, receipt, damage in pool.map(partial(_checked_block, store), some):
                report.bytes += size
                report.damage += damage
                if receipt is not None and receipt.block is not None and not damage:
                    sound[receipt.block] = receipt
    report.processors = dict(Counter(
        name for receipt in sound.values() for name in receipt.processors))
    return sound


def _checked_block(store: RunStore, number: int) -> tuple[int, Receipt | None, list[Damage]]:
    """Return the size of a block's chunks, its receipt if that is sound, and the damages."""
    ((_, receipt, fault),) = blocks.receipts_or_faults(store, [number])
    faults = {blocks.receipt_key(number): fault} if fault else {}
    checksums = {} if receipt is None else receipt.checksums
    keys = {store.chunks.key(variable.name, number): variable.name for variable in store.variables}
    contents = files.read_files(store.storage, list(keys))
    for (key, name), content in zip(keys.items(), contents, strict=True):
        if content is None:
            faults[key] = "missing"
        elif not files.is_sound(content) or files.checksum_of(content) != checksums.get(
                name, files.checksum_of(content)):
            faults[key] = lifecycle.CHANGED
    size = sum(len(content or b"") for content in contents)
    return size, receipt, [Damage(key, what, number) for key, what in faults.items()]


def check_needed(store: RunStore, sound: Container[int], report: IntegrityReport) -> None:
    """Find blocks of a finished store that follow from other results of earlier waves than it has.

    Which of their scenes were needed is not what the rule says.
    """
    numbers = range(len(store.blocks))
    if store.pipeline.stopping is None or not all(number in sound for number in numbers):
        return
    current = InWaves(store).current
    report.damage += [
        Damage(f"block {store.blocks[number]}", "was computed for other results of earlier trials",
               number)
        for number in numbers if number not in current
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

#: Flags of scenes that are not recomputed: they ended their process.
CRASHED = {"detection": DetectionStatus.crashed, "estimate": EstimateStatus.crashed}

#: Number of a block, and of a scene within it.
Scene = tuple[int, int]


def check_scenes(
    store: RunStore, sample: int, sound: Mapping[int, Receipt], report: IntegrityReport
) -> None:
    """Recompute up to ``sample`` scenes of sound blocks.

    Raises
    ------
    MachineFaultError
        If this machine cannot compute them.
    """
    if not sample or not sound:
        report.not_sampled = (
            "there is no sound block" if sample else "a sample of 0 scenes was asked for")
        return
    metadata = {f"{variable.name}/zarr.json" for variable in store.variables}
    if unreadable := metadata & {each.where for each in report.damage}:
        report.not_sampled = f"{min(unreadable)} is damaged"
        return
    try:
        pipeline = computable(store)
    except SweepError as error:
        report.not_sampled = str(error).splitlines()[-1].strip()
        return
    names = [axis.name for axis in pipeline.experiment.scene_axes]
    drawn = {
        (number, scene): stored_values(store, {
            name: slice(k, k + 1)
            for name, k in zip(names, store.blocks[number].cell(scene), strict=True)})
        for number, scene in _drawn(store, sample, sound)
    }
    scenes = {
        scene: values for scene, values in drawn.items()
        if not any((values[name] == flag).any() for name, flag in CRASHED.items())
    }
    report.sampled = len(scenes)
    if not scenes:
        report.not_sampled = "every scene that was drawn had crashed"
        return
    computed = _recomputed(store, pipeline, list(scenes))
    damage = _compared(store, pipeline, scenes, computed, sound)
    if damage:
        report.unstable, example = _unstable(store, pipeline, list(scenes), computed)
        if report.unstable:
            damage = [Damage(report.unstable,
                             f"not deterministic: {report.unstable}: scenes that were recomputed "
                             f"twice on the same images differ, such as {example}")]
    report.damage += damage


def _drawn(store: RunStore, count: int, sound: Mapping[int, Receipt]) -> list[Scene]:
    """Draw needed scenes, each with the same probability, without repetitions, or all."""
    generator = np.random.default_rng()
    sizes = np.array([receipt.scenes_needed for receipt in sound.values()])

    def needed(number: int) -> Integers:
        return np.flatnonzero(scenes_needed(store, store.blocks[number]))

    if count >= sizes.sum():
        return [(number, row) for number in sound for row in needed(number).tolist()]
    numbers = generator.choice(np.array(list(sound)), size=count, p=sizes / sizes.sum())
    return sorted({(number, int(generator.choice(needed(number)))) for number in numbers.tolist()})


def _recomputed(store: RunStore, pipeline: Pipeline, scenes: Sequence[Scene]) -> CellsResult:
    """Recompute scenes in child processes."""
    cells = [store.blocks[block].cell(number) for block, number in scenes]
    indices = [np.array(index, dtype=np.intp) for index in zip(*cells, strict=True)]
    shape = (len(scenes), pipeline.size(Stage.detection), pipeline.size(Stage.estimation))
    return run_cells_isolated(pipeline, indices, np.ones(shape, dtype=bool), TIME_LIMIT_S)


def _compared(
    store: RunStore, pipeline: Pipeline, scenes: Mapping[Scene, StoredValues],
    computed: CellsResult, sound: Mapping[int, Receipt],
) -> list[Damage]:
    """Return the recomputed scenes that differ from the stored ones.

    On another processor few of them may.
    """
    found: list[tuple[bool, Damage]] = []
    elsewhere = 0
    axes = pipeline.experiment.scene_axes
    one = Block((0,) * len(axes), (1,) * len(axes))
    for row, (scene, stored) in enumerate(scenes.items()):
        values = {
            variable.name: to_dataset_layout(
                variable, pipeline, one, computed.columns[variable.name][:, row : row + 1])
            for variable in store.variables
        }
        same_processor = tuple(sound[scene[0]].processors) == (processor(),)
        elsewhere += not same_processor
        difference = compare(values, stored, store.variables, same_processor=same_processor)
        if difference:
            found.append((same_processor, Damage(
                _at(store, scene), f"recomputed, it differs: {difference}", scene[0])))
    few = max(MIN_OUTSIDE, MAX_OUTSIDE * elsewhere)
    tolerated = sum(not same_processor for same_processor, _ in found) <= few
    return [damage for same_processor, damage in found if same_processor or not tolerated]


def _unstable(
    store: RunStore, pipeline: Pipeline, scenes: list[Scene], computed: CellsResult
) -> tuple[str, str]:
    """Recompute scenes again and again; return the parts whose answers change, and a scene.

    Both are empty if none do. A detector or solver may change from call to call, or with the other
    scenes of a call; what comes after it changes, too.
    """
    rows = np.resize(np.arange(len(scenes)), REPEATED)
    again = _recomputed(store, pipeline, [scenes[row] for row in rows])
    for stage in Stage:
        changed = {
            configuration: int(rows[np.argmax(differ)])
            for variable in store.variables if variable.stage is stage
            for configuration, (first, second) in enumerate(zip(
                computed.columns[variable.name], again.columns[variable.name], strict=True))
            if (differ := _differing(first[rows], second)).any()
        }
        if changed:
            names = [_part(pipeline, stage, configuration) for configuration in sorted(changed)]
            return ", ".join(dict.fromkeys(names)), _at(store, scenes[min(changed.values())])
    return "", ""


def _differing(first: NDArray[Any], second: NDArray[Any]) -> NDArray[np.bool_]:
    """Return (N,) which rows of two arrays (N, ...) differ; NaN is equal to NaN."""
    return np.asarray(~is_same(first, second).reshape(len(first), -1).all(axis=1))


def _part(pipeline: Pipeline, stage: Stage, configuration: int) -> str:
    """Return the name of the plug-in or setting of a configuration's stage, as far as known."""
    experiment = pipeline.experiment
    if stage is Stage.estimation:
        return experiment.estimators[configuration % len(experiment.estimators)].solver
    setting = experiment.detectors[configuration] if stage is Stage.detection else None
    if isinstance(setting, PluginSetting):
        return setting.plugin.name
    drawing = [each.name for each in pipeline.plugins if each.kind in {"effect", "renderer"}]
    return " or ".join(drawing) or (OPENCV if stage is Stage.detection else "the renderer")


def _at(store: RunStore, scene: Scene) -> str:
    """Return a scene as ``sweep repro`` takes it."""
    block, number = scene
    names = (axis.name for axis in store.pipeline.experiment.scene_axes)
    index = dict(zip(names, store.blocks[block].cell(number), strict=True))
    return "--at " + selection_text(store.pipeline, index)


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
        Scenes that are drawn at random and recomputed.

    Raises
    ------
    StoreError
        If there is no store, or so little of one that its pipeline is lost.
    """
    if sample < 0:
        raise ArgumentError("sample", sample, "expected at least 0")
    return report_on(lifecycle.open_unchecked(url), sample)


def report_on(store: RunStore, sample: int) -> IntegrityReport:
    """Check a store, and recompute up to ``sample`` scenes; none with a sample of 0."""
    done = blocks.committed(store)
    report = IntegrityReport(store.url, store.finished, len(store.blocks), len(done))
    numbers: Sequence[int] = range(len(store.blocks)) if report.finished else sorted(done)
    listed, others = _listed(store, numbers if report.finished else done)
    listing = lifecycle.read_listed(store, tables=True)
    others -= {"zarr.json", *listing, *map(blocks.receipt_key, numbers)}
    others = {key for key in others if not key.startswith(f"{lock.LOCKS}/")}
    report.files = listed - len(others)
    report.bytes = sum(len(content or b"") for content in listing.values())
    faults = lifecycle.changed_files(store, listing)
    report.damage = [Damage(key, fault) for key, fault in faults.items()]
    if not lifecycle.is_root_sound(store):
        report.damage.append(Damage("zarr.json", lifecycle.CHANGED))
    sound = check_blocks(store, numbers, report)
    if report.finished:
        check_needed(store, sound, report)
    check_scenes(store, sample, sound, report)
    if not lock.is_written(store.storage):
        # Of an unfinished store, no file of a block that a run will write again.
        report.left_over = sorted(key for key in others if report.finished or not (
            key.startswith(f"{blocks.BEGUN}/") or store.chunks.number(key) is not None))
    return report


def _listed(store: RunStore, checked: Container[int]) -> tuple[int, set[str]]:
    """Return how many files there are, and the keys of those that are no chunk of a checked block.

    There may be 25 million files.
    """
    async def others() -> tuple[int, set[str]]:
        count, left = 0, set()
        async for key in store.storage.list_prefix(""):
            count += 1
            number = store.chunks.number(key)
            if number is None or number not in checked:
                left.add(key)
        return count, left

    return files.sync(others())


# --------------------------------------------------------------------------------------------------
# Repair: damaged blocks are recomputed, other damaged files are written again.

def repair(
    url: str, sample: int = SAMPLE, *, workers: int | None = None,
    time_limit_s: float | None = None,
) -> IntegrityReport:
    """Verify a store and repair it: exactly the damaged blocks are recomputed.

    Parameters
    ----------
    url
        The store.
    sample
        Scenes that are recomputed and compared before the repair.
    workers
        Processes that recompute blocks; by default, one a processor.
    time_limit_s
        Block timeout in seconds.

    Returns
    -------
    IntegrityReport
        The state after the repair; ``repaired`` lists the damage before it.

    Raises
    ------
    StoreError
        If there is no store, it cannot be written, or its blocks would be different here.
    RunError
        If blocks failed.
    """
    store = lifecycle.open_unchecked(url, "r+")
    before = report_on(store, sample)
    lasting = [each for each in before.damage if before.unstable and each.where == before.unstable]
    if before.damage == lasting and not before.left_over:
        return before
    numbers = sorted({damage.block for damage in before.damage if damage.block is not None})
    if numbers:
        computable(store)
    with lock.changing(url, store.storage):
        with translate_errors(url, "written"):
            files.delete_files(store.storage, before.left_over)
            _rewrite(store, {each.where for each in before.damage if each.block is None})
        store = lifecycle.open_store(url, "r+")
        for number in numbers:
            blocks.drop_block(store, store.blocks[number])
        if numbers:
            recompute(store, numbers, workers=workers, time_limit_s=time_limit_s)
        if store.finished:
            close(store)
    after = report_on(lifecycle.open_unchecked(url), 0)
    after.sampled, after.not_sampled = before.sampled, before.not_sampled
    after.unstable, after.damage = before.unstable, after.damage + lasting
    remaining = {damage.where for damage in after.damage}
    after.repaired = [damage for damage in before.damage if damage.where not in remaining]
    return after


def _rewrite(store: RunStore, keys: Collection[str]) -> None:
    """Write the files of these keys that follow from the pipeline; delete tables.

    A finished store's tables are written when it is closed again, but for what was measured.
    """
    arrays = lifecycle.planned_arrays(store.pipeline, store.blocks.extents)
    planned = lifecycle.planned_files(arrays)
    again = {key: planned[key] for key in keys if key in planned}
    files.write_files(store.storage, again)
    metadata = store.run_metadata
    listed = metadata["files"] | lifecycle.checksums(again)
    for group in lifecycle.MEASURED:
        if any(key.startswith(f"{group}/") for key in keys):
            files.delete_folder(store.storage, group)
            listed = {key: crc for key, crc in listed.items() if not key.startswith(f"{group}/")}
    files.delete_files(store.storage, filter(lifecycle.is_of_table, keys))
    lifecycle.write_root(store, {**metadata, "files": listed})
