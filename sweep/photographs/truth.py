"""True poses of markers in photographs: by a board, by another camera, from a file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sweep.errors import ArgumentError, PipelineError
from sweep.exchange.answers import Conventions, read_answers
from sweep.experiment.pipeline import file_and_camera
from sweep.measure.estimation import rotation_difference
from sweep.measure.flags import TruthSource
from sweep.measure.solver import both_planar_solutions, reprojection_errors_px
from sweep.messages import plain, refusal
from sweep.model.board import Board
from sweep.model.calibration import MAX_BYTES, Calibration, calibration_of, read_tree
from sweep.model.camera import Cameras
from sweep.model.image_file import read_regular
from sweep.model.lens import pack
from sweep.model.marker import marker_corners
from sweep.model.pose import rotation_of_vector
from sweep.photographs.folder import Folder, FoundCorners, KnownCamera, WantedMarkers, own_corners
from sweep.photographs.pose_fit import MAD_TO_STD, FittedPose, Lens, Poses, fit_pose
from sweep.typing import Floats, Integers

# --------------------------------------------------------------------------------------------------
# Poses from markers' own corners, where no board knows better: of one image, or of two.
#
# Corners by OpenCV's subpix refinement, poses by IPPE: the better of the two planar solutions in
# one image, or in two images the one that fits both of them better.

#: Markers seen by both cameras from which the spread of their poses is estimated.
MIN_PAIRS = 12


@dataclass(frozen=True, slots=True, eq=False)
class SeenMarkers:
    """Markers that were detected in a photograph: indices (k,) and corners (k, 4, 2) px."""

    marker: Integers
    quads: Floats


@dataclass(frozen=True, slots=True, eq=False)
class StereoCamera:
    """Two cameras: a point X in the left one's frame is ``rotation @ X + translation`` (m)."""

    left: Lens
    right: Lens
    rotation: Floats
    translation: Floats

    def swapped(self) -> StereoCamera:
        """Return the same with left and right exchanged."""
        back = self.rotation.T
        return StereoCamera(self.right, self.left, back, -back @ self.translation)


def cameras_of(lens: Lens, count: int) -> Cameras:
    """Return ``count`` equal cameras as solvers take them."""
    matrix = lens.matrix
    view = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
    packed = pack(tuple(lens.distortion.tolist()))
    return Cameras(
        np.repeat(view[None], count, axis=0), np.repeat(packed[None], count, axis=0),
        np.full(count, bool(packed[:14].any())),
    )


def own_poses(lens: Lens, sizes_m: Floats, seen: Sequence[SeenMarkers]) -> Poses:
    """Return the poses of M markers, of sides (M,), in P photographs from their own corners."""
    poses = Poses.none(len(seen), len(sizes_m))
    for photograph, each in enumerate(seen):
        count = len(each.marker)
        if not count:
            continue
        rotation, translation = both_planar_solutions(
            each.quads, cameras_of(lens, count), sizes_m[each.marker]
        )
        for k, marker in enumerate(each.marker.tolist()):
            if np.isfinite(rotation[k, 0]).all() and translation[k, 0, 2] > 0:
                poses.put(photograph, marker, rotation[k, 0], translation[k, 0],
                          np.full(6, np.nan), TruthSource.none)
    return poses


