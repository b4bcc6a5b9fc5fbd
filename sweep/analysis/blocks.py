"""How a dataset that may be larger than memory is looked at: block by block, twice.

Of a dataset's dimensions those that are named are kept, all others are pooled. Of these, ``trial``
counts random draws; the other dimensions of camera, marker and pose make cells, a fixed grid; all
others that are pooled (effects, levels, renderers, settings of detector and estimator, and what
has a name that is no parameter's) see the same draws (`sweep.plan.draws`), so that their values
together count as one draw.

The blocks are the chunks of a lazy dataset, and the result is then lazy, too. What is kept of a
block does not grow with the dataset; the second look, where one is needed, reads the chunks again.
"""

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
from dask.highlevelgraph import HighLevelGraph
from dask.local import get_sync
from dask.optimization import cull
from dask.utils import ensure_dict
from numpy.typing import NDArray

from sweep.analysis.pose_view import INSIDE, Poses
from sweep.analysis.states import State, combined, every_nth, folded, interleaved, scattered
from sweep.analysis.statistics import Found, Output, SinglePass, Statistic
from sweep.errors import StoreError
from sweep.plan.parameters import GEOMETRY_SECTIONS, PARAMETERS
from sweep.plan.schema import LABELS, SCHEMA

NEEDED = ("detection", "estimate", "flipped", "rotation_error_rad", "translation_error_m",
          "true_tvec_m")
"""Variables without which a dataset is none of results."""

Arrays = dict[str, NDArray[Any]]
Masks = NDArray[np.bool_]
Read = Callable[[], list[NDArray[Any]]]
"""What computes the arrays of a block."""
Bins = Mapping[str, Sequence[float]]

MAX_BLOCK = 1 << 18
"""Poses in a block of a dataset that is in memory."""
FAN_IN = 16
"""States that are merged at once."""


def axes_of(results: xr.Dataset) -> list[str]:
    """Return the axes of the template's variables, in their order."""
    dims = [str(dim) for v in SCHEMA if v.name in results for dim in results[v.name].dims]
    return [dim for dim in dict.fromkeys(dims) if dim not in LABELS]


def listed(names: Sequence[str]) -> tuple[str, ...]:
    """Return names as they are given: several, or one by itself.

    Raises
    ------
    StoreError
        For what is no list of names.
    """
    if isinstance(names, str):
        return (names,)
    if not isinstance(names, Iterable) or not all(isinstance(name, str) for name in names):
        raise StoreError(f"per = {names}: expected names of dimensions")
    return tuple(names)


def fingerprint_of(results: xr.Dataset) -> Mapping[str, Any]:
    """Return the fingerprint in a dataset's attributes; empty where they do not have it."""
    about = results.attrs.get("sweep")
    found = about.get("fingerprint") if isinstance(about, Mapping) else None
    return found if isinstance(found, Mapping) else {}


def kept_of(results: xr.Dataset, names: Sequence[str]) -> tuple[str, ...]:
    """Return the dimensions to keep, each once, if all are there.

    Raises
    ------
    StoreError
        For those that are not, with those that are; and where there are no results at all.
    """
    names = listed(names)
    axes = axes_of(results)
    missing = [name for name in dict.fromkeys(names) if name not in axes]
    if missing:
        there = ", ".join(axes) or "none"
        raise StoreError(f"{', '.join(missing)}: no such dimension; there are {there}")
    lacking = [name for name in NEEDED if name not in results]
    if lacking:
        there = ", ".join(map(str, results.data_vars)) or "none"
        raise StoreError(f"no variable {', '.join(lacking)}; there are {there}")
    empty = [name for name in axes if results.sizes[name] == 0]
    if empty:
        raise StoreError(f"there are no poses: {', '.join(empty)} has no values")
    return tuple(dict.fromkeys(names))


@dataclass(frozen=True)
class Layout:
    """What each dimension is, and how each array of a block is laid out.

    ``arrays`` gives each array's dimensions; ``bins`` the edges of each array that is binned.
    """

    arrays: Mapping[str, tuple[str, ...]]
    kept: tuple[str, ...]
    cells: tuple[str, ...]
    draws: tuple[str, ...]
    settings: tuple[str, ...]
    bins: Mapping[str, NDArray[np.float64]]
    view: Callable[[Arrays], Any]

    @property
    def bin_count(self) -> int:
        """How many combinations of bins there are."""
        return math.prod(len(edges) - 1 for edges in self.bins.values())

    def arranged(self, blocks: Sequence[NDArray[Any]], sizes: Mapping[str, int]) -> Arrays:
        """Return a block's arrays as (groups, cells, draws, settings, ...)."""
        found = {}
        parts = (self.kept, self.cells, self.draws, self.settings)
        every = tuple(itertools.chain(*parts))
        shape = [math.prod(sizes[name] for name in names) for names in parts]
        for (name, dims), block in zip(self.arrays.items(), blocks, strict=True):
            inner = [dim for dim in dims if dim not in every]
            present = [dim for dim in every if dim in dims]
            array = block.transpose([dims.index(dim) for dim in (*present, *inner)])
            rest = array.shape[len(present):]
            array = array.reshape((*(sizes[d] if d in dims else 1 for d in every), *rest))
            array = np.broadcast_to(array, (*(sizes[dim] for dim in every), *rest))
            found[name] = array.reshape((*shape, *rest))
        return found


