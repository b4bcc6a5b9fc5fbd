"""The lock of a store: one holder at a time, whoever races for it; stale locks are replaced."""

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from support.lengths import lengths
from sweep.errors import StoreError
from sweep.execution import runner
from sweep.execution.calibration import Calibration
from sweep.execution.status import status
from sweep.plan.pipeline import Pipeline
from sweep.store import lock as locks
from sweep.store.lifecycle import create_store, open_store, remove_store
from sweep.store.locations import open_storage
from sweep.store.lock import KEY, LockFile, hold, holder, locked, refuse_if_held

RACERS = Path(__file__).parents[1] / "support" / "poisoned" / "racers.py"

TEXT = "axes.trial = 4\n[pose]\njitter_px = 0.5\nside_px = 40"


@pytest.fixture
def pipeline():
    return Pipeline.from_text(TEXT, name="held")


@pytest.fixture
def store(pipeline, tmp_path):
    return create_store(str(tmp_path / "held.zarr"), pipeline, (2,))


@pytest.fixture
def quickly(monkeypatch):
    """Watch a lock for 0.3 s, with a heartbeat much more often."""
    monkeypatch.setattr(locks, "SILENCE_S", 0.3)
    monkeypatch.setattr(locks, "BEAT_S", 0.05)
    monkeypatch.setattr(locks, "WATCH_S", 0.02)


def lock_of(store):
    return json.loads(Path(store.url, KEY).read_text())


def put_lock(store, **changes):
    """Write a lock of this process, with changes; None takes a key away."""
    content = json.loads(locks._content("theirs")) | changes
    content = {key: value for key, value in content.items() if value is not None}
    Path(store.url, KEY).write_text(json.dumps(content))


def ended_process():
    with subprocess.Popen([sys.executable, "-S", "-c", ""]) as ended:
        pass
    return ended.pid


@lengths(8, 1000)
@pytest.mark.parametrize("finds", ["nothing", pytest.param("dead", marks=pytest.mark.long)])
def test_of_processes_that_race_for_a_lock_exactly_one_holds_it(count, finds, store):
    ran = subprocess.run(
        [sys.executable, RACERS, store.url, "3", str(count), finds], capture_output=True,
        text=True, check=True, timeout=240,
    )
    assert json.loads(ran.stdout) == {"1": count}
    print(f"{count} races of 3 processes, {finds} found: holders {ran.stdout.strip()}")


