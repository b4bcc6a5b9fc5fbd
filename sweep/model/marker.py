"""The marker: its bitmap, and the straight edges between its modules."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.declaration import parameter
from sweep.environments import child
from sweep.model.coverage import MarkerEdges
from sweep.model.stag import STAG_LIBRARIES, STAG_MODULES, missing_stag, stag_circles
from sweep.model.tag_families import TAG_FAMILIES, missing_library, tag_cells

OUTSIDE, BLACK, WHITE, OCCLUDER = 0, 1, 2, 3
"""Codes of the areas beside an edge."""


def opencv_dictionary_names() -> tuple[str, ...]:
    """Return the names of every predefined dictionary of the installed OpenCV, sorted."""
    return tuple(sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_")))


def dictionary_names() -> tuple[str, ...]:
    """Return the names of all dictionaries: OpenCV's, AprilTag's that OpenCV lacks, and STag's."""
    return (*opencv_dictionary_names(), *TAG_FAMILIES, *STAG_LIBRARIES)


@dataclass(frozen=True, slots=True)
class Marker:
    """A marker's parameters."""

    dictionary: str = parameter(
        "DICT_5X5_50", "the marker's dictionary, by OpenCV's name; tag*: AprilTag's families that "
        "OpenCV lacks; STAG_*: STag's libraries",
        choices=dictionary_names(), prefix="DICT_",
        numbers=tuple((name, getattr(cv2.aruco, name)) for name in opencv_dictionary_names()),
    )
    marker_id: int = parameter(0, "the marker's ID in its dictionary", low=0, high=10**6)
    size_m: float = parameter(
        0.01, "side of the black square (of tag* the white one, whose corners are detected)",
        unit="m", low=1e-9, high=1e9,
    )
    quiet_zone_modules: float = parameter(
        1.0, "width of the white surround, in modules", unit="module", low=0, high=100
    )


@lru_cache(maxsize=64)
def opencv_dictionary(name: str) -> cv2.aruco.Dictionary:
    """Return a predefined dictionary; built once in each process, since it cannot be pickled."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def missing_package(dictionary: str) -> str | None:
    """Return what to install for a dictionary's codes; None if nothing is missing."""
    if dictionary in TAG_FAMILIES:
        return missing_library()
    return missing_stag() if dictionary in STAG_LIBRARIES else None


def marker_count(dictionary: str) -> int:
    """Return how many IDs a dictionary has."""
    if dictionary in TAG_FAMILIES:
        return TAG_FAMILIES[dictionary].count
    if dictionary in STAG_LIBRARIES:
        return STAG_LIBRARIES[dictionary].count
    return len(opencv_dictionary(dictionary).bytesList)


def markers_digest(dictionary: str) -> str:
    """Return a digest of a dictionary's upright markers: the bits, not how many are corrected."""
    return child.markers_digest(opencv_dictionary(dictionary))


def module_count(dictionary: str) -> int:
    """Return the modules along the side of the square whose corners are detected.

    In OpenCV's dictionaries this is the black square: the bits, and a border of one on each side.
    """
    if dictionary in TAG_FAMILIES:
        return TAG_FAMILIES[dictionary].modules
    if dictionary in STAG_LIBRARIES:
        return STAG_MODULES
    return int(opencv_dictionary(dictionary).markerSize) + 2


def overhang(dictionary: str) -> int:
    """Return the modules of a marker beyond that square on each side: 0 in OpenCV's."""
    return TAG_FAMILIES[dictionary].overhang if dictionary in TAG_FAMILIES else 0


def has_circles(dictionary: str) -> bool:
    """Return whether a dictionary's markers are more than square modules."""
    return dictionary in STAG_LIBRARIES


@lru_cache(maxsize=4096)
def modules(dictionary: str, marker_id: int) -> NDArray[np.bool_]:
    """Return a marker's modules (n + 2 overhang,) squared, True for white, top row first."""
    if dictionary in TAG_FAMILIES:
        white = tag_cells(dictionary, marker_id)
    else:
        n = module_count(dictionary)
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
    runs = []
    start = 0
    for stop in range(1, len(line) + 1):
        if stop == len(line) or (line[stop] != line[start]).any():
            before, after = (int(code) for code in line[start])
            if before != after:
                runs.append((start, stop, before, after))
            start = stop
    return runs


def cell_edges(
    codes: NDArray[np.int64],
) -> tuple[list[tuple[float, float, float, float]], list[tuple[int, int]]]:
    """Return the maximal edges between square cells, and the areas beside each.

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
    return ends, sides


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
    ends, sides = cell_edges(codes)
    if surround == WHITE:
        border, codes_beside = _square(beyond - margin, n - beyond + margin, OUTSIDE, WHITE)
        ends += border
        sides += codes_beside
    return MarkerEdges(
        np.array(ends, dtype=np.float64) - beyond, np.array(sides, dtype=np.int64)
    )


def _square(
    low: float, high: float, outside: int, inside: int
) -> tuple[list[tuple[float, float, float, float]], list[tuple[int, int]]]:
    """Return the edges of a square from ``low`` to ``high``, and the areas beside each."""
    return (
        [(low, low, low, high), (high, low, high, high), (low, low, high, low),
         (low, high, high, high)],
        [(outside, inside), (inside, outside), (inside, outside), (outside, inside)],
    )


def _stag_edges(dictionary: str, marker_id: int, margin: float) -> MarkerEdges:
    """Return the edges of a STag marker; its circles are polygons."""
    circle, dots = stag_circles(dictionary, marker_id)
    ends, sides = _square(0, STAG_MODULES, OUTSIDE if margin == 0 else WHITE, BLACK)
    if margin > 0:
        border, beside = _square(-margin, STAG_MODULES + margin, OUTSIDE, WHITE)
        ends, sides = ends + border, sides + beside
    return MarkerEdges(
        np.concatenate([np.array(ends, dtype=np.float64), circle, *dots]),
        np.array(
            [*sides, *[(WHITE, BLACK)] * len(circle),
             *[(BLACK, WHITE)] * sum(len(dot) for dot in dots)], dtype=np.int64,
        ),
    )


MarkerKey = tuple[str, int, float]
"""Dictionary, ID and margin (overhang and quiet zone) in modules: they determine its edges."""
