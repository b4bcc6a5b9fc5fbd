"""Parameters that say the same in different ways: one of the ways is given, not two."""

from __future__ import annotations

from collections.abc import Collection

from sweep.plan.parameters import PARAMETERS

WORLD = tuple(
    f"{whose}_{name}" for whose in ("camera", "marker")
    for name in ("x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg")
)
"""Parameters that place the camera and the marker in the world."""

IN_CAMERA = tuple(
    p.name for p in PARAMETERS.values()
    if p.section == "pose" and p.name not in (*WORLD, "jitter_px")
)
"""Parameters that place the marker in the camera's frame."""


CHOICES: tuple[tuple[tuple[str, ...], ...], ...] = (
    (("distance_m",), ("side_px",)),
    (("bearing_x_deg",), ("x_m",), ("frame_x",)),
    (("bearing_y_deg",), ("y_m",), ("frame_y",)),
    (("tilt_deg",), ("view_angle_deg",), ("yaw_deg", "pitch_deg")),
    (("azimuth_deg",), ("yaw_deg", "pitch_deg")),
)
"""The ways, each of one or more parameters, in which a part of a pose is given in the camera's
frame: one of them, not two."""

PHOTOGRAPHS = "photographs"
"""The parameter that takes poses and images from a record of photographs."""

SIMULATED = "simulated"
"""The parameter that takes from such a record the poses alone."""

RIVALS: dict[str, frozenset[str]] = {
    name: frozenset(
        other for ways in CHOICES for way in ways
        if name not in way and any(name in each for each in ways) for other in way
    )
    for name in IN_CAMERA
}
"""Parameter of a pose in the camera's frame -> those of the other ways.

>>> sorted(RIVALS["yaw_deg"])
['azimuth_deg', 'tilt_deg', 'view_angle_deg']
"""


def superseded(given: Collection[str]) -> set[str]:
    """Return the parameters of a pose that have no meaning beside those that are given.

    >>> sorted(superseded({"view_angle_deg", "distance_m"}))
    ['pitch_deg', 'side_px', 'tilt_deg', 'yaw_deg']
    """
    if PHOTOGRAPHS in given:
        return {*IN_CAMERA, *WORLD, "jitter_px"}
    if any(name in given for name in WORLD):
        return set(IN_CAMERA)
    return {rival for name in given for rival in RIVALS.get(name, ())}


def contradictions(given: Collection[str]) -> list[tuple[str, str]]:
    """Return pairs of given parameters of which only one can be, for each quantity.

    >>> contradictions({"x_m", "bearing_x_deg", "tilt_deg"})
    [('bearing_x_deg', 'x_m')]
    """
    pairs = []
    for choice in CHOICES:
        ways = [[name for name in way if name in given] for way in choice]
        first, *others = [names[0] for names in ways if names] or [""]
        pairs += [(first, other) for other in others]
    return pairs
