"""Pieces of the grid: blocks of scene cells, and every parameter's values on them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.measure.detector import DetectorSetting
from sweep.measure.solver import EstimatorSetting
from sweep.model.camera import VIEW_PARAMETERS, canonical_distortion, intrinsics
from sweep.model.effects import RANDOM, is_on
from sweep.plan.axes import TRIAL, Axis
from sweep.plan.draws import bits, geometry_keys, uniform
from sweep.plan.experiment import Pipeline
from sweep.plan.parameters import PARAMETERS, Stage


@dataclass(frozen=True, slots=True, order=True)
class Block:
    """A box of scene cells: half-open index ranges along the scene axes, in their order.

    It names a piece of the grid everywhere: in a task, a commit, a log line, an error.

    >>> str(Block((0, 10), (5, 20)))
    '0-5,10-20'
    """

    starts: tuple[int, ...]
    stops: tuple[int, ...]

    @property
    def shape(self) -> tuple[int, ...]:
        """Cells along each scene axis."""
        return tuple(b - a for a, b in zip(self.starts, self.stops, strict=True))

    def __len__(self) -> int:
        return math.prod(self.shape)

    def cell(self, scene: int) -> tuple[int, ...]:
        """Return where one of its scenes lies along each scene axis, the last axis fastest."""
        if not self.shape:
            return ()
        within = np.unravel_index(scene, self.shape)
        return tuple(start + int(k) for start, k in zip(self.starts, within, strict=True))

    def __str__(self) -> str:
        pairs = zip(self.starts, self.stops, strict=True)
        return ",".join(f"{a}-{b}" for a, b in pairs) or "all"


@dataclass(frozen=True, slots=True)
class Blocks:
    """The grid of scene cells cut into equal boxes; nothing is listed until it is asked for."""

    lengths: tuple[int, ...]
    extents: tuple[int, ...]

    @property
    def counts(self) -> tuple[int, ...]:
        """Blocks along each scene axis."""
        return tuple(
            -(-length // extent)
            for length, extent in zip(self.lengths, self.extents, strict=True)
        )

    def __len__(self) -> int:
        return math.prod(self.counts)

    def __iter__(self) -> Iterator[Block]:
        return (self[number] for number in range(len(self)))

    def __getitem__(self, number: int) -> Block:
        """Return a block by its number; the last axis counts fastest."""
        index = []
        for count in reversed(self.counts):
            number, position = divmod(number, count)
            index.append(position)
        starts = tuple(i * e for i, e in zip(reversed(index), self.extents, strict=True))
        stops = tuple(
            min(start + extent, length)
            for start, extent, length in zip(starts, self.extents, self.lengths, strict=True)
        )
        return Block(starts, stops)

    def number(self, block: Block) -> int:
        """Return the number of a block."""
        number = 0
        for start, extent, count in zip(block.starts, self.extents, self.counts, strict=True):
            number = number * count + start // extent
        return number


def scene_axes(pipeline: Pipeline) -> tuple[Axis, ...]:
    """Return the axes that blocks are cut along."""
    return pipeline.axes_of(Stage.scene)


def _column(axis: Axis, indices: NDArray[np.intp]) -> Any:
    """Return an axis' values at indices (N,): an array of numbers, or a list of anything else."""
    low, high = int(indices.min()), int(indices.max()) + 1
    part = axis.values[low:high]
    if isinstance(part, range):
        return part.start + part.step * (indices - low)
    if isinstance(part[0], (int, float)) and not any(isinstance(v, (bool, str)) for v in part):
        return np.asarray(part, dtype=np.float64)[indices - low]
    return [part[i] for i in (indices - low).tolist()]


