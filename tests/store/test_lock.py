"""Who may write, change, close and delete a store while other processes do."""

import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from sweep.errors import StoreError
from sweep.execution.runner import execute
from sweep.execution.status import drop_failed, status
from sweep.experiment.pipeline import Pipeline
from sweep.store import lock as locks
from sweep.store.lifecycle import create_store, open_store, remove_store
from sweep.store.lock import changing, closing, is_written, writing

TEXT = "axes.trial = 4\n[pose]\njitter_px = 0.5\nside_px = 40"


@pytest.fixture
def pipeline():
    return Pipeline.from_text(TEXT, name="held")


@pytest.fixture
def store(pipeline, tmp_path, monkeypatch):
    monkeypatch.setattr(locks, "WAIT_S", 0.05)
    return create_store(str(tmp_path / "held.zarr"), pipeline, (2,))


def test_writers_exclude_nobody_who_writes_and_refuse_all_changes(store, pipeline):
    with writing(store.url, store.storage), writing(store.url, store.storage):
        assert status(store.url).being_written
        with closing(store.url, store.storage):
            pass
        for change in (
            lambda: remove_store(store.url), lambda: drop_failed(store),
            lambda: execute(pipeline, store.url, overwrite=True),
        ):
            with pytest.raises(StoreError, match="is writing it"):
                change()
        assert open_store(store.url).run_id == store.run_id
    assert not status(store.url).being_written
    remove_store(store.url)
    assert list(Path(store.url).parent.iterdir()) == []


def test_one_process_changes_a_store_and_others_are_refused(store):
    with changing(store.url, store.storage):
        assert is_written(store.storage)
        for other in (writing, changing):
            with pytest.raises(StoreError, match="is writing it"), other(store.url, store.storage):
                pass


def test_a_store_is_closed_by_one_process_after_another(store):
    held, order = threading.Event(), []

    def first():
        with closing(store.url, store.storage):
            held.set()
            time.sleep(0.1)
            order.append("first")

    thread = threading.Thread(target=first)
    thread.start()
    held.wait()
    with closing(store.url, store.storage):
        order.append("second")
    thread.join()
    assert order == ["first", "second"]


def test_the_lock_of_a_process_that_was_killed_is_free_at_once(store):
    script = (
        "import sys, time; from sweep.store.lifecycle import open_store; "
        "from sweep.store.lock import writing; store = open_store(sys.argv[1], 'r+'); "
        "held = writing(store.url, store.storage); held.__enter__(); print('held', flush=True); "
        "time.sleep(60)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script, store.url], stdout=subprocess.PIPE, text=True
    ) as writer:
        assert writer.stdout.readline() == "held\n"
        assert is_written(store.storage)
        writer.kill()
        writer.wait()
    with changing(store.url, store.storage):
        pass


def test_where_folders_cannot_be_locked_nobody_is_excluded(store, monkeypatch):
    def refused(*_):
        raise OSError("not supported")

    monkeypatch.setattr("sweep.store.lock.fcntl.flock", refused)
    with changing(store.url, store.storage), writing(store.url, store.storage):
        assert not is_written(store.storage)
    assert any(Path(store.url).iterdir())
