"""Finished cells of other stores, copied into a new one: grids grow, halves are joined.

A cell is reusable if the fingerprint and all its parameter values agree. Which cells an old store
has finished follows from its receipts and flags; the old store is only read.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import StoreError
from sweep.plan.axes import TRIAL, Axis
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import Block, scene_axes, scene_values
from sweep.plan.parameters import PARAMETERS, Stage
from sweep.plan.schema import VARIABLES, Variable, variables_of
from sweep.store.blocks import committed
from sweep.store.provenance import changes, fingerprint
from sweep.store.run_store import RunStore

MISSING = -1
"""In place of the index of a value that the old grid does not have."""


@dataclass(frozen=True, slots=True)
class Source:
    """An old store, and where the values of each new axis lie in it.

    Attributes
    ----------
    store
        The old store.
    old_index
        New axis -> (length,) index along the old axis of that name, or ``MISSING``; 0 if the
        parameter is fixed in the old store.
    pinned
        Old axis that is fixed in the new grid -> the index of the fixed value.
    done
        Numbers of the old store's committed blocks.
    """

    store: RunStore
    old_index: dict[str, NDArray[np.int64]]
    pinned: dict[str, int]
    done: frozenset[int]


def match(pipeline: Pipeline, store: RunStore) -> Source:
    """Match a new grid to an old store's.

    Raises
    ------
    StoreError
        If no cell is reusable: another fingerprint, parameters that never agree, or variables that
        the old store's format does not have.
    """
    old = store.pipeline
    mine, theirs = fingerprint(pipeline), store.fingerprint
    # A file that only one of them refers to is a value that only one of them has.
    shared = mine["files"].keys() & theirs["files"].keys()
    for stamp in (mine, theirs):
        stamp["files"] = {path: stamp["files"][path] for path in sorted(shared)}
    faults = [
        f"{key}: the store has {json.dumps(old_value)}, this run {json.dumps(value)}"
        for key, old_value, value in changes(theirs, mine)
    ]
    present = {variable.name for variable in store.variables}
    faults += [
        f"{variable.name}: not a variable of the store's format {store.format}"
        for variable in variables_of(pipeline)
        if variable.name not in present and not variable.drawn_as
    ]
    old_index: dict[str, NDArray[np.int64]] = {}
    pinned: dict[str, int] = {}
    for name in (*PARAMETERS, TRIAL):
        new_axis, old_axis = pipeline.axis(name), old.axis(name)
        new_values = _values(pipeline, name, new_axis)
        old_values = _values(old, name, old_axis)
        if new_values is None or old_values is None:
            if pipeline.distributions.get(name) != old.distributions.get(name):
                faults.append(f"{name}: not drawn from the same distribution in both")
            continue
        index = _indices(new_values, old_values)
        if not (index != MISSING).any():
            faults.append(
                f"{name}: the store has {_excerpt(old_values)}, this run {_excerpt(new_values)}"
            )
        if new_axis is not None:
            old_index[name] = index
        if old_axis is not None and new_axis is None:
            pinned[name] = int(index[0])
    if faults:
        listed = "\n".join(f"  {fault}" for fault in faults)
        raise StoreError(f"{store.url}: no cell of it can be reused\n{listed}")
    return Source(store, old_index, pinned, frozenset(committed(store)))


def is_reusable(pipeline: Pipeline, store: RunStore) -> bool:
    """Return whether a new grid could reuse cells of a store that have been computed."""
    try:
        return bool(match(pipeline, store).done)
    except StoreError:
        return False


def _values(pipeline: Pipeline, name: str, axis: Axis | None) -> Sequence[Any] | None:
    """Return a parameter's values, None if it is drawn from a distribution."""
    if axis is not None:
        return axis.values
    if name == TRIAL:
        return (0,)
    return None if name in pipeline.distributions else (pipeline.fixed[name],)


def _indices(new: Sequence[Any], old: Sequence[Any]) -> NDArray[np.int64]:
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
    """

    values: dict[str, NDArray[Any]]
    available: NDArray[np.bool_]


def read_cells(pipeline: Pipeline, block: Block, sources: Sequence[Source]) -> ReusedCells:
    """Read a block's reusable cells from old stores; of several, the first that has a cell."""
    axes = scene_axes(pipeline)
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
        for v in variables_of(pipeline)
    }
    available = np.zeros([shape[name] for name in order], dtype=bool)
    for source in sources:
        _read_from(source, pipeline, cuts, order, values, available)
    searches = pipeline.size(Stage.detection)
    return ReusedCells(values, available.reshape(len(block), searches, -1))


