"""Covariances of poses from corners, squared deviations, and the arithmetic of the likelihood."""

import math

import cv2
import mpmath
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, kstest

from support.exact_image import LENSES
from sweep.measure.covariance import corner_covariance, squared_deviations
from sweep.measure.likelihood import mirrored_state, solve_positive, state_of, turn_between
from sweep.model.camera import Cameras
from sweep.model.lens import pack
from sweep.model.pose import mirrored

CORNERS = np.array([[-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0], [-0.5, -0.5, 0]])


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


def image_of(step, rotation, translation, size_m, view, lens):
    """OpenCV's image (8,) of a marker that is turned and shifted in the camera frame."""
    turned = Rotation.from_rotvec(step[:3]).as_matrix() @ rotation
    points = (CORNERS * size_m) @ turned.T + translation + step[3:]
    camera = np.array([[view[0], 0, view[2]], [0, view[1], view[3]], [0, 0, 1]])
    zero = np.zeros(3)
    pixels, _ = cv2.projectPoints(points, zero, zero, camera, np.array(lens) if lens else None)
    return pixels.ravel()


def slopes_of(rotation, translation, size_m, view, lens):
    """OpenCV's image differentiated by six central differences of the fourth order, (8, 6)."""
    slopes = np.empty((8, 6))
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-3 * (translation[2] if k > 2 else 1.0)
        near, far = (
            image_of(share * step, rotation, translation, size_m, view, lens)
            - image_of(-share * step, rotation, translation, size_m, view, lens)
            for share in (1, 2)
        )
        slopes[:, k] = (8 * near - far) / (12 * step[k])
    return slopes


def scaled(covariance, size_m):
    unit = np.repeat([1.0, size_m], 3)
    return covariance / np.outer(unit, unit)


def off(found, expected):
    """The largest difference of two covariances in units of the standard deviations."""
    spread = np.sqrt(np.diagonal(expected, axis1=-2, axis2=-1))
    return np.abs((found - expected) / (spread[..., :, None] * spread[..., None, :])).max()


@pytest.mark.parametrize("lens", [(), *LENSES], ids=len)
def test_covariance_is_the_pseudo_inverse_of_opencvs_projection_differentiated(lens):
    rotation, translation, view = drawn_poses(40, 1)
    size_m, noise_px = np.full(40, 0.1), 0.3
    found = corner_covariance(rotation, translation, cameras_of(view, lens), size_m, noise_px)
    assert found.shape == (40, 6, 6)
    worst = 0.0
    for n in range(40):
        slopes = slopes_of(rotation[n], translation[n], 0.1, view[n], lens)
        unit = np.repeat([1.0, 0.1], 3)
        inverse = np.linalg.pinv(slopes * unit, rcond=1e-12)
        expected = noise_px**2 * (inverse @ inverse.T) * np.outer(unit, unit)
        worst = max(worst, off(found[n], expected))
    print(f"\nlens of {len(lens)}: worst difference {worst:.1e} of the deviations")
    # Differences of the fourth order leave 1e-12 · (fifth derivatives), rounding 1e-13 px / 1e-3.
    assert worst < 1e-6


def test_covariance_is_that_of_mpmaths_derivatives():
    """The projection written out in 40 digits, differentiated there, inverted there."""
    rotation, translation, view = drawn_poses(3, 2)
    found = corner_covariance(rotation, translation, cameras_of(view), np.full(3, 0.1), 1.0)
    with mpmath.workdps(40):
        for n in range(3):
            start, centre = mpmath.matrix(rotation[n].tolist()), translation[n].tolist()

            def pixel(step, corner, axis, start=start, centre=centre, n=n):
                cross = mpmath.matrix([
                    [0, -step[2], step[1]], [step[2], 0, -step[0]], [-step[1], step[0], 0],
                ])
                # exp to the second order: exact for first derivatives at 0.
                turned = (mpmath.eye(3) + cross + cross * cross / 2) * start
                point = turned * mpmath.matrix((CORNERS[corner] * 0.1).tolist())
                place = [point[i] + centre[i] + step[3 + i] for i in range(3)]
                return view[n][axis] * place[axis] / place[2]

            slopes = mpmath.matrix(8, 6)
            for line in range(8):
                for k in range(6):
                    slopes[line, k] = mpmath.diff(
                        lambda t, k=k, line=line: pixel(
                            [t if i == k else mpmath.mpf(0) for i in range(6)],
                            line // 2, line % 2,
                        ), 0,
                    )
            inverse = (slopes.T * slopes) ** -1
            expected = np.array(inverse.tolist(), dtype=float).reshape(6, 6)
            assert off(found[n], expected) < 1e-9


