"""Lenses, bent sheets, printed sizes, shifted images: against rays and sums written here."""

import numpy as np
import pytest

from support.blurred import frame_of
from support.exact_image import LENSES, modules_of, plane_of, values
from support.lengths import first_of
from sweep.model import lens
from sweep.model.effects import NEUTRAL
from sweep.model.exposure import (
    areas_px,
    hidden,
    marker_boxes,
    not_modelled,
    shift_waves,
)
from sweep.model.renderers import render
from sweep.model.scene import build_scenes

LEVELS = {"black": 10.0, "white": 240.0, "background": 100.0}


def scenes_of(**given):
    value = values(**(NEUTRAL | {
        "width_px": 48, "height_px": 44, "fx_px": 60.0, "size_m": 0.1, "side_px": 24.0,
    } | LEVELS | given))
    return value, build_scenes(value, 1)


def on_bent_sheet(directions, value):
    """Column and row on the flat sheet of the points that rays (n, 3) from the camera meet first
    (a bulge towards the viewer) or last (a hollow); NaN where they miss."""
    plane = plane_of(value).astype(np.float64)
    n = len(modules_of(value)) - 2
    module = np.linalg.norm(plane[:, 0])
    right, up = plane[:, 0] / module, -plane[:, 1] / module
    turn, k, bend = np.radians(value["bend_deg"]), value["curvature_per_m"], value["bend"]
    c, s = np.cos(turn), np.sin(turn)
    along = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    frame = np.column_stack([right, up, np.cross(right, up)]) @ along.T
    origin, d = frame.T @ -(plane @ [n / 2, n / 2, 1]), directions @ frame
    if bend == "cylinder":
        # x² + (z + 1/k)² = 1/k²
        a = d[:, 0] ** 2 + d[:, 2] ** 2
        b = 2 * (origin[0] * d[:, 0] + (origin[2] + 1 / k) * d[:, 2])
        c = origin[0] ** 2 + origin[2] ** 2 + 2 * origin[2] / k
    else:
        # z + k (x² - y²) / 2 = 0
        a = k / 2 * (d[:, 0] ** 2 - d[:, 1] ** 2)
        b = d[:, 2] + k * (origin[0] * d[:, 0] - origin[1] * d[:, 1])
        c = origin[2] + k / 2 * (origin[0] ** 2 - origin[1] ** 2)
    with np.errstate(invalid="ignore", divide="ignore"):
        root = np.sqrt(b * b - 4 * a * c)
        if bend == "cylinder":
            t = (-b - np.sign(k) * root) / (2 * a)
        else:
            # The root that stays finite as k goes to 0.
            t = -2 * c / (b + np.sign(b) * root)
    x, y, z = (origin + t[:, None] * d).T
    if bend == "cylinder":
        x = np.arctan2(k * x, k * z + 1) / k
    flat = np.column_stack([x, y]) @ along[:2, :2]
    return flat[:, 0] / module + n / 2, n / 2 - flat[:, 1] / module


def sampled_frame(value, per_side, shifted=None):
    """Levels of the frame by samples, each at random in its cell of a pixel."""
    rng = np.random.default_rng(8)
    shape = value["height_px"] * per_side, value["width_px"] * per_side
    v, u = (np.indices(shape) + rng.random((2, *shape))) / per_side - 0.5
    if shifted is not None:
        # What is seen at p was at q, q + shift(q) = p.
        q = np.stack([u, v], axis=-1).reshape(-1, 2)
        p = q.copy()
        for _ in range(10):
            q = p - shifted(q)
        u, v = q.T.reshape(2, *shape)
    centre = (np.array([value["width_px"], value["height_px"]]) - 1) / 2
    rays = np.stack([(u - centre[0]) / value["fx_px"], (v - centre[1]) / value["fx_px"],
                     np.ones_like(u)], axis=-1).reshape(-1, 3)
    if value["distortion"]:
        # The lens by itself is held against OpenCV and fifty digits in test_arithmetic.py.
        packed = lens.pack(value["distortion"])
        rays[:, :2] = lens.undistort_points(rays[None, :, :2], packed[None])[0]
    if value["curvature_per_m"] == 0:
        flat = rays @ np.linalg.inv(plane_of(value).astype(np.float64)).T
        column, row = (flat[:, :2] / flat[:, 2:]).T
    else:
        column, row = on_bent_sheet(rays, value)
    white, quiet = modules_of(value), value["quiet_zone_modules"]
    n = len(white) - 2
    level = np.full(len(column), value["background"])
    on = (np.minimum(column, row) > -quiet) & (np.maximum(column, row) < n + quiet)
    i, j = (np.clip(np.floor(at[on]) + 1, 0, n + 1).astype(int) for at in (row, column))
    level[on] = np.where(white[i, j], value["white"], value["black"])
    # A sheet hides a share of the black square's extent along a direction, and all beyond.
    angle = np.radians(value["occlusion_deg"])
    right, up = np.cos(angle), np.sin(angle)
    edge = n * (abs(right) + abs(up)) * (0.5 - value["occlusion"])
    behind = on & ((column - n / 2) * right - (row - n / 2) * up > edge)
    level[behind & (value["occlusion"] > 0)] = value["occluder"]
    return level.reshape(value["height_px"], per_side, -1, per_side).mean(axis=(1, 3))


