"""The marker's pose in the camera frame, and arithmetic with rotations (batched: (N, ...)).

Camera frame: x right, y down, z forward. Marker frame: x right, y up, z out towards the viewer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from sweep.compilation import compiled
from sweep.declaration import parameter
from sweep.typing import Floats


@dataclass(frozen=True, slots=True)
class Pose:
    """The pose's parameters; all angles zero is upright and parallel to the image plane."""

    distance_m: float | None = parameter(
        None, "depth of the marker's centre along the optical axis", unit="m", low=0,
        high=1e12, open_low=True, drawable=True,
    )
    side_px: float | None = parameter(
        None,
        "side of the black square in the image if it were parallel to it; replaces distance_m",
        unit="px", low=0, open_low=True, drawable=True,
    )
    tilt_deg: float = parameter(
        0.0, "angle between the marker's plane and the image plane", unit="degree", low=-360,
        high=360, drawable=True,
    )
    view_angle_deg: float | None = parameter(
        None,
        "angle between the marker's normal and the line of sight to its centre; replaces tilt_deg",
        unit="degree", low=-180, high=180, drawable=True,
    )
    azimuth_deg: float = parameter(
        0.0, "direction of the tilt axis: in the image plane, with view_angle_deg across the line "
        "of sight", unit="degree", low=-360, high=360, drawable=True,
    )
    yaw_deg: float | None = parameter(
        None,
        "turn about the camera's y axis; with pitch_deg it replaces tilt_deg and azimuth_deg "
        "(default: 0 beside pitch_deg)", unit="degree", low=-360, high=360, drawable=True,
    )
    pitch_deg: float | None = parameter(
        None, "turn about the x axis that yaw_deg has turned (default: 0 beside yaw_deg)",
        unit="degree", low=-360, high=360, drawable=True,
    )
    roll_deg: float = parameter(
        0.0, "rotation of the marker in its own plane, before all others", unit="degree", low=-360,
        high=360, drawable=True,
    )
    bearing_x_deg: float = parameter(
        0.0, "direction of the centre, right of the optical axis", unit="degree", low=-89.999,
        high=89.999, drawable=True,
    )
    bearing_y_deg: float = parameter(
        0.0, "direction of the centre, below the optical axis", unit="degree", low=-89.999,
        high=89.999, drawable=True,
    )
    x_m: float | None = parameter(
        None, "place of the centre, right of the optical axis; replaces bearing_x_deg", unit="m",
        low=-1e12, high=1e12, drawable=True,
    )
    y_m: float | None = parameter(
        None, "place of the centre, below the optical axis; replaces bearing_y_deg", unit="m",
        low=-1e12, high=1e12, drawable=True,
    )
    frame_x: float | None = parameter(
        None,
        "place between the leftmost (0) and the rightmost (1) at which the marker and its quiet "
        "zone are wholly in the frame; replaces bearing_x_deg", low=0, high=1, drawable=True,
    )
    frame_y: float | None = parameter(
        None,
        "place between the uppermost (0) and the lowest (1) at which the marker and its quiet "
        "zone are wholly in the frame; replaces bearing_y_deg", low=0, high=1, drawable=True,
    )
    jitter_px: float = parameter(
        0.0,
        "a: the centre moves parallel to the image plane by uniform [-a, a] pixels in u and in v",
        unit="px", low=0,
    )


def rotation_of_angles(tilt: Any, azimuth: Any, roll: Any) -> Floats:
    """Return Rot((cos azimuth, sin azimuth, 0), tilt) · Rz(roll) · Rx(180°), (N, 3, 3).

    Angles in radians, (N,).
    """
    tilt, azimuth, roll = np.broadcast_arrays(
        *(np.atleast_1d(np.asarray(angle, dtype=np.float64)) for angle in (tilt, azimuth, roll))
    )
    ax, ay = np.cos(azimuth), np.sin(azimuth)
    c, s = np.cos(tilt), np.sin(tilt)
    versine = 2 * np.sin(tilt / 2) ** 2
    tilted = np.empty((tilt.size, 3, 3))
    # Rodrigues' formula for an axis in the image plane; 1 - cos as 2 sin² keeps tiny tilts.
    tilted[:, 0, 0] = c + versine * ax * ax
    tilted[:, 1, 1] = c + versine * ay * ay
    tilted[:, 2, 2] = c
    tilted[:, 0, 1] = tilted[:, 1, 0] = versine * ax * ay
    tilted[:, 0, 2], tilted[:, 2, 0] = s * ay, -s * ay
    tilted[:, 1, 2], tilted[:, 2, 1] = -s * ax, s * ax
    cr, sr = np.cos(roll), np.sin(roll)
    turned = np.zeros_like(tilted)
    # Rz(roll) · diag(1, -1, -1)
    turned[:, 0, 0], turned[:, 0, 1] = cr, sr
    turned[:, 1, 0], turned[:, 1, 1] = sr, -cr
    turned[:, 2, 2] = -1.0
    return np.asarray(tilted @ turned)


def rotation_of_vector(rvec: Floats) -> Floats:
    """Return the rotation matrices (..., 3, 3) of rotation vectors (..., 3) (Rodrigues)."""
    vectors = np.ascontiguousarray(rvec, dtype=np.float64).reshape(-1, 3)
    return rotations(vectors).reshape(*rvec.shape, 3)


