"""Scenes whose print is bent, shifted from point to point, or in several planes."""

from __future__ import annotations

import math
from hashlib import sha256

import numpy as np
from numpy.typing import NDArray

from sweep.model import coverage
from sweep.model.polygon import Projection
from sweep.model.printed import (
    facing,
    outlines,
    own_sheets,
    sheet_planes,
    sheets_m,
    sheets_of,
    visible_prints,
)
from sweep.model.scene import Box, Scenes
from sweep.model.sensor import standard_normals
from sweep.model.sheet import (
    NO_WAVES,
    Shape,
    Sheet,
    fold_cells,
    folds_over,
    sheet_of,
    sheet_pixels,
)
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# Shifts of an image that vary slowly over the frame.
#
# They are a Gaussian random field with the covariance s² exp(-d² / (2 l²)), made of plane waves
# (Rahimi and Recht, "Random features for large-scale kernel machines", 2007): a smooth function
# of the pixel, whatever part of the frame is computed.

WAVES = 32
"""Waves of each coordinate's shift. Given their directions, the field is exactly Gaussian; their
directions are drawn, so that the covariance of one frame deviates from the formula by 1/8 of its
height."""

_STREAM = np.uint64(int.from_bytes(sha256(b"geometry_px").digest()[:8], "little"))


def shift_waves(std_px: float, length_px: float, key: np.uint64) -> Floats:
    """Return the waves (2, M, 4) of a field of shifts (:class:`sweep.model.sheet.Sheet`).

    Parameters
    ----------
    std_px, length_px
        Standard deviation of each coordinate's shift, and its correlation length.
    key
        Of the frame's random numbers.
    """
    normals = np.empty((8, WAVES))
    standard_normals(np.uint64(key ^ _STREAM), 0, 0, 0, normals)
    waves = np.stack([normals[:4].T, normals[4:].T])
    waves[:, :, :2] /= length_px
    waves[:, :, 2:] *= std_px / math.sqrt(WAVES)
    return waves


# --------------------------------------------------------------------------------------------------
# The sheets of scenes whose marker is bent, or whose image is shifted.

def curved_rows(scenes: Scenes) -> NDArray[np.intp]:
    """Return the scenes (n,) whose marker is bent or whose image is shifted."""
    if scenes.effects is None:
        return np.zeros(0, dtype=np.intp)
    curved = (scenes.effects["curvature_per_m"] != 0) | (scenes.effects["geometry_px"] != 0)
    return np.flatnonzero(curved)


def scene_sheet(scenes: Scenes, row: int) -> Sheet | None:
    """Return the sheet of one scene, in modules; None if it is flat and its image not shifted."""
    effect = scenes.effect(row)
    if effect["curvature_per_m"] == 0 and effect["geometry_px"] == 0:
        return None
    waves, length_px = NO_WAVES, math.inf
    if effect["geometry_px"] != 0:
        length_px = effect["geometry_length_px"]
        waves = shift_waves(effect["geometry_px"], length_px, scenes.noise_key[row])
    shape = Shape(
        effect["curvature_per_m"], math.radians(effect["bend_deg"]),
        scenes.meaning("bend", effect) == "saddle",
    )
    module_m = float(np.linalg.norm(scenes.plane[row][:, 0]))
    x, y = scenes.origin[row].tolist()
    return sheet_of(shape, module_m, (x, y), waves, length_px)


def sheet_outline_px(scenes: Scenes, row: int, points: Floats) -> Floats:
    """Return the pixels (M, 2) of points (M, 2) in modules of a marker on its sheet.

    NaN for points that are not before the camera.
    """
    sheet = scene_sheet(scenes, row)
    if sheet is None:
        raise ValueError("the sheet is flat")
    return np.asarray(sheet_pixels(points, scenes.projection(row), sheet))


def sheet_folds(scenes: Scenes, row: int) -> bool:
    """Return whether a part of a marker on its sheet hides another, or is not before the camera.

    Also if shifts that vary too steeply fold the image.
    """
    sheet = scene_sheet(scenes, row)
    if sheet is None:
        return False
    low, high = scenes.sheet[row, :2], scenes.sheet[row, 2:]
    side = float((high - low).max())
    shifted = sheet.waves.shape[1] > 0
    extent = float(np.ptp(scenes.outline_px[row], axis=0).max()) if shifted else 0.0
    return bool(folds_over(
        low, high, fold_cells(sheet, side, extent),
        scenes.projection(row), sheet,
    ))


