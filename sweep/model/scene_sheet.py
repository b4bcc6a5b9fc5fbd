"""The sheets of scenes whose marker is bent, or whose image is shifted."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sweep.model.image_shift import shift_waves
from sweep.model.scene import Scenes
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
