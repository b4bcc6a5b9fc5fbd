"""Readers beside a writer and of copies: no torn block, what is gone is named with its remedy."""

import itertools
import pickle
import re
import shutil
import threading
from pathlib import Path

import numpy as np
import pytest
import zarr
import zarr.storage._local as local
from zarr.abc.store import OffsetByteRequest
from zarr.buffer import default_buffer_prototype
from zarr.core.sync import sync

import sweep
from support.stores import by_hand, editable, same
from sweep.cli import main
from sweep.errors import DamagedStoreError, StoreError
from sweep.evaluation.results import processor
from sweep.execution.block_task import compute_block, match
from sweep.execution.runner import execute
from sweep.execution.status import close, status
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import SCHEMA, VARIABLES
from sweep.integrity.verification import verify
from sweep.measure.flags import EstimateStatus, present_values
from sweep.store.blocks import check_whole, committed, drop_block, missing_chunks, receipts
from sweep.store.lifecycle import create_store, open_store

TEXT = """
seed = 3
pose = { side_px = 40, jitter_px = 0.5 }
scene = { noise_grey = 1, black = 40, white = 200, background = 128, bound = "known_blur" }
axes = { trial = 4, solver = ["ippe_square", "iterative"] }
"""

GRID = """
seed = 3
pose = { jitter_px = 0.5, tilt_deg = { uniform = [0, 60] } }
axes = { side_px = [30, 60], solver = ["ippe_square", "iterative"], trial = 4 }
"""

EXTENTS = (1, 2)  # four blocks of the grid


@pytest.fixture(scope="module")
def pipeline():
    return Pipeline.from_text(TEXT, name="read")


@pytest.fixture(scope="module")
def grid():
    return Pipeline.from_text(GRID, name="grid")


@pytest.fixture(scope="module")
def written(grid, tmp_path_factory):
    """A store of the grid of which every block is committed, and that is not finished."""
    url = tmp_path_factory.mktemp("written") / "written.zarr"
    by_hand(str(url), grid, EXTENTS)
    return url


@pytest.fixture
def copied(written, tmp_path):
    """A copy of the store that is finished."""
    url = Path(shutil.copytree(written, tmp_path / "whole.zarr"))
    close(open_store(str(url), "r+"))
    return url


def see_no_flag_without_its_numbers(values):
    """Assert that where a flag says that there are numbers, there are."""
    for variable in SCHEMA:
        rule = variable.present_when
        if rule is None or rule.number != "always":
            continue
        present = np.isin(values[rule.flag], present_values(VARIABLES[rule.flag].flags))
        numbers = values[variable.name].reshape((*present.shape, -1))
        assert np.isfinite(numbers[present]).all(), variable.name
    solved = values["estimate"] == EstimateStatus.solved
    assert (values["flipped"][solved] != 0).all()
    assert (values["detection"][solved.any(axis=1)] != 0).all()


@pytest.mark.parametrize("work", ["write", "drop"])
def test_reader_between_any_two_writes_of_a_block_sees_no_flag_without_its_numbers(
    work, pipeline, tmp_path, monkeypatch
):
    url = str(tmp_path / "read.zarr")
    store = by_hand(url, pipeline, (2,), [0])
    copies, lock = [], threading.Lock()

    def watched(function):
        def watch(*arguments, **options):
            with lock:  # writes are made by several threads
                copies.append(shutil.copytree(url, tmp_path / str(len(copies))))
                return function(*arguments, **options)

        return watch

    with monkeypatch.context() as patch:
        patch.setattr(local, "_put", watched(local._put))
        patch.setattr(local.Path, "unlink", watched(local.Path.unlink))
        if work == "write":
            compute_block(url, store.run_id, store.blocks[1])
        else:
            drop_block(open_store(url, "r+"), store.blocks[0])
    assert len(copies) > len(SCHEMA)
    solved = []
    for copied in copies:
        group = zarr.open_group(copied, mode="r", use_consolidated=False)
        values = {variable.name: np.asarray(group[variable.name]) for variable in SCHEMA}
        see_no_flag_without_its_numbers(values)
        solved.append(int((values["estimate"] == EstimateStatus.solved).sum()))
    assert (solved[0], solved[-1]) == ((4, 8) if work == "write" else (4, 0))


