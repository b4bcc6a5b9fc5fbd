"""Blurred images: exact ones of many times the resolution, seen by pixels through a Gaussian."""

import dataclasses

import numpy as np
from scipy.special import ndtr

from sweep.model.effects import NEUTRAL
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


class FineImage:
    """The exact image of a scene, ``pad`` pixels around the frame too."""

    def __init__(self, value, pad):
        self.shape = value["height_px"], value["width_px"]
        self.background, self.pad = value["background"], pad
        fine = value | {"fx_px": FINE * value["fx_px"]}
        for size, centre in (("width_px", "cx_px"), ("height_px", "cy_px")):
            fine |= {size: FINE * value[size], centre: FINE * value[size] / 2 - 0.5}
        height, width = (FINE * (side + pad) for side in self.shape)
        self.levels = sharp_of(fine, (-FINE * pad, -FINE * pad, width, height)) - self.background

    def seen(self, sigma, columns=None, rows=None):
        """Levels (rows, columns) through a Gaussian of ``sigma`` px, by default of all pixels."""
        def shares(at, side, count):
            at = np.arange(side) if at is None else np.asarray(at)
            fine = (np.arange(count) + 0.5) / FINE - 0.5 - self.pad
            ends = ((at[:, None] + half - fine) / sigma for half in (0.5, -0.5))
            upper, lower = map(ndtr, ends)
            return (upper - lower) / FINE

        down = shares(rows, self.shape[0], self.levels.shape[0])
        across = shares(columns, self.shape[1], self.levels.shape[1])
        return down @ self.levels @ across.T + self.background
