"""`--durable`: after a power failure at any instant, what was committed is there, whole."""

import random
import shutil
from pathlib import Path

import pytest

from support.lengths import lengths
from support.power import Recorded
from support.stores import by_hand, same
from sweep.execution.block_task import compute_block
from sweep.execution.finalize import close
from sweep.execution.runner import execute
from sweep.execution.status import status
from sweep.integrity.verification import verify
from sweep.plan.experiment import Pipeline
from sweep.store.blocks import committed
from sweep.store.lifecycle import create_store, open_store
from sweep.store.lock import KEY, locked

SEED = 8

TEXT = """
seed = 3
[pose]
side_px = 40
jitter_px = 0.5
[axes]
solver = ["ippe_square", "iterative"]
tilt_deg = [0, 30]
trial = 2
"""

EXTENTS = (1, 1)
"""Four blocks."""


@pytest.fixture(scope="module")
def pipeline():
    return Pipeline.from_text(TEXT, name="power")


def work(folder, pipeline, *, durable):
    """Make a store, compute its blocks and close it, as a run does."""
    url = str(folder / "power.zarr")
    store = create_store(url, pipeline, EXTENTS, durable=durable)
    with locked(store):
        for block in store.blocks:
            compute_block(url, store.run_id, block, durable=durable)
        close(store)


@pytest.fixture(scope="module")
def recorded(pipeline, tmp_path_factory):
    """What a durable run and another one do to the disk, and the finished store."""
    both, patch = {}, pytest.MonkeyPatch()
    by_hand(str(tmp_path_factory.mktemp("warm") / "warm.zarr"), pipeline, EXTENTS)
    for durable in (True, False):
        disk = tmp_path_factory.mktemp("disk")
        both[durable] = Recorded(disk)
        with both[durable].recording(patch):
            work(disk, pipeline, durable=durable)
    return both


def receipts_of(disk):
    """Return when each receipt got its name, in the order of the blocks."""
    return [k for k, event in enumerate(disk.events)
            if event[0] == "move" and "/receipt/c/" in event[2]]


def sound_blocks(url):
    """Return how many blocks a store has; assert that they are whole.

    Closing a store that was interrupted is repeated, whatever it left.
    """
    found = verify(url, 0)
    assert [damage for damage in found.damage if found.finished or damage.block is not None] == []
    return found.blocks_done


@pytest.mark.long
@lengths(2, 150)
def test_nothing_committed_is_lost_and_the_same_store_comes_about(
    count, recorded, tmp_path
):
    disk = recorded[True]
    draw = random.Random(SEED)
    total = len(disk.events)
    seen, receipts = set(), receipts_of(disk)
    # A receipt counts when the folders that lead to it are flushed.
    counted = [next(k for k, event in enumerate(disk.events)
                    if event == ("flush", "power.zarr/commits/receipt/c") and k > receipt) + 4
               for receipt in receipts]
    # From the beginning, in the midst, where a receipt was just flushed, and at the end.
    instants = [counted[1], total]
    instants += [draw.randrange(total + 1) for _ in range(count - len(instants))]
    for k, instant in enumerate(instants):
        left = tmp_path / f"{k}"
        disk.make_state(instant, left, draw)
        url = str(left / "power.zarr")
        if (left / "power.zarr").exists():
            done = sound_blocks(url)
            assert done >= sum(flushed < instant for flushed in counted)
            seen.add(done)
            (left / "power.zarr" / KEY).unlink(missing_ok=True)  # of the boot before
            store = open_store(url, "r+")
            with locked(store):
                for number in set(range(4)) - committed(store):
                    compute_block(url, store.run_id, store.blocks[number])
                if not store.finished:
                    close(store)
            assert status(url).finished
            assert count == 2 or verify(url, 0).damage == []
            assert same(url, str(disk.folder / "power.zarr"))
        else:
            assert instant < receipts[0]
        shutil.rmtree(left)
    assert 4 in seen
    print(f"seed {SEED}: {len(instants)} instants of {total}; committed blocks: {sorted(seen)}")


@pytest.mark.long
def test_every_receipt_is_preceded_by_flushes_of_all_that_it_speaks_of(recorded):
    events = recorded[True].events
    for at in receipts_of(recorded[True]):
        flushed = {event[1] for event in events[:at] if event[0] == "flush"}
        for kind, *paths in events[:at]:
            if kind == "move" and "power.zarr/" in paths[1] and "/c/" in paths[1]:
                assert set(paths[:2]) & flushed
                assert Path(paths[1]).parent.as_posix() in flushed
        assert events[at][1] in flushed  # before it gets its name
        assert ("flush", "power.zarr/commits/receipt/c") in events[at : at + 8]
    assert not any(event[0] == "flush" for event in recorded[False].events)


@pytest.mark.long
def test_without_it_a_power_failure_does_harm(recorded, tmp_path):
    disk, draw, harmed = recorded[False], random.Random(SEED), 0
    for k in range(60):
        disk.make_state(len(disk.events), tmp_path / str(k), draw)
        try:
            sound = status(str(tmp_path / str(k) / "power.zarr")).blocks_done == 4 and (
                verify(str(tmp_path / str(k) / "power.zarr"), 0).damage == []
            )
        except Exception:
            sound = False
        harmed += not sound
    assert harmed > 50


@pytest.mark.long
def test_durable_run_gives_the_same_store(recorded, pipeline, tmp_path, monkeypatch):
    url = tmp_path / "power.zarr"
    disk = Recorded(tmp_path)
    with disk.recording(monkeypatch):
        execute(pipeline, url, durable=True)
    assert same(str(url), str(recorded[True].folder / "power.zarr"))
    assert any(event[0] == "flush" for event in disk.events)
