"""Verification of a store: every file is read and checked, a sample of scenes recomputed."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Container, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import ArgumentError, SweepError
from sweep.evaluation.results import CellsResult, to_dataset_layout
from sweep.execution.limits import TIME_LIMIT_S
from sweep.execution.progress import InWaves
from sweep.experiment.cell_selection import selection_text
from sweep.experiment.grid import Block
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.integrity.recomputation import (
    StoredValues,
    compare,
    computable,
    is_same,
    stored_scene,
)
from sweep.isolation.crash_isolation import run_cells_isolated
from sweep.measure.detectors import OPENCV
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.plugins.declared import PluginSetting
from sweep.processor import processor
from sweep.sampling.rules import make_rule, scenes_needed
from sweep.store.blocks import BEGUN, UNPARSED, RunStore, committed, parsed_receipt
from sweep.store.chunks import receipt_key
from sweep.store.files import read_files, read_json, sync
from sweep.store.layout import checksum_of, documents, is_sound, planned_arrays
from sweep.store.lifecycle import (
    GROUPS,
    changed_coordinates,
    read_attributes,
    root_attributes,
    schema_faults,
    store_of,
)
from sweep.store.locations import open_storage
from sweep.store.lock import LOCKS, is_written
from sweep.store.provenance import environment
from sweep.store.receipt import Receipt

# --------------------------------------------------------------------------------------------------
# What a verification finds, in one record that each check adds to.


@dataclass(frozen=True, slots=True)
class Damage:
    """What is damaged.

    Attributes
    ----------
    where
        A key, an array, a block's name, a scene as ``sweep repro`` takes it, or a part's name.
    what
        What is wrong.
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
        What is damaged; empty for a sound store.
    unstable
        The name of what gives other answers from call to call, or with the other scenes of a call,
        if recomputed scenes differ for that reason: no block is damaged. It is last in ``damage``.
    repaired
        What was damaged and has been repaired.
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

    def to_json(self) -> dict[str, Any]:
        """Return the report as ``sweep verify --json`` prints it."""
        return asdict(self)


# --------------------------------------------------------------------------------------------------
# Blocks: every chunk fits the checksum at its end, and the receipt lists the same.

THREADS, WINDOW = 4, 256
"""Blocks that are read and checked at a time, and that are submitted at a time."""

CHANGED = "changed: does not fit its checksum"


def check_blocks(
    store: RunStore, numbers: Sequence[int], report: IntegrityReport
) -> dict[int, Receipt]:
    """Check blocks in several threads; return the receipts of those without damage, by number."""
    sound: dict[int, Receipt] = {}
    processors: Counter[str] = Counter()
    with ThreadPoolExecutor(THREADS) as pool:
        # A window at a time: there may be very many.
        for start in range(0, len(numbers), WINDOW):
            some = numbers[start : start + WINDOW]
            checked = pool.map(partial(_checked_block, store), some)
            for number, (size, receipt, damage) in zip(some, checked, strict=True):
                report.bytes += size
                report.damage += damage
                if receipt is not None and not damage:
                    processors.update(receipt.processors)
                    sound[number] = receipt
    report.processors = dict(processors)
    return sound


def _checked_block(store: RunStore, number: int) -> tuple[int, Receipt | None, list[Damage]]:
    """Return the size of a block's files, its receipt if that is sound, and what is damaged."""
    key, chunks = receipt_key(number), store.chunks.keys(number)
    content, *contents = read_files(store.storage, [key, *chunks.values()])
    receipt, faults = None, {}
    try:
        receipt = parsed_receipt(store, number, content)
    except UNPARSED as error:
        faults[key] = "missing" if content is None else f"changed: {error}"
    for (name, chunk), values in zip(chunks.items(), contents, strict=True):
        if values is None:
            faults[chunk] = "missing"
        elif not is_sound(values) or (
            receipt is not None and receipt.checksums.get(name) != checksum_of(values)
        ):
            faults[chunk] = CHANGED
    size = sum(len(each or b"") for each in (content, *contents))
    return size, receipt, [Damage(key, what, number) for key, what in faults.items()]


def check_needed(store: RunStore, sound: Container[int], report: IntegrityReport) -> None:
    """Find blocks of a finished store that follow from other results of earlier waves than it has.

    Which of their scenes were needed is not what the rule says.
    """
    rule, sampling = store.pipeline.stopping, make_rule(store.pipeline)
    numbers = range(len(store.blocks))
    if rule is None or sampling is None or not all(number in sound for number in numbers):
        return
    current = InWaves(store, rule, sampling).current
    report.damage += [
        Damage(f"block {store.blocks[number]}", "was computed for other results of earlier trials",
               number)
        for number in numbers if number not in current
    ]


