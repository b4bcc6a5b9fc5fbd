"""Readers beside a writer: no flag speaks of a number that is not there, no block is torn."""

import pickle
import shutil
import threading

import numpy as np
import pytest
import zarr
import zarr.storage._local as local

import sweep
from support.store_files import editable
from support.stores import by_hand
from sweep.errors import StoreError
from sweep.execution.block_task import compute_block
from sweep.execution.status import close, status
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import SCHEMA, VARIABLES
from sweep.integrity.verification import verify
from sweep.measure.flags import EstimateStatus, present_values
from sweep.store.blocks import drop_block, receipts
from sweep.store.lifecycle import create_store, open_store

TEXT = """
seed = 3
[pose]
side_px = 40
jitter_px = 0.5
[scene]
noise_grey = 1
black = 40
white = 200
background = 128
bound = "known_blur"
[axes]
trial = 4
solver = ["ippe_square", "iterative"]
"""


@pytest.fixture(scope="module")
def pipeline():
    return Pipeline.from_text(TEXT, name="read")


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
    store = create_store(url, pipeline, (2,))
    compute_block(url, store.run_id, store.blocks[0])
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


def test_opened_store_shows_the_blocks_that_were_committed_when_it_was_opened(pipeline, tmp_path):
    url = str(tmp_path / "read.zarr")
    store = create_store(url, pipeline, (2,))
    compute_block(url, store.run_id, store.blocks[0])
    # A process that was killed in the midst of a block left a chunk of it.
    editable(url, "estimate")[2:] = np.ones((2, 2), dtype=np.uint8)
    with pickle.loads(pickle.dumps(sweep.open(url))) as results:  # noqa: S301
        before = results.estimate.to_numpy()
        compute_block(url, store.run_id, store.blocks[1])
        after = results.load()
    assert before.tolist() == after.estimate.to_numpy().tolist() == [[1, 1], [1, 1], [0, 0], [0, 0]]
    assert np.isnan(after.rotation_error_deg[2:]).all()
    assert np.isfinite(after.rotation_error_deg[:2]).all()
    close(open_store(url, "r+"))
    with sweep.open(url) as results:
        assert (results.estimate == 1).all()


def swap(url, name):
    """Swap what two blocks have of an array."""
    one, other = (path for path in sorted((url / name / "c").iterdir()))
    kept = one.with_name("kept")
    one.rename(kept)
    other.rename(one)
    kept.rename(other)


def test_blocks_that_were_swapped_with_their_receipts_are_found(pipeline, tmp_path):
    url = tmp_path / "read.zarr"
    close(by_hand(str(url), pipeline, (2,)))
    assert [r.block for _, r in receipts(open_store(str(url)), [0, 1])] == [0, 1]
    for name in ("commits/receipt", *(variable.name for variable in SCHEMA)):
        swap(url, name)
    found = verify(str(url), 0)
    assert {damage.block for damage in found.damage} == {0, 1}
    with pytest.raises(StoreError, match=r"receipt of block 0 is damaged.*verify --repair"):
        status(str(url))
