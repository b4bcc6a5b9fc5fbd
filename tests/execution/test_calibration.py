"""Costs and sizes: measured within a limit, memory flat and plans lazy, whatever the grid."""

import itertools
import json
import math
import os
import subprocess
import sys
from pathlib import Path
from unittest import mock

import numpy as np
import psutil
import pytest

from support.clusters import Cluster
from support.here import Here
from sweep.execution import forecast
from sweep.experiment.grid import Blocks
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.isolation.child_process import ChildDiedError

PIPELINE = Pipeline.from_text("[pose]\nside_px = 20\njitter_px = 0.5\n[axes]\ntrial = 50\n")


@pytest.mark.parametrize(("error", "timing"), [
    (ChildDiedError("time limit", timed_out=True),
     forecast.Timing(forecast.TIMING_LIMIT_S, 1, over=True)),
    (ChildDiedError("SIGSEGV"), forecast.Timing(forecast.UNMEASURED_S, 0)),
])
def test_scenes_that_take_too_long_or_crash_are_taken_for_slow_ones(error, timing):
    child = Here()
    child.call = mock.Mock(side_effect=error)
    assert forecast.measure(child, PIPELINE) == timing
    blocks = forecast.blocks_of(PIPELINE, timing.pose_s, 2)
    assert math.prod(blocks.extents) <= max(forecast.BLOCK_S / timing.pose_s, 1)


def test_processes_are_counted_by_the_work_that_is_left():
    timing = forecast.Timing(1.5 * forecast.SMALL_RUN_S / PIPELINE.size(Stage.scene), 50)
    assert forecast.process_count(PIPELINE, timing, None) == len(os.sched_getaffinity(0))
    assert forecast.process_count(PIPELINE, timing, None, 0.5) == 1
    assert forecast.process_count(PIPELINE, timing, 3, 0.5) == 3


@pytest.mark.parametrize(
    ("poses", "scene_s", "workers", "block_s"),
    [
        (10**4, 1e-3, 2, 0.83),  # six blocks a worker
        (10**6, 1e-3, 8, 2.0),
        (10**8, 1e-3, 1000, 13.3),  # 75 blocks a second; 500 with blocks of 2 s
        (10**9, 1e-3, 64, 10.0),  # 100,000 blocks; 500,000 with blocks of 2 s
        (10**9, 0.05, 1000, 500.0),  # the same, and the time limit grows
    ],
)
def test_blocks_grow_with_the_cluster_and_with_the_run(poses, scene_s, workers, block_s):
    pipeline = Pipeline.from_text(
        f"[pose]\njitter_px = 0.5\n[axes]\nside_px = [20, 40]\ntrial = {poses // 2}"
    )
    cut = forecast.blocks_of(pipeline, scene_s, workers)
    extents, blocks = cut.extents, len(cut)
    assert math.prod(extents) * scene_s == pytest.approx(block_s, rel=0.15)
    assert blocks <= 1.1 * max(forecast.BLOCKS_PER_S * poses * scene_s / workers, 6 * workers)
    assert blocks <= forecast.MAX_BLOCKS
    assert forecast.block_time_limit_s(None, math.prod(extents) * scene_s) == pytest.approx(
        max(600.0, 10 * block_s), rel=0.15)
    limited = forecast.blocks_of(pipeline, scene_s, workers, 30.0)
    assert math.prod(limited.extents) * scene_s == pytest.approx(
        min(block_s, 3.0), rel=0.15, abs=scene_s)


