"""The photographs of a folder, and the markers in them."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from sweep.errors import ArgumentError
from sweep.measure.detectors import DetectorSetting, FindFunction, make_detector
from sweep.messages import nearest_file, plain
from sweep.model.image_file import IMAGE_SUFFIXES, Part, decode_grey, read_image
from sweep.typing import Floats, Integers

# --------------------------------------------------------------------------------------------------
# The photographs of a folder: which files they are, and lines on them for the user.

#: The most files that a line names.
MAX_NAMED = 3

#: Why files are left out, as lines say it; unreadable ones have their own reasons.
NO_IMAGES, UNREADABLE, AGAIN = ": no images", "", ": the same photographs again"


class Photograph(NamedTuple):
    """A photograph: its file, the SHA-256 of the file, and grey levels (height, width)."""

    path: Path
    digest: str
    image: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Folder:
    """Photographs of one size, by name, and lines on files left out or converted."""

    photographs: tuple[Photograph, ...]
    lines: tuple[str, ...]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        height, width = self.photographs[0].image.shape
        return width, height


def fault_of(folder: Path, reason: str) -> ArgumentError:
    """Return the error that names a folder of photographs and what is wrong with it."""
    return ArgumentError("folders", plain(folder, 300), reason)


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
        raise fault_of(home, f"{error.strerror or 'unreadable'}{nearest_file(home)}") from None
    photographs: list[Photograph] = []
    left_out: dict[str, list[str]] = {NO_IMAGES: [], UNREADABLE: [], AGAIN: []}
    names: dict[str, str] = {}
    notes: Counter[str] = Counter()
    for path in files:
        if path.suffix.lower() not in IMAGE_SUFFIXES or path.is_dir():
            left_out[NO_IMAGES].append(path.name)
            continue
        try:
            if any("\ud800" <= character <= "\udfff" for character in path.name):
                raise ValueError("its name is not UTF-8, as a store needs it")
            content, image = read_image(str(path)), decode_grey(str(path))
        except ValueError as error:
            left_out[UNREADABLE].append(f"{plain(path.name)} ({error})")
            continue
        digest = hashlib.sha256(content).hexdigest()
        if digest in names:
            left_out[AGAIN].append(f"{plain(path.name)} (= {plain(names[digest])})")
            continue
        names[digest] = path.name
        notes.update(_conversions(content))
        photographs.append(Photograph(path, digest, image))
    name = plain(home.name, 300)
    lines = [f"{name}: left out {named(some)}{why}" for why, some in left_out.items() if some]
    lines += [f"{name}: {count} of {len(photographs)} photographs {note}"
              for note, count in sorted(notes.items())]
    if not photographs:
        kinds = ", ".join(each[1:].upper() for each in IMAGE_SUFFIXES)
        raise fault_of(home, "; ".join([f"expected photographs ({kinds})", *lines]))
    ((height, width), _), *others = Counter(each.image.shape for each in photographs).most_common()
    if others:
        odd = [f"{plain(path.name)} ({image.shape[1]} x {image.shape[0]})"
               for path, _, image in photographs if image.shape != (height, width)]
        raise fault_of(
            home, f"expected photographs of one size: most are {width} x {height}, not "
            f"{named(odd)}; move those of another camera or size elsewhere",
        )
    if part is not Part.whole and width % 2:
        raise fault_of(home, f"expected images of two halves; they are {width} px wide")
    return Folder(
        tuple(each._replace(image=part.of(each.image)) for each in photographs), tuple(lines)
    )


def named(names: Sequence[str]) -> str:
    """Return a few of some names, and how many they are."""
    rest = len(names) - MAX_NAMED
    listed = ", ".join(plain(name) for name in names[:MAX_NAMED])
    return f"{listed} and {rest} more" if rest > 0 else listed


def _conversions(content: bytes) -> list[str]:
    """Return notes on the conversion of an encoded image to 8-bit grey, upright."""
    encoded, grey = np.frombuffer(content, np.uint8), cv2.IMREAD_GRAYSCALE
    stored = np.asarray(cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED))
    upright = cv2.imdecode(encoded, grey)
    straight = cv2.imdecode(encoded, grey | cv2.IMREAD_IGNORE_ORIENTATION)
    colours = stored.reshape(*stored.shape[:2], -1)[..., :3]
    return [note for holds, note in (
        ((colours != colours[..., :1]).any(), "are in colour; their grey levels are measured"),
        (stored.dtype != np.uint8, "have 16 bits; their upper 8 are measured"),
        (not np.array_equal(np.asarray(straight), np.asarray(upright)),
         "are turned as their EXIF tag says; a calibration must be of images turned so"),
    ) if holds]


# --------------------------------------------------------------------------------------------------
# Markers that are detected in a photograph.

class SeenMarkers(NamedTuple):
    """Markers in a photograph: IDs (k,), each once, and corners (k, 4, 2) px.

    ``repeated`` IDs are there more than once, and left out.
    """

    ids: Integers
    quads: Floats
    repeated: int = 0

    def among(self, ids: Sequence[int] | Integers) -> tuple[Integers, Floats]:
        """Return the places (n,) in ``ids`` of those that are there, and their corners."""
        place = pd.Index(ids).get_indexer(self.ids)
        return place[place >= 0].astype(np.int64), self.quads[place >= 0]


def reference_detector() -> FindFunction:
    """Return the detector that finds boards: whatever is under test, truth is the same."""
    return make_detector(DetectorSetting(cornerRefinementMethod="subpix"))


def detect_markers(
    find: FindFunction, image: NDArray[np.uint8], dictionary: str
) -> SeenMarkers:
    """Return the markers of a dictionary in an image; those of an ID that is there twice are not.

    ``find`` is a detector's search.
    """
    quads, ids, _ = find(image, dictionary, max(image.shape))
    if ids is None:
        return SeenMarkers(np.empty(0, dtype=np.int64), np.empty((0, 4, 2)))
    numbers = np.asarray(ids).ravel().astype(np.int64)
    once = ~pd.Series(numbers).duplicated(keep=False).to_numpy()
    repeated = len(np.unique(numbers[~once]))
    corners = np.concatenate(list(quads)).astype(np.float64).reshape(-1, 4, 2)
    return SeenMarkers(numbers[once], corners[once], repeated)
