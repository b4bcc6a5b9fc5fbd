"""The blocks of a store: values first, flags, and the receipt last."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import time
from collections.abc import AsyncIterator, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, cast

import zarr
from numpy.typing import NDArray
from zarr.abc.store import Store
from zarr.storage import LocalStore

from sweep.errors import StoreError, StoreReplacedError
from sweep.experiment.grid import Block, Blocks, scene_axes
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import VARIABLES, Variable, variables_of
from sweep.store.chunks import Chunks, receipt_key
from sweep.store.files import (
    absent_files,
    delete_files,
    read_files,
    read_json,
    sync,
    write_document,
    write_files,
)
from sweep.store.layout import RECEIPTS, checksum_of
from sweep.store.locations import is_remote, open_group, remote_run_id, translate_errors
from sweep.store.receipt import STAGES, Receipt, decoded, encoded

# --------------------------------------------------------------------------------------------------
# An open store: where it lies, the pipeline that it belongs to, its arrays and its metadata.

@dataclass(frozen=True)
class RunStore:
    """An open store: where it lies, its pipeline, and how its grid is cut into blocks.

    Attributes
    ----------
    url
        As the user gave it.
    group
        The root group.
    pipeline
        What the store was created for.
    run_id
        The run that created it.
    blocks
        The blocks of the grid; each is one chunk of every variable.
    """

    url: str
    group: zarr.Group
    pipeline: Pipeline
    run_id: str
    blocks: Blocks
    _arrays: dict[str, zarr.Array[Any]] = field(default_factory=dict, repr=False, compare=False)

    @property
    def storage(self) -> Store:
        """The storage that holds the store's files."""
        return self.group.store

    @cached_property
    def variables(self) -> tuple[Variable, ...]:
        """The variables of the pipeline."""
        return variables_of(self.pipeline)

    @cached_property
    def variable_names(self) -> frozenset[str]:
        """The names of the variables."""
        return frozenset(variable.name for variable in self.variables)

    @cached_property
    def flag_names(self) -> frozenset[str]:
        """The names of the variables that are flags."""
        return frozenset(variable.name for variable in self.variables if variable.flags is not None)

    @cached_property
    def chunks(self) -> Chunks:
        """The chunks of the variables."""
        return Chunks(self.pipeline, self.blocks)

    @cached_property
    def configurations(self) -> tuple[int, int]:
        """How many detector settings there are, and how many estimators for each."""
        return self.pipeline.size(Stage.detection), self.pipeline.size(Stage.estimation)

    @property
    def data_url(self) -> str:
        """The URL that a user opens with ``xarray.open_zarr``."""
        return f"{self.url}/{self.run_id}" if is_remote(self.url) else self.url

    def array(self, name: str) -> zarr.Array[Any]:
        """Return an array by its path; its metadata is read once.

        Chunks are written even if they hold nothing but the fill value: the missing chunk of a
        committed block is a deleted one.
        """
        if name not in self._arrays:
            array = cast("zarr.Array[Any]", self.group[name])
            self._arrays[name] = array.with_config({"write_empty_chunks": True})
        return self._arrays[name]

    @property
    def finished(self) -> bool:
        """Whether every block is committed and the store is closed."""
        return bool(self.run_metadata["finished"])

    @property
    def fingerprint(self) -> dict[str, Any]:
        """The fingerprint of the run that created the store."""
        return dict(self.run_metadata["fingerprint"])

    @property
    def run_metadata(self) -> dict[str, Any]:
        """The metadata of the run: format, run id, fingerprint, environment, dates."""
        root = read_json(self.storage, "zarr.json") or {}
        return run_metadata_in(root["attributes"])