def assert_sampled(found, expected, per_side):
    """An edge of 230 levels crosses n to 2n cells of a pixel of n² samples: a standard deviation
    of at most 230 sqrt(2 n / 6) / n², of which 5 hold in about 1,000 pixels of an edge."""
    deviation = 230 * np.sqrt(2 * per_side / 6) / per_side**2
    assert np.abs(found - expected).max() < 5 * deviation
    assert np.sqrt(np.mean((found - expected) ** 2)) < 0.7 * deviation
    assert abs(np.mean(found - expected)) < 0.03 * deviation + 0.01


@pytest.mark.parametrize(("distortion", "hidden_share", "hidden_deg", "levels"), [
    *((lens, 0.0, 0.0, {}) for lens in LENSES),
    ((), 0.3, 30.0, {}), ((), 0.9, -100.0, {}), (LENSES[0], 0.5, 200.0, {}),
    ((), 0.3, 30.0, {"background": 240.0, "white": 240.0}),  # the sheet hides the quiet zone, too
])
def test_an_image_under_a_lens_or_a_sheet_is_that_of_samples_traced_back(
    distortion, hidden_share, hidden_deg, levels
):
    value, _ = scenes_of(
        **levels,
        distortion=distortion, tilt_deg=35.0, azimuth_deg=70.0, roll_deg=25.0, bearing_x_deg=8.0,
        quiet_zone_modules=1.5, occlusion=hidden_share, occlusion_deg=hidden_deg, occluder=170.0,
    )
    assert_sampled(frame_of(value), sampled_frame(value, 16), 16)


@pytest.mark.parametrize("curve", first_of([
    ("cylinder", -6.0, 30.0, 0.0), ("saddle", 5.0, 20.0, 25.0), ("cylinder", 1e-6, 10.0, 40.0),
    ("cylinder", 10.0, -100.0, 20.0), ("saddle", -3.0, 0.0, 50.0),
], 3))
def test_bent_marker_is_what_rays_meet(curve):
    bend, curvature, bend_deg, tilt_deg = curve
    value, scenes = scenes_of(
        bend=bend, curvature_per_m=curvature, bend_deg=bend_deg, tilt_deg=tilt_deg,
        azimuth_deg=40.0, roll_deg=15.0,
    )
    assert not not_modelled(scenes)[0]
    assert_sampled(frame_of(value), sampled_frame(value, 16), 16)


def test_true_pose_and_corners_are_those_of_the_tangent_plane():
    value, scenes = scenes_of(
        curvature_per_m=5.0, geometry_px=1.0, marker_scale=1.1, tilt_deg=30.0
    )
    flat = build_scenes(values(**(value | NEUTRAL)), 1)
    for name in ("corners_px", "rotation", "translation", "size_m"):
        assert np.array_equal(getattr(scenes, name), getattr(flat, name))
    assert np.array_equal(areas_px(scenes), areas_px(flat))


@pytest.mark.parametrize("distortion", [(), LENSES[0]])
def test_a_printed_size_is_that_of_a_larger_marker_at_the_same_distance(distortion):
    given = {"tilt_deg": 40.0, "roll_deg": 10.0, "distortion": distortion, "distance_m": 0.25}
    value, scenes = scenes_of(marker_scale=1.25, side_px=None, **given)
    _, larger = scenes_of(size_m=0.125, side_px=None, **given)
    window = (0, 0, 48, 44)
    assert np.array_equal(
        render(scenes, 0, marker_boxes(scenes)[0], window),
        render(larger, 0, marker_boxes(larger)[0], window),
    )
    nominal = build_scenes(value | {"marker_scale": 1.0}, 1)
    assert areas_px(scenes) == pytest.approx(areas_px(nominal), rel=1e-9)


# Where a bent sheet hides a part of itself, it has no image here.

