"""What a run leaves behind in the process of its caller: its store, and nothing else."""

import subprocess
import sys

import pytest

SCRIPT = """
import copy, json, logging, os, signal, sys, time, warnings

import cv2, dask, distributed, numba, numpy, xarray, zarr
from distributed import Client, LocalCluster


def settings():
    loggers = {name: logger for name, logger in logging.Logger.manager.loggerDict.items()
               if isinstance(logger, logging.Logger)}
    loggers[""] = logging.getLogger()
    return {
        "dask": copy.deepcopy(dask.config.config),
        "zarr": copy.deepcopy(zarr.config.config),
        "opencv": cv2.getNumThreads(),
        "numba": {n: str(getattr(numba.config, n)) for n in dir(numba.config) if n.isupper()},
        "numpy": numpy.geterr(),
        "logging": {
            name: (logger.level, logger.disabled, logger.propagate, list(logger.handlers))
            for name, logger in loggers.items()
        },
        "signals": {n: signal.getsignal(n) for n in signal.valid_signals()},
        # Dask notes the process that started workers in a variable of its own.
        "environment": {k: v for k, v in os.environ.items() if k != "__DASK_PARENT_PID"},
        "warnings": list(warnings.filters),
        "path": list(sys.path),
    }


def changes(before, after):
    found = []
    for name, old in before.items():
        new = after[name]
        if isinstance(old, dict):
            new = {key: new.get(key) for key in old}  # what was imported since adds to it
            found += [f"{name}.{key}: {old[key]} -> {new[key]}" for key in old
                      if old[key] != new[key]]
        elif name == "warnings":
            # Libraries that are imported meanwhile add filters of their own.
            found += [f"{name}: {each} is lost" for each in old if each not in new]
        elif old != new:
            found.append(f"{name}: {old} -> {new}")
    return found


def handler(number, frame):
    raise SystemExit(f"signal {number}")


PIPELINE = {"pose": {"side_px": 40, "jitter_px": 0.5}, "axes": {"trial": 3}}

if __name__ == "__main__":
    # What a caller may have set up, none of it the default.
    dask.config.set({"distributed.admin.tick.interval": "700ms", "array.chunk-size": "7MiB"})
    zarr.config.set({"async.concurrency": 7})
    cv2.setNumThreads(3)
    numba.config.THREADING_LAYER = "workqueue"
    numpy.seterr(under="warn")
    logging.getLogger("distributed").setLevel(logging.INFO)
    logging.getLogger("distributed.scheduler").setLevel(logging.DEBUG)
    logging.getLogger("distributed").addHandler(logging.NullHandler(level=7))
    signal.signal(signal.SIGINT, handler)
    signal.signal(signal.SIGTERM, handler)
    (folder,) = sys.argv[1:]
    import sweep

    def run(name, **options):
        before = settings()
        seen = []
        store = f"{folder}/{name}.zarr"
        results = sweep.run(PIPELINE, store=store, progress=seen.append, **options)
        assert int((results.detection == 1).sum()) == 3
        assert seen[-1].done == 3
        changed.extend(f"{name}: {line}" for line in changes(before, settings()))

    changed = []
    run("embedded", workers=1)
    with LocalCluster(
        n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0"
    ) as cluster, Client(cluster) as client:
        run("client", client=client)
        while client.futures:  # released futures go in the client's own time
            time.sleep(0.05)
        run("cluster", client=cluster)
        run("scheduler", scheduler=cluster.scheduler_address)
        assert client.status == "running"
        assert client.submit(sum, [1, 2, 3]).result(timeout=30) == 6
        assert distributed.default_client() is client
        assert cluster.status.name == "running"
        assert len(cluster.workers) == 1
    print(json.dumps(changed))
"""


@pytest.mark.evidence
def test_settings_of_the_caller_are_as_before_and_the_callers_client_still_computes(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    ran = subprocess.run(
        [sys.executable, script, tmp_path], capture_output=True, text=True, check=False,
        timeout=300,
    )
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.splitlines()[-1] == "[]"
