"""Scenes of boards whose markers are in several planes: their planes, and their light."""

from __future__ import annotations

import numpy as np

from sweep.model import coverage
from sweep.model.board import Board
from sweep.model.projection import Projection
from sweep.model.scene import Box, Scenes
from sweep.model.solid_board import facing, outlines, own_sheets, sheet_planes, visible_prints
from sweep.typing import Floats


def solid_board(scenes: Scenes, row: int) -> Board:
    """Return the board of one scene; TypeError if it shows a single marker."""
    board = scenes.markers[scenes.marker[row]]
    if not isinstance(board, Board):
        raise TypeError("a single marker is flat")
    return board


def solid_planes(scenes: Scenes, row: int) -> Floats:
    """Return the planes (P, 3, 3) of the sheets of one scene's board."""
    scale = 1.0 if scenes.effects is None else float(scenes.effects["marker_scale"][row])
    return sheet_planes(
        solid_board(scenes, row), scenes.rotation[row], scenes.translation[row], scale
    )


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
    planes = solid_planes(scenes, row)
    return np.ascontiguousarray(outlines(solid_board(scenes, row), planes)[facing(planes)])


def board_faces(scenes: Scenes, row: int) -> bool:
    """Return whether a sheet of one scene's board faces the camera, be it before it or not."""
    seen = facing(solid_planes(scenes, row))
    return bool(seen[: own_sheets(solid_board(scenes, row))].any())


def sheet_outlines_px(scenes: Scenes, row: int, per_side: int) -> Floats:
    """Return points (M, 2) along the images of the sheets that face the camera."""
    sheets = facing_sheets(scenes, row)[:, :, None]
    t = np.arange(per_side)[:, None] / per_side
    sides = sheets + t * (np.roll(sheets, -1, axis=1) - sheets)
    camera = scenes.cameras.take(np.array([row]))
    return np.asarray(camera.project(np.ascontiguousarray(sides.reshape(1, -1, 3)))[0])