def partner_poses(
    stereo: StereoCamera, size: tuple[int, int], sizes_m: Floats, left: Sequence[SeenMarkers],
    right: Sequence[SeenMarkers],
) -> Poses:
    """Return the poses of M markers in P left photographs, from the right ones of the same moment.

    Their standard deviations are computed from the differences between left and right poses, over
    √2: robust ones over all markers, since a single marker's are not known.

    Parameters
    ----------
    stereo
        The cameras.
    size
        Width and height of the left photographs in pixels.
    sizes_m
        (M,) sides of the markers.
    left, right
        P each.
    """
    poses = Poses.none(len(right), len(sizes_m))
    differences = []
    back = stereo.rotation.T
    for photograph, (own, partner) in enumerate(zip(left, right, strict=True)):
        count = len(partner.marker)
        if not count:
            continue
        sides = sizes_m[partner.marker]
        right_rotation, right_translation = both_planar_solutions(
            partner.quads, cameras_of(stereo.right, count), sides
        )
        rotation = back @ right_rotation
        translation = (right_translation - stereo.translation) @ stereo.rotation
        errors = _errors(stereo.right, partner.quads, sides, right_rotation, right_translation)
        index = {marker: k for k, marker in enumerate(own.marker.tolist())}
        for k, marker in enumerate(partner.marker.tolist()):
            total = errors[k].copy()
            if marker in index:
                quad = own.quads[index[marker]]
                total += _errors(
                    stereo.left, np.repeat(quad[None], 1, axis=0), sides[k : k + 1],
                    rotation[k : k + 1], translation[k : k + 1],
                )[0]
            if not np.isfinite(total).any():
                continue
            best = int(np.nanargmin(total))
            pose = rotation[k, best], translation[k, best]
            if not is_within(stereo.left, size, sides[k], *pose):
                continue
            poses.put(photograph, marker, *pose, np.full(6, np.nan), TruthSource.stereo_partner)
            if marker in index:
                differences.append(_difference(stereo.left, quad, sides[k], *pose))
    known = [each for each in differences if each is not None]
    if len(known) >= MIN_PAIRS:
        spread = MAD_TO_STD * np.median(np.abs(np.array(known)), axis=0) / np.sqrt(2.0)
        poses.std[poses.known] = spread
    return poses


def _errors(
    lens: Lens, quads: Floats, sides: Floats, rotation: Floats, translation: Floats
) -> Floats:
    """Return the RMS reprojection errors (k, 2) of two poses each, px; NaN for none."""
    cameras = cameras_of(lens, len(quads))
    return np.stack([
        reprojection_errors_px(rotation[:, j], translation[:, j], sides, quads, cameras)
        for j in range(2)
    ], axis=1)


def _difference(
    lens: Lens, quad: Floats, side: float, rotation: Floats, translation: Floats
) -> Floats | None:
    """Return the difference (6,) of a marker's pose in this image to another; None for none."""
    own, shift = both_planar_solutions(quad[None], cameras_of(lens, 1), np.array([side]))
    turns = rotation_difference(own[0], np.repeat(rotation[None], 2, axis=0))
    angle = np.linalg.norm(turns, axis=1)
    if not np.isfinite(angle).any():
        return None
    best = int(np.nanargmin(angle))
    return np.concatenate([turns[best], shift[0, best] - translation])


def is_within(
    lens: Lens, size: tuple[int, int], side: float, rotation: Floats, translation: Floats
) -> bool:
    """Return whether a marker is wholly in the frame."""
    points = marker_corners(np.array([side]))[0]
    if not ((points @ rotation.T + translation)[:, 2] > 0).all():
        return False
    pixels = lens.project(points, rotation, translation)
    return bool(((pixels >= -0.5) & (pixels <= np.array(size) - 0.5)).all())


# --------------------------------------------------------------------------------------------------
# Cameras of photographs from files: one camera, or two with the pose of one to the other.

#: Largest deviation of RᵀR from the identity; files have few digits.
ORTHOGONAL = 1e-3


def camera_of_file(written: str, size: tuple[int, int] | None = None) -> Calibration:
    """Return the camera of ``FILE`` or ``FILE#NAME``, for photographs of a size in pixels.

    Raises
    ------
    ArgumentError
        If there is none, or it is of another frame size than given.
    """
    path, name = file_and_camera(written, lambda each: Path(each).is_file())
    calibration = _camera("camera", written, _tree("camera", path), name)
    if size is not None:
        _check_size("camera", written, calibration, size)
    return calibration


