"""A small run: one child process instead of a cluster, with the same numbers and guarantees."""

import contextlib
import os
import signal

import pytest
from distributed import Client

from support.here import Here
from support.stores import by_hand, same
from sweep.errors import MachineFaultError, RunError, StoreReplacedError
from sweep.execution import engines as small_run
from sweep.execution.progress import Tally
from sweep.execution.runner import execute, recompute
from sweep.experiment.pipeline import Pipeline
from sweep.isolation.child_process import Child, ChildRaisedError, Interrupts
from sweep.store.blocks import drop_block
from sweep.store.lifecycle import open_store
from sweep.store.lock import writing

TEXT = """
seed = 3
pose = { jitter_px = 0.5, azimuth_deg = { uniform = [0, 360] } }
axes = { side_px = [20, 40], trial = 6 }
"""


@pytest.fixture(scope="module")
def pipeline():
    return Pipeline.from_text(TEXT, name="small")


@pytest.fixture(scope="module")
def undisturbed(pipeline, tmp_path_factory):
    url = str(tmp_path_factory.mktemp("undisturbed") / "whole.zarr")
    by_hand(url, pipeline)
    return url


@pytest.fixture
def no_cluster(monkeypatch):
    def refused(*_args, **_options):
        pytest.fail("a cluster was started")

    monkeypatch.setattr("sweep.execution.cluster.connected", refused)


@pytest.fixture
def client(cluster):
    with Client(cluster, set_as_default=False) as connected:
        yield connected


@pytest.mark.long
@pytest.mark.usefixtures("no_cluster")
def test_small_run_and_small_repair_start_no_cluster(pipeline, undisturbed, tmp_path):
    url = str(tmp_path / "small.zarr")
    summary = execute(pipeline, url, block_s=0.01)
    assert (summary.computed_scenes, summary.failed, summary.crashed) == (12, 0, 0)
    assert same(url, undisturbed)
    store = open_store(url, "r+")
    with writing(store.url, store.storage):
        drop_block(store, store.blocks[0])
        recompute(store, [0])
    assert same(url, undisturbed)


@pytest.mark.long
def test_what_takes_longer_than_it_was_measured_goes_to_a_cluster(
    pipeline, undisturbed, client, tmp_path, monkeypatch
):
    monkeypatch.setattr(small_run, "SMALL_RUN_LIMIT_S", 0.0)
    asked = []

    @contextlib.contextmanager
    def connected(_):
        asked.append(True)
        yield client

    monkeypatch.setattr("sweep.execution.cluster.connected", connected)
    url = str(tmp_path / "long.zarr")
    summary = execute(pipeline, url, block_s=1e-6)
    assert asked == [True]
    assert summary.computed_blocks == summary.blocks == 12
    assert same(url, undisturbed)


def suicide(*_):
    os.kill(os.getpid(), signal.SIGKILL)


class Failing(Here):
    """A child whose calls fail."""

    def __init__(self, error):
        self._error = error

    def call(self, *_, **__):
        raise self._error

    def restart(self):
        """It would fail again."""


def compute(store, child):
    with child, Interrupts() as interrupts:
        small_run.InChild(store, child, time_limit_s=60).run(
            range(len(store.blocks)), Tally(store), interrupts)


@pytest.mark.long
def test_block_that_ends_its_process_each_time_is_named(undisturbed, monkeypatch):
    monkeypatch.setattr(small_run, "MAX_DEATHS", 1)
    monkeypatch.setattr(small_run, "compute_blocks", suicide)
    failed = r"block 0-2,0-6: its process ended: SIGKILL, as where memory runs out: use "
    with pytest.raises(RunError, match=failed):
        compute(open_store(undisturbed), Child())


@pytest.mark.parametrize(("raised", "error", "reason"), [
    (ChildRaisedError("Traceback:\n  ...\nZeroDivisionError: no"), RunError,
     r"1 blocks failed\n  block 0-2,0-6: ZeroDivisionError: no"),
    (StoreReplacedError("moved"), StoreReplacedError, "moved"),
    (MachineFaultError("full", "here"), RunError, "0-2,0-6: machine fault on here: full"),
])
def test_block_that_fails_is_named(raised, error, reason, undisturbed):
    with pytest.raises(error, match=reason):
        compute(open_store(undisturbed), Failing(raised))