def test_covariance_is_symmetric_positive_definite_and_grows_with_the_noise():
    rotation, translation, view = drawn_poses(50, 3)
    size_m = np.full(50, 0.1)
    one = corner_covariance(rotation, translation, cameras_of(view), size_m, 1.0)
    assert off(one, np.swapaxes(one, 1, 2)) < 1e-9
    assert all(np.linalg.eigvalsh(scaled(matrix, 0.1)).min() > 0 for matrix in one)
    half = corner_covariance(rotation, translation, cameras_of(view), size_m, 0.5)
    np.testing.assert_allclose(half, one / 4, rtol=1e-12)
    none = corner_covariance(rotation, translation, cameras_of(view), size_m, 0.0)
    assert (none == 0).all()


@pytest.mark.parametrize("size_m", [1e-9, 1e-3, 1.0, 1e3, 1e9])
def test_covariance_of_equal_images_scales_with_the_markers_size(size_m):
    rotation, translation, view = drawn_poses(20, 4)
    for lens in ((), LENSES[2]):
        cameras = cameras_of(view, lens)
        base = corner_covariance(rotation, translation, cameras, np.full(20, 0.1), 0.2)
        found = corner_covariance(
            rotation, translation * (size_m / 0.1), cameras, np.full(20, size_m), 0.2
        )
        # Up to a condition of 1e7 times the last bits of what is scaled.
        assert off(scaled(found, size_m / 0.1), base) < 1e-8


def test_no_poses_have_no_covariances():
    found = corner_covariance(
        np.empty((0, 3, 3)), np.empty((0, 3)), cameras_of(np.empty((0, 4))), np.empty(0), 1.0
    )
    assert found.shape == (0, 6, 6)
    assert squared_deviations(np.empty((0, 3)), np.empty((0, 3)), found).shape == (0,)


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


# Squared deviations.

def random_covariances(count, seed):
    """Positive definite (count, 6, 6), with the units of radians and of anything from mm to km."""
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(count, 6, 6))
    unit = np.concatenate(
        [10 ** rng.uniform(-6, 0, (count, 3)), 10 ** rng.uniform(-9, 4, (count, 3))], axis=1
    )
    factor *= unit[:, :, None]
    return factor @ np.swapaxes(factor, 1, 2), factor


def test_squared_deviations_are_those_of_extended_precision():
    covariance, factor = random_covariances(60, 1)
    rng = np.random.default_rng(2)
    error = (factor @ rng.normal(size=(60, 6, 1)))[..., 0]
    found = squared_deviations(error[:, :3], error[:, 3:], covariance)
    with mpmath.workdps(60):
        for n in range(60):
            vector = mpmath.matrix(error[n].tolist())
            solved = mpmath.lu_solve(mpmath.matrix(covariance[n].tolist()), vector)
            expected = float((vector.T * solved)[0])
            spread = np.sqrt(np.diag(covariance[n]))
            condition = np.linalg.cond(covariance[n] / np.outer(spread, spread))
            assert found[n] == pytest.approx(expected, rel=1e-15 * condition + 1e-12)


def test_squared_deviations_are_known_where_the_covariance_is_diagonal():
    covariance = np.diag([1.0, 4, 9, 1e-6, 1e-12, 1e6])[None]
    error = np.array([[1.0, 2, 6, 1e-3, 3e-6, 0]])
    found = squared_deviations(error[:, :3], error[:, 3:], covariance)
    assert found[0] == pytest.approx(1 + 1 + 4 + 1 + 9)


