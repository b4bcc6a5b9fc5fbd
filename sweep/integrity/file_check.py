"""The check of a store's files outside its blocks: digests, metadata, coordinates."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from zarr.buffer import default_buffer_prototype

from sweep.integrity.damage import ArrayDamage, Damage, FileDamage
from sweep.plan.attributes import with_description
from sweep.store.layout import FORMAT, RECEIPTS, PlannedArray, documents
from sweep.store.manifest import Manifest, parsed
from sweep.store.provenance import environment
from sweep.store.run_store import RunStore
from sweep.store.schema_check import schema_faults
from sweep.store.zarr_sync import sync


@dataclass(slots=True)
class FileFindings:
    """The result of the check.

    Attributes
    ----------
    keys
        Keys of the files that belong to the store and to no block.
    bytes
        Size of the sound ones among those that the manifest lists.
    grid_fits
        Whether the arrays are of the grid that the pipeline declares, so that its blocks are
        those of the store.
    damage
        What is damaged.
    """

    keys: set[str] = field(default_factory=set)
    bytes: int = 0
    grid_fits: bool = True
    damage: list[Damage] = field(default_factory=list)


class FileCheck:
    """Checks the files of a store that belong to no block.

    The metadata of a damaged document are replaced, for this process, by those that the pipeline
    asks for (``DigestingStore.substitutes``), so that the files below it can be checked.

    Parameters
    ----------
    store
        The store, which may be damaged.
    manifest
        Its manifest; None if both copies are damaged.
    planned
        The arrays that its pipeline asks for.
    """

    def __init__(
        self, store: RunStore, manifest: Manifest | None, planned: list[PlannedArray]
    ) -> None:
        self._store = store
        self._storage = store.storage
        self._manifest = manifest
        self._planned = planned
        self._expected = documents(planned)
        self._findings = FileFindings()
        self._wrong: set[str] = set()

    def run(self, listed: set[str]) -> FileFindings:
        """Check the files; ``listed`` are the keys of all files of the store."""
        recorded = {} if self._manifest is None else dict(self._manifest.files)
        recorded.pop("zarr.json", None)
        self._check_digests(recorded)
        self._check_schema()
        self._findings.grid_fits = RECEIPTS not in self._wrong
        self._findings.keys = set(recorded) | {"commits/zarr.json"}
        self._check_arrays(recorded.keys() | listed)
        if self._manifest is None:
            self._findings.keys |= {
                key for key in listed if key.startswith(("cost/", "failures/"))
            }
        return self._findings

    def _check_digests(self, recorded: dict[str, int]) -> None:
        for key, expected in recorded.items():
            reason = self._storage.unreadable(key)
            content = None if reason else sync(self._storage.get(key, default_buffer_prototype()))
            if content is None or self._storage.digests.pop(key) != expected:
                self._wrong.add(key)
                what = reason or ("missing" if content is None else "changed")
                self._findings.damage.append(FileDamage(key, what))
                self._substitute(key)
            else:
                self._findings.bytes += len(content)

    def _check_schema(self) -> None:
        for path, fault in schema_faults(self._store).items():
            document = f"{path}/zarr.json"
            if document in self._wrong:
                continue
            self._wrong.add(path)
            self._findings.damage.append(ArrayDamage(path, fault))
            self._substitute(document)

    def _check_arrays(self, known: set[str]) -> None:
        """Check values, attributes, and the copies of the metadata, of the sound arrays.

        Optional ones of which no file is ``known`` are not there.
        """
        consolidated = self._consolidated_metadata()
        # Another version of sweep may word the attributes otherwise.
        recorded = self._store.run_metadata["environment"].get("sweep")
        same_version = self._store.format == FORMAT and recorded == environment()["sweep"]
        for planned in self._planned:
            document = f"{planned.path}/zarr.json"
            own = {document, *planned.value_keys()}
            if planned.optional and not own & known:
                continue
            self._findings.keys |= own
            if self._wrong & {planned.path, *own}:
                continue
            if fault := self._value_fault(planned, same_version):
                self._findings.damage.append(ArrayDamage(planned.path, fault))
                continue
            if consolidated is not None and consolidated.get(planned.path) != parsed(
                sync(self._storage.get(document, default_buffer_prototype()))
            ):
                consolidated = None
                self._findings.damage.append(
                    FileDamage("zarr.json", f"its copy of {document} differs from that document")
                )

    def _substitute(self, key: str) -> None:
        if key in self._expected:
            self._storage.substitutes[key] = self._expected[key]

    def _consolidated_metadata(self) -> dict[str, Any] | None:
        """Return the root's copy of all arrays' metadata; None if it has none."""
        root = parsed(sync(self._storage.get("zarr.json", default_buffer_prototype()))) or {}
        try:
            return dict(root["consolidated_metadata"]["metadata"])
        except (KeyError, TypeError, ValueError):
            return None

    def _value_fault(self, planned: PlannedArray, same_version: bool) -> str:
        """Return how an array's attributes or coordinates differ from the pipeline's."""
        array = self._store.array(planned.path)
        attributes = with_description(planned.path, array.attrs)
        if same_version and attributes != planned.attributes:
            return "its attributes differ from the schema's"
        try:
            for part, values in planned.pieces():
                stored = np.asarray(array[part])
                if stored.shape != values.shape or not (stored == values).all():
                    return "its values differ from the pipeline's"
        except Exception as error:
            # Decoding a damaged chunk may raise anything.
            return f"unreadable: {type(error).__name__}"
        return ""
