"""The run: a bounded window of blocks on a Dask cluster; workers write, the client counts."""

from __future__ import annotations

import contextlib
import importlib
import itertools
import math
import os
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any

from sweep.errors import RunError, StoreError, StoreReplacedError
from sweep.execution.block_task import TIME_LIMIT_S, compute_block
from sweep.execution.calibration import block_extents, calibrate_apart
from sweep.execution.finalize import close, lost
from sweep.execution.reuse import match
from sweep.isolation.child_process import Child
from sweep.isolation.interrupts import Interrupts
from sweep.measure.flags import DetectionStatus
from sweep.plan.experiment import Pipeline
from sweep.plan.parameters import Stage
from sweep.store.failures import MAX_ROWS
from sweep.store.lifecycle import (
    RunStore,
    check_place,
    committed,
    create_store,
    exists,
    is_remote,
    open_store,
    place_of,
    receipts,
    recorded_about,
    remove_store,
)
from sweep.store.lock import locked, refuse_if_held
from sweep.store.provenance import differences

if TYPE_CHECKING:
    from distributed import Client

WINDOW = 3
"""Blocks in flight per worker thread: enough that none waits, few enough that none pile up."""

POLL_S = 0.2
"""How often a run that waits for blocks looks whether it is to stop."""

CALIBRATION_S = 0.6

CALIBRATION_SHARE = 1 / 8
"""Of a block's time limit: how long measuring may take."""

ASK_EACH_S = 1.0
"""How often the cluster is asked how many threads it has."""

NO_WORKERS_TIMEOUT_S = 60.0
"""How long a run waits for workers where there are none."""

MAX_DEATHS = 10
"""How often a block is handed out again whose workers die."""

MAX_FAULTS = 10
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
    time_limit_s: float = TIME_LIMIT_S,
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
    time_limit_s
        Seconds after which a block is taken for endless; the search for the scene that never
        returns keeps within them.
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
    if not 0 < time_limit_s < math.inf:
        raise StoreError(f"--time-limit {time_limit_s}: expected seconds above 0")
    opened = _existing(url, pipeline, overwrite)
    if opened is not None and opened.finished:
        done = len(committed(opened))
        if done != len(opened.blocks):
            raise StoreError(
                f"{url}: damaged: finished, but {done} of {len(opened.blocks)} blocks are there; "
                "`sweep verify --repair` mends it"
            )
        return _summary(opened, {}, time.perf_counter() - started)
    sources = [place(os.fspath(old)) for old in reuse]
    for source in sources:
        if source == place(url):
            raise StoreError(f"--reuse {source}: it is the store that is written; name another")
        match(pipeline, open_store(source))
    if opened is None:
        check_place(url)
    with Interrupts() as interrupts, ThreadPoolExecutor(1) as beside:
        # Compiling and measuring in a child while the workers' processes come up.
        calibrator = None if opened is not None else Child()
        measuring = None if calibrator is None else beside.submit(
            calibrate_apart, calibrator, pipeline, CALIBRATION_S, CALIBRATION_SHARE * time_limit_s
        )
        with contextlib.ExitStack() as stack:
            if calibrator is not None:
                stack.callback(calibrator.close)
            client = stack.enter_context(_cluster(pipeline, workers, scheduler))
            if measuring is not None:
                while not measuring.done():
                    interrupts.check()
                    wait([measuring], timeout=POLL_S)
                interrupts.check()
                count = max(_threads(client), 1)
                extents = block_extents(pipeline, measuring.result(), count, block_s)
                if overwrite and exists(url):
                    remove_store(url)
                opened = create_store(url, pipeline, extents)
            if opened is None:
                raise AssertionError(url)
            beside.submit(importlib.import_module, "xarray")  # needed at the end
            command = "the same command without --overwrite" if overwrite else "the same command"
            with locked(opened), _failing_while_running(command):
                done_before = committed(opened)
                todo = (k for k in range(len(opened.blocks)) if k not in done_before)
                computed = _Run(opened, client, sources, time_limit_s, interrupts).compute(
                    todo, done_before, on_progress
                )
                close(opened)
    return _summary(open_store(url), computed, time.perf_counter() - started)


def recompute(
    store: RunStore,
    numbers: Iterable[int],
    *,
    workers: int | None = None,
    time_limit_s: float = TIME_LIMIT_S,
) -> None:
    """Compute blocks of a store that is held, on an embedded cluster.

    Raises
    ------
    RunError
        Where blocks failed.
    """
    with (
        Interrupts() as interrupts,
        _cluster(store.pipeline, workers, None) as client,
        _failing_while_running("the same command"),
    ):
        _Run(store, client, [], time_limit_s, interrupts).compute(numbers, set(), None)


@contextlib.contextmanager
def _failing_while_running(command: str) -> Iterator[None]:
    """Tell that a run could not go on, and by which command it does."""
    try:
        yield
    except StoreReplacedError as error:
        raise RunError(str(error)) from None
    except (RunError, StoreError) as error:
        first, *others = str(error).splitlines()
        raise RunError("\n".join([f"{first}; {command} continues", *others])) from None


def _cluster(
    pipeline: Pipeline, workers: int | None, scheduler: str | None
) -> contextlib.AbstractContextManager[Client]:
    from sweep.execution.cluster import (  # noqa: PLC0415  (slow to import, and often not needed)
        default_workers,
        embedded,
        external,
    )

    if scheduler is not None:
        return external(scheduler, pipeline)
    return embedded(workers or default_workers())


