"""Detectors and solvers of other packages as plug-ins: their settings and conventions.

Each module imports its package only when a detector is made. Plug-ins are found by the entry points
of pyproject.toml; a package that is not installed is reported with the command that installs it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from sweep.plugins import Plugin

Record = TypeVar("Record", bound=Plugin)


def adapter(
    record: type[Record], package: str, meaning: str, make: Callable[..., Any],
    settings: type[Any], **fields: Any,
) -> Record:
    """Return the plug-in of a package that is an extra of ours, with other ``fields`` of it."""
    return record(**{
        "make": make, "settings": settings, "meaning": f"{meaning} ({package})",
        "distribution": package, "install": f"pip install 'fiducial-sweep[{package}]'", **fields,
    })
