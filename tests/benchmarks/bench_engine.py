"""The engine against bare processes, and against itself in pieces.

    python -m tests.benchmarks engine

Each part works for about a minute on all cores; ratios within one run.
"""

import functools
import itertools
import multiprocessing
import statistics
import tempfile
import time
from collections import deque
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from benchmarks.tables import header, row
from sweep.cli.commands import forecast
from sweep.evaluation.block import run_cells
from sweep.execution.forecast import seconds_of
from sweep.execution.runner import execute
from sweep.experiment.grid import Block
from sweep.experiment.pipeline import Pipeline
from sweep.isolation.child_process import default_workers

GRID = """
seed = 1
[marker]
size_m = 0.04
[pose]
jitter_px = 0.5
[scene]
background = 128
[axes]
marker_id = {{ range = [0, {markers}] }}
tilt_deg = [0, 20, 40, 60]
distance_m = {{ geom = [0.2, 2.0, {distances}] }}
trial = {trials}
"""

SETTINGS = """
cornerRefinementMethod = ["none", "subpix", "contour", "apriltag"]
solver = ["ippe_square", "ippe", "iterative", "sqpnp", "p3p"]
"""

MARKERS, DISTANCES = 10, 20
REPEATS = 3
SECONDS = 60.0
QUICK = {"SECONDS": 0.5, "MARKERS": 1, "DISTANCES": 3, "REPEATS": 1}


def grid(trials):
    """Return the text of a pipeline, and its scenes a trial."""
    text = GRID.format(trials=trials, markers=MARKERS, distances=DISTANCES)
    return text, 4 * MARKERS * DISTANCES


def grid_for(workers):
    """Return a pipeline that keeps ``workers`` busy for about ``SECONDS``, and its trials."""
    text, scenes = grid(2)
    one = Pipeline.from_text(text)
    spent_s, sampled = seconds_of(one, 1536)
    trials = max(int(SECONDS * workers * sampled / (spent_s * scenes)), 8)
    return Pipeline.from_text(grid(trials)[0]), trials


@functools.cache
def experiment_of(text):
    return Pipeline.from_text(text).experiment


def bare(text, trial):
    """Run the kernel alone on a trial."""
    experiment = experiment_of(text)
    lengths = [len(axis) for axis in experiment.scene_axes[:-1]]
    run_cells(experiment, Block((0, 0, 0, trial), (*lengths, trial + 1)).indices())


def begin(text, gate):
    """Compile, and wait until all processes have."""
    bare(text, 0)
    gate.wait()


def bare_rate(text, trials, workers):
    """Return scenes per second of independent processes that run the bare kernel."""
    spawn = multiprocessing.get_context("spawn")
    gate = spawn.Barrier(workers)
    with ProcessPoolExecutor(workers, spawn, begin, (text, gate)) as processes:
        deque(processes.map(functools.partial(bare, text), [0] * workers), maxlen=0)
        begun = time.perf_counter()
        deque(processes.map(functools.partial(bare, text), range(trials)), maxlen=0)
        return trials * grid(1)[1] / (time.perf_counter() - begun)


def engine_against_processes():
    workers = default_workers()
    pipeline, trials = grid_for(workers)
    expected = forecast(pipeline, workers).seconds
    rates = []
    for _ in range(REPEATS):
        rate = bare_rate(pipeline.text, trials, workers)
        with tempfile.TemporaryDirectory() as folder:
            begun = time.perf_counter()
            ends = []
            summary = execute(
                pipeline, f"{folder}/s.zarr", workers=workers,
                progress=lambda p, ends=ends: ends.append((time.perf_counter(), p.done)),
            )
            total = time.perf_counter() - begun
        # Between a block of each worker's and the last of all, none is coming or going.
        (a, done_a), (b, done_b) = ends[workers], ends[-1 - workers]
        rates.append((
            (done_b - done_a) / (b - a) / rate,
            total / (summary.poses / rate),
            total - summary.poses / rate,
            expected / total,
        ))
    steady, whole, extra, predicted = map(statistics.median, zip(*rates, strict=True))
    row(f"{workers} workers / {workers} bare processes, while at work", f"{steady:.2f}")
    row(f"whole run of {total:.0f} s / bare kernel time", f"{whole:.2f}")
    row("start, measuring, shutdown beside that", f"{extra:.1f} s")
    row("predicted / measured time", f"{predicted:.2f}")


def shared_work():
    """Compare 4 refinements x 5 solvers in one sweep with 20 separate sweeps."""
    together = Pipeline.from_text(grid(1)[0] + SETTINGS)
    indices = np.indices([len(axis) for axis in together.experiment.scene_axes])
    indices = list(indices.reshape(len(indices), -1))

    def seconds(refinement, solver):
        one = Pipeline.from_text(
            together.text, [f"cornerRefinementMethod={refinement}", f"solver={solver}"])
        begun = time.perf_counter()
        run_cells(one.experiment, indices)
        return time.perf_counter() - begun

    ratios = []
    for _ in range(REPEATS):
        begun = time.perf_counter()
        run_cells(together.experiment, indices)
        joint = time.perf_counter() - begun
        apart = sum(seconds(*each) for each in itertools.product(
            *(together.axis(name).values for name in ("cornerRefinementMethod", "solver"))))
        ratios.append(apart / joint)
    row("20 sweeps / one sweep of 4 refinements x 5 solvers", f"{statistics.median(ratios):.1f}")


def main():
    header("engine", "ratio")
    shared_work()
    engine_against_processes()
