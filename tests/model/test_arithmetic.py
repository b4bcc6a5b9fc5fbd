"""How far the arithmetic of the model can be trusted, to its extremes, against fifty digits.

The references take the very doubles that the function under test takes. Claims are rows of
pipelines/extremes/README.md. Rotations by the angles that users give are SciPy's.
"""

import itertools
import operator

import cv2
import numpy as np
import pytest
from mpmath import mp, mpf
from scipy.spatial.transform import Rotation

from support.exact_image import DEFAULTS
from support.lengths import lengths
from sweep.measure.estimation import pose_error
from sweep.model import lens
from sweep.model.exposure import areas_px
from sweep.model.pose import (
    angle_between,
    angles_of_rotation,
    rotation_of_angles,
    rotation_of_vector,
    towards,
    vector_of_rotation,
)
from sweep.model.scene import build_scenes

ANGLES = ("tilt_deg", "azimuth_deg", "roll_deg", "bearing_x_deg", "bearing_y_deg")
LENSES = {
    4: (-0.3, 0.1, 0.002, -0.001),
    5: (-0.25, 0.12, -0.001, 0.0015, -0.04),
    8: (0.6, -0.25, 0.001, -0.0008, 0.05, 0.9, -0.1, 0.02),
    12: (-0.2, 0.05, 0.001, 0.002, 0.01, 0.05, -0.02, 0.01, 0.002, -0.001, 0.0015, 0.0005),
    14: (-0.2, 0.08, 0.001, -0.0005, 0.01, 0.1, 0.02, 0.0, 0.002, -0.001, 0.0015, 0.0005, 0.05,
         -0.03),
}
BARREL, MOUSTACHE = (-0.5, 0.0, 0.0, 0.0), (0.5, -0.4, 0.0, 0.0)
PINCUSHION, RATIONAL = (0.5, 0.2, 0.0, 0.0), (8.0, 3.0, 0.0, 0.0, 0.1, 8.3, 5.0, 0.5)
DECENTRED = (0.5225, -0.3219, 0.0227, 0.0007, -0.0644)
"""Newton's method was lost at 43 degrees off its axis, where the determinant is above 0.1."""
INVERTED = (
    *LENSES.values(), BARREL, PINCUSHION, MOUSTACHE, (1.0, -1.0, 0.0, 0.0),
    (-0.4, 0.3, 0.0, 0.0, 0.2), RATIONAL, DECENTRED,
)


@pytest.fixture(autouse=True)
def _fifty_digits():
    with mp.workdps(50):
        yield


# The references.

def rotation_about(axis, angle):
    """Rodrigues' formula for a unit axis."""
    x, y, z = axis
    cross = mp.matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return mp.eye(3) + mp.sin(angle) * cross + (1 - mp.cos(angle)) * (cross * cross)


def exact_pose(value):
    """Return the rotation and the translation of a pose."""
    tilt, azimuth, roll, bearing_x, bearing_y = (mp.radians(mpf(value[name])) for name in ANGLES)
    rotation = (
        rotation_about((mp.cos(azimuth), mp.sin(azimuth), 0), tilt)
        * rotation_about((0, 0, 1), roll)
        * mp.diag([1, -1, -1])
    )
    fx, fy, _, _ = exact_camera(value)
    distance = mpf(value["distance_m"])
    centre = distance * mp.matrix([
        mp.tan(bearing_x) + mpf(value["shift_u_px"]) / fx,
        mp.tan(bearing_y) + mpf(value["shift_v_px"]) / fy,
        1,
    ])
    return rotation, centre


def exact_camera(value):
    """Return fx, fy, cx, cy."""
    width, height = value["width_px"], value["height_px"]
    if value["fx_px"] is None:
        focal = mpf(value["focal_length_mm"])
        # Of the sensor's sides neither is given: it is 4.8 mm wide, and its pixels are square.
        fx = fy = focal / mpf(4.8) * width
    else:
        fx = mpf(value["fx_px"])
        fy = fx if value["fy_px"] is None else mpf(value["fy_px"])
    cx = mpf(width - 1) / 2 if value["cx_px"] is None else mpf(value["cx_px"])
    cy = mpf(height - 1) / 2 if value["cy_px"] is None else mpf(value["cy_px"])
    return fx, fy, cx, cy


