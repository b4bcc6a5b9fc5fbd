"""Plug-ins: found by entry point or file, loaded, and called."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import importlib.util
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
from sweep.messages import nearest, nearest_file, plain
from sweep.plugins import FACTORY, RECORDS, Plugin
from sweep.plugins.recording import is_recording, recorded_detector

# --------------------------------------------------------------------------------------------------
# Output of plug-ins goes to the standard error: the standard output belongs to the command.

@contextlib.contextmanager
def printing_to_stderr() -> Iterator[None]:
    """Turn the standard output of the process into its standard error, also for compiled code.

    It holds for all threads, so it is not for every call: Python's own prints are redirected there
    (:func:`sweep.plugins.loading.call`).
    """
    with contextlib.redirect_stdout(sys.stderr):
        try:
            kept = os.dup(1)
        except OSError:  # there is none
            yield
            return
        try:
            with contextlib.suppress(OSError, ValueError, AttributeError):
                if sys.__stdout__ is not None:
                    sys.__stdout__.flush()
            with contextlib.suppress(OSError):
                os.dup2(2, 1)
            yield
        finally:
            os.dup2(kept, 1)
            os.close(kept)


# --------------------------------------------------------------------------------------------------
# Plug-ins by name: entry points, whose names are read without importing, and files.
#
# A file is executed from the bytes whose digest is taken. It is a module of its own: one that
# imports others beside it is refused, so that the digest says all of it.

#: Its adapters' results change with the version of the numbers, which is recorded in any case.
OWN_DISTRIBUTION = "fiducial-sweep"

MAX_SOURCE_BYTES = 1 << 20


def group_of(kind: str) -> str:
    """Return the group of entry points of a kind of plug-in."""
    return f"sweep.{kind}s"


def installed_names(kind: str) -> list[str]:
    """Return the names of the installed plug-ins of a kind, in order; none is imported."""
    return sorted({entry.name for entry in importlib.metadata.entry_points(group=group_of(kind))})


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


def load(kind: str, name: str, folder: str, digest: str = "") -> Plugin:
    """Return a plug-in's record.

    Parameters
    ----------
    kind
        A key of :data:`sweep.plugins.RECORDS`.
    name
        Of an entry point, or ``module:attribute``.
    folder
        Where files are.
    digest
        The SHA-256 that the file must have; empty for any.

    Raises
    ------
    PluginError
        In one line, what was expected instead.
    """
    file = file_of(name)
    if file is None:
        return _of_entry_point(kind, name)
    if is_recording(name):
        recorded = recorded_detector(name, folder)
        if digest and recorded.digest != digest:
            raise PluginError(f"{file} as it was when the run began: it was changed in {folder}")
        return recorded
    source = read_source(file, folder)
    found = hashlib.sha256(source).hexdigest()
    if digest and found != digest:
        raise PluginError(f"{file} as it was when the run began: it was changed in {folder}")
    return _of_file(kind, name, str(Path(folder) / file), found, source)


def read_source(file: str, folder: str) -> bytes:
    """Return the content of a plug-in's file; PluginError if it cannot be read."""
    try:
        path = Path(folder) / file
        if path.exists() and not path.is_file():
            raise ValueError("not a regular file")
        if path.stat().st_size > MAX_SOURCE_BYTES:
            raise PluginError(f"a file of at most {MAX_SOURCE_BYTES:,} bytes ({file})")
        return path.read_bytes()
    except (OSError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or error
        reason = f"{reason}{nearest_file(Path(folder) / file)}"
        raise PluginError(
            f"the file {plain(file)} in {plain(folder)} ({reason}); packages offer plug-ins by "
            "entry points"
        ) from None


def entry_point(kind: str, name: str) -> EntryPoint:
    """Return the entry point of an installed plug-in.

    Raises
    ------
    PluginError
        If there is none, or several distributions offer the name.
    """
    offered = {
        (entry.value, entry.dist.name if entry.dist else ""): entry
        for entry in importlib.metadata.entry_points(group=group_of(kind), name=name)
    }
    if not offered:
        names = installed_names(kind)
        hint = nearest(name, names) or f"; installed: {', '.join(names) or 'none'}"
        raise PluginError(f"an installed {kind} plug-in, or file:name beside the pipeline{hint}")
    if len(offered) > 1:
        owners = " and ".join(sorted(owner for _, owner in offered))
        raise PluginError(f"a name that one distribution offers: {owners} both have it")
    return next(iter(offered.values()))


@lru_cache(maxsize=256)
def _of_entry_point(kind: str, name: str) -> Plugin:
    entry = entry_point(kind, name)
    with _import_faults(), printing_to_stderr():
        found = entry.load()
    return _record(kind, found)


@lru_cache(maxsize=256)
def _of_file(kind: str, name: str, path: str, digest: str, source: bytes) -> Plugin:
    module = _module(path, digest, source)
    attribute = name.rpartition(":")[2]
    if not hasattr(module, attribute):
        known = [each for each in vars(module) if not each.startswith("_")]
        raise PluginError(f"a name in {Path(path).name}{nearest(attribute, known)}")
    return _record(kind, getattr(module, attribute))


@lru_cache(maxsize=256)
def _module(path: str, digest: str, source: bytes) -> ModuleType:
    """Execute a file once in each process."""
    name = f"sweep_plugin_{digest[:12]}_{Path(path).stem}"
    module = ModuleType(name)
    module.__file__ = path
    sys.modules[name] = module  # dataclasses find their annotations there
    known = set(sys.modules)
    with _import_faults(path), printing_to_stderr():
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


@contextlib.contextmanager
def _import_faults(path: str = "") -> Iterator[None]:
    """Raise PluginError for whatever importing a plug-in raises, also for an attempt to exit."""
    try:
        yield
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        lines = [line for file, line, *_ in traceback.extract_tb(error.__traceback__)
                 if file == path]
        if isinstance(error, SyntaxError):
            lines = [error.lineno or 0]
        where = f" (line {lines[-1]} of {Path(path).name})" if path and lines else ""
        raise PluginError(
            f"a plug-in that can be imported: {exception_line(error)}{where}"
        ) from error


def exception_line(error: BaseException) -> str:
    """Return an exception as one line: its type, and the first line of its message."""
    text = str(error).strip().partition("\n")[0]
    return plain(f"{type(error).__name__}: {text}" if text else type(error).__name__)


def _record(kind: str, found: Any) -> Plugin:
    """Return the record that a name leads to; a class or function is its factory."""
    wanted: Any = RECORDS[kind]
    if isinstance(found, Plugin) and isinstance(found, wanted):
        return found
    if isinstance(found, Plugin) or not callable(found) or kind not in FACTORY:
        raise PluginError(f"a record {wanted.__name__}, not a value of type {type(found).__name__}")
    made: Plugin = wanted(**{FACTORY[kind]: found})
    return made


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
        owner = entry_point(kind, name).dist
        if owner is not None and owner.name != OWN_DISTRIBUTION:
            versions[owner.name] = owner.version
    return tuple(sorted(versions.items()))


# --------------------------------------------------------------------------------------------------
# Calls of plug-ins: whatever one raises is an error of its own, in one line.

def call(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function of the plug-in ``name``; its output goes to stderr.

    A copy of this process that it leaves running ends here, before it does our work a second time.

    Raises
    ------
    PluginError
        For whatever it raises, also for an attempt to exit; not if memory runs out, or the user
        interrupts. Workers ignore interrupts: there it raised that itself.
    """
    process = os.getpid()
    try:
        with contextlib.redirect_stdout(sys.stderr):
            return function(*arguments)
    except MemoryError:
        raise
    except BaseException as error:
        ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        if isinstance(error, KeyboardInterrupt) and not ignored:
            raise  # the user's
        raise PluginError(f"{name}: raises {exception_line(error)}") from error
    finally:
        if os.getpid() != process:
            os._exit(1)


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
