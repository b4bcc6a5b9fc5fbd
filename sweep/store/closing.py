"""The end of a run in its store: groups beside the results, and the mark "finished"."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

import zarr
import zarr.errors
from zarr.buffer import default_buffer_prototype

from sweep.store.lifecycle import utc_now
from sweep.store.locations import translate_errors
from sweep.store.manifest import Manifest, parsed, put, read_manifest, write_manifest
from sweep.store.run_store import RunStore, list_folder
from sweep.store.zarr_sync import sync

if TYPE_CHECKING:
    import xarray as xr


def finish(store: RunStore, groups: Mapping[str, xr.Dataset], counts: dict[str, Any]) -> None:
    """Close a complete store: write its groups, consolidate the metadata, mark it finished."""
    metadata = {
        **store.run_metadata, "finished": True, "finished_at": utc_now(), "counts": counts,
    }
    _write_groups(store, groups, metadata)


def reopen(store: RunStore, text: str | None = None) -> None:
    """Mark a finished store unfinished, so that blocks of it can be computed again.

    Its groups go, since they sum the blocks up. With a ``text``, that is its pipeline from then on:
    one of the same cells. A kill at any instant leaves a store with one of the two.
    """
    metadata = {
        key: value for key, value in store.run_metadata.items()
        if key not in ("finished_at", "counts")
    }
    manifest, _ = read_manifest(store.storage)
    files = {} if manifest is None else {
        key: value for key, value in manifest.files.items()
        if key != "zarr.json" and not key.startswith(("cost/", "failures/"))
    }
    with translate_errors(store.url, "written"):
        # The manifest vouches for none of what is changed, while it is.
        write_manifest(store.storage, Manifest(dict(store.group.attrs), files))
        root = parsed(sync(store.storage.get("zarr.json", default_buffer_prototype()))) or {}
        root["attributes"]["sweep"] = {**metadata, "finished": False}
        if text is not None:
            root["attributes"]["pipeline"] = text
        root.pop("consolidated_metadata", None)
        put(store.storage, "zarr.json", root)
        for name in ("cost", "failures"):
            sync(store.storage.delete_dir(name))
        files["zarr.json"] = store.storage.digests["zarr.json"]
        write_manifest(store.storage, Manifest(dict(root["attributes"]), files))


def write_group(store: RunStore, name: str, content: xr.Dataset) -> None:
    """Write a dataset to a group of a finished store, and consolidate the metadata again."""
    _write_groups(store, {name: content}, store.run_metadata)


def _write_groups(
    store: RunStore, groups: Mapping[str, xr.Dataset], metadata: dict[str, Any]
) -> None:
    manifest, _ = read_manifest(store.storage)
    files = dict(manifest.files) if manifest is not None else {}
    with translate_errors(store.url, "written"), warnings.catch_warnings():
        # Consolidated metadata is not part of the Zarr 3 specification; xarray reads it, and
        # warns if it is missing.
        warnings.simplefilter("ignore", zarr.errors.ZarrUserWarning)
        old = tuple(path for name in groups for path in sync(_arrays_in(store, name, files)))
        files = {
            key: value for key, value in files.items()
            if key not in ("zarr.json", *(f"{name}/zarr.json" for name in groups))
            and not key.startswith(tuple(f"{path}/" for path in old))
        }
        # The manifest vouches for no file while it is being written.
        write_manifest(store.storage, Manifest(dict(store.group.attrs), files))
        for path in old:
            sync(store.storage.delete_dir(path))
        store.storage.digests.clear()
        for name, content in groups.items():
            # Zarr 3 specifies strings of variable length, none of a fixed one.
            texts = [label for label in content.variables if content[label].dtype.kind == "U"]
            content.assign({label: content[label].astype(object) for label in texts}).to_zarr(
                store.storage, group=name, mode="a", zarr_format=3, consolidated=False
            )
        zarr.consolidate_metadata(store.storage, zarr_format=3)
        digests = {
            key: value for key, value in list(store.storage.digests.items())
            if any(key.startswith(f"{name}/") for name in groups)
        }
        files |= digests
        write_manifest(store.storage, Manifest(dict(store.group.attrs), files))
        # The root is written last: a kill before it leaves a store that is closed again.
        root = parsed(sync(store.storage.get("zarr.json", default_buffer_prototype()))) or {}
        root["attributes"]["sweep"] = metadata
        put(store.storage, "zarr.json", root)
        files["zarr.json"] = store.storage.digests["zarr.json"]
        write_manifest(store.storage, Manifest(dict(root["attributes"]), files))


async def _arrays_in(store: RunStore, name: str, known: Collection[str]) -> list[str]:
    """Return the paths of a group's arrays, and of those of ``known`` keys that are damaged."""
    paths = []
    for child in await list_folder(store.storage, name):
        path = f"{name}/{child}"
        document = await store.storage.get(f"{path}/zarr.json", default_buffer_prototype())
        kind = (parsed(document) or {}).get("node_type")
        if kind == "array" or (kind is None and f"{path}/zarr.json" in known):
            paths.append(path)
    return paths
