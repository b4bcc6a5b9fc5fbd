"""Memory of the analyses grows with the columns that are sorted, and with nothing else."""

import pytest

from benchmarks.bench_analysis import CALLS, measured, write_store


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stores")
    return [write_store(folder, poses) for poses in (10**6, 10**7)]


@pytest.mark.long
@pytest.mark.parametrize("name", CALLS)
def test_ten_million_poses_are_analysed_below_a_gigabyte(stores, name):
    small, large = (measured(store, CALLS[name]) for store, _ in stores)
    print(f"\n{name}: {small['peak'] / 1e6:.0f} MB at {stores[0][1]:,} poses, "
          f"{large['peak'] / 1e6:.0f} MB at {stores[1][1]:,}; "
          f"{small['compute_s']:.1f} and {large['compute_s']:.1f} s")
    assert large["peak"] < 1e9
    # The poses themselves are 350 MB more, the values of three columns 220 MB, twice while merged.
    assert large["peak"] - small["peak"] < (500e6 if "error_statistics" in name else 200e6)
