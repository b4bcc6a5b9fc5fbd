"""Copies that were made while the store was written, and stores that are moved meanwhile."""

import random
import shutil

import pytest

from support.stores import by_hand, same
from sweep.errors import StoreError
from sweep.execution.runner import execute
from sweep.execution.status import close
from sweep.experiment.pipeline import Pipeline
from sweep.integrity.verification import verify
from sweep.store.blocks import committed, missing_chunks
from sweep.store.lifecycle import open_store

TEXT = """
seed = 3
[pose]
distance_m = 0.3
jitter_px = 0.5
[axes]
tilt_deg = [0, 30, 60]
cornerRefinementMethod = ["none", "subpix"]
trial = 8
"""

SEED = 12

EXTENTS = (1, 2)
"""Twelve blocks."""


@pytest.fixture(scope="module")
def pipeline():
    return Pipeline.from_text(TEXT, name="copied")


@pytest.fixture(scope="module")
def written(pipeline, tmp_path_factory):
    """A store of which every block is committed, and that is not finished."""
    url = tmp_path_factory.mktemp("written") / "written.zarr"
    by_hand(str(url), pipeline, EXTENTS)
    return url


def copy_of(url, to, draw):
    """Copy a store as one that was written meanwhile: receipts without some of their chunks."""
    shutil.copytree(url, to)
    store = open_store(str(to))
    variables = sorted(variable.name for variable in store.variables)
    lost = set()
    for number in draw.sample(range(12), draw.randint(1, 4)):
        for name in draw.sample(variables, draw.randint(1, len(variables))):
            path = to / store.chunks.key(name, number)
            path.write_bytes(b"") if draw.random() < 0.2 else path.unlink()
        lost.add(number)
    return lost


def test_copy_that_was_made_during_a_run_is_continued_to_the_same_store(
    pipeline, written, tmp_path, capsys
):
    copied, draw = tmp_path / "copied.zarr", random.Random(SEED)
    assert missing_chunks(open_store(str(written)), range(12)) == {}
    lost = copy_of(written, copied, draw)
    store = open_store(str(copied), "r+")
    found = missing_chunks(store, committed(store))
    assert found.keys() == lost
    for path in (copied / key for key in found.values()):
        assert not path.exists() or path.stat().st_size == 0
    with pytest.raises(StoreError, match=rf"{len(lost)} of 12 blocks lack chunks"):
        close(store)
    assert not open_store(str(copied)).finished
    assert execute(pipeline, copied).computed_blocks == len(lost)
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{len(lost)} committed blocks lack chunks, such as" in line
    assert same(copied, written)
    assert verify(str(copied), 0).damage == []
