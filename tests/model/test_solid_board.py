"""Targets of markers in several planes: images against rays, and hidden markers."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sweep.evaluation.search import visibility_flags
from sweep.experiment.pipeline import Pipeline
from sweep.measure.classify import target_scenes
from sweep.measure.flags import DetectionStatus
from sweep.model.marker import modules
from sweep.model.renderers import marker_levels
from sweep.model.scene import build_scenes

LEVELS = 120.0, 10.0, 230.0


def marker(marker_id, x, y, z, *, tilt=0.0, azimuth=0.0, roll=0.0, size=0.04):
    return {"marker_id": marker_id, "x_m": x, "y_m": y, "z_m": z, "tilt_deg": tilt,
            "azimuth_deg": azimuth, "roll_deg": roll, "size_m": size}


CUBE = [marker(0, 0, 0, 0.028)] + [
    marker(1 + k, 0.028 * np.sin(np.radians(a)), -0.028 * np.cos(np.radians(a)), 0.0, tilt=90,
           azimuth=a)
    for k, a in enumerate((0.0, 90.0, 180.0, 270.0))
]
FIELD = [  # each hides a part of the one before, two of them the same part
    marker(1, 0, 0, 0), marker(2, 0.02, 0.01, 0.03, tilt=25, azimuth=40, size=0.025),
    marker(3, -0.02, -0.015, 0.05, roll=30, size=0.02),
    marker(4, 0.005, -0.005, 0.07, roll=10, size=0.015),
]


def pipeline(markers, tilt_deg=30.0, **sections):
    return Pipeline.from_dict({
        "seed": 1,
        "camera": {"width_px": 160, "height_px": 120, "fx_px": 150, "fy_px": 150},
        "marker": {"dictionary": "DICT_4X4_50", "size_m": 0.04},
        "board": {"kind": "markers", "markers": markers},
        "pose": {"distance_m": 0.2, "tilt_deg": tilt_deg, "azimuth_deg": 70, "roll_deg": 20},
        "scene": {"background": LEVELS[0], "black": LEVELS[1], "white": LEVELS[2],
                  **sections.pop("scene", {})},
        "estimator": {"solver": "iterative", **sections.pop("estimator", {})},
        **sections,
    })


def scenes_of(chosen):
    return build_scenes(chosen.experiment.scene_values([]), 1)


def image_of(scenes):
    width, height = scenes.frame[0].tolist()
    mean, share = marker_levels(scenes, 0, (0, 0, width, height))
    return mean + (1 - share) * LEVELS[0]


def turned(each):
    """The rotation of a marker on its target: SciPy's."""
    azimuth = np.radians(each["azimuth_deg"])
    axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    tilt = Rotation.from_rotvec(np.radians(each["tilt_deg"]) * axis)
    return (tilt * Rotation.from_euler("z", each["roll_deg"], degrees=True)).as_matrix()


def traced(markers, scenes, per_side):
    """The mean levels (height, width) of ``per_side``² rays a pixel.

    Each ray takes the nearest sheet. ``markers`` have quiet zones of one module.
    """
    width, height, focal, cx, cy = 160, 120, 150.0, 79.5, 59.5
    rotation, translation = scenes.rotation[0], scenes.translation[0]
    u = (np.arange(width * per_side) + 0.5) / per_side - 0.5
    v = (np.arange(height * per_side) + 0.5) / per_side - 0.5
    x, y = np.meshgrid((u - cx) / focal, (v - cy) / focal)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    nearest, level = np.full(x.shape, np.inf), np.full(x.shape, LEVELS[0])
    for each in markers:
        centre, size = [each[f"{axis}_m"] for axis in "xyz"], each["size_m"]
        axes, middle = rotation @ turned(each), rotation @ centre + translation
        if axes[:, 2] @ middle >= 0:
            continue  # its back
        depth = axes[:, 2] @ middle / (rays @ axes[:, 2])
        at = rays * depth[..., None] - middle
        bits = modules("DICT_4X4_50", each["marker_id"])
        count = len(bits)
        column = (at @ axes[:, 0] / size + 0.5) * count
        line = (0.5 - at @ axes[:, 1] / size) * count
        hit = (depth > 0) & (depth < nearest)
        for along in (column, line):
            hit &= (along >= -1) & (along < count + 1)
        within = (column >= 0) & (column < count) & (line >= 0) & (line < count)
        index = [np.clip(along, 0, count - 1).astype(int) for along in (line, column)]
        white = ~within | bits[tuple(index)]
        nearest[hit] = depth[hit]
        level[hit] = np.where(white, LEVELS[2], LEVELS[1])[hit]
    return level.reshape(height, per_side, width, per_side).mean(axis=(1, 3))


