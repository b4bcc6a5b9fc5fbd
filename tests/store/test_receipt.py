"""Receipts and chunks: what is written is read again, by Zarr too; nothing damaged is."""

import dataclasses
import json

import numpy as np
import pytest

from support.store_files import editable
from sweep.errors import StoreError
from sweep.experiment.pipeline import Pipeline
from sweep.store.blocks import receipts
from sweep.store.files import write_files
from sweep.store.layout import RECEIPTS
from sweep.store.lifecycle import create_store
from sweep.store.receipt import FailedCell, Receipt, receipt_key

RECEIPT = Receipt(
    run_id="a" * 32, processors=("avx2", "sse"), scenes=3,
    computed={"scenes": 3, "detections": 6, "estimates": 12},
    detection=[0, 4, 0, 0, 2], estimate=[0, 8, 4],
    seconds={"scene": [0.5], "detection": [0.1, 0.2], "estimation": [0.1, 0.2, 0.3, 0.4]},
    failures=(FailedCell("trial=2", "failed", "detection", "Traceback: Größe"),),
    wall_s=1.5, written=1.7e9, checksums={"nees": 5}, block=7,
)
"""A block of 3 scenes under 2 detector settings and 2 estimators."""

TEXT = """
seed = 3
pose = { jitter_px = 0.5 }
axes = { side_px = [8, 13, 30] }
search = { precision = { detection_rate = 0.2 }, max_trials = 70 }
"""


@pytest.fixture
def store(tmp_path):
    return create_store(str(tmp_path / "x.zarr"), Pipeline.from_text(TEXT), (2, 10))


def test_receipt_that_is_written_is_read_again_by_zarr_too(store, tmp_path):
    assert Receipt.from_bytes(RECEIPT.to_bytes()) == RECEIPT
    write_files(store.storage, {receipt_key(1): RECEIPT.to_bytes()})
    text = str(store.array(RECEIPTS)[1])
    assert json.loads(text)["failures"][0]["text"].endswith("Größe")
    editable(store.url, RECEIPTS)[2:3] = np.array([text], dtype=object)
    assert (tmp_path / "x.zarr" / receipt_key(2)).read_bytes() == RECEIPT.to_bytes()


@pytest.mark.parametrize("change", [{"run_id": "b" * 32}, {"block": 2}])
def test_receipt_of_another_block_or_run_commits_nothing(change, store):
    own = dataclasses.replace(RECEIPT, run_id=store.run_id, block=1)
    write_files(store.storage, {receipt_key(1): own.to_bytes()})
    assert list(receipts(store, [1])) == [(1, own)]
    other = dataclasses.replace(own, **change)
    write_files(store.storage, {receipt_key(1): other.to_bytes()})
    with pytest.raises(StoreError, match=r"receipt of block 1 is damaged.*verify --repair"):
        list(receipts(store, [1]))
    content = own.to_bytes()
    for damaged in (content[:-1], b"", content[:9] + bytes([content[9] ^ 1]) + content[10:]):
        with pytest.raises(ValueError, match=r"\w"):
            Receipt.from_bytes(damaged)


def test_chunks_are_the_bytes_that_zarr_writes(store, tmp_path):
    for name in ("detection", "corner_error_px", "estimate", "rotation_error_rad"):
        array = editable(store.url, name)
        # Blocks along both axes; the last one along side_px is shorter than its chunk.
        for number in (0, len(store.blocks) - 1):
            block = store.blocks[number]
            part = (*map(slice, block.starts, block.stops), *[slice(None)] * (array.ndim - 2))
            shape = array[part].shape
            values = np.random.default_rng(2).integers(0, 5, shape).astype(array.dtype)
            array[part] = values
            content = (tmp_path / "x.zarr" / store.chunks.key(name, number)).read_bytes()
            assert content == store.chunks.encoded(name, values)
