"""Verification of a store: files, blocks, flags, failures, and what of it is damaged."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Container, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from sweep.errors import ArgumentError, PipelineError, StoreError, SweepError
from sweep.execution.limits import TIME_LIMIT_S
from sweep.integrity.sample_check import (
    ArrayDamage,
    BlockDamage,
    Damage,
    FileDamage,
    SampleCheck,
    as_json,
    computable,
)
from sweep.isolation.child_process import OUTSIDE_SIGNALS
from sweep.isolation.crash_isolation import run_cells_isolated
from sweep.measure.flags import (
    BoundStatus,
    DetectionStatus,
    EstimateStatus,
    Flipped,
    present_values,
)
from sweep.plan.cell_selection import selection_text
from sweep.plan.grid import Block, block_indices, scene_axes
from sweep.plan.parameters import Stage
from sweep.plan.pipeline import Pipeline
from sweep.plan.reader import StoppingRule
from sweep.plan.schema import LOST, UNSEEN, VARIABLES, Variable, with_description
from sweep.sampling.rules import Decider, Decision, scenes_needed
from sweep.store.blocks import (
    BEGUN,
    RunStore,
    committed,
    names_written,
    parsed_receipt,
    receipts,
    region,
)
from sweep.store.chunks import receipt_key
from sweep.store.files import absent_files, parsed, read_files, read_json, sync
from sweep.store.layout import PlannedArray, checksum_of, documents, planned_arrays
from sweep.store.lifecycle import GROUPS, read_attributes, root_attributes, schema_faults, store_of
from sweep.store.locations import open_storage
from sweep.store.lock import KEY, is_written
from sweep.store.provenance import environment
from sweep.store.receipt import Receipt, decoded
from sweep.typing import Masks

# --------------------------------------------------------------------------------------------------
# Whether a block's flags and numbers agree: a number exists exactly where its flag says so.
#
# Which flag governs which number is declared with the variables (``Variable.present_when``), and
# beside which flags numbers exist with the flags (``Flag.present``).

Values = Mapping[str, NDArray[Any]]


def contradiction(
    pipeline: Pipeline, variables: Sequence[Variable], values: Values, receipt: Receipt
) -> str:
    """Return the first contradiction within a block; empty if there is none.

    Parameters
    ----------
    pipeline
        The store's.
    variables
        The variables that the store has.
    values
        The block's values by variable.
    receipt
        The block's, with the counts of its flags.
    """
    for variable in variables:
        if variable.flags is not None:
            unknown = ~np.isin(values[variable.name], [int(flag) for flag in variable.flags])
            if unknown.any():
                return f"{variable.name}: unknown flag {values[variable.name][unknown][0]}"
    for name, counts in (("detection", receipt.detection), ("estimate", receipt.estimate)):
        if np.bincount(values[name].ravel()).tolist() != list(counts):
            return f"{name}: flags other than its receipt counts"
    unneeded = values["detection"] == DetectionStatus.not_needed
    if unneeded.any() and (fault := _not_needed_fault(pipeline, variables, values, unneeded)):
        return fault
    for variable in variables:
        if fault := _number_fault(pipeline, variable, values):
            return f"{variable.name}: {fault}"
    return _flag_contradiction(pipeline, values)


def _number_fault(pipeline: Pipeline, variable: Variable, values: Values) -> str:
    """Return how a variable's numbers contradict the flag that governs them."""
    rule = variable.present_when
    if rule is None:
        return ""
    governing = VARIABLES[rule.flag]
    if governing.flags is None:
        raise AssertionError(rule)
    numbers, flags = values[variable.name], values[rule.flag]
    if rule.number in ("unless_lost", "if_seen"):
        without = LOST if rule.number == "unless_lost" else UNSEEN
        computed = _any_configuration(pipeline, governing, variable, ~np.isin(flags, without))
        computed = computed.reshape(computed.shape + (1,) * len(variable.inner))
        missing = ~np.isfinite(numbers) & computed
        return "no number" if missing.any() else ""
    present = _spread(
        pipeline, governing, np.isin(flags, present_values(governing.flags)), variable
    )
    if rule.number == "always" and (~np.isfinite(numbers) & present).any():
        return f"no number although {rule.flag} says that there is one"
    if (~np.isnan(numbers) & ~present).any():
        return f"a number although {rule.flag} says that there is none"
    return ""