def aggregate(
    results: xr.Dataset,
    needed: Mapping[str, xr.DataArray],
    kept: Sequence[str],
    statistics: Sequence[Statistic],
    bins: Bins | None = None,
    view: Callable[[Arrays], Any] = Poses,
) -> xr.Dataset:
    """Return the statistics of the poses of each combination of ``kept`` and of bins.

    ``needed`` are the arrays, by name, of which ``view`` makes the poses that the statistics look
    at; ``bins`` gives the edges (n + 1,) of bins [low, high) of a variable or coordinate of the
    scene. Lazy where any of the arrays is.

    Raises ``StoreError`` for bins of what is not there, or is no number of a scene.
    """
    binned = _binned(results, kept, bins or {})
    lazy = any(array.chunks is not None for array in needed.values())
    dataset = xr.Dataset(
        {name: array.reset_coords(drop=True) for name, array in needed.items()}
        | {f"bin {name}": array for name, (array, _) in binned.items()}
    )
    dims = [str(dim) for dim in dataset.dims if dim not in LABELS]
    pooled = [name for name in dims if name not in kept]
    cells = tuple(name for name in pooled if name in PARAMETERS
                  and PARAMETERS[name].section in GEOMETRY_SECTIONS)
    draws = tuple(name for name in pooled if name == "trial")
    layout = Layout(
        {str(name): tuple(map(str, array.dims)) for name, array in dataset.items()},
        tuple(kept), cells, draws,
        tuple(name for name in pooled if name not in (*cells, *draws)),
        {f"bin {name}": edges for name, (_, edges) in binned.items()}, view,
    )
    chunked = _chunked(dataset, layout, lazy=lazy)
    lengths = {name: tuple(chunked.chunks[name]) if name in chunked.sizes
               else (results.sizes[name],) for name in (*layout.kept, *pooled)}
    layer, tables = _tables(chunked, lengths, layout, statistics)
    outputs = [output for statistic in statistics for output in statistic.outputs()]
    found = _assembled(layer, tables, lengths, layout, outputs)
    coordinates = {name: value for name, value in results.coords.items()
                   if set(value.dims) <= set(kept)}
    table = xr.Dataset(found, coordinates).assign_coords(_bin_coordinates(results, binned))
    return table if lazy else table.compute(scheduler="synchronous")


def _binned(
    results: xr.Dataset, kept: Sequence[str], bins: Bins
) -> dict[str, tuple[xr.DataArray, NDArray[np.float64]]]:
    """Return what is binned, with its edges."""
    if not isinstance(bins, Mapping):
        raise StoreError(f"bins = {bins}: expected names with edges, such as "
                         '{"marker_area_px": [0, 100, 1000]}')
    found = {}
    for name, given in bins.items():
        try:
            edges = np.asarray(given, dtype=np.float64)
        except (TypeError, ValueError):
            raise StoreError(f"bins of {name}: expected at least two increasing edges") from None
        if name not in results.variables or name in kept:
            there = [str(n) for n, v in results.variables.items()
                     if v.dtype.kind == "f" and n not in kept]
            raise StoreError(f"bins of {name}: no such variable; there are {', '.join(there)}")
        array = results[name].reset_coords(drop=True)
        if name in results.dims:  # an index, which has no chunks
            array = xr.DataArray(array.to_numpy(), dims=name)
        scalar = name in results.coords and not array.dims
        if array.dtype.kind not in "fiu" or scalar or any(dim in LABELS for dim in array.dims):
            raise StoreError(f"bins of {name}: expected one number for each scene")
        if edges.ndim != 1 or len(edges) < 2 or not (edges[1:] > edges[:-1]).all():
            raise StoreError(f"bins of {name}: expected at least two increasing edges")
        found[name] = array, edges
    return found


