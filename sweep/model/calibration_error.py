"""The error of a calibration: normal, with the covariance that the calibration states."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sweep.typing import Floats

VIEW = ("fx_px", "fy_px", "cx_px", "cy_px")

COEFFICIENTS = (
    "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y",
)
"""Lens coefficients in OpenCV's order."""

RTOL = 1e-6
"""Largest asymmetry, and largest rest of the factorisation, of a covariance that is accepted."""


@dataclass(frozen=True, slots=True)
class CalibrationError:
    """The error of n numbers: of fx, fy, cx, cy and, if the lens is uncertain, its coefficients.

    Attributes
    ----------
    names
        Of the numbers, (n,).
    factor
        (n, n) lower triangular L of the covariance matrix L Lᵀ.
    """

    names: tuple[str, ...]
    factor: Floats

    @staticmethod
    def of(
        sd: Sequence[float], covariance: Sequence[float], coefficients: int
    ) -> CalibrationError:
        """Return the error that standard deviations or a covariance matrix state.

        Parameters
        ----------
        sd
            Standard deviations of 4 or 4 + ``coefficients`` numbers; empty if ``covariance`` is
            given.
        covariance
            Their covariance matrix, row by row.
        coefficients
            Number of lens coefficients.

        Raises
        ------
        ValueError
            What was expected.
        """
        n = len(sd) or math.isqrt(len(covariance))
        if n not in (4, 4 + coefficients):
            least = "4 numbers" if sd else "4 x 4 numbers"
            most = f"{4 + coefficients}" if sd else f"{4 + coefficients} x {4 + coefficients}"
            raise ValueError(
                f"{least}, of fx, fy, cx and cy" + (
                    f", or {most}, with the {coefficients} coefficients of distortion"
                    if coefficients else ": distortion is empty"
                )
            )
        names = (*VIEW, *COEFFICIENTS[: n - 4])
        if sd:
            if min(sd) < 0:
                raise ValueError("standard deviations of at least 0")
            return CalibrationError(names, np.diag(np.array(sd, dtype=np.float64)))
        matrix = np.reshape(np.array(covariance, dtype=np.float64), (n, n))
        deviations = np.sqrt(np.diagonal(matrix).clip(0))
        allowed = RTOL * np.outer(deviations, deviations)
        if not (np.abs(matrix - matrix.T) <= allowed).all():
            raise ValueError("a symmetric matrix")
        factor = _cholesky((matrix + matrix.T) / 2)
        if not (np.abs(factor @ factor.T - matrix) <= allowed).all():
            raise ValueError("a covariance: no variance below 0, no correlation beyond 1")
        return CalibrationError(names, factor)

    def sd(self, name: str) -> float:
        """Return the standard deviation of one of the numbers."""
        return math.sqrt(math.fsum((self.factor[self.names.index(name)] ** 2).tolist()))

    def believed(self, truth: Sequence[Floats], normals: Sequence[Floats]) -> list[Floats]:
        """Return the n numbers (N,) each that a calibration of true cameras gives.

        Parameters
        ----------
        truth
            The n true numbers, (N,) each.
        normals
            n standard normal numbers, (N,) each.
        """
        believed = []
        for k, row in enumerate(self.factor):
            source, scale = k, np.array(1.0)
            other = {0: 1, 1: 0}.get(k)
            if other is not None and not row.any() and self.factor[other].any():
                # A focal length without error beside one that has it: the aspect ratio was fixed.
                source, scale = other, truth[k] / truth[other]
            number = truth[k].copy()
            for factor, normal in zip(self.factor[source], normals, strict=True):
                if factor != 0:
                    number += scale * factor * normal
            believed.append(number)
        return believed


def _cholesky(matrix: Floats) -> Floats:
    """Return the lower triangular factor of a semidefinite matrix; columns without variance are 0.

    In plain arithmetic in a fixed order, so that draws are the same on every machine.
    """
    n = len(matrix)
    rows = matrix.tolist()
    factor = [[0.0] * n for _ in range(n)]
    for j in range(n):
        left = rows[j][j] - math.fsum(factor[j][k] ** 2 for k in range(j))
        if not left > 1e-13 * rows[j][j]:
            continue
        factor[j][j] = math.sqrt(left)
        for i in range(j + 1, n):
            rest = rows[i][j] - math.fsum(factor[i][k] * factor[j][k] for k in range(j))
            factor[i][j] = rest / factor[j][j]
    return np.array(factor)
