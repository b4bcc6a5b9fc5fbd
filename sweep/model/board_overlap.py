"""Whether squares in one plane overlap."""

from __future__ import annotations

import numpy as np

from sweep.typing import Floats, Masks

TOUCHING = 1e-9
"""Share of a side by which squares may overlap and still count as touching: rounding."""


def first_overlap(centres: Floats, sides: Floats, rolls_rad: Floats) -> tuple[int, int] | None:
    """Return the first two of n squares that overlap, or None.

    ``centres`` (n, 2), ``sides`` and ``rolls_rad`` (n,). Two convex shapes are disjoint if and only
    if a line parallel to a side of one of them separates them (separating axis theorem).
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415  (slow to import, and boards alone need it)

    pairs = cKDTree(centres).query_pairs(float(sides.max()) * np.sqrt(2), output_type="ndarray")
    if not len(pairs):
        return None
    pairs = pairs[np.lexsort(pairs.T[::-1])]
    first, other = pairs.T
    separation = np.full(len(pairs), -np.inf)
    between = centres[other] - centres[first]
    turn = rolls_rad[other] - rolls_rad[first]
    # Half the width of a square of side 1 across a direction at an angle to its sides.
    half_width = (np.abs(np.cos(turn)) + np.abs(np.sin(turn))) / 2
    for own, foreign in ((first, other), (other, first)):
        for quarter in (0.0, np.pi / 2):
            angle = rolls_rad[own] + quarter
            along = between[:, 0] * np.cos(angle) + between[:, 1] * np.sin(angle)
            reach = sides[own] / 2 + sides[foreign] * half_width
            separation = np.maximum(separation, np.abs(along) - reach)
    overlapping = separation < -TOUCHING * np.minimum(sides[first], sides[other])
    if not overlapping.any():
        return None
    i, j = pairs[np.argmax(overlapping)].tolist()
    return i, j


def sheets_overlap(one: Floats, others: Floats) -> Masks:
    """Return (n,) which of n rectangles (n, 4, 3) overlap another (4, 3) in its plane.

    By the separating axis theorem, as :func:`first_overlap`; those in other planes do not.
    """
    sides = np.stack([one[1] - one[0], one[3] - one[0]])
    other_sides = np.stack([others[:, 1] - others[:, 0], others[:, 3] - others[:, 0]], axis=1)
    side = np.linalg.norm(sides, axis=1).min()
    normal = np.cross(*sides) / np.linalg.norm(np.cross(*sides))
    coplanar = (np.abs((others - one[0]) @ normal) <= TOUCHING * side).all(axis=1)
    separation = np.full(len(others), -np.inf)
    for along in (*(np.broadcast_to(each, (len(others), 3)) for each in sides),
                  other_sides[:, 0], other_sides[:, 1]):
        axis = along / np.linalg.norm(along, axis=1)[:, None]
        a = axis @ one.T
        b = np.einsum("ni,nki->nk", axis, others)
        gap = np.maximum(b.min(axis=1) - a.max(axis=1), a.min(axis=1) - b.max(axis=1))
        separation = np.maximum(separation, gap)
    return np.asarray(coplanar & (separation < -TOUCHING * side))
