"""Cameras in the files of calibration programs: OpenCV, ROS, Kalibr, PhotonVision.

All of them put pixel (0, 0) at the centre of the top left pixel and have OpenCV's lens model
(Kalibr's and ROS's names for it: radtan, plumb_bob, rational_polynomial).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from sweep.messages import nearest, plain
from sweep.model.lens import COUNTS

MATRIX_NAMES = (
    "cameramatrix", "intrinsicmatrix", "cameraintrinsics", "intrinsics", "k", "m", "mtx",
)
DISTORTION_NAMES = (
    "distortioncoefficients", "distortioncoeffs", "distcoeffs", "distcoeff", "distortion", "dist",
    "d",
)
SIZE_NAMES = ("imagesize", "resolution", "imgsize", "framesize", "calibrationsize")
SD_NAMES = ("stddeviationsintrinsics", "stddevintrinsics", "stddevsintrinsics")
COVARIANCE_NAMES = ("covarianceintrinsics", "intrinsicscovariance")
"""Names are compared without case and without what is no letter or digit."""

MODEL_COUNTS = {
    "plumbbob": (0, 4, 5), "radtan": (0, 4), "radialtangential": (0, 4), "none": (0,),
    "rationalpolynomial": (0, 4, 5, 8, 12, 14), "brownconrady": (0, 4, 5), "": COUNTS,
    "lensmodelpinhole": (0,), "lensmodelopencv": COUNTS, "lensmodelopencv4": (4,),
    "lensmodelopencv5": (5,), "lensmodelopencv8": (8,), "lensmodelopencv12": (12,),
}
"""Lens model -> the numbers of coefficients that it may have; other models are refused."""

KINDS = (
    "a file of OpenCV's FileStorage (camera_matrix, distortion_coefficients, image_width, "
    "image_height), ROS (camera_info), Kalibr (camchain) or PhotonVision"
)


@dataclass(frozen=True, slots=True)
class Calibration:
    """What a file says of a camera.

    Attributes
    ----------
    width_px, height_px
        The frame that it holds for; None if the file does not say.
    fx_px, fy_px, cx_px, cy_px
        Focal lengths and principal point.
    distortion
        Coefficients in OpenCV's order.
    sd
        Standard deviations of fx, fy, cx, cy (px) and of the coefficients; empty if not given.
    covariance
        Their covariance matrix, row by row; empty if not given.
    """

    width_px: int | None
    height_px: int | None
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...]
    sd: tuple[float, ...]
    covariance: tuple[float, ...]


def calibration_of(tree: Any, camera: str = "") -> Calibration:
    """Return the camera of a file's tree; ``camera`` is the name of one of several.

    Raises
    ------
    ValueError
        Why there is none, in words that follow the file's name and a colon.
    """
    cameras = _cameras(tree)
    if not cameras:
        raise ValueError(f"not a camera file: it has no camera matrix; expected {KINDS}")
    if camera and camera not in cameras:
        known = [name for name in cameras if name]
        raise ValueError(
            f"no camera {plain(camera)}{nearest(camera, known)}"
            + (f"; it has {', '.join(map(plain, known))}" if known else "; it has one, no name")
        )
    if not camera and len(cameras) > 1:
        names = [plain(name) for name in cameras]
        raise ValueError(
            f"{len(names)} cameras: {', '.join(names[:9])}; name one, as in FILE#{names[0]}"
        )
    return _calibration(cameras[camera or next(iter(cameras))])


def _normal(name: object) -> str:
    return re.sub("[^a-z0-9]", "", str(name).lower())


def _cameras(tree: Any) -> dict[str, dict[str, Any]]:
    """Return the cameras of a tree by name; the name of a single one may be empty."""
    if not isinstance(tree, dict):
        return {}
    if isinstance(listed := tree.get("calibrations"), list):  # PhotonVision's settings
        cameras: dict[str, dict[str, Any]] = {}
        for node in listed:
            if isinstance(node, dict) and _has_matrix(node):
                width, height = _size(_by_name(node))
                name = f"{width}x{height}"
                if name in cameras and _calibration(cameras[name]) != _calibration(node):
                    raise ValueError(f"two calibrations of {name} that differ; delete one of them")
                cameras[name] = node
        return cameras
    if _has_matrix(tree):
        return {"": tree}
    numbered: dict[str, dict[str, Any]] = {}
    rest = {}
    for name, value in tree.items():
        match = re.fullmatch(r"(.*?[A-Za-z])_?([0-9]{1,2})", str(name))
        if match and _normal(match[1]) in (*MATRIX_NAMES, *DISTORTION_NAMES) and (
            isinstance(value, (list, dict))  # a single number k1 is a lens coefficient
        ):
            numbered.setdefault(match[2], {})[match[1]] = value
        else:
            rest[name] = value
    numbered = {name: {**rest, **node} for name, node in numbered.items() if _has_matrix(node)}
    return numbered or {
        str(name): node for name, node in tree.items()
        if isinstance(node, dict) and _has_matrix(node)
    }


def _by_name(node: dict[str, Any]) -> dict[str, tuple[str, Any]]:
    """Return normalised name -> name as written, value."""
    return {_normal(name): (str(name), value) for name, value in node.items()}


def _has_matrix(node: dict[str, Any]) -> bool:
    return not _by_name(node).keys().isdisjoint(MATRIX_NAMES)


def _first(named: dict[str, tuple[str, Any]], names: tuple[str, ...]) -> tuple[str, Any] | None:
    return next((named[name] for name in names if name in named), None)


def _demand_one(named: dict[str, tuple[str, Any]], names: tuple[str, ...]) -> None:
    """Refuse a camera that has other numbers under another of its names."""
    written = [named[name] for name in names if name in named]
    for name, value in written[1:]:
        if _numbers(name, value)[0] != _numbers(*written[0])[0]:
            raise ValueError(
                f"{plain(written[0][0])} and {plain(name)} differ: delete one of them from the file"
            )


def _calibration(node: dict[str, Any]) -> Calibration:
    named = _by_name(node)
    counts = _check_model(named)
    _check_region(named)
    found = _first(named, MATRIX_NAMES)
    if found is None:
        raise AssertionError(sorted(named))
    _demand_one(named, MATRIX_NAMES)
    fx, fy, cx, cy = _matrix(*found)
    lens = _first(named, DISTORTION_NAMES)
    _demand_one(named, DISTORTION_NAMES)
    if lens is None and counts != (0,):
        raise ValueError(
            "no distortion coefficients (distortion_coefficients, distCoeffs, D; an empty list "
            "if there is none)"
        )
    distortion = () if lens is None else _distortion(*lens, counts)
    width, height = _size(named)
    count = 4 + len(distortion)
    sd = _first(named, SD_NAMES)
    covariance = _first(named, COVARIANCE_NAMES)
    return Calibration(
        width, height, fx, fy, cx, cy, distortion,
        () if sd is None else _deviations(*sd, count),
        () if covariance is None else _covariance(*covariance, count),
    )


def _check_model(named: dict[str, tuple[str, Any]]) -> tuple[int, ...]:
    """Return the numbers of coefficients of the file's lens model; ValueError for other models."""
    camera = _normal(named.get("cameramodel", ("", "pinhole"))[1])
    if "xi" in named or camera not in ("pinhole", ""):
        name = named.get("cameramodel", ("", "omnidirectional (xi)"))[1]
        raise ValueError(f"camera model {plain(name)}: not supported, only pinhole cameras are")
    fisheye = named.get("fisheyemodel", ("", "0"))[1]
    if str(fisheye).lower() not in ("0", "false", "no", ""):
        raise ValueError("a fisheye model: not supported, only OpenCV's pinhole lens model is")
    counts: tuple[int, ...] = COUNTS
    for key in ("distortionmodel", "lensmodel", "distortiontype"):
        if key not in named:
            continue
        model = named[key][1]
        if _normal(model) not in MODEL_COUNTS:
            raise ValueError(
                f"lens model {plain(model)}: not supported; only OpenCV's is (plumb_bob, "
                "rational_polynomial, radtan, none)"
            )
        counts = MODEL_COUNTS[_normal(model)]
    return counts


