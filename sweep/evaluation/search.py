"""Search: from a scene's image to its detections, of markers, boards and recordings."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.evaluation.machine_faults import raise_machine_fault
from sweep.evaluation.results import Failure, exception_text
from sweep.measure.board_solver import BoardPoints
from sweep.measure.classify import Quads, classify, classify_decoded, flag_rejected, stacked
from sweep.measure.detectors import (
    NOISE_MARGIN_PX,
    AnyDetectorSetting,
    BoardDetectorSetting,
    BoardOutput,
    DetectorOutput,
    FindFunction,
    full_frame_reason,
    make_board_detector,
    make_detector,
    margin_px,
    uneven_light_needs_frame,
    windows,
)
from sweep.measure.flags import DetectionStatus
from sweep.model.board import Board
from sweep.model.camera import Column, map_columns
from sweep.model.extent import hidden, marker_boxes, not_modelled, outside_frame, outside_of_frame
from sweep.model.marker import marker_corners
from sweep.model.pose import transform_points
from sweep.model.printed import unseen_markers
from sweep.model.renderers import render_all
from sweep.model.scene import Scenes
from sweep.model.scene_sheet import solid_planes
from sweep.plugins.declared import PluginSetting
from sweep.plugins.recording import REJECTED, RecordedDetector, Recording, is_recording
from sweep.typing import Floats, Grey, Integers, Masks

# --------------------------------------------------------------------------------------------------
# Boards in scenes: where their markers and corners are, and what a search found of each.

@dataclass(frozen=True, slots=True)
class BoardScenes:
    """The boards of N scenes, padded to the most markers M and chessboard corners C.

    Attributes
    ----------
    boards
        Each scene's.
    marker_id
        (N, M) IDs; -1 beyond a board's markers.
    corners_px, chessboard_px
        (N, M, 4, 2) and (N, C, 2) true images; NaN beyond a board's.
    flags
        (N, M) why a marker is not searched; ``not_run`` for those that are.
    """

    boards: Sequence[Board]
    marker_id: Integers
    corners_px: Floats
    chessboard_px: Floats
    flags: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class BoardFindings:
    """What one detector setting found of N boards.

    Attributes
    ----------
    flags
        (N,) of the boards: ``detected`` if a marker is, else the flag of the marker that came
        nearest to it.
    marker_flags, marker_corners, chessboard_px
        (N, M), (N, M, 4, 2) and (N, C, 2) px of the frame; NaN for what was not found.
    points
        What estimators get of each board: all decoded markers with an ID that it has, false ones
        included, as OpenCV's ``Board.matchImagePoints`` takes them.
    """

    flags: NDArray[np.uint8]
    marker_flags: NDArray[np.uint8]
    marker_corners: Floats
    chessboard_px: Floats
    points: list[BoardPoints]


_NOT_FOUND = (
    DetectionStatus.wrong_id, DetectionStatus.rejected, DetectionStatus.no_candidate,
    DetectionStatus.not_visible, DetectionStatus.not_modelled,
)
"""Flags of a marker in the order in which they tell most about a board of which none is found."""


def board_scenes(
    scenes: Scenes, boards: Sequence[Board], visibility: NDArray[np.uint8], shape: tuple[int, int]
) -> BoardScenes:
    """Return the boards of N scenes; ``shape`` are the most markers and chessboard corners.

    ``visibility`` (N,) are the flags of the boards as a whole.
    """
    count, (most, corners) = len(scenes), shape
    ids = np.full((count, most), -1, dtype=np.int64)
    corners_px = np.full((count, most, 4, 2), np.nan)
    chessboard_px = np.full((count, corners, 2), np.nan)
    flags = np.full((count, most), DetectionStatus.not_on_board, dtype=np.uint8)
    for board in dict.fromkeys(boards):
        rows = np.flatnonzero([each is board for each in boards])
        size = len(board)
        points = np.concatenate([board.corners_m.reshape(-1, 3), board.chessboard_m])
        pixels = scenes.cameras.take(rows).project(transform_points(
            np.broadcast_to(points, (len(rows), *points.shape)), scenes.rotation[rows],
            scenes.translation[rows],
        ))
        ids[rows, :size] = board.marker_ids
        corners_px[rows, :size] = pixels[:, : 4 * size].reshape(-1, size, 4, 2)
        chessboard_px[rows, : len(board.chessboard_m)] = pixels[:, 4 * size :]
        flags[rows, :size] = visibility[rows, None]
        for row in rows[visibility[rows] == DetectionStatus.not_run].tolist():
            outside = outside_of_frame(scenes, row, board.corners_m, corners_px[row, :size])
            flags[row, :size][outside] = DetectionStatus.not_visible
            if scenes.solid[row]:
                unseen = unseen_markers(board, solid_planes(scenes, row))
                flags[row, :size][unseen] = DetectionStatus.not_visible
    return BoardScenes(boards, ids, corners_px, chessboard_px, flags)


def findings(
    boards: BoardScenes, searched: Sequence[tuple[int, *DetectorOutput]],
    completed: dict[int, BoardOutput], origin: Floats,
) -> BoardFindings:
    """Return what was found of N boards.

    Parameters
    ----------
    boards
        The boards.
    searched, origin
        As :func:`sweep.measure.classify.classify` takes them.
    completed
        Row -> what was found by means of the board.
    """
    count = len(boards.boards)
    marker_flags = boards.flags.copy()
    marker_flags[marker_flags == DetectionStatus.not_run] = DetectionStatus.no_candidate
    marker_corners = np.full_like(boards.corners_px, np.nan)
    chessboard_px = np.full_like(boards.chessboard_px, np.nan)
    none = BoardPoints(
        np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2)), np.zeros(0, dtype=np.int64),
        np.zeros((0, 2)),
    )
    points = [none] * count
    numbers = {
        board: {each: k for k, each in enumerate(board.marker_ids)}
        for board in dict.fromkeys(boards.boards)
    }
    visible = boards.flags == DetectionStatus.not_run
    # Markers as one list, whichever board they are on.
    first = np.concatenate([[0], np.cumsum(visible.sum(axis=1))])
    decoded, rejected = [], []
    for row, quads, ids, others in searched:
        true_px = boards.corners_px[row, visible[row]]
        read = stacked(quads) + origin[row]
        claimed = np.full(len(read), -1) if ids is None else np.ravel(ids)
        decoded.append(_at(true_px, read, claimed, first[row]))
        missed = stacked(others) + origin[row]
        rejected.append(_at(true_px, missed, np.full(len(missed), -1), first[row]))
        points[row] = _points(
            numbers[boards.boards[row]], read, claimed, completed.get(row), origin[row]
        )
        chessboard_px[row, points[row].chessboard] = points[row].chessboard_px
    corners_px = boards.corners_px[visible]
    found, marker_corners[visible] = classify_decoded(
        corners_px, boards.marker_id[visible], _joined(decoded)
    )
    flag_rejected(found, corners_px, _joined(rejected))
    marker_flags[visible] = found
    flags = np.full(count, DetectionStatus.not_visible, dtype=np.uint8)
    for flag in (*reversed(_NOT_FOUND), DetectionStatus.detected):
        flags[(marker_flags == flag).any(axis=1)] = flag
    return BoardFindings(flags, marker_flags, marker_corners, chessboard_px, points)


def _at(
    corners_px: Floats, quads: Floats, ids: NDArray[np.integer[Any]], first: int
) -> Quads:
    """Return quadrilaterals (Q, 4, 2) at each of M markers, whose rows begin with ``first``.

    Those whose centre lies in a marker's bounding box.
    """
    low, high = corners_px.min(axis=1) - 1, corners_px.max(axis=1) + 1
    centres = quads.mean(axis=1)
    inside = ((centres >= low[:, None]) & (centres <= high[:, None])).all(axis=2)
    marker, quad = np.nonzero(inside)
    return Quads(marker + first, quads[quad], ids[quad].astype(np.int64))


def _joined(parts: Sequence[Quads]) -> Quads:
    """Return the quadrilaterals of all parts."""
    none = Quads(np.zeros(0, dtype=np.intp), np.zeros((0, 4, 2)), np.zeros(0, dtype=np.int64))
    return Quads(*(np.concatenate(column) for column in zip(none, *parts, strict=True)))


def _points(
    numbers: Mapping[int, int], quads: Floats, ids: NDArray[np.integer[Any]],
    completed: BoardOutput | None, origin: Floats,
) -> BoardPoints:
    """Return the decoded markers with an ID of the board, and the chessboard's corners."""
    marker = np.array([numbers.get(each, -1) for each in ids.tolist()], dtype=np.int64)
    chessboard = np.zeros(0, dtype=np.int64) if completed is None else completed.chessboard_ids
    pixels = np.zeros((0, 2)) if completed is None else completed.chessboard_px + origin
    known = marker >= 0
    return BoardPoints(marker[known], quads[known], chessboard, pixels)


