"""`sweep require` and `sweep size`: lines and exit statuses; bounds that no pose has."""

import functools
import json
from pathlib import Path

import pytest

import sweep
from support.reports import command
from support.stores import by_hand
from sweep import Pipeline
from sweep.evaluation.block import bound_notes
from sweep.execution.status import close
from sweep.report.report_data import read_report_data
from sweep.store.lifecycle import create_store

TEXT = """
seed = 5
pose = { jitter_px = 0.5 }
axes = { side_px = [11, 40], solver = ["ippe_square", "iterative"], trial = 60 }
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("require")
    required = TEXT + '[require]\nall = ["detection >= 0.8"]\nper = ["side_px"]\n'
    pipeline = Pipeline.from_text(required, name="two")
    create_store(str(folder / "begun.zarr"), pipeline, (2, 60))
    close(by_hand(str(folder / "two.zarr"), pipeline))
    close(by_hand(str(folder / "bare.zarr"), Pipeline.from_text(TEXT)))
    close(by_hand(str(folder / "drawn.zarr"), Pipeline.from_text(
        "[pose]\ndistance_m = { uniform = [0.1, 0.3] }\n[axes]\ntrial = 2\n")))
    close(by_hand(str(folder / "once.zarr"), Pipeline.from_text("[pose]\nside_px = 40\n")))
    (folder / "other.toml").write_text(required.replace("0.8", "0.01"))
    return folder


@pytest.fixture
def require(folder, monkeypatch):
    monkeypatch.chdir(folder)
    return functools.partial(command, "require")


def test_what_the_pipeline_requires_is_decided(require):
    code, out, err = require("two.zarr")
    assert (code, err) == (1, "")
    first, second = (line.split() for line in out.splitlines() if line.startswith("not met"))
    assert " ".join(first).startswith(
        "not met detection_rate >= 0.8 solver=ippe_square 0.167 (0.0829")
    assert " ".join(first).endswith("side_px=11 1 of 2 60")
    assert "solver=iterative" in second
    assert out.splitlines()[-1] == "next: sweep report two.zarr"


@pytest.mark.parametrize(("arguments", "status"), [
    (["detection >= 0.3"], 0), (["detection >= 0.8"], 1),
    (["detection >= 0.995", "--at", "side_px=40.00000000001"], 3),
    (["--pipeline", "other.toml", "--at", "side_px=40"], 0),
])
def test_the_status_is_that_of_the_decision(arguments, status, require):
    code, out, err = require("two.zarr", *arguments, *(
        [] if "--pipeline" in arguments else ["--per", ""]))
    assert (code, err) == (status, ""), out
    if status == 3:
        assert "draws, about" in out


def test_a_store_is_worse_than_another_and_not_than_itself(folder, require):
    noisy = Pipeline.from_text(TEXT, ["noise_grey=8", "blur_px=1.5"])
    close(by_hand(str(folder / "noisy.zarr"), noisy))
    for name, requirement, status, words in (
        ("noisy", "rotation_rmse_unflipped_deg <= 90", 1,
         "worse      mean absolute rotation error"),
        ("two", "detection >= 0.01", 0, "not worse  detection_rate"),
    ):
        code, out, _ = require(f"{name}.zarr", requirement, "--per", "", "--at", "side_px=40",
                               "--against", "two.zarr")
        assert code == status
        assert any(line.startswith(words) for line in out.splitlines()), out


@pytest.mark.usefixtures("require")
def test_the_limits_of_a_store_are_printed_and_drawn():
    asked = "--along", "side_px", "-o", "limit.svg", "--json"
    code, out, err = command("limit", "two.zarr", *asked)
    assert (code, err, Path("limit.svg").read_text()[:5]) == (0, "", "<?xml")
    assert [(each["condition"]["solver"], each["value"]) for each in json.loads(out)["limits"]] == [
        ("ippe_square", 40.0), ("iterative", 40.0)]
    found = sweep.limit("two.zarr", along="side_px")
    assert str(found) in command("limit", "two.zarr", "--along", "side_px")[1]
    assert "<table" in found._repr_html_()
    assert str(sweep.decode_flags(found)).startswith("<xarray.")


@pytest.mark.parametrize(("arguments", "line"), [
    (["begun.zarr"], "begun.zarr: unfinished: 0 of "),
    (["two.zarr", "detection"], "REQUIREMENT detection: expected NAME >= NUMBER"),
    (["two.zarr", "nees <= 7"], "nees_mean: no pose of this store has such a number"),
    (["drawn.zarr", "detection >= 0.5", "--per", "distance_m"], "is drawn in this store"),
    (["two.zarr", "--at", "side=40"], "--at side=40: unknown parameter; did you mean side_px?"),
    (["once.zarr"], "has no section [require]"),
    (["two.zarr", "--against", "once.zarr"], "not the same scenes"),
])
def test_a_mistake_is_told_in_a_line(arguments, line, require):
    code, out, err = require(*arguments)
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert line in err


FILE = """
pose.jitter_px = 0.5
[axes]
side_px = [4, 30, 60]
tilt_deg = [0, 40]
solver = ["ippe", "iterative"]
[require]
all = ["detection >= 0.5"{more}]
[search]
{choose}
max_trials = {trials}
"""


def written(tmp_path, choose='smallest = "side_px"', more="", trials=100):
    path = tmp_path / "marker.toml"
    path.write_text(FILE.format(choose=choose, more=more, trials=trials))
    return path


def test_the_answer_is_the_smallest_side_and_names_what_the_next_fails_by(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    written(tmp_path)
    status, out, _ = command("size", "marker.toml", "--seconds", "0.2", "--json")
    answer = json.loads(out)
    assert (status, answer["decision"], answer["answer"]["side_px"]) == (0, "met", 30.0)
    assert answer["alternatives"][0]["next"] == 4.0
    assert answer["alternatives"][0]["next_cause"]["value"] == 0.0
    assert answer["poses"] <= answer["grid_poses"] <= 600
    status, out, _ = command("size", "runs/marker.zarr", "--seconds", "0.2", "--markdown")
    assert status == 0
    assert out.startswith("side\\_px=30, solver=")
    assert "| solver | side\\_px | next | ms a frame |" in out
    status, out, _ = command("size", "marker.toml", "--seconds", "0.2")
    assert "detection_rate >= 0.5 is not met: 0 (" in str(sweep.size("marker.toml", limit_s=0.2))
    assert "detection_rate >= 0.5 is not met: 0 (" in out
    assert out.splitlines()[-1].startswith("next: sweep report runs/marker.zarr")


def test_no_choice_at_all_names_the_nearest(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = written(tmp_path, more=', "rotation_p95_deg <= 1e-6"')
    status, out, _ = command("size", path, "--seconds", "0.2")
    assert status == 1
    assert "nearest is side_px=60" in out
    assert "rotation_p95_deg <= 1e-06 is not met" in out


BOUND = """
scene = { noise_grey = 2, bound = "known_blur" }
pose = { jitter_px = 0.5 }
[axes]
side_px = [8, 40]
tilt_deg = [0, 89.9]
cornerRefinementMethod = ["none", "subpix"]
solver = ["ippe", "sqpnp", "iterative"]
trial = 2
"""


def test_a_bound_that_no_pose_has_is_a_line_of_every_command_and_of_the_report(tmp_path):
    bounded = str(tmp_path / "two.zarr")
    close(by_hand(bounded, Pipeline.from_text(BOUND, name="two")))
    wanted = "no pose has a bound: clipped"
    for name in ("run", "status", "plan"):
        status, out, _ = command(name, bounded)
        assert status == 0
        assert wanted in out
    assert any(wanted in line for line in read_report_data(bounded).warnings)


@pytest.mark.parametrize(("settings", "reasons"), [
    (["black=[0, 30]", "white=220", "background=200"], []), (["bound=none"], []),
    (["black=30", "white={ uniform = [254, 255] }"], ["clipped"]),
    (["vignetting=0.3"], ["not_in_model"]), (["bound=['none', 'known_blur']"], ["clipped"]),
])
def test_why_no_pose_has_a_bound_is_told(settings, reasons):
    line = "".join(bound_notes(Pipeline.from_text(BOUND, settings)))
    assert [name for name in ("no_noise", "clipped", "not_in_model") if f"{name}: " in line] == (
        reasons)
