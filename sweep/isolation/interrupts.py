"""Ctrl-C that stops a run between two steps, never in the middle of one."""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any, Self


def in_main_thread() -> bool:
    """Tell whether this is the thread that signals arrive in."""
    return threading.current_thread() is threading.main_thread()


class Interrupts:
    """While it is entered, Ctrl-C is noted, and raised where :meth:`check` is called.

    KeyboardInterrupt anywhere in a client's machinery can leave one of its locks taken, and the
    process hangs while it closes the cluster. The second Ctrl-C is raised at once all the same.
    Outside the main thread, where no signals arrive, it does nothing.
    """

    def __init__(self) -> None:
        self._noted = False
        self._before: Any = None

    def __enter__(self) -> Self:
        if in_main_thread():
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
        """Raise KeyboardInterrupt where Ctrl-C has been noted."""
        if self._noted:
            raise KeyboardInterrupt