@pytest.mark.parametrize("scene_s", [1e-3, 0.05])
@pytest.mark.parametrize("lengths", [
    (50, 200, 100_000), (31, 32_258_065), (10,) * 9, (1, 14_999, 66_672),
])
def test_no_grid_of_a_billion_poses_makes_more_blocks_and_files_than_a_disk_can_bear(
    lengths, scene_s
):
    names = ("side_px", "tilt_deg", "azimuth_deg", "roll_deg", "bearing_x_deg", "bearing_y_deg",
             "noise_grey", "blur_px")[:len(lengths) - 1]
    axes = "\n".join(
        f"{name} = {{ linspace = [1, 2, {length}] }}" if length > 1 else f"{name} = [1]"
        for name, length in zip(names, lengths[:-1], strict=True)
    )
    pipeline = Pipeline.from_text(
        f"[pose]\njitter_px = 0.5\n[axes]\n{axes}\ntrial = {lengths[-1]}")
    blocks = forecast.blocks_of(pipeline, scene_s, 64)
    assert len(blocks) <= forecast.MAX_BLOCKS
    timing = forecast.Timing(scene_s, 1)
    assert forecast.forecast_of(".", pipeline, timing, blocks, 64, len(blocks)).files <= 3_000_000
    assert math.prod(blocks.extents) < 2.5 * math.prod(lengths) / forecast.MAX_BLOCKS


SUPPORT = Path(__file__).parents[1] / "support"

GRID = """
[pose]
jitter_px = 0.5
[axes]
marker_id = { range = [0, 50] }
distance_m = { linspace = [0.1, 2, 200] }
trial = %d
"""

CLIENT = """
import json, sys
import synthetic
synthetic.dask_setup()
from sweep.execution import forecast
from sweep.execution.runner import execute
from sweep.experiment.grid import Blocks
from sweep.experiment.pipeline import Pipeline
extents = 1, 200, max(int(sys.argv[4]) // 50, 1)
forecast.blocks_of = lambda *_: Blocks((50, 200, int(sys.argv[4])), extents)
summary = execute(Pipeline.from_toml(sys.argv[1]), sys.argv[2], scheduler=sys.argv[3])
# Not ru_maxrss, which begins at the parent's size.
status = dict(line.split(":", 1) for line in open("/proc/self/status"))
peak = int(status["VmHWM"].split()[0]) * 1024
print(json.dumps({"peak": peak, "blocks": summary.blocks, "poses": summary.poses}))
"""


def run_synthetic(folder, trials):
    """Run a grid of 10,000 x ``trials`` poses on a scheduler process with two workers."""
    path = os.pathsep.join(filter(None, [str(SUPPORT), os.environ.get("PYTHONPATH")]))
    pipeline, store = folder / f"grid{trials}.toml", folder / f"{trials}.zarr"
    pipeline.write_text(GRID % trials)
    with Cluster(folder / f"cluster{trials}", environment={"PYTHONPATH": path}) as cluster:
        cluster.nannies(2, "--preload", "synthetic")
        ran = subprocess.run(
            [sys.executable, "-c", CLIENT, str(pipeline), str(store), cluster.address,
             str(trials)],
            env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, check=False,
        )
        assert ran.returncode == 0, ran.stderr
        grown = psutil.Process(cluster.scheduler.pid).memory_info().rss
        return {**json.loads(ran.stdout), "scheduler": grown, "store": store}


@pytest.mark.evidence
def test_memory_of_client_and_scheduler_does_not_grow_with_the_grid(tmp_path):
    small = run_synthetic(tmp_path, 10)
    large = run_synthetic(tmp_path, 1000)
    assert (small["poses"], large["poses"]) == (10**5, 10**7)
    assert large["peak"] < 300e6
    assert large["peak"] < 1.1 * small["peak"]
    assert large["scheduler"] < 1.25 * small["scheduler"]


def test_blocks_cover_the_grid_once_and_a_billion_poses_are_planned_lazily():
    scenes = [tuple(np.transpose(block.indices())) for block in Blocks((7, 5), (3, 2))]
    assert len(scenes) == 9
    cells = sorted(tuple(cell) for block in scenes for cell in block)
    assert cells == list(itertools.product(range(7), range(5)))
    pipeline = Pipeline.from_text(GRID % 100_000)
    assert pipeline.size(Stage.scene) == 10**9
    blocks = Blocks(tuple(len(axis) for axis in pipeline.experiment.scene_axes), (1, 200, 20))
    assert len(blocks) == 250_000
    assert blocks.number(blocks[249_999]) == 249_999
    assert str(blocks[249_999]) == "49-50,0-200,99980-100000"
