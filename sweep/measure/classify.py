"""Classification of detections: detected, or why not."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sweep.measure.detectors import DetectorOutput
from sweep.measure.flags import DetectionStatus
from sweep.typing import Floats

_TURNS = np.array([np.roll(np.arange(4), -turn) for turn in range(4)])
"""The corners' order after each quarter turn, (4, 4)."""


class Quads(NamedTuple):
    """Quadrilaterals that lie at markers, perhaps the same one at several.

    Attributes
    ----------
    owner
        (M,) rows of the markers.
    corners_px
        (M, 4, 2) px of the frame.
    ids
        (M,) decoded IDs; -1 for rejected candidates.
    """

    owner: NDArray[np.intp]
    corners_px: Floats
    ids: NDArray[np.int64]


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
    decoded = _in_frame(
        [(row, quads, ids) for row, quads, ids, _ in searched if ids is not None], origin
    )
    flags, corners = classify_decoded(true_corners, marker_id, decoded)
    rejected = _in_frame([
        (row, quads, np.full(len(quads), -1)) for row, _, _, quads in searched
        if quads and flags[row] == DetectionStatus.no_candidate
    ], origin)
    flag_rejected(flags, true_corners, rejected)
    return flags, corners


def classify_decoded(
    true_corners: Floats, marker_id: NDArray[np.int64], decoded: Quads
) -> tuple[NDArray[np.uint8], Floats]:
    """Return the flags (N,) and corners (N, 4, 2) of N markers, ``no_candidate`` if not decoded."""
    flags = np.full(len(true_corners), DetectionStatus.no_candidate, dtype=np.uint8)
    corners = np.full_like(true_corners, np.nan)
    owner, quads, claimed = decoded
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
    return flags, corners


def flag_rejected(flags: NDArray[np.uint8], true_corners: Floats, rejected: Quads) -> None:
    """Write the flags of markers (N,) of which no more than a rejected candidate was found."""
    at_marker = _is_at_marker(rejected.corners_px, true_corners[rejected.owner])
    missed = rejected.owner[at_marker]
    flags[missed[flags[missed] == DetectionStatus.no_candidate]] = DetectionStatus.rejected


def stacked(quads: Sequence[NDArray[np.floating[Any]]]) -> Floats:
    """Return quadrilaterals (1, 4, 2) each as an array (M, 4, 2)."""
    return np.concatenate([np.zeros((0, 4, 2)), *quads])


def _in_frame(
    found: Sequence[
        tuple[int, Sequence[NDArray[np.floating[Any]]], NDArray[np.integer[Any]]]
    ],
    origin: Floats,
) -> Quads:
    """Return the quadrilaterals that windows of rows hold, with their IDs, in the frame."""
    rows = np.array([row for row, _, _ in found], dtype=np.intp)
    owner = np.repeat(rows, [len(quads) for _, quads, _ in found])
    corners = stacked([quad for _, quads, _ in found for quad in quads])
    ids = np.concatenate([np.zeros(0, np.int64), *(np.ravel(each) for _, _, each in found)])
    return Quads(owner, corners + origin[owner, None], ids)


def _is_at_marker(quads: Floats, truth: Floats) -> NDArray[np.bool_]:
    """Return (M,) whether a quadrilateral's centre lies in the true, convex one or on its edge.

    Both (M, 4, 2).
    """
    edge = np.roll(truth, -1, axis=1) - truth
    to_centre = quads.mean(axis=1)[:, None, :] - truth
    turn = edge[..., 0] * to_centre[..., 1] - edge[..., 1] * to_centre[..., 0]
    return np.asarray((turn >= 0).all(axis=1) | (turn <= 0).all(axis=1))