def scene_values(pipeline: Pipeline, indices: Sequence[NDArray[np.intp]]) -> dict[str, Any]:
    """Return every parameter's values for scenes at ``indices`` (N,) along each scene axis.

    One value where it is the same for all, else (N,) values; drawn ones are drawn.
    ``distance_m`` is resolved, lenses are canonical, images are absolute paths, and
    ``shift_u_px``, ``shift_v_px`` are the jitter.
    """
    axes = scene_axes(pipeline)
    count = len(indices[0]) if axes else 1
    values: dict[str, Any] = dict(pipeline.fixed)
    trials = np.zeros(count, dtype=np.int64)
    for axis, index in zip(axes, indices, strict=True):
        column = _column(axis, index)
        if axis.name == TRIAL:
            trials = np.asarray(column, dtype=np.int64)
        else:
            values[axis.name] = column
    distortion = values["distortion"]
    values["distortion"] = (
        [canonical_distortion(lens) for lens in distortion]
        if isinstance(distortion, list) else canonical_distortion(distortion)
    )
    background = values.get("background")
    values["background"] = (
        [_absolute(pipeline, value) for value in background]
        if isinstance(background, list) else _absolute(pipeline, background)
    )
    drawn = pipeline.distributions
    if "distance_m" not in drawn and "side_px" not in drawn:
        resolve_distance(values)
    jitter = np.asarray(values["jitter_px"], dtype=np.float64)
    values["shift_u_px"] = values["shift_v_px"] = 0.0
    noisy = any(name in drawn or is_on(name, values[name]) for name in RANDOM)
    if not drawn and not noisy and not (jitter > 0).any():
        return values
    keys = geometry_keys(values, drawn, count)
    for name, distribution in drawn.items():
        values[name] = distribution.at(uniform(pipeline.seed, name, keys, trials))
    if "side_px" in drawn:
        resolve_distance(values)
    if (jitter > 0).any():
        for name in ("shift_u_px", "shift_v_px"):
            draw = uniform(pipeline.seed, name, keys, trials)
            values[name] = jitter * (2 * draw - 1)
    if noisy:
        values["noise_key"] = bits(pipeline.seed, "noise", keys, trials)
    return values


def _absolute(pipeline: Pipeline, value: Any) -> Any:
    if not isinstance(value, str):
        return value
    return str((Path(pipeline.folder) / value).resolve())


def resolve_distance(values: dict[str, Any]) -> None:
    """Turn ``side_px`` into ``distance_m``: fx · size / side."""
    if values.get("side_px") is not None:
        fx = intrinsics(*(values[name] for name in VIEW_PARAMETERS))[0]
        values["distance_m"] = fx * values["size_m"] / values["side_px"]


def block_indices(block: Block) -> list[NDArray[np.intp]]:
    """Return the indices (N,) of a block's cells along each scene axis, the last fastest."""
    grids = np.meshgrid(
        *(np.arange(a, b) for a, b in zip(block.starts, block.stops, strict=True)), indexing="ij"
    )
    return [grid.ravel() for grid in grids]


def combinations(axes: Sequence[Axis]) -> list[dict[str, Any]]:
    """Return every combination of the axes' values, the last axis fastest."""
    return [
        dict(zip((axis.name for axis in axes), chosen, strict=True))
        for chosen in itertools.product(*(axis.values for axis in axes))
    ]


def _setting(pipeline: Pipeline, section: str, chosen: dict[str, Any]) -> dict[str, Any]:
    names = [p.name for p in PARAMETERS.values() if p.section == section]
    given = {name: pipeline.fixed.get(name, PARAMETERS[name].default) for name in names}
    return {**given, **chosen}


def detector_settings(pipeline: Pipeline) -> list[DetectorSetting]:
    """Return the detector settings of the grid, in the order of its detection axes."""
    return [
        DetectorSetting(**_setting(pipeline, "detector", chosen))
        for chosen in combinations(pipeline.axes_of(Stage.detection))
    ]


def estimators(pipeline: Pipeline) -> list[EstimatorSetting]:
    """Return the estimators of the grid, in the order of its estimation axes."""
    return [
        EstimatorSetting(**_setting(pipeline, "estimator", chosen))
        for chosen in combinations(pipeline.axes_of(Stage.estimation))
    ]
