"""A run: the same numbers however it is run, nothing computed twice, nothing mixed."""

import os
import signal
import subprocess
import time

import cv2
import numpy as np
import pytest
import xarray as xr
import zarr

import sweep
from support.commands import started
from support.stores import GRID, by_hand, same
from sweep.errors import ArgumentError, MachineFaultError, StoreError
from sweep.execution.block_task import _opened, compute_block, match
from sweep.execution.runner import execute
from sweep.execution.status import status
from sweep.experiment.pipeline import Pipeline
from sweep.store import provenance
from sweep.store.blocks import committed
from sweep.store.lifecycle import create_store, open_store, remove_store
from sweep.store.provenance import builds

TEXT = GRID.partition("[axes]")[0].replace("seed = 11", "seed = 5") + """
[axes]
dictionary = ["DICT_4X4_50", "DICT_5X5_50"]
distance_m = { geom = [0.2, 1.5, 4] }
cornerRefinementMethod = ["none", "subpix"]
tilt_deg = [0, 50]
solver = ["ippe_square", "iterative"]
trial = 3
"""


@pytest.fixture(scope="module")
def pipeline():
    return Pipeline.from_text(TEXT, name="small")


@pytest.fixture(scope="module")
def undisturbed(pipeline, tmp_path_factory):
    """The store of one process that computes the whole grid as one block."""
    url = str(tmp_path_factory.mktemp("undisturbed") / "whole.zarr")
    by_hand(url, pipeline)
    return url


@pytest.mark.system
def test_number_of_workers_changes_no_bit(pipeline, undisturbed, tmp_path, monkeypatch):
    monkeypatch.setattr("sweep.execution.forecast.block_work_s", lambda *_: 0.02)
    url = str(tmp_path / "run.zarr")
    summary = execute(pipeline, url, workers=2)
    assert same(url, undisturbed)
    assert summary.poses == summary.computed_scenes == 48
    assert summary.results == summary.computed_estimates == 192
    assert open_store(url).finished


def test_stopped_run_is_reused_and_continues_and_finished_one_is_left_alone(
    pipeline, undisturbed, tmp_path
):
    url, new = str(tmp_path / "stopped.zarr"), str(tmp_path / "new.zarr")
    # A block that is computed twice is harmless.
    store = by_hand(url, pipeline, (1, 3, 2, 2), (0, 1, 2, 0))
    assert committed(store) == {0, 1, 2}
    assert not open_store(url).finished
    assert execute(pipeline, new, reuse=[url]).computed_scenes == 48 - (12 + 6 + 4)
    assert same(new, undisturbed)
    summary = execute(pipeline, url)
    assert summary.computed_blocks == len(store.blocks) - 3
    assert same(url, undisturbed)
    assert execute(pipeline, url).computed_blocks == 0


def test_xarray_opens_a_finished_store_with_labels_units_and_flags(pipeline, tmp_path):
    dataset = sweep.run(pipeline, store=tmp_path / "labelled.zarr")
    with xr.open_zarr(tmp_path / "labelled.zarr") as opened:
        assert opened.identical(dataset)
    assert dataset.true_tvec_m.dims == ("dictionary", "distance_m", "tilt_deg", "trial", "xyz")
    assert dataset.detection.attrs["flag_meanings"].split()[:2] == ["not_run", "detected"]
    assert dataset.corner.to_numpy().tolist()[0] == "top_left"
    with xr.open_zarr(tmp_path / "labelled.zarr", group="cost") as cost:
        assert cost.estimation_s.dims == ("block", "cornerRefinementMethod", "solver")
        assert float(cost.detection_s.sum()) > 0


def test_store_of_another_experiment_is_not_continued(pipeline, tmp_path):
    url = str(tmp_path / "one.zarr")
    by_hand(url, pipeline, (2, 4, 2, 3))
    other = Pipeline.from_text(TEXT, ["tilt_deg=[0, 51]", "seed=6", "white=200"], name="small")
    with pytest.raises(StoreError) as told:
        execute(other, url)
    text = str(told.value)
    assert "seed: the store has 5, this run 6" in text
    assert "axes.tilt_deg: the store has 0.0, 50.0, this run 0.0, 51.0" in text
    assert "white: the store has 255.0, this run 200.0" in text
    with pytest.raises(StoreError, match="seed: the store has 5, this run 6"):
        execute(other, tmp_path / "other.zarr", reuse=[url])
    assert not (tmp_path / "other.zarr").exists()
    assert execute(other, url, overwrite=True).poses == 48
    assert open_store(url).pipeline.seed == 6