def _check_region(named: dict[str, tuple[str, Any]]) -> None:
    """Refuse the matrix of a frame of which only a part, or sums of pixels, are sent (ROS)."""
    for key in ("binningx", "binningy"):
        if key in named and _number(*named[key]) > 1:
            name, value = named[key]
            raise ValueError(
                f"{name} = {plain(value)}: the matrix is that of the frame without binning; give "
                "the calibration of the frame as it is sent"
            )
    region = named.get("roi", ("", None))[1]
    if isinstance(region, dict):
        for name in ("x_offset", "y_offset"):
            if _number(name, region.get(name, 0)) != 0:
                raise ValueError(
                    f"roi with {name} = {plain(region[name])}: the matrix is that of the whole "
                    "frame; give the calibration of the frame as it is sent"
                )
        for name, whole in zip(("width", "height"), _size(named), strict=True):
            if _number(name, region.get(name, 0)) not in (0, whole):
                raise ValueError(
                    f"roi with {name} = {plain(region[name])}: the matrix is that of the whole "
                    "frame; give the calibration of the frame as it is sent"
                )


def _number(name: str, value: Any) -> float:
    """Return a finite number; ValueError if the value is none."""
    number = math.nan
    if isinstance(value, str) and "_" not in value:
        try:
            number = float(value)
        except ValueError:
            raise ValueError(f"{plain(name)}: {plain(value)} is not a number") from None
    elif isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e300:
        number = float(value)
    if not abs(number) < 1e300:
        raise ValueError(f"{plain(name)}: {plain(value)} is not a finite number")
    return number


