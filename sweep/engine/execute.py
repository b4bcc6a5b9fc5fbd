"""The run: a bounded window of blocks on a Dask cluster; workers write, the client counts."""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from distributed import Client, LocalCluster, as_completed

from sweep.engine.calibration import block_extents, calibrate
from sweep.engine.fingerprint import differences
from sweep.engine.store import (
    RunStore,
    committed,
    create_store,
    exists,
    finish,
    open_store,
    receipts,
    remove_store,
)
from sweep.engine.task import compute_block
from sweep.errors import RunError, StoreError
from sweep.measure.flags import Detection
from sweep.plan.grid import Block
from sweep.plan.parameters import Stage
from sweep.plan.pipeline import Pipeline

WINDOW = 3
"""Blocks in flight per worker thread: enough that none waits, few enough that none pile up."""

CALIBRATION_S = 0.6

WORKER_ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENCV_FOR_THREADS_NUM": "1",
    "MALLOC_TRIM_THRESHOLD_": "268435456",
    "MALLOC_MMAP_THRESHOLD_": "268435456",
}
"""One thread a worker, and images' memory kept between scenes rather than given back."""


@dataclass(slots=True)
class Progress:
    """How far a run is, in scene cells; handed to the caller after every block."""

    done: int
    total: int
    detected: int


@dataclass(slots=True)
class Summary:
    """What a run did; ``sweep run --json`` prints it."""

    store: str
    poses: int
    results: int
    detected: int
    blocks: int
    computed_blocks: int
    seconds: float
    crashed: int = 0
    failed: int = 0


def default_workers() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (
        os.cpu_count() or 1
    )


