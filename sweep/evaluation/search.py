"""From scenes to images and detections: their sources, and the loop that renders and searches."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sweep.evaluation.machine_faults import raise_machine_fault
from sweep.evaluation.results import Failure, all_or_each, note_failure
from sweep.experiment.experiment import Experiment
from sweep.measure.classify import Findings, TargetScenes, classify, target_scenes
from sweep.measure.detectors import (
    NOISE_MARGIN_PX,
    AnyDetectorSetting,
    SearchOutput,
    full_frame_reason,
    margin_px,
    uneven_light_needs_frame,
    windows,
)
from sweep.measure.flags import DetectionStatus
from sweep.measure.sources import DetectionSource, detection_source
from sweep.model.camera import Column, map_columns
from sweep.model.exposure import hidden, marker_boxes, not_modelled, outside_frame
from sweep.model.renderers import render_all
from sweep.model.scene import Scenes, build_scenes
from sweep.plugins import Poses
from sweep.typing import Grey, Integers, Masks

# --------------------------------------------------------------------------------------------------
# Scenes that are in memory together.

@dataclass(frozen=True, slots=True)
class SceneBatch:
    """N scenes that are in memory together.

    Attributes
    ----------
    experiment
        The experiment that they are of.
    indices
        (N,) along each scene axis of the grid.
    values, scenes
        Parameters and geometry.
    visibility
        (N,) why the scenes are not searched; ``not_run`` for those that are.
    targets
        The targets of the scenes.
    boxes
        (N, 4) left, top, right, bottom of the pixels that the targets can influence.
    """

    experiment: Experiment
    indices: Sequence[NDArray[np.intp]]
    values: Mapping[str, Column]
    scenes: Scenes
    visibility: NDArray[np.uint8]
    targets: TargetScenes
    boxes: Integers

    @property
    def visible(self) -> Masks:
        """(N,) the scenes that are searched."""
        return np.asarray(self.visibility == DetectionStatus.not_run)


def scenes_at(experiment: Experiment, indices: Sequence[NDArray[np.intp]]) -> SceneBatch:
    """Return the scenes at indices (N,) along each scene axis."""
    count = len(indices[0]) if indices else 1
    values = experiment.scene_values(indices)
    scenes = build_scenes(values, count, experiment.scene_plugins)
    absent = values["absent"].values if "absent" in values else DetectionStatus.not_in_photograph
    visibility = visibility_flags(scenes, absent)
    boards = values["board"].listed(count) if "board" in values else None
    targets = target_scenes(scenes, visibility, boards, experiment.grid.largest_board)
    return SceneBatch(
        experiment, indices, values, scenes, visibility, targets, marker_boxes(scenes))


# --------------------------------------------------------------------------------------------------
# Where images come from: a renderer, or a photograph.

#: A function from N scenes, the rows (n,) of some, the boxes (n, 4) that their targets can touch,
#: and their windows (n, 4) in the frame, to n images of these windows.
#:
#: It is :func:`sweep.model.renderers.render_all`, which draws a scene or cuts it out of a
#: photograph, as the scene's renderer says.
ImageSource = Callable[[Scenes, NDArray[np.intp], Integers, Integers], Sequence[Grey]]


def images_of(
    source: ImageSource, batch: SceneBatch, rows: NDArray[np.intp], windows: Integers,
    failures: list[Failure],
) -> list[Grey | None]:
    """Return the images of ``rows`` (n,) in their ``windows`` (N, 4); None where that raises."""
    parts = all_or_each(
        lambda some: source(batch.scenes, some, batch.boxes[some], windows[some]), rows,
        lambda row: note_failure(failures, row, "scene"),
    )
    return [image for part in parts for image in ([None] if part is None else part)]


# --------------------------------------------------------------------------------------------------
# Scenes to detections: sources, windows, rendering in groups, search with each detector setting.

def detection_sources(batch: SceneBatch) -> list[DetectionSource]:
    """Return where the detections of a batch come from, by detector setting."""
    experiment = batch.experiment
    return [
        detection_source(
            setting, on_board, batch.scenes, batch.targets,
            lambda: experiment.image_keys(batch.indices),
        )
        for setting, on_board in zip(experiment.detectors, experiment.board_settings, strict=True)
    ]


@dataclass(slots=True)
class SearchResult:
    """Detections of N scenes with one detector setting.

    Attributes
    ----------
    targets, found
        The targets of the scenes, with the markers that were found of each.
    flags
        (N,) :class:`~sweep.measure.flags.DetectionStatus`: the flags of ``found``, or ``failed``.
    seconds
        Time spent on searching.
    images
        Row -> the image that was searched, if images were to be kept.
    origins
        (N, 2) the first pixel of each searched image in the frame.
    poses
        Poses that come with the detections (:meth:`DetectionSource.poses`).
    outputs, output_origins
        Row -> the markers that the source found, and (N, 2) the pixel of the frame from which it
        counts.
    """

    targets: TargetScenes
    found: Findings
    flags: NDArray[np.uint8]
    seconds: float
    images: dict[int, Grey]
    origins: Integers
    poses: Poses
    outputs: Mapping[int, SearchOutput]
    output_origins: Integers


def whole_frames(batch: SceneBatch) -> Masks:
    """Return (N,) which scenes are rendered as whole frames: as asked, or on a background image."""
    whole = map_columns(
        lambda window, background: window == "full" or isinstance(background, str),
        [batch.values["window"], batch.values["background"]],
    )
    return whole.broadcast(len(batch.scenes), np.bool_)


def visibility_flags(scenes: Scenes, absent: NDArray[np.uint8] | int) -> NDArray[np.uint8]:
    """Return why scenes (N,) are not searched; not_run for those that must be.

    The pose of a marker that a photograph does not show is NaN: it gets ``absent``, (N,) or one.
    """
    flags = np.full(len(scenes), DetectionStatus.not_run, dtype=np.uint8)
    behind = hidden(scenes)
    flags[behind] = DetectionStatus.not_visible
    flags[not_modelled(scenes) & ~behind] = DetectionStatus.not_modelled
    open_rows = np.flatnonzero(flags == DetectionStatus.not_run)
    flags[open_rows[outside_frame(scenes, open_rows)]] = DetectionStatus.not_visible
    return np.where(np.isnan(scenes.translation).any(axis=1), absent, flags).astype(np.uint8)


def search_windows(
    scenes: Scenes, boxes: Integers, setting: AnyDetectorSetting, full: Masks
) -> Integers:
    """Return the windows that a setting searches: a function of scene and setting alone.

    Parameters
    ----------
    scenes
        N scenes.
    boxes
        (N, 4) left, top, right, bottom of the pixels that each marker can influence.
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