def test_squared_deviations_are_nan_where_an_input_is_and_nowhere_else():
    covariance, factor = random_covariances(7, 3)
    error = factor[:, :, 0].copy()
    alone = squared_deviations(error[:, :3], error[:, 3:], covariance)
    error[1, 0] = error[2, 5] = np.nan
    covariance[3] = np.nan
    covariance[4, 2, 1] = np.nan
    found = squared_deviations(error[:, :3], error[:, 3:], covariance)
    assert np.isnan(found[[1, 2, 3, 4]]).all()
    np.testing.assert_allclose(found[[0, 5, 6]], alone[[0, 5, 6]], rtol=1e-9)
    nothing = squared_deviations(error[1:4, :3], error[1:4, 3:], covariance[1:4])
    assert np.isnan(nothing).all()


def test_squared_deviations_of_gaussian_errors_are_chi_square_of_six():
    covariance, factor = random_covariances(20_000, 4)
    rng = np.random.default_rng(5)
    error = (factor @ rng.normal(size=(20_000, 6, 1)))[..., 0]
    spread = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    correlation = covariance / (spread[:, :, None] * spread[:, None, :])
    sound = np.linalg.cond(correlation) < 1e8
    assert sound.mean() > 0.99
    found = squared_deviations(error[sound, :3], error[sound, 3:], covariance[sound])
    assert kstest(found, chi2(6).cdf).pvalue > 0.01


def test_corners_with_gaussian_errors_give_poses_whose_deviations_are_chi_square_of_six():
    """One Gauss-Newton step from the truth is the linear estimate that the covariance is of."""
    rng = np.random.default_rng(6)
    rotation, translation, view = drawn_poses(60, 7)
    noise_px = 0.2
    size_m = np.full(60, 0.1)
    covariance = corner_covariance(
        rotation, translation, cameras_of(view, LENSES[0]), size_m, noise_px
    )
    errors, covariances = [], []
    for n in range(60):
        unit = np.repeat([1.0, 0.1], 3)
        slopes = slopes_of(rotation[n], translation[n], 0.1, view[n], LENSES[0]) * unit
        noise = rng.normal(scale=noise_px, size=(8, 50))
        errors.append((np.linalg.pinv(slopes, rcond=1e-12) @ noise).T * unit)
        covariances.append(np.broadcast_to(covariance[n], (50, 6, 6)))
    error = np.concatenate(errors)
    found = squared_deviations(error[:, :3], error[:, 3:], np.concatenate(covariances))
    assert kstest(found, chi2(6).cdf).pvalue > 0.01


# The solver of positive definite systems.

def test_positive_definite_systems_are_solved_whatever_their_scale():
    rng = np.random.default_rng(8)
    for trial in range(300):
        n, columns = int(rng.integers(1, 11)), int(rng.integers(1, 5))
        factor = rng.normal(size=(n, 2 * n))
        plain = factor @ factor.T
        right = rng.normal(size=(n, columns))
        expected = np.linalg.solve(plain, right)
        # A power of two of each unknown changes no digit: those of x do exactly the inverse.
        most = (0, 3, 30, 500)[trial % 4]
        power = rng.integers(-most, most + 1, size=n)
        matrix = np.ldexp(plain, power[:, None] + power)
        # Up to 1e±150 on each unknown, 1e±300 on the diagonal.
        scaled_right = np.ldexp(right, power[:, None])
        before = matrix.copy()
        assert solve_positive(matrix, scaled_right)
        np.testing.assert_array_equal(matrix, before)
        found = np.ldexp(scaled_right, power[:, None])
        bound = 1e-14 * np.linalg.cond(plain) * np.abs(expected).max()
        assert np.abs(found - expected).max() < bound


def test_inverse_of_a_positive_definite_matrix_is_its_solution_of_the_identity():
    rng = np.random.default_rng(9)
    factor = rng.normal(size=(6, 12))
    inverse = np.eye(6)
    assert solve_positive(factor @ factor.T, inverse)
    np.testing.assert_allclose(inverse, np.linalg.inv(factor @ factor.T), rtol=1e-9, atol=1e-12)


