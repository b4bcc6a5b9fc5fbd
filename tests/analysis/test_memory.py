"""What the analyses of 10^7 poses need: their columns, 350 MB, and as much beside them."""

import pytest

from benchmarks.bench_analysis import CALLS, measured, write_store


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stores")
    return [write_store(folder, poses) for poses in (10**6, 10**7)]


@pytest.mark.evidence
@pytest.mark.parametrize("name", CALLS)
def test_ten_million_poses_are_analysed_below_a_gigabyte(stores, name):
    small, large = (measured(store, CALLS[name]) for store, _ in stores)
    print(f"\n{name}: {small['peak'] / 1e6:.0f} MB at {stores[0][1]:,} poses, "
          f"{large['peak'] / 1e6:.0f} MB at {stores[1][1]:,}; "
          f"{small['seconds']:.1f} and {large['seconds']:.1f} s")
    assert large["peak"] < 1e9
