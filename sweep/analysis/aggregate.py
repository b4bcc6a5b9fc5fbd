"""Statistics of all poses of a dataset that may be larger than memory: block by block, merged.

The blocks are the chunks of a lazy dataset, and the result is then lazy, too.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic

import dask.array as da
import xarray as xr
from dask.typing import Key
from numpy.typing import NDArray

from sweep.analysis.binning import (
    Arrays,
    Binning,
    Bins,
    ChunkReader,
    Layout,
    Lengths,
    ReadBlock,
    TaskLayer,
    add_pass,
    array_of_blocks,
    read_bins,
)
from sweep.analysis.dataset import is_fixed, is_sampling_stopped, of_photographs
from sweep.analysis.draws import (
    as_stopped,
    by_photograph,
    common_trials,
    replicate_order,
    replicated,
)
from sweep.analysis.poses import COMMON
from sweep.analysis.statistic import Nothing, Output, SinglePass, State, Statistic, Variables, ViewT

MAX_AT_ONCE = 1 << 21
"""Poses, times the lengths of inner dimensions, up to which what is in memory is one block.

Dask's graph takes longer than the statistics of so few.
"""


def aggregate(
    results: xr.Dataset,
    inputs: Mapping[str, xr.DataArray],
    kept: Sequence[str],
    statistics: Sequence[Statistic[ViewT, Any, Any, Any]],
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
        A variable (*kept, *bins) for each output; lazy if any of the inputs is.

    Raises
    ------
    ArgumentError
        For bins that cannot be.
    """
    binning, binned = read_bins(results, kept, bins or {})
    lazy = any(array.chunks is not None for array in inputs.values())
    if is_sampling_stopped(results) if stopped is None else stopped:
        statistics = [as_stopped(statistic) for statistic in statistics]
        if (common := common_trials(results, inputs, kept)) is not None:
            inputs = {**inputs, COMMON: common}
    dataset = xr.Dataset(
        {name: array.reset_coords(drop=True) for name, array in inputs.items()} | binned)
    photographs = of_photographs(results)
    layout = Layout.of(dataset, kept, has_cells=not photographs)
    if photographs:
        statistics = [by_photograph(statistic) for statistic in statistics]
    if (order := replicate_order(results, layout.draws)) is not None:
        settings = math.prod(results.sizes[name] for name in layout.settings)
        layout = dataclasses.replace(layout, order=order)
        statistics = [replicated(statistic, settings) for statistic in statistics]
    passes = Passes(layout, binning, tuple(statistics), view)
    coordinates = {name: value.variable for name, value in results.coords.items()
                   if set(value.dims) <= set(kept) and not is_fixed(value)}
    dims = (*layout.kept, *binning.edges)
    if not lazy and math.prod(dataset.sizes.values()) <= MAX_AT_ONCE:
        sizes = {name: dataset.sizes.get(name, results.sizes[name]) for name in layout.dimensions}
        values = passes.of_block(sizes, [each.values for each in dataset.values()])
        shape = (*(sizes[name] for name in layout.kept), *binning.shape)
        found = {output.name: (dims, _pick(output, shape, values), output.attributes())
                 for statistic in statistics for output in statistic.outputs()}
        return xr.Dataset(found, coordinates).assign_coords(binning.coordinates(results))
    chunked = layout.rechunk(dataset, lazy=lazy)
    lengths = {name: tuple(chunked.chunks[name]) if name in chunked.sizes
               else (results.sizes[name],) for name in layout.dimensions}
    layer, tables = _add_tasks(chunked, lengths, passes)
    chunks = (*(lengths[name] for name in layout.kept), *((count,) for count in binning.shape))
    variables = {
        output.name: (dims, array_of_blocks(
            layer, tables, functools.partial(_pick, output), output.name, chunks, output.dtype,
        ), output.attributes())
        for statistic in statistics for output in statistic.outputs()
    }
    table = xr.Dataset(variables, coordinates).assign_coords(binning.coordinates(results))
    return table if lazy else table.compute(scheduler="synchronous")


