"""A board in photographs: its corners, and whether it is the board that was described."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.errors import ArgumentError, SweepError
from sweep.experiment.photographs import board_of
from sweep.measure.detectors import FindFunction
from sweep.messages import plain, shown
from sweep.model.board import Board
from sweep.model.marker import opencv_dictionary_names
from sweep.model.polygon import side_lengths
from sweep.photographs.folder import Photograph, SeenMarkers, detect_markers, fault_of, named
from sweep.typing import Floats, Integers

# --------------------------------------------------------------------------------------------------
# Corners of a board in a photograph, without a model of the camera.
#
# Of a board with a chessboard they are the chessboard's inner corners: the neighbouring markers'
# homography says where they are about, and ``cv2.cornerSubPix`` measures them. Of other boards
# they are the markers' corners, as OpenCV refines them.

#: Markers whose corners give the homography around a corner of the chessboard.
NEIGHBOURS = 4

#: Half window of the search, as a share of the distance to the nearest corner of a marker.
WINDOW_SHARE = 0.8

#: Half windows, in pixels.
MIN_WINDOW, MAX_WINDOW = 2, 11


class FoundCorners(NamedTuple):
    """The corners of a board that were found in a photograph.

    Attributes
    ----------
    points, pixels
        (n, 3) in the board's frame in m, and (n, 2) px.
    number
        (n,) numbers of the corners: of the chessboard's, or 4 · marker + corner.
    """

    points: Floats
    pixels: Floats
    number: Integers


def find_corners(image: NDArray[np.uint8], board: Board, seen: SeenMarkers) -> FoundCorners:
    """Return the corners of a board in an image in which markers were detected."""
    marker, quads = seen.among(board.marker_ids)
    if not len(board.chessboard_m):
        return FoundCorners(
            board.corners_m[marker].reshape(-1, 3), quads.reshape(-1, 2),
            (4 * marker[:, None] + np.arange(4)).ravel(),
        )
    found = {
        number: pixel for number, point in enumerate(board.chessboard_m[:, :2])
        if len(marker) > 1 and (
            pixel := _chessboard_corner(image, point, board.corners_m[marker][..., :2], quads,
                                        _pitch(board))
        ) is not None
    }
    number = np.array(list(found), dtype=np.int64)
    return FoundCorners(
        board.chessboard_m[number], np.array(list(found.values())).reshape(-1, 2), number
    )


def _chessboard_corner(
    image: NDArray[np.uint8], point: Floats, flat: Floats, quads: Floats, pitch: float
) -> Floats | None:
    """Return the pixel (2,) of a chessboard's corner between markers; None if it is not found.

    Parameters
    ----------
    image
        Grey levels.
    point, flat, quads
        The corner (2,) and the markers' corners (k, 4, 2) on the board, and the latter's pixels.
    pitch
        Side of the chessboard's squares.
    """
    distance = np.abs(flat.mean(axis=1) - point).max(axis=1)
    near = np.argsort(distance, kind="stable")[:NEIGHBOURS]
    near = near[distance[near] < 2.1 * pitch]
    if len(near) < 2 or distance[near[0]] > 1.01 * pitch:
        return None
    transform, _ = cv2.findHomography(flat[near].reshape(-1, 2), quads[near].reshape(-1, 2))
    if transform is None:
        return None
    mapped = np.asarray(transform) @ [*point, 1.0]
    start = mapped[:2] / mapped[2]
    offset = np.abs(quads[near].reshape(-1, 2) - start).max(axis=1).min()
    half = int(np.clip(WINDOW_SHARE * offset, MIN_WINDOW, MAX_WINDOW))
    border = half + 2
    if not ((border <= start) & (start < np.array(image.shape[::-1]) - border)).all():
        return None
    found = cv2.cornerSubPix(
        image, start.astype(np.float32).reshape(1, 1, 2), (half, half), (-1, -1),
        (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-3),
    ).reshape(2).astype(np.float64)
    return found if np.abs(found - start).max() < half else None


def _pitch(board: Board) -> float:
    """Return the side of a chessboard's square in m."""
    points = board.chessboard_m[:, :2]
    if len(points) < 2:
        return float(np.abs(board.corners_m[..., :2]).max())
    return float(np.linalg.norm(points[1:] - points[0], axis=1).min())


