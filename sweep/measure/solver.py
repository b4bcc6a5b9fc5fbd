"""Pose from four corners: OpenCV's solvers, guarded or as users call them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.measure.covariance import corner_covariance
from sweep.measure.estimation import Detections, Estimates
from sweep.measure.flags import EstimateStatus
from sweep.model.camera import Cameras
from sweep.model.declaration import parameter
from sweep.model.marker import marker_corners
from sweep.model.pose import rotation_of_vector, transform_points
from sweep.typing import Floats

SOLVERS = {
    "ippe": cv2.SOLVEPNP_IPPE,
    "ippe_square": cv2.SOLVEPNP_IPPE_SQUARE,
    "iterative": cv2.SOLVEPNP_ITERATIVE,
    "sqpnp": cv2.SOLVEPNP_SQPNP,
    "p3p": cv2.SOLVEPNP_P3P,
    "ap3p": cv2.SOLVEPNP_AP3P,
    "epnp": cv2.SOLVEPNP_EPNP,
}

BELIEVED = "as the estimator believes it (default: the truth)"


@dataclass(frozen=True, slots=True)
class EstimatorSetting:
    """How the pose is computed from the corners, and what is believed of camera and marker."""

    solver: str = parameter(
        "ippe_square",
        "OpenCV's solver (epnp is unreliable for a single marker: it is not made for four "
        "coplanar points), or photometric: maximum likelihood on the pixels, started from ippe",
        choices=(*SOLVERS, "photometric"),
    )
    guarded: bool = parameter(
        True, "true: called where the solver is stable, checked, and replaced by iterative where "
        "it fails; false: the plain cv2.solvePnP call (epnp is always called plainly)",
    )
    reprojection_limit: float = parameter(
        0.25, "a solution whose RMS reprojection error is above this share of the found side is "
        "no solution; at infinity it is 0.7", low=0, high=0.5, open_low=True,
    )
    corner_noise_px: float | None = parameter(
        None, "standard deviation of a found corner's coordinates, of which the solvers' pose "
        "covariance is made; photometric makes its own from the pixels", unit="px", low=1e-6,
        high=1e6,
    )
    refined_starts: bool = parameter(
        False, "photometric starts from the detector's corners after cv2.cornerSubPix, too: four "
        "starts instead of two",
    )
    estimate_blur: bool = parameter(
        False, "photometric estimates the point spread, too, from believed_blur_px on"
    )
    believed_fx_px: float | None = parameter(
        None, f"focal length along x {BELIEVED}; that along y stays as it is", unit="px",
        low=1e-3, high=1e9, drawable=True,
    )
    believed_fy_px: float | None = parameter(
        None, f"focal length along y {BELIEVED}", unit="px", low=1e-3, high=1e9, drawable=True
    )
    believed_cx_px: float | None = parameter(
        None, f"principal point, x, {BELIEVED}", unit="px", low=-1e9, high=1e9, drawable=True
    )
    believed_cy_px: float | None = parameter(
        None, f"principal point, y, {BELIEVED}", unit="px", low=-1e9, high=1e9, drawable=True
    )
    believed_distortion: tuple[float, ...] | None = parameter(
        None, f"lens coefficients {BELIEVED}"
    )
    believed_size_m: float | None = parameter(
        None, f"side of the black square {BELIEVED}", unit="m", low=1e-9, high=1e9, drawable=True
    )
    believed_blur_px: float | None = parameter(
        None, f"Gaussian point spread {BELIEVED}", unit="px", low=0, high=1000
    )
    believed_noise_grey: float | None = parameter(
        None, f"noise of a pixel {BELIEVED}", unit="grey level", low=0, high=1e6
    )


def reprojection_errors_px(
    rotation: Floats, translation: Floats, size_m: Floats, corners: Floats, cameras: Cameras
) -> Floats:
    """Return the RMS reprojection error (N,); NaN for poses with a corner behind the camera."""
    pixels = cameras.project(transform_points(marker_corners(size_m), rotation, translation))
    return np.asarray(np.sqrt(((pixels - corners) ** 2).sum(axis=2).mean(axis=1)))


def estimate(
    corners: Floats, cameras: Cameras, size_m: Floats, solver: str, guarded: bool, limit: float
) -> Estimates:
    """Estimate N poses from corners (N, 4, 2) px with believed cameras and sizes (N,).

    ``limit`` is the largest RMS reprojection error of a solution, as a share of the mean side of
    the found quadrilateral.
    """
    # OpenCV raises on strided corners, and the guard would take that for no solution.
    corners = np.ascontiguousarray(corners, dtype=np.float64)
    call = _guarded if guarded and solver != "epnp" else _plain
    rotation, translation = call(corners, cameras, size_m, SOLVERS[solver])
    reprojection = np.stack(
        [
            reprojection_errors_px(rotation[:, k], translation[:, k], size_m, corners, cameras)
            for k in range(2)
        ],
        axis=1,
    )
    side = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).mean(axis=1)
    with np.errstate(invalid="ignore"):
        solved = reprojection <= limit * side[:, None]
    rotation[~solved], translation[~solved], reprojection[~solved] = np.nan, np.nan, np.nan
    solved[:, 1] &= solved[:, 0]
    for k in range(2):
        rotation[~solved[:, 0], k] = np.nan
        reprojection[~solved[:, 0], k] = np.nan
    count = len(corners)
    return Estimates(
        status=np.where(solved[:, 0], EstimateStatus.solved, EstimateStatus.solver_failed).astype(
            np.uint8
        ),
        rotation=rotation[:, 0],
        translation=translation[:, 0],
        reprojection_px=reprojection[:, 0],
        alternative_rotation=rotation[:, 1],
        alternative_reprojection_px=reprojection[:, 1],
        covariance=np.broadcast_to(np.nan, (count, 6, 6)),
        residual_ratio=np.broadcast_to(np.nan, (count,)),
    )


@dataclass(frozen=True, slots=True)
class CornerSolver:
    """OpenCV's solvers as estimators: poses from corners alone."""

    setting: EstimatorSetting

    @property
    def needs_images(self) -> bool:
        """Corners are all that it looks at."""
        return False

    def __call__(self, sightings: Detections) -> Estimates:
        """Return the poses, with covariances where the corners' noise is told."""
        setting = self.setting
        found = estimate(
            sightings.corners, sightings.cameras, sightings.size_m, setting.solver,
            setting.guarded, setting.reprojection_limit,
        )
        if setting.corner_noise_px is None:
            return found
        covariance = corner_covariance(
            found.rotation, found.translation, sightings.cameras, sightings.size_m,
            setting.corner_noise_px,
        )
        return dataclasses.replace(found, covariance=covariance)


