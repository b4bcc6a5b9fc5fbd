"""The manifest: digests of the files outside the blocks, and a copy of the store's attributes.

Together with the digests in the receipts, it covers every stored byte, so that damage is found
wherever it occurs; and the attributes, which no block could restore, are stored twice. The
manifest itself is written twice and carries its own digest.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from zarr.abc.buffer import Buffer
from zarr.abc.store import Store
from zarr.buffer import cpu, default_buffer_prototype

from sweep.store.checksums import digest
from sweep.store.layout import RECEIPTS
from sweep.store.zarr_sync import sync

KEYS = (f"{RECEIPTS}/manifest.json", f"{RECEIPTS}/manifest-copy.json")
"""Keys of the manifest and its copy: in the receipts' folder, where Zarr expects only chunks."""


@dataclass(slots=True)
class Manifest:
    """A store's attributes, and the digests of its files by key."""

    attributes: dict[str, Any]
    files: dict[str, int]


def put(store: Store, key: str, content: dict[str, Any]) -> None:
    """Write a small JSON document beside the arrays."""
    sync(store.set(key, cpu.Buffer.from_bytes(encoded(content))))


def encoded(content: dict[str, Any]) -> bytes:
    """Return a JSON document's bytes."""
    return json.dumps(content, separators=(",", ":")).encode()


def get(store: Store, key: str) -> dict[str, Any] | None:
    """Return a small JSON document's content; None if it is missing or torn."""
    return parsed(sync(store.get(key, default_buffer_prototype())))


def parsed(buffer: Buffer | None) -> dict[str, Any] | None:
    """Return a JSON document's content; None if it is missing or torn."""
    if buffer is None:
        return None
    try:
        content = json.loads(buffer.to_bytes())
    except (ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) else None


def write_manifest(store: Store, manifest: Manifest) -> None:
    """Write a store's manifest and its copy."""
    content = {"attributes": manifest.attributes, "files": manifest.files}
    for key in KEYS:
        put(store, key, {**content, "digest": digest(encoded(content))})


def read_manifest(store: Store) -> tuple[Manifest | None, list[str]]:
    """Return a store's manifest, or None if neither copy is sound, and the unsound copies' keys."""
    copies: list[Manifest] = []
    unsound = []
    for key in KEYS:
        buffer = sync(store.get(key, default_buffer_prototype()))
        content = parsed(buffer)
        try:
            # To the letter: another spelling of the same content is damage, too.
            if buffer is None or content is None or encoded(content) != buffer.to_bytes():
                raise ValueError(key)
            if content.pop("digest") != digest(encoded(content)):
                raise ValueError(key)
            files = {key: int(value) for key, value in content["files"].items()}
            if any("\0" in key or ".." in key or key.startswith("/") for key in files):
                raise ValueError("a key outside the store")
            copies.append(Manifest(dict(content["attributes"]), files))
        except (AttributeError, KeyError, TypeError, ValueError):
            unsound.append(key)
    if len(copies) == 2 and copies[0] != copies[1]:
        # A kill came between the two writes: the first copy is the newer.
        unsound.append(KEYS[1])
    return (copies[0] if copies else None), unsound