NOT_POSITIVE = {
    "zero": np.zeros((3, 3)),
    "one row of zeros": np.diag([1.0, 0.0, 1.0]),
    "negative": -np.eye(3),
    "indefinite": np.array([[1.0, 2.0], [2.0, 1.0]]),
    "singular": np.ones((4, 4)),
    "of rank two": np.array([[1.0, 0, 1], [0, 1, 1], [1, 1, 2]]),
    "singular and small": np.ones((4, 4)) * 1e-200,
    "all but singular": np.array([[1.0, 1.0], [1.0, 1.0 + 1e-14]]),
    "NaN": np.full((3, 3), np.nan),
    "NaN on the diagonal": np.diag([1.0, np.nan, 1.0]),
    "NaN beside the diagonal": np.array([[1.0, np.nan], [np.nan, 1.0]]),
    "infinite": np.diag([1.0, np.inf]),
    "infinite beside the diagonal": np.array([[1.0, np.inf], [np.inf, 1.0]]),
}


@pytest.mark.parametrize("matrix", NOT_POSITIVE.values(), ids=NOT_POSITIVE)
def test_what_is_not_positive_definite_is_told_and_not_solved(matrix):
    right = np.arange(2.0 * len(matrix)).reshape(-1, 2)
    before = right.copy()
    assert not solve_positive(matrix.copy(), right)
    np.testing.assert_array_equal(right, before)


# Rotations.

def state(rotation, translation=(0.0, 0.0, 1.0)):
    return state_of(np.asarray(rotation), np.array(translation), 0.0, np.zeros(3))


def test_turn_between_two_states_is_the_angle_that_one_was_turned_by():
    rng = np.random.default_rng(10)
    for angle in (0.0, 1e-12, 1e-9, 1e-6, 1e-3, 0.1, 1.0, 2.0, 3.0, math.pi - 1e-6, math.pi):
        for _ in range(20):
            axis = rng.normal(size=3)
            axis /= np.linalg.norm(axis)
            start = Rotation.random(rng=rng).as_matrix()
            with mpmath.workdps(40):
                cross = mpmath.matrix([
                    [0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0],
                ])
                length = mpmath.sqrt(sum(mpmath.mpf(part) ** 2 for part in axis.tolist()))
                cross /= length
                turn = (mpmath.eye(3) + mpmath.sin(angle) * cross
                        + (1 - mpmath.cos(angle)) * cross * cross)
                end = turn * mpmath.matrix(start.tolist())
                end = np.array(end.tolist(), dtype=float).reshape(3, 3)
            first, second = state(start), state(end)
            # Matrices are right to some 1e-16 each, whatever the angle.
            assert turn_between(second, first) == pytest.approx(angle, abs=2e-15)
            assert turn_between(first, second) == pytest.approx(angle, abs=2e-15)


def test_mirrored_state_is_the_mirrored_pose_and_twice_mirrored_the_pose():
    rotation, translation, _ = drawn_poses(50, 11)
    expected = mirrored(rotation, translation)
    for n in range(50):
        before = state_of(rotation[n], translation[n], 0.7, np.array([1.0, 2.0, 3.0]))
        given = before.copy()
        found = mirrored_state(given)
        np.testing.assert_array_equal(given, before)
        np.testing.assert_allclose(found[:9].reshape(3, 3), expected[n], atol=1e-15)
        np.testing.assert_array_equal(found[9:], before[9:])
        np.testing.assert_allclose(mirrored_state(found), before, atol=1e-15)


def test_mirrored_state_is_a_rotation_whose_normal_is_reflected_at_the_line_of_sight():
    rotation, translation, _ = drawn_poses(50, 12)
    for n in range(50):
        found = mirrored_state(state(rotation[n], translation[n]))[:9].reshape(3, 3)
        np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(found) == pytest.approx(1)
        sight = translation[n] / np.linalg.norm(translation[n])
        before, after = rotation[n][:, 2], found[:, 2]
        # Equally far from the line of sight, on its other side.
        assert after @ sight == pytest.approx(before @ sight)
        np.testing.assert_allclose(
            after - (after @ sight) * sight, -(before - (before @ sight) * sight), atol=1e-14
        )
        # The corners' first-order image at the centre, across the line of sight, is the same.
        across = np.eye(3) - np.outer(sight, sight)
        np.testing.assert_allclose(across @ found[:, :2], across @ rotation[n][:, :2], atol=1e-14)
