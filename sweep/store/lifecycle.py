"""The Zarr store: laid out by the template, written a block at a time, committed by receipts.

A block's values are written first and its receipt last, so that a block is either whole or not
there. The receipts are the checkpoint; that a chunk exists says nothing.

No path is written by two runs. On this machine, a run holds its store by the folder that it
opened, wherever that is moved; a remote store's data lie under the run's id, to which the place
points.
"""

from __future__ import annotations

import contextlib
import glob
import json
import os
import re
import shutil
import tempfile
import time
import uuid
import warnings
import weakref
from collections.abc import AsyncIterator, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import zarr
import zarr.errors
from numpy.typing import NDArray
from zarr.abc.store import Store
from zarr.core.buffer import default_buffer_prototype
from zarr.core.sync import sync
from zarr.storage import FsspecStore, LocalStore

from sweep.compilation import processor
from sweep.errors import StoreError, StoreReplacedError
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import Block, Blocks, scene_axes
from sweep.plan.parameters import Stage
from sweep.plan.schema import SCHEMA, Variable
from sweep.store.checksums import DigestingStore, is_special
from sweep.store.layout import RECEIPTS, PlannedArray, planned_arrays
from sweep.store.manifest import Manifest, parsed, put, read_manifest, write_manifest
from sweep.store.provenance import environment, fingerprint

if TYPE_CHECKING:
    import xarray as xr

FORMAT = 2
"""Version of the store's layout."""

BEGUN = f"{RECEIPTS}/begun"
"""Folder of a mark for each block that was begun and is not committed."""

REQUIRED = {
    "run_id", "processor", "scenes", "detection", "estimate", "seconds", "failures", "written",
    "digests",
}
"""What every receipt holds."""

UNREADABLE = (
    AttributeError, KeyError, TypeError, ValueError, RecursionError, OSError,
    zarr.errors.BaseZarrError,
)
"""What reading a document of something else, a damaged or a forged one may raise."""

RECORDED = {
    "format": int, "name": str, "folder": str, "run_id": str, "block": list, "fingerprint": dict,
    "environment": dict, "finished": bool,
}
"""What is recorded of every run, and its types."""

GROUPS = ("commits", "cost", "failures")
"""The groups of a store."""

ABANDONED_S = 3600.0
"""Age from which a store that is half made is taken for abandoned."""

POINTER = "sweep_run"
"""Attribute of a remote store's place: the id of the run whose data are the store's."""


@dataclass(frozen=True)
class RunStore:
    """An open store: where it is, what it holds, and how its grid is cut."""

    url: str
    group: zarr.Group
    pipeline: Pipeline
    run_id: str
    blocks: Blocks
    _arrays: dict[str, zarr.Array[Any]] = field(default_factory=dict, repr=False, compare=False)

    @property
    def place(self) -> DigestingStore:
        """Where its files are."""
        return cast("DigestingStore", self.group.store)

    @property
    def data_url(self) -> str:
        """What a user opens with ``xarray.open_zarr``."""
        return f"{self.url}/{self.run_id}" if is_remote(self.url) else self.url

    @property
    def source(self) -> str | Store:
        """What is opened with ``xarray.open_zarr`` here."""
        return self.place.below if is_remote(self.url) else self.url

    def array(self, name: str) -> zarr.Array[Any]:
        """Return an array by its path; its metadata is read once."""
        if name not in self._arrays:
            self._arrays[name] = cast("zarr.Array[Any]", self.group[name])
        return self._arrays[name]

    @property
    def finished(self) -> bool:
        """Whether every block is committed and the store is closed."""
        return bool(self.about["finished"])

    @property
    def fingerprint(self) -> dict[str, Any]:
        """The fingerprint of the run that made the store."""
        return dict(self.about["fingerprint"])

    @property
    def about(self) -> dict[str, Any]:
        """What is recorded of the run: format, run id, fingerprint, environment, dates."""
        root = parsed(sync(self.place.get("zarr.json", default_buffer_prototype()))) or {}
        return dict(root["attributes"]["sweep"])


def is_remote(url: str) -> bool:
    """Tell whether a store is not a local path."""
    return "://" in url


