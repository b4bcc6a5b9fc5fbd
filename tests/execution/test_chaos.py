"""Commit or redo: whatever is killed, and when, the same command brings the same store about."""

import contextlib
import itertools
import random
import shutil
import time
from pathlib import Path

import psutil
import pytest
import xarray as xr

from support.clusters import CLIENT, Cluster, workers_below
from support.commands import pieces, started
from support.here import calls_here
from support.stores import GRID, by_hand, same
from sweep.errors import StoreError
from sweep.execution.runner import execute
from sweep.execution.status import close, status
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.store.blocks import committed, receipts
from sweep.store.lifecycle import create_store, open_store

SEED = 20_261

PRECISION = """
[search]
precision = { detection_rate = 0.03 }
per = ["distance_m", "tilt_deg"]
"""

def whole(url, pipeline, reference):
    """Assert that a store is finished and equals another; each block is committed once."""
    store = open_store(url)
    assert store.finished
    count = len(store.blocks)
    assert committed(store) == set(range(count))
    told = list(receipts(store, range(count)))
    assert [number for number, _ in told] == list(range(count))
    assert sum(receipt.scenes for _, receipt in told) == pipeline.size(Stage.scene)
    assert same(url, reference)
    with xr.open_zarr(url) as opened:  # a warning where its metadata is not in one place
        assert opened.sizes
    computed = sum(receipt.computed["scenes"] > 0 for _, receipt in told)
    with xr.open_zarr(url, group="cost") as cost:
        assert cost.sizes["block"] == computed


def prepared(folder, text, name):
    """Return a pipeline, its file, and a store of it that was computed undisturbed."""
    pipeline = Pipeline.from_text(text, name=name)
    path, url = folder / f"{name}.toml", str(folder / f"{name}.zarr")
    path.write_text(text)
    by_hand(url, pipeline)
    return pipeline, path, url


class Chaos:
    """Runs into new stores, again and again, and kills what runs them at random instants.

    In turn: a client, a worker, the scheduler; of a cluster outside, which goes on when its client
    dies, or of a client with processes of its own.
    """

    def __init__(self, folder, pipeline, path, reference):
        self._folder, self._pipeline, self._path = folder, pipeline, path
        self._reference = reference
        self._random = random.Random(SEED)
        self._left = contextlib.ExitStack()
        self._cluster = None
        self.stores = 0
        self._next_store()

    def run(self, kills):
        with self._left:
            for _, victim in zip(
                range(kills), itertools.cycle(["client", "worker", "scheduler"]), strict=False
            ):
                while not self._killed(victim):
                    pass
            if Path(self._url).exists():
                with self._client() as client:
                    assert client.wait(timeout=900) == 0, self._told()
                whole(self._url, self._pipeline, self._reference)

    def _next_store(self):
        self.stores += 1
        self._url = str(self._folder / f"chaos{self.stores}.zarr")

    def _receipts(self):
        try:
            return len(committed(open_store(self._url)))
        except StoreError:
            return 0

    def _client(self, scheduler=""):
        log = self._left.enter_context((self._folder / "client.log").open("w"))
        return started(
            ["-c", CLIENT, self._path, self._url, scheduler, 0.05], stdout=log, stderr=log)

    def _told(self):
        return (self._folder / "client.log").read_text()

    def _outside(self):
        """Return the cluster outside and the parent of its workers; start them."""
        if self._cluster is None:
            cluster = self._left.enter_context(Cluster(self._folder))
            self._cluster = cluster, cluster.nannies(2)
        return self._cluster

    def _killed(self, victim):
        """Kill at a random instant; tell whether the run still went on then."""
        cluster = parent = None
        if victim == "scheduler" or self._random.random() < 0.5:
            cluster, parent = self._outside()
        with self._client(cluster.address if cluster else "") as client:
            if self._random.random() < 0.5 and victim != "worker":
                self._seconds(client, 6.0)
            else:
                self._some_blocks(client)
                self._seconds(client, 0.3)
            if client.poll() is not None:
                if client.returncode == 0:
                    whole(self._url, self._pipeline, self._reference)
                    self._next_store()
                return False
            if victim == "worker":
                there = workers_below(parent or client)
                if not there:
                    return False
                with contextlib.suppress(psutil.NoSuchProcess):
                    self._random.choice(there).kill()
                self._some_blocks(client)  # the run goes on without being asked to
                assert client.poll() in {None, 0}, self._told()
            else:
                (client if victim == "client" else cluster.scheduler).kill()
        if victim == "scheduler":
            cluster.__exit__()
            self._cluster = None
        return True

    def _seconds(self, client, most):
        deadline = time.monotonic() + self._random.uniform(0.0, most)
        while client.poll() is None and time.monotonic() < deadline:
            time.sleep(0.01)

    def _some_blocks(self, client):
        enough = self._receipts() + self._random.randint(1, 6)
        deadline = time.monotonic() + 300
        while client.poll() is None and self._receipts() < enough:
            assert time.monotonic() < deadline, "no block was committed for five minutes"
            time.sleep(0.02)


