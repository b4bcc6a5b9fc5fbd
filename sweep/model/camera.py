"""The camera: pinhole intrinsics, a lens, and the projection of points in space."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled
from sweep.declaration import parameter
from sweep.model import lens
from sweep.model.projection import Optics

BELIEF_COUNTS = tuple(4 + count for count in lens.COUNTS)
"""Numbers that a calibration estimates: fx, fy, cx, cy and the lens coefficients."""

DEFAULT_SENSOR_MM = (4.8, 3.6)
"""Width and height of the sensor where the pipeline gives neither."""


@dataclass(frozen=True, slots=True)
class Camera:
    """A camera's parameters: focal lengths in pixels, a field of view, or millimetres.

    Pixels are square unless both sides of the sensor, or ``fx_px`` and ``fy_px``, are given.
    """

    width_px: int = parameter(640, "width of the frame", unit="px", low=1, high=100_000)
    height_px: int = parameter(480, "height of the frame", unit="px", low=1, high=100_000)
    sensor_width_mm: float | None = parameter(
        None, "width of the sensor's active area (default: 4.8, or with sensor_height_mm what "
        "makes the pixels square)", unit="mm", low=1e-6, high=1e6,
    )
    sensor_height_mm: float | None = parameter(
        None, "height of the sensor's active area (default: what makes the pixels square)",
        unit="mm", low=1e-6, high=1e6,
    )
    focal_length_mm: float = parameter(
        4.0, "focal length of the lens", unit="mm", low=1e-6, high=1e6
    )
    pixel_size_um: float | None = parameter(
        None, "side of a square pixel; with focal_length_mm, replaces the sensor's sides",
        unit="um", low=0.05, high=1e4,
    )
    hfov_deg: float | None = parameter(
        None, "horizontal field of view between the frame's edges, without lens distortion: "
        "2 atan(width_px / (2 fx)); replaces focal lengths and the sensor's sides",
        unit="degree", low=1e-5, high=179.9,
    )
    vfov_deg: float | None = parameter(
        None, "vertical field of view: 2 atan(height_px / (2 fy)); as hfov_deg",
        unit="degree", low=1e-5, high=179.9,
    )
    dfov_deg: float | None = parameter(
        None, "diagonal field of view between the frame's opposite corners, in square pixels: "
        "2 atan(hypot(width_px, height_px) / (2 fx)); as hfov_deg",
        unit="degree", low=1e-5, high=179.9,
    )
    fx_px: float | None = parameter(
        None, "focal length along x; replaces the parameters in mm", unit="px", low=1e-3,
        high=1e9,
    )
    fy_px: float | None = parameter(
        None, "focal length along y (default: fx_px)", unit="px", low=1e-3, high=1e9
    )
    cx_px: float | None = parameter(
        None, "principal point, x (default: (width_px - 1) / 2)", unit="px", low=-1e9, high=1e9
    )
    cy_px: float | None = parameter(
        None, "principal point, y (default: (height_px - 1) / 2)", unit="px", low=-1e9, high=1e9
    )
    distortion: tuple[float, ...] = parameter(
        (), "lens coefficients in OpenCV's order: 0, 4, 5, 8, 12 or 14 numbers",
        lengths=lens.COUNTS,
    )
    camera_file: str | None = parameter(
        None, "a calibration's file (OpenCV, ROS camera_info, Kalibr camchain, PhotonVision; path "
        "relative to the pipeline file): frame size, focal lengths, principal point, distortion; "
        "FILE#NAME names one of several cameras",
    )
    calibration_sd: tuple[float, ...] = parameter(
        (), "standard deviations of a calibration: of fx, fy, cx, cy in px and of each coefficient "
        "of distortion, for believed = calibration (default: those of camera_file)",
        lengths=tuple(sorted({0, *BELIEF_COUNTS})),
    )
    calibration_covariance: tuple[float, ...] = parameter(
        (), "in place of calibration_sd: the covariance matrix of the same numbers, row by row",
        lengths=tuple(sorted({0, *(count**2 for count in BELIEF_COUNTS)})),
    )


VIEW_PARAMETERS = (
    "width_px", "height_px", "sensor_width_mm", "sensor_height_mm", "focal_length_mm", "fx_px",
    "fy_px", "cx_px", "cy_px", "hfov_deg", "vfov_deg", "pixel_size_um", "dfov_deg",
)
"""The arguments of :func:`intrinsics`, in order."""

SQUARE_RTOL = 1e-12
"""Focal lengths that differ by less, relatively, are those of square pixels."""


def intrinsics(
    width_px: Any,
    height_px: Any,
    sensor_width_mm: Any,
    sensor_height_mm: Any,
    focal_length_mm: Any,
    fx_px: Any,
    fy_px: Any,
    cx_px: Any,
    cy_px: Any,
    hfov_deg: Any = None,
    vfov_deg: Any = None,
    pixel_size_um: Any = None,
    dfov_deg: Any = None,
) -> tuple[Any, Any, Any, Any]:
    """Return fx, fy, cx, cy in pixels (numbers or arrays, as the arguments of :class:`Camera`)."""
    if fx_px is not None:
        fx = fx_px
        fy = fx_px if fy_px is None else fy_px
    elif hfov_deg is not None:
        fx = fy = width_px / (2 * np.tan(np.radians(hfov_deg) / 2))
    elif vfov_deg is not None:
        fx = fy = height_px / (2 * np.tan(np.radians(vfov_deg) / 2))
    elif dfov_deg is not None:
        fx = fy = np.hypot(width_px, height_px) / (2 * np.tan(np.radians(dfov_deg) / 2))
    elif pixel_size_um is not None:
        fx = fy = 1e3 * focal_length_mm / pixel_size_um
    else:
        fx, fy = _of_sensor(
            width_px, height_px, sensor_width_mm, sensor_height_mm, focal_length_mm
        )
    cx = (width_px - 1) / 2 if cx_px is None else cx_px
    cy = (height_px - 1) / 2 if cy_px is None else cy_px
    return fx, fy, cx, cy


def _of_sensor(
    width_px: Any, height_px: Any, sensor_width_mm: Any, sensor_height_mm: Any,
    focal_length_mm: Any,
) -> tuple[Any, Any]:
    """Return fx and fy of a lens before a sensor; square pixels if one of its sides is missing.

    Where the default side makes them square, it is used: the bits are those of the side given.
    """
    width, height = DEFAULT_SENSOR_MM
    fx = focal_length_mm / (width if sensor_width_mm is None else sensor_width_mm) * width_px
    fy = focal_length_mm / (height if sensor_height_mm is None else sensor_height_mm) * height_px
    if sensor_width_mm is not None and sensor_height_mm is not None:
        return fx, fy
    known = fx if sensor_height_mm is None else fy
    square = are_square(fx, fy)
    # Exact: what is added is a difference of almost equal numbers, or 0.
    return known + (fx - known) * square, known + (fy - known) * square


def are_square(fx: Any, fy: Any) -> Any:
    """Return whether pixels are square, of focal lengths in pixels (numbers or arrays)."""
    return np.abs(fx - fy) <= SQUARE_RTOL * np.abs(fx)


def field_of_view_deg(length_px: Any, focal_px: Any) -> Any:
    """Return the angle between a frame's opposite edges, without lens distortion, in degrees.

    ``2 atan(length / (2 focal))`` of a frame that lies symmetrically about the optical axis.
    """
    return np.degrees(2 * np.arctan(np.asarray(length_px) / (2 * np.asarray(focal_px))))


@dataclass(frozen=True, slots=True)
class Cameras:
    """N cameras as arrays: ``view`` (N, 4) fx, fy, cx, cy in px; packed ``lenses`` (N, 24).

    ``distorted`` (N,) says which have a lens model; no lens code runs for the others.
    """

    view: NDArray[np.float64]
    lenses: NDArray[np.float64]
    distorted: NDArray[np.bool_]

    def take(self, rows: NDArray[np.intp]) -> Cameras:
        """Return the cameras of the given rows."""
        return Cameras(self.view[rows], self.lenses[rows], self.distorted[rows])

    def optics(self, row: int) -> Optics:
        """Return one camera as compiled functions take it."""
        return Optics(self.view[row], self.lenses[row], bool(self.distorted[row]))

    def matrix(self, row: int) -> NDArray[np.float64]:
        """Return OpenCV's camera matrix (3, 3) of one row."""
        fx, fy, cx, cy = self.view[row]
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pixels (N, M, 2) of points (N, M, 3) in metres in the camera frame.

        NaN for points with z <= 0.
        """
        return _project(np.ascontiguousarray(points), self.view, self.lenses, self.distorted)

    def normalise(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return undistorted normalised coordinates (N, M, 2) of pixels (N, M, 2).

        NaN if the lens has no inverse at a pixel.
        """
        flat = np.asarray((pixels - self.view[:, None, 2:]) / self.view[:, None, :2])
        if self.distorted.any():
            rows = np.flatnonzero(self.distorted)
            flat[rows] = lens.undistort_points(flat[rows], self.lenses[rows])
        return flat


@compiled
def _project(
    points: NDArray[np.float64], view: NDArray[np.float64], lenses: NDArray[np.float64],
    distorted: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """As :meth:`Cameras.project`."""
    pixels = np.empty((points.shape[0], points.shape[1], 2))
    for i in range(points.shape[0]):
        for j in range(points.shape[1]):
            z = points[i, j, 2]
            x, y = math.nan, math.nan
            if z > 0:
                x, y = points[i, j, 0] / z, points[i, j, 1] / z
                if distorted[i]:
                    x, y = lens.distort(x, y, lenses[i])
            pixels[i, j, 0] = view[i, 0] * x + view[i, 2]
            pixels[i, j, 1] = view[i, 1] * y + view[i, 3]
    return pixels


def canonical_distortion(coefficients: tuple[float, ...]) -> tuple[float, ...]:
    """Return the coefficients without trailing zeros: equal lenses have equal tuples."""
    last = max((i + 1 for i, value in enumerate(coefficients) if value != 0.0), default=0)
    return tuple(float(value) for value in coefficients[:last])
