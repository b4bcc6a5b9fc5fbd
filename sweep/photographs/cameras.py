"""Cameras of photographs, from files or calibrated from them; and poses of what they see."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from sweep.errors import ArgumentError
from sweep.experiment.pipeline import file_and_camera
from sweep.measure import intrinsics
from sweep.measure.flags import CalibrationStatus
from sweep.measure.solver import GuardedPoints
from sweep.messages import plain
from sweep.model.calibration import MAX_BYTES, VIEW, Calibration, calibration_of, read_tree
from sweep.model.camera import Cameras
from sweep.model.image_file import read_regular
from sweep.model.lens import pack
from sweep.model.pose import rotation_of_vector
from sweep.photographs.folder import FoundCorners
from sweep.typing import Floats, Masks

# --------------------------------------------------------------------------------------------------
# A camera, which is a calibration, as OpenCV and as solvers take it.

def derivatives(
    camera: Calibration, points: Floats, rotation: Floats, translation: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return images (n, 2) of points, with derivatives by the pose (2 n, 6) and camera (2 n, c).

    The pose changes by a rotation vector in the camera's frame, about the target's origin, and by
    a translation. The derivative by a point in the camera's frame is OpenCV's by the translation.
    The camera's numbers are fx, fy, cx, cy and the coefficients. Points are (n, 3) of a target.
    """
    turned, none = points @ rotation.T, np.zeros(3)
    image, jacobian = cv2.projectPoints(
        np.ascontiguousarray(turned + translation), none, none, cameras_of(camera, 1).matrix(0),
        np.array(camera.distortion) if camera.distortion else None,
    )
    slopes = np.asarray(jacobian, dtype=np.float64)
    by_point = slopes[:, 3:6].reshape(-1, 2, 3)
    by_turn = np.cross(turned[:, None, :], by_point)
    return (
        np.asarray(image, dtype=np.float64).reshape(-1, 2),
        np.concatenate([by_turn, by_point], axis=2).reshape(-1, 6),
        slopes[:, 6 : 10 + len(camera.distortion)],
    )


def cameras_of(camera: Calibration, count: int) -> Cameras:
    """Return ``count`` equal cameras as solvers take them."""
    view, packed = np.array([getattr(camera, name) for name in VIEW]), pack(camera.distortion)
    return Cameras(
        np.repeat(view[None], count, axis=0), np.repeat(packed[None], count, axis=0),
        np.full(count, bool(packed[:14].any())),
    )


# --------------------------------------------------------------------------------------------------
# The pose of a rigid target from many points: least squares, with its covariance.

MAX_STEPS = 20

#: Step, in rad and in shares of the distance, below which the iteration ends.
CONVERGED = 1e-9

#: Residuals beyond this many robust standard deviations are left out.
OUTLIER = 4.0

MIN_OUTLIER_PX = 0.5

#: Corners of a board, without the marker's own, from which its pose is taken for known.
MIN_CORNERS = 6


class FittedPose(NamedTuple):
    """A fitted pose.

    Attributes
    ----------
    rotation, translation
        (3, 3) and (3,) m, target to camera.
    covariance
        (6, 6) rotation vector in the camera's frame (rad), position (m): from the residuals'
        variance, as if they were independent.
    residuals
        (n, 2) px of all points.
    used
        (n,) which points are no outliers.
    shift_px
        By how much the edges of black squares lie outwards.
    """

    rotation: Floats
    translation: Floats
    covariance: Floats
    residuals: Floats
    used: Masks
    shift_px: float

    @property
    def rms_px(self) -> float:
        """Root mean square of the used residuals' lengths."""
        return float(np.sqrt((self.residuals[self.used] ** 2).sum(axis=1).mean()))


