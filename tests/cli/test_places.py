"""Stores and outputs in places that cannot be: one line each, whatever the command."""

import os
import subprocess
import sys
from pathlib import Path
from unittest import mock

import pytest

from support.reports import command
from sweep import cli
from sweep.errors import MachineFaultError
from sweep.execution.block_task import compute_block
from sweep.experiment.grid import Block

PIPELINE = "[pose]\njitter_px = 0.5\n[axes]\nside_px = [20, 40]\n"

READERS = (["status"], ["verify"], ["repro"], ["report"], ["tradeoff", "--seconds", "1"])


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Go into a folder with a pipeline, a file, and a link that leads to itself."""
    monkeypatch.chdir(tmp_path)
    Path("small.toml").write_text(PIPELINE)
    Path("loop.zarr").symlink_to("loop.zarr")
    monkeypatch.setenv("HOME", "/home/someone")
    return tmp_path


def line_of(*arguments):
    """Return the line that a command is refused with."""
    code, out, err = command(*arguments)
    assert (code, out) == (2, ""), err
    assert len(err.splitlines()) == 1
    return err.rstrip("\n")


NOT_FOUND = "store not found; create one with `sweep run`"

PLACES = {
    "small.toml/s.zarr": NOT_FOUND,
    "/dev/null": "not a sweep store, which `sweep run FILE.toml` makes; choose another path",
    "loop.zarr": "cannot be read: Too many levels of symbolic links",
    "file:/a/b.zarr": "a store on this machine is named by its path: /a/b.zarr",
    "memory://x.zarr": "no other process sees this one's memory; choose a path or s3://",
    "~/x.zarr": "~ is not expanded here; expected /home/someone/x.zarr, or ./~/x.zarr for a "
                "folder of that name",
    "nonsense://x": "cannot be reached: Protocol not known: nonsense",
}


@pytest.mark.parametrize("place", PLACES, ids=lambda place: place[:20])
def test_a_place_without_a_store_is_told_as_what_it_is_by_every_command(place, folder):  # noqa: ARG001
    for reader in READERS:
        if not (reader[0] == "tradeoff" and place.endswith(".toml")):
            assert line_of(*reader, place).endswith(PLACES[place])
    assert line_of("run", "small.toml", "--store", "o.zarr", "--reuse", place).endswith(
        PLACES[place])


@pytest.mark.parametrize(("place", "problem"), [
    ("small.toml/s.zarr", "cannot be written: Not a directory"),
    *((place, PLACES[place]) for place in (
        "loop.zarr", "file:/a/b.zarr", "memory://x.zarr", "~/x.zarr")),
    ("http://127.0.0.1:9/x.zarr", "cannot be reached"),
    ("http://127.0.0.1:99999/x.zarr", "cannot be reached"),
    ("zip://a/x.zarr", "zip://a/x.zarr: "),
    ("small.toml", "not a sweep store, but a pipeline file"),
    ("group.zarr/deep/inner.zarr", "cannot be written: it is inside the store {}/group.zarr"),
], ids=lambda text: text[:20])
def test_a_place_that_cannot_be_written_is_refused_before_anything_starts(place, problem, folder):
    group = Path("group.zarr")
    group.mkdir()
    (group / "zarr.json").write_text("{}")
    before = sorted(path.name for path in folder.rglob("*"))
    for overwrite in ([], ["--overwrite"]):
        assert problem.format(folder) in line_of("run", "small.toml", "--store", place, *overwrite)
    assert sorted(path.name for path in folder.rglob("*")) == before


def test_a_worker_that_does_not_see_the_store_says_what_it_needs(folder):
    url = str(folder / "elsewhere.zarr")
    with pytest.raises(MachineFaultError, match=r"machine fault on .*: not found on ") as told:
        compute_block(url, "0" * 32, Block((0,), (1,)))
    assert "by a worker; every machine needs the store under this path" in str(told.value)


ERRORS = {
    OSError(24, "Too many open files", "chunk"):
        "chunk: Too many open files; allow more open files (ulimit -n)",
    BlockingIOError(11, "Resource temporarily unavailable"):
        "the system refused a request: Resource temporarily unavailable; "
        "allow more processes (ulimit -u)",
    MemoryError(): "out of memory; free memory, or allow more (ulimit -v)",
    RuntimeError("can't start new thread"):
        "the system refused a request: can't start new thread; allow more processes (ulimit -u)",
}


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: str(error)[:20])
def test_what_the_system_refuses_is_told_in_one_line(error, monkeypatch):
    monkeypatch.setattr("sweep.cli.check_installation", mock.Mock(side_effect=error))
    assert command("status", "x") == (1, "", ERRORS[error] + "\n")
    defect = mock.Mock(side_effect=RuntimeError("some defect"))
    monkeypatch.setattr("sweep.cli.check_installation", defect)
    with pytest.raises(RuntimeError, match="some defect"):
        cli.main(["status", "x"])


@pytest.mark.system
@pytest.mark.parametrize("unbuffered", [True, False])
def test_full_standard_output_is_told_in_one_line(unbuffered, monkeypatch):
    monkeypatch.delenv("PYTHONUNBUFFERED", raising=False)
    words = ["-u", "-m", "sweep"] if unbuffered else ["-m", "sweep", "plan", "--help"]
    with open("/dev/full", "wb") as full:  # noqa: PTH123
        done = subprocess.run(
            [sys.executable, *words], stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr == (
        "standard output cannot be written: No space left on device; free space on the disk\n")


@pytest.mark.system
def test_a_closed_stream_is_no_other_file(tmp_path):
    (tmp_path / "print.py").write_text("import os\nos.write(2, b'lost')\nD = print\n")
    for place, lines in (("print:D", 3), ("nothing:D", 0)):
        done = subprocess.run(
            ["sh", "-c", '"$0" -m sweep plugins "$1" 2>&-', sys.executable, place],
            cwd=tmp_path, capture_output=True, text=True, check=False)
        assert (len(done.stdout.splitlines()), done.stderr) == (lines, "")


@pytest.mark.system
def test_characters_that_a_terminal_lacks_are_printed_as_escapes(tmp_path):
    (tmp_path / "x.toml").write_text('title = "\u2013"\n[nonsense-\u00e9]\n', encoding="utf-8")
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    code = ("import sys; from sweep.cli import main\n"
            "main([]); print(sys.argv[1]); main(sys.argv[2:])")
    done = subprocess.run(
        [sys.executable, "-c", code, "\u2013 \u00e9", "plan", tmp_path / "x.toml"],
        env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert done.stdout.endswith("\\u2013 \\xe9\n")
    assert len(done.stderr.splitlines()) == 1
