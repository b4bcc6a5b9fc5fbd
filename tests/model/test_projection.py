"""Poses, projection, lens and rotations against 50 digits and against OpenCV."""


import cv2
import mpmath
import numpy as np
import pytest
from mpmath import mp, mpf

from support.fifty_digits import (
    INVERTED,
    LENSES,
    doubles,
    exact_corners,
    exact_distortion,
    exact_pixels,
    exact_pose,
    values,
)
from support.lengths import lengths
from sweep.model import lens
from sweep.model.extent import areas_px
from sweep.model.pose import (
    mirrored,
)
from sweep.model.scene import build_scenes


@pytest.fixture(autouse=True)
def _fifty_digits():
    with mp.workdps(50):
        yield


# Poses and projection.


def drawn_values(count, seed, reach=np.inf, **given):
    """Draw poses over the whole of what a pipeline may ask, all corners before the camera."""
    rng = np.random.default_rng(seed)
    found = []
    while len(found) < count:
        distance = float(np.exp(rng.uniform(np.log(1e-3), np.log(1e3))))
        value = values(
            distance_m=distance, size_m=distance * float(np.exp(rng.uniform(-6, 0.5))),
            tilt_deg=rng.uniform(-90, 90), azimuth_deg=rng.uniform(-360, 360),
            roll_deg=rng.uniform(-360, 360), bearing_x_deg=rng.uniform(-60, 60),
            bearing_y_deg=rng.uniform(-60, 60), shift_u_px=rng.uniform(-1, 1),
            shift_v_px=rng.uniform(-1, 1), width_px=int(rng.integers(100, 4000)),
            height_px=int(rng.integers(100, 4000)),
        )
        if len(found) % 2:
            value |= {"fx_px": rng.uniform(100, 5000), "fy_px": rng.uniform(100, 5000),
                      "cx_px": rng.uniform(0, 4000), "cy_px": rng.uniform(0, 4000)}
        if len(found) % 4 == 1:
            value |= {"fy_px": None, "cy_px": None}
        corners = exact_corners(value)
        near = min(z for _, _, z in corners) > distance / 10
        if near and max(mp.hypot(x / z, y / z) for x, y, z in corners) < reach:
            found.append(value | given)
    return found


@lengths(40, 300)
def test_corners_are_where_fifty_digits_put_them(count):
    # Measured 6.5e-12 px: a few roundings of coordinates of up to tens of thousands of pixels.
    worst = 0.0
    for value in drawn_values(count, 1):
        found = build_scenes(value, 1).corners_px[0]
        for pair, exact in zip(found, exact_pixels(value), strict=True):
            for number, truth in zip(pair, exact, strict=True):
                error = abs(float(mpf(float(number)) - truth))
                worst = max(worst, error)
                assert error <= max(1e-9, 8 * np.spacing(abs(float(truth))))
    print(f"{count} poses: worst corner {worst:.1e} px")


@lengths(40, 300)
def test_pose_is_what_fifty_digits_say(count):
    worst = np.zeros(2)
    for value in drawn_values(count, 2):
        rotation, centre = exact_pose(value)
        scenes = build_scenes(value, 1)
        turned = np.abs(scenes.rotation[0] - doubles(rotation)).max()
        moved = np.abs(scenes.translation[0] - doubles(centre)[:, 0]).max()
        worst = np.maximum(worst, [turned, moved / float(mp.norm(centre))])
    print(f"{count} poses: worst entry of a rotation {worst[0]:.1e}, of a centre {worst[1]:.1e}")
    # Measured 6e-16 and, relative, 3e-16: a few roundings each.
    assert worst.max() < 2e-15


# The lens.

@pytest.mark.parametrize("coefficients", [(), *LENSES.values()], ids=[0, *LENSES])
def test_distortion_is_that_of_opencv(coefficients):
    rng = np.random.default_rng(3)
    points = rng.uniform(-0.7, 0.7, (1, 1000, 2))
    found = lens.distort_points(points, lens.pack(coefficients)[None])[0]
    space = np.column_stack([points[0], np.ones(1000)])
    expected = cv2.projectPoints(
        space, np.zeros(3), np.zeros(3), np.eye(3), np.array(coefficients) if coefficients else None
    )[0][:, 0]
    worst = np.abs(found - expected).max()
    print(f"worst coordinate {worst:.1e}")
    # Measured 3.3e-16: the same formulae in the same precision. 1e-12 is 1e-9 px at 1000 px.
    assert worst < 1e-12


