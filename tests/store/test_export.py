"""An opened store in the formats and words of others: netCDF, Zarr, tables, labelled flags."""

import json
import warnings

import numpy as np
import pytest
import xarray as xr

import sweep
from support.stores import by_hand
from sweep.errors import ArgumentError
from sweep.execution.status import close
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped
from sweep.store.blocks import drop_block

TEXT = """
title = "Exported"
pose = { jitter_px = 0.5, roll_deg = { uniform = [0, 360] } }
estimator = { corner_noise_px = 0.3 }
[axes]
dictionary = ["DICT_4X4_50", "DICT_5X5_50"]
side_px = [5, 60]
guarded = [true, false]
trial = 2
"""

FLAGS = {"detection": DetectionStatus, "estimate": EstimateStatus, "flipped": Flipped}

ENGINES = {"scipy": "scipy", "netcdf4": "netCDF4", "h5netcdf": "h5netcdf"}


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    """A finished store, and one of which half the blocks are computed."""
    folder = tmp_path_factory.mktemp("exported")
    pipeline = Pipeline.from_text(TEXT, name="exported")
    whole, half = str(folder / "whole.zarr"), str(folder / "half.zarr")
    close(by_hand(whole, pipeline, (1, 2, 2)))
    store = by_hand(half, pipeline, (1, 2, 2))
    drop_block(store, store.blocks[1])
    return whole, half


@pytest.fixture(scope="module", params=["whole", "half"])
def results(request, stores):
    return sweep.open(stores[request.param == "half"])


@pytest.mark.parametrize("engine", ENGINES)
def test_an_opened_store_is_written_as_netcdf_and_read_again(engine, results, tmp_path):
    pytest.importorskip(ENGINES[engine])
    path = tmp_path / "results.nc"
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "endian-ness")  # of netCDF4, on native numbers
        results.to_netcdf(path, engine=engine)
    with xr.open_dataset(path, engine=engine) as again:
        assert set(again.variables) == set(results.variables)
        for name, variable in results.variables.items():
            there = again[name].transpose(*variable.dims)
            np.testing.assert_array_equal(there.values, variable.values, err_msg=str(name))
        assert again.attrs["pipeline"] == TEXT
        assert json.loads(again.attrs["sweep"]) == json.loads(results.attrs["sweep"])


def test_an_opened_store_is_copied_as_zarr_and_as_a_table(results, tmp_path):
    results.to_zarr(tmp_path / "copy.zarr", consolidated=False)
    with xr.open_zarr(tmp_path / "copy.zarr", consolidated=False) as again:
        np.testing.assert_array_equal(again.detection.values, results.detection.values)
    table = results[["detection", "rotation_error_deg"]].to_dataframe()
    assert len(table) == results.rotation_error_deg.size


def test_every_flag_is_told_in_words_lazily_and_all_else_stays(results):
    told = sweep.decode_flags(results)
    assert told.detection.chunks is not None
    for name, flags in FLAGS.items():
        words = [flags(value).name for value in results[name].values.ravel()]
        assert told[name].values.ravel().tolist() == words
        assert told[name].attrs.keys() == results[name].attrs.keys() - {
            "flag_values", "flag_meanings"}
    flagged = [name for name in results.data_vars if "flag_meanings" in results[name].attrs]
    xr.testing.assert_identical(
        told.drop_vars(flagged).compute(), results.drop_vars(flagged).compute())
    masked = sweep.decode_flags(results.detection.where(results.side_px > 30))
    assert (masked.isel(side_px=0) == "not_run").all()
    assert (masked.isel(side_px=1) == told.detection.isel(side_px=1)).all()
    for value in (0.5, -1, 257):  # 257 is 1 in eight bits, as "detected" is
        other = results.detection.astype(type(value)) * 0 + value
        other.attrs = results.detection.attrs
        assert (sweep.decode_flags(other) == "unknown").all(), value


@pytest.mark.parametrize("given", ["runs/smoke.zarr", np.ones(3, dtype="u1")])
def test_what_has_no_flags_to_decode_is_refused_in_a_line(given):
    with pytest.raises(ArgumentError, match="expected a dataset") as error:
        sweep.decode_flags(given)
    assert "\n" not in str(error.value)
