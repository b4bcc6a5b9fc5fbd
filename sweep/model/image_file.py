"""Image files in place of simulated images and backgrounds: checked before they are decoded."""

from __future__ import annotations

import hashlib
import os
import re
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

MAX_PIXELS = 500_000_000
"""Size of the largest image that is read, and of the largest frame that is rendered whole."""

HEADER_BYTES = 1_000_000
"""Length of the part of a file that is searched for the image's size."""

BYTES_PER_PIXEL = 8
"""Largest size of a pixel in a file, beside the header: four channels of 16 bits."""

MAX_PATH_LENGTH = 4096

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".pbm")
"""Ends of the names of image files, in lower case."""

JPEG = b"\xff\xd8\xff"
"""First bytes of a JPEG file."""

_BLANK = rb"(?:[ \t\r\n]|#[^\r\n]*+[\r\n])++"
_PORTABLE = re.compile(rb"P[1-6]" + _BLANK + rb"([0-9]{1,9})" + _BLANK + rb"([0-9]{1,9})[\s#]")


def read_regular(path: str | Path, most: int) -> bytes:
    """Return up to ``most`` + 1 bytes of a file; no pipe, device or folder is opened.

    Raises
    ------
    OSError, ValueError
        If the file does not exist, cannot be read, or is not a regular file; a missing one's
        reason ends with the most similar name in its folder.
    """
    if len(str(path)) > MAX_PATH_LENGTH:
        raise ValueError("File name too long")
    try:
        mode = Path(path).stat().st_mode
    except FileNotFoundError as error:
        reason = f"{error.strerror}{nearest_file(path)}"
        raise FileNotFoundError(error.errno, reason, str(path)) from None
    if not stat.S_ISREG(mode):
        raise ValueError("Is a directory" if Path(path).is_dir() else "Not a regular file")
    with Path(path).open("rb") as file:
        return file.read(most + 1)


def image_size(path: str) -> tuple[int, int]:
    """Return width and height of an image file, from its header.

    Raises ValueError if it is not a PNG, JPEG, BMP or PGM (PPM, PBM) image, or too large.
    """
    try:
        size = _size(read_regular(path, HEADER_BYTES - 1))
        total = Path(path).stat().st_size
    except OSError as error:
        raise ValueError(error.strerror or "unreadable") from None
    if size is None:
        raise ValueError("not an image that OpenCV can read: a PNG, JPEG, BMP or PGM")
    width, height = size
    if not 0 < width * height <= MAX_PIXELS:
        raise ValueError(f"{width} x {height}; at most {MAX_PIXELS:,} pixels are read")
    if total > BYTES_PER_PIXEL * width * height + HEADER_BYTES:
        raise ValueError(f"{total:,} bytes are too many for an image of {width} x {height}")
    return width, height


def read_image(path: str) -> bytes:
    """Return an encoded image file; raises ValueError as :func:`image_size`."""
    width, height = image_size(path)
    try:
        return read_regular(path, BYTES_PER_PIXEL * width * height + HEADER_BYTES)
    except OSError as error:
        raise ValueError(error.strerror or "unreadable") from None


def decode_grey(path: str) -> NDArray[np.uint8]:
    """Return an image file as grey levels (height, width); raises as :func:`image_size`."""
    size = image_size(path)
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
    # OpenCV rotates an image according to its EXIF tag.
    if image is None or damaged or sorted(image.shape) != sorted(size):
        raise ValueError("not an image that OpenCV can read")
    return np.asarray(image, dtype=np.uint8)


def _size(header: bytes) -> tuple[int, int] | None:
    """Return the width and height that a file's header declares; None if it declares none."""
    if header.startswith(b"\x89PNG\r\n\x1a\n") and header[12:16] == b"IHDR":
        return _big(header[16:20]), _big(header[20:24])
    if header.startswith(b"BM") and len(header) >= 26:
        if header[14:18] == b"\x0c\0\0\0":
            return _little(header[18:20]), _little(header[20:22])
        height = int.from_bytes(header[22:26], "little", signed=True)
        return _little(header[18:22]), abs(height)
    if header.startswith(JPEG):
        return _jpeg_size(header)
    match = _PORTABLE.match(header)
    return (int(match[1]), int(match[2])) if match else None


def _big(digits: bytes) -> int:
    return int.from_bytes(digits, "big")


def _little(digits: bytes) -> int:
    return int.from_bytes(digits, "little")


def _jpeg_size(header: bytes) -> tuple[int, int] | None:
    """Return the width and height in the frame header, after the segments before it."""
    at = 2
    while at + 9 <= len(header) and header[at] == 0xFF:
        kind, length = header[at + 1], _big(header[at + 2 : at + 4])
        if 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC):
            return _big(header[at + 7 : at + 9]), _big(header[at + 5 : at + 7])
        at += 1 if kind == 0xFF else 2 + length
    return None


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
