"""Groups and bins of draws over the chunks of a dataset."""

from __future__ import annotations

import functools
import itertools
import math
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import dask.array as da
import numpy as np
import xarray as xr
from dask._task_spec import Task, TaskRef
from dask.highlevelgraph import HighLevelGraph
from dask.local import get_sync
from dask.optimization import cull
from dask.typing import Key
from dask.utils import ensure_dict
from numpy.typing import NDArray

from sweep.analysis.dataset import DRAWS, axes_of, is_grid_axis, parameter_value, without_fixed
from sweep.analysis.poses import INSIDE
from sweep.errors import ArgumentError, DatasetError
from sweep.model.camera import VIEW_PARAMETERS, intrinsics
from sweep.plan.draws import REPLICATES
from sweep.plan.schema import LABELS
from sweep.typing import Floats, Masks

# --------------------------------------------------------------------------------------------------
# How a dataset's dimensions become the four axes of a block: groups, cells, draws, settings.
#
# Named dimensions are kept, all others are pooled. Of these, ``trial`` counts random draws; the
# other dimensions of camera, marker and pose make cells, a fixed grid; all others that are pooled
# (effects, levels, renderers, settings of detector and estimator, and names that are no
# parameter's) see the same draws (`sweep.plan.draws`), so that their values together count as one
# draw.

MAX_BLOCK = 1 << 18
"""Poses in a block of a dataset that is in memory."""

JOINED_BLOCK = 1 << 17
"""Poses up to which the chunks of a lazy dataset are joined.

Of blocks of 10,000 poses half of the time is Python's, during which other threads wait; a thread
needs 25 MB for one of 131,072.
"""

Arrays = dict[str, NDArray[Any]]
"""Arrays of a block, by name."""

Lengths = Mapping[str, tuple[int, ...]]
"""The lengths of the chunks of each dimension."""


