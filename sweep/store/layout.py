"""The layout of a store: its arrays, their metadata, and the values of its coordinates."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import google_crc32c
import numcodecs.zstd
import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.core.metadata import ArrayV3Metadata
from zarr.dtype import parse_dtype
from zarr.storage import MemoryStore

from sweep.experiment.axes import TRIAL, Axis
from sweep.experiment.draws import DISTANCE_PARAMETERS, distance_of_side
from sweep.experiment.grid import Blocks
from sweep.experiment.parameters import PHOTOGRAPHS
from sweep.experiment.photographs import is_simulated
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import (
    LABELS,
    VARIABLES,
    FixedValue,
    Variable,
    fixed_values,
    with_description,
)
from sweep.model.image_file import IMAGE_SUFFIXES
from sweep.store.files import read_files, sync

FORMAT = 7
"""Version of the layout of stores; another one is refused."""

RECEIPTS = "commits/receipt"
"""Array of the blocks' receipts by number, JSON, a chunk each; empty unless committed."""

READING_ATTRIBUTES = {
    "_ARRAY_DIMENSIONS", "_Encoding", "_FillValue", "_Unsigned", "add_offset", "bounds",
    "calendar", "cell_measures", "coordinates", "dtype", "formula_terms", "grid_mapping",
    "missing_value", "scale_factor", "units", "valid_max", "valid_min", "valid_range",
}
"""Attributes by which xarray, other readers of CF data, and people change the values they read."""

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
        _labels(name, LABELS[name], {}) if LABELS[name] else _numbers(name, used[name])
        for name in sorted(used)
    ]
    planned += _distance(pipeline)
    planned += _photographs(pipeline)
    planned += [_fixed(each) for each in fixed_values(pipeline) if each.name not in VARIABLES]
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


def documents(planned: Iterable[PlannedArray]) -> dict[str, dict[str, Any]]:
    """Return the metadata documents of a store with these arrays by key, except the root's."""
    memory = MemoryStore()
    group = zarr.open_group(memory, mode="w", zarr_format=3)
    for array in planned:
        array.create_empty(group)

    async def keys() -> list[str]:
        return [key async for key in memory.list_prefix("") if key.endswith("/zarr.json")]

    found = sync(keys())
    return {key: json.loads(content or b"")
            for key, content in zip(found, read_files(memory, found), strict=True)}


def misfit(document: Mapping[str, Any], expected: Mapping[str, Any]) -> str:
    """Return how an array's metadata document differs from the expected one; empty if it fits.

    Of the attributes, only those are compared that change the values which readers return:
    another version of sweep may word the others differently.
    """
    try:
        stored, wanted = (_schema(each) for each in (document, expected))
    except Exception as error:  # a damaged or forged document may raise anything
        return f"unreadable: {' '.join(str(error).split())[:200]}"
    return next((f"{name} {stored.get(name)}, expected {wanted.get(name)}"
                 for name in {**wanted, **stored} if stored.get(name) != wanted.get(name)), "")


def _schema(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return what decides how values are read, as this version of Zarr writes it."""
    schema = ArrayV3Metadata.from_dict(dict(document)).to_dict()
    attributes = dict(document.get("attributes", {}))
    return {**schema, "attributes": {
        name: attributes[name] for name in sorted(attributes.keys() & READING_ATTRIBUTES)}}
