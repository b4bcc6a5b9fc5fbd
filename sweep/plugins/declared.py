"""What pipelines and stores know of plug-ins without importing them."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.metadata
import math
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from sweep.declaration import Declared, converted, plain_types
from sweep.errors import ArgumentError, PluginError
from sweep.messages import nearest
from sweep.plugins import RECORDS, DetectorPlugin, Plugin
from sweep.plugins.loading import call, file_of, group_of, load, read_source, versions_of
from sweep.plugins.recording import RecordedDetector

# --------------------------------------------------------------------------------------------------
# A plug-in as pipelines and stores know it: all that can be said of it without importing it.

#: Types that a setting may have.
TYPES: dict[str, type] = {"float": float, "int": int, "bool": bool, "str": str}


@dataclass(frozen=True, slots=True)
class Setting(Declared):
    """One setting of a plug-in."""

    def to_json(self) -> dict[str, Any]:
        """Return it as a store records it."""
        declared = {
            field.name: value for field in dataclasses.fields(Declared)[3:]
            if (value := getattr(self, field.name)) != field.default
            and not (isinstance(value, float) and math.isinf(value))
        }
        return {"name": self.name, "types": [kind.__name__ for kind in self.types],
                "default": self.default, **declared}

    @staticmethod
    def from_json(record: Mapping[str, Any]) -> Setting:
        """Return the setting of a record; KeyError, TypeError or ValueError if it is none."""
        declared: dict[str, Any] = {
            key: tuple(value) if isinstance(value, list) else value
            for key, value in record.items() if key not in ("name", "types", "default")
        }
        name, kinds = record["name"], tuple(TYPES[kind] for kind in record["types"])
        if not isinstance(name, str) or not name.isidentifier():
            raise ValueError(name)
        return Setting(name, kinds, record["default"], **declared)


@dataclass(frozen=True, slots=True)
class DeclaredPlugin:
    """A plug-in that a pipeline names.

    Attributes
    ----------
    kind, name
        Its kind ("detector"), and its name in the pipeline.
    meaning
        One line.
    versions
        Distributions that its results depend on, with their versions.
    file, digest
        The file that has it, relative to the pipeline, and its SHA-256; empty for installed ones.
    settings
        Its settings.
    dictionaries
        Dictionaries that a detector knows; empty for all.
    threads
        Threads that it uses.
    needs_images, of_boards, random, widens, step
        As :class:`sweep.plugins.EstimatorPlugin` and :class:`sweep.plugins.EffectPlugin` have them.
    """

    kind: str
    name: str
    meaning: str = ""
    versions: tuple[tuple[str, str], ...] = ()
    file: str = ""
    digest: str = ""
    settings: tuple[Setting, ...] = ()
    dictionaries: tuple[str, ...] = ()
    threads: int = 1
    needs_images: bool = False
    of_boards: bool = False
    random: bool = False
    widens: str = "nothing"
    step: str = "light"

    def record(self, folder: str) -> Plugin:
        """Return the plug-in's record, imported; ``folder`` is the pipeline's folder.

        Raises
        ------
        PluginError
            If it is not the plug-in that was declared; in one line.
        """
        try:
            record = load(self.kind, self.name, folder, self.digest)
            versions = versions_of(self.kind, self.name, record)
        except PluginError as error:
            raise PluginError(f"{self.kind} {self.name}: expected {error}") from error
        if versions != self.versions:
            raise PluginError(
                f"{self.kind} {self.name}: expected {_listed(self.versions)}, "
                f"not {_listed(versions)}"
            )
        return record

    def to_json(self) -> dict[str, Any]:
        """Return it as a store records it."""
        return {
            "kind": self.kind, "name": self.name, "meaning": self.meaning,
            "versions": dict(self.versions), "file": self.file, "digest": self.digest,
            "settings": [setting.to_json() for setting in self.settings],
            "dictionaries": list(self.dictionaries),
            **{name: value for name, kind in TRAITS.items()
               if (value := getattr(self, name)) != kind()},
        }

    @staticmethod
    def from_json(record: Mapping[str, Any]) -> DeclaredPlugin:
        """Return the plug-in of a record; KeyError, TypeError or ValueError if it is none."""
        texts = {key: record[key] for key in ("kind", "name", "meaning", "file", "digest")}
        versions = tuple(sorted(record["versions"].items()))
        dictionaries = tuple(record["dictionaries"])
        traits = {name: kind(record[name]) for name, kind in TRAITS.items() if name in record}
        words = [*texts.values(), *dictionaries, *(word for pair in versions for word in pair)]
        if not all(isinstance(word, str) for word in words) or texts["kind"] not in RECORDS:
            raise TypeError(record["name"])
        return DeclaredPlugin(
            **texts, **traits, versions=versions, dictionaries=dictionaries,
            settings=tuple(Setting.from_json(setting) for setting in record["settings"]),
        )


@dataclass(frozen=True, slots=True)
class PluginSetting:
    """One setting of a plug-in, as a value: the plug-in itself is imported where it is used.

    Attributes
    ----------
    plugin
        The plug-in.
    values
        Name and value of each of its settings.
    folder
        Where its file is.
    """

    plugin: DeclaredPlugin
    values: tuple[tuple[str, Any], ...]
    folder: str

    def record(self) -> Any:
        """Return the plug-in's record; PluginError if it is not the one that was declared."""
        return self.plugin.record(self.folder)

    def instance(self) -> Any:
        """Return its settings as an instance of the plug-in's own dataclass; None without.

        PluginError if the dataclass refuses them.
        """
        settings = self.record().settings
        if settings is None:
            return None
        return call(self.plugin.name, partial(settings, **dict(self.values)))