# --------------------------------------------------------------------------------------------------
# Detections that another program made, in the place of a search of images.

@dataclass(frozen=True, slots=True)
class RecordedPoses:
    """Poses of N detected markers: (N, 3, 3) and (N, 3) in metres; NaN where none was given."""

    rotation: Floats
    translation: Floats


def recording_of(setting: AnyDetectorSetting) -> Recording | None:
    """Return the detections of a setting that searches no images; None for others."""
    if not isinstance(setting, PluginSetting) or not is_recording(setting.plugin.name):
        return None
    record = setting.plugin.record(setting.folder)
    if not isinstance(record, RecordedDetector):
        raise TypeError(record)
    return record.recording


def recorded_candidates(
    recording: Recording, scenes: Scenes, rows: NDArray[np.intp], keys: NDArray[np.uint64],
    failures: list[Failure], setting: int,
) -> tuple[list[tuple[int, *DetectorOutput]], list[int]]:
    """Return what was found in the images of scenes ``rows``, and the rows that were not exported.

    ``keys`` (N,) are those of the scenes' images. Corners are those of the frame; where only a
    pose was given, the true camera's image of it.
    """
    candidates: list[tuple[int, *DetectorOutput]] = []
    failed = []
    for row in rows.tolist():
        try:
            part = recording.rows(keys[row])
        except Exception:
            failures.append(Failure(row, "detection", exception_text(failures), setting))
            failed.append(row)
            continue
        corners = _corners(recording, part, scenes, row)
        decoded = recording.marker_id[part] != REJECTED
        ids = recording.marker_id[part][decoded] if decoded.any() else None
        candidates.append((row, list(corners[decoded][:, None]), ids,
                           list(corners[~decoded][:, None])))
    return candidates, failed


