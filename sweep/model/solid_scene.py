"""Scenes of boards whose markers are in several planes: their planes, and their light."""

from __future__ import annotations

import numpy as np

from sweep.model import coverage
from sweep.model.board import Board
from sweep.model.projection import Projection
from sweep.model.scene import Box, Scenes
from sweep.model.scene_sheet import scene_sheet
from sweep.model.solid_board import (
    facing,
    outlines,
    own_sheets,
    sheet_planes,
    sheets_m,
    sheets_of,
    visible_prints,
)
from sweep.typing import Floats


def solid_board(scenes: Scenes, row: int) -> Board:
    """Return the board of one scene; TypeError if it shows a single marker."""
    board = scenes.markers[scenes.marker[row]]
    if not isinstance(board, Board):
        raise TypeError("a single marker is flat")
    return board


def solid_planes(scenes: Scenes, row: int) -> Floats:
    """Return the planes (P, 3, 3) of the sheets of one scene's board."""
    return sheet_planes(
        solid_board(scenes, row), scenes.rotation[row], scenes.translation[row],
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
    for seen in visible_prints(solid_board(scenes, row), solid_planes(scenes, row), first):
        coverage.accumulate(
            cover, seen.edges, levels, Projection(seen.plane, optics), box[0], box[1], sigma
        )


def facing_sheets(scenes: Scenes, row: int) -> Floats:
    """Return the corners (P, 4, 3) in the camera frame of the sheets that face the camera."""
    board, planes = solid_board(scenes, row), solid_planes(scenes, row)
    return np.ascontiguousarray(outlines(board, planes)[facing(board, planes)])


def board_faces(scenes: Scenes, row: int) -> bool:
    """Return whether a sheet of one scene's board faces the camera, and is not behind it."""
    board = solid_board(scenes, row)
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
    board = scenes.markers[scenes.marker[row]]
    if not isinstance(board, Board) or len(sheets_of(board)) == 1 or scenes.renderer[row] == "warp":
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
    corners = sheets_m(solid_board(scenes, row)) * _scale(scenes, row)
    points = _outlines_px(
        scenes, row, corners @ scenes.rotation[row].T + scenes.translation[row],
        per_side if scenes.cameras.distorted[row] else 1,
    )
    least, most = points.min(axis=1) - 2, points.max(axis=1) + 2
    seen = ((most + reach > 0) & (least - reach < scenes.frame[row])).all(axis=1)
    if not seen.any():
        return low, high
    return np.maximum(low, least[seen].min(axis=0)), np.minimum(high, most[seen].max(axis=0))
