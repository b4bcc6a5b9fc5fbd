"""What a detection is worth: was the marker found, and if not, why."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sweep.measure.detector import Found
from sweep.measure.flags import DetectionStatus
from sweep.typing import Floats

_TURNS = np.array([np.roll(np.arange(4), -turn) for turn in range(4)])
"""The corners' order after each quarter turn, (4, 4)."""


def classify(
    true_corners: Floats, marker_id: NDArray[np.int64], found: Sequence[tuple[int, *Found]],
    origin: Floats,
) -> tuple[NDArray[np.uint8], Floats]:
    """Return what became of N markers, and the corners (N, 4, 2) of those detected (else NaN).

    Parameters
    ----------
    true_corners, marker_id
        (N, 4, 2) px and (N,): the truth.
    found
        Of each scene that was searched its row and what the search gave. Of several right
        markers the nearest counts.
    origin
        (N, 2) px: the top left pixel of the window that was searched.
    """
    flags = np.full(len(true_corners), DetectionStatus.no_candidate, dtype=np.uint8)
    corners = np.full_like(true_corners, np.nan)
    decoded = [(row, quads, ids) for row, quads, ids, _ in found if ids is not None]
    if decoded:
        owner, quads = _placed([(row, some) for row, some, _ in decoded], origin)
        claimed = np.concatenate([ids for _, _, ids in decoded]).ravel()
        there = _there(quads, true_corners[owner])
        flags[owner[there]] = DetectionStatus.wrong_id
        right = np.flatnonzero(there & (claimed == marker_id[owner]))
        away = quads[right][:, _TURNS] - true_corners[owner[right]][:, None]
        squared = (away**2).sum(axis=(2, 3))
        upright = np.argmin(squared, axis=1) == 0
        # From far to near, so that the nearest is written last.
        order = right[upright][np.argsort(-squared[upright, 0], kind="stable")]
        flags[owner[order]] = DetectionStatus.detected
        corners[owner[order]] = quads[order]
    missed = flags == DetectionStatus.no_candidate
    rejected = [(row, quads) for row, _, _, quads in found if quads and missed[row]]
    if rejected:
        owner, quads = _placed(rejected, origin)
        flags[owner[_there(quads, true_corners[owner])]] = DetectionStatus.rejected
    return flags, corners


def _placed(
    found: Sequence[tuple[int, Sequence[NDArray[np.float32]]]], origin: Floats
) -> tuple[NDArray[np.intp], Floats]:
    """Return the rows (M,) and the corners (M, 4, 2) in the frame of quadrilaterals in windows."""
    rows = np.array([row for row, _ in found], dtype=np.intp)
    owner = np.repeat(rows, [len(quads) for _, quads in found])
    joined = np.concatenate([quad for _, quads in found for quad in quads])
    return owner, joined.astype(np.float64) + origin[owner, None]


def _there(found: Floats, truth: Floats) -> NDArray[np.bool_]:
    """Tell (M,) whether the centre of a quadrilateral lies in the true, convex one or on its edge.

    Both (M, 4, 2).
    """
    edge = np.roll(truth, -1, axis=1) - truth
    to_centre = found.mean(axis=1)[:, None, :] - truth
    turn = edge[..., 0] * to_centre[..., 1] - edge[..., 1] * to_centre[..., 0]
    return np.asarray((turn >= 0).all(axis=1) | (turn <= 0).all(axis=1))
