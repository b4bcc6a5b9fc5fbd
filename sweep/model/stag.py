"""STag's markers: dots in a white circle in a black square, their codes from an installed package.

Geometry: Benligiray, Topal, Akinlar, "STag: A stable fiducial marker system", Image and Vision
Computing 89 (2019), section 3.1, and the authors' generator of markers. Published markers have
neighbouring dots joined and smoothed; here the dots are apart. The detector reads dots at their
centres, and takes corners from the square and from the circle.
"""

from __future__ import annotations

import hashlib
import importlib.util
import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sweep.errors import MissingPackageError
from sweep.typing import Floats


@dataclass(frozen=True, slots=True)
class StagLibrary:
    """A library of STag: its number of IDs, and the digest of their codes."""

    count: int
    sha256: str


STAG_LIBRARIES = {
    "STAG_HD11": StagLibrary(
        22_309, "8b094d9a0e7f95956bba2081f2d5238fd86b4abc46b061ad8f2e912051105dd1"
    ),
    "STAG_HD13": StagLibrary(
        2_884, "d452276ebcb1fbaddf3228c47f2c8dee2bdd1747b1ceffb592aa61b0afc3f97e"
    ),
    "STAG_HD15": StagLibrary(
        766, "68a33359c25246f85127ea4fe3ea4b6f4927bda0923fce65377a3dd424c3ff6d"
    ),
    "STAG_HD17": StagLibrary(
        157, "6b7c8cf6538611507dbd2d42186edf45e6dfb452e7fe393efb475e7c012c7922"
    ),
    "STAG_HD19": StagLibrary(
        38, "21b903cb3a75576c1cab1e515ceaf6234bb91c84b6d1c87582d3545af9b4a083"
    ),
    "STAG_HD21": StagLibrary(
        12, "7ac380b8f8dfac5b4f9f398f1590f8901e48ad807b5880849815ef59cb846c3d"
    ),
    "STAG_HD23": StagLibrary(
        6, "b4881e97f27dddbf0f9b66d95a220593abd3763eaf5468808e32aadf1ac99e62"
    ),
}
"""By the Hamming distance between their codes."""

STAG_MODULES = 8
"""A module is an eighth of the side: as wide as the white margin of published markers."""

CIRCLE_RADIUS = 0.4 * STAG_MODULES
DOTS_RADIUS = 0.35 * STAG_MODULES
DOT_RADIUS = 0.062482177287080 * 2 * DOTS_RADIUS
"""In modules: the white circle, the circle that encloses the dots, and a dot."""

DOT_POSITIONS = (
    (0.088363142525988, math.pi / 4),
    (0.206935928182607, 0.459275804122858), (0.206935928182607, math.pi / 2 - 0.459275804122858),
    (0.313672146827381, 0.200579720495241), (0.327493143484516, 0.591687617505840),
    (0.327493143484516, math.pi / 2 - 0.591687617505840),
    (0.313672146827381, math.pi / 2 - 0.200579720495241),
    (0.437421957035861, 0.145724938287167), (0.437226762361658, 0.433363129825345),
    (0.430628029742607, math.pi / 4),
    (0.437226762361658, math.pi / 2 - 0.433363129825345),
    (0.437421957035861, math.pi / 2 - 0.145724938287167),
)
"""Of a quadrant's 12 dots: distance from the centre in diameters of their circle, and angle from x
towards y, which points up. The other quadrants follow counter-clockwise."""

CODE_BITS = 48

CIRCLE_SIDES, DOT_SIDES = 256, 64
"""Sides of the polygons of equal area that stand for the circles: they deviate from them by less
than 1/20,000 of the marker's side."""


def library_file() -> Path | None:
    """Return the compiled module of the installed package stag, or None."""
    spec = importlib.util.find_spec("stag")
    for folder in (spec and spec.submodule_search_locations) or ():
        for path in sorted(Path(folder).glob("_core*")):
            return path
    return None


def missing_stag() -> str | None:
    """Return what to install for the libraries' codes; None if it is installed."""
    if library_file() is not None:
        return None
    return "the package stag for its codes: pip install 'fiducial-sweep[stag-python]'"


def turned(codes: NDArray[np.uint64], quarters: int) -> NDArray[np.uint64]:
    """Return codes after quarter turns: their 12 bits a quadrant move on to the next."""
    shift = np.uint64(CODE_BITS // 4 * (quarters % 4))
    low = codes & np.uint64((1 << CODE_BITS - int(shift)) - 1)
    return (low << shift) | (codes >> np.uint64(CODE_BITS - int(shift)))


@lru_cache(maxsize=8)
def _codes(name: str) -> NDArray[np.uint64]:
    """Return the codes (count,) of a library; bit i is dot i.

    The compiled module has each library's codes in a row, followed by the same codes turned.
    """
    path, library = library_file(), STAG_LIBRARIES[name]
    if path is None:
        raise MissingPackageError(f"{name} needs {missing_stag()}")
    raw = path.read_bytes()
    words = np.frombuffer(raw[: len(raw) // 8 * 8], dtype="<u8").astype(np.uint64)
    n = library.count
    follows = words[n:] == turned(words[:-n], 3)
    follows &= (words[:-n] > 0) & (words[:-n] >> np.uint64(CODE_BITS) == 0)
    ends = np.flatnonzero(np.diff(np.concatenate([[0], follows.view(np.int8), [0]])))
    for first, stop in ends.reshape(-1, 2).tolist():
        for start in range(first, stop - 3 * n + 1):
            codes = words[start : start + n]
            if hashlib.sha256(codes.astype("<u8").tobytes()).hexdigest() == library.sha256:
                return codes
    raise MissingPackageError(f"{name}: its codes are not in {path}; install stag-python 1.1")


def _circle(centre: Floats, radius: float, sides: int) -> Floats:
    """Return the sides (sides, 4) of a regular polygon with a circle's area, as x, y, x, y.

    The inside lies first of the two sides of each edge.
    """
    turn = 2 * math.pi / sides
    angle = turn * np.arange(sides + 1)
    reach = radius * math.sqrt(turn / math.sin(turn))
    points = centre + reach * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points[-1] = points[0]
    return np.concatenate([points[:-1], points[1:]], axis=1)


@lru_cache(maxsize=1)
def dot_centres() -> Floats:
    """Return the centres (48, 2) of the dots in modules, from the square's top left corner."""
    positions = np.array(DOT_POSITIONS)
    radius = np.tile(positions[:, 0], 4) * 2 * DOTS_RADIUS
    angle = (positions[:, 1] + np.arange(4)[:, None] * math.pi / 2).ravel()
    half = STAG_MODULES / 2
    return np.stack([half + radius * np.cos(angle), half - radius * np.sin(angle)], axis=1)


def stag_circles(name: str, marker_id: int) -> tuple[Floats, list[Floats]]:
    """Return the sides of a marker's white circle (256, 4), and of each black dot (64, 4).

    Raises
    ------
    MissingPackageError
        The package stag-python is not installed.
    """
    code = int(_codes(name)[marker_id])
    middle = np.full(2, STAG_MODULES / 2)
    dots = [
        _circle(centre, DOT_RADIUS, DOT_SIDES)
        for bit, centre in enumerate(dot_centres()) if code >> bit & 1
    ]
    return _circle(middle, CIRCLE_RADIUS, CIRCLE_SIDES), dots
