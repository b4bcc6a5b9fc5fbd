"""Cameras of photographs: from files, or calibrated from the photographs themselves."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sweep.errors import ArgumentError
from sweep.experiment.pipeline import file_and_camera
from sweep.measure import intrinsics
from sweep.measure.flags import CalibrationStatus
from sweep.messages import plain
from sweep.model.calibration import MAX_BYTES, Calibration, calibration_of, read_tree
from sweep.model.image_file import read_regular
from sweep.model.pose import rotation_of_vector
from sweep.photographs.board_view import FoundCorners
from sweep.photographs.pose_fit import Lens, fitted_board
from sweep.typing import Floats


class KnownCamera(NamedTuple):
    """A camera: its lens, the errors of its numbers as far as known, and a line on it.

    ``sd`` are their standard deviations, ``covariance`` (c, c) is None if it is not known.
    """

    lens: Lens
    sd: tuple[float, ...] = ()
    line: str = ""
    covariance: Floats | None = None


# --------------------------------------------------------------------------------------------------
# Cameras from files: one camera, or two with the pose of one to the other.

#: Largest deviation of RᵀR from the identity; files have few digits.
ORTHOGONAL = 1e-3


class StereoCamera(NamedTuple):
    """Two cameras: a point X in the left one's frame is ``rotation @ X + translation`` (m)."""

    left: Lens
    right: Lens
    rotation: Floats
    translation: Floats

    def swapped(self) -> StereoCamera:
        """Return the same with left and right exchanged."""
        back = self.rotation.T
        return StereoCamera(self.right, self.left, back, -back @ self.translation)


def camera_of_file(written: str, size: tuple[int, int] | None = None) -> Calibration:
    """Return the camera of ``FILE`` or ``FILE#NAME``, for photographs of a size in pixels.

    Raises
    ------
    ArgumentError
        If there is none, or it is of another frame size than given.
    """
    path, name = file_and_camera(written, lambda each: Path(each).is_file())
    with _reading("camera", written, "a camera file"):
        calibration = calibration_of(read_tree(read_regular(path, MAX_BYTES)), name)
    if size is not None:
        _check_size("camera", written, calibration, size)
    return calibration


def stereo_of_file(written: str, size: tuple[int, int]) -> tuple[StereoCamera, list[Calibration]]:
    """Return the two cameras of a file with K1, D1, K2, D2, R and T, as OpenCV names them.

    Raises
    ------
    ArgumentError
        If it is no such file, or of another frame size.
    """
    with _reading("stereo", written, "a file with K1, D1, K2, D2, R and T of two cameras"):
        tree = read_tree(read_regular(written, MAX_BYTES))
        cameras = [calibration_of(tree, name) for name in ("1", "2")]
        rotation = _numbers(tree, "R", 9, "the rotation").reshape(3, 3)
        translation = _numbers(tree, "T", 3, "the translation, in metres,")
        error = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
        if not error < ORTHOGONAL or np.linalg.det(rotation) < 0:
            raise ValueError("R: expected a rotation matrix")
    for each in cameras:
        _check_size("stereo", written, each, size)
    u, _, vt = np.linalg.svd(rotation)
    return StereoCamera(lens_of(cameras[0]), lens_of(cameras[1]), u @ vt, translation), cameras


def lens_of(calibration: Calibration) -> Lens:
    """Return the camera of a calibration."""
    return Lens.of(
        calibration.fx_px, calibration.fy_px, calibration.cx_px, calibration.cy_px,
        calibration.distortion,
    )


def known_camera(calibration: Calibration) -> KnownCamera:
    """Return the camera of a calibration, with the errors of its numbers as far as it has them."""
    covariance = None
    if calibration.covariance:
        count = math.isqrt(len(calibration.covariance))
        covariance = np.reshape(np.array(calibration.covariance), (count, count))
    return KnownCamera(lens_of(calibration), calibration.sd, covariance=covariance)


@contextlib.contextmanager
def _reading(argument: str, written: str, expected: str) -> Iterator[None]:
    """Turn errors of a file into those of the argument that names it."""
    try:
        yield
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ArgumentError(argument, plain(written), f"expected {expected} ({reason})") from None


