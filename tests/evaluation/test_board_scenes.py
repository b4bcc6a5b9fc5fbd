"""Boards in scenes: images of their parts, each clipped to each pixel; distractors; AprilGrids."""

import numpy as np
import pytest

from support.blocks import run_block, run_cells
from support.board_pictures import KINDS, NAME, SIZE_M, clipped_frame, parts
from support.lengths import first_of, lengths
from support.small_scenes import image_of, scenes_of
from sweep.evaluation.search import visibility_flags
from sweep.experiment.grid import Block
from sweep.experiment.pipeline import Pipeline
from sweep.measure.classify import target_scenes
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.model.board import extent_of, in_space
from sweep.model.exposure import marker_boxes, marker_exposure
from sweep.model.renderers import marker_levels
from sweep.model.scene import build_scenes

# Boards of pipelines have the images of their parts, each clipped to each pixel.

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


LENS = "distortion=[-0.25, 0.08, 0.001, -0.0008]"


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

# Distractors beside a target are in its image and in the search, and count for nothing else.

SQUARES = {"kind": "grid", "rows": 2, "columns": 2, "gap_m": 0.01}
BOARD_ID = {"marker_id": 2, "x_m": 0.11, "y_m": 0.0}
SQUARE = {"x_m": -0.1, "y_m": 0.02, "size_m": 0.03, "roll_deg": 20.0}
OTHER = {"marker_id": 30, "x_m": 0.0, "y_m": 0.1}
BESIDE = [BOARD_ID, SQUARE, OTHER]


def distracted(board, *settings, **sections):
    return Pipeline.from_dict({
        "seed": 5,
        "camera": {"width_px": 320, "height_px": 240, "fx_px": 300, "fy_px": 300},
        "marker": {"dictionary": "DICT_4X4_50", "size_m": 0.04, "quiet_zone_modules": 1},
        "board": board,
        "pose": {"distance_m": 0.35, **sections.pop("pose", {})},
        "scene": {"background": 120, "black": 30, "white": 220, "blur_px": 0.5,
                  **sections.pop("scene", {})},
        "estimator": {"solver": "iterative", "guarded": False},
        **sections,
    }, settings=settings)


def one(chosen, name):
    return run_cells(chosen, []).columns[name][0][0]


@pytest.mark.parametrize("board", [SQUARES, {"kind": "none"}])
def test_a_target_is_visible_and_as_large_as_without_distractors(board):
    for pose in ({}, {"bearing_x_deg": -36.0}):
        plain, beside = (
            distracted({**board, **more}, pose=pose)
            for more in (({} if board is SQUARES else {"distractors": [SQUARE]}),
                         {"distractors": BESIDE})
        )
        assert beside.largest_board == plain.largest_board
        for name in ("marker_area_px", "detection", "marker_detection", "board_marker_id"):
            np.testing.assert_array_equal(one(beside, name), one(plain, name))
    # At the last pose the frame shows the distractor with the board's ID alone.
    assert one(beside, "detection") == DetectionStatus.not_visible


def test_an_id_of_the_board_elsewhere_is_no_detection_of_its_marker():
    """Marker 2 is hidden; what has its ID lies beside the board."""
    chosen = distracted({
        "kind": "markers", "markers": [
            {"marker_id": 0, "x_m": -0.03, "y_m": 0.0}, {"marker_id": 2, "x_m": 0.03, "y_m": 0.0},
        ], "distractors": [{**BOARD_ID, "x_m": -0.1}],
    }, scene={"occlusion": 0.4, "occluder": 120})
    flags = one(chosen, "marker_detection")
    assert flags[0] == DetectionStatus.detected
    assert flags[1] in (DetectionStatus.no_candidate, DetectionStatus.rejected)
    # Solvers get both, as OpenCV's matchImagePoints takes them, and find no pose of these.
    assert one(chosen, "estimate") == EstimateStatus.solver_failed


@pytest.mark.parametrize(("beside", "tilt", "expected"), [
    ([], 60.0, DetectionStatus.not_run),
    ([{"marker_id": 1, "x_m": 0.0, "y_m": 0.45}], 60.0, DetectionStatus.not_modelled),
    ([{"marker_id": 1, "x_m": 0.0, "y_m": 0.45, "z_m": 0.02}], 60.0, DetectionStatus.not_run),
    ([{"marker_id": 1, "x_m": 0.0, "y_m": 0.45}], 120.0, DetectionStatus.not_visible),
])
def test_what_comes_behind_the_camera_is_not_modelled_in_the_board_s_plane(beside, tilt, expected):
    chosen = distracted({**SQUARES, "distractors": beside}, pose={"tilt_deg": tilt})
    values = chosen.experiment.scene_values([])
    scenes = build_scenes(values, 1)
    flags = visibility_flags(scenes, 0)
    assert flags[0] == expected
    boards = target_scenes(
        scenes, flags, values["board"].listed(1), chosen.largest_board)
    assert (boards.flags == expected).all()


APRIL_GRID = {"kind": "aprilgrid", "tagCols": 4, "tagRows": 3, "tagSpacing": 0.3}


def april_pipeline(settings=()):
    return Pipeline.from_dict({
        "marker": {"dictionary": "DICT_APRILTAG_36h11", "size_m": 0.04}, "board": APRIL_GRID,
        "pose": {"jitter_px": 1, "azimuth_deg": {"uniform": [0, 360]},
                 "roll_deg": {"uniform": [0, 360]}},
        "estimator": {"solver": "sqpnp"},
        "axes": {"distance_m": [0.4, 0.7, 1.2], "tilt_deg": [0, 25, 50], "trial": 3},
    }, settings)


FOUND = ["adaptiveThreshConstant=60", "adaptiveThreshWinSizeMax=33", "adaptiveThreshWinSizeStep=4"]
"""The setting that the guide of boards and the plan name."""


def test_the_named_setting_finds_what_the_default_loses():
    default, named = (
        run_block(april_pipeline(settings), Block((0, 0, 0), (3, 3, 3))).values
        for settings in ([], FOUND)
    )
    lost = default["detection"] != DetectionStatus.detected
    assert lost.sum() >= 5
    assert (named["detection"] == DetectionStatus.detected).all()
    assert (default["marker_detection"] == DetectionStatus.detected).mean() < 0.5
    assert (named["marker_detection"] == DetectionStatus.detected).mean() > 0.75
    solved = named["estimate"] == EstimateStatus.solved
    assert solved.mean() > 0.9
    # A board whose markers have other IDs or another turn than the picture fits nowhere.
    assert np.nanmedian(named["reprojection_error_px"][solved]) < 2
    assert np.nanmedian(np.linalg.norm(named["rotation_error_rad"], axis=-1)[solved]) < 0.05


def test_plan_names_the_setting_where_the_default_loses_markers():
    (line,) = [each for each in april_pipeline().facts.notes if "squares" in each]
    for setting in FOUND:
        assert setting.replace("=", " = ") in line
    assert not [each for each in april_pipeline(FOUND).facts.notes if "squares" in each]