def test_opened_store_shows_the_blocks_committed_until_then(pipeline, tmp_path, monkeypatch):
    url = str(tmp_path / "read.zarr")
    monkeypatch.setattr("sweep.store.blocks.MANY_BLOCKS", 2)
    store = by_hand(url, pipeline, (2,), [0])
    # A process that was killed in the midst of a block left a chunk of it.
    editable(url, "estimate")[2:] = np.ones((2, 2), dtype=np.uint8)
    with pickle.loads(pickle.dumps(sweep.open(url))) as results:  # noqa: S301
        before = results.estimate.to_numpy()
        compute_block(url, store.run_id, store.blocks[1])
        after = results.load()
    assert before.tolist() == after.estimate.to_numpy().tolist() == [[1, 1], [1, 1], [0, 0], [0, 0]]
    assert np.isnan(after.rotation_error_deg[2:]).all()
    assert np.isfinite(after.rotation_error_deg[:2]).all()
    with sweep.open(url) as opened:  # of an unfinished store, too, what was committed is there
        chunk = Path(url, "estimate", "c.0.0")
        hidden = chunk.rename(chunk.with_name("hidden"))
        with pytest.raises(DamagedStoreError, match=r"read\.zarr: damaged: estimate/c\.0\.0: miss"):
            opened.load()
        chunk.write_bytes(b"changed")
        reads = store.group.store.with_read_only(read_only=True)
        asked = "estimate/c.0.0", default_buffer_prototype()
        with pytest.raises(DamagedStoreError, match="changed"):  # in another mode, too
            sync(reads.get(*asked))
        assert sync(reads.get(*asked, OffsetByteRequest(2))).to_bytes() == b"anged"  # not checked
        hidden.rename(chunk)
    close(open_store(url, "r+"))
    assert (sweep.open(url).estimate == 1).all()
    monkeypatch.setattr("sweep.store.files.list_folder", lambda *_: [])
    assert check_whole(open_store(url)) == {0, 1}  # no folder has changed since: none is listed
    with pytest.raises(StoreError, match="2 of 2 blocks lack"):  # those of a copy are
        check_whole(open_store(str(shutil.copytree(url, tmp_path / "copy.zarr"))))


def test_copy_that_was_made_during_a_run_is_continued_to_the_same_store(
    grid, written, tmp_path, capsys
):
    copied = Path(shutil.copytree(written, tmp_path / "copied.zarr"))
    store = open_store(str(copied), "r+")
    assert missing_chunks(store, range(4)) == {}
    # Receipts that were copied after chunks: one chunk was not there, and one was being written.
    lost = {1: store.chunk_key("nees", 1), 3: store.chunk_key("true_rvec", 3)}
    (copied / lost[1]).unlink()
    (copied / lost[3]).rename(copied / f"{lost[3]}.partial")
    assert missing_chunks(store, committed(store)) == lost
    with pytest.raises(StoreError, match="2 of 4 blocks lack chunks"):
        close(store)
    assert not open_store(str(copied)).finished
    assert execute(grid, copied).computed_blocks == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "2 committed blocks lack chunks, such as" in line
    assert same(copied, written)
    assert verify(str(copied), 0).damage == []


def test_block_that_is_dropped_while_a_reader_looks_is_not_damaged(written, tmp_path, monkeypatch):
    store = open_store(str(shutil.copytree(written, tmp_path / "copied.zarr")), "r+")

    def dropped(store, numbers):
        drop_block(store, store.blocks[1])
        return missing_chunks(store, numbers)

    monkeypatch.setattr("sweep.store.blocks.missing_chunks", dropped)
    assert check_whole(store) == {0, 2, 3}


