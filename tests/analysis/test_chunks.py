"""Analyses of lazy datasets: nothing is computed by the call, and chunking changes nothing."""

import functools

import dask.array
import numpy as np
import pytest
import xarray as xr
from dask.callbacks import Callback
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from support.small_datasets import INNER, mixed
from sweep.analysis import (
    compare,
    detection_limit,
    detection_rate,
    error_statistics,
    failure_composition,
    flip_rate,
    marker_ranking,
)

SIZES = {"dictionary": 2, "marker_id": 3, "tilt_deg": 2, "side_px": 3, "noise_grey": 2, "trial": 5,
         "cornerRefinementMethod": 2, "solver": 2}
RESULTS = mixed(SIZES, 20)
BINS = {"marker_area_px": [100.0, 400.0, 500.0, 1001.0]}


def between(results, name, per=(), bins=None):
    return compare(results.isel({name: 0}), results.isel({name: 1}), per, bins)


CALLS = {
    "detection_rate": lambda r: detection_rate(r, ("tilt_deg",)),
    "detection_rate in bins": lambda r: detection_rate(r, ("dictionary",), BINS),
    "flip_rate": lambda r: flip_rate(r, ("solver", "trial")),
    "failure_composition": lambda r: failure_composition(r, ("side_px", "noise_grey")),
    "error_statistics of all": error_statistics,
    "error_statistics": lambda r: error_statistics(r, ("tilt_deg", "cornerRefinementMethod")),
    "error_statistics in bins": lambda r: error_statistics(r, ("solver",), BINS),
    "marker_ranking": marker_ranking,
    "marker_ranking of tilts": lambda r: marker_ranking(r, ("tilt_deg",)),
    "compare solvers": lambda r: between(r, "solver", ("side_px",)),
    "compare detectors": lambda r: between(r, "cornerRefinementMethod", ("noise_grey",), BINS),
    "detection_limit": lambda r: detection_limit(r, 0.5, ("dictionary", "noise_grey")),
}


OFTEN = {"detection_rate in bins", "error_statistics", "compare detectors", "marker_ranking"}
EVERY_CALL = pytest.mark.parametrize("call", CALLS)
SOME_CALLS = pytest.mark.parametrize("call", [
    pytest.param(call, marks=[] if call in OFTEN else [pytest.mark.long]) for call in CALLS
])


def is_exact(name, array):
    """Tell whether a variable must be the same to the last bit: counts, quantiles and flags."""
    return array.dtype.kind != "f" or any(part in name for part in ("median", "p95", "p99"))


@functools.cache
def of_memory(call):
    return CALLS[call](RESULTS).compute()


def assert_same(answer, expected):
    assert set(answer.data_vars) == set(expected.data_vars)
    assert set(answer.coords) == set(expected.coords)
    for name, array in expected.variables.items():
        if is_exact(name, array):
            np.testing.assert_array_equal(answer[name], array, err_msg=name)
        else:
            np.testing.assert_allclose(answer[name], array, rtol=1e-10, atol=1e-15, err_msg=name)
        assert answer[name].dims == array.dims
        assert answer[name].dtype == array.dtype


@st.composite
def chunkings(draw):
    """Draw the lengths of the chunks along up to three dimensions, also a variable's own one."""
    sizes = SIZES | {"xyz": len(INNER["xyz"])}
    chunks = dict.fromkeys(sizes, -1)
    for name in draw(st.sets(st.sampled_from(list(sizes)), min_size=1, max_size=3)):
        cuts = draw(st.sets(st.integers(1, sizes[name] - 1), min_size=1, max_size=2))
        chunks[name] = tuple(np.diff([0, *sorted(cuts), sizes[name]]).tolist())
    return chunks


@pytest.mark.parametrize(("call", "count"), [(call, 2) for call in sorted(OFTEN)] + [
    pytest.param(call, 100, marks=pytest.mark.long) for call in CALLS
])
def test_any_chunking_gives_the_same(call, count):
    @settings(derandomize=True, deadline=None, max_examples=count, database=None,
              phases=[Phase.generate])
    @given(chunkings())
    def same(chunks):
        assert_same(CALLS[call](RESULTS.chunk(chunks)).compute(), of_memory(call))

    same()


@pytest.mark.long
@EVERY_CALL
def test_chunks_of_one_value_each_give_the_same(call):
    assert_same(CALLS[call](RESULTS.isel(trial=slice(3)).chunk(1)).compute(),
                CALLS[call](RESULTS.isel(trial=slice(3))).compute())


