"""Calls of plug-ins: whatever one raises is an error of its own, in one line."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from sweep.errors import PluginError
from sweep.plugins.loading import exception_line
from sweep.typing import Floats

_forks = 0
"""How often this process was forked by Python's own function."""


def _count_fork() -> None:
    global _forks  # noqa: PLW0603  (the process has one count)
    _forks += 1


os.register_at_fork(after_in_parent=_count_fork)


def call(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function of the plug-in ``name``; what it prints goes to stderr.

    A copy of this process that it leaves running ends here, before it does our work a second time.

    Raises
    ------
    PluginError
        For whatever it raises, also for an attempt to exit, and if it forks; not if memory runs
        out, or the user interrupts. Workers ignore interrupts: there it raised that itself.
    """
    process, forks = os.getpid(), _forks
    try:
        with contextlib.redirect_stdout(sys.stderr):
            returned = function(*arguments)
    except MemoryError:
        raise
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt) and not _ignores_interrupts():
            raise  # the user's
        raise PluginError(f"{name}: raises {exception_line(error)}") from error
    finally:
        if os.getpid() != process:
            os._exit(1)
    if forks != _forks:
        raise PluginError(f"{name}: forks the process that it runs in; start a program instead")
    return returned


def _ignores_interrupts() -> bool:
    return signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def real_numbers(name: str, what: str, returned: Any) -> Floats:
    """Return what a plug-in returned as a new array of real numbers.

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
    if array.dtype.kind not in "biuf":
        raise PluginError(
            f"{name}: returned {what} of type {array.dtype}; expected real numbers")
    return np.array(array, dtype=np.float64)
