"""A marker that moves at constant linear and angular velocity while its image is taken."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled
from sweep.model.lens import distort, jacobian
from sweep.model.projection import Projection
from sweep.model.sheet import plane_normal
from sweep.typing import Floats


class Motion(NamedTuple):
    """A marker's motion in the camera frame.

    Attributes
    ----------
    translation
        (3,) position of its centre at time 0, in metres.
    velocity
        (6,) linear in m/s and angular in rad/s.
    """

    translation: Floats
    velocity: Floats


class MovingMarker(NamedTuple):
    """A moving marker seen by a camera.

    Attributes
    ----------
    projection
        The camera, and the marker's plane at time 0.
    motion
        How the marker moves.
    outline
        (M, 3) points of its outline: column, row, and height over the plane in modules.
    """

    projection: Projection
    motion: Motion
    outline: Floats


@compiled
def moved_plane(plane: Floats, motion: Motion, time_s: float) -> Floats:
    """Return the plane (3, 3) of a marker after ``time_s``.

    ``plane`` takes module coordinates to the camera frame. The rotation about the centre is
    Rodrigues' formula for the vector angular velocity · time.
    """
    translation, velocity = motion
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


VISIBLE, BEHIND, MEANINGLESS = 0, 1, 2
"""States of a moving marker: in front of the camera; wholly behind it; or without a meaningful
image, since it crosses the camera's plane, shows its back, or lies where the lens folds."""


@compiled
def outline_extent(
    projection: Projection, outline: Floats, extent: Floats
) -> tuple[int, bool]:
    """Write left, top, right, bottom in px of an outline's image to ``extent`` (4,).

    The extent is that of the points (M, 3), in modules, that are in front of the camera.
    Returns how many are behind it, and whether the lens folds at one of the others.
    """
    plane, optics = projection.plane, projection.optics
    intrinsics, lens = optics.intrinsics, optics.lens
    behind, folds = 0, False
    extent[0] = extent[1] = math.inf
    extent[2] = extent[3] = -math.inf
    normal = plane_normal(plane)
    for j in range(len(outline)):
        height = outline[j, 2]
        z = plane[2, 0] * outline[j, 0] + plane[2, 1] * outline[j, 1] + plane[2, 2]
        z += height * normal[2]
        if not z > 0.0:
            behind += 1
            continue
        x = plane[0, 0] * outline[j, 0] + plane[0, 1] * outline[j, 1] + plane[0, 2]
        y = plane[1, 0] * outline[j, 0] + plane[1, 1] * outline[j, 1] + plane[1, 2]
        x, y = (x + height * normal[0]) / z, (y + height * normal[1]) / z
        if optics.distorted:
            a, b, c, d = jacobian(x, y, lens)
            folds = folds or not (math.hypot(x, y) < lens[23] and a * d - b * c > 0.0)
            x, y = distort(x, y, lens)
        u, v = intrinsics[0] * x + intrinsics[2], intrinsics[1] * y + intrinsics[3]
        extent[0], extent[2] = min(extent[0], u), max(extent[2], u)
        extent[1], extent[3] = min(extent[1], v), max(extent[3], v)
    return behind, folds


@compiled
def track(marker: MovingMarker, times_s: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Return the extents (T, 4) left, top, right, bottom in px of a marker, and its states (T,)."""
    projection, motion = marker.projection, marker.motion
    extents = np.empty((len(times_s), 4))
    states = np.zeros(len(times_s), dtype=np.int64)
    for k in range(len(times_s)):
        p = moved_plane(projection.plane, motion, times_s[k])
        behind, folds = outline_extent(
            Projection(p, projection.optics), marker.outline, extents[k]
        )
        if folds:
            states[k] = MEANINGLESS
        # The sign of the line of sight along the normal, which is the columns' cross product.
        facing = 0.0
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            normal = p[a, 0] * p[b, 1] - p[b, 0] * p[a, 1]
            facing += normal * (motion.translation[i] + motion.velocity[i] * times_s[k])
        if behind == len(marker.outline):
            states[k] = BEHIND
        elif behind > 0 or not facing > 0.0:
            states[k] = MEANINGLESS
    return extents, states


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
