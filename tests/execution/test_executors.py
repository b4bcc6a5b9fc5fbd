"""Processes that compute blocks: children of this machine, and workers of the caller's cluster."""

import copy
import itertools
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from unittest import mock

import cv2
import dask
import numpy as np
import psutil
import pytest
import zarr
from distributed import Client

import sweep
from support.clusters import local_cluster
from support.commands import started
from support.here import Here
from support.stores import by_hand, same
from sweep.errors import ArgumentError, MachineFaultError, RunError
from sweep.execution import executors, on_cluster
from sweep.execution.block_task import other_here
from sweep.execution.executors import Children
from sweep.execution.on_cluster import OnCluster, connected
from sweep.execution.runner import compute, execute
from sweep.experiment.pipeline import Pipeline
from sweep.isolation.child_process import Child, Interrupts
from sweep.store.blocks import StoreReplacedError, committed
from sweep.store.lifecycle import create_store, open_store

PIPELINE = Pipeline.from_text(
    "seed = 3\npose = { jitter_px = 0.5, azimuth_deg = { uniform = [0, 360] } }\n"
    "axes = { side_px = [20, 40], trial = 6 }\n", name="small")


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    url = str(tmp_path_factory.mktemp("undisturbed") / "whole.zarr")
    by_hand(url, PIPELINE)
    return url


def settings_of_the_caller():
    return {
        # Dask's scheduler notes in its own section that Bokeh is missing.
        "dask": copy.deepcopy([dask.config.get(f"distributed.{section}")
                               for section in ("nanny", "worker", "comm", "admin")]),
        "zarr": copy.deepcopy(zarr.config.config),
        "threads of OpenCV": cv2.getNumThreads(),
        "numpy": np.geterr(),
        "signals": {number: signal.getsignal(number) for number in signal.valid_signals()},
        "path": list(sys.path),
    }


@pytest.mark.system
def test_local_cluster_computes_the_same_bits_and_leaves_nothing(
    undisturbed, tmp_path, monkeypatch
):
    monkeypatch.setattr("sweep.execution.forecast.block_work_s", lambda *_: 0.01)
    settings = settings_of_the_caller()
    me, threads = psutil.Process(), set(threading.enumerate())
    before = me.children(recursive=True)
    url = str(tmp_path / "local.zarr")
    summary = execute(PIPELINE, url, workers=2, scheduler="local")
    assert (summary.computed_scenes, summary.failed, summary.crashed) == (12, 0, 0)
    assert same(url, undisturbed)
    assert settings_of_the_caller() == settings
    left = [child for child in me.children(recursive=True) if child not in before
            and "resource_tracker" not in " ".join(child.cmdline())]  # Python's own
    psutil.wait_procs(left, timeout=10)
    assert not [child for child in left if child.is_running()]
    # Idle threads of Zarr and Dask, and of one pool without a name, whose number is the process's.
    left = {thread.name.partition("_")[0] for thread in set(threading.enumerate()) - threads}
    unnamed = {name for name in left if name.startswith("ThreadPoolExecutor-")}
    assert len(unnamed) <= 1
    assert left - unnamed <= {"zarr", "asyncio", "Dask-Offload", "Dask-Callback-Thread"}


def test_processes_that_cannot_be_started_are_told_in_a_line(monkeypatch, capsys):
    monkeypatch.setattr(executors, "Child", mock.Mock(side_effect=OSError(11, "no more")))
    with Children(Here(), 3) as executor:
        assert executor.room() == 1
    told = "1 of 3 processes could be started: BlockingIOError: [Errno 11] no more\n"
    assert capsys.readouterr().err == told


def test_a_store_is_closed_once_what_closes_it_is_imported(tmp_path, monkeypatch):
    done = []
    monkeypatch.setattr("sweep.execution.runner.importlib", mock.Mock(
        import_module=lambda name: time.sleep(0.3) or done.append(name)))
    monkeypatch.setattr("sweep.execution.status.close", lambda _: done.append("close"))
    compute_in(tmp_path, Here())
    assert done == ["xarray", "dask.array", "close"]


def suicide(*_):
    os.kill(os.getpid(), signal.SIGKILL)


def compute_in(folder, child):
    store = create_store(str(folder / "one.zarr"), PIPELINE, (2, 6))
    with child, Interrupts() as interrupts, Children(child, 1) as executor:
        compute(store, executor, (), 60, interrupts)


