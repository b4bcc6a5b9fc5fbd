"""From the light on the pixels to the image: the sensor, then the camera's own processing."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from sweep.model.correlated_noise import deviations, normal_field
from sweep.model.demosaic import REACH_PX, demosaiced
from sweep.model.effect import Patch, apply_pointwise, is_coded
from sweep.model.effects import POINTWISE, SWITCHES
from sweep.model.jpeg import BLOCK_PX, compressed
from sweep.model.scene import Box, Scenes
from sweep.model.sensor import Light, Readout, add_noise, digitise, illuminate, read_out
from sweep.model.tone import apply_tone
from sweep.typing import Floats, Grey

GREY_NOISE_DRAW = 2
"""The draw of a pixel that plain grey noise is made from, correlated or not."""


PROCESSING = {
    name: 0 if is_coded(SWITCHES[name]) else SWITCHES[name]
    for name in (
        "noise_correlation", "bayer", "tone_gamma", "tone_toe", "tone_knee", "noise_table",
    )
}
"""Switches of effects between the noise and quantisation -> the numbers at which they are off."""


def sensed_window(scenes: Scenes, row: int, window: Box) -> Box:
    """Return the pixels that must be computed for those of ``window`` to be the frame's own.

    Whole blocks of JPEG, counted from the frame's corner, and around them what demosaicing needs,
    from an even column and row on; clipped at the frame.
    """
    effect = scenes.effect(row)
    if effect["jpeg_quality"] > 0:
        window = _aligned(scenes, row, window, BLOCK_PX)
    if effect["bayer"] > 0:
        left, top, right, bottom = window
        padded = left - REACH_PX, top - REACH_PX, right + REACH_PX, bottom + REACH_PX
        window = _aligned(scenes, row, padded, 2)
    return window


def _aligned(scenes: Scenes, row: int, window: Box, step: int) -> Box:
    """Return a window that begins and ends at multiples of ``step``, or with the frame."""
    left, top, right, bottom = window
    width, height = scenes.frame[row].tolist()
    return (
        max(left // step * step, 0), max(top // step * step, 0),
        min(-(-right // step) * step, width), min(-(-bottom // step) * step, height),
    )


def sensed(
    scenes: Scenes, row: int, levels: Floats, overshoot: Floats | None, computed: Box, window: Box
) -> Grey:
    """Return the image of ``window``, from levels of light (h, w) of the pixels ``computed``.

    In this order: uneven light; electrons, gain and noise; plug-ins' effects on the signal;
    demosaicing; ``overshoot`` (h, w), what sharpening adds to the levels of light; tone; noise by
    level; quantisation; JPEG. Sharpening is linear: it commutes with gain and, for even light, with
    all before it but the noise, which it leaves as it is.

    ``computed`` is :func:`sensed_window` of ``window``. Both arrays are overwritten.
    """
    effect = scenes.effect(row)
    left, top = computed[:2]
    _fall_off(levels, scenes, row, effect, left, top)
    plugged = (*POINTWISE, *scenes.plugins.effects)
    patch = Patch(
        effect, left, top, (int(scenes.frame[row, 0]), int(scenes.frame[row, 1])),
        scenes.cameras.view[row], scenes.noise_key[row],
    )
    if overshoot is not None:
        _fall_off(overshoot, scenes, row, effect, left, top)
        # An effect on the light changes the contrast: sharpening, which follows it, sees that.
        sharp = apply_pointwise(plugged, "light", levels + overshoot, patch)
        overshoot = sharp - apply_pointwise(plugged, "light", levels, patch)
    levels = apply_pointwise(plugged, "light", levels, patch)
    readout = Readout(
        scenes.noise_key[row], effect["full_well_e"], effect["read_noise_e"], effect["gain"],
        effect["noise_grey"], int(effect["bit_depth"]),
    )
    image = np.empty(levels.shape, dtype=np.uint8)
    processed = any(effect[name] != off for name, off in PROCESSING.items())
    if not processed and overshoot is None and all(each.step != "signal" for each in plugged):
        read_out(levels, left, top, readout, image)
    else:
        levels = _signal(levels, patch, readout)
        levels = apply_pointwise(plugged, "signal", levels, patch)
        levels = _rendition(scenes, levels, overshoot, patch)
        digitise(levels, readout.bits, image)
    quality = int(effect["jpeg_quality"])
    if quality:
        blocks = _aligned(scenes, row, window, BLOCK_PX)
        image, computed = compressed(_cut(image, computed, blocks), quality), blocks
    return _cut(image, computed, window)


def _cut(image: Grey, computed: Box, window: Box) -> Grey:
    """Return the pixels of ``window`` from those of ``computed`` around it."""
    if computed == window:
        return image
    left, top = computed[:2]
    return np.ascontiguousarray(
        image[window[1] - top : window[3] - top, window[0] - left : window[2] - left]
    )


def _fall_off(
    levels: Floats, scenes: Scenes, row: int, effect: Mapping[str, float], left: int, top: int
) -> None:
    """Multiply levels (h, w), whose first pixel is (left, top), by the light on each pixel."""
    width, height = scenes.frame[row].tolist()
    slope = effect["illumination_gradient"] / width
    if slope != 0 or effect["vignetting"] > 0:
        turn = math.radians(effect["illumination_deg"])
        light = Light(
            slope * math.cos(turn), slope * math.sin(turn), (width - 1) / 2, (height - 1) / 2,
            effect["vignetting"],
        )
        illuminate(levels, left, top, light, scenes.cameras.view[row])


def _signal(levels: Floats, patch: Patch, readout: Readout) -> Floats:
    """Return the signal (h, w) with its noise and gain, from levels of light."""
    correlation = patch.values["noise_correlation"]
    if correlation == 0 or readout.noise_grey == 0:
        add_noise(levels, patch.left, patch.top, readout)
        return levels
    add_noise(levels, patch.left, patch.top, readout._replace(noise_grey=0.0))
    field = normal_field(
        readout.key, GREY_NOISE_DRAW, patch.left, patch.top, levels.shape, correlation
    )
    return np.asarray(levels + readout.noise_grey * field)


def _rendition(
    scenes: Scenes, levels: Floats, overshoot: Floats | None, patch: Patch
) -> Floats:
    """Return the levels (h, w) that the camera makes of the signal, not quantised."""
    effect = patch.values
    if effect["bayer"] > 0:
        levels = demosaiced(
            levels, scenes.meaning("bayer", effect), scenes.meaning("demosaic", effect),
            effect["bayer_red"], effect["bayer_blue"],
        )
    if overshoot is not None:
        levels = levels + effect["gain"] * overshoot
    tone = effect["tone_gamma"], effect["tone_toe"], effect["tone_knee"]
    if tone != (1.0, 0.0, 0.0):
        apply_tone(levels, *tone)
    if effect["noise_table"] > 0:
        spread = deviations(levels, scenes.meaning("noise_table", effect))
        field = normal_field(
            patch.stream_key("noise_table"), 0, patch.left, patch.top, levels.shape,
            effect["noise_correlation"],
        )
        levels = levels + spread * field
    return levels