def fit_pose(
    camera: Calibration, points: Floats, pixels: Floats, rotation: Floats, translation: Floats,
    used: Masks | None = None, outward: Floats | None = None,
) -> FittedPose | None:
    """Return the pose of least squares from a start; None without 4 points, or if it diverges.

    Gauss-Newton steps in the camera's frame: a rotation vector, as OpenCV's functions have it, is
    singular at the half turn of a board that faces the camera. Without ``used`` outliers are left
    out: those beyond :data:`OUTLIER` robust standard deviations, in two rounds.

    Parameters
    ----------
    camera
        The camera.
    points, pixels
        (n, 3) m and (n, 2) px.
    rotation, translation
        The start.
    used
        (n,) the points to use.
    outward
        (n, 2) px by which the points move if edges move outwards by 1 px: that shift is fitted, too
        (:class:`sweep.photographs.folder.FoundCorners`).
    """
    if used is None:
        used = np.ones(len(points), dtype=bool)
        for _ in range(2):
            pose = fit_pose(camera, points, pixels, rotation, translation, used, outward)
            if pose is None:
                return None
            rotation, translation = pose.rotation, pose.translation
            length = np.linalg.norm(pose.residuals, axis=1)
            # The median length of a two-dimensional normal residual is 1.177 standard deviations.
            spread = float(np.median(length)) / 1.177
            used = length <= max(OUTLIER * spread, MIN_OUTLIER_PX)
    if used.sum() < 4:
        return None
    for _ in range(MAX_STEPS):
        image, design, _ = derivatives(camera, points[used], rotation, translation)
        if outward is not None:
            design = np.column_stack([design, outward[used].ravel()])
        residual = (pixels[used] - image).ravel()
        if not (np.isfinite(design).all() and np.isfinite(residual).all()):
            return None
        step = np.asarray(np.linalg.lstsq(design, residual, rcond=None)[0], dtype=np.float64)
        rotation = rotation_of_vector(step[None, :3])[0] @ rotation
        translation = translation + step[3:6]
        if not translation[2] > 0:
            return None
        moved = np.linalg.norm(step[3:6]) / np.linalg.norm(translation)
        if np.linalg.norm(step[:3]) < CONVERGED and moved < CONVERGED:
            normal, left = design.T @ design, residual - design @ step
            if np.linalg.cond(normal) > 1e18:
                return None
            variance = float(left @ left) / max(len(left) - len(step), 1)
            covariance = np.asarray(variance * np.linalg.inv(normal)[:6, :6], dtype=np.float64)
            residuals = derivatives(camera, points, rotation, translation)[0] - pixels
            shift_px = 0.0 if outward is None else float(step[6])
            residuals += shift_px * (0.0 if outward is None else outward)
            return FittedPose(rotation, translation, covariance, residuals, used, shift_px)
    return None


def fitted_board(camera: Calibration, found: FoundCorners) -> FittedPose | None:
    """Return a board's pose; None with too few corners."""
    if len(found.points) < MIN_CORNERS:
        return None
    guard = GuardedPoints.of(found.points, found.pixels, cameras_of(camera, 1))
    fits = [fit_pose(camera, found.points, found.pixels, *start, outward=found.outward)
            for start in guard.poses(cv2.SOLVEPNP_IPPE)]
    good = [fit for fit in fits if fit is not None and fit.used.sum() >= MIN_CORNERS]
    return min(good, key=lambda fit: float(np.median((fit.residuals**2).sum(axis=1))), default=None)


#: Rounds of a calibration and of the shifts of edges beside it, which take up little of each other.
CALIBRATIONS = 3


def unshifted(camera: Calibration, found: FoundCorners) -> FoundCorners:
    """Return a board's corners in a photograph without the shift of edges beside its pose.

    Cameras blur light before they make levels of it, so that black looks smaller, and ink spreads.
    Each marker is smaller then, around its own centre, as no pose or camera has it. In rendered
    photographs of a grid edges were shifted by 0.3 px, by gamma, denoising, sharpening and JPEG.
    """
    if found.outward is None or (pose := fitted_board(camera, found)) is None:
        return found
    return found._replace(pixels=found.pixels - pose.shift_px * found.outward)


# --------------------------------------------------------------------------------------------------
# Cameras from files: one camera, or two with the pose of one to the other.

#: Largest deviation of R from a rotation matrix; files have few digits.
ORTHOGONAL = 5e-4


class StereoCamera(NamedTuple):
    """Two cameras: a point X in the left one's frame is ``rotation @ X + translation`` (m)."""

    left: Calibration
    right: Calibration
    rotation: Floats
    translation: Floats


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
        check_size("camera", written, calibration, size)
    return calibration


