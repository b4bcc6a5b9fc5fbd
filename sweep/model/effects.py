"""The effects of camera and surroundings on the ideal image: one record for each."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sweep.declaration import drawn, parameter
from sweep.errors import PluginError
from sweep.model import sensor
from sweep.plugins import Widens
from sweep.plugins.loading import call, real_numbers
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# Declarations of an effect, and the pixels that pointwise effects are applied to.

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

    values: Mapping[str, Any]
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
        sensor.standard_normals(self.stream_key(stream), 0, self.left, self.top, normals)
        return normals

    def noise(self, key: np.uint64, draw: int, levels: Floats) -> Floats:
        """Return standard normal numbers for levels (h, w), correlated as the scene's noise is."""
        correlation = self.values["noise_correlation"]
        return sensor.normal_field(key, draw, self.left, self.top, levels.shape, correlation)

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
        that falls on the pixels; "signal": on the pixels' signal, with its noise and gain;
        "colour": on colour filters and their interpolation, which sharpening follows; "response":
        on the levels that the camera makes of it, before quantisation; "readout": on quantisation.
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
    outline
        Its change of the straight outline of a print at rest: "curved": bent, or shifted from
        point to point, as :func:`sweep.model.exposure.scene_sheet` says; "moving": it is where
        :meth:`sweep.model.scene.Scenes.motion` says; "covered": something covers the sheet.
    spread_px
        Standard deviation of the point spread that it adds, in px, by its parameters, the focal
        length in px and inverse depths (...) in 1/m; those of several add in quadrature. Printed
        edges reach so far beyond their place that their windows are widened by it.
    by_depth
        Whether that depends on depth: then each sheet and pixel has a point spread of its own.
    reach_px, block_px
        How far around a pixel it mixes pixels, and the side of the blocks, counted from the frame's
        corner, of which it changes all pixels: windows are widened by them.
    apply
        Of an effect from "light" to "response": a function of levels (h, w), which it leaves as
        they are, and their :class:`Patch` that returns the levels after it. Effects of a step are
        applied in the order of :data:`sweep.model.effects.EFFECTS`, then those of plug-ins; those
        that share a function are one.
    """

    label: str
    step: Literal["edges", "light", "signal", "colour", "response", "readout"]
    parameters: Mapping[str, Any]
    needs: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    random: bool = False
    in_bound: bool = False
    widens: Widens = "nothing"
    worsens: tuple[Literal["noise", "uneven light"], ...] = ()
    outline: Literal["kept", "curved", "moving", "covered"] = "kept"
    spread_px: Callable[[Mapping[str, float], float, Floats], Floats] | None = None
    by_depth: bool = False
    reach_px: int = 0
    block_px: int = 1
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
        words = {None: "not given", (): "[]"}.get(self.off, self.off)
        return words if isinstance(words, str) else f"{words:g}"

    def is_active(self, strength: Any) -> Any:
        """Return whether it is on: numbers (...) as scenes hold them, NaN if not given."""
        if self.off is None:
            return ~np.isnan(strength)
        return strength != (0 if is_coded(self.off) else self.off)


def is_coded(default: Any) -> bool:
    """Return whether scenes hold a parameter as the number of its value: it is text, or a list.

    Number 0 is the default.
    """
    return isinstance(default, (str, tuple))


def after_step(effects: Sequence[Effect], step: str, levels: Floats, patch: Patch) -> Floats:
    """Return levels (h, w) after those of active effects that belong to a step."""
    for apply in dict.fromkeys(each.apply for each in effects if each.step == step):
        levels = levels if apply is None else apply(levels, patch)
    return levels


# --------------------------------------------------------------------------------------------------
# The effects of camera and surroundings on the ideal image: one record for each.
#
# An effect is absent, at no cost, unless its switch has another value than its neutral one. Its
# record in :data:`EFFECTS` is the only place that declares it; parameters of pipeline files,
# their checks, random draws, the bound and the windows follow from it.

VELOCITIES = (
    "velocity_x_m_s", "velocity_y_m_s", "velocity_z_m_s",
    "rotation_x_deg_s", "rotation_y_deg_s", "rotation_z_deg_s",
)


def _defocus_px(values: Mapping[str, float], focal_px: float, inverse_depth: Floats) -> Floats:
    """Return the point spread of a thin lens.

    The circle of confusion has the diameter fx · aperture · |1/focus - 1/z| in pixels; a disk's
    standard deviation along an axis is a quarter of its diameter.
    """
    aperture_px = focal_px * values["aperture_mm"] * 1e-3
    return np.asarray(aperture_px * (1 / values["focus_distance_m"] - inverse_depth) / 4)


def _lit(levels: Floats, patch: Patch) -> Floats:
    """Return levels under uneven light: a gradient, never below 0, and vignetting.

    1 + slope · (pixel - middle of the frame), times a power of the cosine of the pixel's angle to
    the optical axis (the natural cos⁴ law: Born and Wolf, "Principles of optics", section 4.8.1).
    """
    width, height = patch.frame
    fx, fy, cx, cy = patch.intrinsics
    slope = patch.values["illumination_gradient"] / width
    turn = math.radians(patch.values["illumination_deg"])
    x = patch.left + np.arange(levels.shape[1])
    y = patch.top + np.arange(levels.shape[0])[:, None]
    light = 1.0 + slope * math.sin(turn) * (y - (height - 1) / 2)
    light = np.maximum(light + slope * math.cos(turn) * (x - (width - 1) / 2), 0.0)
    if patch.values["vignetting"] > 0:
        squared = 1.0 + ((x - cx) / fx) ** 2 + ((y - cy) / fy) ** 2
        light *= squared ** (-0.5 * patch.values["vignetting"])
    return np.asarray(levels * light)


def _exposed(levels: Floats, patch: Patch) -> Floats:
    """Return levels of electrons, with shot noise and read noise."""
    electrons = levels.copy()
    sensor.expose(
        electrons, patch.left, patch.top, patch.noise_key, patch.values["full_well_e"],
        patch.values["read_noise_e"],
    )
    return electrons


def _noisy(levels: Floats, patch: Patch) -> Floats:
    """Return levels with plain grey noise, which may be correlated."""
    noisy = patch.noise(patch.noise_key, sensor.GREY_NOISE_DRAW, levels)
    noisy *= patch.values["noise_grey"]
    noisy += levels
    return noisy


def _demosaiced(levels: Floats, patch: Patch) -> Floats:
    """Return levels seen through colour filters."""
    names = "bayer", "demosaic", "bayer_red", "bayer_blue"
    return sensor.demosaiced(levels, *(patch.values[name] for name in names))


def _toned(levels: Floats, patch: Patch) -> Floats:
    """Return the camera's response: toe, knee, then gamma."""
    toned = levels.copy()
    sensor.apply_tone(toned, *(patch.values[f"tone_{name}"] for name in ("gamma", "toe", "knee")))
    return toned


