"""The plug-ins that a pipeline names, and their settings as parameters beside our own."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache, lru_cache
from typing import Any

from sweep.errors import PluginError
from sweep.experiment.parameters import PARAMETERS, SECTIONS, Parameter, places
from sweep.messages import MAX_FAULTS
from sweep.plugins.declared import DeclaredPlugin, declare
from sweep.plugins.loading import installed_names

NAMED_BY: dict[str, Parameter] = {
    each.declaration.plugin: each for each in PARAMETERS.values() if each.declaration.plugin
}
"""Kind of plug-in -> the parameter whose values name it."""

EFFECTS_KEY = "effects"
"""The key above the sections that names effects."""


def section_of_settings(kind: str) -> str:
    """Return the section that the settings of a kind of plug-in belong under."""
    return NAMED_BY[kind].section if kind in NAMED_BY else "scene"


def _named(document: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Yield kind, name and key of each plug-in that a document names, in its order."""
    installed = cache(installed_names)
    for kind, parameter in NAMED_BY.items():
        for key, value in places(document, parameter).items():
            listed = value.get("values") if isinstance(value, dict) else value
            for name in listed if isinstance(listed, list) else [listed]:
                if isinstance(name, str) and _is_plugin(parameter, name, installed):
                    yield kind, name, key
    effects = document.get(EFFECTS_KEY)
    for name in effects if isinstance(effects, list) else ():
        if isinstance(name, str):
            yield "effect", name, EFFECTS_KEY


def _is_plugin(
    parameter: Parameter, name: str, installed: Callable[[str], Sequence[str]]
) -> bool:
    """Return whether a value names a plug-in, or is meant to: it is none of the choices.

    ``installed`` returns the names of the installed plug-ins of a kind.
    """
    try:
        parameter.check(name)
    except ValueError:
        kind = parameter.declaration.plugin
        # Where there are several choices, a misspelt one is more likely.
        few = len(parameter.declaration.choices) == 1
        return few or ":" in name or name in installed(kind)
    return False


def read_plugins(
    document: Mapping[str, Any], folder: str, known: Iterable[DeclaredPlugin] | None
) -> tuple[list[DeclaredPlugin], list[tuple[str, str, str, str]]]:
    """Return a document's plug-ins, and faults: kind, key, name and what was expected.

    ``known`` are those of a store, or of the pipeline that the document is a cell of: they are
    taken instead of importing them, also those that the document does not name.
    """
    plugins = list(known or ())
    declared = {(plugin.kind, plugin.name) for plugin in plugins}
    faults: list[tuple[str, str, str, str]] = []
    for kind, name, key in _named(document):
        if (kind, name) in declared:
            continue
        declared.add((kind, name))
        if len(faults) == MAX_FAULTS:
            break  # no more are told
        try:
            if known is not None:
                raise PluginError("a plug-in that the store has recorded")
            plugin = declare(kind, name, folder)
            parameters_with((*plugins, plugin))
        except PluginError as error:
            faults.append((kind, key, name, str(error)))
        else:
            plugins.append(plugin)
    return plugins, faults


def lacking_plugins(plugins: Iterable[DeclaredPlugin], folder: str) -> list[str]:
    """Return a line for each plug-in that is not in this process as it was declared."""
    lines = []
    for plugin in plugins:
        try:
            plugin.record(folder)
        except PluginError as error:
            lines.append(str(error))
    return lines


@lru_cache(maxsize=64)
def parameters_with(plugins: tuple[DeclaredPlugin, ...]) -> Mapping[str, Parameter]:
    """Return every parameter by its name: our own, which may name them, and their settings.

    Raises
    ------
    PluginError
        If a setting has a name of ours, or of another plug-in's that is declared otherwise.
    """
    gathered: dict[str, Parameter] = {}
    owners: dict[str, str] = {}
    for plugin in plugins:
        section = section_of_settings(plugin.kind)
        if plugin.kind in NAMED_BY:
            by = gathered.get(NAMED_BY[plugin.kind].name, NAMED_BY[plugin.kind])
            gathered[by.name] = dataclasses.replace(by, declaration=dataclasses.replace(
                by.declaration, choices=(*by.declaration.choices, plugin.name)
            ))
        for setting in plugin.settings:
            name = setting.name
            parameter = Parameter(
                name, setting.types, setting.default, setting.declaration, section,
                SECTIONS[section][1],
            )
            if name in PARAMETERS:
                raise PluginError(f"another name for its setting {name}: the pipeline has this one")
            if gathered.setdefault(name, parameter) != parameter:
                raise PluginError(
                    f"its setting {name} to be declared as that of {owners[name]}, or another name"
                )
            owners.setdefault(name, plugin.name)
            try:
                if setting.default is not None:
                    parameter.check(setting.default)
            except ValueError as error:
                raise PluginError(
                    f"a default of its setting {name} that is allowed: {error}"
                ) from None
    return {**PARAMETERS, **gathered} if gathered else PARAMETERS
