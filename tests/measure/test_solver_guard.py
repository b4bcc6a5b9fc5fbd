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
    """Poses (N,) of markers at ``centre`` (N, 3), and their exact corners without a lens."""

    def __init__(self, angles_deg, centre, size_m, focal_px=FOCAL_PX):
        tilt, azimuth, roll = np.radians(angles_deg)
        axis = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * tilt], axis=1)
        rotation = Rotation.from_rotvec(tilt[:, None] * axis) * Rotation.from_euler(
            "z", roll[:, None]) * Rotation.from_rotvec([np.pi, 0, 0])
        rotation = rotation.as_matrix()
        sight = centre / np.linalg.norm(centre, axis=1, keepdims=True)
        # Within 1 degree of edge on, a marker of this size is a line of 1 px.
        facing = -np.einsum("ni,ni->n", rotation[:, :, 2], sight) > np.cos(np.radians(89))
        self.rotation, self.translation, sight = rotation[facing], centre[facing], sight[facing]
        count = len(self.rotation)
        reflection = np.eye(3) - 2 * sight[:, :, None] * sight[:, None, :]
        # Every pose's reflection in the plane across the line of sight.
        self.mirrored = reflection @ self.rotation @ np.diag([1.0, 1.0, -1.0])
        self.size_m = np.full(count, size_m)
        view = np.tile([focal_px, focal_px, 319.5, 239.5], (count, 1))
        self.cameras = Cameras(
            view, np.repeat(pack(())[None], count, axis=0), np.zeros(count, dtype=bool))
        self.corners = self.cameras.project(
            np.einsum("nij,kj->nki", self.rotation, size_m * SQUARE) + self.translation[:, None])

    def __len__(self):
        return len(self.rotation)

    def estimates(self, solver, guarded=True):
        return estimate(self.corners, self.cameras, self.size_m, solver, guarded, 0.25)


def all_round(step_deg, bearing_deg=(12.0, -9.0), size_m=1.0):
    """Tilts by 15 degrees, azimuths and rolls by a step, 8 sides away: 67 px."""
    turns = range(0, 360, step_deg)
    angles = np.array(list(itertools.product(range(0, 90, 15), turns, turns)), dtype=float).T
    centre = 8 * size_m * np.array([*np.tan(np.radians(bearing_deg)), 1.0])
    return View(angles, np.tile(centre, (angles.shape[1], 1)), size_m)


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
    mirror = degrees_between(estimates.rotation, view.mirrored) < 0.01
    return ~(right | (mirror & exact)) | (estimates.status != EstimateStatus.solved)


@lengths(45, 30)
@pytest.mark.parametrize("bearing", [(0.0, 0.0), (12.0, -9.0)], ids=["on-axis", "off-axis"])
@pytest.mark.parametrize("size_m", [0.001, 10.0])
def test_guarded_solvers_are_right_where_plain_calls_fail(count, bearing, size_m):
    view = all_round(count, bearing, size_m)
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


def far(count, focal_px):
    """Poses so far away that the perspective across the marker is 1e-3 to 1e-6 px."""
    rng = np.random.default_rng(3)
    side_px = np.geomspace(20, 100, count)
    # To 33 degrees off the axis at the shortest focal length: none is seen from behind.
    steepest = 85 if focal_px > 1e3 else 50
    tilt, azimuth, roll = rng.uniform(0, [[steepest], [360], [360]], (3, count))
    # Every tenth is parallel to the image, or turned about an image axis: where IPPE's rotation
    # vector has a norm of pi.
    side_px[-1], tilt[-1] = 100.0, 0.0
    tilt[::10], azimuth[5::10], roll[5::10] = 0.0, 0.0, 90.0 * rng.integers(0, 4, count // 10)
    depth = focal_px * 0.05 / side_px
    centre = np.stack([*(rng.uniform(-200, 200, (2, count)) * depth / focal_px), depth], axis=1)
    return View((tilt, azimuth, roll), centre, 0.05, focal_px)


@pytest.mark.parametrize("focal_px", [3e2, 1e4, 1e6, 1e8])
@lengths(60, 2000)
def test_guarded_solvers_are_right_at_any_focal_length(count, focal_px):
    view = far(count, focal_px)
    assert len(view) == count
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
    view = all_round(37)  # no multiple of a right angle: the guard needs no fallback
    estimates = view.estimates(solver)
    present = np.isfinite(estimates.alternative_rotation).all(axis=(1, 2))
    assert (present == np.isfinite(estimates.alternative_reprojection_px)).all()
    assert present.all() if solver in ("ippe", "ippe_square") else not present.any()
    if solver in ("ippe", "ippe_square"):
        # Of exact corners, it is the mirror of the truth; 1e-3 degrees covers IPPE's rounding
        # where the marker squarely faces the camera and both solutions meet.
        off = degrees_between(estimates.alternative_rotation, view.mirrored)
        assert off.max() < 1e-3
        assert (estimates.alternative_reprojection_px >= estimates.reprojection_px - 1e-6).all()


def test_an_estimate_is_flipped_when_it_is_the_mirror():
    view = all_round(37)
    tilted = degrees_between(view.mirrored, view.rotation) > 1
    assert tilted.sum() > 100
    for rotation, flipped in ((view.rotation, False), (view.mirrored, True)):
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