ZIPPED = """[axes]
distance_m = { geom = [0.2, 1.5, 4] }
cornerRefinementMethod = ["none", "subpix"]
how = { zip = { solver = ["iterative", "ippe_square"], guarded = [true, false] } }
trial = 3
[axes.view.zip]
dictionary = ["DICT_5X5_50", "DICT_6X6_50", "DICT_4X4_50"]
tilt_deg = [50, 0, 0]
"""

GROWN = {
    "front": (TEXT, ["distance_m={values = [0.1, 0.2, 1.5]}"], 96),
    "trial": (TEXT, ["trial=5"], 192),
    "solver": (TEXT, ['solver=["p3p", "iterative", "ippe_square"]'], 192),
    "fixed": (TEXT, ["solver=iterative", "dictionary=DICT_5X5_50"], 48),
    "new axis": (TEXT, ["background=[128, 60]"], 192),
    "zipped": (TEXT.partition("[axes]")[0] + ZIPPED, [], 48),
}
"""Text of a pipeline, settings, and how many estimates it shares with the undisturbed store."""


@pytest.mark.parametrize(("text", "settings", "shared"), GROWN.values(), ids=GROWN)
def test_grown_grid_reuses_what_there_is_bit_for_bit(
    text, settings, shared, pipeline, undisturbed, tmp_path
):
    grown = Pipeline.from_text(text, settings, name="grown")
    fresh, reusing, back = (str(tmp_path / f"{name}.zarr") for name in ("fresh", "reusing", "back"))
    extents = tuple(min(len(axis), 1 if axis.name == "background" else 3)
                    for axis in grown.experiment.scene_axes)
    by_hand(fresh, grown, extents)
    store = create_store(reusing, grown, extents)
    computed = sum(compute_block(reusing, store.run_id, block, (undisturbed,)).computed["estimates"]
                   for block in store.blocks)
    assert same(fresh, reusing)
    total = int(np.prod([len(axis) for axis in grown.axes]))
    assert computed == total - shared
    store = create_store(back, pipeline, (2, 4, 2, 3))
    receipt = compute_block(back, store.run_id, store.blocks[0], (fresh,))
    assert receipt.computed["estimates"] == 192 - shared
    assert same(back, undisturbed)


def test_places_that_hold_something_else_are_left_unharmed(pipeline, tmp_path):
    file = tmp_path / "file.zarr"
    file.write_text("mine")
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "letter.txt").write_text("mine")
    foreign = tmp_path / "foreign.zarr"
    zarr.open_group(str(foreign), mode="w").create_array("x", shape=(2,), dtype="f8")
    for place in (file, folder, foreign):
        for overwrite in (False, True):
            with pytest.raises(StoreError, match="not a sweep store"):
                execute(pipeline, place, overwrite=overwrite)
    assert file.read_text() == (folder / "letter.txt").read_text() == "mine"
    assert "x" in zarr.open_group(str(foreign), mode="r")


LONG = "[axes]\ntrial = 1500\ndistance_m = [0.05, 0.08]\n[pose]\njitter_px = 0.5\n"


@pytest.mark.system
def test_interrupted_run_says_how_to_go_on_and_goes_on(tmp_path):
    (tmp_path / "long.toml").write_text(LONG)
    with started(
        ["-m", "sweep", "run", "long.toml"], cwd=tmp_path, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True,
    ) as running:
        deadline = time.monotonic() + 120
        while not any(tmp_path.glob("runs/long.zarr/commits/receipt/c.*")):
            assert time.monotonic() < deadline
            assert running.poll() is None
            time.sleep(0.05)
        # As a terminal does it: to every process of the group.
        os.killpg(running.pid, signal.SIGINT)
        out, err = running.communicate(timeout=60)
    assert running.returncode == 130, err
    assert out == ""
    assert err.splitlines()[-1] == "stopped; the same command continues"
    state = status(str(tmp_path / "runs" / "long.zarr"))
    assert not state.being_written
    assert 0 < state.blocks_done < state.blocks


