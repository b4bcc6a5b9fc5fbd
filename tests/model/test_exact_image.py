"""The images of every renderer, against polygon clipping and dense sampling written anew here."""

import cv2
import numpy as np
import pytest

from support.exact_image import (
    DICTIONARIES,
    LENSES,
    clipped_image,
    modules_of,
    through_lens,
    values,
    vertices_of,
    visible,
)
from support.lengths import lengths
from sweep.model.exposure import marker_boxes
from sweep.model.renderers import beside_pixels, marker_levels, render
from sweep.model.scene import build_scenes

# Scenes, and the images of the renderers under test.


def drawn_poses(count, seed, sides, max_tilt, **given):
    """Draw visible poses: three in five are cut by the frame's left, right, top or bottom."""
    rng = np.random.default_rng(seed)
    found = []
    while len(found) < count:
        width, height = (640, 480) if len(found) % 2 else (411, 500)
        where = rng.uniform(-0.5, [width - 0.5, height - 0.5])
        if rng.random() < 0.6:
            axis = rng.integers(2)
            where[axis] = rng.choice([0, (width, height)[axis]])
        value = values(**{
            "width_px": width, "height_px": height, "fx_px": float(rng.choice([300, 800, 2000])),
            "dictionary": str(rng.choice(DICTIONARIES)), "marker_id": int(rng.integers(50)),
            "quiet_zone_modules": float(rng.choice([0, 1, 1.5])),
            "side_px": float(np.exp(rng.uniform(*np.log(sides)))),
            "tilt_deg": rng.uniform(0, max_tilt), "azimuth_deg": rng.uniform(0, 360),
            "roll_deg": rng.uniform(0, 360), "black": float(rng.integers(60)),
            "white": float(rng.integers(180, 256)), "background": float(rng.integers(180)),
        } | given)
        offset = (where - [(width - 1) / 2, (height - 1) / 2]) / value["fx_px"]
        value["bearing_x_deg"], value["bearing_y_deg"] = np.degrees(np.arctan(offset)).tolist()
        if visible(value):
            found.append(value)
    return found


def scene_of(value):
    scenes = build_scenes(value, 1)
    return scenes, marker_boxes(scenes)[0]


def levels_of(value):
    """Levels and share of the whole frame, from the renderer under test."""
    scenes, box = scene_of(value)
    frame = np.zeros((2, value["height_px"], value["width_px"]))
    frame[:, box[1] : box[3], box[0] : box[2]] = marker_levels(scenes, 0, tuple(box.tolist()))
    return frame


def frame_of(value):
    scenes, box = scene_of(value)
    return render(scenes, 0, box, (0, 0, value["width_px"], value["height_px"]))


def worst_difference(value):
    """Largest difference from clipping over all pixels of the frame, in units of a pixel."""
    expected, found = np.array(clipped_image(value)), levels_of(value)
    assert np.isfinite(found).all()
    box = 0, 0, value["width_px"], value["height_px"]
    assert beside_pixels(scene_of(value)[0], 0, box).shape == found.shape[1:]
    assert expected[1].max() > 0
    return (np.abs(expected - found).max(axis=(1, 2)) / [255, 1]).max()


TOLERANCE = 1e-11
"""Of a pixel. Measured 3.9e-13 over the long form: an area is a sum of a few terms below 1, from
coordinates below 1000 px, each off by about 1e-13 in double precision."""


@lengths(12, 200)
def test_every_pixel_equals_its_clipped_area(count, claim):
    worst = max(worst_difference(value) for value in drawn_poses(count, 1, (8, 600), 85))
    claim("every pixel of an undistorted image", "polygon clipping written in the test, 200 poses, "
          "sides 8-600 px, tilts to 85°", worst, "of a pixel")
    assert worst < TOLERANCE


@pytest.mark.parametrize("roll_deg", [0, 1e-10, 45, 90, 90 + 1e-10, 180, 270])
@pytest.mark.parametrize("shift_px", [0.0, 0.5, 0.25])
def test_vertices_and_edges_on_pixel_lines_are_no_exception(roll_deg, shift_px):
    for module_px in (1.0, 1.5, 2.0, 2.5, 6.0, 40.0):
        for dictionary, modules in (("DICT_4X4_50", 6), ("DICT_5X5_50", 7)):
            value = values(
                width_px=128, height_px=96, fx_px=1024.0, size_m=1.0, dictionary=dictionary,
                distance_m=1024.0 / (module_px * modules), roll_deg=float(roll_deg),
                shift_u_px=shift_px, shift_v_px=-shift_px, quiet_zone_modules=2.0,
            )
            assert worst_difference(value) < TOLERANCE
            if module_px.is_integer() and shift_px == 0 and roll_deg % 90 == 0 and modules == 6:
                # Every edge lies on a pixel line: no grey at all.
                white = levels_of(value)[0]
                assert np.minimum(np.abs(white), np.abs(white - 255)).max() < 255 * TOLERANCE


def test_slivers_and_specks_are_finite_and_their_clipped_area():
    rng = np.random.default_rng(3)
    for side_px in (1e-6, 1e-3, 0.3, 1.0, 3.0, 300.0, 1e4, 1e6):
        for tilt_deg in (0.0, 80.0, 89.0, 89.99, 89.9999999):
            value = values(
                side_px=side_px, tilt_deg=tilt_deg, azimuth_deg=rng.uniform(0, 360),
                roll_deg=rng.uniform(0, 360), size_m=0.1, background=99.0,
                shift_u_px=rng.uniform(-1, 1), shift_v_px=rng.uniform(-1, 1),
            )
            assert np.isfinite(levels_of(value)).all()
            if visible(value):
                # A position is rounded by 2e-16 of the largest coordinate.
                assert worst_difference(value) < max(TOLERANCE, 1e-13 * side_px)


