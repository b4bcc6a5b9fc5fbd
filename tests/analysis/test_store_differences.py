"""What differs between two stores of one pipeline is what plain NumPy counts, pose by pose."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.example_results import example_results
from sweep.analysis import store_differences
from sweep.errors import DatasetError
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import DetectionStatus, EstimateStatus

TEXT = """
[pose]
distance_m = 0.3
[axes]
tilt_deg = [0, 30]
"""


@pytest.fixture
def first():
    return example_results()


def test_flags_corners_and_poses_that_differ_are_those_of_plain_numpy(first):
    rng = np.random.default_rng(1)
    flags = first["detection"].values.copy()
    lost = tuple(np.argwhere(flags == DetectionStatus.detected)[0])
    flags[lost] = DetectionStatus.rejected
    flags[0, 0] = DetectionStatus.not_needed
    moves = rng.normal(size=first["corner_error_px"].shape)
    moves[rng.random(moves.shape) > 0.3] = 0
    turns = rng.normal(scale=0.1, size=(*first["estimate"].shape, 3)) * [[0.0], [1.0]]
    second = first.assign(
        detection=(first["detection"].dims, flags),
        corner_error_px=first["corner_error_px"] + moves,
        rotation_error_rad=first["rotation_error_rad"] + turns,
        translation_error_m=first["translation_error_m"] + 0.001 * turns,
    )
    table = store_differences(first.chunk({"side_px": 1}), second.chunk({"trial": 3}))
    assert table["detections_compared"] == flags.size - 1
    assert table["computed_once"] == 1
    assert table["detections_differing"] == 1
    assert table["detections"].sel(first_detection="detected", second_detection="rejected") == 1
    computed = flags != DetectionStatus.not_needed
    apart = np.hypot(*np.moveaxis(moves, -1, 0))[computed]
    assert table["corners_compared"] == apart.size
    assert table["corners_differing"] == (apart > 0).sum()
    np.testing.assert_allclose(
        table["corner_shift_px"],
        [*np.quantile(apart[apart > 0], [0.5, 0.99]), apart.max()], rtol=1e-6)
    solved = (first["estimate"] == EstimateStatus.solved).values
    assert table["poses_compared"].values.tolist() == solved.sum(axis=(0, 1)).tolist()
    assert table["poses_differing"].values.tolist() == [0, solved[..., 1].sum()]
    assert np.isnan(table["rotation_shift_deg"][0]).all()
    rotations = [
        Rotation.from_rotvec(side["rotation_error_rad"].values[solved[..., 1], 1])
        for side in (first, second)
    ]
    angles = np.degrees((rotations[1] * rotations[0].inv()).magnitude())
    np.testing.assert_allclose(table["rotation_shift_deg"][1, 2], angles.max(), rtol=1e-6)
    lengths = 0.001 * np.linalg.norm(turns[solved[..., 1], 1], axis=-1)
    np.testing.assert_allclose(table["position_shift_m"][1, 0], np.median(lengths), rtol=1e-5)


def test_what_differs_in_the_fingerprints_is_listed(first, tmp_path):
    def made_with(**fingerprint):
        return first.assign_attrs(sweep=json.dumps({"fingerprint": fingerprint}))

    table = store_differences(
        made_with(seed=1, opencv="4.14.0", builds={"numpy": "a", "numba": "b"}),
        made_with(seed=1, opencv="5.0.0", builds={"numpy": "a", "numba": "c"}, plugins={"x": "1"}),
    )
    assert dict(zip(table["entry"].values, table["fingerprint"].values.tolist(), strict=True)) == {
        "builds.numba": ["b", "c"], "opencv": ["4.14.0", "5.0.0"], "plugins.x": ["none", "1"]}
    table.to_netcdf(tmp_path / "table.nc")


def with_pipeline(results, text):
    return results.assign_attrs(
        pipeline=Pipeline.from_text(text).text, sweep=json.dumps({"format": 5, "fingerprint": {}}))


@pytest.mark.parametrize(("change", "named"), [
    (lambda each: each.assign_coords(side_px=[10.0, 20.0, 41.0]), "side_px"),
    (lambda each: each.isel(solver=0, drop=True), "solver"),
    (lambda each: each.assign(true_tvec_m=each["true_tvec_m"] + 0.01), "true_tvec_m"),
    (lambda each: each.drop_vars("estimate"), "estimate"),
    (lambda each: with_pipeline(each, TEXT + "[scene]\nnoise_grey = 2"), "noise_grey is 0"),
    (lambda each: each.assign_attrs(sweep='{"fingerprint": {"seed": 2}}'), "seeds 1 and 2"),
])
def test_stores_that_are_no_pair_are_refused_in_one_line(first, change, named):
    first = with_pipeline(first, TEXT)
    if "seed" in named:
        first = first.assign_attrs(sweep='{"fingerprint": {"seed": 1}}')
    with pytest.raises(DatasetError, match=named) as refused:
        store_differences(first, change(first))
    assert "\n" not in str(refused.value)
