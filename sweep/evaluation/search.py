"""Search: from a scene's image to its detections, by detectors or of recordings."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import compress
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from sweep.evaluation.machine_faults import raise_machine_fault
from sweep.evaluation.results import Failure, exception_text
from sweep.measure.classify import Findings, TargetScenes, classify, target_scenes
from sweep.measure.detectors import (
    NOISE_MARGIN_PX,
    AnyDetectorSetting,
    BoardDetector,
    BoardDetectorSetting,
    FindFunction,
    SearchOutput,
    full_frame_reason,
    make_board_detector,
    make_detector,
    margin_px,
    uneven_light_needs_frame,
    windows,
)
from sweep.measure.flags import DetectionStatus
from sweep.model.camera import Column, map_columns
from sweep.model.extent import hidden, marker_boxes, not_modelled, outside_frame
from sweep.model.pose import transform_points
from sweep.model.renderers import render_all
from sweep.model.scene import Scenes
from sweep.plugins.declared import PluginSetting
from sweep.plugins.recording import OF_TARGET, REJECTED, Recording, is_recording
from sweep.typing import Floats, Grey, Integers, Masks

# --------------------------------------------------------------------------------------------------
# Where detections come from: a detector that searches images, or what another program found.

class DetectionSource(Protocol):
    """Where the detections of N scenes with one setting come from.

    One that needs images gets them in windows; else its pixels are those of the frame.
    """

    @property
    def needs_images(self) -> bool:
        """Whether scenes are rendered for it."""
        ...

    def __call__(self, row: int, image: Grey) -> SearchOutput:
        """Return what is found in the image of scene ``row``."""
        ...

    def poses(self, found: Findings) -> Poses | None:
        """Return the poses that come with what was found; None if there never are any."""
        ...


class Poses(NamedTuple):
    """Poses of N detected targets: (N, 3, 3) and (N, 3) in metres; NaN where none was given."""

    rotation: Floats
    translation: Floats


@dataclass(slots=True)
class ImageSearch:
    """A detector's search of scenes' images.

    Attributes
    ----------
    find, boards
        The search for markers, and what OpenCV does by means of a board.
    scenes, targets
        What the images show.
    """

    find: FindFunction
    boards: BoardDetector
    scenes: Scenes
    targets: TargetScenes
    needs_images: bool = True
    _last: tuple[Grey, str, SearchOutput] | None = None

    def __call__(self, row: int, image: Grey) -> SearchOutput:
        """Return what is found in an image of scene ``row``."""
        dictionary, target = self.scenes.targets[row].dictionary, self.targets.targets[row]
        if self._last is not None and self._last[0] is image and self._last[1] == dictionary:
            return self._last[2]  # another marker of a photograph
        found = self.find(image, dictionary, int(self.scenes.frame[row].max()))
        output = (
            SearchOutput(*found) if target.is_marker
            else self.boards.complete(image, target, found)
        )
        self._last = image, dictionary, output
        return output

    def poses(self, found: Findings) -> None:
        """Return None: images have no poses."""


@dataclass(frozen=True, slots=True)
class RecordedSearch:
    """Detections that another program made, in the place of a search of images.

    Attributes
    ----------
    recording, scenes, targets
        The detections, and the scenes whose images they are of.
    keys
        (N,) keys of the scenes' images.
    """

    recording: Recording
    scenes: Scenes
    targets: TargetScenes
    keys: NDArray[np.uint64]
    needs_images: bool = False

    def __call__(self, row: int, image: Grey) -> SearchOutput:  # noqa: ARG002
        """Return what was found in the image of scene ``row``, in pixels of the frame."""
        quads, ids, _ = self._squares(row)
        decoded, corners = ids != REJECTED, quads[:, None]
        return SearchOutput(
            list(corners[decoded]), ids[decoded] if decoded.any() else None,
            list(corners[~decoded]),
        )

    def poses(self, found: Findings) -> Poses:
        """Return the pose of each detected target: of the target itself, or of a square of it."""
        count = len(found.flags)
        poses = Poses(np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan))
        for row in np.flatnonzero(found.flags == DetectionStatus.detected).tolist():
            part = self.recording.rows(self.keys[row])
            of_target = part.start + np.flatnonzero(self.recording.marker_id[part] == OF_TARGET)
            first, last = np.searchsorted(found.owner, [row, row + 1])
            squares = found.corners[first:last]
            chosen = of_target.tolist() + [
                at for quad, number, at in zip(*self._squares(row), strict=True)
                if number in self.targets.targets[row].marker_ids
                and (quad == squares).all(axis=(1, 2)).any()
            ]
            for at in chosen:
                if np.isfinite(self.recording.translation[at]).all():
                    poses.rotation[row] = self.recording.rotation[at]
                    poses.translation[row] = self.recording.translation[at]
                    break
        return poses

    def _squares(self, row: int) -> tuple[Floats, Integers, Integers]:
        """Return the squares of an image: corners (n, 4, 2), IDs and rows of the recording (n,).

        Where only a pose was given, the corners are the true camera's image of its square (the
        first, of an ID that the target lacks); of the pose of the target as a whole all of them,
        if the image has no corners.
        """
        part, target = self.recording.rows(self.keys[row]), self.targets.targets[row]
        given, ids = self.recording.corners[part], self.recording.marker_id[part]
        missing = np.isnan(given).any(axis=(1, 2))
        numbers = {marker_id: k for k, marker_id in enumerate(target.marker_ids)}
        objects = target.corners_m * (self.scenes.size_m[row] if target.is_marker else 1.0)
        quads, known, rows = [given[~missing]], ids[~missing].tolist(), np.flatnonzero(~missing)
        at = rows.tolist()
        for i in np.flatnonzero(missing).tolist():
            if ids[i] != OF_TARGET:
                shown = {int(ids[i]): numbers.get(int(ids[i]), 0)}
            else:
                shown = numbers if missing.all() else {}
            points = transform_points(
                objects[list(shown.values())].reshape(1, -1, 3),
                self.recording.rotation[part][[i]], self.recording.translation[part][[i]],
            )
            pixels = self.scenes.cameras.take(np.array([row])).project(points)
            quads.append(pixels.reshape(-1, 4, 2))
            known += shown
            at += [i] * len(shown)
        order = np.argsort(at, kind="stable")
        return (
            np.concatenate(quads)[order], np.array(known, dtype=np.int64)[order],
            part.start + np.array(at, dtype=np.int64)[order],
        )


def detection_source(
    setting: AnyDetectorSetting, scenes: Scenes, targets: TargetScenes,
    keys: NDArray[np.uint64] | None, board_setting: BoardDetectorSetting,
) -> DetectionSource:
    """Return where a setting's detections of scenes come from; ``keys`` are for recordings."""
    if isinstance(setting, PluginSetting) and is_recorded(setting):
        if keys is None:
            raise TypeError("recorded detections need keys")
        return RecordedSearch(setting.record().recording, scenes, targets, keys)
    return ImageSearch(
        make_detector(setting), make_board_detector(setting, board_setting), scenes, targets
    )


