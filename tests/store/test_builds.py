"""What ran is what is written down: builds of libraries, compared wherever numbers meet."""

import json

import cv2
import numba
import pytest

import sweep
from sweep.errors import MachineFaultError, StoreError
from sweep.execution.block_task import compute_block
from sweep.execution.reuse import match
from sweep.execution.runner import execute
from sweep.store import provenance
from sweep.store.lifecycle import create_store, open_store
from sweep.store.provenance import builds, fingerprint

PIPELINE = sweep.Pipeline.from_dict(
    {"pose": {"side_px": 40, "jitter_px": 0.5}, "axes": {"trial": 4}}
)


@pytest.fixture
def other_build(monkeypatch):
    """OpenCV of the same version, built otherwise."""
    here = dict(builds())
    there = {**here, "opencv": f"{cv2.__version__} 000000000000"}
    monkeypatch.setattr(provenance, "builds", lambda: there)
    return here["opencv"], there["opencv"]


def test_loaded_builds_are_recorded():
    here = fingerprint(PIPELINE)["builds"]
    assert here["opencv"].startswith(f"{cv2.__version__} ")
    assert here["numba"] == numba.__version__
    assert set(here) == {"opencv", "numpy", "numba", "llvmlite"}
    json.dumps(here)


def test_another_build_of_the_same_version_is_refused_by_run_reuse_and_workers(
    other_build, monkeypatch, tmp_path
):
    there, here = other_build
    url = str(tmp_path / "theirs.zarr")
    with monkeypatch.context() as patch:
        patch.setattr(provenance, "builds", builds)
        store = create_store(url, PIPELINE, (4,))
    line = f"builds.opencv: the store has {there}, this run {here}"
    with pytest.raises(StoreError, match=line):
        execute(PIPELINE, url)
    with pytest.raises(StoreError, match=r"builds\.opencv: the store has"):
        match(PIPELINE, open_store(url))
    with pytest.raises(MachineFaultError, match=f"on a worker builds.opencv is {here}") as raised:
        compute_block(url, store.run_id, store.blocks[0])
    assert len(str(raised.value).splitlines()) == 1
