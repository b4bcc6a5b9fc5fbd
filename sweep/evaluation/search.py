"""Scenes to detections: windows, rendering in groups, search with each detector setting."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sweep.evaluation.board_search import BoardFindings, BoardScenes, findings
from sweep.evaluation.foreign_search import ForeignSearch
from sweep.evaluation.machine_faults import raise_machine_fault
from sweep.evaluation.recorded_search import (
    RecordedPoses,
    recorded_candidates,
    recorded_poses,
    recording_of,
)
from sweep.evaluation.results import Failure, exception_text
from sweep.measure.board_detector import BoardDetectorSetting, BoardOutput
from sweep.measure.classify import classify
from sweep.measure.detector import NOISE_MARGIN_PX, DetectorOutput, windows
from sweep.measure.detectors import (
    AnyDetectorSetting,
    FindFunction,
    full_frame_reason,
    make_board_detector,
    make_detector,
    margin_px,
    uneven_light_needs_frame,
)
from sweep.measure.flags import DetectionStatus
from sweep.measure.foreign_detector import ForeignDetector
from sweep.model.columns import Column, map_columns
from sweep.model.extent import hidden, marker_boxes, not_modelled, outside_frame
from sweep.model.renderers import render_all
from sweep.model.scene import Scenes
from sweep.typing import Floats, Grey, Integers, Masks


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
    searches = [
        ForeignSearch(
            each.find, k, dictionary, sides, row_s, failures, each.candidates, each.failed,
            each.crashed,
        ) if isinstance(each.find, ForeignDetector) else None
        for k, each in enumerate(passes)
    ]
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
            elsewhere = searches[k]
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
                if elsewhere is not None:
                    elsewhere.add(row, searched)
                    now = clock()
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

    for setting_pass, elsewhere in zip(passes, searches, strict=True):
        if elsewhere is not None:
            begun = clock()
            elsewhere.search()
            setting_pass.seconds += clock() - begun

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
        flags[setting_pass.crashed] = DetectionStatus.crashed
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
    crashed: list[int] = field(default_factory=list)
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
