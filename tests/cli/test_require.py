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


def test_json_is_one_object(require):
    code, out, err = require("two.zarr", "rotation_p95_deg <= 3", "--json")
    found = json.loads(out)
    assert (code, err) == (1, "")
    assert found["decision"] == "not_met"
    worst = found["requirements"][0]
    assert (worst["value"], worst["value_flag"]) == (None, "infinite")
    assert worst["condition"] == {"side_px": 11.0}
    told = json.loads(require("two.zarr", "rotation_p95_deg <= 0.001", "--per", "side_px",
                              "--at", "solver=iterative", "--json")[1])["requirements"]
    assert [len(each["failing"]) for each in told] == [2]
    assert told[0]["failing"][0]["condition"] == {"side_px": 11.0}
    assert {row["decision"] for row in told[0]["failing"]} == {"not_met"}


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


@pytest.mark.parametrize(("arguments", "line"), [
    (["begun.zarr"], "begun.zarr: unfinished: 0 of "),
    (["none.zarr"], "none.zarr: "),
    (["two.zarr", "detection"], "REQUIREMENT detection: expected NAME >= NUMBER"),
    (["two.zarr", "detection >= 99 %"], "write 0.99"),
    (["two.zarr", "nees <= 7"], "nees_mean: no pose of this store has such a number"),
    (["drawn.zarr", "detection >= 0.5", "--per", "distance_m"], "is drawn in this store"),
    (["two.zarr", "--per", "trial"], "intervals are over the draws"),
    (["two.zarr", "--at", "side=40"], "--at side=40: unknown parameter; did you mean side_px?"),
    (["two.zarr", "--at", "side_px=41"], "no such value; there are 11.0, 40.0"),
    (["once.zarr", "detection >= 0.5"], "a single draw of each pose"),
    (["once.zarr"], "has no section [require]"),
    (["two.zarr", "--against", "once.zarr"], "not the same scenes"),
])
def test_a_mistake_is_told_in_a_line(arguments, line, require):
    code, out, err = require(*arguments)
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert line in err
