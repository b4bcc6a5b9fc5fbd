"""Locus: its detector of markers, and its estimator of boards."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from sweep.adapters import adapter
from sweep.plugins import DetectorPlugin, EstimatorPlugin, Markers, Poses, parameter

# --------------------------------------------------------------------------------------------------
# The detector, for AprilTag's and ArUco's dictionaries.

FAMILIES = {
    "DICT_4X4_50": "ArUco4x4_50",
    "DICT_4X4_100": "ArUco4x4_100",
    "DICT_6X6_250": "ArUco6x6_250",
    "DICT_APRILTAG_16h5": "AprilTag16h5",
    "DICT_APRILTAG_36h11": "AprilTag36h11",
    "DICT_ARUCO_MIP_36h12": "ArUcoMip36h12",
}

PROFILES = ("standard", "grid", "high_accuracy")


@dataclass(frozen=True)
class LocusSettings:
    """The profile, and choices beside it."""

    locus_profile: str = parameter(
        "standard", "Locus: the shipped profile of settings", choices=PROFILES)
    locus_decimation: int = parameter(
        1, "Locus: decimation of the image before the search", 1, 64)


def make(settings: LocusSettings, family: str) -> Callable[[Any], Markers]:
    """Return the search for markers of one family."""
    import locus  # noqa: PLC0415  (optional)

    detector = locus.Detector(
        profile=settings.locus_profile, decimation=settings.locus_decimation, threads=1,
        families=[getattr(locus.TagFamily, family)])

    def search(image: Any) -> Markers:
        found = detector.detect(image)
        return Markers(found.corners, found.ids, found.rejected_corners)

    return search


DETECTOR = adapter(
    DetectorPlugin, "locus-tag", "Locus", make, LocusSettings, families=FAMILIES, pixel_center=0.5)


# --------------------------------------------------------------------------------------------------
# The estimators of boards, which detect and solve on their own.

#: From our board's frame (y up, z out) to Locus', which has the same origin (y down, z in).
_Z_IN = np.diag([1.0, -1.0, -1.0])

#: Corners (4, 2) of an upright square of side 1.
_SQUARE = np.array([[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]])


@dataclass(frozen=True)
class LocusBoardSettings:
    """The detector's profile, and the corners of a chessboard that are used."""

    locus_board_profile: str = parameter(
        "standard", "Locus' boards: the shipped profile of settings", choices=PROFILES)
    locus_chessboard: bool = parameter(
        True, "Locus' boards: of a charuco, the corners of its chessboard (CharucoRefiner) in "
        "place of those of its markers (BoardEstimator)")


def make_board_estimator(settings: LocusBoardSettings) -> Callable[[Any], Poses]:
    """Return the estimator of boards' poses from their images."""
    import locus  # noqa: PLC0415  (optional)
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  (slow to import)

    @lru_cache(maxsize=64)
    def tools(board: Any, scale: float) -> tuple[Any, Any]:
        """Return Locus' detector for a board, and its estimator; ValueError if it has none."""
        if board.dictionary not in FAMILIES:
            raise ValueError(f"locus-tag has no family for {board.dictionary}")
        family = getattr(locus.TagFamily, FAMILIES[board.dictionary])
        detector = locus.Detector(
            profile=settings.locus_board_profile, threads=1, families=[family])
        if board.marker_ids != tuple(range(len(board))):
            raise ValueError(
                "locus-tag numbers markers from 0 in reading order: expected marker_id 0")
        squares = board.chessboard
        if squares is None:
            rows, columns, gap_m, side_m = grid_of(board.corners_m)
            return detector, locus.BoardEstimator(
                locus.AprilGrid(rows, columns, gap_m * scale, side_m * scale, family))
        if not (squares.legacy_pattern and squares.squares_y % 2 == 0):
            raise ValueError(
                "locus-tag's charucos have a marker at the top left: expected "
                "legacy_pattern = true and an even number of squares_y")
        charuco = locus.CharucoBoard(
            squares.squares_y, squares.squares_x, squares.square_m * scale,
            squares.marker_m * scale, family)
        chosen = locus.CharucoRefiner if settings.locus_chessboard else (
            locus.BoardEstimator.from_charuco)
        return detector, chosen(charuco)

    def solve(detections: Any) -> Poses:
        count = len(detections.targets)
        poses = Poses(*(np.full((count, *shape), np.nan) for shape in ((3, 3), (3,), (6, 6))))
        for i, (board, image) in enumerate(
            zip(detections.targets, detections.images, strict=True)
        ):
            if detections.cameras.distorted[i]:
                raise ValueError("locus-tag is built without lenses: expected none")
            detector, estimator = tools(board, float(detections.scale[i]))
            fx, fy, cx, cy = detections.cameras.view[i].tolist()
            left, top = detections.origins[i].tolist()
            # The centre of Locus' first pixel is at 0.5.
            camera = locus.CameraIntrinsics(fx, fy, cx - left + 0.5, cy - top + 0.5)
            found = estimator.estimate(detector, np.ascontiguousarray(image), camera)
            if found.board_pose is None:
                continue
            # Quaternions are w, x, y, z there.
            turn = Rotation.from_quat(np.roll(found.board_pose[3:], -1)).as_matrix()
            poses.rotation[i], poses.translation[i] = turn @ _Z_IN, found.board_pose[:3]
            if found.board_cov is not None:
                # Theirs is along the board's axes.
                to_camera = np.kron(np.eye(2), turn)
                poses.covariance[i] = to_camera @ found.board_cov @ to_camera.T
        return poses

    return solve


def grid_of(corners_m: Any) -> tuple[int, int, float, float]:
    """Return rows, columns, gap and side of a grid whose markers have corners (n, 4, 3) in metres.

    ValueError for another board.
    """
    (x, y, _), count = (corners_m[:, 1] - corners_m[:, 0])[0], len(corners_m)
    side = float(np.hypot(x, y))
    near = 1e-6 * side  # rounding
    columns = int((np.abs(corners_m[:, 0, 1] - corners_m[0, 0, 1]) < near).sum())
    # To the next of the row, or of the column.
    step = side if count == 1 else float(np.linalg.norm(corners_m[1, 0] - corners_m[0, 0]))
    row, column = np.divmod(np.arange(count), columns)
    places = np.stack([column, -row], axis=1) * step
    off = np.array(corners_m)
    off[..., :2] -= (places - places.mean(axis=0))[:, None] + side * _SQUARE
    if count % columns or np.abs(off).max() > near:
        raise ValueError("locus-tag has grids and charucos: expected kind = grid")
    return count // columns, columns, step - side, side


SOLVER = adapter(
    EstimatorPlugin, "locus-tag", "Locus' own board estimator, which searches the image by itself",
    make_board_estimator, LocusBoardSettings, needs_images=True, of_boards=True)
