"""The marker: its bitmap, the straight edges between its modules."""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.declaration import parameter
from sweep.errors import SweepError
from sweep.installation import check_installation
from sweep.model.coverage import MarkerEdges, joined
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# AprilTag's families that OpenCV lacks: their codes are read from an installed AprilTag library.
#
# In these families data lies outside the square whose corners are detected, too: beyond a black
# ring around it, while the ring inside it is white (Krogius, Haggenmiller, Olson, "Flexible
# layouts for fiducial tags", IROS 2019, section III).

@dataclass(frozen=True, slots=True)
class Family:
    """A family of markers that OpenCV lacks.

    Attributes
    ----------
    modules
        Along the side of the square whose corners are detected.
    overhang
        Modules beyond that square on each side.
    count
        IDs.
    digest
        Of a library of STag: the beginning of the SHA-256 of its codes.
    """

    modules: int
    overhang: int
    count: int
    digest: str = ""


#: By AprilTag's own names.
TAG_FAMILIES = {
    "tagCircle21h7": Family(5, 2, 38),
    "tagCircle49h12": Family(5, 3, 65_535),
    "tagCustom48h12": Family(6, 2, 42_211),
    "tagStandard41h12": Family(5, 2, 2_115),
    "tagStandard52h13": Family(6, 2, 48_714),
}

#: Python packages whose AprilTag library has all families.
PACKAGES = ("pyapriltags", "pupil_apriltags")


class _Family(ctypes.Structure):
    """The beginning of ``apriltag_family_t`` of AprilTag 3."""

    _fields_ = (
        ("ncodes", ctypes.c_uint32),
        ("codes", ctypes.POINTER(ctypes.c_uint64)),
        ("width_at_border", ctypes.c_int),
        ("total_width", ctypes.c_int),
        ("reversed_border", ctypes.c_bool),
        ("nbits", ctypes.c_uint32),
        ("bit_x", ctypes.POINTER(ctypes.c_int32)),
        ("bit_y", ctypes.POINTER(ctypes.c_int32)),
    )


def _file_of(package: str, *patterns: str) -> Path | None:
    """Return the first file in an installed package whose name has one of some patterns."""
    spec = importlib.util.find_spec(package)
    for folder in (spec and spec.submodule_search_locations) or ():
        for pattern in patterns:
            for path in sorted(Path(folder).glob(pattern)):
                return path
    return None


def library_path() -> Path | None:
    """Return the AprilTag library of the first installed package that brings one, or None."""
    names = "libapriltag.so", "lib*/libapriltag.so", "libapriltag.dylib"
    return next(filter(None, (_file_of(package, *names) for package in PACKAGES)), None)


@lru_cache(maxsize=8)
def _codes(name: str) -> tuple[NDArray[np.uint64], NDArray[np.int32]]:
    """Return a family's codes (count,), and the positions (bits, 2) of its bits: column, row.

    Bits count from the code's highest; positions from the first module inside the square.
    """
    path = library_path()
    if path is None:
        raise SweepError(f"{name} needs {missing_package(name)}")
    create = getattr(ctypes.CDLL(str(path)), f"{name}_create")
    create.restype = ctypes.POINTER(_Family)
    family = create().contents  # the library keeps it; it is read once in a process
    codes = np.array(family.codes[: family.ncodes], dtype=np.uint64)
    positions = np.array(
        [family.bit_x[: family.nbits], family.bit_y[: family.nbits]], dtype=np.int32
    ).T
    return codes, positions


# --------------------------------------------------------------------------------------------------
# STag's markers: dots in a white circle in a black square, their codes from an installed package.
#
# Geometry: Benligiray, Topal, Akinlar, "STag: A stable fiducial marker system", Image and Vision
# Computing 89 (2019), section 3.1, and the authors' generator of markers. Published markers have
# neighbouring dots joined and smoothed; here the dots are apart. The detector reads dots at their
# centres, and takes corners from the square and from the circle.

#: A module is an eighth of the side: as wide as the white margin of published markers.
STAG_MODULES = 8

