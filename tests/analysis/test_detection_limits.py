"""The limit of detection along any axes that change the size in the image, by plain loops."""

import math

import numpy as np
import pytest

from support.small_datasets import perfect, with_detected
from sweep.analysis import detection_limit
from sweep.analysis.requirements import Reach
from sweep.errors import ArgumentError, DatasetError

TEXT = """
[camera]
width_px = 640
height_px = 480
{camera}
[marker]
dictionary = "DICT_4X4_50"
{marker}
[pose]
jitter_px = 0.5
{pose}
[axes]
trial = 40
"""
FX, SIZE_M, DISTANCE_M, TRIALS = 600.0, 0.06, 1.0, 40
HFOV = [20.0, 40.0, 60.0, 80.0]


def dataset(coordinates, rates, camera="fx_px = 600", marker="size_m = 0.06",
            pose="distance_m = 1.0"):
    """Return a dataset with these axes, whose rate at each cell (...) is exactly this."""
    rates = np.asarray(rates)
    sizes = {name: len(values) for name, values in coordinates.items()} | {"trial": TRIALS}
    results = perfect(np.random.default_rng(3), sizes).assign_coords(coordinates)
    results.attrs["pipeline"] = TEXT.format(camera=camera, marker=marker, pose=pose)
    return with_detected(results, np.round(rates * TRIALS)[..., None] > np.arange(TRIALS))


AXES = {
    "size_m": ([0.02, 0.04, 0.08, 0.16], lambda v: FX * v / DISTANCE_M, {"marker": ""}),
    "fx_px": ([200.0, 400.0, 800.0, 1600.0], lambda v: v * SIZE_M / DISTANCE_M, {"camera": ""}),
    "focal_length_mm": (
        [2.0, 4.0, 8.0, 16.0], lambda v: v / 4.8 * 640 * SIZE_M / DISTANCE_M,
        {"camera": "sensor_width_mm = 4.8\nsensor_height_mm = 3.6"}),
    "hfov_deg": (HFOV, lambda v: 320 / math.tan(math.radians(v) / 2) * SIZE_M / DISTANCE_M,
                 {"camera": ""}),
    "pixel_size_um": ([2.0, 4.0, 8.0, 16.0], lambda v: 4e3 / v * SIZE_M / DISTANCE_M,
                      {"camera": "focal_length_mm = 4"}),
    "distance_m": ([0.5, 1.0, 2.0, 4.0], lambda v: FX * SIZE_M / v, {}),
}


@pytest.mark.parametrize("name", AXES)
def test_the_limit_is_found_along_any_axis_that_changes_the_size(name):
    values, side_of, texts = AXES[name]
    sides = [side_of(value) for value in values]
    rates = [1.0 if side > sorted(sides)[1] * 1.01 else 0.5 for side in sides]
    answer = detection_limit(dataset({name: values}, rates, **texts), rate=0.9)
    expected = sorted(sides)[2]  # down to which all are detected
    assert answer["side_px"].item() == pytest.approx(expected, rel=1e-9)
    assert Reach(answer["reach"].item()) is Reach.found
    value, low, high = (answer[f"{name}{end}"].item() for end in ("", "_low", "_high"))
    assert value == values[sides.index(expected)]
    assert low <= value <= high
    assert {low, high} <= {-math.inf, math.inf, *values}


def test_a_limit_for_each_size_has_the_same_side():
    results = dataset({"distance_m": [1.0, 2.0, 4.0], "size_m": [0.06, 0.12]},
                      [[1.0, 1.0], [0.5, 1.0], [0.0, 0.5]], marker="")
    answer = detection_limit(results, rate=0.7, per=["size_m"])
    assert answer["distance_m"].values.tolist() == [1.0, 2.0]
    assert answer["side_px"].values.tolist() == pytest.approx([FX * SIZE_M] * 2)
    np.testing.assert_allclose(answer["side_px_per_module"], FX * SIZE_M / 6)


def test_an_axis_of_sides_may_have_their_distances():
    results = dataset({"side_px": [10.0, 20.0, 40.0]}, [0.2, 0.5, 1.0]).assign_coords(
        distance_m=("side_px", [4.0, 2.0, 1.0]))
    assert detection_limit(results)["side_px"] == 40.0


@pytest.mark.parametrize(("results", "per", "error", "problem"), [
    (dataset({"tilt_deg": [0.0, 10.0]}, [1.0, 1.0]), None, ArgumentError, "there are none"),
    *((dataset({"distance_m": [1.0, 2.0], "size_m": [0.1, 0.2]}, np.ones((2, 2)), marker=""), per,
       ArgumentError, "but one") for per in ([], ["distance_m", "size_m"])),
    (dataset({"tilt_deg": [0.0]}, [1.0], pose="distance_m = { uniform = [1, 5] }").assign_coords(
        distance_m=("trial", np.linspace(1.0, 5.0, TRIALS))), None, DatasetError, "is drawn"),
])
def test_a_limit_that_cannot_be_is_refused(results, per, error, problem):
    with pytest.raises(error, match=problem) as refused:
        detection_limit(results, per=per)
    assert "\n" not in str(refused.value)
