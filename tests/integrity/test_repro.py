"""Repro: one scene of a store again, and whether it gives what the store holds; failures kept."""

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import xarray as xr
import zarr

from support.stores import by_hand
from sweep.cli import main
from sweep.evaluation.results import Failure
from sweep.execution.status import close
from sweep.experiment.grid import Block
from sweep.experiment.pipeline import Pipeline
from sweep.store.outcome import MAX_CHARACTERS, recorded

TEXT = """
title = "Scenes to be seen again"
seed = 11
[marker]
size_m = 0.04
[pose]
jitter_px = 0.5
[scene]
background = 128
[axes]
distance_m = [0.2, 0.4]
cornerRefinementMethod = ["none", "subpix"]
distortion = [[], [0.1, 0, 0, 0]]
solver = ["ippe_square", "iterative"]
trial = 3
"""

EXTENTS = (1, 1, 3)
"""Block k has the scenes 3 k to 3 k + 2."""

NEAR = "distance_m=0.2,distortion=[],cornerRefinementMethod=subpix,solver=iterative,trial=1"
"""The scene 1, in which the marker is found."""


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    url = str(tmp_path_factory.mktemp("seen") / "seen.zarr")
    close(by_hand(url, Pipeline.from_text(TEXT, name="seen"), EXTENTS))
    return Path(url)


@pytest.fixture
def copied(finished, tmp_path):
    return Path(shutil.copytree(finished, tmp_path / "copied.zarr"))


def test_scene_gives_what_the_store_holds_and_its_image(finished, tmp_path, capsys):
    out, pipeline = tmp_path / "scene.png", tmp_path / "seen.toml"
    pipeline.write_text(TEXT)
    assert main(["repro", str(finished), "--at", NEAR, "-o", str(out), "--plain"]) == 0
    told = capsys.readouterr().out
    assert "agrees with the store bit for bit" in told
    assert str(out) in told
    with xr.open_zarr(finished) as store:
        cell = store.isel(distance_m=0, distortion=0, trial=1).sel(
            cornerRefinementMethod="subpix", solver="iterative"
        ).load()
    lines = {line.split()[0]: line.split()[1:] for line in told.splitlines() if line.split()}
    for name in ("rotation_error_deg", "reprojection_error_px", "marker_area_px"):
        assert float(lines[name][0]) == pytest.approx(float(cell[name]), rel=1e-5), name
    depth = float(cell["true_tvec_m"].sel(xyz="z"))
    assert float(lines["true_tvec_m"][2]) == pytest.approx(depth, rel=1e-5)
    assert re.search(r"^ *detection +detected *$", told, re.MULTILINE)
    shown = tmp_path / "shown.png"
    assert main(["show", str(pipeline), "--at", NEAR, "-o", str(shown), "--plain"]) == 0
    image = cv2.imread(str(out), cv2.IMREAD_UNCHANGED)
    assert image.ndim == 2
    assert image.std() > 10
    np.testing.assert_array_equal(image, cv2.imread(str(shown), cv2.IMREAD_UNCHANGED))


def test_number_that_was_changed_is_named(copied, tmp_path, capsys):
    array = zarr.open_array(f"{copied}/normal_error_deg", mode="r+")
    assert array.shape == (2, 2, 2, 2, 3)
    array[0, 1, 0, 1, 1] = np.nextafter(array[0, 1, 0, 1, 1], np.float32(1e9))
    out = tmp_path / "drawn.png"
    assert main(["repro", str(copied), "--at", NEAR, "-o", str(out)]) == 1
    told = capsys.readouterr().out
    assert re.search(r"^differs from the store: .*normal_error_deg", told, re.MULTILINE)
    drawn = cv2.imread(str(out), cv2.IMREAD_UNCHANGED)
    assert drawn.ndim == 3  # what was found is drawn on it, in colour


def test_receipts_keep_a_bounded_number_of_rows_and_the_end_of_a_long_traceback():
    text = "first" + "x" * 10 * MAX_CHARACTERS + "last"
    failures = [Failure(k, "scene", text, crashed=bool(k % 2)) for k in range(1000)]
    rows = list(range(5000, 6000))
    pipeline = Pipeline.from_text("[pose]\nside_px = 40\njitter_px = 1\n[axes]\ntrial = 6000")
    block = Block((0,), (6000,))
    kept = recorded(pipeline, block, failures, rows, {"failed": 1000, "crashed": 7})
    assert len([one for one in kept if one.kind == "crashed"]) == 7
    failed = [one for one in kept if one.kind == "failed"]
    assert 0 < len(failed) <= 100
    assert [one.at for one in failed] == [f"trial={5000 + 2 * k}" for k in range(len(failed))]
    assert all(one.text.endswith("last") and len(one.text) <= 4000 for one in kept)
    assert recorded(pipeline, block, failures, rows, {"failed": 0, "crashed": 0}) == ()
