"""A run from a pipeline to a finished store: what is prepared, computed and finished, in order."""

from __future__ import annotations

import contextlib
import importlib
import math
import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sweep.errors import ArgumentError, RunError, StoreError, StoreReplacedError
from sweep.execution.calibration import Calibration, block_extents, calibrate_isolated
from sweep.execution.finalize import close, lost
from sweep.execution.limits import CALIBRATION_S, CALIBRATION_SHARE, POLL_S, TIME_LIMIT_S
from sweep.execution.progress import ProgressReport
from sweep.execution.reuse import match
from sweep.isolation.child_process import Child
from sweep.isolation.interrupts import Interrupts
from sweep.measure.flags import DetectionStatus
from sweep.plan.experiment import Pipeline
from sweep.plan.parameters import Stage
from sweep.store.blocks import committed
from sweep.store.lifecycle import create_store, open_store, read_run_metadata, remove_store
from sweep.store.locations import check_writable, exists, is_remote, open_storage
from sweep.store.lock import locked, refuse_if_held
from sweep.store.provenance import differences
from sweep.store.run_store import RunStore

if TYPE_CHECKING:
    from distributed import Client

    from sweep.execution.cluster import Cluster

# `sweep.execution.cluster` and `in_flight` are imported where they are used: Dask is slow to
# import, and a finished store needs none of it.


@dataclass(frozen=True, slots=True)
class Summary:
    """What a run did; ``sweep run --json`` prints it.

    Attributes
    ----------
    store
        The store as it was given, or the default.
    data
        What ``xarray.open_zarr`` opens.
    poses
        Cells of the grid's scene axes.
    results
        Estimates: poses times detector settings times estimators.
    detected
        Detections, over all detector settings.
    blocks
        Blocks of the store.
    computed_blocks, computed_scenes, computed_estimates
        What this run computed; the rest was committed before, or reused from other stores.
    seconds
        Duration of this run.
    crashed, failed
        Cells that are flagged so.
    """

    store: str
    data: str
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


def absolute_url(url: str) -> str:
    """Return a store's address as every process of this machine understands it."""
    return url if is_remote(url) else str(Path(url).absolute())


def execute(
    pipeline: Pipeline,
    store: str | os.PathLike[str] | None = None,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    client: Client | Cluster | None = None,
    reuse: Sequence[str | os.PathLike[str]] = (),
    overwrite: bool = False,
    block_s: float | None = None,
    time_limit_s: float = TIME_LIMIT_S,
    progress: ProgressReport | None = None,
) -> Summary:
    """Run a pipeline into a store; what is committed there already is not computed again.

    Parameters
    ----------
    pipeline
        What to compute.
    store
        Path or URL of the store (default: ``runs/NAME.zarr``).
    workers
        Processes of the embedded cluster (default: the available processors).
    scheduler
        Address of a running Dask scheduler, in place of the embedded cluster. Its workers must
        reach the store under the same path.
    client
        A ``distributed.Client`` or cluster object, in place of the embedded cluster; a client
        stays open.
    reuse
        Stores whose finished cells are reused where their parameters agree.
    overwrite
        Delete an existing store.
    block_s
        Seconds of work in a block (default: about 2, less if there is little to do).
    time_limit_s
        Block timeout in seconds; the search for a scene that never returns keeps within it.
    progress
        Called before the first block and after each one.

    Raises
    ------
    ArgumentError
        If an argument is out of its range, or the cluster cannot be used.
    StoreError
        If the store cannot be written, continued or reused as asked.
    RunError
        If blocks failed; the others are in the store, and another run continues.
    """
    started = time.perf_counter()
    _check_arguments(workers, scheduler, client, block_s, time_limit_s)
    url = os.fspath(store) if store is not None else f"runs/{pipeline.name}.zarr"
    unfinished = _store_to_continue(url, pipeline, overwrite)
    if unfinished is not None and unfinished.finished:
        return _summary_of_complete(unfinished, started)
    sources = _matching_sources(url, pipeline, reuse)
    if unfinished is None:
        check_writable(url)

    from sweep.execution.cluster import connected  # noqa: PLC0415  (slow to import)

    with contextlib.ExitStack() as stack:
        interrupts = stack.enter_context(Interrupts())
        # Compiling and measuring in a child process while the workers' processes start.
        measuring = None if unfinished is not None else stack.enter_context(
            _calibrating(pipeline, CALIBRATION_SHARE * time_limit_s)
        )
        connection = stack.enter_context(
            connected(pipeline, workers=workers, scheduler=scheduler, client=client)
        )
        if unfinished is None and measuring is not None:
            calibration = _result(measuring, interrupts)
            unfinished = _new_store(url, pipeline, calibration, connection, block_s, overwrite)
        if unfinished is None:
            raise AssertionError(url)
        with _continuable_errors(without=" without overwrite" if overwrite else ""):
            computed = _compute_and_close(
                unfinished, connection, sources, time_limit_s, interrupts, progress
            )
    return _summary(open_store(url), computed, time.perf_counter() - started)


def recompute(
    store: RunStore,
    numbers: Iterable[int],
    *,
    workers: int | None = None,
    time_limit_s: float = TIME_LIMIT_S,
) -> None:
    """Compute blocks of a store whose lock this process holds, on an embedded cluster.

    Raises
    ------
    RunError
        If blocks failed.
    """
    from sweep.execution.cluster import connected  # noqa: PLC0415  (slow to import)
    from sweep.execution.in_flight import BlocksInFlight  # noqa: PLC0415  (slow to import)

    _check_arguments(workers, None, None, None, time_limit_s)
    with (
        Interrupts() as interrupts,
        connected(store.pipeline, workers=workers) as client,
        _continuable_errors(),
    ):
        BlocksInFlight(
            store, client, absolute_url(store.url), (), time_limit_s, interrupts=interrupts
        ).compute(numbers)


