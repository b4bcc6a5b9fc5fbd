"""Dask clusters of which every part is a process, so that it can be killed."""

import contextlib
import json
import logging
import os
import time

import psutil
from distributed import LocalCluster

from support.commands import started


@contextlib.contextmanager
def local_cluster(workers=1, **options):
    """Yield a cluster that this process starts, of workers of one thread."""
    with LocalCluster(
        n_workers=workers, threads_per_worker=1, host="127.0.0.1",
        dashboard_address="127.0.0.1:0", silence_logs=logging.CRITICAL, **options,
    ) as cluster:
        yield cluster


CLIENT = """
import sys
from sweep.execution import forecast
from sweep.execution.runner import execute
from sweep.experiment.pipeline import Pipeline

if __name__ == "__main__":
    pipeline, store, scheduler, block_s = sys.argv[1:]
    forecast.block_work_s = lambda *_: float(block_s)
    execute(Pipeline.from_toml(pipeline), store, workers=2, scheduler=scheduler or None)
"""
"""As `sweep run`, its blocks small."""


class Cluster:
    """A scheduler, and workers that are started beside it; all end with the ``with`` block.

    Parameters
    ----------
    folder
        Where files and logs lie.
    options
        Of ``dask scheduler`` and ``dask worker``, such as certificates.
    environment
        Variables beside this process's.
    """

    def __init__(self, folder, options=(), protocol="tcp", environment=None):
        self._folder, self._options, self._protocol = folder, options, protocol
        self._environment = {**os.environ, "DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL": "5s",
                             **(environment or {})}
        self._stack, self._count = contextlib.ExitStack(), 0

    def __enter__(self):
        self._folder.mkdir(exist_ok=True)
        file = self._folder / "scheduler.json"
        file.unlink(missing_ok=True)
        self.scheduler = self._start(
            "scheduler", "--port", "0", "--protocol", self._protocol, "--scheduler-file", file)
        deadline = time.monotonic() + 60
        while not (file.exists() and file.stat().st_size):
            assert time.monotonic() < deadline, self.log()
            time.sleep(0.05)
        self.address = json.loads(file.read_text())["address"]
        return self

    def __exit__(self, *_):
        self._stack.close()

    def worker(self, *options):
        """Start a worker of one thread, without a nanny that would begin it again."""
        return self.nannies(1, "--no-nanny", *options)

    def nannies(self, count, *options):
        """Start the process of ``count`` nannies, each with a worker of one thread."""
        return self._start(
            "worker", self.address, "--nworkers", count, "--nthreads", "1", "--local-directory",
            self._folder, *options)

    def log(self):
        """Return what all its processes said."""
        return "\n".join(path.read_text() for path in self._folder.glob("dask_*.log"))

    def _start(self, name, *arguments):
        self._count += 1
        log = self._stack.enter_context(
            (self._folder / f"dask_{name}_{self._count}.log").open("w"))
        return self._stack.enter_context(started(
            ["-m", f"distributed.cli.dask_{name}", *arguments, "--host", "127.0.0.1",
             "--no-dashboard", *self._options],
            stdout=log, stderr=log, env=self._environment))


def workers_below(process):
    """Return the worker processes that nannies below a process started."""
    found = []
    with contextlib.suppress(psutil.Error):
        for child in psutil.Process(process.pid).children(recursive=True):
            with contextlib.suppress(psutil.Error):
                if any(word in " ".join(child.cmdline()) for word in ("spawn_main", "serve(")):
                    found.append(child)
    return found
