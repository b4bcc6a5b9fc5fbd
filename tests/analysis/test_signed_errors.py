"""Errors along axes and about angles against SciPy's Rotation, closed forms and plain loops."""

import math

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial.transform import Rotation

from support.small_datasets import ALL, mixed, perfect
from sweep.analysis import error_statistics
from sweep.analysis.poses import SIGNED, SignedErrors
from sweep.errors import ArgumentError
from sweep.measure.flags import EstimateStatus, Flipped

UPRIGHT = Rotation.from_rotvec([math.pi, 0, 0])
NAMES = [quantity.name for group in SIGNED.values() for quantity in group]


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
        self.found = SignedErrors(
            self.rotation.as_rotvec(), self.position, size_rad * axis, self.moved)


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


@given(st.floats(1e-12, 1e-3), st.sampled_from(["yaw", "pitch", "roll"]), st.booleans())
def test_tiny_errors_and_half_turns_keep_their_digits(size, name, half_turn):
    axis = {"yaw": 1, "pitch": 0, "roll": 2}[name]
    start = np.zeros(3)
    if half_turn and name != "pitch":
        start[{"yaw": 0, "roll": 2}[name]] = math.pi - size / 2  # the estimate lies beyond 180
    true = Rotation.from_euler("YXZ", start) * UPRIGHT
    step = np.zeros(3)
    step[axis] = size
    found = SignedErrors(true.as_rotvec(), np.array([0.0, 0.0, 1.0]), step, np.zeros(3))
    expected = dict.fromkeys(("yaw", "pitch", "roll"), 0.0) | {name: math.degrees(size)}
    values = dict(zip(expected, found.yaw_pitch_roll_deg.tolist(), strict=True))
    if half_turn and name == "yaw":
        expected = {"yaw": math.degrees(size), "pitch": 0.0, "roll": 0.0}
    # The last digits of an angle of 180 degrees.
    assert values == pytest.approx(expected, abs=2e-13, rel=1e-12)
    in_plane = -math.degrees(size) if name == "roll" else 0.0
    assert found.in_plane_deg == pytest.approx(in_plane, abs=1e-13, rel=1e-12)


def test_nothing_is_made_of_what_is_missing():
    nan = np.full(3, np.nan)
    found = SignedErrors(np.array([math.pi, 0, 0]), np.array([0.0, 0.0, 1.0]), nan, nan)
    for name in ("in_camera_m", "along_marker_m", "of_camera_m", "yaw_pitch_roll_deg",
                 "tilt_deg", "viewing_angle_deg", "in_plane_deg"):
        assert np.isnan(getattr(found, name)).all(), name


# The statistics.

def signed_of(results):
    """Return every signed error (dims) of a dataset, by SciPy alone."""
    wide = xr.broadcast(results[["true_rvec", "true_tvec_m", "rotation_error_rad",
                                 "translation_error_m"]])[0]
    dims = [dim for dim in wide.dims if dim != "xyz"]
    arrays = {name: wide[name].transpose(*dims, "xyz").values.reshape(-1, 3).astype(float)
              for name in wide.data_vars}
    error = np.nan_to_num(arrays["rotation_error_rad"])
    moved = np.nan_to_num(arrays["translation_error_m"])
    true = Rotation.from_rotvec(arrays["true_rvec"])
    estimate = Rotation.from_rotvec(error) * true
    position = np.nan_to_num(arrays["true_tvec_m"])
    angles = [(each * UPRIGHT.inv()).as_euler("YXZ", degrees=True) for each in (estimate, true)]
    camera = true.inv().apply(position) - estimate.inv().apply(position + moved)
    ahead = np.tile([0.0, 0.0, -1.0], (len(error), 1))
    quaternion = Rotation.from_rotvec(error).as_quat()
    columns = {
        **dict(zip("xyz", moved.T, strict=True)),
        **{f"marker_frame_{k}": c for k, c in zip("xyz", true.inv().apply(moved).T, strict=True)},
        **{f"camera_in_marker_{k}": c for k, c in zip("xyz", camera.T, strict=True)},
        **dict(zip(("yaw", "pitch", "roll"), ((angles[0] - angles[1] + 180) % 360 - 180).T,
                   strict=True)),
        "tilt": angle(normal_of(estimate), ahead) - angle(normal_of(true), ahead),
        "viewing_angle": angle(normal_of(estimate), -position - moved)
        - angle(normal_of(true), -position),
        "in_plane": np.degrees(2 * np.arctan2(
            (quaternion[:, :3] * normal_of(true)).sum(1), quaternion[:, 3])),
    }
    shape = [wide.sizes[dim] for dim in dims]
    return {name: xr.DataArray(values.reshape(shape), dims=dims)
            for name, values in columns.items()}


@pytest.mark.parametrize("per", [(), ("tilt_deg", "solver")])
def test_bias_and_spread_are_those_of_plain_arithmetic(per):
    results = mixed(ALL, seed=4)
    used = (results["estimate"] == EstimateStatus.solved) & (
        results["flipped"] != Flipped.flipped)
    expected = signed_of(results)
    over = [dim for dim in used.dims if dim not in per]
    answer = error_statistics(results, per, quantities=list(SIGNED))
    assert not [name for name in answer if name.startswith(("rotation", "range", "position"))]
    for name in NAMES:
        unit = "m" if ("_" in name and "angle" not in name and "plane" not in name) or len(
            name) == 1 else "deg"
        values = expected[name].where(used)
        np.testing.assert_allclose(
            answer[f"{name}_bias_{unit}"].transpose(*per), values.mean(over).transpose(*per),
            rtol=1e-6, atol=1e-6, err_msg=name)
        np.testing.assert_allclose(
            answer[f"{name}_sd_{unit}"].transpose(*per), values.std(over, ddof=1).transpose(*per),
            rtol=1e-6, atol=1e-6, err_msg=name)
        for statistic in ("bias", "sd"):
            array = answer[f"{name}_{statistic}_{unit}"]
            low, high = (answer[f"{name}_{statistic}_{unit}_{end}"] for end in ("low", "high"))
            assert ((low <= array) & (array <= high)).all(), name
            assert array.attrs["units"] == {"m": "m", "deg": "degree"}[unit]
            assert array.attrs["long_name"]


def test_bias_and_spread_of_signed_errors_are_covered():
    # 400 conditions of 50 draws; the chance of a false alarm is below 1e-6 for each, for
    # coverages of 0.93 and more.
    rng = np.random.default_rng(5)
    sizes = {"regime": 400, "marker_id": 1, "trial": 50}
    results = perfect(rng, sizes, rotation=rng.normal([0.01, 0, -0.02], 0.01, (400, 1, 50, 3)),
                      position=rng.normal([0.001, 0.0, 0.004], 0.003, (400, 1, 50, 3)))
    results["true_rvec"].values[...] = [math.pi, 0.0, 0.0]
    answer = error_statistics(results, ["regime"], quantities=["camera_frame", "in_plane"])
    truth = {"x_bias_m": 0.001, "z_bias_m": 0.004, "y_sd_m": 0.003,
             "in_plane_bias_deg": math.degrees(0.02), "in_plane_sd_deg": math.degrees(0.01)}
    for name, value in truth.items():
        count = int(((answer[f"{name}_low"] <= value) & (value <= answer[f"{name}_high"])).sum())
        assert stats.binom.cdf(count, 400, 0.93) > 5e-7, name


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
