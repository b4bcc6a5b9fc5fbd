"""What pipelines and stores know of plug-ins without importing them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from sweep.declaration import Declared, declared_fields
from sweep.errors import ArgumentError, PluginError
from sweep.messages import exception_line, nearest
from sweep.plugins import RECORDS, DetectorPlugin, Plugin
from sweep.plugins.loading import call, file_of, load, offered, owner, versions_of

# --------------------------------------------------------------------------------------------------
# A plug-in as pipelines and stores know it: all that can be said of it without importing it.

#: Types that a setting may have.
TYPES: dict[str, type] = {"float": float, "int": int, "bool": bool, "str": str}

#: Key of the plug-ins in a store's metadata.
RECORDED = "plugins"


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
    settings: tuple[Declared, ...] = ()
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
            record, digest = load(self.kind, self.name, folder)
            if digest != self.digest:
                raise PluginError(
                    f"{self.file} as it was when the run began: it was changed in {folder}")
            versions = versions_of(self.kind, self.name, record)
            if versions != self.versions:
                raise PluginError(f"{_listed(self.versions)}, not {_listed(versions)}")
        except PluginError as error:
            raise PluginError(f"{self.kind} {self.name}: expected {error}") from error
        return record

    def to_json(self) -> dict[str, Any]:
        """Return it as a store records it."""
        settings = [
            {field.name: value for field in dataclasses.fields(setting)
             if (value := getattr(setting, field.name)) != field.default}
            | {"types": [kind.__name__ for kind in setting.types]}
            for setting in self.settings
        ]
        return dataclasses.asdict(self) | {"versions": dict(self.versions), "settings": settings}

    @staticmethod
    def from_json(record: Mapping[str, Any]) -> DeclaredPlugin:
        """Return the plug-in of a record; AttributeError, KeyError or TypeError if it is none."""
        settings: list[dict[str, Any]] = [
            {key: tuple(value) if isinstance(value, list) else value
             for key, value in setting.items()}
            | {"types": tuple(TYPES[kind] for kind in setting["types"])}
            for setting in record["settings"]
        ]
        return DeclaredPlugin(**{
            **record, "versions": tuple(sorted(record["versions"].items())),
            "settings": tuple(Declared(**setting) for setting in settings),
            "dictionaries": tuple(record["dictionaries"]),
        })


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


def _listed(versions: tuple[tuple[str, str], ...]) -> str:
    return ", ".join(f"{name} {version}" for name, version in versions) or "none"


#: Fields of records that are known without importing them.
TRAITS = ("threads", "needs_images", "of_boards", "random", "widens", "step")


def declare(kind: str, name: str, folder: str) -> DeclaredPlugin:
    """Import a plug-in and return its declaration.

    Raises
    ------
    PluginError
        In one line, what was expected instead.
    """
    record, digest = load(kind, name, folder)
    families = record.families if isinstance(record, DetectorPlugin) else None
    return DeclaredPlugin(
        kind, name, record.meaning, versions_of(kind, name, record), file_of(name) or "", digest,
        _settings(record), tuple(families or ()),
        **{name: getattr(record, name) for name in TRAITS if hasattr(record, name)},
    )


def _settings(record: Plugin) -> tuple[Declared, ...]:
    """Return the settings that a plug-in's dataclass declares."""
    if record.settings is None:
        return ()
    types = [name for name in TYPES if name != "str" or record.kind not in ("effect", "renderer")]
    declared: list[Declared] = []
    try:
        wrong = [each.name for each in dataclasses.fields(record.settings)
                 if "declaration" not in each.metadata]
        declared += () if wrong else declared_fields(record.settings).values()
        wrong += [each.name for each in declared if each.default is dataclasses.MISSING
                  or each.reads or not {kind.__name__ for kind in each.types} <= set(types)]
    except Exception as error:
        wrong = [exception_line(error)]
    if wrong:
        raise PluginError(
            f"settings of the {record.kind} as a dataclass with `name: type = parameter(default, "
            f"meaning)`, of the types {', '.join(types)}; not so: {', '.join(wrong)}")
    if record.kind == "effect" and not declared:
        raise PluginError("settings, of which the first switches the effect on")
    return tuple(
        dataclasses.replace(each, default=float(each.default))
        if each.types == (float,) and type(each.default) is int else each for each in declared)


# --------------------------------------------------------------------------------------------------
# Which plug-ins are installed, and the declaration of one.

def installed() -> list[dict[str, str]]:
    """Return kind, name and distribution of each installed plug-in; none is imported."""
    return [{"kind": kind, "name": entry.name, "distribution": owner(entry)}
            for kind in RECORDS for entry in offered(kind)]


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
