"""The provenance of numbers beside the pipeline: versions, seed, files, and the environment."""

from __future__ import annotations

import importlib.metadata
import platform
from pathlib import Path
from typing import Any

from sweep.plan.experiment import Pipeline
from sweep.version import __version__

NUMBERS_VERSION = 3
"""Raised whenever the numbers change; a test with golden digests fails if it is not."""


def versions() -> dict[str, str]:
    """Return the versions that the numbers of this process depend on."""
    packages = {
        "opencv": "opencv-contrib-python-headless", "numpy": "numpy", "numba": "numba",
    }
    return {name: importlib.metadata.version(package) for name, package in packages.items()}


def fingerprint(pipeline: Pipeline) -> dict[str, Any]:
    """Return the values that two stores must share for one to reuse cells of the other."""
    return {
        "numbers": NUMBERS_VERSION,
        **versions(),
        "seed": pipeline.seed,
        "files": dict(sorted(pipeline.files.items())),
    }


def environment() -> dict[str, str]:
    """Return what is recorded beside the fingerprint: versions of sweep and Python, the CPU."""
    return {
        "sweep": __version__,
        "python": platform.python_version(),
        "cpu": _cpu(),
    }


def _cpu() -> str:
    """Return the CPU's model name."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def differences(ours: Pipeline, theirs: Pipeline, stored: dict[str, Any]) -> list[str]:
    """Return a line for each difference between a pipeline and a store's.

    Parameters
    ----------
    ours, theirs
        The pipeline, and the store's.
    stored
        The store's fingerprint.
    """
    lines = []
    mine = fingerprint(ours)
    lines += [
        f"{key}: the store has {stored.get(key)}, this run {mine.get(key)}"
        for key in sorted({*mine, *stored})
        if mine.get(key) != stored.get(key)
    ]
    if [axis.name for axis in ours.axes] != [axis.name for axis in theirs.axes]:
        lines.append(f"axes: the store has {_names(theirs)}, this run {_names(ours)}")
    lines += [
        f"axes.{axis.name}: the store has {_values(other.values)}, "
        f"this run {_values(axis.values)}"
        for axis in ours.axes
        if (other := theirs.axis(axis.name)) is not None
        and not same_values(axis.values, other.values)
    ]
    for our_values, their_values in (
        (ours.fixed, theirs.fixed), (ours.distributions, theirs.distributions),
    ):
        lines += [
            f"{name}: the store has {their_values.get(name)}, this run {our_values.get(name)}"
            for name in sorted({*our_values, *their_values})
            if ours.axis(name) is None and theirs.axis(name) is None
            and their_values.get(name) != our_values.get(name)
        ]
    return lines


def same_values(a: Any, b: Any) -> bool:
    """Return whether two axes have the same values in the same order."""
    if isinstance(a, range) and isinstance(b, range):
        return a == b
    return len(a) == len(b) and all(x == y for x, y in zip(a, b, strict=True))


def _names(pipeline: Pipeline) -> str:
    return ", ".join(axis.name for axis in pipeline.axes) or "none"


def _values(values: Any) -> str:
    if len(values) <= 6:
        return ", ".join(str(value) for value in values)
    return f"{values[0]}, {values[1]}, ... {values[-1]} ({len(values):,} values)"
