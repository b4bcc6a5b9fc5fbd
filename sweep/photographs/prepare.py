"""Photographs made ready to be measured: a record of their truth, and a pipeline that names it."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sweep.errors import ArgumentError
from sweep.evaluation.opencv_threads import single_threaded
from sweep.experiment.photographs import board_document, board_of
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import TruthSource
from sweep.messages import plain
from sweep.model.board import Board
from sweep.model.image_file import Part
from sweep.photographs.board_check import calibrate, check_board, check_resolution
from sweep.photographs.folder import (
    Folder,
    FoundCorners,
    KnownCamera,
    Prepared,
    WantedMarkers,
    detect_markers,
    find_corners,
    name_of,
    named,
    read_folder,
    reference_detector,
    setting_name,
    write_record,
)
from sweep.photographs.pose_fit import Poses
from sweep.photographs.truth import (
    SeenMarkers,
    board_poses,
    camera_of_file,
    known_camera,
    own_poses,
    partner_poses,
    poses_of_file,
    stereo_of_file,
)
from sweep.typing import Floats

PathName = str | os.PathLike[str]

#: In the place of a camera's file: calibrated from the photographs.
CALIBRATE = "calibrate"


def prepare(
    folders: Sequence[PathName],
    camera: PathName | None = None,
    *,
    board: PathName | None = None,
    poses: PathName | None = None,
    stereo: PathName | None = None,
    settings: Sequence[str] = (),
    home: str | Path = "runs",
    name: str = "",
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
    home, name
        Folder and name of the record (default: the first folder's name).
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
    _check_arguments(folders, camera, poses, stereo)
    with single_threaded():  # OpenCV's calibration is the same to the bit only then
        return _prepare(
            folders, camera, board, poses, stereo, list(settings), Path(home), name,
            overwrite=overwrite, one_camera=one_camera,
        )


def _prepare(
    folders: Sequence[PathName], camera: PathName | None, board: PathName | None,
    poses: PathName | None, stereo: PathName | None, settings: list[str], home: Path,
    name: str, *, overwrite: bool, one_camera: bool,
) -> Prepared:
    document = None if board is None else board_document(Path(board))
    target = None if document is None else board_of(document, plain(board))
    side_by_side = stereo is not None and len(folders) == 1
    parts = [Part.left, Part.right] if side_by_side else [Part.whole] * len(folders)
    where = list(folders) * 2 if side_by_side else folders
    found = [read_folder(Path(each), part) for each, part in zip(where, parts, strict=True)]
    lines = list(dict.fromkeys(line for folder in found for line in folder.lines))
    if stereo is not None:
        _check_pairs(found)
    find, first = reference_detector(), found[0]
    dictionary = _dictionary(target, settings)
    detected = [
        [detect_markers(find, each.image, dictionary) for each in folder.photographs]
        for folder in found
    ]
    markers = _markers(target, settings, [ids for side in detected for ids, _ in side])
    if target is not None and board is not None:
        markers = dataclasses.replace(markers, board=json.dumps(document, sort_keys=True))
        check_board(Path(board), target, [each for side in detected for each in side], find,
                    first.photographs)
    seen = [[_seen(markers, *each) for each in side] for side in detected]
    corners = [] if target is None else [
        find_corners(each.image, target, *one)
        for each, one in zip(first.photographs, detected[0], strict=True)
    ]
    if stereo is not None:
        rig, calibrations = stereo_of_file(str(stereo), first.size)
        cameras = [known_camera(each) for each in calibrations]
        truth = [
            partner_poses(each, first.size, markers.sizes_m, own, partner)
            for each, own, partner in (
                (rig, seen[0], seen[1]), (rig.swapped(), seen[1], seen[0]),
            )
        ]
        if one_camera:
            found, parts, cameras, truth = found[:1], parts[:1], cameras[:1], truth[:1]
    else:
        cameras = [_camera(first, camera, corners)]
        lines += [each.line for each in cameras if each.line]
    if poses is not None:
        given, said = poses_of_file(Path(poses), first, markers, cameras[0].lens, seen[0])
        truth, lines = [given], lines + said
    elif target is not None and (stereo is None or one_camera):
        by_board, said = _poses_of_board(first, cameras[0], str(camera), target, corners)
        truth, lines = [by_board], lines + said
    elif stereo is None:
        truth = [own_poses(cameras[0].lens, markers.sizes_m, seen[0])]
    lines += _summary(found, truth)
    return write_record(
        found, parts, cameras, markers, truth, settings, home,
        name or name_of(Path(folders[0])), lines, overwrite=overwrite,
    )


def _check_arguments(
    folders: Sequence[PathName], camera: PathName | None, poses: object, stereo: object
) -> None:
    if stereo is not None and poses is not None:
        raise ArgumentError("poses", poses, "expected one truth; delete poses or stereo")
    if stereo is not None and camera is not None:
        raise ArgumentError(
            "camera", camera, "expected none beside stereo, whose file has both cameras"
        )
    if stereo is None and camera is None:
        raise ArgumentError(
            "camera", "none", f"expected the file of a calibration, or {CALIBRATE}"
        )
    most = 1 if stereo is None else 2
    if not 1 <= len(folders) <= most:
        raise ArgumentError(
            "folders", ", ".join(map(str, folders)),
            "expected one folder" + ("" if most == 1 else ", or those of the left and the right "
                                     "camera"),
        )


def _check_pairs(found: Sequence[Folder]) -> None:
    """Demand photographs of the same names and sizes of both cameras."""
    names = [[each.path.name for each in folder.photographs] for folder in found]
    odd = sorted(set(names[0]) ^ set(names[1]))
    if odd:
        raise ArgumentError(
            "folders", plain(odd[0]), "expected the same names of both cameras' photographs; it is "
            "in one folder alone",
        )
    if found[0].size != found[1].size:
        raise ArgumentError(
            "folders", " and ".join("{} x {}".format(*folder.size) for folder in found),
            "expected one size of both cameras' photographs",
        )


def _dictionary(board: Board | None, settings: Sequence[str]) -> str:
    return board.dictionary if board is not None else str(_settled(settings).fixed["dictionary"])


def _settled(settings: Sequence[str]) -> Pipeline:
    """Return a pipeline with settings, for the values that they give."""
    return Pipeline.from_dict({"pose": {"distance_m": 1.0}}, settings, source="--set")


def _markers(
    board: Board | None, settings: Sequence[str], found: Sequence[np.ndarray[Any, Any]]
) -> WantedMarkers:
    given = {setting_name(each) for each in settings}
    if board is not None:
        twice = given & {"dictionary", "size_m", "marker_id"}
        if twice:
            raise ArgumentError(
                "settings", min(twice), "expected none beside a board, which says it"
            )
        sides = np.linalg.norm(board.corners_m[:, 1] - board.corners_m[:, 0], axis=1)
        order = np.argsort(board.marker_ids)
        ids = tuple(board.marker_ids[k] for k in order.tolist())
        return WantedMarkers(board.dictionary, ids, np.round(sides[order], 12))
    if not {"dictionary", "size_m"} <= given:
        raise ArgumentError(
            "board", "none", "expected the file of a board, or `--set dictionary=...` and "
            "`--set size_m=...` of single markers",
        )
    settled = _settled(settings)
    every = sorted({each for ids in found for each in ids.tolist()})
    ids = tuple(every)
    if not ids:
        raise ArgumentError(
            "settings", f"dictionary={settled.fixed['dictionary']}",
            "no photograph shows a marker of it; give the dictionary of the markers",
        )
    return WantedMarkers(
        str(settled.fixed["dictionary"]), ids, np.full(len(ids), float(settled.fixed["size_m"]))
    )


def _seen(markers: WantedMarkers, ids: Any, quads: Floats) -> SeenMarkers:
    """Return the detected markers that are looked for."""
    index = {each: k for k, each in enumerate(markers.ids)}
    known = np.array([each in index for each in ids.tolist()], dtype=bool)
    return SeenMarkers(
        np.array([index[each] for each in ids[known].tolist()], dtype=np.int64), quads[known]
    )


def _camera(
    folder: Folder, camera: PathName | None, corners: Sequence[FoundCorners]
) -> KnownCamera:
    """Return the camera of a file, or by a board's corners."""
    if str(camera) != CALIBRATE:
        return known_camera(camera_of_file(str(camera), folder.size))
    if not corners:
        raise ArgumentError(
            "camera", CALIBRATE, "expected a board beside it, from whose corners it is calibrated"
        )
    return calibrate(folder.size, corners)