@contextlib.contextmanager
def telling(url: str, doing: str) -> Iterator[None]:
    """Turn what a disk or a server says into one line: ``url: cannot be <doing>: why``."""
    try:
        yield
    except (StoreError, zarr.errors.BaseZarrError):
        raise
    except FileNotFoundError as error:
        raise StoreError(f"{url}: cannot be {doing}: {error.strerror or error}") from None
    except OSError as error:
        raise StoreError(f"{url}: cannot be {doing}: {_reason(error)}") from None
    except Exception as error:
        # What a remote store's library raises is no OSError, and is of no one kind.
        if not is_remote(url) or not _is_foreign(error):
            raise
        raise StoreError(f"{url}: cannot be {doing}: {_reason(error)}") from None


def _is_foreign(error: Exception) -> bool:
    return type(error).__module__.partition(".")[0] not in ("sweep", "zarr", "builtins", "numpy")


def _reason(error: BaseException) -> str:
    """Return in a line why; what a remote store's library says is never quoted at length."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return " ".join(str(error).split())[:200] or type(error).__name__


def _checked_url(url: str) -> str:
    """Return a store's url; StoreError where it holds what must not be kept or shown."""
    if is_remote(url):
        scheme, _, rest = url.partition("://")
        if any(sign in rest for sign in ("@", "?", "#", "://", "::")):
            raise StoreError(
                f"{scheme}://...: a store's name is shown and written down: expected no "
                "credentials or options in it; the environment has them (AWS_ACCESS_KEY_ID, ...)"
            )
        return url.rstrip("/")
    return url


def _store_at(url: str, *, read_only: bool) -> Store:
    """Return the Zarr store of a url."""
    if not is_remote(url):
        return LocalStore(url, read_only=read_only)
    try:
        # What others have written since is listed too.
        return FsspecStore.from_url(
            url, storage_options={"use_listings_cache": False}, read_only=read_only
        )
    except ImportError as error:
        raise StoreError(f"{url}: {error}") from None
    except ValueError as error:
        raise StoreError(f"{url}: cannot be reached: {_reason(error)}") from None


def _run_at(url: str) -> str | None:
    """Return the run whose data are those of a remote store; None where there is no store."""
    with telling(url, "reached"):
        try:
            pointer = _open_group(_store_at(url, read_only=True), "r")
        except (FileNotFoundError, zarr.errors.GroupNotFoundError):
            return None
    run_id = pointer.attrs.get(POINTER)
    if not isinstance(run_id, str) or not re.fullmatch("[0-9a-f]{32}", run_id):
        raise StoreError(_something_else(url))
    return run_id


def exists(url: str) -> bool:
    """Tell whether anything is at a store's place."""
    if not is_remote(_checked_url(url)):
        return Path(url).exists() or Path(url).is_symlink()
    return _run_at(url) is not None


def _something_else(url: str) -> str:
    return f"{url}: holds something else than a store of sweep; name another place"


def place_of(url: str, mode: str = "r") -> DigestingStore:
    """Return where a store's files are.

    With ``mode`` "r+" a local one is held by its folder: what is written goes there, also when
    another store has taken its place.

    Raises
    ------
    StoreError
        Where there is none.
    """
    url = _checked_url(url)
    if not exists(url):
        raise StoreError(f"{url}: there is no store; `sweep run` makes one")
    if is_remote(url):
        return DigestingStore(_store_at(f"{url}/{_run_at(url)}", read_only=mode == "r"))
    if mode == "r" or not Path("/proc/self/fd").is_dir():
        return DigestingStore(LocalStore(url, read_only=mode == "r"))
    try:
        folder = _Folder(url)
    except NotADirectoryError:
        raise StoreError(_something_else(url)) from None
    except OSError as error:
        raise StoreError(f"{url}: cannot be read: {error.strerror}") from None
    return DigestingStore(LocalStore(f"/proc/self/fd/{folder.number}"), folder)


class _Folder:
    """A folder that is held open as long as this object lives."""

    def __init__(self, path: str) -> None:
        self.number = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
        weakref.finalize(self, os.close, self.number)