def recorded_poses(
    recording: Recording, scenes: Scenes, rows: NDArray[np.intp], keys: NDArray[np.uint64],
    corners: Floats,
) -> RecordedPoses:
    """Return the poses that belong to the detected corners (N, 4, 2) of scenes ``rows``."""
    count = len(corners)
    poses = RecordedPoses(np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan))
    for row in rows.tolist():
        part = recording.rows(keys[row])
        same = (_corners(recording, part, scenes, row) == corners[row]).all(axis=(1, 2))
        same &= recording.marker_id[part] == scenes.marker_id[row]
        first = part.start + int(np.argmax(same))
        poses.rotation[row] = recording.rotation[first]
        poses.translation[row] = recording.translation[first]
    return poses


def _corners(recording: Recording, part: slice, scenes: Scenes, row: int) -> Floats:
    """Return the corners (n, 4, 2) of an image's markers."""
    corners = recording.corners[part]
    missing = np.isnan(corners).any(axis=(1, 2))
    if not missing.any():
        return corners
    corners = corners.copy()
    which = np.flatnonzero(missing)
    points = transform_points(
        marker_corners(np.repeat(scenes.size_m[row], len(which))),
        recording.rotation[part][which], recording.translation[part][which],
    )
    corners[which] = scenes.cameras.take(np.repeat(row, len(which))).project(points)
    return corners


def any_recorded(settings: Sequence[AnyDetectorSetting]) -> bool:
    """Return whether a setting takes its detections from a file."""
    return any(
        isinstance(setting, PluginSetting) and is_recording(setting.plugin.name)
        for setting in settings
    )


# --------------------------------------------------------------------------------------------------
# Scenes to detections: windows, rendering in groups, search with each detector setting.

@dataclass(slots=True)
class SearchResult:
    """Detections of N scenes with one detector setting.

    Attributes
    ----------
    flags
        (N,) :class:`~sweep.measure.flags.DetectionStatus`.
    corners
        (N, 4, 2) px in the frame; NaN if the marker was not detected.
    seconds
        Time spent on searching.
    images
        Row -> the image that was searched, if images were to be kept.
    origins
        (N, 2) the first pixel of each searched image in the frame.
    poses
        Those that recorded detections have; None where images are searched.
    boards
        What was found of the boards; None for scenes of single markers, whose corners are NaN.
    """

    flags: NDArray[np.uint8]
    corners: Floats
    seconds: float
    images: dict[int, Grey]
    origins: Integers
    poses: RecordedPoses | None = None
    boards: BoardFindings | None = None


def whole_frames(values: Mapping[str, Column], count: int) -> Masks:
    """Return (N,) which scenes are rendered as whole frames: as asked, or on a background image."""
    whole = map_columns(
        lambda window, background: window == "full" or isinstance(background, str),
        [values["window"], values["background"]],
    )
    return whole.broadcast(count, np.bool_)


