"""The optional parts of model and measurement that a pipeline needs, and why."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

from sweep.environments.identity import identify
from sweep.environments.interpreters import INSTALLED
from sweep.errors import EnvironmentFaultError
from sweep.measure.detector import NOISE_MARGIN_PX, DetectorSetting
from sweep.measure.detectors import full_frame_reason, margin_px, uneven_light_needs_frame
from sweep.measure.estimators import SOLVERS
from sweep.measure.foreign_detector import own_defaults
from sweep.messages import label
from sweep.model.camera import canonical_distortion
from sweep.model.effect import Effect, is_coded
from sweep.plan.boards import target_word
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import detector_settings
from sweep.plan.parameters import PARAMETERS
from sweep.plan.scene_plugins import effects_of
from sweep.plugins.declared import DeclaredPlugin


@dataclass(frozen=True, slots=True)
class Part:
    """An optional part of the work.

    Attributes
    ----------
    name
        Its name.
    active, reason
        Whether it runs, and why.
    switch
        Of an effect: the parameter that switches it on.
    """

    name: str
    active: bool
    reason: str
    switch: str = ""


def _effect(pipeline: Pipeline, effect: Effect) -> Part:
    name, switch = effect.label, effect.switch
    if switch in pipeline.distributions:
        return Part(name, True, f"{switch} is drawn: {pipeline.distributions[switch]}", switch)
    values = [value for value in pipeline.values_of(switch) if effect.is_on(value)]
    if not values:
        return Part(name, False, f"{switch} is {effect.off_text}", switch)
    if is_coded(effect.off):
        extent = ", ".join(dict.fromkeys(map(label, values)))
    else:
        low, high = min(values), max(values)
        extent = f"{low:g}" if low == high else f"{low:g} to {high:g}"
    return Part(name, True, f"{switch} is {extent}", switch)


def _needs_images(pipeline: Pipeline, solver: str) -> bool:
    plugin = pipeline.plugin("estimator", solver)
    return SOLVERS[solver].needs_images if plugin is None else plugin.needs_images


def _described(plugin: DeclaredPlugin) -> str:
    """Return a plug-in in words: kind, name, versions."""
    versions = ", ".join(f"{name} {version}" for name, version in plugin.versions)
    threads = f", {plugin.threads} threads" if plugin.threads > 1 else ""
    return f"{plugin.kind} {plugin.name}" + (f" ({versions})" if versions else "") + threads


def parts(pipeline: Pipeline) -> list[Part]:
    """Return every optional part, active or not."""
    effects, target = effects_of(pipeline.plugins), target_word(pipeline)
    lens = pipeline.any_value("distortion", lambda value: len(canonical_distortion(value)) > 0)
    draws = [*pipeline.distributions]
    if pipeline.any_value("jitter_px", lambda value: value > 0):
        draws.append("jitter_px")
    draws += [
        each.switch for each in effects
        if each.random and each.switch not in draws
        and pipeline.any_value(each.switch, each.is_on)
    ]
    if pipeline.any_value("believed", lambda value: value == "calibration"):
        draws.append("the believed calibration")
    renderers = sorted(set(pipeline.values_of("renderer")))
    image = pipeline.any_value("background", lambda value: isinstance(value, str))
    asked = pipeline.any_value("window", lambda value: value == "full")
    settings = detector_settings(pipeline)
    whole = sorted({reason for s in settings if (reason := full_frame_reason(s)) is not None})
    gain = max([1.0, *(value for value in pipeline.values_of("gain"))])
    on = [
        effect for effect in effects
        if pipeline.any_value(effect.switch, effect.is_on)
        or effect.switch in pipeline.distributions
    ]
    if any("uneven light" in effect.worsens for effect in on):
        gain = math.inf
    uneven = any(effect.widens == "uneven light" for effect in on)
    if uneven and any(uneven_light_needs_frame(setting, gain) for setting in settings):
        whole.append("adaptiveThreshConstant is low for uneven light")
    if image:
        whole.append(
            f"the background is an image: clutter near the {target} may change the detection")
    if asked:
        whole.append('window = "full"')
    noisy = any(effect.switch in draws for effect in effects if effect.widens == "noise")
    coarse = any("noise" in effect.worsens for effect in on)
    noise = f", and {NOISE_MARGIN_PX * (1 + coarse)} more for noise" if noisy else ""
    margins = sorted({margin_px(s) for s in settings if full_frame_reason(s) is None})
    windowed = bool(margins) and not (asked or image)
    guarded = pipeline.any_value("guarded", bool)
    assumptions = [
        name for name in PARAMETERS
        if name.startswith("believed_") and pipeline.fixed.get(name, "varies") is not None
    ]
    if pipeline.any_value("believed", lambda value: value == "calibration"):
        assumptions.append("believed: calibration")
    bounds = sorted(set(pipeline.values_of("bound")) - {"none"})
    pixels = [name for name in pipeline.values_of("solver") if _needs_images(pipeline, name)]
    others = [
        _environment(pipeline, name) for name in pipeline.values_of("environment")
        if name != INSTALLED
    ]
    return [
        Part("lens distortion", lens, "distortion is given" if lens else "distortion is empty"),
        Part(
            "random draws", bool(draws),
            ", ".join(draws) + (", Sobol' points" if pipeline.sampling == "sobol" else "")
            if draws else "nothing is random",
        ),
        Part("background image", image, "background names a file" if image else "a level"),
        Part(
            "window", windowed,
            f"{', '.join(str(m) for m in margins)} px around the {target}'s pixels{noise}"
            if windowed else "the full frame",
        ),
        Part(
            "plug-ins", bool(pipeline.plugins),
            ", ".join(_described(plugin) for plugin in pipeline.plugins) or "none is named",
        ),
        Part("environments", bool(others), "; ".join(others) or "OpenCV of this Python alone"),
        Part("full frame", bool(whole), "; ".join(whole) if whole else "no setting needs it"),
        Part("renderer", True, ", ".join(renderers)),
        *(_effect(pipeline, effect) for effect in effects),
        Part(
            "solver guard", guarded,
            "guarded = true" if guarded else "guarded = false: plain cv2.solvePnP",
        ),
        Part(
            "accuracy bound", bool(bounds),
            f"bound is {', '.join(bounds)}" if bounds else "bound is none",
        ),
        Part(
            "pixels kept", bool(pixels),
            f"solver {', '.join(pixels)} needs them" if pixels else "no solver needs them",
        ),
        Part(
            "wrong assumptions", bool(assumptions),
            ", ".join(assumptions) or "the estimator knows the true camera and size",
        ),
    ]


def _environment(pipeline: Pipeline, name: str) -> str:
    """Return what another environment's OpenCV is, and what it has otherwise than this one."""
    try:
        identity = identify(name, pipeline.folder)
    except EnvironmentFaultError as error:
        return f"{name} ({error})"
    own = own_defaults(identity, pipeline.given)
    declared = {field.name for field in dataclasses.fields(DetectorSetting)}
    lacks = sorted(declared - identity.fields.keys())
    facts = [f"OpenCV {identity.opencv}"]
    if own:
        listed = ", ".join(f"{field} {value:g}" for field, value in own.items())
        facts.append(f"by its own defaults {listed}")
    if lacks:
        facts.append(f"without {', '.join(lacks)}")
    return f"{name} ({', '.join(facts)})"
