"""What readers check of a store: its chunks and coordinates are there, and which processor."""

import shutil
from pathlib import Path

import numpy as np
import pytest

import sweep
from support.store_files import editable
from support.stores import by_hand
from sweep.cli import main
from sweep.errors import StoreError
from sweep.execution.block_task import compute_block
from sweep.execution.reuse import match
from sweep.execution.status import close, status
from sweep.experiment.pipeline import Pipeline
from sweep.integrity.reproduction import reproduce
from sweep.integrity.verification import verify
from sweep.processor import processor
from sweep.store.blocks import drop_block, receipts
from sweep.store.lifecycle import create_store, open_store

TEXT = """
seed = 3
[pose]
jitter_px = 0.5
tilt_deg = { uniform = [0, 60] }
[axes]
side_px = [30, 60]
solver = ["ippe_square", "iterative"]
trial = 4
"""

EXTENTS = (1, 2)
"""Four blocks."""


@pytest.fixture(scope="module")
def pipeline():
    return Pipeline.from_text(TEXT, name="whole")


@pytest.fixture(scope="module")
def finished(pipeline, tmp_path_factory):
    url = str(tmp_path_factory.mktemp("finished") / "whole.zarr")
    close(by_hand(url, pipeline, EXTENTS))
    return Path(url)


@pytest.fixture
def copied(finished, tmp_path):
    return Path(shutil.copytree(finished, tmp_path / "whole.zarr"))


COMMANDS = (["status"], ["require", "detection >= 0.1"])


@pytest.mark.parametrize("lost", [
    ("detection/c/0", "rotation_error_rad/c/1/0/1"), ("true_rvec/c",), ("commits/receipt/c/2",),
    ("tilt_deg/c/0/1",),
], ids=["parts", "a variable", "a receipt", "a drawn coordinate"])
def test_readers_name_what_is_gone_and_what_repairs_it(lost, pipeline, copied, capsys):
    store = open_store(str(copied))
    for key in lost:
        path = copied / key
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    name = lost[0].partition("/c")[0]
    for reader in (sweep.open, status, lambda url: match(pipeline, open_store(url))):
        if name == "commits/receipt" and reader is not sweep.open:
            continue
        with pytest.raises(StoreError, match=rf"{name}/c/.* of block .*sweep verify --repair"):
            reader(str(copied))
    for command, *more in COMMANDS:
        assert main([command, str(copied), *more]) == 2
        assert "sweep verify --repair" in capsys.readouterr().err
    assert {damage.block for damage in verify(str(copied), 0).damage} <= set(range(4))
    if name == "detection":
        with pytest.raises(StoreError, match="detection/c/0"):
            reproduce(str(copied), "side_px=30")
    assert store.finished


def test_store_that_is_being_written_is_read_though_blocks_are_missing(pipeline, tmp_path):
    url = str(tmp_path / "half.zarr")
    store = by_hand(url, pipeline, EXTENTS)
    drop_block(store, store.blocks[1])
    assert status(url).blocks_done == 3
    assert int((sweep.open(url).detection == 0).sum()) == 2


@pytest.mark.parametrize(("name", "values"), [
    ("side_px", [30.0, 61.0]), ("solver", ["iterative", "ippe_square"]),
    ("xyz", ["x", "z", "y"]), ("size_m", 0.02),
])
def test_readers_name_a_coordinate_that_was_rewritten(name, values, copied, capsys):
    array = editable(copied, name)
    array[...] = np.array(values, dtype=object if array.dtype.kind in "OTU" else None)
    with pytest.raises(StoreError, match=rf"{name}/c.*changed.*--repair"):
        sweep.open(copied)
    assert main(["require", str(copied), "detection >= 0.1"]) == 2
    assert f"{name}/c" in capsys.readouterr().err
    assert name in {damage.where.partition("/")[0] for damage in verify(str(copied), 0).damage}


def test_reused_cells_keep_the_processor_that_computed_them(
    pipeline, tmp_path, monkeypatch, capsys
):
    old, url = str(tmp_path / "old.zarr"), str(tmp_path / "grown.zarr")
    with monkeypatch.context() as patch:
        patch.setattr("sweep.execution.block_task.processor", lambda: "elsewhere")
        by_hand(old, pipeline, EXTENTS)
    grown = Pipeline.from_text(TEXT.replace("trial = 4", "trial = 6"), name="grown")
    store = create_store(url, grown, (1, 3))
    for block in store.blocks:
        compute_block(url, store.run_id, block, (old,))
    close(store)
    found = [receipt.processors for _, receipt in receipts(store, range(4))]
    assert found == [("elsewhere",), tuple(sorted({"elsewhere", processor()}))] * 2
    report = verify(url, 40)
    assert (report.damage, report.processors) == ([], {"elsewhere": 4, processor(): 2})
    for command in ("verify", "status"):
        assert main([command, url]) == 0
        assert "processors with 2 different sets of features" in capsys.readouterr().out