def _bin_coordinates(results: xr.Dataset, binned: Mapping[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, (_, edges) in binned.items():
        attributes = dict(results[name].attrs)
        # Of a bin without an end the middle is its other end.
        finite = np.nan_to_num(edges, neginf=edges[1], posinf=edges[-2])
        for label, values in ((name, (finite[:-1] + finite[1:]) / 2),
                              (f"{name}_low", edges[:-1]), (f"{name}_high", edges[1:])):
            found[label] = (name, values, attributes)
    return found


def _chunked(dataset: xr.Dataset, layout: Layout, *, lazy: bool) -> xr.Dataset:
    """Return the dataset in chunks; settings and inner dimensions are whole in each."""
    if not lazy:
        lengths, size = {}, math.prod(dataset.sizes[name] for name in _axes(layout, dataset))
        for name in (*layout.cells, *layout.draws, *layout.kept):
            if name in dataset.sizes and size > MAX_BLOCK:
                length = dataset.sizes[name]
                lengths[name] = max(1, length * MAX_BLOCK // size)
                size = size // length * lengths[name]
        return dataset.chunk({str(name): lengths.get(str(name), -1) for name in dataset.dims})
    whole = {name: -1 for name in dataset.dims if name in LABELS or name in layout.settings}
    return dataset.chunk().unify_chunks().chunk(whole)


def _axes(layout: Layout, dataset: xr.Dataset) -> list[str]:
    return [name for name in (*layout.kept, *layout.cells, *layout.draws, *layout.settings)
            if name in dataset.sizes]


Lengths = Mapping[str, tuple[int, ...]]
"""The lengths of the chunks of each dimension."""
Key = tuple[str, int]
"""Name of a task: that of its layer, and a number."""


class Layer:
    """Tasks of one name, which may refer to each other."""

    def __init__(self, name: str) -> None:
        self.name = f"{name}-{uuid.uuid4().hex}"
        self.tasks: dict[Any, Any] = {}

    def add(self, function: Callable[..., Any], *arguments: Any) -> Key:
        """Add a task and return its key; arguments are keys, or lists of keys."""
        key = (self.name, len(self.tasks))
        self.tasks[key] = (function, *arguments)
        return key

    def merged(self, states: list[Key]) -> Key:
        """Add tasks that merge states, a few at a time."""
        while len(states) > 1:
            states = [self.add(_combined, states[k : k + FAN_IN])
                      for k in range(0, len(states), FAN_IN)]
        return states[0]


class Reading:
    """How the chunks of some arrays are computed, those of a block together, within a task.

    Were they tasks of their own, a scheduler would keep those of the first look for the second.
    """

    def __init__(self, arrays: Sequence[da.Array]) -> None:
        self._names = [array.name for array in arrays]
        self._graph = {key: task for array in arrays
                       for key, task in ensure_dict(array.__dask_graph__()).items()}

    def of(self, indices: Iterable[tuple[int, ...]]) -> Read:
        """Return what computes a chunk of each array."""
        keys = [(name, *index) for name, index in zip(self._names, indices, strict=True)]
        needed, _ = cull(self._graph, keys)
        return functools.partial(_computed, needed, keys)


def _computed(graph: Mapping[Any, Any], keys: list[Any]) -> list[NDArray[Any]]:
    # No callbacks: a user's progress bar is that of the whole.
    return [np.asarray(chunk) for chunk in get_sync(graph, keys, callbacks=())]


def _tables(
    dataset: xr.Dataset, lengths: Lengths, layout: Layout, statistics: Sequence[Statistic]
) -> tuple[Layer, list[Key]]:
    """Return the tasks, and the keys of what is found in each block of the kept dimensions."""
    layer = Layer("looks")
    reading = Reading([da.asarray(array.data) for array in dataset.data_vars.values()])
    looks = _looks(layer, reading, layout, lengths, functools.partial(_first, layout, statistics))
    known = [layer.add(functools.partial(_between, statistics), layer.merged(states))
             for states in looks]
    finish = functools.partial(_finish, statistics)
    if all(isinstance(statistic, SinglePass) for statistic in statistics):
        return layer, [layer.add(finish, of_first) for of_first in known]
    looks = _looks(layer, reading, layout, lengths, functools.partial(_second, layout, statistics),
                   known)
    tables = [layer.add(finish, of_first, layer.merged(states))
              for of_first, states in zip(known, looks, strict=True)]
    return layer, tables


def _looks(
    layer: Layer, reading: Reading, layout: Layout, lengths: Lengths,
    look: Callable[..., Any], known: Sequence[Key] = (),
) -> list[list[Key]]:
    """Add looks at all blocks; return the states, folded, by block of the kept dimensions."""
    found = []

    def numbers(names: Sequence[str]) -> list[dict[str, int]]:
        every = itertools.product(*(range(len(lengths[name])) for name in names))
        return [dict(zip(names, each, strict=True)) for each in every]

    for number, kept in enumerate(numbers(layout.kept)):
        states = []
        for cell in numbers(layout.cells):
            parts = []
            for draw in numbers(layout.draws):
                at = kept | cell | draw
                read = reading.of(
                    tuple(at.get(dim, 0) for dim in dims) for dims in layout.arrays.values())
                sizes = {name: chunks[at.get(name, 0)] for name, chunks in lengths.items()}
                parts.append(layer.add(
                    functools.partial(look, sizes, read), *known[number : number + 1]))
            states.append(layer.add(_folded, parts))
        found.append(states)
    return found


SceneInspection = list[tuple[State, State]]
"""The states of a block and of its cells, for each statistic."""


def _first(
    layout: Layout, statistics: Sequence[Statistic], sizes: Mapping[str, int],
    read: Read,
) -> SceneInspection:
    arrays = layout.arranged(read(), sizes)
    return _joined([
        _in_their_cells([s.first(poses) for s in statistics], cells)
        for poses, cells in _in_bins(layout, arrays)
    ])


def _second(
    layout: Layout, statistics: Sequence[Statistic], sizes: Mapping[str, int],
    read: Read, known: list[State],
) -> SceneInspection:
    arrays = layout.arranged(read(), sizes)
    return _joined([
        _in_their_cells(
            [s.second(poses, every_nth(of_first, layout.bin_count, number))
             for s, of_first in zip(statistics, known, strict=True)],
            cells,
        )
        for number, (poses, cells) in enumerate(_in_bins(layout, arrays))
    ])


def _in_bins(layout: Layout, arrays: Arrays) -> Iterator[tuple[Any, Masks | None]]:
    """Yield the poses of each combination of bins, and the cells that have any (None: all)."""
    if not layout.bins:
        yield layout.view(arrays), None
        return
    # Of values at the last edge and beyond, and of NaN, it is the number of bins.
    within = [np.searchsorted(edges, arrays[name], side="right") - 1
              for name, edges in layout.bins.items()]
    counts = [len(edges) - 1 for edges in layout.bins.values()]
    for index in np.ndindex(*counts):
        inside = np.logical_and.reduce([a == b for a, b in zip(within, index, strict=True)])
        cells = inside.any(axis=(0, 2, 3))
        part = {name: array[:, cells] for name, array in (arrays | {INSIDE: inside}).items()}
        yield layout.view(part), cells


def _in_their_cells(look: SceneInspection, cells: Masks | None) -> SceneInspection:
    """Return the states of some cells as those of all."""
    if cells is None:
        return look
    return [(pooled, scattered(state, cells)) for pooled, state in look]


def _joined(looks: list[SceneInspection]) -> SceneInspection:
    """Return what was seen in the bins as one."""
    return [
        (interleaved([pooled for pooled, _ in each]), interleaved([cells for _, cells in each]))
        for each in zip(*looks, strict=True)
    ]


def _folded(parts: list[SceneInspection]) -> list[State]:
    """Return the states of some cells, of all their draws."""
    return [
        combined([pooled for pooled, _ in each]) | folded(combined([cells for _, cells in each]))
        for each in zip(*parts, strict=True)
    ]


def _combined(states: list[list[State]]) -> list[State]:
    return [combined(each) for each in zip(*states, strict=True)]


def _between(statistics: Sequence[Statistic], states: list[State]) -> list[State]:
    return [s.between(state) for s, state in zip(statistics, states, strict=True)]


def _finish(
    statistics: Sequence[Statistic], known: list[State], second: list[State] | None = None
) -> Found:
    found: Found = {}
    second = second or [{} for _ in known]
    for statistic, of_first, of_second in zip(statistics, known, second, strict=True):
        found |= statistic.finish(of_first, of_second)
    return found


def _assembled(
    looks: Layer, tables: list[Key], lengths: Lengths, layout: Layout,
    outputs: Sequence[Output],
) -> dict[str, tuple[tuple[str, ...], da.Array, Mapping[str, Any]]]:
    """Return the variables, put together from the blocks of the kept dimensions."""
    bins = tuple(len(edges) - 1 for edges in layout.bins.values())
    dims = (*layout.kept, *(name.removeprefix("bin ") for name in layout.bins))
    chunks = (*(lengths[name] for name in layout.kept), *((count,) for count in bins))
    found: dict[str, tuple[tuple[str, ...], da.Array, Mapping[str, Any]]] = {}
    for output in outputs:
        layer = Layer(output.name)
        for table, index in zip(tables, np.ndindex(*map(len, chunks)), strict=True):
            shape = tuple(sizes[k] for sizes, k in zip(chunks, index, strict=True))
            layer.tasks[layer.name, *index] = (functools.partial(_variable, output, shape), table)
        graph = HighLevelGraph({looks.name: looks.tasks, layer.name: layer.tasks},
                               {looks.name: set(), layer.name: {looks.name}})
        array = da.Array(graph, layer.name, chunks, dtype=output.dtype)
        found[output.name] = dims, array, output.attributes()
    return found


def _variable(output: Output, shape: tuple[int, ...], table: Found) -> NDArray[Any]:
    return table[output.name].reshape(shape).astype(output.dtype)
