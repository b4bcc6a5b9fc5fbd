"""A report groups by the viewing angle as it does by the tilt, and areas in the world vary."""


import sweep
from sweep.report.report_data import read_report_data
from tests.support.here import calls_here


def made(tmp_path, pose, axes):
    url = str(tmp_path / "angles.zarr")
    with calls_here():
        sweep.run({"marker": {"size_m": 0.05}, "pose": pose, "axes": axes}, store=url)
    return read_report_data(url)


def test_sizes_in_the_world_vary_with_the_places(tmp_path):
    data = made(tmp_path, {"marker_yaw_deg": 180}, {"marker_x_m": [0.3, 0.6, 1.2]})
    assert data.size_axis is None
    assert data.size == "marker_area_px"
