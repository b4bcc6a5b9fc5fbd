"""An experiment's scenes as a set of images: their numbers, names, windows, and visibility."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sweep.evaluation.search import search_windows, visibility_flags, whole_frames
from sweep.measure.flags import DetectionStatus
from sweep.model.columns import Column
from sweep.model.extent import marker_boxes
from sweep.model.scene import Scenes, build_scenes
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import detector_settings, scene_axes, scene_values
from sweep.plan.image_keys import image_keys
from sweep.plan.scene_plugins import scene_plugins
from sweep.typing import Integers, Masks

BATCH = 256
"""Scenes that are in memory together."""


@dataclass(frozen=True, slots=True)
class ImageBatch:
    """N scenes of an experiment and their images' names.

    Attributes
    ----------
    numbers
        (N,) places in the grid of scene axes, the last axis fastest.
    keys
        (N,) keys of the images (:func:`sweep.plan.image_keys.image_keys`).
    values, scenes
        Parameters and geometry.
    visible
        (N,) whether there is an image: the marker is in the frame, and the lens model holds there.
    boxes, windows
        (N, 4) left, top, right, bottom in pixels of the frame, half-open: what the marker can
        touch, and the part of the frame that the image shows.
    """

    numbers: NDArray[np.intp]
    keys: NDArray[np.uint64]
    values: dict[str, Column]
    scenes: Scenes
    visible: Masks
    boxes: Integers
    windows: Integers

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def names(self) -> list[str]:
        """The images' names without a suffix."""
        return [
            image_name(number, key)
            for number, key in zip(self.numbers.tolist(), self.keys.tolist(), strict=True)
        ]


def image_name(number: int, key: int) -> str:
    """Return the name of an image: its number, which sorts, and half its key, which identifies.

    >>> image_name(12, 0x0123456789ABCDEF)
    '000012-89abcdef'
    """
    return f"{number:06d}-{key & 0xFFFFFFFF:08x}"


def scene_count(pipeline: Pipeline) -> int:
    """Return the number of scenes of an experiment."""
    return math.prod(len(axis) for axis in scene_axes(pipeline))


def scene_indices(pipeline: Pipeline, numbers: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Return the indices (N,) along each scene axis of scenes by their numbers (N,)."""
    lengths = tuple(len(axis) for axis in scene_axes(pipeline))
    return [np.asarray(index) for index in np.unravel_index(numbers, lengths)] if lengths else []


def image_batch(
    pipeline: Pipeline, numbers: NDArray[np.intp], *, windowed: bool = False
) -> ImageBatch:
    """Return scenes by their numbers (N,); ``windowed``: images of the marker's surroundings.

    A window is the smallest that holds those of all detector settings of the experiment.
    """
    indices = scene_indices(pipeline, numbers)
    count = len(numbers)
    values = scene_values(pipeline, indices)
    scenes = build_scenes(values, count, scene_plugins(pipeline))
    visible = visibility_flags(scenes) == DetectionStatus.not_run
    boxes = marker_boxes(scenes)
    frames = np.concatenate([np.zeros_like(scenes.frame), scenes.frame], axis=1)
    windows = frames
    if windowed:
        full = whole_frames(values, count)
        cut = [
            search_windows(scenes, boxes, setting, full) for setting in detector_settings(pipeline)
        ]
        windows = np.concatenate([
            np.min([each[:, :2] for each in cut], axis=0),
            np.max([each[:, 2:] for each in cut], axis=0),
        ], axis=1)
    return ImageBatch(
        np.asarray(numbers), image_keys(pipeline, indices), values, scenes, visible, boxes, windows
    )


def image_batches(pipeline: Pipeline, *, windowed: bool = False) -> Iterator[ImageBatch]:
    """Yield all scenes of an experiment, in the order of their numbers."""
    count = scene_count(pipeline)
    for start in range(0, count, BATCH):
        numbers = np.arange(start, min(start + BATCH, count), dtype=np.intp)
        yield image_batch(pipeline, numbers, windowed=windowed)
