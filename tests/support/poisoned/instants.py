"""Run a piece of work again and again, each time in a fork that ends or stops at a later instant.

An instant is the beginning of a write to the store (a temporary file), of a renaming or of a
removal. Arguments: the work, the store or the folder of stores, a pipeline's file, the name of a
signal, a step. Piece k meets the signal at instant k times the step; the first that meets none is
the last.

Prints how many met the signal. After SIGSTOP, it then waits for a line, has all go on, and prints
whether all ended well.
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
from sweep.execution.status import close, drop_failed
from sweep.experiment.pipeline import Pipeline
from sweep.store.lifecycle import create_store, open_store
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
    drop_failed(open_store(
        shutil.copytree(f"{folder}/complete.zarr", f"{folder}/{number}.zarr"), "r+"))


def creating(folder, file, number):
    """Make one of several empty stores."""
    create_store(f"{folder}/{number}.zarr", Pipeline.from_toml(file), (1, 1, 10))


def watched(function, left, number):
    """Return a function before whose calls this process counts down, and meets a signal at 0."""
    def watch(*arguments, **options):
        if next(left) == 0:
            os.kill(os.getpid(), number)
        return function(*arguments, **options)

    return watch


def fork(work, number, at, met):
    """Run a piece in a process; return it."""
    if pid := os.fork():
        return pid
    code = 1
    try:
        left = itertools.count(at, -1)
        local._put = watched(local._put, left, met)
        for name in ("replace", "rename", "unlink"):
            setattr(Path, name, watched(getattr(Path, name), left, met))
        work(number)
        code = 0
    except Exception as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
    finally:
        os._exit(code)


def main():
    name, url, file, met, step = sys.argv[1:]
    signal.alarm(PATIENCE_S)
    work = {"block": block, "closing": closing, "creating": creating, "dropping": dropping}[name]
    # What a process does once is done here: compiled code is loaded, libraries are digested.
    pipeline = Pipeline.from_toml(file)
    fingerprint(pipeline)
    assert pipeline.facts.notes is not None
    xr.Dataset({"any": ("one", np.zeros(1, dtype="U1"))})
    run_cells(pipeline.experiment, pipeline.experiment.all_scenes.indices(np.arange(1)))
    stopped = []
    for number in itertools.count():
        pid = fork(lambda number: work(url, file, number), number, number * int(step),
                   signal.Signals[met])
        _, status = os.waitpid(pid, os.WUNTRACED)
        if os.WIFEXITED(status):
            assert os.WEXITSTATUS(status) == 0
            break
        stopped += [pid] if os.WIFSTOPPED(status) else []
    print(number, flush=True)
    if stopped:
        sys.stdin.readline()
        for pid in stopped:
            os.kill(pid, signal.SIGCONT)
        print(all(os.WEXITSTATUS(os.waitpid(pid, 0)[1]) == 0 for pid in stopped), flush=True)


if __name__ == "__main__":
    main()
