"""Verification of a store: every stored byte is checked, and a sample of scenes is recomputed."""

from __future__ import annotations

import json
from collections.abc import Container, Sequence
from dataclasses import dataclass, field
from typing import Any

from zarr.buffer import cpu, default_buffer_prototype

from sweep.errors import ArgumentError, StoreError
from sweep.integrity.block_check import BlockCheck
from sweep.integrity.damage import Damage, FileDamage, as_json
from sweep.integrity.failure_check import FailureCheck, is_doubtful
from sweep.integrity.file_check import FileCheck
from sweep.integrity.needed_check import NeededCheck
from sweep.integrity.sample_check import SampleCheck
from sweep.store.blocks import BEGUN, committed
from sweep.store.layout import planned_arrays
from sweep.store.lifecycle import store_of
from sweep.store.locations import open_storage
from sweep.store.lock import holder
from sweep.store.manifest import KEYS, Manifest, parsed, read_manifest
from sweep.store.snapshot import BlockKeys, axis_positions, block_of_chunk
from sweep.store.zarr_sync import sync

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

    def to_json(self) -> dict[str, Any]:
        """Return the report as ``sweep verify --json`` prints it."""
        return {
            "store": self.store, "finished": self.finished, "blocks": self.blocks,
            "blocks_done": self.blocks_done, "files": self.files, "bytes": self.bytes,
            "sampled": self.sampled, "not_sampled": self.not_sampled,
            "retried": self.retried,
            "damage": [as_json(damage) for damage in self.damage],
            "repaired": [as_json(damage) for damage in self.repaired],
            "left_over": self.left_over,
        }


def verify(url: str, sample: int = SAMPLE) -> IntegrityReport:
    """Check every file against its digest and flags against numbers, and recompute a sample.

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
        The storage that holds its files; damaged metadata are substituted.
    manifest
        Its manifest; None if both copies are damaged.
    store
        The store.
    planned
        The arrays that its pipeline asks for.
    """

    def __init__(self, url: str, mode: str) -> None:
        self.storage = open_storage(url, mode)
        self.manifest, unsound = read_manifest(self.storage)
        self._damage: list[Damage] = [
            FileDamage(key, "unreadable or out of date") for key in unsound
        ]
        self.store = store_of(url, self.storage, self._root_attributes(url), mode)
        self._positions = axis_positions(self.store)
        self.planned = planned_arrays(
            self.store.pipeline, self.store.blocks.extents, self.store.format
        )

    def _root_attributes(self, url: str) -> dict[str, Any]:
        """Return the root's attributes, or the manifest's if the root's are damaged."""
        buffer = sync(self.storage.get("zarr.json", default_buffer_prototype()))
        content = parsed(buffer)
        recorded = None if self.manifest is None else self.manifest.files.get("zarr.json")
        changed = recorded is not None and recorded != self.storage.digests.get("zarr.json")
        if content is not None and isinstance(content.get("attributes"), dict) and not changed:
            return dict(content["attributes"])
        what = self.storage.unreadable("zarr.json") or ("missing" if buffer is None else "changed")
        self._damage.append(FileDamage("zarr.json", what))
        if self.manifest is None:
            raise StoreError(
                f"{url}: zarr.json and both copies of the manifest are damaged, so that its "
                "pipeline is lost; `sweep run --overwrite` computes it again"
            )
        self.storage.substitutes["zarr.json"] = cpu.Buffer.from_bytes(root_document(self.manifest))
        return self.manifest.attributes

    def report(self, sample: int) -> IntegrityReport:
        """Check the store, and recompute up to ``sample`` scenes and all that failed.

        With a sample of 0, nothing is recomputed.
        """
        store = self.store
        done = committed(store)
        numbers: Sequence[int] = range(len(store.blocks)) if store.finished else sorted(done)
        checked: Container[int] = numbers if store.finished else done
        listed, left = sync(self._listed(checked))
        files = FileCheck(store, self.manifest, self.planned).run(left)
        if not files.grid_fits:
            # The blocks of the pipeline's grid are not those of the arrays.
            numbers = []
            listed, left = sync(self._listed(numbers))
        left -= {"zarr.json", *KEYS} | files.keys
        self._damage += files.damage
        size = files.bytes
        sound: dict[int, str] = {}
        needed: dict[int, int] = {}
        doubtful = []
        for block in BlockCheck(store).run(numbers):
            size += block.bytes
            self._damage += block.damage
            if not block.damage and block.receipt is not None:
                sound[block.number] = block.receipt.processor
                needed[block.number] = block.receipt.scenes_needed
                if is_doubtful(block.receipt):
                    doubtful.append(block.number)
        self._damage += NeededCheck(store).run(sound)
        sampled = SampleCheck(store).run(sample, sound, needed)
        self._damage += sampled.damage
        retried = FailureCheck(store).run(doubtful if sample else [])
        self._damage += retried.damage
        held = holder(self.storage) is not None
        return IntegrityReport(
            store.url, store.finished, len(store.blocks), len(done), listed - len(left), size,
            sampled.count, sampled.reason, retried.count, self._damage,
            left_over=[] if held else sorted(
                key for key in left if not self._of_unfinished_block(key, done)
            ),
        )

    async def _listed(self, checked: Container[int]) -> tuple[int, set[str]]:
        """Return how many files there are, and the keys of those that belong to no checked block.

        There may be 25 million files.
        """
        count, others, block_keys = 0, set(), BlockKeys(self.store)
        async for key in self.storage.list_prefix(""):
            count += 1
            number = block_keys.number(key)
            if number is None or number not in checked:
                others.add(key)
        return count, others

    def _of_unfinished_block(self, key: str, done: set[int]) -> bool:
        """Return whether a key belongs to a block that a run will write again."""
        store = self.store
        if key.startswith(f"{BEGUN}/"):
            number = key.removeprefix(f"{BEGUN}/")
            return number.isdecimal() and int(number) not in done
        written = block_of_chunk(key, store.blocks, self._positions)
        return written is not None and not store.finished and written not in done


def root_document(manifest: Manifest) -> bytes:
    """Return the root's metadata document as a manifest records it."""
    content = {"zarr_format": 3, "node_type": "group", "attributes": manifest.attributes}
    return json.dumps(content).encode()
