"""The dataset template: each variable's name, stage, dimensions, type, units and flags.

The only schema: the kernel fills it, the store is laid out by it, analysis reads by it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np

from sweep.measure.bound import BoundStatus
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped
from sweep.plan.experiment import Pipeline
from sweep.plan.parameters import Stage

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
    """Return the attributes of a variable, after the CF conventions."""
    attributes: dict[str, Any] = {"long_name": meaning}
    if units:
        attributes["units"] = units
    if flags is not None:
        attributes["flag_values"] = [int(flag) for flag in flags]
        attributes["flag_meanings"] = " ".join(flag.name for flag in flags)
    return attributes


@dataclass(frozen=True, slots=True)
class Variable:
    """One variable of the dataset; ``inner`` are its dimensions beside the axes."""

    name: str
    stage: Stage
    dtype: str
    meaning: str
    units: str = ""
    inner: tuple[str, ...] = ()
    flags: type[IntEnum] | None = field(default=None)

    @property
    def fill(self) -> float | int:
        """The value of what was not computed: NaN, or the flag not_run."""
        return 0 if self.flags is not None else float("nan")

    @property
    def inner_shape(self) -> tuple[int, ...]:
        """Lengths of the inner dimensions."""
        return tuple(len(LABELS[name]) for name in self.inner)

    def dimensions(self, pipeline: Pipeline) -> tuple[str, ...]:
        """Return the names of its dimensions: the axes of its stage and before, then inner."""
        stages = [stage for stage in Stage if stage <= self.stage]
        return tuple(axis.name for axis in pipeline.axes_of(*stages)) + self.inner

    def shape(self, pipeline: Pipeline) -> tuple[int, ...]:
        """Return the lengths of its dimensions."""
        stages = [stage for stage in Stage if stage <= self.stage]
        return tuple(len(axis) for axis in pipeline.axes_of(*stages)) + self.inner_shape

    def attributes(self) -> dict[str, Any]:
        """Return its attributes."""
        return cf_attributes(self.meaning, self.units, self.flags)


_S, _D, _E = Stage.scene, Stage.detection, Stage.estimation

SCHEMA: tuple[Variable, ...] = (
    Variable("true_rvec", _S, "f8", "true rotation vector, marker to camera", "radian", ("xyz",)),
    Variable("true_tvec_m", _S, "f8", "true position of the marker's centre", "m", ("xyz",)),
    Variable("marker_area_px", _S, "f8", "area of the projected black square", "px2"),
    Variable("bound", _S, "u1", "what became of the accuracy bound", flags=BoundStatus),
    Variable("bound_std", _S, "f4",
             "least standard deviation of an unbiased estimate, camera frame (Cramér-Rao)",
             "radian, m", ("pose_parameter",)),
    Variable("bound_kappa", _S, "f4",
             "bias of the depth from the bound's own spread of the tilt, in standard deviations"),
    Variable("mirror_distance", _S, "f4",
             "standard deviations between the pose and its mirrored minimum; NaN: there is none"),
    Variable("detection", _D, "u1", "what became of the marker", flags=DetectionStatus),
    Variable("corner_error_px", _D, "f4", "found corner minus true corner", "px",
             ("corner", "xy")),
    Variable("estimate", _E, "u1", "what became of the pose", flags=EstimateStatus),
    Variable("translation_error_m", _E, "f4", "estimated minus true, camera frame", "m",
             ("xyz",)),
    Variable("rotation_error_rad", _E, "f4",
             "rotation vector of estimated times true transposed, camera frame", "radian",
             ("xyz",)),
    Variable("rotation_error_deg", _E, "f4", "angle of the rotation error", "degree"),
    Variable("normal_error_deg", _E, "f4", "angle between true and estimated normal", "degree"),
    Variable("reprojection_error_px", _E, "f4", "RMS over the corners", "px"),
    Variable("alternative_rotation_error_deg", _E, "f4",
             "angle of the rotation error of the other planar solution", "degree"),
    Variable("alternative_reprojection_error_px", _E, "f4",
             "RMS over the corners of the other planar solution", "px"),
    Variable("predicted_std", _E, "f4",
             "standard deviation of the error that the estimator expects, camera frame",
             "radian, m", ("pose_parameter",)),
    Variable("nees", _E, "f4",
             "squared error in units of the expected covariance; its mean is 6 where that is true"),
    Variable("residual_variance_ratio", _E, "f4",
             "variance of the pixels' residuals over that of noise and rounding"),
    Variable("flipped", _E, "u1", "whether the solution is nearer to the mirror of the truth",
             flags=Flipped),
)
"""Every variable, in the order in which the stages make them."""


def bytes_per_block(pipeline: Pipeline, scenes: int) -> int:
    """Return the uncompressed bytes that ``scenes`` scene cells take in the store."""
    total = 0
    inner = {
        _S: 1,
        _D: pipeline.size(Stage.detection),
        _E: pipeline.size(Stage.detection, Stage.estimation),
    }
    for variable in SCHEMA:
        cells = inner[variable.stage] * int(np.prod(variable.inner_shape, dtype=np.int64))
        total += cells * np.dtype(variable.dtype).itemsize
    return total * scenes
