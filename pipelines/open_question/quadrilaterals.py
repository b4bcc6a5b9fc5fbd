"""The quadrilaterals that the detector sees of a small upright marker at its thresholds.

The adaptive threshold takes a pixel for black if it is darker than the mean of its window by a
constant. At a corner of the black square that mean depends on the window: one of 3 px holds five
white pixels of nine, one of 23 px mostly what surrounds the marker. So the grey pixels of the
square's edge are black for some windows and not for others, and each window has its own whole-pixel
corners. A border of three pixels or more is hollow for a window of 3 px: one quadrilateral more.
The detector reads them one after the other, the largest first.

Sources: OpenCV 5, modules/objdetect/src/aruco/aruco_detector.cpp (_threshold,
_findMarkerContours, filterTooCloseCandidates).
"""  # noqa: INP001  (a folder of a page, not a package)

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sweep.model.exposure import WARP_PX_PER_MODULE
from sweep.model.polygon import side_lengths
from sweep.typing import Floats

WHITE = 255.0
DATA_WHITE = 0.5
"""Share of white among a marker's data bits; it changes only what large windows see."""

INWARDS = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
"""Directions from the corners TL, TR, BR, BL into the square."""

HOLLOW = np.array([[0.0, 1.0], [-1.0, 0.0], [0.0, -1.0], [1.0, 0.0]])
"""The hollow border's quadrilateral relative to the square's, in pixels. A border of three pixels
or more has a middle that a window of 3 px sees no white in, and does not take for black. The
outline of that hole has its corners cut off by a pixel, and of each cut one end becomes a corner:
the quadrilateral is turned by a pixel."""


def from_unit_square(quads: Floats) -> Floats:
    """Return the homographies (P, 3, 3) of the unit square to quadrilaterals (P, 4, 2).

    (0, 0), (1, 0), (1, 1), (0, 1) become the corners in their order. From Heckbert, "Fundamentals
    of texture mapping and image warping" (1989), section 2.2.3.
    """
    p0, p1, p2, p3 = (quads[:, k] for k in range(4))
    d1, d2, total = p1 - p2, p3 - p2, p0 - p1 + p2 - p3

    def cross(a: Floats, b: Floats) -> Floats:
        return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])

    area = cross(d1, d2)
    g, h = (cross(total, d2) / area)[:, None], (cross(d1, total) / area)[:, None]
    out = np.ones((len(quads), 3, 3))
    out[:, :2, 0], out[:, :2, 1], out[:, :2, 2] = p1 - p0 + g * p1, p3 - p0 + h * p3, p0
    out[:, 2, :2] = np.column_stack([g, h])
    return out


@dataclass(frozen=True, slots=True)
class Thresholds:
    """The detector's adaptive threshold, and which of its quadrilaterals are told apart."""

    windows: tuple[int, ...]
    """Sides of the windows, odd, in pixels."""
    constant: float
    """Grey levels by which a black pixel is darker than its window's mean."""
    group_distance: float
    """Distance in modules by which a quadrilateral differs from the one before it."""


@dataclass(frozen=True, slots=True)
class Surround:
    """What lies around a black (0) and white (255) marker, and how soft its edges are."""

    quiet_zone: float = 1.0
    """Width of the white border in modules."""
    background: float = 0.0
    """Grey level around it."""
    ramp_modules: float = 1.0 / WARP_PX_PER_MODULE
    """Width of the linear ramp from black to white in modules; the default is that of the renderer
    ``warp``, which interpolates a bitmap."""
    ramp_px: float = 0.0
    """Width of the ramp in pixels, added to it."""