def is_recorded(setting: AnyDetectorSetting) -> bool:
    """Return whether a setting takes its detections from a file."""
    return isinstance(setting, PluginSetting) and is_recording(setting.plugin.name)


# --------------------------------------------------------------------------------------------------
# Scenes to detections: windows, rendering in groups, search with each detector setting.

@dataclass(slots=True)
class SearchResult:
    """Detections of N scenes with one detector setting.

    Attributes
    ----------
    targets, found
        What the scenes show, and what was found of it.
    flags
        (N,) :class:`~sweep.measure.flags.DetectionStatus`: those of ``found``, or ``failed``.
    seconds
        Time spent on searching.
    images
        Row -> the image that was searched, if images were to be kept.
    origins
        (N, 2) the first pixel of each searched image in the frame.
    poses
        Those that recorded detections have; None where images are searched.
    """

    targets: TargetScenes
    found: Findings
    flags: NDArray[np.uint8]
    seconds: float
    images: dict[int, Grey]
    origins: Integers
    poses: Poses | None = None


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
    margin = margin_px(setting) + NOISE_MARGIN_PX * scenes.effects.noise_coarseness[:, None]
    cut = windows(boxes, scenes.frame, margin)
    whole = full | (full_frame_reason(setting) is not None)
    whole |= uneven_light_needs_frame(setting, scenes.effects.uneven_gain)
    frame = np.concatenate([np.zeros_like(scenes.frame), scenes.frame], axis=1)
    return np.where(whole[:, None], frame, cut)


def common_windows(windows: Sequence[Integers]) -> Integers:
    """Return the smallest windows (N, 4) that hold several settings' windows (N, 4)."""
    return np.concatenate([
        np.min([each[:, :2] for each in windows], axis=0),
        np.max([each[:, 2:] for each in windows], axis=0),
    ], axis=1)


