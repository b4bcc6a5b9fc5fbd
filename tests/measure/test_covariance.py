"""Covariances of poses and of calibrations, squared deviations, and values of flags."""

from __future__ import annotations

import math
import pickle

import cv2
import numpy as np
import pytest
import scipy.stats
from scipy.spatial.transform import Rotation

from support.exact_image import LENSES
from support.lengths import lengths
from sweep.measure.estimation import point_covariance, squared_deviations
from sweep.measure.flags import (
    BoundStatus,
    CalibrationStatus,
    DetectionStatus,
    EstimateStatus,
    Flipped,
)
from sweep.measure.intrinsics import INTRINSICS, calibrate
from sweep.model.camera import Cameras
from sweep.model.lens import pack
from sweep.model.marker import marker_corners

# Covariances of poses from corners, squared deviations, and the arithmetic of the likelihood.

CORNERS = np.array([[-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0], [-0.5, -0.5, 0]])


def corner_covariance(rotation, translation, cameras, size_m, noise_px):
    """The covariances of poses from the corners of one marker each."""
    return point_covariance(
        rotation, translation, marker_corners(size_m), np.arange(len(size_m)), cameras, noise_px
    )


def drawn_poses(count, seed, size_m=0.1):
    """Rotations, translations and views of markers of 20-200 px, up to 75° off the line of sight.

    Upright and frontal is a turn of 180° about the camera's x axis.
    """
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(count, 3)) * [1, 1, 0]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    tilt = Rotation.from_rotvec(axis * np.radians(rng.uniform(1, 75, (count, 1))))
    roll = Rotation.from_rotvec(rng.uniform(0, 2 * np.pi, (count, 1)) * [[0, 0, 1]])
    rotation = (tilt * roll * Rotation.from_euler("x", np.pi)).as_matrix()
    view = np.column_stack([
        rng.uniform(500, 900, count), rng.uniform(500, 900, count), rng.uniform(300, 340, count),
        rng.uniform(220, 260, count),
    ])
    z = view[:, 0] * size_m / np.exp(rng.uniform(np.log(20), np.log(200), count))
    translation = z[:, None] * np.column_stack([rng.uniform(-0.25, 0.25, (count, 2)), z / z])
    return rotation, translation, view


def cameras_of(view, lens=()):
    count = len(view)
    return Cameras(view, np.tile(pack(lens), (count, 1)), np.full(count, len(lens) > 0))


def off(found, expected):
    """The largest difference of two covariances in units of the standard deviations."""
    spread = np.sqrt(np.diagonal(expected, axis1=-2, axis2=-1))
    return np.abs((found - expected) / (spread[..., :, None] * spread[..., None, :])).max()


@pytest.mark.parametrize("lens", [(), *LENSES], ids=len)
def test_covariance_is_the_pseudo_inverse_of_opencvs_projection_differentiated(lens, claim):
    rotation, translation, view = drawn_poses(40, 1)
    size_m, noise_px = np.full(40, 0.1), 0.3
    found = corner_covariance(rotation, translation, cameras_of(view, lens), size_m, noise_px)
    assert found.shape == (40, 6, 6)
    worst = 0.0
    for n, (fx, fy, cx, cy) in enumerate(view):
        # By OpenCV's rotation vector at 0, of a marker whose points are turned already.
        camera = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        slopes = cv2.projectPoints(
            0.1 * CORNERS @ rotation[n].T, np.zeros(3), translation[n], camera,
            np.array(lens) if lens else None)[1][:, :6]
        unit = np.repeat([1.0, 0.1], 3)
        inverse = np.linalg.pinv(slopes * unit, rcond=1e-12)
        expected = noise_px**2 * (inverse @ inverse.T) * np.outer(unit, unit)
        worst = max(worst, off(found[n], expected))
    claim("covariances of poses from corners", "the pseudo-inverse of OpenCV's derivatives", worst,
          "of the deviations")
    assert worst < 1e-9


def test_covariance_is_nan_where_the_pose_is_or_where_nothing_tells_it():
    rotation, translation, view = drawn_poses(6, 5)
    alone = corner_covariance(rotation, translation, cameras_of(view), np.full(6, 0.1), 1.0)
    rotation[0], translation[1] = np.nan, np.nan
    rotation[2, 1, 2] = translation[3, 2] = np.nan
    # The third column of a rotation places no corner: it may be unknown.
    size_m = np.full(6, 0.1)
    size_m[4] = 0.0
    found = corner_covariance(rotation, translation, cameras_of(view), size_m, 1.0)
    assert np.isnan(found[[0, 1, 3, 4]]).all()
    assert np.isfinite(found[2]).all() or np.isnan(found[2]).all()
    np.testing.assert_array_equal(found[5], alone[5])


