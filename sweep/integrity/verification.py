"""Verification of a store: files, blocks, flags, failures, and what of it is damaged."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Container, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from sweep.errors import ArgumentError, PipelineError, StoreError
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import LOST, UNSEEN, VARIABLES, Variable, with_description
from sweep.integrity.recomputation import (
    Damage,
    IntegrityReport,
    SoundBlock,
    check_scenes,
    is_doubtful,
)
from sweep.measure.flags import (
    BoundStatus,
    DetectionStatus,
    EstimateStatus,
    Flipped,
    present_values,
)
from sweep.sampling.rules import Decider, Decision, scenes_needed
from sweep.store.blocks import (
    BEGUN,
    RunStore,
    committed,
    names_written,
    parsed_receipt,
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


def check_blocks(
    store: RunStore, numbers: Sequence[int], report: IntegrityReport
) -> dict[int, SoundBlock]:
    """Check blocks in several threads; return those without damage, by number."""
    sound: dict[int, SoundBlock] = {}
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
                    sound[number] = SoundBlock(
                        tuple(receipt.processors), receipt.scenes_needed, is_doubtful(receipt))
    report.processors = dict(processors)
    return sound


def _checked_block(store: RunStore, number: int) -> tuple[int, Receipt | None, list[Damage]]:
    """Return the size of a block's files, its receipt if that is sound, and what is damaged."""
    key = receipt_key(number)
    chunks = store.chunks.keys(number)
    keys = [key, *chunks.values()]
    contents = dict(zip(keys, read_files(store.storage, keys), strict=True))
    faults = {key: "missing" for key, content in contents.items() if content is None}
    receipt: Receipt | None = None
    if (content := contents[key]) is not None:
        try:
            receipt = parsed_receipt(store, number, decoded(content))
        except Exception:  # decoding a damaged chunk may raise anything
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
            try:
                if receipt is not None and checksum_of(content) != receipt.checksums[name]:
                    raise ValueError("checksum")
                values[name] = store.chunks.decoded(name, number, content)
            except (ValueError, RuntimeError):
                faults[chunk] = CHANGED
    damage = [Damage("file", key, what, number) for key, what in faults.items()]
    if not faults and receipt is not None and (
        fault := contradiction(store.pipeline, store.variables, values, receipt)
    ):
        damage.append(Damage("block", f"block {store.blocks[number]}", fault, number))
    return sum(len(content or b"") for content in contents.values()), receipt, damage


# --------------------------------------------------------------------------------------------------
# The check of a store's files outside its blocks: metadata, coordinates, tables of the run.

TABLES = ("cost", "failures")
"""Groups that a finished store has."""


class FileCheck:
    """Checks the files of a store that belong to no block.

    Parameters
    ----------
    store
        The store, which may be damaged.
    report
        Takes what is damaged.

    Attributes
    ----------
    keys
        Keys of the files that belong to the store and to no block.
    """

    def __init__(self, store: RunStore, report: IntegrityReport) -> None:
        self._store, self._storage, self._report = store, store.storage, report
        self._planned = planned_arrays(store.pipeline, store.blocks.extents)
        self._expected = {key: parsed(each.to_bytes())
                          for key, each in documents(self._planned).items()}
        self._root = read_json(self._storage, "zarr.json") or {}
        # Another version of sweep may word the attributes otherwise.
        self._same_version = (
            store.run_metadata["environment"].get("sweep") == environment()["sweep"])
        self._copies = self._consolidated()
        self.keys = {"zarr.json"}

    def run(self) -> None:
        """Check the files."""
        self._check_root()
        faults = schema_faults(self._store)
        for planned in self._planned:
            self._check_array(planned, faults.pop(planned.path, ""))
        self._report.damage += [
            Damage("array", path, fault) for path, fault in faults.items() if path not in GROUPS]
        for name in GROUPS:
            if self._report.finished or name not in TABLES:
                self._check_group(name)
        contents = read_files(self._storage, sorted(self.keys))
        self._report.bytes += sum(len(content or b"") for content in contents)

    def _add(self, key: str, what: str) -> None:
        self._report.damage.append(Damage("file", key, what))

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
        elif self._report.finished and self._copies is None:
            self._add("zarr.json", "lacks its copy of the metadata")

    def _check_array(self, planned: PlannedArray, fault: str) -> None:
        key = f"{planned.path}/zarr.json"
        self.keys.add(key)
        document = read_json(self._storage, key)
        array = None if fault or document is None else self._store.array(planned.path)
        if not fault and self._same_version:
            attributes = with_description(planned.path, (document or {}).get("attributes") or {})
            if attributes != planned.attributes:
                fault = "its attributes differ from the schema's"
        if fault or not self._fits_copy(key, document):
            self._add(key, fault or "changed")
        for chunk, part, values in planned.pieces():
            self.keys.add(chunk)
            if list(absent_files(self._storage, [chunk], planned.path)):
                self._add(chunk, "missing")
            elif array is not None and (fault := _value_fault(array, part, values)):
                self._add(chunk, fault)

    def _fits_copy(self, key: str, document: dict[str, Any] | None) -> bool:
        """Return whether a document is as the root's copy has it, or the copy alone is wrong."""
        if self._copies is None:
            return document is not None
        if self._copies.get(key.removesuffix("/zarr.json")) == document:
            return True
        if document is not None and document == self._expected.get(key):
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
            self.keys.add(key)
            document = read_json(self._storage, key)
            if document is None or not self._fits_copy(key, document):
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
            self.keys.add(key)
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

