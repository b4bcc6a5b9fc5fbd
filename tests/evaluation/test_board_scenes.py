"""Boards of pipelines have the images of their parts, each clipped to each pixel."""

import cv2
import numpy as np
import pytest

from support.board_pictures import KINDS, NAME, SIZE_M, clipped_frame, parts
from support.lengths import first_of, lengths
from support.small_scenes import image_of, scenes_of
from sweep.model.board import extent_of, in_space
from sweep.model.exposure import marker_boxes, marker_exposure
from sweep.model.renderers import marker_levels

LEVELS = {"black": 20.3, "white": 230.1, "background": 90.4}
SIZE = (96, 80)

MARKER = {
    "seed": 3, "marker": {"dictionary": NAME, "size_m": SIZE_M}, "scene": LEVELS,
    "camera": {"width_px": SIZE[0], "height_px": SIZE[1], "fx_px": 110, "fy_px": 105},
    "estimator": {"solver": "iterative"}, "pose": {"distance_m": 0.2},
}


def board_of(name):
    """A pipeline with a board of ``KINDS``, or with one as declared."""
    return MARKER | {"board": KINDS[name] if isinstance(name, str) else name}


def drawn(count, seed):
    """Poses as settings, some cut by the frame."""
    rng = np.random.default_rng(seed)
    return [
        [f"distance_m={rng.uniform(0.1, 0.5)}", f"tilt_deg={rng.uniform(0, 75)}",
         f"azimuth_deg={rng.uniform(0, 360)}", f"roll_deg={rng.uniform(0, 360)}",
         f"bearing_x_deg={rng.uniform(-20, 20)}", f"bearing_y_deg={rng.uniform(-15, 15)}"]
        for _ in range(count)
    ]


def shown(scenes):
    """Whether all of a board lies well before the camera and faces it."""
    outline = in_space(extent_of(scenes.targets[0]).sheet[None], scenes.plane)
    return (
        outline[..., 2].min() > 0.03
        and scenes.rotation[0, :, 2] @ scenes.translation[0] < 0
    )


def expected(name, scenes, hides=None):
    return clipped_frame(
        name, LEVELS, scenes.cameras.view[0], scenes.rotation[0], scenes.translation[0], SIZE,
        hides,
    )


def exact_levels(scenes, areas=None):
    """Levels (h, w) of the frame before quantisation."""
    box = marker_boxes(scenes)[0]
    frame = np.full((SIZE[1], SIZE[0]), LEVELS["background"])
    if box[2] > box[0]:
        if areas is None:
            mean, share = marker_levels(scenes, 0, tuple(box.tolist()))
            inner = mean + (1 - share) * LEVELS["background"]
        else:
            inner = marker_exposure(scenes, 0, tuple(box.tolist()), areas)
        frame[box[1] : box[3], box[0] : box[2]] = inner
    return frame


@pytest.mark.parametrize("name", first_of(["beside", *(k for k in KINDS if k != "beside")], 4))
@lengths(1, 40)
def test_every_pixel_of_a_board_is_its_clipped_area(name, count, claim):
    compared, worst = 0, 0.0
    for settings in drawn(4 * count, 1):
        scenes = scenes_of(settings, board_of(name))
        if not shown(scenes) or compared == count:
            continue
        compared += 1
        # The plain image (one call for all its scenes), and the levels before quantisation.
        clipped = expected(name, scenes)
        worst = max(worst, np.abs(exact_levels(scenes) - clipped).max())
        image = image_of(settings, text=board_of(name))
        off = np.abs(image - clipped)
        assert off.max() < 0.5 + 255e-9
    claim("pixels of a board (seven layouts, one with distractors)", "polygon clipping, 280 poses",
          worst, "grey levels")
    assert compared == count
    assert worst < 255e-9