# --------------------------------------------------------------------------------------------------
# Files outside the blocks: metadata, coordinates, tables of the run.

TABLES = ("cost", "failures")
"""Groups that a finished store has."""


def check_files(store: RunStore, report: IntegrityReport) -> set[str]:
    """Check the files that belong to the store and to no block; return their keys."""
    planned = planned_arrays(store.pipeline, store.blocks.extents)
    root = read_json(store.storage, "zarr.json") or {}
    copies = _copies(root)
    groups = [name for name in GROUPS if report.finished or name not in TABLES]
    tables = [path for path in copies if path.startswith(tuple(f"{name}/" for name in TABLES))]
    paths = list(dict.fromkeys([*(each.path for each in planned), *groups, *tables]))
    stored = {path: read_json(store.storage, f"{path}/zarr.json") for path in paths}

    # Another version of sweep or of Zarr may word documents otherwise.
    own = store.run_metadata["environment"].get("sweep") == environment()["sweep"]
    expected = documents(planned) if own else {}
    faults = schema_faults(store)
    for path, document in stored.items():
        wanted = expected.get(f"{path}/zarr.json", copies.get(path, document))
        if document is None or document != wanted:
            faults.setdefault(path, "missing or changed")
    found = {f"{path}/zarr.json" if path in stored else path: fault
             for path, fault in faults.items()}

    attributes = root_attributes(store.pipeline, planned, store.run_metadata)
    if own and any(root["attributes"].get(name) != value for name, value in attributes.items()):
        found["zarr.json"] = "its attributes differ from the pipeline's"
    elif report.finished and not faults and any(
        copies.get(path) != document for path, document in stored.items()
    ):
        found["zarr.json"] = "its copy of the metadata differs from the arrays' own"

    sound = [each for each in planned if each.path not in faults]
    chunks = {key for each in planned for key, _, _ in each.pieces()}
    found |= changed_coordinates(store, sound)
    for path in tables:
        if path not in faults and (stored[path] or {}).get("node_type") == "array":
            read = dict(_read_table(store, path))
            chunks |= read.keys()
            found |= {key: fault for key, fault in read.items() if fault}
    keys = {"zarr.json", *(f"{path}/zarr.json" for path in stored), *chunks}
    report.damage += [Damage(key, fault) for key, fault in found.items()]
    report.bytes += sum(len(each or b"") for each in read_files(store.storage, sorted(keys)))
    return keys


def _copies(root: Mapping[str, Any]) -> dict[str, Any]:
    """Return the root's copy of all metadata by path; empty of an unfinished store."""
    try:
        copies = dict(root["consolidated_metadata"]["metadata"])
        return {path: {key: value for key, value in copy.items() if key != "consolidated_metadata"}
                for path, copy in copies.items()}
    except (AttributeError, KeyError, TypeError, ValueError):
        return {}


def _read_table(store: RunStore, path: str) -> Iterator[tuple[str, str]]:
    """Yield the key of each chunk of an array of a table, and how it is damaged if it is."""
    array: Any = store.group[path]
    counts = [math.ceil(size / chunk) for size, chunk in zip(
        array.shape, array.chunks, strict=True)]
    for number in itertools.product(*map(range, counts)):
        key = f"{path}/{array.metadata.encode_chunk_key(number)}"
        (content,) = read_files(store.storage, [key])
        yield key, "missing" if content is None else "" if is_sound(content) else CHANGED


# --------------------------------------------------------------------------------------------------
# Scenes of sound blocks that are recomputed and compared.

MAX_OUTSIDE = 0.1
"""Largest share of the scenes recomputed on another processor that may differ."""

MIN_OUTSIDE = 2
"""That many scenes may differ however few were recomputed on another processor."""

REPEATED = 128
"""Scenes that are recomputed, in turns, where a recomputed one differs. They are searched and
solved in calls of several scenes, where the first time each scene has calls of its own."""

CRASHED = {"detection": DetectionStatus.crashed, "estimate": EstimateStatus.crashed}
"""Flags of scenes that are not recomputed: they ended their process."""

