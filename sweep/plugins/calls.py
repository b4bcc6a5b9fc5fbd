"""Calls of plug-ins: whatever one raises is an error of its own, in one line."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable
from typing import Any

from sweep.errors import PluginError
from sweep.plugins.loading import exception_line


def call(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function of the plug-in ``name``; what it prints goes to stderr.

    Raises
    ------
    PluginError
        For whatever it raises, also for an attempt to exit; not if memory runs out, or the user
        interrupts.
    """
    try:
        with contextlib.redirect_stdout(sys.stderr):
            return function(*arguments)
    except (KeyboardInterrupt, MemoryError):
        raise
    except BaseException as error:
        raise PluginError(f"{name}: raises {exception_line(error)}") from error
