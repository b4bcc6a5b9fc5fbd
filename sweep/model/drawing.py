"""Exact images of many scenes on plain backgrounds, drawn in one call."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled
from sweep.model.coverage import ROUNDING_SNAP, MarkerEdges, accumulate
from sweep.model.projection import Optics, Projection
from sweep.typing import Floats


@compiled
def sum_grey(cover: Floats, outside: float, grey: NDArray[np.uint8]) -> None:
    """As ``coverage.sum_levels``, quantised to 8 bits (round half up) and clipped."""
    for i in range(grey.shape[0]):
        level = outside
        rounded = np.uint8(min(max(level + (0.5 + ROUNDING_SNAP), 0.0), 255.0))
        for j in range(grey.shape[1]):
            # Most pixels touch no edge: they repeat their neighbour at the cost of a comparison.
            if cover[i, j] != 0.0:
                level += cover[i, j]
                cover[i, j] = 0.0
                rounded = np.uint8(min(max(level + (0.5 + ROUNDING_SNAP), 0.0), 255.0))
            grey[i, j] = rounded
        cover[i, grey.shape[1] :] = 0.0


class Canvas(NamedTuple):
    """The windows of n scenes, which are drawn one after another.

    Attributes
    ----------
    images
        The pixels of all windows in one vector.
    starts
        (n,) index of each window's first pixel in ``images``.
    windows, boxes
        (n, 4) left, top, right, bottom of the windows and of the pixels that the markers may
        touch.
    scratch
        A vector of zeros of at least (width + 2) · height of the largest box, left as zeros.
    """

    images: NDArray[np.uint8]
    starts: NDArray[np.int64]
    windows: NDArray[np.int64]
    boxes: NDArray[np.int64]
    scratch: Floats


class DrawnScenes(NamedTuple):
    """All scenes of a block as far as :func:`draw_greys` needs them.

    Attributes
    ----------
    edges, spans
        The edges of all markers, and (K, 2) the first and past-the-end row of each marker's.
    marker
        (N,) index of each scene's marker.
    levels, plane, intrinsics, lenses, distorted
        (N, 3), (N, 3, 3), (N, 4), (N, 24), (N,), of each scene as
        :func:`sweep.model.coverage.accumulate` takes them.
    """

    edges: MarkerEdges
    spans: NDArray[np.int64]
    marker: NDArray[np.int64]
    levels: Floats
    plane: Floats
    intrinsics: Floats
    lenses: Floats
    distorted: NDArray[np.bool_]


@compiled
def draw_greys(canvas: Canvas, scenes: DrawnScenes, rows: NDArray[np.int64]) -> None:
    """Draw scenes ``rows`` (n,) into their windows of ``canvas``, quantised to 8 bits."""
    for i in range(rows.shape[0]):
        row = rows[i]
        window, box = canvas.windows[i], canvas.boxes[i]
        width, height = window[2] - window[0], window[3] - window[1]
        image = canvas.images[canvas.starts[i] : canvas.starts[i] + width * height]
        image[:] = np.uint8(scenes.levels[row, 0] + (0.5 + ROUNDING_SNAP))
        left, top, right, bottom = box[0], box[1], box[2], box[3]
        if left == right:
            continue
        cover = canvas.scratch[: (bottom - top) * (right - left + 2)].reshape(
            bottom - top, right - left + 2
        )
        first, last = scenes.spans[scenes.marker[row], 0], scenes.spans[scenes.marker[row], 1]
        accumulate(
            cover, MarkerEdges(scenes.edges.ends[first:last], scenes.edges.sides[first:last]),
            scenes.levels[row],
            Projection(
                scenes.plane[row],
                Optics(scenes.intrinsics[row], scenes.lenses[row], scenes.distorted[row]),
            ),
            left, top, 0.0,
        )
        grey = image.reshape(height, width)[
            top - window[1] : bottom - window[1], left - window[0] : right - window[0]
        ]
        sum_grey(cover, scenes.levels[row, 0], grey)
