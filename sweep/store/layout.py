"""The layout of a store: its arrays, their metadata, and the values of its coordinates."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cache
from typing import Any, cast

import google_crc32c
import numcodecs.zstd
import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.buffer import cpu, default_buffer_prototype
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.dtype import parse_dtype
from zarr.storage import MemoryStore

from sweep.experiment.axes import TRIAL, Axis
from sweep.experiment.draws import DISTANCE_PARAMETERS, distance_of_side
from sweep.experiment.grid import Blocks, scene_axes
from sweep.experiment.parameters import PHOTOGRAPHS
from sweep.experiment.photographs import is_simulated
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import (
    LABELS,
    VARIABLES,
    FixedValue,
    Variable,
    fixed_values,
    variables_of,
    with_description,
)
from sweep.model.image_file import IMAGE_SUFFIXES
from sweep.store.files import sync

FORMAT = 6
"""Version of the layout of stores; another one is refused."""

RECEIPTS = "commits/receipt"
"""Array of the blocks' receipts by number, JSON, a chunk each; empty unless committed."""

DECODING_ATTRIBUTES = {
    "_ARRAY_DIMENSIONS", "_Encoding", "_FillValue", "_Unsigned", "add_offset", "bounds",
    "calendar", "cell_measures", "coordinates", "dtype", "formula_terms", "grid_mapping",
    "missing_value", "scale_factor", "valid_max", "valid_min", "valid_range",
}
"""Attributes by which xarray and other readers of CF data change the values that they return."""

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
        Returns its values in [start, stop) along the first dimension; None for an array to which
        blocks or receipts are written later.
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
    values: Callable[[int, int], NDArray[Any]] | None = None
    coordinate: bool = False

    def create(self, group: zarr.Group) -> None:
        """Create the array and write its values."""
        # Also what equals the fill value, such as a tilt of 0: a missing chunk is a deleted one.
        array = self.create_empty(group).with_config({"write_empty_chunks": True})
        for _, part, values in self.pieces():
            array[part] = values

    def create_empty(self, group: zarr.Group) -> zarr.Array[Any]:
        """Create the array without values."""
        options = {} if self.fill is None else {"fill_value": self.fill}
        return group.create_array(
            self.path, shape=self.shape, chunks=self.chunks, dtype=_dtype(self.dtype),
            dimension_names=self.dimensions, compressors=codecs(), attributes=self.attributes,
            overwrite=True, **options,
        )

    def pieces(self) -> Iterator[tuple[str, Any, NDArray[Any]]]:
        """Yield the key of each chunk whose values follow from the pipeline, its index, and them.

        The array is cut along its first dimension alone.
        """
        if self.values is None:
            return
        if not self.shape:
            yield f"{self.path}/c", ..., self.values(0, 0)
            return
        rest = "/0" * (len(self.shape) - 1)
        for number, start in enumerate(range(0, self.shape[0], self.chunks[0])):
            stop = min(start + self.chunks[0], self.shape[0])
            yield f"{self.path}/c/{number}{rest}", slice(start, stop), self.values(start, stop)

    def misfit(self, array: zarr.Array[Any]) -> str:
        """Return how a stored array differs from this one; empty if it does not.

        Of the attributes, only those are compared that change the values which readers return:
        another version of sweep may write others, or word them otherwise.
        """
        metadata = array.metadata
        if metadata.zarr_format != 3:
            return "Zarr format 2, expected 3"
        expected = {
            "shape": self.shape,
            "chunks": self.chunks,
            "dtype": np.dtype(_dtype(self.dtype).to_native_dtype()),
            "dimensions": self.dimensions,
            "codecs": [codec.to_dict() for codec in codecs()],
            "chunk keys": ("default", "/"),
        }
        keys = metadata.chunk_key_encoding.to_dict()
        stored = {
            "shape": array.shape,
            "chunks": array.chunks if not array.shards else ("shards", array.shards),
            "dtype": array.dtype,
            "dimensions": tuple(metadata.dimension_names or ()),
            "codecs": [codec.to_dict() for codec in metadata.codecs[1:]],
            "chunk keys": (
                keys["name"], cast("dict[str, Any]", keys.get("configuration", {})).get("separator")
            ),
        }
        for name, value in expected.items():
            if stored[name] != value:
                return f"{name} {stored[name]}, expected {value}"
        serializer = metadata.codecs[0].to_dict()
        if serializer["name"] != ("vlen-utf8" if self.dtype == "string" else "bytes"):
            return f"serializer {serializer['name']}"
        if "big" in str(serializer.get("configuration")):
            return "serializer big-endian, expected little"
        decoding = dict(array.attrs).keys() & DECODING_ATTRIBUTES
        if foreign := sorted(decoding - self.attributes.keys()):
            return f"attribute {foreign[0]}: not one of a sweep store"
        if array.attrs.get("units") != self.attributes.get("units"):
            return f"units {array.attrs.get('units')}, expected {self.attributes.get('units')}"
        if self.fill is not None and not _equal(metadata.fill_value, self.fill):
            return f"fill value {metadata.fill_value}, expected {self.fill}"
        return ""


