"""Plug-ins, and recordings of other programs: found by entry point or file, declared, called."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import importlib.metadata
import io
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar, Literal, Self, cast, get_type_hints

import numpy as np
from numpy.typing import NDArray

from sweep.declaration import Declared, check_table, declared_fields
from sweep.errors import ArgumentError, PluginError
from sweep.messages import exception_line, nearest, nearest_file, plain
from sweep.plugins import RECORDS, DetectorPlugin, Markers, Plugin, Widens
from sweep.typing import Floats

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
def _its_faults(begin: str = "a plug-in that can be imported:", path: str = "") -> Iterator[None]:
    """Raise PluginError for whatever is raised, also for an attempt to exit: one line.

    The line begins with a text and ends, for a plug-in in a file, with its line of the file. It is
    that of a MemoryError if memory runs out. If the user interrupts, that is raised; workers ignore
    interrupts: there a plug-in raised it itself.
    """
    ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    try:
        yield
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt) and not ignored:
            raise
        lines = [line for file, line, *_ in traceback.extract_tb(error.__traceback__)
                 if file == path]
        where = f" (line {lines[-1]} of {Path(path).name})" if lines else ""
        kind = MemoryError if isinstance(error, MemoryError) else PluginError
        raise kind(f"{begin} {plain(exception_line(error))}{where}") from error


def call(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function of the plug-in ``name``; its output goes to stderr.

    Raises
    ------
    PluginError
        For whatever it raises, also for an attempt to exit; not if memory runs out, which is a
        MemoryError that names it, or the user interrupts.
    """
    with contextlib.redirect_stdout(sys.stderr), _its_faults(f"{name}: raises"):
        return function(*arguments)


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
    with _its_faults(f"{name}: returned {what} that are no array of numbers:"):
        array = np.asarray(returned)
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
# Files of arrays, the same bytes for the same arrays.

@dataclass(frozen=True, slots=True, eq=False)
class ArrayFile:
    """A dataclass of arrays, tuples of texts, texts and numbers that a ``.npz`` file holds.

    Attributes
    ----------
    meaning
        Description of the file, in words that follow "expected".
    version
        The number in its array ``version``.
    shapes
        Field -> shape of its array: lengths, or letters, each of which stands for one length.
    """

    meaning: ClassVar[str]
    version: ClassVar[int]
    shapes: ClassVar[Mapping[str, tuple[int | str, ...]]]

    def content(self) -> bytes:
        """Return the content of the file: the same bytes for the same attributes."""
        file = io.BytesIO()  # its members have a fixed date
        np.savez_compressed(file, version=self.version, **dataclasses.asdict(self))
        return file.getvalue()

    @classmethod
    def read(cls, path: str | Path) -> tuple[Self, str]:
        """Return what a file holds, and the file's SHA-256; it is read once in each process.

        Raises
        ------
        PluginError
            If it cannot be read, or is none; in words that follow "expected".
        """
        with reading(cls.meaning, Path(path)):
            state = Path(path).stat()
            read: tuple[Self, str] = _read(
                cast("Any", cls), str(path), state.st_mtime_ns, state.st_size)
        return read


@contextlib.contextmanager
def reading(what: str, path: Path) -> Iterator[None]:
    """Raise PluginError, in words that follow "expected", if the file of something is at fault."""
    try:
        yield
    except Exception as error:
        reason = getattr(error, "strerror", None) or exception_line(error)
        raise PluginError(
            f"{what} in {plain(path.parent)} ({plain(reason)}{nearest_file(path)})") from None


@lru_cache(maxsize=16)
def _read(
    kind: type[ArrayFile], path: str, modified_ns: int, size: int  # noqa: ARG001  (the key)
) -> Any:
    """Return what a file holds, and its SHA-256; any exception if it is none."""
    content, hints = Path(path).read_bytes(), get_type_hints(kind)
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        arrays = dict(archive)
    if arrays.pop("version") != kind.version:
        raise ValueError("of another version")
    record = kind(**{
        name: hints[name](array.item()) if array.ndim == 0
        else tuple(array.tolist()) if array.dtype.kind == "U" else array
        for name, array in arrays.items()})
    lengths: dict[int | str, int] = {}
    for name, shape in kind.shapes.items():
        found = np.shape(getattr(record, name))
        lengths = dict(zip(shape, found, strict=False)) | lengths
        wanted = tuple(each if isinstance(each, int) else lengths.get(each, each) for each in shape)
        if found != wanted:
            raise ValueError(f"{name}: expected the shape {wanted}, not {found}")
    return record, hashlib.sha256(content).hexdigest()


# --------------------------------------------------------------------------------------------------
# Recorded detections as a detector.
#
# What another program found in exported images is a detector: `sweep score` writes a recording of
# it, which pipelines name as a file `.npz`.

