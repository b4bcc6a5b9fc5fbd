"""Kinds of errors of poses: what statistics are computed of, by name."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from operator import attrgetter

import numpy as np

from sweep.analysis.pose_view import ERROR_INPUTS, SIGNED_INPUTS, Poses, norm_squared
from sweep.errors import ArgumentError
from sweep.messages import nearest
from sweep.plan.variable import XYZ
from sweep.typing import Floats


@dataclass(frozen=True)
class Quantity:
    """A kind of error of poses.

    Attributes
    ----------
    name
        In the names of variables.
    unit
        As in names, such as ``deg``.
    units
        As in attributes, such as ``degree``.
    words
        As in meanings.
    vector
        The error vectors (..., components) of poses.
    bound
        The largest absolute error that exists; None if there is none.
    signed
        Whether it has a sign, and one component.
    inputs
        Names of the arrays that it reads, as in `sweep.analysis.pose_view.pose_arrays`.
    """

    name: str
    unit: str
    units: str
    words: str
    vector: Callable[[Poses], Floats]
    bound: float | None = None
    signed: bool = False
    inputs: tuple[str, ...] = ERROR_INPUTS

    def norm(self, poses: Poses) -> Floats:
        """Return the absolute errors (...)."""
        return np.sqrt(self.squares(poses)[..., 0])

    def squares(self, poses: Poses) -> Floats:
        """Return the squared absolute errors (..., 1)."""
        if self.name not in poses.squares:
            poses.squares[self.name] = norm_squared(self.vector(poses))[..., None]
        return poses.squares[self.name]

    def named(self, statistic: str) -> str:
        """Return a variable's name, such as ``rotation_p95_deg``."""
        return f"{self.name}_{statistic}_{self.unit}"


QUANTITIES = (
    Quantity("rotation", "deg", "degree", "rotation error", lambda poses: poses.rotation_deg,
             bound=180.0),
    Quantity("range", "percent", "percent", "depth error of the true depth",
             lambda poses: poses.range_percent, signed=True),
    Quantity("position", "m", "m", "position error", lambda poses: poses.position_m),
)
"""What `sweep.analysis.error_statistics` is of unless it is asked for others."""


def _component(
    name: str, source: str, k: int | None, words: str, unit: str = "m", units: str = "m"
) -> Quantity:
    """Return the k-th component of an array of `SignedErrors`, or the array itself."""
    errors = attrgetter(f"signed.{source}")

    def vector(poses: Poses) -> Floats:
        values = errors(poses)
        return np.asarray(values[..., None] if k is None else values[..., k : k + 1])

    return Quantity(name, unit, units, words, vector, signed=True, inputs=SIGNED_INPUTS)


def _angle(name: str, source: str, k: int | None, words: str) -> Quantity:
    return _component(name, source, k, words, "deg", "degree")


SIGNED: dict[str, tuple[Quantity, ...]] = {
    "camera_frame": tuple(
        _component(axis, "in_camera_m", k, f"position error along {axis} of the camera")
        for k, axis in enumerate(XYZ)),
    "marker_frame": tuple(
        _component(f"marker_frame_{axis}", "along_marker_m", k,
                   f"position error along {axis} of the true marker")
        for k, axis in enumerate(XYZ)),
    "camera_in_marker": tuple(
        _component(f"camera_in_marker_{axis}", "of_camera_m", k,
                   f"error of the camera's {axis} in the marker's frame")
        for k, axis in enumerate(XYZ)),
    "yaw_pitch_roll": tuple(
        _angle(name, "yaw_pitch_roll_deg", k, f"{name} error")
        for k, name in enumerate(("yaw", "pitch", "roll"))),
    "angles": (
        _angle("tilt", "tilt_deg", None, "error of the angle to the image plane"),
        _angle("viewing_angle", "viewing_angle_deg", None,
               "error of the angle between normal and line of sight"),
        _angle("in_plane", "in_plane_deg", None, "rotation error about the true normal"),
    ),
}
"""Errors with a sign, by groups: of these bias and standard deviation are computed."""


def chosen_quantities(names: Iterable[str] | None) -> list[Quantity]:
    """Return the quantities of some names of quantities or groups, each once; default `QUANTITIES`.

    Raises
    ------
    ArgumentError
        For a name that is neither, or none at all.

    Examples
    --------
    >>> [quantity.name for quantity in chosen_quantities(["range", "yaw_pitch_roll", "yaw"])]
    ['range', 'yaw', 'pitch', 'roll']
    """
    if names is None:
        return list(QUANTITIES)
    known: dict[str, tuple[Quantity, ...]] = {each.name: (each,) for each in QUANTITIES}
    known |= {each.name: (each,) for group in SIGNED.values() for each in group} | SIGNED
    if isinstance(names, str):
        names = (names,)
    if not isinstance(names, Iterable) or not (wanted := list(names)):
        raise ArgumentError("quantities", names, f"expected some of {', '.join(known)}")
    for name in wanted:
        if name not in known:
            raise ArgumentError(
                "quantities", name,
                f"no such error{nearest(str(name), [*known])}; there are {', '.join(known)}")
    return list({each.name: each for name in wanted for each in known[name]}.values())