def stereo_of_file(written: str, size: tuple[int, int]) -> StereoCamera:
    """Return the two cameras of a file with K1, D1, K2, D2, R and T, as OpenCV names them.

    Raises
    ------
    ArgumentError
        If it is no such file, or of another frame size.
    """
    with _reading("stereo", written, "a file with K1, D1, K2, D2, R and T of two cameras"):
        tree = read_tree(read_regular(written, MAX_BYTES))
        left, right = (calibration_of(tree, name) for name in ("1", "2"))
        rotation, translation = (_numbers(tree, *each) for each in (("R", (3, 3)), ("T", (3,))))
        u, _, vt = np.linalg.svd(rotation)
        nearest = np.asarray(u @ vt)
        if np.abs(rotation - nearest).max() > ORTHOGONAL or np.linalg.det(nearest) < 0:
            raise ValueError("R: expected a rotation matrix")
    for each in (left, right):
        check_size("stereo", written, each, size)
    return StereoCamera(left, right, nearest, translation)


def covariance_of(calibration: Calibration) -> Floats | None:
    """Return the covariance (c, c) of a camera's numbers, fx, fy, cx, cy and coefficients first.

    None if it is not known.
    """
    count = math.isqrt(len(calibration.covariance))
    return np.reshape(calibration.covariance, (count, count)) if count else None


@contextlib.contextmanager
def _reading(argument: str, written: str, expected: str) -> Iterator[None]:
    """Turn errors of a file into those of the argument that names it."""
    try:
        yield
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ArgumentError(argument, plain(written), f"expected {expected} ({reason})") from None


def _numbers(tree: Any, name: str, shape: tuple[int, ...]) -> Floats:
    """Return the numbers of a matrix in a file; raises ValueError if they are not there."""
    value = {str(key).upper(): each for key, each in tree.items()}.get(name)
    data = value.get("data") if isinstance(value, dict) else value
    with contextlib.suppress(TypeError, ValueError):
        numbers = np.array(data, dtype=np.float64).reshape(shape)
        if np.isfinite(numbers).all():
            return numbers
    raise ValueError(
        f"{name}: expected {math.prod(shape)} numbers: R and T, in metres, take points of the left "
        "camera's frame to the right one's"
    )