def _numbers(tree: Any, name: str, count: int, meaning: str) -> Floats:
    """Return the numbers of a matrix in a file; raises ValueError if they are not there."""
    value = next((each for key, each in tree.items() if str(key).lower() == name.lower()), None)
    if isinstance(value, dict):
        value = value.get("data")
    with contextlib.suppress(TypeError, ValueError):
        numbers = np.array(value, dtype=np.float64).ravel()
        if len(numbers) == count and np.isfinite(numbers).all():
            return numbers
    raise ValueError(
        f"{name}: expected {count} numbers: {meaning} that takes points of the left camera's frame "
        "to the right one's"
    )


def _check_size(
    argument: str, written: str, calibration: Calibration, size: tuple[int, int]
) -> None:
    """Refuse the calibration of images of another size."""
    own, fault = (calibration.width_px, calibration.height_px), ""
    cx, cy = calibration.cx_px, calibration.cy_px
    if None not in own and own != size:
        turned = "; they are turned, perhaps by their EXIF tags" if own == size[::-1] else ""
        fault = (f"it holds for {own[0]} x {own[1]}, but the photographs are {size[0]} x {size[1]}"
                 f"{turned}")
    elif not (0 < cx < size[0] and 0 < cy < size[1]):
        fault = (f"its principal point ({cx:g}, {cy:g}) is outside the photographs of {size[0]} x "
                 f"{size[1]}")
    if fault:
        raise ArgumentError(
            argument, plain(written), f"{fault}; give the calibration of their size"
        )


# --------------------------------------------------------------------------------------------------
# Whether a camera's file is of the photographs' resolution, where it does not say.

#: RMS of a board's corners, in the median photograph, from which other resolutions are tried.
DOUBTFUL_PX = 0.5

#: Share of that RMS below which another resolution fits.
CLEARLY_BETTER = 0.5

#: Photographs with the most corners in which they are tried.
MAX_TRIED_VIEWS = 5

#: Resolutions of photographs over the resolution of a calibration.
SCALES = tuple(map(Fraction, ("1/4", "1/3", "1/2", "2/3", "3/4", "4/3", "3/2", "2", "3", "4")))


def check_resolution(
    written: str, lens: Lens, size: tuple[int, int], found: Sequence[FoundCorners], rms_px: float
) -> None:
    """Refuse a camera of a file that fits the board far better in another resolution.

    Parameters
    ----------
    written
        The file.
    lens, size
        The camera, and the photographs' width and height in px.
    found
        The board's corners in each photograph.
    rms_px
        Their RMS in the median photograph with this camera.

    Raises
    ------
    ArgumentError
        One line.
    """
    if rms_px < DOUBTFUL_PX:
        return
    best = sorted(found, key=lambda each: -len(each.points))[:MAX_TRIED_VIEWS]
    own = _median_rms(lens, best)
    fitting = {scale: _median_rms(scaled(lens, float(scale)), best) for scale in SCALES}
    scale = min(fitting, key=lambda each: fitting[each])
    if fitting[scale] < CLEARLY_BETTER * own:
        raise ArgumentError(
            "camera", plain(written),
            f"the board's corners are {own:.2g} px RMS beside it, and {fitting[scale]:.2g} px if "
            f"its numbers are times {scale}: it is of another resolution; give the calibration of "
            f"{size[0]} x {size[1]}",
        )


def scaled(lens: Lens, scale: float) -> Lens:
    """Return the camera of images that are ``scale`` times as large; pixels' edges lie at halves.

    >>> scaled(Lens.of(100.0, 100.0, 9.5, 7.5, ()), 2.0).matrix[0].tolist()
    [200.0, 0.0, 19.5]
    """
    matrix = lens.matrix.copy()
    matrix[:2] *= scale
    matrix[:2, 2] += (scale - 1.0) / 2.0
    return Lens(matrix, lens.distortion)


