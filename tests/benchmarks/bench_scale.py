"""The client, a Dask scheduler and a store under many simulated workers.

    python tests/benchmarks/bench_scale.py [--workers 64 256 1000] [--waves 4] [--stored 100000]
        [--chunks] [--block-s 2.0]

Many `distributed.Worker`s live in two processes; a block's work is replaced by waiting its time,
after which a real receipt is written. Blocks are as long as a run of this size would have them.
The second table is of stores of ``--stored`` committed blocks, of which only receipts are made;
with ``--chunks`` also chunks, many names of few files: processor seconds, and most memory in MB.
Efficiency is the workers' busy share between their first and their last block; start and end count
in the other figure, so more with few ``--waves`` (blocks a worker).
"""

import argparse
import asyncio
import dataclasses
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from functools import lru_cache
from pathlib import Path

import dask
import psutil
from distributed import Client, Worker

import sweep
from sweep.execution import on_cluster
from sweep.execution.forecast import block_work_s
from sweep.execution.progress import Tally
from sweep.execution.runner import compute
from sweep.execution.status import close, status
from sweep.execution.waves import AnyOrder
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.integrity.verification import verify
from sweep.isolation.child_process import Interrupts
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped
from sweep.store.blocks import committed, missing_chunks, receipts
from sweep.store.files import write_files
from sweep.store.layout import RECEIPTS, checksum_of
from sweep.store.lifecycle import create_store, open_store
from sweep.store.receipt import Receipt, receipt_key

PROCESSES = 2
SCENES = 1000
"""Poses of a block."""

GRID = """
[pose]
jitter_px = 0.5
side_px = 50
[axes]
tilt_deg = {{ linspace = [0, 60, 100] }}
trial = {trials}
"""

MONITORS = {
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.tick.cycle": "3s",
    "distributed.scheduler.active-memory-manager.start": False,
    "distributed.admin.system-monitor.interval": "600s",
    "distributed.worker.memory.monitor-interval": "600s",
}


def receipt_of(store, number, wall_s, idle_s=0.0):
    """Return the receipt of a block whose poses were all detected and solved."""
    scenes = len(store.blocks[number])
    return Receipt(
        run_id=store.run_id, processors=("simulated",), scenes=scenes,
        computed={"scenes": scenes, "detections": scenes, "estimates": scenes},
        detection=[0, scenes], estimate=[0, scenes],
        seconds={"scene": [idle_s], "detection": [0.0], "estimation": [0.0]}, failures=(),
        wall_s=wall_s, written=time.time(), block=number,
        checksums={variable.name: 123456789 for variable in store.variables},
    )


@lru_cache(maxsize=1)
def opened(url, run_id):  # noqa: ARG001  (a store of its own for each run)
    return open_store(url, "r+")


LAST = threading.local()
"""When the worker of this thread was to end its last block."""


def share_of(number):
    """Return how long a block takes, 0.5 to 1.5: workers do not finish all at once."""
    return 0.5 + number * 0.6180339887498949 % 1.0


def simulated_blocks(url, run_id, blocks, _decision, _sources, time_limit_s, *_others):
    """Wait a block's time, here passed as its time limit; write its receipt and return it."""
    (block,) = blocks
    begun = time.perf_counter()
    idle_s = begun - getattr(LAST, "end", math.nan)
    store = opened(url, run_id)
    number = store.blocks.number(block)
    wanted = time_limit_s * share_of(number)
    receipt = receipt_of(store, number, wanted, 0.0 if math.isnan(idle_s) else idle_s)
    time.sleep(max(wanted - (time.perf_counter() - begun), 0.0))
    write_files(store.storage, {receipt_key(number): receipt.to_bytes()})
    LAST.end = begun + wanted
    return [receipt]


async def live(address, count):
    """Be ``count`` workers of a scheduler until it goes away."""
    workers = []
    with dask.config.set(MONITORS):
        while len(workers) < count:
            some = [
                Worker(address, nthreads=1, memory_limit=0, dashboard=False)
                for _ in range(min(25, count - len(workers)))
            ]
            await asyncio.gather(*some)
            workers += some
        await asyncio.gather(*(worker.finished() for worker in workers))