@SOME_CALLS
def test_variables_may_be_chunked_differently(call):
    chunked = RESULTS.chunk(trial=3, marker_id=2)
    chunked["estimate"] = RESULTS["estimate"].chunk(trial=2, solver=1)
    chunked["detection"] = RESULTS["detection"]  # in memory beside lazy ones
    chunked["rotation_error_rad"] = RESULTS["rotation_error_rad"].chunk(-1)
    assert_same(CALLS[call](chunked).compute(), of_memory(call))


@SOME_CALLS
def test_slices_of_a_lazy_dataset_are_those_of_memory(call):
    part = {"trial": slice(1, 4), "marker_id": [2, 0], "side_px": slice(None, None, -1)}
    answer = CALLS[call](RESULTS.chunk(trial=2, marker_id=1, solver=1).isel(part)).compute()
    assert_same(answer, CALLS[call](RESULTS.isel(part)).compute())


def unreadable(results):
    """Return the dataset with lazy variables whose values cannot be computed."""
    def refuse(block):
        raise AssertionError(f"a block of {block.shape} was computed")

    out = results.copy()
    for name, array in results.chunk(trial=3, marker_id=1).data_vars.items():
        lazy = dask.array.map_blocks(
            refuse, array.data, dtype=array.dtype, meta=np.empty((0,) * array.ndim, array.dtype))
        out[name] = (array.dims, lazy, array.attrs)
    return out


class Counter(Callback):
    """Counts the tasks that a scheduler starts."""

    def __init__(self):
        super().__init__(pretask=self.note)
        self.tasks = 0

    def note(self, *_):
        self.tasks += 1


@EVERY_CALL
def test_the_call_computes_nothing_and_what_it_gives_is_lazy(call):
    with Counter() as counter:
        answer = CALLS[call](unreadable(RESULTS))
    assert counter.tasks == 0
    for name, array in answer.data_vars.items():
        assert dask.is_dask_collection(array.data), name
    with pytest.raises(AssertionError, match="was computed"):
        answer.compute()


@SOME_CALLS
def test_lazy_results_have_the_shape_and_kind_of_those_in_memory(call):
    lazy, expected = CALLS[call](RESULTS.chunk(trial=2)), of_memory(call)
    for name, array in expected.variables.items():
        assert lazy[name].dims == array.dims, name
        assert lazy[name].shape == array.shape, name
        assert lazy[name].dtype == array.dtype, name
        assert lazy[name].attrs == array.attrs, name


@SOME_CALLS
def test_each_value_is_read_twice_at_most(call):
    reads = []

    def noted(block, block_info=None):
        if block_info:  # none where Dask asks for the kind only
            reads.append(block.size)
        return block

    lazy = RESULTS.chunk(trial=3, marker_id=1, side_px=1)
    total = 0
    for name, array in list(lazy.data_vars.items()):
        total += array.size
        data = array.data.map_blocks(
            noted, dtype=array.dtype, meta=np.empty((0,) * array.ndim, array.dtype))
        lazy[name] = (array.dims, data, array.attrs)
    answer = CALLS[call](lazy)
    reads.clear()
    answer.compute()
    print(f"{call}: {sum(reads) / total:.2f} reads a value")
    assert sum(reads) <= 2 * total


EVERY_FUNCTION = pytest.mark.parametrize("function", [
    error_statistics,
    pytest.param(lambda r: compare(r, r), id="compare"),
    *(pytest.param(function, marks=pytest.mark.long) for function in (
        detection_rate, flip_rate, failure_composition, marker_ranking)),
])


class Cache(Callback):
    """Notes the most bytes of arrays that a scheduler keeps at a time."""

    def __init__(self):
        super().__init__(posttask=self.note)
        self.most = 0

    def note(self, _key, _result, _graph, state, _worker):
        kept = sum(value.nbytes for value in state["cache"].values()
                   if isinstance(value, np.ndarray))
        self.most = max(self.most, kept)


@pytest.mark.long
@EVERY_FUNCTION
def test_what_was_looked_at_is_not_kept_in_memory(function, tmp_path):
    results = mixed({"marker_id": 2, "trial": 120}, 21).drop_vars("xyz")
    results.chunk(trial=4).to_zarr(tmp_path / "store.zarr", zarr_format=3, consolidated=False)
    lazy = xr.open_zarr(tmp_path / "store.zarr", consolidated=False)
    answer = function(lazy)
    with Cache() as cache:
        answer.compute(scheduler="synchronous")
    whole = sum(array.nbytes for array in lazy.data_vars.values())
    print(f"{cache.most / whole:.3f} of the store in memory at a time, in 30 chunks")
    assert cache.most < 0.25 * whole
