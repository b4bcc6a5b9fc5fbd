"""Blurred images: exact ones of many times the resolution, seen by pixels through a Gaussian."""

import dataclasses

import numpy as np
from scipy.special import ndtr

from sweep.model.effects import NEUTRAL
from sweep.model.exposure import marker_boxes, marker_exposure
from sweep.model.renderers import marker_levels
from sweep.model.scene import build_scenes

FINE = 16
"""Finer pixels along a side of a pixel.

They hold mean levels, so an edge in one is off by up to half of it: what is seen converges as
1 / FINE², and is off by a third of the 0.24 levels that 8 and 16 differ by."""


def sharp_of(value, box, plane=None):
    """Exact levels of a box without any effect, optionally of a marker in another place."""
    scenes = build_scenes(value | NEUTRAL, 1)
    if plane is not None:
        scenes = dataclasses.replace(scenes, plane=np.ascontiguousarray(plane)[None])
    mean, share = marker_levels(scenes, 0, box)
    return mean + (1 - share) * value["background"]


def exposure_of(value, box, plane=None):
    """Levels of a box with all effects, optionally of a marker in another place."""
    scenes = build_scenes(value, 1)
    if plane is not None:
        scenes = dataclasses.replace(scenes, plane=np.ascontiguousarray(plane)[None])
    areas = np.array([value[name] for name in ("background", "black", "white", "occluder")])
    return marker_exposure(scenes, 0, box, areas)


def frame_of(value):
    """Levels (height, width) of the frame under test: the background beyond the marker's box."""
    frame = np.full((value["height_px"], value["width_px"]), value["background"])
    scenes = build_scenes(value, 1)
    box = left, top, right, bottom = marker_boxes(scenes)[0].tolist()
    if right > left:
        exposed = exposure_of if scenes.effects.active[0] else sharp_of
        frame[top:bottom, left:right] = exposed(value, box)
    return frame


def finer(value):
    """The scene in a camera that has FINE x FINE pixels for each."""
    fine = value | {name: FINE * value[name] for name in ("fx_px", "width_px", "height_px")}
    return fine | {f"c{axis}_px": FINE * value[side] / 2 - 0.5
                   for axis, side in (("x", "width_px"), ("y", "height_px"))}


def finer_box(low, high, pad):
    """The box of finer pixels from ``low`` to ``high``, and ``pad`` pixels around."""
    return tuple(FINE * at for at in (low[0] - pad, low[1] - pad, high[0] + pad, high[1] + pad))


def through_gaussian(levels, pad, sigma, columns=None, rows=None):
    """What pixels (rows, columns) see of finer levels through a Gaussian of ``sigma`` px.

    By default of all but the ``pad`` pixels around; beyond these is 0.
    """
    def shares(at, count):
        at = np.arange(count // FINE - 2 * pad) if at is None else np.asarray(at)
        fine = (np.arange(count) + 0.5) / FINE - 0.5 - pad
        upper, lower = (ndtr((at[:, None] + half - fine) / sigma) for half in (0.5, -0.5))
        return (upper - lower) / FINE

    return shares(rows, levels.shape[0]) @ levels @ shares(columns, levels.shape[1]).T


class FineImage:
    """The exact image of a scene, ``pad`` pixels around the frame too."""

    def __init__(self, value, pad):
        box = finer_box((0, 0), (value["width_px"], value["height_px"]), pad)
        self.background, self.pad = value["background"], pad
        self.levels = sharp_of(finer(value), box) - self.background

    def seen(self, sigma, columns=None, rows=None):
        """Levels (rows, columns) through a Gaussian of ``sigma`` px, by default of all pixels."""
        seen = through_gaussian(self.levels, self.pad, sigma, columns, rows)
        return seen + self.background
