"""Chunks and receipts that are written without Zarr's arrays are those of Zarr."""

import dataclasses

import numpy as np
import pytest

from sweep.execution.block_task import compute_block, compute_blocks
from sweep.plan.pipeline import Pipeline
from sweep.sampling.rules import Decision
from sweep.store.blocks import receipt_of
from sweep.store.lifecycle import create_store
from sweep.store.receipt import encoded

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
    for name in ("detection", "corner_error_px", "estimate", "rotation_error_rad"):
        array = store.array(name)
        # Blocks along both axes; the last one along side_px is shorter than its chunk.
        for number in (0, len(store.blocks) - 1):
            block = store.blocks[number]
            part = (*map(slice, block.starts, block.stops), *[slice(None)] * (array.ndim - 2))
            shape = array[part].shape
            values = np.random.default_rng(2).integers(0, 5, shape).astype(array.dtype)
            content = store.chunks.encoded(name, number, values)
            array[part] = values
            assert (tmp_path / "x.zarr" / store.chunks.key(name, number)).read_bytes() == content
            assert np.array_equal(store.chunks.decoded(name, number, content), values)
            with pytest.raises(ValueError, match="checksum"):
                store.chunks.decoded(name, number, content[:-1] + b"?")


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