def both_planar_solutions(
    corners: Floats, cameras: Cameras, size_m: Floats
) -> tuple[Floats, Floats]:
    """Return IPPE's rotations (N, 2, 3, 3) and translations (N, 2, 3), guarded; NaN for none."""
    corners = np.ascontiguousarray(corners, dtype=np.float64)
    return _guarded(corners, cameras, size_m, cv2.SOLVEPNP_IPPE)


def _plain(
    corners: Floats, cameras: Cameras, size_m: Floats, method: int
) -> tuple[Floats, Floats]:
    """Call ``cv2.solvePnP`` as users do: marker frame, metres, OpenCV's own lens inverse."""
    count = len(corners)
    rvec, translation = np.full((count, 2, 3), np.nan), np.full((count, 2, 3), np.nan)
    objects = marker_corners(size_m)
    for i in range(count):
        distortion = cameras.lenses[i, :14] if cameras.distorted[i] else None
        try:
            found, r, t = cv2.solvePnP(
                objects[i], corners[i], cameras.matrix(i), distortion, flags=method
            )
        except cv2.error:
            continue
        if found:
            rvec[i, 0], translation[i, 0] = r[:, 0], t[:, 0]
    return rotation_of_vector(rvec), translation


# The guard. IPPE divides by sin(pi) where the rotation vector's norm is pi, which in the marker
# frame (z out) is every upright marker tilted about one image axis; and it is not finite for a
# few poses on the optical axis in any frame. SQPNP's tolerances are absolute lengths. On 14,832
# noise-free poses the plain calls of ippe, ippe_square and sqpnp were wrong for 2,441, 2,431 and
# 572 of them (`pytest -m long -k guard -s` counts again). OpenCV inverts a lens in about five
# steps, converged or not: of 990 poses to 40° off the axis 36 to 45 % came out wrong by more than
# 0.01° (tests/test_guards.py), so corners are undistorted before.

_UNIT_SQUARE = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
"""Corners BL, BR, TR, TL (the order that IPPE_SQUARE wants) in the marker's frame turned z in."""

_Z_OUT = np.array([1.0, -1.0, -1.0])

_CREDIBLE_SHARE = 0.05
"""Reprojection errors below this share of the side are taken as they are; wrong solutions lie far
above it. Beyond it a solution must hold its own against ITERATIVE."""

_CREDIBLE_RATIO = 2.0
"""The largest ratio of a solution's reprojection error to that of ITERATIVE."""


