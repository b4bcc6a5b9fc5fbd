"""Recorded detections as a detector: what another program found in exported images.

A recording is a ``.npz`` file that ``sweep score`` makes: detections in the frame's pixels and in
OpenCV's conventions, sorted by the keys of their images, and the keys of all images that were
exported.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sweep.errors import PluginError
from sweep.messages import plain
from sweep.plugins import Plugin
from sweep.plugins.array_file import array_file, read_arrays
from sweep.typing import Floats

SUFFIX = ".npz"

REJECTED = -1
"""The ID of a candidate that was not decoded."""

OF_TARGET = -2
"""The ID of a pose that is of the target as a whole, not of one of its markers."""

VERSION = 1

_ARRAYS = {
    "exported": (np.uint64, ()), "image": (np.uint64, ()), "marker_id": (np.int64, ()),
    "corners": (np.float64, (4, 2)), "rotation": (np.float64, (3, 3)),
    "translation": (np.float64, (3,)),
}
"""Arrays of a recording: type, and shape of each row."""


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

    def content(self) -> bytes:
        """Return the content of its file: the same bytes for the same detections."""
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        return array_file({"version": np.int64(VERSION), **arrays})


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedDetector(Plugin):
    """A detector whose detections are read from a file; no image is searched.

    Attributes
    ----------
    recording
        The detections.
    digest
        SHA-256 of their file.
    margin_px
        No pixel changes a detection.
    """

    kind: ClassVar[str] = "detector"
    recording: Recording
    digest: str
    margin_px: int = 0


def is_recording(name: str) -> bool:
    """Return whether a detector's name is the file of recorded detections.

    >>> is_recording("mine.npz"), is_recording("opencv")
    (True, False)
    """
    return name.endswith(SUFFIX)


def recorded_detector(name: str, folder: str) -> RecordedDetector:
    """Return the detector of a file of recorded detections; it is read once in each process.

    Raises
    ------
    PluginError
        If it cannot be read, or is none; in words that follow "expected".
    """
    path = Path(folder) / name
    try:
        state = path.stat()
        return _read(str(path), state.st_mtime_ns, state.st_size)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise PluginError(
            f"the file {plain(name)} in {plain(folder)} that `sweep score` made ({plain(reason)})"
        ) from None


@lru_cache(maxsize=8)
def _read(path: str, modified_ns: int, size: int) -> RecordedDetector:  # noqa: ARG001  (the key)
    """Return a file's detector; OSError or ValueError if there is none."""
    read, digest = read_arrays(path)
    if not read.keys() >= {"version", *_ARRAYS}:
        raise ValueError("it is none")
    if read["version"].size != 1 or int(read["version"]) != VERSION:
        raise ValueError("of another version")
    arrays = {name: read[name] for name in _ARRAYS}
    for name, (kind, shape) in _ARRAYS.items():
        values = arrays[name]
        rows = len(arrays["exported" if name == "exported" else "image"])
        if values.dtype != kind or values.shape != (rows, *shape):
            raise ValueError(f"damaged: {name}")
        if not shape and kind is np.uint64 and (values[1:] < values[:-1]).any():
            raise ValueError(f"damaged: {name}")
    return RecordedDetector(
        meaning="detections that another program made", recording=Recording(**arrays),
        digest=digest,
    )
