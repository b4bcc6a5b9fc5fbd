"""What the dataset knows of one variable, and the dimensions that are no axes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from sweep.measure.flags import DetectionStatus, Flag
from sweep.plan.axes import Axis
from sweep.plan.parameters import Stage

if TYPE_CHECKING:
    from sweep.plan.experiment import Pipeline

XYZ = ("x", "y", "z")
CORNERS = ("top_left", "top_right", "bottom_right", "bottom_left")

POSE_PARAMETERS = tuple(f"{part}_{axis}" for part in ("rotation", "translation") for axis in XYZ)

LABELS: dict[str, tuple[str, ...]] = {
    "corner": CORNERS, "xy": ("x", "y"), "xyz": XYZ, "pose_parameter": POSE_PARAMETERS,
    "marker": (), "chessboard_corner": (),
}
"""Coordinates of the dimensions that are no axes; of boards' they are numbers, from 0 on."""


def cf_attributes(
    meaning: str, units: str = "", flags: type[IntEnum] | None = None
) -> dict[str, Any]:
    """Return the attributes of a variable, after the CF conventions.

    `sweep.plan.attributes.with_description` gives it a short ``long_name`` for readers.
    """
    attributes: dict[str, Any] = {"long_name": meaning}
    if units:
        attributes["units"] = units
    if flags is not None:
        attributes["flag_values"] = [int(flag) for flag in flags]
        attributes["flag_meanings"] = " ".join(flag.name for flag in flags)
    return attributes


@dataclass(frozen=True, slots=True)
class FlagRule:
    """Where a flag variable demands or forbids the numbers of another variable.

    Attributes
    ----------
    flag
        Name of the flag variable. "Present" below means that its flag says that the numbers of
        its stage exist.
    number
        "always": a number wherever the flag is present, NaN elsewhere; "only": NaN wherever the
        flag is not present; "unless_lost": a number unless every flag of the scene is in
        :data:`LOST`; "if_seen": a number unless every flag of the scene is in :data:`UNSEEN`.
    """

    flag: str
    number: Literal["always", "only", "unless_lost", "if_seen"]


@dataclass(frozen=True, slots=True)
class Tolerance:
    """How far a recomputation on another processor may lie from a stored value.

    On a processor with the same features every bit agrees. The limits were measured on 9,000
    scenes with AVX-512, AVX2 and all of AVX switched off in turn.

    Attributes
    ----------
    kind
        "equal": no difference; "absolute": of each number; "relative": of each number;
        "length": of each component, relative to the stored vector's norm; "distance": norm of
        the difference, relative to the marker's true distance; "rotation": angle in radians
        between the two rotation vectors' rotations.
    limit
        The largest difference, in the variable's unit where ``kind`` is "absolute".
    """

    kind: Literal["equal", "absolute", "relative", "length", "distance", "rotation"]
    limit: float = 0.0


LOST = (
    DetectionStatus.failed, DetectionStatus.crashed, DetectionStatus.not_needed,
    DetectionStatus.not_in_photograph,
)
"""Detections of a scene for which not even the truth may be known."""

UNSEEN = (*LOST, DetectionStatus.not_visible)
"""Detections of a scene in which a corner may be behind the camera: the marker has no image."""

TRUTH_RTOL = 1e-12
"""Of the true pose (relative to its length) and of the marker's area."""

BOUND_RTOL = 1e-6
"""Of the accuracy bound's numbers: they pass through the inverse of a 6 x 6 matrix."""

CORNER_ATOL_PX = 1e-2
"""Of corners and of the reprojection error."""

ROTATION_ATOL_RAD = 1e-4
"""Also, in degrees, of the angles that follow from the rotation: they change by no more."""

TRANSLATION_RTOL = 1e-4
"""Relative to the marker's distance."""