def search(
    scenes: Scenes,
    wanted: Masks,
    settings: Sequence[AnyDetectorSetting],
    full: Masks,
    failures: list[Failure],
    *,
    keep: bool = False,
    keys: NDArray[np.uint64] | None = None,
    targets: TargetScenes | None = None,
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
    targets
        What the scenes show; by default markers, all of them visible.
    board_settings
        What each detector setting does with boards; by default OpenCV's.

    Returns
    -------
    results : list of SearchResult
        One for each setting.
    render_s : float
        Seconds spent on rendering.
    row_s : ndarray
        (N,) seconds spent on each scene.
    """
    if targets is None:
        targets = target_scenes(scenes, np.full(len(scenes), DetectionStatus.not_run, np.uint8))
    boxes = marker_boxes(scenes)
    on_boards = board_settings or [BoardDetectorSetting()] * len(settings)
    passes = [
        _Pass(
            detection_source(setting, scenes, targets, keys, on_board), k,
            search_windows(scenes, boxes, setting, full), keep, failures, np.zeros(len(scenes)),
        )
        for k, (setting, on_board) in enumerate(zip(settings, on_boards, strict=True))
    ]
    widest = common_windows([each.windows for each in passes])
    for each in passes:
        each.cut_from(widest)
    imaged = wanted & np.array([keep or each.source.needs_images for each in passes])
    render_s, render_row_s = 0.0, np.zeros(len(scenes))
    for rows in _groups(np.flatnonzero(imaged.any(axis=1)), widest, scenes.plain):
        begun = time.perf_counter()
        images = rendered(scenes, rows, boxes, widest, failures)
        spent = time.perf_counter() - begun
        render_s += spent
        render_row_s[rows] = spent / len(rows)
        for each in passes:
            asked = imaged[rows, each.number]
            each.search(rows[asked].tolist(), list(compress(images, asked)))
    for each in passes:
        unseen = np.flatnonzero(wanted[:, each.number] & ~imaged[:, each.number])
        each.search(unseen.tolist(), [_UNSEEN] * len(unseen))
    results = [each.result(targets) for each in passes]
    return results, render_s, render_row_s + np.sum([each.row_s for each in passes], axis=0)


_UNSEEN = np.empty((0, 0), dtype=np.uint8)
"""The image of a scene that is not rendered, since no source needs it."""


@dataclass(slots=True)
class _Pass:
    """The search with one setting, its windows (N, 4) and its outputs by row.

    ``crops`` are the windows in the rendered images, if these are larger; ``failed`` are the rows
    for which it raised, ``row_s`` (N,) the seconds spent on each.
    """

    source: DetectionSource
    number: int
    windows: Integers
    keep: bool
    failures: list[Failure]
    row_s: Floats
    crops: list[list[int]] | None = None
    outputs: dict[int, SearchOutput] = field(default_factory=dict)
    images: dict[int, Grey] = field(default_factory=dict)
    failed: list[int] = field(default_factory=list)
    seconds: float = 0.0

    def cut_from(self, rendered: Integers) -> None:
        """Take the windows' images from those of windows (N, 4), which hold them."""
        if not (self.windows == rendered).all():
            self.crops = (self.windows - np.tile(rendered[:, :2], 2)).tolist()

    def search(self, rows: Sequence[int], images: Sequence[Grey | None]) -> None:
        """Search the rendered images of scenes ``rows``; None are those that were not rendered."""
        begun = now = time.perf_counter()
        for row, image in zip(rows, images, strict=True):
            start = now
            if image is None:
                self.failed.append(row)
                continue
            searched = image
            if self.crops is not None:
                x0, y0, x1, y1 = self.crops[row]
                searched = image[y0:y1, x0:x1]
            if self.keep:
                self.images[row] = searched
            try:
                self.outputs[row] = self.source(row, searched)
            except Exception as error:
                if self.source.needs_images:
                    raise_machine_fault(error)
                text = exception_text(len(self.failures))
                self.failures.append(Failure(row, "detection", text, self.number))
                self.failed.append(row)
            now = time.perf_counter()
            self.row_s[row] += now - start
        self.seconds += now - begun

    def result(self, targets: TargetScenes) -> SearchResult:
        """Return what was found."""
        start, origins = time.perf_counter(), self.windows[:, :2]
        offset = origins if self.source.needs_images else np.zeros_like(origins)
        found = classify(targets, self.outputs, offset.astype(np.float64))
        flags = found.flags.copy()
        flags[self.failed] = DetectionStatus.failed
        poses = self.source.poses(found)
        seconds = self.seconds + time.perf_counter() - start
        return SearchResult(targets, found, flags, seconds, self.images, origins, poses)


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


def rendered(
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
                failures.append(Failure(row, "scene", exception_text(len(failures))))
                images.append(None)
        return images
