"""Where detections come from: a detector that searches images, or what another program found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sweep.measure import detectors
from sweep.measure.classify import Findings, TargetScenes
from sweep.measure.detectors import DetectorSetting, SearchOutput
from sweep.measure.flags import DetectionStatus
from sweep.model.pose import transform_points
from sweep.model.scene import Scenes
from sweep.plugins import Poses
from sweep.plugins.loading import OF_TARGET, REJECTED, Recording, is_recording
from sweep.typing import Floats, Grey, Integers


@dataclass(slots=True)
class ImageSearch:
    """A detector's search of scenes' images.

    Attributes
    ----------
    setting, on_board
        The detector of markers, and how OpenCV uses what it knows of a board.
    scenes, targets
        The targets in the images.
    """

    setting: detectors.AnyDetectorSetting
    on_board: detectors.BoardDetectorSetting
    scenes: Scenes
    targets: TargetScenes
    needs_images: bool = True
    _find: detectors.FindFunction = field(init=False)
    _sides: list[int] = field(init=False)
    _last: tuple[Grey, str, SearchOutput] | None = None

    def __post_init__(self) -> None:
        self._find = detectors.make_detector(self.setting)
        self._sides = self.scenes.frame.max(axis=1).tolist()

    def __call__(self, row: int, image: Grey) -> SearchOutput:
        """Return the finds in an image of scene ``row``."""
        target = self.targets.targets[row]
        dictionary = target.dictionary
        if self._last is not None and self._last[0] is image and self._last[1] == dictionary:
            return self._last[2]  # another marker of a photograph
        found = self._find(image, dictionary, self._sides[row])
        if target.is_marker:
            output = SearchOutput(*found)
        else:
            own = self.setting if isinstance(self.setting, DetectorSetting) else DetectorSetting()
            output = detectors.completed(image, target, found, self.on_board, own)
        self._last = image, dictionary, output
        return output

    def poses(self, found: Findings) -> Poses:  # noqa: ARG002
        """Return that images have no poses."""
        return Poses(None, None)


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
        """Return the recorded finds in the image of scene ``row``, in pixels of the frame."""
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
            quads, ids, at = self._squares(row)
            used = (quads[:, None] == found.corners[found.owner == row]).all(axis=(2, 3))
            used &= np.isin(ids, self.targets.targets[row].marker_ids)[:, None]
            chosen = np.concatenate([of_target, at[used.any(axis=1)]])
            chosen = chosen[np.isfinite(self.recording.translation[chosen]).all(axis=1)][:1]
            poses.rotation[row : row + len(chosen)] = self.recording.rotation[chosen]
            poses.translation[row : row + len(chosen)] = self.recording.translation[chosen]
        return poses

    def _squares(self, row: int) -> tuple[Floats, Integers, Integers]:
        """Return the squares of an image: corners (n, 4, 2), IDs and rows of the recording (n,).

        Where only a pose was given, the corners are the true camera's image of its square (the
        first, of an ID that the target lacks); of the pose of the target as a whole all of them,
        if the image has no corners.
        """
        part, target = self.recording.rows(self.keys[row]), self.targets.targets[row]
        given, ids = self.recording.corners[part], self.recording.marker_id[part].tolist()
        missing = np.asarray(np.isnan(given).any(axis=(1, 2)))
        numbers = {marker_id: k for k, marker_id in enumerate(target.marker_ids)}
        objects = target.corners_m * (self.scenes.size_m[row] if target.is_marker else 1.0)
        camera = self.scenes.cameras.take(np.array([row]))
        quads, found, rows = [np.empty((0, 4, 2))], list[int](), list[int]()
        for i, marker_id in enumerate(ids):
            shown = {marker_id: numbers.get(marker_id, 0)}
            if not missing[i]:
                quads.append(given[[i]])
            else:
                if marker_id == OF_TARGET:
                    shown = numbers if missing.all() else {}
                points = transform_points(
                    objects[list(shown.values())].reshape(1, -1, 3),
                    self.recording.rotation[part][[i]], self.recording.translation[part][[i]],
                )
                quads.append(camera.project(points).reshape(-1, 4, 2))
            found += shown
            rows += [part.start + i] * len(shown)
        return (
            np.concatenate(quads), np.array(found, dtype=np.int64), np.array(rows, dtype=np.int64)
        )


#: Where the detections of N scenes with one setting come from.
#:
#: One that needs images gets them in windows; else its pixels are those of the frame. Its ``poses``
#: are those (N, 3, 3), (N, 3) in metres that come with what was found: NaN where none does, None in
#: the place of both if there never are any.
DetectionSource = ImageSearch | RecordedSearch


def detection_source(
    setting: detectors.AnyDetectorSetting, on_board: detectors.BoardDetectorSetting, scenes: Scenes,
    targets: TargetScenes, keys: Callable[[], NDArray[np.uint64]],
) -> DetectionSource:
    """Return where the detections of N scenes with a setting come from.

    ``keys`` returns the keys (N,) of their images.
    """
    if isinstance(setting, detectors.PluginSetting) and is_recording(setting.plugin.name):
        return RecordedSearch(setting.record().recording, scenes, targets, keys())
    return ImageSearch(setting, on_board, scenes, targets)