# --------------------------------------------------------------------------------------------------
# Scenes of boards whose markers are in several planes: their planes, and their light.

def solid_planes(scenes: Scenes, row: int) -> Floats:
    """Return the planes (P, 3, 3) of the sheets of one scene's board."""
    return sheet_planes(
        scenes.target(row), scenes.rotation[row], scenes.translation[row],
        _scale(scenes, row),
    )


def _scale(scenes: Scenes, row: int) -> float:
    return 1.0 if scenes.effects is None else float(scenes.effects["marker_scale"][row])


def accumulate_solid(
    cover: Floats, scenes: Scenes, row: int, levels: Floats, box: Box, sigma: float,
    first: int = 0,
) -> None:
    """Add the edges of all that is seen of a scene's board, from sheet ``first`` on, to ``cover``.

    ``cover`` is (height, width + 2) of ``box``; ``levels`` and ``sigma`` as
    :func:`sweep.model.coverage.accumulate` takes them.
    """
    optics = scenes.cameras.optics(row)
    for seen in visible_prints(scenes.target(row), solid_planes(scenes, row), first):
        coverage.accumulate(
            cover, seen.edges, levels, Projection(seen.plane, optics), box[0], box[1], sigma
        )


def facing_sheets(scenes: Scenes, row: int) -> Floats:
    """Return the corners (P, 4, 3) in the camera frame of the sheets that face the camera."""
    board, planes = scenes.target(row), solid_planes(scenes, row)
    return np.ascontiguousarray(outlines(board, planes)[facing(board, planes)])


def board_faces(scenes: Scenes, row: int) -> bool:
    """Return whether a sheet of one scene's board faces the camera, and is not behind it."""
    board = scenes.target(row)
    return bool(facing(board, solid_planes(scenes, row))[: own_sheets(board)].any())


def sheet_outlines_px(scenes: Scenes, row: int, per_side: int) -> Floats:
    """Return points (M, 2) along the images of the sheets that face the camera."""
    return _outlines_px(scenes, row, facing_sheets(scenes, row), per_side).reshape(-1, 2)


def _outlines_px(scenes: Scenes, row: int, corners: Floats, per_side: int) -> Floats:
    """Return points (P, M, 2) along the images of sheets with corners (P, 4, 3) in the camera."""
    sheets = corners[:, :, None]
    t = np.arange(per_side)[:, None] / per_side
    sides = sheets + t * (np.roll(sheets, -1, axis=1) - sheets)
    camera = scenes.cameras.take(np.array([row]))
    pixels = camera.project(np.ascontiguousarray(sides.reshape(1, -1, 3)))[0]
    return np.asarray(pixels.reshape(len(sheets), 4 * per_side, 2))


def _separate_sheets(scenes: Scenes, row: int) -> bool:
    """Return whether a scene's board is on several sheets, and nothing is between their images."""
    if len(sheets_of(scenes.target(row))) == 1 or scenes.renderer[row] == "warp":
        return False
    return scenes.effects is None or (
        scenes.motion(row) is None and scenes.effects["occlusion"][row] == 0
        and scene_sheet(scenes, row) is None
    )


def extent_in_frame(
    scenes: Scenes, row: int, low: Floats, high: Floats, reach: float, per_side: int
) -> tuple[Floats, Floats]:
    """Return the extent, from ``low`` to ``high`` (2,), without sheets that the frame cannot see.

    ``reach``: how far in px a sheet's image spreads beyond its outline.
    """
    if not _separate_sheets(scenes, row):
        return low, high
    corners = sheets_m(scenes.target(row)) * _scale(scenes, row)
    points = _outlines_px(
        scenes, row, corners @ scenes.rotation[row].T + scenes.translation[row],
        per_side if scenes.cameras.distorted[row] else 1,
    )
    least, most = points.min(axis=1) - 2, points.max(axis=1) + 2
    seen = ((most + reach > 0) & (least - reach < scenes.frame[row])).all(axis=1)
    if not seen.any():
        return low, high
    return np.maximum(low, least[seen].min(axis=0)), np.minimum(high, most[seen].max(axis=0))
