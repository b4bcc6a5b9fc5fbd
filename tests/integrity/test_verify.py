"""Verify and repair: every damage is named, exactly it is mended, and a sound store is sound."""

import json
import random
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import sweep
from support.commands import command, started
from support.here import calls_here
from support.poison import Poison, poisoned, raising
from support.stores import by_hand, edit_receipt, edit_root, editable, files, same
from sweep.cli import main
from sweep.errors import StoreError, SweepError
from sweep.execution.block_task import compute_block
from sweep.execution.status import close
from sweep.experiment.pipeline import Pipeline
from sweep.integrity.verification import repair, verify
from sweep.store.blocks import begin_block, committed, receipts
from sweep.store.files import checksum_of
from sweep.store.lifecycle import create_store, open_store

TEXT = """
title = "Größen, klein"
seed = 7
marker = { size_m = 0.04 }
pose = { jitter_px = 0.5, azimuth_deg = { uniform = [0, 360] } }
scene = { background = 128 }
[axes]
side_px = [30, 60, 4]
cornerRefinementMethod = ["none", "subpix"]
solver = ["ippe_square", "iterative"]
trial = 5
"""
"""Markers of 4 px are not found: the last blocks have no numbers."""

EXTENTS = (2, 2)
"""Blocks 0 to 5 are 2 x 3: side_px 30 and 60, then 4; trials 0 and 1, 2 and 3, then 4."""

FAILED = Poison(12, "scene", "raise")
"""A scene of block 4."""

RECEIPT = "commits/receipt/c"

KINDS = {
    "chunk": ("corner_error_px/c.0.0.0.0.0", 0),
    "chunk of an edge block": ("translation_error_m/c.1.0.0.2.0", 5),
    "chunk without numbers": ("nees/c.0.0.0.1", 1),
    "chunk of flags": ("estimate/c.1.0.0.0", 3),
    "receipt": (f"{RECEIPT}.2", 2),
    "coordinate": ("side_px/c.0", None),
    "coordinate that follows": ("distance_m/c.0", None),
    "labels of an axis": ("solver/c.0", None),
    "labels of a dimension": ("xyz/c.0", None),
    "metadata of a variable": ("detection/zarr.json", None),
    "metadata of a coordinate": ("trial/zarr.json", None),
    "metadata of labels": ("corner/zarr.json", None),
    "metadata of the commits": ("commits/zarr.json", None),
    "metadata of the receipts": ("commits/receipt/zarr.json", None),
    "metadata of the costs": ("cost/zarr.json", None),
    "metadata of a cost": ("cost/estimation_s/zarr.json", None),
    "chunk of a cost": ("cost/scene_s/c/0", None),
}
"""Kind of file -> the key of one, and its block."""


def spoil(path, generator):
    """Put another value in place of one byte."""
    content = bytearray(path.read_bytes())
    k = generator.randrange(len(content))
    content[k] = generator.choice([value for value in range(256) if value != content[k]])
    path.write_bytes(content)


def shorten(path, generator):
    content = path.read_bytes()
    path.write_bytes(content[: generator.randrange(len(content))])


def delete(path, _):
    path.unlink()


@pytest.fixture(scope="session")
def pipeline():
    return Pipeline.from_text(TEXT, name="small")


@pytest.fixture(scope="session")
def sound(pipeline, tmp_path_factory):
    """A finished store with a scene that raised; nobody writes to it."""
    folder = tmp_path_factory.mktemp("sound")
    url = str(folder / "sound.zarr")
    store = create_store(url, pipeline, EXTENTS)
    with calls_here(), raising([FAILED], folder / "notes.jsonl"):
        for block in store.blocks:
            compute_block(url, store.run_id, block)
    close(store)
    return Path(url)


@pytest.fixture
def copied(sound, tmp_path):
    return Path(shutil.copytree(sound, tmp_path / "copied.zarr"))


@pytest.fixture
def here(monkeypatch, tmp_path):
    """Repair in this process, without a cluster; returns the numbers that were computed again."""
    computed = []

    def execute(pipeline, url, **_):
        store = open_store(url, "r+")
        assert pipeline.text == store.pipeline.text
        with raising([FAILED], tmp_path / "notes.jsonl"):
            for number in sorted({*range(len(store.blocks))} - committed(store)):
                computed.append(number)
                compute_block(url, store.run_id, store.blocks[number])
        close(store)

    monkeypatch.setattr("sweep.integrity.verification.execute", execute)
    return computed


