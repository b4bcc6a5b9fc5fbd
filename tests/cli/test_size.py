"""`sweep size` ends in an answer, as text, JSON or Markdown, or in a line that says what to do."""

import json

import pytest

from sweep.cli import main

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


def told(arguments, capsys):
    status = main(["size", *map(str, arguments)])
    printed = capsys.readouterr()
    return status, printed.out, printed.err


def written(tmp_path, choose='smallest = "side_px"', more="", trials=100):
    path = tmp_path / "marker.toml"
    path.write_text(FILE.format(choose=choose, more=more, trials=trials))
    return path


@pytest.fixture
def found(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    written(tmp_path)
    return told(["marker.toml", "--seconds", "0.2", "--json"], capsys)


def test_the_answer_is_the_smallest_side_and_names_what_the_next_fails_by(found, capsys):
    status, out, _ = found
    answer = json.loads(out)
    assert (status, answer["decision"], answer["answer"]["side_px"]) == (0, "met", 30.0)
    assert answer["alternatives"][0]["next"] == 4.0
    assert answer["alternatives"][0]["next_cause"]["value"] == 0.0
    assert answer["poses"] <= answer["grid_poses"] <= 600
    status, out, _ = told(["runs/marker.zarr", "--seconds", "0.2", "--markdown"], capsys)
    assert status == 0
    assert out.startswith("side\\_px=30, solver=")
    assert "| solver | side\\_px | next | ms a frame | why not better |" in out
    status, out, _ = told(["marker.toml", "--seconds", "0.2"], capsys)
    assert "detection_rate >= 0.5 is not met: 0 (" in out
    assert out.splitlines()[-1].startswith("next: sweep report runs/marker.zarr")


def test_no_choice_at_all_names_the_nearest(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    path = written(tmp_path, more=', "rotation_p95_deg <= 1e-6"')
    status, out, _ = told([path, "--seconds", "0.2"], capsys)
    assert status == 1
    assert "nearest is side_px=60" in out
    assert "rotation_p95_deg <= 1e-06 is not met" in out


def test_a_pipeline_without_a_choice_is_told_what_to_write(tmp_path, capsys):
    path = tmp_path / "plain.toml"
    path.write_text("[pose]\njitter_px = 0.5\n[axes]\nside_px = [20, 40]\ntrial = 5\n")
    status, _, err = told([path], capsys)
    assert (status, err.count("\n")) == (2, 1)
    assert 'expected what is chosen: [search] smallest = "size_m", max_trials = 5000' in err


@pytest.mark.parametrize(("choose", "more", "line"), [
    ('smallest = "solver"', "", "search.smallest"),
    ('smallest = "side_px"', ', "budget_ms >= 2"', "expected milliseconds of a frame"),
    ('smallest = "side_px"', ', "detection <= 0.2"', "no result can be both"),
    ('smallest = "side_px"', ', "solved >= 0.999"', "search.max_trials = 100: expected at least"),
    ("", "", "expected one of along, smallest"),
])
def test_what_cannot_be_searched_is_a_line_before_anything_runs(
    choose, more, line, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    status, _, err = told([written(tmp_path, choose, more)], capsys)
    assert status == 2
    assert line in err
    assert "Traceback" not in err
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("command", ["size", "limit"])
def test_a_file_that_cannot_be_read_is_told_before_more_is_asked_for(
    command, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert main([command, "missing.toml"]) == 2
    line, = capsys.readouterr().err.splitlines()
    assert line.startswith("missing.toml: cannot be read: No such file")