@pytest.mark.parametrize("name", first_of(KINDS, 1))
@lengths(2, 20)
def test_an_occluded_board_is_its_clipped_parts_and_the_sheet(name, count):
    rng = np.random.default_rng(4)
    compared = 0
    for pose in drawn(4 * count, 2):
        share, angle = rng.choice([0.1, 0.3, 0.7]), float(rng.choice([0.0, 90.0, 37.0, -140.0]))
        settings = [*pose, f"occlusion={share}", f"occlusion_deg={angle}", "occluder=150"]
        scenes = scenes_of(settings, board_of(name))
        if not shown(scenes) or compared == count:
            continue
        compared += 1
        # The sheet hides a share of the width of what is black.
        points = np.concatenate([
            corners for corners, level, _ in parts(name, LEVELS, beside=False)
            if level == LEVELS["black"]
        ])
        low, high = points.min(axis=0), points.max(axis=0)
        normal = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
        limit = normal @ (low + high) / 2 + (high - low) @ np.abs(normal) * (0.5 - share)
        areas = np.array([LEVELS["background"], LEVELS["black"], LEVELS["white"], 150.0])
        found = exact_levels(scenes, areas)
        assert np.abs(found - expected(name, scenes, (normal, limit, 150.0))).max() < 255e-9
    assert compared == count


ROUND = [f"{key}={round(level)}" for key, level in LEVELS.items()]
"""Levels that 8 bits have."""

LENS = "distortion=[-0.25, 0.08, 0.001, -0.0008]"


def test_an_image_behind_a_board_shows_beside_it_and_alone_where_there_is_none(tmp_path):
    noise = np.random.default_rng(5).integers(0, 256, (SIZE[1], SIZE[0])).astype(np.uint8)
    path = tmp_path / "behind.png"
    cv2.imwrite(str(path), noise)
    behind, text = f"background='{path}'", board_of("charuco")
    facing = ["distance_m=0.25", *ROUND]
    found, plain = image_of([*facing, behind], text=text), image_of(facing, text=text)
    # 126 mm of sheet at 0.25 m: 55.4 px wide about 47.5, 52.9 px high about 39.5.
    beside = np.ones_like(noise, dtype=bool)
    beside[13:67, 19:77] = False
    np.testing.assert_array_equal(found[beside], noise[beside])
    np.testing.assert_array_equal(found[14:65, 21:75], plain[14:65, 21:75])
    for out in ("bearing_x_deg=80", "bearing_y_deg=-80"):
        np.testing.assert_array_equal(image_of([*facing, behind, out], text=text), noise)
        assert (image_of([*facing, out], text=text) == 90).all()


SINGLE = {
    "grid": {"kind": "grid", "rows": 1, "columns": 1, "gap_m": 0.01},
    "markers": {"kind": "markers", "markers": [{"marker_id": 0, "x_m": 0, "y_m": 0}]},
}
WITH = (
    ["blur_px=0.7", "noise_grey=3"], [LENS], ["renderer='warp'"], ["renderer='supersample-4'"],
    ["curvature_per_m=6", LENS, "blur_px=0.5", "occlusion=0.2"], ["background=230.1"],
    ["curvature_per_m=5", "bend_deg=30", "geometry_px=0.8", "geometry_length_px=40"],
    ["velocity_x_m_s=0.3", "exposure_s=0.01", "marker_scale=1.02", "jpeg_quality=70"],
)


@pytest.mark.parametrize("settings", WITH)
@pytest.mark.parametrize("kind", SINGLE)
def test_a_board_of_one_marker_is_that_marker_to_the_bit(settings, kind):
    poses = [["distance_m=0.06", "tilt_deg=40", "azimuth_deg=70", "roll_deg=200"],
             ["distance_m=0.1", "bearing_x_deg=20", "tilt_deg=10"]]
    for pose in poses:
        single = image_of([*pose, *settings], text=MARKER)
        board = image_of([*pose, *settings], text=board_of(SINGLE[kind]))
        assert np.ptp(single) > 100
        np.testing.assert_array_equal(board, single)


@pytest.mark.parametrize("settings", [["blur_px=0.8", "bayer=RGGB"], ["tilt_deg=60"]])
@pytest.mark.parametrize("z", [0.0, 0.004])
def test_markers_outside_the_frame_widen_no_window(settings, z):
    """The image is that of the frame's marker alone, and so is the box, up to 3 px."""
    alone, many = (
        board_of({"kind": "markers", "markers": [
            {"marker_id": k, "x_m": x, "y_m": 0.0, "z_m": z if k else 0.0}
            for k, x in enumerate(places)
        ]}) for places in ((0.0,), (0.0, -3.6, -0.4, 0.4, 0.8, 3.2))
    )
    one, several = (marker_boxes(scenes_of(settings, each))[0] for each in (alone, many))
    assert np.abs(one - several).max() <= 3
    assert one[2] - one[0] < 0.7 * SIZE[0]
    np.testing.assert_array_equal(image_of(settings, text=alone), image_of(settings, text=many))