SUFFIX = ".npz"

#: The ID of a candidate that was not decoded.
REJECTED = -1

#: The ID of a pose that is of the target as a whole, not of one of its markers.
OF_TARGET = -2


@dataclass(frozen=True, slots=True, eq=False)
class Recording(ArrayFile):
    """Detections of M markers in exported images: frame's pixels, OpenCV's conventions.

    Attributes
    ----------
    exported
        Sorted keys of all images that were exported.
    image
        (M,) sorted keys of the images with the markers.
    marker_id
        (M,) IDs; :data:`REJECTED` for candidates that were not decoded, :data:`OF_TARGET` for poses
        of the target as a whole.
    corners
        (M, 4, 2) px in the frame; NaN where only a pose was given.
    rotation, translation
        (M, 3, 3) and (M, 3): poses, target to camera, metres; NaN where only corners were given.
    """

    meaning = "detections that `sweep score` recorded"
    version = 1
    shapes = {  # noqa: RUF012
        "exported": ("images",), "image": ("M",), "marker_id": ("M",), "corners": ("M", 4, 2),
        "rotation": ("M", 3, 3), "translation": ("M", 3)}
    exported: NDArray[np.uint64]
    image: NDArray[np.uint64]
    marker_id: NDArray[np.int64]
    corners: Floats
    rotation: Floats
    translation: Floats

    def rows(self, key: np.uint64) -> slice:
        """Return the rows of an image.

        Raises
        ------
        PluginError
            If the image was not exported.
        """
        listed, rows = (
            slice(*(int(np.searchsorted(keys, key, side)) for side in ("left", "right")))
            for keys in (self.exported, self.image))
        if listed.start == listed.stop:
            raise PluginError(
                "its image is not among those that were exported; export it, and score again")
        return rows


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedDetector(DetectorPlugin):
    """A detector whose detections are those of a recording, whatever the image."""

    recording: Recording


def is_recording(name: str) -> bool:
    """Return whether a detector's name is the file of recorded detections.

    >>> is_recording("mine.npz"), is_recording("opencv")
    (True, False)
    """
    return name.endswith(SUFFIX)


# --------------------------------------------------------------------------------------------------
# Plug-ins by name: entry points, whose names are read without importing, and files.
#
# A file is executed from the bytes whose digest is taken. It is a module of its own: one that
# imports others beside it is refused, so that the digest says all of it.

#: Distributions and their versions.
Versions = tuple[tuple[str, str], ...]


def offered(kind: str) -> importlib.metadata.EntryPoints:
    """Return the entry points of the installed plug-ins of a kind; none is imported."""
    return importlib.metadata.entry_points(group=f"sweep.{kind}s")


def _entry_point(kind: str, name: str) -> importlib.metadata.EntryPoint:
    """Return an installed plug-in's entry point; PluginError if not exactly one has the name."""
    entries, names = offered(kind), sorted(offered(kind).names)
    found = tuple(entries.select(name=name))
    if len(found) == 1:
        return found[0]
    if found:
        owners = " and ".join(sorted(each.dist.name for each in found if each.dist))
        raise PluginError(f"a name that one distribution offers: {owners} both have it")
    hint = nearest(name, names) or f"; installed: {', '.join(names) or 'none'}"
    raise PluginError(f"an installed {kind} plug-in, or file:name beside the pipeline{hint}")


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
        recording, digest = Recording.read(path)
        found = RecordedDetector(
            make=lambda settings, family: lambda image: Markers((), ()),  # noqa: ARG005
            margin_px=0, meaning="detections that another program made", recording=recording)
    elif file_of(name):
        with reading(f"the file {plain(file_of(name))}", path):
            source = path.read_bytes()
        digest = hashlib.sha256(source).hexdigest()
        names, attribute = vars(_module(str(path), digest, source)), name.rpartition(":")[2]
        if attribute not in names:
            raise PluginError(f"a name in {path.name}{nearest(attribute, names)}")
        found = names[attribute]
    else:
        entry = _entry_point(kind, name)
        with _its_faults(), printing_to_stderr():
            found = entry.load()
        # Our adapters' results change with the version of the numbers, which is recorded anyway.
        if entry.dist is not None and entry.dist.name != "fiducial-sweep":
            versions[entry.dist.name] = entry.dist.version
    if callable(found) and not isinstance(found, Plugin) and kind != "effect":
        found = record(**{"render" if kind == "renderer" else "make": found})
    if not isinstance(found, record):
        raise PluginError(f"a record {record.__name__}, not a value of type {type(found).__name__}")
    needed = found.distribution
    for distribution in (needed,) * bool(needed) if isinstance(needed, str) else needed:
        try:
            versions[distribution] = importlib.metadata.version(distribution)
        except Exception:  # also of what is no name
            command = found.install or f"pip install {distribution}"
            raise PluginError(f"the distribution {distribution}, which is not installed: "
                              f"`{command}`") from None
    return found, digest, tuple(sorted(versions.items()))


