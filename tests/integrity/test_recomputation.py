"""Scenes computed again: repro, tolerances, and plug-ins whose answers change."""

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import xarray as xr
import zarr
from scipy.spatial.transform import Rotation

from support.here import Here
from support.stores import by_hand
from sweep import cli
from sweep.cli import main
from sweep.evaluation.results import Failure, compare
from sweep.execution.runner import execute
from sweep.execution.status import close
from sweep.experiment.grid import Block
from sweep.experiment.pipeline import Pipeline
from sweep.integrity.verification import repair, verify
from sweep.store.blocks import MAX_CHARACTERS, MAX_PER_BLOCK, recorded

TEXT = """
title = "Scenes to be seen again"
seed = 11
marker = { size_m = 0.04 }
pose = { jitter_px = 0.5 }
scene = { background = 128 }
[axes]
distance_m = [0.2, 0.4]
cornerRefinementMethod = ["none", "subpix"]
distortion = [[], [0.1, 0, 0, 0]]
solver = ["ippe_square", "iterative"]
trial = 3
"""

EXTENTS = (1, 1, 3)  # block k has the scenes 3 k to 3 k + 2

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
    failures = [Failure(5000 + k, "scene", text, crashed=bool(k % 2)) for k in range(1000)]
    pipeline = Pipeline.from_text("[pose]\nside_px = 40\njitter_px = 1\n[axes]\ntrial = 6000")
    block = Block((0,), (6000,))
    kept = recorded(pipeline, block, failures)
    for first, kind in enumerate(("failed", "crashed")):
        assert [one["at"] for one in kept if one["kind"] == kind] == [
            f"trial={5000 + first + 2 * k}" for k in range(MAX_PER_BLOCK)]
    assert all(one["text"].endswith("last") and len(one["text"]) <= 4000 for one in kept)


TURN = Rotation.from_rotvec([0.3, -0.2, 0.1])


def scene():
    """Return the values of one scene under two estimators."""
    return {
        "true_rvec": np.array([3.0, 0.1, 0.2]),
        "true_tvec_m": np.array([0.0, 0.3, 0.4]),
        "marker_area_px": np.array(900.0),
        "bound": np.array(1, dtype="u1"),
        "bound_std": np.full(6, 1e-3, dtype="f4"),
        "mirror_distance": np.array(np.nan, dtype="f4"),
        "detection": np.array(1, dtype="u1"),
        "corner_error_px": np.full((4, 2), 0.1, dtype="f4"),
        "estimate": np.array([1, 3], dtype="u1"),
        "translation_error_m": np.array([[1e-3, 0, 2e-3], [np.nan] * 3], dtype="f4"),
        "rotation_error_rad": np.array([TURN.as_rotvec(), [np.nan] * 3], dtype="f4"),
        "rotation_error_deg": np.array([21.4, np.nan], dtype="f4"),
        "reprojection_error_px": np.array([0.2, np.nan], dtype="f4"),
        "nees": np.array([5.0, np.nan], dtype="f4"),
    }


def found(name, change, *, same_processor=False):
    """Return what differs where a variable is changed, to an array or by a number."""
    values = scene()
    changed = change(values[name]) if callable(change) else values[name] + change
    values[name] = changed.astype(values[name].dtype)
    return compare(values, scene(), same_processor=same_processor)


def turned(angle_rad):
    """Return the change by which the first estimate is turned further."""
    def change(vectors):
        further = TURN * Rotation.from_rotvec([0, angle_rad, 0])
        return np.array([further.as_rotvec(), vectors[1]])

    return change


@pytest.mark.parametrize("name", scene())
def test_every_bit_counts_on_the_same_processor(name):
    values, stored = scene(), scene()
    assert compare(values, stored, same_processor=True) == ""
    flat = values[name].reshape(-1)
    flat[0] = np.nextafter(flat[0], 9, dtype=flat.dtype) if flat.dtype.kind == "f" else 7
    if np.isnan(flat[0]):
        flat[0] = 0
    assert compare(values, stored, same_processor=True).startswith(f"{name} ")


@pytest.mark.parametrize(
    ("name", "within", "beyond"),
    [
        ("corner_error_px", 0.009, 0.011), ("reprojection_error_px", -0.009, 0.011),
        # 1e-4 rad in degrees.
        ("rotation_error_deg", 0.0055, -0.006),
        # 1e-4 of 0.5 m, as the length of the difference.
        ("translation_error_m", [2.5e-5, 3e-5, 2.5e-5], [3.5e-5, 3.5e-5, 3.5e-5]),
        ("rotation_error_rad", turned(0.9e-4), turned(1.1e-4)),
        ("detection", 0, 1), ("estimate", 0, [0, 1]),
        # Of the truth each component, relative to the vector's length.
        ("true_rvec", 2.9e-12, 3.3e-12), ("true_tvec_m", 0.4e-12, 0.6e-12),
        ("marker_area_px", 8e-10, 10e-10), ("bound_std", 0.9e-9, 1.5e-9), ("bound", 0, 1),
        # Without a tolerance: compared on the same processor alone.
        ("nees", 1.0, None),
        # What one of the two alone has is a difference.
        ("mirror_distance", 0, np.ones_like), ("reprojection_error_px", 0, np.ones_like),
    ],
)
def test_scenes_of_another_processor_lie_within_their_tolerance(name, within, beyond):
    assert found(name, within) == ""
    if beyond is None:
        assert found(name, within, same_processor=True).startswith(f"{name} ")
    else:
        assert found(name, beyond).startswith(f"{name} ")


PLUGIN = """
import itertools
import cv2
import numpy as np

COUNT = itertools.cycle(range(101))  # small, however many calls the forecast makes
SQUARE = 0.005 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])


def counting(settings):
    def solve(detections):
        rotations, translations = [], []
        for row, corners in enumerate(detections.corners):
            _, rvec, tvec = cv2.solvePnP(SQUARE, corners, detections.cameras.matrix(row), None,
                                         flags=cv2.SOLVEPNP_IPPE_SQUARE)
            rotations.append(cv2.Rodrigues(rvec)[0])
            translations.append(tvec.ravel() + 1e-6 * next(COUNT))
        return np.array(rotations), np.array(translations)
    return solve
"""

CHANGING = """
pose = { side_px = { uniform = [40, 60] }, tilt_deg = 30, azimuth_deg = 40 }
axes = { solver = ["mine:counting", "ippe_square"], trial = 6 }
"""


def test_what_changes_from_call_to_call_is_named_and_no_block_is_damaged(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr("sweep.isolation.crash_isolation.Child", Here)
    (tmp_path / "mine.py").write_text(PLUGIN)
    store = str(tmp_path / "grid.zarr")
    execute(Pipeline.from_text(CHANGING, folder=tmp_path), store, workers=None)
    for report in (repair(store), verify(store)):  # they do not alternate
        assert (report.unstable, report.damage, report.repaired) == ("mine:counting", [], [])
    assert cli.main(["verify", store]) == 1
    out = capsys.readouterr().out
    assert "not deterministic: mine:counting" in out
    assert "damaged" not in out