@pytest.mark.parametrize("coefficients", LENSES.values(), ids=LENSES)
def test_distortion_and_its_jacobian_are_those_of_fifty_digits(coefficients):
    rng = np.random.default_rng(4)
    packed = lens.pack(coefficients)
    worst = [0.0, 0.0]
    for x, y in rng.uniform(-0.7, 0.7, (20, 2)).tolist():
        truth = np.array(exact_distortion(mpf(x), mpf(y), coefficients), dtype=np.float64)
        worst[0] = max(worst[0], np.abs(lens.distort(x, y, packed) - truth).max())
        slopes = [
            float(mpmath.diff(lambda a, b, i=i: exact_distortion(a, b, coefficients)[i], (x, y), n))
            for i in (0, 1)
            for n in ((1, 0), (0, 1))
        ]
        worst[1] = max(worst[1], np.abs(np.array(lens.jacobian(x, y, packed)) - slopes).max())
    print(f"worst point {worst[0]:.1e}, worst slope {worst[1]:.1e}")
    # Measured 2.2e-16 and 3.3e-16: roundings.
    assert worst[0] < 1e-14
    assert worst[1] < 1e-13


def test_undistortion_of_a_point_outside_the_lens_image_is_not_found():
    packed = lens.pack((-0.5, 0.0, 0.0, 0.0))
    reach = lens.distort(packed[23], 0.0, packed)[0]
    outside = np.array([[[reach * 1.001, 0.0], [2.0, 0.0], [0.0, -5.0]]])
    assert np.isnan(lens.undistort_points(outside, packed[None])).all()


def scanned_fold(coefficients, step=1e-4, reach=5.0):
    """First radius at which the distorted radius stops growing, or the denominator vanishes."""
    k = [*coefficients, *[0.0] * (14 - len(coefficients))]
    r = np.arange(step, reach, step)
    s = r * r
    denominator = 1 + k[5] * s + k[6] * s**2 + k[7] * s**3
    image = r * (1 + k[0] * s + k[1] * s**2 + k[4] * s**3) / denominator
    over = np.append(np.diff(image) <= 0, False) | (denominator <= 0)
    return float(r[over.argmax()]) if over.any() else np.inf


@lengths(30, 300)
def test_fold_radius_is_where_a_scan_finds_it(count):
    rng = np.random.default_rng(6)
    finite = 0
    for i in range(count):
        coefficients = rng.normal(0, 0.3, (4, 5, 8)[i % 3])
        coefficients[2:4] = 0
        expected = scanned_fold(coefficients)
        found = lens.fold_radius(tuple(coefficients.tolist()))
        if found > 4.99:
            assert expected == np.inf
            continue
        finite += 1
        assert found == pytest.approx(expected, abs=2e-4)
    print(f"{finite} of {count} lenses fold below a radius of 5")
    assert 0 < finite < count


@pytest.mark.parametrize("coefficients", [LENSES[5], INVERTED["folding barrel"],
                                          INVERTED["moustache"]])
def test_fold_is_told_beyond_its_radius_and_not_inside(coefficients):
    rng = np.random.default_rng(7)
    packed = lens.pack(coefficients)
    for _ in range(50):
        centre, turn = rng.uniform(-0.2, 0.2, 2), rng.uniform(0, 2 * np.pi)
        square = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
        cosine, sine = np.cos(turn), np.sin(turn)
        square = square @ np.array([[cosine, -sine], [sine, cosine]])
        reach = np.linalg.norm(centre + square * 0.1, axis=1).max()
        corners = (centre + square * 0.1) / reach * packed[23]
        for factor, folded in ((0.5, False), (0.9, False), (1.001, True), (2.0, True)):
            found = lens.folds(factor * corners[None], packed[None])
            assert found[0] == folded, factor


