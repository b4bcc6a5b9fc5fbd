"""The photographs of a folder: which files they are, and what of them is said to the user."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.errors import ArgumentError
from sweep.messages import plain
from sweep.model.image_file import IMAGE_SUFFIXES, decode_grey, read_image
from sweep.model.photograph import Part

MAX_NAMED = 3
"""The most files that a line names."""


@dataclass(frozen=True, slots=True, eq=False)
class Photograph:
    """A photograph: its file, the SHA-256 of the file, and grey levels (height, width)."""

    path: Path
    digest: str
    image: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Folder:
    """Photographs of one size, by name, and lines on what was left out or converted."""

    photographs: tuple[Photograph, ...]
    lines: tuple[str, ...]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        height, width = self.photographs[0].image.shape
        return width, height


def read_folder(folder: str | Path, part: Part = Part.whole) -> Folder:
    """Return the photographs of a folder, or the same half of each of its images.

    Raises
    ------
    ArgumentError
        If it has no photographs, or photographs of several sizes; in a line each.
    """
    home = Path(folder)
    try:
        files = sorted(path for path in home.iterdir() if not path.name.startswith("."))
    except OSError as error:
        raise ArgumentError("folders", plain(home, 300), error.strerror or "unreadable") from None
    photographs: list[Photograph] = []
    other = [
        path.name for path in files
        if path.suffix.lower() not in IMAGE_SUFFIXES or path.is_dir()
    ]
    unreadable: list[str] = []
    repeated: list[str] = []
    digests: dict[str, str] = {}
    notes: Counter[str] = Counter()
    for path in files:
        if path.name in other:
            continue
        try:
            content = read_image(str(path))
            image = decode_grey(str(path))
        except ValueError as error:
            unreadable.append(f"{plain(path.name)} ({error})")
            continue
        digest = hashlib.sha256(content).hexdigest()
        if digest in digests:
            repeated.append(f"{plain(path.name)} (= {plain(digests[digest])})")
            continue
        digests[digest] = path.name
        notes.update(_conversions(content))
        photographs.append(Photograph(path, digest, part.of(image)))
    lines = [f"{home.name}: left out {_named(other)}: no images"] if other else []
    if unreadable:
        lines.append(f"{home.name}: left out {_named(unreadable)}")
    if repeated:
        lines.append(f"{home.name}: left out {_named(repeated)}: the same photographs again")
    lines += [f"{home.name}: {count} of {len(photographs)} photographs {note}"
              for note, count in sorted(notes.items())]
    if not photographs:
        raise ArgumentError(
            "folders", plain(home, 300),
            f"expected photographs ({', '.join(each[1:].upper() for each in IMAGE_SUFFIXES)})"
            + (f"; {'; '.join(lines)}" if lines else ""),
        )
    _check_sizes(home, photographs)
    if part is not Part.whole and (width := decode_width(photographs[0])) % 2:
        raise ArgumentError(
            "folders", plain(home, 300), f"expected images of two halves; they are {width} px wide"
        )
    return Folder(tuple(photographs), tuple(lines))


def decode_width(photograph: Photograph) -> int:
    """Return the width of the whole image of a photograph."""
    return int(decode_grey(str(photograph.path)).shape[1])


def _check_sizes(home: Path, photographs: Sequence[Photograph]) -> None:
    """Raise ArgumentError if photographs have several sizes."""
    sizes = Counter(each.image.shape for each in photographs)
    if len(sizes) == 1:
        return
    (height, width), _ = sizes.most_common(1)[0]
    odd = [
        f"{plain(each.path.name)} ({each.image.shape[1]} x {each.image.shape[0]})"
        for each in photographs if each.image.shape != (height, width)
    ]
    raise ArgumentError(
        "folders", plain(home, 300),
        f"expected photographs of one size: most are {width} x {height}, not {_named(odd)}; move "
        "those of another camera or size elsewhere",
    )


def _named(names: Sequence[str]) -> str:
    """Return a few of some names, and how many they are."""
    rest = len(names) - MAX_NAMED
    listed = ", ".join(plain(name) for name in names[:MAX_NAMED])
    return f"{listed} and {rest} more" if rest > 0 else listed


def _conversions(content: bytes) -> list[str]:
    """Return what the conversion to 8-bit grey, upright, does to an encoded image."""
    encoded = np.frombuffer(content, np.uint8)
    stored = cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED)
    notes: list[str] = []
    if stored is None:
        return notes
    if stored.ndim == 3:
        levels = stored[..., :3]
        if (levels != levels[..., :1]).any():
            notes.append("are in colour; their grey levels are measured")
    if stored.dtype != np.uint8:
        notes.append("have 16 bits; their upper 8 are measured")
    if b"Exif" in content[:4096] or b"eXIf" in content[:4096]:
        straight = cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        turned = cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE)
        if straight is None or turned is None:
            return notes
        if straight.shape != turned.shape or not np.array_equal(straight, turned):
            notes.append(
                "are turned as their EXIF tag says; a calibration must be of images turned so"
            )
    return notes