def stereo_of_file(written: str, size: tuple[int, int]) -> tuple[StereoCamera, list[Calibration]]:
    """Return the two cameras of a file with K1, D1, K2, D2, R and T, as OpenCV names them.

    Raises
    ------
    ArgumentError
        If it is no such file, or of another frame size.
    """
    tree = _tree("stereo", written)
    cameras = [_camera("stereo", written, tree, name) for name in ("1", "2")]
    for each in cameras:
        _check_size("stereo", written, each, size)
    rotation, translation = (_numbers(written, tree, *each) for each in (("R", 9), ("T", 3)))
    rotation = rotation.reshape(3, 3)
    error = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if not error < ORTHOGONAL or np.linalg.det(rotation) < 0:
        raise ArgumentError("stereo", plain(written), "R: expected a rotation matrix")
    u, _, vt = np.linalg.svd(rotation)
    return StereoCamera(lens_of(cameras[0]), lens_of(cameras[1]), u @ vt, translation), cameras


def lens_of(calibration: Calibration) -> Lens:
    """Return the camera of a calibration."""
    return Lens.of(
        calibration.fx_px, calibration.fy_px, calibration.cx_px, calibration.cy_px,
        calibration.distortion,
    )


def known_camera(calibration: Calibration) -> KnownCamera:
    """Return the camera of a calibration, with the errors of its numbers as far as it has them."""
    covariance = None
    if calibration.covariance:
        count = math.isqrt(len(calibration.covariance))
        covariance = np.reshape(np.array(calibration.covariance), (count, count))
    return KnownCamera(lens_of(calibration), calibration.sd, covariance=covariance)


def _tree(argument: str, path: str) -> Any:
    try:
        return read_tree(read_regular(path, MAX_BYTES))
    except OSError as error:
        raise ArgumentError(
            argument, plain(path), f"expected a camera file ({error.strerror or 'unreadable'})"
        ) from None
    except ValueError as error:
        raise ArgumentError(argument, plain(path), f"expected a camera file ({error})") from None


def _camera(argument: str, written: str, tree: Any, name: str) -> Calibration:
    try:
        return calibration_of(tree, name)
    except ValueError as error:
        expected = "expected a camera file" if argument == "camera" else (
            "expected a file with K1, D1, K2, D2, R and T of two cameras"
        )
        raise ArgumentError(argument, plain(written), f"{expected} ({error})") from None


def _check_size(
    argument: str, written: str, calibration: Calibration, size: tuple[int, int]
) -> None:
    own = calibration.width_px, calibration.height_px
    if None not in own and own != size:
        turned = "; they are turned, perhaps by their EXIF tags" if own == size[::-1] else ""
        raise ArgumentError(
            argument, plain(written),
            f"it holds for {own[0]} x {own[1]}, but the photographs are {size[0]} x {size[1]}"
            f"{turned}; give the calibration of their size",
        )
    cx, cy = calibration.cx_px, calibration.cy_px
    if not (0 < cx < size[0] and 0 < cy < size[1]):
        raise ArgumentError(
            argument, plain(written),
            f"its principal point ({cx:g}, {cy:g}) is outside the photographs of {size[0]} x "
            f"{size[1]}; give the calibration of their size",
        )