@pytest.mark.parametrize("roll_deg", [0.0, 1e-3, 3.0, 89.0])
def test_coverage_does_not_drift_along_the_rows_of_a_wide_frame(roll_deg):
    """Edges cross a hundred thousand pixels of a row; the running sum rounds at each."""
    value = values(width_px=100_000, height_px=6, fx_px=1e5, side_px=90_000.0, roll_deg=roll_deg,
                   shift_u_px=0.3, shift_v_px=45_000.3)
    assert worst_difference(value) < 1e-9


@pytest.mark.parametrize("on_image", [False, True])
@lengths(5, 40)
def test_image_is_the_clipped_area_before_the_background_rounded_once(count, on_image, tmp_path):
    rng = np.random.default_rng(5)
    for value in drawn_poses(count, 5, (8, 600), 85):
        levels, share = clipped_image(value)
        behind = value["background"]
        if on_image:
            behind = rng.integers(0, 256, share.shape, dtype=np.uint8)
            value["background"] = str(tmp_path / f"{rng.integers(2**63)}.png")
            cv2.imwrite(value["background"], behind)
        reference = levels + (1 - share) * behind
        decided = np.abs(reference % 1 - 0.5) > 1e-6
        assert (frame_of(value)[decided] == np.floor(reference + 0.5)[decided]).all()


# The approximate renderers.

def test_half_a_level_rounds_up_beside_a_marker_and_at_the_corners_of_its_box():
    value = values(side_px=40.0, roll_deg=45.0, background=127.5)
    left, top, _, bottom = scene_of(value)[1].tolist()
    assert (frame_of(value)[[0, top, bottom - 1], [0, left, left]] == 128).all()


def paper_image(value):
    """Steps 5-8 of the paper, on the whole frame: the corners, the transform, the warp."""
    white = modules_of(value)
    n, pad = len(white) - 2, round(10 * value["quiet_zone_modules"])
    bitmap = np.kron(white[1:-1, 1:-1], np.ones((10, 10)))
    bitmap = np.pad(bitmap, pad, constant_values=1) * (value["white"] - value["black"])
    bitmap = (bitmap + value["black"]).astype(np.uint8)
    low, high = pad - 0.5, pad + 10 * n - 0.5
    corners = np.array([[low, low], [high, low], [high, high], [low, high]], dtype=np.float32)
    image = vertices_of(value)[[1, 1, -2, -2], [1, -2, -2, 1]]
    centre = np.array([value["width_px"] - 1, value["height_px"] - 1]) / 2
    flat = (image[:, :2] / image[:, 2:] - centre).astype(np.float64) / value["fx_px"]
    if value["distortion"]:
        flat = through_lens(flat, value["distortion"])
    target = (flat * value["fx_px"] + centre).astype(np.float32)
    return cv2.warpPerspective(
        bitmap, cv2.getPerspectiveTransform(corners, target),
        (value["width_px"], value["height_px"]), flags=cv2.INTER_LINEAR,
        borderValue=(value["background"],),
    )


@pytest.mark.parametrize("distortion", [(), LENSES[0]])
@lengths(10, 100)
def test_warp_is_the_image_of_the_paper(count, distortion):
    # The corners' 32-bit rounding depends on the origin of the box that is warped. OpenCV 5.0
    # interpolates at the point itself: 1 level, in 1 of 10,000 pixels of the marker. 4.14 rounds
    # it to 1/32 px of the bitmap, a step of up to 8 levels: 12 of 1.5 million took another step.
    differing = covered = 0
    given = {"renderer": "warp", "distortion": distortion}
    # Between bent corners the paper's edges are straight: a quiet zone far off the lens' own.
    wide = values(fx_px=300.0, side_px=250.0, quiet_zone_modules=1.5, background=150.0,
                  bearing_x_deg=30.0, bearing_y_deg=-15.0, **given)
    for value in [wide, *drawn_poses(count, 8, (8, 500), 85, **given)]:
        expected, found = paper_image(value).astype(int), frame_of(value).astype(int)
        assert np.abs(expected - found).max() <= 8
        differing += (np.abs(expected - found) > 1).sum()
        covered += (expected != value["background"]).sum()
    print(f"{differing} of {covered} pixels differ by more than 1 level")
    assert differing <= 1e-4 * covered


@pytest.mark.parametrize("renderer", ["supersample-8", "supersample-8-jittered"])
@pytest.mark.parametrize("distortion", [(), LENSES[1]])
@lengths(2, 40)
def test_supersampled_image_is_near_the_exact_one(count, distortion, renderer):
    # Samples on a line that is parallel to an axis miss it by up to half of 1/8 px: 16 of 255
    # levels for each edge in the pixel. Measured over the pixels with an edge, long form: worst
    # 18, rms 2.0 regular and 2.7 jittered, mean below 0.05.
    errors = []
    lens = {"distortion": distortion, "fx_px": 500.0, "fy_px": 440.0}
    for value in drawn_poses(count, 9, (20, 100), 80, **lens):
        mean, share = levels_of(value | {"renderer": renderer}) - levels_of(value)
        errors.append((mean - share * value["background"])[np.abs(mean) + np.abs(share) > 1e-9])
    error = np.concatenate(errors)
    print(f"{renderer}: worst {np.abs(error).max():.1f}, rms {np.sqrt((error**2).mean()):.2f}, "
          f"mean {error.mean():.3f} levels")
    assert np.abs(error).max() < 32
    assert np.sqrt((error**2).mean()) < 4
    assert abs(error.mean()) < 0.5
