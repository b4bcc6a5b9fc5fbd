"""What estimators believe of the camera: rules across the keys, and draws of a calibration."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from sweep.experiment.axes import MAX_DEVIATIONS, Distribution
from sweep.experiment.reader import Reading
from sweep.model.calibration import CalibrationError
from sweep.model.camera import VIEW_PARAMETERS, Column, intrinsics
from sweep.typing import Floats

OWN_BELIEFS = (
    "believed_fx_px", "believed_fy_px", "believed_cx_px", "believed_cy_px",
    "believed_focal_scale", "believed_distortion",
)
"""Beliefs about what a calibration determines."""

STATED = ("calibration_sd", "calibration_covariance")

CALIBRATED = "calibrated_"
"""Begins the names of numbers that a calibration gives, among a scene's values."""

NORMAL = Distribution("normal", 0.0, 1.0)


def believed_calibration(
    fixed: Mapping[str, Any], believed: Sequence[Any]
) -> CalibrationError | None:
    """Return the error of the calibration that an estimator believes; None if none does.

    Parameters
    ----------
    fixed
        A checked pipeline's fixed values.
    believed
        The values of its parameter ``believed``.
    """
    if "calibration" not in believed:
        return None
    sd, covariance = (fixed[name] for name in STATED)
    n = len(sd) or round(len(covariance) ** 0.5)
    return CalibrationError.of(sd, covariance, n - 4)


def calibrated_columns(
    error: CalibrationError, values: Mapping[str, Column], count: int,
    draw: Callable[[str], Floats],
) -> dict[str, Column]:
    """Return the numbers that a calibration gives of each scene's camera.

    Parameters
    ----------
    error
        The calibration's error.
    values
        The values of ``count`` scenes.
    draw
        Name of a quantity -> uniform numbers (count,) in (0, 1).
    """
    view = intrinsics(*(values[name].values for name in VIEW_PARAMETERS))
    lenses = np.zeros((count, len(error.names) - len(view)))
    for row, lens in enumerate(values["distortion"].listed(count) if lenses.size else ()):
        lenses[row, : len(lens)] = lens
    truth = [np.array(np.broadcast_to(number, (count,)), dtype=np.float64) for number in view]
    normals = [NORMAL.at(draw(CALIBRATED + name)) for name in error.names]
    numbers = error.believed([*truth, *lenses.T], normals)
    return {
        CALIBRATED + name: Column.of(number)
        for name, number in zip(error.names, numbers, strict=True)
    }


def beliefs_in_one_way(reading: Reading) -> None:
    """Demand beliefs that do not contradict each other, and a calibration where one is believed."""
    known = _calibration_is_sound(reading)
    if "calibration" not in reading.values_of("believed"):
        return
    if known and not any(reading.fixed[name] for name in STATED):
        where = "camera_file has none" if reading.fixed.get("camera_file") else "or a camera_file"
        reading.refuse(
            "believed", f"a calibration's standard deviations: give calibration_sd under [camera] "
            f"({where})")
    for name in OWN_BELIEFS:
        if name in reading.given:
            reading.refuse(name, "no other belief about the camera beside believed = calibration; "
                           "delete one of them")


def _calibration_is_sound(reading: Reading) -> bool:
    """Note what is wrong with standard deviations or covariance; return whether nothing is."""
    def fault(name: str, expected: str) -> bool:
        reading.refuse(name, expected)
        return False

    if any(name in reading.given and name not in reading.fixed for name in STATED):
        for name in STATED:
            if reading.axis_of(name) is not None:
                return fault(name, "one list of numbers, not an axis")
        return False
    sd, covariance = (reading.fixed[name] for name in STATED)
    if sd and covariance:
        return fault("calibration_sd", "calibration_sd or calibration_covariance, not both; delete "
                     "one of them")
    if not sd and not covariance:
        return True
    name = STATED[0] if sd else STATED[1]
    try:
        errors = [
            CalibrationError.of(sd, covariance, count)
            for count in {len(lens) for lens in reading.values_of("distortion")}
        ]
    except ValueError as error:
        return fault(name, str(error))
    values = [reading.values_of(parameter) for parameter in VIEW_PARAMETERS]
    if not errors or not all(map(len, values)):
        return False
    least = intrinsics(*map(_with_least_focal_length, VIEW_PARAMETERS, values))
    for focal, length in zip(("fx_px", "fy_px"), least, strict=False):
        if not float(length) > MAX_DEVIATIONS * errors[0].sd(focal):
            return fault(
                name, f"focal lengths with standard deviations below 1/{MAX_DEVIATIONS} of them, "
                f"here {float(length) / MAX_DEVIATIONS:.4g} px",
            )
    return True


def _with_least_focal_length(parameter: str, values: Sequence[Any]) -> Any:
    """Return the value of a camera's parameter on the grid at which focal lengths are least."""
    if values[0] is None:
        return None
    grows = parameter in ("width_px", "height_px", "focal_length_mm", "fx_px", "fy_px")
    return min(values) if grows else max(values)


def belief_notes(
    given: frozenset[str] | set[str], fixed: Mapping[str, Any], believed: Sequence[Any]
) -> list[str]:
    """Return a line for each belief that may surprise (arguments as a pipeline has them)."""
    lines = [
        f"believed_{own}_px alone: the {other} believed stays the true one; believed_focal_scale "
        "is a focal length believed wrongly"
        for own, other in (("fx", "fy"), ("fy", "fx"))
        if f"believed_{own}_px" in given and f"believed_{other}_px" not in given
    ]
    lines += [
        f"{name} has no effect: no estimator has believed = calibration" for name in STATED
        if name in given and "calibration" not in believed and fixed.get("camera_file") is None
    ]
    if "calibration" in believed and fixed["calibration_sd"]:
        lines.append(
            "the calibration's numbers are drawn independently of each other; those of most "
            "calibrations, fx and fy above all, vary together, which calibration_covariance states"
        )
    return lines
