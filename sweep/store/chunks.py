"""Chunks of a store's variables: a block has one of each. Their keys, shapes and contents."""

from __future__ import annotations

from operator import floordiv
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.experiment.grid import Block, Blocks
from sweep.experiment.pipeline import Pipeline
from sweep.store.layout import RECEIPTS, packed


def receipt_key(number: int) -> str:
    """Return the key of a block's receipt."""
    return f"{RECEIPTS}/c/{number}"


class Chunks:
    """Chunks of the variables of a pipeline whose grid is cut into blocks; there may be millions.

    It holds only what can be pickled, since readers in other processes use it.

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
        # For each scene axis, its position among a variable's dimensions.
        self._positions: dict[str, tuple[int, ...]] = {}
        # The key of a variable's chunk, to be filled in with a block's index along each axis.
        self._templates: dict[str, str] = {}
        self._shapes: dict[str, tuple[int, ...]] = {}
        self._types: dict[str, tuple[str, float | int]] = {}
        for variable in pipeline.experiment.variables:
            names = variable.dimensions(pipeline)
            positions = tuple(names.index(name) for name in axes)
            parts = ["0"] * len(names)
            for axis, position in enumerate(positions):
                parts[position] = f"{{{axis}}}"
            self._positions[variable.name] = positions
            self._templates[variable.name] = "/".join([variable.name, "c", *parts])
            self._shapes[variable.name] = tuple(
                extents.get(name, length) for name, length in zip(
                    names, variable.shape(pipeline), strict=True)
            )
            self._types[variable.name] = variable.dtype, variable.fill

    def key(self, name: str, number: int) -> str:
        """Return the key of a variable's chunk of a block."""
        return self._templates[name].format(*self._index(number))

    def keys(self, number: int) -> dict[str, str]:
        """Return the keys of a block's chunks by variable."""
        index = self._index(number)
        return {name: template.format(*index) for name, template in self._templates.items()}

    def number(self, key: str) -> int | None:
        """Return the number of the block whose receipt or chunk lies under a key, else None."""
        name, _, position = key.partition("/c/")
        if name == RECEIPTS:
            number = int(position) if position.isascii() and position.isdecimal() else None
            return number if number is not None and receipt_key(number) == key else None
        if name not in self._positions:
            return None
        index = position.split("/") if position else []
        try:
            starts = tuple(
                int(index[at]) * extent
                for at, extent in zip(self._positions[name], self._blocks.extents, strict=True)
            )
            number = self._blocks.number(Block(starts, starts))
        except (IndexError, ValueError):
            return None
        inside = 0 <= number < len(self._blocks)
        return number if inside and self.key(name, number) == key else None

    def encoded(self, name: str, values: NDArray[Any]) -> bytes:
        """Return the content of a variable's chunk, as Zarr writes it.

        ``values`` are the block's, in the variable's dimensions. Beyond the grid's end, a chunk has
        fill values.
        """
        dtype, fill = self._types[name]
        shape = self._shapes[name]
        if np.shape(values) != shape:
            whole = np.full(shape, fill, dtype=dtype)
            whole[tuple(map(slice, np.shape(values)))] = values
            values = whole
        little = np.ascontiguousarray(values, dtype=np.dtype(dtype).newbyteorder("<"))
        return packed(little.tobytes())

    def _index(self, number: int) -> tuple[int, ...]:
        """Return a block's index along each scene axis."""
        return tuple(map(floordiv, self._blocks[number].starts, self._blocks.extents))