@lru_cache(maxsize=256)
def _module(path: str, digest: str, source: bytes) -> ModuleType:
    """Execute a file once in each process."""
    name = f"sweep_plugin_{digest[:12]}_{Path(path).stem}"
    module = ModuleType(name)
    module.__file__ = path
    sys.modules[name] = module  # dataclasses find their annotations there
    known = set(sys.modules)
    with _its_faults(path=path), printing_to_stderr():
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

#: Declarations that are taken over from a plug-in's record.
TRAITS = ("needs_images", "of_boards", "random", "widens", "step")

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
        settings = [  # what is not given is left out
            {key: value for key, value in vars(setting).items()
             if value != getattr(Declared, key, dataclasses.MISSING)}
            | {"types": [kind.__name__ for kind in setting.types]} for setting in self.settings]
        return dataclasses.asdict(self) | {"versions": dict(self.versions), "settings": settings}


def recorded_plugins(metadata: Mapping[str, Any]) -> tuple[DeclaredPlugin, ...]:
    """Return the plug-ins that a store's metadata record; none for stores without plug-ins.

    Raises
    ------
    KeyError, TypeError, ValueError, AttributeError
        If they are not what :meth:`DeclaredPlugin.to_json` returns.
    """
    def fields(table: Mapping[str, Any], **others: Any) -> dict[str, Any]:
        return {key: tuple(value) if isinstance(value, list) else value
                for key, value in table.items()} | others

    plugins = []
    for plugin in metadata.get(RECORDED, ()):
        settings = tuple(
            Declared(**fields(each, types=tuple(TYPES[kind] for kind in each["types"])))
            for each in plugin["settings"])
        versions = tuple(sorted(plugin["versions"].items()))
        plugins.append(DeclaredPlugin(**fields(plugin, versions=versions, settings=settings)))
    return tuple(plugins)


def declare(kind: str, name: str, folder: str) -> DeclaredPlugin:
    """Import a plug-in and return its declaration.

    Raises
    ------
    PluginError
        In one line, what was expected instead.
    """
    record, digest, versions = load(kind, name, folder)
    return DeclaredPlugin(
        kind, name, record.meaning, versions, file_of(name), digest, _settings(kind, record),
        tuple(map(str, getattr(record, "families", None) or ())),
        **{trait: value for trait, value in vars(record).items() if trait in TRAITS})


def _settings(kind: str, record: Plugin) -> tuple[Declared, ...]:
    """Return the settings that a plug-in's dataclass declares.

    Of NumPy's numbers and of members of enumerations, plain numbers and texts are declared: a store
    records them, and other processes do not know the plug-in's types.
    """
    types = [name for name in TYPES if name != "str" or kind not in ("effect", "renderer")]
    expected = f"settings of the {kind} as a dataclass of parameters, not so:"
    with _its_faults(expected):
        fields = dataclasses.fields(record.settings) if record.settings else ()
        faults = [f"{each.name}: expected `{each.name}: type = parameter(default, meaning)`"
                  for each in fields if getattr(each.metadata.get("declaration"), "reads", True)]
        declared = declared_fields(record.settings) if record.settings and not faults else {}
        for name, each in declared.items():
            default, *choices = ("".join(one) if isinstance(one, str) else np.array(one).tolist()
                                 for one in (each.default, *each.choices))
            declared[name] = dataclasses.replace(each, default=default, choices=tuple(choices))
            faults += [f"{name}: expected {words}" for fits, words in (
                ({*each.types} <= {*map(TYPES.get, types)}, f"a type of {', '.join(types)}"),
                ({type(each.meaning), type(each.unit)} == {str}, "meaning and unit as texts"),
                ({isinstance(one, str) for one in choices} <= {str in each.types},
                 f"choices that are {'texts' if str in each.types else 'numbers'}, as its values"),
            ) if not fits]
        given = {name: each.default for name, each in declared.items() if each.default is not None}
        faults = faults or check_table(declared, given, "")[1]
    if faults:
        raise PluginError(f"{expected} {'; '.join(faults)}")
    if kind == "effect" and not declared:
        raise PluginError("settings, of which the first switches the effect on")
    return tuple(declared.values())


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
    found, faults = [], []
    for kind in [each for each in RECORDS if file_of(name) or name in offered(each).names]:
        try:
            found.append(declare(kind, name, folder))
        except PluginError as error:
            faults.append(f"expected {error}")
    if not found or (faults and not file_of(name)):
        hint = nearest(name, [each["name"] for each in installed()])
        faults.append(f"no such plug-in{hint or '; `sweep plugins` lists them'}")
        raise ArgumentError("name", name, faults[0])
    return found
