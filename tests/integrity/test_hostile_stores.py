"""Stores that fit no pipeline, or lead elsewhere: refused in a line, nothing touched outside."""

import shutil
from pathlib import Path

import pytest

import sweep
from support.store_files import edit_root
from support.stores import by_hand
from sweep.cli import main
from sweep.errors import SweepError
from sweep.execution.status import close
from sweep.experiment.pipeline import Pipeline
from sweep.integrity.verification import verify

TEXT = """
title = "Small"
seed = 3
[pose]
distance_m = 0.3
jitter_px = 0.5
[scene]
background = 128
[axes]
tilt_deg = [0, 30]
trial = 4
"""

EXTENTS = (2, 2)
"""Two blocks, each of both tilts and two trials."""


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    url = str(tmp_path_factory.mktemp("sound") / "sound.zarr")
    close(by_hand(url, Pipeline.from_text(TEXT, name="small"), EXTENTS))
    return Path(url)


@pytest.fixture
def copied(sound, tmp_path):
    return Path(shutil.copytree(sound, tmp_path / "copied.zarr"))


def see_refused(url, capsys):
    """Assert that all refuse a store in a line; verify may tell damage in place of that."""
    with pytest.raises(SweepError) as told:
        sweep.open(url)
    assert str(told.value).isprintable()
    capsys.readouterr()
    assert main(["status", str(url)]) == 2
    said = capsys.readouterr()
    assert (said.out, said.err.count("\n")) == ("", 1)
    code = main(["verify", str(url), "--sample", "0"])
    said = capsys.readouterr()
    assert "damaged" in said.out if code == 1 else (code, said.err.count("\n")) == (2, 1)


CHANGED = {
    "type": lambda text: text.replace('"float32"', '"float64"'),
    "chunks": lambda text: text.replace('"chunk_shape"', '"chunkshape"'),
    "scaled": lambda text: text.replace('"attributes":', '"attributes": {"scale_factor": 9}, "x":'),
    "nested too deeply": lambda _: "[" * 100_000,
}


@pytest.mark.parametrize("change", CHANGED.values(), ids=CHANGED)
def test_array_whose_metadata_was_changed_is_refused(change, copied, capsys):
    path = copied / "translation_error_m/zarr.json"
    before = path.read_text()
    path.write_text(change(before))
    assert path.read_text() != before
    see_refused(copied, capsys)


@pytest.mark.parametrize("change", [
    lambda attributes, _: attributes.update(pipeline="\x00\x1b[2J"),
    lambda _, metadata: metadata.update(fingerprint=5),
])
def test_root_of_something_else_is_refused(change, copied, capsys):
    edit_root(copied, change)
    see_refused(copied, capsys)


@pytest.mark.parametrize("number", [7, None])
def test_store_of_another_format_is_refused_with_what_to_do(number, copied, tmp_path, capsys):
    edit_root(copied, lambda _, metadata: metadata.update(format=number))
    see_refused(copied, capsys)
    file = tmp_path / "small.toml"
    file.write_text(TEXT)
    for more in (["--store", str(copied)], ["--reuse", str(copied), "--store", f"{tmp_path}/n"]):
        assert main(["run", str(file), *more]) == 2
        said = capsys.readouterr().err
        assert f"{copied}: store format {number}" in said
        assert "sweep run PIPELINE --store NEW" in said
        assert said.count("\n") == 1


def test_store_that_is_a_link_is_a_store(copied, tmp_path):
    link = tmp_path / "link.zarr"
    link.symlink_to(copied)
    assert verify(str(link), 2).damage == []
    with sweep.open(link) as results:
        assert (results.detection == 1).all()