def _guarded(
    corners: Floats, cameras: Cameras, size_m: Floats, method: int
) -> tuple[Floats, Floats]:
    """Solve where the solver is stable: undistorted corners, unit side, z in, roll within 45°.

    Returns both solutions' rotations (N, 2, 3, 3) and translations (N, 2, 3), NaN where there is
    none.
    """
    pixels = corners
    if cameras.distorted.any():
        flat = cameras.normalise(corners)
        pixels = flat * cameras.view[:, None, :2] + cameras.view[:, None, 2:]
    points = np.ascontiguousarray(pixels[:, ::-1])
    right = points[:, 1] + points[:, 2] - points[:, 0] - points[:, 3]
    roll = np.arctan2(right[:, 1], right[:, 0])
    turns = np.nan_to_num(np.round(roll / (np.pi / 2))).astype(np.int64) % 4
    matrices = np.zeros((len(points), 3, 3))
    matrices[:, 0, 0], matrices[:, 1, 1] = cameras.view[:, 0], cameras.view[:, 1]
    matrices[:, 0, 2], matrices[:, 1, 2] = cameras.view[:, 2], cameras.view[:, 3]
    matrices[:, 2, 2] = 1.0

    rotation, translation = _solve_turned(points, matrices, turns, method)
    pinhole = Cameras(cameras.view, cameras.lenses, np.zeros(len(points), dtype=bool))
    unit = np.ones(len(points))
    side = np.linalg.norm(np.roll(points, -1, axis=1) - points, axis=2).mean(axis=1)

    def errors(rows: NDArray[np.intp], r: Floats, t: Floats) -> Floats:
        return reprojection_errors_px(r, t, unit[rows], pixels[rows], pinhole.take(rows))

    everyone = np.arange(len(points))
    error = errors(everyone, rotation[:, 0], translation[:, 0])
    with np.errstate(invalid="ignore"):
        doubtful = ~(error <= _CREDIBLE_SHARE * side)
    doubtful &= np.isfinite(points).all(axis=(1, 2))
    rows = np.flatnonzero(doubtful)
    if len(rows):
        for k in range(1, 4):
            others = _solve_turned(points[rows], matrices[rows], (turns[rows] + k) % 4, method)
            other = errors(rows, others[0][:, 0], others[1][:, 0])
            with np.errstate(invalid="ignore"):
                better = ~np.isfinite(error[rows]) & np.isfinite(other)
            chosen = rows[better]
            rotation[chosen], translation[chosen] = others[0][better], others[1][better]
            error[chosen] = other[better]
        if method != cv2.SOLVEPNP_ITERATIVE:
            others = _solve_turned(
                points[rows], matrices[rows], turns[rows], cv2.SOLVEPNP_ITERATIVE
            )
            other = errors(rows, others[0][:, 0], others[1][:, 0])
            with np.errstate(invalid="ignore"):
                better = ~(error[rows] <= _CREDIBLE_RATIO * other) & np.isfinite(other)
            chosen = rows[better]
            rotation[chosen], translation[chosen] = others[0][better], others[1][better]
    return rotation, translation * size_m[:, None, None]


def _solve_turned(
    points: Floats, matrices: Floats, turns: NDArray[np.int64], method: int
) -> tuple[Floats, Floats]:
    """Solve with the corners' labels turned by quarter ``turns`` (n,), and turn the result back.

    Points (n, 4, 2) are BL, BR, TR, TL in undistorted pixels. Returns rotations (n, 2, 3, 3) of
    the marker frame and translations (n, 2, 3) in sides.
    """
    count = len(points)
    nothing = np.full((3, 1), np.nan)
    order = (np.arange(4) + turns[:, None]) % 4
    turned = np.take_along_axis(points, order[:, :, None], axis=1)
    vectors: list[Any] = []
    both = method in (cv2.SOLVEPNP_IPPE, cv2.SOLVEPNP_IPPE_SQUARE)
    for pixels, matrix in zip(turned, matrices, strict=True):
        try:
            if both:
                found, rs, ts, _ = cv2.solvePnPGeneric(
                    _UNIT_SQUARE, pixels, matrix, None, flags=method
                )
            else:
                found, r, t = cv2.solvePnP(_UNIT_SQUARE, pixels, matrix, None, flags=method)
                rs, ts = (r,), (t,)
        except cv2.error:
            found = False
        if not found:
            vectors += [nothing] * 4
        elif len(rs) > 1:
            vectors += [rs[0], rs[1], ts[0], ts[1]]
        else:
            vectors += [rs[0], nothing, ts[0], nothing]
    solved = np.concatenate(vectors).reshape(count, 2, 2, 3) if vectors else np.empty((0, 2, 2, 3))
    rotation, translation = rotation_of_vector(solved[:, 0]), solved[:, 1]
    c, s = np.array([1.0, 0.0, -1.0, 0.0])[turns], np.array([0.0, 1.0, 0.0, -1.0])[turns]
    back = np.zeros((count, 3, 3))
    back[:, 0, 0], back[:, 0, 1], back[:, 1, 0], back[:, 1, 1] = c, -s, s, c
    back[:, 2, 2] = 1.0
    return np.asarray(rotation @ (back * _Z_OUT)[:, None]), translation.copy()
