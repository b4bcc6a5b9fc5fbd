"""The scenes on which costs are measured: a seeded sample of each condition."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sweep.measure.detectors import full_frame_reason
from sweep.plan.axes import TRIAL
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import detector_settings, scene_axes

Indices = NDArray[np.intp]

MIN_SCENES, MAX_SCENES = 12, 48
"""Scenes of each condition: fewer if whole frames are searched."""

MAX_PX = 1 << 27
"""Pixels of images that are kept, over all conditions: 134 MB."""


def whole_frames_of(pipeline: Pipeline) -> list[bool]:
    """Return whether whole frames are searched, for each detector setting."""
    whole = pipeline.any_value("window", lambda value: value == "full")
    whole |= pipeline.any_value("background", lambda value: isinstance(value, str))
    return [
        whole or full_frame_reason(setting) is not None for setting in detector_settings(pipeline)
    ]


def sample_scenes(
    pipeline: Pipeline, fixed: Mapping[str, int], conditions: int
) -> list[Indices]:
    """Return a seeded sample of the scenes of a condition: (n,) indices along each scene axis.

    The cells of the axes that are not fixed have equal shares, or are drawn if they are more than
    the sample has scenes; trials are drawn.

    Parameters
    ----------
    pipeline
        Its grid is sampled; its frames decide how many scenes fit into memory.
    fixed
        Scene axis -> the index along it that makes the condition.
    conditions
        Number of conditions. The size of the sample follows from it and the pipeline alone, so that
        the same scenes are measured each time.
    """
    generator = np.random.Generator(np.random.PCG64(0))
    frame = max(pipeline.values_of("width_px")) * max(pipeline.values_of("height_px"))
    count = MIN_SCENES if any(whole_frames_of(pipeline)) else MAX_SCENES
    count = int(min(max(MAX_PX // (frame * conditions), 1), count))
    axes = scene_axes(pipeline)
    lengths = [
        1 if axis.name in fixed or axis.name == TRIAL else len(axis) for axis in axes
    ]
    cells = math.prod(lengths)
    numbers = (
        np.arange(count) * cells // count if cells <= count
        else generator.integers(0, cells, count)
    )
    indices = []
    for axis, length in zip(reversed(axes), reversed(lengths), strict=True):
        numbers, index = numbers // length, numbers % length
        if axis.name in fixed:
            index = np.full(count, fixed[axis.name])
        elif axis.name == TRIAL:
            index = generator.integers(0, len(axis), count)
        indices.append(index.astype(np.intp))
    return indices[::-1]
