"""The run: a bounded window of blocks on a Dask cluster; workers write, the client counts."""

from __future__ import annotations

import itertools
import math
import os
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np
import xarray as xr
from distributed import Client

from sweep.engine.calibration import block_extents, calibrate
from sweep.engine.cluster import default_workers, embedded, external
from sweep.engine.interrupts import Interrupts
from sweep.engine.lock import locked, refuse_if_held
from sweep.engine.provenance import differences
from sweep.engine.reuse import match
from sweep.engine.store import (
    RunStore,
    check_place,
    committed,
    create_store,
    exists,
    finish,
    is_remote,
    open_store,
    receipts,
    remove_store,
)
from sweep.engine.task import compute_block
from sweep.errors import RunError, StoreError
from sweep.measure.flags import Detection, Estimate
from sweep.plan.grid import Block
from sweep.plan.parameters import Stage
from sweep.plan.pipeline import Pipeline

WINDOW = 3
"""Blocks in flight per worker thread: enough that none waits, few enough that none pile up."""

POLL_S = 0.2
"""How often a run that waits for blocks looks whether it is to stop."""

CALIBRATION_S = 0.6

MOST_FAULTS = 10
"""Failed blocks after which no more are begun."""


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
    computed_scenes: int
    computed_estimates: int
    seconds: float
    crashed: int = 0
    failed: int = 0


def place(url: str) -> str:
    """Return where a store is, in words that every process of this machine understands."""
    return url if is_remote(url) else str(Path(url).absolute())


