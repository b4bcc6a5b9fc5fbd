"""The detector's reading of the bits of a small upright marker: whole pixels, a majority.

If modules are a few pixels wide, detection depends on how the grids of modules, pixels and samples
fall on each other. It can be computed without an image, and without a fitted number (a cell is a
module as OpenCV samples it):

1. *Pixels.* A pixel has the colour of the module that its centre lies in.
2. *Quadrilaterals.* Bits are read in quadrilaterals with whole-pixel corners: the outermost pixels
   that a threshold takes for black. Each window of the adaptive threshold has its own
   (`quadrilaterals.py`). Corners are refined only after that.
3. *Samples.* A quadrilateral is mapped to p samples a cell by nearest neighbour. Of an upright
   frontal square, sample k of n·p reads pixel round(k·W / (n·p - 1)) after the first, where W is
   the number of pixels from the first to the last. That depends on the whole number W alone; the
   modules' edges do not.
4. *Majority.* A bit is wrong if more than 49 % of its samples have the other colour, so half is
   wrong for black and for white. More wrong bits than are corrected lose the quadrilateral; if
   no quadrilateral can be read, the marker is lost.

Left out: grey pixels between modules, and corners that a threshold cuts off.

Sources: OpenCV 5, modules/objdetect/src/aruco/aruco_detector.cpp (_extractCellPixelRatio,
_getBorderErrors, filterTooCloseCandidates, identifyCandidates) and aruco_dictionary.cpp
(Dictionary::identify).
"""  # noqa: INP001  (a folder of a page, not a package)

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from quadrilaterals import (
    Surround,
    Thresholds,
    candidates,
    from_unit_square,
    transformed,
)

from sweep.measure.detectors import DetectorSetting
from sweep.model.marker import opencv_dictionary
from sweep.typing import Floats

Bits = NDArray[np.bool_]

LATTICE = (610, 377)
"""Sub-pixel positions, and the step along y: a Fibonacci lattice (Niederreiter, "Random number
generation and quasi-Monte Carlo methods", 1992, section 5.1). Rates have an error of about 0.01."""


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
    thresholds: Thresholds
    """The adaptive threshold's windows, and which quadrilaterals are told apart."""


def reading_of(
    dictionary: str, width_px: int, height_px: int, setting: DetectorSetting
) -> Reading:
    """Return how a detector with a setting reads a dictionary's markers in frames of a size.

    Raises
    ------
    ValueError
        The setting has another search for candidates, or another border, than the model.
    """
    for name, modelled in (
        ("cornerRefinementMethod", setting.cornerRefinementMethod != "apriltag"),
        ("useAruco3Detection", not setting.useAruco3Detection),
        ("detectInvertedMarker", not setting.detectInvertedMarker),
        ("markerBorderBits", setting.markerBorderBits == 1),
    ):
        if not modelled:
            raise ValueError(f"{name} = {getattr(setting, name)!r} is not modelled: leave it out")
    known = opencv_dictionary(dictionary)
    cell_px = setting.perspectiveRemovePixelPerCell
    return Reading(
        cell_px=cell_px,
        margin_px=int(setting.perspectiveRemoveIgnoredMarginPerCell * cell_px),
        valid_share=setting.validBitIdThreshold,
        corrected_bits=int(known.maxCorrectionBits * setting.errorCorrectionRate),
        border_errors=int(known.markerSize**2 * setting.maxErroneousBitsInBorderRate),
        outline_px=int(setting.minMarkerPerimeterRate * max(width_px, height_px)),
        thresholds=Thresholds(
            # An even window is a pixel larger.
            windows=tuple(window | 1 for window in range(
                setting.adaptiveThreshWinSizeMin, setting.adaptiveThreshWinSizeMax + 1,
                setting.adaptiveThreshWinSizeStep,
            )),
            constant=setting.adaptiveThreshConstant,
            group_distance=setting.minGroupDistance,
        ),
    )


