"""Photographs of a board with known effects of the camera, and the scene that is fitted to them."""

import cv2
import numpy as np

import sweep
from support.board_photographs import BOARD, SIZE, board, camera, toml
from support.board_scenes import BoardPose, board_scene
from sweep.model.exposure import marker_boxes
from sweep.model.pose import rotation_of_angles
from sweep.model.renderers import render_all

FX = 390.0
LEVELS = {"black": 60.0, "white": 175.0, "background": 100.0}
TRUTH = {
    "blur_px": 0.6, "sharpening": 0.6, "bloom": 0.15,
    "geometry_px": 0.15, "geometry_length_px": 60.0, "edge_px": 0.1, "edge_length_px": 4.0,
    "marker_scale": 1.004, **LEVELS,
}
EFFECTS = TRUTH | {"noise_grey": 2.0}
PLAIN = LEVELS | {"blur_px": 0.5, "noise_grey": 1.0}


def drawn_pose(rng):
    """Return a pose, up to 45° from facing the camera, at which the board fills about 0.9 of the
    frame's height and its centre lies in the middle half."""
    points = board().corners_m.reshape(-1, 3)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    rotation = rotation_of_angles(
        np.radians(rng.uniform(5, 45, 1)), rng.uniform(0, 2 * np.pi, 1), rng.normal(0, 0.2, 1)
    )[0]
    depth = FX * np.ptp(points, axis=0).max() / (0.9 * SIZE[1])
    offset = rng.uniform(-0.25, 0.25, 2) * SIZE / FX
    return BoardPose(rotation, depth * np.array([*offset, 1.0]) - rotation @ middle)


def taken(folder, effects, seed, count):
    """Write photographs, the camera's file and the board's; return `sweep.fit`'s arguments.

    Of a ``marker_scale`` the board's file has smaller markers than are printed."""
    effects, rng = dict(effects), np.random.default_rng(seed)
    scale = effects.pop("marker_scale", 1.0)
    frame = {"width_px": SIZE[0], "height_px": SIZE[1], "fx_px": FX}
    shots = folder / "shots"
    shots.mkdir(parents=True)
    for number in range(count):
        scenes = board_scene(board(), frame, drawn_pose(rng), seed * 100_000 + number, **effects)
        (image,) = render_all(
            scenes, np.array([0]), marker_boxes(scenes), np.array([[0, 0, *SIZE]]))
        cv2.imwrite(str(shots / f"photo_{number:02d}.png"), image)
    files = {"camera": folder / "camera.json", "board": folder / "board.toml"}
    files["camera"].write_text(camera(view=(FX, FX, (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)))
    files["board"].write_text(toml(marker_m=BOARD["marker_m"] / scale))
    return (shots,), files


def fitted(folder, effects, seed, count, markers=6):
    folders, options = taken(folder, effects, seed, count)
    return sweep.fit(*folders, **options, markers=markers, check=False)


def terms_of(found):
    return {each.parameter: each for each in found.found.terms}
