"""The grid: the value, axis or distribution of every parameter; its blocks of scene cells."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.experiment.axes import Axis, Distribution, combinations
from sweep.experiment.parameters import (
    PHOTOGRAPHS,
    SIMULATED,
    STATED,
    Parameter,
    Stage,
    parameters_with,
)
from sweep.model.board_kinds import ARRANGING, SINGLE, Markers, arranged
from sweep.model.calibration import CalibrationError
from sweep.model.camera import VIEW_PARAMETERS, canonical_distortion, intrinsics
from sweep.plugins.declared import DeclaredPlugin

# --------------------------------------------------------------------------------------------------
# What a document and the pipeline that is read from it have in common: values on a grid.

@dataclass(frozen=True)
class Grid:
    """The value, the axis or the distribution of every parameter.

    Attributes
    ----------
    seed, sampling
        The seed of all random draws, and how those of a cell's trials relate
        (:data:`sweep.experiment.draws.SAMPLINGS`).
    fixed
        Value of every parameter that is neither an axis nor drawn.
    given
        Names of the parameters that the document has, even with a value that cannot be.
    distributions
        Distribution of every parameter that is drawn per trial.
    axes
        The grid's dimensions, in the document's order.
    plugins
        The plug-ins that the document names.
    files
        Path as written -> SHA-256 of every file that the document refers to.
    folder
        Where relative paths start.
    """

    seed: int
    sampling: str
    fixed: Mapping[str, Any]
    given: AbstractSet[str]
    distributions: dict[str, Distribution]
    axes: Sequence[Axis]
    plugins: tuple[DeclaredPlugin, ...]
    files: Mapping[str, str]
    folder: str

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """Every parameter by its name: our own, and the settings of its plug-ins."""
        return parameters_with(self.plugins)

    def plugin(self, kind: str, name: str) -> DeclaredPlugin | None:
        """Return the plug-in of a kind by its name; None if it is not one of the document's."""
        return next((p for p in self.plugins if (p.kind, p.name) == (kind, name)), None)

    def axis(self, name: str) -> Axis | None:
        """Return an axis by name."""
        return next((axis for axis in self.axes if axis.name == name), None)

    def axis_of(self, parameter: str) -> Axis | None:
        """Return the axis along which a parameter varies, alone or together with others."""
        return next((axis for axis in self.axes if parameter in axis.columns), None)

    def axes_of(self, *stages: Stage) -> tuple[Axis, ...]:
        """Return the axes that bind to the given stages, in the document's order."""
        return tuple(axis for axis in self.axes if axis.stage in stages)

    def size(self, *stages: Stage) -> int:
        """Return the number of grid points over the axes of the given stages."""
        return math.prod(len(axis) for axis in self.axes_of(*stages))

    def values_of(self, name: str) -> Sequence[Any]:
        """Return the values of a parameter on the grid; empty if it is drawn, or at fault."""
        axis = self.axis_of(name)
        if axis is not None:
            return axis.columns[name]
        return (self.fixed[name],) if name in self.fixed else ()

    def any_value(self, name: str, condition: Callable[[Any], bool]) -> bool:
        """Return whether a parameter takes a value for which ``condition`` holds."""
        return any(condition(value) for value in self.values_of(name) if value is not None)

    @property
    def calibration(self) -> CalibrationError | None:
        """The error of the calibration that an estimator believes; None if none does."""
        if "calibration" not in self.values_of("believed"):
            return None
        sd, covariance = (self.fixed[name] for name in STATED)
        count = len(sd) or round(len(covariance) ** 0.5)
        return CalibrationError.of(sd, covariance, count - 4)

    @property
    def view(self) -> tuple[float, ...] | None:
        """The numbers fx, fy, cx, cy of the camera, if there is a single one."""
        if any(name not in self.fixed for name in VIEW_PARAMETERS):
            return None
        return tuple(map(float, intrinsics(*(self.fixed[name] for name in VIEW_PARAMETERS))))

    @property
    def truth(self) -> dict[str, Any]:
        """The true value of each belief, None where it varies."""
        names = ("believed_fx_px", "believed_fy_px", "believed_cx_px", "believed_cy_px")
        lens = self.fixed.get("distortion")
        return {
            **dict(zip(names, self.view or (None,) * 4, strict=True)),
            "believed_focal_scale": 1.0,
            "believed_distortion": None if lens is None else canonical_distortion(lens),
            **{f"believed_{name}": self.fixed.get(name)
               for name in ("size_m", "blur_px", "noise_grey")},
        }

    def arrangements(self) -> Iterator[tuple[Any, ...]]:
        """Yield the values of `ARRANGING` of each combination of their axes."""
        axes = [axis for axis in self.axes if not axis.columns.keys().isdisjoint(ARRANGING)]
        for chosen in combinations(axes):
            yield tuple({**self.fixed, **chosen}[name] for name in ARRANGING)

    @property
    def shows_boards(self) -> bool:
        """Whether scenes show boards, or something beside a marker; all markers are boards then."""
        return any(self.values_of("distractors")) or self.any_value(
            "kind", lambda kind: kind != SINGLE)

    @property
    def target_word(self) -> str:
        """What the scenes show, in a word: marker, board, or target if both."""
        if not self.shows_boards:
            return "marker"
        return "target" if self.any_value("kind", lambda kind: kind == SINGLE) else "board"

    @cached_property
    def largest_board(self) -> tuple[int, int]:
        """The most markers and the most chessboard corners of a target."""
        if not self.shows_boards:
            return 1, 0
        markers, corners = zip(
            *(arranged(values).counts for values in self.arrangements()), strict=True)
        return max(markers), max(corners)

    @property
    def relative_sizes(self) -> tuple[float, float]:
        """The least and the largest side of a marker over ``size_m``: listed ones have own."""
        listed = [
            each.size_m / values[ARRANGING.index("size_m")]
            for values in self.arrangements()
            if isinstance(board := arranged(values), Markers) for each in board.markers
        ] if self.any_value("markers", bool) else []
        return min(listed, default=1.0), max(listed, default=1.0)

    @property
    def is_simulated(self) -> bool:
        """Whether images are simulated at the poses of photographs."""
        return self.fixed.get(SIMULATED) is True

    @property
    def shows_photographs(self) -> bool:
        """Whether the images are photographs, not simulated at their poses."""
        return PHOTOGRAPHS in self.given and not self.is_simulated


