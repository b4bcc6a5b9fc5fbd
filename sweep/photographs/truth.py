"""True poses of markers in photographs: by a board, by another camera, from a file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sweep.errors import PipelineError
from sweep.exchange.answers import Conventions, read_answers
from sweep.experiment.photographs import PhotographRecord
from sweep.measure.estimation import rotation_difference
from sweep.measure.flags import TruthSource
from sweep.measure.solver import both_planar_solutions, marker_frame, reprojection_errors_px
from sweep.messages import plain, refusal
from sweep.model.board import Board
from sweep.model.calibration import Calibration
from sweep.model.marker import marker_corners
from sweep.model.polygon import side_lengths
from sweep.photographs.board_view import FoundCorners, own_corners
from sweep.photographs.cameras import (
    MIN_CORNERS,
    FittedPose,
    StereoCamera,
    cameras_of,
    covariance_of,
    derivatives,
    fit_pose,
    fitted_board,
    project,
)
from sweep.photographs.folder import SeenMarkers
from sweep.typing import Floats, Masks

# --------------------------------------------------------------------------------------------------
# Poses of M markers in P photographs are written into their record, which has none before.

def put(
    record: PhotographRecord, place: tuple[Any, Any], rotation: Floats, translation: Floats,
    source: TruthSource, std: Floats | float = np.nan,
) -> None:
    """Write the poses of photographs and markers, by their numbers, into a record."""
    record.rotation[place], record.translation[place] = rotation, translation
    record.std[place], record.source[place] = std, source


def are_within(
    record: PhotographRecord, camera: Calibration, corners: Floats, rotation: Floats,
    translation: Floats,
) -> Masks:
    """Return which markers (M,), of corners (M, 4, 3), are wholly in the frame at a pose."""
    points = corners.reshape(-1, 3)
    pixels = project(camera, points, rotation, translation)
    inside = ((pixels >= -0.5) & (pixels <= record.size - 0.5)).all(axis=1)
    before = (points @ rotation.T + translation)[:, 2] > 0
    return np.asarray((inside & before).reshape(-1, 4).all(axis=1))


# --------------------------------------------------------------------------------------------------
# Poses from markers' own corners, where no board knows better: of one image, or of two.
#
# Corners by OpenCV's subpix refinement, poses by IPPE: the better of the two planar solutions in
# one image, or in two images the one that fits both of them better.

#: Markers seen by both cameras from which the spread of their poses is estimated.
MIN_PAIRS = 12

#: Standard deviation over the median absolute value, of a normal variable of mean 0.
MAD_TO_STD = 1.4826


def own_poses(
    record: PhotographRecord, camera: Calibration, sizes_m: Floats, seen: Sequence[SeenMarkers]
) -> None:
    """Write the poses of markers, of sides (M,), by their own corners."""
    for photograph, one in enumerate(seen):
        marker, quads = one.among(record.marker_id)
        rotation, translation = both_planar_solutions(
            quads, cameras_of(camera, len(quads)), sizes_m[marker]
        )
        good = np.isfinite(rotation[:, 0]).all(axis=(1, 2)) & (translation[:, 0, 2] > 0)
        put(record, (photograph, marker[good]), rotation[good, 0], translation[good, 0],
            TruthSource.none)


def partner_poses(
    record: PhotographRecord, stereo: StereoCamera, sizes_m: Floats, left: Sequence[SeenMarkers],
    right: Sequence[SeenMarkers],
) -> None:
    """Write the poses in left photographs, from the right ones of the same moment.

    Their standard deviations are computed from the differences between left and right poses, over
    √2: robust ones over all markers, since a single marker's are not known.

    Parameters
    ----------
    record
        Of the left photographs.
    stereo
        The cameras.
    sizes_m
        (M,) sides of the markers.
    left, right
        P each.
    """
    differences, ids = [], record.marker_id
    for photograph, (own, partner) in enumerate(zip(left, right, strict=True)):
        (own_marker, own_quads), (marker, quads) = own.among(ids), partner.among(ids)
        sides, own_sides = sizes_m[marker], sizes_m[own_marker]
        by_partner = both_planar_solutions(quads, cameras_of(stereo.right, len(quads)), sides)
        rotation = stereo.rotation.T @ by_partner[0]
        translation = (by_partner[1] - stereo.translation) @ stereo.rotation
        error = _errors(stereo.right, quads, sides, *by_partner)
        _, at_own, at = np.intersect1d(own_marker, marker, return_indices=True)
        error[at] += _errors(
            stereo.left, own_quads[at_own], sides[at], rotation[at], translation[at]
        )
        own_turns, own_places = both_planar_solutions(
            own_quads[at_own], cameras_of(stereo.left, len(at)), own_sides[at_own]
        )
        for k in np.flatnonzero(np.isfinite(error).any(axis=1)).tolist():
            best = int(np.nanargmin(error[k]))
            turn, shift = rotation[k, best], translation[k, best]
            corners = marker_corners(sides[k : k + 1])
            if not are_within(record, stereo.left, corners, turn, shift)[0]:
                continue
            put(record, (photograph, int(marker[k])), turn, shift, TruthSource.stereo_partner)
            for both in np.flatnonzero(at == k).tolist():
                turns = rotation_difference(own_turns[both], np.repeat(turn[None], 2, axis=0))
                angle = np.linalg.norm(turns, axis=1)
                if np.isfinite(angle).any():
                    j = int(np.nanargmin(angle))
                    differences.append([*turns[j], *(own_places[both, j] - shift)])
    if len(differences) >= MIN_PAIRS:
        spread = MAD_TO_STD * np.median(np.abs(np.array(differences)), axis=0) / np.sqrt(2.0)
        record.std[record.shown] = spread


def _errors(
    camera: Calibration, quads: Floats, sides: Floats, rotation: Floats, translation: Floats
) -> Floats:
    """Return the RMS reprojection errors (k, 2) of two poses each, px; NaN for none."""
    cameras = cameras_of(camera, len(quads))
    return np.stack([
        reprojection_errors_px(rotation[:, j], translation[:, j], sides, quads, cameras)
        for j in range(2)
    ], axis=1)


# --------------------------------------------------------------------------------------------------
# Truth by a file of poses, which is checked against the markers that are detected.

#: Distance of a detected corner to the one of the file's pose, as a share of the marker's side.
NEAR_SHARE = 0.5

#: Ratio of distances from which positions are taken for those in another unit.
OTHER_UNIT = 1.5


def poses_of_file(
    record: PhotographRecord, path: Path, camera: Calibration, sizes_m: Floats,
    seen: Sequence[SeenMarkers],
) -> list[str]:
    """Write a file's poses of markers wholly in their photographs; return lines on them.

    Raises
    ------
    PipelineError, StoreError
        If it cannot be read, is of other images or markers, or if most detected markers are not
        where its poses have them; in lines.
    """
    names, faults = {Path(each).stem: k for k, each in enumerate(record.paths)}, []
    if len(names) < len(record.paths):
        raise refusal([f"{plain(path)}: expected photographs of different names without suffixes"])
    try:
        answers = read_answers(path, names, Conventions())
    except PipelineError as error:
        lines = [line.partition(", or pass --doubled")[0] for line in error.faults]
        raise PipelineError(lines) from None
    marker = pd.Index(record.marker_id).get_indexer(answers.marker_id)
    if (marker < 0).any():
        unknown = answers.marker_id[marker < 0].min()
        faults.append(f"marker {unknown}: expected one of the board or the photographs")
    if not np.isfinite(answers.translation).all() or not np.isfinite(answers.rotation).all():
        faults.append("expected a pose in each row: rx, ry, rz, tx, ty, tz")
    if not faults:
        put(record, (answers.image, marker), answers.rotation, answers.translation,
            TruthSource.poses_file)
        faults += _faults(record, camera, sizes_m, seen)
    if faults:
        raise refusal([f"{plain(path)}: {fault}" for fault in faults])
    given = np.argwhere(record.shown).tolist()
    for photograph, k in given:
        pose = record.rotation[photograph, k], record.translation[photograph, k]
        if not are_within(record, camera, marker_corners(sizes_m[k : k + 1]), *pose)[0]:
            record.translation[photograph, k] = np.nan
    cut = len(given) - int(record.shown.sum())
    line = f"{cut:,} poses of markers that are not wholly in the frame: not counted"
    return [line] if cut else []


def _faults(
    record: PhotographRecord, camera: Calibration, sizes_m: Floats, seen: Sequence[SeenMarkers]
) -> list[str]:
    """Return the fault of poses that are not where markers are detected, if there is one."""
    ratios, distances = [], []
    for photograph, one in enumerate(seen):
        for k, quad in zip(*one.among(record.marker_id), strict=True):
            if not record.shown[photograph, k]:
                continue
            points = marker_corners(sizes_m[k : k + 1])[0]
            pose = record.rotation[photograph, k], record.translation[photograph, k]
            pixels, side = project(camera, points, *pose), side_lengths(quad[None]).mean()
            behind = ((points @ pose[0].T + pose[1])[:, 2] <= 0).any()
            away = np.linalg.norm(pixels - quad, axis=1).max()
            distances.append(np.inf if behind else float(away) / side)
            ratios.append(side / side_lengths(pixels[None]).mean())
    if not distances or np.median(distances) < NEAR_SHARE:
        return []
    ratio = float(np.median(ratios))
    fault = (
        "most markers are not where its poses have them; expected rotation vectors and positions "
        "from the marker's frame (x right, y up) to the camera's (x right, y down, z forward)"
    ) if 1 / OTHER_UNIT < ratio < OTHER_UNIT else (
        f"its positions are {ratio:.3g} times those of the detected markers; expected metres, and "
        "the marker's true size"
    )
    return [fault]


# --------------------------------------------------------------------------------------------------
# Truth by a board: the pose of each marker, from all corners of the board but its own.
#
# Its covariance is the one of least squares with the residuals' variance, and is raised where the
# poses of two halves of the corners differ by more than it says: neighbouring residuals are not
# independent. An error of the camera's numbers is in it as far as the marker's own corners do not
# lead to the same change of the pose: what truth and estimates share is no error of either
# against the other. A bent board is not in it.

#: Corners in each of two halves whose poses are compared.
MIN_HALF = 5


def board_poses(
    record: PhotographRecord, board: Board, camera: Calibration, found: Sequence[FoundCorners]
) -> tuple[list[FittedPose], float]:
    """Write the poses of a board's markers in photographs, of markers wholly in them.

    Parameters
    ----------
    record
        The photographs, and all markers of the board.
    board, camera
        The board and the camera.
    found
        The board's corners in each photograph.

    Returns
    -------
    tuple
        The board's own poses in the photographs with corners enough.
        The root mean square of the differences between the poses of two halves of the corners,
        over the prediction from the residuals' variance; NaN if no photograph has corners enough.
    """
    camera_covariance = covariance_of(camera)
    boards = [fitted_board(camera, each) for each in found]
    ratio = _halves_ratio(camera, boards, found, 1 if len(board.chessboard_m) else 4)
    raised = max(1.0, ratio) if np.isfinite(ratio) else 1.0
    frames = [marker_frame(each)[1] for each in board.corners_m]
    column = np.argsort(np.argsort(board.marker_ids)).tolist()
    own = own_corners(board)
    for photograph, (pose, corners) in enumerate(zip(boards, found, strict=True)):
        if pose is None:
            continue
        shown = are_within(record, camera, board.corners_m, pose.rotation, pose.translation)
        for k in np.flatnonzero(shown).tolist():
            without = pose.used & ~np.isin(corners.number, own[k])
            axes, centre = frames[k]
            fitted = fit_pose(
                camera, (corners.points - centre) @ axes, corners.pixels, pose.rotation @ axes,
                pose.rotation @ centre + pose.translation, without,
            ) if without.sum() >= MIN_CORNERS else None
            if fitted is None:
                continue
            variance = raised**2 * np.diag(fitted.covariance)
            if camera_covariance is not None:
                variance = variance + unshared_variance(
                    camera, camera_covariance, fitted, (corners.points[without] - centre) @ axes,
                    (board.corners_m[k] - centre) @ axes,
                )
            put(record, (photograph, column[k]), fitted.rotation, fitted.translation,
                TruthSource.board_without_this_marker, np.sqrt(variance))
    return [each for each in boards if each is not None], ratio


def unshared_variance(
    camera: Calibration, camera_covariance: Floats, pose: FittedPose, points: Floats, own: Floats
) -> Floats:
    """Return the variances (6,) of a pose by errors of the camera that the estimates do not share.

    To first order a pose by least squares from the marker's ``own`` corners (4, 3) changes by
    another amount than that from the board's ``points`` (n, 3): the difference counts.
    """
    by_points, by_own = (
        np.linalg.lstsq(by_pose, by_camera, rcond=None)[0] for _, by_pose, by_camera in (
            derivatives(camera, each, pose.rotation, pose.translation) for each in (points, own)
        )
    )
    change = np.asarray(by_points - by_own, dtype=np.float64)
    return np.asarray(np.diag(change @ camera_covariance @ change.T))


def _halves_ratio(
    camera: Calibration, boards: Sequence[FittedPose | None], found: Sequence[FoundCorners],
    together: int,
) -> float:
    """Return how far the poses of two halves differ, in predicted standard deviations.

    ``together`` corners of following numbers are in the same half: every other corner of a
    chessboard's row, or every other marker of a grid.
    """
    squares = []
    for pose, corners in zip(boards, found, strict=True):
        if pose is None:
            continue
        first, centre = (corners.number // together) % 2 == 0, corners.points.mean(axis=0)
        one, other = (
            fit_pose(camera, corners.points - centre, corners.pixels, pose.rotation,
                     pose.rotation @ centre + pose.translation, half & pose.used)
            if (half & pose.used).sum() >= MIN_HALF else None for half in (first, ~first)
        )
        if one is None or other is None:
            continue
        turn = rotation_difference(one.rotation[None], other.rotation[None])[0]
        difference = np.concatenate([turn, one.translation - other.translation])
        covariance = one.covariance + other.covariance
        squares.append(float(difference @ np.linalg.solve(covariance, difference)) / 6)
    return float(np.sqrt(np.mean(squares))) if squares else float("nan")
