"""What a run says of failures, what it tries again, and faults of machines, never data."""

import errno
import itertools
import os
import shutil
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
import zarr.storage._local as local
from distributed import Client

import sweep
from support import machine_faults
from support.clusters import local_cluster
from support.commands import pieces
from support.poison import Poison, poisoned
from support.stores import by_hand, same
from sweep.cli import main
from sweep.errors import MachineFaultError, RunError, StoreError
from sweep.execution.block_task import compute_block
from sweep.execution.on_cluster import OnCluster
from sweep.execution.runner import compute, execute
from sweep.execution.status import (
    Totals,
    account_of,
    close,
    failure_groups,
    poses_per_second,
    status,
)
from sweep.experiment.pipeline import Pipeline
from sweep.integrity.verification import verify
from sweep.isolation.child_process import Interrupts
from sweep.store.blocks import begin_block, committed
from sweep.store.lifecycle import create_store, open_store

TRACEBACK = """Traceback (most recent call last):
  File "a.py", line 3, in f
    raise ValueError("x")
    ^^^^^^^^^^^^^^^^^^^^^
{}
"""


def outcome(detection, estimate, cells):
    totals = Totals(detection=Counter(detection), estimate=Counter(estimate),
                    lost={"failed": cells, "crashed": []})
    pipeline = Pipeline.from_text("[pose]\njitter_px = 1\nside_px = 9\n[axes]\ntrial = 2")
    return account_of(SimpleNamespace(url="a b.zarr", pipeline=pipeline, blocks=[]), totals)


def lost_cell(message, at, kind="failed", stage="estimation"):
    return {"at": at, "kind": kind, "stage": stage, "text": TRACEBACK.format(message)}


def test_failures_are_grouped_by_exception_without_its_numbers_and_by_stage():
    cells = [
        lost_cell(
            f"ValueError: pose {n} at 0x7f{n:04x}: {n / 7} px\n  more lines: {n}", f"trial={n}")
        for n in range(9)
    ]
    cells += [lost_cell("ValueError: other", "trial=20"),
              lost_cell("ValueError: other", "trial=22", stage="detection")]
    cells += [{
        "at": "trial=23", "kind": "crashed", "stage": "scene", "text": "ended by SIGSEGV"}]
    found = [tuple(group[name] for name in ("count", "kind", "stage", "reason", "at"))
             for group in failure_groups(cells)]
    assert found == [
        (9, "failed", "estimation", "ValueError: pose 0 at 0x7f0000: 0.0 px", "trial=0"),
        (1, "failed", "estimation", "ValueError: other", "trial=20"),
        (1, "failed", "detection", "ValueError: other", "trial=22"),
        (1, "crashed", "scene", "ended by SIGSEGV", "trial=23"),
    ]


@pytest.mark.parametrize(
    ("detection", "estimate", "nothing", "share", "first"),
    [
        ({"detected": 40}, {"failed": 40}, True, 1.0, "nothing computed: all 40 estimates failed"),
        ({"failed": 30, "crashed": 10}, {"no_detection": 40}, True, 1.0,
         "nothing computed: all 40 detections failed or crashed"),
        ({"detected": 80, "crashed": 20}, {"solved": 80, "no_detection": 20}, False, 0.2,
         "warning: 20 crashed of 100 detections (20 %)"),
        ({"detected": 990, "failed": 10}, {"solved": 990, "no_detection": 10}, False, 0.01,
         "10 failed of 1,000 detections (1 %)"),
        ({"not_visible": 7}, {"no_detection": 7}, False, 0.0,
         "warning: nothing was detected: 7 not_visible (The marker is wholly outside"),
        ({"detected": 7}, {"solver_failed": 7}, False, 0.0,
         "warning: no pose was estimated: 7 solver_failed (The solver returned no solution"),
        ({"detected": 7}, {"solved": 7}, False, 0.0, None),
        ({"detected": 7}, {"not_explained": 7}, False, 0.0, None),
    ],
)
def test_what_failed_is_said_first_and_loudest(detection, estimate, nothing, share, first):
    cells = [lost_cell("E: 1", "trial=3")] if share else []
    found = outcome(detection, estimate, cells)
    assert (found["nothing_computed"], found["failed_share"]) == (nothing, pytest.approx(share))
    if first is None:
        assert (found["warnings"], found["advice"]) == ([], "")
        return
    assert found["warnings"][0].startswith(first)
    expected = "--at trial=3" if share else "--at trial=0 -o scene.png"
    assert found["advice"] == f"sweep repro 'a b.zarr' {expected}"


