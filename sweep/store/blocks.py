"""The blocks of a store: values first, flags, and the receipt last."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import json
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.abc.store import ByteRequest, Store
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import LocalStore, WrapperStore

from sweep.errors import DamagedStoreError, StoreError
from sweep.experiment.grid import Block, Blocks
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline, selection_text
from sweep.experiment.schema import VARIABLES, Variable
from sweep.measure.flags import DetectionStatus
from sweep.messages import quoted
from sweep.store import files
from sweep.store.locations import is_remote, remote_run_id, translate_errors
from sweep.typing import Masks


class StoreReplacedError(StoreError):
    """A store that was moved, deleted or replaced by another run's while a run wrote it."""


# --------------------------------------------------------------------------------------------------
# A store is damaged: a file is missing or changed. Each reader says so, and names store and file.

def damaged(url: str, fault: str, remedy: str = "") -> DamagedStoreError:
    """Return the error that names a store's fault, and the remedy: by default, its repair."""
    repair = f"`{quoted('sweep', 'verify', url, '--repair')}` repairs it"
    return DamagedStoreError(f"{url}: damaged: {fault}; {remedy or repair}")


class CheckedReads(WrapperStore[Store]):
    """The storage of a store for its readers: a chunk that is changed or missing is an error.

    Zarr's own error names neither the store nor the chunk, and a missing one has fill values.

    Parameters
    ----------
    store
        The storage itself.
    url
        The store's, as the user gave it.
    shown
        Whether the block at each index along the scene axes is shown: chunks of others are not
        read, but have fill values. None: all blocks.
    names
        Variable -> name of its chunks, to be filled in with indices along those axes.
    """

    def __init__(
        self, store: Store, url: str, shown: Masks | None = None,
        names: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(store)
        self._url, self._shown, self._names = url, shown, names or {}

    def _with_store(self, store: Store) -> CheckedReads:
        return CheckedReads(store, self._url, self._shown, self._names)

    def _is_shown(self, variable: str, chunk: str) -> bool:
        """Return whether the block is shown that a variable's chunk, such as "c.0.1", is of."""
        if self._shown is None or variable not in self._names:
            return True
        filled_in = dict(zip(self._names[variable].split(files.SEPARATOR),
                             chunk.split(files.SEPARATOR), strict=True))
        return bool(self._shown[tuple(int(filled_in[f"{{{k}}}"]) for k in range(self._shown.ndim))])

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """Return the content of a key; a range of its bytes is not checked.

        Raises
        ------
        DamagedStoreError
            If it is a chunk of a block that is shown, and was changed or is missing.
        StoreError
            If it cannot be read.
        """
        array, _, name = key.rpartition("/")
        is_chunk = name.partition(files.SEPARATOR)[0] == "c"
        if is_chunk and not self._is_shown(array, name):
            return None
        with translate_errors(self._url, "read"):
            value = await self._store.get(key, prototype, byte_range)
        if is_chunk and (value is None or not (byte_range or files.is_sound(value.to_bytes()))):
            raise damaged(self._url, f"{key}: {'missing' if value is None else files.CHANGED}")
        return value


# --------------------------------------------------------------------------------------------------
# An open store: where it lies, the pipeline that it belongs to, its arrays and its metadata.

@dataclass(frozen=True)
class RunStore:
    """An open store: where it lies, its pipeline, and how its grid is cut into blocks.

    Attributes
    ----------
    url
        As the user gave it.
    storage
        The storage that holds the store's files.
    group
        The root group, whose chunks are checked when they are read.
    pipeline
        The experiment that the store was created for.
    run_id
        The run that created it.
    blocks
        The blocks of the grid; each is one chunk of every variable.
    """

    url: str
    storage: Store
    group: zarr.Group
    pipeline: Pipeline
    run_id: str
    blocks: Blocks
    _arrays: dict[str, zarr.Array[Any]] = field(default_factory=dict, repr=False, compare=False)

    @functools.cached_property
    def variables(self) -> tuple[Variable, ...]:
        """The variables of the pipeline."""
        return self.pipeline.experiment.variables

    @property
    def data_url(self) -> str:
        """The URL that a user opens with ``xarray.open_zarr``."""
        return f"{self.url}/{self.run_id}" if is_remote(self.url) else self.url

    def array(self, name: str) -> zarr.Array[Any]:
        """Return an array by its path; its metadata is read once."""
        if name not in self._arrays:
            self._arrays[name] = cast("zarr.Array[Any]", self.group[name])
        return self._arrays[name]

    def chunk_key(self, name: str, number: int) -> str:
        """Return the key of a variable's chunk of a block."""
        return f"{name}/{self.chunks[name][0].format(*self.blocks.index(number))}"

    def chunk(self, name: str, values: NDArray[Any]) -> bytes:
        """Return the content of a variable's chunk of a block, as Zarr writes it.

        ``values`` are in the variable's dimensions. Beyond the grid's end, a chunk has fill values.
        """
        whole = self.chunks[name][1].copy()
        whole[tuple(map(slice, np.shape(values)))] = values
        return files.packed(whole.tobytes())

    @functools.cached_property
    def chunks(self) -> dict[str, tuple[str, NDArray[Any]]]:
        """Variable -> name of its chunks, to be filled in with indices along axes; an empty one."""
        axes = [axis.name for axis in self.pipeline.experiment.scene_axes]
        extents = dict(zip(axes, self.blocks.extents, strict=True))
        chunks = {}
        for variable in self.variables:
            names = variable.dimensions(self.pipeline)
            index = (f"{{{axes.index(name)}}}" if name in axes else "0" for name in names)
            shape = (extents.get(name, length) for name, length in zip(
                names, variable.shape(self.pipeline), strict=True))
            fill = np.array(variable.fill, dtype=np.dtype(variable.dtype).newbyteorder("<"))
            chunks[variable.name] = (
                files.SEPARATOR.join(["c", *index]), np.broadcast_to(fill, tuple(shape)))
        return chunks

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
        return root_of(self.storage)[1]


def root_of(storage: Store) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the attributes of a store's root, and the run's metadata, a text of JSON among them.

    Raises
    ------
    KeyError, TypeError, ValueError
        If there are none.
    """
    attributes = (files.read_json(storage, "zarr.json") or {})["attributes"]
    return attributes, dict(json.loads(attributes["sweep"]))


# --------------------------------------------------------------------------------------------------
# Receipts: what commits a block, the last file that is written of it. They are the checkpoint; that
# a chunk exists says nothing.

def receipt_key(number: int) -> str:
    """Return the key of a block's receipt."""
    return f"{files.RECEIPTS}/c{files.SEPARATOR}{number}"


@dataclass(frozen=True, slots=True)
class Receipt:
    """The receipt that commits a block.

    Attributes
    ----------
    run_id
        The run that the store belongs to.
    processors
        Features of the processors that computed its cells, in order: several where cells were
        taken from other stores, or computed on another basis before.
    scenes
        Number of scenes of the block.
    computed
        "scenes", "detections" and "estimates" -> how many were computed and not reused.
    detection, estimate
        How often each flag occurs, by name.
    seconds
        Stage -> seconds for each configuration; zeros where nothing was computed.
    failures
        The cells that failed or crashed, as far as they are recorded (:func:`recorded`).
    wall_s
        Seconds from the block's start to its receipt.
    written
        Time at which it was computed, seconds since 1970.
    checksums
        Variable -> the CRC-32C at the end of its chunk.
    block
        The block's number; None until it is written.
    basis
        A digest of the inputs that determine the block's needed scenes: the rule by which sampling
        stops, and the results of earlier waves; None where all scenes are needed.
    """

    run_id: str
    processors: Sequence[str]
    scenes: int
    computed: Mapping[str, int]
    detection: Mapping[str, int]
    estimate: Mapping[str, int]
    seconds: Mapping[str, Sequence[float]]
    failures: Sequence[Mapping[str, str]]
    wall_s: float = 0.0
    written: float = 0.0
    checksums: Mapping[str, int] = field(default_factory=dict)
    block: int | None = None
    basis: int | None = None

    @property
    def scenes_needed(self) -> int:
        """How many of its scenes were needed, for the precision that was asked for."""
        unneeded = self.detection.get(DetectionStatus.not_needed.name, 0)
        return self.scenes - unneeded * self.scenes // max(sum(self.detection.values()), 1)

    def to_bytes(self) -> bytes:
        """Return the chunk that a store holds: a text of JSON, the bytes that Zarr writes."""
        text = json.dumps(asdict(self), separators=(",", ":")).encode()
        # As the codec "vlen-utf8" has it: how many texts, then the length of each before it.
        return files.packed(struct.pack("<II", 1, len(text)) + text)

    @classmethod
    def from_bytes(cls, chunk: bytes | None) -> Receipt:
        """Return the receipt that a chunk holds.

        Raises
        ------
        ValueError
            If the chunk is missing, fails its checksum, or holds something else.
        """
        if chunk is None:
            raise ValueError("missing")
        try:
            return cls(**json.loads(files.unpacked(chunk)[8:]))
        except (AttributeError, KeyError, TypeError, RuntimeError) as error:
            raise ValueError(f"no receipt: {error}") from None


#: Failed cells, and as many crashed ones, that a receipt keeps; the flags count all of them.
MAX_PER_BLOCK = 100

#: Characters that are kept of a traceback: its end.
MAX_CHARACTERS = 4000


def recorded(
    pipeline: Pipeline, block: Block, failures: Sequence[Any]
) -> list[dict[str, str]]:
    """Return the failures that a block's receipt keeps.

    Returns
    -------
    Of each its coordinates ``at``, as ``sweep repro --at`` takes them; its ``kind``, "failed" (it
    raised) or "crashed" (its process died); its ``stage``, "scene", "detection" or "estimation";
    the ``text``: the end of the traceback, or how the process died.
    """
    kept = []
    for kind in ("failed", "crashed"):
        some = (each for each in failures if each.crashed == (kind == "crashed"))
        kept += [{
            "at": selected(pipeline, block.cell(each.scene), each), "kind": kind,
            "stage": each.stage, "text": each.text[-MAX_CHARACTERS:],
        } for each in itertools.islice(some, MAX_PER_BLOCK)]
    return kept


def reason_of(text: str) -> str:
    """Return the first line of the exception's message in a traceback; of other texts the last."""
    lines = text.strip().splitlines()
    frames = [number for number, line in enumerate(lines) if line.startswith('  File "')]
    raised = (line for line in lines[frames[-1] + 1 :] if not line[:1].isspace()) \
        if frames else iter(())
    return next(raised, lines[-1] if lines else "")


def selected(pipeline: Pipeline, cell: Sequence[int], failure: Any) -> str:
    """Return the coordinates of a failure's cell, as ``sweep repro --at`` takes them."""
    indices = {axis.name: k for axis, k in zip(pipeline.experiment.scene_axes, cell, strict=True)}
    for number, stage in (
        (failure.setting, Stage.detection), (failure.estimator, Stage.estimation),
    ):
        axes = pipeline.axes_of(stage)
        if number is not None and axes:
            index = np.unravel_index(number, [len(axis) for axis in axes])
            indices |= {axis.name: int(k) for axis, k in zip(axes, index, strict=True)}
    return selection_text(pipeline, indices)


# --------------------------------------------------------------------------------------------------
# Blocks of a store: begun, written, committed by their receipts, and dropped.
#
# A block's values are written first and its receipt last, so that a block is either complete or
# absent.

#: Folder of a mark for each block that was begun and is not committed.
BEGUN = f"{files.RECEIPTS}/begun"

#: The flag variables that say where numbers exist.
GOVERNING = {each.present_when.flag for each in VARIABLES.values() if each.present_when}

#: Receipts that are read and held at a time.
RECEIPTS_AT_ONCE = 1000


def region(variable: Variable, pipeline: Pipeline, block: Block) -> tuple[slice, ...]:
    """Return a block's part of a variable's array."""
    axes = (axis.name for axis in pipeline.experiment.scene_axes)
    slices = dict(zip(axes, map(slice, block.starts, block.stops), strict=True))
    return tuple(slices.get(name, slice(None)) for name in variable.dimensions(pipeline))


def begin_block(store: RunStore, block: Block) -> bool:
    """Mark a block as begun; return whether it had been begun before."""
    with translate_errors(store.url, "written"):
        check_not_replaced(store)
        key = f"{BEGUN}/{store.blocks.number(block)}"
        if files.read_files(store.storage, [key]) != [None]:
            return True
        files.write_files(store.storage, {key: b"{}"})
    return False


def withdraw_block(store: RunStore, block: Block) -> None:
    """Delete the mark that a block was begun, if that can be: it did not end its process."""
    with contextlib.suppress(Exception):
        files.delete_files(store.storage, [f"{BEGUN}/{store.blocks.number(block)}"])


def write_block(
    store: RunStore, block: Block, values: Mapping[str, NDArray[Any]], receipt: Receipt
) -> Receipt:
    """Write a block's values, then commit them by its receipt; return it with their checksums.

    A block that is committed on the same basis stays as it is; on another one, it is replaced.
    """
    number = store.blocks.number(block)
    with translate_errors(store.url, "written"):
        check_not_replaced(store)
        before = receipt_of(store, block)
        if before is not None and before.basis == receipt.basis:
            withdraw_block(store, block)
            return before  # another worker was given it, too, perhaps of another processor
        files.delete_files(store.storage, [receipt_key(number)])
        checksums = {}
        for together in in_writing_order(store.variables):
            contents = {}
            for name in together:
                content = store.chunk(name, values[name])
                contents[store.chunk_key(name, number)] = content
                checksums[name] = files.checksum_of(content)
            files.write_files(store.storage, contents)
        receipt = dataclasses.replace(receipt, checksums=checksums, block=number)
        files.write_files(store.storage, {receipt_key(number): receipt.to_bytes()})
        withdraw_block(store, block)
    return receipt


def in_writing_order(variables: Sequence[Variable]) -> list[list[str]]:
    """Return the names of variables in the order in which a block's are written: flags last.

    So whoever reads the store meanwhile finds no flag that speaks of a number that is not there.
    Files that are listed together are written at once.
    """
    numbers = [variable.name for variable in variables if variable.flags is None]
    flags = [variable.name for variable in variables if variable.flags is not None]
    return [numbers, *([name] for name in sorted(flags, key=GOVERNING.__contains__))]


def drop_block(store: RunStore, block: Block) -> None:
    """Delete a block's receipt and its chunks, so that it is computed again."""
    number = store.blocks.number(block)
    names = itertools.chain(*in_writing_order(store.variables))
    keys = [store.chunk_key(name, number) for name in names]
    with translate_errors(store.url, "written"):
        files.delete_files(store.storage, [receipt_key(number), *reversed(keys)])


def check_not_replaced(store: RunStore) -> None:
    """Raise StoreReplacedError if another run has replaced the store since it was opened."""
    current = None
    with contextlib.suppress(KeyError, TypeError, ValueError):
        current = remote_run_id(store.url) if is_remote(store.url) else (
            root_of(LocalStore(store.url, read_only=True))[1]["run_id"])
    if current != store.run_id:
        raise StoreReplacedError(
            f"{store.url}: moved, or replaced by another run, while this run was in progress"
        )


def committed(store: RunStore) -> set[int]:
    """Return the numbers of the blocks that are committed."""
    names = set(files.list_folder(store.storage, files.RECEIPTS))
    return {
        number for number in range(len(store.blocks)) if f"c{files.SEPARATOR}{number}" in names}


def receipts(store: RunStore, numbers: Iterable[int]) -> Iterator[tuple[int, Receipt]]:
    """Yield the receipts of committed blocks, in the order of their numbers.

    Raises
    ------
    StoreError
        If one is missing or damaged.
    """
    for number, receipt in receipts_or_faults(store, numbers):
        if isinstance(receipt, str):
            raise damaged(store.url, f"the receipt of block {number}: {receipt}")
        yield number, receipt


def receipt_of(store: RunStore, block: Block) -> Receipt | None:
    """Return a block's receipt; None if it is not committed, or its receipt is damaged."""
    ((_, receipt),) = receipts_or_faults(store, [store.blocks.number(block)])
    return None if isinstance(receipt, str) else receipt


def receipts_or_faults(
    store: RunStore, numbers: Iterable[int]
) -> Iterator[tuple[int, Receipt | str]]:
    """Yield blocks' numbers in order, each with its receipt, or the receipt's fault.

    A receipt of another block or run commits nothing.
    """
    ordered = sorted(numbers)
    for start in range(0, len(ordered), RECEIPTS_AT_ONCE):
        some = ordered[start : start + RECEIPTS_AT_ONCE]
        contents = files.read_files(store.storage, [receipt_key(number) for number in some])
        for number, content in zip(some, contents, strict=True):
            try:
                receipt = Receipt.from_bytes(content)
                if (receipt.run_id, receipt.block) != (store.run_id, number):
                    raise ValueError(f"of block {receipt.block} of run {receipt.run_id}")
                yield number, receipt
            except ValueError as error:
                yield number, str(error)


def missing_chunks(store: RunStore, numbers: Iterable[int]) -> dict[int, str]:
    """Return the committed blocks that lack chunks, each with the key of one.

    A copy that was made while the store was written has such blocks, for instance.
    """
    missing: dict[int, str] = {}
    some = list(numbers)
    # All indices at once; one more than there are axes, for a store of one block without any.
    indices = np.unravel_index(np.array(some, np.intp), (*store.blocks.counts, 1))

    @functools.cache  # many variables have chunks of the same names
    def numbered(template: str) -> dict[str, int]:
        names = map(template.format, *(index.tolist() for index in indices))
        return dict(zip(names, some, strict=True))

    for variable, (template, _) in store.chunks.items() if some else ():
        names, listed = numbered(template), files.list_folder(store.storage, variable)
        absent = {f"{variable}/{name}": names[name] for name in names.keys() - listed}
        # A listing may be older than a file, as over NFS: what it lacks is looked for.
        found = zip(absent.items(), files.read_files(store.storage, [*absent]), strict=True)
        missing |= {number: key for (key, number), content in found if content is None}
    return missing


#: Blocks from which folders are known by their times. Fewer are quick to list, and may be written
#: within a second: whether a file system with so coarse times changes those of folders is not seen.
MANY_BLOCKS = 1000


def folder_states(store: RunStore) -> dict[str, list[int]]:
    """Return what tells whether the folders of a local store have the names that they had.

    Returns
    -------
    Of each folder of chunks its inode, and when a name in it was last made or deleted, in ns since
    1970, which POSIX has a file system keep: a folder of the same state has the same names. A copy
    has other states. Empty of few blocks, on an object store, and if a chunk is newer than its
    folder: that file system, such as one that shows an object store, does not keep the time.
    """
    root, variable = Path(store.url), next(iter(store.chunks))
    with contextlib.suppress(OSError):  # no URL is a path
        found = {name: (root / name).stat() for name in (*store.chunks, files.RECEIPTS)}
        chunk = (root / store.chunk_key(variable, len(store.blocks) - 1)).stat()
        if len(store.blocks) >= MANY_BLOCKS and found[variable].st_ctime_ns >= chunk.st_mtime_ns:
            return {name: [each.st_ino, each.st_ctime_ns] for name, each in found.items()}
    return {}


def check_whole(store: RunStore) -> set[int]:
    """Return the committed blocks, of which all chunks are there; of a finished store, all blocks.

    Folders that have not changed since the store was finished are not listed again.

    Raises
    ------
    StoreError
        If receipts of a finished store, or chunks of committed blocks, are missing.
    """
    # Asked first: the last blocks may be written, and the store closed, after blocks are listed.
    metadata = store.run_metadata
    if (states := folder_states(store)) and states == metadata.get("folders"):
        return set(range(len(store.blocks)))
    done = committed(store)
    if missing := missing_chunks(store, done):
        # A writer may have begun to compute a block again in between, and even committed it.
        done &= committed(store)
        missing = missing_chunks(store, done & missing.keys())
    if metadata["finished"]:
        missing |= {number: receipt_key(number) for number in range(len(store.blocks))
                    if number not in done}
    if not missing:
        return done
    examples = [f"{key} of block {number}" for number, key in sorted(missing.items())[:2]]
    raise damaged(store.url, f"{len(missing):,} of {len(store.blocks):,} blocks lack chunks, such "
                  f"as {', '.join(examples)}")
