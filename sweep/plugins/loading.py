"""Plug-ins: found by entry point or file, loaded, and called."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from functools import lru_cache
from importlib.metadata import EntryPoint, PackageNotFoundError
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from sweep.errors import PluginError
from sweep.messages import exception_line, nearest, nearest_file, plain
from sweep.plugins import RECORDS, Plugin
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
                 if path and file == path]
        if isinstance(error, SyntaxError):
            lines = [error.lineno or 0]
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
    name: str, what: str, returned: Any, shape: tuple[int, ...] = (), *,
    finite: bool = False, whole: bool = False,
) -> NDArray[Any]:
    """Return a plug-in's result as a new array of real, or of whole numbers.

    Parameters
    ----------
    name, what
        The plug-in's name, and what it returned, in messages.
    returned
        What it returned.
    shape
        The shape that it must have; () for any. One that begins with -1, any number, is that of
        nothing, too.
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
    if np.ma.is_masked(returned):
        raise PluginError(f"{name}: returned {what} of which some are masked; expected NaN or none")
    kinds, words = ("iu", "whole") if whole else ("biuf", "real")
    if array.size and array.dtype.kind not in kinds:
        raise PluginError(
            f"{name}: returned {what} of type {array.dtype}; expected {words} numbers")
    if shape[:1] == (-1,) and not array.size:
        array = array.reshape(0, *shape[1:])
    if shape and array.shape != shape and (-1, *array.shape[1:]) != shape:
        expected = str(shape).replace("-1", "n")
        raise PluginError(f"{name}: returned {what} of shape {array.shape}; expected {expected}")
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


def offered(kind: str) -> list[EntryPoint]:
    """Return the entry points of the installed plug-ins of a kind, by name; none is imported."""
    found = importlib.metadata.entry_points(group=f"sweep.{kind}s")
    # A folder that is twice on the path has all of its own twice.
    unlike = {(entry.name, entry.value, owner(entry)): entry for entry in found}
    return [unlike[key] for key in sorted(unlike)]


def owner(entry: EntryPoint) -> str:
    """Return the distribution that has an entry point."""
    return entry.dist.name if entry.dist else ""


def entry_point(kind: str, name: str) -> EntryPoint:
    """Return the entry point of an installed plug-in.

    Raises
    ------
    PluginError
        If there is none, or several distributions offer the name.
    """
    entries = offered(kind)
    found = [entry for entry in entries if entry.name == name]
    if not found:
        names = sorted({entry.name for entry in entries})
        hint = nearest(name, names) or f"; installed: {', '.join(names) or 'none'}"
        raise PluginError(f"an installed {kind} plug-in, or file:name beside the pipeline{hint}")
    if len(found) > 1:
        owners = " and ".join(sorted(map(owner, found)))
        raise PluginError(f"a name that one distribution offers: {owners} both have it")
    return found[0]


def file_of(name: str) -> str | None:
    """Return the file that ``module:attribute`` names, relative to the pipeline; None for others.

    >>> file_of("mine:Detector"), file_of("../own/mine:Detector"), file_of("pyapriltags")
    ('mine.py', '../own/mine.py', None)

    A file of recorded detections is its own name.

    >>> file_of("mine.npz")
    'mine.npz'
    """
    module, colon, _ = name.rpartition(":")
    if is_recording(name):
        return name
    if not colon:
        return None
    if module.endswith(".py"):
        return module
    return f"{module if '/' in module else module.replace('.', '/')}.py"


def load(kind: str, name: str, folder: str) -> tuple[Plugin, str]:
    """Return a plug-in's record, and the SHA-256 of its file; empty for an installed one.

    Parameters
    ----------
    kind
        A key of :data:`sweep.plugins.RECORDS`.
    name
        Of an entry point, ``module:attribute``, or a file of recorded detections.
    folder
        Where files are.

    Raises
    ------
    PluginError
        In one line, what was expected instead.
    """
    file, digest = file_of(name), ""
    if file is None:
        entry = entry_point(kind, name)
        with _its_faults(IMPORTED), printing_to_stderr():
            found = entry.load()
    elif is_recording(name):
        found, digest = recorded_detector(Path(folder) / file)
    else:
        path = Path(folder) / file
        try:
            source = path.read_bytes()
        except (OSError, ValueError) as error:
            reason = f"{getattr(error, 'strerror', None) or error}{nearest_file(path)}"
            raise PluginError(
                f"the file {plain(file)} in {plain(folder)} ({reason}); packages offer plug-ins by "
                "entry points"
            ) from None
        digest = hashlib.sha256(source).hexdigest()
        module, attribute = _module(str(path), digest, source), name.rpartition(":")[2]
        if not hasattr(module, attribute):
            known = [each for each in vars(module) if not each.startswith("_")]
            raise PluginError(f"a name in {path.name}{nearest(attribute, known)}")
        found = getattr(module, attribute)
    record: Any = RECORDS[kind]
    if isinstance(found, record):
        return cast("Plugin", found), digest
    if isinstance(found, Plugin) or not callable(found) or kind == "effect":
        raise PluginError(f"a record {record.__name__}, not a value of type {type(found).__name__}")
    return record(**{record.function: found}), digest


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
        file = getattr(sys.modules.get(other), "__file__", None)
        if file is not None and Path(file).resolve().parent == folder:
            del sys.modules[other]
            raise PluginError(
                f"a plug-in in one file, whose digest is recorded: {Path(path).name} imports "
                f"{Path(file).name} beside it; put both into one, or make a package of them"
            )
    return module


def versions_of(kind: str, name: str, record: Plugin) -> tuple[tuple[str, str], ...]:
    """Return the distributions that a plug-in's results depend on, with their versions.

    Raises
    ------
    PluginError
        If one is not installed.
    """
    versions = {}
    for distribution in record.distributions:
        try:
            versions[distribution] = importlib.metadata.version(distribution)
        except PackageNotFoundError:
            command = record.install or f"pip install {distribution}"
            raise PluginError(
                f"the distribution {distribution}, which is not installed: `{command}`"
            ) from None
    if file_of(name) is None:
        dist = entry_point(kind, name).dist
        if dist is not None and dist.name != OWN_DISTRIBUTION:
            versions[dist.name] = dist.version
    return tuple(sorted(versions.items()))
