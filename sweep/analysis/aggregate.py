"""Statistics of all poses of a dataset, by group: the one way to a table.

Columns are held in memory, those of a lazy dataset from the call on.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.analysis.binning import Bins, read_bins
from sweep.analysis.dataset import (
    DRAWS,
    is_fixed,
    is_grid_axis,
    is_sampling_stopped,
    of_photographs,
)
from sweep.analysis.draws import Design, Unit, common_trials, replicate_order
from sweep.analysis.poses import COMMON
from sweep.analysis.statistic import MAX_BLOCK, Arrays, Blocks, Statistic, Variables, ViewT
from sweep.experiment.draws import REPLICATES
from sweep.experiment.schema import LABELS

MAX_THREADS = 4
"""Blocks that are computed side by side; with more, reading memory is what takes time."""


def aggregate(
    results: xr.Dataset,
    inputs: Mapping[str, xr.DataArray],
    kept: Sequence[str],
    statistics: Sequence[Statistic[ViewT]],
    view: Callable[[Arrays], ViewT],
    bins: Bins | None = None,
    *,
    stopped: bool | None = None,
) -> xr.Dataset:
    """Return the statistics of the poses of each combination of ``kept`` and of bins.

    Parameters
    ----------
    results
        The dataset whose coordinates and variables name what is kept and binned.
    inputs
        The arrays, by name, of which ``view`` makes the poses that the statistics read.
    kept
        The dimensions of the table; all others are pooled.
    statistics
        What to compute.
    view
        Makes the view from a block's arrays, (groups, cells, draws, settings, ...).
    bins
        Edges (n + 1,) of bins [low, high) of a variable or coordinate of the scene.
    stopped
        Whether sampling was stopped (`sweep.analysis.draws`); by default what the
        dataset's attributes say.

    Returns
    -------
    xr.Dataset
        A variable (*kept, *bins) for each output, computed.

    Raises
    ------
    ArgumentError
        For bins that cannot be.
    """
    binning, binned = read_bins(results, kept, bins or {})
    stopped = is_sampling_stopped(results) if stopped is None else stopped
    if stopped and (common := common_trials(results, inputs, kept)) is not None:
        inputs = {**inputs, COMMON: common}
    inputs = {**inputs, **binned}
    layout = Layout.of(results, inputs, kept)
    columns = {name: layout.arranged(array) for name, array in inputs.items()}
    unit = Unit.replicate if layout.order is not None else (
        Unit.photograph if of_photographs(results) else Unit.trial)
    design = Design(unit, math.prod(layout.sizes[name] for name in layout.settings), stopped)
    with ThreadPoolExecutor(min(MAX_THREADS, len(os.sched_getaffinity(0)))) as threads:
        tables = [_table(part, statistics, view, design, threads)
                  for part in binning.split(columns)]
    shape = (*(layout.sizes[name] for name in layout.kept), *binning.shape)
    dims = (*layout.kept, *binning.edges)
    variables = {
        output.name: (
            dims, np.stack([table[output.name] for table in tables], axis=-1).reshape(shape).astype(
                output.dtype), output.attributes())
        for statistic in statistics for output in statistic.outputs()}
    coordinates = {name: value.variable for name, value in results.coords.items()
                   if set(value.dims) <= set(kept) and not is_fixed(value)}
    return xr.Dataset(variables, coordinates).assign_coords(binning.coordinates(results))


def _table(
    columns: Arrays, statistics: Sequence[Statistic[ViewT]], view: Callable[[Arrays], ViewT],
    design: Design, threads: Executor,
) -> Variables:
    """Return the variables (groups,) of columns, some groups at a time if they are small."""
    groups, *rest = next(iter(columns.values())).shape[:4]
    step = max(MAX_BLOCK // max(math.prod(rest), 1), 1)

    def of_groups(start: int, threads: Executor | None = None) -> Variables:
        blocks = Blocks(
            {name: array[start : start + step] for name, array in columns.items()}, view, threads)
        return {name: values for statistic in statistics
                for name, values in statistic.variables(blocks, design).items()}

    if groups <= step:
        return of_groups(0, threads)
    parts = list(threads.map(of_groups, range(0, groups, step)))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


# --------------------------------------------------------------------------------------------------
# How a dataset's dimensions become the four axes of a block: groups, cells, draws, settings.
#
# Named dimensions are kept, all others are pooled. Of these, ``trial`` counts random draws; the
# other dimensions of camera, marker and pose make cells, a fixed grid; all others that are pooled
# (effects, levels, renderers, settings of detector and estimator, and names that are no
# parameter's) see the same draws (`sweep.experiment.draws`), so that their values together count
# as one draw.

@dataclass(frozen=True)
class Layout:
    """What each dimension is: kept, of cells, of draws, or of settings.

    ``order`` are the indices of the trials by replicate, if they have such: then replicates stand
    in the place of draws.
    """

    sizes: Mapping[str, int]
    kept: tuple[str, ...]
    cells: tuple[str, ...]
    draws: tuple[str, ...]
    settings: tuple[str, ...]
    order: NDArray[np.intp] | None = None

    @classmethod
    def of(
        cls, results: xr.Dataset, inputs: Mapping[str, xr.DataArray], kept: Sequence[str]
    ) -> Layout:
        """Return the layout of the dimensions of some arrays of a dataset."""
        sizes = {name: results.sizes[name] for name in kept}
        for array in inputs.values():
            sizes |= {str(dim): size for dim, size in array.sizes.items() if dim not in LABELS}
        pooled = [name for name in sizes if name not in kept]
        draws = tuple(name for name in pooled if name == DRAWS)
        cells = tuple(
            name for name in pooled if name != DRAWS and is_grid_axis(name, results))
        return cls(
            sizes, tuple(kept), cells, draws,
            tuple(name for name in pooled if name not in (*cells, *draws)),
            replicate_order(results, draws))

    def arranged(self, array: xr.DataArray) -> NDArray[Any]:
        """Return the values of an array as (groups, cells, draws, settings, ...)."""
        parts = (self.kept, self.cells, self.draws, self.settings)
        dims = [dim for dim in itertools.chain(*parts) if dim in array.dims]
        inner = [dim for dim in array.dims if dim not in dims]
        values = array.variable.transpose(*dims, *inner).to_numpy()
        rest = values.shape[len(dims):]
        # Of dimensions that make an axis together an array has all, or is repeated along some.
        present = [any(name in dims for name in part) for part in parts]
        own = [name for part, some in zip(parts, present, strict=True) if some for name in part]
        values = values.reshape((*(self.sizes[name] if name in dims else 1 for name in own), *rest))
        values = np.broadcast_to(values, (*(self.sizes[name] for name in own), *rest))
        shape = [math.prod(self.sizes[name] for name in part) for part in parts]
        values = values.reshape((
            *(size if some else 1 for size, some in zip(shape, present, strict=True)), *rest))
        values = np.broadcast_to(values, (*shape, *rest))
        return values if self.order is None else _by_replicate(values, self.order)


def _by_replicate(array: NDArray[Any], order: NDArray[np.intp]) -> NDArray[Any]:
    """Return (groups, cells, trials, settings, ...) as (groups, cells, replicates, rest, ...)."""
    groups, cells, trials, settings = array.shape[:4]
    rest = trials // REPLICATES * settings
    return array[:, :, order].reshape((groups, cells, REPLICATES, rest, *array.shape[4:]))
