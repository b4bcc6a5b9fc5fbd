"""What is known of another Python before a run: versions, fields, dictionaries."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sweep.environments.interpreters import find_python
from sweep.environments.process import DetectorProcess
from sweep.errors import EnvironmentFaultError


@dataclass(frozen=True)
class EnvironmentIdentity:
    """What results of a detector in an environment depend on.

    Attributes
    ----------
    python_version, opencv, opencv_build, numpy, numpy_build
        Versions, and digests of how OpenCV and NumPy were built.
    fields
        Fields of its ``DetectorParameters`` with their defaults.
    dictionaries
        Predefined dictionaries with a digest of their markers.
    """

    python_version: str
    opencv: str
    opencv_build: str
    numpy: str
    numpy_build: str
    fields: Mapping[str, Any]
    dictionaries: Mapping[str, str]


def identify(environment: str, folder: str) -> EnvironmentIdentity:
    """Return what an environment is; its Python is started once for each state of its file.

    Parameters
    ----------
    environment
        A name, or the path of a Python or of a virtual environment.
    folder
        The folder at which relative paths start.

    Raises
    ------
    EnvironmentFaultError
        In one line, if it cannot be used.
    """
    python = find_python(environment, folder)
    process = process_of(python)
    said = process.identity
    try:
        return EnvironmentIdentity(
            said["python"], said["opencv"], said["opencv_build"], said["numpy"],
            said["numpy_build"], said["fields"], said["dictionaries"],
        )
    except (KeyError, TypeError):
        raise EnvironmentFaultError("sent something else than a detector's process does") from None


def process_of(python: str) -> DetectorProcess:
    """Return the process of an interpreter that this process keeps, started if it has ended."""
    key = python, os.getpid()  # a fork has none
    process = _kept.get(key)
    if process is None or process.ended:
        process = _kept[key] = DetectorProcess(python)
    return process


_kept: dict[tuple[str, int], DetectorProcess] = {}