def open_store(url: str, mode: str = "r") -> RunStore:
    """Open a store that :func:`create_store` made.

    Raises
    ------
    StoreError
        Where there is none, or something else, or its arrays are not what its pipeline asks for.
    """
    url = _checked_url(url)
    place = place_of(url, mode)
    try:
        attributes = dict(_open_group(place, mode).attrs)
    except PermissionError as error:
        raise StoreError(f"{url}: cannot be read: {_reason(error)}") from None
    except UNREADABLE:
        if read_manifest(place)[0] is None:
            raise StoreError(_something_else(url)) from None
        raise StoreError(f"{url}: damaged: zarr.json; `sweep verify --repair` mends it") from None
    store = store_of(url, place, attributes, mode)
    faults = schema_faults(store)
    if faults:
        name, what = next(iter(faults.items()))
        raise StoreError(
            f"{url}: not as its pipeline says: {name}: {what}; `sweep verify` tells more"
        )
    return store


def store_of(
    url: str, place: DigestingStore, attributes: Mapping[str, Any], mode: str = "r"
) -> RunStore:
    """Return the store whose attributes are given; StoreError where they are of something else."""
    try:
        about = dict(attributes["sweep"])
        if about["format"] != FORMAT:
            raise StoreError(
                f"{url}: store format {about['format']}, this version of sweep has {FORMAT}; "
                "run its pipeline into a new store"
            )
        for key, kind in RECORDED.items():
            if not isinstance(about[key], kind):
                raise TypeError(key)
        if about["finished"]:
            for name in ("detection", "estimate"):
                if not _are_counts(about["counts"][name], None):
                    raise TypeError(name)
        pipeline = Pipeline.from_text(
            str(attributes["pipeline"]), name=about["name"], source=f"{url} (its pipeline)",
            folder=about["folder"], files=about["fingerprint"]["files"],
        )
        lengths, extents = tuple(len(a) for a in scene_axes(pipeline)), tuple(about["block"])
        if len(extents) != len(lengths) or not all(
            type(extent) is int and 1 <= extent <= length
            for extent, length in zip(extents, lengths, strict=True)
        ):
            raise ValueError(extents)
        if not re.fullmatch("[0-9a-f]{32}", about["run_id"]):
            raise ValueError(about["run_id"])
        group = _open_group(place, mode)
        return RunStore(url, group, pipeline, about["run_id"], Blocks(lengths, extents))
    except UNREADABLE:
        raise StoreError(_something_else(url)) from None


def _open_group(place: Store, mode: str) -> zarr.Group:
    return zarr.open_group(
        place, mode=mode, zarr_format=3, use_consolidated=False  # type: ignore[arg-type]
    )


def schema_faults(store: RunStore) -> dict[str, str]:
    """Return what is wrong with a store's arrays by their names: missing, foreign, or others."""
    planned = {array.path: array for array in planned_arrays(store.pipeline, store.blocks.extents)}
    faults: dict[str, str] = {}
    with warnings.catch_warnings():
        # Files that are not Zarr's are no fault.
        warnings.simplefilter("ignore")
        there: set[str] = set()
        keys = sync(_listed(store.place, ""))
        for name in sorted({key for key in keys if not key.startswith(".")} | {RECEIPTS}):
            try:
                member = store.group[name]
            except KeyError:
                continue
            except Exception as error:
                # Whatever is in a damaged or forged document.
                there.add(name)
                faults[name] = f"unreadable: {_reason(error)}"
                continue
            there.add(name)
            if isinstance(member, zarr.Group):
                if name not in GROUPS:
                    faults[name] = "a group that no store of sweep has"
            elif name not in planned:
                faults[name] = "an array that no store of sweep has"
            elif misfit := _misfit(planned[name], member):
                faults[name] = misfit
    faults.update({name: "missing" for name in planned if name not in there})
    return faults


def _misfit(planned: PlannedArray, array: zarr.Array[Any]) -> str:
    try:
        return planned.misfit(array)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        return f"unreadable: {_reason(error)}"


async def _listed(place: Store, prefix: str) -> list[str]:
    try:
        return [key async for key in place.list_dir(prefix)]
    except FileNotFoundError:
        return []


