"""A marker that moves at constant linear and angular velocity while its image is taken."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled

Floats = NDArray[np.float64]


@compiled
def moved(plane: Floats, translation: Floats, velocity: Floats, time_s: float) -> Floats:
    """Return the plane (3, 3) of a marker after ``time_s``.

    ``plane`` takes module coordinates to the camera frame, ``translation`` (3,) is the centre's
    position, ``velocity`` (6,) linear in m/s and angular in rad/s, camera frame; the rotation
    about the centre is Rodrigues' formula for the vector angular velocity · time.
    """
    x, y, z = velocity[3] * time_s, velocity[4] * time_s, velocity[5] * time_s
    angle = math.sqrt(x * x + y * y + z * z)
    sine, versine = 1.0, 0.5
    if angle > 0.0:
        half = math.sin(angle / 2) / angle
        sine, versine = math.sin(angle) / angle, 2 * half * half
    after = np.empty((3, 3))
    for k in range(3):
        px, py, pz = plane[0, k], plane[1, k], plane[2, k]
        if k == 2:
            px, py, pz = px - translation[0], py - translation[1], pz - translation[2]
        cx, cy, cz = y * pz - z * py, z * px - x * pz, x * py - y * px
        dx, dy, dz = y * cz - z * cy, z * cx - x * cz, x * cy - y * cx
        after[0, k] = px + sine * cx + versine * dx
        after[1, k] = py + sine * cy + versine * dy
        after[2, k] = pz + sine * cz + versine * dz
    for k in range(3):
        after[k, 2] += translation[k] + velocity[k] * time_s
    return after


def row_times(
    top: int, bottom: int, height: int, exposure_s: float, row_time_s: float
) -> tuple[float, float]:
    """Return when the exposure of rows [top, bottom) begins and ends.

    Time 0 is the middle of the middle row's exposure.
    """
    middle = (height - 1) / 2
    return (
        row_time_s * (top - middle) - exposure_s / 2,
        row_time_s * (bottom - 1 - middle) + exposure_s / 2,
    )