def upright_corners(
    side_px: float, tilt_deg: float = 0.0, azimuth_deg: float = 0.0, focal_px: float = math.inf
) -> Floats:
    """Return the corners (4, 2) of a tilted upright square around (0, 0), TL, TR, BR, BL, in px.

    Parameters
    ----------
    side_px
        Side of the square if it is parallel to the image, in pixels.
    tilt_deg, azimuth_deg
        As in pipelines; the axis of the tilt is an image axis: azimuth 0 (the side along y becomes
        side · cos tilt) or 90 (the side along x).
    focal_px
        Focal length in pixels; infinite: no perspective.

    Raises
    ------
    ValueError
        The side is not above 0, the azimuth is another, the tilt is not below 90 degrees, or a
        corner lies behind the camera.
    """
    if not 0.0 < side_px < math.inf:
        raise ValueError(f"side_px = {side_px}: expected a number above 0")
    if not 0.0 <= tilt_deg < 90.0:
        raise ValueError(f"tilt_deg = {tilt_deg}: expected 0 to below 90")
    if azimuth_deg not in (0.0, 90.0):
        raise ValueError(f"azimuth_deg = {azimuth_deg}: expected 0 or 90, an axis of the image")
    x, y = 0.5 * side_px * np.array([[-1.0, 1.0, 1.0, -1.0], [-1.0, -1.0, 1.0, 1.0]])
    tilt = math.radians(tilt_deg)
    if azimuth_deg == 0.0:
        y, depth = y * math.cos(tilt), y * math.sin(tilt)
    else:
        x, depth = x * math.cos(tilt), -x * math.sin(tilt)
    # With the distance equal to the focal length a pixel is a unit of length on the marker.
    nearness = 1.0 + depth / focal_px
    if nearness.min() <= 0.0:
        raise ValueError(f"side_px = {side_px} at focal_px = {focal_px}: behind the camera")
    return np.asarray(np.column_stack([x, y]) / nearness[:, None])


def threshold_level(
    window: int, thresholds: Thresholds, surround: Surround, along_px: float, across_px: float,
    modules: int,
) -> float:
    """Return the level up to which a grey pixel at a corner of the square is black for a window.

    The pixel lies on an edge of the square, in the first row inside. Its window's mean is that of
    white, black and background by area, where half of the data is white; the grey pixels of the
    edge, all of its level g, are part of it: g ≤ mean(g) - constant.

    Parameters
    ----------
    along_px, across_px
        Length of the black square along the grey edge, and across it, in pixels.
    modules
        n, along a side, border included.
    """
    half = (window - 1) / 2.0

    def parts(side: float, inside: float) -> tuple[float, float, float]:
        """Return the window's pixels on the quiet zone, on the square and on its data."""
        module = side / modules
        quiet = surround.quiet_zone * module
        square = min(side, inside)
        data = max(min(side - module, inside) - min(module, inside), 0.0)
        return min(quiet, half) + min(max(inside - side, 0.0), quiet), square, data

    quiet_x, square_x, data_x = parts(across_px, half)
    quiet_y, square_y, data_y = parts(along_px, half + 1.0)
    marker = (quiet_x + square_x) * (quiet_y + square_y)
    # Above its first row the column of the edge is quiet zone.
    white = marker - square_x * square_y + DATA_WHITE * data_x * data_y + quiet_y
    outside = window**2 - (quiet_x + square_x + 1.0) * (quiet_y + square_y)
    others = (WHITE * white + surround.background * outside) / window**2
    return (others - thresholds.constant) / (1.0 - square_y / window**2)


def outlines(
    corners: Floats, modules: int, thresholds: Thresholds, surround: Surround
) -> list[Floats]:
    """Return the quadrilaterals (P, 4, 2) of each threshold, the largest first.

    A quadrilateral's corners are pixels: the last that are black along the square's edges.

    Parameters
    ----------
    corners
        (P, 4, 2): true corners of P squares of the same size, TL, TR, BR, BL.
    """
    width, height = np.ptp(corners[0], axis=0).tolist()
    grown = []
    for window in thresholds.windows:
        shifts = []
        for across, along in ((width, height), (height, width)):
            level = threshold_level(window, thresholds, surround, along, across, modules)
            ramp = surround.ramp_modules * across / modules + surround.ramp_px
            shifts.append(ramp * (min(max(level / WHITE, 0.0), 1.0) - 0.5))
        grown.append(tuple(shifts))
    grown.sort(reverse=True)
    return [_black_pixels(corners, *shifts) for shifts in grown]


