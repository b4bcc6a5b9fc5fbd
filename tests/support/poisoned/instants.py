"""Run pieces of work in forked processes, each of which ends or stops at an instant of its own.

An instant is the beginning of a write to the store (a temporary file), of a renaming or of a
removal; they are numbered. Arguments: the work, the store or the folder of stores, a
pipeline's file, the name of a signal, and a JSON list of [number of the piece, instant].

Prints one line of JSON: for each piece, the signal that it met (0: none) and the instants that it
came to see. After SIGSTOP, it then waits for a line, has all go on, and prints their exit
statuses.
"""

import json
import os
import signal
import sys
from pathlib import Path

import zarr.storage._local as local

from sweep.evaluation.block import run_cells
from sweep.execution.block_task import compute_block
from sweep.execution.status import close
from sweep.experiment.pipeline import Pipeline
from sweep.store.lifecycle import create_store, open_store

PATIENCE_S = 300


def block(url, file, number):
    """Compute, write and commit one block of a store."""
    del file
    store = open_store(url, "r+")
    compute_block(url, store.run_id, store.blocks[number])


def closing(url, file, number):
    """Close one of several complete stores, as a run does."""
    del file
    store = open_store(f"{url}/{number}.zarr", "r+")
    close(store)


def creating(url, file, number):
    """Make one of several empty stores."""
    create_store(f"{url}/{number}.zarr", Pipeline.from_toml(file), (1, 1, 10))


class Instants:
    """Counts instants as they come, and sends this process a signal at one of them."""

    def __init__(self, at, number, pipe):
        self._at, self._signal, self._pipe = at, number, pipe
        local._put = self._watched(local._put)
        for name in ("replace", "rename", "unlink"):
            setattr(Path, name, self._watched(getattr(Path, name)))

    def _watched(self, function):
        def watched(*arguments, **options):
            self._next()
            return function(*arguments, **options)

        return watched

    def _next(self):
        os.write(self._pipe, b".")
        if self._at == 0:
            os.kill(os.getpid(), self._signal)
        self._at -= 1


def fork(work, given, number, at, signal_number):
    """Run a piece in a process; return its number and the pipe in which it counts."""
    read, write = os.pipe()
    pid = os.fork()
    if pid:
        os.close(write)
        return pid, read
    code = 1
    try:
        Instants(at, signal_number, write)
        work(*given, number)
        code = 0
    except Exception as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
    finally:
        os._exit(code)


def main():
    name, url, file, signal_name, instants = sys.argv[1:]
    signal.alarm(PATIENCE_S)
    work = {"block": block, "closing": closing, "creating": creating}[name]
    if work is block:
        # Compiled code is loaded once, here.
        store = open_store(url)
        run_cells(store.pipeline.experiment, store.blocks[0].indices())
    told, stopped = [], []
    for number, at in json.loads(instants):
        pid, pipe = fork(work, (url, file), number, at, signal.Signals[signal_name])
        _, status = os.waitpid(pid, os.WUNTRACED)
        if os.WIFSTOPPED(status):
            stopped.append(pid)
            told.append([os.WSTOPSIG(status), None])
        else:
            met = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
            told.append([met, len(os.read(pipe, 100_000))])
    print(json.dumps(told), flush=True)
    if signal_name == "SIGSTOP":
        sys.stdin.readline()
        for pid in stopped:
            os.kill(pid, signal.SIGCONT)
        print(json.dumps([os.WEXITSTATUS(os.waitpid(pid, 0)[1]) for pid in stopped]), flush=True)


if __name__ == "__main__":
    main()
