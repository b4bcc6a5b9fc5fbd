"""Chunks and receipts that are written and read without Zarr's arrays are those of Zarr."""

import dataclasses
import itertools

import numpy as np
import pytest
import zarr

from support.lengths import first_of
from sweep.execution.block_task import compute_block, compute_blocks
from sweep.plan.experiment import Pipeline
from sweep.sampling.deciding import Decision
from sweep.store.blocks import receipt_of
from sweep.store.chunk_reading import read_part
from sweep.store.layout import encoded_chunk
from sweep.store.lifecycle import create_store
from sweep.store.receipt_text import encoded

TEXT = """
seed = 3
pose = { jitter_px = 0.5 }
axes = { side_px = [8, 13, 30] }
precision = { detection_rate = 0.2, max_trials = 70 }
"""


@pytest.fixture
def store(tmp_path):
    return create_store(str(tmp_path / "x.zarr"), Pipeline.from_text(TEXT), (2, 10))


def test_contents_are_the_bytes_that_zarr_writes(store, tmp_path):
    array = store.array("commits/receipt")
    array[1:2] = np.array(["Größe 1"], dtype=object)
    assert (tmp_path / "x.zarr/commits/receipt/c/1").read_bytes() == encoded("Größe 1")
    values = np.arange(100, dtype="u1").reshape(2, 50)[:, :10] % 5
    store.array("detection")[:2, :10] = values
    assert (tmp_path / "x.zarr/detection/c/0/0").read_bytes() == encoded_chunk(values)


@pytest.mark.parametrize("name", first_of(
    ["detection", "corner_error_px", "estimate", "rotation_error_rad"], 2
))
def test_parts_are_those_that_zarr_reads(store, name, tmp_path):
    array = zarr.open_array(tmp_path / "x.zarr" / name)
    draws = np.random.default_rng(2).integers(0, 5, array.shape)
    array[:2] = draws[:2].astype(array.dtype)  # the rest is fill values
    inner = [slice(None)] * (array.ndim - 2)
    for side, trial in itertools.product(
        (slice(0, 3), slice(1, 2), slice(1, 3)), (slice(0, 70), slice(40, 60), slice(50, 70))
    ):
        part = (side, trial, *inner)
        assert np.array_equal(read_part(store, name, part), array[part], equal_nan=True)


def test_damaged_chunks_are_named(store, tmp_path):
    store.array("detection")[:2, :10] = 1
    path = tmp_path / "x.zarr/detection/c/0/0"
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    with pytest.raises(ValueError, match=r"detection/c/0/0: damaged \(checksum\)"):
        read_part(store, "detection", (slice(0, 1), slice(0, 50)))


@pytest.mark.long
def test_together_and_alone_are_the_same_bytes(tmp_path):
    pipeline, found, files = Pipeline.from_text(TEXT), [], []
    for name in ("alone", "together"):
        store = create_store(str(tmp_path / name), pipeline, (2, 50))
        # Whole, cut along side_px, along trial, and along both.
        blocks, where = list(store.blocks), (store.url, store.run_id)
        decision = Decision(pipeline.stopping, 1, (7,), settled=True)
        receipts = (
            [compute_block(*where, block, decision=decision) for block in blocks]
            if name == "alone" else compute_blocks(*where, blocks, decision)
        )
        assert compute_blocks(*where, blocks, decision) == [
            receipt_of(store, block) for block in blocks]
        found.append([
            dataclasses.replace(each, run_id="", wall_s=0.0, written=0.0, failures=())
            for each in receipts
        ])
        files.append({
            str(path.relative_to(store.url)): path.read_bytes()
            for path in sorted((tmp_path / name).glob("*/c/**/*"))
            if path.is_file() and path.relative_to(store.url).parts[0] in store.variable_names
        })
        assert not list((tmp_path / name / "commits/receipt/begun").glob("*"))
    assert found[0] == found[1]
    assert files[0] == files[1]
    assert {key.partition("/")[0] for key in files[1]} == store.flag_names
