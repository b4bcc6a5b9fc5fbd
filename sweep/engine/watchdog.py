"""Time limits that hold whatever the code does: the process ends when one runs out."""

from __future__ import annotations

import contextlib
import faulthandler
import itertools
import os
import threading
import time
from collections.abc import Iterator

_lock = threading.Lock()
_deadlines: dict[int, float] = {}
_numbers = itertools.count()
_nowhere = os.open(os.devnull, os.O_WRONLY)


@contextlib.contextmanager
def ending_after(limit_s: float) -> Iterator[None]:
    """End this process where the body takes longer than ``limit_s`` seconds.

    The clock is ``faulthandler``'s: a thread of C that needs no lock of the interpreter, so that
    compiled code that never returns is ended too. Several threads may have limits at a time.
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
    if not _deadlines:
        faulthandler.cancel_dump_traceback_later()
        return
    left = max(min(_deadlines.values()) - time.monotonic(), 0.001)
    faulthandler.dump_traceback_later(left, exit=True, file=_nowhere)
