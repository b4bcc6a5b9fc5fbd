"""A machine's fault is never data: its blocks are computed elsewhere, or the run says so."""

import contextlib

import pytest
from distributed import Client

import sweep
from support import machine_faults
from support.clusters import local_cluster
from support.stores import by_hand, same
from sweep.errors import MachineFaultError, RunError
from sweep.execution.block_task import compute_block
from sweep.execution.on_cluster import OnCluster
from sweep.execution.progress import Tally
from sweep.execution.runner import compute
from sweep.execution.status import close
from sweep.execution.waves import AnyOrder
from sweep.isolation.child_process import Interrupts
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.store.blocks import committed
from sweep.store.lifecycle import create_store, open_store
from sweep.store.locations import exists
from sweep.store.lock import writing

PIPELINE = sweep.Pipeline.from_dict(
    {"seed": 5, "pose": {"side_px": 40, "jitter_px": 0.5},
     "axes": {"solver": ["ippe_square", "iterative"], "trial": 12}}
)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    url = str(tmp_path_factory.mktemp("undisturbed") / "whole.zarr")
    by_hand(url, PIPELINE)
    return url


@contextlib.contextmanager
def workers():
    with local_cluster(2) as cluster, Client(cluster, set_as_default=False) as client:
        yield client


def run_on(client, url):
    """Run the pipeline in blocks of one scene, or continue; return how many scenes failed."""
    store = open_store(str(url), "r+") if exists(str(url)) else create_store(
        str(url), PIPELINE, (1,)
    )
    done = committed(store)
    waiting = AnyOrder(number for number in range(len(store.blocks)) if number not in done)
    with writing(store.url, store.storage), Interrupts() as interrupts:
        tally = Tally(store, waiting)
        tally.begin(done)
        compute(store, waiting, tally, OnCluster(client), (), 600.0, interrupts)
        close(store)
    counts = open_store(str(url)).run_metadata["counts"]
    return counts["detection"][DetectionStatus.failed] + counts["estimate"][EstimateStatus.failed]


@pytest.mark.parametrize(("fault", "place"), [
    ("disk", "render_all"), ("passing", "render_all"), ("disk", "set"),  # the last in the store
])
def test_block_that_a_machine_failed_is_not_committed(fault, place, tmp_path):
    store = create_store(str(tmp_path / "faulty.zarr"), PIPELINE, (12,))
    machine_faults.inject(fault, place, 0)
    try:
        with pytest.raises(MachineFaultError) as raised:
            compute_block(store.url, store.run_id, store.blocks[0])
    finally:
        machine_faults.clear()
    assert len(str(raised.value).splitlines()) == 1
    assert committed(store) == set()


@pytest.mark.system
def test_blocks_of_a_worker_whose_machine_is_at_fault_are_computed_by_others(
    tmp_path, undisturbed, capfd
):
    url = tmp_path / "one.zarr"
    with workers() as client:
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
