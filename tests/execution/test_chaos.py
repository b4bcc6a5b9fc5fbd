"""Commit or redo: whatever is killed, and when, the same command brings the same store about."""

import contextlib
import itertools
import json
import os
import random
import shutil
import signal
import subprocess
import time
from collections import Counter
from pathlib import Path

import psutil
import pytest
import xarray as xr

from support.clusters import Cluster, workers_below
from support.commands import command, complaints, started
from support.lengths import lengths
from support.stores import by_hand, same
from sweep.errors import StoreError
from sweep.execution.block_task import compute_block
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.store.blocks import committed, receipts
from sweep.store.lifecycle import create_store, open_store

SEED = 20_261

INSTANTS = Path(__file__).parents[1] / "support" / "poisoned" / "instants.py"

GRID = """
title = "A grid of many small blocks"
seed = 3
[marker]
size_m = 0.04
[pose]
jitter_px = 0.5
azimuth_deg = { uniform = [0, 360] }
[scene]
background = 128
[axes]
distance_m = [0.2, 0.3, 0.4]
cornerRefinementMethod = ["none", "subpix"]
tilt_deg = [10, 45]
solver = ["ippe_square", "iterative"]
trial = %d
"""
SHORT_TRIALS, LONG_TRIALS = 250, 1500

IN_WAVES = {
    "precision": """
[search]
precision = { detection_rate = 0.03 }
per = ["distance_m", "tilt_deg"]
""",
    "limit": """
[require]
all = ["detection >= 0.9"]
[search]
along = "distance_m"
""",
    "choose": """
[require]
all = ["detection >= 0.9"]
[search]
largest = "distance_m"
""",
}