def _median_rms(lens: Lens, found: Sequence[FoundCorners]) -> float:
    fits = [fitted_board(lens, each) for each in found]
    return float(np.median([np.inf if fit is None else fit.rms_px for fit in fits]))


# --------------------------------------------------------------------------------------------------
# The camera from the photographs themselves.

#: Photographs with a board from which a camera is calibrated.
MIN_PHOTOGRAPHS = 4

#: Corners of a board in a photograph that is used.
MIN_CORNERS = 12

#: RMS of the corners beside the calibrated camera that is refused, in images of 800 px or less; in
#: larger ones it grows with the width.
MAX_RMS_PX = 2.0


def calibrate(size: tuple[int, int], found: Sequence[FoundCorners]) -> KnownCamera:
    """Calibrate a camera with five coefficients (:func:`sweep.measure.intrinsics.calibrate`).

    Parameters
    ----------
    size
        Width and height in pixels.
    found
        The board's corners in each photograph.

    Raises
    ------
    ArgumentError
        If too few photographs show enough of the board.
    """
    used = [each for each in found if len(each.points) >= MIN_CORNERS]
    made = intrinsics.calibrate(
        [each.points for each in used], [each.pixels for each in used], size
    )
    limit, fault = MAX_RMS_PX * max(1.0, size[0] / 800), ""
    if len(used) < MIN_PHOTOGRAPHS:
        fault = (
            f"expected {MIN_PHOTOGRAPHS} photographs with at least {MIN_CORNERS} corners of the "
            f"board, from different sides; there are {len(used)}; take more, or give the file of a "
            "calibration"
        )
    elif made.status != CalibrationStatus.calibrated:
        fault = (
            "OpenCV cannot calibrate from these photographs; take others, from different sides, or "
            "give the file of a calibration"
        )
    elif made.rms_px > limit:
        fault = (
            f"corners are {made.rms_px:.2g} px RMS beside the calibrated camera; expected at most "
            f"{limit:.2g} px: check the board's kind, that the print is flat, and that all "
            "photographs are of one camera at one focus"
        )
    if fault:
        raise ArgumentError("camera", "calibrate", fault)
    fx, fy, cx, cy, *distortion = made.values.tolist()
    lens = Lens.of(fx, fy, cx, cy, tuple(distortion))
    numbers = ", ".join(
        f"{name} {value:.1f} ± {sd:.1f}"
        for name, value, sd in zip(("fx", "fy", "cx", "cy"), made.values, made.std, strict=False)
    )
    line = (
        f"camera: calibrated from {made.views} photographs, {made.rms_px:.2f} px RMS: {numbers} px "
        "(standard deviations; truth_std has of them what truth and estimates do not share)"
    )
    covariance = _covariance(lens, [used[i] for i in made.used], made)
    return KnownCamera(lens, tuple(made.std.tolist()), line, covariance)


def _covariance(lens: Lens, used: Sequence[FoundCorners], made: intrinsics.Intrinsics) -> Floats:
    """Return the covariance (9, 9) of the camera's numbers beside the photographs' poses.

    By least squares with the residuals' variance: the inverse of the Schur complement of the
    poses in the normal equations, as of a bundle adjustment (Triggs et al., 2000, section 6.1).
    """
    numbers = len(intrinsics.INTRINSICS)
    information = np.zeros((numbers, numbers))
    squares, count = 0.0, 0
    rotations = rotation_of_vector(made.turns)
    for found, rotation, shift in zip(used, rotations, made.shifts, strict=True):
        image, pose, camera = lens.derivatives(found.points * [1.0, -1.0, -1.0], rotation, shift)
        cross = pose.T @ camera
        information += camera.T @ camera - cross.T @ np.linalg.solve(pose.T @ pose, cross)
        squares += float(((image - found.pixels) ** 2).sum())
        count += 2 * len(found.points) - 6
    scale = np.sqrt(np.diag(information))  # the numbers' units differ by many powers of ten
    inverse = np.linalg.pinv(information / np.outer(scale, scale), hermitian=True)
    return np.asarray(squares / max(count - numbers, 1) * inverse / np.outer(scale, scale))
