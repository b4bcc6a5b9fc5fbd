"""The guarded solvers are right where the plain calls fail, and no nonsense passes as solved."""

import itertools

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.lengths import lengths
from support.solving import estimate
from sweep.measure.estimation import pose_error
from sweep.measure.flags import EstimateStatus
from sweep.measure.solver import OPENCV_SOLVERS
from sweep.model.camera import Cameras
from sweep.model.lens import pack

RELIABLE = tuple(name for name in OPENCV_SOLVERS if name != "epnp")
FOCAL_PX = 1600 / 3
SQUARE = np.array([[-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0], [-0.5, -0.5, 0]])
class View:
    """Poses (N,) over tilt, azimuth and roll at one bearing, and their exact corners."""

    def __init__(self, step_deg, bearing_deg, size_m=1.0, lens=()):
        tilt, azimuth, roll = np.radians(
            list(itertools.product(range(0, 90, 15), *[range(0, 360, step_deg)] * 2))
        ).T
        axis = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros_like(tilt)], axis=1)
        rotation = Rotation.from_rotvec(tilt[:, None] * axis) * Rotation.from_rotvec(
            roll[:, None] * [0.0, 0.0, 1.0]
        )
        self.rotation = (rotation * Rotation.from_rotvec([np.pi, 0, 0])).as_matrix()
        # 8 sides away: 67 px.
        centre = 8 * size_m * np.array([*np.tan(np.radians(bearing_deg)), 1.0])
        self.sight = centre / np.linalg.norm(centre)
        # Within 1 degree of edge on, a marker of this size is a line of 1 px.
        facing = np.arccos(np.clip(-self.rotation[:, :, 2] @ self.sight, -1, 1)) < np.radians(89)
        self.rotation = self.rotation[facing]
        self.translation = np.tile(centre, (len(self.rotation), 1))
        self.size_m = np.full(len(self.rotation), size_m)
        self.cameras = cameras(len(self.rotation), lens)
        self.corners = self.cameras.project(in_space(self.rotation, self.translation, size_m))

    def __len__(self):
        return len(self.rotation)

    def mirrored(self):
        """Return the reflection of every pose in the plane across the line of sight."""
        reflection = np.eye(3) - 2 * np.outer(self.sight, self.sight)
        return reflection @ self.rotation @ np.diag([1.0, 1.0, -1.0])

    def estimates(self, solver, guarded, corners=None):
        corners = self.corners if corners is None else corners
        return estimate(corners, self.cameras, self.size_m, solver, guarded, 0.25)


def in_space(rotation, translation, size_m):
    return np.einsum("nij,kj->nki", rotation, size_m * SQUARE) + translation[:, None]


def cameras(count, lens=()):
    view = np.tile([FOCAL_PX, FOCAL_PX, 319.5, 239.5], (count, 1))
    return Cameras(view, np.repeat(pack(lens)[None], count, axis=0), np.full(count, bool(lens)))


def degrees_between(rotation, other):
    """Return the angles (N,); infinite where ``rotation`` is NaN."""
    angle = np.full(len(rotation), np.inf)
    known = np.isfinite(rotation).all(axis=(1, 2))
    difference = rotation[known] @ np.swapaxes(other[known], 1, 2)
    angle[known] = np.degrees(Rotation.from_matrix(difference).magnitude())
    return angle


def wrong(view, estimates):
    """Tell (N,) which estimates are neither within 0.01 degrees nor the mirror, as exact as it.

    0.01 degrees is 1e-4 of the smallest tilt step and 100 times what iterative solvers leave.
    """
    right = degrees_between(estimates.rotation, view.rotation) < 0.01
    with np.errstate(invalid="ignore"):
        exact = estimates.reprojection_px < 1e-6  # where the mirror is no worse than the truth
    mirror = degrees_between(estimates.rotation, view.mirrored()) < 0.01
    return ~(right | (mirror & exact)) | (estimates.status != EstimateStatus.solved)


@lengths(45, 30)
@pytest.mark.parametrize("bearing", [(0.0, 0.0), (12.0, -9.0)], ids=["on-axis", "off-axis"])
@pytest.mark.parametrize("size_m", [0.001, 10.0])
def test_guarded_solvers_are_right_where_plain_calls_fail(count, bearing, size_m):
    view = View(count, bearing, size_m)
    failures = {
        (solver, guarded): int(wrong(view, view.estimates(solver, guarded)).sum())
        for solver in RELIABLE
        for guarded in (True, False)
    }
    assert not any(failures[solver, True] for solver in RELIABLE)
    # The guard's reason to exist.
    assert failures["ippe", False] > 0
    assert failures["ippe_square", False] > 0
    if size_m == 0.001:
        assert failures["sqpnp", False] > 0


