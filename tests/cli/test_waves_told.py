"""Runs in waves as the command line tells them: progress, refusals, advice that can be followed."""

import json
import shlex

import pytest

from support.here import calls_here
from sweep.cli import main

FILE = """
pose.jitter_px = 0.5
[axes]
side_px = [4, 8, 40]
tilt_deg = [0, 40]
"""
SEARCH = ["--require", "detection >= 0.9", "--along", "side_px", "--coarse-trials", "10"]


@pytest.fixture(autouse=True)
def marker(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "folder" / "marker.toml"
    path.parent.mkdir()
    path.write_text(FILE)


def told(capsys, *words):
    with calls_here():
        try:
            status = main([*words])
        except SystemExit as ended:
            status = ended.code
    printed = capsys.readouterr()
    return status, printed.out, printed.err


@pytest.mark.long
def test_a_search_says_what_it_knows_once_and_names_the_command_that_goes_on(capsys):
    search = ["limit", "folder/marker.toml", *SEARCH]
    status, out, err = told(capsys, *search, "--max-trials", "12")
    assert status == 3
    assert "2 limits of 2 are not decided to one value of the grid" in out
    assert "conditions" not in err  # the answer says it, of the limits themselves
    _, out, _ = told(capsys, "status", "runs/marker-limit-side_px.zarr")
    assert ", of 72 with all trials" in out
    # Into the store of another search: the command that is printed can be followed.
    status, _, err = told(capsys, *search, "--max-trials=20", "--store",
                          "runs/marker-limit-side_px.zarr")
    assert status == 2
    line = err.splitlines()[0]
    assert line.startswith("runs/marker-limit-side_px.zarr: holds another experiment; reuse")
    words = shlex.split(line.partition("in a new store: ")[2])
    assert words[-4:] == ["--store", "runs/marker-limit-side_px-2.zarr",
                          "--reuse", "runs/marker-limit-side_px.zarr"]
    status, out, _ = told(capsys, *words[1:], "--json")
    assert status == 3
    assert json.loads(out)["store"].endswith("-2.zarr")


def test_a_choice_into_another_store_is_told_the_command_that_reuses_it(capsys):
    size = ["size", "folder/marker.toml", "--set", 'require.all=["detection >= 0.5"]',
            "--set", 'choose.smallest="side_px"']
    assert told(capsys, *size, "--set", "choose.max_trials=60")[0] == 0
    status, _, err = told(capsys, *size, "--set", "choose.max_trials=70")
    assert status == 2
    assert "in a new store: sweep size folder/marker.toml" in err
    assert "--store runs/marker-2.zarr --reuse runs/marker.zarr" in err


@pytest.mark.parametrize(("words", "line"), [
    (["run", "--precision", "detection_rate = 0.1"],
     "--max-trials: expected max_trials, too: the most trials of a condition, such as 2400"),
    (["run", "--precision", "detection_rate = 0.1", "--max-trials", "1"],
     "folder/marker.toml: precision.max_trials = 1: expected at least 2"),
    (["run", "--precision", "detection_rate = 0.1", "--max-trials", "10"],
     "folder/marker.toml: precision.max_trials = 10: expected at least 19: with fewer no interval"),
    (["run", "--precision", "detektion = 0.1", "--max-trials", "90"],
     "folder/marker.toml: precision.detektion: nothing of this name"),
    (["limit", "--require", "detektion >= 0.1", "--along", "side_px"],
     'folder/marker.toml: limit.require = "detektion >= 0.1": '),
    (["size"], "folder/marker.toml: expected what is chosen: [choose]"),
])
def test_a_fault_is_one_line_that_begins_with_the_file_or_the_flag(words, line, capsys):
    status, _, err = told(capsys, words[0], "folder/marker.toml", *words[1:])
    assert status == 2
    assert line in err.splitlines()[-1]
