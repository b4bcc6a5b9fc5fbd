"""Cells of other stores that a run can take over."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import StoreError
from sweep.evaluation.variables import GEOMETRY
from sweep.experiment.axes import TRIAL, Axis
from sweep.experiment.grid import Block
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.same_meaning import alike
from sweep.experiment.schema import VARIABLES, Variable
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.model.scene import build_scenes
from sweep.store.blocks import RunStore, check_whole, receipts
from sweep.store.provenance import changes, fingerprint

# --------------------------------------------------------------------------------------------------
# Where the cells of a new grid lie in an old one: cells agree where all parameter values do.
#
# Whether a parameter is fixed, an axis of its own, or goes together with others does not matter.
# Axes of both grids that share parameters are matched together, along the rows of one axis where
# each grid has one, and cell by cell where one grid has several.

MISSING = -1
"""In place of the index of a value that the old grid does not have."""


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


def rows_in(group: Group, new: Pipeline, old: Pipeline) -> NDArray[np.int64]:
    """Return the index in the old grid of each value along the new axis, or ``MISSING``.

    The group has one new axis at most, and one old one at most. Without a new axis there is one
    value, the fixed one; without an old axis the index is 0 where the values agree.
    """
    names = sorted(group.parameters)
    ours, theirs = (
        [_column(axes, pipeline, name) for name in names]
        for axes, pipeline in ((group.new, new), (group.old, old))
    )
    if len(names) == 1:
        return indices_in(ours[0], theirs[0])
    return indices_in(_rows(group.new, ours), _rows(group.old, theirs))


def _column(axes: Sequence[Axis], pipeline: Pipeline, name: str) -> Sequence[Any]:
    """Return a parameter's values along the one axis that there may be; else its fixed one."""
    columns = axes[0].columns if axes else {}
    return columns.get(name, (fixed_value(pipeline, name),))


def _rows(axes: Sequence[Axis], columns: Sequence[Sequence[Any]]) -> list[tuple[Any, ...]]:
    """Return the combinations of values along the one axis that there may be."""
    count = len(axes[0]) if axes else 1
    return list(zip(*(
        column if len(column) == count else itertools.repeat(column[0], count)
        for column in columns
    ), strict=True))


def indices_in(new: Sequence[Any], old: Sequence[Any]) -> NDArray[np.int64]:
    """Return the index in ``old`` of each value of ``new``, or ``MISSING``."""
    if isinstance(new, range) and isinstance(old, range):
        low, step = old.start, old.step
        values = np.arange(new.start, new.stop, new.step, dtype=np.int64)
        index, remainder = np.divmod(values - low, step)
        exists = (remainder == 0) & (index >= 0) & (index < len(old))
        return np.where(exists, index, MISSING)
    if isinstance(old, range):
        indices = [old.index(value) if value in old else MISSING for value in new]
        return np.array(indices, dtype=np.int64)
    index_of = {value: i for i, value in enumerate(old)}
    return np.array([index_of.get(value, MISSING) for value in new], dtype=np.int64)


def cells_in(
    group: Group, new: Pipeline, old: Pipeline, along: Sequence[Sequence[int]]
) -> Iterator[tuple[dict[str, int], dict[str, int]]]:
    """Yield the cells of a group that both grids have: index along each new and each old axis.

    ``along`` has the indices along each new axis that are looked for.
    """
    owner = {name: axis for axis in group.old for name in axis.columns}
    tables: dict[str, Mapping[tuple[Any, ...], int]] = {
        axis.name: {row: k for k, row in enumerate(zip(*axis.columns.values(), strict=True))}
        for axis in group.old
    }
    names = sorted(group.parameters)
    for chosen in itertools.product(*along):
        values = {name: fixed_value(new, name) for name in names}
        for axis, index in zip(group.new, chosen, strict=True):
            values |= axis.at(index)
        if any(values[name] != fixed_value(old, name) for name in names if name not in owner):
            continue
        at = {
            axis.name: tables[axis.name].get(
                tuple(values[name] for name in axis.columns), MISSING
            )
            for axis in group.old
        }
        if MISSING not in at.values():
            yield {a.name: i for a, i in zip(group.new, chosen, strict=True)}, at


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
"""Flags of cells that are not reused."""

PINNED = ""
"""In place of the name of an old dimension of which one index is read."""