def check_size(
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

#: Resolutions of photographs over the resolution of a calibration.
SCALES = tuple(map(Fraction, ("1/4", "1/3", "1/2", "2/3", "3/4", "4/3", "3/2", "2", "3", "4")))


def check_resolution(
    written: str, camera: Calibration, size: tuple[int, int], found: Sequence[FoundCorners],
    rms_px: float,
) -> None:
    """Refuse a file's camera that fits the board badly, or far better in another resolution.

    Parameters
    ----------
    written
        The file.
    camera, size
        The camera, and the photographs' width and height in px.
    found
        The board's corners in each photograph.
    rms_px
        Their RMS in the median photograph with this camera; NaN if it is not known.

    Raises
    ------
    ArgumentError
        One line.
    """
    fault = _rms_fault(rms_px, size)
    if rms_px >= DOUBTFUL_PX:
        least, scale = min(
            (_median_rms(scaled(camera, float(each)), found[:: 1 + len(found) // 20]), each)
            for each in SCALES)
        if least < CLEARLY_BETTER * rms_px:
            fault = (
                f"the board's corners are {rms_px:.2g} px RMS beside it, and {least:.2g} px if its "
                f"numbers are times {scale}: it is of another resolution; give the calibration of "
                f"{size[0]} x {size[1]}"
            )
    if fault:
        raise ArgumentError("camera", plain(written), fault)


def scaled(camera: Calibration, scale: float) -> Calibration:
    """Return the camera of images that are ``scale`` times as large; pixels' edges lie at halves.

    >>> scaled(Calibration(20, 16, 100.0, 100.0, 9.5, 7.5, (), (), ()), 2.0).cx_px
    19.5
    """
    shift = (scale - 1.0) / 2.0
    return replace(
        camera, fx_px=scale * camera.fx_px, fy_px=scale * camera.fy_px,
        cx_px=scale * camera.cx_px + shift, cy_px=scale * camera.cy_px + shift,
    )


def _median_rms(camera: Calibration, found: Sequence[FoundCorners]) -> float:
    fits = [fitted_board(camera, each) for each in found]
    return float(np.median([np.inf if fit is None else fit.rms_px for fit in fits]))


# --------------------------------------------------------------------------------------------------
# The camera from the photographs themselves.

#: Photographs with a board from which a camera is calibrated.
MIN_PHOTOGRAPHS = 4

#: Corners of a board in a photograph from which a camera is calibrated.
MIN_CALIBRATING = 12

#: RMS of the corners beside the calibrated camera that is refused, in images of 800 px or less; in
#: larger ones it grows with the width.
MAX_RMS_PX = 2.0


def calibrate(size: tuple[int, int], found: Sequence[FoundCorners]) -> tuple[Calibration, str]:
    """Return a camera with five coefficients, and a line (:mod:`sweep.measure.intrinsics`).

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
    used = [each for each in found if len(each.points) >= MIN_CALIBRATING]
    made = intrinsics.calibrate(
        [each.points for each in used], [each.pixels for each in used], size
    )
    fault = _rms_fault(made.rms_px, size)
    if len(used) < MIN_PHOTOGRAPHS:
        fault = (
            f"expected {MIN_PHOTOGRAPHS} photographs with at least {MIN_CALIBRATING} corners of "
            f"the board, from different sides; there are {len(used)}; take more, or give the file "
            "of a calibration"
        )
    elif made.status != CalibrationStatus.calibrated:
        fault = (
            "OpenCV cannot calibrate from these photographs; take others, from different sides, or "
            "give the file of a calibration"
        )
    if fault:
        raise ArgumentError("camera", "calibrate", fault)
    fx, fy, cx, cy, *distortion = made.values.tolist()
    camera = Calibration(*size, fx, fy, cx, cy, tuple(distortion), tuple(made.std.tolist()), ())
    numbers = ", ".join(
        f"{name} {value:.1f} ± {sd:.1f}"
        for name, value, sd in zip(("fx", "fy", "cx", "cy"), made.values, made.std, strict=False)
    )
    line = (
        f"camera: calibrated from {made.views} photographs, {made.rms_px:.2f} px RMS: {numbers} px "
        "(standard deviations; truth_std has of them what truth and estimates do not share)"
    )
    covariance = _covariance(camera, [used[i] for i in made.used], made)
    return replace(camera, covariance=tuple(covariance.ravel().tolist())), line


def _rms_fault(rms_px: float, size: tuple[int, int]) -> str:
    """Return the fault of a camera beside which a board's corners have that RMS, or none."""
    limit = MAX_RMS_PX * max(1.0, size[0] / 800)
    return "" if not rms_px > limit else (
        f"corners are {rms_px:.2g} px RMS beside the camera; expected at most {limit:.2g} px: "
        "check the board's kind, that it is flat, and that all photographs are of this camera"
    )


def _covariance(
    camera: Calibration, used: Sequence[FoundCorners], made: intrinsics.Intrinsics
) -> Floats:
    """Return the covariance (9, 9) of the camera's numbers beside the photographs' poses.

    By least squares with the residuals' variance: the inverse of the Schur complement of the
    poses in the normal equations, as of a bundle adjustment (Triggs et al., 2000, section 6.1).
    """
    numbers = len(intrinsics.INTRINSICS)
    information = np.zeros((numbers, numbers))
    squares, count = 0.0, 0
    rotations = rotation_of_vector(made.turns)
    for found, rotation, shift in zip(used, rotations, made.shifts, strict=True):
        image, by_pose, by_camera = derivatives(
            camera, found.points * [1.0, -1.0, -1.0], rotation, shift
        )
        cross = by_pose.T @ by_camera
        pose = np.linalg.solve(by_pose.T @ by_pose, cross)
        information += by_camera.T @ by_camera - cross.T @ pose
        squares += float(((image - found.pixels) ** 2).sum())
        count += 2 * len(found.points) - 6
    scale = np.sqrt(np.diag(information))  # the numbers' units differ by many powers of ten
    inverse = np.linalg.pinv(information / np.outer(scale, scale), hermitian=True)
    return np.asarray(squares / max(count - numbers, 1) * inverse / np.outer(scale, scale))
