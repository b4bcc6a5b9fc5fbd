"""The provenance of numbers beside the pipeline: versions, seed, files, and the environment."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import itertools
import json
import platform
import runpy
from collections.abc import Iterator, Sequence
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

from sweep.environments.identity import identify
from sweep.environments.interpreters import INSTALLED
from sweep.errors import EnvironmentFaultError
from sweep.installation import check_installation, check_loaded_opencv
from sweep.measure.foreign_detector import provenance
from sweep.model.camera import VIEW_PARAMETERS, intrinsics
from sweep.plan.draws import SAMPLINGS
from sweep.plan.experiment import Pipeline
from sweep.plan.stopping import not_continued
from sweep.version import __version__

NUMBERS_VERSION = 4
"""Raised whenever the numbers change; a test with golden digests fails if it is not."""

NEAR_NUMBERS_VERSION = 3
"""The version where no marker is far: version 4 changed guarded solvers at sides below 1/800 of
the focal length (`sweep.measure.solver`), and nothing else."""

NEAR_FOCAL_PX = 4000.0
"""Up to this focal length such sides are below 5 px, where no marker is detected."""


def versions() -> dict[str, str]:
    """Return the versions that the numbers of this process depend on."""
    packages = {
        "opencv": "opencv-contrib-python-headless", "numpy": "numpy", "numba": "numba",
    }
    return {name: importlib.metadata.version(package) for name, package in packages.items()}


@cache
def builds() -> dict[str, str]:
    """Return which builds of libraries are loaded in this process, whatever their metadata say.

    Raises
    ------
    StoreError
        If OpenCV is installed in a way that makes it uncertain which one is used.
    """
    check_installation()
    import cv2  # noqa: PLC0415  (slow to import)
    import llvmlite  # noqa: PLC0415
    import numpy as np  # noqa: PLC0415

    check_loaded_opencv(cv2.__version__)
    config: dict[str, Any] = {**np.show_config(mode="dicts")}
    for dependency in config["Build Dependencies"].values():
        for path in ("include directory", "lib directory", "pc file directory"):
            dependency.pop(path, None)
    # The processor's features have an entry of their own in each receipt.
    config = {part: config.get(part) for part in ("Compilers", "Build Dependencies")}
    return {
        "opencv": f"{cv2.__version__} {_digest(cv2.getBuildInformation())}",
        "numpy": f"{np.__version__} {_digest(json.dumps(config, sort_keys=True))}",
        "numba": _numba_version(),
        "llvmlite": llvmlite.__version__,
    }


def _digest(text: str) -> str:
    return sha256(text.encode()).hexdigest()[:12]


def _numba_version() -> str:
    """Return ``numba.__version__`` from the file that it comes from: Numba is slow to import."""
    spec = importlib.util.find_spec("numba")
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError("numba", name="numba")
    content = runpy.run_path(str(Path(spec.origin).parent / "_version.py"))
    return str(content["get_versions"]()["version"])


def fingerprint(pipeline: Pipeline) -> dict[str, Any]:
    """Return the values that two stores must share for one to reuse cells of the other.

    Raises
    ------
    StoreError
        If OpenCV is installed in a way that makes it uncertain which one is used.
    """
    return {
        "numbers": numbers_version(pipeline),
        **versions(),
        "builds": dict(builds()),
        "seed": pipeline.seed,
        **({} if pipeline.sampling == SAMPLINGS[0] else {"sampling": pipeline.sampling}),
        "files": dict(sorted(pipeline.files.items())),
        **({"plugins": versions_used} if (versions_used := plugin_versions(pipeline)) else {}),
        **({"effects": effects} if (effects := effects_in_order(pipeline)) else {}),
        **({"environments": others} if (others := environment_versions(pipeline)) else {}),
    }


def environment_versions(pipeline: Pipeline) -> dict[str, str]:
    """Return what the results of each of a pipeline's environments depend on, or why it is none."""
    versions_of = {}
    for name in pipeline.values_of("environment"):
        if name != INSTALLED:
            try:
                versions_of[name] = provenance(identify(name, pipeline.folder), pipeline.given)
            except EnvironmentFaultError as error:
                versions_of[name] = f"none ({error})"
    return versions_of


