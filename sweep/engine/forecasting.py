"""What a run would take: blocks, bytes, memory and time, from a short calibration."""

from __future__ import annotations

import math
import resource
from dataclasses import dataclass

from sweep.engine.calibration import block_extents, calibrate
from sweep.engine.cluster import default_workers
from sweep.engine.runner import CALIBRATION_S
from sweep.errors import StoreError
from sweep.plan.grid import Blocks, scene_axes
from sweep.plan.parameters import Stage
from sweep.plan.pipeline import Pipeline
from sweep.plan.template import bytes_per_block

START_S = 3.0
"""Seconds that a run takes beside its blocks: processes start and end, packages are imported."""


@dataclass(frozen=True, slots=True)
class Forecast:
    """What is to be expected of a run."""

    poses: int
    results: int
    block: tuple[int, ...]
    blocks: int
    bytes: int
    worker_bytes: int
    pose_s: float
    sampled: int
    workers: int
    seconds: float


def forecast(pipeline: Pipeline, workers: int | None = None) -> Forecast:
    """Return what a run with ``workers`` processes would take; nothing is written."""
    if workers is None:
        workers = default_workers()
    if workers < 1:
        raise StoreError(f"--workers {workers}: expected at least 1")
    calibration = calibrate(pipeline, CALIBRATION_S)
    extents = block_extents(pipeline, calibration, workers)
    blocks = Blocks(tuple(len(axis) for axis in scene_axes(pipeline)), extents)
    poses = pipeline.size(Stage.scene)
    busy = min(workers, default_workers(), len(blocks))
    process = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return Forecast(
        poses=poses,
        results=pipeline.size(*Stage),
        block=extents,
        blocks=len(blocks),
        bytes=bytes_per_block(pipeline, poses),
        worker_bytes=process + 3 * bytes_per_block(pipeline, math.prod(extents)),
        pose_s=calibration.scene_s,
        sampled=calibration.sampled,
        workers=workers,
        seconds=START_S + poses * calibration.scene_s / busy,
    )
