"""The analysis functions on a store of many poses: time and peak memory of each, by itself.

    python -m tests.benchmarks analysis

The store is one as `sweep run` makes it, in chunks of about 10,000 poses along the axes of the
scene, with the variables that the analyses read, filled at random. Each function runs in a fresh
interpreter on the default threads.
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.bench_scale import receipt_of
from benchmarks.tables import header, row
from support.small_datasets import perfect, with_every_flag
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import EstimateStatus
from sweep.store.blocks import write_block
from sweep.store.lifecycle import create_store, write_groups

POSES = 10**7

GRID = """
seed = 1
[marker]
size_m = 0.04
[pose]
jitter_px = 0.5
[axes]
marker_id = {{ range = [0, 50] }}
tilt_deg = [0, 25, 50, 75]
side_px = {{ geom = [10, 200, 25] }}
solver = ["ippe_square", "iterative"]
trial = {trials}
"""
POSES_A_TRIAL = 50 * 4 * 25 * 2
DIMS = ("marker_id", "tilt_deg", "side_px", "solver", "trial")
EXTENTS = (1, 4, 25)
TRIALS_A_CHUNK = 50  # 10,000 poses

CALLS = {
    "open and look": "results",
    "detection_rate": "detection_rate(results, ('tilt_deg', 'side_px'))",
    "detection_rate, bins": "detection_rate(results, bins={'marker_area_px': AREAS})",
    "flip_rate": "flip_rate(results, ('solver', 'tilt_deg'))",
    "failure_composition": "failure_composition(results, ('solver', 'side_px'))",
    "error_statistics, all": "error_statistics(results)",
    "error_statistics": "error_statistics(results, ('solver', 'tilt_deg', 'side_px'))",
    "error_statistics, bins":
        "error_statistics(results, ('solver',), {'marker_area_px': AREAS})",
    "ambiguity": "ambiguity(results, ('tilt_deg', 'side_px'))",
    "marker_ranking": "marker_ranking(results)",
    "compare": "compare(results.isel(solver=0), results.isel(solver=1), ('tilt_deg',))",
    "requirement_limits": "requirement_limits(results, ['detection >= 0.9'], 'side_px')",
}

QUICK = {"POSES": 10**4, "CALLS": dict(list(CALLS.items())[1:2])}

CHILD = """
import json, sys, time
import numpy as np
import sweep
from sweep.analysis import (ambiguity, compare, detection_rate, error_statistics,
                            failure_composition, flip_rate, marker_ranking, requirement_limits)
AREAS = np.geomspace(100, 40_000, 13)
begun = time.perf_counter()
results = sweep.open(sys.argv[1])
table = {call}
done = time.perf_counter()
assert "looked_for" not in table or table["looked_for"].sum() > 0  # the store was read
# Not ru_maxrss, which begins at the parent's size.
status = dict(line.split(":", 1) for line in open("/proc/self/status"))
print(json.dumps({{"peak": int(status["VmHWM"].split()[0]) * 1024, "seconds": done - begun,
                   "values": sum(a.size for a in table.data_vars.values())}}))
"""


def write_store(folder, poses):
    """Write a store of about so many poses, at least one chunk; return its place and its poses."""
    trials = max(poses // POSES_A_TRIAL, 1)
    pipeline = Pipeline.from_text(GRID.format(trials=trials))
    store = create_store(
        str(Path(folder) / f"{poses}.zarr"), pipeline, (*EXTENTS, min(TRIALS_A_CHUNK, trials)))
    rng = np.random.default_rng(1)
    for number, block in enumerate(store.blocks):
        *scene, draws = block.shape
        sizes = dict(zip(DIMS, (*scene, 2, draws), strict=True))
        values = with_every_flag(rng, perfect(rng, sizes), good=0.9)
        solved = values["estimate"] == EstimateStatus.solved
        for name in ("reprojection_error_px", "alternative_reprojection_error_px"):
            values[name] = solved.dims, rng.uniform(0.1, 1.0, solved.shape)
            values[name] = values[name].where(solved)
        contents = {each.name: values.get(each.name, each.fill) for each in store.variables}
        write_block(store, block, contents, receipt_of(store, number, 0.0))
    write_groups(store, {}, counts={})
    return store.url, trials * POSES_A_TRIAL


def measured(store, call):
    """Run a call on a store in a fresh interpreter; return its figures."""
    return json.loads(subprocess.check_output(
        [sys.executable, "-c", CHILD.format(call=call), store], text=True))


def main():
    with tempfile.TemporaryDirectory(prefix="sweep-bench-") as folder:
        begun = time.perf_counter()
        store, written = write_store(folder, POSES)
        print(f"{written:,} poses written in {time.perf_counter() - begun:.0f} s")
        header("call", "s", "peak MB", "values")
        for name, call in CALLS.items():
            found = measured(store, call)
            row(name, f"{found['seconds']:.1f}", f"{found['peak'] / 1e6:.0f}",
                f"{found['values']:,}")