def exact_corners(value):
    """Return the black square's corners in space: TL, TR, BR, BL."""
    rotation, centre = exact_pose(value)
    half = mpf(value["size_m"]) / 2
    return [
        rotation * mp.matrix([x * half, y * half, 0]) + centre
        for x, y in ((-1, 1), (1, 1), (1, -1), (-1, -1))
    ]


def exact_pixels(value):
    fx, fy, cx, cy = exact_camera(value)
    return [(fx * x / z + cx, fy * y / z + cy) for x, y, z in exact_corners(value)]


def doubles(matrix):
    return np.array(matrix.tolist(), dtype=object).astype(np.float64)


def values(**given):
    return DEFAULTS | given


def error_of(found, truth):
    return abs(float(mpf(float(found)) - truth))


def bar_px(truth):
    """1e-9 px, or 8 units in the last place where the coordinate is so large that it has less."""
    return max(1e-9, 8 * np.spacing(abs(float(truth))))


MPMATH, BAR = "mpmath, 50 digits", "of 1e-9 px (or of 8 units in the last place)"


# Projection.

def drawn_views(rng, count):
    """fx, fy, cx, cy (N, 4): 10 to 1e5 px, principal points up to a million pixels outside."""
    focal = np.exp(rng.uniform(np.log(10), np.log(1e5), (count, 2)))
    centre = rng.choice([0.0, 1e3, 1e6], (count, 2)) * rng.uniform(-1, 1, (count, 2))
    return np.concatenate([focal, centre], axis=1)


def drawn_value(rng, bearing_deg, focal_px=None, **given):
    """A scene of any camera; up to ``bearing_deg`` off the axis, or exactly there."""
    distance = float(np.exp(rng.uniform(np.log(1e-3), np.log(1e3))))
    bearings = rng.uniform(-bearing_deg, bearing_deg, 2)
    fx, fy, cx, cy = drawn_views(rng, 1)[0].tolist()
    camera = [{"fx_px": fx, "fy_px": fy, "cx_px": cx, "cy_px": cy}, {"fx_px": fx}, {}][
        rng.integers(3)]
    if focal_px:
        camera, bearings = {"fx_px": focal_px, "cx_px": cx}, [bearing_deg, 0.0]
    return values(**{
        "distance_m": distance, "size_m": distance * float(np.exp(rng.uniform(-9, 0))),
        "tilt_deg": float(rng.choice([89.99, rng.uniform(-90, 90)])),
        "azimuth_deg": rng.uniform(-360, 360), "roll_deg": rng.uniform(-360, 360),
        "bearing_x_deg": float(bearings[0]), "bearing_y_deg": float(bearings[1]),
        "shift_u_px": rng.uniform(-1, 1), "shift_v_px": rng.uniform(-1, 1),
        "width_px": int(rng.integers(100, 4000)), "height_px": int(rng.integers(100, 4000)),
    } | camera | given)


def chain_error(value, depth=0.5):
    """Error of a scene's corners from its angles, in units of the bar; of corners deep enough."""
    scenes = build_scenes(value, 1)
    worst = 0.0
    for found, pixel, space in zip(
        scenes.corners_px[0], exact_pixels(value), exact_corners(value), strict=True
    ):
        if space[2] > depth * value["distance_m"]:
            for number, truth in zip(found, pixel, strict=True):
                worst = max(worst, error_of(number, truth) / bar_px(truth))
    return worst


@lengths(60, 1000)
def test_corners_from_angles_are_projected_to_the_bar(count, claim):
    # The tangent of a bearing in degrees is off by its argument's rounding over cos², relative:
    # f / cos² · 1.7e-16 reaches 1e-9 px at 89.3 to 89.9 degrees (f = 1e3 px), 80 to 86 (1e5 px).
    rng = np.random.default_rng(5)
    worst, pose = 0.0, np.zeros(2)
    for _ in range(count):
        value = drawn_value(rng, 60)
        worst = max(worst, chain_error(value))
        scenes, (rotation, centre) = build_scenes(value, 1), exact_pose(value)
        turned = np.abs(scenes.rotation[0] - doubles(rotation)).max()
        moved = np.abs(scenes.translation[0] - doubles(centre)[:, 0]).max()
        pose = np.maximum(pose, [turned, moved / float(mp.norm(centre))])
    claim("projected corners, from the angles, bearings to 60°", MPMATH, worst, BAR)
    assert worst <= 1
    # Measured 6e-16 and, relative, 3e-16: a few roundings each.
    assert pose.max() < 2e-15
    for focal_px, bearings in ((1e3, (70, 83, 88.9)), (1e5, (70, 75, 79.9))):
        for bearing in bearings:
            assert max(chain_error(drawn_value(rng, bearing, focal_px)) for _ in range(8)) <= 1


