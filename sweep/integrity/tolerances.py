"""Whether a recomputed scene agrees with the stored one.

On a processor with the same features every bit agrees. On another one, OpenCV, NumPy and the
mathematical library take other routines, and last bits differ; how far is the ``tolerance`` of
each variable in :mod:`sweep.plan.schema`, measured on 9,000 scenes with AVX-512, AVX2 and all of
AVX switched off in turn. Without AVX, 0.02 % of ordinary scenes, and at most 4.4 % of those of a
pipeline of extremes, lie outside them, because a last bit can decide between two minima.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.model.pose import rotation_of_vector
from sweep.plan.parameters import Stage
from sweep.plan.schema import SCHEMA
from sweep.plan.variable import Tolerance, Variable

Values = Mapping[str, NDArray[Any]]
"""Variable -> values of one scene, of its inner dimensions last."""

MAX_OUTSIDE = 0.1
"""Largest share of the scenes recomputed on another processor that may lie outside."""

MIN_OUTSIDE = 2
"""That many scenes may lie outside however few were recomputed."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """How a recomputed scene differs from the stored one; texts are empty if it does not.

    Attributes
    ----------
    departure
        The first variable that differs in a way in which no scene may: by a bit on a processor
        with the same features, beyond the tolerance of the truth or the bound on another one.
    outside
        The first variable of detection or estimation outside its tolerance: few scenes of another
        processor may.
    """

    departure: str = ""
    outside: str = ""

    @property
    def difference(self) -> str:
        """The departure, or else what lies outside."""
        return self.departure or self.outside


def compare(
    recomputed: Values, stored: Values, variables: Sequence[Variable] = SCHEMA, *,
    same_processor: bool,
) -> Comparison:
    """Compare a recomputed scene with the stored one, in the variables that both have.

    Parameters
    ----------
    recomputed, stored
        The values by variable, of the same shapes. A tolerance of the kind "distance" needs
        ``true_tvec_m`` among the stored ones.
    variables
        Those that are compared, in this order.
    same_processor
        Whether both were computed by the same versions on processors with the same features, so
        that every bit must agree.

    Examples
    --------
    >>> stored = {"reprojection_error_px": np.array([0.2], dtype="f4")}
    >>> recomputed = {"reprojection_error_px": np.array([0.201], dtype="f4")}
    >>> compare(recomputed, stored, same_processor=False).difference
    ''
    >>> compare(recomputed, stored, same_processor=True).difference
    'reprojection_error_px 0.201000005, stored 0.200000003'
    """
    outside = ""
    for variable in variables:
        if variable.name not in recomputed or variable.name not in stored:
            continue
        ours, theirs = recomputed[variable.name], stored[variable.name]
        if same_processor:
            differ = ~_same(ours, theirs)
        elif variable.tolerance is None:
            continue
        else:
            distance = np.linalg.norm(stored["true_tvec_m"]) if "true_tvec_m" in stored else 0.0
            differ = _beyond(variable.tolerance, ours, theirs, float(distance))
        if not differ.any():
            continue
        text = f"{variable.name} {ours[differ][0]:.9g}, stored {theirs[differ][0]:.9g}"
        if same_processor or variable.stage is Stage.scene:
            return Comparison(departure=text)
        outside = outside or text
    return Comparison(outside=outside)


def _same(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.bool_]:
    """Return where two arrays are equal or both NaN; also of integers."""
    return np.asarray((a == b) | ((a != a) & (b != b)))  # noqa: PLR0124  (NaN)


def _beyond(
    tolerance: Tolerance, recomputed: NDArray[Any], stored: NDArray[Any], distance_m: float
) -> NDArray[np.bool_]:
    """Return where recomputed values lie outside a tolerance, of the arrays' shape."""
    same = _same(recomputed, stored)
    if tolerance.kind == "equal":
        return ~same
    a, b = recomputed.astype(np.float64), stored.astype(np.float64)
    if tolerance.kind == "rotation":
        # The norm of the difference of two rotations is sqrt(8) times the sine of half their angle.
        turned = [rotation_of_vector(vector.reshape(-1, 3)) for vector in (a, b)]
        angle = np.linalg.norm(turned[0] - turned[1], axis=(1, 2)) / np.sqrt(2)
        within = (angle <= tolerance.limit).reshape(a.shape[:-1])[..., None]
    elif tolerance.kind == "distance":
        within = np.linalg.norm(a - b, axis=-1, keepdims=True) <= tolerance.limit * distance_m
    elif tolerance.kind == "length":
        length = np.linalg.norm(b, axis=-1, keepdims=True)
        within = np.abs(a - b) <= tolerance.limit * length
    elif tolerance.kind == "relative":
        within = np.abs(a - b) <= tolerance.limit * np.abs(b)
    else:
        within = np.abs(a - b) <= tolerance.limit
    return np.asarray(~(same | within))
