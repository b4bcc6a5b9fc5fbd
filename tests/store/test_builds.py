"""What ran is what is written down: builds of libraries, compared wherever numbers meet."""

import json
from pathlib import Path

import cv2
import numba
import pytest

import sweep
from sweep import installation
from sweep.errors import MachineFaultError, StoreError
from sweep.execution.block_task import compute_block
from sweep.execution.reuse import match
from sweep.execution.runner import execute
from sweep.store import provenance
from sweep.store.lifecycle import create_store, open_store
from sweep.store.provenance import builds, changes, differences, fingerprint

PIPELINE = sweep.Pipeline.from_dict(
    {"pose": {"side_px": 40, "jitter_px": 0.5}, "axes": {"trial": 4}}
)


def without_builds(url):
    """Rewrite a store's fingerprint as those of earlier versions are."""
    path = Path(url) / "zarr.json"
    content = json.loads(path.read_text())
    del content["attributes"]["sweep"]["fingerprint"]["builds"]
    path.write_text(json.dumps(content))


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
    with pytest.raises(MachineFaultError, match=f"a worker has builds.opencv {here}") as raised:
        compute_block(url, store.run_id, store.blocks[0])
    assert len(str(raised.value).splitlines()) == 1


def test_store_that_has_no_builds_is_compared_by_its_versions_alone(other_build, tmp_path):
    del other_build
    url = str(tmp_path / "old.zarr")
    create_store(url, PIPELINE, (4,))
    without_builds(url)
    store = open_store(url, "r+")
    assert differences(PIPELINE, store.pipeline, store.fingerprint) == []
    assert match(PIPELINE, store).store is store
    assert compute_block(url, store.run_id, store.blocks[0]).scenes == 4


def test_damaged_entry_of_builds_is_a_difference():
    ours = fingerprint(PIPELINE)
    assert [name for name, *_ in changes({**ours, "builds": 3}, ours)] == ["builds"]


@pytest.mark.long
@pytest.mark.parametrize("loaded", ["4.12.0", "5.1.0-dev"])
def test_opencv_that_contradicts_its_metadata_is_refused_by_library_and_workers(
    loaded, monkeypatch, tmp_path
):
    url = str(tmp_path / "made.zarr")
    store = create_store(url, PIPELINE, (4,))
    monkeypatch.setattr(cv2, "__version__", loaded)
    monkeypatch.setattr(provenance, "builds", builds.__wrapped__)
    for call in (
        lambda: sweep.run(PIPELINE, store=tmp_path / "new.zarr"),
        lambda: compute_block(url, store.run_id, store.blocks[0]),
    ):
        with pytest.raises((StoreError, MachineFaultError)) as raised:
            call()
        (line,) = str(raised.value).splitlines()
        assert f"OpenCV {loaded} is loaded, but opencv-contrib-python-headless " in line
        assert "`pip install --force-reinstall opencv-contrib-python-headless`" in line
    assert not (tmp_path / "new.zarr").exists()


@pytest.mark.long
def test_several_distributions_of_opencv_are_refused_by_the_library(monkeypatch, tmp_path):
    monkeypatch.setattr(provenance, "builds", builds.__wrapped__)
    version = installation.distribution(installation.OPENCV)
    monkeypatch.setattr(installation, "distribution", lambda _: version)
    monkeypatch.setattr(installation, "NAMESAKE", "fiducial-sweep")
    monkeypatch.setattr(installation, "_is_ours", lambda _: True)
    with pytest.raises(StoreError, match="several distributions of OpenCV"):
        sweep.run(PIPELINE, store=tmp_path / "new.zarr")
