"""Locus: its detector of markers, and its estimator of boards."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.adapters import adapter, install
from sweep.plugins import EstimatorPlugin, Markers, Poses, parameter

# --------------------------------------------------------------------------------------------------
# The detector of the package locus-tag, for AprilTag's and ArUco's dictionaries.

FAMILIES = {
    "DICT_4X4_50": "ArUco4x4_50",
    "DICT_4X4_100": "ArUco4x4_100",
    "DICT_6X6_250": "ArUco6x6_250",
    "DICT_APRILTAG_16h5": "AprilTag16h5",
    "DICT_APRILTAG_36h11": "AprilTag36h11",
    "DICT_ARUCO_MIP_36h12": "ArUcoMip36h12",
}


@dataclass(frozen=True)
class LocusSettings:
    """The profile, and choices beside it."""

    locus_profile: str = parameter(
        "standard", "Locus: the shipped profile of settings",
        choices=("standard", "grid", "high_accuracy"),
    )
    locus_decimation: int = parameter(
        1, "Locus: decimation of the image before the search", low=1, high=64
    )


def make(settings: LocusSettings, family: str) -> Callable[[Any], Markers]:
    """Return the search for markers of one family."""
    import locus  # noqa: PLC0415  (optional)

    detector = locus.Detector(
        profile=settings.locus_profile, decimation=settings.locus_decimation, threads=1,
        families=[getattr(locus.TagFamily, family)],
    )

    def search(image: Any) -> Markers:
        found = detector.detect(image)
        return Markers(found.corners, found.ids, found.rejected_corners)

    return search


DETECTOR = adapter("locus-tag", "Locus", make, LocusSettings, FAMILIES, pixel_center=0.5)


# --------------------------------------------------------------------------------------------------
# The board estimators of the package locus-tag, which detects and solves on its own.

Floats = NDArray[np.float64]

#: From our board's frame (y up, z out) to Locus', which has the same origin (y down, z in).
_Z_IN = np.diag([1.0, -1.0, -1.0])

#: How far a corner may be from where Locus has it, in sides: rounding.
SAME = 1e-6


@dataclass(frozen=True)
class LocusBoardSettings:
    """The detector's profile, and the corners of a chessboard that are used."""

    locus_board_profile: str = parameter(
        "standard", "Locus' boards: the shipped profile of settings",
        choices=("standard", "grid", "high_accuracy"),
    )
    locus_chessboard: bool = parameter(
        True, "Locus' boards: of a charuco, the corners of its chessboard (CharucoRefiner) in "
        "place of those of its markers (BoardEstimator)",
    )


def make_board_estimator(settings: LocusBoardSettings) -> Callable[[Any], Poses]:
    """Return the estimator of boards' poses from their images."""
    import locus  # noqa: PLC0415  (optional)

    estimators: dict[Any, tuple[Any, Any]] = {}

    def estimator_of(board: Any, scale: float) -> tuple[Any, Any]:
        """Return Locus' detector for a board, and its estimator; kept."""
        if (board, scale) not in estimators:
            if board.dictionary not in FAMILIES:
                raise ValueError(f"locus-tag has no family for {board.dictionary}")
            family = getattr(locus.TagFamily, FAMILIES[board.dictionary])
            detector = locus.Detector(
                profile=settings.locus_board_profile, threads=1, families=[family]
            )
            estimators[board, scale] = detector, _estimator(locus, board, scale, family, settings)
        return estimators[board, scale]

    def solve(detections: Any) -> Poses:
        count = len(detections.targets)
        rotation, translation = np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan)
        covariance = np.full((count, 6, 6), np.nan)
        for i, (board, image) in enumerate(
            zip(detections.targets, detections.images, strict=True)
        ):
            if detections.cameras.distorted[i]:
                raise ValueError("locus-tag is built without lenses: expected none")
            detector, estimator = estimator_of(board, float(detections.scale[i]))
            fx, fy, cx, cy = detections.cameras.view[i].tolist()
            left, top = detections.origins[i].tolist()
            # The centre of Locus' first pixel is at 0.5.
            camera = locus.CameraIntrinsics(fx, fy, cx - left + 0.5, cy - top + 0.5)
            found = estimator.estimate(detector, np.ascontiguousarray(image), camera)
            if found.board_pose is None:
                continue
            turn = _rotation(found.board_pose[3:])
            rotation[i], translation[i] = turn @ _Z_IN, found.board_pose[:3]
            if found.board_cov is not None:
                # Theirs is along the board's axes.
                to_camera = np.kron(np.eye(2), turn)
                covariance[i] = to_camera @ found.board_cov @ to_camera.T
        return Poses(rotation, translation, covariance)

    return solve


def _estimator(
    locus: Any, board: Any, scale: float, family: Any, settings: LocusBoardSettings
) -> Any:
    """Return Locus' estimator of a board; ValueError for a board that it cannot describe."""
    if board.marker_ids != tuple(range(len(board))):
        raise ValueError("locus-tag numbers markers from 0 in reading order: expected marker_id 0")
    squares = board.chessboard
    if squares is not None:
        if not (squares.legacy_pattern and squares.squares_y % 2 == 0):
            raise ValueError(
                "locus-tag's charucos have a marker at the top left: expected "
                "legacy_pattern = true and an even number of squares_y"
            )
        charuco = locus.CharucoBoard(
            squares.squares_y, squares.squares_x, squares.square_m * scale,
            squares.marker_m * scale, family,
        )
        if settings.locus_chessboard:
            return locus.CharucoRefiner(charuco)
        return locus.BoardEstimator.from_charuco(charuco)
    rows, columns, gap_m, side_m = _grid(board.corners_m)
    return locus.BoardEstimator(
        locus.AprilGrid(rows, columns, gap_m * scale, side_m * scale, family)
    )


def _grid(corners_m: Floats) -> tuple[int, int, float, float]:
    """Return rows, columns, gap and side of a grid whose markers have corners (n, 4, 3) in metres.

    ValueError for another board.
    """
    side = float(np.linalg.norm(corners_m[0, 1] - corners_m[0, 0]))
    columns = int((np.abs(corners_m[:, 0, 1] - corners_m[0, 0, 1]) < SAME * side).sum())
    rows = len(corners_m) // columns
    step = side if len(corners_m) == 1 else float(
        np.linalg.norm(corners_m[1, 0] - corners_m[0, 0])  # the next of the row, or of the column
    )
    row, column = np.indices((rows, columns)).reshape(2, -1)
    middles = np.stack([column - (columns - 1) / 2, (rows - 1) / 2 - row], axis=1) * step
    square = np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]]) * side / 2
    expected = np.zeros((len(middles), 4, 3))
    expected[..., :2] = middles[:, None] + square
    if len(expected) != len(corners_m) or np.abs(expected - corners_m).max() > SAME * side:
        raise ValueError("locus-tag has grids and charucos: expected kind = grid")
    return rows, columns, step - side, side


def _rotation(quaternion: Floats) -> Floats:
    """Return the rotation (3, 3) of a quaternion w, x, y, z of any length."""
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])


SOLVER = EstimatorPlugin(
    make=make_board_estimator, settings=LocusBoardSettings, needs_images=True, of_boards=True,
    meaning="Locus' own board estimator (locus-tag): it searches the image by itself",
    distribution="locus-tag", install=install("locus-tag"),
)
