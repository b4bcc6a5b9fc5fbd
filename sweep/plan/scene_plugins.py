"""The effects and renderers of a pipeline: the built-in ones, and those of its plug-ins."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from typing import Any, cast

from sweep.model.effect import Effect
from sweep.model.effects import EFFECTS
from sweep.model.plugged_scene import ScenePlugins, checked_effect, checked_renderer
from sweep.plan.experiment import Pipeline
from sweep.plugins import EffectPlugin, RendererPlugin
from sweep.plugins.declared import DeclaredPlugin


def effects_of(plugins: Iterable[DeclaredPlugin]) -> tuple[Effect, ...]:
    """Return the built-in effects and those of plug-ins, which are not imported for it."""
    return (*EFFECTS, *(_effect(plugin) for plugin in plugins if plugin.kind == "effect"))


def _effect(plugin: DeclaredPlugin) -> Effect:
    widens: Any = plugin.widens
    step: Any = plugin.step
    parameters = {setting.name: setting for setting in plugin.settings}
    return Effect(plugin.name, step, parameters, random=plugin.random, widens=widens)


def scene_plugins(pipeline: Pipeline) -> ScenePlugins:
    """Return what a pipeline's plug-ins add to its scenes, imported.

    Raises
    ------
    PluginError
        If one is not the plug-in that was declared; in one line.
    """
    return _imported(pipeline.plugins, pipeline.folder)


@lru_cache(maxsize=16)
def _imported(plugins: tuple[DeclaredPlugin, ...], folder: str) -> ScenePlugins:
    effects, renderers, settings = [], {}, []
    for plugin in plugins:
        if plugin.kind == "effect":
            record = cast("EffectPlugin", plugin.record(folder))
            effects.append(_effect(plugin).applying(checked_effect(plugin.name, record.apply)))
        elif plugin.kind == "renderer":
            renderer = cast("RendererPlugin", plugin.record(folder))
            renderers[plugin.name] = checked_renderer(plugin.name, renderer.render)
            settings += [setting.name for setting in plugin.settings]
    return ScenePlugins(tuple(effects), renderers, tuple(settings))