def cell_mixing(
    side_px: float, modules: int, edges_px: Floats, reading: Reading
) -> tuple[Floats, Floats]:
    """Return the shares of the modules that the cells of an upright square read along one axis.

    Parameters
    ----------
    side_px
        Length of the black square along the axis.
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


def quadrilateral_mixing(
    quads: Floats, corners: Floats, modules: int, reading: Reading
) -> Floats:
    """Return the shares of the modules that the cells of quadrilaterals read.

    Parameters
    ----------
    quads
        (P, 4, 2): the corners in which bits are read, TL, TR, BR, BL, in pixels.
    corners
        (P, 4, 2): the true corners of the black square, in pixels.
    modules
        n, along a side, border included.

    Returns
    -------
    mixing
        (P, n², n² + 1): of each cell the share of its samples on each module, row by row; the last
        is the white quiet zone.
    """
    n, p = modules, reading.cell_px
    seen = np.arange(n * p).reshape(n, p)[:, reading.margin_px : p - reading.margin_px].ravel()
    at = seen / (n * p - 1.0)
    grid = np.column_stack([np.tile(at, len(at)), np.repeat(at, len(at))])
    pixels = np.asarray(np.rint(transformed(from_unit_square(quads), grid)), dtype=np.float64)
    back = np.asarray(np.linalg.inv(from_unit_square(corners)), dtype=np.float64)
    within = np.floor(n * transformed(back, pixels))
    column, row = within[..., 0], within[..., 1]
    inside = (column >= 0) & (column < n) & (row >= 0) & (row < n)
    module = np.where(inside, row * n + column, n * n).astype(np.int64)
    cell = np.repeat(np.arange(n), len(seen) // n)
    cells = (cell[:, None] * n + cell).ravel()
    count = len(quads)
    index = (np.arange(count)[:, None] * n * n + cells) * (n * n + 1) + module
    hits = np.bincount(index.ravel(), minlength=count * n * n * (n * n + 1))
    return hits.reshape(count, n * n, n * n + 1) / (len(seen) // n) ** 2


def wrong_cells(bits: Bits, mixing: Floats, reading: Reading) -> Bits:
    """Return which cells of M markers are misread: (P, n², M).

    Parameters
    ----------
    bits
        (M, n, n): the black squares' modules with their border, True for white.
    mixing
        (P, n², n² + 1), see :func:`quadrilateral_mixing`.
    """
    flat = bits.reshape(len(bits), -1).T
    white = mixing @ np.vstack([flat, np.ones(len(bits), dtype=bool)]).astype(np.float64)
    return np.asarray(np.where(flat, 1.0 - white, white) > reading.valid_share)


def are_read(bits: Bits, mixing: Floats, reading: Reading) -> Bits:
    """Return which of M markers are read: (P, M); parameters as of :func:`wrong_cells`."""
    n = bits.shape[1]
    inner = np.zeros((n, n), dtype=bool)
    inner[1:-1, 1:-1] = True
    wrong = wrong_cells(bits, mixing, reading)
    errors = wrong[:, inner.ravel()].sum(axis=1)
    border_errors = wrong[:, ~inner.ravel()].sum(axis=1)
    return np.asarray(
        (errors <= reading.corrected_bits) & (border_errors <= reading.border_errors)
    )


def predicted_rates(
    bits: Bits, corners: Floats, reading: Reading, surround: Surround | None = None,
) -> Floats:
    """Return the share of sub-pixel positions at which each of M upright markers is detected.

    Parameters
    ----------
    bits
        (M, n, n), as in :func:`wrong_cells`.
    corners
        (4, 2): the projected corners of the black square, TL, TR, BR, BL, in pixels; its sides are
        nearly along the image's axes (`upright_corners` of `quadrilaterals.py`).
    surround
        What lies around the square, and how soft its edges are; default: as the paper's.

    Returns
    -------
    rates
        (M,)
    """
    n = bits.shape[1]
    count, step = LATTICE
    i = np.arange(count)
    positions = np.column_stack([i, i * step % count]) / count
    moved = corners + positions[:, None]
    detected = np.zeros((count, len(bits)), dtype=bool)
    for quads, tries in candidates(moved, n, reading.thresholds, surround or Surround()):
        sides = np.abs(np.roll(quads, -1, axis=1) - quads).max(axis=2)
        # A square below two pixels has no area in whole pixels.
        found = (sides.sum(axis=1) >= reading.outline_px) & (sides.min(axis=1) >= 1.0)
        rows = np.flatnonzero(tries & found)
        if len(rows):
            mixing = quadrilateral_mixing(quads[rows], moved[rows], n, reading)
            detected[rows] |= are_read(bits, mixing, reading)
    return np.asarray(detected.mean(axis=0))


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