@dataclass(frozen=True, slots=True)
class Source:
    """An old store, and where the values of each new axis lie in it.

    Attributes
    ----------
    store
        The old store.
    old_index
        New axis -> (length,) index along the old axis of its parameters, or ``MISSING``; 0 if they
        are fixed in the old store.
    renamed
        Old axis -> the new axis of its parameters.
    pinned
        Old axis that is fixed in the new grid -> the index of the fixed value.
    tangled
        Axes whose cells are matched one by one.
    done
        Numbers of the old store's committed blocks.
    """

    store: RunStore
    old_index: dict[str, NDArray[np.int64]]
    renamed: dict[str, str]
    pinned: dict[str, int]
    tangled: list[Group]
    done: frozenset[int]


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
    source = Source(store, {}, {}, {}, [], frozenset(check_whole(store)))
    for group in groups(pipeline, old):
        if group.parameters & (pipeline.distributions.keys() | old.distributions.keys()):
            continue  # a fault that is noted already
        if len(group.new) > 1 or len(group.old) > 1:
            source.tangled.append(group)
            continue
        index = rows_in(group, pipeline, old)
        if not (index != MISSING).any():
            first, *others = sorted(group.parameters)
            faults.append(
                f"{group.names}: no values of {', '.join([first, *others])} go together in both"
                if others else _difference(pipeline, old, first)
            )
        for axis in group.new:
            source.old_index[axis.name] = index
            source.renamed.update({other.name: axis.name for other in group.old})
        if not group.new:
            source.pinned[group.old[0].name] = int(index[0])
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
    axes = pipeline.experiment.scene_axes
    cuts = {
        axis.name: slice(start, stop)
        for axis, start, stop in zip(axes, block.starts, block.stops, strict=True)
    }
    settings = [*pipeline.axes_of(Stage.detection), *pipeline.axes_of(Stage.estimation)]
    order = [axis.name for axis in (*axes, *settings)]
    shape = {
        **dict(zip((axis.name for axis in axes), block.shape, strict=True)),
        **{axis.name: len(axis) for axis in settings},
    }
    values = {
        v.name: np.full(
            [shape[n] for n in v.dimensions(pipeline) if n in shape] + list(v.inner_shape),
            v.fill, dtype=v.dtype,
        )
        for v in pipeline.experiment.variables
    }
    available = np.zeros([shape[name] for name in order], dtype=bool)
    processors: set[str] = set()
    for source in sources:
        for untangled in _untangled(source, pipeline, cuts):
            read = _read_from(untangled, pipeline, cuts, order, values, available)
            for _, receipt in receipts(source.store, read):
                processors.update(receipt.processors)
    searches = pipeline.size(Stage.detection)
    return ReusedCells(values, available.reshape(len(block), searches, -1), processors)


def _untangled(source: Source, pipeline: Pipeline, cuts: dict[str, slice]) -> Iterator[Source]:
    """Yield a source for each cell of the tangled axes: of new ones one value, old ones pinned."""
    old = source.store.pipeline
    cells = (
        cells_in(group, pipeline, old, [
            range(*cuts.get(axis.name, slice(None)).indices(len(axis))) for axis in group.new
        ])
        for group in source.tangled
    )
    for chosen in itertools.product(*cells):
        new = {name: index for indices, _ in chosen for name, index in indices.items()}
        one_value = {
            axis.name: np.where(np.arange(len(axis)) == new[axis.name], 0, MISSING)
            for axis in pipeline.axes if axis.name in new
        }
        yield dataclasses.replace(
            source, tangled=[], old_index=source.old_index | one_value,
            pinned=source.pinned | {name: k for _, at in chosen for name, k in at.items()},
        )


def _read_from(
    source: Source,
    pipeline: Pipeline,
    cuts: dict[str, slice],
    order: list[str],
    values: dict[str, NDArray[Any]],
    available: NDArray[np.bool_],
) -> set[int]:
    """Add an old store's cells to ``values`` and ``available``, of which ``order`` is the axes.

    Returns the numbers of the old blocks that they come from.
    """
    positions: dict[str, NDArray[np.int64]] = {}
    indices: dict[str, NDArray[np.int64]] = {}
    for name in order:
        index = source.old_index[name][cuts.get(name, slice(None))]
        positions[name] = np.flatnonzero(index != MISSING)
        indices[name] = index[positions[name]]
        if len(positions[name]) == 0:
            return set()
    ready, numbers = _committed_cells(source, order, positions, indices)
    if not ready.any():
        return set()
    variables = pipeline.experiment.variables
    present = {variable.name for variable in source.store.variables}
    old = {
        v.name: _read(source, pipeline, v, indices) for v in variables if v.name in present
    }
    old |= _computed(
        pipeline, [v for v in variables if v.name not in present], cuts, positions,
        np.isfinite(old["true_tvec_m"]).all(axis=-1),
    )
    # A cell is finished if its block is committed and its flags say that it was run. What failed is
    # computed, so that the new store has the reasons of all its failures.
    run = _along(order, pipeline, "estimate", old)
    fresh = ready & ~np.isin(run, (EstimateStatus.not_run, EstimateStatus.not_needed))
    for name, flags in LOST.items():
        fresh &= ~np.isin(_along(order, pipeline, name, old), flags)
    fresh &= ~available[np.ix_(*(positions[name] for name in order))]
    if not fresh.any():
        return set()
    available[np.ix_(*(positions[name] for name in order))] |= fresh
    for variable in variables:
        names = [name for name in variable.dimensions(pipeline) if name in positions]
        # With a configuration of a scene (or of a detection), what it shares is reused.
        away = tuple(k for k, name in enumerate(order) if name not in names)
        chosen = fresh.any(axis=away)
        kept = [name for name in order if name in names]
        chosen = np.transpose(chosen, [kept.index(name) for name in names])
        target = values[variable.name]
        grid = np.ix_(*(positions[name] for name in names)) if names else ...
        part = target[grid]
        part[chosen] = old[variable.name][chosen]
        target[grid] = part
    return numbers


