"""Time limits that end the process, also if compiled code never returns."""

from __future__ import annotations

import contextlib
import faulthandler
import itertools
import os
import threading
import time
from collections.abc import Iterator
from typing import Any

import numba.core.event

_lock = threading.RLock()
_deadlines: dict[int, float] = {}
_numbers = itertools.count()
_devnull = os.open(os.devnull, os.O_WRONLY)


@contextlib.contextmanager
def ending_after(limit_s: float) -> Iterator[None]:
    """End this process, with exit status 1, if the body takes longer than ``limit_s`` seconds.

    The clock is ``faulthandler``'s: a thread of C that needs no lock of the interpreter, so that
    compiled code that never returns is ended too. The clock stands still while Numba compiles or
    loads code, which takes a minute if nothing is cached. Several threads may have limits at once.
    """
    number = next(_numbers)
    with _lock:
        _deadlines[number] = time.monotonic() + limit_s
        _arm()
    try:
        yield
    finally:
        with _lock:
            del _deadlines[number]
            _arm()


def _arm() -> None:
    if not _deadlines or _Compiling.depth:
        faulthandler.cancel_dump_traceback_later()
        return
    left = max(min(_deadlines.values()) - time.monotonic(), 0.001)
    faulthandler.dump_traceback_later(left, exit=True, file=_devnull)


class _Compiling(numba.core.event.Listener):
    """Stops the clock while code is compiled; one compilation may begin others."""

    depth = 0
    began = 0.0
    total_s = 0.0

    def on_start(self, event: object) -> None:  # noqa: ARG002
        with _lock:
            if not _Compiling.depth:
                _Compiling.began = time.monotonic()
            _Compiling.depth += 1
            _arm()

    def on_end(self, event: object) -> None:  # noqa: ARG002
        with _lock:
            _Compiling.depth -= 1
            if not _Compiling.depth:
                took = time.monotonic() - _Compiling.began
                _Compiling.total_s += took
                for number in _deadlines:
                    _deadlines[number] += took
            _arm()


def compilation_s() -> float:
    """Return the seconds for which this process has compiled or loaded code so far."""
    return _Compiling.total_s


_register: Any = numba.core.event.register
_register("numba:compile", _Compiling())