def _numbers(written: str, tree: Any, name: str, count: int) -> Floats:
    """Return the numbers of a matrix in a file."""
    value = next((each for key, each in tree.items() if str(key).lower() == name.lower()), None)
    if isinstance(value, dict):
        value = value.get("data")
    try:
        numbers = np.array(value, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ArgumentError(
            "stereo", plain(written),
            f"{name}: expected {count} numbers: "
            + ("the rotation" if count == 9 else "the translation, in metres,")
            + " that takes points of the left camera's frame to the right one's",
        )
    return numbers


# --------------------------------------------------------------------------------------------------
# Truth by a file of poses, which is checked against the markers that are detected.

#: Distance of a detected corner to the one of the file's pose, as a share of the marker's side.
NEAR_SHARE = 0.5

#: Ratio of distances from which positions are taken for those in another unit.
OTHER_UNIT = 1.5


def poses_of_file(
    path: Path, folder: Folder, markers: WantedMarkers, lens: Lens, seen: Sequence[SeenMarkers]
) -> tuple[Poses, list[str]]:
    """Return the poses that a file gives of markers wholly in their photographs, and lines.

    Raises
    ------
    PipelineError, StoreError
        If it cannot be read, is of other images or markers, or if most detected markers are not
        where its poses have them; in lines.
    """
    names = {each.path.stem: k for k, each in enumerate(folder.photographs)}
    if len(names) < len(folder.photographs):
        raise refusal([f"{plain(path)}: expected photographs of different names without suffixes"])
    try:
        answers = read_answers(path, names, Conventions())
    except PipelineError as error:
        raise PipelineError([_of_photographs(line) for line in error.faults]) from None
    index = {each: k for k, each in enumerate(markers.ids)}
    unknown = sorted(set(answers.marker_id.tolist()) - index.keys())
    if unknown:
        raise refusal([
            f"{plain(path)}: marker {unknown[0]}: expected one of the board or the photographs"
        ])
    if not np.isfinite(answers.translation).all() or not np.isfinite(answers.rotation).all():
        raise refusal([f"{plain(path)}: expected a pose in each row: rx, ry, rz, tx, ty, tz"])
    poses, cut = Poses.none(len(names), len(markers.ids)), 0
    for photograph, marker_id, rotation, translation in zip(
        answers.image.tolist(), answers.marker_id.tolist(), answers.rotation, answers.translation,
        strict=True,
    ):
        marker = index[marker_id]
        poses.put(photograph, marker, rotation, translation, np.full(6, np.nan),
                  TruthSource.poses_file)
    if fault := _fault(poses, markers.sizes_m, lens, seen):
        raise refusal([f"{plain(path)}: {fault}"])
    for photograph, marker in np.argwhere(poses.known).tolist():
        pose = poses.rotation[photograph, marker], poses.translation[photograph, marker]
        if not is_within(lens, folder.size, markers.sizes_m[marker], *pose):
            poses.translation[photograph, marker] = np.nan
            cut += 1
    lines = [f"{cut:,} poses of markers that are not wholly in the frame: not counted"]
    return poses, lines if cut else []


def _of_photographs(line: str) -> str:
    """Return the line of a fault of answers to an export as one of photographs."""
    line = line.partition("; delete one, or pass")[0]
    if "is not among those that were exported" in line:
        line, _, hint = line.partition("; expected a name such as ")
        line = line.replace("is not among those that were exported", "is none of the photographs")
        line += f"; expected a name such as {hint.removesuffix('.png')}" if hint else ""
    return line


def _fault(
    poses: Poses, sizes_m: Floats, lens: Lens, seen: Sequence[SeenMarkers]
) -> str:
    """Return the fault of poses that are not where markers are detected; empty if there is none."""
    own = own_poses(lens, sizes_m, seen)
    distances, ratios = [], []
    for photograph, each in enumerate(seen):
        for marker, quad in zip(each.marker.tolist(), each.quads, strict=True):
            rotation = poses.rotation[photograph, marker]
            translation = poses.translation[photograph, marker]
            if np.isnan(translation).any() or np.isnan(own.translation[photograph, marker]).any():
                continue
            points = marker_corners(sizes_m[marker : marker + 1])[0]
            ratios.append(float(
                np.linalg.norm(translation) / np.linalg.norm(own.translation[photograph, marker])
            ))
            side = float(np.linalg.norm(np.roll(quad, -1, axis=0) - quad, axis=1).mean())
            behind = ((points @ rotation.T + translation)[:, 2] <= 0).any()
            away = np.linalg.norm(lens.project(points, rotation, translation) - quad, axis=1).max()
            distances.append(np.inf if behind else float(away) / side)
    if not distances or np.median(distances) < NEAR_SHARE:
        return ""
    ratio = float(np.median(ratios))
    if not 1 / OTHER_UNIT < ratio < OTHER_UNIT:
        return (
            f"its positions are {ratio:.3g} times those of the detected markers; expected metres, "
            "and the marker's true size"
        )
    return (
        "most markers are not where its poses have them; expected rotation vectors and positions "
        "from the marker's frame (x right, y up) to the camera's (x right, y down, z forward)"
    )


# --------------------------------------------------------------------------------------------------
# Truth by a board: the pose of each marker, from all corners of the board but its own.
#
# Its covariance is the one of least squares with the residuals' variance, and is raised where the
# poses of two halves of the corners differ by more than it says: neighbouring residuals are not
# independent. An error of the camera's numbers is in it as far as the marker's own corners do not
# lead to the same change of the pose: what truth and estimates share is no error of either
# against the other. A bent board is not in it.

#: Corners of a board, without the marker's own, from which its pose is taken for known.
MIN_CORNERS = 6

#: Corners in each of two halves whose poses are compared.
MIN_HALF = 5

#: Takes points of a board to a frame with z away from the viewer, where IPPE is stable.
Z_IN = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, slots=True, eq=False)
class BoardPoses:
    """The poses of a board's M markers in P photographs.

    Attributes
    ----------
    poses
        Of the markers that are wholly in the photograph.
    boards
        The board's own pose in each photograph; None where too few corners were found.
    halves_ratio
        Root mean square of the differences between the poses of two halves of the corners, over
        the prediction from the residuals' variance; NaN if no photograph has corners enough.
    """

    poses: Poses
    boards: tuple[FittedPose | None, ...]
    halves_ratio: float


