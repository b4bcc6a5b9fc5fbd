"""The errors that reach a user: their messages say in lines what to change."""

from __future__ import annotations

import numbers
import os
import socket
from collections.abc import Iterable, Sequence
from typing import Any

from sweep.messages import MAX_LINE_LENGTH, plain

#: Faults of a pipeline that are listed; the others are counted.
MAX_FAULTS = 20


class SweepError(Exception):
    """An error that the user can correct: one line a fault, shown without a traceback.

    Errors whose text is made of parts keep the parts as ``args``, by which another process makes
    them again: their ``__init__`` does not call this one's.
    """


class PipelineError(SweepError):
    """A pipeline that is not valid; the error has all faults at once.

    Parameters
    ----------
    faults
        One line a fault, each naming file, key, value and what was expected. The first
        :data:`MAX_FAULTS` are told, without control characters.
    """

    def __init__(self, faults: Sequence[str]) -> None:
        self.faults = tuple(plain(fault, MAX_LINE_LENGTH) for fault in faults[:MAX_FAULTS])
        if len(faults) > MAX_FAULTS:
            self.faults += (f"... and {len(faults) - MAX_FAULTS:,} faults more",)

    def __str__(self) -> str:
        return "\n".join(self.faults)


class ArgumentError(SweepError, ValueError):
    """An argument that is not valid; it is a ValueError, too. The commands name their flag instead.

    Parameters
    ----------
    argument
        Python's name of the argument, such as ``time_limit_s``.
    value
        The given value.
    problem
        The fault, or the expectation: "expected seconds above 0".

    Examples
    --------
    >>> print(ArgumentError("workers", 0, "expected at least 1"))
    workers = 0: expected at least 1
    """

    def __init__(self, argument: str, value: object, problem: str) -> None:
        self.argument, self.value, self.problem = argument, value, problem

    def __str__(self) -> str:
        given = f" = {plain(self.value, 300)}" if str(self.value) else ""
        return f"{self.argument}{given}: {self.problem}"


#: The most processes of a run: a number beyond is a mistake, for which no machine has the memory.
MAX_WORKERS = 1000


def check_positive(argument: str, value: Any, expected: str = "", most: int = MAX_WORKERS) -> None:
    """Raise ArgumentError unless a value is None, or a number above 0 as it is ``expected``.

    Where no text says what is expected, it is a whole number up to ``most``. Numbers of 1e300 and
    more count as infinite, as everywhere here.
    """
    kind: Any = numbers.Real if expected else numbers.Integral
    if value is not None and not (isinstance(value, kind) and 0 < value < float("inf")
                                  and int(value) <= (10**300 if expected else most)):
        raise ArgumentError(argument, value, expected or f"expected a whole number, 1 to {most:,}")


def path_of(argument: str, given: object) -> str:
    """Return the path or URL that an argument is; ArgumentError if it is none."""
    if not isinstance(given, (str, os.PathLike)):
        raise ArgumentError(argument, " ".join(repr(given)[:60].split()), "expected a path or URL")
    return str(os.fspath(given))


def texts_of(argument: str, given: object, expected: str = "texts") -> list[str]:
    """Return the texts that an argument lists; one that is no list counts as a list of one.

    Raises
    ------
    ArgumentError
        If it is neither.
    """
    texts: list[Any] = [given] if isinstance(given, str) or not (  # nor an array of no dimension
        isinstance(given, Iterable) and getattr(given, "ndim", True)) else [*given]
    if not all(isinstance(each, str) for each in texts):
        raise ArgumentError(argument, " ".join(repr(given)[:60].split()), f"expected {expected}")
    return texts


class StoreError(SweepError):
    """A store that cannot be written, read or continued as asked."""


class DamagedStoreError(StoreError):
    """A store of which a file is missing or changed."""


class DatasetError(StoreError):
    """A dataset that lacks what an analysis needs, or two that do not fit together.

    It is a StoreError because analyses raised that in 0.5: deprecated since 0.6.
    """


class RunError(SweepError):
    """A run that failed; finished blocks stay in the store, and another run continues."""


class MachineFaultError(RunError):
    """A fault of a machine, which no scene's data can cause: it is not a result of the scene.

    It names the machine and the fault (:func:`local_fault`).
    """


def local_fault(fault: str) -> MachineFaultError:
    """Return the error that names a fault of this machine."""
    return MachineFaultError(f"machine fault on {socket.gethostname()}: {plain(fault, 300)}")


class PluginError(SweepError):
    """A plug-in that cannot be used, or that returned what it must not; one line."""
