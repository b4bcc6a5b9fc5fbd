"""Where the cells of a new grid lie in an old one: cells agree where all parameter values do.

Whether a parameter is fixed, an axis of its own, or goes together with others does not matter.
Axes of both grids that share parameters are matched together, along the rows of one axis where
each grid has one, and cell by cell where one grid has several.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.plan.axes import TRIAL, Axis
from sweep.plan.experiment import Pipeline

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