# The lens.

def distorted(points, packed):
    """Points (N, 2) through a packed lens."""
    return np.array([lens.distort(x, y, packed) for x, y in points])


@pytest.mark.parametrize("coefficients", [(), *LENSES.values()], ids=[0, *LENSES])
def test_distortion_and_its_jacobian_are_those_of_opencv(coefficients):
    """OpenCV's derivatives by a translation across, of points at a distance of 1."""
    points = np.random.default_rng(3).uniform(-0.7, 0.7, (1000, 2))
    packed = lens.pack(coefficients)
    expected, derivatives = cv2.projectPoints(
        np.column_stack([points, np.zeros(1000)]), np.zeros(3), np.array([0.0, 0, 1]), np.eye(3),
        np.array(coefficients) if coefficients else None,
    )
    # Measured 3.3e-16: the same formulae in the same precision. 1e-12 is 1e-9 px at 1000 px.
    assert np.abs(distorted(points, packed) - expected[:, 0]).max() < 1e-12
    found = np.array([lens.jacobian(x, y, packed) for x, y in points])
    assert np.abs(found - derivatives[:, 3:5].reshape(1000, 4)).max() < 1e-12


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
    assert 0 < finite < count


@pytest.mark.parametrize("coefficients", [LENSES[5], BARREL, MOUSTACHE])
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


def inside_the_lens(points, packed):
    """Tell for points (N, 2) whether the Jacobian stays well positive from the centre to them."""
    return np.array([
        all(a * d - b * c > 0.1
            for t in np.linspace(0, 1, 21)
            for a, b, c, d in [lens.jacobian(t * x, t * y, packed)])
        for x, y in points
    ])


def drawn_lens(rng, kind):
    """Coefficients of a wide-angle lens: 5, 8 or 14 of them, tangential ones small."""
    k = [*rng.normal(0, 0.3, 2), *rng.normal(0, 0.003, 2), rng.normal(0, 0.1)]
    k += [*rng.uniform(0, 0.5, 3)] if kind else []
    k += [*rng.normal(0, 0.003, 4), *rng.normal(0, 0.03, 2)] if kind == 2 else []
    return tuple(float(number) for number in k)


@lengths(30, 1500)
def test_no_point_inside_a_lens_is_lost(count, claim):
    # Newton's method must not give up where the distorted point, its start, lies beyond a fold
    # that the undistorted one is inside of: tangential terms fold inside the radial fold, too.
    rng = np.random.default_rng(8)
    worst = 0.0
    for coefficients in [*INVERTED, *(drawn_lens(rng, i % 3) for i in range(count))]:
        packed = lens.pack(coefficients)
        reach = min(0.99 * packed[23], 1.5)
        radius, turn = reach * np.sqrt(rng.random(100)), rng.uniform(0, 2 * np.pi, 100)
        points = np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=1)
        points = points[inside_the_lens(points, packed)]
        targets = distorted(points, packed)
        found = lens.undistort_points(targets[None], packed[None])[0]
        assert np.isfinite(found).all(), coefficients
        worst = max(worst, np.abs(found - points).max(initial=0.0))
    claim("inverse of random wide lenses, radii to 1.5 or the fold", "the points themselves",
          worst, "of the focal length")
    # Measured 5e-15: the model's rounding over its slope, of 0.1 and more.
    assert worst < 1e-12


@pytest.mark.parametrize(("coefficients", "radii"), [
    # Close to a fold the model's slope falls to 0; without one radii of 5.6 and more are lost.
    (BARREL, lens.pack(BARREL)[23] * np.array([0.9, 0.99, 0.999])),
    *((coefficients, np.array([1.0, 3.2, 5.0])) for coefficients in (PINCUSHION, RATIONAL)),
], ids=str)
def test_points_near_a_fold_and_far_off_the_axis_come_back(coefficients, radii):
    packed = lens.pack(coefficients)
    points = np.array([radii * np.cos(turn) + 1j * radii * np.sin(turn) for turn in (0, 1, 4)])
    points = np.stack([points.real, points.imag], axis=-1).reshape(-1, 2)
    found = lens.undistort_points(distorted(points, packed)[None], packed[None])[0]
    assert np.abs(found - points).max() < 1e-12 * max(1, radii.max())
    if coefficients == BARREL:  # beyond the lens' image there is none
        reach = lens.distort(packed[23], 0.0, packed)[0]
        outside = np.array([[[reach * 1.001, 0.0], [2.0, 0.0], [0.0, -5.0]]])
        assert np.isnan(lens.undistort_points(outside, packed[None])).all()


