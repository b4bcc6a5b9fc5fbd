"""What was drawn, and what is fixed, is in the dataset under the parameter's own name."""

import numpy as np
import pytest
import xarray as xr
from scipy.spatial.transform import Rotation

import sweep
from support.stores import by_hand

PIPELINE = {
    "seed": 5,
    "camera": {"fx_px": 500},
    "marker": {"size_m": 0.05},
    "pose": {
        "side_px": {"uniform": [25, 60]},
        "tilt_deg": {"uniform": [0, 60]},
        "roll_deg": {"normal": [0, 40]},
        "bearing_x_deg": {"uniform": [-10, 10]},
        "jitter_px": 0.5,
    },
    "scene": {"background": 255, "noise_grey": {"uniform": [0, 4]}},
    "estimator": {"believed_fx_px": {"normal": [500, 5]}},
    "axes": {"azimuth_deg": [0, 30], "trial": 40},
}
DRAWN = {
    "side_px", "tilt_deg", "roll_deg", "bearing_x_deg", "noise_grey", "believed_fx_px",
    "distance_m", "jitter_u_px", "jitter_v_px",
}


@pytest.fixture(scope="module")
def url(tmp_path_factory):
    url = str(tmp_path_factory.mktemp("drawn") / "drawn.zarr")
    by_hand(url, sweep.Pipeline.from_dict(PIPELINE))
    return url


def test_the_true_pose_follows_from_the_coordinates(url):
    r = sweep.open(url).load()
    zeros = xr.zeros_like(r.tilt_deg)
    tilt, azimuth, roll = (np.radians(x + zeros).values.ravel() for x in (
        r.tilt_deg, r.azimuth_deg, r.roll_deg))
    axis = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=-1)
    expected = (
        Rotation.from_rotvec(axis * tilt[:, None]) * Rotation.from_euler("z", roll[:, None])
        * Rotation.from_euler("x", 180, degrees=True)
    )
    rvec = r.true_rvec.transpose(..., "xyz").values.reshape(-1, 3)
    assert (expected * Rotation.from_rotvec(rvec).inv()).magnitude().max() < 1e-14
    z = 500 * 0.05 / r.side_px
    np.testing.assert_allclose(r.distance_m, z, rtol=1e-15)
    x = z * np.tan(np.radians(r.bearing_x_deg)) + r.jitter_u_px * z / 500
    y = r.jitter_v_px * z / 500
    np.testing.assert_allclose(
        r.true_tvec_m.transpose("xyz", ...), np.stack([x, y, z]), rtol=0, atol=1e-14
    )
    assert (abs(r.jitter_u_px) <= 0.5).all()
    assert r.jitter_u_px.std() > 0.2


def test_every_parameter_is_a_coordinate_whether_fixed_an_axis_or_drawn(url):
    for opened in (sweep.open(url), xr.open_zarr(url, consolidated=False)):
        assert set(opened.coords) >= DRAWN
        for name in DRAWN:
            assert opened[name].dims == ("azimuth_deg", "trial"), name
            assert opened[name].dtype == "f8"
            assert opened[name].chunks == opened["marker_area_px"].chunks
        assert opened.azimuth_deg.dims == ("azimuth_deg",)
        fixed = {"size_m": 0.05, "fx_px": 500.0, "jitter_px": 0.5, "bearing_y_deg": 0.0,
                 "marker_id": 0, "background": 255.0, "quiet_zone_modules": 1.0}
        assert {name: opened[name].item() for name in fixed} == fixed
        assert opened["dictionary"].item() == "DICT_5X5_50"
        assert opened["tilt_deg"].attrs["units"] == "degree"
        assert "distortion" not in opened.variables  # neither given, nor of marker or pose
        assert not DRAWN & set(opened.data_vars)
