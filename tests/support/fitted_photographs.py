"""Photographs with known effects, and the scene that is fitted to them."""

import json

import sweep
from support.photographs import photographs, save
from sweep.experiment.photographs import board_of

BOARD = {
    "kind": "charuco", "dictionary": "DICT_4X4_50", "squares_x": 5, "squares_y": 4,
    "square_m": 0.03, "marker_m": 0.022,
}
CAMERA = {"width_px": 360, "height_px": 270, "fx_px": 390.0}
LEVELS = {"black": 60.0, "white": 175.0, "background": 100.0}
TRUTH = {
    "blur_px": 0.6, "sharpening": 0.6, "bloom": 0.15,
    "geometry_px": 0.15, "geometry_length_px": 60.0, "edge_px": 0.1, "edge_length_px": 4.0,
    "marker_scale": 1.004, **LEVELS,
}
EFFECTS = TRUTH | {"noise_grey": 2.0}
PLAIN = LEVELS | {"blur_px": 0.5, "noise_grey": 1.0}


def taken(folder, effects, seed, count):
    """Write photographs, the camera's file and the board's; return `sweep.fit`'s arguments.

    Of a ``marker_scale`` the board's file has smaller markers than are printed."""
    effects = dict(effects)
    scale = effects.pop("marker_scale", 1.0)
    shots = photographs(board_of(BOARD, "board"), CAMERA, count, seed, effects, 0.9)
    camera = save(folder / "shots", shots, CAMERA)
    camera = camera.rename(folder / "camera.yml")
    (folder / "shots" / "truth.json").unlink()
    (folder / "board.toml").write_text(
        "".join(f"{key} = {json.dumps(value)}\n" for key, value in
                {**BOARD, "marker_m": BOARD["marker_m"] / scale}.items()))
    return (folder / "shots",), {"camera": camera, "board": folder / "board.toml"}


def fitted(folder, effects, seed, count, markers=6):
    folders, options = taken(folder, effects, seed, count)
    return sweep.fit(*folders, **options, markers=markers, check=False)


def terms_of(found):
    return {each.parameter: each for each in found.found.terms}
