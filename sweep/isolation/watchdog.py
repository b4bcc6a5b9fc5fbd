"""Time limits that end the process, also if compiled code never returns."""

from __future__ import annotations

import contextlib
import faulthandler
import os
import threading
import time
from collections.abc import Iterator
from typing import Any

from numba.core import event

_lock = threading.RLock()
#: When each limit of this process runs out; several threads may have some at once.
_deadlines: dict[object, float] = {}
_devnull = os.open(os.devnull, os.O_WRONLY)


@contextlib.contextmanager
def ending_after(limit_s: float) -> Iterator[None]:
    """End this process, with exit status 1, if the body takes longer than ``limit_s`` seconds.

    The clock is ``faulthandler``'s: a thread of C that needs no lock of the interpreter, so that
    compiled code that never returns is ended too. The clock stands still while Numba compiles or
    loads code, which takes a minute if nothing is cached. Several threads may have limits at once.
    """
    mine = object()
    with _lock:
        _deadlines[mine] = time.monotonic() + limit_s
        _arm()
    try:
        yield
    finally:
        with _lock:
            del _deadlines[mine]
            _arm()


def _arm() -> None:
    if not _deadlines or _compiling.begun:
        faulthandler.cancel_dump_traceback_later()
        return
    left = max(min(_deadlines.values()) - time.monotonic(), 0.001)
    faulthandler.dump_traceback_later(left, exit=True, file=_devnull)


class _Compiling(event.Listener):
    """Stops the clock while code is compiled."""

    def __init__(self) -> None:
        self.begun: list[float] = []  # one compilation may begin others
        self.total_s = 0.0

    def on_start(self, _event: object) -> None:
        with _lock:
            self.begun.append(time.monotonic())
            _arm()

    def on_end(self, _event: object) -> None:
        with _lock:
            took_s = time.monotonic() - self.begun.pop()
            if not self.begun:
                self.total_s += took_s
                for limit in _deadlines:
                    _deadlines[limit] += took_s
            _arm()


_compiling = _Compiling()
_register: Any = event.register
_register("numba:compile", _compiling)


def compilation_s() -> float:
    """Return the seconds for which this process has compiled or loaded code so far."""
    return _compiling.total_s
