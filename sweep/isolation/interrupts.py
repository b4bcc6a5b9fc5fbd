"""Ctrl-C that stops a run between two steps, never in the middle of one."""

from __future__ import annotations

import signal
import threading
from concurrent.futures import Future, wait
from types import FrameType
from typing import Any, Self, TypeVar

Result = TypeVar("Result")

POLL_S = 0.2
"""How often Ctrl-C is checked while a result is awaited."""


def in_main_thread() -> bool:
    """Return whether this is the thread in which Python handles signals."""
    return threading.current_thread() is threading.main_thread()


class Interrupts:
    """While this context is entered, Ctrl-C is noted, and raised by :meth:`check`.

    KeyboardInterrupt inside a client's code can leave one of its locks taken, and the process then
    hangs while it closes the cluster. The second Ctrl-C is raised at once.

    The caller's handler is restored at the end. Nothing is done outside the main thread, where no
    signals arrive, and if the caller ignores Ctrl-C or handles it outside Python.
    """

    def __init__(self) -> None:
        self._noted = False
        self._before: Any = None

    def __enter__(self) -> Self:
        if in_main_thread() and signal.getsignal(signal.SIGINT) not in (None, signal.SIG_IGN):
            self._before = signal.signal(signal.SIGINT, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)

    def _note(self, number: int, frame: FrameType | None) -> None:
        del number, frame
        if self._noted:
            raise KeyboardInterrupt
        self._noted = True

    def check(self) -> None:
        """Raise KeyboardInterrupt if Ctrl-C has been noted."""
        if self._noted:
            raise KeyboardInterrupt

    def await_result(self, future: Future[Result]) -> Result:
        """Return a future's result, checking meanwhile."""
        while not future.done():
            self.check()
            wait([future], timeout=POLL_S)
        self.check()
        return future.result()
