"""The Cramér-Rao bound of the pixels of a target in several planes."""

from __future__ import annotations

import numpy as np

from sweep.measure.likelihood import GREY_LEVELS, POSITION, SPREAD
from sweep.measure.positive_definite import pose_covariance
from sweep.model.derivatives import (
    LEVELS,
    POSE,
    differentiate,
    normal_equations,
    work_space,
)
from sweep.model.projection import Optics, Projection
from sweep.model.scene import Scenes
from sweep.model.solid_board import moving_edges, own_sheets, visible_prints
from sweep.model.solid_scene import solid_board, solid_planes
from sweep.typing import Floats, Integers


def solid_covariance(
    scenes: Scenes, row: int, state: Floats, corner: Integers, image: Floats, variance: float,
    *, spread_free: bool,
) -> tuple[Floats, bool]:
    """Return the bound's covariance (6, 6) of one scene, and whether it exists.

    The slopes of all that is seen are summed; an edge at which a sheet hides another moves with
    the sheet in front. Levels are eliminated, as is the point spread with ``spread_free``.

    Parameters
    ----------
    scenes, row
        The scene.
    state
        (16,) its true state, as :mod:`sweep.measure.likelihood` has it.
    corner, image
        (2,) the first pixel of a box, and its pixels: NaN for those that are left out.
    variance
        Of a pixel, in squared grey levels.
    """
    board, planes = solid_board(scenes, row), solid_planes(scenes, row)
    optics = scenes.cameras.optics(row)
    local = optics.intrinsics.copy()
    local[2:] -= corner
    local_optics = Optics(local, optics.lens, optics.distorted)
    work, count = work_space(*image.shape), 0
    for seen in visible_prints(board, planes):
        if seen.number >= own_sheets(board):
            continue
        for edges, plane in moving_edges(seen, planes):
            count = differentiate(
                work, edges, state[GREY_LEVELS], Projection(plane, local_optics), state[POSITION],
                state[SPREAD], count,
            )
    free = POSE + 1 if spread_free else POSE
    matrix, vector = np.empty((free + LEVELS, free + LEVELS)), np.empty(free + LEVELS)
    normal_equations(image, work, free, matrix, vector)
    covers = np.flatnonzero(np.diag(matrix)[free:] > 0) + free
    mixed = matrix[:free, covers]
    information = matrix[:free, :free] - mixed @ np.linalg.solve(
        matrix[np.ix_(covers, covers)], mixed.T
    )
    covariance, exists = pose_covariance(np.ascontiguousarray(information), variance, 1.0)
    # Beyond half a turn rounding has made a singular problem a regular one.
    return covariance, bool(exists) and not (np.diag(covariance)[:3] > np.pi**2).any()
