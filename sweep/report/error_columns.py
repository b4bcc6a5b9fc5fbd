"""Columns of rates and errors that several figures' tables share, and the curves of errors."""

from __future__ import annotations

from sweep.report.curve import Curve

Columns = dict[str, tuple[str, float]]
"""Heading -> variable of an analysis, and the factor that it is multiplied by."""

LOOKED_FOR: Columns = {"looked for": ("looked_for", 1.0)}
RATES: Columns = LOOKED_FOR | {"detected, %": ("detection_rate", 100.0)}
ERRORS: Columns = {
    "solved, %": ("solved_rate", 100.0),
    "rotation median, deg": ("rotation_median_deg", 1.0),
    "rotation p95, deg": ("rotation_p95_deg", 1.0),
    "rotation RMSE without flips, deg": ("rotation_rmse_unflipped_deg", 1.0),
    "range median, %": ("range_median_percent", 1.0),
    "range p95, %": ("range_p95_percent", 1.0),
    "range RMSE without flips, %": ("range_rmse_unflipped_percent", 1.0),
    "range bias, %": ("range_bias_percent", 1.0),
}
SIGNED_GROUPS = ("range", "camera_frame", "yaw_pitch_roll")
"""Kinds of errors, as `sweep.analysis.error_statistics` takes them."""

IN_MM, IN_DEG = ("x", "y", "z"), ("yaw", "pitch", "roll")
SIGNED: Columns = {"solved": ("solved", 1.0)} | {
    f"{name} {words}, {unit}": (f"{name}_{statistic}_{stored}", scale)
    for names, unit, stored, scale in ((IN_MM, "mm", "m", 1000.0), (IN_DEG, "deg", "deg", 1.0))
    for name in names for words, statistic in (("bias", "bias"), ("SD", "sd"))
}
"""Bias and standard deviation along the camera's axes and about the angles."""

DETECTED = Curve("detection_rate", "Detected", "%", 100.0, share=True)
ERROR_CURVES = (
    Curve("rotation_median_deg", "Rotation error, median", "deg"),
    Curve("rotation_p95_deg", "Rotation error, p95", "deg"),
    Curve("range_median_percent", "Range error, median", "%"),
    Curve("range_p95_percent", "Range error, p95", "%"),
)
RANGE_BIAS = Curve("range_bias_percent", "Range bias", "%", signed=True)
SIGNED_CURVES = (
    RANGE_BIAS,
    *(Curve(f"{name}_bias_m", f"{name} bias", "mm", 1000.0, signed=True) for name in IN_MM),
    Curve("yaw_bias_deg", "Yaw bias", "deg", signed=True),
)
INFINITE_ERRORS = (
    "In median and p95 a pose that is not solved counts as an infinite error (drawn at the edge); "
    "an interval that reaches the edge ends beyond all draws."
)
"""Sentence of captions."""
