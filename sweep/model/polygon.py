"""Polygons: their areas, and what a half plane leaves of them."""

from __future__ import annotations

import numpy as np

from sweep.typing import Floats


def signed_areas(points: Floats) -> Floats:
    """Return the signed areas (N,) of polygons (N, M, 2)."""
    local = points - points[:, :1]
    following = np.roll(local, -1, axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        doubled = local[..., 0] * following[..., 1] - local[..., 1] * following[..., 0]
        return np.asarray(0.5 * doubled.sum(axis=1))


def half_plane(polygon: Floats, inside: Floats) -> Floats:
    """Clip a polygon (M, D) to the half space in which a linear function is not negative.

    ``inside`` (M,) are the function's values at the polygon's points.
    """
    kept = []
    for i in range(len(polygon)):
        j = (i + 1) % len(polygon)
        if inside[i] >= 0:
            kept.append(polygon[i])
        if (inside[i] >= 0) != (inside[j] >= 0):
            t = inside[i] / (inside[i] - inside[j])
            kept.append(polygon[i] + t * (polygon[j] - polygon[i]))
    return np.array(kept).reshape(-1, polygon.shape[1])
