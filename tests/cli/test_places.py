"""Stores and outputs in places that cannot be: one line each, whatever the command."""

import os
from pathlib import Path

import pytest

from support.reports import command
from sweep.store.locations import checked_url, exists

PIPELINE = """
[pose]
jitter_px = 0.5
[axes]
side_px = [20, 40]
"""

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
    "none.zarr": NOT_FOUND,
    "small.toml/s.zarr": NOT_FOUND,
    "small.toml": "not a sweep store; choose another path",
    "/dev/null": "not a sweep store; choose another path",
    "loop.zarr": "cannot be read: Too many levels of symbolic links",
    "x" * 300: "cannot be read: File name too long",
    "x/" * 3000: "cannot be read: File name too long",
    "file:///a/b%20c.zarr": "a store on this machine is named by its path: /a/b c.zarr",
    "file:/a/b.zarr": "a store on this machine is named by its path: /a/b.zarr",
    "memory://x.zarr":
        "no other process sees what is in this one's memory; choose a path or s3://",
    "~/x.zarr": "~ is not expanded here; expected /home/someone/x.zarr, or ./~/x.zarr for a "
                "folder of that name",
    "nonsense://x": "cannot be reached: Protocol not known: nonsense",
    "a\0b": "a path cannot hold a null character; choose another one",
}


@pytest.mark.parametrize("place", PLACES, ids=lambda place: place[:20].replace("\0", "NUL"))
def test_a_place_without_a_store_is_told_as_what_it_is_by_every_command(place, folder):  # noqa: ARG001
    for reader in READERS:
        if not (reader[0] == "tradeoff" and place.endswith(".toml")):
            line = line_of(*reader, place)
            assert line.endswith(PLACES[place])
    assert line_of("run", "small.toml", "--store", "o.zarr", "--reuse", place).endswith(
        PLACES[place])


@pytest.mark.parametrize(
    ("place", "problem"),
    [
        ("small.toml/s.zarr", "cannot be written: Not a directory"),
        *((place, PLACES[place]) for place in (
            "loop.zarr", "x" * 300, "file:/a/b.zarr", "memory://x.zarr", "~/x.zarr", "a\0b")),
        ("http://127.0.0.1:9/x.zarr", "cannot be reached"),
        ("small.toml", "not a sweep store; choose another path"),
        ("group.zarr/inner.zarr", "cannot be written: it is inside the store {}/group.zarr"),
        ("group.zarr/deep/inner.zarr", "cannot be written: it is inside the store {}/group.zarr"),
    ],
    ids=lambda text: text[:20].replace("\0", "NUL"),
)
def test_a_place_that_cannot_be_written_is_refused_before_anything_starts(
    place, problem, folder
):
    group = Path("group.zarr")
    group.mkdir()
    (group / "zarr.json").write_text("{}")
    before = sorted(path.name for path in folder.rglob("*"))
    for overwrite in ([], ["--overwrite"]):
        line = line_of("run", "small.toml", "--store", place, *overwrite)
        assert problem.format(folder) in line
    assert sorted(path.name for path in folder.rglob("*")) == before


def test_a_store_that_can_only_be_read_is_not_begun(folder, monkeypatch):  # noqa: ARG001
    monkeypatch.setattr("sweep.store.locations.remote_run_id", lambda _: None)
    assert line_of("run", "small.toml", "--store", "https://example.org/x.zarr") == (
        "https://example.org/x.zarr: can only be read; choose a path or s3://")


def test_names_that_only_look_like_urls_are_paths():
    for path in ("a:b.zarr", "./file:x", "~user/x.zarr", "x~", "./~/x.zarr"):
        assert checked_url(path) == path


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may become another user")
def test_a_folder_that_may_not_be_searched_is_told(folder):
    private = folder / "private"
    private.mkdir(mode=0o700)
    folder.chmod(0o777)
    os.seteuid(54321)
    try:
        assert not exists("none.zarr")
        for reader in READERS:
            line = line_of(*reader, "private/s.zarr")
            assert line == "private/s.zarr: cannot be read: Permission denied"
        assert line_of("run", "small.toml", "--store", "private/s.zarr") == (
            "private/s.zarr: cannot be read: Permission denied")
    finally:
        os.seteuid(0)