# --------------------------------------------------------------------------------------------------
# Pieces of the grid: blocks of scene cells, and every parameter's values on them.

@dataclass(frozen=True, slots=True, order=True)
class Block:
    """A box of scene cells: half-open index ranges along the scene axes, in their order.

    It identifies a piece of the grid in tasks, receipts, logs and errors.

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

    def indices(self, scenes: NDArray[np.intp] | None = None) -> list[NDArray[np.intp]]:
        """Return the indices (N,) along each scene axis of its scenes, by default of all.

        ``scenes`` (N,) are their numbers in the block, in which the last axis counts fastest.
        """
        numbers = np.arange(len(self)) if scenes is None else scenes
        within = np.unravel_index(numbers, self.shape) if self.shape else ()
        return [start + index for start, index in zip(self.starts, within, strict=True)]

    def cell(self, scene: int) -> tuple[int, ...]:
        """Return the indices of its scene number ``scene`` along each scene axis."""
        return tuple(int(index[0]) for index in self.indices(np.array([scene])))

    def __str__(self) -> str:
        pairs = zip(self.starts, self.stops, strict=True)
        return ",".join(f"{a}-{b}" for a, b in pairs) or "all"


@dataclass(frozen=True, slots=True)
class Blocks:
    """The grid of scene cells cut into equal boxes, which are made on demand."""

    lengths: tuple[int, ...]
    extents: tuple[int, ...]

    @property
    def counts(self) -> tuple[int, ...]:
        """Blocks along each scene axis."""
        return tuple(-(-a // b) for a, b in zip(self.lengths, self.extents, strict=True))

    def __len__(self) -> int:
        return math.prod(self.counts)

    def __iter__(self) -> Iterator[Block]:
        return (self[number] for number in range(len(self)))

    def __getitem__(self, number: int) -> Block:
        """Return a block by its number; the last axis counts fastest."""
        index = np.unravel_index(number, self.counts) if self.counts else ()
        starts = np.multiply(index, self.extents).astype(np.int64)
        stops = np.minimum(starts + self.extents, self.lengths)
        return Block(tuple(starts.tolist()), tuple(map(int, stops)))

    def number(self, block: Block) -> int:
        """Return the number of a block."""
        if not self.counts:
            return 0
        index = np.floor_divide(block.starts, self.extents)
        return int(np.ravel_multi_index(index.tolist(), self.counts))
