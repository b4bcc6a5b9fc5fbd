"""What a detection is worth: was the marker found, and if not, why."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sweep.measure.flags import Detection

Floats = NDArray[np.float64]

REJECTED_ID = -1
"""Stands for the ID of a candidate that could not be decoded."""


def _inside(points: Floats, quadrilaterals: Floats) -> NDArray[np.bool_]:
    """Tell which points (M, 2) lie in, or on the edge of, their convex quadrilateral (M, 4, 2)."""
    edge = np.roll(quadrilaterals, -1, axis=1) - quadrilaterals
    to_point = points[:, None, :] - quadrilaterals
    turn = edge[..., 0] * to_point[..., 1] - edge[..., 1] * to_point[..., 0]
    return np.asarray((turn >= 0).all(axis=1) | (turn <= 0).all(axis=1))


def classify(
    true_corners: Floats,
    marker_id: NDArray[np.int64],
    owner: NDArray[np.intp],
    found_id: NDArray[np.int64],
    found: Floats,
) -> tuple[NDArray[np.uint8], Floats]:
    """Return what became of N markers, and the corners (N, 4, 2) of those detected (else NaN).

    Parameters
    ----------
    true_corners, marker_id
        (N, 4, 2) px and (N,): the truth.
    owner, found_id, found
        (M,) the scene, (M,) the ID or ``REJECTED_ID``, (M, 4, 2) px of all that was found. Of
        several right ones the nearest counts.
    """
    flags = np.full(len(true_corners), Detection.no_candidate, dtype=np.uint8)
    corners = np.full_like(true_corners, np.nan)
    truth = true_corners[owner]
    there = _inside(found.mean(axis=1), truth)
    decoded = found_id != REJECTED_ID
    flags[owner[there & ~decoded]] = Detection.rejected
    flags[owner[there & decoded]] = Detection.wrong_id
    squared = np.stack(
        [((np.roll(found, -turn, axis=1) - truth) ** 2).sum(axis=(1, 2)) for turn in range(4)],
        axis=1,
    )
    right = there & (found_id == marker_id[owner]) & (np.argmin(squared, axis=1) == 0)
    flags[owner[right]] = Detection.detected
    # From far to near, so that the nearest is written last.
    order = np.flatnonzero(right)
    order = order[np.argsort(-squared[order, 0], kind="stable")]
    corners[owner[order]] = found[order]
    return flags, corners
