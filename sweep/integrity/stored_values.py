"""Values as a store holds them, and the pipeline with which they are recomputed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import processor
from sweep.errors import StoreError
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import Block, scene_axes
from sweep.store.blocks import committed, receipts, region
from sweep.store.provenance import differences
from sweep.store.run_store import RunStore

Values = dict[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class StoredCell:
    """A cell of a store.

    Attributes
    ----------
    values
        Variable -> its value, of the dimensions that are no axes.
    same_processor
        Whether it was computed on a processor with the features of this one.
    """

    values: Values
    same_processor: bool


def stored_cell(store: RunStore, index: Mapping[str, int]) -> StoredCell | None:
    """Return the cell at an index along each axis; None if its block is not committed.

    Raises
    ------
    StoreError
        If its receipt is damaged.
    """
    corner = tuple(index[axis.name] for axis in scene_axes(store.pipeline))
    number = store.blocks.number(Block(corner, corner))
    if number not in committed(store):
        return None
    _, receipt = next(iter(receipts(store, [number])))
    values = {}
    for variable in store.variables:
        part = tuple(
            index.get(name, slice(None)) for name in variable.dimensions(store.pipeline)
        )
        values[variable.name] = np.asarray(store.array(variable.name)[part])
    return StoredCell(values, receipt.processor == processor())


def stored_scene(store: RunStore, number: int, scene: int) -> Values:
    """Return a scene of a block with all its configurations; its scene axes have length 1."""
    index = store.blocks[number].cell(scene)
    block = Block(index, tuple(k + 1 for k in index))
    return {
        variable.name: np.asarray(
            store.array(variable.name)[region(variable, store.pipeline, block)]
        )
        for variable in store.variables
    }


def current_pipeline(store: RunStore) -> tuple[Pipeline, list[str]]:
    """Return a store's pipeline with the files and versions of this machine, and what changed.

    Raises
    ------
    PipelineError
        If it cannot be computed at all, for want of a file, say.
    """
    stored = store.pipeline
    pipeline = Pipeline.from_text(
        stored.text, name=stored.name, source=store.url, folder=stored.folder,
        camera_files=stored.files,
    )
    return pipeline, differences(pipeline, stored, store.fingerprint)


def computable(store: RunStore) -> Pipeline:
    """Return a store's pipeline, to be computed on this machine.

    Raises
    ------
    StoreError
        If it would give other numbers.
    PipelineError
        If it cannot be computed at all, for want of a file, say.
    """
    pipeline, changes = current_pipeline(store)
    if changes:
        raise StoreError("\n".join(
            [f"{store.url}: cannot be recomputed on this machine:", *changes]
        ))
    return pipeline
