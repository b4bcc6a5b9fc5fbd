"""Repro: one scene of a store again, and whether it gives what the store holds; failures kept."""

import json
import re
import shlex
import shutil
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
import xarray as xr
import zarr

from support.commands import command
from support.poison import Poison, poisoned
from sweep.cli import main
from sweep.evaluation.results import Failure
from sweep.execution.block_task import compute_block
from sweep.execution.status import close
from sweep.plan.pipeline import Pipeline
from sweep.store.blocks import begin_block
from sweep.store.lifecycle import create_store, open_store
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

POISONS = [
    Poison(4, "scene", "raise"),
    Poison(7, "detection", "raise", (("cornerRefinementMethod", "subpix"),)),
    Poison(8, "estimation", "abort", (), (("solver", "iterative"),)),
]

FAR = "distance_m=0.4,distortion=[],solver=iterative,trial=2"
"""The scene 8, which ends its process."""

NEAR = "distance_m=0.2,distortion=[],cornerRefinementMethod=subpix,solver=iterative,trial=1"
"""The scene 1, in which the marker is found."""


@contextmanager
def poison(folder):
    """Have children of this process poisoned."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in poisoned(POISONS, folder / "notes.jsonl").items():
            patch.setenv(name, value)
        yield


@pytest.fixture(scope="module")
def pipeline():
    return Pipeline.from_text(TEXT, name="seen")


@pytest.fixture(scope="module")
def finished(pipeline, tmp_path_factory):
    """A store of which three scenes failed or crashed."""
    folder = tmp_path_factory.mktemp("seen")
    url = str(folder / "seen.zarr")
    store = create_store(url, pipeline, EXTENTS)
    for number, block in enumerate(store.blocks):
        if number in (1, 2):
            # What was begun before is computed in a child, which is poisoned.
            begin_block(store, block)
        with poison(folder):
            compute_block(url, store.run_id, block)
    close(store)
    return Path(url)


@pytest.fixture
def copied(finished, tmp_path):
    return Path(shutil.copytree(finished, tmp_path / "copied.zarr"))


def see_refused(arguments, capsys):
    """Assert that a command is refused in a line; return it."""
    assert main(["repro", *map(str, arguments)]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.count("\n") == 1
    return told.err


@pytest.mark.long
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
        )
        wanted = {
            name: float(cell[name]) for name in
            ("rotation_error_deg", "reprojection_error_px", "marker_area_px")
        }
        depth = float(cell["true_tvec_m"].sel(xyz="z"))
    for name, value in wanted.items():
        line = next(line for line in told.splitlines() if line.split()[:1] == [name])
        assert float(line.split()[1]) == pytest.approx(value, rel=1e-5), line
    line = next(line for line in told.splitlines() if line.split()[:1] == ["true_tvec_m"])
    assert float(line.split()[3]) == pytest.approx(depth, rel=1e-5)
    assert re.search(r"^ +detection +detected$", told, re.MULTILINE)
    shown = tmp_path / "shown.png"
    assert main(["show", str(pipeline), "--at", NEAR, "-o", str(shown), "--plain"]) == 0
    image = cv2.imread(str(out), cv2.IMREAD_UNCHANGED)
    assert image.ndim == 2
    assert image.std() > 10
    np.testing.assert_array_equal(image, cv2.imread(str(shown), cv2.IMREAD_UNCHANGED))


@pytest.mark.long
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


@pytest.mark.long
def test_what_cannot_be_asked_for_is_told_in_a_line(finished, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    told = see_refused([finished, "--at", "distance_m=0.3"], capsys)
    assert "distance_m" in told
    assert "0.2" in told
    assert "tilt_deg" in see_refused([finished, "--at", "tilt_deg=10"], capsys)
    assert "trial" in see_refused([finished, "--at", "trial=3"], capsys)
    assert "solver" in see_refused([finished, "--at", "solver=p3p"], capsys)
    assert "distanc_m" in see_refused([finished, "--at", "distanc_m=0.2"], capsys)
    see_refused([finished, "--at", "distance_m"], capsys)
    see_refused([finished, "--at", NEAR, "--time-limit", "0"], capsys)
    see_refused([finished, "--at", NEAR, "--time-limit", "nan"], capsys)
    assert "none.zarr" in see_refused([tmp_path / "none.zarr"], capsys)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
def test_block_that_is_not_there_yet_is_said(pipeline, tmp_path, capsys):
    url = str(tmp_path / "begun.zarr")
    store = create_store(url, pipeline, EXTENTS)
    compute_block(url, store.run_id, store.blocks[0])
    out = tmp_path / "scene.png"
    assert main(["repro", url, "--at", "distance_m=0.4", "-o", str(out)]) == 0
    told = capsys.readouterr().out
    assert "does not hold this cell yet" in told
    assert "agrees with" not in told
    assert out.exists()


def commands_of(url, capsys):
    """Return what ``sweep status`` prints to be handed on: (kind, --at, reason) a line."""
    assert main(["status", str(url)]) == 0
    told = capsys.readouterr().out
    return re.findall(r"^ +(failed|crashed) +--at (.+?)  (\w+: .*)$", told, re.MULTILINE)


@pytest.mark.long
def test_every_failure_that_status_lists_is_seen_again_as_printed(finished, tmp_path, capsys):
    listed = commands_of(finished, capsys)
    assert sorted(kind for kind, _, _ in listed) == ["crashed"] * 2 + ["failed"] * 2
    env = poisoned(POISONS, tmp_path / "notes.jsonl")
    for number, (kind, at, reason) in enumerate(listed):
        if number and listed[number - 1][0] == kind:
            continue  # one of each kind; the others in the long test
        out = tmp_path / f"{number}.png"
        # As a shell splits what is pasted into it.
        words = shlex.split(f"repro {finished} --at {at} -o {out}")
        ran = command(*words, env=env, timeout=60)
        assert (ran.returncode, ran.stderr) == (0, "")
        assert "agrees with the store bit for bit" in ran.stdout
        assert reason.split(": ", 1)[1] in ran.stdout
        assert re.search(rf"^ +(detection|estimate) +{kind}$", ran.stdout, re.MULTILINE)


@pytest.mark.long
def test_scene_that_crashed_and_no_longer_does_differs(finished, tmp_path, capsys):
    out = tmp_path / "scene.png"
    assert main(["repro", str(finished), "--at", FAR, "-o", str(out)]) == 1
    told = capsys.readouterr().out
    assert re.search(r"^differs from the store: estimate", told, re.MULTILINE)
    assert re.search(r"^ +estimate +solved.*\(stored: crashed\)$", told, re.MULTILINE)


@pytest.mark.long
def test_table_of_failures_tells_where_what_and_why(finished):
    with xr.open_zarr(finished, group="failures") as table:
        rows = {
            str(at): (str(kind), str(stage), str(text)) for at, kind, stage, text in zip(
                *(table[name].to_numpy() for name in ("at", "kind", "stage", "text")),
                strict=True,
            )
        }
        attributes = dict(table.attrs)
    by_scene = {}
    for at, row in rows.items():
        named = dict(re.findall(r"(\w+)=(\[[^\]]*\]|[^,]+)", at))
        scene = 6 * (named["distance_m"] == "0.4") + 3 * (named["distortion"] != "[]")
        by_scene.setdefault(scene + int(named["trial"]), []).append((named, *row))
    assert by_scene.keys() == {4, 7, 8}
    ((_, kind, stage, text),) = by_scene[4]
    assert (kind, stage) == ("failed", "scene")
    assert text.startswith("Traceback")
    assert text.strip().endswith("RuntimeError: poisoned")
    ((named, kind, stage, text),) = by_scene[7]
    assert (kind, stage, named["cornerRefinementMethod"]) == ("failed", "detection", "subpix")
    for named, kind, stage, text in by_scene[8]:
        assert (kind, stage, named["solver"]) == ("crashed", "estimation", "iterative")
        assert "SIGABRT" in text
    # Cells by their flags, counted here: a scene that is not drawn fails under both settings.
    with xr.open_zarr(finished) as store:
        meanings = {
            name: dict(zip(store[name].attrs["flag_meanings"].split(),
                           store[name].attrs["flag_values"], strict=True))
            for name in ("detection", "estimate")
        }
        for kind in ("failed", "crashed"):
            count = sum(int((store[name] == meanings[name][kind]).sum()) for name in meanings)
            assert attributes[f"{kind}_cells"] == count == {"failed": 3, "crashed": 2}[kind]


@pytest.mark.long
def test_table_of_failures_is_bounded_and_all_are_counted(copied, monkeypatch):
    # Twenty rows in each receipt, of both kinds; the bound is made small.
    monkeypatch.setattr("sweep.execution.status.MAX_ROWS", 25)
    row = {"scene": 1, "stage": "scene", "setting": None, "estimator": None, "text": "Error: x"}
    array = zarr.open_array(f"{copied}/commits/receipt", mode="r+")
    for number in range(4):
        content = json.loads(str(np.asarray(array[number])))
        content["failures"] = [row | {"kind": kind} for kind in ("failed", "crashed") * 10]
        array[number : number + 1] = np.array([json.dumps(content)], dtype=object)
    close(open_store(str(copied), "r+"))
    with xr.open_zarr(copied, group="failures") as table:
        kinds = table["kind"].to_numpy().tolist()
        counts = {kind: table.attrs[f"{kind}_cells"] for kind in ("failed", "crashed")}
    assert (kinds.count("failed"), kinds.count("crashed")) == (25, 25)
    assert counts == {"failed": 3, "crashed": 2}  # of the flags, not of the rows


def test_receipts_keep_a_bounded_number_of_rows_and_the_end_of_a_long_traceback():
    text = "first" + "x" * 10 * MAX_CHARACTERS + "last"
    failures = [Failure(k, "scene", text, crashed=bool(k % 2)) for k in range(1000)]
    rows = list(range(5000, 6000))
    kept = recorded(failures, rows, {"failed": 1000, "crashed": 7})
    assert len([one for one in kept if one.kind == "crashed"]) == 7
    failed = [one for one in kept if one.kind == "failed"]
    assert 0 < len(failed) <= 100
    assert [one.scene for one in failed] == list(range(5000, 5000 + 2 * len(failed), 2))
    assert all(one.text.endswith("last") and len(one.text) <= 4000 for one in kept)
    assert recorded(failures, rows, {"failed": 0, "crashed": 0}) == ()