#: By the Hamming distance between their codes.
STAG_LIBRARIES = {
    "STAG_HD11": Family(STAG_MODULES, 0, 22_309, "8b094d9a0e7f9595"),
    "STAG_HD13": Family(STAG_MODULES, 0, 2_884, "d452276ebcb1fbad"),
    "STAG_HD15": Family(STAG_MODULES, 0, 766, "68a33359c25246f8"),
    "STAG_HD17": Family(STAG_MODULES, 0, 157, "6b7c8cf653861150"),
    "STAG_HD19": Family(STAG_MODULES, 0, 38, "21b903cb3a75576c"),
    "STAG_HD21": Family(STAG_MODULES, 0, 12, "7ac380b8f8dfac5b"),
    "STAG_HD23": Family(STAG_MODULES, 0, 6, "b4881e97f27dddbf"),
}

CIRCLE_RADIUS = 0.4 * STAG_MODULES
DOTS_RADIUS = 0.35 * STAG_MODULES
#: In modules: the white circle, the circle that encloses the dots, and a dot.
DOT_RADIUS = 0.062482177287080 * 2 * DOTS_RADIUS

#: Of a quadrant's 12 dots: distance from the centre in diameters of their circle, and angle from x
#: towards y, which points up. The other quadrants follow counter-clockwise.
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

CODE_BITS = 48

#: Sides of the polygons of equal area that stand for the circles: they deviate from them by less
#: than 1/20,000 of the marker's side.
CIRCLE_SIDES, DOT_SIDES = 256, 64


def library_file() -> Path | None:
    """Return the compiled module of the installed package stag, or None."""
    return _file_of("stag", "_core*")


