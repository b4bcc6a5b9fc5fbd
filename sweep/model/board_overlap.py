"""Whether squares in one plane overlap."""

from __future__ import annotations

import numpy as np

from sweep.typing import Floats

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
