"""The marker's pose in the camera frame, and arithmetic with rotations (batched: (N, ...)).

Camera frame: x right, y down, z forward. Marker frame: x right, y up, z out towards the viewer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.model.declaration import parameter

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Pose:
    """The pose's parameters; all angles zero is upright and parallel to the image plane."""

    distance_m: float | None = parameter(
        None, "depth of the marker's centre along the optical axis", unit="m", low=0,
        high=1e12, open_low=True, drawable=True,
    )
    side_px: float | None = parameter(
        None,
        "side of the black square in the image were it parallel to it; in place of distance_m",
        unit="px", low=0, open_low=True, drawable=True,
    )
    tilt_deg: float = parameter(
        0.0, "angle between the marker's plane and the image plane", unit="degree", low=-360,
        high=360, drawable=True,
    )
    azimuth_deg: float = parameter(
        0.0, "direction of the axis of the tilt, in the image plane", unit="degree", low=-360,
        high=360, drawable=True,
    )
    roll_deg: float = parameter(
        0.0, "turn of the marker in its own plane, before the tilt", unit="degree", low=-360,
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
    angle = np.linalg.norm(rvec, axis=-1)[..., None, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        sine = np.where(angle > 0, np.sin(angle) / angle, 1.0)
        versine = np.where(angle > 0, 2 * np.sin(angle / 2) ** 2 / angle**2, 0.5)
    cross = np.zeros((*rvec.shape, 3))
    x, y, z = rvec[..., 0], rvec[..., 1], rvec[..., 2]
    cross[..., 0, 1], cross[..., 1, 0] = -z, z
    cross[..., 0, 2], cross[..., 2, 0] = y, -y
    cross[..., 1, 2], cross[..., 2, 1] = -x, x
    return np.asarray(np.eye(3) + sine * cross + versine * (cross @ cross))


def vector_of_rotation(rotation: Floats) -> Floats:
    """Return the rotation vectors (..., 3) of rotation matrices (..., 3, 3), angle in [0, π].

    Through the unit quaternion by its largest component (Shepperd 1978) and atan2, so that
    neither angles near 0 nor near π lose digits; ``cv2.Rodrigues`` returns 0 below 1e-5 rad.
    """
    r = rotation
    trace = r[..., 0, 0] + r[..., 1, 1] + r[..., 2, 2]
    scores = np.stack([r[..., 0, 0], r[..., 1, 1], r[..., 2, 2], trace], axis=-1)
    wx = r[..., 2, 1] - r[..., 1, 2]
    wy = r[..., 0, 2] - r[..., 2, 0]
    wz = r[..., 1, 0] - r[..., 0, 1]
    xy = r[..., 0, 1] + r[..., 1, 0]
    xz = r[..., 0, 2] + r[..., 2, 0]
    yz = r[..., 1, 2] + r[..., 2, 1]
    # Rows: four times one quaternion component, times (x, y, z, w).
    products = np.stack(
        [
            np.stack([1 + 2 * r[..., 0, 0] - trace, xy, xz, wx], axis=-1),
            np.stack([xy, 1 + 2 * r[..., 1, 1] - trace, yz, wy], axis=-1),
            np.stack([xz, yz, 1 + 2 * r[..., 2, 2] - trace, wz], axis=-1),
            np.stack([wx, wy, wz, 1 + trace], axis=-1),
        ],
        axis=-2,
    )
    largest = np.argmax(np.nan_to_num(scores, nan=-9.0), axis=-1)
    quaternion = np.take_along_axis(products, largest[..., None, None], axis=-2)[..., 0, :]
    quaternion = np.where(quaternion[..., 3:] < 0, -quaternion, quaternion)
    axis, w = quaternion[..., :3], quaternion[..., 3]
    length = np.linalg.norm(axis, axis=-1)
    half = np.arctan2(length, w)
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.where(length > 0, 2 * half / length, 0.0)
    return np.asarray(axis * scale[..., None])


def angle_between(a: Floats, b: Floats) -> Floats:
    """Return the angle (...,) in radians between vectors (..., 3), by atan2, never acos."""
    return np.asarray(
        np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))
    )


def mirrored(rotation: Floats, translation: Floats) -> Floats:
    """Return the rotations (N, 3, 3) of the second planar solution of exact corners.

    With Q the smallest rotation that takes the z axis to the line of sight, the first-order
    image of the marker's centre fixes Qᵀ·R up to the sign of its third row's and column's
    off-diagonal entries (Collins and Bartoli, "Infinitesimal plane-based pose estimation", 2014,
    section 3), so the other solution is Q·S·Qᵀ·R·S with S = diag(1, 1, -1).
    """
    sight = translation / np.linalg.norm(translation, axis=-1, keepdims=True)
    x, y, z = sight[:, 0], sight[:, 1], sight[:, 2]
    q = np.empty_like(rotation)
    with np.errstate(invalid="ignore", divide="ignore"):
        k = 1 / (1 + z)
        q[:, 0, 0], q[:, 0, 1], q[:, 0, 2] = 1 - k * x * x, -k * x * y, x
        q[:, 1, 0], q[:, 1, 1], q[:, 1, 2] = -k * x * y, 1 - k * y * y, y
        q[:, 2, 0], q[:, 2, 1], q[:, 2, 2] = -x, -y, z
        sign = np.array([1.0, 1.0, -1.0])
        return np.asarray((q * sign) @ np.swapaxes(q, 1, 2) @ rotation * sign)