def test_of_those_who_find_the_same_stale_lock_exactly_one_replaces_it(store):
    put_lock(store, pid=ended_process())
    file = LockFile(store.storage, KEY)
    stale = file.read()
    got, start = [], threading.Barrier(4)

    def race(number):
        start.wait()
        if LockFile(open_storage(store.url, "r+"), KEY).exchange(stale, b"%d" % number):
            got.append(b"%d" % number)

    for _ in range(20):
        threads = [threading.Thread(target=race, args=(k,)) for k in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert [file.read()] == got
        assert file.exchange(got.pop(), stale)
    assert not file.exchange(None, b"new")
    assert not file.exchange(b"other", b"new")


def test_where_folders_cannot_be_locked_a_file_is_linked_and_read_again(store, monkeypatch):
    def refused(*_):
        raise OSError("not supported")

    monkeypatch.setattr("sweep.store.lock.fcntl.flock", refused)
    monkeypatch.setattr("sweep.store.lock.SETTLE_S", 0.01)
    file = LockFile(store.storage, KEY)
    assert file.exchange(None, b"one")
    assert not file.exchange(None, b"two")
    assert file.exchange(b"one", b"two")
    assert file.exchange(b"two", None)
    assert file.read() is None


@pytest.mark.parametrize("changes", [
    {"pid": "ended"}, {"started": "1"}, {"clock": -60.0}, {"clock": 1e9},
], ids=["dead", "reused pid", "silent", "clock of the future"])
def test_lock_that_is_known_to_be_stale_is_replaced_at_once(changes, store):
    if "pid" in changes:
        changes = changes | {"pid": ended_process()}
    if changes.get("clock") == -60.0:
        changes = {"clock": time.monotonic() - 60.0}
    put_lock(store, **changes)
    assert holder(store.storage) is None
    begun = time.monotonic()
    with locked(store):
        assert lock_of(store)["pid"] == os.getpid()
    assert time.monotonic() < begun + 1.0
    assert not Path(store.url, KEY).exists()


def test_lock_of_a_living_process_is_refused_at_once(store):
    put_lock(store)
    with pytest.raises(StoreError, match=f"process {os.getpid()} on .* is writing it"):
        refuse_if_held(store.url, store.storage)
    assert status(store.url).writer is not None


ELSEWHERE = {
    "another machine": {"host": "elsewhere", "boot": "b"},
    "container of the same host name": {"namespace": 1, "pid": 10**6},
    "same host before it was booted again": {"boot": "a"},
}


@pytest.mark.usefixtures("quickly")
@pytest.mark.parametrize(
    ("changes", "offset_s"), list(zip(ELSEWHERE.values(), (-1e6, 1e6, 0), strict=True)),
    ids=ELSEWHERE,
)
def test_lock_of_elsewhere_is_judged_by_whether_it_changes_not_by_clocks(
    changes, offset_s, store, capsys
):
    done = threading.Event()

    def beat():
        while not done.wait(0.05):
            put_lock(store, **changes, beat=time.time() + offset_s)

    put_lock(store, **changes, beat=time.time() + offset_s)
    beating = threading.Thread(target=beat)
    beating.start()
    try:
        with pytest.raises(StoreError, match="is writing it"), locked(store):
            pass
    finally:
        done.set()
        beating.join()
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "watching its lock for up to" in said
    begun = time.monotonic()
    refuse_if_held(store.url, store.storage)
    assert 0.2 < time.monotonic() - begun < 2.0
    # What was watched once is not watched again.
    begun = time.monotonic()
    with locked(store):
        assert lock_of(store)["pid"] == os.getpid()
    assert time.monotonic() - begun < 0.2


@pytest.mark.usefixtures("quickly")
def test_writer_renews_its_lock(store):
    with locked(store) as lock:
        before = lock_of(store)
        time.sleep(0.2)
        after = lock_of(store)
        lock.check()
    assert before["clock"] < after["clock"]
    assert {**before, "clock": 0, "beat": 0} == {**after, "clock": 0, "beat": 0}


@pytest.mark.usefixtures("quickly")
def test_writer_that_was_stopped_notices_that_its_lock_was_taken_over(store):
    with locked(store) as lock:
        numbers = lock.checked(range(9))
        assert next(numbers) == 0
        theirs = {**lock_of(store), "token": "another"}
        Path(store.url, KEY).write_text(json.dumps(theirs))
        time.sleep(0.15)
        for _ in range(2):
            with pytest.raises(StoreError, match="another process took over its lock"):
                lock.check()
        with pytest.raises(StoreError, match="another process took over its lock"):
            next(numbers)
    assert lock_of(store) == theirs


def test_stopped_writer_checks_its_lock_before_it_closes_the_store(store):
    with locked(store) as lock:
        Path(store.url, KEY).unlink()
        lock.check()  # no heartbeat was missed yet
        with pytest.raises(StoreError, match="another process took over its lock"):
            lock.check(now=True)


@pytest.mark.long
def test_writer_that_is_stopped_for_long_loses_its_lock_to_another_process(store):
    script = (
        "import sys, time\nfrom sweep.store import lock\n"
        "from sweep.store.lifecycle import open_store\nlock.BEAT_S = 0.1\n"
        "with lock.locked(open_store(sys.argv[1], 'r+')) as held:\n"
        "    print('held', flush=True)\n    sys.stdin.readline()\n    held.check(now=True)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script, store.url], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True,
    ) as writer:
        assert writer.stdout.readline() == "held\n"
        with pytest.raises(StoreError, match=f"process {writer.pid} on"):
            refuse_if_held(store.url, store.storage)
        writer.send_signal(signal.SIGSTOP)
        deadline = time.monotonic() + locks.SILENCE_S + 10
        while True:
            try:
                held = locked(store)
                held.__enter__()
                break
            except StoreError:
                assert time.monotonic() < deadline
                time.sleep(0.5)
        writer.send_signal(signal.SIGCONT)
        _, said = writer.communicate("go on\n", timeout=30)
        assert "another process took over its lock" in said
        assert lock_of(store)["pid"] == os.getpid()
        held.__exit__(None, None, None)


def test_copied_lock_locks_nothing_for_ever(store, tmp_path, quickly):
    del quickly
    with locked(store):
        copy = Path(shutil.copytree(store.url, tmp_path / "copy.zarr"))
        time.sleep(0.4)
        refuse_if_held(str(copy), open_storage(str(copy), "r+"))
        with pytest.raises(StoreError, match="is writing it"):
            refuse_if_held(store.url, store.storage)


def test_store_that_another_process_began_to_write_meanwhile_is_not_removed(pipeline, store):
    with (
        hold(store.url, open_storage(store.url, "r+")),
        pytest.raises(StoreError, match=f"process {os.getpid()} on .* is writing it"),
    ):
        remove_store(store.url)
    assert open_store(store.url).run_id == store.run_id
    # As a run with --overwrite does, long after it was asked for.
    with (
        hold(store.url, open_storage(store.url, "r+")),
        pytest.raises(StoreError, match="is writing it"),
    ):
        runner._new_store(
            store.url, pipeline, Calibration(0.001, 0.0, 1, (0.0,)), None, None, 600.0,
            overwrite=True,
        )
    assert open_store(store.url).run_id == store.run_id
    remove_store(store.url)
    assert list(Path(store.url).parent.iterdir()) == []
