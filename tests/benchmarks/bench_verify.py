"""What it takes to read a store of 10^6 poses, to verify it, and to find it finished.

Run it with ``python tests/benchmarks/bench_verify.py``. The store holds random numbers, which
compress as badly as results do; its flags fit them.
"""

import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import xarray as xr

from sweep.evaluation.results import CellsResult
from sweep.execution import block_task as task
from sweep.execution.status import close
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.integrity.verification import verify
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped
from sweep.store.lifecycle import create_store

GRID = """
[pose]
jitter_px = 0.5
[axes]
marker_id = { range = [0, 50] }
distance_m = { linspace = [0.1, 2, 200] }
trial = 100
"""
EXTENTS = (1, 200, 50)
ROUNDS = 7


def noisy_cells(experiment, indices, need=None):  # noqa: ARG001
    """Return random results of the scenes at ``indices``, nine in ten of them solved."""
    count = len(indices[0])
    generator = np.random.default_rng([int(index[0]) for index in indices])
    solved = generator.random(count) < 0.9
    flags = {
        "bound": np.zeros(count),
        "detection": np.where(solved, DetectionStatus.detected, DetectionStatus.rejected),
        "estimate": np.where(solved, EstimateStatus.solved, EstimateStatus.no_detection),
        "flipped": np.where(solved, Flipped.not_flipped, Flipped.no_estimate),
    }
    absent = ("bound_", "mirror", "predicted", "nees", "residual")
    columns = {}
    for variable in experiment.variables:
        if variable.flags is not None:
            values = flags[variable.name]
        else:
            values = generator.normal(size=(count, *variable.inner_shape))
            if variable.name.startswith(absent):
                values[:] = np.nan
            elif variable.stage is not Stage.scene:
                values[~solved] = np.nan
        columns[variable.name] = values.astype(variable.dtype)[None]
    seconds = {"scene": [1e-6], "detection": [1e-6], "estimation": [1e-6]}
    return CellsResult(columns, seconds, np.full(count, 1e-7))


def timed(function, *arguments):
    """Return the seconds that a call takes."""
    start = time.perf_counter()
    function(*arguments)
    return time.perf_counter() - start


def read(url):
    """Read all of a store's root with xarray."""
    with xr.open_zarr(url, chunks=None) as results:
        for name in results.variables:
            results[name].to_numpy()


def main():
    """Make the store, and print the figures."""
    task.run_cells = noisy_cells
    with tempfile.TemporaryDirectory() as folder:
        url, path = f"{folder}/large.zarr", Path(folder) / "large.toml"
        path.write_text(GRID)
        pipeline = Pipeline.from_toml(path)
        store = create_store(url, pipeline, EXTENTS)
        for block in store.blocks:
            task.compute_block(url, store.run_id, block)
        close(store)
        found = verify(url, 0)
        print(f"{found.blocks} blocks, {found.files:,} files, {found.bytes / 1e6:.0f} MB, "
              f"{len(found.damage)} damaged")
        pairs = [(timed(read, url), timed(verify, url, 0)) for _ in range(ROUNDS)]
        plain, checked = (statistics.median(times) for times in zip(*pairs, strict=True))
        ratio = statistics.median(ours / theirs for theirs, ours in pairs)
        print(f"plain read {plain:.2f} s, verify {checked:.2f} s, ratio {ratio:.2f} "
              f"({', '.join(f'{ours / theirs:.2f}' for theirs, ours in pairs)})")
        command = [sys.executable, "-m", "sweep", "run", str(path), "--store", url]
        waits = [
            timed(lambda: subprocess.run(command, check=True, capture_output=True))
            for _ in range(ROUNDS)
        ]
        print(f"finished store found finished in {statistics.median(waits):.2f} s "
              f"({min(waits):.2f} to {max(waits):.2f})")


if __name__ == "__main__":
    main()