# Rotations.

AXES = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, -1), (1, 2, 3), (-3, 1, 1e-3),
        (1, -1, 1), (-1e-6, 1, 1e-9)]


def unit(axis):
    vector = mp.matrix([mpf(float(entry)) for entry in axis])
    return vector / mp.norm(vector)


def drawn_axes(rng, count):
    """Axes of every kind: along, in and off the coordinate planes, nearly so, and random."""
    kinds = [*AXES, (1, 1, 1), (1e-9, 1, 1), (1e-8, 1e-8, 1), (1e-160, 0, 1)]
    return [unit(axis) for axis in (*kinds, *rng.normal(size=(count, 3)))]


def error_of_rotation(found, truth):
    return max(error_of(found[i, j], truth[i, j]) for i, j in np.ndindex(3, 3))


@lengths(2, 60)
def test_rotations_of_vectors_are_those_of_fifty_digits_and_come_back(count, claim):
    # Measured 1.4e-15 at 4π, where the angle itself is rounded by 9e-16; 2e-16 at 1 rad.
    rng = np.random.default_rng(17)
    sizes = [1e-300, 1e-200, *10.0 ** -np.arange(164.0, 152, -1), 1e-150, 1e-100, 1e-20, 1e-12,
             1e-8, 1e-5, 1e-2, 0.1, 1.0, 2.1, 3.0, *(np.pi - 10.0 ** -np.arange(1.0, 15, 3)),
             np.pi, 2 * np.pi, 4 * np.pi]
    axes, worst, small, back = drawn_axes(rng, count), 0.0, 0.0, 0.0
    for size, axis in itertools.product(sizes, axes):
        vector = np.array([float(size * entry) for entry in axis])
        found, given = rotation_of_vector(vector), mp.matrix(vector.tolist())
        truth = rotation_about(given / mp.norm(given), mp.norm(given))
        worst = max(worst, error_of_rotation(found, truth))
        if size < 1:
            # The small entries themselves: the rotation, not the identity that it is near.
            entries = [(found[i - 1, i - 2], truth[i - 1, i - 2]) for i in range(3)]
            small = max(small, max(error_of(*entry) for entry in entries) / size)
        if 1e-150 <= size <= np.pi:  # squares of less underflow
            again = vector_of_rotation(doubles(truth))
            # A half turn's vector has either sign.
            signs = (1, -1) if size > 3.1415926 else (1,)
            off = min(np.abs(sign * again - vector).max() for sign in signs) / size
            back = max(back, off)
    claim("rotation vectors, 1e-12 rad to π, and back", "mpmath, 50 digits", back, "relative")
    assert worst < 4e-15
    assert small < 1e-15
    assert back < 2e-15


@lengths(4, 150)
def test_rotation_error_of_two_poses_is_off_by_their_last_bits_only(count, claim):
    # Storing the two rotations as doubles loses 1.3e-16 rad, their product rounded to doubles
    # 8e-16, its logarithm nothing beside: float32's 6e-8 of the error are right down to 1e-10 rad.
    rng = np.random.default_rng(16)
    worst = 0.0
    for power, _ in itertools.product((*range(13), None), range(count)):
        angle = mp.pi - mpf(10) ** -12 if power is None else mpf(10) ** -power
        axis = unit(rng.normal(size=3))
        truth = rotation_about(unit(rng.normal(size=3)), mpf(rng.uniform(0, np.pi)))
        pair = [doubles(rotation_about(axis, angle) * truth), doubles(truth)]
        found = pose_error(pair[0][None], np.ones((1, 3)), pair[1][None], np.ones((1, 3)))
        worst = max(worst, error_of(found.rotation_angle_rad[0], angle), *(
            error_of(entry, angle * along)
            for entry, along in zip(found.rotation_rad[0], axis, strict=True)))
    claim("rotation error, 1e-12 rad to π - 1e-12", "mpmath, 50 digits", worst, "rad")
    assert worst < 2e-15


