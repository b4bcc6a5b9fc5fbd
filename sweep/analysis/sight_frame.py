"""The sight frame: the camera's frame, turned by the shortest way so that z is the line of sight.

On the optical axis it is the camera's frame. Elsewhere the error along the line of sight, which is
by far the largest, would be in x and y of the camera in proportion to the bearing.
"""

from __future__ import annotations

import numpy as np

from sweep.model.pose import angle_between, rotation_of_vector
from sweep.typing import Floats


def sight_rotation(position_m: Floats) -> Floats:
    """Return the rotations Q (..., 3, 3) whose columns are the sight frame's axes in the camera's.

    With the direction w = (a, b, c) to the marker and k = 1 / (1 + c) they are (1 - k a², -k a b,
    -a), (-k a b, 1 - k b², -b) and w: the rotation of z to w about their cross product (Rodrigues).

    Examples
    --------
    >>> sight_rotation(np.array([0.0, 3.0, 4.0])).round(3).tolist()
    [[1.0, -0.0, 0.0], [-0.0, 0.8, 0.6], [-0.0, -0.6, 0.8]]
    """
    position_m = np.asarray(position_m, dtype=np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        w = position_m / np.linalg.norm(position_m, axis=-1, keepdims=True)
        a, b, c = w[..., 0], w[..., 1], w[..., 2]
        k = 1.0 / (1.0 + c)
        rows = [[1.0 - k * a * a, -k * a * b, a], [-k * a * b, 1.0 - k * b * b, b], [-a, -b, c]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def in_sight_frame(vectors: Floats, position_m: Floats) -> Floats:
    """Return vectors (..., 3) of the camera's frame as Qᵀ v in the sight frame of positions."""
    return np.asarray(
        np.einsum("...ij,...i->...j", sight_rotation(position_m), np.asarray(vectors, dtype=float)))


def viewing_angle_of(rvec: Floats, position_m: Floats) -> Floats:
    """Return the angles (...) in degrees between the marker's normal and the line of sight."""
    normal = rotation_of_vector(np.asarray(rvec, dtype=np.float64))[..., 2]
    return np.degrees(angle_between(normal, -np.asarray(position_m, dtype=np.float64)))