Scene = tuple[int, int]
"""Number of a block, and of a scene within it."""


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
    try:
        pipeline = computable(store)
    except SweepError as error:
        report.not_sampled = str(error).splitlines()[-1].strip()
        return
    drawn = {scene: stored_scene(store, *scene) for scene in _drawn(store, sample, sound)}
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
    """Draw needed scenes, each with the same probability, without repetitions."""
    generator = np.random.default_rng()
    sizes = np.array([receipt.scenes_needed for receipt in sound.values()])
    if not sizes.any():
        return []
    numbers = generator.choice(np.array(list(sound)), size=count, p=sizes / sizes.sum())
    return sorted({
        (number, int(generator.choice(np.flatnonzero(scenes_needed(store, store.blocks[number])))))
        for number in numbers.tolist()
    })


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
    damage: list[Damage] = []
    elsewhere: list[Damage] = []
    other_processor = 0
    axes = pipeline.experiment.scene_axes
    one = Block((0,) * len(axes), (1,) * len(axes))
    for row, (scene, stored) in enumerate(scenes.items()):
        values = {
            variable.name: to_dataset_layout(
                variable, pipeline, one,
                [column[row : row + 1] for column in computed.columns[variable.name]])
            for variable in store.variables
        }
        same_processor = tuple(sound[scene[0]].processors) == (processor(),)
        other_processor += not same_processor
        difference = compare(values, stored, store.variables, same_processor=same_processor)
        if difference:
            (damage if same_processor else elsewhere).append(Damage(
                _at(store, scene), f"recomputed, it differs: {difference}", scene[0]))
    few = len(elsewhere) <= max(MIN_OUTSIDE, MAX_OUTSIDE * other_processor)
    return damage if few else damage + elsewhere


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
    """Return the name of what computes a configuration of a stage, as far as can be told."""
    if stage is Stage.estimation:
        settings = pipeline.experiment.estimators
        return settings[configuration % len(settings)].solver
    if stage is Stage.detection:
        setting = pipeline.experiment.detectors[configuration]
        if isinstance(setting, PluginSetting):
            return setting.plugin.name
    drawing = [each.name for each in pipeline.plugins if each.kind in {"effect", "renderer"}]
    return " or ".join(drawing) or (OPENCV if stage is Stage.detection else "the renderer")


def _at(store: RunStore, scene: Scene) -> str:
    """Return a scene as ``sweep repro`` takes it."""
    block, number = scene
    return "--at " + selection_text({
        axis.name: axis.values[index] for axis, index in zip(
            store.pipeline.experiment.scene_axes, store.blocks[block].cell(number), strict=True)
    })


# --------------------------------------------------------------------------------------------------
# Verification of a store: its files, its blocks, and a sample.

SAMPLE = 20
"""Scenes that are recomputed by default."""


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
    return report_on(damaged_store(url), sample)


def damaged_store(url: str, mode: str = "r") -> RunStore:
    """Open a store that may be damaged."""
    storage = open_storage(url, mode)
    return store_of(url, storage, read_attributes(url, storage), mode)


def report_on(store: RunStore, sample: int) -> IntegrityReport:
    """Check a store, and recompute up to ``sample`` scenes; none with a sample of 0."""
    done = committed(store)
    report = IntegrityReport(store.url, store.finished, len(store.blocks), len(done))
    numbers: Sequence[int] = range(len(store.blocks)) if report.finished else sorted(done)
    listed, left = sync(_listed(store, numbers if report.finished else done))
    left -= check_files(store, report)
    left = {key for key in left if not key.startswith(f"{LOCKS}/")}
    report.files = listed - len(left)
    sound = check_blocks(store, numbers, report)
    if report.finished:
        check_needed(store, sound, report)
    check_scenes(store, sample, sound, report)
    if not is_written(store.storage):
        report.left_over = sorted(
            key for key in left
            if report.finished or not _of_unfinished_block(store, key, done)
        )
    return report


async def _listed(store: RunStore, checked: Container[int]) -> tuple[int, set[str]]:
    """Return how many files there are, and the keys of those that belong to no checked block.

    There may be 25 million files.
    """
    count, others = 0, set()
    async for key in store.storage.list_prefix(""):
        count += 1
        number = store.chunks.number(key)
        if number is None or number not in checked:
            others.add(key)
    return count, others


def _of_unfinished_block(store: RunStore, key: str, done: Container[int]) -> bool:
    """Return whether a key belongs to a block that a run will write again."""
    number = store.chunks.number(key)
    begun = key.removeprefix(f"{BEGUN}/")
    if number is None and begun.isdecimal():
        number = int(begun)
    return number is not None and number not in done
