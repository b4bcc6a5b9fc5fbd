"""Blocks of which not all scenes are needed: what is written of those that are not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.execution.reuse import LOST
from sweep.measure.flags import DetectionStatus
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import Block, scene_axes
from sweep.plan.variable import Variable
from sweep.sampling.deciding import by_scene
from sweep.store.blocks import region
from sweep.store.run_store import RunStore
from sweep.typing import Masks

Values = dict[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class OwnCells:
    """What a committed block holds.

    Attributes
    ----------
    values
        Variable -> values in the dataset's dimensions.
    needed
        (N,) scenes that were needed.
    whole
        (N,) those of them of which no cell failed or crashed.
    """

    values: Values
    needed: Masks
    whole: Masks


def own_cells(store: RunStore, block: Block) -> OwnCells:
    """Return what a committed block of a store holds."""
    pipeline = store.pipeline
    values = {
        variable.name: np.asarray(store.array(variable.name)[region(variable, pipeline, block)])
        for variable in store.variables
    }
    flags = {
        variable.name: by_scene(variable, pipeline, block, values[variable.name])
        for variable in store.variables if variable.name in LOST
    }
    needed = (flags["detection"] != DetectionStatus.not_needed).all(axis=1)
    lost = np.zeros(len(block), dtype=bool)
    for name, losses in LOST.items():
        lost |= np.isin(flags[name], losses).any(axis=1)
    return OwnCells(values, needed, needed & ~lost)


def with_scenes(
    variables: Sequence[Variable], pipeline: Pipeline, block: Block, scenes: Masks,
    values: Mapping[str, NDArray[Any]], others: Mapping[str, NDArray[Any]] | None = None,
) -> Values:
    """Return values of a block with the ``scenes`` (N,) taken from others.

    Without others, they are not needed: their flags say so, and their numbers are NaN.
    """
    taken: Values = {}
    for variable in variables:
        names = variable.dimensions(pipeline)
        along = dict(zip((axis.name for axis in scene_axes(pipeline)), block.shape, strict=True))
        mask = scenes.reshape([along.get(name, 1) for name in names])
        other = variable.not_needed if others is None else others[variable.name]
        taken[variable.name] = np.where(mask, other, values[variable.name]).astype(variable.dtype)
    return taken