def test_fold_by_tangential_terms_is_told():
    # d(xd)/dx = 1 + 6 p2 x vanishes at x = -1 / (6 p2), where no radial term folds.
    packed = lens.pack((0.0, 0.0, 0.0, 0.5))
    square = 0.05 * np.array([[[1.0, 1], [-1, 1], [-1, -1], [1, -1]]])
    assert packed[23] == np.inf
    assert not lens.folds(square - [0.2, 0.0], packed[None])[0]
    assert lens.folds(square - [0.4, 0.0], packed[None])[0]


# Rotations.


@lengths(40, 300)
def test_mirrored_pose_is_the_second_solution_of_ippe(count):
    # OpenCV's IPPE on exact corners, in the frame in which it does not divide by zero (z away
    # from the viewer).
    worst = 0.0
    square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) / 2
    away = np.diag([1.0, -1.0, -1.0])
    rng = np.random.default_rng(10)
    for _ in range(count):
        value = values(
            distance_m=rng.uniform(2, 20), size_m=1.0, tilt_deg=rng.uniform(10, 75),
            azimuth_deg=rng.uniform(0, 360), roll_deg=rng.uniform(-40, 40),
            bearing_x_deg=rng.uniform(-30, 30), bearing_y_deg=rng.uniform(-30, 30),
        )
        scenes = build_scenes(value, 1)
        _, vectors, _, _ = cv2.solvePnPGeneric(
            square, scenes.corners_px[0], scenes.cameras.matrix(0), None, flags=cv2.SOLVEPNP_IPPE
        )
        solutions = [cv2.Rodrigues(vector)[0] @ away for vector in vectors]
        truth, mirror = scenes.rotation[0], mirrored(scenes.rotation, scenes.translation)[0]
        miss = min(
            max(np.abs(solutions[i] - truth).max(), np.abs(solutions[1 - i] - mirror).max())
            for i in (0, 1)
        )
        worst = max(worst, miss)
    print(f"{count} poses: worst entry {worst:.1e}")
    # Measured 6e-12: IPPE's own rounding, for small markers tilted little.
    assert worst < 1e-9


# Areas.

@lengths(40, 300)
def test_area_is_that_of_the_exact_quadrilateral(count):
    worst = 0.0
    for value in drawn_values(count, 11):
        corners = exact_pixels(value)
        area = abs(sum(
            x0 * y1 - x1 * y0
            for (x0, y0), (x1, y1) in zip(corners, corners[1:] + corners[:1], strict=True)
        )) / 2
        found = areas_px(build_scenes(value, 1))[0]
        side = max(mp.hypot(x0 - x1, y0 - y1) for x0, y0 in corners for x1, y1 in corners)
        worst = max(worst, float(abs(found - area) / side))
    print(f"{count} poses: worst area {worst:.1e} px times its diameter")
    # Measured 1.5e-12: the corners' own rounding.
    assert worst < 1e-10


@lengths(10, 60)
def test_area_under_a_lens_is_that_of_a_polygon_of_many_chords(count):
    worst = 0.0
    square = np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]) / 2
    t = np.arange(500)[:, None] / 500
    sides = zip(square, np.roll(square, -1, axis=0), strict=True)
    outline = np.concatenate([(1 - t) * start + t * stop for start, stop in sides])
    for value in drawn_values(count, 12, reach=0.8, distortion=LENSES[12]):
        scenes = build_scenes(value, 1)
        rotation, centre = (doubles(matrix) for matrix in exact_pose(value))
        points = cv2.projectPoints(
            value["size_m"] * outline, rotation, centre, scenes.cameras.matrix(0),
            np.array(LENSES[12]),
        )[0][:, 0]
        x, y = (points - points[0]).T
        area = 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
        worst = max(worst, abs(areas_px(scenes)[0] / area - 1))
    print(f"{count} poses: worst area {worst:.1e} of it")
    # Measured 4.5e-7: 256 chords a side cut off (1/256)² of what one chord would.
    assert worst < 5e-6
