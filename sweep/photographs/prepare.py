"""Photographs made ready to be measured: a record of their truth, and a pipeline that names it."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sweep.errors import ArgumentError, StoreError
from sweep.evaluation.opencv_threads import single_threaded
from sweep.experiment.photographs import (
    SUFFIX,
    PhotographRecord,
    board_document,
    board_of,
)
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import TruthSource
from sweep.messages import plain
from sweep.model.board import Board
from sweep.model.calibration import VIEW, Calibration
from sweep.model.image_file import Part
from sweep.photographs.board_view import FoundCorners, check_board, find_corners
from sweep.photographs.cameras import (
    calibrate,
    camera_of_file,
    check_resolution,
    stereo_of_file,
)
from sweep.photographs.folder import (
    Folder,
    SeenMarkers,
    detect_markers,
    fault_of,
    named,
    read_folder,
    reference_detector,
)
from sweep.photographs.truth import board_poses, own_poses, partner_poses, poses_of_file
from sweep.store.files import write_whole
from sweep.store.locations import translate_errors

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
    photographs, markers
        How many there are: markers whose pose is known.
    """

    pipeline: Pipeline
    lines: tuple[str, ...]
    photographs: int
    markers: int


@single_threaded()  # OpenCV's calibration is the same to the bit only then
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
    document = {} if board is None else board_document(Path(board))
    target = None if board is None else board_of(document, plain(board))
    side_by_side = stereo is not None and len(folders) == 1
    parts = [Part.left, Part.right] if side_by_side else [Part.whole] * len(folders)
    where = list(folders) * 2 if side_by_side else folders
    found = [read_folder(Path(each), part) for each, part in zip(where, parts, strict=True)]
    lines = list(dict.fromkeys(line for folder in found for line in folder.lines))
    if stereo is not None:
        _check_pairs(found)
    dictionary, sizes, seen = _detected(target, document, str(board), settings, found)
    sizes_m, first = np.array(list(sizes.values())), found[0]
    corners = [] if target is None else [
        find_corners(each.image, target, one)
        for each, one in zip(first.photographs, seen[0], strict=True)
    ]
    if stereo is not None:
        rig = stereo_of_file(str(stereo), first.size)
        cameras = [rig.left, rig.right]
    else:
        calibration, said = _camera(first, camera, corners)
        rig, cameras, lines = None, [calibration], lines + said
    described = json.dumps(document, sort_keys=True) if document else ""
    records = [
        _without_truth(folder, part, sizes, described, Path(home))
        for folder, part in zip(found, parts, strict=True)
    ][: 1 if one_camera else None]
    if poses is not None:
        lines += poses_of_file(records[0], Path(poses), cameras[0], sizes_m, seen[0])
    elif target is not None and (rig is None or one_camera):
        lines += _poses_of_board(records[0], cameras[0], camera, target, corners)
    elif rig is None:
        own_poses(records[0], cameras[0], sizes_m, seen[0])
    else:
        for k, (record, one) in enumerate(zip(records, (rig, rig.swapped()), strict=False)):
            partner_poses(record, one, sizes_m, seen[k], seen[1 - k])
    lines += _summary(records, first)
    pipeline = _write_records(
        records, cameras, dictionary, sizes, settings, Path(home),
        name or name_of(Path(folders[0])), first, overwrite=overwrite,
    )
    known = sum(int(each.shown.sum()) for each in records)
    return Prepared(pipeline, tuple(lines), len(first.photographs), known)


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
    folders: Sequence[PathName], camera: PathName | None, poses: object, stereo: object
) -> None:
    most = 1 if stereo is None else 2
    several = ", or those of the left and the right camera" if most == 2 else ""
    faults = (
        (stereo is not None and poses is not None, "poses", poses,
         "expected one truth; delete poses or stereo"),
        (stereo is not None and camera is not None, "camera", camera,
         "expected none beside stereo, whose file has both cameras"),
        (stereo is None and camera is None, "camera", "none",
         f"expected the file of a calibration, or {CALIBRATE}"),
        (not 1 <= len(folders) <= most, "folders", ", ".join(map(str, folders)),
         f"expected one folder{several}"),
    )
    for holds, argument, value, reason in faults:
        if holds:
            raise ArgumentError(argument, value, reason)