def _threads(client: Client) -> int:
    from sweep.execution.cluster import threads  # noqa: PLC0415  (as above)

    return threads(client)


def _existing(url: str, pipeline: Pipeline, overwrite: bool) -> RunStore | None:
    """Return the store to continue, or None where a new one is to be made."""
    if not exists(url):
        return None
    if overwrite:
        # It goes when all else has been seen to work, just before the new one is made.
        there = place_of(url, "r+")
        recorded_about(url, there)
        refuse_if_held(url, there)
        return None
    store = open_store(url, "r+")
    refuse_if_held(url, store.place)
    lines = differences(pipeline, store.pipeline, store.fingerprint)
    if lines:
        listed = "\n".join(f"  {line}" for line in lines)
        raise StoreError(
            f"{url}: holds another experiment; take another --store, or --overwrite it\n{listed}"
        )
    return store


class _Run:
    """Blocks of a store being computed on a cluster, a bounded window of them at a time."""

    def __init__(
        self, store: RunStore, client: Client, sources: Sequence[str], time_limit_s: float,
        interrupts: Interrupts,
    ) -> None:
        self._store = store
        self._client = client
        self._sources = sources
        self._time_limit_s = time_limit_s
        self._interrupts = interrupts
        self._finished: SimpleQueue[Any] = SimpleQueue()
        self._flying: dict[Any, int] = {}
        self._failures = Counter({"failed": 0, "crashed": 0})
        self._deaths: Counter[int] = Counter()

    def compute(
        self, numbers: Iterable[int], done: set[int],
        on_progress: Callable[[Progress], None] | None,
    ) -> Mapping[str, int]:
        """Compute blocks by their numbers; ``done`` are those that are committed.

        Returns how many blocks, scenes, detections and estimates were computed.
        """
        todo = iter(numbers)
        progress = Progress(0, self._store.pipeline.size(Stage.scene), 0)
        for _, receipt in receipts(self._store, done):
            self._count(progress, receipt)
        if on_progress is not None:
            on_progress(progress)
        computed: Counter[str] = Counter()
        faults: list[str] = []
        room = _InFlightLimit(self._client)
        for number in itertools.islice(todo, room()):
            self._submit(number)
        while self._flying:
            self._interrupts.check()
            wanted = room()
            try:
                future = self._finished.get(timeout=POLL_S)
            except Empty:
                continue
            number = self._flying.pop(future)
            if future.status == "finished":
                receipt = future.result()
                computed.update({"blocks": 1, **receipt["computed"]})
                self._count(progress, receipt)
                if on_progress is not None:
                    on_progress(progress)
            elif (fault := self._fault(number, future)) is not None:
                faults.append(fault)
            future.release()
            if len(faults) < MAX_FAULTS:
                for following in itertools.islice(todo, max(wanted - len(self._flying), 0)):
                    self._submit(following)
        if faults:
            raise RunError(
                f"{self._store.url}: {len(faults)} blocks failed\n"
                + "\n".join(f"  {fault}" for fault in faults)
            )
        return computed

    def _submit(self, number: int) -> None:
        block = self._store.blocks[number]
        room = {kind: max(MAX_ROWS - count, 0) for kind, count in self._failures.items()}
        future = self._client.submit(
            compute_block, place(self._store.url), self._store.run_id, block, self._sources,
            self._time_limit_s, room, pure=False, key=f"block-{block}-{uuid.uuid4().hex[:8]}",
        )
        self._flying[future] = number
        future.add_done_callback(self._finished.put)

    def _fault(self, number: int, future: Any) -> str | None:
        """Return why a block failed; None where it is run again."""
        from distributed import KilledWorker  # noqa: PLC0415  (slow to import)

        if future.status in ("cancelled", "lost"):
            raise RunError(
                "the scheduler went away"
            )
        error = future.exception()
        if isinstance(error, StoreError):
            raise error
        if isinstance(error, KilledWorker) and self._deaths[number] < MAX_DEATHS:
            # A block that ends its process is found out when it is begun again, but it may have
            # been in line behind one, or its workers were killed from outside.
            self._deaths[number] += 1
            self._submit(number)
            return None
        return f"block {self._store.blocks[number]}: {type(error).__name__}: {error}"

    def _count(self, progress: Progress, receipt: Mapping[str, Any]) -> None:
        progress.done += receipt["scenes"]
        counts = receipt["detection"]
        progress.detected += (
            counts[DetectionStatus.detected] if len(counts) > DetectionStatus.detected else 0
        )
        self._failures.update(failure["kind"] for failure in receipt["failures"])


class _InFlightLimit:
    """How many blocks may be in flight: it grows and shrinks with the cluster."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._asked = 0.0
        self._blocks = WINDOW
        self._seen = time.monotonic()

    def __call__(self) -> int:
        """Return the room; RunError where the scheduler went away, or no workers came for long."""
        if time.monotonic() > self._asked + ASK_EACH_S:
            there = _threads(self._client)
            self._asked = time.monotonic()
            if there:
                self._blocks, self._seen = WINDOW * there, self._asked
        if time.monotonic() > self._seen + NO_WORKERS_TIMEOUT_S:
            raise RunError(
                f"there have been no workers for {NO_WORKERS_TIMEOUT_S:.0f} s; start some"
            )
        return self._blocks


def _summary(store: RunStore, computed: Mapping[str, int], seconds: float) -> Summary:
    """Tell of a finished store what was counted when it was closed."""
    counts = store.about["counts"]
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