@dataclass(frozen=True)
class Layout:
    """What each dimension is: kept, of cells, of draws, or of settings.

    ``arrays`` gives the dimensions of each array; ``order`` the indices of the trials by replicate,
    if they have such (`sweep.analysis.draws`): then replicates stand in the place of draws.
    """

    arrays: Mapping[str, tuple[str, ...]]
    kept: tuple[str, ...]
    cells: tuple[str, ...]
    draws: tuple[str, ...]
    settings: tuple[str, ...]
    order: NDArray[np.intp] | None = None

    @classmethod
    def of(cls, dataset: xr.Dataset, kept: Sequence[str], *, has_cells: bool = True) -> Layout:
        """Return that of a dataset's arrays; without cells other dimensions are settings."""
        pooled = [str(dim) for dim in dataset.dims if dim not in LABELS and dim not in kept]
        cells = tuple(
            name for name in pooled
            if has_cells and name != DRAWS and is_grid_axis(name, dataset)
        )
        draws = tuple(name for name in pooled if name == DRAWS)
        return cls(
            {str(name): tuple(map(str, array.dims)) for name, array in dataset.items()},
            tuple(kept), cells, draws,
            tuple(name for name in pooled if name not in (*cells, *draws)),
        )

    @property
    def dimensions(self) -> tuple[str, ...]:
        """All dimensions, in the order of a block's axes."""
        return (*self.kept, *self.cells, *self.draws, *self.settings)

    def arrange(self, blocks: Sequence[NDArray[Any]], sizes: Mapping[str, int]) -> Arrays:
        """Return a block's arrays as (groups, cells, draws, settings, ...)."""
        arrays = {}
        parts = (self.kept, self.cells, self.draws, self.settings)
        shape = [math.prod(sizes[name] for name in names) for names in parts]
        for (name, dims), block in zip(self.arrays.items(), blocks, strict=True):
            inner = [dim for dim in dims if dim not in self.dimensions]
            present = [dim for dim in self.dimensions if dim in dims]
            array = block.transpose([dims.index(dim) for dim in (*present, *inner)])
            rest = array.shape[len(present):]
            array = array.reshape(
                (*(sizes[dim] if dim in dims else 1 for dim in self.dimensions), *rest))
            array = np.broadcast_to(array, (*(sizes[dim] for dim in self.dimensions), *rest))
            array = array.reshape((*shape, *rest))
            arrays[name] = array if self.order is None else _by_replicate(array, self.order)
        return arrays

    def rechunk(self, dataset: xr.Dataset, *, lazy: bool) -> xr.Dataset:
        """Return the dataset in chunks; settings and inner dimensions are whole in each.

        So are draws that have replicates.

        Those of a lazy dataset are joined up to `JOINED_BLOCK` poses, but not along kept
        dimensions; one in memory is cut into blocks of `MAX_BLOCK` poses.
        """
        together = () if self.order is None else self.draws
        if lazy:
            whole = {name: -1 for name in dataset.dims
                     if name in LABELS or name in self.settings or name in together}
            return self._joined(dataset.chunk().unify_chunks().chunk(whole))
        lengths: dict[str, int] = {}
        size = math.prod(dataset.sizes[name] for name in self.dimensions if name in dataset.sizes)
        for name in (*self.cells, *self.draws, *self.kept):
            if name in dataset.sizes and name not in together and size > MAX_BLOCK:
                length = dataset.sizes[name]
                lengths[name] = max(1, length * MAX_BLOCK // size)
                size = size // length * lengths[name]
        return dataset.chunk({str(name): lengths.get(str(name), -1) for name in dataset.dims})


    def _joined(self, dataset: xr.Dataset) -> xr.Dataset:
        """Return the dataset with neighbouring chunks of draws and of cells joined."""
        chunks = {name: tuple(dataset.chunks[name])
                  for name in self.dimensions if name in dataset.sizes}
        size = math.prod(map(max, chunks.values()))
        joined = {}
        for name in (*self.draws, *self.cells):
            count = JOINED_BLOCK // size
            if name in chunks and count > 1:
                lengths = chunks[name]
                joined[name] = tuple(
                    sum(lengths[k : k + count]) for k in range(0, len(lengths), count))
                size = size // max(lengths) * max(joined[name])
        return dataset.chunk(joined)


def _by_replicate(array: NDArray[Any], order: NDArray[np.intp]) -> NDArray[Any]:
    """Return (groups, cells, trials, settings, ...) as (groups, cells, replicates, rest, ...)."""
    groups, cells, trials, settings = array.shape[:4]
    rest = trials // REPLICATES * settings
    return array[:, :, order].reshape((groups, cells, REPLICATES, rest, *array.shape[4:]))


def block_numbers(names: Sequence[str], lengths: Lengths) -> Iterator[dict[str, int]]:
    """Yield the number of the chunk along each of some dimensions, for every block of them."""
    for numbers in itertools.product(*(range(len(lengths[name])) for name in names)):
        yield dict(zip(names, numbers, strict=True))


# --------------------------------------------------------------------------------------------------
# Tasks of Dask that pass statistics over all blocks of a lazy dataset, once or twice.
#
# No state grows with the dataset. A second pass, if one is needed, reads the chunks again: they
# are computed within its tasks, for as tasks of their own a scheduler would keep those of the
# first pass in memory for the second.

# Dask's documentation calls these `dask.Task` and `dask.TaskRef`, but no version has them there.


FAN_IN = 16
"""States that are merged at once."""

ReadBlock = Callable[[], list[NDArray[Any]]]
"""Computes the arrays of a block."""

Chunks = tuple[tuple[int, ...], ...]
"""The lengths of an array's chunks, along each dimension."""


class TaskLayer:
    """Tasks under one name, which may depend on each other."""

    def __init__(self, name: str) -> None:
        self.name = f"{name}-{uuid.uuid4().hex}"
        self.tasks: dict[Key, Any] = {}

    def add(
        self, function: Callable[..., Any], *dependencies: Key,
        index: tuple[int, ...] | None = None,
    ) -> Key:
        """Add a task that calls a function with the results of others; return its key."""
        key: Key = (self.name, *((len(self.tasks),) if index is None else index))
        self.tasks[key] = Task(key, function, *map(TaskRef, dependencies))
        return key

    def merge(self, function: Callable[..., Any], keys: Sequence[Key]) -> Key:
        """Add tasks that merge results, a few at a time; return the key of the last."""
        while len(keys) > 1:
            keys = [self.add(function, *keys[k : k + FAN_IN])
                    for k in range(0, len(keys), FAN_IN)]
        return keys[0]


class ChunkReader:
    """How the chunks of some arrays are computed within a task, those of a block together."""

    def __init__(self, arrays: Sequence[da.Array]) -> None:
        self._names = [array.name for array in arrays]
        self._graph = {key: task for array in arrays
                       for key, task in ensure_dict(array.__dask_graph__()).items()}

    def block(self, indices: Iterable[tuple[int, ...]]) -> ReadBlock:
        """Return what computes a chunk of each array."""
        keys = [(name, *index) for name, index in zip(self._names, indices, strict=True)]
        needed, _ = cull(self._graph, keys)
        return functools.partial(_compute_chunks, needed, keys)


def _compute_chunks(graph: Mapping[Any, Any], keys: list[Any]) -> list[NDArray[Any]]:
    # No callbacks: a user's progress bar is that of the whole.
    return [np.asarray(chunk) for chunk in get_sync(graph, keys, callbacks=())]


def add_pass(
    layer: TaskLayer, reader: ChunkReader, layout: Layout, lengths: Lengths,
    read_state: Callable[..., Any], fold: Callable[..., Any], known: Sequence[Key] = (),
) -> list[list[Key]]:
    """Add tasks that read every block; return the keys of folded states.

    Parameters
    ----------
    read_state
        Called with the block's sizes, its `ReadBlock`, and the result of a key of ``known``.
    fold
        Called with the results of ``read_state`` for all draws of the same cells.
    known
        A key for each block of the kept dimensions, or none.

    Returns
    -------
    list of lists of keys
        For each block of the kept dimensions, those of the blocks of cells.
    """
    folded = []
    for number, kept in enumerate(block_numbers(layout.kept, lengths)):
        states = []
        for cells in block_numbers(layout.cells, lengths):
            parts = []
            for draws in block_numbers(layout.draws, lengths):
                at = kept | cells | draws
                read = reader.block(
                    tuple(at.get(dim, 0) for dim in dims) for dims in layout.arrays.values())
                sizes = {name: chunks[at.get(name, 0)] for name, chunks in lengths.items()}
                parts.append(layer.add(
                    functools.partial(read_state, sizes, read), *known[number : number + 1]))
            states.append(layer.add(fold, *parts))
        folded.append(states)
    return folded


def array_of_blocks(
    layer: TaskLayer, tables: Sequence[Key], pick: Callable[..., NDArray[Any]], name: str,
    chunks: Chunks, dtype: str,
) -> da.Array:
    """Return the array whose chunks are ``pick(shape, table)`` of the tables' results."""
    picked = TaskLayer(name)
    for table, index in zip(tables, np.ndindex(*map(len, chunks)), strict=True):
        shape = tuple(sizes[k] for sizes, k in zip(chunks, index, strict=True))
        picked.add(functools.partial(pick, shape), table, index=index)
    graph = HighLevelGraph({layer.name: layer.tasks, picked.name: picked.tasks},
                           {layer.name: set(), picked.name: {layer.name}})
    return da.Array(graph, picked.name, chunks, dtype=dtype)


# --------------------------------------------------------------------------------------------------
# Bins of a variable of the scene, as a dimension of a table.

Bins = Mapping[str, Sequence[float]]
"""Edges of bins, by the name of the variable or coordinate that is binned."""

PREFIX = "bin "
"""What stands before the name of an array that is binned, among a block's arrays."""


@dataclass(frozen=True)
class Binning:
    """The edges (n + 1,) of the bins [low, high) of each name."""

    edges: Mapping[str, Floats]

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of bins of each name."""
        return tuple(len(edges) - 1 for edges in self.edges.values())

    @property
    def count(self) -> int:
        """Number of combinations of bins."""
        return math.prod(self.shape)

    def split(self, arrays: Arrays) -> Iterator[tuple[Arrays, Masks | None]]:
        """Yield the arrays of each combination, and a mask of the cells that these have.

        Of cells that have no pose in the combination nothing is given; None stands for all cells.
        """
        if not self.edges:
            yield arrays, None
            return
        # Of values at the last edge and beyond, and of NaN, it is the number of bins.
        numbers = [np.searchsorted(edges, arrays[f"{PREFIX}{name}"], side="right") - 1
                   for name, edges in self.edges.items()]
        for index in np.ndindex(*self.shape):
            inside = np.logical_and.reduce([a == b for a, b in zip(numbers, index, strict=True)])
            cells = inside.any(axis=(0, 2, 3))
            yield ({name: array[:, cells]
                    for name, array in (arrays | {INSIDE: inside}).items()}, cells)

    def coordinates(self, results: xr.Dataset) -> dict[str, Any]:
        """Return the coordinates of the bins: middles, lower and upper edges."""
        coordinates: dict[str, Any] = {}
        for name, edges in self.edges.items():
            attributes = dict(results[name].attrs)
            # Of a bin without an end the middle is its other end.
            finite = np.nan_to_num(edges, neginf=edges[1], posinf=edges[-2])
            for label, values in ((name, (finite[:-1] + finite[1:]) / 2),
                                  (f"{name}_low", edges[:-1]), (f"{name}_high", edges[1:])):
                coordinates[label] = (name, values, attributes)
        return coordinates


def read_bins(
    results: xr.Dataset, kept: Sequence[str], bins: Bins
) -> tuple[Binning, dict[str, xr.DataArray]]:
    """Return the binning, and the arrays that are binned by their names in a block.

    Raises
    ------
    ArgumentError
        For bins of a variable that does not exist or is not one number for each scene, and for
        edges that do not increase.
    """
    if not isinstance(bins, Mapping):
        raise ArgumentError("bins", bins, "expected names with edges, such as "
                            '{"marker_area_px": [0, 100, 1000]}')
    edges, arrays = {}, {}
    for name, given in bins.items():
        if name not in results.variables or name in kept:
            possible = [str(other) for other, variable in results.variables.items()
                        if variable.dtype.kind == "f" and other not in kept]
            raise ArgumentError("bins", name, f"no such variable; there are {', '.join(possible)}")
        array = results[name].reset_coords(drop=True)
        if name in results.dims:  # an index, which has no chunks
            array = xr.DataArray(array.to_numpy(), dims=name)
        scalar = name in results.coords and not array.dims
        if array.dtype.kind not in "fiu" or scalar or any(dim in LABELS for dim in array.dims):
            raise ArgumentError("bins", name, "expected a variable of one number for each scene")
        edges[name], arrays[f"{PREFIX}{name}"] = _increasing(name, given), array
    return Binning(edges), arrays


def _increasing(name: str, given: Any) -> NDArray[np.float64]:
    """Return the edges, if they are."""
    try:
        edges = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        edges = np.empty(0)
    if edges.ndim != 1 or len(edges) < 2 or not (edges[1:] > edges[:-1]).all():
        raise ArgumentError("bins", name, "expected at least two increasing edges")
    return edges


# --------------------------------------------------------------------------------------------------
# The side of the black square in pixels, over the axes that change it.

SIZE_PARAMETERS = ("side_px", "distance_m", "size_m", *VIEW_PARAMETERS)
"""What the side depends on: itself, or distance, size and camera."""


def image_sides(results: xr.Dataset, bins: Bins) -> xr.DataArray:
    """Return the sides as if the square were parallel to the image plane: fx · size / distance.

    Parameters
    ----------
    results
        The dataset of a run.
    bins
        Edges of drawn parameters, whose bins' middles take the place of the draws.

    Returns
    -------
    xr.DataArray
        Sides in pixels over the dimensions that change them, bins' names among these.

    Raises
    ------
    DatasetError
        If they cannot be computed, or are drawn and not in bins.
    """
    middles = {name: (name, (np.asarray(edges)[:-1] + np.asarray(edges)[1:]) / 2.0)
               for name, edges in bins.items()}
    given = {name: array for name, array in results.coords.items() if name not in bins}
    shell = xr.Dataset(coords=given, attrs=results.attrs).assign_coords(middles)
    for name in SIZE_PARAMETERS:
        derived = name == "distance_m" and "side_px" in shell.coords
        if name in shell.coords and DRAWS in shell[name].dims and not derived:
            raise DatasetError(f"{name}: is drawn, so that the side is no number of the grid; "
                               f'give bins, such as bins={{"{name}": [...edges...]}}')
    if "side_px" in shell.coords:
        return _checked(shell["side_px"])
    return sides_of(functools.partial(parameter_value, shell))


def sides_of(value: Callable[[str], Any]) -> xr.DataArray:
    """Return the sides in pixels from distance, size and camera.

    Parameters
    ----------
    value
        Returns the value of a parameter, or its values over the dimensions that it has.

    Raises
    ------
    DatasetError
        If they cannot be computed.
    """
    distance = value("distance_m")
    if distance is None:
        raise DatasetError(
            "distance_m: is no number of this store, whose poses are given in the world; a "
            "limit needs an axis distance_m or side_px (per= takes any axis for rates)")
    fx = xr.DataArray(intrinsics(*map(value, VIEW_PARAMETERS))[0])
    return _checked(fx * value("size_m") / distance)


def _checked(sides: xr.DataArray) -> xr.DataArray:
    """Return sides without coordinates of fixed parameters, if all can be."""
    sides = sides.astype(np.float64)
    if not (np.isfinite(sides) & (sides > 0)).all():
        raise DatasetError("sides must be finite and above 0 px: see the coordinates of the size, "
                           "the distance and the camera")
    return without_fixed(sides)


def require_size_axes(results: xr.Dataset, sides: xr.DataArray) -> None:
    """Raise unless the sides differ along an axis."""
    if not sides.dims:
        raise DatasetError(
            "side_px or distance_m: no axis changes the size in the image; there are "
            f"{', '.join(axes_of(results)) or 'none'}")


def parameters_along(results: xr.Dataset, axis: str, bins: Bins) -> list[str]:
    """Return the names of the numbers along an axis that the sides depend on."""
    if axis in bins:
        return [axis]
    return [name for name in SIZE_PARAMETERS if name in results.coords
            and results[name].dims == (axis,) and results[name].dtype.kind in "fiu"]