def tidy(store: RunStore) -> None:
    """Delete what killed processes left in a local store; nobody else may write it.

    Zarr warns of files that it does not know among its groups; elsewhere they are harmless.
    """
    if is_remote(store.url):
        return
    root = Path(store.url).resolve()
    for folder in ("", *GROUPS, *(f"{name}/*" for name in GROUPS)):
        for path in root.glob(f"{folder}/*.partial".lstrip("/")):
            if path.parent.resolve().is_relative_to(root):
                path.unlink(missing_ok=True)
    done = committed(store)
    for mark in sync(_listed(store.place, BEGUN)):
        if mark.isdecimal() and int(mark) in done:
            sync(store.place.delete(f"{BEGUN}/{mark}"))


def check_place(url: str) -> None:
    """See that a store can be made at a place, before any work is done for it.

    Raises
    ------
    StoreError
        Where it cannot be written.
    """
    if is_remote(_checked_url(url)):
        trial = f".sweep-{uuid.uuid4().hex}"
        with telling(url, "written"):
            there = _store_at(url, read_only=False)
            put(there, trial, {})
            sync(there.delete(trial))
        return
    with telling(url, "written"):
        Path(url).parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=Path(url).parent, prefix=".sweep-"):
            pass


def create_store(url: str, pipeline: Pipeline, extents: tuple[int, ...]) -> RunStore:
    """Lay out an empty store for a pipeline, its chunks equal to blocks of ``extents``.

    Raises
    ------
    StoreError
        Where the place cannot be written.
    """
    run_id = uuid.uuid4().hex
    with telling(url, "written"):
        if is_remote(url):
            _lay_out(_store_at(f"{url}/{run_id}", read_only=False), pipeline, extents, run_id)
            # The place points to it once it is whole.
            put(_store_at(url, read_only=False), "zarr.json", {
                "zarr_format": 3, "node_type": "group", "attributes": {POINTER: run_id},
            })
        else:
            # Beside its place and then moved there: a kill between leaves no half a store.
            check_place(url)
            _tidy_beside(url)
            building = _beside(url, "new")
            try:
                _lay_out(LocalStore(building), pipeline, extents, run_id)
                building.rename(Path(url).resolve())
            finally:
                shutil.rmtree(building, ignore_errors=True)
    return open_store(url, "r+")


def _beside(url: str, ending: str) -> Path:
    """Return an unused path in the folder of a local store, which may lie behind a link."""
    path = Path(url).resolve()
    return path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.{ending}")


def _tidy_beside(url: str) -> None:
    """Delete what killed processes left of stores that they were making or deleting here."""
    real = Path(url).resolve()
    for ending, age_s in (("deleted", 0.0), ("new", ABANDONED_S)):
        for path in real.parent.glob(f".{glob.escape(real.name)}.*.{ending}"):
            with contextlib.suppress(OSError):
                if path.stat().st_mtime <= time.time() - age_s:
                    shutil.rmtree(path, ignore_errors=True)


def _lay_out(to: Store, pipeline: Pipeline, extents: tuple[int, ...], run_id: str) -> None:
    """Write a store's coordinates, its empty arrays, its attributes, and its manifest."""
    place = DigestingStore(to)
    group = _open_group(place, "w-")
    planned = planned_arrays(pipeline, extents)
    for array in planned:
        array.create(group)
    derived = [array.path for array in planned if array.path == "distance_m"
               and pipeline.axis("distance_m") is None]
    attributes: dict[str, Any] = {
        "title": pipeline.title or pipeline.name,
        "pipeline": pipeline.text,
        **({"coordinates": " ".join(derived)} if derived else {}),
        "sweep": {
            "format": FORMAT,
            "name": pipeline.name,
            "folder": pipeline.folder,
            "run_id": run_id,
            "block": list(extents),
            "fingerprint": fingerprint(pipeline),
            "environment": environment(),
            "created": _now(),
            "finished": False,
        },
    }
    group.attrs.update(attributes)
    write_manifest(place, Manifest(attributes, dict(place.digests)))


def _now() -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())


