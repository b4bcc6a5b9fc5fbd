"""Images of the one scene of a small pipeline, in any window."""

import numpy as np

from sweep.experiment.pipeline import Pipeline
from sweep.model.exposure import marker_boxes
from sweep.model.renderers import render_all
from sweep.model.scene import build_scenes

SMALL = """
seed = 11
[camera]
width_px = 57
height_px = 45
fx_px = 80.0
fy_px = 80.0
[marker]
size_m = 0.1
[pose]
distance_m = 0.4
tilt_deg = 35.0
azimuth_deg = 70.0
roll_deg = 25.0
[scene]
black = 30.3
white = 221.7
background = 90.4
"""
"""A marker of 20 px in a frame of 57 x 45 px, with a quiet zone that is seen."""


def scenes_of(settings=(), text=SMALL, index=0):
    read = Pipeline.from_text if isinstance(text, str) else Pipeline.from_dict
    pipeline = read(text, list(settings))
    indices = [np.array([index])] * len(pipeline.experiment.scene_axes)
    return build_scenes(pipeline.experiment.scene_values(indices), 1)


def image_of(settings=(), window=None, text=SMALL, index=0):
    """The image (h, w) in a window (left, top, right, bottom), by default the whole frame.

    ``index``: of the value on every axis.
    """
    scenes = scenes_of(settings, text, index)
    window = window or (0, 0, *scenes.frame[0].tolist())
    return render_all(scenes, np.array([0]), marker_boxes(scenes), np.array([window]))[0]