def recorded_plugins(metadata: Mapping[str, Any]) -> tuple[DeclaredPlugin, ...]:
    """Return the plug-ins that a store's metadata record; none for stores without plug-ins.

    Raises
    ------
    KeyError, TypeError, ValueError, AttributeError
        If they are not what :meth:`DeclaredPlugin.to_json` returns.
    """
    return tuple(DeclaredPlugin.from_json(record) for record in metadata.get(RECORDED, ()))


#: Key of the plug-ins in a store's metadata.
RECORDED = "plugins"


def _listed(versions: tuple[tuple[str, str], ...]) -> str:
    return ", ".join(f"{name} {version}" for name, version in versions) or "none"


def declare(kind: str, name: str, folder: str) -> DeclaredPlugin:
    """Import a plug-in and return its declaration.

    Raises
    ------
    PluginError
        In one line, what was expected instead.
    """
    file = file_of(name)
    record = load(kind, name, folder)
    digest = ""
    if isinstance(record, RecordedDetector):
        digest = record.digest
    elif file is not None:
        digest = hashlib.sha256(read_source(file, folder)).hexdigest()
    dictionaries: tuple[str, ...] = ()
    if isinstance(record, DetectorPlugin) and record.families is not None:
        dictionaries = tuple(record.families)
    return DeclaredPlugin(
        kind, name, record.meaning, versions_of(kind, name, record), file or "", digest,
        tuple(_settings(record)), dictionaries,
        **{name: getattr(record, name) for name in TRAITS if hasattr(record, name)},
    )


#: Fields of records that are known without importing them.
TRAITS: dict[str, type] = {
    "threads": int, "needs_images": bool, "of_boards": bool, "random": bool, "widens": str,
    "step": str,
}


def _settings(record: Plugin) -> Iterator[Setting]:
    """Yield the settings that a plug-in's dataclass declares."""
    if record.settings is None:
        return
    if not dataclasses.is_dataclass(record.settings):
        raise PluginError("settings that are a dataclass")
    try:
        hints = typing.get_type_hints(record.settings)
    except Exception as error:
        raise PluginError(f"settings whose annotations can be read: {error}") from None
    if record.kind == "effect" and not dataclasses.fields(record.settings):
        raise PluginError("settings, of which the first switches the effect on")
    for field in dataclasses.fields(record.settings):
        declaration = field.metadata.get("declaration")
        kinds = plain_types(hints[field.name])
        if (
            not isinstance(declaration, Declared) or declaration.reads is not None
            or not set(kinds) <= set(TYPES.values())
        ):
            raise PluginError(
                f"the setting {field.name} as `name: type = parameter(default, meaning)` with "
                f"one of the types {', '.join(TYPES)}"
            )
        if record.kind in ("effect", "renderer") and str in kinds:
            raise PluginError(f"numbers as settings of {record.kind}s; {field.name} is a text")
        default = field.default
        if default is dataclasses.MISSING:
            raise PluginError(f"a default of the setting {field.name}")
        if default is not None and type(default) is int and kinds == (float,):
            default = float(default)
        yield converted(dataclasses.replace(
            declaration, name=field.name, types=kinds, default=default), Setting)


# --------------------------------------------------------------------------------------------------
# Which plug-ins are installed, and the declaration of one.

def installed() -> list[dict[str, str]]:
    """Return kind, name and distribution of each installed plug-in; none is imported."""
    return [
        {"kind": kind, "name": name, "distribution": distribution}
        for kind in RECORDS
        for name, distribution in sorted({
            (entry.name, entry.dist.name if entry.dist else "")
            for entry in importlib.metadata.entry_points(group=group_of(kind))
        })
    ]


def described(name: str, folder: str = ".") -> list[DeclaredPlugin]:
    """Import the plug-ins of a name, of whichever kinds, and return their declarations.

    Raises
    ------
    ArgumentError
        If there is none, or one cannot be used.
    """
    listed = installed()
    kinds = [each["kind"] for each in listed if each["name"] == name]
    if file_of(name) is None and not kinds:
        hint = nearest(name, [each["name"] for each in listed]) or "; `sweep plugins` lists them"
        raise ArgumentError("name", name, f"no such plug-in{hint}")
    found, faults = [], []
    for kind in kinds or RECORDS:
        try:
            found.append(declare(kind, name, folder))
        except PluginError as error:
            faults.append(str(error))
    if not found or (kinds and faults):
        raise ArgumentError("name", name, f"expected {faults[0]}")
    return found
