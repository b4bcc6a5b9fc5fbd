"""The schema of the dataset: one record a variable, from which everything else about it follows.

The evaluation fills it, the store is laid out by it, verification checks flags and tolerances by
it, analysis and report read by it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from sweep.measure.flags import (
    BoundStatus,
    DetectionStatus,
    EstimateStatus,
    Flag,
    Flipped,
    TruthSource,
)
from sweep.plan.alternatives import PHOTOGRAPHS
from sweep.plan.axes import Axis
from sweep.plan.coordinates import drawn_quantities
from sweep.plan.parameters import Stage

if TYPE_CHECKING:
    from sweep.plan.experiment import Pipeline

XYZ = ("x", "y", "z")
CORNERS = ("top_left", "top_right", "bottom_right", "bottom_left")

POSE_PARAMETERS = tuple(f"{part}_{axis}" for part in ("rotation", "translation") for axis in XYZ)

LABELS: dict[str, tuple[str, ...]] = {
    "corner": CORNERS, "xy": ("x", "y"), "xyz": XYZ, "pose_parameter": POSE_PARAMETERS,
}
"""Coordinates of the dimensions that are no axes."""


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

    Examples
    --------
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
        return tuple(len(LABELS[name]) for name in self.inner)

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


_S, _D, _E = Stage.scene, Stage.detection, Stage.estimation
_TRUTH = FlagRule("detection", "unless_lost")
_BOUND, _MAYBE_BOUND = FlagRule("bound", "always"), FlagRule("bound", "only")
_DETECTED = FlagRule("detection", "always")
_POSE, _MAYBE_POSE = FlagRule("estimate", "always"), FlagRule("estimate", "only")
_EQUAL = Tolerance("equal")
_ANGLE = Tolerance("absolute", math.degrees(ROTATION_ATOL_RAD))

SCHEMA: tuple[Variable, ...] = (
    Variable("true_rvec", _S, "f8", "true rotation vector, marker to camera", "radian", ("xyz",),
             present_when=_TRUTH, tolerance=Tolerance("length", TRUTH_RTOL)),
    Variable("true_tvec_m", _S, "f8", "true position of the marker's centre", "m", ("xyz",),
             present_when=_TRUTH, tolerance=Tolerance("length", TRUTH_RTOL)),
    Variable("marker_area_px", _S, "f8", "area of the projected black square", "px2",
             present_when=FlagRule("detection", "if_seen"),
             tolerance=Tolerance("relative", TRUTH_RTOL)),
    Variable("viewing_angle_deg", _S, "f8",
             "angle between the marker's normal and the line of sight to its centre", "degree",
             present_when=_TRUTH, tolerance=Tolerance("absolute", 180 * TRUTH_RTOL),
             since_format=5),
    Variable("bound", _S, "u1", "what became of the accuracy bound", flags=BoundStatus,
             tolerance=_EQUAL),
    Variable("bound_std", _S, "f4",
             "least standard deviation of an unbiased estimate, camera frame (Cramér-Rao)",
             "radian, m", ("pose_parameter",),
             present_when=_BOUND, tolerance=Tolerance("relative", BOUND_RTOL)),
    Variable("bound_kappa", _S, "f4",
             "bias of the depth from the bound's own spread of the tilt, in standard deviations",
             present_when=_BOUND, tolerance=Tolerance("relative", BOUND_RTOL)),
    Variable("mirror_distance", _S, "f4",
             "standard deviations between the pose and its mirrored minimum; NaN: there is none",
             present_when=_MAYBE_BOUND, tolerance=Tolerance("relative", BOUND_RTOL)),
    Variable("detection", _D, "u1", "what became of the marker", flags=DetectionStatus,
             tolerance=_EQUAL),
    Variable("corner_error_px", _D, "f4", "found corner minus true corner", "px",
             ("corner", "xy"),
             present_when=_DETECTED, tolerance=Tolerance("absolute", CORNER_ATOL_PX)),
    Variable("estimate", _E, "u1", "what became of the pose", flags=EstimateStatus,
             tolerance=_EQUAL),
    Variable("translation_error_m", _E, "f4", "estimated minus true, camera frame", "m",
             ("xyz",),
             present_when=_POSE, tolerance=Tolerance("distance", TRANSLATION_RTOL)),
    Variable("rotation_error_rad", _E, "f4",
             "rotation vector of estimated times true transposed, camera frame", "radian",
             ("xyz",),
             present_when=_POSE, tolerance=Tolerance("rotation", ROTATION_ATOL_RAD)),
    Variable("rotation_error_deg", _E, "f4", "angle of the rotation error", "degree",
             present_when=_POSE, tolerance=_ANGLE),
    Variable("normal_error_deg", _E, "f4", "angle between true and estimated normal", "degree",
             present_when=_POSE, tolerance=_ANGLE),
    Variable("reprojection_error_px", _E, "f4", "RMS over the corners", "px",
             present_when=_POSE, tolerance=Tolerance("absolute", CORNER_ATOL_PX)),
    Variable("alternative_rotation_error_deg", _E, "f4",
             "angle of the rotation error of the other planar solution", "degree",
             present_when=_MAYBE_POSE),
    Variable("alternative_reprojection_error_px", _E, "f4",
             "RMS over the corners of the other planar solution", "px",
             present_when=_MAYBE_POSE),
    Variable("predicted_std", _E, "f4",
             "standard deviation of the error that the estimator expects, camera frame",
             "radian, m", ("pose_parameter",), present_when=_MAYBE_POSE),
    Variable("nees", _E, "f4",
             "squared error in units of the expected covariance; its mean is 6 where that is true",
             present_when=_MAYBE_POSE),
    Variable("residual_variance_ratio", _E, "f4",
             "variance of the pixels' residuals over that of noise and rounding",
             present_when=_MAYBE_POSE),
    Variable("misfit_px", _E, "f4",
             "standard deviation of shifts of the marker's parts beside the fitted pose that the "
             "residuals of photometric_real show", "px", present_when=_MAYBE_POSE,
             since_format=5),
    Variable("flipped", _E, "u1", "whether the solution is nearer to the mirror of the truth",
             flags=Flipped),
)
"""Every variable, in the order in which the stages make them."""

VARIABLES: dict[str, Variable] = {variable.name: variable for variable in SCHEMA}
"""Every variable by its name."""


PHOTOGRAPH_SCHEMA: tuple[Variable, ...] = (
    Variable("side_px", _S, "f8", "side of the black square if it were parallel to the image plane",
             "px", present_when=_TRUTH, tolerance=Tolerance("relative", TRUTH_RTOL),
             since_format=5, drawn_as="side_px"),
    Variable("distance_m", _S, "f8", "depth of the marker's centre along the optical axis", "m",
             present_when=_TRUTH, tolerance=Tolerance("relative", TRUTH_RTOL), since_format=5,
             drawn_as="distance_m"),
    Variable("tilt_deg", _S, "f8", "angle between the marker's plane and the image plane", "degree",
             present_when=_TRUTH, tolerance=Tolerance("absolute", 180 * TRUTH_RTOL),
             since_format=5, drawn_as="tilt_deg"),
    Variable("image_x_px", _S, "f8", "image of the marker's centre, x", "px", present_when=_TRUTH,
             tolerance=Tolerance("absolute", 1e-6), since_format=5, drawn_as="image_x_px"),
    Variable("image_y_px", _S, "f8", "image of the marker's centre, y", "px", present_when=_TRUTH,
             tolerance=Tolerance("absolute", 1e-6), since_format=5, drawn_as="image_y_px"),
    Variable("truth", _S, "u1", "origin of the true pose", flags=TruthSource, tolerance=_EQUAL,
             since_format=5),
    Variable("truth_std", _S, "f4",
             "standard deviation of the true pose, as far as it is known; camera frame",
             "radian, m", ("pose_parameter",),
             tolerance=Tolerance("relative", 1e-6), since_format=5),
)
"""The variables that stores of photographs have besides."""

DRAWN_FORMAT = 5
"""The store format from which on drawn quantities are variables."""


def schema_of(store_format: float) -> tuple[Variable, ...]:
    """Return the variables that every store of a format has.

    >>> schema_of(2)[0].name
    'true_rvec'
    """
    return tuple(variable for variable in SCHEMA if variable.since_format <= store_format)


def drawn_variables(pipeline: Pipeline) -> tuple[Variable, ...]:
    """Return the variables that hold what is drawn for each scene of a pipeline."""
    return tuple(
        Variable(
            drawn.name, Stage.scene, "f8", drawn.meaning, drawn.unit, present_when=_TRUTH,
            tolerance=(
                Tolerance("absolute", TRUTH_RTOL * drawn.scale) if drawn.scale
                else Tolerance("relative", TRUTH_RTOL)
            ),
            since_format=DRAWN_FORMAT, drawn_as=drawn.column,
        )
        for drawn in drawn_quantities(pipeline)
    )


def variables_of(pipeline: Pipeline, store_format: float = math.inf) -> tuple[Variable, ...]:
    """Return the variables that a pipeline's store of a format has: the schema's, then draws.

    >>> from sweep.plan.experiment import Pipeline
    >>> pipeline = Pipeline.from_dict({"pose": {"distance_m": 1, "jitter_px": 0.5}})
    >>> [variable.name for variable in variables_of(pipeline)[-2:]]
    ['jitter_u_px', 'jitter_v_px']
    """
    drawn = drawn_variables(pipeline) if store_format >= DRAWN_FORMAT else ()
    photographed = PHOTOGRAPH_SCHEMA if PHOTOGRAPHS in pipeline.given else ()
    return schema_of(store_format) + drawn + photographed


def bytes_per_block(pipeline: Pipeline, scenes: int) -> int:
    """Return the uncompressed bytes that ``scenes`` scene cells take in the store."""
    return scenes * sum(
        variable.configurations(pipeline)
        * math.prod(variable.inner_shape)
        * np.dtype(variable.dtype).itemsize
        for variable in variables_of(pipeline)
    )
