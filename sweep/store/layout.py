"""The layout of a store: its arrays, their metadata, and the values of its coordinates."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import google_crc32c
import numcodecs.zstd
import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.dtype import parse_dtype
from zarr.storage import MemoryStore

from sweep.experiment.draws import DISTANCE_PARAMETERS, distance_of_side
from sweep.experiment.grid import TRIAL, Axis, Blocks
from sweep.experiment.parameters import PHOTOGRAPHS
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import (
    LABELS,
    VARIABLES,
    Variable,
    fixed_values,
    with_description,
)
from sweep.model.image_file import IMAGE_SUFFIXES
from sweep.store.files import files_in

FORMAT = 8
"""Version of the layout of stores; another one is refused."""

RECEIPTS = "commits/receipt"
"""Array of the blocks' receipts by number, JSON, a chunk each; empty unless committed."""

COORDINATE_CHUNK = 1 << 20

ZSTD_LEVEL = 3
"""Level of the compression of every chunk."""


@dataclass(frozen=True, slots=True)
class PlannedArray:
    """One array of a store.

    Attributes
    ----------
    path
        Its path in the store.
    shape, chunks, dtype, dimensions, fill, attributes
        Its metadata; ``fill`` is None for Zarr's default.
    values
        Its values; None for an array to which blocks or receipts are written later.
    coordinate
        Whether it is a coordinate that is no dimension.
    """

    path: str
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dtype: str
    dimensions: tuple[str, ...]
    fill: Any = None
    attributes: dict[str, Any] = field(default_factory=dict)
    values: NDArray[Any] | None = None
    coordinate: bool = False

    def create(self, group: zarr.Group) -> None:
        """Create the array and write its values."""
        options = {} if self.fill is None else {"fill_value": self.fill}
        array = group.create_array(
            self.path, shape=self.shape, chunks=self.chunks, dtype=_dtype(self.dtype),
            dimension_names=self.dimensions, compressors=codecs(), attributes=self.attributes,
            # Also what equals the fill value (a tilt of 0): a missing chunk is a deleted one.
            config={"write_empty_chunks": True}, **options,
        )
        if self.values is not None:
            array[...] = self.values


def planned_files(planned: Iterable[PlannedArray]) -> dict[str, bytes]:
    """Return the contents of the files that an empty store has by key, except the root's."""
    memory = MemoryStore()
    group = zarr.open_group(memory, mode="w", zarr_format=3)
    for array in planned:
        array.create(group)
    return {key: content for key, content in files_in(memory).items() if key != "zarr.json"}


@cache
def _dtype(name: str) -> Any:
    """Return Zarr's data type of a name; it looks through all that it knows, each time."""
    return parse_dtype(name, zarr_format=3)


def codecs() -> list[Any]:
    """Return the codecs of every array; a damaged chunk fails its checksum when it is read."""
    return [ZstdCodec(level=ZSTD_LEVEL), Crc32cCodec()]


def checksum_of(content: bytes) -> int:
    """Return the CRC-32C that Zarr wrote at a chunk's end."""
    return int.from_bytes(content[-4:], "little")


def packed(body: bytes) -> bytes:
    """Return a chunk's content from its bytes before compression, as Zarr writes it."""
    compressed = bytes(numcodecs.zstd.compress(body, ZSTD_LEVEL))
    checksum: int = google_crc32c.value(compressed)
    return compressed + checksum.to_bytes(4, "little")


def is_sound(content: bytes) -> bool:
    """Return whether a chunk fits the checksum at its end."""
    return bool(google_crc32c.value(content[:-4]) == checksum_of(content))


def unpacked(content: bytes) -> bytes:
    """Return the bytes that :func:`packed` took; ValueError or RuntimeError if damaged."""
    if not is_sound(content):
        raise ValueError("its checksum differs")
    return bytes(numcodecs.zstd.decompress(content[:-4]))


