"""Classification of detections: detected, or why not."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.measure.detector import DetectorOutput
from sweep.measure.flags import DetectionStatus
from sweep.typing import Floats

_TURNS = np.array([np.roll(np.arange(4), -turn) for turn in range(4)])
"""The corners' order after each quarter turn, (4, 4)."""


def classify(
    true_corners: Floats, marker_id: NDArray[np.int64],
    searched: Sequence[tuple[int, *DetectorOutput]], origin: Floats,
) -> tuple[NDArray[np.uint8], Floats]:
    """Return the flags (N,) of N markers, and the corners (N, 4, 2) of those detected (else NaN).

    Parameters
    ----------
    true_corners, marker_id
        (N, 4, 2) px and (N,): the truth.
    searched
        Row and detector's output of each scene that was searched. Of several right markers the
        nearest counts.
    origin
        (N, 2) px: the top left pixel of the window that was searched.
    """
    flags = np.full(len(true_corners), DetectionStatus.no_candidate, dtype=np.uint8)
    corners = np.full_like(true_corners, np.nan)
    decoded = [(row, quads, ids) for row, quads, ids, _ in searched if ids is not None]
    if decoded:
        owner, quads = _in_frame([(row, some) for row, some, _ in decoded], origin)
        claimed = np.concatenate([ids for _, _, ids in decoded]).ravel()
        at_marker = _is_at_marker(quads, true_corners[owner])
        flags[owner[at_marker]] = DetectionStatus.wrong_id
        right = np.flatnonzero(at_marker & (claimed == marker_id[owner]))
        offset = quads[right][:, _TURNS] - true_corners[owner[right]][:, None]
        squared = (offset**2).sum(axis=(2, 3))
        upright = np.argmin(squared, axis=1) == 0
        # From far to near, so that the nearest is written last.
        order = right[upright][np.argsort(-squared[upright, 0], kind="stable")]
        flags[owner[order]] = DetectionStatus.detected
        corners[owner[order]] = quads[order]
    missed = flags == DetectionStatus.no_candidate
    rejected = [(row, quads) for row, _, _, quads in searched if quads and missed[row]]
    if rejected:
        owner, quads = _in_frame(rejected, origin)
        flags[owner[_is_at_marker(quads, true_corners[owner])]] = DetectionStatus.rejected
    return flags, corners


def _in_frame(
    quads: Sequence[tuple[int, Sequence[NDArray[np.floating[Any]]]]], origin: Floats
) -> tuple[NDArray[np.intp], Floats]:
    """Return the rows (M,) and the corners (M, 4, 2) in the frame of quadrilaterals in windows."""
    rows = np.array([row for row, _ in quads], dtype=np.intp)
    owner = np.repeat(rows, [len(each) for _, each in quads])
    corners = np.concatenate([quad for _, each in quads for quad in each])
    return owner, corners.astype(np.float64) + origin[owner, None]


def _is_at_marker(quads: Floats, truth: Floats) -> NDArray[np.bool_]:
    """Return (M,) whether a quadrilateral's centre lies in the true, convex one or on its edge.

    Both (M, 4, 2).
    """
    edge = np.roll(truth, -1, axis=1) - truth
    to_centre = quads.mean(axis=1)[:, None, :] - truth
    turn = edge[..., 0] * to_centre[..., 1] - edge[..., 1] * to_centre[..., 0]
    return np.asarray((turn >= 0).all(axis=1) | (turn <= 0).all(axis=1))
