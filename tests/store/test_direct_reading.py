"""Chunks that are read without Zarr hold what Zarr reads, bit for bit."""

import pickle
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import sweep
from support.reports import CAMERA, made
from sweep.analysis.pose_view import component_sum
from sweep.store.direct_reading import ChunkedVariable
from sweep.store.lifecycle import open_store
from sweep.store.snapshot import Snapshot, snapshot

GRID = f"""
{CAMERA}
[pose]
jitter_px = 0.5
[axes]
solver = ["ippe_square", "iterative"]
side_px = [6, 20, 40]
tilt_deg = [0, 60, 80]
"""


@pytest.fixture(scope="module")
def unfinished(tmp_path_factory):
    """A store of which one block of four is computed; the last ones are shorter."""
    return made(tmp_path_factory.mktemp("stores"), GRID, "grid", finished=False)


def by_zarr(url):
    return xr.open_zarr(snapshot(open_store(url)), consolidated=False, zarr_format=3)


def test_every_variable_has_the_bits_attributes_and_chunks_that_zarr_gives(unfinished, monkeypatch):
    with by_zarr(unfinished) as expected:
        chunks = {name: expected[name].chunks for name in expected.data_vars}
        whole = expected.load()
    results = sweep.open(unfinished)
    read = []
    kept = ChunkedVariable._chunk
    monkeypatch.setattr(
        ChunkedVariable, "_chunk", lambda self, at: read.append(at) or kept(self, at))
    for name, values in results.data_vars.items():
        assert values.to_numpy().tobytes() == whole[name].to_numpy().tobytes()
        assert values.dtype == whole[name].dtype
        assert values.dims == whole[name].dims
        assert values.attrs == whole[name].attrs
        assert values.chunks == chunks[name]
    assert len(read) >= 4 * len(results.data_vars)


def test_any_slice_has_the_bits_that_zarr_gives(unfinished):
    with by_zarr(unfinished) as expected:
        errors = expected["rotation_error_rad"].load()
    lazy = sweep.open(unfinished)["rotation_error_rad"]
    for index in (
        {"side_px": 1}, {"side_px": slice(1, 3), "tilt_deg": -1},
        {"tilt_deg": slice(None, None, 2)}, {"side_px": [2, 0]}, {"xyz": 2, "solver": 1},
        {"side_px": slice(0, 0)},
    ):
        np.testing.assert_array_equal(lazy.isel(index).to_numpy(), errors.isel(index).to_numpy())


def test_it_can_be_sent_to_other_processes(unfinished):
    results = sweep.open(unfinished)[["estimate"]]
    xr.testing.assert_identical(pickle.loads(pickle.dumps(results)).load(), results.load())  # noqa: S301


def test_chunks_are_read_in_the_thread_that_asks(unfinished, monkeypatch):
    results = sweep.open(unfinished)

    async def refused(*_, **__):
        raise AssertionError

    monkeypatch.setattr(Snapshot, "get", refused)
    assert results["estimate"].data.compute().size == 18


def test_what_is_missing_is_the_fill_value_and_what_is_damaged_is_told(tmp_path):
    url = made(tmp_path, GRID, "damaged")
    chunks = sorted(path for path in Path(url, "rotation_error_deg", "c").rglob("*")
                    if path.is_file())
    chunks[0].unlink()
    chunks[1].write_bytes(chunks[1].read_bytes()[:-1] + b"x")
    chunks[2].write_bytes(b"")
    read = sweep.open(url)["rotation_error_deg"].data.to_delayed().ravel()
    assert np.isnan(read[0].compute()).all()
    for number in (1, 2):
        with pytest.raises(ValueError, match=r"rotation_error_deg/c/.*: damaged"):
            read[number].compute()


@pytest.mark.parametrize("components", [1, 2, 3, 5])
def test_components_are_summed_as_numpy_sums_them(components):
    rng = np.random.default_rng(components)
    values = rng.standard_normal((7, 5, 3, components)) * 10.0 ** rng.uniform(-9, 9, (7, 5, 3, 1))
    values[rng.random(values.shape) < 0.1] = np.nan
    values[rng.random(values.shape) < 0.1] = -0.0
    for array in (values, values.transpose(2, 1, 0, 3), np.asfortranarray(values), -0.0 * values):
        assert component_sum(array).tobytes() == array.sum(axis=-1).tobytes()