def remove_store(url: str) -> None:
    """Delete a store of sweep, and nothing else.

    Raises
    ------
    StoreError
        Where something else is there, or it cannot be deleted.
    """
    place = place_of(url, "r+")
    about = recorded_about(url, place)
    with telling(url, "overwritten"):
        if is_remote(url):
            pointer = _store_at(url, read_only=False)
            sync(pointer.delete("zarr.json"))
            sync(pointer.delete_dir(str(about["run_id"])))
            return
        # Out of the way at once, then at leisure: a kill between leaves no half a store.
        doomed = _beside(url, "deleted")
        Path(url).resolve().rename(doomed)
        shutil.rmtree(doomed, ignore_errors=True)


def recorded_about(url: str, place: DigestingStore) -> dict[str, Any]:
    """Return what is recorded of a store that may be damaged or of another format.

    Raises
    ------
    StoreError
        Where something else is there.
    """
    manifest, _ = read_manifest(place)
    try:
        attributes = _open_group(place, "r").attrs if manifest is None else manifest.attributes
        return dict(cast("dict[str, Any]", attributes["sweep"]))
    except UNREADABLE:
        raise StoreError(_something_else(url)) from None


def region(variable: Variable, pipeline: Pipeline, block: Block) -> tuple[slice, ...]:
    """Return a block's part of a variable's array."""
    cuts = {
        axis.name: slice(start, stop)
        for axis, start, stop in zip(
            scene_axes(pipeline), block.starts, block.stops, strict=True
        )
    }
    return tuple(cuts.get(name, slice(None)) for name in variable.dimensions(pipeline))


def chunk_key(store: RunStore, variable: Variable, block: Block) -> str:
    """Return the key of the one chunk of a variable that a block is."""
    array = store.array(variable.name)
    position = tuple(
        (part.start or 0) // extent
        for part, extent in zip(
            region(variable, store.pipeline, block), array.chunks, strict=True
        )
    )
    return f"{variable.name}/{array.metadata.encode_chunk_key(position)}"


def begin_block(store: RunStore, block: Block) -> bool:
    """Note that a block is begun; tell whether it had been begun before."""
    with telling(store.url, "written"):
        _see_that_it_is_ours(store)
        key = f"{BEGUN}/{store.blocks.number(block)}"
        if sync(store.place.exists(key)):
            return True
        put(store.place, key, {"pid": os.getpid(), "at": time.time()})
    return False


def write_block(
    store: RunStore, block: Block, values: Mapping[str, NDArray[Any]], receipt: Mapping[str, Any]
) -> None:
    """Write a block's values, then commit them by its receipt."""
    number = store.blocks.number(block)
    with telling(store.url, "written"):
        _see_that_it_is_ours(store)
        if sync(store.place.exists(f"{RECEIPTS}/c/{number}")):
            return  # another worker was given it too, perhaps of another processor
        for variable in SCHEMA:
            array = store.array(variable.name)
            array[region(variable, store.pipeline, block)] = values[variable.name]
        _see_that_it_is_ours(store)
        digests = [_digest(store, chunk_key(store, variable, block)) for variable in SCHEMA]
        content = json.dumps(
            {"run_id": store.run_id, "processor": processor(), **receipt, "digests": digests},
            separators=(",", ":"),
        )
        store.array(RECEIPTS)[number : number + 1] = np.array([content], dtype=object)
        store.place.digests.pop(f"{RECEIPTS}/c/{number}", None)
        with contextlib.suppress(FileNotFoundError):
            sync(store.place.delete(f"{BEGUN}/{number}"))


def _digest(store: RunStore, key: str) -> int:
    """Return the digest of what was written under a key, and forget it."""
    if key not in store.place.digests:
        # The same block was written twice at once in this process.
        sync(store.place.get(key, default_buffer_prototype()))
    return store.place.digests.pop(key)


def drop_block(store: RunStore, block: Block) -> None:
    """Take a block's commit back, so that it is computed again, and delete its chunks."""
    keys = [f"{RECEIPTS}/c/{store.blocks.number(block)}"]
    keys += [chunk_key(store, variable, block) for variable in SCHEMA]
    with telling(store.url, "written"):
        for key in keys:
            with contextlib.suppress(FileNotFoundError):
                sync(store.place.delete(key))


