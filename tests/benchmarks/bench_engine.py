"""The engine against bare processes, and against itself in pieces.

    python tests/benchmarks/bench_engine.py [SECONDS]

Each part works for about SECONDS (default 60) on all cores; ratios within one run.
"""

import itertools
import multiprocessing
import statistics
import sys
import tempfile
import time

import numpy as np
from tables import header, row

from sweep.evaluation.block import run_cells
from sweep.execution.forecast import forecast, seconds_of
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
START_S = 8.0
"""Seconds that independent processes have to start."""
REPEATS = 3


def grid(trials):
    """Return the text of a pipeline, and its scenes a trial."""
    text = GRID.format(trials=trials, markers=MARKERS, distances=DISTANCES)
    return text, 4 * MARKERS * DISTANCES


def grid_for(seconds, workers):
    """Return a pipeline that keeps ``workers`` busy for about ``seconds``."""
    text, scenes = grid(2)
    one = Pipeline.from_text(text)
    spent_s, sampled = seconds_of(one, 1536)
    trials = max(int(seconds * workers * sampled / (spent_s * scenes)), 8)
    return Pipeline.from_text(grid(trials)[0]), trials


def bare(text, start, stop, seconds, at):
    """Run the kernel alone on a part of the trials; report scenes and time."""
    pipeline = Pipeline.from_text(text)
    axes = pipeline.experiment.scene_axes
    run_cells(pipeline.experiment, [np.zeros(1, dtype=np.intp) for _ in axes])
    while time.time() < at:
        time.sleep(0.001)
    begun = time.perf_counter()
    done = 0
    for trial in range(start, stop):
        lengths = tuple(len(axis) for axis in axes)
        block = Block((0, 0, 0, trial), (*lengths[:3], trial + 1))
        run_cells(pipeline.experiment, block.indices())
        done += len(block)
    seconds.put((done, time.perf_counter() - begun))


def two_processes(text, trials, workers):
    """Return scenes per second of independent processes that run the bare kernel."""
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    cuts = np.linspace(0, trials, workers + 1).astype(int)
    at = time.time() + START_S
    processes = [
        context.Process(target=bare, args=(text, int(a), int(b), queue, at))
        for a, b in itertools.pairwise(cuts)
    ]
    for process in processes:
        process.start()
    told = [queue.get() for _ in processes]
    for process in processes:
        process.join()
    return sum(done for done, _ in told) / max(spent for _, spent in told)


def engine_against_processes(seconds):
    workers = default_workers()
    pipeline, trials = grid_for(seconds, workers)
    expected = forecast(pipeline, workers).seconds
    rates = []
    for _ in range(REPEATS):
        bare_rate = two_processes(pipeline.text, trials, workers)
        with tempfile.TemporaryDirectory() as folder:
            begun = time.perf_counter()
            first = []
            summary = execute(
                pipeline, f"{folder}/s.zarr", workers=workers,
                progress=lambda p, first=first: first.append((time.perf_counter(), p.done)),
            )
            total = time.perf_counter() - begun
        # Between a block of each worker's and the last of all, none is coming or going.
        (a, done_a), (b, done_b) = first[workers], first[-1 - workers]
        rates.append(
            (
                (done_b - done_a) / (b - a) / bare_rate,
                total / (summary.poses / bare_rate),
                total - summary.poses / bare_rate,
                expected / total,
            )
        )
    steady, whole, extra, predicted = (statistics.median(x) for x in zip(*rates, strict=True))
    row(f"{workers} workers / {workers} bare processes, while at work", f"{steady:.2f}")
    row(f"whole run of {total:.0f} s / bare kernel time", f"{whole:.2f}")
    row("start, measuring, shutdown beside that", f"{extra:.1f} s")
    row("predicted / measured time", f"{predicted:.2f}")


def shared_work():
    """Compare 4 refinements x 5 solvers in one sweep with 20 separate sweeps."""
    text = grid(1)[0] + SETTINGS
    together = Pipeline.from_text(text)
    axes = together.experiment.scene_axes
    indices = [g.ravel() for g in np.indices([len(axis) for axis in axes])]
    ratios = []
    for _ in range(REPEATS):
        begun = time.perf_counter()
        one = run_cells(together.experiment, indices)
        joint = time.perf_counter() - begun
        apart = 0.0
        for k, refinement in enumerate(("none", "subpix", "contour", "apriltag")):
            for j, solver in enumerate(("ippe_square", "ippe", "iterative", "sqpnp", "p3p")):
                single = Pipeline.from_text(
                    text, [f"cornerRefinementMethod={refinement}", f"solver={solver}"]
                )
                begun = time.perf_counter()
                other = run_cells(single.experiment, indices)
                apart += time.perf_counter() - begun
                for name in ("estimate", "rotation_error_rad", "reprojection_error_px"):
                    np.testing.assert_array_equal(
                        one.columns[name][5 * k + j], other.columns[name][0]
                    )
        ratios.append(apart / joint)
    ratio = statistics.median(ratios)
    row("20 sweeps / one sweep of 4 refinements x 5 solvers", f"{ratio:.1f}")


def main():
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 60.0
    header("engine", "ratio")
    shared_work()
    engine_against_processes(seconds)


if __name__ == "__main__":
    main()