def _black_pixels(corners: Floats, shift_x: float, shift_y: float) -> Floats:
    """Return the outermost pixels (P, 4, 2) inside squares whose edges are shifted outwards."""
    out = np.empty_like(corners)
    # Of each corner the neighbours along the horizontal edge and along the vertical one.
    for k, (beside, below) in enumerate(((1, 3), (0, 2), (3, 1), (2, 0))):
        corner = corners[:, k]
        right, low = k in (1, 2), k in (2, 3)

        def first(edge: Floats, shift: float, far: bool) -> Floats:
            return np.asarray(np.ceil(edge + shift) - 1.0 if far else np.ceil(edge - shift))

        across = _slope(corners[:, beside] - corner, 0)
        down = _slope(corners[:, below] - corner, 1)
        row = first(corner[:, 1], shift_y, low)
        for _ in range(2):
            column = first(corner[:, 0] + down * (row - corner[:, 1]), shift_x, right)
            row = first(corner[:, 1] + across * (column - corner[:, 0]), shift_y, low)
        out[:, k, 0], out[:, k, 1] = column, row
    return out


def _slope(edge: Floats, axis: int) -> Floats:
    """Return the change of the other coordinate along edges (P, 2) per pixel of one axis."""
    return np.asarray(edge[:, 1 - axis] / edge[:, axis])


def candidates(
    corners: Floats, modules: int, thresholds: Thresholds, surround: Surround
) -> list[tuple[Floats, NDArray[np.bool_]]]:
    """Return the quadrilaterals (P, 4, 2) in which bits are read, and where each is tried (P,).

    The outlines, the largest first, then those of the hollow border. One is tried if its corners'
    root mean square distance to those of the one tried before it is above ``group_distance``
    modules. Parameters as of :func:`outlines`.
    """
    found = outlines(corners, modules, thresholds, surround)
    existing = [np.ones(len(corners), dtype=bool) for _ in found]
    found.append(found[0] + HOLLOW)
    hollow = _is_hollow(found[0], corners, modules, thresholds, surround)
    existing.append(hollow & (min(thresholds.windows) == 3))
    before = found[0].copy()
    out = [(found[0], existing[0])]
    for quads, exists in zip(found[1:], existing[1:], strict=True):
        distance = np.sqrt(((quads - before) ** 2).sum(axis=2).mean(axis=1))
        sides = side_lengths(quads).mean(axis=1)
        tried = exists & (distance > thresholds.group_distance * sides / modules)
        before[tried] = quads[tried]
        out.append((quads, tried))
    return out


def _is_hollow(
    outline: Floats, corners: Floats, modules: int, thresholds: Thresholds, surround: Surround
) -> NDArray[np.bool_]:
    """Return for which squares (P,) the border is three black pixels wide on all of its sides.

    Three grey pixels beside it, of a level three times the threshold's constant, make a window's
    black centre black for the threshold.
    """
    module_px = np.ptp(corners[0], axis=0) / modules
    ramp = surround.ramp_modules + surround.ramp_px / module_px
    grey = ramp * max(0.5 - 3.0 * thresholds.constant / WHITE, 0.0)
    back = np.asarray(np.linalg.inv(from_unit_square(corners)), dtype=np.float64)

    def depth(pixels: Floats) -> Floats:
        within = modules * transformed(back, pixels)
        return np.asarray(np.where(INWARDS > 0.0, within, modules - within))

    black = (depth(outline) > grey) & (depth(outline + 2.0 * INWARDS) < 1.0 - grey)
    return np.asarray(black.all(axis=(1, 2)))


def transformed(homographies: Floats, points: Floats) -> Floats:
    """Return points (N, 2) or (P, N, 2) under homographies (P, 3, 3): (P, N, 2)."""
    moved = points @ homographies[:, :2, :2].transpose(0, 2, 1) + homographies[:, None, :2, 2]
    scale = points @ homographies[:, 2, :2, None] + homographies[:, 2, 2, None, None]
    return np.asarray(moved / scale)
