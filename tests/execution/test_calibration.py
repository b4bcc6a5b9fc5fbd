"""What scenes cost is measured within a limit, whatever they cost."""

import math
import time

import numpy as np
import pytest

from support.reports import command
from sweep.execution import forecast as forecast_module
from sweep.execution.calibration import (
    MIN_LIMIT_S,
    BatchCost,
    Calibration,
    block_extents,
    block_time_limit_s,
    calibrate,
    calibrate_in,
    calibrate_isolated,
)
from sweep.execution.forecast import files_of, forecast
from sweep.execution.limits import BLOCK_S, BLOCKS_PER_S, MAX_BLOCKS
from sweep.isolation.child_process import Child
from sweep.plan.grid import Blocks
from sweep.plan.pipeline import Pipeline

HUGE = """
[camera]
width_px = 20000
height_px = 20000
fx_px = 20000
[scene]
renderer = "supersample-16"
window = "full"
noise_grey = 3
[pose]
jitter_px = 0.5
[axes]
side_px = [6000, 12000]
trial = 50
"""


def grid(scenes):
    return Pipeline.from_text(
        f"[pose]\njitter_px = 0.5\n[axes]\nside_px = [20, 40]\ntrial = {scenes // 2}")


def simulated(scene_s, endless=math.inf):
    """Return a cost function whose scenes take ``scene_s``; the batch with the scene of number
    ``endless`` is ended after 1 s. It notes the sizes of its batches."""
    sizes = []

    def cost(_, indices):
        sizes.append(len(indices[0]))
        if sum(sizes) > endless:
            raise TimeoutError(1.0)
        seconds = np.full(sizes[-1], scene_s)
        time.sleep(min(seconds.sum(), 0.02))
        return BatchCost(seconds.sum(), seconds, seconds.sum())

    return cost, sizes


def test_scenes_that_never_return_leave_what_was_measured_before():
    cost, sizes = simulated(1e-3, endless=40)
    measured = calibrate(grid(1000), 0.6, cost)
    assert measured.over
    # The mean is at least that of the scenes and of the batch that was ended.
    assert 1.0 / sum(sizes) < measured.scene_s < 1.1 / sizes[-1]
    assert calibrate(grid(1000), 0.6, simulated(1.0, endless=0)[0]).scene_s == 1.0


@pytest.mark.long
def test_a_scene_that_takes_too_long_ends_the_measurement_and_makes_blocks_of_single_scenes():
    pipeline = Pipeline.from_text(HUGE)
    with Child("sweep.execution.calibration") as child:
        began = time.monotonic()
        measured = calibrate_in(child, pipeline, 0.1, limit_s=0.2)
    assert measured.over
    assert time.monotonic() - began < 30  # half of it if the machine is idle
    assert min(0.2, MIN_LIMIT_S) <= measured.scene_s
    assert math.prod(block_extents(pipeline, measured, 2)) <= max(BLOCK_S / measured.scene_s, 1)
    with Child() as child:
        child.close()
        unmeasured = calibrate_isolated(child, pipeline, 0.1, 1.0)
    assert (unmeasured.sampled, unmeasured.over) == (0, False)


@pytest.mark.long
def test_plan_answers_whatever_a_scene_costs(tmp_path, monkeypatch):
    monkeypatch.setattr(forecast_module, "PLAN_SCENES_LIMIT_S", 0.2)
    (tmp_path / "huge.toml").write_text(HUGE)
    code, out, err = command("plan", tmp_path / "huge.toml")
    assert (code, err) == (0, "")
    assert "ms a pose (1 sampled, then the measurement was ended)" in out
    assert "  time     over " in out
    assert "grey noise        on   noise_grey is 3; cost not measured, poses take too long" in out


@pytest.mark.long
def test_plan_measures_each_effect_within_its_share():
    pipeline = Pipeline.from_text(
        "[scene]\nnoise_grey = 3\n[axes]\nside_px = [20, 40]\ntrial = 9")
    expected, costs = forecast(pipeline, 2, ["noise_grey"])
    assert not expected.over
    assert expected.worker_bytes > 50e6
    assert 0 < expected.pose_s < 1
    assert all(0 <= cost < expected.pose_s for cost in costs.values())


@pytest.mark.parametrize(
    ("poses", "scene_s", "workers", "block_s"),
    [
        (10**4, 1e-3, 2, 0.83),  # six blocks a worker
        (10**6, 1e-3, 8, 2.0),
        (10**8, 1e-3, 1000, 13.3),  # 75 blocks a second; 500 with blocks of 2 s
        (10**9, 1e-3, 64, 10.0),  # 100,000 blocks; 500,000 with blocks of 2 s
        (10**9, 1e-3, 1000, 13.3),
        (10**9, 0.05, 1000, 500.0),  # the same, and the time limit grows
        (10**9, 1.0, 1000, 3600.0),  # an hour at most
    ],
)
def test_blocks_grow_with_the_cluster_and_with_the_run(poses, scene_s, workers, block_s):
    pipeline = Pipeline.from_text(
        f"[pose]\njitter_px = 0.5\n[axes]\nside_px = [20, 40]\ntrial = {poses // 2}"
    )
    extents = block_extents(pipeline, Calibration(scene_s, 0.0, 1, (0.0, 0.0)), workers)
    assert math.prod(extents) * scene_s == pytest.approx(block_s, rel=0.15)
    blocks = len(Blocks((2, poses // 2), extents))
    assert blocks <= 1.1 * max(BLOCKS_PER_S * poses * scene_s / workers, 6 * workers)
    assert blocks <= MAX_BLOCKS or block_s == 3600.0
    assert block_time_limit_s(None, math.prod(extents) * scene_s) == pytest.approx(
        max(600.0, 10 * block_s), rel=0.15)
    limited = block_extents(
        pipeline, Calibration(scene_s, 0.0, 1, (0.0, 0.0)), workers, None, 30.0)
    assert math.prod(limited) * scene_s == pytest.approx(min(block_s, 3.0), rel=0.15)


@pytest.mark.parametrize("lengths", [
    (50, 200, 100_000), (999, 1001, 1003), (31, 32_258_065), (10,) * 9, (1, 14_999, 66_672),
])
@pytest.mark.parametrize("scene_s", [1e-3, 0.05])
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
    measured = Calibration(scene_s, 0.0, 1, (0.0,) * len(lengths))
    extents = block_extents(pipeline, measured, 64)
    blocks = len(Blocks(lengths, extents))
    assert blocks <= MAX_BLOCKS
    assert files_of(pipeline, blocks) <= 3_000_000
    assert math.prod(extents) * scene_s < 2.5 * math.prod(lengths) * scene_s / MAX_BLOCKS
