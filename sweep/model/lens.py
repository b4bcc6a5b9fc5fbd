"""OpenCV's lens distortion, its Jacobian, its inverse, and its folds.

The model is the one documented under "Detailed Description" of OpenCV's calib3d module: rational
radial (k1-k6), tangential (p1, p2), thin prism (s1-s4) and tilted sensor (tau_x, tau_y) terms.
All coordinates are normalised image coordinates (metres at one metre's depth, no unit).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled, compiled_inline

#: Numbers of coefficients that OpenCV's models have.
COUNTS = (0, 4, 5, 8, 12, 14)

#: Length of a packed lens: 14 coefficients, the 3x3 sensor tilt (row major), the fold radius.
PACKED = 24


def _tilt_matrix(tau_x: float, tau_y: float) -> NDArray[np.float64]:
    """Return the homography (3, 3) of a tilted sensor (OpenCV, tilted sensor model)."""
    cx, sx, cy, sy = math.cos(tau_x), math.sin(tau_x), math.cos(tau_y), math.sin(tau_y)
    about_x = np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    about_y = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
    rotation = about_y @ about_x
    onto_sensor = np.array(
        [[rotation[2, 2], 0, -rotation[0, 2]], [0, rotation[2, 2], -rotation[1, 2]], [0, 0, 1]]
    )
    return np.asarray(onto_sensor @ rotation, dtype=np.float64)


def fold_radius(coefficients: Sequence[float]) -> float:
    """Return the radius at which the radial terms stop growing; infinity if they never do.

    The distorted radius is r·N(s)/D(s) with s = r²; its derivative has the sign of
    N·D + 2s(N'·D - N·D') as long as D > 0. The fold is at the first positive root of either.
    """
    k = [*coefficients, *[0.0] * (14 - len(coefficients))]
    numerator = np.polynomial.Polynomial([1.0, k[0], k[1], k[4]])
    denominator = np.polynomial.Polynomial([1.0, k[5], k[6], k[7]])
    s = np.polynomial.Polynomial([0.0, 1.0])
    growth = numerator * denominator + 2 * s * (
        numerator.deriv() * denominator - numerator * denominator.deriv()
    )
    first = math.inf
    for polynomial in (growth, denominator):
        # A leading coefficient this small moves no relevant root, but makes all of them inaccurate.
        trimmed = polynomial.trim(1e-13 * float(np.abs(polynomial.coef).max()))
        if trimmed.degree() == 0:
            continue
        for root in np.asarray(trimmed.roots(), dtype=np.complex128).tolist():
            if abs(root.imag) <= 1e-9 * max(1.0, abs(root.real)) and root.real > 0:
                first = min(first, math.sqrt(root.real))
    return first


def pack(coefficients: tuple[float, ...]) -> NDArray[np.float64]:
    """Return a lens as the vector (24,) that the compiled functions take.

    Each call returns an array of its own: for one that is read-only each function would be
    compiled a second time.
    """
    return _packed(coefficients).copy()


@lru_cache(maxsize=1024)
def _packed(coefficients: tuple[float, ...]) -> NDArray[np.float64]:
    packed = np.zeros(PACKED)
    packed[: len(coefficients)] = coefficients
    packed[14:23] = _tilt_matrix(packed[12], packed[13]).ravel()
    packed[23] = fold_radius(coefficients)
    return packed


@compiled_inline
def _upright(x: float, y: float, lens: NDArray[np.float64]) -> tuple[float, float]:
    """Return the distorted normalised coordinates of (x, y) on a sensor without tilt."""
    r2 = x * x + y * y
    radial = (1 + ((lens[4] * r2 + lens[1]) * r2 + lens[0]) * r2) / (
        1 + ((lens[7] * r2 + lens[6]) * r2 + lens[5]) * r2
    )
    xd = x * radial + 2 * lens[2] * x * y + lens[3] * (r2 + 2 * x * x)
    yd = y * radial + lens[2] * (r2 + 2 * y * y) + 2 * lens[3] * x * y
    xd += (lens[9] * r2 + lens[8]) * r2
    yd += (lens[11] * r2 + lens[10]) * r2
    return xd, yd


@compiled
def distort(x: float, y: float, lens: NDArray[np.float64]) -> tuple[float, float]:
    """Return the distorted normalised coordinates of (x, y)."""
    xd, yd = _upright(x, y, lens)
    if lens[12] != 0.0 or lens[13] != 0.0:
        w = lens[20] * xd + lens[21] * yd + lens[22]
        return (
            (lens[14] * xd + lens[15] * yd + lens[16]) / w,
            (lens[17] * xd + lens[18] * yd + lens[19]) / w,
        )
    return xd, yd


@compiled
def jacobian(x: float, y: float, lens: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Return d(xd)/dx, d(xd)/dy, d(yd)/dx, d(yd)/dy of :func:`distort` at (x, y)."""
    r2 = x * x + y * y
    n = 1 + ((lens[4] * r2 + lens[1]) * r2 + lens[0]) * r2
    d = 1 + ((lens[7] * r2 + lens[6]) * r2 + lens[5]) * r2
    dn = (3 * lens[4] * r2 + 2 * lens[1]) * r2 + lens[0]
    dd = (3 * lens[7] * r2 + 2 * lens[6]) * r2 + lens[5]
    radial = n / d
    slope = 2 * (dn * d - n * dd) / (d * d)
    prism_x = 2 * (2 * lens[9] * r2 + lens[8])
    prism_y = 2 * (2 * lens[11] * r2 + lens[10])
    a = radial + slope * x * x + 2 * lens[2] * y + 6 * lens[3] * x + prism_x * x
    b = slope * x * y + 2 * lens[2] * x + 2 * lens[3] * y + prism_x * y
    c = slope * x * y + 2 * lens[2] * x + 2 * lens[3] * y + prism_y * x
    e = radial + slope * y * y + 6 * lens[2] * y + 2 * lens[3] * x + prism_y * y
    if lens[12] != 0.0 or lens[13] != 0.0:
        xd, yd = _upright(x, y, lens)
        w = lens[20] * xd + lens[21] * yd + lens[22]
        u = (lens[14] * xd + lens[15] * yd + lens[16]) / w
        v = (lens[17] * xd + lens[18] * yd + lens[19]) / w
        ux, uy = (lens[14] - u * lens[20]) / w, (lens[15] - u * lens[21]) / w
        vx, vy = (lens[17] - v * lens[20]) / w, (lens[18] - v * lens[21]) / w
        return ux * a + uy * c, ux * b + uy * e, vx * a + vy * c, vx * b + vy * e
    return a, b, c, e