def test_squared_deviations_are_those_of_independent_numbers_that_are_mixed():
    """With the units of radians and of anything from mm to km; x = F·n has xᵀ(FFᵀ)⁻¹x = nᵀn."""
    rng = np.random.default_rng(1)
    factor, normal = rng.normal(size=(60, 6, 6)), rng.normal(size=(60, 6))
    unit = 10 ** rng.uniform([-6] * 3 + [-9] * 3, [0] * 3 + [4] * 3, (60, 6))
    error = unit * np.einsum("nij,nj->ni", factor, normal)
    plain = factor @ np.swapaxes(factor, 1, 2)
    covariance = unit[:, :, None] * plain * unit[:, None, :]
    found = squared_deviations(error[:, :3], error[:, 3:], covariance)
    off = np.abs(found / (normal**2).sum(axis=1) - 1)
    assert (off < 1e-14 * np.linalg.cond(plain) + 1e-12).all()


# Calibrations of points with known noise: the truth comes back, reported deviations hold it.

FRAME = 640, 480
TRUTH = np.array([600.0, 605.0, 322.0, 238.0, -0.2, 0.05, 0.001, -0.0005, 0.01])
BOARD = np.array([[0.03 * x - 0.09, 0.06 - 0.03 * y, 0.0] for y in range(5) for x in range(7)])


def image_of(points, camera=TRUTH):
    """OpenCV's pixels (..., 2) of points in the camera frame."""
    fx, fy, cx, cy = camera[:4]
    pixels, _ = cv2.projectPoints(
        points.reshape(-1, 3), np.zeros(3), np.zeros(3),
        np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), camera[4:])
    return pixels.reshape(*points.shape[:-1], 2)


def views(count, noise_px, draw, tilt_deg=45.0):
    """The board's points, and their pixels in views from all sides."""
    pixels = []
    for _ in range(count):
        tilt, around, roll = draw.uniform(0, math.radians(tilt_deg)), *draw.uniform(0, 6.28, 2)
        rotation = (
            Rotation.from_rotvec([tilt * math.cos(around), tilt * math.sin(around), 0.0])
            * Rotation.from_euler("x", np.pi) * Rotation.from_rotvec([0.0, 0.0, roll])
        ).as_matrix()
        at = np.array([*draw.uniform(-0.05, 0.05, 2), draw.uniform(0.3, 0.5)])
        pixels.append(image_of(BOARD @ rotation.T + at) + draw.normal(0, noise_px, (35, 2)))
    return [BOARD] * count, pixels


@lengths(20, 600)
def test_reported_deviations_hold_the_truth_of_unbiased_points(count):
    """A calibration whose intervals of 95 % hold 93 % fails with a probability of 1e-7 each."""
    draw = np.random.default_rng(2)
    held = np.zeros(len(INTRINSICS), dtype=int)
    for _ in range(count):
        found = calibrate(*views(8, 0.2, draw), FRAME)
        held += np.abs(found.values - TRUTH) <= 1.96 * found.std
    least = scipy.stats.binom.ppf(1e-7, count, 0.93)
    assert (held >= least).all(), dict(zip(INTRINSICS, held, strict=True))


def test_coefficients_that_are_not_wanted_stay_zero():
    for coefficients, free in ((0, 4), (1, 5), (2, 6), (4, 8), (5, 9)):
        found = calibrate(*views(6, 0.1, np.random.default_rng(3)), FRAME, coefficients)
        assert (found.std[:free] > 0).all()
        assert not found.std[free:].any()
        assert not found.values[free:].any()


@pytest.mark.parametrize(("objects", "status"), [
    ([BOARD] * 2, CalibrationStatus.too_few_views),
    ([BOARD[:5]] * 9, CalibrationStatus.too_few_views),  # five points
    ([BOARD[:7]] * 9, CalibrationStatus.too_few_views),  # on a line
    ([], CalibrationStatus.too_few_views),
])
def test_views_that_cannot_calibrate_are_said_to_be_too_few(objects, status):
    _, pixels = views(len(objects), 0.1, np.random.default_rng(4))
    found = calibrate(
        objects, [each[: len(points)] for points, each in zip(objects, pixels, strict=True)], FRAME
    )
    assert found.status == status
    assert np.isnan(found.values).all()

# The flags: values that stores hold, and what is derived from the members.

STORED = {
    DetectionStatus: "not_run detected wrong_id rejected no_candidate not_visible not_modelled "
    "failed crashed",
    EstimateStatus: "not_run solved no_detection solver_failed failed crashed not_converged "
    "not_explained",
    BoundStatus: "not_run given no_noise no_contrast clipped not_in_model not_visible",
    Flipped: "not_run not_flipped flipped no_estimate",
}
"""What stores of 0.5.0 hold, from 0 on."""


@pytest.mark.parametrize("kind", STORED)
def test_values_are_those_of_existing_stores_and_survive_pickling(kind):
    names = STORED[kind].split()
    assert [kind(value).name for value in range(len(names))] == names
    assert all(pickle.loads(pickle.dumps(member)) is member for member in kind)  # noqa: S301
