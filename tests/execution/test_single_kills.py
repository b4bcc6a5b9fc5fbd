"""SIGKILL of a nanny, a worker, the scheduler or the client, also during reuse and overwriting."""

import contextlib
import json
import subprocess
import time

import psutil
import pytest

from support.commands import started
from support.stores import by_hand, same
from sweep.errors import StoreError
from sweep.experiment.pipeline import Pipeline
from sweep.store.blocks import committed, receipts
from sweep.store.lifecycle import open_store

GRID = """
seed = 3
[marker]
size_m = 0.04
[pose]
jitter_px = 0.5
[axes]
distance_m = [0.2, 0.3, 0.4]
cornerRefinementMethod = ["none", "subpix"]
tilt_deg = [10, 45]
trial = 200
"""

CLIENT = """
import json, sys
from sweep.execution.runner import execute
from sweep.experiment.pipeline import Pipeline

if __name__ == "__main__":
    pipeline, store, scheduler, options = sys.argv[1:]
    execute(Pipeline.from_toml(pipeline), store, scheduler=scheduler, block_s=0.1,
            **json.loads(options))
"""

QUIET = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}


class Cluster:
    """A scheduler, and the nannies of two workers in a process beside it."""

    def __init__(self, folder, stack):
        self._folder, self._stack = folder, stack
        self.start()

    def start(self):
        self._file = self._folder / "scheduler.json"
        self._file.unlink(missing_ok=True)
        self.scheduler = self._stack.enter_context(started(
            ["-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0",
             "--no-dashboard", "--scheduler-file", self._file], **QUIET,
        ))
        self.start_workers()
        deadline = time.monotonic() + 60
        while not (self._file.exists() and self._file.stat().st_size):
            assert time.monotonic() < deadline, "no scheduler came up"
            time.sleep(0.05)

    def start_workers(self):
        self.nannies = self._stack.enter_context(started(
            ["-m", "distributed.cli.dask_worker", "--scheduler-file", self._file, "--nworkers",
             "2", "--nthreads", "1", "--no-dashboard", "--host", "127.0.0.1",
             "--local-directory", self._folder], **QUIET,
        ))

    @property
    def address(self):
        return json.loads(self._file.read_text())["address"]

    def worker(self):
        below = psutil.Process(self.nannies.pid).children(recursive=True)
        return next(one for one in below if "spawn_main" in " ".join(one.cmdline()))


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("undisturbed")
    path, url = folder / "grid.toml", str(folder / "grid.zarr")
    path.write_text(GRID)
    by_hand(url, Pipeline.from_text(GRID))
    return path, url


def options_of(manner, folder, url):
    """Return what a run is given, after the store that it reuses or overwrites was made."""
    if manner == "reuse":
        old = str(folder / "old.zarr")
        by_hand(old, Pipeline.from_text(GRID, ["trial=20"]))
        return {"reuse": [old]}
    if manner == "overwrite":
        by_hand(url, Pipeline.from_text(GRID, ["seed=4", "trial=20"]))
        return {"overwrite": True}
    return {}


def run_id(url):
    """Return the run of the store at a place, and how many blocks it has."""
    with contextlib.suppress(StoreError):
        store = open_store(url)
        return store.run_id, len(committed(store))
    return None, 0


@pytest.mark.long
@pytest.mark.parametrize("manner", ["plain", "reuse", "overwrite"])
@pytest.mark.parametrize("victim", ["nanny", "worker", "scheduler", "client"])
def test_kill_of_any_one_process_changes_no_bit(victim, manner, undisturbed, tmp_path):
    path, reference = undisturbed
    url, log = str(tmp_path / "killed.zarr"), tmp_path / "client.log"
    options = options_of(manner, tmp_path, url)
    before, _ = run_id(url)

    def client():
        file = stack.enter_context(log.open("w"))
        return stack.enter_context(started(
            ["-c", CLIENT, path, url, cluster.address, json.dumps(options)], stdout=file,
            stderr=file,
        ))

    with contextlib.ExitStack() as stack:
        cluster = Cluster(tmp_path, stack)
        running = client()
        deadline = time.monotonic() + 120
        while running.poll() is None:
            current, blocks = run_id(url)
            if current != before and blocks >= 3:
                break
            assert time.monotonic() < deadline, log.read_text()
            time.sleep(0.02)
        assert running.poll() is None, log.read_text()
        killed = {"nanny": cluster.nannies, "scheduler": cluster.scheduler,
                  "client": running}.get(victim) or cluster.worker()
        killed.kill()
        left = run_id(url)[1]
        if victim == "nanny":
            cluster.start_workers()
        code = running.wait(timeout=300)
        if victim in ("nanny", "worker"):
            assert code == 0, log.read_text()  # it goes on without being asked to
        else:
            assert code != 0
            if victim == "scheduler":
                assert "the scheduler went away" in log.read_text()
                cluster.start()
            options.pop("overwrite", None)
            assert client().wait(timeout=300) == 0, log.read_text()
    store = open_store(url)
    count = len(store.blocks)
    assert store.finished
    assert [number for number, _ in receipts(store, committed(store))] == list(range(count))
    assert same(url, reference)
    print(f"{victim}, {manner}: killed after {left} of {count} blocks; exit status {code}")
