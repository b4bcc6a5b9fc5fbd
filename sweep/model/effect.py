"""What an effect declares, and the pixels that pointwise effects are applied to."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from typing import Any, Literal

import numpy as np

from sweep.model.sensor import standard_normals
from sweep.typing import Floats


@dataclass(frozen=True, slots=True)
class Patch:
    """The pixels of one scene that a pointwise effect is applied to.

    Attributes
    ----------
    values
        Every parameter of the effects in this scene; NaN if it is not given. Of text and lists
        the number of the value, 0 for the default.
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
        standard_normals(self.stream_key(stream), 0, self.left, self.top, normals)
        return normals

    def stream_key(self, stream: str) -> np.uint64:
        """Return the key of a stream of random numbers of this scene."""
        own = int.from_bytes(sha256(stream.encode()).digest()[:8], "little")
        return np.uint64(self.noise_key ^ np.uint64(own))


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
    worsens
        What it makes worse for the search of windows, where another effect brings it: coarse noise
        needs twice the margin of noise, steep uneven light the whole frame.
    apply
        Of a pointwise effect: a function of levels (h, w) and their :class:`Patch` that returns
        the levels after it. Applied at its ``step``, "light" or "signal", after the built-in
        effects of that step, in the order of :data:`sweep.model.effects.EFFECTS`. None for the
        built-in effects, which renderers and :mod:`sweep.model.sensing` apply.
    """

    label: str
    step: Literal["edges", "light", "signal", "readout"]
    parameters: Mapping[str, Any]
    needs: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    random: bool = False
    in_bound: bool = False
    widens: Literal["nothing", "noise", "uneven light"] = "nothing"
    worsens: tuple[Literal["noise", "uneven light"], ...] = ()
    apply: Callable[[Floats, Patch], Floats] | None = None

    @property
    def switch(self) -> str:
        """The parameter that switches it on."""
        return next(iter(self.parameters))

    @property
    def off(self) -> Any:
        """The value of its switch at which it is absent."""
        return self.parameters[self.switch].default

    @property
    def off_text(self) -> str:
        """The value at which it is absent, in words."""
        if self.off is None:
            return "not given"
        if self.off == ():
            return "[]"
        return self.off if isinstance(self.off, str) else f"{self.off:g}"

    def is_on(self, value: Any) -> bool:
        """Return whether its switch has another value than its neutral one."""
        return bool(value != self.off)

    def is_active(self, strength: Any) -> Any:
        """Return whether it is on: numbers (...) as scenes hold them, NaN if not given."""
        if self.off is None:
            return ~np.isnan(strength)
        return strength != (0 if is_coded(self.off) else self.off)

    def applying(self, apply: Callable[[Floats, Patch], Floats]) -> Effect:
        """Return it as a pointwise effect."""
        return dataclasses.replace(self, apply=apply)


def is_coded(default: Any) -> bool:
    """Return whether scenes hold a parameter as the number of its value: it is text, or a list.

    Number 0 is the default.
    """
    return isinstance(default, (str, tuple))


def apply_pointwise(
    effects: Sequence[Effect], step: str, levels: Floats, patch: Patch
) -> Floats:
    """Return levels (h, w) after the active ones of pointwise effects, those of a step."""
    for effect in effects:
        if effect.step == step and effect.is_active(patch.values[effect.switch]):
            assert effect.apply is not None  # noqa: S101  (for the type checker)
            levels = effect.apply(levels, patch)
    return levels