@cache
def _dtype(name: str) -> Any:
    """Return Zarr's data type of a name; it looks through all that it knows, each time."""
    return parse_dtype(name, zarr_format=3)


def _equal(a: Any, b: Any) -> bool:
    return bool(a == b or (a != a and b != b))  # noqa: PLR0124  (NaN)


def codecs() -> list[Any]:
    """Return the codecs of every array; a damaged chunk fails its checksum when it is read."""
    return [ZstdCodec(level=ZSTD_LEVEL), Crc32cCodec()]


def checksum_of(content: bytes) -> int:
    """Return the CRC-32C that Zarr wrote at a chunk's end."""
    return int.from_bytes(content[-4:], "little")


def decoded_chunk(content: bytes, dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Return the values of a stored chunk of numbers.

    Raises
    ------
    ValueError, RuntimeError
        If it fails its checksum, or is of another size.
    """
    body = content[:-4]
    if google_crc32c.value(body) != checksum_of(content):
        raise ValueError("checksum")
    values = np.empty(shape, dtype=dtype.newbyteorder("<"))
    # Into memory of the right size, whatever size the content declares.
    if numcodecs.zstd.decompress(body, values.reshape(-1)).nbytes != values.nbytes:
        raise ValueError("size")
    return values


def encoded_chunk(values: NDArray[Any]) -> bytes:
    """Return the content of a chunk of numbers, the same bytes as Zarr writes."""
    little = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
    body = bytes(numcodecs.zstd.compress(little.reshape(-1), ZSTD_LEVEL))
    checksum: int = google_crc32c.value(body)
    return body + checksum.to_bytes(4, "little")


def planned_arrays(pipeline: Pipeline, extents: tuple[int, ...]) -> list[PlannedArray]:
    """Return the arrays of a pipeline's store whose chunks are blocks of ``extents``."""
    variables = variables_of(pipeline)
    scene_extent = dict(zip((axis.name for axis in scene_axes(pipeline)), extents, strict=True))
    planned = [each for axis in pipeline.axes for each in _axis(axis)]
    used = {
        name: length for variable in variables
        for name, length in zip(variable.inner, variable.inner_shape, strict=True)
    }
    planned += [
        _labels(name, LABELS[name], {}) if LABELS[name] else _numbers(name, used[name])
        for name in sorted(used)
    ]
    planned += _distance(pipeline)
    planned += _photographs(pipeline)
    planned += [_fixed(each) for each in fixed_values(pipeline) if each.name not in VARIABLES]
    planned += [_variable(variable, pipeline, scene_extent) for variable in variables]
    planned = [dataclasses.replace(each, attributes=with_description(each.path, each.attributes))
               for each in planned]
    lengths = tuple(len(axis) for axis in scene_axes(pipeline))
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


def _axis(axis: Axis) -> list[PlannedArray]:
    """Return the coordinates of a dimension, and those of the parameters that go together there."""
    attributes = {"zip": " ".join(axis.columns)} if axis.zipped else {}
    return [
        _coordinate(axis, axis.name, attributes),
        *(
            _coordinate(Axis(name, values, plugged=axis.plugged), axis.name, {})
            for name, values in axis.zipped
        ),
    ]


def _coordinate(axis: Axis, dimension: str, attributes: dict[str, Any]) -> PlannedArray:
    """Return the values along an axis as a coordinate over a dimension."""
    attributes = {"long_name": axis.meaning, **attributes}
    if axis.unit:
        attributes["units"] = axis.unit
    if axis.labelled:
        labels = axis.coordinates().tolist()
        return dataclasses.replace(
            _labels(dimension, labels, attributes), path=axis.name,
            coordinate=axis.name != dimension,
        )
    return PlannedArray(
        axis.name, (len(axis),), (min(len(axis), COORDINATE_CHUNK),),
        axis.coordinates(0, 1).dtype.str.lstrip("<>|="), (dimension,), None, attributes,
        axis.coordinates, coordinate=axis.name != dimension,
    )


def _labels(name: str, labels: Any, attributes: dict[str, Any]) -> PlannedArray:
    values = np.array(list(labels), dtype=object)
    return PlannedArray(
        name, values.shape, values.shape, "string", (name,), None, attributes,
        lambda start, stop: values[start:stop],
    )


def _numbers(name: str, length: int) -> PlannedArray:
    """Return the coordinate of a dimension that is counted from 0 on."""
    return PlannedArray(
        name, (length,), (length,), "int64", (name,), None, {},
        lambda start, stop: np.arange(start, stop, dtype=np.int64),
    )


def _distance(pipeline: Pipeline) -> list[PlannedArray]:
    """Return ``distance_m`` as a coordinate if it follows from ``side_px``."""
    sides = pipeline.values_of("side_px")
    if not sides or sides[0] is None:
        return []
    axes = [
        axis for axis in scene_axes(pipeline) if axis.columns.keys() & set(DISTANCE_PARAMETERS)
    ]
    values = {name: pipeline.fixed.get(name) for name in DISTANCE_PARAMETERS}
    for k, axis in enumerate(axes):
        for name in axis.columns.keys() & set(DISTANCE_PARAMETERS):
            column = np.array(axis.columns[name], dtype=np.float64)
            values[name] = column.reshape([-1 if j == k else 1 for j in range(len(axes))])
    distance = np.broadcast_to(
        np.asarray(distance_of_side(values), dtype=np.float64), tuple(len(axis) for axis in axes)
    )
    return [
        PlannedArray(
            "distance_m", distance.shape, distance.shape, "f8",
            tuple(axis.name for axis in axes), None,
            {"long_name": "depth of the marker's centre along the optical axis", "units": "m"},
            lambda start, stop: distance[start:stop] if distance.ndim else distance,
            coordinate=True,
        )
    ]


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
    if is_simulated(pipeline):  # two cameras' photographs have the same names
        files = files[: len({name.rpartition("/")[2] for name, _ in files})]
        files *= -(-len(trials) // max(len(files), 1))
    if len(files) < len(trials):
        return []
    files = files[: len(trials)]
    columns = {
        "photograph": ([name.rpartition("/")[2] for name, _ in files], "file of the photograph"),
        "sha256": ([digest for _, digest in files], "SHA-256 of the photograph's file"),
    }
    return [
        dataclasses.replace(
            _labels(TRIAL, values, {"long_name": meaning}), path=name, coordinate=True,
        )
        for name, (values, meaning) in columns.items()
    ]


def _fixed(fixed: FixedValue) -> PlannedArray:
    """Return the coordinate without dimensions of a parameter that is fixed."""
    text = isinstance(fixed.value, str)
    value = np.array(fixed.value, dtype=object if text else None)
    return PlannedArray(
        fixed.name, (), (), "string" if text else value.dtype.str.lstrip("<>|="), (), None,
        dict(fixed.attributes), lambda start, stop: value,  # noqa: ARG005  (it has no dimension)
        coordinate=True,
    )


def documents(planned: Iterable[PlannedArray]) -> dict[str, cpu.Buffer]:
    """Return the metadata documents of a store with these arrays by key, except the root's."""
    memory = MemoryStore()
    group = zarr.open_group(memory, mode="w", zarr_format=3)
    for array in planned:
        array.create_empty(group)

    async def gather() -> dict[str, cpu.Buffer]:
        contents = {}
        async for key in memory.list_prefix(""):
            content = await memory.get(key, default_buffer_prototype())
            if key.endswith("/zarr.json") and content is not None:
                contents[key] = cpu.Buffer.from_bytes(content.to_bytes())
        return contents

    return sync(gather())
