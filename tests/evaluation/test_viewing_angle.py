"""The viewing angle is a variable of every dataset: the true one, whichever way a pose is given."""

import numpy as np
import pytest

import sweep
from support.here import calls_here
from sweep.integrity.verification import verify

EXACT_DEG = 2e-13
"""A few roundings of 1.1e-16 rad."""


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    url = str(tmp_path_factory.mktemp("angles") / "angles.zarr")
    with calls_here():
        yield sweep.run(
            {"marker": {"size_m": 0.05}, "pose": {"jitter_px": 2, "distance_m": 0.4},
             "axes": {"tilt_deg": [0, 60, 180], "azimuth_deg": [0, 90],
                      "bearing_x_deg": [-80, 0, 25], "solver": ["ippe", "sqpnp"], "trial": 2}},
            store=url,
        )
    assert verify(url, 4).damage == []


def test_it_is_the_angle_between_normal_and_line_of_sight(results):
    angle = results.viewing_angle_deg
    assert angle.dims == ("tilt_deg", "azimuth_deg", "bearing_x_deg", "trial")
    assert angle.dtype == np.float64
    assert angle.attrs["units"] == "degree"
    tilt, azimuth = np.radians(results.tilt_deg), np.radians(results.azimuth_deg)
    # The normal of Rot(axis, tilt) · (0, 0, -1), by Rodrigues' formula.
    normal = (-np.sin(tilt) * np.sin(azimuth), np.sin(tilt) * np.cos(azimuth), -np.cos(tilt))
    centre = [results.true_tvec_m.sel(xyz=name) for name in "xyz"]
    cosine = -sum(n * c for n, c in zip(normal, centre, strict=True))
    length = np.sqrt(sum(c**2 for c in centre))
    expected = np.degrees(np.arccos(np.clip(cosine / length, -1, 1))).transpose(*angle.dims)
    # The arc cosine has half the digits near 0 and 180°.
    np.testing.assert_allclose(angle, expected, atol=2e-6)
    for tilt_deg, start, sign in ((0, 0, 1), (180, 180, -1)):
        x, y, z = (c.sel(tilt_deg=tilt_deg).to_numpy() for c in centre)
        away = np.degrees(np.arctan2(np.hypot(x, y), z))
        parallel = angle.sel(tilt_deg=tilt_deg).to_numpy()
        np.testing.assert_allclose(parallel, start + sign * away, atol=EXACT_DEG)


@pytest.mark.long
def test_all_scenes_have_it_also_those_that_cannot_be_seen(results):
    assert np.isfinite(results.viewing_angle_deg).all()
    assert (results.detection == 5).any()
