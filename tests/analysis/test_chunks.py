"""Neither the blocks in which poses are computed nor the chunks of a dataset change anything."""

import functools

import numpy as np
import pytest
import xarray as xr

from support.small_datasets import ALL, mixed
from sweep.analysis import (
    compare,
    covariance_trust,
    detection_rate,
    efficiency,
    error_models,
    error_statistics,
    estimator,
    failure_composition,
    flip_rate,
    marker_ranking,
)

RESULTS = mixed(ALL, 20)
REPLICATED = mixed({"tilt_deg": 2, "noise_grey": 2, "trial": 64, "solver": 2}, 21).assign_attrs(
    sweep={"fingerprint": {"sampling": "sobol"}})

EDGES = RESULTS.assign(
    # No bound here, one of 0 there; a pose without an error, one without depth.
    bound_std=RESULTS["marker_area_px"].expand_dims(pose_parameter=[
        "rotation_x", "rotation_y", "rotation_z", "translation_z"], axis=-1) * [0, 1, np.nan, 1],
    rotation_error_rad=0 * RESULTS["rotation_error_rad"],
    true_tvec_m=0 * RESULTS["true_tvec_m"])
"""Where divisions, roots and logarithms have no value."""

BINS = {"marker_area_px": [100.0, 400.0, 500.0, 1001.0]}


CALLS = {
    "detection_rate in bins": lambda r: detection_rate(r, ("dictionary",), BINS),
    "failure_composition": lambda r: failure_composition(r, ("side_px", "noise_grey")),
    "error_statistics of all": error_statistics,
    "error_statistics in bins": lambda r: error_statistics(r, ("solver",), BINS),
    "error_statistics of replicates": lambda _: error_statistics(REPLICATED, ("solver",)),
    "error_models": lambda _: error_models(mixed({"side_px": 3, "trial": 250}, 22)),
    "marker_ranking": marker_ranking,
    "compare": lambda r: compare(
        r.isel(cornerRefinementMethod=0), r.isel(cornerRefinementMethod=1), ("noise_grey",), BINS),
}
EVERY_CALL = pytest.mark.parametrize("call", CALLS)


@functools.cache
def expected(call):
    return CALLS[call](RESULTS)


def assert_same(answer, call):
    assert set(answer.variables) == set(expected(call).variables)
    for name, array in expected(call).variables.items():
        assert answer[name].dims == array.dims
        assert answer[name].dtype == array.dtype
        assert answer[name].attrs == array.attrs
        # Counts, quantiles and flags are the same to the last bit.
        if array.dtype.kind != "f" or any(part in name for part in ("median", "p95", "p99")):
            np.testing.assert_array_equal(answer[name], array, err_msg=name)
        else:
            np.testing.assert_allclose(answer[name], array, rtol=1e-9, atol=1e-15, err_msg=name)


@pytest.mark.parametrize("analysis", [
    efficiency, error_statistics, covariance_trust, flip_rate, failure_composition])
def test_a_lazy_dataset_without_values_gives_the_same_without_a_warning(analysis):
    lazy = analysis(EDGES.chunk(trial=3), ("solver",)).compute()
    xr.testing.assert_identical(lazy, analysis(EDGES, ("solver",)))


@EVERY_CALL
def test_blocks_of_any_size_give_the_same(call, monkeypatch):
    assert expected(call) is not None
    monkeypatch.setattr(estimator, "MAX_BLOCK", 7)
    assert_same(CALLS[call](RESULTS), call)


@EVERY_CALL
def test_variables_may_be_chunked_each_in_its_own_way(call):
    chunked = RESULTS.chunk(trial=3, marker_id=2)
    chunked["estimate"] = RESULTS["estimate"].chunk(trial=2, solver=1)
    chunked["detection"] = RESULTS["detection"]  # in memory beside lazy ones
    chunked["rotation_error_rad"] = RESULTS["rotation_error_rad"].chunk(xyz=1)
    assert_same(CALLS[call](chunked), call)