CLIENT = """
import json, sys
from sweep.execution.runner import execute
from sweep.experiment.pipeline import Pipeline

if __name__ == "__main__":
    pipeline, store, scheduler, options = sys.argv[1:]
    execute(Pipeline.from_toml(pipeline), store, workers=2, scheduler=scheduler or None,
            block_s=0.05, **json.loads(options))
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

    In turn: a worker, the scheduler, the client; with processes of the client's, and with a cluster
    outside of it that goes on when the client dies. Cells of an ``older`` store are reused, and
    every other store stands in the place of an older one.
    """

    def __init__(self, folder, pipeline, path, reference, seed, older=""):
        self._folder, self._pipeline, self._path = folder, pipeline, path
        self._older = older
        self._reference = reference
        self._random = random.Random(seed)
        self._left = contextlib.ExitStack()
        self._cluster = None
        self._waited = False
        self.stores = 0
        self.killed = Counter()
        self.ended = Counter()

    def run(self, kills):
        turns = itertools.cycle(
            [self._scheduler_outside, self._client_inside, self._worker_inside,
             self._client_outside, self._worker_outside]
        )
        wanted = {"worker": 0, "scheduler": 0, "client": 0}
        for _, victim in zip(range(kills), itertools.cycle(wanted), strict=False):
            wanted[victim] += 1
        with self._left:
            self._next_store()
            while self.killed.total() < kills:
                turn = next(turns)
                victim = turn.__name__.split("_")[1]
                if self.killed[victim] < wanted[victim]:
                    turn()
            self._to_the_end()
        assert dict(self.killed) == {k: n for k, n in wanted.items() if n}

    def _next_store(self):
        self.stores += 1
        self._url = str(self._folder / f"chaos{self.stores}.zarr")
        self._overwritten = None
        if self._older and self.stores % 2 == 0:
            shutil.copytree(self._older, self._url)
            self._overwritten = open_store(self._url).run_id

    def _receipts(self):
        try:
            return len(committed(open_store(self._url)))
        except StoreError:
            return 0

    def _client(self, scheduler=""):
        log = (self._folder / "client.log").open("w")
        self._left.callback(log.close)
        options = {"reuse": [self._older]} if self._older else {}
        if self._overwritten is not None:
            with contextlib.suppress(StoreError):  # it may be gone, and the new one not there
                options["overwrite"] = open_store(self._url).run_id == self._overwritten
        return started(
            ["-c", CLIENT, self._path, self._url, scheduler, json.dumps(options)],
            stdout=log, stderr=log,
        )

    def _told(self):
        return (self._folder / "client.log").read_text()

    def _instant(self, client):
        """Wait for a random instant; tell whether the run still goes on then.

        Half of them lie anywhere from the start, the others just after a block was committed.
        """
        if self._random.random() < 0.5:
            deadline = time.monotonic() + self._random.uniform(0.0, 6.0)
            while client.poll() is None and time.monotonic() < deadline:
                time.sleep(0.01)
        else:
            self._some_blocks(client)
            time.sleep(self._random.uniform(0.0, 0.3))
        return client.poll() is None

    def _some_blocks(self, client):
        enough = self._receipts() + self._random.randint(1, 6)
        deadline = time.monotonic() + 300
        while client.poll() is None and self._receipts() < enough:
            assert time.monotonic() < deadline, "no block was committed for five minutes"
            time.sleep(0.02)

    def _see_it_finished(self, client):
        """Handle a client that ended of itself: with a finished store, or so that one goes on."""
        code = client.wait()
        self.ended[code] += 1
        if code == 0:
            whole(self._url, self._pipeline, self._reference)
            self._next_store()

    def _to_the_end(self):
        if not Path(self._url).exists():
            return
        with self._client() as client:
            assert client.wait(timeout=900) == 0, self._told()
        whole(self._url, self._pipeline, self._reference)

    def _outside(self):
        """Return scheduler, workers' parent and address of the cluster outside; start one."""
        if self._cluster is None:
            cluster = self._left.enter_context(Cluster(self._folder))
            self._cluster = cluster, cluster.scheduler, cluster.nannies(2), cluster.address
        return self._cluster[1:]

    def _end_outside(self):
        self._cluster[0].__exit__()
        self._cluster = None

    def _scheduler_outside(self):
        scheduler, _, address = self._outside()
        with self._client(address) as client:
            if not self._instant(client):
                self._see_it_finished(client)
                return
            scheduler.kill()
            self.killed["scheduler"] += 1
            if not self._waited:
                # It ends of itself, rather than wait for ever for blocks that nobody computes.
                self._waited = True
                code = client.wait(timeout=120)
                self.ended[code] += 1
                assert code != 0
            else:
                time.sleep(self._random.uniform(0.0, 1.0))
        self._end_outside()

    def _client_inside(self):
        with self._client() as client:
            self._kill_client(client)

    def _client_outside(self):
        # The cluster stays: its workers end the blocks that they are at, while the next client
        # has them computed again.
        with self._client(self._outside()[2]) as client:
            self._kill_client(client)

    def _kill_client(self, client):
        if self._instant(client):
            client.kill()
            client.wait()
            self.killed["client"] += 1
        else:
            self._see_it_finished(client)

    def _worker_inside(self):
        with self._client() as client:
            self._kill_worker(client, client)

    def _worker_outside(self):
        _, parent, address = self._outside()
        with self._client(address) as client:
            self._kill_worker(client, parent)

    def _kill_worker(self, client, parent):
        self._some_blocks(client)
        time.sleep(self._random.uniform(0.0, 0.5))
        there = workers_below(parent)
        if client.poll() is None and there:
            with contextlib.suppress(psutil.NoSuchProcess):
                self._random.choice(there).kill()
                self.killed["worker"] += 1
            # The run goes on without being asked to.
            self._some_blocks(client)
            assert client.poll() in {None, 0}, self._told()
        if client.poll() is not None:
            self._see_it_finished(client)


@pytest.mark.long
@pytest.mark.parametrize(("count", "older"), [(6, False), (6, True), (200, False)])
def test_kills_at_random_instants_change_no_bit_and_lose_no_block(count, older, tmp_path):
    trials = SHORT_TRIALS if count < 100 else LONG_TRIALS
    pipeline, path, reference = prepared(tmp_path, GRID % trials, "undisturbed")
    old = str(tmp_path / "old.zarr") if older else ""
    if older:
        by_hand(old, Pipeline.from_text(GRID % 20))
    chaos = Chaos(tmp_path, pipeline, path, reference, SEED, old)
    begun = time.monotonic()
    chaos.run(count)
    print(
        f"seed {SEED}: {chaos.killed.total()} kills ({dict(chaos.killed)}), {chaos.stores} stores "
        f"of {pipeline.size(Stage.scene):,} scenes, 0 differences, 0 blocks lost or doubled; "
        f"clients that ended of themselves, by status: {dict(chaos.ended)}; "
        f"{time.monotonic() - begun:.0f} s; left behind: "
        f"{sum(1 for _ in tmp_path.rglob('*.partial'))} partial files"
    )