def test_angle_between_vectors_keeps_its_digits_from_1e_15_to_pi():
    # Relative to the angle between the very doubles: their difference is exact where it is small.
    rng = np.random.default_rng(18)
    angles = [*10.0 ** -np.arange(16.0), 2.0, 3.0, *(np.pi - 10.0 ** -np.arange(1.0, 16)), np.pi]
    for angle in angles:
        a, aside = np.linalg.qr(rng.normal(size=(3, 3)))[0].T[:2]
        b = np.cos(angle) * a + np.sin(angle) * aside
        x, y = (list(map(mpf, vector.tolist())) for vector in (a, b))
        sine = mp.norm([x[i - 2] * y[i - 1] - x[i - 1] * y[i - 2] for i in range(3)])
        truth = mp.atan2(sine, mp.fsum(map(operator.mul, x, y)))
        assert error_of(angle_between(a, b), truth) < 1e-12 * truth


# Areas.

@lengths(40, 300)
def test_areas_are_those_of_the_exact_quadrilateral_and_under_a_lens_of_many_chords(count):
    rng = np.random.default_rng(11)
    square = np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]) / 2
    t = np.arange(500)[:, None] / 500
    outline = np.concatenate([
        (1 - t) * start + t * stop
        for start, stop in zip(square, np.roll(square, -1, axis=0), strict=True)])
    for index in range(count):
        value = drawn_value(rng, 40)
        corners = exact_pixels(value)
        area = abs(sum(
            x0 * y1 - x1 * y0
            for (x0, y0), (x1, y1) in zip(corners, corners[1:] + corners[:1], strict=True)
        )) / 2
        side = max(mp.hypot(x0 - x1, y0 - y1) for x0, y0 in corners for x1, y1 in corners)
        # Measured 1.5e-12: the corners' own rounding.
        assert abs(areas_px(build_scenes(value, 1))[0] - area) / side < 1e-10
        if index % 4:
            continue
        value = drawn_value(rng, 25, fx_px=800.0, fy_px=None, distortion=LENSES[12])
        value["size_m"] = min(value["size_m"], 0.3 * value["distance_m"])
        scenes = build_scenes(value, 1)
        rotation, centre = (doubles(matrix) for matrix in exact_pose(value))
        points, _ = cv2.projectPoints(value["size_m"] * outline, rotation, centre,
                                      scenes.cameras.matrix(0), np.array(LENSES[12]))
        x, y = (points[:, 0] - points[0, 0]).T
        area = 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
        # Measured 4.5e-7: 256 chords a side cut off (1/256)² of what one chord would.
        assert abs(areas_px(scenes)[0] / area - 1) < 5e-6

# Rotations and their angles, against SciPy's; special angles: tests/experiment/test_pose_values.py.

TOLERANCE = 4e-15
"""Of an element: some ten roundings of sines, cosines and their products, each of 1.1e-16."""


def test_tilt_azimuth_and_roll_of_a_rotation_make_it_and_lie_in_their_ranges():
    rotation = Rotation.random(5000, np.random.default_rng(2)).as_matrix()
    tilt, *around = angles_of_rotation(rotation)
    np.testing.assert_allclose(rotation_of_angles(tilt, *around), rotation, atol=TOLERANCE)
    assert ((tilt >= 0) & (tilt <= np.pi)).all()
    assert (np.abs(around) <= np.pi).all()


def test_the_smallest_rotation_to_a_line_of_sight_is_scipys():
    # Up to 89.9° off the axis, from 1 mm to 1 km away.
    rng = np.random.default_rng(4)
    off = np.radians(np.concatenate([rng.uniform(0, 89.9, 1000), [0, 1e-9, 80, 89.9]]))
    around = rng.uniform(0, 2 * np.pi, len(off))
    length = 10.0 ** rng.uniform(-3, 3, len(off))
    sight = (length * np.array(
        [np.sin(off) * np.cos(around), np.sin(off) * np.sin(around), np.cos(off)]
    )).T
    expected = [
        Rotation.align_vectors(each[None], [[0, 0, 1]])[0].as_matrix() for each in sight]
    np.testing.assert_allclose(towards(sight), expected, atol=TOLERANCE)