@pytest.mark.parametrize(("curvature", "given", "modelled"), [
    (10.0, {}, True),  # radius = side: half a side turns by 0.5 rad, 0.64 with the quiet zone
    (20.0, {}, True), (26.0, {}, False),  # the quiet zone's rim turns by 1.67 rad
    (10.0, {"tilt_deg": 40.0}, True), (10.0, {"tilt_deg": 70.0}, False),
    (-10.0, {"tilt_deg": 70.0}, False),  # the near rim of a hollow hides its inside
    (1e6, {}, False),
    (-9.0, {"size_m": 0.3, "side_px": 200.0, "fx_px": 60.0}, False),  # around the camera
])
def test_a_sheet_that_hides_a_part_of_itself_is_not_modelled(curvature, given, modelled):
    # Seen from far: a part turned by more than 90° from the line of sight is seen from behind.
    _, scenes = scenes_of(curvature_per_m=curvature, **{"bend_deg": 90.0, "fx_px": 6000.0} | given)
    assert not hidden(scenes)[0]
    assert not_modelled(scenes)[0] != modelled


@pytest.mark.parametrize("bend_deg", [0.0, 45.0, 135.0])
def test_a_sheet_begins_to_hide_itself_alike_from_opposite_sides(bend_deg):
    def limit(azimuth_deg):
        low, high = 1.0, 60.0
        while high / low > 1.0001:
            middle = (low * high) ** 0.5
            _, scenes = scenes_of(curvature_per_m=middle, bend_deg=bend_deg, fx_px=6000.0,
                                  tilt_deg=40.0, azimuth_deg=azimuth_deg)
            low, high = (low, middle) if not_modelled(scenes)[0] else (middle, high)
        return high

    assert limit(45.0) == pytest.approx(limit(225.0), rel=1e-3)
    assert limit(135.0) == pytest.approx(limit(315.0), rel=1e-3)


# Shifts of the image.

def shift_of(waves):
    """The field that waves (2, M, 4) are: points (n, 2) to shifts (n, 2)."""
    def shift(points):
        phase = points @ waves[:, :, :2].transpose(0, 2, 1)
        return np.sum(waves[:, None, :, 2] * np.cos(phase) + waves[:, None, :, 3] * np.sin(phase),
                      axis=2).T
    return shift


@pytest.mark.parametrize("fields", first_of([
    {"geometry": (0.4, 20.0)}, {"geometry": (0.4, 30.0), "edge": (0.3, 4.0)},
    {"geometry": (1.5, 15.0)}, {"geometry": (8.0, 400.0)},
], 2))
def test_shifted_image_is_that_of_samples_shifted_by_each_field(fields):
    given = {}
    for name, (spread_px, length_px) in fields.items():
        given |= {f"{name}_px": spread_px, f"{name}_length_px": length_px}
    value, scenes = scenes_of(
        noise_key=77, tilt_deg=30.0, roll_deg=15.0, width_px=28, height_px=26, side_px=14.0, **given
    )
    assert not not_modelled(scenes)[0]
    keys = {name: scenes.patch(0, 0, 0).stream_key(f"{name}_px") for name in fields}
    waves = [shift_of(shift_waves(*field, keys[name])) for name, field in fields.items()]
    expected = sampled_frame(value, 6, lambda points: sum(wave(points) for wave in waves))
    assert_sampled(frame_of(value), expected, 6)


def test_shifts_are_normal_and_correlated_as_said():
    # 4,000 frames; means of squares have a standard error of 1.41/sqrt(8,000) = 1.6 %, products
    # of points at a distance less than that: 5.5 % are beyond an error probability of 1e-6.
    at = np.array([[0.0, 0.0], [30.0, 40.0], [500.0, 0.0]])
    drawn = np.array([shift_of(shift_waves(2.0, 50.0, np.uint64(key)))(at) for key in range(4000)])
    second = np.einsum("kpi,kqi->pq", drawn, drawn) / drawn[:, 0].size
    distance = np.linalg.norm(at[:, None] - at[None], axis=2)
    assert np.abs(second / 4 - np.exp(-0.5 * (distance / 50) ** 2)).max() < 0.055
    across = np.mean(drawn[:, 0, 0] * drawn[:, 0, 1]) / 4
    assert abs(across) < 5 / np.sqrt(4000)
    # Normal: the share within one standard deviation is 0.6827 ± 5 x 0.0030 (24,000, correlated
    # in pairs).
    assert abs(np.mean(np.abs(drawn) < 2) - 0.6827) < 0.02


def test_shifts_that_fold_the_image_are_not_modelled():
    _, scenes = scenes_of(geometry_px=40.0, geometry_length_px=5.0)
    assert not_modelled(scenes)[0]
    _, scenes = scenes_of(geometry_px=40.0, geometry_length_px=2000.0)
    assert not not_modelled(scenes)[0]
