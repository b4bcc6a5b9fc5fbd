"""The camera: pinhole intrinsics, a lens, the projection of points."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from sweep.compilation import compiled
from sweep.declaration import parameter
from sweep.model import lens
from sweep.model.polygon import Optics
from sweep.typing import Floats, Masks

# --------------------------------------------------------------------------------------------------
# The camera: pinhole intrinsics, a lens, and the projection of points in space.

#: Numbers that a calibration estimates: fx, fy, cx, cy and the lens coefficients.
BELIEF_COUNTS = tuple(4 + count for count in lens.COUNTS)

#: Width and height of the sensor where the pipeline gives neither.
DEFAULT_SENSOR_MM = (4.8, 3.6)


@dataclass(frozen=True, slots=True)
class Camera:
    """A camera's parameters: focal lengths in pixels, a field of view, or millimetres.

    Pixels are square unless both sides of the sensor, or ``fx_px`` and ``fy_px``, are given.
    """

    width_px: int = parameter(640, "width of the frame", 1, 100_000)
    height_px: int = parameter(480, "height of the frame", 1, 100_000)
    sensor_width_mm: float | None = parameter(
        None, "width of the sensor's active area (default: 4.8, or with sensor_height_mm what "
        "makes the pixels square)", 1e-6, 1e6,
    )
    sensor_height_mm: float | None = parameter(
        None, "height of the sensor's active area (default: what makes the pixels square)", 1e-6,
        1e6,
    )
    focal_length_mm: float = parameter(4.0, "focal length of the lens", 1e-6, 1e6)
    pixel_size_um: float | None = parameter(
        None, "side of a square pixel; with focal_length_mm, replaces the sensor's sides", 0.05,
        1e4,
    )
    hfov_deg: float | None = parameter(
        None, "horizontal field of view between the frame's edges, without lens distortion: 2 "
        "atan(width_px / (2 fx)); replaces focal lengths and the sensor's sides", 1e-5, 179.9,
    )
    vfov_deg: float | None = parameter(
        None, "vertical field of view: 2 atan(height_px / (2 fy)); as hfov_deg", 1e-5, 179.9
    )
    dfov_deg: float | None = parameter(
        None, "diagonal field of view between the frame's opposite corners, in square pixels: 2 "
        "atan(hypot(width_px, height_px) / (2 fx)); as hfov_deg", 1e-5, 179.9,
    )
    fx_px: float | None = parameter(
        None, "focal length along x; replaces the parameters in mm", 1e-3, 1e9
    )
    fy_px: float | None = parameter(None, "focal length along y (default: fx_px)", 1e-3, 1e9)
    cx_px: float | None = parameter(
        None, "principal point, x (default: (width_px - 1) / 2)", -1e9, 1e9
    )
    cy_px: float | None = parameter(
        None, "principal point, y (default: (height_px - 1) / 2)", -1e9, 1e9
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


#: The arguments of :func:`intrinsics`, in order.
VIEW_PARAMETERS = (
    "width_px", "height_px", "sensor_width_mm", "sensor_height_mm", "focal_length_mm", "fx_px",
    "fy_px", "cx_px", "cy_px", "hfov_deg", "vfov_deg", "pixel_size_um", "dfov_deg",
)

#: Focal lengths that differ by less, relatively, are those of square pixels.
SQUARE_RTOL = 1e-12


def intrinsics(
    width_px: Any, height_px: Any, sensor_width_mm: Any, sensor_height_mm: Any,
    focal_length_mm: Any, fx_px: Any, fy_px: Any, cx_px: Any, cy_px: Any, hfov_deg: Any = None,
    vfov_deg: Any = None, pixel_size_um: Any = None, dfov_deg: Any = None,
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
        # Where the default side makes pixels square, it is used: the bits are those of the side
        # given.
        width = DEFAULT_SENSOR_MM[0] if sensor_width_mm is None else sensor_width_mm
        height = DEFAULT_SENSOR_MM[1] if sensor_height_mm is None else sensor_height_mm
        fx, fy = focal_length_mm / width * width_px, focal_length_mm / height * height_px
        if sensor_width_mm is None or sensor_height_mm is None:
            known, square = fx if sensor_height_mm is None else fy, are_square(fx, fy)
            # Exact: what is added is a difference of almost equal numbers, or 0.
            fx, fy = known + (fx - known) * square, known + (fy - known) * square
    cx = (width_px - 1) / 2 if cx_px is None else cx_px
    cy = (height_px - 1) / 2 if cy_px is None else cy_px
    return fx, fy, cx, cy


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

    @property
    def matrices(self) -> NDArray[np.float64]:
        """OpenCV's camera matrices (N, 3, 3)."""
        out = np.zeros((len(self.view), 3, 3))
        out[:, 0, 0], out[:, 1, 1], out[:, 2, 2] = self.view[:, 0], self.view[:, 1], 1.0
        out[:, :2, 2] = self.view[:, 2:]
        return out

    def matrix(self, row: int) -> NDArray[np.float64]:
        """Return OpenCV's camera matrix (3, 3) of one row."""
        return np.asarray(self.take(np.array([row])).matrices[0])

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pixels (N, M, 2) of points (N, M, 3) in metres in the camera frame.

        NaN for points with z <= 0.
        """
        distorted = self.distorted if self.distorted.any() else None
        return _project(np.ascontiguousarray(points), self.view, self.lenses, distorted)

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
    distorted: NDArray[np.bool_] | None,
) -> NDArray[np.float64]:
    """As :meth:`Cameras.project`; ``distorted`` is None if none is: no lens code is compiled."""
    pixels = np.empty((points.shape[0], points.shape[1], 2))
    for i in range(points.shape[0]):
        for j in range(points.shape[1]):
            z = points[i, j, 2]
            x, y = math.nan, math.nan
            if z > 0:
                x, y = points[i, j, 0] / z, points[i, j, 1] / z
                if distorted is not None and distorted[i]:
                    x, y = lens.distort(x, y, lenses[i])
            pixels[i, j, 0] = view[i, 0] * x + view[i, 2]
            pixels[i, j, 1] = view[i, 1] * y + view[i, 3]
    return pixels


def canonical_distortion(coefficients: tuple[float, ...]) -> tuple[float, ...]:
    """Return the coefficients without trailing zeros: equal lenses have equal tuples."""
    last = max((i + 1 for i, value in enumerate(coefficients) if value != 0.0), default=0)
    return tuple(float(value) for value in coefficients[:last])


# --------------------------------------------------------------------------------------------------
# The values of one parameter for N scenes: one for all of them, or one each.

@dataclass(frozen=True, slots=True)
class Column:
    """The values of one parameter for N scenes.

    Only this class knows in which of its forms a parameter comes: functions of one value are
    applied by :meth:`map`, arithmetic is done on :attr:`values`, arrays are made by
    :meth:`broadcast`.

    Attributes
    ----------
    values
        The value of all scenes, or N values: an array of numbers, or a list of anything else.
    constant
        Whether all scenes share the value.

    Examples
    --------
    >>> Column.of(0.3).broadcast(2)
    array([0.3, 0.3])
    >>> Column.of(["exact", "warp"]).map(len).values
    [5, 4]
    >>> Column.of(None).broadcast(2)
    array([nan, nan])
    """

    values: Any
    constant: bool

    @staticmethod
    def of(values: Any) -> Column:
        """Return a column of N values (a list or an array), of one value, or as it is."""
        if isinstance(values, Column):
            return values
        # An array without dimensions is one number.
        constant = not isinstance(values, list) and getattr(values, "ndim", 0) == 0
        return Column(values, constant)

    @property
    def missing(self) -> bool:
        """Whether the parameter is not given: None for all scenes."""
        return self.constant and self.values is None

    def broadcast(self, count: int, dtype: DTypeLike = np.float64) -> NDArray[Any]:
        """Return a contiguous array (count,) of the values; None becomes NaN."""
        return np.full(count, np.asarray(self.values, dtype=dtype))

    def listed(self, count: int) -> list[Any]:
        """Return the values as a list of ``count``."""
        if self.constant:
            return [self.values] * count
        return self.values.tolist() if isinstance(self.values, np.ndarray) else list(self.values)

    def map(self, function: Callable[[Any], Any]) -> Column:
        """Return the column of ``function`` of each value."""
        return map_columns(function, [self])

    def differs_from(self, value: Any) -> bool:
        """Return whether any scene has another value than ``value``."""
        if isinstance(self.values, np.ndarray):
            return bool(np.any(self.values != value))
        return any(each != value for each in ([self.values] if self.constant else self.values))


def map_columns(function: Callable[..., Any], columns: Sequence[Column]) -> Column:
    """Return the column of ``function`` of the values that each scene has in ``columns``.

    ``function`` is called once where all columns are constant.
    """
    if all(column.constant for column in columns):
        return Column(function(*(column.values for column in columns)), constant=True)
    each = (itertools.repeat(one.values) if one.constant else one.listed(0) for one in columns)
    # Constants repeat without end.
    return Column([function(*row) for row in zip(*each, strict=False)], constant=False)


# --------------------------------------------------------------------------------------------------
# Places at which the whole marker is in the frame.
#
# Along x only the frame's left and right edges bound a marker, along y only its upper and lower
# one. A point of the marker that lies (o_x, o_y, o_z) from its centre is in the frame if the
# pixel of (x + o_x)/(z + o_z) is. Without a lens that bounds x by the points' offsets and depths
# alone; with one, an edge of the frame is a curve, and the limits along x depend on y. So do all
# of them if the marker is turned against the line of sight. Then the place is a fixed point: x at
# its share between the limits at (x, y), and y at its.

#: Steps of the fixed point: each gains a digit or more, unless the lens folds in the frame.
MAX_STEPS = 200

#: Step, relative to the depth, at which the fixed point is reached.
CONVERGED = 1e-12

#: Bisections between a place that is in the frame and one that is not.
HALVINGS = 50

#: Pixels by which a point may be beyond the frame's edge: rounding, where it lies upon it.
SLACK_PX = 1e-6

#: Points of a side that is bent by a lens; between them it bulges by less than 1/64 of the side's
#: bulge, which :data:`BULGE_PX` covers up to 3 px.
PER_SIDE = 8

#: Pixels that are kept free at the frame's edges under a lens.
BULGE_PX = 0.05


@dataclass(frozen=True, slots=True)
class Framing:
    """Where N markers are to be between the places at which they touch the frame.

    Attributes
    ----------
    cameras, frame
        N cameras, and (N, 2) width and height of their frames in px.
    depth
        (N,) of the marker's centre, in metres.
    offsets
        Returns the points (n, M, 3) of the markers of rows (n,), from the centre, in the camera's
        frame, if the centre is at (x, y) (n, 2): the corners, or points along the sides.
    share
        (N, 2) between the first (0) and the last (1) place along x and y; NaN: along this axis the
        marker stays at ``given``.
    given
        (N, 2) x and y, metres, where there is no share.
    margin, shift
        (N, 2) metres: free space that is kept at both ends, and what is added to the place
        afterwards (at most the margin).
    """

    cameras: Cameras
    frame: Floats
    depth: Floats
    offsets: Callable[[NDArray[np.intp], Floats], Floats]
    share: Floats
    given: Floats
    margin: Floats
    shift: Floats

    def centres(self) -> Floats:
        """Return the centres (N, 2) in metres, without ``shift``.

        Along an axis along which a marker is too large to be in the frame, it is in the middle
        between the places at which it touches the two edges.
        """
        wanted = self._solve(self.share)
        outside = np.flatnonzero(~self._fits(np.arange(len(wanted)), wanted))
        if len(outside):
            wanted[outside] = self._nearest(outside, wanted[outside])
        return np.asarray(np.where(np.isnan(self.share), self.given, wanted - self.shift))

    def _solve(self, share: Floats) -> Floats:
        """Return the fixed points (N, 2) of a share (N, 2), with ``shift``."""
        centre_xy = np.where(np.isnan(share), self.given + self.shift, 0.0)
        active = np.arange(len(centre_xy))
        for _ in range(MAX_STEPS):
            moved = self._step(active, centre_xy[active], share[active])
            step = np.abs(moved - centre_xy[active]).max(axis=1)
            centre_xy[active] = moved
            # Each row ends by itself: a scene's place depends on no other scene.
            active = active[step > CONVERGED * (self.depth[active] + np.abs(moved).max(axis=1))]
            if not len(active):
                break
        return centre_xy

    def _step(self, rows: NDArray[np.intp], centre_xy: Floats, share: Floats) -> Floats:
        """Return the places (n, 2) at their share between the limits at ``centre_xy``."""
        offsets = self.offsets(rows, centre_xy)
        depth = self.depth[rows, None] + offsets[..., 2]
        depth = np.where(depth > 0, depth, np.nan)
        # The first and last places along each axis that keep each point inside, (n, M, 2).
        first, last = (
            self._rays(rows, centre_xy, offsets, side) * depth[..., None] - offsets[..., :2]
            for side in (0, 1)
        )
        low, high = first.max(axis=1) + self.margin[rows], last.min(axis=1) - self.margin[rows]
        tight = high < low
        chosen = low + np.where(tight, 0.5, share) * (high - low) + self.shift[rows]
        return np.where(np.isfinite(chosen), chosen, centre_xy)

    def _rays(
        self, rows: NDArray[np.intp], centre_xy: Floats, offsets: Floats, side: int
    ) -> Floats:
        """Return (n, M, 2) x/z of the left (1: right) and y/z of the upper (lower) edge.

        Under a lens, of the edge's points beside the marker's points.
        """
        cameras = self.cameras.take(rows)
        edge = np.array([-0.5, -0.5]) if side == 0 else self.frame[rows] - 0.5
        edge = np.broadcast_to(edge, (len(rows), 2))
        straight = (edge - cameras.view[:, 2:]) / cameras.view[:, :2]
        rays = np.repeat(straight[:, None, :], offsets.shape[1], axis=1)
        curved = np.flatnonzero(cameras.distorted)
        if not len(curved):
            return rays
        lenses = cameras.take(curved)
        centre = np.column_stack([centre_xy, self.depth[rows]])[curved]
        pixels = lenses.project(offsets[curved] + centre[:, None, :])
        frame = self.frame[rows[curved], None, :]
        inward = BULGE_PX * (1 - 2 * side)
        fold = lenses.lenses[:, 23, None]
        for axis in (0, 1):
            beside = np.clip(np.nan_to_num(pixels), -0.5, frame - 0.5)
            beside[..., axis] = edge[curved, None, axis] + inward
            inverse = lenses.normalise(beside)[..., axis]
            # Where the lens shows nothing up to the edge, its fold is the limit.
            limit = np.where(np.isfinite(fold), fold * (2 * side - 1), rays[curved, :, axis])
            rays[curved, :, axis] = np.where(np.isfinite(inverse), inverse, limit)
        return rays

    def _fits(self, rows: NDArray[np.intp], centre_xy: Floats) -> Masks:
        """Return (n,) whether all points are in the frame along the axes that have a share."""
        offsets = self.offsets(rows, centre_xy)
        centre = np.column_stack([centre_xy, self.depth[rows]])
        cameras = self.cameras.take(rows)
        points = offsets + centre[:, None, :]
        pixels = cameras.project(points)
        inside = (pixels >= -0.5 - SLACK_PX) & (
            pixels <= self.frame[rows, None, :] - 0.5 + SLACK_PX
        )
        inside |= np.isnan(self.share[rows, None, :]) & np.isfinite(pixels)
        fits = np.asarray(inside.all(axis=(1, 2)))
        curved = np.flatnonzero(cameras.distorted & fits)
        if len(curved):
            corners = points[curved, :: max(points.shape[1] // 4, 1)]
            flat = np.ascontiguousarray(corners[..., :2] / corners[..., 2:])
            fits[curved] = ~lens.folds(flat, cameras.lenses[curved])
        return fits

    def _nearest(self, rows: NDArray[np.intp], wanted: Floats) -> Floats:
        """Return the last place (n, 2) in the frame on the way from the middle to ``wanted``.

        ``wanted`` itself, if the marker is not wholly in the frame in the middle.
        """
        middle = self._solve(np.where(np.isnan(self.share), np.nan, 0.5))[rows]
        middle = np.where(self._fits(rows, middle)[:, None], middle, wanted)
        inside, outside = np.zeros(len(rows)), np.ones(len(rows))
        for _ in range(HALVINGS):
            half = (inside + outside) / 2
            fits = self._fits(rows, middle + half[:, None] * (wanted - middle))
            inside, outside = np.where(fits, half, inside), np.where(fits, outside, half)
        return np.asarray(middle + inside[:, None] * (wanted - middle))
