"""Cells of other stores that a run can take over."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import StoreError
from sweep.evaluation.variables import GEOMETRY
from sweep.experiment.axes import TRIAL, Axis
from sweep.experiment.grid import Block, block_indices
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.same_meaning import alike
from sweep.experiment.schema import Variable
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.model.scene import build_scenes
from sweep.store.blocks import RunStore, check_whole, receipts, region
from sweep.store.provenance import changes, fingerprint
from sweep.typing import Masks

# --------------------------------------------------------------------------------------------------
# Where the cells of a new grid lie in an old one: cells agree where all parameter values do.
#
# Whether a parameter is fixed, an axis of its own, or goes together with others does not matter.
# Axes of both grids that share parameters are matched together, by the key of each cell: the
# values of these parameters.

@dataclass(slots=True)
class Group:
    """Axes of two grids that share parameters.

    Attributes
    ----------
    new, old
        The axes of either grid.
    """

    new: list[Axis] = field(default_factory=list)
    old: list[Axis] = field(default_factory=list)

    @property
    def parameters(self) -> set[str]:
        """The parameters of its axes."""
        return {name for axis in (*self.new, *self.old) for name in axis.columns}

    @property
    def names(self) -> str:
        """Its axes in words."""
        return ", ".join(dict.fromkeys(axis.name for axis in (*self.new, *self.old)))


def groups(new: Pipeline, old: Pipeline) -> list[Group]:
    """Return the axes of two grids, those together that share parameters."""
    found: list[Group] = []
    for axis, is_new in [*((a, True) for a in new.axes), *((a, False) for a in old.axes)]:
        merged = Group([axis] if is_new else [], [] if is_new else [axis])
        for group in [group for group in found if group.parameters & axis.columns.keys()]:
            found.remove(group)
            merged = Group(group.new + merged.new, group.old + merged.old)
        found.append(merged)
    return found


def fixed_value(pipeline: Pipeline, name: str) -> Any:
    """Return a fixed parameter's value; of ``trial`` the first."""
    return 0 if name == TRIAL else pipeline.fixed.get(name)


def row_index(axis: Axis) -> Callable[[tuple[Any, ...]], int | None]:
    """Return what gives the index along an axis of a row of its columns' values, or None."""
    first, *others = axis.columns.values()
    if isinstance(first, range) and not others:  # of trials, which may be many
        return lambda row: first.index(row[0]) if row[0] in first else None
    return {row: k for k, row in enumerate(zip(first, *others, strict=True))}.get


@dataclass(frozen=True, slots=True)
class Source:
    """An old store, and where the cells of a new grid lie in it.

    Attributes
    ----------
    store
        The old store.
    new, old
        Both grids, with values in the same words.
    groups
        Their axes that share parameters.
    done
        Numbers of the old store's committed blocks.
    """

    store: RunStore
    new: Pipeline
    old: Pipeline
    groups: list[Group]
    done: frozenset[int]
    _rows: dict[str, Callable[[tuple[Any, ...]], int | None]]

    @staticmethod
    def of(new: Pipeline, store: RunStore, done: frozenset[int]) -> Source:
        """Return where the cells of a new grid lie in a store."""
        new, old = alike(new, store.pipeline)
        rows = {axis.name: row_index(axis) for axis in old.axes}
        return Source(store, new, old, groups(new, old), done, rows)

    def cells_in(
        self, group: Group, along: Sequence[range]
    ) -> Iterator[tuple[int, tuple[int, ...]]]:
        """Yield the cells of a group that both grids have.

        Parameters
        ----------
        group
            The group.
        along
            The indices along each new axis that are looked for.

        Yields
        ------
        The number of the new cell within ``along``, the last axis fastest; its index along each
        old axis.
        """
        owned = {name for axis in group.old for name in axis.columns}
        fixed = {name: fixed_value(self.new, name) for name in group.parameters}
        others = [(name, fixed_value(self.old, name)) for name in group.parameters - owned]
        for number, chosen in enumerate(itertools.product(*along)):
            values = dict(fixed)
            for axis, index in zip(group.new, chosen, strict=True):
                values |= axis.at(index)
            if any(values[name] != value for name, value in others):
                continue
            at = [self._rows[axis.name](tuple(values[name] for name in axis.columns))
                  for axis in group.old]
            found = tuple(index for index in at if index is not None)
            if len(found) == len(at):
                yield number, found

    def located(
        self, order: Sequence[str], cuts: dict[str, range]
    ) -> tuple[Masks, dict[str, NDArray[np.intp]]]:
        """Return which cells of a box of the new grid the old one has, and where.

        Parameters
        ----------
        order
            The new grid's axes, along which the results' dimensions are.
        cuts
            The box: axis -> indices.

        Returns
        -------
        Whether the old grid has a cell; old axis -> index along it.
        """
        shape = tuple(len(cuts[name]) for name in order)
        exists = np.ones(shape, dtype=bool)
        indices: dict[str, NDArray[np.intp]] = {}
        for group in self.groups:
            names = [axis.name for axis in group.new]
            along = [cuts[name] for name in names]
            found = np.zeros([len(part) for part in along], dtype=bool)
            at = np.zeros([len(group.old), *found.shape], dtype=np.intp)
            flat = at.reshape(len(group.old), found.size)
            for number, index in self.cells_in(group, along):
                found.reshape(-1)[number] = True
                flat[:, number] = index
            within = [name for name in order if name in names]
            axes = [names.index(name) for name in within]
            spread = tuple(slice(None) if name in names else None for name in order)
            exists &= found.transpose(axes)[spread]
            for axis, part in zip(group.old, at, strict=True):
                indices[axis.name] = np.broadcast_to(part.transpose(axes)[spread], shape)
        return exists, indices


