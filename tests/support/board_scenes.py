"""The scene of a board whose pose is a rotation and a translation."""

from typing import NamedTuple

import numpy as np

from support.exact_image import values
from sweep.model.effects import NEUTRAL
from sweep.model.exposure import marker_exposure
from sweep.model.pose import angles_of_rotation
from sweep.model.scene import build_scenes


class BoardPose(NamedTuple):
    """A board's pose in the camera frame: rotation (3, 3), translation (3,) in metres."""

    rotation: np.ndarray
    translation: np.ndarray


def board_scene(board, camera, pose, key=0, **effects):
    """Return the scene. ``camera`` and ``effects`` are parameters of pipelines by name: width_px,
    height_px, fx_px, ...; levels and effects. ``key`` makes noise and shifts."""
    unknown = {*effects} - {*NEUTRAL, "black", "white", "background"}
    if unknown:
        raise ValueError(f"no effect has {sorted(unknown)}")
    angles = dict(zip(
        ("tilt_deg", "azimuth_deg", "roll_deg"),
        (float(np.degrees(angle[0])) for angle in angles_of_rotation(pose.rotation[None])),
        strict=True,
    ))
    x, y, z = (float(each) for each in pose.translation)
    side = float(np.linalg.norm(board.corners_m[0, 1] - board.corners_m[0, 0]))
    return build_scenes(values(**(NEUTRAL | angles | {
        "board": board, "dictionary": board.dictionary, "size_m": side, "noise_key": key,
        "x_m": x, "y_m": y, "distance_m": z,
    } | camera | effects)), 1)


def levels_of(scenes, background, black, white):
    """Return the light (height, width) of a frame in which an effect is active, before the sensor,
    from the levels of the areas."""
    box = (0, 0, *scenes.frame[0].tolist())
    return marker_exposure(scenes, 0, box, np.array([background, black, white, 0.0]))