def board_poses(
    board: Board, lens: Lens, size: tuple[int, int], found: Sequence[FoundCorners],
    camera_covariance: Floats | None = None,
) -> BoardPoses:
    """Return the poses of a board's markers in photographs.

    Parameters
    ----------
    board, lens
        The board and the camera.
    size
        Width and height of the photographs in px.
    found
        The board's corners in each photograph.
    camera_covariance
        (c, c) of fx, fy, cx, cy and the coefficients; None if it is not known.
    """
    boards = tuple(fitted_board(lens, each) for each in found)
    # Every other corner of a chessboard's row, every other marker of a grid.
    ratio = _halves_ratio(lens, boards, found, 1 if len(board.chessboard_m) else 4)
    raised = max(1.0, ratio) if np.isfinite(ratio) else 1.0
    own, frames = own_corners(board), marker_frames(board)
    poses = Poses.none(len(found), len(board))
    for photograph, (pose, corners) in enumerate(zip(boards, found, strict=True)):
        if pose is None:
            continue
        shown = markers_within(board, lens, size, pose)
        for k in np.flatnonzero(shown).tolist():
            without = pose.used & ~np.isin(corners.number, list(own[k]))
            if without.sum() < MIN_CORNERS:
                continue
            axes, centre = frames[k]
            fitted = fit_pose(
                lens, (corners.points - centre) @ axes, corners.pixels, pose.rotation @ axes,
                pose.rotation @ centre + pose.translation, without,
            )
            if fitted is None:
                continue
            variance = raised**2 * np.diag(fitted.covariance)
            if camera_covariance is not None:
                variance = variance + unshared_variance(
                    lens, camera_covariance, fitted, (corners.points[without] - centre) @ axes,
                    (board.corners_m[k] - centre) @ axes,
                )
            poses.put(photograph, k, fitted.rotation, fitted.translation, np.sqrt(variance),
                      TruthSource.board_without_this_marker)
    return BoardPoses(poses, boards, ratio)


