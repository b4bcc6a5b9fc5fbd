"""Whether a scene that is computed again gives what a store holds.

On a processor with the same features every bit agrees. On another one, OpenCV, NumPy and the
mathematical library take other routines, and last bits differ; the tolerances below were measured
on 9,000 scenes with AVX-512, AVX2 and all of AVX switched off in each: without AVX, 0.02 % of
ordinary scenes, and at most 4.4 % of those of a pipeline of extremes, lie beyond them, because a
last bit can decide between two minima.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.model.pose import rotation_of_vector
from sweep.plan.schema import SCHEMA

Values = Mapping[str, NDArray[Any]]

TRUTH = 1e-12
"""Relative, of the true pose (of its length) and of the marker's area."""

BOUND = 1e-6
"""Relative, of the bound's numbers."""

CORNER_PX = 1e-2
"""Also of the reprojection error."""

ROTATION_RAD = 1e-4

TRANSLATION = 1e-4
"""Relative to the marker's distance."""

MAX_OUTSIDE = 0.1
"""Share of the scenes computed on another processor that may lie outside; two always may."""


def difference(here: Values, there: Values) -> str:
    """Return the first variable in which a scene's values differ by a bit; empty where in none."""
    for variable in SCHEMA:
        a, b = here[variable.name], there[variable.name]
        differ = ~((a == b) | (_nan(a) & _nan(b)))
        if differ.any():
            return f"{variable.name} {a[differ][0]:.9g}, stored {b[differ][0]:.9g}"
    return ""


def departure(here: Values, there: Values) -> str:
    """Return in what a scene's truth or bound lies outside the tolerances; empty where in nothing.

    No scene's may, on whatever processor.
    """
    for name in ("true_rvec", "true_tvec_m"):
        a, b = here[name], there[name]
        length = np.linalg.norm(b, axis=-1, keepdims=True)
        if not (_nan(a) & _nan(b) | (np.abs(a - b) <= TRUTH * length)).all():
            return name
    if not np.array_equal(here["bound"], there["bound"]):
        return "bound"
    for name, tolerance in (
        ("marker_area_px", TRUTH), ("bound_std", BOUND), ("bound_kappa", BOUND),
        ("mirror_distance", BOUND),
    ):
        if not np.allclose(here[name], there[name], rtol=tolerance, atol=0, equal_nan=True):
            return name
    return ""


def outside(here: Values, there: Values) -> str:
    """Return in what a scene's results lie outside the tolerances; empty where in nothing."""
    for name in ("detection", "estimate"):
        if not np.array_equal(here[name], there[name]):
            return name
    for name in ("corner_error_px", "reprojection_error_px"):
        if not np.allclose(here[name], there[name], rtol=0, atol=CORNER_PX, equal_nan=True):
            return name
    moved = here["translation_error_m"].astype(float) - there["translation_error_m"]
    distance = np.linalg.norm(there["true_tvec_m"])
    if (np.linalg.norm(moved, axis=-1) > TRANSLATION * distance).any():
        return "translation_error_m"
    turned = [
        rotation_of_vector(values["rotation_error_rad"].astype(float).reshape(-1, 3))
        for values in (here, there)
    ]
    # The norm of the difference of two rotations is sqrt(8) times the sine of half their angle.
    apart = np.linalg.norm(turned[0] - turned[1], axis=(1, 2)) / np.sqrt(2)
    if (apart > ROTATION_RAD).any():
        return "rotation_error_rad"
    return ""


def _nan(values: NDArray[Any]) -> NDArray[np.bool_]:
    return np.asarray(values != values)  # noqa: PLR0124  (also of integers)