@pytest.mark.system
def test_block_that_ends_its_process_each_time_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(executors, "MAX_ATTEMPTS", 2)
    monkeypatch.setattr(executors, "compute_block", suicide)
    failed = r"block 0-2,0-6: its process ended: SIGKILL, as where memory runs out: use "
    with pytest.raises(RunError, match=failed):
        compute_in(tmp_path, Child())


@pytest.mark.parametrize(("raised", "error", "reason"), [
    (ZeroDivisionError("no"), RunError,
     r"1 blocks failed\n  block 0-2,0-6: ZeroDivisionError: no"),
    (StoreReplacedError("moved"), StoreReplacedError, "moved"),
    (MachineFaultError("fault on here: full"), RunError, "0-2,0-6: fault on here: full"),
])
def test_block_that_fails_is_named(raised, error, reason, tmp_path, monkeypatch):
    monkeypatch.setattr(executors, "compute_block", mock.Mock(side_effect=raised))
    with pytest.raises(error, match=reason):
        compute_in(tmp_path, Here())


@pytest.mark.evidence
def test_children_end_with_their_client_whatever_ends_it(tmp_path):
    """Also where Ctrl-C is ignored; and a lost scheduler is told in the last line."""
    (tmp_path / "long.toml").write_text(
        "[pose]\njitter_px = 0.5\nside_px = 50\n[axes]\ntrial = 40000\n")
    for name in ("long", "own"):
        create_store(str(tmp_path / f"{name}.zarr"), Pipeline.from_toml(tmp_path / "long.toml"),
                     (500,))
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # as of `nohup`
    options = {"stderr": subprocess.PIPE, "text": True, "cwd": tmp_path}
    run = ["-m", "sweep", "run", "long.toml", "--store"]
    try:
        with (
            local_cluster() as cluster,
            started([*run, "long.zarr", "--scheduler", cluster.scheduler_address],
                    **options) as lost,
            started([*run, "own.zarr", "--workers", 2], **options) as own,
        ):
            deadline = time.monotonic() + 120
            while not (any(tmp_path.glob("long.zarr/commits/receipt/c.*"))
                       and any(tmp_path.glob("own.zarr/commits/receipt/c.*"))):
                assert time.monotonic() < deadline
                time.sleep(0.1)
            children = psutil.Process(own.pid).children(recursive=True)
            assert len(children) >= 2
            own.send_signal(signal.SIGINT)
            own.kill()
            own.wait()
            psutil.wait_procs(children, timeout=30)
            assert not any(child.is_running() for child in children)
            cluster.close()
            assert lost.wait(timeout=60) == 1
            (*_, line) = lost.stderr.read().splitlines()
    finally:
        signal.signal(signal.SIGINT, before)
    assert line == "the scheduler went away; run it again to continue"


def elsewhere(pipeline, begun):
    """Return what a thread says, as if it were another process, of other versions."""
    return other_here(pipeline, begun | {"opencv": "0.0"}), ("elsewhere", 1), "AVX2"


def refusal(client, scheduler=None):
    with pytest.raises(ArgumentError) as raised, connected(PIPELINE, scheduler, client):
        pass
    return str(raised.value)


@pytest.mark.system
def test_clients_and_clusters_that_cannot_be_used_are_refused_in_a_line(tmp_path, monkeypatch):
    monkeypatch.setattr(on_cluster, "WORKERS_S", 0.5)
    # A scene that crashes, and the time limit, end the process of a worker: threads do not do.
    with local_cluster(1, processes=False, protocol="tcp://") as cluster:
        assert "its workers are threads of this process" in refusal(cluster)
        with monkeypatch.context() as patch:
            patch.setattr(on_cluster, "this_process", elsewhere)
            for given in ({"scheduler": cluster.scheduler_address}, {"client": cluster}):
                with pytest.raises(ArgumentError, match=r"tcp://.*: opencv is .*, the run began"):
                    execute(PIPELINE, tmp_path / "other.zarr", **given)
        assert not (tmp_path / "other.zarr").exists()
        client = Client(cluster, set_as_default=False)
        client.close()
        assert refusal(client) == "client = Client: it is closed"
        client = Client(cluster, set_as_default=False)
        client.retire_workers()
        assert refusal(client).endswith("no workers within 0 s; start some")
        client.close()
    assert refusal(cluster) == "client = LocalCluster: it is closed"


