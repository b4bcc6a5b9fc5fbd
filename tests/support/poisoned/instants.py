"""Run a piece of work again and again, each time in a fork that is killed at a later instant.

An instant is the beginning of a write to the store (a temporary file), of a renaming or of a
removal. Arguments: the work, the store or the folder of stores, a pipeline's file, a step. Piece k
is killed at instant k times the step; the first that ends before is the last.

Prints how many were killed.
"""

import itertools
import os
import shutil
import signal
import sys
from pathlib import Path

import numpy as np
import xarray as xr
import zarr.storage._local as local

from sweep.evaluation.block import run_cells
from sweep.execution.block_task import compute_block
from sweep.execution.status import close, failed_blocks
from sweep.experiment.pipeline import Pipeline
from sweep.store.lifecycle import create_store, open_store, reopen
from sweep.store.provenance import fingerprint

PATIENCE_S = 300


def block(url, _, number):
    """Compute, write and commit one block of a store."""
    store = open_store(url, "r+")
    compute_block(url, store.run_id, store.blocks[number])


def closing(folder, _, number):
    """Close a copy of a complete store, as a run does."""
    close(open_store(shutil.copytree(f"{folder}/complete.zarr", f"{folder}/{number}.zarr"), "r+"))


def dropping(folder, _, number):
    """Drop the blocks with failed cells of a copy of a complete store."""
    store = open_store(
        shutil.copytree(f"{folder}/complete.zarr", f"{folder}/{number}.zarr"), "r+")
    reopen(store, drop=failed_blocks(store, range(len(store.blocks))))


def creating(folder, file, number):
    """Make one of several empty stores."""
    create_store(f"{folder}/{number}.zarr", Pipeline.from_toml(file), (1, 1, 10))


def watched(function, left):
    """Return a function before whose calls this process counts down, and is killed at 0."""
    def watch(*arguments, **options):
        if next(left) == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*arguments, **options)

    return watch


def fork(work, number, at):
    """Run a piece in a process; return it."""
    if pid := os.fork():
        return pid
    code = 1
    try:
        left = itertools.count(at, -1)
        local._put = watched(local._put, left)
        for name in ("replace", "rename", "unlink"):
            setattr(Path, name, watched(getattr(Path, name), left))
        work(number)
        code = 0
    except Exception as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
    finally:
        os._exit(code)


def main():
    name, url, file, step = sys.argv[1:]
    signal.alarm(PATIENCE_S)
    work = {"block": block, "closing": closing, "creating": creating, "dropping": dropping}[name]
    # What a process does once is done here: compiled code is loaded, libraries are digested.
    pipeline = Pipeline.from_toml(file)
    fingerprint(pipeline)
    assert pipeline.facts.notes is not None
    xr.Dataset({"any": ("one", np.zeros(1, dtype="U1"))})
    run_cells(pipeline.experiment, pipeline.experiment.all_scenes.indices(np.arange(1)))
    for number in itertools.count():
        pid = fork(lambda number: work(url, file, number), number, number * int(step))
        _, status = os.waitpid(pid, 0)
        if os.WIFEXITED(status):
            assert os.WEXITSTATUS(status) == 0
            break
    print(number, flush=True)


if __name__ == "__main__":
    main()