@pytest.mark.long
@pytest.mark.parametrize(("rule", "count"), [("precision", 20), ("limit", 3), ("choose", 3)])
def test_kills_of_a_run_in_waves_change_no_bit(rule, count, tmp_path):
    text = (GRID % 2000).replace("[0.2, 0.3, 0.4]", "[0.2, 1.1, 1.2, 1.3, 1.4]") + IN_WAVES[rule]
    pipeline, path, reference = prepared(tmp_path, text, "undisturbed")
    chaos = Chaos(tmp_path, pipeline, path, reference, SEED)
    chaos.run(count)
    needed = open_store(reference)
    needed = sum(receipt.scenes_needed for _, receipt in receipts(needed, committed(needed)))
    assert 0 < needed < pipeline.size(Stage.scene)
    print(
        f"{chaos.killed.total()} kills ({dict(chaos.killed)}), {chaos.stores} stores of "
        f"{needed:,} needed scenes of {pipeline.size(Stage.scene):,}, 0 differences"
    )


SMALL = (GRID % 10).replace("[0.2, 0.3, 0.4]", "[0.2, 0.3, 0.4, 0.5]")
"""80 scenes: as blocks of one scene they are more than the instants within a block."""

NEVER = 10**6

ALL = 1000
"""More than there are instants in a block."""