def test_what_is_no_client_and_what_is_no_address_are_refused():
    for client in ("tcp://127.0.0.1:9", 3, object()):
        assert "expected a distributed.Client or a cluster object" in refusal(client)
    for address in ("nowhere", "tcp://", "tcp://a:b", "tcp://a"):
        assert "expected an address such as tcp://host:8786" in refusal(None, address)


def test_run_without_progress_says_so_once_in_a_while(monkeypatch, capsys):
    # Each look at the clock is half a minute after the one before.
    monkeypatch.setattr(executors, "time", mock.Mock(monotonic=itertools.count(0, 30).__next__))
    monkeypatch.setattr(executors, "POLL_S", 0.02)
    monkeypatch.setattr(OnCluster, "_look", lambda _: None)
    engine = OnCluster(mock.Mock(status="closed"))
    engine._states = {str(k): {"nthreads": 1, "status": name}
                      for k, name in enumerate(("paused", "running"))}
    left = itertools.count(6, -1)
    engine.room = lambda: 9 if next(left) else pytest.fail("time is up")
    with Interrupts() as interrupts, pytest.raises(pytest.fail.Exception):
        list(engine.map([(0, ())], 7, interrupts))
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2  # each 60 s
    assert all("no block was finished for 60 s: 1 are with 2 workers, 1 of them paused by Dask"
               in each for each in lines)


@pytest.mark.evidence
def test_workers_whose_processors_differ_are_named_before_and_after_the_run(tmp_path, capfd):
    older = os.environ | {"OPENCV_CPU_DISABLE": "AVX2,AVX512-SKX", "OPENCV_IPP": "disabled"}
    with (
        local_cluster() as cluster,
        started(["-m", "distributed.cli.dask_worker", cluster.scheduler_address, "--nthreads", "1",
                 "--no-dashboard"], env=older, stderr=subprocess.DEVNULL),
        Client(cluster, set_as_default=False) as client,
    ):
        client.wait_for_workers(2, timeout=60)
        capfd.readouterr()
        store = create_store(str(tmp_path / "mixed.zarr"), PIPELINE, (1, 1))
        summary = execute(PIPELINE, store.url, client=client)
    (line,) = (each for each in capfd.readouterr().err.splitlines() if "processors" in each)
    assert line.startswith("warning: processors with 2 different sets of features: last digits ")
    assert "(1 workers: " in line
    counts = open_store(store.url).run_metadata["counts"]["processors"]
    assert (len(counts), sum(counts.values())) == (2, len(open_store(store.url).blocks))
    assert sum("no IPP" in name for name in counts) == 1
    assert any(warning.startswith("processors with 2") for warning in summary.warnings)


PLUGINS = Path(__file__).parents[2] / "pipelines/plugins"


def test_a_store_is_read_and_written_where_its_path_led_at_first(tmp_path, monkeypatch):
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path)
    by_hand("rel.zarr", PIPELINE, (1, 3))
    results, opened = sweep.open("rel.zarr"), open_store("rel.zarr", "r+")
    begun = create_store("new.zarr", PIPELINE, (2, 6))
    monkeypatch.chdir(tmp_path / "other")
    assert (results.detection != 0).all()
    assert (opened.array("detection")[...] != 0).all()
    assert not committed(begun)
    assert (tmp_path / "new.zarr/zarr.json").exists()


@pytest.mark.evidence
def test_workers_in_another_folder_read_and_write_the_same_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("files", "elsewhere"):
        Path(name).mkdir()
    cv2.imwrite("files/grey.png", np.full((480, 640), 128, dtype=np.uint8))
    shutil.copy(PLUGINS / "homography.py", "files")
    document = {
        "pose": {"jitter_px": 0.5, "side_px": 40}, "scene": {"background": "files/grey.png"},
        "axes": {"trial": 3, "solver": ["ippe_square", "files/homography.py:SOLVER"]},
    }
    grown = document | {"axes": document["axes"] | {"trial": 5}}
    with local_cluster() as cluster, Client(cluster) as client:
        client.run(os.chdir, str(tmp_path / "elsewhere"))
        for some, options in (
            (document, {"store": "runs/first.zarr"}),
            (grown, {"store": "grown.zarr", "reuse": ["runs/first.zarr"]}),
        ):
            results = sweep.run(some, client=client, **options)
            assert (results.estimate.compute() == 1).all()
            assert (sweep.open(options["store"]).detection.compute() == 1).all()
        assert client.submit(sum, [1, 2, 3]).result(timeout=30) == 6  # the caller's as before
    assert not list(Path("elsewhere").iterdir())