def _not_needed_fault(
    pipeline: Pipeline, variables: Sequence[Variable], values: Values, unneeded: Masks
) -> str:
    """Return what contradicts that scenes were not needed: nothing of them may be there."""
    detection = VARIABLES["detection"]
    scenes = _any_configuration(pipeline, detection, VARIABLES["bound"], unneeded)
    for variable in variables:
        found = _spread(pipeline, VARIABLES["bound"], scenes, variable)
        if variable.flags is None:
            if (found & ~np.isnan(values[variable.name])).any():
                return f"{variable.name}: a number of a scene that was not needed"
        elif ((values[variable.name] == variable.not_needed) != found).any():
            return f"{variable.name}: contradicts that scenes were not needed"
    return ""


def _flag_contradiction(pipeline: Pipeline, values: Values) -> str:
    """Return how the flags of different stages contradict each other."""
    detection, estimate = VARIABLES["detection"], VARIABLES["estimate"]
    needed = values["estimate"] != EstimateStatus.not_needed
    solved = values["estimate"] == EstimateStatus.solved
    flipped_exists = np.isin(values["flipped"], present_values(Flipped))
    no_estimate = values["flipped"] == Flipped.no_estimate
    if ((flipped_exists != solved) | (needed & (no_estimate == solved))).any():
        return "flipped: contradicts estimate"
    detected = _spread(
        pipeline, detection,
        np.isin(values["detection"], present_values(DetectionStatus)), estimate,
    )
    if (np.isin(values["estimate"], present_values(EstimateStatus)) & ~detected).any():
        return "estimate: a pose although nothing was detected"
    if (needed & ((values["estimate"] == EstimateStatus.no_detection) == detected)).any():
        return "estimate: contradicts detection"
    if (values["detection"] == DetectionStatus.not_run).any():
        return "detection: not run"
    computed = _any_configuration(
        pipeline, detection, VARIABLES["bound"], ~np.isin(values["detection"], LOST)
    )
    demanded = pipeline.fixed.get("bound", "none") != "none"
    if demanded and ((values["bound"] == BoundStatus.not_run) & computed).any():
        return "bound: not run"
    return ""


def _spread(
    pipeline: Pipeline, variable: Variable, values: NDArray[Any], wanted: Variable
) -> NDArray[Any]:
    """Return values of one variable's dimensions, shaped to broadcast to those of another."""
    names = variable.dimensions(pipeline)
    return values.reshape([
        values.shape[names.index(name)] if name in names else 1
        for name in wanted.dimensions(pipeline)
    ])


