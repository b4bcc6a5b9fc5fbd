"""A camera as users know it: fields of view, pixel sizes, square pixels, and no silent trap."""

import itertools
import math
import tomllib

import numpy as np
import pytest

import sweep
from support.here import calls_here
from sweep.execution.runner import execute
from sweep.experiment.pipeline import Pipeline, cell
from sweep.model.camera import VIEW_PARAMETERS, intrinsics


def pipeline(camera=None, settings=(), **sections):
    return Pipeline.from_dict(
        {"camera": camera or {}, "pose": {"distance_m": 1.0}, **sections}, settings
    )


def view(camera):
    fixed = pipeline(camera).fixed
    return [float(number) for number in intrinsics(*(fixed[name] for name in VIEW_PARAMETERS))]


# 1. Ways to give a camera.

@pytest.mark.parametrize("width", [640, 1280, 1921])
@pytest.mark.parametrize("fov", [1e-3, 30.0, 60.0, 90.0, 179.0])
def test_a_field_of_view_reaches_from_edge_to_edge_of_the_frame(fov, width):
    fx, fy, cx, cy = view({"width_px": width, "height_px": 700, "hfov_deg": fov})
    assert fx == fy == pytest.approx(width / 2 / math.tan(math.radians(fov / 2)), rel=1e-14)
    # The rays through the outer edges of the first and the last pixel.
    left, right = math.atan((-0.5 - cx) / fx), math.atan((width - 0.5 - cx) / fx)
    assert math.degrees(right - left) == pytest.approx(fov, rel=1e-10)
    fx, fy, cx, cy = view({"width_px": 700, "height_px": width, "vfov_deg": fov})
    top, bottom = math.atan((-0.5 - cy) / fy), math.atan((width - 0.5 - cy) / fy)
    assert fx == fy
    assert math.degrees(bottom - top) == pytest.approx(fov, rel=1e-10)


def test_a_diagonal_field_of_view_reaches_from_corner_to_corner():
    # A webcam of 78 degrees at 1920 x 1080: 1360 px.
    fx, fy, cx, cy = view({"width_px": 1920, "height_px": 1080, "dfov_deg": 78.0})
    assert fx == fy == pytest.approx(math.hypot(960, 540) / math.tan(math.radians(39)), rel=1e-14)
    rays = [np.array([(u - cx) / fx, (v - cy) / fy, 1]) for u, v in (
        (-0.5, -0.5), (1919.5, 1079.5))]
    cosine = rays[0] @ rays[1] / (np.linalg.norm(rays[0]) * np.linalg.norm(rays[1]))
    assert math.degrees(math.acos(cosine)) == pytest.approx(78, rel=1e-12)


def test_a_pixel_size_gives_the_focal_length_in_pixels():
    # 8 mm before pixels of 3.45 um.
    assert view({"pixel_size_um": 3.45, "focal_length_mm": 8.0})[:2] == pytest.approx(
        [8.0 / 3.45e-3] * 2, rel=1e-15
    )


@pytest.mark.parametrize(("camera", "focal"), [
    ({"width_px": 1280, "height_px": 720}, 4.0 / 4.8 * 1280),
    ({"width_px": 100, "height_px": 100}, 4.0 / 4.8 * 100),
    ({"height_px": 400}, 4.0 / 4.8 * 640),
    ({"sensor_width_mm": 6.4}, 4.0 / 6.4 * 640),
    ({"sensor_height_mm": 4.8}, 4.0 / 4.8 * 480),
    ({"sensor_height_mm": 2.7, "width_px": 1280, "height_px": 720}, 4.0 / 2.7 * 720),
    ({"focal_length_mm": 8.0, "width_px": 1920, "height_px": 1200}, 8.0 / 4.8 * 1920),
    ({"fx_px": 700}, 700.0),
])
def test_pixels_are_square_unless_both_sides_are_given(camera, focal):
    fx, fy, _, _ = view(camera)
    assert [fx, fy] == pytest.approx([focal] * 2, rel=1e-15)
    assert pipeline(camera).facts.camera["square"]


# 2. --set and --at.

