"""Markers behind the camera, or with a corner there, are results: flagged, stored and sound."""

import warnings

import numpy as np
import pytest

import sweep
from sweep.integrity.verification import verify
from sweep.measure.flags import DetectionStatus


@pytest.mark.parametrize(
    ("pose", "axes"),
    [({}, {"distance_m": [0.01, 0.3], "tilt_deg": [0, 80, 180]}),
     ({"camera_yaw_deg": 180}, {"marker_x_m": [-0.3, 0, 0.3]})],
    ids=["a corner behind", "the marker behind"],
)
def test_a_store_with_markers_behind_the_camera_is_sound(pose, axes, tmp_path):
    url = str(tmp_path / "behind.zarr")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        results = sweep.run({"marker": {"size_m": 0.05}, "pose": pose, "axes": axes}, store=url)
    flags = results["detection"].to_numpy()
    behind = results["true_tvec_m"].sel(xyz="z").to_numpy() <= 0
    assert (flags[behind] == DetectionStatus.not_visible).all()
    assert (flags == DetectionStatus.detected).any()
    assert (flags == DetectionStatus.not_visible).any()
    assert np.isfinite(results["true_tvec_m"]).all()
    assert np.isfinite(results["true_rvec"]).all()
    assert verify(url, 10).damage == []
