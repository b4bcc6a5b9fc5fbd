"""What may be wrong with the conventions of answers, where the truth fits other ones better."""

from __future__ import annotations

import itertools

import numpy as np

from sweep.exchange.answers import Answers
from sweep.exchange.conventions import CORNERS, Conventions, frame_axes, right_handed_frames
from sweep.exchange.image_set import image_batch
from sweep.plan.experiment import Pipeline
from sweep.typing import Floats, Integers

SAMPLE = 500
"""Markers that are compared with the truth."""

MIN_MARKERS = 5

MAX_TURN_RAD = 0.5
"""The median rotation error of another frame that fits."""


def hints(
    pipeline: Pipeline, answers: Answers, numbers: Integers, origins: Integers,
    conventions: Conventions,
) -> list[str]:
    """Return a line for each convention that the truth contradicts in most of the markers.

    Parameters
    ----------
    pipeline
        The export's.
    answers
        In what are said to be our conventions.
    numbers, origins
        Number of the scene, and (…, 2) first pixel in the frame, of each image.
    conventions
        Those that were said.
    """
    chosen = np.unique(np.linspace(0, max(len(answers.image) - 1, 0), SAMPLE).astype(np.int64))
    chosen = chosen[: len(answers.image)]
    if not len(chosen):
        return []
    image = answers.image[chosen]
    batch = image_batch(pipeline, numbers[image])
    scenes = batch.scenes
    right = answers.marker_id[chosen] == np.array(scenes.marker_id)
    truth = scenes.corners_px - origins[image][:, None]
    lines = []
    known = right & np.isfinite(answers.corners[chosen]).all(axis=(1, 2))
    if known.sum() >= MIN_MARKERS:
        lines += _of_corners(answers.corners[chosen][known], truth[known], conventions)
    posed = right & np.isfinite(answers.translation[chosen]).all(axis=1)
    if posed.sum() >= MIN_MARKERS:
        lines += _of_poses(
            answers.rotation[chosen][posed], answers.translation[chosen][posed],
            scenes.rotation[posed], scenes.translation[posed], conventions,
        )
    return lines


def _of_corners(corners: Floats, truth: Floats, conventions: Conventions) -> list[str]:
    """Return the lines of corners (n, 4, 2) beside the truth."""
    side = np.linalg.norm(np.roll(truth, -1, axis=1) - truth, axis=2).mean(axis=1)
    orders = list(itertools.permutations(range(4)))
    distance = np.array([
        np.median(np.linalg.norm(corners[:, order] - truth, axis=2).mean(axis=1) / side)
        for order in orders
    ])
    best = int(np.argmin(distance))
    lines = []
    if orders[best] != (0, 1, 2, 3) and distance[best] < 0.2 < distance[0]:
        # corner k of the truth is corner order[k] of the answers, which they call ...
        theirs = [""] * 4
        for k, j in enumerate(orders[best]):
            theirs[conventions.corner_order.index(CORNERS[j])] = CORNERS[k]
        lines.append(
            f'the corners come in the order {" ".join(theirs)}: pass --corner-order '
            f'"{" ".join(theirs)}"'
        )
        corners = corners[:, list(orders[best])]
    offset = np.median((corners - truth).mean(axis=1), axis=0)
    if (np.abs(np.abs(offset) - 0.5) < 0.1).all() and offset[0] * offset[1] > 0:
        center = conventions.pixel_center + round(2 * float(offset[0])) / 2
        lines.append(
            f"the corners are offset by {offset[0]:.2f}, {offset[1]:.2f} px: if the program puts "
            f"the centre of the first pixel at {center:g}, pass --pixel-center {center:g}"
        )
    return lines


def _of_poses(
    rotation: Floats, translation: Floats, true_rotation: Floats, true_translation: Floats,
    conventions: Conventions,
) -> list[str]:
    """Return the lines of poses (n, 3, 3) and (n, 3) beside the truth."""
    lines = []
    ratio = np.median(
        np.linalg.norm(translation, axis=1) / np.linalg.norm(true_translation, axis=1)
    )
    if ratio > 50 or ratio < 0.02:
        lines.append(f"the positions are {ratio:.3g} times the truth; expected metres")
    said = frame_axes(conventions.frame)
    fits = {
        words: float(np.median(_angles(rotation @ said.T @ frame_axes(words), true_rotation)))
        for words in right_handed_frames()
    }
    best = min(fits, key=fits.__getitem__)
    if best != conventions.frame and fits[best] < MAX_TURN_RAD < fits[conventions.frame]:
        words = " ".join(best)
        lines.append(f'the marker\'s x, y, z point {words}: pass --frame "{words}"')
    return lines


def _angles(rotation: Floats, truth: Floats) -> Floats:
    """Return the angles (n,) between rotations."""
    trace = np.einsum("nij,nij->n", rotation, truth)
    return np.asarray(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
