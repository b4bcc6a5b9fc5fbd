"""The effects of camera and surroundings on the ideal image: one record for each.

An effect is absent, at no cost, unless its switch has another value than its neutral one. Its
record in :data:`EFFECTS` is the only place that declares it; parameters of pipeline files, their
checks, the list of active parts, random draws, the bound and the windows follow from it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from typing import Any, Literal

import numpy as np

from sweep.declaration import parameter
from sweep.model.sensor import standard_normals
from sweep.typing import Floats

VELOCITIES = (
    "velocity_x_m_s", "velocity_y_m_s", "velocity_z_m_s",
    "rotation_x_deg_s", "rotation_y_deg_s", "rotation_z_deg_s",
)


@dataclass(frozen=True, slots=True)
class Patch:
    """The pixels of one scene that a pointwise effect is applied to.

    Attributes
    ----------
    values
        Every parameter of the effects in this scene; NaN if it is not given.
    left, top
        The first pixel's column and row in the frame.
    frame
        Width and height of the frame in pixels.
    intrinsics
        (4,) fx, fy, cx, cy in pixels.
    noise_key
        Key of the scene's random numbers.
    """

    values: Mapping[str, float]
    left: int
    top: int
    frame: tuple[int, int]
    intrinsics: Floats
    noise_key: np.uint64

    def normals(self, stream: str, shape: tuple[int, ...]) -> Floats:
        """Return standard normal numbers (h, w), a function of scene, stream and pixel alone.

        ``stream`` is a name of the effect's own, such as its switch. Whatever window is rendered,
        a pixel of the frame has the same number.
        """
        normals = np.empty(shape)
        own = np.uint64(int.from_bytes(sha256(stream.encode()).digest()[:8], "little"))
        standard_normals(self.noise_key ^ own, self.left, self.top, normals)
        return normals


@dataclass(frozen=True, slots=True)
class Effect:
    """One effect.

    Attributes
    ----------
    label
        Its name in ``sweep plan`` and in tables.
    step
        The step of the image chain on which it acts. "edges": on the marker's edges, before
        pixels (only the renderer ``exact`` has these effects); "light": on the levels of light
        that falls on the pixels; "signal": on the pixels' signal, with its noise and gain, before
        quantisation; "readout": on quantisation.
    parameters
        Its parameters by name, as :func:`sweep.declaration.parameter` declares them. The
        first is its switch: the effect is active if that has another value than its default.
    needs
        Parameter -> parameters of which one must be given beside it.
    random
        Whether it draws random numbers.
    in_bound
        Whether the accuracy bound's model of the image has it.
    widens
        Whether more than the usual window must be searched: "noise" makes candidates around the
        marker that reach into one another, "uneven light" makes candidates of a plain background.
    apply
        Of a pointwise effect: a function of levels (h, w) and their :class:`Patch` that returns
        the levels after it. Applied at its ``step``, "light" or "signal", after the built-in
        effects of that step, in the order of :data:`EFFECTS`. None for the built-in effects, which
        renderers, :func:`sweep.model.sensor.illuminate` and :func:`sweep.model.sensor.read_out`
        apply in one pass.
    """

    label: str
    step: Literal["edges", "light", "signal", "readout"]
    parameters: Mapping[str, Any]
    needs: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    random: bool = False
    in_bound: bool = False
    widens: Literal["nothing", "noise", "uneven light"] = "nothing"
    apply: Callable[[Floats, Patch], Floats] | None = None

    @property
    def switch(self) -> str:
        """The parameter that switches it on."""
        return next(iter(self.parameters))

    @property
    def off(self) -> Any:
        """The value of its switch at which it is absent."""
        return self.parameters[self.switch].default

    def is_on(self, value: Any) -> bool:
        """Return whether its switch has another value than its neutral one."""
        return bool(value != self.off)

    def is_active(self, strength: Any) -> Any:
        """Return whether it is on: numbers (...) as scenes hold them, NaN if not given."""
        return ~np.isnan(strength) if self.off is None else strength != self.off

    def applying(self, apply: Callable[[Floats, Patch], Floats]) -> Effect:
        """Return it as a pointwise effect."""
        return dataclasses.replace(self, apply=apply)


EFFECTS: tuple[Effect, ...] = (
    Effect(
        "occlusion", "edges",
        {
            "occlusion": parameter(
                0.0, "share of the black square's extent that a sheet with a straight edge hides; "
                "it lies on the marker and also hides the quiet zone on its side", low=0, high=1,
                drawable=True,
            ),
            "occlusion_deg": parameter(
                0.0, "side that the sheet comes from, in the marker's plane: 0 its right, 90 its "
                "top", unit="degree", low=-360, high=360, drawable=True,
            ),
            "occluder": parameter(
                128.0, "level of the sheet", unit="grey level", low=0, high=255, drawable=True
            ),
        },
    ),
    Effect(
        "uneven light", "light",
        {
            "illumination_gradient": parameter(
                0.0, "change of the light across the frame's width, relative to its centre",
                low=-2, high=2, drawable=True,
            ),
            "illumination_deg": parameter(
                0.0, "direction in which the light grows: 0 right, 90 down", unit="degree",
                low=-360, high=360, drawable=True,
            ),
        },
        widens="uneven light",
    ),
    Effect(
        "motion blur", "edges",
        {
            "exposure_s": parameter(
                0.0, "exposure time: the image is the mean over it; the true pose is that in its "
                "middle", unit="s", low=0, high=1e6, drawable=True,
            ),
        },
        needs={"exposure_s": VELOCITIES},
    ),
    Effect(
        "rolling shutter", "edges",
        {
            "row_time_s": parameter(
                0.0, "rolling shutter: time from one row's exposure to the next's; the true pose "
                "is that at the middle row's", unit="s", low=0, high=1e6, drawable=True,
            ),
            # The velocities are those of both effects of motion.
            "velocity_x_m_s": parameter(
                0.0, "velocity of the marker's centre, right", unit="m/s", low=-1e9, high=1e9,
                drawable=True,
            ),
            "velocity_y_m_s": parameter(
                0.0, "velocity of the marker's centre, down", unit="m/s", low=-1e9, high=1e9,
                drawable=True,
            ),
            "velocity_z_m_s": parameter(
                0.0, "velocity of the marker's centre, away from the camera", unit="m/s",
                low=-1e9, high=1e9, drawable=True,
            ),
            "rotation_x_deg_s": parameter(
                0.0, "angular velocity about the axis through the marker's centre that points "
                "right", unit="degree/s", low=-1e9, high=1e9, drawable=True,
            ),
            "rotation_y_deg_s": parameter(
                0.0, "angular velocity about the axis through the marker's centre that points "
                "down", unit="degree/s", low=-1e9, high=1e9, drawable=True,
            ),
            "rotation_z_deg_s": parameter(
                0.0, "angular velocity about the axis through the marker's centre that points "
                "forward", unit="degree/s", low=-1e9, high=1e9, drawable=True,
            ),
        },
        needs={
            "row_time_s": VELOCITIES,
            **dict.fromkeys(VELOCITIES, ("exposure_s", "row_time_s")),
        },
    ),
    Effect(
        "optical blur", "edges",
        {
            "blur_px": parameter(
                0.0, "standard deviation of the lens' Gaussian point spread", unit="px", low=0,
                high=1000, drawable=True,
            ),
        },
        in_bound=True,
    ),
    Effect(
        "defocus", "edges",
        {
            "aperture_mm": parameter(
                None, "diameter of the lens' opening: defocus adds a quarter of the circle of "
                "confusion's diameter to the point spread, in quadrature, at each depth",
                unit="mm", low=0, high=1e6, open_low=True, drawable=True,
            ),
            "focus_distance_m": parameter(
                None, "depth at which the image is sharp", unit="m", low=0, open_low=True,
                drawable=True,
            ),
        },
        needs={
            "aperture_mm": ("focus_distance_m",), "focus_distance_m": ("aperture_mm",),
        },
    ),
    Effect(
        "vignetting", "light",
        {
            "vignetting": parameter(
                0.0, "power of the cosine of a pixel's angle to the optical axis by which its "
                "light falls off; 4 is the natural law", low=0, high=100, drawable=True,
            ),
        },
        widens="uneven light",
    ),
    Effect(
        "shot noise", "signal",
        {
            "full_well_e": parameter(
                None, "electrons that a pixel holds, at level 255 and gain 1; the shot noise is "
                "theirs", unit="e-", low=1, high=1e9, drawable=True,
            ),
            "read_noise_e": parameter(
                0.0, "standard deviation of the read noise", unit="e-", low=0, high=1e9,
                drawable=True,
            ),
        },
        needs={"read_noise_e": ("full_well_e",)}, random=True, widens="noise",
    ),
    Effect(
        "gain", "signal",
        {
            "gain": parameter(
                1.0, "factor on the signal and its noise, before it is quantised", low=0,
                high=1e6, open_low=True, drawable=True,
            ),
        },
        in_bound=True,
    ),
    Effect(
        "grey noise", "signal",
        {
            "noise_grey": parameter(
                0.0, "standard deviation of plain Gaussian noise on the grey levels",
                unit="grey level", low=0, high=1e6, drawable=True,
            ),
        },
        random=True, in_bound=True, widens="noise",
    ),
    Effect(
        "bit depth", "readout",
        {
            "bit_depth": parameter(
                8, "bits to which the levels 0 to 255 are quantised, clipped; OpenCV gets them "
                "rounded to 8", unit="bit", low=8, high=16,
            ),
        },
    ),
)
"""Every effect, in physical order."""


def _declared() -> dict[str, Any]:
    """Return every parameter of the effects."""
    declared: dict[str, Any] = {}
    for effect in EFFECTS:
        for name, declaration in effect.parameters.items():
            if name in declared:
                raise TypeError(f"parameter {name} is declared by two effects")
            declared[name] = declaration
        if effect.apply is not None and effect.step not in ("light", "signal"):
            raise TypeError(f"effect {effect.label}: pointwise effects act on light or signal")
    return declared


Effects: type = dataclasses.make_dataclass(
    "Effects",
    [
        (name, float | None if each.default is None else type(each.default), each)
        for name, each in _declared().items()
    ],
    frozen=True,
)
"""The parameters of all effects as a dataclass, as those of camera, marker and pose are."""

NEUTRAL: dict[str, Any] = {name: each.default for name, each in _declared().items()}
"""Every parameter of the effects at its default: no effect is active."""

SWITCHES: dict[str, Any] = {effect.switch: effect.off for effect in EFFECTS}
"""Parameters that switch an effect on -> the value at which it is absent."""

GEOMETRIC = tuple(effect.switch for effect in EFFECTS if effect.step == "edges")
"""Switches of the effects that only the ``exact`` renderer has."""

RANDOM = tuple(effect.switch for effect in EFFECTS if effect.random)
"""Switches of the effects that draw random numbers."""

IN_BOUND = tuple(effect.switch for effect in EFFECTS if effect.in_bound)
"""Switches of the effects that the accuracy bound models."""

NEEDS: dict[str, tuple[str, ...]] = {
    name: others for effect in EFFECTS for name, others in effect.needs.items()
}
"""Parameter -> parameters of which one must be given beside it."""

POINTWISE = tuple(effect for effect in EFFECTS if effect.apply is not None)
"""Effects that are applied by a function of their own."""


def apply_pointwise(
    effects: Sequence[Effect], step: str, levels: Floats, patch: Patch
) -> Floats:
    """Return levels (h, w) after the active ones of pointwise effects, those of a step."""
    for effect in effects:
        if effect.step == step and effect.is_active(patch.values[effect.switch]):
            assert effect.apply is not None  # noqa: S101  (for the type checker)
            levels = effect.apply(levels, patch)
    return levels
