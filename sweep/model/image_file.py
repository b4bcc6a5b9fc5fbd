"""Image files in place of simulated images and backgrounds: checked before they are decoded."""

from __future__ import annotations

import hashlib
import os
import stat
import tempfile
from enum import StrEnum
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.messages import nearest_file

# --------------------------------------------------------------------------------------------------
# Image files named by a pipeline: their size is read and checked before they are decoded.

#: Size of the largest image that is read, and of the largest frame that is rendered whole.
MAX_PIXELS = 500_000_000

#: Size of the largest image file: four channels of 16 bits.
MAX_IMAGE_BYTES = 8 * MAX_PIXELS

#: Ends of the names of image files, in lower case.
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".pbm")

#: First bytes of a JPEG file.
JPEG = b"\xff\xd8\xff"

#: First bytes of the files with these ends.
SIGNATURES = (JPEG, b"\x89PNG", b"BM", *(b"P%d" % kind for kind in range(1, 7)))


def read_regular(path: str | Path, most: int) -> bytes:
    """Return the bytes of a file; no pipe, device or folder is opened.

    Raises
    ------
    OSError, ValueError
        If the file does not exist, cannot be read, is not a regular file, or has more than
        ``most`` bytes; a missing one's reason ends with the most similar name in its folder.
    """
    try:
        status = Path(path).stat()
    except FileNotFoundError as error:
        reason = f"{error.strerror}{nearest_file(path)}"
        raise FileNotFoundError(error.errno, reason, str(path)) from None
    if not stat.S_ISREG(status.st_mode):
        raise ValueError("Is a directory" if Path(path).is_dir() else "Not a regular file")
    if status.st_size > most:
        raise ValueError(f"expected at most {most:,} bytes")
    return Path(path).read_bytes()


def read_image(path: str) -> bytes:
    """Return an encoded image file.

    Raises ValueError if it is not a PNG, JPEG, BMP or PGM (PPM, PBM) image, or too large.
    """
    try:
        encoded = read_regular(path, MAX_IMAGE_BYTES)
    except OSError as error:
        raise ValueError(error.strerror or "unreadable") from None
    if not encoded.startswith(SIGNATURES):
        raise ValueError("not an image that OpenCV can read: a PNG, JPEG, BMP or PGM")
    return encoded


def decode_grey(path: str) -> NDArray[np.uint8]:
    """Return an image file as grey levels (height, width); raises as :func:`read_image`."""
    encoded = read_image(path)
    with tempfile.TemporaryFile() as printed:
        # The decoders print to standard error; the caller prints one line of its own.
        kept = os.dup(2)
        os.dup2(printed.fileno(), 2)
        try:
            image = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_GRAYSCALE)
        except cv2.error:
            image = None
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        # A JPEG that ends early is filled with grey; only what the decoder prints shows it.
        damaged = encoded.startswith(JPEG) and printed.seek(0, os.SEEK_END) > 0
    if image is None or damaged:
        raise ValueError("not an image that OpenCV can read")
    if image.size > MAX_PIXELS:
        raise ValueError(f"{image.size:,} pixels; at most {MAX_PIXELS:,} are read")
    return np.asarray(image, dtype=np.uint8)


# --------------------------------------------------------------------------------------------------
# Photographs in place of simulated images: an image file, or a half of one, by its digest.
#
# Levels are 8-bit grey: colour is converted by OpenCV's weights, 16 bits are divided by 256, and
# an image is turned as its EXIF tag says.

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
