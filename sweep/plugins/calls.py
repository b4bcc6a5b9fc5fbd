"""Calls of plug-ins: whatever one raises is an error of its own, in one line."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable
from typing import Any

from sweep.errors import PluginError
from sweep.plugins.loading import exception_line

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
        out, or the user interrupts.
    """
    process, forks = os.getpid(), _forks
    try:
        with contextlib.redirect_stdout(sys.stderr):
            returned = function(*arguments)
    except (KeyboardInterrupt, MemoryError):
        raise
    except BaseException as error:
        raise PluginError(f"{name}: raises {exception_line(error)}") from error
    finally:
        if os.getpid() != process:
            os._exit(1)
    if forks != _forks:
        raise PluginError(f"{name}: forks the process that it runs in; start a program instead")
    return returned