def unshared_variance(
    lens: Lens, camera_covariance: Floats, pose: FittedPose, points: Floats, own: Floats
) -> Floats:
    """Return the variances (6,) of a pose by errors of the camera that the estimates do not share.

    To first order a pose by least squares from the marker's ``own`` corners (4, 3) changes by
    another amount than that from the board's ``points`` (n, 3): the difference counts.
    """
    change = (
        lens.by_camera(own, pose.rotation, pose.translation)
        - lens.by_camera(points, pose.rotation, pose.translation)
    )
    return np.asarray(np.diag(change @ camera_covariance @ change.T))


def fitted_board(lens: Lens, found: FoundCorners) -> FittedPose | None:
    """Return a board's pose; None with too few corners."""
    if len(found.points) < MIN_CORNERS:
        return None
    points = np.ascontiguousarray(found.points @ Z_IN)
    pixels = np.ascontiguousarray(found.pixels)
    starts = []
    for method in (cv2.SOLVEPNP_ITERATIVE, cv2.SOLVEPNP_IPPE):
        try:
            _, rotations, translations, _ = cv2.solvePnPGeneric(
                points, pixels, lens.matrix, lens.distortion, flags=method
            )
        except cv2.error:
            continue
        starts += [
            (
                rotation_of_vector(np.asarray(rotation, dtype=np.float64).reshape(1, 3))[0] @ Z_IN,
                np.asarray(translation, dtype=np.float64).ravel(),
            )
            for rotation, translation in zip(rotations, translations, strict=True)
            if np.isfinite(rotation).all() and np.asarray(translation).ravel()[2] > 0
        ]
    fits = [fit_pose(lens, found.points, found.pixels, *start) for start in starts]
    good = [fit for fit in fits if fit is not None and fit.used.sum() >= MIN_CORNERS]
    if not good:
        return None
    return min(good, key=lambda fit: float(np.median((fit.residuals**2).sum(axis=1))))


def marker_frames(board: Board) -> list[tuple[Floats, Floats]]:
    """Return the axes (3, 3) and the centre (3,) of each marker in its board's frame."""
    frames = []
    for top_left, top_right, bottom_right, bottom_left in board.corners_m:
        right = top_right - top_left
        up = top_left - bottom_left
        x, y = right / np.linalg.norm(right), up / np.linalg.norm(up)
        centre = (top_left + top_right + bottom_right + bottom_left) / 4
        frames.append((np.column_stack([x, y, np.cross(x, y)]), centre))
    return frames


def markers_within(
    board: Board, lens: Lens, size: tuple[int, int], pose: FittedPose
) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Return which markers (M,) of a board are wholly in the frame."""
    points = board.corners_m.reshape(-1, 3)
    depth = (points @ pose.rotation.T + pose.translation)[:, 2]
    pixels = lens.project(points, pose.rotation, pose.translation)
    limit = np.array(size) - 0.5
    inside = (depth > 0) & ((pixels >= -0.5) & (pixels <= limit)).all(axis=1)
    return np.asarray(inside.reshape(len(board), 4).all(axis=1))


def _halves_ratio(
    lens: Lens, boards: Sequence[FittedPose | None], found: Sequence[FoundCorners], together: int
) -> float:
    """Return how far the poses of two halves differ, in predicted standard deviations.

    ``together`` corners of following numbers are in the same half.
    """
    squares = []
    for pose, corners in zip(boards, found, strict=True):
        if pose is None:
            continue
        first = (corners.number // together) % 2 == 0
        centre = corners.points.mean(axis=0)
        halves = [
            fit_pose(lens, corners.points - centre, corners.pixels, pose.rotation,
                     pose.rotation @ centre + pose.translation, half & pose.used)
            if (half & pose.used).sum() >= MIN_HALF else None
            for half in (first, ~first)
        ]
        one, other = halves
        if one is None or other is None:
            continue
        turn = rotation_difference(one.rotation[None], other.rotation[None])[0]
        difference = np.concatenate([turn, one.translation - other.translation])
        covariance = one.covariance + other.covariance
        squares.append(float(difference @ np.linalg.solve(covariance, difference)) / 6)
    return float(np.sqrt(np.mean(squares))) if squares else float("nan")
