"""Chunks of a store's variables: a block has one of each. Their keys, shapes and contents."""

from __future__ import annotations

from operator import floordiv
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.experiment.grid import Blocks
from sweep.experiment.pipeline import Pipeline
from sweep.store.layout import RECEIPTS, packed


def receipt_key(number: int) -> str:
    """Return the key of a block's receipt."""
    return f"{RECEIPTS}/c/{number}"


class Chunks:
    """Chunks of the variables of a pipeline whose grid is cut into blocks; there may be millions.

    Parameters
    ----------
    pipeline
        The pipeline.
    blocks
        The blocks of its grid.
    """

    def __init__(self, pipeline: Pipeline, blocks: Blocks) -> None:
        self._blocks = blocks
        axes = [axis.name for axis in pipeline.experiment.scene_axes]
        extents = dict(zip(axes, blocks.extents, strict=True))
        # The key of a variable's chunk, to be filled in with a block's index along each axis, and
        # for each axis, where its index is in the key.
        self._templates: dict[str, str] = {}
        self._positions: dict[str, list[int]] = {}
        self._empty: dict[str, NDArray[Any]] = {}
        for variable in pipeline.experiment.variables:
            names = variable.dimensions(pipeline)
            index = (f"{{{axes.index(name)}}}" if name in axes else "0" for name in names)
            self._templates[variable.name] = "/".join([variable.name, "c", *index])
            self._positions[variable.name] = [names.index(name) for name in axes]
            self._empty[variable.name] = np.broadcast_to(
                np.array(variable.fill, dtype=np.dtype(variable.dtype).newbyteorder("<")),
                tuple(extents.get(name, length) for name, length in zip(
                    names, variable.shape(pipeline), strict=True)),
            )

    def key(self, name: str, number: int) -> str:
        """Return the key of a variable's chunk of a block."""
        starts = self._blocks[number].starts
        return self._templates[name].format(*map(floordiv, starts, self._blocks.extents))

    def number(self, key: str) -> int | None:
        """Return the number of the block of which a chunk lies under a key; None if none does."""
        name, _, position = key.partition("/c/")
        parts = position.split("/")
        try:
            index = [int(parts[at]) for at in self._positions[name]]
            number = int(np.ravel_multi_index(index, self._blocks.counts)) if index else 0
        except (KeyError, IndexError, ValueError):
            return None
        return number if self.key(name, number) == key else None

    def encoded(self, name: str, values: NDArray[Any]) -> bytes:
        """Return the content of a variable's chunk, as Zarr writes it.

        ``values`` are the block's, in the variable's dimensions. Beyond the grid's end, a chunk has
        fill values.
        """
        whole = self._empty[name].copy()
        whole[tuple(map(slice, np.shape(values)))] = values
        return packed(whole.tobytes())