def own_corners(board: Board) -> list[Integers]:
    """Return the numbers of each marker's own corners: those that are left out of its truth.

    Of a chessboard they are the corners of the marker's square.
    """
    if not len(board.chessboard_m):
        return list(np.arange(4 * len(board)).reshape(-1, 4))
    centres, reach = board.corners_m.mean(axis=1), 0.51 * _pitch(board) * 1.2
    return [
        np.flatnonzero(np.abs(board.chessboard_m - centre).max(axis=1) < reach)
        for centre in centres
    ]


# --------------------------------------------------------------------------------------------------
# Whether photographs show the board that was described; if not, which one fits better.

#: Share of the detected markers that lie where the board has them.
MIN_FITTING = 0.8

#: Share of fitting markers from which no other board is tried.
DOUBTFUL = 0.98

#: By how much more of the markers another board must fit.
CLEARLY = 0.02

#: Distance of a corner to its place by the board's homography, as a share of the marker's side.
FITTING_SHARE = 0.2

#: Relative difference of the markers' measured side to the board's that is refused; blur makes
#: detected markers up to 5 % smaller.
MAX_SIZE_ERROR = 0.08

#: Share of the markers of a single photograph that must lie there, and how many tell.
MIN_OWN, MIN_JUDGED = 0.6, 4

#: Photographs in which other dictionaries are searched for.
MAX_TRIED = 3


def check_board(
    name: str, document: Mapping[str, Any], board: Board, seen: Sequence[SeenMarkers],
    find: FindFunction, photographs: Sequence[Photograph],
) -> None:
    """Refuse a board, of a file of that name and content, that the photographs do not show.

    Raises
    ------
    ArgumentError
        One line: the fault, and which board fits.
    """
    _check_halves(seen, photographs)
    ids = sorted({each for one in seen for each in one.ids.tolist()})
    fault = ""
    if not ids:
        fault = _no_marker(board, find, photographs)
    elif not set(ids) & set(board.marker_ids):
        fault = (f"none of its markers is in the photographs, which show IDs {shown(ids)}; correct "
                 "first_id or ids")
    else:
        _check_each(board, seen, photographs)
        fault = _other_size(board, seen) or _other_kind(document, board, seen)
    if fault:
        raise ArgumentError("board", plain(name), fault)


def _check_each(
    board: Board, seen: Sequence[SeenMarkers], photographs: Sequence[Photograph]
) -> None:
    """Refuse a few photographs of another board."""
    odd = [
        photograph.path.name for photograph, one in zip(photographs, seen, strict=False)
        if len(one.ids) >= MIN_JUDGED and fitting_share(board, [one]) < MIN_OWN
    ]
    if odd and len(odd) < len(photographs) / 2:
        raise fault_of(
            photographs[0].path.parent,
            f"{named(odd)}: less than {100 * MIN_OWN:.0f} % of the markers lie where the board "
            f"has them, unlike in {len(photographs) - len(odd)} other photographs; move those of "
            "another board elsewhere",
        )


def _other_size(board: Board, seen: Sequence[SeenMarkers]) -> str:
    """Return the fault of markers that are larger or smaller beside a board's other lengths."""
    ratio = measured_side(board, seen)
    centres = board.corners_m.mean(axis=1, keepdims=True)
    scaled = dataclasses.replace(board, corners_m=centres + ratio * (board.corners_m - centres))
    if abs(ratio - 1.0) <= MAX_SIZE_ERROR or fitting_share(scaled, seen) < MIN_FITTING:
        return ""
    side = float(np.linalg.norm(board.corners_m[0, 1] - board.corners_m[0, 0]))
    return (f"markers of {side:g} m do not fit its other lengths, beside which the photographs "
            f"show about {side * ratio:.3g} m; correct marker_m, or the squares or gaps")


def _other_kind(
    document: Mapping[str, Any], board: Board, seen: Sequence[SeenMarkers]
) -> str:
    """Return the fault of a board whose markers lie elsewhere, and which board fits better."""
    share = fitting_share(board, seen)
    if share > DOUBTFUL:
        return ""
    # Of those that fit as well, the first.
    found, better = max(
        ((fitting_share(other, seen), words) for words, other in _others(document)),
        key=lambda each: each[0], default=(0.0, ""),
    )
    if found < max(MIN_FITTING, share + CLEARLY):
        better = ""
    if share >= MIN_FITTING and not better:
        return ""
    remedy = f"{better} fits" if better else "correct its kind, its rows and columns, or its IDs"
    return f"only {100 * share:.0f} % of the detected markers lie where it has them; {remedy}"