def _read_from(
    source: Source,
    pipeline: Pipeline,
    cuts: dict[str, slice],
    order: list[str],
    values: dict[str, NDArray[Any]],
    available: NDArray[np.bool_],
) -> None:
    """Add an old store's cells to ``values`` and ``available``, of which ``order`` is the axes."""
    positions: dict[str, NDArray[np.int64]] = {}
    indices: dict[str, NDArray[np.int64]] = {}
    for name in order:
        index = source.old_index[name][cuts.get(name, slice(None))]
        positions[name] = np.flatnonzero(index != MISSING)
        indices[name] = index[positions[name]]
        if len(positions[name]) == 0:
            return
    ready = _committed_cells(source, order, positions, indices)
    if not ready.any():
        return
    variables = variables_of(pipeline)
    present = {variable.name for variable in source.store.variables}
    old = {
        v.name: _read(source, pipeline, v, indices) for v in variables if v.name in present
    }
    old |= _drawn(
        pipeline, [v for v in variables if v.name not in present], cuts, positions,
        np.isfinite(old["true_tvec_m"]).all(axis=-1),
    )
    # A cell is finished if its block is committed and its flag says that it was run.
    estimate = VARIABLES["estimate"]
    names = [name for name in estimate.dimensions(pipeline) if name in positions]
    flags = np.transpose(old["estimate"], [names.index(name) for name in order])
    fresh = ready & (flags != 0) & ~available[np.ix_(*(positions[name] for name in order))]
    if not fresh.any():
        return
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


def _drawn(
    pipeline: Pipeline, variables: Sequence[Variable], cuts: dict[str, slice],
    positions: dict[str, NDArray[np.int64]], computed: NDArray[np.bool_],
) -> dict[str, NDArray[np.float64]]:
    """Return drawn quantities that the old store's format lacks, NaN where no truth was stored."""
    if not variables:
        return {}
    along = [
        cuts[axis.name].start + positions[axis.name].astype(np.intp)
        for axis in scene_axes(pipeline)
    ]
    indices = [grid.ravel() for grid in np.meshgrid(*along, indexing="ij")]
    values = scene_values(pipeline, indices)
    return {
        variable.name: np.where(
            computed, values[variable.drawn_as].broadcast(computed.size).reshape(computed.shape),
            np.nan,
        )
        for variable in variables
    }


def _committed_cells(
    source: Source,
    order: list[str],
    positions: dict[str, NDArray[np.int64]],
    indices: dict[str, NDArray[np.int64]],
) -> NDArray[np.bool_]:
    """Return for each candidate cell (axes ``order``) whether its old block is committed."""
    store = source.store
    blocks = store.blocks
    along: list[NDArray[np.int64]] = []
    names = []
    for axis in scene_axes(store.pipeline):
        names.append(axis.name)
        if axis.name in source.pinned:
            along.append(np.array([source.pinned[axis.name]]))
        else:
            along.append(indices[axis.name])
    numbers = [
        index // extent for index, extent in zip(along, blocks.extents, strict=True)
    ]
    ready = np.zeros([len(index) for index in along], dtype=bool)
    for chosen in itertools.product(*(np.unique(number) for number in numbers)):
        starts = tuple(int(c) * e for c, e in zip(chosen, blocks.extents, strict=True))
        if blocks.number(Block(starts, starts)) in source.done:
            ready[np.ix_(*(n == c for n, c in zip(numbers, chosen, strict=True)))] = True
    # Pinned dimensions are dropped; new ones that are fixed in the old store get length 1.
    for k in reversed(range(len(names))):
        if names[k] in source.pinned:
            ready = ready.take(0, axis=k)
            del names[k]
    full = ready.transpose([names.index(name) for name in order if name in names])
    for k, name in enumerate(order):
        if name not in names:
            full = np.expand_dims(full, k)
    return np.array(np.broadcast_to(full, [len(positions[name]) for name in order]))


def _read(
    source: Source, pipeline: Pipeline, variable: Variable, indices: dict[str, NDArray[np.int64]]
) -> NDArray[Any]:
    """Read an old variable at ``indices``, in the new grid's dimensions."""
    array = source.store.array(variable.name)
    names = list(variable.dimensions(source.store.pipeline))
    selection: list[Any] = []
    for name in names:
        if name in variable.inner:
            selection.append(slice(None))
        elif name in source.pinned:
            selection.append(np.array([source.pinned[name]]))
        else:
            selection.append(indices[name])
    part = np.asarray(array.oindex[tuple(selection)]) if names else np.asarray(array[...])
    for k in reversed(range(len(names))):
        if names[k] in source.pinned:
            part = part.take(0, axis=k)
            del names[k]
    new_names = list(variable.dimensions(pipeline))
    part = part.transpose([names.index(name) for name in new_names if name in names])
    for k, name in enumerate(new_names):
        if name not in names:
            part = np.expand_dims(part, k)
    shape = [len(indices[n]) if n in indices else part.shape[k] for k, n in enumerate(new_names)]
    return np.array(np.broadcast_to(part, shape))
