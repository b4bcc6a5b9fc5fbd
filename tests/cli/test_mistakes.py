"""Ordinary mistakes of a new user: each is told in a line that says what to change, or works."""

import shlex

import pytest
from matplotlib.figure import Figure

import sweep
from support.reports import command
from support.stores import by_hand
from sweep import cli
from sweep.errors import SweepError
from sweep.execution.status import close
from sweep.experiment.pipeline import Pipeline
from sweep.store.lifecycle import open_store
from sweep.store.lock import writing

TEXT = """
pose = { jitter_px = 0.5 }
axes = { side_px = [30, 60], solver = ["ippe_square", "iterative"], trial = 2 }
"""


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mistakes")
    (folder / "small.toml").write_text(TEXT)
    (folder / "few.toml").write_text(TEXT.replace(", trial = 2", ""))
    pipeline = Pipeline.from_toml(folder / "small.toml")
    close(by_hand(str(folder / "runs/small.zarr"), pipeline))
    by_hand(str(folder / "runs/unfinished.zarr"), pipeline)
    return folder


@pytest.fixture
def folder(stores, monkeypatch):
    monkeypatch.chdir(stores)


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(("line", "hint"), [
    ("runn small.toml", "did you mean run?"),
    ("run small.toml tilt_deg=3", "did you mean --set tilt_deg=3?"),
    ("plan small.toml --worker-count 2", "did you mean --workers?"),
    ("run runs", "runs: not a sweep store, which `sweep run FILE.toml` makes; choose another path"),
    ("show small.toml -o cell.jpg", "--output cell.jpg: expected a file that ends in .png"),
    ("repro runs/small.zarr --at side_px=31", "not on the grid; its values are 30.0, 60.0"),
    ("repro small.toml", "`sweep run small.toml` makes its store"),
    ("status small", "did you mean runs/small.zarr?"),
    ("size small.toml", "expected what is chosen: [search] smallest = "),
    ("reference tilt", "did you mean tilt_deg?"),
    ("compare runs/small.zarr runs/small.zarr --repeats -1", "--repeats -1: expected none"),
    ("compare runs/small.zarr runs/small.zarr --workers 2", "--workers 2: expected none"),
    ("verify runs/small.zarr --repair --workers 9999", "expected a whole number, 1 to 1,000"),
    ("verify runs/small.zarr --workers 2", "--workers 2: expected --repair, which alone"),
    ("run few.toml --precision a=b", "--precision a=b: expected a quantity and the half-width"),
    ("report runs/small.zarr -o report.pdf", "expected a file that ends in .html or .md"),
    ("report runs/unfinished.zarr", "unfinished: 1 of 1 blocks; `sweep run` continues it"),
    ("tradeoff runs/small.zarr --criterion rotation_p95", "did you mean rotation_p95_deg?"),
    ("run small.toml --retry-failed --reuse runs/small.zarr", "expected no retry_failed"),
    ("run small.toml --set trial=5", "run PIPELINE --store NEW --reuse runs/small.zarr`"),
    ("tradeoff runs/small.zarr --seconds nan", "--seconds nan: expected a finite number ab"),
    ("run few.toml --precision 'detection_rate = 0.1'", "expected max_trials, too: the most"),
])
def test_a_mistake_is_refused_with_what_to_change(line, hint):
    code, out, err = command(*shlex.split(line))
    assert (code, out) == (2, "")
    assert hint in err
    assert "Traceback" not in err


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(("line", "following"), [
    ("run small.toml", "sweep report runs/small.zarr"),
    ("plan small.toml --set trial=1", "sweep run small.toml --set trial=1"),
    ("repro runs/small.zarr --at trial=1",
     "sweep repro runs/small.zarr --at side_px=30.0,solver=ippe_square,trial=1 -o scene.png"),
    ("status runs/unfinished.zarr", "sweep run runs/unfinished.zarr"),
    ("verify runs/small.zarr --sample 0", "sweep report runs/small.zarr"),
    ("report runs/small.zarr", "sweep tradeoff runs/small.zarr"),
    ("tradeoff runs/small.zarr --seconds 0.1", "sweep report runs/small.zarr"),
])
def test_every_command_ends_with_what_to_do_next(line, following, monkeypatch):
    if line.startswith("report"):
        monkeypatch.setattr(Figure, "savefig", lambda *_, **__: None)
    code, out, _ = command(*shlex.split(line))
    assert code == 0
    last = out.splitlines()[-1]
    assert last.partition("  #")[0] == f"next: {following}"
    assert cli.parser.build_parser()[0].parse_args(shlex.split(following)[1:]).command is not None


@pytest.mark.usefixtures("folder")
def test_a_store_that_is_being_written_is_not_said_to_need_a_run():
    url = "runs/unfinished.zarr"
    with writing(url, open_store(url, "r+").storage):
        _, out, _ = command(*shlex.split(f"verify {url} --sample 0"))
        _, _, err = command(*shlex.split(f"report {url}"))
    assert out.splitlines()[-1] == f"next: sweep status {url}"
    assert err.endswith("it is being written: wait until it is finished\n")


def test_python_is_told_that_nothing_was_detected(tmp_path, capsys):
    url = str(tmp_path / "far.zarr")
    far = {"pose": {"jitter_px": 0.5}, "axes": {"side_px": [2], "trial": 2}}
    with sweep.run(far, store=url):
        pass
    assert capsys.readouterr().err.splitlines() == [
        "warning: nothing was detected: 2 no_candidate (No candidate at the marker)",
        f"look at it: sweep repro {url} --at side_px=2.0,trial=0 -o scene.png",
    ]


def test_a_run_that_is_too_large_is_refused_in_a_line_unless_it_is_confirmed(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "small.toml").write_text(TEXT)
    monkeypatch.setattr("sweep.execution.forecast.free_bytes", lambda _url: 100)
    code, out, err = command(*shlex.split("run small.toml"))
    assert (code, out) == (2, "")
    assert ("before compression, and 100 bytes are free; make it smaller, or confirm it with "
            "`--yes`") in err.splitlines()[-1]
    assert not (tmp_path / "runs/small.zarr").exists()
    with pytest.raises(SweepError, match="yes=True"):
        sweep.run("small.toml")
    assert command(*shlex.split("run small.toml --yes"))[0] == 0
