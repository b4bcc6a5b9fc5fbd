"""The manifest: digests of a store's files that are no block's, and a copy of its attributes.

With the digests that receipts hold, every stored byte is accounted for, so that damage is found
wherever it is; and what no block tells, such as the pipeline, is there twice. The manifest itself
is written twice and carries its own digest.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from zarr.abc.store import Store
from zarr.core.buffer import Buffer, cpu, default_buffer_prototype
from zarr.core.sync import sync

from sweep.store.checksums import digest
from sweep.store.layout import RECEIPTS

KEYS = (f"{RECEIPTS}/manifest.json", f"{RECEIPTS}/manifest-copy.json")
"""Where the manifest lies: in the receipts' folder, where Zarr looks for chunks alone."""


@dataclass(slots=True)
class Manifest:
    """What is recorded of a store: its attributes, and the digests of its files by key."""

    attributes: dict[str, Any]
    files: dict[str, int]


def put(store: Store, key: str, content: dict[str, Any]) -> None:
    """Write a small JSON document beside the arrays."""
    sync(store.set(key, cpu.Buffer.from_bytes(encoded(content))))


def encoded(content: dict[str, Any]) -> bytes:
    """Return a JSON document's bytes."""
    return json.dumps(content, separators=(",", ":")).encode()


def get(store: Store, key: str) -> dict[str, Any] | None:
    """Read a small JSON document; None where it is not there or is torn."""
    return parsed(sync(store.get(key, default_buffer_prototype())))


def parsed(buffer: Buffer | None) -> dict[str, Any] | None:
    """Return a JSON document's content; None where there is none or it is torn."""
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
    """Return a store's manifest, None where neither copy is sound, and the unsound copies' keys."""
    found: list[Manifest] = []
    unsound = []
    for key in KEYS:
        buffer = sync(store.get(key, default_buffer_prototype()))
        content = parsed(buffer)
        try:
            # To the letter: another spelling of the same is damage too.
            if buffer is None or content is None or encoded(content) != buffer.to_bytes():
                raise ValueError(key)
            if content.pop("digest") != digest(encoded(content)):
                raise ValueError(key)
            files = {key: int(value) for key, value in content["files"].items()}
            if any("\0" in key or ".." in key or key.startswith("/") for key in files):
                raise ValueError("a key outside the store")
            found.append(Manifest(dict(content["attributes"]), files))
        except (AttributeError, KeyError, TypeError, ValueError):
            unsound.append(key)
    if len(found) == 2 and found[0] != found[1]:
        # A kill came between the two: the first is the later.
        unsound.append(KEYS[1])
    return (found[0] if found else None), unsound