class FarView:
    """Poses (N,) so far away that the perspective across the marker is 1e-3 to 1e-6 px."""

    def __init__(self, count, focal_px, seed):
        rng = np.random.default_rng(seed)
        side_px = np.geomspace(20, 100, count)
        # To 33 degrees off the axis at the shortest focal length: none is seen from behind.
        steepest = 85 if focal_px > 1e3 else 50
        tilt, azimuth, roll = rng.uniform(0, [[steepest], [360], [360]], (3, count))
        # Every tenth is parallel to the image, or turned about an image axis: where IPPE's
        # rotation vector has a norm of pi.
        side_px[-1], tilt[-1] = 100.0, 0.0
        tilt[::10], azimuth[5::10], roll[5::10] = 0.0, 0.0, 90.0 * rng.integers(0, 4, count // 10)
        along = np.radians(azimuth)
        axis = np.stack([np.cos(along), np.sin(along), 0 * tilt], axis=1)
        rotation = Rotation.from_rotvec(np.radians(tilt)[:, None] * axis) * Rotation.from_euler(
            "z", roll[:, None], degrees=True)
        self.rotation = (rotation * Rotation.from_rotvec([np.pi, 0, 0])).as_matrix()
        self.size_m = np.full(count, 0.05)
        depth = focal_px * self.size_m / side_px
        centre_px = rng.uniform(-200, 200, (2, count))
        self.translation = np.stack([*(centre_px * depth / focal_px), depth], axis=1)
        view = np.tile([focal_px, focal_px, 319.5, 239.5], (count, 1))
        lenses = np.repeat(pack(())[None], count, axis=0)
        self.cameras = Cameras(view, lenses, np.zeros(count, dtype=bool))
        self.corners = self.cameras.project(in_space(self.rotation, self.translation, 0.05))

    def estimates(self, solver):
        return estimate(self.corners, self.cameras, self.size_m, solver, guarded=True, limit=0.25)


@pytest.mark.parametrize("focal_px", [3e2, 1e4, 1e6, 1e8])
@lengths(60, 2000)
def test_guarded_solvers_are_right_at_any_focal_length(count, focal_px):
    view = FarView(count, focal_px, seed=3)
    for solver in RELIABLE:
        estimates = view.estimates(solver)
        assert (estimates.status == EstimateStatus.solved).all(), solver
        error = degrees_between(estimates.rotation, view.rotation).max()
        # Not even the mirror is right: the corners tell them apart. AP3P alone loses digits of
        # frontal markers before they are far.
        assert error < (0.2 if (solver, focal_px) == ("ap3p", 1e4) else 0.01), solver
        relative = np.linalg.norm(estimates.translation - view.translation, axis=1)
        # ITERATIVE's own stop leaves 4e-6 at short focal lengths.
        assert (relative / view.translation[:, 2]).max() < 2e-5, solver


@pytest.mark.parametrize("solver", OPENCV_SOLVERS)
def test_other_planar_solution_is_there_for_the_solvers_that_give_both(solver):
    view = View(37, (12.0, -9.0))  # no multiple of a right angle: the guard needs no fallback
    estimates = view.estimates(solver, guarded=True)
    present = np.isfinite(estimates.alternative_rotation).all(axis=(1, 2))
    assert (present == np.isfinite(estimates.alternative_reprojection_px)).all()
    assert present.all() if solver in ("ippe", "ippe_square") else not present.any()
    if solver in ("ippe", "ippe_square"):
        # Of exact corners, it is the mirror of the truth; 1e-3 degrees covers IPPE's rounding
        # where the marker squarely faces the camera and both solutions meet.
        off = degrees_between(estimates.alternative_rotation, view.mirrored())
        assert off.max() < 1e-3
        assert (estimates.alternative_reprojection_px >= estimates.reprojection_px - 1e-6).all()


def test_an_estimate_is_flipped_when_it_is_the_mirror():
    view = View(37, (12.0, -9.0))
    tilted = degrees_between(view.mirrored(), view.rotation) > 1
    assert tilted.sum() > 100
    for rotation, flipped in ((view.rotation, False), (view.mirrored(), True)):
        error = pose_error(rotation, view.translation, view.rotation, view.translation)
        assert (error.flipped[tilted] == flipped).all()
    # OpenCV's own second solution of one whose first is right.
    row = np.flatnonzero(tilted & ~wrong(view, view.estimates("ippe", guarded=False)))[0]
    _, rvecs, _, _ = cv2.solvePnPGeneric(
        SQUARE, view.corners[row], view.cameras.matrix(row), None, flags=cv2.SOLVEPNP_IPPE
    )
    second = Rotation.from_rotvec(rvecs[1][:, 0]).as_matrix()[None]
    one = slice(row, row + 1)
    assert pose_error(
        second, view.translation[one], view.rotation[one], view.translation[one]
    ).flipped.all()