def visibility_flags(scenes: Scenes) -> NDArray[np.uint8]:
    """Return why scenes (N,) are not searched; not_run for those that must be.

    A pose that is NaN is that of a marker that a photograph does not show.
    """
    flags = np.full(len(scenes), DetectionStatus.not_run, dtype=np.uint8)
    behind = hidden(scenes)
    flags[behind] = DetectionStatus.not_visible
    flags[not_modelled(scenes) & ~behind] = DetectionStatus.not_modelled
    open_rows = np.flatnonzero(flags == DetectionStatus.not_run)
    flags[open_rows[outside_frame(scenes, open_rows)]] = DetectionStatus.not_visible
    flags[np.isnan(scenes.translation).any(axis=1)] = DetectionStatus.not_in_photograph
    return flags


def search_windows(
    scenes: Scenes, boxes: Integers, setting: AnyDetectorSetting, full: Masks
) -> Integers:
    """Return the windows that a setting searches: a function of scene and setting alone.

    Parameters
    ----------
    scenes
        N scenes.
    boxes
        (N, 4) left, top, right, bottom of what each marker can influence, px.
    setting
        The detector setting.
    full
        (N,) scenes of which the whole frame is searched.

    Returns
    -------
    ndarray
        (N, 4) left, top, right, bottom in pixels of the frame, half-open.
    """
    margin = margin_px(setting) + NOISE_MARGIN_PX * scenes.noise_coarseness[:, None]
    cut = windows(boxes, scenes.frame, margin)
    whole = full | (full_frame_reason(setting) is not None)
    whole |= uneven_light_needs_frame(setting, scenes.uneven_gain)
    frame = np.concatenate([np.zeros_like(scenes.frame), scenes.frame], axis=1)
    return np.where(whole[:, None], frame, cut)


def search(
    scenes: Scenes,
    wanted: Masks,
    settings: Sequence[AnyDetectorSetting],
    full: Masks,
    failures: list[Failure],
    *,
    keep: bool = False,
    keys: NDArray[np.uint64] | None = None,
    boards: BoardScenes | None = None,
    board_settings: Sequence[BoardDetectorSetting] = (),
) -> tuple[list[SearchResult], float, Floats]:
    """Render each scene once and search it with detector settings.

    Parameters
    ----------
    scenes
        N scenes.
    wanted
        (N, settings) which scene is searched with which setting.
    settings
        The detector settings.
    full
        (N,) scenes that are rendered and searched as whole frames.
    failures
        The exceptions of single scenes are appended.
    keep
        Whether the results keep the images.
    keys
        (N,) keys of the images, by which recorded detections are found.
    boards, board_settings
        The scenes' boards, and what each detector setting does with them; None for single markers.

    Returns
    -------
    results : list of SearchResult
        One for each setting.
    render_s : float
        Seconds spent on rendering.
    row_s : ndarray
        (N,) seconds spent on each scene.
    """
    boxes = marker_boxes(scenes)
    cut = [search_windows(scenes, boxes, setting, full) for setting in settings]
    widest = np.concatenate(
        [
            np.min([window[:, :2] for window in cut], axis=0),
            np.max([window[:, 2:] for window in cut], axis=0),
        ],
        axis=1,
    )
    # A setting whose windows are those that are rendered needs no crops.
    crops = [
        None if (window == widest).all() else (window - np.tile(widest[:, :2], 2)).tolist()
        for window in cut
    ]
    recordings = [recording_of(setting) for setting in settings]
    passes = [_Pass(make_detector(setting)) for setting in settings]
    board_detectors = [
        make_board_detector(setting, board_setting)
        for setting, board_setting in zip(settings, board_settings, strict=boards is not None)
    ]
    imaged = wanted if keep else wanted & np.array([each is None for each in recordings])
    dictionary, sides = scenes.dictionary, scenes.frame.max(axis=1).tolist()
    render_s = 0.0
    row_s = [0.0] * len(scenes)
    clock = time.perf_counter
    asked = imaged.T.tolist()
    for rows in _groups(np.flatnonzero(imaged.any(axis=1)), widest, scenes.plain):
        begun = clock()
        images = _rendered(scenes, rows, boxes, widest, failures)
        now = clock()
        render_s += now - begun
        for row in rows.tolist():
            row_s[row] = (now - begun) / len(rows)
        for k, (setting_pass, crop, ask) in enumerate(zip(passes, crops, asked, strict=True)):
            find, note = setting_pass.find, setting_pass.candidates.append
            begun = now = clock()
            for row, image in zip(rows.tolist(), images, strict=True):
                if not ask[row]:
                    continue
                start = now
                if image is None:
                    setting_pass.failed.append(row)
                    continue
                searched = image
                if crop is not None:
                    x0, y0, x1, y1 = crop[row]
                    searched = image[y0:y1, x0:x1]
                if keep:
                    setting_pass.images[row] = searched
                if recordings[k] is not None:
                    continue
                if setting_pass.searched is searched and setting_pass.sought == dictionary[row]:
                    note((row, *setting_pass.candidates[-1][1:]))  # another marker of a photograph
                    continue
                try:
                    output = find(searched, dictionary[row], sides[row])
                    if boards is not None:
                        completed = board_detectors[k].complete(
                            searched, boards.boards[row], output
                        )
                        setting_pass.completed[row], output = completed, completed.markers
                    note((row, *output))
                    setting_pass.searched, setting_pass.sought = searched, dictionary[row]
                except Exception as error:
                    raise_machine_fault(error)
                    failures.append(Failure(row, "detection", exception_text(failures), k))
                    setting_pass.failed.append(row)
                now = clock()
                row_s[row] += now - start
            setting_pass.seconds += now - begun

    results = []
    marker_id = np.array(scenes.marker_id, dtype=np.int64)
    for k, (setting_pass, recording, window) in enumerate(
        zip(passes, recordings, cut, strict=True)
    ):
        start = clock()
        origin = window[:, :2].astype(np.float64)
        if recording is not None:
            if keys is None:
                raise TypeError("recorded detections need keys")
            rows = np.setdiff1d(np.flatnonzero(wanted[:, k]), setting_pass.failed)
            setting_pass.candidates, unknown = recorded_candidates(
                recording, scenes, rows, keys, failures, k
            )
            setting_pass.failed += unknown
            origin = np.zeros_like(origin)  # they are in pixels of the frame
        found = None
        if boards is None:
            flags, corners = classify(
                scenes.corners_px, marker_id, setting_pass.candidates, origin
            )
        else:
            found = findings(boards, setting_pass.candidates, setting_pass.completed, origin)
            flags, corners = found.flags, np.full_like(scenes.corners_px, np.nan)
        flags[setting_pass.failed] = DetectionStatus.failed
        poses = None
        if recording is not None and keys is not None:
            rows = np.flatnonzero(flags == DetectionStatus.detected)
            poses = recorded_poses(recording, scenes, rows, keys, corners)
        results.append(
            SearchResult(
                flags, corners, setting_pass.seconds + clock() - start, setting_pass.images,
                window[:, :2], poses, found,
            )
        )
    return results, render_s, np.array(row_s)


