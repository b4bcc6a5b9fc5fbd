"""Errors of estimated poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sweep.model.pose import angle_between, mirrored, vector_of_rotation
from sweep.typing import Floats


@dataclass(frozen=True, slots=True)
class PoseError:
    """Errors of N poses, estimated against true, in the camera frame; NaN if not solved."""

    translation_m: Floats
    """(N, 3)"""
    rotation_rad: Floats
    """(N, 3) rotation vector of R_est · R_trueᵀ"""
    rotation_angle_rad: Floats
    """(N,) its length: the geodesic angle"""
    normal_angle_rad: Floats
    """(N,) angle between the true and the estimated normal"""
    flipped: NDArray[np.bool_]
    """(N,) nearer to the mirror of the truth than to the truth"""


def rotation_difference(rotation: Floats, other: Floats) -> Floats:
    """Return the rotation vectors (N, 3) of rotation · otherᵀ, both (N, 3, 3)."""
    return vector_of_rotation(rotation @ np.swapaxes(other, 1, 2))


def pose_error(
    rotation: Floats, translation: Floats, true_rotation: Floats, true_translation: Floats
) -> PoseError:
    """Compare estimated poses (N, 3, 3), (N, 3) with true ones of the same shapes."""
    difference = rotation_difference(rotation, true_rotation)
    angle = np.linalg.norm(difference, axis=1)
    mirror = mirrored(true_rotation, true_translation)
    to_mirror = np.linalg.norm(rotation_difference(rotation, mirror), axis=1)
    return PoseError(
        translation_m=translation - true_translation,
        rotation_rad=difference,
        rotation_angle_rad=angle,
        normal_angle_rad=angle_between(rotation[:, :, 2], true_rotation[:, :, 2]),
        flipped=to_mirror < angle,
    )
