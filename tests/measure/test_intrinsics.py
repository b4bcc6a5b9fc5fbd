"""Calibrations of points with known noise: the truth comes back, reported deviations hold it."""

import math

import numpy as np
import pytest
import scipy.stats

from support.lengths import lengths
from sweep.measure.flags import CalibrationStatus
from sweep.measure.intrinsics import INTRINSICS, calibrate

FRAME = 640, 480
TRUTH = np.array([600.0, 605.0, 322.0, 238.0, -0.2, 0.05, 0.001, -0.0005, 0.01])
BOARD = np.array([[0.03 * x - 0.09, 0.06 - 0.03 * y, 0.0] for y in range(5) for x in range(7)])


def image_of(points, camera=TRUTH):
    """Pixels (..., 2) of points in the camera frame: OpenCV's documented lens model, written out"""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = camera
    x, y = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([fx * u + cx, fy * v + cy], axis=-1)


def views(count, noise_px, draw, tilt_deg=45.0):
    """The board's points, and their pixels in views from all sides."""
    pixels = []
    for _ in range(count):
        tilt, around, roll = draw.uniform(0, math.radians(tilt_deg)), *draw.uniform(0, 6.28, 2)
        rotation = scipy.spatial.transform.Rotation.from_rotvec(
            [tilt * math.cos(around), tilt * math.sin(around), 0.0]
        ).as_matrix() @ np.diag([1.0, -1.0, -1.0]) @ scipy.spatial.transform.Rotation.from_rotvec(
            [0.0, 0.0, roll]).as_matrix()
        at = np.array([*draw.uniform(-0.05, 0.05, 2), draw.uniform(0.3, 0.5)])
        pixels.append(image_of(BOARD @ rotation.T + at) + draw.normal(0, noise_px, (35, 2)))
    return [BOARD] * count, pixels


def test_points_without_noise_give_the_camera():
    found = calibrate(*views(10, 0.0, np.random.default_rng(1)), FRAME)
    assert found.status == CalibrationStatus.calibrated
    np.testing.assert_allclose(found.values[:4], TRUTH[:4], atol=0.01)
    grid = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 9), np.linspace(-0.3, 0.3, 7), [1.0]), -1)
    assert np.abs(image_of(grid, found.values) - image_of(grid)).max() < 0.01


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
