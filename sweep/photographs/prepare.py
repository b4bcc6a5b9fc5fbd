"""Photographs made ready to be measured: the record of their truth, their pipeline, their twins."""

from __future__ import annotations

import copy
import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from sweep.errors import ArgumentError, PipelineError, PluginError, StoreError
from sweep.evaluation.opencv_threads import single_threaded
from sweep.exchange.answers import Conventions, read_answers
from sweep.experiment.document import file_text, read_document, refusing, section_of
from sweep.experiment.grid import TRIAL
from sweep.experiment.parameters import PHOTOGRAPHS, SIMULATED
from sweep.experiment.photographs import SUFFIX, PhotographRecord, board_document, board_of
from sweep.experiment.pipeline import Pipeline
from sweep.measure.estimation import rotation_difference
from sweep.measure.flags import TruthSource
from sweep.measure.solver import both_planar_solutions, marker_frame, reprojection_errors_px
from sweep.messages import notice, plain, shown
from sweep.model.board import Board
from sweep.model.calibration import VIEW, Calibration
from sweep.model.image_file import Part
from sweep.model.marker import marker_corners
from sweep.model.polygon import side_lengths
from sweep.model.pose import transform_points
from sweep.photographs import cameras, folder
from sweep.photographs.cameras import FittedPose, cameras_of, fit_pose
from sweep.photographs.folder import FoundCorners, SeenMarkers
from sweep.store.files import write_whole
from sweep.store.locations import translate_errors
from sweep.typing import Floats, Integers, Masks

PathName = str | os.PathLike[str]

#: In the place of a camera's file: calibrated from the photographs.
CALIBRATE = "calibrate"


class Prepared(NamedTuple):
    """Photographs that are ready to be measured.

    Attributes
    ----------
    pipeline
        The experiment.
    lines
        Photographs found, left out and converted, a line each.
    store
        Path or URL of the store in which the results belong.
    """

    pipeline: Pipeline
    lines: tuple[str, ...]
    store: str


class Side(NamedTuple):
    """One camera's photographs, and what is known of them.

    Attributes
    ----------
    shots
        The photographs.
    seen
        The markers that are detected in each.
    camera
        The camera.
    sizes_m
        (M,) sides of the markers of the record.
    record
        The true poses, which has none before they are written.
    """

    shots: folder.Folder
    seen: list[SeenMarkers]
    camera: Calibration
    sizes_m: Floats
    record: PhotographRecord

    def solutions(self, photograph: int) -> tuple[Integers, Floats, Floats, Floats]:
        """Return the numbers (n,) of the markers that are seen, their corners, and their poses.

        The corners are (n, 4, 2) px, both planar solutions (n, 2, 3, 3) and (n, 2, 3) m.
        """
        marker, quads = self.seen[photograph].among(self.record.marker_id)
        camera = cameras_of(self.camera, len(quads))
        return marker, quads, *both_planar_solutions(quads, camera, self.sizes_m[marker])

    def put(
        self, place: tuple[Any, Any], rotation: Floats, translation: Floats, source: TruthSource,
        std: Floats | float = np.nan,
    ) -> None:
        """Write the poses of photographs and markers, by their numbers."""
        self.record.rotation[place], self.record.translation[place] = rotation, translation
        self.record.std[place], self.record.source[place] = std, source

    def corners_px(self, corners_m: Floats, rotation: Floats, translation: Floats) -> Floats:
        """Return the images (n, 4, 2) of corners (n, 4, 3) at n poses; NaN behind the camera."""
        return cameras_of(self.camera, len(corners_m)).project(
            transform_points(corners_m, rotation, translation)
        )

    def images(self, place: tuple[Any, ...]) -> Floats:
        """Return the images (n, 4, 2) of n markers at their poses in the record."""
        corners_m = marker_corners(self.sizes_m[place[1]])
        return self.corners_px(corners_m, self.record.rotation[place],
                               self.record.translation[place])

    def are_within(self, pixels: Floats) -> Masks:
        """Return which markers (n,), of corners (n, 4, 2), are wholly in the frame."""
        inside = (pixels >= -0.5) & (pixels <= self.record.size - 0.5)
        return np.asarray(inside.all(axis=(1, 2)))


