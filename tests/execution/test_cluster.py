"""The cluster of a run: embedded, on the loopback interface alone and quiet, or the caller's."""

import contextlib
import logging
import socket
import time

import psutil
import pytest
from distributed import Client, LocalCluster

import sweep
from sweep.errors import ArgumentError
from sweep.execution import cluster as clusters
from sweep.execution.cluster import borrowed, embedded
from sweep.execution.runner import execute

PIPELINE = sweep.Pipeline.from_dict(
    {"pose": {"side_px": 40, "jitter_px": 0.5}, "axes": {"trial": 40}}
)


def test_embedded_cluster_listens_on_loopback_only_and_needs_no_certain_port(capfd):
    # Dask's usual port for its page is taken, as by another run.
    with socket.socket() as taken:
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            taken.bind(("127.0.0.1", 8787))
            taken.listen()
        except OSError:
            pass  # by someone else, which is as good
        with embedded(1) as client:
            me = psutil.Process()
            addresses = {
                connection.laddr.ip
                for process in (me, *me.children(recursive=True))
                for connection in process.net_connections(kind="inet")
                if connection.status == psutil.CONN_LISTEN
            }
            assert client.submit(sum, [1, 2]).result() == 3
    assert addresses == {"127.0.0.1"}
    told = capfd.readouterr()
    assert told.out == told.err == ""


@contextlib.contextmanager
def local_cluster(workers=1, **options):
    with LocalCluster(
        n_workers=workers, threads_per_worker=1, host="127.0.0.1",
        dashboard_address="127.0.0.1:0", silence_logs=logging.CRITICAL, **options,
    ) as cluster:
        yield cluster


def refusal(client):
    with pytest.raises(ArgumentError) as raised, borrowed(client, PIPELINE):
        pass
    return str(raised.value)


def test_clients_and_clusters_that_cannot_be_used_are_refused_in_a_line(monkeypatch):
    monkeypatch.setattr(clusters, "NO_WORKERS_TIMEOUT_S", 0.5)
    with local_cluster(0) as cluster:
        assert refusal(cluster) == (
            f"client = LocalCluster({cluster.scheduler_address}): no workers within 0 s; start some"
        )
        client = Client(cluster, set_as_default=False)
        address = cluster.scheduler_address
        client.close()
        assert refusal(client) == "client = Client(None): it is closed"
    assert refusal(cluster).startswith("client = LocalCluster(")
    for given in (address, 3, object()):
        assert "expected a distributed.Client or a cluster object" in refusal(given)


def test_workers_that_are_threads_of_the_caller_are_refused():
    # A scene that crashes, and the time limit, end the process of a worker.
    with local_cluster(1, processes=False, protocol="tcp://") as cluster:
        assert "its workers are threads of this process" in refusal(cluster)


def test_run_that_is_stopped_takes_its_blocks_back_from_the_callers_client(tmp_path):
    def stop(progress):
        if progress.done:
            raise KeyboardInterrupt

    with local_cluster() as cluster, Client(cluster, set_as_default=False) as client:
        with pytest.raises(KeyboardInterrupt):
            execute(
                PIPELINE, tmp_path / "stopped.zarr", client=client, block_s=1e-6, progress=stop
            )
        deadline = time.monotonic() + 30
        while client.run_on_scheduler(lambda dask_scheduler: len(dask_scheduler.tasks)):
            assert time.monotonic() < deadline
            time.sleep(0.05)
        results = sweep.run(PIPELINE, store=tmp_path / "stopped.zarr", client=client)
        assert (results.detection == 1).all()


@pytest.mark.long
def test_cluster_that_adapts_starts_a_worker_for_a_run(tmp_path):
    with local_cluster(0) as cluster:
        cluster.adapt(minimum=0, maximum=2, interval="200ms")
        results = sweep.run(PIPELINE, store=tmp_path / "adapted.zarr", client=cluster)
        assert (results.detection == 1).all()
