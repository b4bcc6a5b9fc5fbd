"""Neither the blocks in which poses are computed nor the chunks of a dataset change anything."""

import functools

import numpy as np
import pytest

from benchmarks import bench_analysis
from support.small_datasets import ALL, mixed
from sweep.analysis import (
    compare,
    detection_rate,
    error_models,
    error_statistics,
    estimator,
    failure_composition,
    marker_ranking,
)

RESULTS = mixed(ALL, 20)
REPLICATED = mixed({"tilt_deg": 2, "noise_grey": 2, "trial": 64, "solver": 2}, 21).assign_attrs(
    sweep={"fingerprint": {"sampling": "sobol"}})

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


@pytest.mark.parametrize("call", CALLS)
def test_blocks_of_any_size_and_variables_chunked_each_in_its_own_way_give_the_same(
    call, monkeypatch
):
    assert expected(call) is not None
    with monkeypatch.context() as patch:
        patch.setattr(estimator, "MAX_BLOCK", 7)
        assert_same(CALLS[call](RESULTS), call)
    chunked = RESULTS.chunk(trial=3, marker_id=2)
    chunked["estimate"] = RESULTS["estimate"].chunk(trial=2, solver=1)
    chunked["detection"] = RESULTS["detection"]  # in memory beside lazy ones
    chunked["rotation_error_rad"] = RESULTS["rotation_error_rad"].chunk(xyz=1)
    assert_same(CALLS[call](chunked), call)


@pytest.mark.evidence
def test_ten_million_poses_are_analysed_below_a_gigabyte(tmp_path, claim):
    store, _ = bench_analysis.write_store(tmp_path, 10**7)
    for name in ("error_statistics, all", "error_statistics", "ambiguity", "compare"):
        peak = bench_analysis.measured(store, bench_analysis.CALLS[name])["peak"]
        claim("memory of an analysis of 10^7 poses", "a fresh interpreter", peak / 1e6, "MB")
        assert peak < 1e9