def _along(
    order: Sequence[str], pipeline: Pipeline, name: str, values: dict[str, NDArray[Any]]
) -> NDArray[Any]:
    """Return a variable's values along the axes ``order``, of length 1 along those it lacks."""
    names = [axis for axis in VARIABLES[name].dimensions(pipeline) if axis in order]
    kept = [axis for axis in order if axis in names]
    moved = np.transpose(values[name], [names.index(axis) for axis in kept])
    return moved[tuple(slice(None) if axis in names else None for axis in order)]


def _follows(variable: Variable) -> bool:
    """Return whether a variable follows from the scene's values, without its image."""
    return bool(variable.drawn_as) or variable.name in GEOMETRY


def _computed(
    pipeline: Pipeline, variables: Sequence[Variable], cuts: dict[str, slice],
    positions: dict[str, NDArray[np.int64]], computed: NDArray[np.bool_],
) -> dict[str, NDArray[np.float64]]:
    """Return variables that the old store lacks, NaN where no truth was stored."""
    if not variables:
        return {}
    along = [
        cuts[axis.name].start + positions[axis.name].astype(np.intp)
        for axis in pipeline.experiment.scene_axes
    ]
    indices = [grid.ravel() for grid in np.meshgrid(*along, indexing="ij")]
    values = pipeline.experiment.scene_values(indices)
    scenes = build_scenes(values, computed.size)
    columns = {
        variable.name: values[variable.drawn_as].broadcast(computed.size) if variable.drawn_as
        else GEOMETRY[variable.name](scenes)
        for variable in variables
    }
    return {
        name: np.where(computed, column.reshape(computed.shape), np.nan)
        for name, column in columns.items()
    }


def _committed_cells(
    source: Source,
    order: list[str],
    positions: dict[str, NDArray[np.int64]],
    indices: dict[str, NDArray[np.int64]],
) -> tuple[NDArray[np.bool_], set[int]]:
    """Return for each candidate cell (axes ``order``) whether its old block is committed.

    Also returns the numbers of these blocks.
    """
    store = source.store
    blocks = store.blocks
    along: list[NDArray[np.int64]] = []
    names = []
    for axis in store.pipeline.experiment.scene_axes:
        if axis.name in source.pinned:
            names.append(PINNED)
            along.append(np.array([source.pinned[axis.name]]))
        else:
            names.append(source.renamed[axis.name])
            along.append(indices[names[-1]])
    counts = [
        index // extent for index, extent in zip(along, blocks.extents, strict=True)
    ]
    ready = np.zeros([len(index) for index in along], dtype=bool)
    numbers = set()
    for chosen in itertools.product(*(np.unique(count) for count in counts)):
        starts = tuple(int(c) * e for c, e in zip(chosen, blocks.extents, strict=True))
        number = blocks.number(Block(starts, starts))
        if number in source.done:
            numbers.add(number)
            ready[np.ix_(*(n == c for n, c in zip(counts, chosen, strict=True)))] = True
    # Pinned dimensions are dropped; new ones that are fixed in the old store get length 1.
    for k in reversed(range(len(names))):
        if names[k] == PINNED:
            ready = ready.take(0, axis=k)
            del names[k]
    full = ready.transpose([names.index(name) for name in order if name in names])
    for k, name in enumerate(order):
        if name not in names:
            full = np.expand_dims(full, k)
    cells = np.broadcast_to(full, [len(positions[name]) for name in order])
    return np.array(cells), numbers


def _read(
    source: Source, pipeline: Pipeline, variable: Variable, indices: dict[str, NDArray[np.int64]]
) -> NDArray[Any]:
    """Read an old variable at ``indices``, in the new grid's dimensions."""
    array = source.store.array(variable.name)
    names = list(variable.dimensions(source.store.pipeline))
    selection: list[Any] = []
    for k, name in enumerate(names):
        if name in variable.inner:
            selection.append(slice(None))
        elif name in source.pinned:
            selection.append(np.array([source.pinned[name]]))
            names[k] = PINNED
        else:
            names[k] = source.renamed[name]
            selection.append(indices[names[k]])
    part = np.asarray(array.oindex[tuple(selection)]) if names else np.asarray(array[...])
    for k in reversed(range(len(names))):
        if names[k] == PINNED:
            part = part.take(0, axis=k)
            del names[k]
    new_names = list(variable.dimensions(pipeline))
    part = part.transpose([names.index(name) for name in new_names if name in names])
    for k, name in enumerate(new_names):
        if name not in names:
            part = np.expand_dims(part, k)
    part = variable.fitted(part)
    shape = [len(indices[n]) if n in indices else part.shape[k] for k, n in enumerate(new_names)]
    return np.array(np.broadcast_to(part, shape))
