"""An open store: where it lies, the pipeline that it belongs to, its arrays and its metadata."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, cast

import zarr
from zarr.abc.store import Store
from zarr.buffer import default_buffer_prototype

from sweep.plan.experiment import Pipeline
from sweep.plan.grid import Blocks
from sweep.plan.parameters import Stage
from sweep.plan.schema import variables_of
from sweep.plan.variable import Variable
from sweep.store.checksums import DigestingStore
from sweep.store.durability import DurableStore
from sweep.store.locations import is_remote
from sweep.store.manifest import parsed
from sweep.store.zarr_sync import sync


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
    format
        The version of the layout, which decides which variables there are.
    """

    url: str
    group: zarr.Group
    pipeline: Pipeline
    run_id: str
    blocks: Blocks
    format: int
    _arrays: dict[str, zarr.Array[Any]] = field(default_factory=dict, repr=False, compare=False)

    @property
    def storage(self) -> DigestingStore:
        """The storage that holds the store's files."""
        return cast("DigestingStore", self.group.store)

    @cached_property
    def variables(self) -> tuple[Variable, ...]:
        """The variables of the pipeline in the store's format."""
        return variables_of(self.pipeline, self.format)

    @cached_property
    def variable_names(self) -> frozenset[str]:
        """The names of the variables."""
        return frozenset(variable.name for variable in self.variables)

    @cached_property
    def flag_names(self) -> frozenset[str]:
        """The names of the variables that are flags."""
        return frozenset(variable.name for variable in self.variables if variable.flags is not None)

    @cached_property
    def configurations(self) -> tuple[int, int]:
        """How many detector settings there are, and how many estimators for each."""
        return self.pipeline.size(Stage.detection), self.pipeline.size(Stage.estimation)

    @property
    def data_url(self) -> str:
        """The URL that a user opens with ``xarray.open_zarr``."""
        return f"{self.url}/{self.run_id}" if is_remote(self.url) else self.url

    @property
    def durable(self) -> bool:
        """Whether it flushes what it writes, so that a power failure takes nothing of it."""
        return isinstance(self.storage.below, DurableStore)

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
        root = parsed(sync(self.storage.get("zarr.json", default_buffer_prototype()))) or {}
        return dict(root["attributes"]["sweep"])


async def list_folder(storage: Store, prefix: str) -> list[str]:
    """Return the names in a folder of a storage; none if there is no such folder."""
    try:
        names: AsyncIterator[str] = storage.list_dir(prefix)
        return [name async for name in names]
    except FileNotFoundError:
        return []
