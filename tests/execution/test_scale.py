"""Memory stays flat and plans stay lazy, whatever the size of the grid."""

import json
import os
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from support.clusters import Cluster
from sweep.experiment.grid import Blocks
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline

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
synthetic.install()
from sweep.execution.runner import execute
from sweep.experiment.grid import Blocks
from sweep.experiment.pipeline import Pipeline
import sweep.execution.runner as engine
extents = 1, 200, max(int(sys.argv[4]) // 50, 1)
engine.blocks_of = lambda *_: Blocks((50, 200, int(sys.argv[4])), extents)
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
    print(f"client {small['peak'] / 1e6:.0f} and {large['peak'] / 1e6:.0f} MB, scheduler "
          f"{small['scheduler'] / 1e6:.0f} and {large['scheduler'] / 1e6:.0f} MB")
    assert large["peak"] < 300e6
    assert large["peak"] < 1.1 * small["peak"]
    assert large["scheduler"] < 1.25 * small["scheduler"]


def test_a_billion_poses_are_planned_lazily():
    pipeline = Pipeline.from_text(GRID % 100_000)
    assert pipeline.size(Stage.scene) == 10**9
    blocks = Blocks(tuple(len(axis) for axis in pipeline.experiment.scene_axes), (1, 200, 20))
    assert len(blocks) == 250_000
    assert blocks.number(blocks[249_999]) == 249_999
    assert str(blocks[249_999]) == "49-50,0-200,99980-100000"