@single_threaded()  # OpenCV's calibration is the same to the bit only then
def prepare(
    folders: Sequence[PathName],
    camera: PathName | None = None,
    *,
    board: PathName | None = None,
    poses: PathName | None = None,
    stereo: PathName | None = None,
    settings: Sequence[str] = (),
    store: PathName | None = None,
    home: PathName | None = None,
    overwrite: bool = False,
    one_camera: bool = False,
) -> Prepared:
    """Find out the truth of photographs, record it, and return the experiment.

    Parameters
    ----------
    folders
        A folder of photographs; with ``stereo`` one of images with the left and the right camera's
        halves side by side, or two of the same names.
    camera
        The file of a calibration, or "calibrate".
    board, poses, stereo
        Where truth comes from: a board's file, a file of poses as `sweep score` reads them, the
        file of a stereo calibration. A board beside ``poses`` or ``stereo`` says which markers
        there are; without one, ``settings`` give dictionary and size_m.
    settings
        "key=value" for the pipeline, as ``--set`` takes them.
    store
        Of the results, whose name the record has (default: ``runs/NAME.zarr`` with the first
        folder's name).
    home
        Folder of the record (default: beside the store, as :func:`record_home` says).
    overwrite
        Whether another record of that name is replaced.
    one_camera
        Of two cameras the left one alone, with a board's truth where there is one: poses by the
        other camera have the error of a single marker.

    Raises
    ------
    ArgumentError, PipelineError, StoreError
        Says in lines what to change.
    """
    _check_arguments(folders, camera, board, poses, stereo)
    document = {} if board is None else board_document(Path(board))
    target = None if board is None else board_of(document, plain(board))
    halves = (Part.left, Part.right) if stereo is not None and len(folders) == 1 else (Part.whole,)
    found = [folder.read_folder(Path(each), part) for each in folders for part in halves]
    lines = list(dict.fromkeys(line for shots in found for line in shots.lines))
    if stereo is not None:
        _check_pairs(found[0], found[1])
    beside, name = record_home(store)
    first, place = found[0], Path(home or beside)
    dictionary, sizes, seen = _detected(target, document, str(board), settings, found)
    corners = [] if target is None else [
        folder.find_corners(each.image, target, one)
        for each, one in zip(first.photographs, seen[0], strict=True)
    ]
    rig = None if stereo is None else cameras.stereo_of_file(str(stereo), first.size)
    if rig is not None:
        known = [rig.left, rig.right]
    elif str(camera) != CALIBRATE:
        known = [cameras.camera_of_file(str(camera), first.size)]
    else:
        straight = corners
        for _ in range(1 if corners[0].outward is None else cameras.CALIBRATIONS):
            calibrated, line = cameras.calibrate(first.size, straight)
            straight = [cameras.unshifted(calibrated, each) for each in corners]
        known, lines = [calibrated], [*lines, line]
    described = json.dumps(document, sort_keys=True) if document else ""
    sizes_m = np.array(list(sizes.values()))
    sides = [
        Side(*each, sizes_m, _without_truth(each[0], sizes, described, place))
        for each in zip(found, seen, known, strict=True)
    ]
    one, *others = sides
    if poses is not None:
        lines += poses_of_file(one, Path(poses))
    elif target is not None and (rig is None or one_camera):
        rms_px, shift_px = board_poses(one, target, corners)
        if rig is None and str(camera) != CALIBRATE:
            cameras.check_resolution(str(camera), one.camera, first.size, corners, rms_px)
        lines.append(f"board: {rms_px:.2f} px RMS of its corners in the median photograph" + (
            f"; black squares' edges {shift_px:+.2f} px outwards (blur, ink, or a wrong marker_m)"
            if shift_px else ""))
    elif rig is None:
        own_poses(one)
    else:
        partner_poses(one, others[0], rig.rotation, rig.translation)
        partner_poses(others[0], one, rig.rotation.T, -rig.rotation.T @ rig.translation)
        if sizes and any(not each.record.shown.any() or _misplaced(each) for each in sides):
            raise ArgumentError("stereo", plain(stereo), "most markers are not where the other "
                                "camera has them; expected R and T, in metres, from left to right")
    sides = sides[:1] if one_camera else sides
    lines += _summary(sides, dictionary)
    name = name or name_of(Path(folders[0]))
    records = _write_records(sides, place, name, overwrite=overwrite)
    pipeline = _experiment(sides, records, dictionary, settings, place, name)
    return Prepared(pipeline, tuple(lines), os.fspath(store or place / f"{name}.zarr"))


