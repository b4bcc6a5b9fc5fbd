"""Receipts: what is written is read again, and nothing else is."""

import json

import numpy as np
import pytest

from sweep.experiment.pipeline import Pipeline
from sweep.store.blocks import receipt_texts
from sweep.store.chunks import receipt_key
from sweep.store.layout import RECEIPTS
from sweep.store.lifecycle import create_store
from sweep.store.receipt import Receipt, RecordedFailure, decoded

RECEIPT = Receipt(
    run_id="a" * 32, processors=("avx2", "sse"), scenes=3,
    computed={"scenes": 3, "detections": 6, "estimates": 12},
    detection=[0, 4, 0, 0, 2], estimate=[0, 8, 4],
    seconds={"scene": [0.5], "detection": [0.1, 0.2], "estimation": [0.1, 0.2, 0.3, 0.4]},
    failures=(RecordedFailure(2, "failed", "detection", 1, None, "Traceback: x"),),
    wall_s=1.5, written=1.7e9, checksums={"nees": 5}, block=7,
)
"""A block of 3 scenes under 2 detector settings and 2 estimators."""


def test_receipt_that_is_written_is_read_again():
    again = Receipt.from_json(RECEIPT.to_json())
    assert again == RECEIPT
    again.check(scenes=3, settings=2, estimates=4)


@pytest.mark.parametrize(
    ("scenes", "settings", "estimates"), [(4, 2, 4), (3, 1, 4), (3, 2, 2), (2, 2, 4), (3, 4, 4)]
)
def test_receipt_of_another_block_is_refused(scenes, settings, estimates):
    with pytest.raises(ValueError, match="not a receipt of this block"):
        RECEIPT.check(scenes, settings, estimates)


@pytest.mark.parametrize(
    "change",
    [
        {"checksums": {"nees": -1}}, {"checksums": {"nees": "1"}}, {"checksums": None},
        {"scenes": True}, {"scenes": 3.0},
        {"detection": {"1": 4}}, {"estimate": [-1]}, {"seconds": {"scene": [1.0]}},
        {"seconds": {"scene": ["x"], "detection": [], "estimation": []}}, {"computed": [3]},
        {"computed": {"scenes": "3"}}, {"wall_s": "1"}, {"written": None}, {"processors": 5},
        {"run_id": None}, {"block": -1}, {"block": "1"},
        {"failures": [{}]}, {"failures": [None]}, {"failures": {}},
    ],
    ids=str,
)
def test_values_of_wrong_types_are_refused(change):
    content = json.loads(RECEIPT.to_json()) | change
    with pytest.raises(ValueError, match=r"\w"):
        Receipt.from_json(json.dumps(content))


@pytest.mark.parametrize("key", ["checksums", "scenes", "processors", "failures"])
def test_incomplete_receipts_are_refused(key):
    content = json.loads(RECEIPT.to_json())
    del content[key]
    with pytest.raises(ValueError, match="incomplete"):
        Receipt.from_json(json.dumps(content))


@pytest.mark.parametrize("text", ["", "{", "[]", "7", "null", "[" * 100_000])
def test_texts_that_are_no_receipt_are_refused(text):
    with pytest.raises(ValueError, match=r"\w"):
        Receipt.from_json(text)


def test_receipts_may_hold_more_than_this_version_knows():
    content = json.loads(RECEIPT.to_json()) | {"memory_bytes": 5}
    assert Receipt.from_json(json.dumps(content)) == RECEIPT


def test_texts_are_those_that_zarr_reads_and_damage_is_seen(tmp_path):
    """Decoded without Zarr's threads: 10^5 receipts in 7 s of processor time in place of 30 s."""
    grid = Pipeline.from_text("[pose]\njitter_px = 0.5\nside_px = 50\n[axes]\ntrial = 4")
    store = create_store(str(tmp_path / "s.zarr"), grid, (1,))
    array = store.array(RECEIPTS)
    texts = ["short", "", "μ" * 10_000]
    array[:3] = np.array(texts, dtype=object)
    assert receipt_texts(store, [0, 2]) == [texts[0], texts[2]]
    assert receipt_texts(store, [0, 2]) == array.oindex[np.array([0, 2])].tolist()
    with pytest.raises(ValueError, match="missing"):
        receipt_texts(store, [3])
    content = (tmp_path / "s.zarr" / receipt_key(2)).read_bytes()
    for damaged in (
        content[:-1], content[:3], b"", content[:9] + bytes([content[9] ^ 1]) + content[10:],
    ):
        with pytest.raises(ValueError, match=r"."):
            decoded(damaged)
