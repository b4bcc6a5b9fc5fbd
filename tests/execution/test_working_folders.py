"""Relative paths mean the folder of the process that was given them, wherever they are read."""

import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from distributed import Client

import sweep
from support.clusters import local_cluster
from support.stores import by_hand
from sweep.execution.status import close
from sweep.experiment.pipeline import Pipeline
from sweep.store.lifecycle import create_store, open_store

PLUGINS = Path(__file__).parents[2] / "pipelines/plugins"

PIPELINE = Pipeline.from_text(
    "seed = 3\n[pose]\njitter_px = 0.5\n[axes]\nside_px = [30, 60]\ntrial = 4\n", name="rel")


@pytest.mark.parametrize("state", ["finished", "unfinished"])
def test_a_store_is_read_and_written_where_its_path_led_at_first(state, tmp_path, monkeypatch):
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path)
    store = by_hand("rel.zarr", PIPELINE, (1, 4))
    if state == "finished":
        close(store)
    results, opened = sweep.open("rel.zarr"), open_store("rel.zarr", "r+")
    begun = create_store("new.zarr", PIPELINE, (2, 4))
    monkeypatch.chdir(tmp_path / "other")
    assert (results.detection == 1).all()
    assert (opened.array("detection")[...] == 1).all()
    assert begun.array("detection")[...].sum() == 0
    assert (tmp_path / "new.zarr/zarr.json").exists()


@pytest.mark.evidence
def test_workers_in_another_folder_read_and_write_the_same_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("files", "elsewhere"):
        Path(name).mkdir()
    cv2.imwrite("files/grey.png", np.full((480, 640), 128, dtype=np.uint8))
    shutil.copy(PLUGINS / "homography.py", "files")
    document = {
        "pose": {"jitter_px": 0.5, "side_px": 40}, "scene": {"background": "files/grey.png"},
        "axes": {"trial": 3, "solver": ["ippe_square", "files/homography.py:SOLVER"]},
    }
    grown = document | {"axes": document["axes"] | {"trial": 5}}
    with local_cluster() as cluster, Client(cluster) as client:
        client.run(os.chdir, str(tmp_path / "elsewhere"))
        for some, options in (
            (document, {"store": "runs/first.zarr"}),
            (grown, {"store": "grown.zarr", "reuse": ["runs/first.zarr"]}),
        ):
            results = sweep.run(some, client=client, **options)
            assert (results.estimate.compute() == 1).all()
            assert (sweep.open(options["store"]).detection.compute() == 1).all()
    assert not list(Path("elsewhere").iterdir())
