"""Recordings: files of arrays, the same bytes for the same arrays, and detections in them.

What another program found in exported images is a detector: ``sweep score`` writes a recording of
it, which pipelines name as a file ``.npz``.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, Self, cast, get_type_hints

import numpy as np
from numpy.typing import NDArray

from sweep.errors import PluginError
from sweep.messages import plain
from sweep.plugins import DetectorPlugin, Markers
from sweep.typing import Floats

SUFFIX = ".npz"


@dataclass(frozen=True, slots=True, eq=False)
class ArrayFile:
    """A dataclass of arrays, tuples of texts, texts and numbers that a ``.npz`` file holds.

    Attributes
    ----------
    meaning
        Description of the file, in words that follow "expected".
    version
        The number in its array ``version``.
    shapes
        Field -> shape of its array: lengths, or letters, each of which stands for one length.
    """

    meaning: ClassVar[str]
    version: ClassVar[int]
    shapes: ClassVar[Mapping[str, tuple[int | str, ...]]]

    def content(self) -> bytes:
        """Return the content of the file: the same bytes for the same attributes."""
        values: dict[str, Any] = {
            each.name: getattr(self, each.name) for each in dataclasses.fields(self)}
        file = io.BytesIO()
        np.savez_compressed(file, version=self.version, **values)  # its members have a fixed date
        return file.getvalue()

    @classmethod
    def read(cls, path: str | Path) -> tuple[Self, str]:
        """Return what a file holds, and the file's SHA-256; it is read once in each process.

        Raises
        ------
        PluginError
            If it cannot be read, or is none; in words that follow "expected".
        """
        try:
            state = Path(path).stat()
            read: tuple[Self, str] = _read(
                cast("Any", cls), str(path), state.st_mtime_ns, state.st_size)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            folder = plain(Path(path).parent)
            raise PluginError(f"{cls.meaning}, in {folder} ({plain(reason)})") from None
        return read


@lru_cache(maxsize=16)
def _read(
    kind: type[ArrayFile], path: str, modified_ns: int, size: int  # noqa: ARG001  (the key)
) -> Any:
    """Return what a file holds, and its SHA-256; OSError or ValueError if it is none."""
    content, hints = Path(path).read_bytes(), get_type_hints(kind)
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            record = archive["version"] == kind.version and kind(**{
                name: hints[name](array.item()) if array.ndim == 0
                else tuple(array.tolist()) if array.dtype.kind == "U" else array
                for name, array in archive.items() if name != "version"})
    except Exception:
        raise ValueError("it is none") from None
    if not record:
        raise ValueError("of another version")
    lengths: dict[int | str, int] = {}
    for name, shape in kind.shapes.items():
        found = np.shape(getattr(record, name))
        lengths = dict(zip(shape, found, strict=False)) | lengths
        wanted = tuple(each if isinstance(each, int) else lengths.get(each, each) for each in shape)
        if found != wanted:
            raise ValueError(f"{name}: expected the shape {wanted}, not {found}")
    return record, hashlib.sha256(content).hexdigest()


# --------------------------------------------------------------------------------------------------
# Recorded detections as a detector.

#: The ID of a candidate that was not decoded.
REJECTED = -1

#: The ID of a pose that is of the target as a whole, not of one of its markers.
OF_TARGET = -2


@dataclass(frozen=True, slots=True, eq=False)
class Recording(ArrayFile):
    """Detections of M markers in exported images: frame's pixels, OpenCV's conventions.

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

    meaning = "detections that `sweep score` recorded"
    version = 1
    shapes = {  # noqa: RUF012
        "exported": ("images",), "image": ("M",), "marker_id": ("M",), "corners": ("M", 4, 2),
        "rotation": ("M", 3, 3), "translation": ("M", 3)}
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
        listed, rows = (
            slice(*(int(np.searchsorted(keys, key, side)) for side in ("left", "right")))
            for keys in (self.exported, self.image))
        if listed.start == listed.stop:
            raise PluginError(
                "its image is not among those that were exported; export it, and score again")
        return rows


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
    recording, digest = Recording.read(path)
    return RecordedDetector(
        make=lambda settings, family: lambda image: Markers((), ()),  # noqa: ARG005
        margin_px=0, meaning="detections that another program made", recording=recording,
    ), digest