BOARDS = {
    "cube": {"kind": "markers", "markers": CUBE},
    "field": {"kind": "markers", "markers": FIELD},
    "distractors": {"kind": "markers", "markers": FIELD[:2], "distractors": FIELD[2:]},
}


@pytest.mark.parametrize(("name", "tilt_deg"), [
    ("field", 60.0), ("distractors", 60.0),
    *(pytest.param(name, tilt, marks=pytest.mark.long)
      for name, tilt in (("cube", 30.0), ("distractors", 0.0), ("field", 150.0))),
])
def test_an_image_is_that_of_rays(name, tilt_deg):
    """Errors of the rays fall with the power 1.5 of their number along a side, those of the image
    would stay. Distractors hide a board that is flat on one sheet, or of several."""
    declared = BOARDS[name]
    chosen = pipeline([], tilt_deg, board=declared)
    scenes = scenes_of(chosen)
    image = image_of(scenes)
    shown = [*declared.get("markers", []), *declared.get("distractors", [])]
    coarse, fine = (
        np.sqrt(((image - traced(shown, scenes, n)) ** 2).mean()) for n in (3, 9)
    )
    assert fine < 0.8
    assert fine < 0.3 * coarse or fine == coarse == 0
    assert chosen.largest_board[0] == len(declared["markers"])


EXPOSED = {"exposure_s": 0.01, "row_time_s": 1e-4, "velocity_x_m_s": 0.6, "velocity_z_m_s": -0.5,
           "aperture_mm": 10.0, "focus_distance_m": 0.2, "sharpening": 0.5}


@pytest.mark.parametrize(("exposed", "tolerance"), [({}, 1e-9), (EXPOSED, 1e-3)])
def test_a_marker_in_one_plane_of_several_is_one_alone(exposed, tolerance):
    """Blurred and moved by another quadrature."""
    levels = {"background": LEVELS[0], "black": LEVELS[1], "white": LEVELS[2]}
    single = Pipeline.from_dict({
        "camera": {"width_px": 160, "height_px": 120, "fx_px": 150, "fy_px": 150},
        "marker": {"dictionary": "DICT_4X4_50", "marker_id": 7, "size_m": 0.04},
        "pose": {"distance_m": 0.15, "tilt_deg": 0.0}, "scene": exposed | levels,
    })
    raised = pipeline([marker(7, 0, 0, 0.05)], 0.0, pose={"distance_m": 0.2}, scene=exposed)
    np.testing.assert_allclose(
        image_of(scenes_of(raised)), image_of(scenes_of(single)), atol=tolerance
    )


@pytest.mark.parametrize(("board", "seen"), [
    ({"kind": "markers", "markers": [
        marker(0, 0, 0, 0, size=0.01), marker(1, 0, 0, 0.05), marker(2, 0.05, 0, 0),
        marker(3, -0.05, 0, 0, tilt=180),
    ]}, [False, True, True, False]),
    ({"kind": "grid", "rows": 1, "columns": 2, "gap_m": 0.02,
      "distractors": [marker(9, 0.03, 0.0, 0.05)]}, [True, False]),
])
def test_markers_behind_other_sheets_and_from_behind_are_not_visible(board, seen):
    chosen = pipeline([], tilt_deg=0.0, board=board)
    scenes, values = scenes_of(chosen), chosen.experiment.scene_values([])
    size = len(seen), 0
    boards = target_scenes(scenes, visibility_flags(scenes, 0), values["board"].listed(1), size)
    assert (boards.flags[0] == DetectionStatus.not_run).tolist() == seen
    assert (boards.flags[0] == DetectionStatus.not_visible).tolist() == np.invert(seen).tolist()