def record_home(store: PathName | None) -> tuple[str, str]:
    """Return the folder and the name of the record of a store: beside it, if that is a path.

    >>> record_home("results/desk.zarr"), record_home("s3://bucket/desk.zarr"), record_home(None)
    (('results', 'desk'), ('runs', 'desk'), ('runs', ''))
    """
    if store is None:
        return "runs", ""
    url = os.fspath(store).rstrip("/")
    folder, _, last = url.rpartition("/")
    return ("runs" if "://" in url else folder or "."), last.removesuffix(".zarr")


def setting_name(setting: str) -> str:
    """Return the parameter that a setting "section.key=value" or "key=value" is of."""
    return setting.partition("=")[0].strip().rpartition(".")[2]


def name_of(folder: Path) -> str:
    """Return the name that a folder gives its store."""
    return re.sub(r"[^A-Za-z0-9._+-]", "-", folder.resolve().name).strip("-._") or "photographs"


# --------------------------------------------------------------------------------------------------
# What is given, and what the photographs show.

def _check_arguments(
    folders: Sequence[PathName], camera: PathName | None, board: object, poses: object,
    stereo: object,
) -> None:
    fault: tuple[str, object, str] | None = None
    if stereo is not None and poses is not None:
        fault = "poses", poses, "expected one truth; delete poses or stereo"
    elif stereo is not None and camera is not None:
        fault = "camera", camera, "expected none beside stereo, whose file has both cameras"
    elif stereo is None and camera is None:
        fault = "camera", "none", f"expected the file of a calibration, or {CALIBRATE}"
    elif str(camera) == CALIBRATE and board is None:
        fault = "camera", CALIBRATE, "expected a board beside it, whose corners calibrate it"
    elif not 1 <= len(folders) <= (1 if stereo is None else 2):
        fault = "folders", ", ".join(map(str, folders)), "expected one, or with stereo one or two"
    if fault:
        raise ArgumentError(*fault)


def _check_pairs(left: folder.Folder, right: folder.Folder) -> None:
    """Demand photographs of the same names and sizes of both cameras."""
    odd = {(each.path.name, *each.image.shape) for each in left.photographs} ^ {
        (each.path.name, *each.image.shape) for each in right.photographs
    }
    if odd:
        name, height, width = min(odd)
        raise ArgumentError(
            "folders", f"{plain(name)} of {width} x {height}", "expected the same names and sizes "
            "of both cameras' photographs; it is in one folder alone",
        )


def _detected(
    board: Board | None, document: Mapping[str, Any], name: str, settings: Sequence[str],
    found: Sequence[folder.Folder],
) -> tuple[str, dict[int, float], list[list[SeenMarkers]]]:
    """Return dictionary and sides (m, by increasing ID) of the markers, and those that are seen.

    These are of each photograph of each camera. Settings that say what the board says are refused,
    and a board, of a file of a name and content, that is not in the photographs.
    """
    given = {setting_name(each) for each in settings}
    if board is not None and (twice := given & {"dictionary", "size_m", "marker_id"}):
        raise ArgumentError("settings", min(twice), "expected none beside a board, which says it")
    fixed: dict[str, Any] = {"dictionary": board.dictionary} if board is not None else dict(
        Pipeline.from_dict({"pose": {"distance_m": 1.0}}, settings, source="--set").fixed
    )
    if board is None and not {"dictionary", "size_m"} <= given & fixed.keys():
        raise ArgumentError(
            "board", "none", "expected the file of a board, or `--set dictionary=...` and "
            "`--set size_m=...` of single markers, one value each",
        )
    find, dictionary = folder.reference_detector(), str(fixed["dictionary"])
    # What the usual detector does not see, another one under test may.
    faint = None if board is None else folder.reference_detector(**folder.FAINT)
    seen = [
        [folder.detect_markers(find, each.image, dictionary, faint) for each in shots.photographs]
        for shots in found
    ]
    every = [each for side in seen for each in side]
    if board is not None:
        folder.check_board(name, document, board, every, find, found[0].photographs)
        sides = np.linalg.norm(board.corners_m[:, 1] - board.corners_m[:, 0], axis=1)
        sizes = dict(sorted(zip(board.marker_ids, np.round(sides, 12).tolist(), strict=True)))
        return dictionary, sizes, seen
    ids = sorted({each for one in every for each in one.ids.tolist()})
    return dictionary, dict.fromkeys(ids, float(fixed["size_m"])), seen


