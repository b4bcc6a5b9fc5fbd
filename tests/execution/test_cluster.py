"""The cluster of a run: embedded, on the loopback interface alone and quiet, or the caller's."""

import contextlib
import logging
import os
import signal
import socket
import subprocess
import sys
import time

import psutil
import pytest
from distributed import Client, LocalCluster

import sweep
from support.commands import started
from sweep.errors import ArgumentError, RunError
from sweep.execution import cluster as clusters
from sweep.execution import cluster as worker_versions
from sweep.execution import on_cluster
from sweep.execution.cluster import WorkerState, borrowed, embedded
from sweep.execution.on_cluster import OnCluster
from sweep.execution.runner import execute
from sweep.experiment.pipeline import Pipeline
from sweep.isolation.child_process import Interrupts
from sweep.store.lifecycle import create_store, open_store
from sweep.store.provenance import fingerprint

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


def test_cluster_that_cannot_start_is_told_in_a_line(monkeypatch):
    def refuse(**_):
        raise RuntimeError("Cluster failed to start") from OSError(24, "Too many open files")

    monkeypatch.setattr(clusters, "LocalCluster", refuse)
    with pytest.raises(RunError) as raised, embedded(3):
        pass
    assert str(raised.value) == (
        "3 worker processes cannot be started: OSError: [Errno 24] Too many open files"
    )


MASK = "import signal; print(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, []))"


def test_ctrl_c_while_workers_start_reaches_this_process_and_none_of_them():
    with Interrupts() as interrupts:
        with clusters._interrupts_held_back():
            os.kill(os.getpid(), signal.SIGINT)
            child = subprocess.run([sys.executable, "-c", MASK], capture_output=True, check=True)
        assert child.stdout == b"True\n"
        with pytest.raises(KeyboardInterrupt):
            interrupts.check()


@pytest.mark.long
def test_process_ends_quietly_without_its_scheduler_and_where_ctrl_c_is_ignored(tmp_path):
    """Workers end with their client, whatever signals it inherited; nothing stands below its line.
    """
    (tmp_path / "long.toml").write_text(
        "[pose]\njitter_px = 0.5\nside_px = 50\n[axes]\ntrial = 40000\n")
    create_store(str(tmp_path / "runs" / "long.zarr"), Pipeline.from_toml(tmp_path / "long.toml"),
                 (500,))
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # as of `nohup`
    try:
        with local_cluster() as cluster, started(
            ["-m", "sweep", "run", "long.toml", "--scheduler", cluster.scheduler_address],
            stderr=subprocess.PIPE, text=True, cwd=tmp_path,
        ) as lost, started(
            ["-m", "sweep", "run", "long.toml", "--store", "own.zarr", "--workers", 2],
            stderr=subprocess.PIPE, text=True, cwd=tmp_path,
        ) as own:
            deadline = time.monotonic() + 120
            while not (any(tmp_path.glob("runs/long.zarr/commits/receipt/c/*"))
                       and any(tmp_path.glob("own.zarr/commits/receipt/c/*"))):
                assert time.monotonic() < deadline
                time.sleep(0.1)
            workers = psutil.Process(own.pid).children(recursive=True)
            own.send_signal(signal.SIGINT)
            own.terminate()
            assert own.wait(timeout=30) == -signal.SIGTERM
            psutil.wait_procs(workers, timeout=60)
            assert not any(worker.is_running() for worker in workers)
            cluster.close()
            assert lost.wait(timeout=60) == 1
            (*_, line) = lost.stderr.read().splitlines()
    finally:
        signal.signal(signal.SIGINT, before)
    assert line == "the scheduler went away; run it again to continue"


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
    assert refusal(cluster) == f"client = LocalCluster({address}): it is closed"
    for given in (address, 3, object()):
        assert "expected a distributed.Client or a cluster object" in refusal(given)


def test_workers_that_are_threads_of_the_caller_are_refused():
    # A scene that crashes, and the time limit, end the process of a worker.
    with local_cluster(1, processes=False, protocol="tcp://") as cluster:
        assert "its workers are threads of this process" in refusal(cluster)


def test_workers_with_other_versions_are_refused(tmp_path, monkeypatch):
    async def elsewhere(_, given):
        return {"tcp://worker": worker_versions.WorkerIdentity(
            {**fingerprint(given), "opencv": "0.0"}, ("elsewhere", 1), [], "AVX2")}

    monkeypatch.setattr(worker_versions, "_worker_identities", elsewhere)
    with local_cluster(1, processes=False, protocol="tcp://") as cluster:
        for given in ({"scheduler": cluster.scheduler_address}, {"client": cluster}):
            with pytest.raises(ArgumentError, match=r"tcp://worker: opencv 0\.0, here"):
                execute(PIPELINE, tmp_path / "other.zarr", **given)
    assert not (tmp_path / "other.zarr").exists()


@pytest.mark.long
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