def effects_in_order(pipeline: Pipeline) -> list[str]:
    """Return the names of the plug-ins' effects in the order in which they act."""
    return [each.name for each in pipeline.plugins if each.kind == "effect"]


def plugin_versions(pipeline: Pipeline) -> dict[str, dict[str, str]]:
    """Return the versions of distributions that plug-ins depend on; a file is in ``files``."""
    return {each.name: dict(each.versions) for each in pipeline.plugins if each.versions}


def numbers_version(pipeline: Pipeline) -> int:
    """Return the version of the numbers of a pipeline: the earliest with the same ones."""
    ends = [_ends(pipeline.values_of(name)) for name in VIEW_PARAMETERS]
    focal_px = max(max(intrinsics(*values)[:2]) for values in itertools.product(*ends))
    return NUMBERS_VERSION if focal_px > NEAR_FOCAL_PX else NEAR_NUMBERS_VERSION


def _ends(values: Sequence[Any]) -> Sequence[Any]:
    """Return the smallest and the largest value; focal lengths are monotonous in each."""
    numbers = [value for value in values if value is not None]
    return (min(numbers), max(numbers)) if len(numbers) > 1 else (numbers or [None])


def changes(stored: dict[str, Any], own: dict[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Yield name, stored and own value of each entry in which two fingerprints differ.

    Builds are compared one by one; stores up to format 3 may have none, and are not refused. Files
    are compared by their contents: a pipeline's values have their paths, where these matter.

    Examples
    --------
    >>> list(changes({"numba": "1", "builds": {"numpy": "a"}}, {"numba": "1", "builds": {}}))
    [('builds.numpy', 'a', None)]
    """
    for key in sorted({*stored, *own}):
        theirs, mine = stored.get(key), own.get(key)
        if key == "builds" and key not in stored:
            continue
        if key == "builds" and isinstance(theirs, dict) and isinstance(mine, dict):
            yield from (
                (f"{key}.{name}", theirs.get(name), mine.get(name))
                for name in sorted({*theirs, *mine}) if theirs.get(name) != mine.get(name)
            )
        elif key == "environments":
            # Cells of an environment that only one of them has are not compared.
            stored_ones, own_ones = theirs or {}, mine or {}
            yield from (
                (f"{key}.{name}", stored_ones[name], own_ones[name])
                for name in sorted(stored_ones.keys() & own_ones.keys())
                if stored_ones[name] != own_ones[name]
            )
        elif key == "files" and _contents(theirs) == _contents(mine):
            continue
        elif theirs != mine:
            yield key, theirs, mine


def _contents(files: Any) -> list[str]:
    return sorted(map(str, files.values())) if isinstance(files, dict) else []


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
    lines = [
        f"{key}: the store has {stored_value}, this run {own_value}"
        for key, stored_value, own_value in changes(stored, fingerprint(ours))
    ]
    if [axis.name for axis in ours.axes] != [axis.name for axis in theirs.axes]:
        lines.append(f"axes: the store has {_names(theirs)}, this run {_names(ours)}")
    lines += [
        f"axes.{axis.name}: the store has {_values(other.values)}, "
        f"this run {_values(axis.values)}"
        for axis in ours.axes
        if (other := theirs.axis(axis.name)) is not None
        and not (
            axis.columns.keys() == other.columns.keys()
            and all(same_values(axis.columns[name], other.columns[name]) for name in axis.columns)
        )
    ]
    for our_values, their_values in (
        (ours.fixed, theirs.fixed), (ours.distributions, theirs.distributions),
    ):
        lines += [
            f"{name}: the store has {their_values.get(name)}, this run {our_values.get(name)}"
            for name in sorted({*our_values, *their_values})
            if ours.axis_of(name) is None and theirs.axis_of(name) is None
            and name != "camera_file"
            and their_values.get(name) != our_values.get(name)
        ]
    if problem := not_continued(ours.stopping, theirs.stopping):
        lines.append(problem)
    if any(line.startswith("sensor_") for line in lines):
        lines.append("pixels are square unless both sides of the sensor are given")
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