def _see_that_it_is_ours(store: RunStore) -> None:
    """Raise StoreError where another run has replaced the store since it was opened."""
    there: str | None
    if is_remote(store.url):
        there = _run_at(store.url)
    else:
        try:
            group = _open_group(LocalStore(store.url, read_only=True), "r")
            there = cast("dict[str, Any]", group.attrs["sweep"])["run_id"]
        except (KeyError, FileNotFoundError):
            there = None
    if there != store.run_id:
        raise StoreReplacedError(
            f"{store.url}: replaced by another run, or moved, while this one was going on"
        )


def committed(store: RunStore) -> set[int]:
    """Return the numbers of the blocks that are committed."""
    async def gather(keys: AsyncIterator[str]) -> set[int]:
        return {int(key) async for key in keys if key.isascii() and key.isdecimal()}

    count = len(store.blocks)
    try:
        listed = sync(gather(store.place.list_dir(f"{RECEIPTS}/c")))
    except FileNotFoundError:
        return set()
    return {number for number in listed if number < count}


def receipts(
    store: RunStore, numbers: Iterable[int]
) -> Iterable[tuple[int, dict[str, Any]]]:
    """Yield the receipts of committed blocks by number."""
    ordered = sorted(numbers)
    for start in range(0, len(ordered), 1000):
        some = ordered[start : start + 1000]
        try:
            texts = np.asarray(store.array(RECEIPTS).oindex[np.array(some)]).tolist()
            contents = [
                parsed_receipt(store, number, text)
                for number, text in zip(some, texts, strict=True)
            ]
        except (ValueError, AttributeError, KeyError, TypeError, OSError) as error:
            raise StoreError(
                f"{store.url}: damaged receipts among blocks {some[0]} to {some[-1]} ({error}); "
                "`sweep verify --repair` mends it"
            ) from None
        yield from zip(some, contents, strict=True)


def parsed_receipt(store: RunStore, number: int, text: str) -> dict[str, Any]:
    """Return the content of a block's receipt; ValueError where it is not one of this run."""
    try:
        content = json.loads(text)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    if not isinstance(content, dict) or not content.keys() >= REQUIRED:
        raise ValueError("incomplete")
    if content["run_id"] != store.run_id:
        raise ValueError("of another run")
    scenes = len(store.blocks[number])
    searches = store.pipeline.size(Stage.detection)
    estimates = searches * store.pipeline.size(Stage.estimation)
    seconds, failures = content["seconds"], content["failures"]
    right = (
        content["scenes"] == scenes
        and _are_counts(content["detection"], scenes * searches)
        and _are_counts(content["estimate"], scenes * estimates)
        and _are_counts(content["digests"], None) and len(content["digests"]) == len(SCHEMA)
        and isinstance(content["written"], (int, float))
        and isinstance(content["processor"], str)
        and isinstance(seconds, dict)
        and all(
            isinstance(seconds.get(name), list) and len(seconds[name]) in (0, length)
            and all(isinstance(value, (int, float)) for value in seconds[name])
            for name, length in (("scene", 1), ("detection", searches), ("estimation", estimates))
        )
        and isinstance(failures, list)
        and all(_is_failure(failure, scenes, searches, estimates) for failure in failures)
    )
    if not right:
        raise ValueError("not a receipt of this block")
    return content


def _are_counts(values: Any, total: int | None) -> bool:
    return (
        isinstance(values, list) and all(type(value) is int and value >= 0 for value in values)
        and (total is None or sum(values) == total)
    )