def planned_arrays(pipeline: Pipeline, extents: tuple[int, ...]) -> list[PlannedArray]:
    """Return the arrays of a pipeline's store whose chunks are blocks of ``extents``."""
    variables = pipeline.experiment.variables
    names = (axis.name for axis in pipeline.experiment.scene_axes)
    scene_extent = dict(zip(names, extents, strict=True))
    planned = [each for axis in pipeline.axes for each in _axis(axis)]
    used = {
        name: length for variable in variables
        for name, length in zip(variable.inner, variable.inner_shape, strict=True)
    }
    planned += [
        _coordinate(name, (name,), LABELS[name] or np.arange(used[name], dtype=np.int64), {})
        for name in sorted(used)
    ]
    planned += _distance(pipeline)
    planned += _photographs(pipeline)
    planned += [
        _coordinate(name, (), value, attributes)
        for name, (value, attributes) in fixed_values(pipeline).items() if name not in VARIABLES
    ]
    planned += [_variable(variable, pipeline, scene_extent) for variable in variables]
    planned = [dataclasses.replace(each, attributes=with_description(each.path, each.attributes))
               for each in planned]
    lengths = tuple(len(axis) for axis in pipeline.experiment.scene_axes)
    planned.append(
        PlannedArray(RECEIPTS, (len(Blocks(lengths, extents)),), (1,), "string", ("block",))
    )
    return planned


def _variable(
    variable: Variable, pipeline: Pipeline, scene_extent: dict[str, int]
) -> PlannedArray:
    names, shape = variable.dimensions(pipeline), variable.shape(pipeline)
    chunks = tuple(
        scene_extent.get(name, length) for name, length in zip(names, shape, strict=True)
    )
    return PlannedArray(
        variable.name, shape, chunks, variable.dtype, names, variable.fill, variable.attributes(),
        coordinate=bool(variable.drawn_as),
    )


def _coordinate(
    path: str, dimensions: tuple[str, ...], values: Any, attributes: Mapping[str, Any]
) -> PlannedArray:
    """Return a coordinate of numbers, truth values or texts along dimensions."""
    array = np.asarray(values)
    if array.dtype.kind in "TU":
        array = array.astype(object)
    return PlannedArray(
        path, array.shape, tuple(min(length, COORDINATE_CHUNK) for length in array.shape),
        "string" if array.dtype == object else array.dtype.str.lstrip("<>|="), dimensions, None,
        dict(attributes), array, coordinate=dimensions != (path,),
    )


def _axis(axis: Axis) -> list[PlannedArray]:
    """Return the coordinates of a dimension, and those of the parameters that go together there."""
    together = [Axis(each.name, {each.name: axis.columns[each.name]}, (each,))
                for each in axis.parameters if axis.zipped]
    return [
        _coordinate(each.name, (axis.name,), each.coordinates(), {
            "long_name": each.meaning,
            **({"zip": " ".join(each.columns)} if each.zipped else {}),
            **({"units": each.unit} if each.unit else {}),
        })
        for each in (axis, *together)
    ]


def _distance(pipeline: Pipeline) -> list[PlannedArray]:
    """Return ``distance_m`` as a coordinate if it follows from ``side_px``."""
    sides = pipeline.values_of("side_px")
    if not sides or sides[0] is None:
        return []
    axes = [
        axis for axis in pipeline.experiment.scene_axes
        if axis.columns.keys() & set(DISTANCE_PARAMETERS)
    ]
    values = {name: pipeline.fixed.get(name) for name in DISTANCE_PARAMETERS}
    for k, axis in enumerate(axes):
        for name in axis.columns.keys() & set(DISTANCE_PARAMETERS):
            column = np.array(axis.columns[name], dtype=np.float64)
            values[name] = column.reshape([-1 if j == k else 1 for j in range(len(axes))])
    distance = np.broadcast_to(
        np.asarray(distance_of_side(values), dtype=np.float64), tuple(len(axis) for axis in axes)
    )
    return [_coordinate(
        "distance_m", tuple(axis.name for axis in axes), distance,
        {"long_name": "depth of the marker's centre along the optical axis", "units": "m"},
    )]


def _photographs(pipeline: Pipeline) -> list[PlannedArray]:
    """Return names and digests of photographs as coordinates along their numbers."""
    trials = pipeline.axis(TRIAL)
    if PHOTOGRAPHS not in pipeline.given or trials is None:
        return []
    # Photographs of a record are in the order of their names.
    files = sorted(
        (name, digest) for name, digest in pipeline.files.items()
        if name.lower().endswith(IMAGE_SUFFIXES)
    )
    if pipeline.is_simulated:  # two cameras' photographs have the same names
        files = files[: len({name.rpartition("/")[2] for name, _ in files})]
        files *= -(-len(trials) // max(len(files), 1))
    if len(files) < len(trials):
        return []
    names, digests = zip(*files[: len(trials)], strict=True)
    return [
        _coordinate("photograph", (TRIAL,), [name.rpartition("/")[2] for name in names],
                    {"long_name": "file of the photograph"}),
        _coordinate("sha256", (TRIAL,), digests,
                    {"long_name": "SHA-256 of the photograph's file"}),
    ]
