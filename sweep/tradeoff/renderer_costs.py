"""The cost of each renderer, and how far its images differ from a reference's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from sweep.evaluation.opencv_threads import single_threaded
from sweep.evaluation.search import visibility_flags
from sweep.isolation.interrupts import Interrupts
from sweep.measure.flags import DetectionStatus
from sweep.model.extent import marker_boxes
from sweep.model.renderers import render_all
from sweep.model.scene import build_scenes
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import scene_values
from sweep.plan.scene_plugins import scene_plugins
from sweep.tradeoff.paired_timing import time_in_turns
from sweep.tradeoff.scene_sample import Indices
from sweep.typing import Floats


@dataclass(frozen=True, slots=True)
class RendererCosts:
    """The costs of K renderers in R rounds; NaN if no scene is visible.

    Attributes
    ----------
    seconds
        (R, K) seconds an image.
    grey_rms, grey_max
        (K,) RMS and largest difference from the reference's images, in grey levels, over the pixels
        that the marker covers there.
    """

    seconds: Floats
    grey_rms: Floats
    grey_max: Floats


@single_threaded()
def measure_renderers(
    pipeline: Pipeline, samples: Sequence[Sequence[Indices]], reference: int, limit_s: float,
    interrupts: Interrupts,
) -> RendererCosts:
    """Measure K renderers on the same scenes.

    Parameters
    ----------
    pipeline
        A pipeline whose renderer is an axis.
    samples
        For each renderer, (n,) indices along each scene axis; equal apart from the renderer's.
    reference
        Number of the renderer with which the others are compared.
    limit_s
        Time limit in seconds.
    interrupts
        Checked between two measurements.
    """
    count = len(samples[0][0])
    plugins = scene_plugins(pipeline)
    scenes = [
        build_scenes(scene_values(pipeline, indices), count, plugins) for indices in samples
    ]
    rows = np.flatnonzero(visibility_flags(scenes[reference]) == DetectionStatus.not_run)
    boxes = [marker_boxes(each)[rows] for each in scenes]
    windows = np.concatenate(
        [np.min([box[:, :2] for box in boxes], axis=0),
         np.max([box[:, 2:] for box in boxes], axis=0)],
        axis=1,
    )
    if not len(rows):
        unknown = np.full(len(scenes), np.nan)
        return RendererCosts(unknown[None], unknown, unknown)
    images = [
        render_all(each, rows, box, windows) for each, box in zip(scenes, boxes, strict=True)
    ]
    rms, largest = np.zeros(len(scenes)), np.zeros(len(scenes))
    inner = boxes[reference] - np.tile(windows[:, :2], 2)
    for k in range(len(scenes)):
        differences = [
            (image.astype(np.float64) - true)[top:bottom, left:right].ravel()
            for image, true, (left, top, right, bottom) in zip(
                images[k], images[reference], inner.tolist(), strict=True
            )
        ]
        difference = np.concatenate(differences)
        rms[k], largest[k] = np.sqrt(np.mean(difference**2)), np.abs(difference).max()
    parts = [
        partial(render_all, each, rows, box, windows)
        for each, box in zip(scenes, boxes, strict=True)
    ]
    seconds = time_in_turns(
        parts, lambda spent: np.asarray(spent / spent[:, reference : reference + 1]), limit_s,
        interrupts,
    )
    return RendererCosts(seconds / len(rows), rms, largest)
