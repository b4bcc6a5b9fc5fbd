"""The schema of the dataset: one record a variable, from which everything else about it follows.

The evaluation fills it, the store is laid out by it, verification checks flags and tolerances by
it, analysis and report read by it.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np

from sweep.measure.flags import (
    BoundStatus,
    DetectionStatus,
    EstimateStatus,
    Flipped,
    TruthSource,
)
from sweep.plan.alternatives import PHOTOGRAPHS
from sweep.plan.boards import largest_board, shows_boards
from sweep.plan.coordinates import drawn_quantities
from sweep.plan.parameters import Stage
from sweep.plan.variable import (
    BOUND_RTOL,
    CORNER_ATOL_PX,
    ROTATION_ATOL_RAD,
    TRANSLATION_RTOL,
    TRUTH_RTOL,
    FlagRule,
    Tolerance,
    Variable,
)

if TYPE_CHECKING:
    from sweep.plan.experiment import Pipeline

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

_BOARD_MARKER = FlagRule("marker_detection", "always")

BOARD_SCHEMA: tuple[Variable, ...] = (
    Variable("board_marker_id", _S, "f4", "ID of each marker of the board", inner=("marker",),
             since_format=5),
    Variable("marker_detection", _D, "u1", "what became of each marker of the board",
             inner=("marker",), flags=DetectionStatus, tolerance=_EQUAL, since_format=5),
    Variable("marker_corner_error_px", _D, "f4", "found corner minus true corner, of each marker",
             "px", ("marker", "corner", "xy"), present_when=_BOARD_MARKER,
             tolerance=Tolerance("absolute", CORNER_ATOL_PX), since_format=5),
    Variable("chessboard_corner_error_px", _D, "f4",
             "interpolated corner of the chessboard minus true corner; NaN: not found", "px",
             ("chessboard_corner", "xy"), present_when=FlagRule("detection", "only"),
             tolerance=Tolerance("absolute", CORNER_ATOL_PX), since_format=5),
    Variable("point_count", _E, "f4", "points that the pose was estimated from",
             present_when=_POSE, since_format=5),
)
"""The variables that stores of boards have besides; those of :data:`NOT_OF_BOARDS` they lack."""

NOT_OF_BOARDS = frozenset({"corner_error_px"})

VARIABLES: dict[str, Variable] = {
    variable.name: variable for variable in (*SCHEMA, *BOARD_SCHEMA)
}
"""Every variable by its name, those of boards included."""


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
    common = schema_of(store_format)
    if shows_boards(pipeline):
        common = tuple(each for each in common if each.name not in NOT_OF_BOARDS)
        common += _board_variables(pipeline)
    return common + drawn + photographed


def _board_variables(pipeline: Pipeline) -> tuple[Variable, ...]:
    """Return the variables of a pipeline's boards, as long as its largest board."""
    markers, corners = largest_board(pipeline)
    lengths = (("marker", markers), ("chessboard_corner", corners))
    return tuple(
        dataclasses.replace(variable, lengths=lengths) for variable in BOARD_SCHEMA
        if corners or "chessboard_corner" not in variable.inner
    )


def bytes_per_block(pipeline: Pipeline, scenes: int) -> int:
    """Return the uncompressed bytes that ``scenes`` scene cells take in the store."""
    return scenes * sum(
        variable.configurations(pipeline)
        * math.prod(variable.inner_shape)
        * np.dtype(variable.dtype).itemsize
        for variable in variables_of(pipeline)
    )
