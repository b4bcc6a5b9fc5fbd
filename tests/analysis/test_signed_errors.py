"""Errors along axes and about angles against SciPy's Rotation, closed forms and plain loops."""

import math

import numpy as np
import pytest
import xarray as xr
from scipy.spatial.transform import Rotation

from support.small_datasets import ALL, mixed, perfect
from sweep.analysis import error_statistics
from sweep.analysis.dataset import SIGNED, Poses
from sweep.errors import ArgumentError
from sweep.measure.flags import EstimateStatus, Flipped

UPRIGHT = Rotation.from_rotvec([math.pi, 0, 0])
class Truth:
    """Poses and their estimates as SciPy has them; ``size_rad``: of the rotation's error."""

    def __init__(self, count, size_rad, seed=1):
        rng = np.random.default_rng(seed)
        self.angles = rng.uniform([-180, -80, -180], [180, 80, 180], (count, 3))
        self.rotation = Rotation.from_euler("YXZ", self.angles, degrees=True) * UPRIGHT
        self.position = rng.normal([0, 0, 3], size=(count, 3))
        axis = rng.normal(size=(count, 3))
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        self.error = Rotation.from_rotvec(size_rad * axis)
        self.moved = rng.normal(size=(count, 3)) * size_rad
        self.estimate = self.error * self.rotation
        self.found = Poses({
            "true_rvec": self.rotation.as_rotvec(), "true_tvec_m": self.position,
            "rotation_error_rad": size_rad * axis, "translation_error_m": self.moved})


def normal_of(rotation):
    return rotation.apply([0.0, 0.0, 1.0])


def angle(a, b):
    cosine = (a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


SIZES = pytest.mark.parametrize("size_rad", [1e-6, 1e-3, 0.1, 2.0, 3.1])


@SIZES
def test_positions_are_those_of_scipys_rotations(size_rad):
    truth = Truth(500, size_rad)
    back, back_estimated = truth.rotation.inv(), truth.estimate.inv()
    camera = -back_estimated.apply(truth.position + truth.moved) + back.apply(truth.position)
    # A difference of two positions of some metres: 1e-15 of these.
    np.testing.assert_allclose(truth.found.of_camera_m, camera, atol=1e-14)
    np.testing.assert_allclose(truth.found.along_marker_m, back.apply(truth.moved), atol=1e-14)
    np.testing.assert_array_equal(truth.found.in_camera_m, truth.moved)


@SIZES
def test_angles_are_those_of_scipys_rotations(size_rad):
    truth = Truth(500, size_rad)
    angles = (truth.estimate * UPRIGHT.inv()).as_euler("YXZ", degrees=True)
    difference = (angles - truth.angles + 180) % 360 - 180
    if size_rad < 1:  # then neither pitch comes near 90 degrees
        np.testing.assert_allclose(truth.found.yaw_pitch_roll_deg, difference, atol=1e-9)
    else:
        turns = (truth.found.yaw_pitch_roll_deg - difference) / 360
        np.testing.assert_allclose(turns, np.rint(turns), atol=1e-9)
    sight, towards = [0.0, 0.0, 1.0], -truth.position
    normal, estimated = normal_of(truth.rotation), normal_of(truth.estimate)
    # arccos, of these references alone, has 1e-7 degrees near 0.
    np.testing.assert_allclose(
        truth.found.tilt_deg, angle(estimated, -np.tile(sight, (500, 1)))
        - angle(normal, -np.tile(sight, (500, 1))), atol=1e-6)
    np.testing.assert_allclose(
        truth.found.viewing_angle_deg,
        angle(estimated, towards - truth.moved) - angle(normal, towards), atol=1e-6)


@SIZES
def test_in_plane_error_is_what_is_left_of_the_rotation_after_the_shortest_one(size_rad):
    truth = Truth(500, size_rad)
    normal, estimated = normal_of(truth.rotation), normal_of(truth.estimate)
    turn = np.radians(truth.found.in_plane_deg)[:, None] * normal
    # The shortest rotation that takes one normal to the other.
    across = np.cross(normal, estimated)
    length = np.linalg.norm(across, axis=1, keepdims=True)
    swing = across / length * np.arctan2(length, (normal * estimated).sum(1, keepdims=True))
    product = Rotation.from_rotvec(swing) * Rotation.from_rotvec(turn)
    left = (product * truth.error.inv()).magnitude()
    assert left.max() < 1e-9


COLUMNS = {
    **{prefix + axis: (attribute, k) for prefix, attribute in (
        ("", "in_camera_m"), ("marker_frame_", "along_marker_m"),
        ("camera_in_marker_", "of_camera_m")) for k, axis in enumerate("xyz")},
    **{name: ("yaw_pitch_roll_deg", k) for k, name in enumerate(("yaw", "pitch", "roll"))},
    **{name: (f"{name}_deg", None) for name in ("tilt", "viewing_angle", "in_plane")}}
"""Where `Poses`, which the tests above compare with SciPy, has the error of a name."""


@pytest.mark.parametrize("per", [(), ("tilt_deg", "solver")])
def test_bias_and_spread_are_those_of_plain_arithmetic(per):
    results = mixed(ALL, seed=4)
    used = (results["estimate"] == EstimateStatus.solved) & (
        results["flipped"] != Flipped.flipped)
    wide, = xr.broadcast(results[["true_rvec", "true_tvec_m", "rotation_error_rad",
                                  "translation_error_m"]].astype(float))
    signed = Poses({name: wide[name].transpose(*used.dims, "xyz").values for name in wide})
    over = [dim for dim in used.dims if dim not in per]
    answer = error_statistics(results, per, quantities=list(SIGNED))
    assert not [name for name in answer if name.startswith(("rotation", "range", "position"))]
    for name, (attribute, k) in COLUMNS.items():
        unit = attribute.rpartition("_")[2]
        errors = getattr(signed, attribute)
        values = xr.DataArray(errors if k is None else errors[..., k], dims=used.dims).where(used)
        for statistic, expected in (("bias", values.mean(over)), ("sd", values.std(over, ddof=1))):
            array, low, high = (
                answer[f"{name}_{statistic}_{unit}{end}"] for end in ("", "_low", "_high"))
            np.testing.assert_allclose(
                array.transpose(*per), expected.transpose(*per), rtol=1e-6, atol=1e-6, err_msg=name)
            assert ((low <= array) & (array <= high)).all(), name
            assert array.attrs["units"] == {"m": "m", "deg": "degree"}[unit]


def test_what_a_user_asks_for_is_what_there_is():
    results = perfect(np.random.default_rng(1), {"trial": 5})
    default = error_statistics(results)
    assert set(error_statistics(results, quantities=["rotation", "range", "position"])) == set(
        default)
    one = error_statistics(results, quantities="yaw")
    assert set(one) - set(default) == {f"yaw_{name}_deg{end}" for name in ("bias", "sd")
                                       for end in ("", "_low", "_high")}
    with pytest.raises(ArgumentError, match=r"quantities = yawn: no such error.*yaw"):
        error_statistics(results, quantities=["yawn"])
    with pytest.raises(ArgumentError, match=r"quantities = .*: expected some of rotation, "):
        error_statistics(results, quantities=[])