def _summary(sides: Sequence[Side], dictionary: str) -> list[str]:
    """Return lines on how many markers there are, and on photographs without any."""
    records = [each.record for each in sides]
    shown = np.array([each.shown for each in records])
    if not shown.any():
        raise folder.fault_of(
            sides[0].shots.photographs[0].path.parent,
            f"no photograph shows a whole marker of {dictionary} whose pose is known",
        )
    std, translation, sources = (
        np.array([getattr(each, name) for each in records])
        for name in ("std", "translation", "source")
    )
    empty = ~shown.any(axis=2)
    lost = empty & (sources == TruthSource.none).any(axis=2)
    lines = [
        words.format(folder.named([Path(records[k].paths[i]).name for k, i in np.argwhere(some)]))
        for some, words in (
            (lost, "no marker of the board is seen in {}: all of them count as missed"),
            (empty & ~lost, "no pose of a marker is known in {}: not counted"),
        ) if some.any()
    ]
    std, translation = std[shown], translation[shown]
    source, spread = TruthSource(int(sources[shown][0])).name.replace("_", " "), ""
    if np.isfinite(std).any():
        turn = np.degrees(np.linalg.norm(std[:, :3], axis=1))
        spread = (
            f"; median standard deviations {np.nanmedian(turn):.2g}° and "
            f"{100 * np.nanmedian(std[:, 5] / translation[:, 2]):.2g} % of the range"
        )
    what = "photographs" if len(records) == 1 else "pairs of photographs"
    away = f"{translation[:, 2].min():.3g} to {translation[:, 2].max():.3g} m away"
    count = (~empty).any(axis=0).sum()
    return [*lines, f"{shown.sum():,} markers, {away}, in {count} {what}; truth: {source}{spread}"]


# --------------------------------------------------------------------------------------------------
# Poses from markers' own corners, where no board knows better: of one image, or of two.
#
# Corners by OpenCV's subpix refinement, poses by IPPE: the better of the two planar solutions in
# one image, or in two images the one that fits both of them better.

#: Markers seen by both cameras from which the spread of their poses is estimated.
MIN_PAIRS = 12

#: Standard deviation over the median absolute value, of a normal variable of mean 0.
MAD_TO_STD = 1.4826


def own_poses(side: Side) -> None:
    """Write the poses of markers by their own corners."""
    for photograph in range(len(side.seen)):
        marker, _, rotation, translation = side.solutions(photograph)
        good = np.isfinite(rotation[:, 0]).all(axis=(1, 2)) & (translation[:, 0, 2] > 0)
        side.put((photograph, marker[good]), rotation[good, 0], translation[good, 0],
                 TruthSource.none)


