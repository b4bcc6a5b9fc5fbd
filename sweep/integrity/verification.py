"""Whether a store is whole and right: every stored byte accounted for, and a sample recomputed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from zarr.buffer import cpu, default_buffer_prototype

from sweep.compilation import processor
from sweep.errors import StoreError, SweepError
from sweep.evaluation.results import to_dataset_layout
from sweep.execution.limits import TIME_LIMIT_S
from sweep.integrity.consistency import contradiction
from sweep.integrity.tolerances import MAX_OUTSIDE, departure, difference, outside
from sweep.isolation.crash_isolation import run_cells_isolated
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.plan.cell_selection import at_text
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import Block, scene_axes
from sweep.plan.parameters import Stage
from sweep.plan.schema import SCHEMA, Variable
from sweep.store.blocks import BEGUN, chunk_key, committed, parsed_receipt, region
from sweep.store.checksums import digest
from sweep.store.layout import (
    RECEIPTS,
    PlannedArray,
    decoded_chunk,
    documents,
    planned_arrays,
)
from sweep.store.lifecycle import store_of
from sweep.store.locations import open_storage
from sweep.store.lock import holder
from sweep.store.manifest import KEYS, Manifest, parsed, read_manifest
from sweep.store.provenance import differences, environment
from sweep.store.receipt import Receipt
from sweep.store.run_store import RunStore
from sweep.store.schema_check import schema_faults
from sweep.store.zarr_sync import sync

THREADS, WINDOW = 4, 256
"""Blocks that are read and decoded at a time, and that are under way."""

CHANGED = "changed: not what its checksum says"

SAMPLE = 20
"""Scenes that are computed again where no number is given."""


@dataclass(frozen=True, slots=True)
class Damage:
    """One thing that is wrong: which file, array or scene, in what, and of which block."""

    where: str
    what: str
    block: int | None = None


@dataclass(slots=True)
class IntegrityReport:
    """What was found in a store.

    Attributes
    ----------
    damage
        What is wrong; empty for a sound store.
    repaired
        What was wrong, and has been mended.
    blocks, blocks_done
        In all, and committed.
    files, bytes
        How many stored files were read, and their size.
    sampled
        Scenes that were computed again.
    not_sampled
        Why none were, where none were.
    left_over
        Files that are no part of the store, such as what a killed process was writing.
    """

    store: str
    finished: bool
    blocks: int
    blocks_done: int
    files: int = 0
    bytes: int = 0
    sampled: int = 0
    not_sampled: str = ""
    damage: list[Damage] = field(default_factory=list)
    repaired: list[Damage] = field(default_factory=list)
    left_over: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class _Checked:
    """A block that was looked through: what is wrong with it by key."""

    number: int
    faults: dict[str, str]
    bytes: int
    processor: str


def verify(url: str, sample: int = SAMPLE) -> IntegrityReport:
    """Check a store: every file against its digest, flags against numbers, a sample computed again.

    Raises
    ------
    StoreError
        Where there is no store, or so little of one that it cannot be told what it was.
    """
    if sample < 0:
        raise StoreError(f"--sample {sample}: expected at least 0")
    return Check(url, "r").verdict(sample)


class Check:
    """One look through a store; ``mode`` "r+" to mend it afterwards."""

    def __init__(self, url: str, mode: str) -> None:
        self.place = open_storage(url, mode)
        self.manifest, unsound = read_manifest(self.place)
        self._damage = [Damage(key, "unreadable or out of date") for key in unsound]
        self._bytes = 0
        self._grid_fits = True
        self.store = store_of(url, self.place, self._attributes(url), mode)
        self.planned = planned_arrays(self.store.pipeline, self.store.blocks.extents)

    async def _listed(self) -> set[str]:
        return {key async for key in self.place.list_prefix("")}

    def _attributes(self, url: str) -> dict[str, Any]:
        """Return the root's attributes, from the manifest where the root's own are damaged."""
        buffer = sync(self.place.get("zarr.json", default_buffer_prototype()))
        content = parsed(buffer)
        recorded = None if self.manifest is None else self.manifest.files.get("zarr.json")
        changed = recorded is not None and recorded != self.place.digests.get("zarr.json")
        if content is not None and isinstance(content.get("attributes"), dict) and not changed:
            return dict(content["attributes"])
        self._damage.append(Damage("zarr.json", "missing" if buffer is None else "changed"))
        if self.manifest is None:
            raise StoreError(
                f"{url}: zarr.json and the manifest are damaged: what it held cannot be told; "
                "`sweep run --overwrite` computes it again"
            )
        self.place.substitutes["zarr.json"] = cpu.Buffer.from_bytes(root_document(self.manifest))
        return self.manifest.attributes

    def verdict(self, sample: int) -> IntegrityReport:
        """Look through the store, and compute up to ``sample`` scenes again."""
        store = self.store
        done = committed(store)
        left = sync(self._listed())
        files = len(left)
        left -= {"zarr.json", *KEYS} | self._check_files()
        sound: dict[int, str] = {}
        expected = range(len(store.blocks)) if store.finished else sorted(done)
        if not self._grid_fits:
            expected = []  # the blocks that the pipeline says are not those of the arrays
        with ThreadPoolExecutor(THREADS) as pool:
            # A window of them at a time: their number may be large.
            for start in range(0, len(expected), WINDOW):
                for block in pool.map(self._check_block, expected[start : start + WINDOW]):
                    left.difference_update(self._block_keys(block.number))
                    self._bytes += block.bytes
                    self._damage += [
                        Damage(key, what, block.number) for key, what in block.faults.items()
                    ]
                    if not block.faults:
                        sound[block.number] = block.processor
        files -= len(left)
        sampled, not_sampled = 0, "no scenes were asked for" if not sample else "no block is there"
        if sample and sound:
            sampled, not_sampled = self._check_sample(sample, sound)
        alive = holder(self.place) is not None
        return IntegrityReport(
            store.url, store.finished, len(store.blocks), len(done), files,
            self._bytes, sampled, not_sampled, self._damage,
            left_over=[] if alive else sorted(key for key in left if not self._in_use(key, done)),
        )

    def _in_use(self, key: str, done: set[int]) -> bool:
        """Tell whether a key is of a block that a run will write again."""
        name, _, place = key.partition("/c/")
        if key.startswith(f"{BEGUN}/"):
            number = key.removeprefix(f"{BEGUN}/")
            return number.isdecimal() and int(number) not in done
        variable = next((v for v in SCHEMA if v.name == name), None)
        if variable is None or self.store.finished:
            return False
        position = dict(
            zip(variable.dimensions(self.store.pipeline), place.split("/"), strict=False)
        )
        try:
            starts = tuple(
                int(position[axis.name]) * extent for axis, extent in
                zip(scene_axes(self.store.pipeline), self.store.blocks.extents, strict=True)
            )
        except (KeyError, ValueError):
            return False
        return self.store.blocks.number(Block(starts, starts)) not in done

    def _check_files(self) -> set[str]:
        """Check all files that are no block's; return their keys."""
        recorded = {} if self.manifest is None else dict(self.manifest.files)
        recorded.pop("zarr.json", None)
        wrong: set[str] = set()
        # What is below a damaged document is read by the document that should be there.
        right = documents(self.planned)
        for key, expected in recorded.items():
            content = sync(self.place.get(key, default_buffer_prototype()))
            if content is None or self.place.digests.pop(key) != expected:
                wrong.add(key)
                self._damage.append(Damage(key, "missing" if content is None else "changed"))
                if key in right:
                    self.place.substitutes[key] = right[key]
            else:
                self._bytes += len(content)
        for name, fault in schema_faults(self.store).items():
            if f"{name}/zarr.json" in wrong:
                continue
            wrong.add(name)
            self._damage.append(Damage(name, fault))
            if f"{name}/zarr.json" in right:
                self.place.substitutes[f"{name}/zarr.json"] = right[f"{name}/zarr.json"]
        known = set(recorded) | {"commits/zarr.json"}
        self._grid_fits = RECEIPTS not in wrong
        consolidated = self._consolidated()
        for planned in self.planned:
            own = {f"{planned.path}/zarr.json", *planned.value_keys()}
            known |= own
            if wrong & {planned.path, *own}:
                continue
            if fault := self._misfit(planned):
                self._damage.append(Damage(planned.path, fault))
                continue
            document = f"{planned.path}/zarr.json"
            if consolidated is not None and consolidated.get(planned.path) != parsed(
                sync(self.place.get(document, default_buffer_prototype()))
            ):
                consolidated = None
                self._damage.append(
                    Damage("zarr.json", f"its copy of {document} is not that document")
                )
        if self.manifest is None:
            known |= {
                key for key in sync(self._listed()) if key.startswith(("cost/", "failures/"))
            }
        return known

    def _consolidated(self) -> dict[str, Any] | None:
        """Return the copy of all arrays' documents that the root has; None where it has none."""
        root = parsed(sync(self.place.get("zarr.json", default_buffer_prototype()))) or {}
        try:
            return dict(root["consolidated_metadata"]["metadata"])
        except (KeyError, TypeError, ValueError):
            return None

    def _misfit(self, planned: PlannedArray) -> str:
        """Return in what an array is not as the pipeline says, beside its schema."""
        array = self.store.array(planned.path)
        same_sweep = self.store.run_metadata["environment"].get("sweep") == environment()["sweep"]
        if same_sweep and dict(array.attrs) != planned.attributes:
            return "its attributes are not as they should be"
        try:
            for where, values in planned.pieces():
                there = np.asarray(array[where])
                if there.shape != values.shape or not (there == values).all():
                    return "its values are not the pipeline's"
        except Exception as error:
            # Whatever decoding a damaged chunk raises.
            return f"unreadable: {type(error).__name__}"
        return ""

    def _block_keys(self, number: int) -> list[str]:
        """Return the keys of a block's receipt and chunks."""
        block = self.store.blocks[number]
        return [f"{RECEIPTS}/c/{number}",
                *(chunk_key(self.store, variable, block) for variable in SCHEMA)]

    def _check_block(self, number: int) -> _Checked:
        """Check one block; in any thread."""
        store, block = self.store, self.store.blocks[number]
        keys = self._block_keys(number)
        contents = self.place.contents(keys)
        faults = {
            key: "missing" for key, content in zip(keys, contents, strict=True) if content is None
        }
        size = sum(len(content) for content in contents if content is not None)
        receipt: Receipt | None = None
        if contents[0] is not None:
            try:
                text = np.asarray(store.array(RECEIPTS)[number : number + 1]).tolist()[0]
                receipt = parsed_receipt(store, number, text)
            except Exception:
                # Whatever decoding a damaged chunk raises.
                faults[keys[0]] = CHANGED
        values: dict[str, NDArray[Any]] = {}
        for variable, key, content in zip(SCHEMA, keys[1:], contents[1:], strict=True):
            if content is None:
                continue
            if receipt is not None and digest(content) != receipt.digests[variable.name]:
                faults[key] = CHANGED
                continue
            try:
                values[variable.name] = self._decoded(content, variable, block)
            except (ValueError, RuntimeError):
                faults[key] = CHANGED
        if not faults and receipt is not None:
            against = contradiction(store.pipeline, values, receipt)
            if against:
                faults[f"block {block}"] = against
        return _Checked(number, faults, size, receipt.processor if receipt is not None else "")

    def _decoded(self, content: bytes, variable: Variable, block: Block) -> NDArray[Any]:
        """Return a chunk's values within the grid; ValueError where it fails its checksum."""
        array = self.store.array(variable.name)
        cells = decoded_chunk(content, array.dtype, array.chunks)
        inside = region(variable, self.store.pipeline, block)
        return cells[tuple(
            slice(0, (part.stop or length) - (part.start or 0))
            for part, length in zip(inside, array.shape, strict=True)
        )]

    def _check_sample(self, count: int, sound: Mapping[int, str]) -> tuple[int, str]:
        """Compute scenes of sound blocks again; return how many, or why none."""
        store = self.store
        try:
            pipeline = computable(store)
        except SweepError as error:
            return 0, str(error).splitlines()[-1].strip()
        generator = np.random.default_rng()
        numbers = np.array(list(sound))
        scenes = np.array([len(store.blocks[number]) for number in numbers.tolist()])
        picked = generator.choice(numbers, size=count, p=scenes / scenes.sum()).tolist()
        cells = sorted({
            (number, int(generator.integers(len(store.blocks[number])))) for number in picked
        })
        stored = {cell: self._stored(*cell) for cell in cells}
        # What ended a process then is not tried again here.
        cells = [
            cell for cell in cells
            if not (stored[cell]["detection"] == DetectionStatus.crashed).any()
            and not (stored[cell]["estimate"] == EstimateStatus.crashed).any()
        ]
        if not cells:
            return 0, "the scenes that were drawn had ended their process"
        indices = [
            np.array(index, dtype=np.intp)
            for index in zip(
                *(store.blocks[number].cell(scene) for number, scene in cells), strict=True
            )
        ]
        shape = (len(cells), pipeline.size(Stage.detection), pipeline.size(Stage.estimation))
        again = run_cells_isolated(pipeline, indices, np.ones(shape, dtype=bool), TIME_LIMIT_S)
        axes = scene_axes(pipeline)
        one = Block((0,) * len(axes), (1,) * len(axes))
        elsewhere = 0
        strayed: list[str] = []
        for row, cell in enumerate(cells):
            here = {
                v.name: to_dataset_layout(
                    v, pipeline, one, [part[row : row + 1] for part in again.columns[v.name]]
                )
                for v in SCHEMA
            }
            there = stored[cell]
            at = at_text({
                axis.name: axis.values[k]
                for axis, k in zip(axes, store.blocks[cell[0]].cell(cell[1]), strict=True)
            })
            if sound[cell[0]] == processor():
                told = difference(here, there)
            else:
                elsewhere += 1
                told = departure(here, there)
                strayed += [f"{name} at --at {at}" for name in [outside(here, there)] if name]
            if told:
                self._damage.append(
                    Damage(f"--at {at}", f"computed again, it differs: {told}", cell[0])
                )
        if len(strayed) > max(2, MAX_OUTSIDE * elsewhere):
            self._damage.append(
                Damage("sample", f"{len(strayed)} of {elsewhere} scenes of another processor "
                       f"differ beyond the tolerance, as {strayed[0]}")
            )
        return len(cells), ""

    def _stored(self, number: int, scene: int) -> dict[str, NDArray[Any]]:
        index = self.store.blocks[number].cell(scene)
        one = Block(index, tuple(k + 1 for k in index))
        return {
            v.name: np.asarray(self.store.array(v.name)[region(v, self.store.pipeline, one)])
            for v in SCHEMA
        }


def computable(store: RunStore) -> Pipeline:
    """Return a store's pipeline, to be computed here.

    Raises
    ------
    StoreError
        Where it would give other numbers here.
    PipelineError
        Where it cannot be run here at all, as for want of a file.
    """
    stored = store.pipeline
    pipeline = Pipeline.from_text(
        stored.text, name=stored.name, source=store.url, folder=stored.folder
    )
    lines = differences(pipeline, stored, store.fingerprint)
    if lines:
        raise StoreError("\n".join([f"{store.url}: cannot be computed again here:", *lines]))
    return pipeline


def root_document(manifest: Manifest) -> bytes:
    """Return the root's metadata as a manifest has them."""
    content = {"zarr_format": 3, "node_type": "group", "attributes": manifest.attributes}
    return json.dumps(content).encode()