@pytest.mark.parametrize("lost", [
    ("detection/c.0.*", "rotation_error_rad/c.1.0.1.*"), ("true_rvec/c.*",),
    ("commits/receipt/c.2",), ("tilt_deg/c.0.1",),
], ids=["parts", "a variable", "a receipt", "a drawn coordinate"])
def test_readers_name_what_is_gone_and_what_repairs_it(lost, grid, copied):
    for path in itertools.chain(*map(copied.glob, lost)):
        path.unlink()
    name = lost[0].partition("/c")[0]
    for reader in (sweep.open, status, lambda url: match(grid, open_store(url))):
        with pytest.raises(DamagedStoreError, match=rf"{name}/c\..* of block .*zarr --repair"):
            reader(str(copied))
    assert {damage.block for damage in verify(str(copied), 0).damage} <= set(range(4))


@pytest.mark.parametrize("share", [None, 0, 0.5], ids=["deleted", "emptied", "cut"])
def test_each_reader_names_a_damaged_store_and_what_repairs_it(share, copied, monkeypatch, capsys):
    monkeypatch.chdir(Path(shutil.copytree(copied, copied.with_name("good.zarr"))).parent)
    opened = sweep.open(copied)
    for name in ("detection", "estimate", "rotation_error_deg", "translation_error_m"):
        content = (chunk := next(copied.glob(f"{name}/c.*"))).read_bytes()
        chunk.unlink() if share is None else chunk.write_bytes(content[:int(share * len(content))])
    with pytest.raises(DamagedStoreError, match=r"whole\.zarr: damaged: .*/c\.\S+: (mis|chang)"):
        opened.load()
    Path("big.toml").write_text(GRID.replace("30, 60", "30, 60, 90"))
    for words in (
        "report {}", "report {} --error-model e.json", "require {} detection>=0.1", "tradeoff {}",
        "require good.zarr detection>=0.1 --against {}", "compare {} good.zarr", "verify {}",
        "compare good.zarr {}", "repro {} --at side_px=30", "run big.toml --reuse {}",
        "limit {} --along side_px --require detection>=0.1", "verify {} --repair",
    ):
        assert main([*words.format("whole.zarr").split()]) == (0 if "--repair" in words else 1)
        named = r"whole\.zarr: damaged: .*sweep verify \S*whole\.zarr --repair|repaired .*/c\."
        assert re.search(named, "".join(capsys.readouterr()), re.DOTALL), words
    assert same(copied, "good.zarr")


@pytest.mark.parametrize(("name", "values"), [
    ("side_px", [30.0, 61.0]), ("solver", ["iterative", "ippe_square"]),
    ("xyz", ["x", "z", "y"]), ("size_m", 0.02),
])
def test_readers_name_a_coordinate_that_was_rewritten(name, values, copied, capsys):
    array = editable(copied, name)
    array[...] = np.array(values, dtype=object if array.dtype.kind in "OTU" else None)
    with pytest.raises(DamagedStoreError, match=rf"{name}/c.*changed.*--repair"):
        sweep.open(copied)
    assert main(["require", str(copied), "detection >= 0.1"]) == 1
    assert f"{name}/c" in capsys.readouterr().err
    assert name in {damage.where.partition("/")[0] for damage in verify(str(copied), 0).damage}


def test_reused_cells_keep_the_processor_that_computed_them(grid, tmp_path, monkeypatch, capsys):
    old, url = str(tmp_path / "old.zarr"), str(tmp_path / "grown.zarr")
    with monkeypatch.context() as patch:
        patch.setattr("sweep.execution.block_task.processor", lambda: "elsewhere")
        by_hand(old, grid, EXTENTS)
    grown = Pipeline.from_text(GRID.replace("trial = 4", "trial = 6"), name="grown")
    store = create_store(url, grown, (1, 3))
    for block in store.blocks:
        compute_block(url, store.run_id, block, (old,))
    close(store)
    found = [receipt.processors for _, receipt in receipts(store, range(4))]
    assert found == [["elsewhere"], sorted({"elsewhere", processor()})] * 2
    report = verify(url, 40)
    assert (report.damage, report.processors) == ([], {"elsewhere": 4, processor(): 2})
    for command in ("verify", "status"):
        assert main([command, url]) == 0
        assert "processors with 2 different sets of features" in capsys.readouterr().out