@pytest.mark.parametrize(("camera", "setting", "left"), [
    ({"fx_px": 500, "fy_px": 510}, "hfov_deg=50", {"hfov_deg": 50}),
    ({"hfov_deg": 50}, "fx_px=600", {"fx_px": 600}),
    ({"hfov_deg": 50, "width_px": 1280}, "focal_length_mm=6",
     {"width_px": 1280, "focal_length_mm": 6}),
    ({"focal_length_mm": 8, "sensor_width_mm": 6}, "pixel_size_um=3",
     {"focal_length_mm": 8, "pixel_size_um": 3}),
])
def test_choosing_one_way_to_give_a_camera_drops_the_others(camera, setting, left):
    chosen = pipeline(camera, [setting])
    assert tomllib.loads(chosen.to_toml())["camera"] == left
    assert cell(pipeline(camera), setting).fixed == chosen.fixed


# 3. What is told.

def test_sides_of_a_board_s_markers_are_their_own():
    # 600 · 0.01 / 2 and 600 · 0.04 / 1 px; the size of [marker] is that of no marker.
    board = Pipeline.from_dict({
        "camera": {"fx_px": 600}, "estimator": {"solver": "sqpnp"}, "marker": {"size_m": 0.5},
        "board": {"kind": "markers", "markers": [
            {"marker_id": 0, "x_m": 0, "y_m": 0, "size_m": 0.04},
            {"marker_id": 1, "x_m": 0.1, "y_m": 0, "size_m": 0.01},
        ]}, "axes": {"distance_m": [1, 2]},
    })
    assert board.facts.camera["side_px"] == pytest.approx((3, 24))
    assert "the markers' sides are 3 to 24 px" in board.facts.camera_line


@pytest.mark.parametrize(("sections", "line"), [
    ({"camera": {"cx_px": 640, "cy_px": 360, "fx_px": 500}}, "cx_px = 640: outside the frame of"),
    ({"camera": {"width_px": 1280, "height_px": 720, "cx_px": 320, "fx_px": 500}},
     "cx_px = 320: far from the centre of the frame of 1280 x 720 px; is it that of another frame"),
    ({"camera": {"cx_px": 319.5}, "axes": {"width_px": [640, 1280]}},
     "cx_px = 319.5: far from the centre of the frame of 640 to 1280 x 480 px"),
])
def test_what_may_surprise_of_a_camera_is_told(sections, line):
    camera = sections.pop("camera")
    told = pipeline(camera, **sections).facts.camera_notes
    assert [each for each in told if line in each], told


def test_notes_are_told_by_a_run_from_python(tmp_path, capfd):
    with calls_here():
        execute(pipeline({"fx_px": 400, "cx_px": 700}), tmp_path / "s.zarr")
    assert "cx_px = 700: outside the frame" in capfd.readouterr().err
    told = sweep.open(tmp_path / "s.zarr").attrs["camera_notes"]
    assert told.startswith("cx_px = 700: outside the frame")


def test_axes_of_the_camera_give_what_each_value_gives_on_its_own():
    axes = {
        "hfov_deg": [40.0, 60.0], "width_px": [640, 1280], "height_px": [480, 720],
        "side_px": [20.0, 50.0],
    }
    grid = Pipeline.from_dict({"marker": {"size_m": 0.04}, "axes": axes})
    lengths = [len(axis) for axis in grid.experiment.scene_axes]
    values = grid.experiment.scene_values([index.ravel() for index in np.indices(lengths)])
    columns = [values[name].values for name in VIEW_PARAMETERS]
    fx, fy, _, _ = intrinsics(*columns)
    for k, chosen in enumerate(itertools.product(*axes.values())):
        camera = dict(zip(("hfov_deg", "width_px", "height_px"), chosen[:3], strict=True))
        assert [fx[k], fy[k]] == view(camera)[:2]
        alone = Pipeline.from_dict(
            {"marker": {"size_m": 0.04}, "camera": camera, "pose": {"side_px": chosen[3]}}
        )
        distance = alone.experiment.scene_values([])["distance_m"].values
        assert values["distance_m"].values[k] == distance == fx[k] * 0.04 / chosen[3]