# --------------------------------------------------------------------------------------------------
# Finished cells of other stores, copied into a new one: grids grow, halves are joined.
#
# A cell is reusable if the fingerprint and all its parameter values agree, and nothing of it
# failed or crashed. Which cells an old store has finished follows from its receipts and flags;
# the old store is only read.

LOST = {
    "detection": (DetectionStatus.failed, DetectionStatus.crashed),
    "estimate": (EstimateStatus.failed, EstimateStatus.crashed),
}
"""Flags of cells that are not reused, so that the new store has the reasons of all its failures."""


def match(pipeline: Pipeline, store: RunStore) -> Source:
    """Match a new grid to an old store's.

    Raises
    ------
    StoreError
        If no cell is reusable: another fingerprint, or parameters that never agree; or if chunks
        of committed blocks are missing.
    """
    old = store.pipeline
    mine, theirs = fingerprint(pipeline), store.fingerprint
    # A file that only one of them refers to is a value that only one of them has.
    for key in ("files", "plugins"):  # as of a plug-in
        shared = mine.get(key, {}).keys() & theirs.get(key, {}).keys()
        for stamp in (mine, theirs):
            stamp[key] = {name: stamp[key][name] for name in sorted(shared)}
    faults = [
        f"{key}: the store has {json.dumps(old_value)}, this run {json.dumps(value)}"
        for key, old_value, value in changes(theirs, mine)
    ]
    present = {variable.name for variable in store.variables}
    faults += [
        f"{variable.name}: not a variable of the store"
        for variable in pipeline.experiment.variables
        if variable.name not in present and not _follows(variable)
    ]
    pipeline, old = alike(pipeline, old)
    for name in dict.fromkeys((*pipeline.parameters, *old.parameters, TRIAL)):
        if pipeline.distributions.get(name) != old.distributions.get(name):
            faults.append(f"{name}: not drawn from the same distribution in both")
        elif (
            name in pipeline.fixed and name in old.fixed
            and pipeline.fixed[name] != old.fixed[name]
        ):
            faults.append(_difference(pipeline, old, name))
    source = Source.of(pipeline, store, frozenset(check_whole(store)))
    for group in source.groups:
        if len(group.new) > 1 or len(group.old) > 1 or group.parameters & (
                pipeline.distributions.keys() | old.distributions.keys()):
            continue  # matched cell by cell, or a fault that is noted already
        whole = [range(len(axis)) for axis in group.new]
        if next(source.cells_in(group, whole), None) is None:
            first, *others = sorted(group.parameters)
            faults.append(
                f"{group.names}: no values of {', '.join([first, *others])} go together in both"
                if others else _difference(pipeline, old, first)
            )
    if faults:
        listed = "\n".join(f"  {fault}" for fault in faults)
        raise StoreError(f"{store.url}: no cell of it can be reused\n{listed}")
    return source


def is_reusable(pipeline: Pipeline, store: RunStore) -> bool:
    """Return whether a new grid could reuse cells of a store that have been computed."""
    try:
        return bool(match(pipeline, store).done)
    except StoreError:
        return False


def _difference(pipeline: Pipeline, old: Pipeline, name: str) -> str:
    """Return a line on the values that a parameter has in either grid."""
    ours, theirs = (_excerpt(_values(grid, name)) for grid in (pipeline, old))
    return f"{name}: the store has {theirs}, this run {ours}"


def _values(pipeline: Pipeline, name: str) -> Sequence[Any]:
    """Return a parameter's values."""
    axis = pipeline.axis_of(name)
    return (fixed_value(pipeline, name),) if axis is None else axis.columns[name]


def _excerpt(values: Sequence[Any]) -> str:
    shown = ", ".join(str(value) for value in values[:4])
    return shown if len(values) <= 4 else f"{shown}, ... ({len(values):,} values)"


@dataclass(slots=True)
class ReusedCells:
    """The cells of a block that old stores have.

    Attributes
    ----------
    values
        Variable -> values in the dataset's dimensions; fill values in cells that are missing.
    available
        (N, detector settings, estimators): the cells that need not be computed.
    processors
        Features of the processors that computed the blocks which cells come from.
    """

    values: dict[str, NDArray[Any]]
    available: NDArray[np.bool_]
    processors: set[str]