def partner_poses(left: Side, right: Side, turn: Floats, shift: Floats) -> None:
    """Write the poses in left photographs, from the right ones of the same moment.

    Their standard deviations are computed from the differences between left and right poses, over
    √2: robust ones over all markers, since a single marker's are not known.

    Parameters
    ----------
    left, right
        Both cameras' photographs; the left one's record gets the poses.
    turn, shift
        (3, 3) and (3,) m: a point X in the left camera's frame is ``turn @ X + shift`` in the
        right one's.
    """
    differences = np.empty((0, 6))
    for photograph in range(len(left.seen)):
        (own_marker, own_quads, own_rotation, own_translation), (marker, quads, *by_partner) = (
            each.solutions(photograph) for each in (left, right)
        )
        rotation, translation = turn.T @ by_partner[0], (by_partner[1] - shift) @ turn
        error = _errors(right, marker, quads, *by_partner)
        _, at_own, at = np.intersect1d(own_marker, marker, return_indices=True)
        error[at] += _errors(left, marker[at], own_quads[at_own], rotation[at], translation[at])
        # The solution that fits both images better, of markers that have one in the frame.
        best = _least(error)
        rotation, translation = rotation[best], translation[best]
        images = left.corners_px(marker_corners(left.sizes_m[marker]), rotation, translation)
        good = np.isfinite(error[best]) & left.are_within(images)
        left.put((photograph, marker[good]), rotation[good], translation[good],
                 TruthSource.stereo_partner)
        at_own, at = at_own[good[at]], at[good[at]]
        turns = rotation_difference(
            own_rotation[at_own].reshape(-1, 3, 3), np.repeat(rotation[at], 2, axis=0)
        ).reshape(-1, 2, 3)
        shifts = own_translation[at_own] - translation[at, None]
        nearest = np.concatenate([turns, shifts], axis=2)[_least(np.linalg.norm(turns, axis=2))]
        differences = np.vstack([differences, nearest[np.isfinite(nearest).all(axis=1)]])
    if len(differences) >= MIN_PAIRS:
        spread = MAD_TO_STD * np.median(np.abs(differences), axis=0) / np.sqrt(2.0)
        left.record.std[left.record.shown] = spread


def _least(values: Floats) -> tuple[Integers, Integers]:
    """Return the places of the least value of each row (k, 2); NaN is the largest."""
    return np.arange(len(values)), np.where(np.isnan(values), np.inf, values).argmin(axis=1)


def _errors(
    side: Side, marker: Integers, quads: Floats, rotation: Floats, translation: Floats
) -> Floats:
    """Return the RMS reprojection errors (k, 2) of both solutions of k markers."""
    return reprojection_errors_px(
        rotation.reshape(-1, 3, 3), translation.reshape(-1, 3), np.repeat(side.sizes_m[marker], 2),
        np.repeat(quads, 2, axis=0), cameras_of(side.camera, 2 * len(quads)),
    ).reshape(-1, 2)


# --------------------------------------------------------------------------------------------------
# Truth by a file of poses, which is checked against the markers that are detected.

#: Distance of a corner to where the detected marker has it, as a share of the marker's side.
NEAR_SHARE = 0.5


def poses_of_file(side: Side, path: Path) -> list[str]:
    """Write a file's poses of markers wholly in their photographs; return lines on them.

    Raises
    ------
    PipelineError, StoreError
        If it cannot be read, is of other images or markers, or if most detected markers are not
        where its poses have them; in lines.
    """
    record, faults = side.record, []
    names = {Path(each).stem: k for k, each in enumerate(record.paths)}
    if len(names) < len(record.paths):
        raise PipelineError([f"{plain(path)}: expected images of different names without suffixes"])
    try:
        answers = read_answers(path, names, Conventions())
    except PipelineError as error:
        lines = [line.partition(", or pass --doubled")[0] for line in error.faults]
        raise PipelineError(lines) from None
    marker = pd.Index(record.marker_id).get_indexer(answers.marker_id)
    if unknown := sorted({*answers.marker_id[marker < 0].tolist()}):
        faults.append(f"markers {shown(unknown)}: expected those of the board, or of the "
                      f"dictionary in the photographs: {shown(record.marker_id.tolist())}")
    poses = answers.translation.sum(axis=1) + answers.rotation.sum(axis=(1, 2))
    if not len(poses) or not np.isfinite(poses).all():
        faults.append("expected rows, and a pose in each: rx, ry, rz, tx, ty, tz")
    if not faults:
        side.put((answers.image, marker), answers.rotation, answers.translation,
                 TruthSource.poses_file)
        ratio = _misplaced(side)
        if ratio is not None:
            faults.append(
                "most markers are not where its poses have them, with positions that are "
                f"{ratio:.3g} times those of the detected markers; expected metres, and poses from "
                "the marker's frame (x right, y up) to the camera's (x right, y down, z forward)"
            )
    if faults:
        raise PipelineError([f"{plain(path)}: {fault}" for fault in faults])
    given = np.nonzero(record.shown)
    cut = ~side.are_within(side.images(given))
    record.translation[given[0][cut], given[1][cut]] = np.nan
    line = f"{int(cut.sum()):,} poses of markers that are not wholly in the frame: not counted"
    return [line] if cut.any() else []