def _any_configuration(
    pipeline: Pipeline, variable: Variable, wanted: Variable, truth: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return for each scene whether ``truth`` holds in any configuration."""
    kept = wanted.dimensions(pipeline)
    others = tuple(
        k for k, name in enumerate(variable.dimensions(pipeline)) if name not in kept
    )
    return np.asarray(truth.any(axis=others))


# --------------------------------------------------------------------------------------------------
# The check of a store's blocks: checksums of their chunks, and flags against numbers.

THREADS, WINDOW = 4, 256
"""Blocks that are read and decoded at a time, and that are submitted at a time."""

CHANGED = "changed: does not fit its checksum"


@dataclass(frozen=True, slots=True)
class CheckedBlock:
    """A block that was checked.

    Attributes
    ----------
    number
        Its number.
    bytes
        Size of its receipt and its chunks.
    receipt
        Its receipt; None if that is damaged.
    damage
        What is damaged.
    """

    number: int
    bytes: int
    receipt: Receipt | None
    damage: Sequence[Damage]


class BlockCheck:
    """Checks blocks of a store in several threads."""

    def __init__(self, store: RunStore) -> None:
        self._store = store

    def run(self, numbers: Sequence[int]) -> Iterator[CheckedBlock]:
        """Yield the blocks of these numbers in order, checked."""
        with ThreadPoolExecutor(THREADS) as pool:
            # A window at a time: there may be very many.
            for start in range(0, len(numbers), WINDOW):
                yield from pool.map(self._check, numbers[start : start + WINDOW])

    def _check(self, number: int) -> CheckedBlock:
        """Check one block; called in any thread."""
        store, block = self._store, self._store.blocks[number]
        key = receipt_key(number)
        chunks = store.chunks.keys(number)
        keys = [key, *chunks.values()]
        contents = dict(zip(keys, read_files(store.storage, keys), strict=True))
        faults = {key: "missing" for key, content in contents.items() if content is None}
        receipt = self._receipt(number, contents[key])
        if receipt is None and key not in faults:
            faults[key] = CHANGED
        values: dict[str, NDArray[Any]] = {}
        written = store.variable_names if receipt is None else names_written(store, receipt)
        for name, chunk in chunks.items():
            content = contents[chunk]
            if name not in written:
                faults.pop(chunk, None)
                if content is not None:
                    faults[chunk] = "numbers of a block of which none was needed"
                values[name] = store.chunks.fill(name, number)
            elif content is not None:
                values_read = self._values(content, name, number, receipt)
                if values_read is None:
                    faults[chunk] = CHANGED
                else:
                    values[name] = values_read
        damage: list[Damage] = [FileDamage(key, what, number) for key, what in faults.items()]
        if not faults and receipt is not None:
            fault = contradiction(store.pipeline, store.variables, values, receipt)
            if fault:
                damage.append(BlockDamage(number, str(block), fault))
        return CheckedBlock(
            number, sum(len(content) for content in contents.values() if content is not None),
            receipt, damage,
        )

    def _receipt(self, number: int, content: bytes | None) -> Receipt | None:
        """Return a block's receipt from its chunk; None if it is missing or damaged."""
        if content is None:
            return None
        try:
            return parsed_receipt(self._store, number, decoded(content))
        except Exception:
            # Decoding a damaged chunk may raise anything.
            return None

    def _values(
        self, content: bytes, name: str, number: int, receipt: Receipt | None
    ) -> NDArray[Any] | None:
        """Return a chunk's values within the grid; None if it fails a checksum."""
        if receipt is not None and checksum_of(content) != receipt.checksums[name]:
            return None
        try:
            return self._store.chunks.decoded(name, number, content)
        except (ValueError, RuntimeError):
            return None


# --------------------------------------------------------------------------------------------------
# The check of a store's files outside its blocks: metadata, coordinates, tables of the run.

TABLES = ("cost", "failures")
"""Groups that a finished store has."""


@dataclass(slots=True)
class FileFindings:
    """The result of the check.

    Attributes
    ----------
    keys
        Keys of the files that belong to the store and to no block.
    bytes
        Size of them.
    damage
        What is damaged.
    """

    keys: set[str] = field(default_factory=set)
    bytes: int = 0
    damage: list[Damage] = field(default_factory=list)


class FileCheck:
    """Checks the files of a store that belong to no block.

    Parameters
    ----------
    store
        The store, which may be damaged.
    """

    def __init__(self, store: RunStore) -> None:
        self._store, self._storage = store, store.storage
        self._planned = planned_arrays(store.pipeline, store.blocks.extents)
        self._expected = {key: parsed(each.to_bytes())
                          for key, each in documents(self._planned).items()}
        self._root = read_json(self._storage, "zarr.json") or {}
        metadata = store.run_metadata
        self._finished = bool(metadata["finished"])
        # Another version of sweep may word the attributes otherwise.
        self._same_version = metadata["environment"].get("sweep") == environment()["sweep"]
        self._copies = self._consolidated()
        self._findings = FileFindings(keys={"zarr.json"})

    def run(self) -> FileFindings:
        """Check the files."""
        self._check_root()
        faults = schema_faults(self._store)
        for planned in self._planned:
            self._check_array(planned, faults.pop(planned.path, ""))
        for path, fault in faults.items():
            if path in GROUPS:
                continue
            self._findings.damage.append(ArrayDamage(path, fault))
        for name in GROUPS:
            if self._finished or name not in TABLES:
                self._check_group(name)
        contents = read_files(self._storage, sorted(self._findings.keys))
        self._findings.bytes = sum(len(content) for content in contents if content is not None)
        return self._findings

    def _add(self, key: str, what: str) -> None:
        self._findings.damage.append(FileDamage(key, what))

    def _consolidated(self) -> dict[str, Any] | None:
        """Return the root's copy of all metadata; None if it has none, as an unfinished store."""
        try:
            copies = dict(self._root["consolidated_metadata"]["metadata"])
            return {
                path: {key: value for key, value in copy.items() if key != "consolidated_metadata"}
                for path, copy in copies.items()
            }
        except (AttributeError, KeyError, TypeError, ValueError):
            return None

    def _check_root(self) -> None:
        store = self._store
        expected = root_attributes(store.pipeline, self._planned, store.run_metadata)
        attributes = self._root["attributes"]
        if self._same_version and any(
            attributes.get(name) != value for name, value in expected.items() if name != "sweep"
        ):
            self._add("zarr.json", "its attributes differ from the pipeline's")
        elif self._finished and self._copies is None:
            self._add("zarr.json", "lacks its copy of the metadata")

    def _check_array(self, planned: PlannedArray, fault: str) -> None:
        key = f"{planned.path}/zarr.json"
        self._findings.keys.add(key)
        document = read_json(self._storage, key)
        array = None if fault or document is None else self._store.array(planned.path)
        if not fault and self._same_version:
            attributes = with_description(planned.path, (document or {}).get("attributes") or {})
            if attributes != planned.attributes:
                fault = "its attributes differ from the schema's"
        if fault or not self._fits_copy(key, document, self._expected.get(key)):
            self._add(key, fault or "changed")
        for chunk, part, values in planned.pieces():
            self._findings.keys.add(chunk)
            if list(absent_files(self._storage, [chunk], planned.path)):
                self._add(chunk, "missing")
            elif array is not None and (fault := _value_fault(array, part, values)):
                self._add(chunk, fault)

    def _fits_copy(
        self, key: str, document: dict[str, Any] | None, expected: dict[str, Any] | None = None
    ) -> bool:
        """Return whether a document is as the root's copy has it, or the copy alone is wrong."""
        if self._copies is None:
            return document is not None
        if self._copies.get(key.removesuffix("/zarr.json")) == document:
            return True
        if document is not None and document == expected:
            self._add("zarr.json", f"its copy of {key} differs from that document")
            self._copies = None
            return True
        return False

    def _check_group(self, name: str) -> None:
        """Check a group's document and, of a finished store's tables, all arrays and chunks."""
        paths = [name]
        if name in TABLES and self._copies is not None:
            paths += [path for path in self._copies if path.startswith(f"{name}/")]
        for path in paths:
            key = f"{path}/zarr.json"
            self._findings.keys.add(key)
            document = read_json(self._storage, key)
            if document is None or not self._fits_copy(key, document, self._expected.get(key)):
                self._add(key, "missing or changed")
            elif document.get("node_type") == "array":
                self._check_table(path)

    def _check_table(self, path: str) -> None:
        """Check that every chunk of an array is there and can be read."""
        array: Any = self._store.group[path]
        counts = [math.ceil(size / chunk) for size, chunk in zip(
            array.shape, array.chunks, strict=True)]
        for number in itertools.product(*map(range, counts)):
            key = f"{path}/{array.metadata.encode_chunk_key(number)}"
            self._findings.keys.add(key)
            if list(absent_files(self._storage, [key], path)):
                self._add(key, "missing")
                continue
            try:
                array.get_block_selection(number) if number else array[...]
            except Exception as error:
                # Decoding a damaged chunk may raise anything.
                self._add(key, f"unreadable: {type(error).__name__}")


def _value_fault(array: zarr.Array[Any], part: Any, values: Any) -> str:
    """Return how a part of a coordinate differs from the pipeline's; empty if it does not."""
    try:
        stored = np.asarray(array[part])
    except Exception as error:
        return f"unreadable: {type(error).__name__}"
    if stored.shape != values.shape or not (stored == values).all():
        return "its values differ from the pipeline's"
    return ""


# --------------------------------------------------------------------------------------------------
# The check of what was not needed: the rule of stopping is applied to the stored results again.

class NeededCheck:
    """Finds blocks whose scenes were needed, or not, against the rule of their pipeline."""

    def __init__(self, store: RunStore) -> None:
        self._store = store

    def run(self, sound: Container[int]) -> Iterator[Damage]:
        """Yield the damage of blocks; a group is followed as far as its blocks are sound."""
        rule = self._store.pipeline.stopping
        if rule is None:
            return
        try:
            decider = Decider.of(self._store, rule)
        except (PipelineError, ValueError) as error:
            yield BlockDamage(0, str(self._store.blocks[0]), f"no rule of stopping: {error}")
            return
        waves = decider.waves
        for group in range(waves.groups):
            for wave in range(len(waves.ends)):
                numbers = list(waves.numbers(group, wave))
                if not all(number in sound for number in numbers):
                    break
                if (damage := list(self._of_wave(decider, rule, numbers, wave))):
                    yield from damage
                    break

    def _of_wave(
        self, decider: Decider, rule: StoppingRule, numbers: list[int], wave: int
    ) -> Iterator[Damage]:
        # Bases only have to differ from wave to wave here: one process reads a store as it is.
        decision = Decision(rule, wave, tuple(range(wave)))
        for number in numbers:
            block = self._store.blocks[number]
            stored = scenes_needed(self._store, block)
            try:
                needed = decider.needed(block, decision) if wave else np.ones_like(stored)
            except StoreError as error:
                yield BlockDamage(number, str(block), str(error))
                return
            if (wrong := int((stored != needed).sum())):
                yield BlockDamage(
                    number, str(block),
                    f"{wrong:,} scenes are not flagged as the results of earlier trials demand",
                )


# --------------------------------------------------------------------------------------------------
# The check of failures: scenes that failed are recomputed, since a machine may have been at
# fault.
#
# A scene that ended its process is recomputed only if a signal from outside did so.

FLAGS = {
    "detection": (DetectionStatus.failed, DetectionStatus.crashed),
    "estimate": (EstimateStatus.failed, EstimateStatus.crashed),
}
"""Variable -> its flags of scenes that raised, and of those that ended their process."""


@dataclass(slots=True)
class FailureFindings:
    """How many scenes were recomputed, and the blocks of those that succeed now."""

    count: int = 0
    damage: list[Damage] = field(default_factory=list)


def is_doubtful(receipt: Receipt) -> bool:
    """Return whether a block has scenes that this check recomputes."""
    return bool(_killed(receipt)) or any(
        len(counts) > failed and counts[failed]
        for counts, (failed, _) in zip(
            (receipt.detection, receipt.estimate), FLAGS.values(), strict=True
        )
    )


class FailureCheck:
    """Recomputes all scenes of blocks that failed, in child processes."""

    def __init__(self, store: RunStore) -> None:
        self._store = store

    def run(self, numbers: Sequence[int]) -> FailureFindings:
        """Recompute the failed scenes of blocks; none if this machine would give other numbers.

        Raises
        ------
        MachineFaultError
            If this machine cannot compute them.
        """
        findings = FailureFindings()
        if not numbers:
            return findings
        try:
            pipeline = computable(self._store)
        except SweepError:
            return findings  # as the report says of the sample
        for number, receipt in receipts(self._store, numbers):
            self._check(pipeline, number, receipt, findings)
        return findings

    def _check(
        self, pipeline: Pipeline, number: int, receipt: Receipt, findings: FailureFindings
    ) -> None:
        block = self._store.blocks[number]
        killed = np.zeros(len(block), dtype=bool)
        killed[_killed(receipt)] = True
        doubtful = {}
        for name, (failed, crashed) in FLAGS.items():
            flags = self._flags(name, block)
            doubtful[name] = (flags == failed) | ((flags == crashed) & killed[:, None])
        rows = np.flatnonzero(np.any([each.any(axis=1) for each in doubtful.values()], axis=0))
        if not len(rows):
            return
        findings.count += len(rows)
        shape = (len(rows), pipeline.size(Stage.detection), pipeline.size(Stage.estimation))
        cells = run_cells_isolated(
            pipeline, [index[rows] for index in block_indices(block)],
            np.ones(shape, dtype=bool), TIME_LIMIT_S,
        )
        succeed = np.zeros(len(rows), dtype=bool)
        for name, failures in FLAGS.items():
            again = np.stack(cells.columns[name], axis=1)
            succeed |= (doubtful[name][rows] & ~np.isin(again, failures)).any(axis=1)
        if succeed.any():
            example = self._at(block, int(rows[np.argmax(succeed)]))
            findings.damage.append(BlockDamage(
                number, str(block),
                f"scenes that had failed and succeed when recomputed: {int(succeed.sum())}, such "
                f"as --at {example}",
            ))

    def _flags(self, name: str, block: Block) -> NDArray[np.uint8]:
        """Return a flag variable of a block: (scenes, configurations)."""
        pipeline = self._store.pipeline
        variable: Variable = next(v for v in self._store.variables if v.name == name)
        values = np.asarray(self._store.array(name)[region(variable, pipeline, block)])
        scene = [axis.name for axis in scene_axes(pipeline)]
        names = list(variable.dimensions(pipeline))
        configurations = [axis.name for axis in variable.configuration_axes(pipeline)]
        order = [names.index(each) for each in (*scene, *configurations)]
        return values.transpose(order).reshape(len(block), -1)

    def _at(self, block: Block, scene: int) -> str:
        axes = scene_axes(self._store.pipeline)
        return selection_text({
            axis.name: axis.values[index]
            for axis, index in zip(axes, block.cell(scene), strict=True)
        })


def _killed(receipt: Receipt) -> list[int]:
    """Return the scenes of a block that a signal from outside ended, as far as recorded."""
    return sorted({
        failure.scene for failure in receipt.failures
        if failure.kind == "crashed" and failure.text.strip() in OUTSIDE_SIGNALS
    })


# --------------------------------------------------------------------------------------------------
# Verification of a store: every file is read and checked, a sample of scenes recomputed.

SAMPLE = 20
"""Scenes that are recomputed by default."""


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
    retried
        Scenes flagged ``failed``, or ended by a signal from outside, that were recomputed.
    damage
        What is damaged; empty for a sound store.
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
    retried: int = 0
    damage: list[Damage] = field(default_factory=list)
    repaired: list[Damage] = field(default_factory=list)
    left_over: list[str] = field(default_factory=list)
    processors: dict[str, int] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return the report as ``sweep verify --json`` prints it."""
        return {
            "store": self.store, "finished": self.finished, "blocks": self.blocks,
            "blocks_done": self.blocks_done, "files": self.files, "bytes": self.bytes,
            "sampled": self.sampled, "not_sampled": self.not_sampled,
            "retried": self.retried,
            "damage": [as_json(damage) for damage in self.damage],
            "repaired": [as_json(damage) for damage in self.repaired],
            "left_over": self.left_over, "processors": self.processors,
        }


def verify(url: str, sample: int = SAMPLE) -> IntegrityReport:
    """Check every file by its checksum, flags against numbers, and recompute a sample.

    All scenes that are flagged ``failed`` are recomputed, too, unless the sample is 0: those that
    succeed now are damage of their block.

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
    return Verification(url, "r").report(sample)


class Verification:
    """A store that is being verified.

    Parameters
    ----------
    url
        The store.
    mode
        "r", or "r+" to repair it afterwards.

    Attributes
    ----------
    storage
        The storage that holds its files.
    store
        The store.
    """

    def __init__(self, url: str, mode: str) -> None:
        self.storage = open_storage(url, mode)
        self.store = store_of(url, self.storage, read_attributes(url, self.storage), mode)

    def report(self, sample: int) -> IntegrityReport:
        """Check the store, and recompute up to ``sample`` scenes and all that failed.

        With a sample of 0, nothing is recomputed.
        """
        store = self.store
        done = committed(store)
        numbers: Sequence[int] = range(len(store.blocks)) if store.finished else sorted(done)
        checked: Container[int] = numbers if store.finished else done
        listed, left = sync(self._listed(checked))
        files = FileCheck(store).run()
        left -= {KEY, *files.keys}
        damage, size = files.damage, files.bytes
        sound: dict[int, Sequence[str]] = {}
        needed: dict[int, int] = {}
        processors: Counter[str] = Counter()
        doubtful = []
        for block in BlockCheck(store).run(numbers):
            size += block.bytes
            damage += block.damage
            if not block.damage and block.receipt is not None:
                sound[block.number] = block.receipt.processors
                needed[block.number] = block.receipt.scenes_needed
                processors.update(block.receipt.processors)
                if is_doubtful(block.receipt):
                    doubtful.append(block.number)
        damage += NeededCheck(store).run(sound)
        sampled = SampleCheck(store).run(sample, sound, needed)
        damage += sampled.damage
        retried = FailureCheck(store).run(doubtful if sample else [])
        damage += retried.damage
        held = is_written(self.storage)
        return IntegrityReport(
            store.url, store.finished, len(store.blocks), len(done), listed - len(left), size,
            sampled.count, sampled.reason, retried.count, damage,
            left_over=[] if held else sorted(
                key for key in left if not self._of_unfinished_block(key, done)
            ),
            processors=dict(processors),
        )

    async def _listed(self, checked: Container[int]) -> tuple[int, set[str]]:
        """Return how many files there are, and the keys of those that belong to no checked block.

        There may be 25 million files.
        """
        count, others = 0, set()
        async for key in self.storage.list_prefix(""):
            count += 1
            number = self.store.chunks.number(key)
            if number is None or number not in checked:
                others.add(key)
        return count, others

    def _of_unfinished_block(self, key: str, done: set[int]) -> bool:
        """Return whether a key belongs to a block that a run will write again."""
        store = self.store
        if key.startswith(f"{BEGUN}/"):
            number = key.removeprefix(f"{BEGUN}/")
            return number.isdecimal() and int(number) not in done
        written = store.chunks.number(key)
        return written is not None and not store.finished and written not in done
