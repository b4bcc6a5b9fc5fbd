"""Which pixels show what stands beside a target."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from sweep.model import coverage
from sweep.model.board import Board
from sweep.model.exposure import marker_exposure
from sweep.model.renderers import marker_levels
from sweep.model.scene import Box, Scenes
from sweep.model.solid_board import own_sheets
from sweep.model.solid_scene import accumulate_solid
from sweep.typing import Floats, Masks

_SHARE = 1e-9
"""Share of a pixel that counts: less is rounding."""


def beside_pixels(scenes: Scenes, row: int, box: Box) -> Masks:
    """Return (height, width) which pixels of a box of one scene a distractor touches.

    With blur and motion, and the pixels next to these: to renderers that are not exact, and to
    what mixes neighbours, it is not sharper.
    """
    key = scenes.markers[scenes.marker[row]]
    if not isinstance(key, Board) or not key.distractors:
        return np.zeros((box[3] - box[1], box[2] - box[0]), dtype=bool)
    if scenes.solid[row]:
        sigma = scenes.effect(row)["blur_px"] if scenes.affected[row] else 0.0
        cover = np.zeros((box[3] - box[1], box[2] - box[0] + 2))
        area = np.array([0.0, 1.0, 1.0])
        accumulate_solid(cover, scenes, row, area, box, sigma, own_sheets(key))
        share = np.empty((box[3] - box[1], box[2] - box[0]))
        coverage.sum_levels(cover, 0.0, share)
        return _touched(share)
    alone = dataclasses.replace(key, prints=key.distractors, distractors=())
    others = dataclasses.replace(
        scenes, renderer=["exact"] * len(scenes),
        markers=tuple(alone if each is key else each for each in scenes.markers),
    )
    if scenes.affected[row]:
        share = marker_exposure(others, row, box, np.array([0.0, 1.0, 1.0, 0.0]))
    else:
        _, share = marker_levels(others, row, box)
    return _touched(share)


def _touched(share: Floats) -> Masks:
    touched = (np.abs(share) > _SHARE).astype(np.uint8)
    return np.asarray(cv2.dilate(touched, np.ones((3, 3), dtype=np.uint8)) > 0)
