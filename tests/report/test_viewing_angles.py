"""A report groups by the viewing angle as it does by the tilt, and areas in the world vary."""

import pytest

import sweep
from sweep.analysis import detection_limit
from sweep.report.figures import figures_of
from sweep.report.report_data import course_of, read_report_data
from tests.support.here import calls_here


def made(tmp_path, pose, axes):
    url = str(tmp_path / "angles.zarr")
    with calls_here():
        sweep.run({"marker": {"size_m": 0.05}, "pose": pose, "axes": axes}, store=url)
    return read_report_data(url)


@pytest.mark.long
def test_a_viewing_angle_is_an_angle_as_the_tilt_is(tmp_path):
    data = made(tmp_path, {"bearing_x_deg": 15},
                {"view_angle_deg": [0, 60], "distance_m": [0.3, 0.6], "trial": 1})
    assert (data.angle_axis, data.angle) == ("view_angle_deg", "viewing angle")
    assert data.by_angle().per == ("view_angle_deg",)
    figures = {figure.name: figure for figure in figures_of(data)}
    assert "maps" in figures
    assert "by viewing angle" in figures["detection"].caption
    assert detection_limit(data.results, rate=1)["side_px"].dims == ("view_angle_deg",)
    assert course_of(data) == ("distance_m", ("view_angle_deg",))


def test_sizes_in_the_world_vary_with_the_places(tmp_path):
    data = made(tmp_path, {"marker_yaw_deg": 180}, {"marker_x_m": [0.3, 0.6, 1.2]})
    assert data.size_axis is None
    assert data.size == "marker_area_px"