def _check_pairs(found: Sequence[Folder]) -> None:
    """Demand photographs of the same names and sizes of both cameras."""
    left, right = ({each.path.name for each in folder.photographs} for folder in found)
    if left != right:
        raise ArgumentError(
            "folders", plain(min(left ^ right)), "expected the same names of both cameras' "
            "photographs; it is in one folder alone",
        )
    if found[0].size != found[1].size:
        raise ArgumentError(
            "folders", " and ".join("{} x {}".format(*folder.size) for folder in found),
            "expected one size of both cameras' photographs",
        )


def _detected(
    board: Board | None, document: Mapping[str, Any], name: str, settings: Sequence[str],
    found: Sequence[Folder],
) -> tuple[str, dict[int, float], list[list[SeenMarkers]]]:
    """Return dictionary and sides (m, by increasing ID) of the markers, and those that are seen.

    These are of each photograph of each camera. Settings that say what the board says are refused,
    and a board, of a file of a name and content, that is not in the photographs.
    """
    given = {setting_name(each) for each in settings}
    if board is not None and (twice := given & {"dictionary", "size_m", "marker_id"}):
        raise ArgumentError("settings", min(twice), "expected none beside a board, which says it")
    if board is None and not {"dictionary", "size_m"} <= given:
        raise ArgumentError(
            "board", "none", "expected the file of a board, or `--set dictionary=...` and "
            "`--set size_m=...` of single markers",
        )
    fixed: dict[str, Any] = {"dictionary": board.dictionary} if board is not None else dict(
        Pipeline.from_dict({"pose": {"distance_m": 1.0}}, settings, source="--set").fixed
    )
    find, dictionary = reference_detector(), str(fixed["dictionary"])
    seen = [
        [detect_markers(find, each.image, dictionary) for each in folder.photographs]
        for folder in found
    ]
    every = [each for side in seen for each in side]
    if board is not None:
        check_board(name, document, board, every, find, found[0].photographs)
        sides = np.linalg.norm(board.corners_m[:, 1] - board.corners_m[:, 0], axis=1)
        sizes = dict(sorted(zip(board.marker_ids, np.round(sides, 12).tolist(), strict=True)))
        return dictionary, sizes, seen
    ids = sorted({each for one in every for each in one.ids.tolist()})
    if not ids:
        raise ArgumentError(
            "settings", f"dictionary={dictionary}",
            "no photograph shows a marker of it; give the dictionary of the markers",
        )
    return dictionary, dict.fromkeys(ids, float(fixed["size_m"])), seen


def _camera(
    folder: Folder, camera: PathName | None, corners: Sequence[FoundCorners]
) -> tuple[Calibration, list[str]]:
    """Return the camera of a file, or by a board's corners with a line on it."""
    if str(camera) != CALIBRATE:
        return camera_of_file(str(camera), folder.size), []
    if not corners:
        raise ArgumentError(
            "camera", CALIBRATE, "expected a board beside it, from whose corners it is calibrated"
        )
    calibration, line = calibrate(folder.size, corners)
    return calibration, [line]


def _poses_of_board(
    record: PhotographRecord, camera: Calibration, written: PathName | None, board: Board,
    corners: Sequence[FoundCorners],
) -> list[str]:
    """Write the poses of a board's markers; return a line on them."""
    boards, halves = board_poses(record, board, camera, corners)
    if not boards:
        return []
    rms = float(np.median([each.rms_px for each in boards]))
    if written is not None and str(written) != CALIBRATE:
        check_resolution(str(written), camera, record.size, corners, rms)
    line = f"board: {rms:.2f} px RMS of its corners in the median photograph"
    return [line if np.isnan(halves) else (
        f"{line}; the poses of halves of its corners differ by {halves:.2g} of what their "
        "residuals predict"
    )]


