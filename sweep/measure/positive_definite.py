"""Systems of equations with a positive definite matrix, and the covariance of a pose."""

from __future__ import annotations

import math

import numpy as np

from sweep.compilation import compiled
from sweep.model.derivatives import POSE
from sweep.typing import Floats


@compiled
def solve_positive(matrix: Floats, right: Floats) -> bool:
    """Solve matrix · x = right in place; return False if the matrix is not positive definite.

    Scaled to a unit diagonal, then by Cholesky's factors; a pivot must be above 1e-11.
    """
    n = matrix.shape[0]
    scale, factor = np.empty(n), np.empty((n, n))
    for i in range(n):
        if not (matrix[i, i] > 0.0 and matrix[i, i] < math.inf):
            return False
        scale[i] = 1.0 / math.sqrt(matrix[i, i])
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j] * scale[i] * scale[j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i > j:
                factor[i, j] = total / factor[j, j]
            elif total > 1e-11:
                factor[i, i] = math.sqrt(total)
            else:
                return False
    for column in range(right.shape[1]):
        for i in range(n):
            total = right[i, column] * scale[i]
            for k in range(i):
                total -= factor[i, k] * right[k, column]
            right[i, column] = total / factor[i, i]
        for i in range(n - 1, -1, -1):
            total = right[i, column]
            for k in range(i + 1, n):
                total -= factor[k, i] * right[k, column]
            right[i, column] = total / factor[i, i]
        for i in range(n):
            right[i, column] *= scale[i]
    return True


@compiled
def pose_covariance(information: Floats, variance: float, distance: float) -> tuple[Floats, bool]:
    """Return the covariance (6, 6) of the pose in radians and metres, and whether it exists."""
    free = information.shape[0]
    inverse = np.eye(free)
    exists = solve_positive(information, inverse)
    for i in range(POSE):
        for j in range(POSE):
            unit = (distance if i >= 3 else 1.0) * (distance if j >= 3 else 1.0)
            inverse[i, j] *= variance * unit
    return inverse[:POSE, :POSE].copy(), exists
