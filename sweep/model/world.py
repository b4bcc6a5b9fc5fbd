"""Camera and marker placed in a world frame.

World frame: x forward, y left, z up (ROS REP 103). At angles of zero the camera looks along the
world's x with z up, and the marker faces along x, upright.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sweep.declaration import parameter
from sweep.model.rotations import axis_rotation
from sweep.typing import Floats

OPTICAL_OF_BODY = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Takes a camera's body frame (x forward, y left, z up) to its image's (x right, y down)."""

BODY_OF_MARKER = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Takes the marker frame (x right, y up, z out) to its body's: x out of its face, z up.

Whoever looks at the marker sees the body's left, y, on the right.
"""


def _coordinate(whose: str, axis: str) -> Any:
    return parameter(
        None,
        f"{whose} place in the world along {axis}; with the others it replaces the pose in the "
        "camera's frame (default: 0 beside another place in the world)",
        unit="m", low=-1e12, high=1e12, drawable=True,
    )


def _angle(whose: str, meaning: str) -> Any:
    return parameter(
        None, f"{whose} {meaning} (default: 0 beside another place in the world)", unit="degree",
        low=-360, high=360, drawable=True,
    )


@dataclass(frozen=True, slots=True)
class WorldPose:
    """Places and orientations in the world: R = Rz(yaw) · Ry(pitch) · Rx(roll)."""

    camera_x_m: float | None = _coordinate("the camera's", "x, forward")
    camera_y_m: float | None = _coordinate("the camera's", "y, left")
    camera_z_m: float | None = _coordinate("the camera's", "z, up")
    camera_yaw_deg: float | None = _angle(
        "the camera's", "turn about the world's z, to the left; last of the three"
    )
    camera_pitch_deg: float | None = _angle(
        "the camera's", "turn about its y (left): above 0 it looks down"
    )
    camera_roll_deg: float | None = _angle(
        "the camera's", "turn about its line of sight, x: above 0 its right side sinks"
    )
    marker_x_m: float | None = _coordinate("the marker's", "x, forward")
    marker_y_m: float | None = _coordinate("the marker's", "y, left")
    marker_z_m: float | None = _coordinate("the marker's", "z, up")
    marker_yaw_deg: float | None = _angle(
        "the marker's", "turn about the world's z; 180 faces a camera that looks along x"
    )
    marker_pitch_deg: float | None = _angle(
        "the marker's", "turn about its y: above 0 it faces down, -90 faces up from the floor"
    )
    marker_roll_deg: float | None = _angle(
        "the marker's", "turn about its normal, x, before the others"
    )


def orientation(yaw: Floats, pitch: Floats, roll: Floats) -> Floats:
    """Return Rz(yaw) · Ry(pitch) · Rx(roll), (N, 3, 3), body to world; radians, (N,) each."""
    return np.asarray(axis_rotation(2, yaw) @ axis_rotation(1, pitch) @ axis_rotation(0, roll))


def pose_in_camera(
    camera: Floats, camera_orientation: Floats, marker: Floats, marker_orientation: Floats
) -> tuple[Floats, Floats]:
    """Return the marker's rotation (N, 3, 3) and position (N, 3) in the camera's frame.

    Parameters
    ----------
    camera, marker
        (N, 3) places in the world, in metres.
    camera_orientation, marker_orientation
        (N, 3, 3) body to world, as :func:`orientation` returns them.

    Returns
    -------
    tuple
        R = B · Cᵀ · M · A and t = B · Cᵀ · (marker - camera), with orientations C and M, B of
        :data:`OPTICAL_OF_BODY` and A of :data:`BODY_OF_MARKER`. t_z <= 0: behind the camera.
    """
    optical = OPTICAL_OF_BODY @ np.swapaxes(camera_orientation, 1, 2)
    position = np.sum(optical * (marker - camera)[:, None, :], axis=2)
    return np.asarray(optical @ marker_orientation @ BODY_OF_MARKER), position
