"""Photographs of a small ChArUco board at known poses, rendered exactly, with noise."""

import json

import cv2
import numpy as np

from support.board_scenes import BoardPose, board_scene, levels_of
from sweep.experiment.photographs import board_of

SIZE = (360, 270)
VIEW = (420.0, 420.0, 180.0, 132.0)
BOARD = {
    "kind": "charuco", "dictionary": "DICT_4X4_50", "squares_x": 5, "squares_y": 4,
    "square_m": 0.03, "marker_m": 0.022,
}


def rotation(x_deg, y_deg, z_deg):
    """Return Rx(180°) turned about the camera's axes: a board that faces the camera."""
    turns = [
        cv2.Rodrigues(np.radians(angle) * axis)[0]
        for angle, axis in zip((x_deg, y_deg, z_deg), np.eye(3), strict=True)
    ]
    return turns[0] @ turns[1] @ turns[2] @ np.diag([1.0, -1.0, -1.0])


POSES = (
    (rotation(10, -20, 3), (0.0, 0.0, 0.30)),
    (rotation(-25, 8, -12), (0.01, 0.005, 0.34)),
    (rotation(20, 25, 30), (-0.01, 0.0, 0.36)),
    (rotation(-15, -28, 80), (0.0, -0.01, 0.38)),
    (rotation(5, 35, -5), (0.075, 0.0, 0.33)),  # cut by the frame's right side
)


def board():
    return board_of(BOARD, "board")


def toml(**changes):
    """Return the board's file."""
    lines = {**BOARD, **changes}
    return "".join(f"{key} = {json.dumps(value)}\n" for key, value in lines.items())


def camera(size=SIZE, view=VIEW):
    """Return a calibration's file, as JSON in OpenCV's names."""
    fx, fy, cx, cy = view
    return json.dumps({
        "image_width": size[0], "image_height": size[1],
        "camera_matrix": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]],
        "distortion_coefficients": [0, 0, 0, 0, 0],
    })


def image(pose, seed, view=VIEW, printed=None):
    """Return a photograph (height, width), of another board if that is printed."""
    view = dict(zip(("fx_px", "fy_px", "cx_px", "cy_px"), view, strict=True))
    scenes = board_scene(
        printed or board(), {"width_px": SIZE[0], "height_px": SIZE[1], **view},
        BoardPose(pose[0], np.array(pose[1])), blur_px=0.6,
    )
    levels = levels_of(scenes, background=120.0, black=35.0, white=210.0)
    noise = np.random.default_rng(seed).normal(0.0, 2.0, levels.shape)
    return np.clip(np.rint(levels + noise), 0, 255).astype(np.uint8)


def write_set(folder, poses=POSES):
    """Write photographs, the board's file and the camera's into a folder."""
    shots = folder / "shots"
    shots.mkdir(parents=True)
    for number, pose in enumerate(poses):
        cv2.imwrite(str(shots / f"shot{number}.png"), image(pose, number))
    (folder / "board.toml").write_text(toml())
    (folder / "camera.json").write_text(camera())
    return shots


def marker_poses(pose):
    """Return the true rotations (M, 3, 3) and positions (M, 3) of the markers at a board's pose."""
    centres = board().corners_m.mean(axis=1)
    return np.repeat(pose[0][None], len(centres), axis=0), centres @ pose[0].T + pose[1]