@dataclass(frozen=True)
class Passes(Generic[ViewT]):
    """The passes of several statistics over a block, as functions of tasks.

    States are in lists, one for each statistic. Groups are those of the kept dimensions times the
    combinations of bins, the bins fastest.
    """

    layout: Layout
    binning: Binning
    statistics: tuple[Statistic[ViewT, Any, Any, Any], ...]
    view: Callable[[Arrays], ViewT]

    @property
    def single(self) -> bool:
        """Whether no statistic needs the second pass."""
        return all(isinstance(statistic, SinglePass) for statistic in self.statistics)

    def first_pass(self, sizes: Mapping[str, int], read: ReadBlock) -> list[State]:
        """Return the states of a block."""
        return self._by_bin(sizes, read, lambda poses, _: [
            statistic.first_pass(poses) for statistic in self.statistics])

    def prepare_second(self, first: Sequence[State]) -> list[State]:
        """Return what the second pass needs, from the states of all blocks."""
        return [statistic.prepare_second(state)
                for statistic, state in zip(self.statistics, first, strict=True)]

    def second_pass(
        self, sizes: Mapping[str, int], read: ReadBlock, known: Sequence[State]
    ) -> list[State]:
        """Return the states of a block."""
        return self._by_bin(sizes, read, lambda poses, number: [
            statistic.second_pass(poses, state.every_nth(self.binning.count, number))
            for statistic, state in zip(self.statistics, known, strict=True)])

    def finish(self, known: Sequence[State], second: Sequence[State] | None = None) -> Variables:
        """Return the variables of all statistics, each (groups,)."""
        variables: Variables = {}
        second = second or [Nothing()] * len(known)
        for statistic, *states in zip(self.statistics, known, second, strict=True):
            variables |= statistic.finish(*states)
        return variables

    def of_block(
        self, sizes: Mapping[str, int], arrays: Sequence[NDArray[Any]]
    ) -> Variables:
        """Return the variables of all statistics of a dataset that is one block."""
        def read() -> list[NDArray[Any]]:
            return list(arrays)

        known = self.prepare_second(fold(self.first_pass(sizes, read)))
        if self.single:
            return self.finish(known)
        return self.finish(known, fold(self.second_pass(sizes, read, known)))

    def _by_bin(
        self, sizes: Mapping[str, int], read: ReadBlock,
        pass_over: Callable[[ViewT, int], list[State]],
    ) -> list[State]:
        """Return the states of all combinations of bins, those of a group together."""
        arrays = self.layout.arrange(read(), sizes)
        by_bin = []
        for number, (part, cells) in enumerate(self.binning.split(arrays)):
            states = pass_over(self.view(part), number)
            by_bin.append(states if cells is None else [each.scatter(cells) for each in states])
        return [type(states[0]).interleave(states) for states in zip(*by_bin, strict=True)]


def fold(*parts: Sequence[State]) -> list[State]:
    """Return the folded states of some cells, of all their draws."""
    return [functools.reduce(type(states[0]).merge, states).fold()
            for states in zip(*parts, strict=True)]


def merge(*parts: Sequence[State]) -> list[State]:
    """Return the states of all blocks together."""
    return [functools.reduce(type(states[0]).merge, states)
            for states in zip(*parts, strict=True)]


def _add_tasks(
    dataset: xr.Dataset, lengths: Lengths, passes: Passes[ViewT]
) -> tuple[TaskLayer, list[Key]]:
    """Return the tasks, and the keys of the variables of each block of the kept dimensions."""
    layer = TaskLayer("statistics")
    reader = ChunkReader([da.asarray(array.data) for array in dataset.data_vars.values()])
    add = functools.partial(add_pass, layer, reader, passes.layout, lengths)
    known = [layer.add(passes.prepare_second, layer.merge(merge, states))
             for states in add(passes.first_pass, fold)]
    if passes.single:
        return layer, [layer.add(passes.finish, state) for state in known]
    second = [layer.merge(merge, states) for states in add(passes.second_pass, fold, known)]
    return layer, [layer.add(passes.finish, *states)
                   for states in zip(known, second, strict=True)]


def _pick(output: Output, shape: tuple[int, ...], table: Variables) -> NDArray[Any]:
    return table[output.name].reshape(shape).astype(output.dtype)