def _misplaced(side: Side) -> float | None:
    """Return the ratio of distances to those of markers' own poses, if most are elsewhere."""
    own = side._replace(record=copy.deepcopy(side.record))
    own.record.translation[:] = np.nan
    own_poses(own)
    both = np.nonzero(side.record.shown & own.record.shown)
    seen = own.images(both)
    away = np.linalg.norm(side.images(both) - seen, axis=2).max(axis=1)
    shares = np.nan_to_num(away / side_lengths(seen).mean(axis=1), nan=np.inf)
    if not len(shares) or np.median(shares) < NEAR_SHARE:
        return None
    given, detected = (
        np.linalg.norm(each.record.translation[both], axis=1) for each in (side, own)
    )
    return float(np.median(given / detected))


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


def board_poses(side: Side, board: Board, found: Sequence[FoundCorners]) -> Floats:
    """Write the poses of a board's markers in photographs, of markers wholly in them.

    Where no marker is seen, such as in a blurred photograph, each detector misses all.

    Parameters
    ----------
    side
        The photographs, with a record of all markers of the board.
    board
        The board.
    found
        The board's corners in each photograph.

    Returns
    -------
    array
        The RMS of the corners and the shift of edges (2,) in px of the median photograph, NaN if
        none has corners enough.
    """
    camera, covariance = side.camera, cameras.covariance_of(side.camera)
    boards = [cameras.fitted_board(camera, each) for each in found]
    raised = _halves_ratio(camera, boards, found, 1 if len(board.chessboard_m) else 4)
    column = np.argsort(np.argsort(board.marker_ids)).tolist()
    own = folder.own_corners(board)
    side.record.source[[not (len(each.ids) or each.repeated) for each in side.seen]] = (
        TruthSource.none)
    for photograph, (pose, corners) in enumerate(zip(boards, found, strict=True)):
        if pose is None:
            continue
        same = [np.repeat(each[None], len(board), axis=0) for each in pose[:2]]
        shown = side.are_within(side.corners_px(board.corners_m, *same))
        for k in np.flatnonzero(shown).tolist():
            without = pose.used & ~np.isin(corners.number, own[k])
            _, (axes, centre) = marker_frame(board.corners_m[k])
            points = (corners.points - centre) @ axes
            fitted = fit_pose(
                camera, points, corners.pixels, pose.rotation @ axes,
                pose.rotation @ centre + pose.translation, without, corners.outward,
            ) if without.sum() >= cameras.MIN_CORNERS else None
            if fitted is None:
                continue
            variance = raised**2 * np.diag(fitted.covariance)
            if covariance is not None:
                variance = variance + unshared_variance(
                    camera, covariance, fitted, points[without],
                    (board.corners_m[k] - centre) @ axes,
                )
            side.put((photograph, column[k]), fitted.rotation, fitted.translation,
                     TruthSource.board_without_this_marker, np.sqrt(variance))
    known = [(each.rms_px, each.shift_px) for each in boards if each is not None]
    return np.asarray(np.median(known or [(np.nan, 0.0)], axis=0))


def unshared_variance(
    camera: Calibration, camera_covariance: Floats, pose: FittedPose, points: Floats, own: Floats
) -> Floats:
    """Return the variances (6,) of a pose by errors of the camera that the estimates do not share.

    To first order a pose by least squares from the marker's ``own`` corners (4, 3) changes by
    another amount than that from the board's ``points`` (n, 3): the difference counts.
    """
    by_points, by_own = (
        np.linalg.lstsq(by_pose, by_camera, rcond=None)[0] for _, by_pose, by_camera in (
            cameras.derivatives(camera, each, pose.rotation, pose.translation)
            for each in (points, own)
        )
    )
    change = np.asarray(by_points - by_own, dtype=np.float64)
    return np.asarray(np.diag(change @ camera_covariance @ change.T))


