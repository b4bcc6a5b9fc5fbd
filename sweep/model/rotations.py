"""Rotations by angles that users give, and the pose's three angles of a rotation (batched).

Camera frame: x right, y down, z forward. Angles in radians, (N,) each.
"""

from __future__ import annotations

import numpy as np

from sweep.model.pose import rotation_of_angles, vector_of_rotation
from sweep.typing import Floats

ABOUT_X_180 = np.diag([1.0, -1.0, -1.0])
"""Rx(180°): the marker frame (y up, z out) of an upright marker that faces the camera."""

DEGENERATE = 1e-15
"""Sine or cosine of half a tilt below which the tilt's axis, or the roll, has no meaning."""


def axis_rotation(axis: int, angle: Floats) -> Floats:
    """Return the rotations (N, 3, 3) about the axis x, y or z (0, 1, 2) by angles (N,).

    >>> axis_rotation(2, np.array([np.pi / 2])).round(3)[0].tolist()
    [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    """
    rotation = np.zeros((len(angle), 3, 3))
    following, last = (axis + 1) % 3, (axis + 2) % 3
    rotation[:, axis, axis] = 1.0
    rotation[:, following, following] = rotation[:, last, last] = np.cos(angle)
    rotation[:, last, following] = np.sin(angle)
    rotation[:, following, last] = -np.sin(angle)
    return rotation


def rotation_of_yaw_pitch_roll(yaw: Floats, pitch: Floats, roll: Floats) -> Floats:
    """Return Ry(yaw) · Rx(pitch) · Rz(roll) · Rx(180°), (N, 3, 3): intrinsic y-x-z angles."""
    turned = axis_rotation(1, yaw) @ axis_rotation(0, pitch) @ axis_rotation(2, roll)
    return np.asarray(turned @ ABOUT_X_180)


def towards(sight: Floats) -> Floats:
    """Return the smallest rotations (N, 3, 3) that take (0, 0, 1) to lines of sight (N, 3), z > 0.

    With s of length 1, 1 + s_z is twice the squared cosine of half the angle; the rest is
    Rodrigues' formula about (-s_y, s_x, 0).
    """
    x, y, z = (sight / np.linalg.norm(sight, axis=1, keepdims=True)).T
    shared = 1 / (1 + z)
    rows = [
        [1 - x * x * shared, -x * y * shared, x],
        [-x * y * shared, 1 - y * y * shared, y],
        [-x, -y, z],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def rotation_of_view_angle(
    view: Floats, azimuth: Floats, roll: Floats, sight: Floats
) -> Floats:
    """Return S · Rot((cos azimuth, sin azimuth, 0), view) · Rz(roll) · Rx(180°), (N, 3, 3).

    S is the smallest rotation of the optical axis to the line of sight (N, 3), so that the angle
    between the marker's normal and the line of sight is ``view`` wherever the marker is.
    """
    return np.asarray(towards(sight) @ rotation_of_angles(view, azimuth, roll))


def angles_of_rotation(rotation: Floats) -> tuple[Floats, Floats, Floats]:
    """Return tilt in [0, π], azimuth and roll in [-π, π] of rotations (N, 3, 3).

    The inverse of :func:`sweep.model.pose.rotation_of_angles`. The quaternion (w, x, y, z) of
    R · Rx(180°) is that of a tilt about an axis in the image plane times that of a roll:
    w = cos(tilt/2) cos(roll/2), z = cos(tilt/2) sin(roll/2), and (x, y) is sin(tilt/2) in the
    direction azimuth - roll/2. Without a tilt the azimuth is 0, at a tilt of 180° the roll is.
    """
    vector = vector_of_rotation(np.asarray(rotation @ ABOUT_X_180))
    half = np.linalg.norm(vector, axis=1) / 2
    # sin(half)/(2 half) times the vector is the quaternion's vector part.
    x, y, z = (vector * (np.sinc(half / np.pi) / 2)[:, None]).T
    w = np.cos(half)
    sine, cosine = np.hypot(x, y), np.hypot(w, z)
    roll = np.where(cosine > DEGENERATE, 2 * np.arctan2(z, w), 0.0)
    azimuth = np.where(sine > DEGENERATE, np.arctan2(y, x) + roll / 2, 0.0)
    return 2 * np.arctan2(sine, cosine), _wrapped(azimuth), _wrapped(roll)


def _wrapped(angle: Floats) -> Floats:
    """Return angles from -2π to 2π in [-π, π], those that are there already to the bit."""
    return np.asarray(angle - 2 * np.pi * (np.abs(angle) > np.pi) * np.sign(angle))