def _summary(records: Sequence[PhotographRecord], folder: Folder) -> list[str]:
    """Return lines on how many markers there are, and on photographs without any."""
    shown = np.array([each.shown for each in records])
    if not shown.any():
        raise fault_of(
            folder.photographs[0].path.parent,
            "no photograph shows a whole marker whose pose is known",
        )
    with_pose = shown.any(axis=2)
    empty = [Path(records[k].paths[i]).name for k, i in np.argwhere(~with_pose).tolist()]
    count = int(with_pose.any(axis=0).sum())
    lines = [f"no pose of a marker is known in {named(empty)}: not counted"] if empty else []
    if count == 1:
        lines.append(
            "one photograph: errors and rates have no intervals, which several photographs give"
        )
    std, translation, sources = (
        np.array([getattr(each, name) for each in records])[shown]
        for name in ("std", "translation", "source")
    )
    source, spread = TruthSource(int(sources[0])).name.replace("_", " "), ""
    if np.isfinite(std).any():
        turn = np.degrees(np.linalg.norm(std[:, :3], axis=1))
        spread = (
            f"; median standard deviations {np.nanmedian(turn):.2g}° and "
            f"{100 * np.nanmedian(std[:, 5] / translation[:, 2]):.2g} % of the range"
        )
    what = "photographs" if len(records) == 1 else "pairs of photographs"
    return [*lines, f"{int(shown.sum()):,} markers in {count:,} {what}; truth: {source}{spread}"]


# --------------------------------------------------------------------------------------------------
# The record of photographs beside their store, and the pipeline that names it.

def _without_truth(
    folder: Folder, part: Part, ids: Iterable[int], board: str, home: Path
) -> PhotographRecord:
    """Return the record, in ``home``, of photographs whose markers' poses are not known."""
    numbers = np.array(list(ids), dtype=np.int64)
    grid = len(folder.photographs), len(numbers)
    return PhotographRecord(
        tuple(os.path.relpath(each.path.resolve(), home.resolve()) for each in folder.photographs),
        tuple(each.digest for each in folder.photographs), part, *folder.size, numbers,
        np.full((*grid, 3, 3), np.nan), np.full((*grid, 3), np.nan), np.full((*grid, 6), np.nan),
        np.zeros(grid, dtype=np.uint8), board,
    )


def _write_records(
    records: Sequence[PhotographRecord], cameras: Sequence[Calibration], dictionary: str,
    sizes: Mapping[int, float], settings: Sequence[str], home: Path, name: str, folder: Folder,
    *, overwrite: bool,
) -> Pipeline:
    """Write the records, and return the experiment."""
    names = [f"{name}{SUFFIX}"] if len(records) == 1 else [
        f"{name}-{side}{SUFFIX}" for side in ("left", "right")
    ]
    with translate_errors(plain(home, 300), "written"):
        home.mkdir(parents=True, exist_ok=True)
        for each, record in zip(names, records, strict=True):
            path, content = home / each, record.content()
            used = (home / f"{name}.zarr").exists() and path.exists()
            if used and path.read_bytes() != content and not overwrite:
                raise StoreError(
                    f"{plain(path, 300)}: holds other photographs or poses, which a store may "
                    "refer to; choose another store, or overwrite it"
                )
            write_whole(path, content)
    (width, height), shots = folder.size, folder.photographs
    columns = {
        "photographs": names,
        **{key: [getattr(each, key) for each in cameras[: len(names)]] for key in VIEW},
        "distortion": [list(each.distortion) for each in cameras[: len(names)]],
    }
    camera: dict[str, Any] = {"width_px": width, "height_px": height}
    marker: dict[str, Any] = {"dictionary": dictionary}
    scene, axes = dict[str, Any](), dict[str, Any](trial=len(shots))
    if len(records) == 1:
        scene["photographs"], *_ = columns.pop("photographs")
        camera |= {key: values[0] for key, values in columns.items()}
        if cameras[0].sd:
            camera["calibration_sd"] = list(cameras[0].sd)
    else:
        axes["stereo_camera"] = {"zip": columns}
    if len(set(sizes.values())) == 1:
        marker["size_m"], axes["marker_id"] = next(iter(sizes.values())), list(sizes)
    else:
        axes["marker"] = {"zip": {"marker_id": list(sizes), "size_m": list(sizes.values())}}
    document = {
        "title": f"Photographs of {plain(shots[0].path.parent.name, 150)}", "camera": camera,
        "marker": marker, "scene": scene, "axes": axes,
    }
    others = [each for each in settings if setting_name(each) not in ("dictionary", "size_m")]
    return Pipeline.from_dict(document, others, name=name, source="photographs", folder=home)