def execute(
    pipeline: Pipeline,
    store: str | os.PathLike[str] | None = None,
    *,
    workers: int | None = None,
    overwrite: bool = False,
    block_s: float | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> Summary:
    """Run a pipeline into a store; what is committed there already is not computed again.

    Parameters
    ----------
    store
        Path of the store; ``runs/NAME.zarr`` where it is not given.
    workers
        Processes of the embedded cluster (default: the processors at hand).
    overwrite
        Delete a store that is there.
    block_s
        Seconds of work in a block (default: about 2, less where there is little to do).
    on_progress
        Called after every block.

    Raises
    ------
    StoreError
        Where the store cannot be used as asked.
    RunError
        Where blocks failed; the others are in the store.
    """
    started = time.perf_counter()
    url = os.fspath(store) if store is not None else f"runs/{pipeline.name}.zarr"
    if workers is None:
        workers = default_workers()
    if workers < 1:
        raise StoreError(f"--workers {workers}: expected at least 1")
    opened = _existing(url, pipeline, overwrite)
    if opened is not None and opened.finished:
        return _summary(opened, 0, time.perf_counter() - started)
    with ThreadPoolExecutor(1) as beside:
        # Compiling and measuring here while the workers' processes come up.
        measuring = beside.submit(calibrate, pipeline, CALIBRATION_S)
        with _embedded(workers) as client:
            calibration = measuring.result()
            if opened is None:
                extents = block_extents(pipeline, calibration, workers, block_s)
                opened = create_store(url, pipeline, extents)
            computed = _compute(opened, client, workers, on_progress)
    finish(opened, _cost(opened))
    return _summary(open_store(url), computed, time.perf_counter() - started)


def _existing(url: str, pipeline: Pipeline, overwrite: bool) -> RunStore | None:
    """Return the store to continue, or None where a new one is to be made."""
    if not exists(url):
        return None
    store = open_store(url, "r+")
    if overwrite:
        remove_store(url)
        return None
    lines = differences(pipeline, store.pipeline, store.fingerprint)
    if lines:
        listed = "\n".join(f"  {line}" for line in lines)
        raise StoreError(
            f"{url}: holds another experiment; take another --store, or --overwrite it\n{listed}"
        )
    return store


@contextlib.contextmanager
def _embedded(workers: int) -> Iterator[Client]:
    """Start a cluster of ``workers`` single-threaded processes on this machine, and end it quietly.

    It listens on the loopback interface only.
    """
    quiet = logging.CRITICAL
    for name in ("distributed", "distributed.nanny", "distributed.worker"):
        logging.getLogger(name).setLevel(quiet)
    import dask  # noqa: PLC0415  (configured before the cluster reads it)

    with dask.config.set(
        {"distributed.nanny.pre-spawn-environ": WORKER_ENVIRONMENT,
         "distributed.worker.memory.terminate": False}
    ), LocalCluster(
        n_workers=workers, threads_per_worker=1, processes=True, host="127.0.0.1",
        dashboard_address=None, silence_logs=quiet,
    ) as cluster, Client(cluster, set_as_default=False) as client:
        yield client


def _compute(
    store: RunStore, client: Client, workers: int, on_progress: Callable[[Progress], None] | None
) -> int:
    """Compute what is not committed, a bounded window at a time; return how many blocks it was."""
    done = committed(store)
    todo = (block for block in store.blocks if str(block) not in done)
    progress = Progress(0, store.pipeline.size(Stage.scene), 0)
    if done:
        for _, receipt in receipts(store, done):
            _count(progress, receipt)
    if on_progress is not None:
        on_progress(progress)

    def submit(block: Block) -> Any:
        return client.submit(
            compute_block, store.url, store.run_id, block, pure=False,
            key=f"block-{block}-{store.run_id}",
        )

    computed = 0
    faults: list[str] = []
    first = [submit(block) for block in itertools.islice(todo, WINDOW * workers)]
    flight = as_completed(first, loop=client.loop)
    del first
    for future in flight:
        if future.status == "finished":
            computed += 1
            _count(progress, future.result())
            if on_progress is not None:
                on_progress(progress)
        else:
            error = future.exception()
            faults.append(f"{future.key}: {type(error).__name__}: {error}")
        future.release()
        following = next(todo, None) if len(faults) < 10 else None
        if following is not None:
            flight.add(submit(following))
    if faults:
        raise RunError(
            f"{store.url}: {len(faults)} blocks failed; run again to continue\n"
            + "\n".join(f"  {fault}" for fault in faults)
        )
    return computed


def _count(progress: Progress, receipt: Mapping[str, Any]) -> None:
    progress.done += receipt["scenes"]
    counts = receipt["detection"]
    progress.detected += counts[Detection.detected] if len(counts) > Detection.detected else 0


def _cost(store: RunStore) -> xr.Dataset:
    """Return the cost group: seconds per stage and treatment for each block."""
    names, scene, detection, estimation = [], [], [], []
    for name, receipt in receipts(store, sorted(committed(store))):
        seconds = receipt["seconds"]
        names.append(name)
        scene.append(seconds["scene"][0])
        detection.append(seconds["detection"])
        estimation.append(seconds["estimation"])
    pipeline = store.pipeline
    settings = [axis for axis in pipeline.axes if axis.stage is Stage.detection]
    solvers = [axis for axis in pipeline.axes if axis.stage is Stage.estimation]
    both = [*settings, *solvers]
    count = len(names)

    def shaped(values: list[Any], axes: list[Any]) -> Any:
        return np.asarray(values, dtype=np.float64).reshape(
            (count, *(len(axis) for axis in axes))
        )

    return xr.Dataset(
        {
            "scene_s": (("block",), shaped(scene, [])),
            "detection_s": (("block", *(a.name for a in settings)), shaped(detection, settings)),
            "estimation_s": (("block", *(a.name for a in both)), shaped(estimation, both)),
        },
        coords={axis.name: axis.coordinates().astype(object)
                if axis.coordinates().dtype.kind == "T" else axis.coordinates()
                for axis in both},
        attrs={"long_name": "seconds per stage and treatment for each block"},
    )


def _summary(store: RunStore, computed: int, seconds: float) -> Summary:
    """Count a finished store by its receipts."""
    detection = np.zeros(len(Detection), dtype=np.int64)
    blocks = 0
    for _, receipt in receipts(store, committed(store)):
        counts = receipt["detection"]
        detection[: len(counts)] += counts
        blocks += 1
    return Summary(
        store=store.url,
        poses=store.pipeline.size(Stage.scene),
        results=math.prod(len(axis) for axis in store.pipeline.axes),
        detected=int(detection[Detection.detected]),
        blocks=blocks,
        computed_blocks=computed,
        seconds=round(seconds, 3),
        crashed=int(detection[Detection.crashed]),
        failed=int(detection[Detection.failed]),
    )
