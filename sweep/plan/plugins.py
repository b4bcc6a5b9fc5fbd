"""The plug-ins that a pipeline names, and their settings as parameters beside our own."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from typing import Any

from sweep.errors import PluginError
from sweep.measure.detectors import OPENCV, detector_name
from sweep.plan.parameters import PARAMETERS, SECTIONS, Parameter
from sweep.plugins.declared import DeclaredPlugin, declare

NAMED_BY: dict[str, tuple[str, str]] = {"detector": ("detector", "detector")}
"""Kind of plug-in -> the section of its settings, and the parameter whose values name it."""

OWN: dict[str, tuple[str, ...]] = {"detector": (OPENCV,)}
"""Kind of plug-in -> names that are not of plug-ins."""


def named(document: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Yield kind, name and key of each plug-in that a document names, in its order, once."""
    seen = set()
    for kind, (section, parameter) in NAMED_BY.items():
        for key, value in _values(document, section, parameter):
            for name in value if isinstance(value, list) else [value]:
                if not isinstance(name, str) or not name.strip():
                    continue
                name = detector_name(name)  # noqa: PLW2901
                if name not in OWN[kind] and (kind, name) not in seen:
                    seen.add((kind, name))
                    yield kind, name, key


def _values(document: Mapping[str, Any], section: str, parameter: str) -> Iterator[tuple[str, Any]]:
    """Yield key and value of each place of a document that gives a parameter."""
    table = document.get(section)
    if isinstance(table, dict) and parameter in table:
        yield f"{section}.{parameter}", table[parameter]
    axes = document.get("axes")
    for key, value in axes.items() if isinstance(axes, dict) else ():
        if key == parameter:
            yield f"axes.{key}", value.get("values") if isinstance(value, dict) else value
        elif isinstance(value, dict) and isinstance(value.get("zip"), dict):
            member = value["zip"].get(parameter)
            if member is not None:
                yield f"axes.{key}.{parameter}", (
                    member.get("values") if isinstance(member, dict) else member
                )


def read_plugins(
    document: Mapping[str, Any], folder: str, known: Iterable[DeclaredPlugin] | None
) -> tuple[list[DeclaredPlugin], list[tuple[str, str, str, str]]]:
    """Return a document's plug-ins, and faults: kind, key, name and what was expected.

    ``known`` are those of a store, taken instead of importing them.
    """
    plugins: list[DeclaredPlugin] = []
    faults = []
    recorded = None if known is None else {(each.kind, each.name): each for each in known}
    for kind, name, key in named(document):
        if recorded is not None:
            if (kind, name) in recorded:
                plugins.append(recorded[kind, name])
            else:
                faults.append((kind, key, name, "a plug-in that the store has recorded"))
            continue
        try:
            plugin = declare(kind, name, folder)
            parameters_with((*plugins, plugin))
        except PluginError as error:
            faults.append((kind, key, name, str(error)))
        else:
            plugins.append(plugin)
    return plugins, faults


@lru_cache(maxsize=64)
def parameters_with(plugins: tuple[DeclaredPlugin, ...]) -> Mapping[str, Parameter]:
    """Return every parameter by its name: our own, and the settings of plug-ins.

    Raises
    ------
    PluginError
        If a setting has a name of ours, or of another plug-in's that is declared otherwise.
    """
    gathered: dict[str, Parameter] = {}
    owners: dict[str, str] = {}
    for plugin in plugins:
        section, _ = NAMED_BY[plugin.kind]
        for setting in plugin.settings:
            name = setting.name
            parameter = Parameter(
                name, section, SECTIONS[section][1], setting.types, setting.default,
                setting.declaration,
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