def run_metadata_in(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a run's metadata from the attributes of its store, where they are a text of JSON.

    Raises
    ------
    KeyError, TypeError, ValueError
        If there are none.
    """
    metadata = attributes["sweep"]
    # Up to format 5 they were an object, which netCDF cannot hold.
    return dict(json.loads(metadata) if isinstance(metadata, str) else metadata)


# --------------------------------------------------------------------------------------------------
# Blocks of a store: begun, written, committed by their receipts, and dropped.
#
# A block's values are written first and its receipt last, so that a block is either complete or
# absent. The receipts are the checkpoint; that a chunk exists says nothing.

BEGUN = f"{RECEIPTS}/begun"
"""Folder of a mark for each block that was begun and is not committed."""

GOVERNING = {each.present_when.flag for each in VARIABLES.values() if each.present_when}
"""The flag variables that say where numbers exist."""

RECEIPTS_AT_ONCE = 1000
"""Receipts that are read and held at a time."""


def region(variable: Variable, pipeline: Pipeline, block: Block) -> tuple[slice, ...]:
    """Return a block's part of a variable's array."""
    slices = {
        axis.name: slice(start, stop)
        for axis, start, stop in zip(
            scene_axes(pipeline), block.starts, block.stops, strict=True
        )
    }
    return tuple(slices.get(name, slice(None)) for name in variable.dimensions(pipeline))


def begin_block(store: RunStore, block: Block) -> bool:
    """Mark a block as begun; return whether it had been begun before."""
    with translate_errors(store.url, "written"):
        check_not_replaced(store)
        key = f"{BEGUN}/{store.blocks.number(block)}"
        if sync(store.storage.exists(key)):
            return True
        write_document(store.storage, key, {"pid": os.getpid(), "at": time.time()})
    return False


def withdraw_block(store: RunStore, block: Block) -> None:
    """Delete the mark that a block was begun, if that can be: it did not end its process."""
    with contextlib.suppress(Exception):
        sync(store.storage.delete(f"{BEGUN}/{store.blocks.number(block)}"))


def write_block(
    store: RunStore, block: Block, values: Mapping[str, NDArray[Any]], receipt: Receipt
) -> Receipt:
    """Write a block's values, then commit them by its receipt; return it with their checksums.

    A block that is committed on the same basis stays as it is; on another one, it is replaced. Of a
    block of which nothing was needed, only the flags are written: its numbers are fill values.
    """
    number = store.blocks.number(block)
    with translate_errors(store.url, "written"):
        check_not_replaced(store)
        if sync(store.storage.exists(receipt_key(number))):
            if receipt.basis is None or committed_basis(store, number) == receipt.basis:
                withdraw_block(store, block)
                # Another worker was given it too, perhaps of another processor.
                return receipt_of(store, block) or receipt
            if receipt.any_needed:
                delete_files(store.storage, [receipt_key(number)])
            else:
                drop_block(store, block)
        checksums = {}
        for variable in in_writing_order(store.variables):
            if receipt.any_needed or variable.flags is not None:
                content = store.chunks.encoded(variable.name, number, values[variable.name])
                write_files(store.storage, {store.chunks.key(variable.name, number): content})
                checksums[variable.name] = checksum_of(content)
        check_not_replaced(store)
        receipt = dataclasses.replace(receipt, checksums=checksums, block=number)
        _commit(store, receipt)
    return receipt


def _commit(store: RunStore, receipt: Receipt) -> None:
    """Write a receipt, in the place of another if there is one."""
    if receipt.block is None:
        raise AssertionError(receipt)
    write_files(store.storage, {receipt_key(receipt.block): encoded(receipt.to_json())})
    delete_files(store.storage, [f"{BEGUN}/{receipt.block}"])


def recommit_block(store: RunStore, receipt: Receipt) -> None:
    """Replace a block's receipt; its values stay as they are."""
    with translate_errors(store.url, "written"):
        check_not_replaced(store)
        _commit(store, receipt)


def receipt_of(store: RunStore, block: Block) -> Receipt | None:
    """Return a block's receipt; None if it is not committed, or its receipt is damaged."""
    number = store.blocks.number(block)
    try:
        return parsed_receipt(store, number, receipt_texts(store, [number])[0])
    except (ValueError, AttributeError, KeyError, TypeError, OSError):
        return None


def committed_basis(store: RunStore, number: int) -> int | None:
    """Return the basis of a committed block."""
    receipt = receipt_of(store, store.blocks[number])
    return None if receipt is None else receipt.basis


def names_written(store: RunStore, receipt: Receipt) -> frozenset[str]:
    """Return the names of the variables of which a block has a chunk, by its receipt."""
    return store.variable_names if receipt.any_needed else store.flag_names


def in_writing_order(variables: Iterable[Variable]) -> list[Variable]:
    """Return variables in the order in which a block's are written: numbers before their flags.

    So whoever reads the store meanwhile finds no flag that speaks of a number that is not there.
    """
    return sorted(variables, key=lambda v: (v.flags is not None, v.name in GOVERNING))


def drop_block(store: RunStore, block: Block) -> None:
    """Delete a block's receipt and its chunks, so that it is computed again."""
    number = store.blocks.number(block)
    names = [variable.name for variable in in_writing_order(store.variables)]
    keys = [store.chunks.key(name, number) for name in reversed(names)]
    with translate_errors(store.url, "written"):
        delete_files(store.storage, [receipt_key(number), *keys])


def check_not_replaced(store: RunStore) -> None:
    """Raise StoreReplacedError if another run has replaced the store since it was opened."""
    current: str | None
    if is_remote(store.url):
        current = remote_run_id(store.url)
    else:
        try:
            group = open_group(LocalStore(store.url, read_only=True), "r")
            current = run_metadata_in(dict(group.attrs))["run_id"]
        except (KeyError, FileNotFoundError):
            current = None
    if current != store.run_id:
        raise StoreReplacedError(
            f"{store.url}: moved, or replaced by another run, while this run was in progress"
        )


def committed(store: RunStore) -> set[int]:
    """Return the numbers of the blocks that are committed."""
    async def gather(keys: AsyncIterator[str]) -> set[int]:
        return {int(key) async for key in keys if key.isascii() and key.isdecimal()}

    count = len(store.blocks)
    try:
        listed = sync(gather(store.storage.list_dir(f"{RECEIPTS}/c")))
    except FileNotFoundError:
        return set()
    return {number for number in listed if number < count}


def receipts(store: RunStore, numbers: Iterable[int]) -> Iterable[tuple[int, Receipt]]:
    """Yield the receipts of committed blocks, in the order of their numbers.

    Raises
    ------
    StoreError
        If one is damaged.
    """
    ordered = sorted(numbers)
    for start in range(0, len(ordered), RECEIPTS_AT_ONCE):
        some = ordered[start : start + RECEIPTS_AT_ONCE]
        try:
            texts = receipt_texts(store, some)
            contents = [
                parsed_receipt(store, number, text)
                for number, text in zip(some, texts, strict=True)
            ]
        except (ValueError, AttributeError, KeyError, TypeError, OSError) as error:
            raise StoreError(
                f"{store.url}: damaged receipts among blocks {some[0]} to {some[-1]} ({error}); "
                "`sweep verify --repair` repairs it"
            ) from None
        yield from zip(some, contents, strict=True)


def receipt_texts(store: RunStore, numbers: Sequence[int]) -> list[str]:
    """Return the texts of committed blocks' receipts; ValueError if one is missing or damaged."""
    keys = [receipt_key(number) for number in numbers]
    texts = []
    for key, content in zip(keys, read_files(store.storage, keys), strict=True):
        if content is None:
            raise ValueError(f"{key}: missing")
        texts.append(decoded(content))
    return texts


def parsed_receipt(store: RunStore, number: int, text: str) -> Receipt:
    """Return a block's receipt from its text; ValueError if it is not one of this run's."""
    receipt = Receipt.from_json(text)
    if receipt.run_id != store.run_id:
        raise ValueError("of another run")
    if receipt.block != number:
        raise ValueError(f"block {number} has the receipt of block {receipt.block}")
    settings, estimators = store.configurations
    receipt.check(len(store.blocks[number]), settings, settings * estimators)
    if receipt.checksums.keys() != names_written(store, receipt):
        raise ValueError("checksums of other variables than the store's")
    return receipt


def missing_chunks(store: RunStore, numbers: Iterable[int]) -> dict[int, str]:
    """Return those of the committed blocks of which chunks are missing, each with the key of one.

    A copy that was made while the store was written has such blocks, for instance.

    Raises
    ------
    StoreError
        If the receipt of a block without chunks is damaged.
    """
    missing = _missing(store, numbers, store.variable_names)
    if store.pipeline.stopping is None or not missing:
        return missing
    # Blocks of which nothing was needed have chunks of flags alone.
    flags = [number for number, receipt in receipts(store, missing) if not receipt.any_needed]
    lacking = _missing(store, flags, store.flag_names)
    return {number: key for number, key in missing.items() if number not in set(flags)} | lacking


def _missing(store: RunStore, numbers: Iterable[int], names: Collection[str]) -> dict[int, str]:
    """Return those of the blocks that lack a chunk of these variables, each with its key."""
    missing: dict[int, str] = {}
    left = list(numbers)
    for name in sorted(names):
        keys = {store.chunks.key(name, number): number for number in left}
        lacking = {keys[key]: key for key in absent_files(store.storage, keys, f"{name}/c")}
        missing |= lacking
        left = [number for number in left if number not in lacking]
    return missing


def check_whole(store: RunStore, *, finished: bool | None = None) -> set[int]:
    """Return the committed blocks, of which all chunks are there; of a finished store, all blocks.

    Raises
    ------
    StoreError
        If receipts of a finished store, or chunks of committed blocks, are missing.
    """
    for _ in range(3):
        done = committed(store)
        missing = missing_chunks(store, done)
        # A writer may have begun to compute a block again in between.
        if not missing.keys() & committed(store):
            break
    finished = store.finished if finished is None else finished
    uncommitted = set(range(len(store.blocks))) - done if finished else set()
    if not (missing or uncommitted):
        return done
    names = ", ".join(sorted({key.partition("/c")[0] for key in missing.values()})[:3])
    examples = [f"{key} of block {number}" for number, key in sorted(missing.items())]
    examples += [f"{receipt_key(number)} of block {number}" for number in sorted(uncommitted)]
    raise StoreError(
        f"{store.url}: damaged: {len(missing) + len(uncommitted):,} of {len(store.blocks):,} "
        f"blocks lack chunks of {names or 'all variables'}, such as {', '.join(examples[:2])}; "
        "`sweep verify --repair` computes them again"
    )


CHECKED_BLOCKS = 100
"""Blocks, evenly over a store, of which its readers compare drawn coordinates with receipts."""


def changed_draw(store: RunStore) -> str:
    """Return the key of a drawn coordinate's chunk that is not as its receipt says; empty if none.

    So chunks are found that were swapped, or written by another program. `sweep verify` looks at
    all blocks; the store must be finished.
    """
    names = sorted(variable.name for variable in store.variables if variable.drawn_as)
    if not names:
        return ""
    count = len(store.blocks)
    numbers = sorted({k * count // CHECKED_BLOCKS for k in range(CHECKED_BLOCKS)})
    wanted = {store.chunks.key(name, number): receipt.checksums[name]
              for number, receipt in receipts(store, numbers)
              for name in names if name in receipt.checksums}
    contents = read_files(store.storage, list(wanted))
    return next((key for (key, checksum), content in zip(wanted.items(), contents, strict=True)
                 if content is None or checksum_of(content) != checksum), "")


# --------------------------------------------------------------------------------------------------
# Blocks of which nothing was needed, written together: flags alone, of few different contents.

def write_unneeded(store: RunStore, blocks: Sequence[Block], basis: int) -> list[Receipt]:
    """Write blocks that are not committed and of which nothing is needed; return their receipts.

    The values of all are written first, then their receipts. No block is marked as begun: nothing
    is computed that might end the process.

    Parameters
    ----------
    store
        A store whose sampling stops by a rule.
    blocks
        The blocks.
    basis
        What it follows from that nothing is needed.
    """
    if not blocks:
        return []
    begun = time.perf_counter()
    flags = in_writing_order(v for v in store.variables if v.flags is not None)
    with translate_errors(store.url, "written"):
        check_not_replaced(store)
        numbers = [store.blocks.number(block) for block in blocks]
        contents: dict[str, bytes] = {}
        filled: dict[tuple[str, tuple[int, ...]], bytes] = {}
        checksums: dict[int, dict[str, int]] = {number: {} for number in numbers}
        for number, block in zip(numbers, blocks, strict=True):
            for variable in flags:
                kind = variable.name, block.shape
                if kind not in filled:
                    filled[kind] = store.chunks.encoded(
                        variable.name, number, int(variable.not_needed))
                content = filled[kind]
                contents[store.chunks.key(variable.name, number)] = content
                checksums[number][variable.name] = checksum_of(content)
        write_files(store.storage, contents)
        wall_s = (time.perf_counter() - begun) / len(blocks)
        receipts = [
            Receipt(
                run_id=store.run_id, processors=(), scenes=len(block),
                computed={"scenes": 0, "detections": 0, "estimates": 0},
                detection=_counts(store, "detection", block),
                estimate=_counts(store, "estimate", block),
                seconds={stage: [] for stage in STAGES}, failures=(), wall_s=wall_s,
                written=time.time(), checksums=checksums[number], block=number, basis=basis,
            )
            for number, block in zip(numbers, blocks, strict=True)
        ]
        check_not_replaced(store)
        write_files(store.storage, {
            receipt_key(number): encoded(receipt.to_json())
            for number, receipt in zip(numbers, receipts, strict=True)
        })
        marks = {f"{BEGUN}/{number}" for number in numbers}
        delete_files(store.storage, marks.difference(absent_files(store.storage, marks, BEGUN)))
    return receipts


def _counts(store: RunStore, name: str, block: Block) -> list[int]:
    """Return how often each value of a flag occurs in a block where nothing was needed."""
    variable = VARIABLES[name]
    counts = [0] * (int(variable.not_needed) + 1)
    counts[-1] = len(block) * variable.configurations(store.pipeline)
    return counts
