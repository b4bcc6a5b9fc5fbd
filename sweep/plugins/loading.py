"""Plug-ins: found by entry point or file, declared, loaded, and called."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import importlib.metadata
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from sweep.declaration import Declared, declared_fields
from sweep.errors import ArgumentError, PluginError
from sweep.messages import exception_line, nearest, nearest_file, plain
from sweep.plugins import RECORDS, Plugin, Widens
from sweep.plugins.recording import is_recording, recorded_detector

# --------------------------------------------------------------------------------------------------
# Whatever a plug-in prints goes to stderr, and whatever it raises is an error of its own.

@contextlib.contextmanager
def printing_to_stderr() -> Iterator[None]:
    """Turn the standard output of the process into its standard error, also for compiled code.

    It holds for all threads, so it is not for every call: Python's own prints are redirected there
    (:func:`call`).
    """
    with contextlib.redirect_stdout(sys.stderr), contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):  # there is none
            kept = os.dup(1)
            stack.callback(os.close, kept)
            os.dup2(2, 1)
            stack.callback(os.dup2, kept, 1)
        yield


@contextlib.contextmanager
def _its_faults(begin: str, path: str = "") -> Iterator[None]:
    """Raise PluginError for whatever is raised, also for an attempt to exit: one line.

    The line begins with a text and ends, for a plug-in in a file, with its line of the file. If
    memory runs out, or the user interrupts, that is raised. Workers ignore interrupts: there a
    plug-in raised it itself.
    """
    try:
        yield
    except MemoryError:
        raise
    except BaseException as error:
        ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        if isinstance(error, KeyboardInterrupt) and not ignored:
            raise
        lines = [line for file, line, *_ in traceback.extract_tb(error.__traceback__)
                 if file == path]
        where = f" (line {lines[-1]} of {Path(path).name})" if lines else ""
        raise PluginError(f"{begin} {plain(exception_line(error))}{where}") from error


def call(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function of the plug-in ``name``; its output goes to stderr.

    Raises
    ------
    PluginError
        For whatever it raises, also for an attempt to exit; not if memory runs out, or the user
        interrupts.
    """
    with contextlib.redirect_stdout(sys.stderr), _its_faults(f"{name}: raises"):
        return function(*arguments)


