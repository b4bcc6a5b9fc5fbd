"""The client, a Dask scheduler and a store under many simulated workers.

    python -m tests.benchmarks scale [--workers 64 256 1000] [--waves 4] [--stored 100000]

Many `distributed.Worker`s live in two processes; a block's work is replaced by waiting its time,
after which a real receipt is written. Blocks are as long as a run of this size would have them.
The workers' busy share has start and end in it, which count more with few ``--waves`` (blocks a
worker). The second table is of stores of ``--stored`` committed blocks, all of whose chunks are one
file: processor seconds.
"""

import argparse
import asyncio
import contextlib
import functools
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import dask
import psutil
from distributed import Client, Worker

import sweep
from support.clusters import Cluster
from support.commands import started
from sweep.execution import on_cluster
from sweep.execution import status as execution_status
from sweep.execution.forecast import block_work_s
from sweep.execution.runner import compute
from sweep.execution.status import close, status
from sweep.experiment.pipeline import Pipeline
from sweep.isolation.child_process import SINGLE_THREADED, Interrupts
from sweep.store.blocks import Receipt, check_whole, receipt_key, receipts
from sweep.store.files import write_files
from sweep.store.lifecycle import create_store, open_store

PROCESSES = 2
WORKERS, WAVES, BLOCK_S = (64, 256, 1000), 4, None
QUICK = {"WORKERS": (2,), "WAVES": 2, "BLOCK_S": 0.1}
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


def receipt_of(store, number, wall_s):
    """Return the receipt of a block whose poses were all detected and solved."""
    scenes = len(store.blocks[number])
    return Receipt(
        run_id=store.run_id, processors=("simulated",), scenes=scenes,
        computed={"scenes": scenes, "detections": scenes, "estimates": scenes},
        detection={"detected": scenes}, estimate={"solved": scenes},
        seconds={"scene": [0.0], "detection": [0.0], "estimation": [0.0]}, failures=(),
        wall_s=wall_s, written=time.time(), block=number,
        checksums={variable.name: 123456789 for variable in store.variables},
    )


@functools.lru_cache(maxsize=1)
def opened(url, run_id):  # noqa: ARG001  (a store of its own for each run)
    return open_store(url, "r+")


def simulated_block(url, run_id, block, _sources, time_limit_s, _decision):
    """Wait a block's time, here passed as its time limit; write its receipt and return it.

    It takes 0.5 to 1.5 of that: workers do not finish all at once.
    """
    begun, store = time.perf_counter(), opened(url, run_id)
    number = store.blocks.number(block)
    wanted = time_limit_s * (0.5 + number * 0.6180339887498949 % 1.0)
    receipt = receipt_of(store, number, wanted)
    time.sleep(max(wanted - (time.perf_counter() - begun), 0.0))
    write_files(store.storage, {receipt_key(number): receipt.to_bytes()})
    return receipt


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


def cpu_s(process):
    times = process.cpu_times()
    return times.user + times.system


def created(blocks, url):
    """Return an empty store of at least ``blocks`` blocks, a multiple of 100."""
    trials = SCENES * -(-blocks // 100)
    return create_store(url, Pipeline.from_text(GRID.format(trials=trials)), (1, SCENES))


def simulated(count, waves, folder):
    """Return the figures of a run of ``waves`` blocks a worker."""
    # By default as in a run of 100,000 blocks.
    block_s = BLOCK_S or block_work_s(1e5 * max(2.0, count / 75), count)
    store = created(count * waves, f"{folder}/{count}.zarr")
    environment = {**SINGLE_THREADED, "PYTHONPATH": os.pathsep.join(sys.path)}
    with contextlib.ExitStack() as stack:
        cluster = stack.enter_context(Cluster(Path(folder) / str(count), environment=environment))
        script = (f"import asyncio, {__name__} as us; "
                  f"asyncio.run(us.live({cluster.address!r}, {count // PROCESSES}))")
        for _ in range(PROCESSES):
            stack.enter_context(started(
                ["-c", script], env=os.environ | environment, stderr=subprocess.DEVNULL))
        client = stack.enter_context(Client(cluster.address, set_as_default=False))
        interrupts = stack.enter_context(Interrupts())
        workers = count // PROCESSES * PROCESSES
        client.wait_for_workers(workers, timeout=300)
        processes = {"scheduler": psutil.Process(cluster.scheduler.pid), "client": psutil.Process()}
        spent = {name: cpu_s(process) for name, process in processes.items()}
        begun = time.perf_counter()
        compute(store, on_cluster.OnCluster(client), (), block_s, interrupts, lambda _: None)
        wall = time.perf_counter() - begun
        busy_s = sum(one.wall_s for _, one in receipts(store, range(len(store.blocks))))
        return {
            "workers": count, "blocks": len(store.blocks), "block_s": round(block_s, 2),
            "blocks_a_s": round(len(store.blocks) / wall, 1),
            "with_start_and_end": round(busy_s / workers / wall, 3),
            **{f"{name}_core": round((cpu_s(process) - spent[name]) / wall, 2)
               for name, process in processes.items()},
            **{f"{name}_mb": round(process.memory_info().rss / 1e6)
               for name, process in processes.items()},
        }


def stored(count, folder):
    """Return processor seconds that ``count`` blocks take to be continued, closed and opened."""
    store = created(count, f"{folder}/stored.zarr")
    home = Path(store.url)
    for number in range(len(store.blocks)):
        if number % 1000 == 0:  # a file may have so many names
            chunk = home.parent / f"chunk{number}"
            chunk.write_bytes(b"x")
        for variable in store.variables:
            (home / store.chunk_key(variable.name, number)).hardlink_to(chunk)
        (home / receipt_key(number)).write_bytes(receipt_of(store, number, 2.0).to_bytes())
    calls = {
        "continue": lambda: sum(1 for _ in receipts(store, check_whole(store))),
        "status": lambda: status(store.url),
        "close": lambda: close(store),
        "sweep.open": lambda: sweep.open(store.url),
    }
    figures = {"blocks": len(store.blocks)}
    for name, call in calls.items():
        spent = time.process_time()
        call()
        figures[name] = round(time.process_time() - spent, 2)
    return figures


def main(*words):
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--workers", type=int, nargs="*", default=WORKERS)
    parser.add_argument("--waves", type=int, default=WAVES)
    parser.add_argument("--stored", type=int, nargs="*", default=[])
    options = parser.parse_args(words)
    on_cluster.on_worker = simulated_block
    execution_status.close = lambda _store: None  # it has no chunks
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))  # a worker needs several
    with tempfile.TemporaryDirectory() as folder:
        for count in options.workers:
            print(json.dumps(simulated(count, options.waves, folder)), flush=True)
    for count in options.stored:
        with tempfile.TemporaryDirectory() as folder:
            print(json.dumps(stored(count, folder)), flush=True)
