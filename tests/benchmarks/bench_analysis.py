"""The analysis functions on a store of many poses: time and peak memory of each, by itself.

    python -m tests.benchmarks analysis

The store is one as `sweep run` makes it, in chunks of about 10,000 poses along the axes of the
scene, with the variables that the analyses read, filled at random. Each function runs in a fresh
interpreter on the default threads.
"""

import json
import math
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.tables import header, row
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped
from sweep.store.blocks import STAGES, Receipt, region, write_block
from sweep.store.lifecycle import create_store, finish

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
    "detection_limit": "detection_limit(results, 0.9)",
}

QUICK = {"POSES": 10**4, "CALLS": dict(list(CALLS.items())[:2])}

CHILD = """
import json, sys, time
import numpy as np
import xarray as xr
from sweep.analysis import (ambiguity, compare, detection_limit, detection_rate, error_statistics,
                            failure_composition, flip_rate, marker_ranking)
AREAS = np.geomspace(100, 40_000, 13)
begun = time.perf_counter()
results = xr.open_zarr(sys.argv[1], consolidated=False)  # no block has a receipt
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
    flags = {"detection": len(DetectionStatus), "estimate": len(EstimateStatus)}
    for block in store.blocks:
        values = chunk(rng, pipeline, block)
        for variable in store.variables:
            array = store.array(variable.name)
            some = np.full([len(range(*cut.indices(size))) for cut, size in zip(
                region(variable, pipeline, block), array.shape, strict=True)],
                array.fill_value, array.dtype)
            some[...] = values.get(variable.name, some)
            values[variable.name] = some
        counts = {name: np.bincount(values[name].ravel(), minlength=size).tolist()
                  for name, size in flags.items()}
        write_block(store, block, values, Receipt(
            run_id=store.run_id, processors=[], scenes=math.prod(block.shape),
            computed=dict.fromkeys(("scenes", "detections", "estimates"), 0), **counts,
            seconds={stage: [] for stage in STAGES}, failures=[], wall_s=0.0, written=0.0))
    finish(store, {}, {"detection": [0] * len(DetectionStatus),
                       "estimate": [0] * len(EstimateStatus)})
    return store.url, trials * POSES_A_TRIAL


def chunk(rng, pipeline, block):
    """Return plausible values of a block: small markers are missed; errors grow as they shrink."""
    scene = block.shape
    estimated = (*scene[:-1], len(pipeline.axis("solver")), scene[-1])
    sides = np.array(pipeline.axis("side_px").values)[block.starts[2]:block.stops[2], None]
    depth = np.broadcast_to(30.0 / sides, scene)
    found = rng.random(scene) < 1 - np.exp(-sides / 8)
    solved = found[..., None, :] & (rng.random(estimated) < 0.995)
    flipped = solved & (rng.random(estimated) < 0.05)
    errors = rng.standard_normal((2, *estimated, 3), dtype=np.float32)
    errors *= 0.3 / sides[..., None, None]
    errors[:, ~solved] = np.nan
    return {
        "true_tvec_m": np.stack([0 * depth, 0 * depth, depth], axis=-1),
        "marker_area_px": sides**2 * rng.uniform(0.9, 1.0, scene),
        "detection": np.where(found, DetectionStatus.detected, DetectionStatus.no_candidate),
        "estimate": np.where(solved, EstimateStatus.solved, np.where(
            found[..., None, :], EstimateStatus.solver_failed, EstimateStatus.no_detection)),
        "flipped": np.select(
            [flipped, solved], [Flipped.flipped, Flipped.not_flipped], Flipped.no_estimate),
        "rotation_error_rad": errors[0], "translation_error_m": errors[1],
        "rotation_error_deg": np.degrees(np.linalg.norm(errors[0], axis=-1)),
        "reprojection_error_px": np.where(solved, 0.1, np.nan),
        "alternative_reprojection_error_px": np.where(
            solved, rng.uniform(0.1, 1.0, estimated), np.nan),
    }


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