def read_cells(pipeline: Pipeline, block: Block, sources: Sequence[Source]) -> ReusedCells:
    """Read a block's reusable cells from old stores; of several, the first that has a cell."""
    settings = [*pipeline.axes_of(Stage.detection), *pipeline.axes_of(Stage.estimation)]
    # The last axis is that of a grid without any.
    order = [*(axis.name for axis in (*pipeline.experiment.scene_axes, *settings)), ""]
    parts = [range(*cut) for cut in zip(block.starts, block.stops, strict=True)]
    parts += [*(range(len(axis)) for axis in settings), range(1)]
    cuts = dict(zip(order, parts, strict=True))
    variables = pipeline.experiment.variables
    values = {
        v.name: np.full(
            [len(cuts[n]) for n in v.dimensions(pipeline) if n in cuts] + list(v.inner_shape),
            v.fill, dtype=v.dtype,
        )
        for v in variables
    }
    available = np.zeros([len(part) for part in parts], dtype=bool)
    processors: set[str] = set()
    for source in sources:
        exists, at = source.located(order, cuts)
        numbers = _block_numbers(source, at, exists.shape)
        taken = np.zeros_like(available)
        wanted = exists & ~available
        for number in source.done.intersection(np.unique(numbers[wanted]).tolist()):
            cells = np.nonzero(wanted & (numbers == number))
            taken[_copied(source, number, variables, order, cells, at, values)] = True
        present = {variable.name for variable in source.store.variables}
        scenes = np.asarray(taken.reshape(len(block), -1).any(axis=1))
        _compute(pipeline, block, [v for v in variables if v.name not in present], scenes, values)
        used = np.unique(numbers[taken]).tolist()
        for _, receipt in receipts(source.store, used):
            processors.update(receipt.processors)
        available |= taken
    searches = pipeline.size(Stage.detection)
    return ReusedCells(values, available.reshape(len(block), searches, -1), processors)


def _block_numbers(
    source: Source, at: dict[str, NDArray[np.intp]], shape: tuple[int, ...]
) -> NDArray[np.intp]:
    """Return the number of the old block that each cell lies in."""
    blocks = source.store.blocks
    numbers = np.zeros(shape, dtype=np.intp)
    for axis, extent, count in zip(
        source.old.experiment.scene_axes, blocks.extents, blocks.counts, strict=True
    ):
        numbers = numbers * count + at[axis.name] // extent
    return numbers


def _copied(
    source: Source, number: int, variables: Sequence[Variable], order: Sequence[str],
    cells: tuple[NDArray[np.intp], ...], at: dict[str, NDArray[np.intp]],
    values: dict[str, NDArray[Any]],
) -> tuple[NDArray[np.intp], ...]:
    """Copy the finished ones of some ``cells`` of an old block into ``values``; return these.

    A cell is finished if its flags say that it was run. With a configuration of a scene (or of a
    detection), what it shares is copied.
    """
    store, pipeline = source.store, source.store.pipeline
    block = store.blocks[number]
    axes = pipeline.experiment.scene_axes
    first = dict(zip((axis.name for axis in axes), block.starts, strict=True))
    inside = {name: index[cells] - first.get(name, 0) for name, index in at.items()}
    present = {variable.name: variable for variable in store.variables}

    def read(variable: Variable) -> NDArray[Any]:
        """Return a variable of the cells (cells, inner)."""
        old = present[variable.name]
        part = np.asarray(store.array(variable.name)[region(old, pipeline, block)])
        names = [name for name in old.dimensions(pipeline) if name in inside]
        return variable.fitted(part[tuple(inside[name] for name in names)])

    flags = {v.name: read(v) for v in variables if v.name in LOST}
    ended = ~np.isin(flags["estimate"], (EstimateStatus.not_run, EstimateStatus.not_needed))
    for name, lost in LOST.items():
        ended &= ~np.isin(flags[name], lost)
    inside = {name: index[ended] for name, index in inside.items()}
    finished = tuple(index[ended] for index in cells)
    if ended.any():
        for variable in variables:
            if variable.name in present:
                names = [n for n in variable.dimensions(source.new) if n in order]
                target = tuple(finished[order.index(name)] for name in names)
                values[variable.name][target] = read(variable)
    return finished


def _follows(variable: Variable) -> bool:
    """Return whether a variable follows from the scene's values, without its image."""
    return bool(variable.drawn_as) or variable.name in GEOMETRY


def _compute(
    pipeline: Pipeline, block: Block, variables: Sequence[Variable], scenes: Masks,
    values: dict[str, NDArray[Any]],
) -> None:
    """Compute variables that an old store lacks in some scenes, where it has their truth."""
    has_truth = np.isfinite(values["true_tvec_m"]).all(axis=-1)
    rows = np.flatnonzero(scenes & has_truth.reshape(-1))
    if not (variables and len(rows)):
        return
    drawn = pipeline.experiment.scene_values([index[rows] for index in block_indices(block)])
    built = build_scenes(drawn, len(rows))
    for variable in variables:
        values[variable.name].reshape(-1)[rows] = (
            drawn[variable.drawn_as].broadcast(len(rows)) if variable.drawn_as
            else GEOMETRY[variable.name](built))