HOSTILE = {
    "distributed.scheduler.idle-timeout": "1ms",
    "distributed.scheduler.no-workers-timeout": "1ms",
    "distributed.scheduler.worker-ttl": "1ms",
    "distributed.scheduler.allowed-failures": -1,
    "distributed.scheduler.work-stealing": "perhaps",
    "distributed.scheduler.worker-saturation": 1e-9,
    "distributed.scheduler.blocked-handlers": ["register-client", "update-graph", "identity"],
    "distributed.scheduler.preload": ["no_such_module"],
    "distributed.scheduler.pickle": False,
    "distributed.scheduler.http.routes": ["no.such.module"],
    "distributed.worker.blocked-handlers": ["run", "compute-task"],
    "distributed.worker.preload": ["no_such_module"],
    "distributed.worker.lifetime.duration": "1s",
    "distributed.worker.lifetime.stagger": "0s",
    "distributed.worker.memory.pause": 1e-6,
    "distributed.worker.memory.target": 1e-6,
    "distributed.worker.memory.spill": 1e-6,
    "distributed.worker.memory.terminate": 1e-6,
    "distributed.worker.resources": {"GPU": 1},
    "distributed.worker.connections.outgoing": 0,
    "distributed.worker.daemon": "no",
    "distributed.worker.http.routes": ["no.such.module"],
    "distributed.worker.multiprocessing-method": "carrier pigeon",
    "distributed.nanny.preload": ["no_such_module"],
    "distributed.nanny.environ": {"PYTHONPATH": "/nowhere", "DASK_SCHEDULER": "sync"},
    "distributed.comm.require-encryption": True,
    "distributed.comm.default-scheme": "tls",
    "distributed.comm.timeouts.connect": "1ms",
    "distributed.comm.timeouts.tcp": "1ms",
    "distributed.comm.socket-backlog": 0,
    "distributed.comm.compression": "no such codec",
    "distributed.comm.shard": "1 B",
    "distributed.comm.tls.ca-file": "/nowhere/ca.pem",
    "distributed.client.heartbeat": "1000h",
    "distributed.deploy.lost-worker-timeout": "1ms",
    "distributed.admin.log-format": "%(no such)s",
    "distributed.admin.event-loop": "no such loop",
    "distributed.diagnostics.nvml": "perhaps",
    "distributed.dashboard.link": "{no such}",
    "temporary-directory": "/proc/nowhere",
    "scheduler": "sync",
    "scheduler-address": "tcp://192.0.2.1:8786",
}


def computes():
    """Tell whether an embedded cluster computes."""
    with embedded(1) as client:
        return client.submit(sum, [1, 2]).result(timeout=60) == 3


@pytest.mark.parametrize(("states", "line"), [
    (("running", "running"), "0 are with 2 workers; a block ends after at most 7 s"),
    (("paused", "running"), "0 are with 2 workers, 1 of them paused by Dask"),
])
def test_run_without_progress_says_so_once_in_a_while(states, line, monkeypatch, capsys):
    monkeypatch.setattr(on_cluster, "STALL_S", 0.1)
    monkeypatch.setattr(on_cluster, "worker_states", lambda *_: {
        str(k): WorkerState(1, state) for k, state in enumerate(states)})
    engine = OnCluster(None, None, time_limit_s=7)
    deadline = time.monotonic() + 0.35
    while time.monotonic() < deadline:
        engine.check()
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2  # after 0.1 s, and after 0.2 s
    assert all(f"no block was finished for 0 s: {line}" in each for each in lines)


@pytest.mark.long
def test_workers_whose_processors_differ_are_named_before_and_after_the_run(tmp_path, capfd):
    pipeline = Pipeline.from_text(
        '[pose]\nside_px = 60\n[detector]\ncornerRefinementMethod = "subpix"\n[axes]\ntrial = 4\n'
        "tilt_deg = [0, 20]\n[scene]\nnoise_grey = 1\n")
    older = os.environ | {"OPENCV_CPU_DISABLE": "AVX2,AVX512-SKX", "OPENCV_IPP": "disabled"}
    with (
        local_cluster() as cluster,
        started(["-m", "distributed.cli.dask_worker", cluster.scheduler_address, "--nthreads", "1",
                 "--no-dashboard"], env=older, stderr=subprocess.DEVNULL),
        Client(cluster, set_as_default=False) as client,
    ):
        client.wait_for_workers(2, timeout=60)
        capfd.readouterr()
        store = create_store(str(tmp_path / "mixed.zarr"), pipeline, (1, 1))
        summary = execute(pipeline, store.url, client=client)
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("warning: processors with 2 different sets of features: last digits ")
    assert "(1 workers: " in line
    assert line.count("no IPP") == 1
    counts = open_store(store.url).run_metadata["counts"]["processors"]
    assert (len(counts), sum(counts.values())) == (2, len(open_store(store.url).blocks))
    assert sum("no IPP" in name for name in counts) == 1
    assert any(warning.startswith("processors with 2") for warning in summary.warnings)