def turned(codes: NDArray[np.uint64], quarters: int) -> NDArray[np.uint64]:
    """Return codes after quarter turns: their 12 bits a quadrant move on to the next."""
    shift = np.uint64(CODE_BITS // 4 * (quarters % 4))
    low = codes & np.uint64((1 << CODE_BITS - int(shift)) - 1)
    return (low << shift) | (codes >> np.uint64(CODE_BITS - int(shift)))


@lru_cache(maxsize=8)
def _stag_codes(name: str) -> NDArray[np.uint64]:
    """Return the codes (count,) of a library; bit i is dot i.

    The compiled module has each library's codes in a row, followed by the same codes turned.
    """
    path, library = library_file(), STAG_LIBRARIES[name]
    if path is None:
        raise SweepError(f"{name} needs {missing_package(name)}")
    raw = path.read_bytes()
    words = np.frombuffer(raw[: len(raw) // 8 * 8], dtype="<u8").astype(np.uint64)
    n = library.count
    follows = words[n:] == turned(words[:-n], 3)
    follows &= (words[:-n] > 0) & (words[:-n] >> np.uint64(CODE_BITS) == 0)
    ends = np.flatnonzero(np.diff(np.concatenate([[0], follows.view(np.int8), [0]])))
    for first, stop in ends.reshape(-1, 2).tolist():
        for start in range(first, stop - 3 * n + 1):
            codes = words[start : start + n]
            digest = hashlib.sha256(codes.astype("<u8").tobytes()).hexdigest()
            if digest.startswith(library.digest):
                return codes
    raise SweepError(f"{name}: its codes are not in {path}; install stag-python 1.1")


def _circle(centre: Floats, radius: float, sides: int, areas: tuple[int, int]) -> MarkerEdges:
    """Return a regular polygon with a circle's area; ``areas`` are those inside and outside."""
    turn = 2 * math.pi / sides
    angle = turn * np.arange(sides + 1)
    reach = radius * math.sqrt(turn / math.sin(turn))
    points = centre + reach * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points[-1] = points[0]
    return MarkerEdges(
        np.concatenate([points[:-1], points[1:]], axis=1),
        np.tile(np.array(areas, dtype=np.int64), (sides, 1)),
    )


@lru_cache(maxsize=1)
def dot_centres() -> Floats:
    """Return the centres (48, 2) of the dots in modules, from the square's top left corner."""
    positions = np.array(DOT_POSITIONS)
    radius = np.tile(positions[:, 0], 4) * 2 * DOTS_RADIUS
    angle = (positions[:, 1] + np.arange(4)[:, None] * math.pi / 2).ravel()
    half = STAG_MODULES / 2
    return np.stack([half + radius * np.cos(angle), half - radius * np.sin(angle)], axis=1)


# --------------------------------------------------------------------------------------------------
# The marker: its bitmap, and the straight edges between its modules.

check_installation()  # the dictionaries below are those of the OpenCV that is loaded

#: Of markers that OpenCV lacks: AprilTag's and STag's.
FAMILIES = {**TAG_FAMILIES, **STAG_LIBRARIES}

#: Codes of the areas beside an edge.
OUTSIDE, BLACK, WHITE, OCCLUDER = 0, 1, 2, 3


def opencv_dictionary_names() -> tuple[str, ...]:
    """Return the names of every predefined dictionary of the installed OpenCV, sorted."""
    return tuple(sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_")))


def dictionary_names() -> tuple[str, ...]:
    """Return the names of all dictionaries: OpenCV's, AprilTag's that OpenCV lacks, and STag's."""
    return (*opencv_dictionary_names(), *FAMILIES)


@dataclass(frozen=True, slots=True)
class Marker:
    """A marker's parameters."""

    dictionary: str = parameter(
        "DICT_5X5_50", "the marker's dictionary, by OpenCV's name; tag*: AprilTag's families that "
        "OpenCV lacks; STAG_*: STag's libraries", choices=dictionary_names(), prefix="DICT_",
        abbreviated=True,
    )
    marker_id: int = parameter(0, "the marker's ID in its dictionary", 0, 10**6)
    size_m: float = parameter(
        0.01, "side of the black square (of tag* the white one, whose corners are detected)", 1e-9,
        1e9,
    )
    quiet_zone_modules: float = parameter(1.0, "width of the white surround, in modules", 0, 100)


@lru_cache(maxsize=64)
def opencv_dictionary(name: str) -> cv2.aruco.Dictionary:
    """Return a predefined dictionary; built once in each process, since it cannot be pickled."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def missing_package(dictionary: str) -> str | None:
    """Return the package to install for a dictionary's codes; None if none is missing."""
    if dictionary in TAG_FAMILIES and library_path() is None:
        return "an AprilTag library for its codes: pip install 'fiducial-sweep[pyapriltags]'"
    if dictionary in STAG_LIBRARIES and library_file() is None:
        return "the package stag for its codes: pip install 'fiducial-sweep[stag-python]'"
    return None


def marker_count(dictionary: str) -> int:
    """Return how many IDs a dictionary has."""
    if dictionary in FAMILIES:
        return FAMILIES[dictionary].count
    return len(opencv_dictionary(dictionary).bytesList)


def module_count(dictionary: str) -> int:
    """Return the modules along the side of the square whose corners are detected.

    In OpenCV's dictionaries this is the black square: the bits, and a border of one on each side.
    """
    if dictionary in FAMILIES:
        return FAMILIES[dictionary].modules
    return int(opencv_dictionary(dictionary).markerSize) + 2


def overhang(dictionary: str) -> int:
    """Return the modules of a marker beyond that square on each side: 0 in OpenCV's."""
    return FAMILIES[dictionary].overhang if dictionary in FAMILIES else 0


@lru_cache(maxsize=4096)
def modules(dictionary: str, marker_id: int) -> NDArray[np.bool_]:
    """Return a marker's modules (n + 2 overhang,) squared, True for white, top row first.

    Modules of a tag without a bit beyond the black ring, and in the middle of Custom48h12, are
    white: on the published images they are transparent.

    Raises
    ------
    SweepError
        No package with an AprilTag library is installed.
    """
    n, start = module_count(dictionary), overhang(dictionary)
    if dictionary in TAG_FAMILIES:
        codes, positions = _codes(dictionary)
        white = np.ones((n + 2 * start, n + 2 * start), dtype=np.bool_)
        ring = np.s_[start - 1 : start + n + 1]
        white[ring, ring] = False
        white[start : start + n, start : start + n] = True
        shift = np.arange(len(positions) - 1, -1, -1, dtype=np.uint64)
        column, row = (positions + start).T
        white[row, column] = (codes[marker_id] >> shift & np.uint64(1)).astype(np.bool_)
    else:
        bitmap = cv2.aruco.generateImageMarker(opencv_dictionary(dictionary), marker_id, n)
        white = np.asarray(bitmap) > 127
    white.setflags(write=False)
    return white


def marker_corners(size_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the black square's corners (N, 4, 3) in the marker frame: TL, TR, BR, BL."""
    unit = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
    return np.asarray(np.asarray(size_m, dtype=np.float64)[:, None, None] * unit)


def _runs(line: NDArray[np.int64]) -> list[tuple[int, int, int, int]]:
    """Return (start, end, before, after) of maximal runs in a line (m, 2) of side codes."""
    starts = [0, *(np.flatnonzero((line[1:] != line[:-1]).any(axis=1)) + 1).tolist()]
    runs = zip(starts, [*starts[1:], len(line)], *line[starts].T.tolist(), strict=True)
    return [run for run in runs if run[2] != run[3]]


def cell_edges(codes: NDArray[np.int64]) -> MarkerEdges:
    """Return the maximal edges between square cells.

    ``codes`` (h + 2, w + 2) are the areas' codes, with those around the cells; the ends are
    (column, row, to column, to row) in cells from the top left corner.
    """
    ends: list[tuple[float, float, float, float]] = []
    sides: list[tuple[int, int]] = []
    height, width = codes.shape[0] - 2, codes.shape[1] - 2
    for line in range(max(height, width) + 1):
        if line <= width:
            beside = np.stack([codes[1:-1, line], codes[1:-1, line + 1]], axis=1)
            for start, stop, left, right in _runs(beside):
                ends.append((line, start, line, stop))
                sides.append((left, right))
        if line <= height:
            stacked = np.stack([codes[line, 1:-1], codes[line + 1, 1:-1]], axis=1)
            for start, stop, above, below in _runs(stacked):
                # A quarter turn takes "down with the right side at greater x" to "right, above".
                ends.append((start, line, stop, line))
                sides.append((below, above))
    return MarkerEdges(np.array(ends, dtype=np.float64), np.array(sides, dtype=np.int64))


def rectangle_edges(boxes: Floats, outside: int, inside: int) -> MarkerEdges:
    """Return the edges of rectangles (n, 4): left, top, right, bottom; right and down.

    ``outside`` and ``inside`` are the codes of the areas.
    """
    left, top, right, bottom = boxes.T
    ends = np.concatenate([
        np.stack([left, top, left, bottom], axis=1), np.stack([right, top, right, bottom], axis=1),
        np.stack([left, top, right, top], axis=1), np.stack([left, bottom, right, bottom], axis=1),
    ])
    codes = [(outside, inside), (inside, outside), (inside, outside), (outside, inside)]
    return MarkerEdges(ends, np.repeat(np.array(codes, dtype=np.int64), len(boxes), axis=0))


def square_edges(low: float, high: float, outside: int, inside: int) -> MarkerEdges:
    """Return the edges of one square, its corners at (low, low) and (high, high)."""
    return rectangle_edges(np.array([[low, low, high, high]], dtype=np.float64), outside, inside)


@lru_cache(maxsize=8192)
def edges(dictionary: str, marker_id: int, margin: float) -> MarkerEdges:
    """Return the maximal straight edges between areas of different colour.

    In modules, from the square's top left corner. ``margin`` is how far the marker extends beyond
    the square: its overhang, and the quiet zone.
    """
    if dictionary in STAG_LIBRARIES:
        return _stag_edges(dictionary, marker_id, margin)
    beyond = overhang(dictionary)
    surround = OUTSIDE if margin == beyond else WHITE
    codes = np.pad(
        np.where(modules(dictionary, marker_id), WHITE, BLACK).astype(np.int64), 1,
        constant_values=surround,
    )
    n = len(codes) - 2
    parts = [cell_edges(codes)]
    if surround == WHITE:
        parts.append(square_edges(beyond - margin, n - beyond + margin, OUTSIDE, WHITE))
    whole = joined(parts)
    return MarkerEdges(whole.ends - beyond, whole.sides)


def _stag_edges(dictionary: str, marker_id: int, margin: float) -> MarkerEdges:
    """Return the edges of a STag marker; its circles are polygons.

    Raises
    ------
    SweepError
        The package stag-python is not installed.
    """
    code = int(_stag_codes(dictionary)[marker_id])
    parts = [square_edges(0, STAG_MODULES, OUTSIDE if margin == 0 else WHITE, BLACK)]
    if margin > 0:
        parts.append(square_edges(-margin, STAG_MODULES + margin, OUTSIDE, WHITE))
    middle = np.full(2, STAG_MODULES / 2)
    parts.append(_circle(middle, CIRCLE_RADIUS, CIRCLE_SIDES, (WHITE, BLACK)))
    parts += [
        _circle(centre, DOT_RADIUS, DOT_SIDES, (BLACK, WHITE))
        for bit, centre in enumerate(dot_centres()) if code >> bit & 1
    ]
    return joined(parts)
