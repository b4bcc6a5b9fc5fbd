"""Background images that a pipeline names: that they can be read, their size, their digests."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from sweep.messages import shown
from sweep.model.image_file import image_size, read_image
from sweep.model.renderers import background_image
from sweep.plan.reader import Reading


def check_backgrounds(reading: Reading) -> None:
    """Note the digests of a reading's background images, and the faults of those that cannot be."""
    for value in reading.values("background"):
        if not isinstance(value, str):
            continue
        if not value.isprintable():
            reading.fault("scene.background", value, "a path without control characters")
            continue
        if reading.known_files is not None:
            reading.files[value] = reading.known_files.get(value, "")
            continue
        path = os.path.join(reading.folder, value)  # noqa: PTH118  (it may be of any length)
        try:
            width, height = image_size(path)
            problem = _wrong_size(reading, value, width, height)
            if problem is None or _wrong_size(reading, value, height, width) is None:
                # Its EXIF tag may turn it.
                height, width = background_image(str(Path(path).resolve())).shape
                problem = _wrong_size(reading, value, width, height)
                reading.files[value] = file_digest(Path(path)) or ""
        except ValueError as error:
            reading.fault("scene.background", value, f"a level or an image file ({error})")
            continue
        if problem is not None:
            reading.fault("scene.background", value, problem)


def _wrong_size(reading: Reading, background: str, width: int, height: int) -> str | None:
    """Return the expectation that a background of a size in pixels misses; None if it fits."""
    for name, length in (("width_px", width), ("height_px", height)):
        frames = {
            frame for backgrounds, frames in reading.together("background", name)
            if background in backgrounds for frame in frames
        }
        if frames - {length}:
            return (
                f"an image of exactly the frame's size: it is {width} x {height}, but "
                f"{name} = {shown(reading.written(name))}"
            )
    return None


def file_digest(path: Path) -> str | None:
    """Return the SHA-256 of an image file; None if it cannot be read."""
    try:
        return hashlib.sha256(read_image(str(path))).hexdigest()
    except ValueError:
        return None