def _is_failure(failure: Any, scenes: int, searches: int, estimates: int) -> bool:
    def number(name: str, count: int) -> bool:
        value = failure.get(name)
        return type(value) is int and 0 <= value < count

    return (
        isinstance(failure, dict) and number("scene", scenes)
        and failure.get("kind") in ("failed", "crashed")
        and failure.get("stage") in ("scene", "detection", "estimation")
        and (failure.get("setting") is None or number("setting", searches))
        and (failure.get("estimator") is None or number("estimator", estimates // searches))
        and isinstance(failure.get("text"), str)
    )


def finish(store: RunStore, groups: Mapping[str, xr.Dataset], counts: dict[str, Any]) -> None:
    """Close a complete store: its groups, the mark, and the metadata in one place."""
    about = {**store.about, "finished": True, "finished_at": _now(), "counts": counts}
    _write_groups(store, groups, about)


def write_group(store: RunStore, name: str, content: xr.Dataset) -> None:
    """Write a dataset to a group of a complete store, and put all metadata in one place again."""
    _write_groups(store, {name: content}, store.about)


def _write_groups(
    store: RunStore, groups: Mapping[str, xr.Dataset], about: dict[str, Any]
) -> None:
    manifest, _ = read_manifest(store.place)
    files = dict(manifest.files) if manifest is not None else {}
    with telling(store.url, "written"), warnings.catch_warnings():
        # Consolidated metadata is not part of the Zarr 3 specification; xarray reads it, and
        # warns where it is missing.
        warnings.simplefilter("ignore", zarr.errors.ZarrUserWarning)
        old = tuple(path for name in groups for path in sync(_arrays_in(store, name, files)))
        files = {
            key: value for key, value in files.items()
            if key not in ("zarr.json", *(f"{name}/zarr.json" for name in groups))
            and not key.startswith(tuple(f"{path}/" for path in old))
        }
        # What is being written is not vouched for until it is whole.
        write_manifest(store.place, Manifest(dict(store.group.attrs), files))
        for path in old:
            sync(store.place.delete_dir(path))
        store.place.digests.clear()
        for name, content in groups.items():
            # Zarr 3 specifies strings of any length, none of a fixed one.
            texts = [label for label in content.variables if content[label].dtype.kind == "U"]
            content.assign({label: content[label].astype(object) for label in texts}).to_zarr(
                store.place, group=name, mode="a", zarr_format=3, consolidated=False
            )
        zarr.consolidate_metadata(store.place, zarr_format=3)
        digests = {
            key: value for key, value in list(store.place.digests.items())
            if any(key.startswith(f"{name}/") for name in groups)
        }
        files |= digests
        write_manifest(store.place, Manifest(dict(store.group.attrs), files))
        # The last thing that is written: a kill before it leaves a store to be closed again.
        root = parsed(sync(store.place.get("zarr.json", default_buffer_prototype()))) or {}
        root["attributes"]["sweep"] = about
        put(store.place, "zarr.json", root)
        files["zarr.json"] = store.place.digests["zarr.json"]
        write_manifest(store.place, Manifest(dict(root["attributes"]), files))


async def _arrays_in(store: RunStore, name: str, known: Collection[str]) -> list[str]:
    """Return the paths of a group's arrays, and of those by ``known`` keys that are damaged."""
    paths = []
    for child in await _listed(store.place, name):
        path = f"{name}/{child}"
        document = await store.place.get(f"{path}/zarr.json", default_buffer_prototype())
        kind = (parsed(document) or {}).get("node_type")
        if kind == "array" or (kind is None and f"{path}/zarr.json" in known):
            paths.append(path)
    return paths


def open_dataset(url: str | os.PathLike[str]) -> xr.Dataset:
    """Open a store's results, lazily; also those of an unfinished one.

    Raises
    ------
    StoreError
        Where there is none, or something else.
    """
    store = open_store(os.fspath(url))
    import xarray as xr  # noqa: PLC0415  (slow to import, and workers do without)

    if not is_remote(store.url):
        for planned in planned_arrays(store.pipeline, store.blocks.extents):
            for key in planned.value_keys():
                if is_special(Path(store.url, key)):
                    raise StoreError(f"{store.url}: {key} is not a file")
    try:
        dataset: xr.Dataset = xr.open_zarr(store.source, consolidated=False, zarr_format=3)
        # NumPy's strings of any length are new, and much of xarray and pandas does without them.
        texts = {name: (value.dims, value.to_numpy().astype(object), value.attrs)
                 for name, value in dataset.coords.items() if value.dtype.kind == "T"}
    except (*UNREADABLE, RuntimeError) as error:
        raise StoreError(
            f"{store.url}: damaged ({_reason(error)}); `sweep verify --repair` mends it"
        ) from None
    ordered = [variable.name for variable in SCHEMA if variable.name in dataset]
    return dataset.assign_coords(texts)[ordered]
