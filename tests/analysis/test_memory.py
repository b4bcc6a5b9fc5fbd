"""What the analyses of 10^7 poses need: their columns, 350 MB, and as much beside them."""

import pytest

from benchmarks.bench_analysis import CALLS, measured, write_store


@pytest.mark.evidence
def test_ten_million_poses_are_analysed_below_a_gigabyte(tmp_path, claim):
    store, _ = write_store(tmp_path, 10**7)
    for name in ("error_statistics, all", "error_statistics", "ambiguity", "compare"):
        peak = measured(store, CALLS[name])["peak"]
        claim("memory of an analysis of 10^7 poses", "a fresh interpreter", peak / 1e6, "MB")
        assert peak < 1e9