def _halves_ratio(
    camera: Calibration, boards: Sequence[FittedPose | None], found: Sequence[FoundCorners],
    together: int,
) -> float:
    """Return how far the poses of two halves differ, in predicted standard deviations; at least 1.

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
                     pose.rotation @ centre + pose.translation, half & pose.used, corners.outward)
            if (half & pose.used).sum() >= MIN_HALF else None for half in (first, ~first)
        )
        if one is None or other is None:
            continue
        turn = rotation_difference(one.rotation[None], other.rotation[None])[0]
        difference = np.concatenate([turn, one.translation - other.translation])
        covariance = one.covariance + other.covariance
        squares.append(float(difference @ np.linalg.solve(covariance, difference)) / 6)
    return max(1.0, float(np.sqrt(np.mean(squares)))) if squares else 1.0


# --------------------------------------------------------------------------------------------------
# The record of photographs beside their store, and the pipeline that names it.

def _without_truth(
    shots: folder.Folder, sizes: Mapping[int, float], board: str, home: Path
) -> PhotographRecord:
    """Return the record, in ``home``, of photographs whose markers' poses are not known."""
    numbers = np.array(list(sizes), dtype=np.int64)
    grid = len(shots.photographs), len(numbers)
    return PhotographRecord(
        tuple(os.path.relpath(each.path.resolve(), home.resolve()) for each in shots.photographs),
        tuple(each.digest for each in shots.photographs), shots.part, *shots.size, numbers,
        np.full((*grid, 3, 3), np.nan), np.full((*grid, 3), np.nan), np.full((*grid, 6), np.nan),
        np.zeros(grid, dtype=np.uint8), board,
    )


def _write_records(sides: Sequence[Side], home: Path, name: str, *, overwrite: bool) -> list[str]:
    """Write the records of a store of that name, and return their names.

    Another record of a store is kept.
    """
    names = [f"{name}{end}{SUFFIX}" for end in (["-left", "-right"] if sides[1:] else [""])]
    with translate_errors(plain(home, 300), "written"):
        home.mkdir(parents=True, exist_ok=True)
        for each, side in zip(names, sides, strict=True):
            path, content = home / each, side.record.content()
            used = (home / f"{name}.zarr").exists() and path.exists()
            if used and path.read_bytes() != content and not overwrite:
                raise StoreError(
                    f"{plain(path, 300)}: holds other photographs or poses, which a store may "
                    "refer to; choose another store, or overwrite it"
                )
            write_whole(path, content)
    return names


def _experiment(
    sides: Sequence[Side], records: Sequence[str], dictionary: str, settings: Sequence[str],
    home: Path, name: str,
) -> Pipeline:
    """Return the experiment on records of those names."""
    columns = {
        "photographs": records,
        **{key: [getattr(each.camera, key) for each in sides] for key in VIEW},
        "distortion": [list(each.camera.distortion) for each in sides],
    }
    first, ids, sizes = sides[0], sides[0].record.marker_id.tolist(), sides[0].sizes_m.tolist()
    (width, height), shots = first.shots.size, first.shots.photographs
    values = {"width_px": width, "height_px": height, "dictionary": dictionary}
    axes: dict[str, Any] = {"trial": len(shots)}
    if len(sides) == 1:
        values |= {key: column[0] for key, column in columns.items()}
        values |= {"calibration_sd": list(first.camera.sd)} if first.camera.sd else {}
    else:
        axes["stereo_camera"] = {"zip": columns}
    if len(set(sizes)) == 1:
        values["size_m"], axes["marker_id"] = sizes[0], ids
    else:
        axes["marker"] = {"zip": {"marker_id": ids, "size_m": sizes}}
    title = f"Photographs of {plain(shots[0].path.parent.name, 150)}"
    document: dict[str, Any] = {"title": title}
    for key, value in values.items():
        document.setdefault(section_of(key), {})[key] = value
    document["axes"] = axes
    others = [each for each in settings if setting_name(each) not in ("dictionary", "size_m")]
    return Pipeline.from_dict(document, others, name=name, source="photographs", folder=home)