def named(verdict):
    return {(damage.where, damage.block) for damage in verdict.damage}


def see_repaired(url, sound, wanted, here):
    """Repair; assert that all that was wrong is named and mended, and no other block computed."""
    mended = repair(str(url), 0)
    assert {(damage.where, damage.block) for damage in mended.repaired} == wanted
    assert mended.damage == []
    assert here == sorted({block for _, block in wanted if block is not None})
    again = verify(str(url), 0)
    assert again.damage == []
    assert again.files == len(files(url)) == len(files(sound))
    assert files(url) == files(sound)
    assert same(url, sound)


def edit_values(url, name, change):
    """Change a variable's values through Zarr, so that the codec's checksum fits."""
    array = editable(url, name)
    array[...] = change(np.asarray(array[...]))


@pytest.mark.parametrize("sample", [14, 10**30])
def test_recomputed_sample_of_a_sound_store_agrees_to_the_bit(sound, tmp_path, sample):
    with raising([FAILED], tmp_path / "notes.jsonl"):
        found = verify(str(sound), sample)
    assert (found.damage, found.repaired, found.not_sampled) == ([], [], "")
    assert (found.finished, found.blocks, found.blocks_done) == (True, 6, 6)
    assert found.files == len(files(sound))
    assert (4 if sample < 15 else 15) <= found.sampled <= 15  # fewer of 14: below 1e-7


@pytest.mark.parametrize("manner", [delete, spoil, shorten])
def test_many_damages_at_once_are_named_and_mended(manner, sound, copied, here):
    generator = random.Random(2)
    wanted = set(KINDS.values())
    for key, _ in sorted(wanted, key=str):
        manner(copied / key, generator)
    assert named(verify(str(copied), 0)) == wanted
    see_repaired(copied, sound, wanted, here)


@pytest.mark.parametrize("change", [
    lambda path: path.write_bytes(b"{"),
    lambda path: path.write_text(path.read_text().replace("side_px = [30, 60, 4]", "side_px=[1]")),
    lambda path: path.write_text(path.read_text().replace('\\"seed\\": 7', '\\"seed\\": 8')),
], ids=["no JSON", "another pipeline", "another seed"])
def test_store_whose_root_is_lost_is_run_again(change, copied):
    before = (copied / "zarr.json").read_bytes()
    change(copied / "zarr.json")
    assert (copied / "zarr.json").read_bytes() != before
    for function in (verify, repair, lambda url, _: sweep.open(url)):
        with pytest.raises(StoreError, match=r"damaged: .*zarr\.json.*sweep run PIPELINE") as told:
            function(str(copied), 0)
        assert "\n" not in str(told.value)


def test_sound_chunks_in_wrong_places_and_edited_ones_are_named(sound, copied, here, tmp_path):
    wanted = set()
    # Two exchanged.
    one, other = (copied / f"rotation_error_deg/c.0.0.0.{k}" for k in (0, 1))
    content = one.read_bytes()
    assert content != other.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(content)
    wanted |= {(f"rotation_error_deg/c.0.0.0.{k}", k) for k in (0, 1)}
    # A chunk and a receipt of another store.
    elsewhere = tmp_path / "other.zarr"
    by_hand(str(elsewhere), Pipeline.from_text(TEXT, ["seed=8"], name="small"), EXTENTS)
    taken = {("corner_error_px/c.0.0.2.0.0", 2), (f"{RECEIPT}.3", 3)}
    for key, _ in taken:
        shutil.copy(elsewhere / key, copied / key)
    wanted |= taken

    # xarray.open_zarr reads these in place of the arrays' own.
    root = json.loads((copied / "zarr.json").read_text())
    root["consolidated_metadata"]["metadata"]["detection"]["attributes"]["flag_meanings"] = "a b"
    (copied / "zarr.json").write_text(json.dumps(root))
    wanted.add(("zarr.json", None))

    edit_values(copied, "marker_area_px", lambda values: values + (np.arange(5) == 4))
    wanted |= {("marker_area_px/c.0.2", 2), ("marker_area_px/c.1.2", 5)}
    assert named(verify(str(copied), 0)) == wanted
    see_repaired(copied, sound, wanted, here)