@contextlib.contextmanager
def pieces(work, url, file, signal_name, instants):
    """Start pieces of work that each meet a signal at an instant; give what they came to."""
    with started(
        ["-W", "ignore", INSTANTS, work, url, file, signal_name, json.dumps(instants)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as running:
        line = running.stdout.readline()
        assert line, running.stderr.read()
        yield running, json.loads(line)


def instants_of(work, url, file, number):
    """Return how many instants a piece of work has; it is done by that."""
    with pieces(work, url, file, "SIGKILL", [[number, NEVER]]) as (_, told):
        ((met, seen),) = told
    assert met == 0
    assert seen > 2
    return seen


def some(total, count):
    """Return about ``count`` instants of ``total`` and the one after them: both ends, others."""
    if count >= total:
        return list(range(total + 1))
    middle = random.Random(SEED).sample(range(1, total - 1), count)
    return sorted({0, *middle, total - 1, total})


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A pipeline of few scenes, its file, and its store."""
    return prepared(tmp_path_factory.mktemp("small"), SMALL, "small")


@pytest.mark.long
@lengths(2, ALL)
def test_kill_between_any_two_writes_of_a_block_loses_that_block_alone(
    count, small, tmp_path
):
    pipeline, path, reference = small
    url = str(tmp_path / "small.zarr")
    store = create_store(url, pipeline, (1, 1, 1) if count == ALL else (1, 1, 5))
    total = instants_of("block", url, path, 0)
    chosen = some(total, count)
    assert len(chosen) < len(store.blocks)
    instants = [[1 + k, at] for k, at in enumerate(chosen)]
    with pieces("block", url, path, "SIGKILL", instants) as (_, told):
        pass
    assert [met for met, _ in told] == [
        signal.SIGKILL if at < total else 0 for at in chosen
    ]
    # The receipt's renaming is what commits; what comes after it, if anything, may be lost.
    lost = [number for number, _ in instants if number not in committed(store)]
    assert lost == [1 + k for k in range(len(lost))]
    assert len(chosen) - 1 >= len(lost) >= len(chosen) - 4
    state = command("status", url, "--json")
    assert state.returncode == 0, state.stderr
    assert json.loads(state.stdout)["blocks_done"] == len(committed(store))
    before = len(committed(store))
    ran = command("run", path, "--store", url, "--json")
    assert (ran.returncode, complaints(ran)) == (0, [])
    told = json.loads(ran.stdout)
    assert told["computed_blocks"] == len(store.blocks) - before
    assert told["crashed"] == 0
    whole(url, pipeline, reference)
    print(f"killed at {len(chosen) - 1} of {total} instants of a block")


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:Object at zarr.*partial")  # left by a kill, and no fault
def test_kill_between_any_two_writes_of_closing_leaves_no_half_finished_store(
    small, tmp_path
):
    pipeline, path, reference = small
    folder = tmp_path / "closing"
    folder.mkdir()

    def complete(number):
        by_hand(str(folder / f"{number}.zarr"), pipeline, (4, 2, 10))

    complete(0)
    total = instants_of("closing", folder, path, 0)
    whole(str(folder / "0.zarr"), pipeline, reference)
    instants = [[1 + k, at] for k, at in enumerate(range(total + 1))]
    for number, _ in instants:
        complete(number)
    with pieces("closing", folder, path, "SIGKILL", instants):
        pass
    for number, at in instants:
        url = str(folder / f"{number}.zarr")
        if not open_store(url).finished:
            assert at < total
            instants_of("closing", folder, path, number)
        whole(url, pipeline, reference)


@pytest.mark.long
@lengths(2, ALL)
def test_kill_between_any_two_writes_of_a_new_store_leaves_all_or_none(
    count, small, tmp_path
):
    pipeline, path, _ = small
    folder = tmp_path / "creating"
    folder.mkdir()
    total = instants_of("creating", folder, path, 0)
    instants = [[1 + k, at] for k, at in enumerate(some(total, count))]
    with pieces("creating", folder, path, "SIGKILL", instants):
        pass
    for number, at in instants:
        url = folder / f"{number}.zarr"
        assert url.exists() or at < total
        if not url.exists():
            create_store(str(url), pipeline, (1, 1, 10))
        assert committed(open_store(str(url))) == set()


@pytest.mark.long
@pytest.mark.parametrize("count", [2, ALL])
def test_orphan_that_goes_on_after_an_overwrite_harms_nothing(count, small, cluster, tmp_path):
    pipeline, path, _ = small
    url = str(tmp_path / "small.zarr")
    create_store(url, pipeline, (1, 1, 1) if count == ALL else (1, 1, 5))
    total = instants_of("block", url, path, 0)
    chosen = some(total, count)[:-1]
    other_text = SMALL.replace("seed = 3", "seed = 4")
    other, other_path, reference = prepared(tmp_path, other_text, "other")
    instants = [[1 + k, at] for k, at in enumerate(chosen)]
    with pieces("block", url, path, "SIGSTOP", instants) as (running, told):
        assert {met for met, _ in told} == {signal.SIGSTOP}
        ran = command("run", other_path, "--store", url, "--overwrite",
                      "--scheduler", cluster.scheduler_address)
        assert (ran.returncode, complaints(ran)) == (0, [])
        whole(url, other, reference)
        running.stdin.write("go on\n")
        running.stdin.flush()
        assert running.stdout.readline(), running.stderr.read()
    whole(url, other, reference)
    print(f"stopped at {len(chosen)} of {total} instants of a block")


class Disk:
    """A file system of a given size in memory."""

    def __init__(self, path):
        self.path = path

    def remount(self, options):
        """Change its options; what is being written is given time to end."""
        deadline = time.monotonic() + 30
        while True:
            ran = subprocess.run(
                ["mount", "-o", f"remount,{options}", self.path], check=False, capture_output=True,
                text=True,
            )
            if ran.returncode == 0:
                return
            assert time.monotonic() < deadline, ran.stderr
            time.sleep(0.05)

    def leave(self, size):
        """Fill it until ``size`` bytes are left."""
        filler = self.path / "filler"
        filler.unlink(missing_ok=True)
        state = os.statvfs(self.path)
        if (fill := state.f_bavail * state.f_frsize - size) > 0:
            with filler.open("wb") as file:
                os.posix_fallocate(file.fileno(), 0, fill)

    def clear(self):
        """Take away what fills it."""
        (self.path / "filler").unlink(missing_ok=True)


PAGE = 4096


@pytest.fixture
def disk(tmp_path):
    """Give a disk of 1 MB; skip where mounting is not permitted."""
    path = tmp_path / "disk"
    path.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", path], check=False, capture_output=True,
        text=True,
    )
    if mounted.returncode != 0:
        pytest.skip(f"mounting is not permitted: {mounted.stderr.strip()}")
    try:
        yield Disk(path)
    finally:
        subprocess.run(["umount", "--lazy", path], check=True)


def told_in_a_line(ran, what, codes=(1,)):
    """Assert that a command failed, and said why in one line."""
    assert ran.returncode in codes, (ran.returncode, ran.stdout, ran.stderr)
    assert what in ran.stderr
    assert len(ran.stderr.strip().splitlines()) == 1, ran.stderr
    assert "Traceback" not in ran.stdout + ran.stderr


FULL = "No space left on device"


@pytest.mark.long
def test_run_on_a_full_disk_says_so_in_a_line_and_continues_when_there_is_room(
    small, disk, cluster, tmp_path
):
    pipeline, path, reference = small
    url = str(disk.path / "small.zarr")
    store = create_store(url, pipeline, (1, 1, 2))
    arguments = ("run", path, "--store", url, "--scheduler", cluster.scheduler_address)
    told_in_a_line(command(*arguments, cwd=tmp_path), FULL)
    done = len(committed(store))
    assert 0 < done < len(store.blocks)
    disk.remount("size=64m")
    ran = command(*arguments, "--json", cwd=tmp_path)
    assert (ran.returncode, complaints(ran)) == (0, [])
    assert json.loads(ran.stdout)["computed_blocks"] == len(store.blocks) - done
    whole(url, pipeline, reference)


@pytest.mark.long
def test_read_only_store_is_told_in_a_line_and_continued_when_it_can_be_written(
    small, disk, tmp_path
):
    pipeline, path, reference = small
    url = str(disk.path / "small.zarr")
    disk.remount("size=64m")
    store = create_store(url, pipeline, (2, 2, 10))
    compute_block(url, store.run_id, store.blocks[0])
    disk.remount("ro")
    arguments = ("run", path, "--store", url, "--workers", 2)
    told_in_a_line(command(*arguments, cwd=tmp_path), "Read-only file system", {1, 2})
    fresh = ("run", path, "--store", disk.path / "new.zarr", "--workers", 2)
    told_in_a_line(command(*fresh, cwd=tmp_path), "Read-only file system", {1, 2})
    disk.remount("rw")
    ran = command(*arguments, cwd=tmp_path)
    assert (ran.returncode, complaints(ran)) == (0, [])
    whole(url, pipeline, reference)


def test_new_store_on_a_full_disk_is_told_and_leaves_nothing(small, disk):
    pipeline, _, _ = small
    url = disk.path / "small.zarr"
    create_store(str(url), pipeline, (1, 1, 10))
    state = os.statvfs(disk.path)
    pages = state.f_blocks - state.f_bfree
    subprocess.run(["rm", "-r", url], check=True)
    for left in range(0, pages, 7):
        disk.leave(left * PAGE)
        with pytest.raises(StoreError, match=f"cannot be written: {FULL}"):
            create_store(str(url), pipeline, (1, 1, 10))
        assert [path.name for path in disk.path.iterdir()] == ["filler"]
    disk.clear()
    assert committed(create_store(str(url), pipeline, (1, 1, 10))) == set()


@pytest.mark.long
@pytest.mark.parametrize("blocks_done", ["some", "all"])
def test_disk_that_is_full_to_any_page_is_told_in_a_line(blocks_done, small, disk, tmp_path):
    """The lock, the marks, a block's variables, its receipt, and the closing: each hits the end."""
    pipeline, path, reference = small
    disk.remount("size=64m")
    arguments = ("run", path, "--workers", 2, "--store")
    failed = 0
    for left in itertools.chain(range(12), range(12, 90, 6)):
        url = str(disk.path / f"{left}.zarr")
        store = create_store(url, pipeline, (2, 2, 5))
        blocks = list(store.blocks)
        for block in blocks if blocks_done == "all" else blocks[:2]:
            compute_block(url, store.run_id, block)
        disk.leave(left * PAGE)
        ran = command(*arguments, url, cwd=tmp_path)
        if ran.returncode != 0:
            told_in_a_line(ran, FULL, {1, 2})
            failed += 1
        disk.clear()
        ran = command(*arguments, url, cwd=tmp_path)
        assert (ran.returncode, complaints(ran)) == (0, [])
        whole(url, pipeline, reference)
        subprocess.run(["rm", "-r", url], check=True)
    print(f"{failed} runs met a full disk")
    assert failed > 5
