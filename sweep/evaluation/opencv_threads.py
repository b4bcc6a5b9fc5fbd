"""OpenCV on one thread while cells are computed: parallelism is over blocks."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import cv2

_lock = threading.Lock()
#: The process' own number of threads, once for each context that is open.
_entered: list[int] = []


@contextmanager
def single_threaded() -> Iterator[None]:
    """Keep OpenCV to one thread within the context; the number before is restored afterwards.

    The number belongs to the process: contexts of several threads may overlap, and the last one
    restores it.
    """
    with _lock:
        _entered.append(_entered[0] if _entered else cv2.getNumThreads())
        cv2.setNumThreads(1)
    try:
        yield
    finally:
        with _lock:
            before = _entered.pop()
            if not _entered:
                cv2.setNumThreads(before)