def test_unfinished_store_is_sound_and_goes_on_after_a_repair(pipeline, sound, tmp_path, here):
    url = tmp_path / "begun.zarr"
    store = create_store(str(url), pipeline, EXTENTS)
    found = verify(str(url), 5)
    assert (found.damage, found.blocks_done) == ([], 0)
    assert (found.finished, found.sampled) == (False, 0)
    for number in (0, 3, 5):
        compute_block(str(url), store.run_id, store.blocks[number])
    # Two that a killed worker left: one begun, one torn.
    begin_block(store, store.blocks[1])
    (url / "detection/c.0.0.2").write_bytes(b"torn")
    found = verify(str(url), 0)
    assert (found.damage, found.blocks_done) == ([], 3)
    spoil(url / "true_rvec/c.1.0.0", random.Random(3))
    (url / "xyz/c.0").unlink()
    assert named(verify(str(url), 0)) == {("true_rvec/c.1.0.0", 3), ("xyz/c.0", None)}
    mended = repair(str(url), 0)
    assert (mended.damage, here, mended.blocks_done) == ([], [], 2)
    for number in (3, 2, 4, 1):
        with raising([FAILED], tmp_path / "notes.jsonl"):
            compute_block(str(url), store.run_id, store.blocks[number])
    close(open_store(str(url), "r+"))
    found = verify(str(url), 0)
    assert (found.damage, found.finished, found.files) == ([], True, len(files(sound)))
    assert same(url, sound)


ELSEWHERE = {
    "NPY_DISABLE_CPU_FEATURES": "X86_V4", "OPENCV_CPU_DISABLE": "AVX2",
    "OPENBLAS_CORETYPE": "Nehalem",
}
"""Environment in which the libraries take the routines of an older processor."""

@pytest.mark.evidence
def test_numbers_beyond_the_tolerance_are_told_on_this_and_on_another_processor(
    sound, copied, tmp_path
):
    name, store = "rotation_error_rad", open_store(str(copied))
    edit_values(copied, name, lambda values: 1.01 * values)
    for number in range(6):  # the receipts tell of it
        changed = checksum_of((copied / store.chunk_key(name, number)).read_bytes())
        edit_receipt(copied, number, lambda told, to=changed: told["checksums"].update({name: to}))
    assert verify(str(copied), 0).damage == []
    with calls_here(), raising([FAILED], tmp_path / "notes.jsonl"):
        damage = verify(str(copied), 40).damage
    assert damage
    assert all(one.where.startswith("--at ") and name in one.what for one in damage)
    elsewhere = {**poisoned([FAILED], tmp_path / "notes.jsonl"), **ELSEWHERE}
    (_, receipt), = receipts(store, [0])
    ran = started(["-c", "from sweep.evaluation.results import processor; print(processor())"],
                  env=elsewhere, stdout=subprocess.PIPE, text=True)
    with ran as process:
        assert [process.communicate()[0].strip()] != receipt.processors
    for url, sound_there in ((sound, True), (copied, False)):
        told = json.loads(command("verify", url, "--sample", "40", "--json", env=elsewhere).stdout)
        assert told["sampled"] >= 8
        assert (told["damage"] == []) is sound_there


# Stores that fit no pipeline: refused in a line.

DEEP = "[" * 100_000


@pytest.mark.parametrize("change", [
    lambda url: (url / "translation_error_m/zarr.json").write_text(DEEP),
    lambda url: edit_root(url, lambda own, _: own.update(pipeline="\x00\x1b[2J")),
    lambda url: edit_root(url, lambda _, run: run.update(fingerprint=5)),
    lambda url: edit_root(url, lambda _, run: run.update(format=7)),
], ids=["metadata", "pipeline", "fingerprint", "format"])
def test_what_is_changed_is_refused_in_a_line(change, copied, tmp_path, capsys):
    change(copied)
    with pytest.raises(SweepError) as told:
        sweep.open(copied)
    assert str(told.value).isprintable()
    assert main(["status", str(copied)]) == (1 if ": damaged: " in str(told.value) else 2)
    said = capsys.readouterr()
    assert (said.out, said.err.count("\n")) == ("", 1)
    code = main(["verify", str(copied), "--sample", "3"])
    said = capsys.readouterr()
    if code == 1:
        assert "translation_error_m/zarr.json is damaged" in said.out  # why no scene is recomputed
    assert code == 1 or (code, said.err.count("\n")) == (2, 1)
    if "store format 7" in said.err:
        assert "sweep run PIPELINE --store NEW" in said.err
        (tmp_path / "small.toml").write_text(TEXT)
        for more in (["--store", copied], ["--reuse", copied, "--store", tmp_path / "new"]):
            assert main(["run", *map(str, [tmp_path / "small.toml", *more])]) == 2
            assert f"{copied}: store format 7" in capsys.readouterr().err.splitlines()[-1]
