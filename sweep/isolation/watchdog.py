"""Time limits that end the process, also if compiled code never returns."""

from __future__ import annotations

import contextlib
import faulthandler
import os
import threading
import time
from collections.abc import Iterator

from numba.core import event

_lock = threading.RLock()
#: When each limit of this process runs out, by :func:`_clock_s`; several threads may have some.
_ends: list[float] = []
_devnull = os.open(os.devnull, os.O_WRONLY)


@contextlib.contextmanager
def ending_after(limit_s: float) -> Iterator[None]:
    """End this process, with exit status 1, if the body takes longer than ``limit_s`` seconds.

    The clock is ``faulthandler``'s: a thread of C that needs no lock of the interpreter, so that
    compiled code that never returns is ended too. The clock stands still while Numba compiles or
    loads code, which takes a minute if nothing is cached. Several threads may have limits at once.
    """
    with _lock:
        end = _clock_s() + limit_s
        _ends.append(end)
        _arm()
    try:
        yield
    finally:
        with _lock:
            _ends.remove(end)
            _arm()


def _arm() -> None:
    if not _ends or _compiling.depth:
        faulthandler.cancel_dump_traceback_later()
    else:
        left_s = max(min(_ends) - _clock_s(), 0.001)
        faulthandler.dump_traceback_later(left_s, exit=True, file=_devnull)


class _Compiling(event.Listener):
    """Stops the clock while code is compiled; one compilation may begin others."""

    depth, since, total_s = 0, 0.0, 0.0

    def on_start(self, _event: object) -> None:
        with _lock:
            self.since = self.since if self.depth else time.monotonic()
            self.depth += 1
            _arm()

    def on_end(self, _event: object) -> None:
        with _lock:
            self.depth -= 1
            if not self.depth:
                self.total_s += time.monotonic() - self.since
            _arm()


_compiling = _Compiling()
event.register("numba:compile", _compiling)  # type: ignore[no-untyped-call]


def _clock_s() -> float:
    """Return seconds without those of compilation, which must not go on."""
    return time.monotonic() - _compiling.total_s


def compilation_s() -> float:
    """Return the seconds for which this process has compiled or loaded code so far."""
    return _compiling.total_s