def _numbers(name: str, value: Any) -> tuple[list[float], tuple[int, int] | None]:
    """Return a list's or a matrix' numbers, row by row, and its shape if it has one."""
    shape = None
    single = False
    if isinstance(value, dict):
        if "data" not in value:
            raise ValueError(f"{plain(name)}: a matrix without data")
        if "rows" in value and "cols" in value:
            rows, columns = (_number(f"{name}.{key}", value[key]) for key in ("rows", "cols"))
            shape = int(rows), int(columns)
        single = value.get("dt") == "f"
        value = value["data"]
    if isinstance(value, str) and value.startswith("$base64$"):
        raise ValueError(f"{plain(name)}: base64; write the file with numbers")
    if isinstance(value, str):
        value = value.split()
    if value is None:
        value = []
    if not isinstance(value, list):
        value = [value]
    if value and all(isinstance(row, list) for row in value):
        if len({len(row) for row in value}) != 1:
            raise ValueError(f"{plain(name)}: rows of unequal lengths")
        shape = len(value), len(value[0])
        value = [number for row in value for number in row]
    if len(value) > 1000:
        raise ValueError(f"{plain(name)}: {len(value):,} numbers are too many")
    numbers = [_number(name, each) for each in value]
    if shape is not None and shape[0] * shape[1] != len(numbers):
        raise ValueError(
            f"{plain(name)}: {shape[0]} x {shape[1]}, but {len(numbers)} numbers; is it cut short?"
        )
    if single:
        # Digits enough for single precision stand for a number of single precision.
        numbers = [float(np.float32(number)) for number in numbers]
    return numbers, shape


def _matrix(name: str, value: Any) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy of a camera matrix, or of Kalibr's list of the four."""
    numbers, shape = _numbers(name, value)
    if len(numbers) == 4 and _normal(name) == "intrinsics" and shape is None:
        fx, fy, cx, cy = numbers
    elif len(numbers) == 9 and shape in (None, (3, 3)):
        if not any(numbers):
            raise ValueError(f"{plain(name)}: a matrix of zeros: the camera was not calibrated")
        fx, skew, cx, below, fy, cy = numbers[:6]
        if numbers[6:] != [0, 0, 1]:
            raise ValueError(f"{plain(name)}: expected 0, 0, 1 as the last row of a camera matrix")
        if skew != 0 or below != 0:
            raise ValueError(f"{plain(name)}: a skew of {skew or below:g} is not supported")
    else:
        raise ValueError(f"{plain(name)}: {len(numbers)} numbers; expected a matrix of 3 x 3")
    if not (fx > 0 and fy > 0):
        raise ValueError(f"{plain(name)}: focal lengths {fx:g} and {fy:g}; expected above 0")
    return fx, fy, cx, cy


def _distortion(name: str, value: Any, counts: tuple[int, ...]) -> tuple[float, ...]:
    numbers, shape = _numbers(name, value)
    if shape is not None and 1 not in shape and numbers:
        raise ValueError(f"{plain(name)}: {shape[0]} x {shape[1]}; expected a row or a column")
    if len(numbers) not in (counts if any(numbers) else COUNTS):
        raise ValueError(
            f"{plain(name)}: {len(numbers)} coefficients; expected "
            f"{' or '.join(str(count) for count in counts)} of this lens model"
        )
    return tuple(numbers)


def _size(named: dict[str, tuple[str, Any]]) -> tuple[int | None, int | None]:
    """Return the frame's width and height; None if the file does not say."""
    for width, height in (("imagewidth", "imageheight"), ("width", "height")):
        if width in named and height in named:
            return _whole(*named[width]), _whole(*named[height])
    found = _first(named, SIZE_NAMES)
    if found is None:
        return None, None
    name, value = found
    if isinstance(value, dict):
        return _size(_by_name(value))
    if isinstance(value, str):
        value = re.split("[x, ]+", value.strip("[]() "))
    numbers, _ = _numbers(name, value)
    if len(numbers) != 2:
        raise ValueError(f"{plain(name)}: {len(numbers)} numbers; expected width and height")
    return _whole(name, numbers[0]), _whole(name, numbers[1])


def _whole(name: str, value: Any) -> int:
    number = _number(name, value)
    if number != int(number) or not 1 <= number <= 100_000:
        raise ValueError(f"{plain(name)}: {number:g}; expected whole pixels, from 1 to 100000")
    return int(number)


def _deviations(name: str, value: Any, count: int) -> tuple[float, ...]:
    """Return the first ``count`` standard deviations of OpenCV's list of up to 18."""
    numbers, _ = _numbers(name, value)
    if len(numbers) < count or any(numbers[count:]):
        raise ValueError(
            f"{plain(name)}: {len(numbers)} numbers; expected {count}: of fx, fy, cx, cy and each "
            "coefficient"
        )
    if min(numbers) < 0:
        raise ValueError(f"{plain(name)}: a standard deviation below 0")
    return tuple(numbers[:count])


def _covariance(name: str, value: Any, count: int) -> tuple[float, ...]:
    """Return the leading ``count`` x ``count`` numbers of a covariance matrix."""
    numbers, _ = _numbers(name, value)
    side = math.isqrt(len(numbers))
    if side * side != len(numbers) or side < count:
        raise ValueError(
            f"{plain(name)}: {len(numbers)} numbers; expected {count} x {count}: of fx, fy, cx, "
            "cy and each coefficient"
        )
    return tuple(np.reshape(numbers, (side, side))[:count, :count].ravel().tolist())