def test_another_build_of_the_same_version_is_refused_by_run_reuse_and_workers(
    pipeline, undisturbed, monkeypatch
):
    there = builds()
    assert set(there) == {"opencv", "numpy", "numba", "llvmlite"}
    assert there["opencv"].startswith(f"{cv2.__version__} ")
    here = f"{cv2.__version__} 000000000000"
    monkeypatch.setattr(provenance, "builds", lambda: {**there, "opencv": here})
    store = open_store(undisturbed)
    _opened.cache_clear()
    line = f"builds.opencv: the store has .?{there['opencv']}.?, this run .?{here}"
    for refused in (lambda: execute(pipeline, undisturbed), lambda: match(pipeline, store)):
        with pytest.raises(StoreError, match=line):
            refused()
    with pytest.raises(MachineFaultError, match=f"on a worker builds.opencv is {here}") as raised:
        compute_block(undisturbed, store.run_id, store.blocks[0])
    assert len(str(raised.value).splitlines()) == 1


def test_nothing_is_overwritten_by_a_run_that_cannot_be(pipeline, tmp_path):
    url = str(tmp_path / "kept.zarr")
    by_hand(url, pipeline, (2, 4, 2, 3))
    for options, error in (
        ({"reuse": [url]}, ArgumentError), ({"reuse": 3}, ArgumentError),
        ({"reuse": [str(tmp_path / "none.zarr")]}, StoreError),
        ({"scheduler": "nowhere"}, ArgumentError), ({"client": "nowhere"}, ArgumentError),
    ):
        with pytest.raises(error):
            execute(pipeline, url, overwrite=True, **options)
        assert len(committed(open_store(url))) == 1


def test_task_of_a_replaced_store_writes_nothing(pipeline, tmp_path):
    url = str(tmp_path / "replaced.zarr")
    old = by_hand(url, pipeline, (2, 4, 2, 3))
    remove_store(url)
    new = create_store(url, Pipeline.from_text(TEXT, ["seed=8"], name="other"), (2, 4, 2, 3))
    with pytest.raises(StoreError, match="replaced by another run"):
        compute_block(url, old.run_id, old.blocks[0])
    assert committed(new) == set()


def test_an_image_that_was_changed_during_the_run_is_a_fault_of_the_machine(tmp_path):
    image = tmp_path / "grey.png"
    cv2.imwrite(str(image), np.full((480, 640), 90, np.uint8))
    pipeline = Pipeline.from_text(
        '[pose]\ndistance_m = 0.05\n[axes]\nbackground = [90, "grey.png"]', folder=tmp_path)
    store = create_store(str(tmp_path / "mixed.zarr"), pipeline, (2,))
    assert sweep.open(store.url).background.to_numpy().tolist() == ["90.0", "grey.png"]
    cv2.imwrite(str(image), np.full((480, 640), 91, np.uint8))
    with pytest.raises(MachineFaultError, match=r"grey\.png is not in .* as it was when the run"):
        compute_block(store.url, store.run_id, store.blocks[0])


WITH_DRAWS = """
seed = 5
camera = { fx_px = 500 }
marker = { size_m = 0.05 }
scene = { background = 255, noise_grey = { uniform = [0, 4] } }
estimator = { believed_fx_px = { normal = [500, 5] } }
axes = { azimuth_deg = [0, 30], trial = 40 }
[pose]
side_px = { uniform = [25, 60] }
tilt_deg = { uniform = [0, 60] }
roll_deg = { normal = [0, 40] }
bearing_x_deg = { uniform = [-10, 10] }
jitter_px = 0.5
"""
DRAWN = {
    "side_px", "tilt_deg", "roll_deg", "bearing_x_deg", "noise_grey", "believed_fx_px",
    "distance_m", "jitter_u_px", "jitter_v_px",
}


def test_every_parameter_is_a_coordinate_whether_fixed_an_axis_or_drawn(tmp_path):
    url = str(tmp_path / "drawn.zarr")
    by_hand(url, Pipeline.from_text(WITH_DRAWS))
    for opened in (sweep.open(url), xr.open_zarr(url, consolidated=False)):
        assert set(opened.coords) >= DRAWN
        for name in DRAWN:
            assert opened[name].dims == ("azimuth_deg", "trial"), name
            assert opened[name].dtype == "f8"
            assert opened[name].chunks == opened["marker_area_px"].chunks
        assert opened.azimuth_deg.dims == ("azimuth_deg",)
        fixed = {"size_m": 0.05, "fx_px": 500.0, "jitter_px": 0.5, "bearing_y_deg": 0.0,
                 "marker_id": 0, "background": 255.0, "quiet_zone_modules": 1.0}
        assert {name: opened[name].item() for name in fixed} == fixed
        assert opened["dictionary"].item() == "DICT_5X5_50"
        assert opened["tilt_deg"].attrs["units"] == "degree"
        assert "distortion" not in opened.variables  # neither given, nor of marker or pose
        assert not DRAWN & set(opened.data_vars)
