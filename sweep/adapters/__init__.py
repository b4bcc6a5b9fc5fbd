"""Detectors of other packages as plug-ins: their settings, and their conventions for corners.

Each module imports its package only when a detector is made. Plug-ins are found by the entry points
of pyproject.toml; a package that is not installed is reported with the command that installs it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from sweep.plugins import DetectorPlugin


def install(extra: str) -> str:
    """Return the command that installs an extra of ours."""
    return f"pip install 'fiducial-sweep[{extra}]'"


def adapter(
    package: str, meaning: str, make: Callable[[Any, str], Callable[[Any], Any]],
    settings: type[Any], families: Mapping[str, str], *others: str, **conventions: Any,
) -> DetectorPlugin:
    """Return the detector of a package that is an extra of ours, and of ``others`` it builds on."""
    return DetectorPlugin(
        make=make, settings=settings, meaning=f"{meaning} ({package})", families=families,
        distribution=(package, *others), install=install(package), **conventions,
    )