def _poses_of_board(
    folder: Folder, camera: KnownCamera, written: str, board: Board,
    corners: Sequence[FoundCorners],
) -> tuple[Poses, list[str]]:
    """Return the poses of a board's markers in the order of their IDs, and a line on them."""
    result = board_poses(board, camera.lens, folder.size, corners, camera.covariance)
    fits = [each for each in result.boards if each is not None]
    lines = []
    if fits:
        rms = float(np.median([each.rms_px for each in fits]))
        if written not in (CALIBRATE, "None"):
            check_resolution(written, camera.lens, folder.size, corners, rms)
        lines.append(
            f"board: {rms:.2f} px RMS of its corners in the median photograph"
            + ("" if np.isnan(result.halves_ratio) else
               "; the poses of halves of its corners differ by "
               f"{result.halves_ratio:.2g} of what their residuals predict")
        )
    return result.poses.take(np.argsort(board.marker_ids)), lines


def _summary(found: Sequence[Folder], truth: Sequence[Poses]) -> list[str]:
    """Return lines on how many markers there are, and on photographs without any."""
    lines = []
    known = np.concatenate([each.known for each in truth])
    if not known.any():
        raise ArgumentError(
            "folders", plain(found[0].photographs[0].path.parent, 300),
            "no photograph shows a whole marker whose pose is known",
        )
    empty = [
        each.path.name for folder, poses in zip(found, truth, strict=True)
        for each, some in zip(
            folder.photographs, np.asarray(poses.known.any(axis=1)).tolist(), strict=True
        ) if not some
    ]
    if empty:
        lines.append(f"no pose of a marker is known in {named(empty)}: not counted")
    if np.any([each.known.any(axis=1) for each in truth], axis=0).sum() == 1:
        lines.append(
            "one photograph: errors and rates have no intervals, which several photographs give"
        )
    std = np.concatenate([each.std[each.known] for each in truth])
    distance = np.concatenate([each.translation[each.known][:, 2] for each in truth])
    source = TruthSource(int(truth[0].source[truth[0].known][0])).name.replace("_", " ")
    spread = ""
    if np.isfinite(std).any():
        turn = np.degrees(np.linalg.norm(std[:, :3], axis=1))
        spread = (
            f"; median standard deviations {np.nanmedian(turn):.2g}° and "
            f"{100 * np.nanmedian(std[:, 5] / distance):.2g} % of the range"
        )
    count = int(np.any([each.known.any(axis=1) for each in truth], axis=0).sum())
    lines.append(
        f"{int(known.sum()):,} markers in {count:,} "
        f"{'photographs' if len(truth) == 1 else 'pairs of photographs'}; truth: {source}{spread}"
    )
    return lines
