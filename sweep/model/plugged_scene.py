"""What plug-ins add to scenes: effects and renderers, whose results are checked."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import PluginError
from sweep.model.effect import Effect, Patch
from sweep.model.effects import EFFECTS
from sweep.plugins.calls import call, real_numbers
from sweep.typing import Floats


@dataclass(frozen=True, slots=True)
class MarkerView:
    """The marker of one scene, as a plug-in's renderer draws it.

    Attributes
    ----------
    modules
        (m, m) whether a module of the marker is white; row 0 is the marker's top.
    quiet_zone_modules, black, white
        Width of the white border beyond them in modules, and the grey levels.
    plane
        (3, 3) takes module coordinates (column, row, 1), which start at the top left corner of
        `modules`, to the camera frame in metres.
    camera_matrix
        (3, 3) as OpenCV has it; the centre of the frame's first pixel is (0, 0).
    distortion
        (14,) lens coefficients in OpenCV's order; None without a lens.
    box
        Left, top, right, bottom of the pixels that the marker may touch, half-open.
    values
        Each of the plug-in's settings in this scene.
    """

    modules: NDArray[np.bool_]
    quiet_zone_modules: float
    black: float
    white: float
    plane: Floats
    camera_matrix: Floats
    distortion: Floats | None
    box: tuple[int, int, int, int]
    values: Mapping[str, float]

    @property
    def homography(self) -> Floats:
        """(3, 3) takes module coordinates to pixels; ValueError with a lens."""
        if self.distortion is not None:
            raise ValueError("this renderer has no lens: expected distortion = []")
        return np.asarray(self.camera_matrix @ self.plane)


Render = Callable[[MarkerView], tuple[Floats, Floats]]
"""A renderer: levels and shares (h, w) each."""


@dataclass(frozen=True, slots=True)
class ScenePlugins:
    """The plug-ins of scenes.

    Attributes
    ----------
    effects
        In the order in which they act, after the built-in ones of their step.
    renderers
        By the name that pipelines have.
    settings
        Names of the renderers' settings.
    """

    effects: tuple[Effect, ...] = ()
    renderers: Mapping[str, Render] = field(default_factory=dict)
    settings: tuple[str, ...] = ()

    @property
    def all_effects(self) -> tuple[Effect, ...]:
        """The built-in effects, and those of plug-ins."""
        return (*EFFECTS, *self.effects)


NO_PLUGINS = ScenePlugins()


def checked_effect(
    name: str, apply: Callable[[Any, Any], Any]
) -> Callable[[Floats, Patch], Floats]:
    """Return an effect's function that raises PluginError for results that are no levels."""

    def applied(levels: Floats, patch: Patch) -> Floats:
        returned = real_numbers(name, "levels", call(name, apply, levels.copy(), patch))
        return _checked(name, "levels", returned, levels.shape)

    return applied


def checked_renderer(name: str, render: Callable[[Any], Any]) -> Render:
    """Return a renderer that raises PluginError for results that are no levels and shares."""

    def rendered(view: MarkerView) -> tuple[Floats, Floats]:
        left, top, right, bottom = view.box
        returned = call(name, render, view)
        if not isinstance(returned, tuple) or len(returned) != 2:
            raise PluginError(
                f"{name}: returned a {type(returned).__name__}; expected a tuple (levels, share)"
            )
        shape = (bottom - top, right - left)
        levels, share = (
            _checked(name, what, real_numbers(name, what, each), shape)
            for what, each in zip(("levels", "share"), returned, strict=True)
        )
        if ((share < 0) | (share > 1)).any():
            raise PluginError(f"{name}: returned shares outside 0 to 1")
        return levels, share

    return rendered


def _checked(name: str, what: str, array: Floats, shape: tuple[int, ...]) -> Floats:
    if array.shape != shape:
        raise PluginError(f"{name}: returned {what} of shape {array.shape}; expected {shape}")
    if not np.isfinite(array).all():
        raise PluginError(f"{name}: returned {what} that are not finite")
    return array