@pytest.mark.evidence
@pytest.mark.parametrize(("text", "kills"), [
    pytest.param(GRID.replace("trial = 8", "trial = 250"), 160, id="grid"),
    pytest.param(GRID.replace("[0.2, 0.3, 0.4]", "[0.2, 1.1, 1.2, 1.3, 1.4]").replace(
        "trial = 8", "trial = 2000") + PRECISION, 40, id="waves"),
])
def test_kills_at_random_instants_change_no_bit_and_lose_no_block(text, kills, claim, tmp_path):
    chaos = Chaos(tmp_path, *prepared(tmp_path, text, "undisturbed"))
    chaos.run(kills)
    claim("stores after kills of client, worker, scheduler at random instants",
          f"an undisturbed run; {kills} kills", 0.0, "bits differ")


SMALL = GRID.replace("[0.2, 0.3, 0.4]", "[0.2, 0.3, 0.4, 0.5]").replace("= 8", "= 10")
"""80 scenes: as blocks of one scene they are more than the instants within a block."""


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A pipeline of few scenes, its file, and its store."""
    return prepared(tmp_path_factory.mktemp("small"), SMALL, "small")


@pytest.mark.system
@pytest.mark.parametrize("step", [15, pytest.param(1, marks=pytest.mark.evidence)])
def test_kill_between_any_two_writes_of_a_block_loses_that_block_alone(step, small, tmp_path):
    pipeline, path, reference = small
    url = str(tmp_path / "small.zarr")
    store = create_store(url, pipeline, (1, 1, 1 if step == 1 else 5))
    count = pieces("block", url, path, step)
    # The receipt's renaming is what commits; what comes after it, if anything, may be lost.
    before = committed(store)
    assert before == set(range(count + 1 - len(before), count + 1))
    assert len(before) <= 4
    assert status(url).blocks_done == len(before)
    with calls_here():
        summary = execute(pipeline, url)
    assert summary.computed_blocks == len(store.blocks) - len(before)
    assert (summary.crashed, summary.warnings) == (0, [])
    whole(url, pipeline, reference)


@pytest.mark.evidence
@pytest.mark.filterwarnings("ignore:Object at zarr.*partial")  # left by a kill, and no fault
def test_kill_between_any_two_writes_of_closing_and_of_a_new_store_leaves_all_or_none(
    small, tmp_path
):
    pipeline, path, reference = small
    by_hand(str(tmp_path / "complete.zarr"), pipeline, (4, 2, 10))
    count = pieces("closing", tmp_path, path)
    for number in range(count + 1):
        url = str(tmp_path / f"{number}.zarr")
        if not open_store(url).finished:
            assert number < count
            close(open_store(url, "r+"))
        whole(url, pipeline, reference)
        shutil.rmtree(url)
    count = pieces("creating", tmp_path, path)
    for number in range(count + 1):
        url = tmp_path / f"{number}.zarr"
        assert url.exists() or number < count
        if not url.exists():
            create_store(str(url), pipeline, (1, 1, 10))
        assert committed(open_store(str(url))) == set()
