"""Relative paths mean the folder of the process that was given them, wherever they are read."""

import logging
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from distributed import Client, LocalCluster

import sweep
from support.stores import by_hand
from sweep.execution.status import close
from sweep.experiment.pipeline import Pipeline
from sweep.store.lifecycle import create_store, open_store

PLUGINS = Path(__file__).parents[2] / "pipelines/plugins"

TEXT = """
seed = 3
[pose]
jitter_px = 0.5
[axes]
side_px = [30, 60]
trial = 4
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def elsewhere(here):
    """A Dask client whose worker has another working folder."""
    other = here / "elsewhere"
    other.mkdir()
    with LocalCluster(
        n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0",
        silence_logs=logging.CRITICAL,
    ) as cluster, Client(cluster) as client:
        client.run(os.chdir, str(other))
        yield client


@pytest.mark.parametrize("state", ["finished", "unfinished"])
def test_an_opened_store_is_read_from_another_folder(state, here, monkeypatch):
    store = by_hand("rel.zarr", Pipeline.from_text(TEXT, name="rel"), (1, 4))
    if state == "finished":
        close(store)
    results = sweep.open("rel.zarr")
    (here / "other").mkdir()
    monkeypatch.chdir(here / "other")
    assert (results.detection == 1).all()
    assert np.isfinite(results.rotation_error_deg).all()
    # So is a store that was opened to be written.
    monkeypatch.chdir(here)
    opened = open_store("rel.zarr", "r+")
    monkeypatch.chdir(here / "other")
    assert (opened.array("detection")[...] == 1).all()


def test_a_new_store_is_written_where_its_path_led_at_first(here, monkeypatch):
    store = create_store("new.zarr", Pipeline.from_text(TEXT), (2, 4))
    (here / "other").mkdir()
    monkeypatch.chdir(here / "other")
    assert store.array("detection")[...].sum() == 0
    assert (here / "new.zarr/zarr.json").exists()


@pytest.mark.evidence
def test_workers_in_another_folder_read_and_write_the_same_store(here, elsewhere):
    (here / "first.toml").write_text(TEXT)
    first = sweep.run("first.toml", store="runs/first.zarr", client=elsewhere)
    assert (first.detection.compute() == 1).all()
    assert (sweep.open("runs/first.zarr").detection.compute() == 1).all()
    grown = Pipeline.from_text(TEXT.replace("trial = 4", "trial = 6"), name="grown")
    results = sweep.run(
        grown, store="grown.zarr", reuse=["runs/first.zarr"], client=elsewhere)
    assert (results.detection.compute() == 1).all()
    assert not list(Path("elsewhere").iterdir())


@pytest.mark.evidence
def test_files_of_a_pipeline_are_found_from_another_folder(elsewhere):
    Path("files").mkdir()
    cv2.imwrite("files/grey.png", np.full((480, 640), 128, dtype=np.uint8))
    shutil.copy(PLUGINS / "homography.py", "files")
    document = {
        "pose": {"jitter_px": 0.5, "side_px": 40}, "scene": {"background": "files/grey.png"},
        "axes": {"trial": 3, "solver": ["ippe_square", "files/homography.py:SOLVER"]},
    }
    results = sweep.run(document, store="files.zarr", client=elsewhere)
    assert (results.estimate.compute() == 1).all()