def _noisy_by_level(levels: Floats, patch: Patch) -> Floats:
    """Return levels with noise whose standard deviation is interpolated over the level."""
    table = patch.values["noise_table"]
    noise = patch.noise(patch.stream_key("noise_table"), 0, levels)
    return np.asarray(levels + np.interp(levels, table[::2], table[1::2]) * noise)


def _shift(label: str, name: str, meaning: str, length_px: float) -> Effect:
    """Return an effect that shifts the image from point to point, anew for each frame."""
    return Effect(label, "edges", {
        f"{name}_px": drawn(
            0.0, f"standard deviation, right and down, of shifts of the image that vary {meaning}",
            0, 1000,
        ),
        f"{name}_length_px": drawn(
            length_px, "distance at which the correlation of these shifts has fallen to 0.61", 1,
            1e6,
        ),
    }, needs={f"{name}_length_px": (f"{name}_px",)}, random=True, outline="curved")


def _tone(name: str, default: float, meaning: str, low: float, high: float) -> Effect:
    """Return one of the effects that make up the camera's response."""
    return Effect(name, "response", {
        f"tone_{name}": drawn(default, meaning, low, high),
    }, worsens=("uneven light",), apply=_toned)


#: Every effect, in physical order.
EFFECTS: tuple[Effect, ...] = (
    Effect("printed size", "edges", {
        "marker_scale": drawn(
            1.0, "size of the printed marker relative to size_m, which truth and belief keep",
            0, 10, open_low=True,
        ),
    }),
    Effect("bend", "edges", {
        "curvature_per_m": drawn(
            0.0, "curvature of the marker's sheet; positive if it bulges towards the viewer; "
            "the true pose is that of the tangent plane at the centre", -1e6, 1e6,
        ),
        "bend": parameter(
            "cylinder", "shape of the bent sheet: cylinder: paper on a can, not stretched; "
            "saddle: curved as much the other way across", choices=("cylinder", "saddle"),
        ),
        "bend_deg": drawn(
            0.0, "direction in which the sheet curves, in the marker's plane: 0 right, 90 up",
            -360, 360,
        ),
    }, needs=dict.fromkeys(("bend", "bend_deg"), ("curvature_per_m",)), outline="curved"),
    Effect("occlusion", "edges", {
        "occlusion": drawn(
            0.0, "share of the black square's extent that a sheet with a straight edge hides; "
            "it lies on the marker and also hides the quiet zone on its side", 0, 1,
        ),
        "occlusion_deg": drawn(
            0.0, "side that the sheet comes from, in the marker's plane: 0 its right, 90 its "
            "top", -360, 360,
        ),
        "occluder": drawn(128.0, "level of the sheet", 0, 255, unit="grey level"),
    }, outline="covered"),
    Effect("uneven light", "light", {
        "illumination_gradient": drawn(
            0.0, "change of the light across the frame's width, relative to its centre", -2, 2
        ),
        "illumination_deg": drawn(
            0.0, "direction in which the light grows: 0 right, 90 down", -360, 360
        ),
    }, widens="uneven light", apply=_lit),
    Effect("motion blur", "edges", {
        "exposure_s": drawn(
            0.0, "exposure time: the image is the mean over it; the true pose is that in its "
            "middle", 0, 1e6,
        ),
    }, needs={"exposure_s": VELOCITIES}, outline="moving"),
    Effect("rolling shutter", "edges", {
        "row_time_s": drawn(
            0.0, "rolling shutter: time from one row's exposure to the next's; the true pose "
            "is that at the middle row's", 0, 1e6,
        ),
        # The velocities are those of both effects of motion.
        **{
            name: drawn(0.0, f"{velocity} {along}", -1e9, 1e9)
            for name, (velocity, along) in zip(VELOCITIES, [
                *(("velocity of the marker's centre,", along)
                  for along in ("right", "down", "away from the camera")),
                *(("angular velocity about the axis through the marker's centre that points", along)
                  for along in ("right", "down", "forward")),
            ], strict=True)
        },
    },
        needs={
            "row_time_s": VELOCITIES,
            **dict.fromkeys(VELOCITIES, ("exposure_s", "row_time_s")),
        },
        outline="moving",
    ),
    Effect("optical blur", "edges", {
        "blur_px": drawn(0.0, "standard deviation of the lens' Gaussian point spread", 0, 1000),
    }, in_bound=True, spread_px=lambda values, _, depth: np.full(depth.shape, values["blur_px"])),
    Effect("defocus", "edges", {
        "aperture_mm": drawn(
            None, "diameter of the lens' opening: defocus adds a quarter of the circle of "
            "confusion's diameter to the point spread, in quadrature, at each depth", 0, 1e6,
            open_low=True,
        ),
        "focus_distance_m": drawn(None, "depth at which the image is sharp", 0, open_low=True),
    },
        needs={
            "aperture_mm": ("focus_distance_m",), "focus_distance_m": ("aperture_mm",),
        },
        spread_px=_defocus_px, by_depth=True,
    ),
    _shift(
        "image shift", "geometry", "slowly over the frame, as of a lens that its model does not "
        "describe; drawn anew for each frame", 100.0,
    ),
    _shift(
        "ragged edges", "edge", "from one module to the next, as a screen's raster, compression "
        "and a camera's colour filter lead to; drawn anew for each frame, beside geometry_px", 4.0,
    ),
    Effect("sharpening", "edges", {
        "sharpening": drawn(
            0.0, "amount of unsharp masking in the camera: the exact image plus so many times "
            "its difference from the image blurred by sharpening_px; the noise stays as it is",
            -1, 100,
        ),
        "sharpening_px": drawn(
            1.0, "radius of sharpening: standard deviation of the Gaussian whose blurred image "
            "is subtracted", 0, 1000, open_low=True,
        ),
    },
        needs={"sharpening_px": ("sharpening",)},
        # That of the image that is subtracted.
        spread_px=lambda values, _, depth: np.full(depth.shape, values["sharpening_px"]),
    ),
    Effect("bloom", "light", {
        "bloom": drawn(
            0.0, "widening of bright areas: a level that is a share s of the way from black to "
            "white is lifted by bloom · s · (1 - s) of it", -1, 1,
        ),
    }),
    Effect("vignetting", "light", {
        "vignetting": drawn(
            0.0, "power of the cosine of a pixel's angle to the optical axis by which its "
            "light falls off; 4 is the natural law", 0, 100,
        ),
    }, widens="uneven light", apply=_lit),
    Effect("decimation", "light", {
        "decimation": parameter(
            1.0, "column and row i are those of number floor(i · decimation) of a larger image, so "
            "that pixels are not evenly spaced; a fraction of at most eighths", 1, 100,
        ),
    }, reach_px=sensor.TAPS_PX, apply=lambda levels, patch: sensor.decimated(
        levels, patch.left, patch.top, patch.values["decimation"]
    )),
    Effect("shot noise", "signal", {
        "full_well_e": drawn(
            None, "electrons that a pixel holds, at level 255 and gain 1; the shot noise is "
            "theirs", 1, 1e9,
        ),
        "read_noise_e": drawn(0.0, "standard deviation of the read noise", 0, 1e9),
    }, needs={"read_noise_e": ("full_well_e",)}, random=True, widens="noise", apply=_exposed),
    Effect("gain", "signal", {
        "gain": drawn(
            1.0, "factor on the signal and its noise, before it is quantised", 0, 1e6,
            open_low=True,
        ),
    }, in_bound=True, apply=lambda levels, patch: levels * patch.values["gain"]),
    Effect("grey noise", "signal", {
        "noise_grey": drawn(
            0.0, "standard deviation of plain Gaussian noise on the grey levels", 0, 1e6,
            unit="grey level",
        ),
    }, random=True, in_bound=True, widens="noise", apply=_noisy),
    Effect("correlated noise", "signal", {
        "noise_correlation": drawn(
            0.0, "correlation of the grey noise (noise_grey, noise_table) of neighbouring "
            "pixels; two pixels apart 0.025, 0.084, 0.24, 0.66 for 0.3, 0.5, 0.7, 0.9; the "
            "standard deviation stays", 0, 0.99,
        ),
    }, needs={"noise_correlation": ("noise_grey", "noise_table")}, worsens=("noise",)),
    Effect("demosaicing", "colour", {
        "bayer": parameter(
            "none", "colour filters of the frame's first two by two pixels; none: a grey "
            "camera", choices=("none", *sensor.PATTERNS),
        ),
        "demosaic": parameter(
            "bilinear", "how colours are interpolated (OpenCV), before they are turned to grey",
            choices=tuple(sensor.METHODS),
        ),
        "bayer_red": drawn(1.0, "gain of the red pixels relative to the green ones", 0, 100),
        "bayer_blue": drawn(1.0, "gain of the blue pixels relative to the green ones", 0, 100),
    },
        needs=dict.fromkeys(("demosaic", "bayer_red", "bayer_blue"), ("bayer",)),
        reach_px=sensor.REACH_PX, apply=_demosaiced,
    ),
    _tone(
        "gamma", 1.0, "exponent of the camera's response: level 255 · (signal / 255) ^ tone_gamma; "
        "below 1 dark areas are lifted", 0.1, 10,
    ),
    _tone(
        "toe", 0.0, "compression of the lower half of the scale towards black: the response has "
        "the slope 1 - tone_toe at black", -1, 1,
    ),
    _tone(
        "knee", 0.0, "compression of the upper half of the scale towards white: the response has "
        "the slope 1 - tone_knee at white", -1, 1,
    ),
    Effect("noise by level", "response", {
        "noise_table": parameter(
            (), "standard deviation of Gaussian noise over the level in the image: level, "
            "deviation, level, deviation, ..., ascending, interpolated, constant beyond",
            unit="grey level", lengths=(0, *range(2, 513, 2)),
            list_text="a list of an even number of finite numbers, at most 512",
        ),
    }, random=True, widens="noise", apply=_noisy_by_level),
    Effect("bit depth", "readout", {
        "bit_depth": parameter(
            8, "bits to which the levels 0 to 255 are quantised, clipped; OpenCV gets them "
            "rounded to 8", 8, 16, unit="bit",
        ),
    }),
    Effect("JPEG", "readout", {
        "jpeg_quality": parameter(
            0, "quality of JPEG compression (OpenCV's encoder), 1 to 100; 0: not compressed", 0,
            100,
        ),
    }, worsens=("noise", "uneven light"), block_px=sensor.BLOCK_PX),
)