def searched_windows(batch: SceneBatch) -> list[Integers]:
    """Return the windows (N, 4) that each detector setting searches."""
    full = whole_frames(batch)
    return [
        search_windows(batch.scenes, batch.boxes, setting, full)
        for setting in batch.experiment.detectors
    ]


def common_windows(windows: Sequence[Integers]) -> Integers:
    """Return the smallest windows (N, 4) that hold several settings' windows (N, 4)."""
    return np.concatenate([
        np.min([each[:, :2] for each in windows], axis=0),
        np.max([each[:, 2:] for each in windows], axis=0),
    ], axis=1)


def detections_of(
    batch: SceneBatch, wanted: Masks, failures: list[Failure], *, keep: bool = False
) -> list[SearchResult]:
    """Render each scene once and search it with each detector setting; return a result for each.

    Parameters
    ----------
    batch
        N scenes.
    wanted
        (N, detector settings) which scene is searched with which setting.
    failures
        The exceptions of single scenes are appended.
    keep
        Whether the results keep the images.
    """
    sources, windows = detection_sources(batch), searched_windows(batch)
    rendered = common_windows(windows)
    passes = [
        _Pass(source, k, cut, rendered, keep, failures)
        for k, (source, cut) in enumerate(zip(sources, windows, strict=True))
    ]
    imaged = wanted & np.array([keep or source.needs_images for source in sources])
    for rows in _groups(np.flatnonzero(imaged.any(axis=1)), rendered, batch.scenes):
        images = images_of(render_all, batch, rows, rendered, failures)
        for each in passes:
            some = np.flatnonzero(imaged[rows, each.number])
            each.search(rows[some], [images[i] for i in some.tolist()])
    for each in passes:
        unseen = np.flatnonzero(wanted[:, each.number] & ~imaged[:, each.number])
        each.search(unseen, [_UNSEEN] * len(unseen))
    return [each.result(batch.targets) for each in passes]