def _check_arguments(
    workers: int | None, scheduler: str | None, client: object, block_s: float | None,
    time_limit_s: float,
) -> None:
    if workers is not None and workers < 1:
        raise ArgumentError("workers", workers, "expected at least 1")
    if scheduler is not None and client is not None:
        raise ArgumentError("scheduler", scheduler, "expected no client beside it")
    for name, seconds in (("block_s", block_s), ("time_limit_s", time_limit_s)):
        if seconds is not None and not 0 < seconds < math.inf:
            raise ArgumentError(name, seconds, "expected seconds above 0")


# Before anything is computed


def _store_to_continue(url: str, pipeline: Pipeline, overwrite: bool) -> RunStore | None:
    """Return the store at a URL if the run continues it, None if the run creates one."""
    if not exists(url):
        return None
    if overwrite:
        # It is deleted once everything else is known to work, just before the new one is made.
        storage = open_storage(url, "r+")
        read_run_metadata(url, storage)
        refuse_if_held(url, storage)
        return None
    store = open_store(url, "r+")
    refuse_if_held(url, store.storage)
    lines = differences(pipeline, store.pipeline, store.fingerprint)
    if lines:
        listed = "\n".join(f"  {line}" for line in lines)
        raise StoreError(
            f"{url}: holds another experiment; choose another store, or overwrite it\n{listed}"
        )
    return store


def _summary_of_complete(store: RunStore, started: float) -> Summary:
    done = len(committed(store))
    if done != len(store.blocks):
        raise StoreError(
            f"{store.url}: damaged: finished, but {done} of {len(store.blocks)} blocks exist; "
            "repair it with `sweep verify --repair`"
        )
    return _summary(store, {}, time.perf_counter() - started)


def _matching_sources(
    url: str, pipeline: Pipeline, reuse: Sequence[str | os.PathLike[str]]
) -> list[str]:
    """Return the addresses of the stores to reuse; StoreError if one has no cell in common."""
    sources = [absolute_url(os.fspath(source)) for source in reuse]
    for source in sources:
        if source == absolute_url(url):
            raise ArgumentError("reuse", source, "it is the store that is written; choose another")
        match(pipeline, open_store(source))
    return sources


# While the cluster starts


@contextlib.contextmanager
def _calibrating(pipeline: Pipeline, limit_s: float) -> Iterator[Future[Calibration]]:
    """Measure what scenes cost, in a child process, while the body runs."""
    with ThreadPoolExecutor(1) as thread, Child() as child:
        yield thread.submit(calibrate_isolated, child, pipeline, CALIBRATION_S, limit_s)


def _result(measuring: Future[Calibration], interrupts: Interrupts) -> Calibration:
    while not measuring.done():
        interrupts.check()
        wait([measuring], timeout=POLL_S)
    interrupts.check()
    return measuring.result()


def _new_store(
    url: str, pipeline: Pipeline, calibration: Calibration, client: Client,
    block_s: float | None, overwrite: bool,
) -> RunStore:
    """Create an empty store whose blocks suit the calibration and the cluster."""
    from sweep.execution.cluster import thread_count  # noqa: PLC0415  (slow to import)

    threads = max(thread_count(client), 1)
    extents = block_extents(pipeline, calibration, threads, block_s)
    if overwrite and exists(url):
        remove_store(url)
    return create_store(url, pipeline, extents)


# On the cluster


def _compute_and_close(
    store: RunStore, client: Client, sources: Sequence[str], time_limit_s: float,
    interrupts: Interrupts, progress: ProgressReport | None,
) -> Mapping[str, int]:
    """Compute the blocks that are not committed; return counts of what was computed."""
    from sweep.execution.in_flight import BlocksInFlight  # noqa: PLC0415  (slow to import)

    with ThreadPoolExecutor(1) as thread, locked(store):
        thread.submit(importlib.import_module, "xarray")  # to close the store
        done = committed(store)
        waiting = (number for number in range(len(store.blocks)) if number not in done)
        blocks = BlocksInFlight(
            store, client, absolute_url(store.url), sources, time_limit_s, interrupts=interrupts
        )
        computed = blocks.compute(waiting, done, progress)
        close(store)
    return computed


@contextlib.contextmanager
def _continuable_errors(without: str = "") -> Iterator[None]:
    """Raise RunError for errors after which another run continues, and add how."""
    try:
        yield
    except StoreReplacedError as error:
        raise RunError(str(error)) from None
    except (RunError, StoreError) as error:
        first, *others = str(error).splitlines()
        advice = f"{first}; run it again{without} to continue"
        raise RunError("\n".join([advice, *others])) from None


def _summary(store: RunStore, computed: Mapping[str, int], seconds: float) -> Summary:
    """Return the summary of a finished store from the counts that it recorded."""
    counts = store.run_metadata["counts"]
    missing = lost(counts["detection"], counts["estimate"])
    return Summary(
        store=store.url,
        data=store.data_url,
        poses=store.pipeline.size(Stage.scene),
        results=math.prod(len(axis) for axis in store.pipeline.axes),
        detected=counts["detection"][DetectionStatus.detected],
        blocks=len(store.blocks),
        computed_blocks=computed.get("blocks", 0),
        computed_scenes=computed.get("scenes", 0),
        computed_estimates=computed.get("estimates", 0),
        seconds=round(seconds, 3),
        **missing,
    )
