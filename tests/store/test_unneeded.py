"""Chunks and receipts that are written without Zarr's arrays are those of Zarr."""


import numpy as np
import pytest

from sweep.experiment.pipeline import Pipeline
from sweep.store.lifecycle import create_store
from sweep.store.receipt import encoded

TEXT = """
seed = 3
pose = { jitter_px = 0.5 }
axes = { side_px = [8, 13, 30] }
search = { precision = { detection_rate = 0.2 }, max_trials = 70 }
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