def fitting_share(board: Board, seen: Sequence[SeenMarkers]) -> float:
    """Return the share of all detected markers that lie where a board has them."""
    fitting = 0
    for one in seen:
        marker, quads = one.among(board.marker_ids)
        if len(marker) < 2:
            continue
        flat = board.corners_m[marker, :, :2]
        transform, _ = cv2.findHomography(
            flat.reshape(-1, 2), quads.reshape(-1, 2), cv2.RANSAC,
            FITTING_SHARE * float(side_lengths(one.quads).mean()) / 2,
        )
        if transform is None:
            continue
        mapped = cv2.perspectiveTransform(flat.reshape(1, -1, 2), transform).reshape(-1, 4, 2)
        distance = np.linalg.norm(mapped - quads, axis=2).max(axis=1)
        fitting += int((distance < FITTING_SHARE * side_lengths(quads).mean(axis=1)).sum())
    return fitting / max(sum(len(one.ids) for one in seen), 1)


def measured_side(board: Board, seen: Sequence[SeenMarkers]) -> float:
    """Return the side of the markers over the board's, by the distances of their centres."""
    ratios: list[float] = []
    for one in seen:
        marker, quads = one.among(board.marker_ids)
        if len(marker) < 4:
            continue
        flat = board.corners_m[marker, :, :2]
        tolerance = float(np.ptp(flat[0], axis=0).max()) / 4
        transform, _ = cv2.findHomography(
            quads.mean(axis=1), flat.mean(axis=1), cv2.RANSAC, tolerance
        )
        if transform is None:
            continue
        back = cv2.perspectiveTransform(quads.reshape(1, -1, 2), np.asarray(transform))
        sides = side_lengths(back.reshape(-1, 4, 2)).mean(axis=1)
        ratios += (sides / side_lengths(flat).mean(axis=1)).tolist()
    return float(np.median(ratios)) if ratios else 1.0


#: Kind of a board -> keys of how many squares or markers it has across and down.
COUNTS = {
    "charuco": ("squares_x", "squares_y"), "grid": ("columns", "rows"),
    "aprilgrid": ("tagCols", "tagRows"),
}


def _others(document: Mapping[str, Any]) -> Iterator[tuple[str, Board]]:
    """Yield boards that differ from a file's in an often mistaken key, each in words."""
    kind = document.get("kind")
    if kind not in COUNTS:
        return
    across, down = COUNTS[kind]
    width, height = document[across], document[down]
    sizes: list[dict[str, Any]] = [{}, {across: height, down: width}, *(
        {across: width + x, down: height + y}
        for x, y in itertools.product((-1, 0, 1), repeat=2) if (x, y) != (0, 0)
    )]
    pattern = {"legacy_pattern": not document.get("legacy_pattern", False)}
    changes = [
        size | also for size in sizes for also in ({}, pattern if kind == "charuco" else {})
    ]
    ids = list(document.get("ids", range(width * height)))
    if kind == "grid" and len(ids) == width * height:
        lines = np.array(ids).reshape(height, width)
        changes += [
            {"ids": each.ravel().tolist(), "first_id": None}
            for each in (lines[::-1, ::-1], lines[::-1])
        ]
    for change in filter(None, changes):
        changed = {key: value for key, value in {**document, **change}.items() if value is not None}
        try:
            other = board_of(changed, "board")
        except SweepError:
            continue
        yield ", ".join(
            f"{key} = {shown(value)}" for key, value in change.items() if value is not None
        ), other


def _check_halves(seen: Sequence[SeenMarkers], photographs: Sequence[Photograph]) -> None:
    """Refuse images of two cameras side by side: most of their markers are in both halves."""
    height, width = photographs[0].image.shape
    twice = sum(one.repeated for one in seen)
    every = twice + sum(len(one.ids) for one in seen)
    if width >= 2 * height and every >= MIN_JUDGED and twice > every / 2:
        raise fault_of(
            photographs[0].path.parent,
            "most markers are in both halves of the images: of two cameras side by side give the "
            "calibration (--stereo FILE)",
        )


def _no_marker(
    board: Board, find: FindFunction, photographs: Sequence[Photograph]
) -> str:
    """Return the line for photographs without a marker of a board's dictionary."""
    tried = photographs[:MAX_TRIED]
    counts = {
        name: sum(len(detect_markers(find, each.image, name).ids) for each in tried)
        for name in opencv_dictionary_names()
    }
    best = max(counts, key=lambda name: counts[name])
    return f"no photograph shows a marker of {board.dictionary}; " + (
        f"there are {counts[best]} of {best} in the first {len(tried)}" if counts[best] > 1
        else "check that the board is in focus and wholly lit"
    )