def vector_of_rotation(rotation: Floats) -> Floats:
    """Return the rotation vectors (..., 3) of rotation matrices (..., 3, 3), angle in [0, π].

    Through the unit quaternion by its largest component (Shepperd 1978) and atan2, so that
    neither angles near 0 nor near π lose digits; ``cv2.Rodrigues`` returns 0 below 1e-5 rad.
    """
    matrices = np.ascontiguousarray(rotation, dtype=np.float64).reshape(-1, 3, 3)
    return vectors(matrices).reshape(rotation.shape[:-1])


@compiled
def rotations(rvec: Floats) -> Floats:
    """As :func:`rotation_of_vector`, (N, 3) to (N, 3, 3), for compiled code."""
    rotation = np.empty((len(rvec), 3, 3))
    for i in range(len(rvec)):
        x, y, z = rvec[i, 0], rvec[i, 1], rvec[i, 2]
        angle = math.sqrt(x * x + y * y + z * z)
        sine, versine = 1.0, 0.5
        if not angle <= 0.0:
            half = math.sin(angle / 2) / angle
            sine, versine = math.sin(angle) / angle, 2 * half * half
        rotation[i, 0, 0] = 1.0 - versine * (y * y + z * z)
        rotation[i, 1, 1] = 1.0 - versine * (x * x + z * z)
        rotation[i, 2, 2] = 1.0 - versine * (x * x + y * y)
        xy, xz, yz = versine * x * y, versine * x * z, versine * y * z
        rotation[i, 0, 1], rotation[i, 1, 0] = xy - sine * z, xy + sine * z
        rotation[i, 2, 0], rotation[i, 0, 2] = xz - sine * y, xz + sine * y
        rotation[i, 1, 2], rotation[i, 2, 1] = yz - sine * x, yz + sine * x
    return rotation


@compiled
def vectors(rotation: Floats) -> Floats:
    """As :func:`vector_of_rotation`, (N, 3, 3) to (N, 3), for compiled code."""
    rvec = np.empty((len(rotation), 3))
    for i in range(len(rotation)):
        r = rotation[i]
        a, b, c = r[0, 0], r[1, 1], r[2, 2]
        trace = a + b + c
        wx, wy, wz = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
        xy, xz, yz = r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1]
        # Four times the largest of the quaternion's components, times (x, y, z, w).
        if trace >= a and trace >= b and trace >= c:
            x, y, z, w = wx, wy, wz, 1 + trace
        elif a >= b and a >= c:
            x, y, z, w = 1 + 2 * a - trace, xy, xz, wx
        elif b >= c:
            x, y, z, w = xy, 1 + 2 * b - trace, yz, wy
        else:
            x, y, z, w = xz, yz, 1 + 2 * c - trace, wz
        if w < 0:
            x, y, z, w = -x, -y, -z, -w
        length = math.sqrt(x * x + y * y + z * z)
        scale = 2 * math.atan2(length, w) / length if length != 0.0 else 0.0
        rvec[i, 0], rvec[i, 1], rvec[i, 2] = x * scale, y * scale, z * scale
    return rvec


def transform_points(points: Floats, rotation: Floats, translation: Floats) -> Floats:
    """Return marker-frame points (N, M, 3) moved to the camera frame by poses (N, 3, 3), (N, 3)."""
    return _transform_points(
        np.ascontiguousarray(points), np.ascontiguousarray(rotation),
        np.ascontiguousarray(translation),
    )


@compiled
def _transform_points(points: Floats, rotation: Floats, translation: Floats) -> Floats:
    moved = np.empty_like(points)
    for i in range(points.shape[0]):
        for j in range(points.shape[1]):
            x, y, z = points[i, j, 0], points[i, j, 1], points[i, j, 2]
            for k in range(3):
                moved[i, j, k] = (
                    rotation[i, k, 0] * x + rotation[i, k, 1] * y + rotation[i, k, 2] * z
                ) + translation[i, k]
    return moved


def angle_between(a: Floats, b: Floats) -> Floats:
    """Return the angle (...,) in radians between vectors (..., 3), by atan2, never acos."""
    cosine = np.sum(a * b, axis=-1)
    # a x b = a x (b - a), whose digits do not cancel for similar vectors.
    other = np.where(cosine[..., None] > 0, b - a, b)
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(a, other), axis=-1), cosine))


def viewing_angle(rotation: Floats, translation: Floats) -> Floats:
    """Return the angles (N,) in radians between markers' normals and the lines of sight to them.

    0: seen frontally; above π/2: from behind. Rotations (N, 3, 3), positions (N, 3) of the centres;
    without a line of sight, at the camera's centre, it is 0.
    """
    length = np.linalg.norm(translation, axis=1, keepdims=True)
    return angle_between(rotation[:, :, 2], -translation / np.where(length > 0, length, 1.0))


def mirrored(rotation: Floats, translation: Floats) -> Floats:
    """Return the rotations (N, 3, 3) of the second planar solution of exact corners.

    The first-order image of the marker's centre fixes the pose up to the sign of its tilt against
    the line of sight s (Collins and Bartoli, "Infinitesimal plane-based pose estimation", 2014,
    section 3): the other solution is (1 - 2 s sᵀ) · R · diag(1, 1, -1).
    """
    sight = translation / np.linalg.norm(translation, axis=-1, keepdims=True)
    swapped = rotation * np.array([1.0, 1.0, -1.0])
    return np.asarray(swapped - 2 * sight[:, :, None] * (sight[:, None, :] @ swapped))