def blocks(workers, count, *, begin, took=2.0, scenes=100, lockstep=True):
    """Return blocks of workers that are always busy, from ``begin`` on."""
    shift = 0.0 if lockstep else took / workers
    return [
        (begin + took * (n // workers + 1) + shift * (n % workers), took, scenes)
        for n in range(count)
    ]


@pytest.mark.parametrize("lockstep", [True, False])
@pytest.mark.parametrize(("workers", "count"), [(1, 8), (2, 20), (1000, 9000)])
def test_rate_is_within_a_fifth_of_the_true_one_also_after_a_faster_run(workers, count, lockstep):
    run = blocks(workers, count, begin=5000.0, lockstep=lockstep)
    before = blocks(workers, count, begin=0.0, took=0.5, lockstep=lockstep)
    np.random.default_rng(0).shuffle(run)
    for written in (run, [*before, *run]):
        assert poses_per_second(written) == pytest.approx(workers * 100 / 2.0, rel=0.2)


RETRIED = """
seed = 3
pose = { jitter_px = 0.5, azimuth_deg = { uniform = [0, 360] } }
axes = { side_px = [30, 60, 90], solver = ["ippe_square", "iterative"], trial = 2 }
"""

EXTENTS = (1, 2)


@pytest.fixture(scope="module")
def pipeline():
    return Pipeline.from_text(RETRIED, name="retried")


@pytest.fixture(scope="module")
def clean(pipeline, tmp_path_factory):
    url = str(tmp_path_factory.mktemp("clean") / "clean.zarr")
    close(by_hand(url, pipeline, EXTENTS))
    return url


@pytest.fixture(scope="module")
def failed(pipeline, tmp_path_factory):
    """A finished store: of its three blocks two have cells that raised or ended their process."""
    folder = tmp_path_factory.mktemp("failed")
    url = str(folder / "failed.zarr")
    store = create_store(url, pipeline, EXTENTS)
    poisons = [Poison(1, "estimation", "raise", (), (("solver", "iterative"),)),
               Poison(4, "detection", "segv")]
    for number, block in enumerate(store.blocks):
        with pytest.MonkeyPatch.context() as patch:
            if number != 1:
                begin_block(store, block)  # so that it is computed in a child, which is poisoned
                for name, value in poisoned(poisons, folder / "notes").items():
                    patch.setenv(name, value)
            compute_block(url, store.run_id, block)
    close(store)
    return url


@pytest.fixture
def copied(failed, tmp_path):
    return shutil.copytree(failed, str(tmp_path / "copied.zarr"))


@pytest.mark.system
def test_retry_computes_what_failed_and_nothing_else(pipeline, clean, copied, capsys):
    before = status(copied)
    assert [len(before.failed), len(before.crashed)] == [1, 1]
    assert execute(pipeline, copied).computed_blocks == 0
    summary = execute(pipeline, copied, retry_failed=True)
    assert (summary.retried, summary.recovered, summary.computed_blocks) == (2, 2, 2)
    assert (summary.failures, summary.warnings) == ([], [])
    assert same(copied, clean)
    assert verify(copied, 0).damage == []
    assert main(["run", copied, "--retry-failed"]) == 0
    assert "no cell failed or crashed; nothing is tried again" in capsys.readouterr().out
    assert same(copied, clean)


@pytest.mark.evidence
def test_retry_that_is_killed_at_any_write_is_continued(pipeline, clean, failed, tmp_path):
    shutil.copytree(failed, tmp_path / "complete.zarr")
    (tmp_path / "retried.toml").write_text(RETRIED)
    count = pieces("dropping", tmp_path, tmp_path / "retried.toml")
    assert count >= 4  # a mark, two blocks, and the end
    for number in range(count + 1):
        url = str(tmp_path / f"{number}.zarr")
        store = open_store(url)
        assert committed(store) >= ({0, 1, 2} if store.finished else {1})
    execute(pipeline, url, retry_failed=True)
    assert same(url, clean)


@pytest.mark.system
def test_cells_that_failed_are_not_reused(pipeline, clean, failed, tmp_path):
    url = str(tmp_path / "grown.zarr")
    summary = execute(pipeline, url, reuse=[failed])
    assert (summary.failed, summary.crashed, summary.warnings) == (0, 0, [])
    # One estimate raised; a detection ended its process, and both its solvers went without.
    assert (summary.computed_scenes, summary.computed_estimates) == (2, 3)
    assert same(url, clean)


FAULTY = sweep.Pipeline.from_dict(
    {"seed": 5, "pose": {"side_px": 40, "jitter_px": 0.5},
     "axes": {"solver": ["ippe_square", "iterative"], "trial": 12}}
)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    url = str(tmp_path_factory.mktemp("undisturbed") / "whole.zarr")
    by_hand(url, FAULTY)
    return url


def run_on(client, url):
    """Run the pipeline in blocks of one scene; return how many scenes failed."""
    store = create_store(str(url), FAULTY, (1,))
    with Interrupts() as interrupts:
        compute(store, OnCluster(client), (), 600.0, interrupts)
    counts = open_store(str(url)).run_metadata["counts"]
    return sum(counts[flags].get("failed", 0) for flags in ("detection", "estimate"))


@pytest.mark.parametrize(("fault", "place"), [
    ("disk", "render_all"), ("passing", "render_all"), ("disk", "set"),  # the last in the store
])
def test_block_that_a_machine_failed_is_not_committed(fault, place, tmp_path):
    store = create_store(str(tmp_path / "faulty.zarr"), FAULTY, (12,))
    machine_faults.inject(fault, place, 0)
    try:
        with pytest.raises(MachineFaultError) as raised:
            compute_block(store.url, store.run_id, store.blocks[0])
    finally:
        machine_faults.clear()
    assert len(str(raised.value).splitlines()) == 1
    assert committed(store) == set()


@pytest.mark.parametrize("room", [0, 3, 9])
def test_new_store_on_a_full_disk_is_told_and_leaves_nothing(room, tmp_path, monkeypatch):
    """A disk with room for so many files."""
    left, put = itertools.count(room, -1), local._put

    def put_while_there_is_room(*arguments, **options):
        if next(left) <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return put(*arguments, **options)

    monkeypatch.setattr(local, "_put", put_while_there_is_room)
    with pytest.raises(StoreError, match="cannot be written: No space left on device"):
        create_store(str(tmp_path / "full.zarr"), FAULTY, (12,))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.system
def test_blocks_of_a_worker_whose_machine_is_at_fault_are_computed_by_others(
    tmp_path, undisturbed, capfd
):
    url = tmp_path / "one.zarr"
    with local_cluster(2) as cluster, Client(cluster, set_as_default=False) as client:
        faulty, _ = client.nthreads()
        client.run(machine_faults.inject, "disk", "render_all", 0, workers=[faulty])
        assert run_on(client, url) == 0
        assert same(url, undisturbed)
        (line,) = capfd.readouterr().err.splitlines()
        assert line.startswith(f"worker {faulty}: machine fault on ")
        assert "No space left on device" in line
        # Nobody is left to whom its blocks could be given.
        client.run(machine_faults.clear, workers=[faulty])
        client.run(machine_faults.inject, "memory", "render_all", 0)
        with pytest.raises(RunError) as raised:
            run_on(client, tmp_path / "none.zarr")
    (line,) = str(raised.value).splitlines()
    assert "machine fault on " in line
    assert "MemoryError" in line