def made(name: str, make: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
    """Return the function that a plug-in's ``make`` returns; raises as :func:`call`."""
    function = call(name, make, *arguments)
    if not callable(function):
        raise PluginError(f"{name}: make returns a {type(function).__name__}, not a function")
    return cast("Callable[..., Any]", function)


def real_numbers(
    name: str, what: str, returned: Any, shape: tuple[int, ...], *, finite: bool = False,
    whole: bool = False,
) -> NDArray[Any]:
    """Return a plug-in's result as a new array of real, or of whole numbers.

    Parameters
    ----------
    name, what
        The plug-in's name, and what it returned, in messages.
    returned
        What it returned.
    shape
        The shape that it must have. One that begins with -1, any number, is that of nothing, too.
    finite
        Whether all numbers must be finite.
    whole
        Whether they must be integers.

    Raises
    ------
    PluginError
        If it is none; also for what NumPy would make numbers of by leaving something away, or by
        guessing: complex numbers, texts, masked values.
    """
    try:
        array = np.asarray(returned)
    except Exception:
        raise PluginError(f"{name}: returned {what} that are no array of numbers") from None
    if shape[0] < 0 and not array.size:
        array = array.reshape(0, *shape[1:])
    kinds, words = ("iu", "whole") if whole else ("biuf", "real")
    for wrong, fault in (
        (np.ma.is_masked(returned), "of which some are masked; expected NaN or none"),
        (array.size and array.dtype.kind not in kinds,
         f"of type {array.dtype}; expected {words} numbers"),
        (shape not in (array.shape, (-1, *array.shape[1:])),
         f"of shape {array.shape}; expected {str(shape).replace('-1', 'n')}"),
    ):
        if wrong:
            raise PluginError(f"{name}: returned {what} {fault}")
    if finite and not np.isfinite(array).all():
        raise PluginError(f"{name}: returned {what} that are not finite")
    return np.array(array, dtype=np.int64 if whole else np.float64)


# --------------------------------------------------------------------------------------------------
# Plug-ins by name: entry points, whose names are read without importing, and files.
#
# A file is executed from the bytes whose digest is taken. It is a module of its own: one that
# imports others beside it is refused, so that the digest says all of it.

#: Its adapters' results change with the version of the numbers, which is recorded in any case.
OWN_DISTRIBUTION = "fiducial-sweep"

#: Distributions and their versions.
Versions = tuple[tuple[str, str], ...]


def offered(kind: str) -> EntryPoints:
    """Return the entry points of the installed plug-ins of a kind; none is imported."""
    return importlib.metadata.entry_points(group=f"sweep.{kind}s")


def _entry_point(kind: str, name: str) -> EntryPoint:
    """Return an installed plug-in's entry point; PluginError if not exactly one has the name."""
    names = sorted(offered(kind).names)
    found = [each for each in offered(kind) if each.name == name]
    if not found:
        hint = nearest(name, names) or f"; installed: {', '.join(names) or 'none'}"
        raise PluginError(f"an installed {kind} plug-in, or file:name beside the pipeline{hint}")
    if len(found) > 1:
        owners = " and ".join(sorted(each.dist.name for each in found if each.dist))
        raise PluginError(f"a name that one distribution offers: {owners} both have it")
    return found[0]


def file_of(name: str) -> str:
    """Return the file that ``file:attribute`` names, relative to the pipeline; "" for others.

    >>> file_of("mine:Detector"), file_of("../own/mine.py:Detector"), file_of("pyapriltags")
    ('mine.py', '../own/mine.py', '')

    A file of recorded detections is its own name.

    >>> file_of("mine.npz")
    'mine.npz'
    """
    module, colon, _ = name.rpartition(":")
    return name if is_recording(name) else f"{module.removesuffix('.py')}.py" if colon else ""


def load(kind: str, name: str, folder: str) -> tuple[Plugin, str, Versions]:
    """Return a plug-in's record, the SHA-256 of its file ("" without), and what it depends on.

    Parameters
    ----------
    kind
        A key of :data:`sweep.plugins.RECORDS`.
    name
        Of an entry point, ``file:attribute``, or a file of recorded detections.
    folder
        Where files are.

    Raises
    ------
    PluginError
        In one line, what was expected instead.
    """
    record: Any = RECORDS[kind]
    path, digest, versions = Path(folder) / file_of(name), "", {}
    if is_recording(name):
        found, digest = recorded_detector(path)
    elif file_of(name):
        try:
            source = path.read_bytes()
        except (OSError, ValueError) as error:
            reason = f"{getattr(error, 'strerror', None) or error}{nearest_file(path)}"
            raise PluginError(
                f"the file {plain(file_of(name))} in {plain(folder)} ({reason}); packages offer "
                "plug-ins by entry points") from None
        digest = hashlib.sha256(source).hexdigest()
        names, attribute = vars(_module(str(path), digest, source)), name.rpartition(":")[2]
        if attribute not in names:
            known = [each for each in names if not each.startswith("_")]
            raise PluginError(f"a name in {path.name}{nearest(attribute, known)}")
        found = names[attribute]
    else:
        entry = _entry_point(kind, name)
        with _its_faults(IMPORTED), printing_to_stderr():
            found = entry.load()
        if entry.dist is not None and entry.dist.name != OWN_DISTRIBUTION:
            versions[entry.dist.name] = entry.dist.version
    if callable(found) and not isinstance(found, Plugin) and kind != "effect":
        found = record(**{record.function: found})
    if not isinstance(found, record):
        raise PluginError(f"a record {record.__name__}, not a value of type {type(found).__name__}")
    needed = found.distribution
    for distribution in [needed] * bool(needed) if isinstance(needed, str) else needed:
        try:
            versions[distribution] = importlib.metadata.version(distribution)
        except importlib.metadata.PackageNotFoundError:
            command = found.install or f"pip install {distribution}"
            raise PluginError(f"the distribution {distribution}, which is not installed: "
                              f"`{command}`") from None
    return found, digest, tuple(sorted(versions.items()))


IMPORTED = "a plug-in that can be imported:"


@lru_cache(maxsize=256)
def _module(path: str, digest: str, source: bytes) -> ModuleType:
    """Execute a file once in each process."""
    name = f"sweep_plugin_{digest[:12]}_{Path(path).stem}"
    module = ModuleType(name)
    module.__file__ = path
    sys.modules[name] = module  # dataclasses find their annotations there
    known = set(sys.modules)
    with _its_faults(IMPORTED, path), printing_to_stderr():
        exec(compile(source, path, "exec"), module.__dict__)  # noqa: S102  (the user's own file)
    folder = Path(path).parent.resolve()
    for other in set(sys.modules) - known:
        file = getattr(sys.modules[other], "__file__", None)
        if file is not None and Path(file).resolve().parent == folder:
            del sys.modules[other]
            raise PluginError(
                f"a plug-in in one file, whose digest is recorded: {Path(path).name} imports "
                f"{Path(file).name} beside it; put both into one, or make a package of them")
    return module


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
    versions: Versions = ()
    file: str = ""
    digest: str = ""
    settings: tuple[Declared, ...] = ()
    dictionaries: tuple[str, ...] = ()
    threads: int = 1
    needs_images: bool = False
    of_boards: bool = False
    random: bool = False
    widens: Widens = "nothing"
    step: Literal["light", "signal"] = "light"

    def record(self, folder: str) -> Any:
        """Return the plug-in's record, imported; ``folder`` is the pipeline's folder.

        Raises
        ------
        PluginError
            If it is not the plug-in that was declared; in one line.
        """
        try:
            record, digest, versions = load(self.kind, self.name, folder)
            if digest != self.digest:
                raise PluginError(
                    f"{self.file} as it was when the run began: it was changed in {folder}")
            if versions != self.versions:
                declared, here = (", ".join(map(" ".join, each)) or "none"
                                  for each in (self.versions, versions))
                raise PluginError(f"{declared}, not {here}")
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
        settings = tuple(
            Declared(**_with_tuples(setting) | {
                "types": tuple(TYPES[kind] for kind in setting["types"])})
            for setting in record["settings"])
        return DeclaredPlugin(**_with_tuples(record) | {
            "versions": tuple(sorted(record["versions"].items())), "settings": settings})


def _with_tuples(table: Mapping[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in table.items()}


def recorded_plugins(metadata: Mapping[str, Any]) -> tuple[DeclaredPlugin, ...]:
    """Return the plug-ins that a store's metadata record; none for stores without plug-ins.

    Raises
    ------
    KeyError, TypeError, ValueError, AttributeError
        If they are not what :meth:`DeclaredPlugin.to_json` returns.
    """
    return tuple(map(DeclaredPlugin.from_json, metadata.get(RECORDED, ())))


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
        return settings and call(self.plugin.name, partial(settings, **dict(self.values)))


def declare(kind: str, name: str, folder: str) -> DeclaredPlugin:
    """Import a plug-in and return its declaration.

    Raises
    ------
    PluginError
        In one line, what was expected instead.
    """
    record, digest, versions = load(kind, name, folder)
    traits = ("threads", "needs_images", "of_boards", "random", "widens", "step")
    return DeclaredPlugin(
        kind, name, record.meaning, versions, file_of(name), digest, _settings(kind, record),
        tuple(getattr(record, "families", None) or ()),
        **{trait: getattr(record, trait) for trait in traits if hasattr(record, trait)},
    )


def _settings(kind: str, record: Plugin) -> tuple[Declared, ...]:
    """Return the settings that a plug-in's dataclass declares."""
    if record.settings is None:
        return ()
    types = [name for name in TYPES if name != "str" or kind not in ("effect", "renderer")]
    declared: list[Declared] = []
    try:
        wrong = [each.name for each in dataclasses.fields(record.settings)
                 if "declaration" not in each.metadata]
        declared += () if wrong else declared_fields(record.settings).values()
        wrong += [each.name for each in declared
                  if each.reads or not {one.__name__ for one in each.types} <= {*types}]
    except Exception as error:
        wrong = [exception_line(error)]
    if wrong:
        raise PluginError(
            f"settings of the {kind} as a dataclass with `name: type = parameter(default, "
            f"meaning)`, of the types {', '.join(types)}; not so: {', '.join(wrong)}")
    if kind == "effect" and not declared:
        raise PluginError("settings, of which the first switches the effect on")
    return tuple(declared)


# --------------------------------------------------------------------------------------------------
# Which plug-ins are installed, and the declaration of one.

def installed() -> list[dict[str, str]]:
    """Return kind, name and distribution of each installed plug-in; none is imported."""
    return [{"kind": kind, "name": each.name, "distribution": each.dist.name if each.dist else ""}
            for kind in RECORDS for each in sorted(offered(kind), key=lambda each: each.name)]


def described(name: str, folder: str = ".") -> list[DeclaredPlugin]:
    """Import the plug-ins of a name, of whichever kinds, and return their declarations.

    Raises
    ------
    ArgumentError
        If there is none, or one cannot be used.
    """
    kinds = [kind for kind in RECORDS if file_of(name) or name in offered(kind).names]
    if not kinds:
        hint = nearest(name, [each["name"] for each in installed()])
        raise ArgumentError(
            "name", name, f"no such plug-in{hint or '; `sweep plugins` lists them'}")
    found, faults = [], []
    for kind in kinds:
        try:
            found.append(declare(kind, name, folder))
        except PluginError as error:
            faults.append(str(error))
    if not found or (faults and not file_of(name)):
        raise ArgumentError("name", name, f"expected {faults[0]}")
    return found