# --------------------------------------------------------------------------------------------------
# Twins of photographs: images of their markers, simulated at the same poses.

def twin_pipeline(pipeline: Pipeline, scene: Mapping[str, Any], repeats: int = 1) -> Pipeline:
    """Return the pipeline that simulates the markers of photographs at their true poses.

    Each image has one marker on a plain ground, with what its board has printed around it. Camera,
    detectors, estimators, rows and flags are the photographs' own, so that results pair: trial
    k has the poses of photograph k modulo their number. What is drawn of the scene is drawn for
    each photograph and repeat, and is the same for all its markers; noise and shifts are each
    marker's own. What counts as missed in photographs that do not show their board does so here.

    Parameters
    ----------
    pipeline
        The pipeline of a store of photographs.
    scene
        Parameters of the section [scene] by name, as a document has them: values, or
        distributions such as ``{"normal": [0.8, 0.1]}``. The ``background`` is as ``black`` unless
        it is given; of a drawn one it is another draw.
    repeats
        How often each photograph is simulated.

    Raises
    ------
    ArgumentError, PipelineError
        If the pipeline is not one of photographs, or the scene is not valid.
    """
    if not pipeline.shows_photographs:
        raise ArgumentError(
            "photographs", plain(pipeline.name),
            "expected a store of photographs, as `sweep photos` makes it",
        )
    axis, photographs = pipeline.axis(TRIAL), len(record_of(pipeline).paths)
    trials = 1 if axis is None else len(axis)
    if repeats != 1 and (repeats < 1 or trials != photographs):
        raise ArgumentError(
            "repeats", repeats, f"expected at least 1, and 1 where {trials} of {photographs} "
            "photographs are measured"
        )
    document = read_document(pipeline.to_toml())
    document["title"] = plain(f"Twins of {pipeline.heading}", 200)
    ground = {"background": scene["black"]} if "black" in scene else {}
    document["scene"] = {**document.get("scene", {}), SIMULATED: True, **ground, **scene}
    document.setdefault("axes", {})[TRIAL] = trials * repeats
    return Pipeline.from_dict(
        document, name=f"{pipeline.name}-twins", source="scene", folder=pipeline.folder
    )


def record_of(pipeline: Pipeline) -> PhotographRecord:
    """Return the record of photographs of a pipeline; of two cameras the left one's.

    Raises
    ------
    ArgumentError
        If it cannot be read.
    """
    name = str(pipeline.values_of(PHOTOGRAPHS)[0])
    try:
        return PhotographRecord.read(Path(pipeline.folder) / name)[0]
    except PluginError as error:
        raise ArgumentError(PHOTOGRAPHS, plain(name), f"expected {error}") from None


def twin_store(photographs: PathName, scene: PathName) -> str:
    """Return the store of the twins of a store of photographs with a file's scene.

    >>> twin_store("runs/shots.zarr", "fitted/webcam.toml")
    'runs/shots-webcam.zarr'
    """
    return f"{os.fspath(photographs).rstrip('/').removesuffix('.zarr')}-{Path(scene).stem}.zarr"


def read_scene(path: PathName, like: Pipeline | None = None) -> dict[str, Any]:
    """Return the section [scene] of a TOML file, such as `sweep fit` writes.

    Warns if its camera has other pixels than the camera of ``like``, whose twins get the scene.

    Raises
    ------
    ArgumentError, PipelineError
        If it cannot be read, or has no such section.
    """
    name = plain(path, 300)
    with refusing(name):
        document = read_document(file_text(os.fspath(path)))
    scene, camera = document.get("scene"), document.get("camera")
    if not isinstance(scene, dict):
        raise ArgumentError("scene", name, "expected a section [scene]")
    own, other = (
        "{width_px} x {height_px}".format_map({"width_px": None, "height_px": None, **known})
        for known in (camera if isinstance(camera, dict) else {}, like.fixed if like else {})
    )
    if own != other and "None" not in own + other:
        notice(f"{name}: fitted to images of {own}, not of {other}: its blur, noise and shifts in "
               "px are of those")
    return scene