def execute(
    pipeline: Pipeline,
    store: str | os.PathLike[str] | None = None,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    reuse: Sequence[str | os.PathLike[str]] = (),
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
    scheduler
        Address of a running Dask scheduler, in place of the embedded cluster. Its workers must
        reach the store under the same path.
    reuse
        Stores whose finished cells are taken where they agree.
    overwrite
        Delete a store that is there.
    block_s
        Seconds of work in a block (default: about 2, less where there is little to do).
    on_progress
        Called after every block.

    Raises
    ------
    StoreError
        Where the store or the cluster cannot be used as asked.
    RunError
        Where blocks failed; the others are in the store.
    """
    started = time.perf_counter()
    url = os.fspath(store) if store is not None else f"runs/{pipeline.name}.zarr"
    if workers is not None and workers < 1:
        raise StoreError(f"--workers {workers}: expected at least 1")
    opened = _existing(url, pipeline, overwrite)
    if opened is not None and opened.finished:
        done = len(committed(opened))
        if done != len(opened.blocks):
            raise StoreError(
                f"{url}: damaged: finished, but {done} of {len(opened.blocks)} blocks are there; "
                "--overwrite computes it again"
            )
        return _summary(opened, [], time.perf_counter() - started)
    sources = [place(os.fspath(old)) for old in reuse]
    for source in sources:
        if source == place(url):
            raise StoreError(f"--reuse {source}: it is the store that is written; name another")
        match(pipeline, open_store(source))
    if opened is None:
        check_place(url)
    with Interrupts() as interrupts, ThreadPoolExecutor(1) as beside:
        # Compiling and measuring here while the workers' processes come up.
        measuring = beside.submit(calibrate, pipeline, CALIBRATION_S) if opened is None else None
        cluster = embedded(workers or default_workers()) if scheduler is None else (
            external(scheduler, pipeline)
        )
        with cluster as client:
            if measuring is not None:
                threads = sum(client.nthreads().values())
                extents = block_extents(pipeline, measuring.result(), threads, block_s)
                if overwrite and exists(url):
                    remove_store(url)
                opened = create_store(url, pipeline, extents)
            if opened is None:
                raise AssertionError(url)
            with locked(opened):
                receipts_seen = _compute(opened, client, sources, on_progress, interrupts)
                finish(opened, _cost(opened))
    return _summary(open_store(url), receipts_seen, time.perf_counter() - started)


def _existing(url: str, pipeline: Pipeline, overwrite: bool) -> RunStore | None:
    """Return the store to continue, or None where a new one is to be made."""
    if not exists(url):
        return None
    store = open_store(url, "r+")
    refuse_if_held(url, store.group.store)
    if overwrite:
        # It goes when all else has been seen to work, just before the new one is made.
        return None
    lines = differences(pipeline, store.pipeline, store.fingerprint)
    if lines:
        listed = "\n".join(f"  {line}" for line in lines)
        raise StoreError(
            f"{url}: holds another experiment; take another --store, or --overwrite it\n{listed}"
        )
    return store


def _compute(
    store: RunStore,
    client: Client,
    sources: Sequence[str],
    on_progress: Callable[[Progress], None] | None,
    interrupts: Interrupts,
) -> list[dict[str, int]]:
    """Compute what is not committed, a bounded window of blocks at a time.

    Returns for each block that was run how many scenes, detections and estimates it computed.
    """
    done = committed(store)
    todo = (store.blocks[k] for k in range(len(store.blocks)) if k not in done)
    progress = Progress(0, store.pipeline.size(Stage.scene), 0)
    for _, receipt in receipts(store, done):
        _count(progress, receipt)
    if on_progress is not None:
        on_progress(progress)
    url = place(store.url)

    finished: SimpleQueue[Any] = SimpleQueue()
    flying: set[Any] = set()

    def submit(block: Block) -> None:
        future = client.submit(
            compute_block, url, store.run_id, block, sources, pure=False,
            key=f"block-{block}-{uuid.uuid4().hex[:8]}",
        )
        flying.add(future)
        future.add_done_callback(finished.put)

    computed: list[dict[str, int]] = []
    faults: list[str] = []
    room = _Room(client)
    for block in itertools.islice(todo, room()):
        submit(block)
    while flying:
        interrupts.check()
        try:
            future = finished.get(timeout=POLL_S)
        except Empty:
            continue
        flying.discard(future)
        if future.status == "finished":
            receipt = future.result()
            computed.append(receipt["computed"])
            _count(progress, receipt)
            if on_progress is not None:
                on_progress(progress)
        else:
            error = future.exception()
            if isinstance(error, StoreError):
                raise error
            faults.append(f"{future.key}: {type(error).__name__}: {error}")
        future.release()
        if len(faults) < MOST_FAULTS:
            for block in itertools.islice(todo, max(room() - len(flying), 0)):
                submit(block)
    if faults:
        raise RunError(
            f"{store.url}: {len(faults)} blocks failed; run again to continue\n"
            + "\n".join(f"  {fault}" for fault in faults)
        )
    return computed


class _Room:
    """How many blocks may be in flight: it grows and shrinks with the cluster."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._asked = 0.0
        self._blocks = 0

    def __call__(self) -> int:
        if time.monotonic() > self._asked + 1.0:
            self._blocks = WINDOW * max(sum(self._client.nthreads().values()), 1)
            self._asked = time.monotonic()
        return self._blocks


def _count(progress: Progress, receipt: Mapping[str, Any]) -> None:
    progress.done += receipt["scenes"]
    counts = receipt["detection"]
    progress.detected += counts[Detection.detected] if len(counts) > Detection.detected else 0


def _cost(store: RunStore) -> xr.Dataset:
    """Return the cost group: seconds per stage and treatment for each block."""
    numbers, scene, detection, estimation = [], [], [], []
    for number, receipt in receipts(store, committed(store)):
        seconds = receipt["seconds"]
        if not seconds["scene"]:
            continue
        numbers.append(number)
        scene.append(seconds["scene"][0])
        detection.append(seconds["detection"])
        estimation.append(seconds["estimation"])
    pipeline = store.pipeline
    settings = [axis for axis in pipeline.axes if axis.stage is Stage.detection]
    solvers = [axis for axis in pipeline.axes if axis.stage is Stage.estimation]
    both = [*settings, *solvers]
    count = len(numbers)

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
        coords={"block": numbers, **{axis.name: axis.coordinates().astype(object)
                if axis.coordinates().dtype.kind == "T" else axis.coordinates()
                for axis in both}},
        attrs={"long_name": "seconds per stage and treatment for each block"},
    )


def _summary(store: RunStore, computed: Sequence[Mapping[str, int]], seconds: float) -> Summary:
    """Count a finished store by its receipts."""
    detection = np.zeros(len(Detection), dtype=np.int64)
    estimate = np.zeros(len(Estimate), dtype=np.int64)
    blocks = 0
    for _, receipt in receipts(store, committed(store)):
        for total, counts in ((detection, receipt["detection"]), (estimate, receipt["estimate"])):
            total[: len(counts)] += counts
        blocks += 1
    return Summary(
        store=store.url,
        poses=store.pipeline.size(Stage.scene),
        results=math.prod(len(axis) for axis in store.pipeline.axes),
        detected=int(detection[Detection.detected]),
        blocks=blocks,
        computed_blocks=len(computed),
        computed_scenes=sum(block["scenes"] for block in computed),
        computed_estimates=sum(block["estimates"] for block in computed),
        seconds=round(seconds, 3),
        crashed=int(detection[Detection.crashed] + estimate[Estimate.crashed]),
        failed=int(detection[Detection.failed] + estimate[Estimate.failed]),
    )