_DECLARED = {name: each for effect in EFFECTS for name, each in effect.parameters.items()}

#: The parameters of all effects as a dataclass, as those of camera, marker and pose are.
Effects: type = dataclasses.make_dataclass(
    "Effects",
    [
        (name, float | None if each.default is None else type(each.default), each)
        for name, each in _DECLARED.items()
    ],
    frozen=True,
)

#: Every parameter of the effects at its default: no effect is active.
NEUTRAL: dict[str, Any] = {name: each.default for name, each in _DECLARED.items()}

#: Parameters that are text or lists: scenes hold the numbers of their values.
CODED = tuple(name for name, default in NEUTRAL.items() if is_coded(default))

#: Switches of the effects that only the ``exact`` renderer has.
GEOMETRIC = tuple(effect.switch for effect in EFFECTS if effect.step == "edges")

#: Switches of the effects that draw random numbers.
RANDOM = tuple(effect.switch for effect in EFFECTS if effect.random)

#: Parameter -> parameters of which one must be given beside it.
NEEDS: dict[str, tuple[str, ...]] = {
    name: others for effect in EFFECTS for name, others in effect.needs.items()
}


# --------------------------------------------------------------------------------------------------
# Additions of plug-ins to scenes: effects and renderers, whose results are checked.

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