@dataclass(frozen=True, slots=True)
class Variable:
    """One variable of the dataset: the record from which everything else about it follows.

    Attributes
    ----------
    name
        Its name in the dataset.
    stage
        The stage that makes it. It has the axes of this stage and of those before.
    dtype
        NumPy's type string, as stored.
    meaning, units
        What it means (``description``), and its ``units``.
    inner
        Names of its dimensions beside the axes: keys of :data:`LABELS`.
    flags
        The flags that it takes its values from; None for a number.
    present_when
        The flag variable that says where its number exists; None where none does.
    tolerance
        How far another processor may lie from its stored value; None if it is not compared there.
        No scene may lie outside the tolerance of a scene's variable, few may outside the others'.
    since_format
        The store format that introduced it: stores of an older format do not have it.
    drawn_as
        Name among the scene's values of the drawn quantity that it holds; such a variable is a
        coordinate of the dataset. Empty for what is computed.
    lengths
        Length of each inner dimension without labels, which differs from pipeline to pipeline.

    Examples
    --------
    >>> from sweep.plan.schema import VARIABLES
    >>> variable = VARIABLES["corner_error_px"]
    >>> variable.stage.name, variable.inner_shape, variable.units
    ('detection', (4, 2), 'px')
    """

    name: str
    stage: Stage
    dtype: str
    meaning: str
    units: str = ""
    inner: tuple[str, ...] = ()
    flags: type[Flag] | None = None
    present_when: FlagRule | None = None
    tolerance: Tolerance | None = None
    since_format: int = 2
    drawn_as: str = ""
    lengths: tuple[tuple[str, int], ...] = ()

    @property
    def fill(self) -> float | int:
        """The value of cells that were not computed: NaN, or the flag ``not_run``."""
        return 0 if self.flags is not None else float("nan")

    @property
    def not_needed(self) -> float | int:
        """The value of cells that were not needed: NaN, or the flag ``not_needed``."""
        if self.flags is None:
            return self.fill
        return int(getattr(self.flags, "not_needed", self.fill))

    @property
    def inner_shape(self) -> tuple[int, ...]:
        """Lengths of the inner dimensions."""
        lengths = dict(self.lengths)
        return tuple(lengths.get(name, len(LABELS[name])) for name in self.inner)

    def fitted(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return another store's values (..., inner) cut or filled to this one's inner lengths.

        A store's boards have as many markers as the largest of its grid: what is cut or filled
        lies beyond the boards of the cells that two grids share.
        """
        lengths = self.inner_shape
        cut: list[Any] = [..., *(slice(length) for length in lengths)]
        kept: NDArray[Any] = values[tuple(cut)]
        outer = kept.ndim - len(lengths)
        missing = [a - b for a, b in zip(lengths, kept.shape[outer:], strict=True)]
        if not any(missing):
            return kept
        beyond = DetectionStatus.not_on_board if self.flags is DetectionStatus else math.nan
        widths = [(0, 0)] * outer + [(0, each) for each in missing]
        return np.pad(kept, widths, constant_values=beyond)

    def configuration_axes(self, pipeline: Pipeline) -> tuple[Axis, ...]:
        """Return the axes of detection and estimation that it has, stage by stage.

        They span its configurations, the last axis fastest; a scene's variable has none.
        """
        stages = [stage for stage in Stage if Stage.scene < stage <= self.stage]
        return tuple(axis for stage in stages for axis in pipeline.axes_of(stage))

    def configurations(self, pipeline: Pipeline) -> int:
        """Return the number of its configurations: one for a scene's variable."""
        return math.prod(len(axis) for axis in self.configuration_axes(pipeline))

    def axes(self, pipeline: Pipeline) -> tuple[Axis, ...]:
        """Return its axes in the pipeline's order: those of its stage and of the stages before."""
        return pipeline.axes_of(*(stage for stage in Stage if stage <= self.stage))

    def dimensions(self, pipeline: Pipeline) -> tuple[str, ...]:
        """Return the names of its dimensions: its axes, then ``inner``."""
        return tuple(axis.name for axis in self.axes(pipeline)) + self.inner

    def shape(self, pipeline: Pipeline) -> tuple[int, ...]:
        """Return the lengths of its dimensions."""
        return tuple(len(axis) for axis in self.axes(pipeline)) + self.inner_shape

    def attributes(self) -> dict[str, Any]:
        """Return its attributes, after the CF conventions."""
        return cf_attributes(self.meaning, self.units, self.flags)