@compiled
def undistort(xd: float, yd: float, lens: NDArray[np.float64]) -> tuple[float, float, bool]:
    """Return (x, y, converged) with distort(x, y) = (xd, yd) inside the fold, by Newton's method.

    ``converged`` is False if no such point was reached: the pixel lies outside the lens' image.
    """
    if lens[12] != 0.0 or lens[13] != 0.0:
        # Start from the point before the sensor's tilt: solve the 2x2 system of its homography.
        a, b = lens[14] - xd * lens[20], lens[15] - xd * lens[21]
        c, d = lens[17] - yd * lens[20], lens[18] - yd * lens[21]
        e, f = xd * lens[22] - lens[16], yd * lens[22] - lens[19]
        determinant = a * d - b * c
        x, y = (e * d - b * f) / determinant, (a * f - e * c) / determinant
    else:
        x, y = xd, yd
    radius = math.hypot(x, y)
    if radius >= lens[23]:
        shrink = 0.5 * lens[23] / radius
        x, y = x * shrink, y * shrink
    # Tangential terms may fold inside that radius: start nearer to the centre, before they do.
    a, b, c, d = jacobian(x, y, lens)
    for _ in range(60):
        if a * d - b * c > 0.0:
            break
        x, y = 0.5 * x, 0.5 * y
        a, b, c, d = jacobian(x, y, lens)
    u, v = distort(x, y, lens)
    for _ in range(60):
        determinant = a * d - b * c
        if not determinant > 0.0:
            return x, y, False
        miss = math.hypot(xd - u, yd - v)
        dx = ((xd - u) * d - b * (yd - v)) / determinant
        dy = (a * (yd - v) - c * (xd - u)) / determinant
        if abs(dx) + abs(dy) <= 4e-16 * (1.0 + abs(x) + abs(y)):
            return x + dx, y + dy, True
        # Near a fold the full step leaps out of the lens' image or over the fold: shorten it until
        # it helps.
        halvings = 0
        while halvings < 40:
            if math.hypot(x + dx, y + dy) < lens[23]:
                u, v = distort(x + dx, y + dy, lens)
                if math.hypot(xd - u, yd - v) < miss or miss < 1e-14:
                    a, b, c, d = jacobian(x + dx, y + dy, lens)
                    if a * d - b * c > 0.0:
                        break
            dx, dy = 0.5 * dx, 0.5 * dy
            halvings += 1
        if halvings == 40:
            return x, y, miss <= 1e-12
        x, y = x + dx, y + dy
    return x, y, math.hypot(xd - u, yd - v) <= 1e-12


@compiled
def undistort_points(
    points: NDArray[np.float64], lenses: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Undistort points (N, M, 2) through packed lenses (N, 24); NaN if there is no inverse."""
    undistorted = np.empty_like(points)
    for i in range(points.shape[0]):
        for j in range(points.shape[1]):
            x, y, converged = undistort(points[i, j, 0], points[i, j, 1], lenses[i])
            undistorted[i, j, 0] = x if converged else np.nan
            undistorted[i, j, 1] = y if converged else np.nan
    return undistorted


@compiled
def folds(corners: NDArray[np.float64], lenses: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return for each convex quadrilateral (N, 4, 2) whether the lens folds somewhere on it.

    A lens folds if its radial part stops growing or the Jacobian's determinant is not positive;
    the latter is evaluated on a 9x9 grid over the quadrilateral.
    """
    folded = np.zeros(corners.shape[0], dtype=np.bool_)
    for i in range(corners.shape[0]):
        lens = lenses[i]
        for j in range(4):
            # A convex quadrilateral's largest radius is at a corner.
            if not math.hypot(corners[i, j, 0], corners[i, j, 1]) < lens[23]:
                folded[i] = True
        for j in range(81):
            s, t = (j % 9) / 8.0, (j // 9) / 8.0
            weights = ((1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t)
            x = y = 0.0
            for corner in range(4):
                x += weights[corner] * corners[i, corner, 0]
                y += weights[corner] * corners[i, corner, 1]
            a, b, c, d = jacobian(x, y, lens)
            if not a * d - b * c > 0.0:
                folded[i] = True
    return folded