#: A renderer: levels and shares (h, w) each.
Render = Callable[[MarkerView], tuple[Floats, Floats]]


@dataclass(frozen=True, slots=True)
class ScenePlugins:
    """What scenes may have: the built-in effects, and what plug-ins add.

    Attributes
    ----------
    effects
        In the order in which they act in their step: the built-in ones, then those of plug-ins.
    renderers
        By the name that pipelines have.
    settings
        Names of the renderers' settings.
    """

    effects: tuple[Effect, ...] = EFFECTS
    renderers: Mapping[str, Render] = field(default_factory=dict)
    settings: tuple[str, ...] = ()


NO_PLUGINS = ScenePlugins()


def checked_effect(
    name: str, apply: Callable[[Any, Any], Any]
) -> Callable[[Floats, Patch], Floats]:
    """Return an effect's function that raises PluginError for results that are no levels."""

    def applied(levels: Floats, patch: Patch) -> Floats:
        returned = call(name, apply, levels.copy(), patch)
        return real_numbers(name, "levels", returned, levels.shape, finite=True)

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
            real_numbers(name, what, each, shape, finite=True)
            for what, each in zip(("levels", "share"), returned, strict=True)
        )
        if ((share < 0) | (share > 1)).any():
            raise PluginError(f"{name}: returned shares outside 0 to 1")
        return levels, share

    return rendered
