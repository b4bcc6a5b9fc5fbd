"""``sweep require``: lines, exit statuses, Markdown and JSON, on a store of two sides."""

import json

import pytest

from support.stores import by_hand
from sweep import Pipeline, cli
from sweep.execution.status import close
from sweep.store.lifecycle import create_store

TEXT = """
seed = 5
[pose]
jitter_px = 0.5
[require]
all = ["detection >= 0.8"]
per = ["side_px"]
[axes]
side_px = [11, 40]
solver = ["ippe_square", "iterative"]
trial = 60
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("require")
    pipeline = Pipeline.from_text(TEXT, name="two")
    create_store(str(folder / "begun.zarr"), pipeline, (2, 60))
    close(by_hand(str(folder / "two.zarr"), pipeline))
    bare = TEXT.partition("[require]")[0] + "[axes]" + TEXT.partition("[axes]")[2]
    close(by_hand(str(folder / "bare.zarr"), Pipeline.from_text(bare)))
    close(by_hand(str(folder / "drawn.zarr"), Pipeline.from_text(
        "[pose]\ndistance_m = { uniform = [0.1, 0.3] }\n[axes]\ntrial = 2\n")))
    close(by_hand(str(folder / "once.zarr"), Pipeline.from_text("[pose]\nside_px = 40\n")))
    (folder / "other.toml").write_text(TEXT.replace("0.8", "0.01"))
    return folder


@pytest.fixture
def require(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)

    def run(*arguments):
        code = cli.main(["require", *arguments])
        return code, *capsys.readouterr()

    return run


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
    (["detection >= 0.55"], 3), (["detection >= 0.3"], 0), (["detection >= 0.8"], 1),
    (["detection >= 0.8", "--at", "side_px=40"], 0),
    (["detection >= 0.995", "--at", "side_px=40"], 3),
    (["detection >= 0.3", "rotation_p95_deg <= 0.0001", "--per", "side_px"], 1),
    (["--pipeline", "other.toml", "--at", "side_px=40"], 0),
])
def test_the_status_is_that_of_the_decision(arguments, status, require):
    code, out, err = require("two.zarr", *arguments, *(
        [] if "--per" in arguments or "--pipeline" in arguments else ["--per", ""]))
    assert (code, err) == (status, ""), out
    if status == 3:
        assert "draws, about" in out


def test_every_condition_that_fails_has_a_line(require):
    code, out, _ = require("two.zarr", "rotation_p95_deg <= 0.001", "--per", "side_px",
                           "--at", "solver=iterative")
    assert code == 1
    rows = out.partition("Conditions that fail")[2].splitlines()[3:5]
    assert ["side_px=11" in row for row in rows] == [True, False]
    assert "side_px=40" in rows[1]
    told = json.loads(require("two.zarr", "rotation_p95_deg <= 0.001", "--per", "side_px",
                              "--json")[1])["requirements"]
    assert [len(each["failing"]) for each in told] == [2, 2]
    assert told[0]["failing"][0]["condition"] == {"side_px": 11.0}
    assert {row["decision"] for each in told for row in each["failing"]} == {"not_met"}


def test_markdown_has_every_condition(require):
    code, out, _ = require("two.zarr", "--markdown", "--at", "solver=iterative")
    assert code == 1
    assert "| met | detection\\_rate >= 0.8 | solver=iterative | side\\_px=40 | 1.00 (0.940" in (
        out.replace("&gt;", ">"))


def test_json_is_one_object(require):
    code, out, err = require("two.zarr", "rotation_p95_deg <= 3", "--json")
    found = json.loads(out)
    assert (code, err) == (1, "")
    assert found["decision"] == "not_met"
    worst = found["requirements"][0]
    assert (worst["value"], worst["value_flag"]) == (None, "infinite")
    assert worst["condition"] == {"side_px": 11.0}


def test_a_store_is_not_worse_than_itself(require):
    code, out, _ = require("two.zarr", "--against", "two.zarr", "--pipeline", "other.toml",
                           "--at", "side_px=40")
    assert code == 0
    assert "not worse  detection_rate" in out


def test_a_worse_store_is_not_met(folder, require):
    noisy = Pipeline.from_text(TEXT, ["noise_grey=8", "blur_px=1.5"])
    close(by_hand(str(folder / "noisy.zarr"), noisy))
    code, out, _ = require("noisy.zarr", "rotation_rmse_unflipped_deg <= 90", "--per", "",
                           "--at", "side_px=40", "--against", "two.zarr")
    assert code == 1
    assert any(line.startswith("worse      mean absolute rotation error")
               for line in out.splitlines()), out


@pytest.mark.parametrize(("arguments", "line"), [
    (["begun.zarr"], "begun.zarr: unfinished: 0 of "),
    (["none.zarr"], "none.zarr: "),
    (["two.zarr", "detection"], "REQUIREMENT detection: expected NAME >= NUMBER"),
    (["two.zarr", "detection >= 99 %"], "write 0.99"),
    (["two.zarr", "nees <= 7"], "nees_mean: no pose of this store has such a number"),
    (["two.zarr", "--per", "side"], "--per side: no such dimension"),
    (["drawn.zarr", "detection >= 0.5", "--per", "distance_m"], "is drawn in this store"),
    (["two.zarr", "--per", "trial"], "intervals are over the draws"),
    (["two.zarr", "--at", "side=40"], "--at side=40: unknown parameter; did you mean side_px?"),
    (["two.zarr", "--at", "side_px=41"], "no such value; there are 11.0, 40.0"),
    (["once.zarr", "detection >= 0.5"], "a single draw of each pose"),
    (["once.zarr"], "has no section [require]"),
    (["two.zarr", "--against", "once.zarr"], "not the same scenes"),
    (["two.zarr", "--pipeline", "none.toml"], "none.toml: cannot be read"),
])
def test_a_mistake_is_told_in_a_line(arguments, line, require):
    code, out, err = require(*arguments)
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert line in err