#: The image of a scene that is not rendered, since no source needs it.
_UNSEEN = np.empty((0, 0), dtype=np.uint8)


@dataclass(slots=True)
class _Pass:
    """The search by one source: its windows (N, 4), those that are rendered, its outputs by row.

    ``seconds`` are spent on all scenes so far, ``failed`` are the rows that raised.
    """

    source: DetectionSource
    number: int
    windows: Integers
    rendered: Integers
    keep: bool
    failures: list[Failure]
    seconds: float = 0.0
    outputs: dict[int, SearchOutput] = field(default_factory=dict)
    images: dict[int, Grey] = field(default_factory=dict)
    failed: list[int] = field(default_factory=list)

    def search(self, rows: NDArray[np.intp], images: Sequence[Grey | None]) -> None:
        """Search the rendered images of scenes ``rows`` (n,); None is one that was not rendered."""
        cut = self.windows[rows] - np.tile(self.rendered[rows, :2], 2)
        cropped = (self.windows[rows] != self.rendered[rows]).any(axis=1)
        for i, (row, image) in enumerate(zip(rows.tolist(), images, strict=True)):
            if image is None:
                self.failed.append(row)
                continue
            begun = time.perf_counter()
            if cropped[i] and image is not _UNSEEN:
                left, top, right, bottom = cut[i].tolist()
                image = image[top:bottom, left:right]  # noqa: PLW2901
            if self.keep:
                self.images[row] = image
            try:
                self.outputs[row] = self.source(row, image)
            except Exception as error:
                if self.source.needs_images:
                    raise_machine_fault(error)
                note_failure(self.failures, row, "detection", self.number)
                self.failed.append(row)
            self.seconds += time.perf_counter() - begun

    def result(self, targets: TargetScenes) -> SearchResult:
        """Return the markers that were found in the windows."""
        begun, first = time.perf_counter(), self.windows[:, :2]
        origins = first if self.source.needs_images else np.zeros_like(first)
        found = classify(targets, self.outputs, origins.astype(np.float64))
        flags = found.flags.copy()
        flags[self.failed] = DetectionStatus.failed
        poses = self.source.poses(found)
        seconds = self.seconds + time.perf_counter() - begun
        return SearchResult(
            targets, found, flags, seconds, self.images, first, poses, self.outputs, origins)


#: Pixels that are rendered, in one call, before they are searched: 17 MB of memory.
GROUP_PX = 1 << 24


def _groups(
    rows: NDArray[np.intp], windows: Integers, scenes: Scenes
) -> Iterator[NDArray[np.intp]]:
    """Cut rows into runs whose windows have about ``GROUP_PX`` pixels, at least one each.

    A scene that is not plain is rendered alone.
    """
    if not len(rows):
        return
    size = windows[rows, 2:] - windows[rows, :2]
    number = np.cumsum(size[:, 0] * size[:, 1]) // GROUP_PX
    alone = ~scenes.plain(rows)
    cuts = (np.diff(number) != 0) | alone[1:] | alone[:-1]
    yield from np.split(rows, np.flatnonzero(cuts) + 1)
