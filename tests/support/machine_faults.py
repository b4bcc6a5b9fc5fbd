"""Faults of a machine, put into a process that computes blocks, and taken away again."""

import errno
import itertools
import os

import cv2
from numba.core.errors import LoweringError
from zarr.storage import LocalStore

from sweep.evaluation import block as cells
from sweep.evaluation import search

_before = {}


def _no_memory():
    error = cv2.error("Failed to allocate 9000000 bytes")
    error.code = cv2.Error.StsNoMem
    return error


ERRORS = {
    "compiler": lambda: LoweringError("no module"),
    "disk": lambda: OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)),
    "memory": MemoryError,
    "opencv memory": _no_memory,
    "import": lambda: ImportError("libstdc++.so.6: file too short"),
    "passing": lambda: RuntimeError("not like this"),  # of a batch and a scene, and never again
}

PLACES = {
    "build_scenes": search, "detections_for": cells, "build": cells, "render_all": search,
    "classify": search,
    "set": LocalStore,
}
"""Functions and what they belong to; "set" writes a file of a store."""


def inject(fault, place, at):
    """From the call number ``at`` on, a function that blocks need fails as on a faulty machine.

    What is written to a store fails by a fault of the disk, whatever the ``fault``.
    """
    _before.update({name: getattr(module, name) for name, module in PLACES.items()})
    if place == "set":
        fault = "disk"
    real, calls = _before[place], itertools.count()

    def faulty(*arguments, **options):
        call = next(calls)
        if call >= at and (fault != "passing" or call < at + 2):
            error = ERRORS[fault]()
            raise error
        return real(*arguments, **options)

    setattr(PLACES[place], place, faulty)


def clear():
    """Mend the machine."""
    if _before:
        for name, module in PLACES.items():
            setattr(module, name, _before.pop(name))
