"""Poses in the camera frame: arithmetic with rotations, users' angles, a world frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from sweep.compilation import compiled
from sweep.declaration import drawn, parameter
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# The marker's pose in the camera frame, and arithmetic with rotations (batched: (N, ...)).
#
# Camera frame: x right, y down, z forward. Marker frame: x right, y up, z out towards the viewer.

@dataclass(frozen=True, slots=True)
class Pose:
    """The pose's parameters; all angles zero is upright and parallel to the image plane."""

    distance_m: float | None = drawn(
        None, "depth of the marker's centre along the optical axis", 0, 1e12, open_low=True
    )
    side_px: float | None = drawn(
        None, "side of the black square in the image if it were parallel to it; replaces "
        "distance_m", 0, open_low=True,
    )
    tilt_deg: float = drawn(0.0, "angle between the marker's plane and the image plane", -360, 360)
    view_angle_deg: float | None = drawn(
        None, "angle between the marker's normal and the line of sight to its centre; replaces "
        "tilt_deg", -180, 180,
    )
    azimuth_deg: float = drawn(
        0.0, "direction of the tilt axis: in the image plane, with view_angle_deg across the line "
        "of sight", -360, 360,
    )
    yaw_deg: float | None = drawn(
        None, "turn about the camera's y axis; with pitch_deg it replaces tilt_deg and azimuth_deg "
        "(default: 0 beside pitch_deg)", -360, 360,
    )
    pitch_deg: float | None = drawn(
        None, "turn about the x axis that yaw_deg has turned (default: 0 beside yaw_deg)", -360,
        360,
    )
    roll_deg: float = drawn(
        0.0, "rotation of the marker in its own plane, before all others", -360, 360
    )
    bearing_x_deg: float = drawn(
        0.0, "direction of the centre, right of the optical axis", -89.999, 89.999
    )
    bearing_y_deg: float = drawn(
        0.0, "direction of the centre, below the optical axis", -89.999, 89.999
    )
    x_m: float | None = drawn(
        None, "place of the centre, right of the optical axis; replaces bearing_x_deg", -1e12, 1e12
    )
    y_m: float | None = drawn(
        None, "place of the centre, below the optical axis; replaces bearing_y_deg", -1e12, 1e12
    )
    frame_x: float | None = drawn(
        None, "place between the leftmost (0) and the rightmost (1) at which the marker and its "
        "quiet zone are wholly in the frame; replaces bearing_x_deg", 0, 1,
    )
    frame_y: float | None = drawn(
        None, "place between the uppermost (0) and the lowest (1) at which the marker and its "
        "quiet zone are wholly in the frame; replaces bearing_y_deg", 0, 1,
    )
    jitter_px: float = parameter(
        0.0, "a: the centre moves parallel to the image plane by uniform [-a, a] pixels in u and "
        "in v", 0,
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


# --------------------------------------------------------------------------------------------------
# Rotations by angles that users give, and the pose's three angles of a rotation (batched).
#
# Camera frame: x right, y down, z forward. Angles in radians, (N,) each.

#: Rx(180°): the marker frame (y up, z out) of an upright marker that faces the camera.
ABOUT_X_180 = np.diag([1.0, -1.0, -1.0])

#: Sine or cosine of half a tilt below which the tilt's axis, or the roll, has no meaning.
DEGENERATE = 1e-15


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


# --------------------------------------------------------------------------------------------------
# Camera and marker placed in a world frame.
#
# World frame: x forward, y left, z up (ROS REP 103). At angles of zero the camera looks along the
# world's x with z up, and the marker faces along x, upright.

#: Takes a camera's body frame (x forward, y left, z up) to its image's (x right, y down).
OPTICAL_OF_BODY = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])

#: Takes the marker frame (x right, y up, z out) to its body's: x out of its face, z up.
#:
#: Whoever looks at the marker sees the body's left, y, on the right.
BODY_OF_MARKER = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def _coordinate(whose: str, axis: str) -> Any:
    return drawn(
        None, f"{whose} place in the world along {axis}; with the others it replaces the pose in "
        "the camera's frame (default: 0 beside another place in the world)", -1e12, 1e12,
    )


def _angle(whose: str, meaning: str) -> Any:
    default = "default: 0 beside another place in the world"
    return drawn(None, f"{whose} {meaning} ({default})", -360, 360)


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