@dataclass(slots=True)
class _Pass:
    """The search with one setting: its candidates by row, and the rows for which it raised.

    ``searched`` is the image of the last of the candidates, ``sought`` its dictionary: what was
    found in a photograph counts for all its markers. ``completed`` is what was found by means of a
    board.
    """

    find: FindFunction
    candidates: list[tuple[int, *DetectorOutput]] = field(default_factory=list)
    images: dict[int, Grey] = field(default_factory=dict)
    failed: list[int] = field(default_factory=list)
    completed: dict[int, BoardOutput] = field(default_factory=dict)
    seconds: float = 0.0
    searched: Grey | None = None
    sought: str = ""


GROUP_PX = 1 << 24
"""Pixels that are rendered, in one call, before they are searched: 17 MB of memory."""


def _groups(
    rows: NDArray[np.intp], windows: Integers, plain: Masks
) -> Iterator[NDArray[np.intp]]:
    """Cut rows into runs whose windows have about ``GROUP_PX`` pixels, at least one each.

    A scene that is not ``plain`` (N,) is rendered alone, so that its time is its own.
    """
    if not len(rows):
        return
    size = windows[rows, 2:] - windows[rows, :2]
    number = np.cumsum(size[:, 0] * size[:, 1]) // GROUP_PX
    alone = ~plain[rows]
    cuts = (np.diff(number) != 0) | alone[1:] | alone[:-1]
    yield from np.split(rows, np.flatnonzero(cuts) + 1)


def _rendered(
    scenes: Scenes, rows: NDArray[np.intp], boxes: Integers, windows: Integers,
    failures: list[Failure],
) -> Sequence[Grey | None]:
    """Return the images of ``rows`` in their windows; None for those whose rendering raised."""
    try:
        return render_all(scenes, rows, boxes[rows], windows[rows])
    except Exception as batch_error:
        raise_machine_fault(batch_error)
        images: list[Grey | None] = []
        for row in rows.tolist():
            alone = np.array([row])
            try:
                images += render_all(scenes, alone, boxes[alone], windows[alone])
            except Exception as error:
                raise_machine_fault(error)
                failures.append(Failure(row, "scene", exception_text(failures)))
                images.append(None)
        return images
