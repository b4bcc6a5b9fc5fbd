"""The detector's reading of the bits of an upright frontal marker: three roundings, a majority.

If modules are a few pixels wide, detection depends on how the grids of modules, pixels and samples
fall on each other. It can be computed without an image (a cell is a module as OpenCV samples it):

1. *Pixels.* A pixel has the colour of the module that its centre lies in.
2. *Corners.* Bits are read in a quadrilateral with whole-pixel corners: the first and the last
   pixel whose centres lie in the black square. Corners are refined only after that.
3. *Samples.* The quadrilateral is mapped to p samples a cell by nearest neighbour: sample k of
   n·p reads pixel round(k·W / (n·p - 1)) after the first, where W is the number of pixels from
   the first to the last. That depends on the whole number W alone; the modules' edges do not.
4. *Majority.* A bit is wrong if more than 49 % of its samples have the other colour, so half is
   wrong for black and for white. More wrong bits than are corrected lose the marker.

Left out: grey pixels on edges, corners that a threshold cuts off, and the further quadrilaterals
of the square that the detector tries if the first cannot be read (see :data:`STAYS_LOST`).

Sources: OpenCV 5, modules/objdetect/src/aruco/aruco_detector.cpp (_extractCellPixelRatio,
_getBorderErrors, _findMarkerContours) and aruco_dictionary.cpp (Dictionary::identify).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sweep.measure.detector import DetectorSetting
from sweep.model.marker import opencv_dictionary
from sweep.typing import Floats

STAYS_LOST = 0.4
"""Share of the first quadrilateral's losses that further ones do not recover: the only fitted
number, to DICT_5X5_50 with the renderer ``warp``, a black surround and the default settings."""

Bits = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Reading:
    """The detector's settings for reading bits."""

    cell_px: int
    """Samples along a cell, p."""
    margin_px: int
    """Samples at each side of a cell that are ignored."""
    valid_share: float
    """A cell is wrong if more than this share of it has the other colour."""
    corrected_bits: int
    """Largest number of wrong bits of a detected marker."""
    border_errors: int
    """Largest number of wrong cells of its border."""
    outline_px: int
    """Smallest number of pixels on the outline of a candidate."""


def reading_of(
    dictionary: str, width_px: int, height_px: int, setting: DetectorSetting
) -> Reading:
    """Return how a detector with a setting reads a dictionary's markers in frames of a size."""
    known = opencv_dictionary(dictionary)
    cell_px = setting.perspectiveRemovePixelPerCell
    return Reading(
        cell_px=cell_px,
        margin_px=int(setting.perspectiveRemoveIgnoredMarginPerCell * cell_px),
        valid_share=setting.validBitIdThreshold,
        corrected_bits=int(known.maxCorrectionBits * setting.errorCorrectionRate),
        border_errors=int(known.markerSize**2 * setting.maxErroneousBitsInBorderRate),
        outline_px=int(setting.minMarkerPerimeterRate * max(width_px, height_px)),
    )


def cell_mixing(
    side_px: float, modules: int, edges_px: Floats, reading: Reading
) -> tuple[Floats, Floats]:
    """Return the shares of the modules that the cells along one axis read, and the span.

    Parameters
    ----------
    side_px
        Side of the black square.
    modules
        n, along that side, border included.
    edges_px
        (K,): the square's edge relative to the centre of the first pixel inside, in (-1, 0].

    Returns
    -------
    mixing
        (K, n, n): of each cell (row) the share of its samples on each module. The reading of an
        image is separable: C_y · bits · C_xᵀ.
    span_px
        (K,): pixels from the first to the last of the square, W.
    """
    count = modules * reading.cell_px
    span = np.ceil(edges_px + side_px) - 1.0
    pixel = np.rint(np.arange(count) * span[:, None] / (count - 1))
    module = np.floor((pixel - edges_px[:, None]) * (modules / side_px)).astype(np.int64)
    hits = (module[..., None] == np.arange(modules)).reshape(-1, modules, reading.cell_px, modules)
    seen = slice(reading.margin_px, reading.cell_px - reading.margin_px)
    return hits[:, :, seen].mean(axis=2), span


def wrong_cells(bits: Bits, along_y: Floats, along_x: Floats, reading: Reading) -> Bits:
    """Return which cells are misread: (Y, X, n, n).

    Parameters
    ----------
    bits
        (n, n): the black square's modules with their border, True for white.
    along_y, along_x
        (Y, n, n) and (X, n, n): the mixing along each axis (see :func:`cell_mixing`).
    """
    rows = along_y @ bits.astype(np.float64)
    white = np.einsum("yim,xjm->yxij", rows, along_x, optimize=True)
    return np.asarray(np.where(bits, 1.0 - white, white) > reading.valid_share)


def predicted_rate(
    bits: Bits, side_px: float, reading: Reading, offsets: int = 200,
    stays_lost: float = STAYS_LOST,
) -> float:
    """Return the share of sub-pixel positions at which an upright frontal marker is detected.

    Parameters
    ----------
    bits, side_px
        (n, n), as in :func:`wrong_cells`, and the side of the black square.
    offsets
        Sub-pixel offsets along each axis, spread evenly over a pixel.
    stays_lost
        Share of the first quadrilateral's losses that stay lost; 1 if it is the only one.
    """
    mixing, span, share = _along(side_px, len(bits), reading, offsets)
    wrong = wrong_cells(bits, mixing, mixing, reading)
    errors = wrong[..., 1:-1, 1:-1].sum(axis=(2, 3))
    read = errors <= reading.corrected_bits
    read &= wrong.sum(axis=(2, 3)) - errors <= reading.border_errors
    seen = 2.0 * (span[:, None] + span) >= reading.outline_px
    return float(share @ (np.where(read, 1.0, 1.0 - stays_lost) * seen) @ share)


@lru_cache(maxsize=8)
def _along(
    side_px: float, modules: int, reading: Reading, offsets: int
) -> tuple[Floats, Floats, Floats]:
    """Return the distinct mixings (K, n, n), their spans (K,) and their shares of the offsets."""
    edges = -(np.arange(offsets) + 0.5) / offsets
    mixing, span = cell_mixing(side_px, modules, edges, reading)
    flat = np.column_stack([span, mixing.reshape(offsets, -1)])
    distinct, counts = np.unique(flat, axis=0, return_counts=True)
    return distinct[:, 1:].reshape(-1, modules, modules), distinct[:, 0], counts / offsets


def lone_cells(bits: Bits) -> int:
    """Return the larger number of lone cells in the middle column and in the middle row.

    A cell is lone if both of its neighbours across the column (row) have the other colour. At
    4 samples a cell, W odd above 2(4n - 1)/3 and a side below 3n px, the middle cell reads half
    of its samples from these two. 0 if n is even: there is no middle.
    """
    if len(bits) % 2 == 0:
        return 0
    middle = len(bits) // 2
    return max(
        int(((a[:, middle] != a[:, middle - 1]) & (a[:, middle] != a[:, middle + 1])).sum())
        for a in (bits, bits.T)
    )
