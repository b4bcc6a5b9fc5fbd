"""Photographs in place of simulated images: an image file, or a half of one, by its digest.

Levels are 8-bit grey: colour is converted by OpenCV's weights, 16 bits are divided by 256, and an
image is turned as its EXIF tag says.
"""

from __future__ import annotations

import hashlib
from enum import StrEnum
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sweep.model.image_file import decode_grey, read_image


class Part(StrEnum):
    """The part of an image that is the photograph: stereo cameras put two side by side."""

    whole = "whole"
    left = "left"
    right = "right"

    def of(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the part of an image (height, width)."""
        half = image.shape[1] // 2
        if self is Part.whole:
            return image
        return image[:, :half] if self is Part.left else image[:, half:]


def reference(path: str | Path, digest: str, part: Part) -> str:
    """Return the text by which a scene names a photograph: part, SHA-256 and path."""
    return f"{part}:{digest}:{Path(path).resolve()}"


@lru_cache(maxsize=16)
def photograph_image(named: str) -> NDArray[np.uint8]:
    """Return the grey levels (height, width) of a photograph by its :func:`reference`.

    The array is contiguous and must not be written to.

    Raises
    ------
    OSError
        If the file is not the photograph that was recorded: a fault of the machine, no result.
    """
    part, digest, path = named.split(":", 2)
    try:
        if hashlib.sha256(read_image(path)).hexdigest() != digest:
            raise OSError(f"{path}: the photograph has changed since it was recorded")
        image = np.ascontiguousarray(Part(part).of(decode_grey(path)))
    except ValueError as error:
        raise OSError(f"{path}: {error}") from None
    image.setflags(write=False)
    return image