def many_files():
    """Allow as many open files as the system does: a worker needs several."""
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


def cpu_s(process):
    times = process.cpu_times()
    return times.user + times.system


def created(blocks, url):
    """Return an empty store of at least ``blocks`` blocks, a multiple of 100."""
    trials = SCENES * -(-blocks // 100)
    return create_store(url, Pipeline.from_text(GRID.format(trials=trials)), (1, SCENES))


def simulated(count, waves, block_s, folder):
    """Return the figures of a run of ``waves`` blocks a worker."""
    if block_s is None:
        # As in a run of 100,000 blocks.
        block_s = block_work_s(1e5 * max(2.0, count / 75), count)
    store = created(count * waves, f"{folder}/{count}.zarr")
    address = Path(folder) / f"{count}.json"
    paths = [str(Path(__file__).parent), str(Path(sweep.__file__).parents[1])]
    environment = {
        **os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }
    children = [subprocess.Popen(
        [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port",
         "0", "--no-dashboard", "--scheduler-file", str(address)],
        env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        preexec_fn=many_files,  # noqa: PLW1509  (no threads yet that hold locks)
    )]
    try:
        while not address.exists():
            time.sleep(0.1)
        url = json.loads(address.read_text())["address"]
        begun = time.perf_counter()
        children += [subprocess.Popen(
            [sys.executable, __file__, "--live", url, str(count // PROCESSES)], env=environment,
            stderr=subprocess.DEVNULL, preexec_fn=many_files,  # noqa: PLW1509
        ) for _ in range(PROCESSES)]
        with Client(url, set_as_default=False) as client, Interrupts() as interrupts:
            client.wait_for_workers(count // PROCESSES * PROCESSES, timeout=300)
            start_s = time.perf_counter() - begun
            return {
                "workers": count, "blocks": len(store.blocks), "block_s": round(block_s, 2),
                "start_s": round(start_s, 1),
                **measured(store, client, block_s, interrupts, psutil.Process(children[0].pid)),
            }
    finally:
        for child in reversed(children):
            child.kill()
            child.wait()


def measured(store, client, block_s, interrupts, scheduler):
    """Return the figures of a run of all blocks of a store on a cluster that is there."""
    client_process, number = psutil.Process(), len(store.blocks)
    threads = sum(client.nthreads().values())
    memory = [process.memory_info().rss for process in (scheduler, client_process)]
    spent = [cpu_s(scheduler), cpu_s(client_process)]
    halfway = []

    def report(progress):
        if 2 * progress.done >= progress.total and not halfway:
            halfway.extend([scheduler.memory_info().rss, client_process.memory_info().rss])

    begun = time.perf_counter()
    waiting = AnyOrder(range(number))
    compute(store, waiting, Tally(store, waiting, report), on_cluster.OnCluster(client), (),
            block_s, interrupts)
    wall = time.perf_counter() - begun
    after = [process.memory_info().rss for process in (scheduler, client_process)]
    found = [receipt for _, receipt in receipts(store, range(number))]
    busy_s = sum(receipt.wall_s for receipt in found)
    # From the end of a worker's block to the start of its next one, with the writing of receipts.
    idle_s = sum(receipt.seconds["scene"][0] for receipt in found)
    return {
        "blocks_a_s": round(number / wall, 1),
        "efficiency": round(busy_s / (busy_s + idle_s), 3),
        "with_start_and_end": round(busy_s / threads / wall, 3),
        "scheduler_core": round((cpu_s(scheduler) - spent[0]) / wall, 2),
        "client_core": round((cpu_s(client_process) - spent[1]) / wall, 2),
        "scheduler_mb": [round(b / 1e6) for b in (memory[0], halfway[0], after[0])],
        "client_mb": [round(b / 1e6) for b in (memory[1], halfway[1], after[1])],
    }


def fill(store, chunks):
    """Write all receipts of a store past Zarr, and with ``chunks`` a chunk for each variable."""
    root, count = Path(store.url), len(store.blocks)
    contents, checksums = {}, {variable.name: 123456789 for variable in store.variables}
    if chunks:
        for variable in store.variables:
            flag = variable.present_when.flag if variable.present_when else ""
            there = variable.stage is Stage.scene and flag != "bound"
            empty = 0.0 if there else variable.fill
            value = empty if variable.flags is None else SOUND.get(variable.name, 0)
            content = store.chunks.encoded(variable.name, value)
            contents[variable.name], checksums[variable.name] = content, checksum_of(content)
    (root / RECEIPTS / "c").mkdir(parents=True, exist_ok=True)
    for number in range(count):
        receipt = receipt_of(store, number, 2.0)
        scenes = receipt.scenes
        receipt = dataclasses.replace(
            receipt, checksums=checksums, detection=[0] * SOUND["detection"] + [scenes],
            estimate=[0] * SOUND["estimate"] + [scenes],
        )
        (root / receipt_key(number)).write_bytes(receipt.to_bytes())
    for name, content in contents.items():
        source = None
        for links in range(count):
            path = root / store.chunks.key(name, links)
            path.parent.mkdir(parents=True, exist_ok=True)
            if links % MAX_LINKS == 0:
                path.write_bytes(content)
                source = path
            elif path != source:
                path.unlink(missing_ok=True)
                os.link(source, path)


SOUND = {"detection": DetectionStatus.no_candidate, "estimate": EstimateStatus.no_detection,
         "flipped": Flipped.no_estimate}
"""Flags of the chunks that are made: no numbers stand beside them."""

MAX_LINKS = 60_000
"""Names of one file; a file of its own for each chunk would take hours to make."""


def peak_mb():
    """Return the most memory that this process has used since this was called last."""
    status_file, control = Path("/proc/self/status"), Path("/proc/self/clear_refs")
    lines = dict(line.split(":", 1) for line in status_file.read_text().splitlines())
    control.write_text("5")
    return int(lines["VmHWM"].split()[0]) * 1024 / 1e6


def stored(count, folder, chunks):
    """Return what a store of ``count`` blocks takes to list, count, open, verify and close.

    Processor seconds, and the most memory in MB; with ``chunks``, also of what looks at them.
    """
    store = created(count, f"{folder}/stored.zarr")
    fill(store, chunks)
    url = store.url
    calls = {
        "open_store": lambda: open_store(url),
        "committed": lambda: committed(store),
        "continue": lambda: Tally(store, AnyOrder(())).begin(committed(store)),
        "status": lambda: status(url),
        "sweep.open": lambda: sweep.open(url),
    }
    if chunks:
        calls |= {
            "missing_chunks": lambda: check(missing_chunks(store, committed(store)) == {}),
            "close": lambda: close(store),
            "verify": lambda: check(not verify(url, 0).damage),
        }
    figures = {"blocks": len(store.blocks)}
    for name, call in calls.items():
        peak_mb()
        spent = time.process_time()
        call()
        figures[name] = [round(time.process_time() - spent, 2), round(peak_mb())]
    return figures


def check(sound):
    """Raise AssertionError unless what was measured is right."""
    if not sound:
        raise AssertionError


def main():
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--workers", type=int, nargs="*", default=[64, 256, 1000])
    parser.add_argument("--waves", type=int, default=4)
    parser.add_argument("--block-s", type=float)
    parser.add_argument("--stored", type=int, nargs="*", default=[])
    parser.add_argument("--chunks", action="store_true")
    parser.add_argument("--live", nargs=2)
    options = parser.parse_args()
    if options.live:
        asyncio.run(live(options.live[0], int(options.live[1])))
        return
    sys.path.insert(0, str(Path(__file__).parent))
    import bench_scale  # noqa: PLC0415  (tasks name their function by its module)

    on_cluster.compute_blocks = bench_scale.simulated_blocks
    with tempfile.TemporaryDirectory() as folder:
        many_files()
        for count in options.workers:
            figures = simulated(count, options.waves, options.block_s, folder)
            print(json.dumps(figures), flush=True)
    for count in options.stored:
        with tempfile.TemporaryDirectory() as folder:
            figures = stored(count, folder, options.chunks)
        print(json.dumps(figures), flush=True)


if __name__ == "__main__":
    main()
