"""Where blocks are computed: an embedded cluster on this machine, or one that is running."""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import signal
from collections.abc import Iterator
from typing import Any

import dask
from distributed import Client, LocalCluster, fire_and_forget

from sweep.engine.interrupts import in_main_thread
from sweep.engine.provenance import fingerprint
from sweep.errors import StoreError
from sweep.plan.pipeline import Pipeline

ANSWER_S = 10.0
"""How long a scheduler, and then its first worker, may take to answer."""

WORKER_ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENCV_FOR_THREADS_NUM": "1",
    "MALLOC_TRIM_THRESHOLD_": "268435456",
    "MALLOC_MMAP_THRESHOLD_": "268435456",
}
"""One thread a worker, and images' memory kept between scenes rather than given back."""

STILL: dict[str, Any] = {
    "distributed.worker.memory.terminate": False,
    "distributed.worker.memory.monitor-interval": "1s",
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.tick.cycle": "3s",
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.scheduler.active-memory-manager.start": False,
}
"""The cluster watches itself less often: with Dask's defaults two idle workers, their scheduler
and client take 0.12 of a core, so 0.01, and nothing here shows what is watched."""

QUIET = logging.CRITICAL


def default_workers() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextlib.contextmanager
def embedded(workers: int) -> Iterator[Client]:
    """Start a cluster of ``workers`` single-threaded processes on this machine; end it quietly.

    It listens on the loopback interface only.
    """
    _hush()
    settings = {"distributed.nanny.pre-spawn-environ": WORKER_ENVIRONMENT, **STILL}
    # Ctrl-C reaches every process of the terminal; the workers leave it to the client.
    before = signal.getsignal(signal.SIGINT) if in_main_thread() else None
    if before is not None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with dask.config.set(settings):
            cluster = LocalCluster(
                n_workers=workers, threads_per_worker=1, processes=True, host="127.0.0.1",
                dashboard_address="127.0.0.1:0", silence_logs=QUIET,
                scheduler_kwargs={"dashboard": False},
            )
    finally:
        if before is not None:
            signal.signal(signal.SIGINT, before)
    with cluster, Client(cluster, set_as_default=False) as client:
        # The workers import their packages while the caller measures.
        fire_and_forget(
            [client.submit(_warm, workers=[worker], pure=False) for worker in client.nthreads()]
        )
        yield client


def _warm() -> None:
    """Import what a block needs."""
    importlib.import_module("sweep.engine.task")


@contextlib.contextmanager
def external(address: str, pipeline: Pipeline) -> Iterator[Client]:
    """Connect to a running scheduler whose workers make the same numbers as this process.

    Raises
    ------
    StoreError
        Where it does not answer, has no workers, or a worker has other versions.
    """
    _hush()
    if "://" not in address:
        raise StoreError(f"--scheduler {address}: expected an address such as tcp://host:8786")
    try:
        client = Client(address, timeout=ANSWER_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError):
        raise StoreError(
            f"--scheduler {address}: no answer within {ANSWER_S:.0f} s; is `dask scheduler` "
            "running there?"
        ) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=ANSWER_S)
        except TimeoutError:
            raise StoreError(
                f"--scheduler {address}: no workers; start some with `dask worker {address}`"
            ) from None
        _refuse_other_versions(client, address, pipeline)
        yield client


def _refuse_other_versions(client: Client, address: str, pipeline: Pipeline) -> None:
    mine = fingerprint(pipeline)
    try:
        answers: dict[str, dict[str, Any]] = client.run(fingerprint, pipeline)
    except Exception as error:
        raise StoreError(
            f"--scheduler {address}: its workers cannot run sweep: {error}; install it there"
        ) from None
    lines = sorted(
        f"  {worker}: {key} {theirs.get(key)}, here {mine[key]}"
        for worker, theirs in answers.items()
        for key in mine
        if theirs.get(key) != mine[key]
    )
    if lines:
        raise StoreError(
            f"--scheduler {address}: workers with other versions; install the same everywhere\n"
            + "\n".join(lines)
        )


def _hush() -> None:
    """Keep distributed from narrating: what matters is told as errors of this package."""
    for name in ("distributed", "distributed.nanny", "distributed.worker"):
        logging.getLogger(name).setLevel(QUIET)