def check_needed(store: RunStore, sound: Container[int], report: IntegrityReport) -> None:
    """Find blocks whose scenes were needed, or not, against the rule of their pipeline.

    A group is followed as far as its blocks are sound.
    """
    rule = store.pipeline.stopping
    if rule is None:
        return
    try:
        decider = Decider.of(store, rule)
    except (PipelineError, ValueError) as error:
        report.damage.append(Damage(
            "block", f"block {store.blocks[0]}", f"no rule of stopping: {error}", 0))
        return
    waves = decider.waves
    for group in range(waves.groups):
        for wave in range(len(waves.ends)):
            numbers = list(waves.numbers(group, wave))
            if not all(number in sound for number in numbers):
                break
            # Bases only have to differ from wave to wave: one process reads a store as it is.
            decision = Decision(rule, wave, tuple(range(wave)))
            damage = [
                Damage("block", f"block {store.blocks[number]}", fault, number)
                for number in numbers
                if (fault := _needed_fault(store, decider, decision, number))
            ]
            report.damage += damage
            if damage:
                break


def _needed_fault(store: RunStore, decider: Decider, decision: Decision, number: int) -> str:
    """Return how the scenes of a block that were needed differ from the rule's; else nothing."""
    block = store.blocks[number]
    stored = scenes_needed(store, block)
    try:
        needed = decider.needed(block, decision) if decision.wave else np.ones_like(stored)
    except StoreError as error:
        return str(error)
    wrong = int((stored != needed).sum())
    what = f"{wrong:,} scenes are not flagged as the results of earlier trials demand"
    return what if wrong else ""


# --------------------------------------------------------------------------------------------------
# Verification of a store: every file is read and checked, a sample of scenes recomputed.

SAMPLE = 20
"""Scenes that are recomputed by default."""


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
    return report_on(damaged_store(url), sample)


def damaged_store(url: str, mode: str = "r") -> RunStore:
    """Open a store that may be damaged."""
    storage = open_storage(url, mode)
    return store_of(url, storage, read_attributes(url, storage), mode)


def report_on(store: RunStore, sample: int) -> IntegrityReport:
    """Check a store, and recompute up to ``sample`` scenes and all that failed.

    With a sample of 0, nothing is recomputed.
    """
    done = committed(store)
    report = IntegrityReport(store.url, store.finished, len(store.blocks), len(done))
    numbers: Sequence[int] = range(len(store.blocks)) if report.finished else sorted(done)
    listed, left = sync(_listed(store, numbers if report.finished else done))
    files = FileCheck(store, report)
    files.run()
    left -= {KEY, *files.keys}
    report.files = listed - len(left)
    sound = check_blocks(store, numbers, report)
    check_needed(store, sound, report)
    check_scenes(store, sample, sound, report)
    if not is_written(store.storage):
        report.left_over = sorted(
            key for key in left
            if not _of_unfinished_block(store, key, done, finished=report.finished)
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


def _of_unfinished_block(
    store: RunStore, key: str, done: Container[int], finished: bool
) -> bool:
    """Return whether a key belongs to a block that a run will write again."""
    if key.startswith(f"{BEGUN}/"):
        number = key.removeprefix(f"{BEGUN}/")
        return number.isdecimal() and int(number) not in done
    written = store.chunks.number(key)
    return written is not None and not finished and written not in done
