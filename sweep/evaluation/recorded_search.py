"""Detections that another program made, in the place of a search of images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sweep.evaluation.results import Failure, exception_text
from sweep.measure.detector import DetectorOutput
from sweep.measure.detectors import AnyDetectorSetting
from sweep.model.marker import marker_corners
from sweep.model.pose import transform_points
from sweep.model.scene import Scenes
from sweep.plugins.declared import PluginSetting
from sweep.plugins.recording import REJECTED, RecordedDetector, Recording, is_recording
from sweep.typing import Floats


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
