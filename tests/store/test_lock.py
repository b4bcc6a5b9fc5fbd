"""Who may write, change, close and delete a store, and files that are whole or not there."""

import errno
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest import mock

import pytest
from zarr.storage import MemoryStore

from sweep.errors import StoreError
from sweep.execution.runner import compute, execute
from sweep.execution.status import status
from sweep.experiment.pipeline import Pipeline
from sweep.store import lock as locks
from sweep.store.files import files_in, write_files
from sweep.store.lifecycle import create_store, open_store, remove_store, reopen
from sweep.store.lock import changing, is_written, writing

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
        for change in (
            lambda: remove_store(store.url), lambda: reopen(store),
            lambda: execute(pipeline, store.url, overwrite=True),
        ):
            with pytest.raises(StoreError, match="is writing it"):
                change()
        with pytest.raises(StoreError, match="another process has made it meanwhile"):
            create_store(store.url, pipeline, (4,))
        assert open_store(store.url).run_id == store.run_id
    assert not status(store.url).being_written
    remove_store(store.url)
    assert list(Path(store.url).parent.iterdir()) == []


def test_a_run_that_another_rule_of_stopping_has_overtaken_changes_nothing(tmp_path):
    rules = (f"[search]\nmax_trials = 100\nprecision.detection_rate = {w}" for w in (0.2, 0.1))
    loose, strict = (Pipeline.from_text(
        TEXT.partition("\n")[2] + "\n" + rule, name="held") for rule in rules)
    begun = create_store(str(tmp_path / "held.zarr"), loose, (50,))
    reopen(open_store(begun.url, "r+"), strict)
    for late in lambda: reopen(begun), lambda: compute(begun, None, (), 1.0, None):
        with pytest.raises(StoreError, match="another run has changed when its sampling stops"):
            late()
    assert open_store(begun.url).pipeline.stopping == strict.stopping


def test_the_key_of_a_process_that_was_killed_is_free_after_a_while():
    storage, dead = MemoryStore(), f"{locks.CHANGE}dead"  # as on an object store: no folder
    write_files(storage, {dead: str(time.time()).encode()})
    assert is_written(storage)
    write_files(storage, {dead: str(time.time() - locks.SILENCE_S).encode()})
    with changing("s3://a", storage):
        for other in (writing, changing):
            with pytest.raises(StoreError, match="is writing it"), other("s3://a", storage):
                pass
    assert set(files_in(storage)) <= {dead}


def test_of_many_changes_of_an_object_store_at_once_one_at_most_is_inside():
    storage, inside, most, refused = MemoryStore(), [], [], []

    def change(number):
        try:
            with changing("s3://a", storage):
                inside.append(number)
                most.append(len(inside))
                time.sleep(0.01)
                inside.remove(number)
        except StoreError:
            refused.append(number)

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(change, range(40)))
    assert max(most, default=1) == 1
    assert len(most) + len(refused) == 40


def test_where_folders_cannot_be_locked_a_line_says_so(store, monkeypatch, capsys):
    monkeypatch.setattr(
        "sweep.store.lock.fcntl.flock", mock.Mock(side_effect=OSError(errno.ENOLCK, "none")))
    with changing(store.url, store.storage):
        assert not is_written(store.storage)
    assert capsys.readouterr().err.endswith("no locks: keep others from deleting the store\n")
