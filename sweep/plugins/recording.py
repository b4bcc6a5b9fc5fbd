"""Recorded detections as a detector: what another program found in exported images.

A recording is a ``.npz`` file that ``sweep score`` makes: detections in the frame's pixels and in
OpenCV's conventions, sorted by the keys of their images, and the keys of all images that were
exported.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sweep.errors import PluginError
from sweep.plugins import DetectorPlugin, Markers
from sweep.plugins.array_file import ArrayFile
from sweep.typing import Floats

SUFFIX = ".npz"

#: The ID of a candidate that was not decoded.
REJECTED = -1

#: The ID of a pose that is of the target as a whole, not of one of its markers.
OF_TARGET = -2


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Detections of M markers in exported images.

    Attributes
    ----------
    exported
        Sorted keys of all images that were exported.
    image
        (M,) sorted keys of the images with the markers.
    marker_id
        (M,) IDs; :data:`REJECTED` for candidates that were not decoded, :data:`OF_TARGET` for poses
        of the target as a whole.
    corners
        (M, 4, 2) px in the frame; NaN where only a pose was given.
    rotation, translation
        (M, 3, 3) and (M, 3): poses, target to camera, metres; NaN where only corners were given.
    """

    exported: NDArray[np.uint64]
    image: NDArray[np.uint64]
    marker_id: NDArray[np.int64]
    corners: Floats
    rotation: Floats
    translation: Floats

    def rows(self, key: np.uint64) -> slice:
        """Return the rows of an image.

        Raises
        ------
        PluginError
            If the image was not exported.
        """
        position = int(np.searchsorted(self.exported, key))
        if position == len(self.exported) or self.exported[position] != key:
            raise PluginError(
                "its image is not among those that were exported; export it, and score again"
            )
        first = int(np.searchsorted(self.image, key, "left"))
        return slice(first, int(np.searchsorted(self.image, key, "right")))


#: Files of recordings.
RECORDINGS = ArrayFile(
    "detections that `sweep score` recorded", 1, Recording, {
        "exported": ("images",), "image": ("M",), "marker_id": ("M",), "corners": ("M", 4, 2),
        "rotation": ("M", 3, 3), "translation": ("M", 3)})


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedDetector(DetectorPlugin):
    """A detector whose detections are those of a recording, whatever the image."""

    recording: Recording


def is_recording(name: str) -> bool:
    """Return whether a detector's name is the file of recorded detections.

    >>> is_recording("mine.npz"), is_recording("opencv")
    (True, False)
    """
    return name.endswith(SUFFIX)


def recorded_detector(path: Path) -> tuple[RecordedDetector, str]:
    """Return the detector of a file of recorded detections, and the file's SHA-256.

    Raises
    ------
    PluginError
        If it cannot be read, or is none; in words that follow "expected".
    """
    recording, digest = RECORDINGS.read(path)
    return RecordedDetector(
        make=lambda settings, family: lambda image: Markers((), ()),  # noqa: ARG005
        margin_px=0, meaning="detections that another program made", recording=recording,
    ), digest
