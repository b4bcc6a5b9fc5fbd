"""Photographs of boards with known truth: every effect of the camera, saved as a user has them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from support.board_scenes import BoardPose, board_scene, image_of_board
from sweep.model.board import Board
from sweep.model.pose import rotation_of_angles

WEBCAM = {
    "sharpening": 0.6, "sharpening_px": 1.5, "bloom": 0.15, "tone_gamma": 0.9, "blur_px": 0.6,
    "noise_grey": 2.0, "noise_correlation": 0.5, "illumination_gradient": 0.3,
    "illumination_deg": 30.0, "geometry_px": 0.15, "geometry_length_px": 60.0,
}
"""Effects such as a webcam's."""


@dataclass(frozen=True)
class Photograph:
    """An image (h, w) of a board, and the board's pose in the camera frame."""

    image: np.ndarray
    pose: BoardPose


def photograph(board: Board, camera: dict, pose: BoardPose, effects: dict, key: int) -> Photograph:
    """Return a photograph of a board.

    ``camera`` has width_px, height_px, fx_px and perhaps cx_px, cy_px and distortion, as sections
    of pipelines have them; ``effects`` the parameters of effects and levels by name; ``key`` makes
    its noise and shifts.
    """
    return Photograph(image_of_board(board_scene(board, camera, pose, key, **effects)), pose)


def drawn_pose(rng, board: Board, camera: dict, share: float) -> BoardPose:
    """Return a pose, up to 45° from facing the camera, at which the board fills about ``share`` of
    the frame's height and its centre lies in the middle half."""
    points = board.corners_m.reshape(-1, 3)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    height = np.ptp(points, axis=0).max()
    rotation = rotation_of_angles(
        np.radians(rng.uniform(5, 45, 1)), rng.uniform(0, 2 * np.pi, 1), rng.normal(0, 0.2, 1)
    )[0]
    fx = camera["fx_px"]
    depth = fx * height / (share * camera["height_px"])
    offset = rng.uniform(-0.25, 0.25, 2) * [camera["width_px"], camera["height_px"]] / fx
    return BoardPose(rotation, depth * np.array([*offset, 1.0]) - rotation @ middle)


def photographs(
    board: Board, camera: dict, count: int, seed: int, effects: dict | None = None,
    share: float = 0.8,
) -> list[Photograph]:
    """Return ``count`` photographs of a board at drawn poses; WEBCAM's effects unless others."""
    rng = np.random.default_rng(seed)
    effects = WEBCAM if effects is None else effects
    return [
        photograph(
            board, camera, drawn_pose(rng, board, camera, share), effects, seed * 100_000 + number
        )
        for number in range(count)
    ]


def save(folder: Path, taken: list[Photograph], camera: dict, suffix: str = ".png") -> Path:
    """Write photographs (photo_00.png, ...), camera.yml and truth.json; return the camera's file.

    The truth has each image's rotation (3 x 3) and translation in metres.
    """
    folder.mkdir(parents=True, exist_ok=True)
    truth = {}
    for number, each in enumerate(taken):
        name = f"photo_{number:02d}{suffix}"
        settings = [cv2.IMWRITE_JPEG_QUALITY, 92] if suffix == ".jpg" else []
        cv2.imwrite(str(folder / name), each.image, settings)
        truth[name] = {
            "rotation": each.pose.rotation.tolist(), "translation": each.pose.translation.tolist(),
        }
    (folder / "truth.json").write_text(json.dumps(truth, indent=1))
    width, height, fx = (camera[name] for name in ("width_px", "height_px", "fx_px"))
    matrix = np.array([
        [fx, 0, camera.get("cx_px", (width - 1) / 2)],
        [0, camera.get("fy_px", fx), camera.get("cy_px", (height - 1) / 2)], [0, 0, 1],
    ], dtype=np.float64)
    file = folder / "camera.yml"
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", width)
    storage.write("image_height", height)
    storage.write("camera_matrix", matrix)
    lens = tuple(camera.get("distortion", ()))
    length = next(each for each in (4, 5, 8, 12, 14) if each >= len(lens))
    distortion = np.array(lens + (0.0,) * (length - len(lens)))
    storage.write("distortion_coefficients", distortion[None])
    storage.release()
    return file
