"""The provenance of numbers beside the pipeline: versions, seed, files, and the environment."""

from __future__ import annotations

import json
import platform
from collections.abc import Iterator, Mapping
from collections.abc import Set as AbstractSet
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import llvmlite
import numba
import numpy as np

from sweep.errors import StoreError
from sweep.experiment.draws import SAMPLINGS
from sweep.experiment.grid import MAX_LISTED, TRIAL, Axis
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.sampling import not_continued
from sweep.store import blocks
from sweep.store.blocks import RunStore
from sweep.version import __version__

#: Raised whenever the numbers change; a test with golden digests fails if it is not.
NUMBERS_VERSION = 5


@cache
def builds() -> dict[str, str]:
    """Return which builds of libraries are loaded in this process, whatever their metadata say."""
    config: dict[str, Any] = {**np.show_config(mode="dicts")}
    # Directories are other ones for each Python that NumPy was built for. The processor's features
    # have an entry of their own in each receipt.
    parts = [config.get("Compilers"), *(
        {key: value for key, value in each.items() if "directory" not in key}
        for each in config["Build Dependencies"].values())]
    return {
        "opencv": f"{cv2.__version__} {_digest(cv2.getBuildInformation())}",
        "numpy": f"{np.__version__} {_digest(json.dumps(parts))}",
        "numba": numba.__version__,
        "llvmlite": llvmlite.__version__,
    }


def _digest(text: str) -> str:
    return sha256(text.encode()).hexdigest()[:12]


def fingerprint(pipeline: Pipeline) -> dict[str, Any]:
    """Return the values that two stores must share for one to reuse cells of the other."""
    where_there_are = {
        "sampling": "" if pipeline.sampling == SAMPLINGS[0] else pipeline.sampling,
        # Of distributions that plug-ins depend on; a file is in ``files``.
        "plugins": {each.name: dict(each.versions) for each in pipeline.plugins if each.versions},
        # In the order in which they act.
        "effects": [each.name for each in pipeline.plugins if each.kind == "effect"],
    }
    loaded = builds()
    return {
        "numbers": NUMBERS_VERSION,
        **{name: loaded[name].partition(" ")[0] for name in ("opencv", "numpy", "numba")},
        **{f"builds.{name}": build for name, build in loaded.items()},
        "seed": pipeline.seed,
        "files": dict(sorted(pipeline.files.items())),
        **{name: value for name, value in where_there_are.items() if value},
    }


def changes(stored: Mapping[str, Any], own: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Yield name, stored and own value of each entry in which two fingerprints differ.

    Files are compared by their contents: a pipeline's values have their paths, where these matter.

    Examples
    --------
    >>> list(changes({"numba": "1", "builds.numpy": "a"}, {"numba": "1"}))
    [('builds.numpy', 'a', None)]
    """
    for key in sorted({*stored, *own}):
        theirs, mine = stored.get(key), own.get(key)
        if theirs != mine and not (key == "files" and _contents(theirs) == _contents(mine)):
            yield key, theirs, mine


def _contents(files: Any) -> list[str]:
    return sorted(map(str, files.values())) if isinstance(files, dict) else []


def environment() -> dict[str, str]:
    """Return the record beside the fingerprint: versions of sweep and Python, the CPU."""
    return {
        "sweep": __version__,
        "python": platform.python_version(),
        "cpu": _cpu(),
    }


def _cpu() -> str:
    """Return the CPU's model name."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.machine())


def differences(ours: Pipeline, theirs: Pipeline, stored: dict[str, Any]) -> list[str]:
    """Return a line for each difference between a pipeline and a store's.

    Parameters
    ----------
    ours, theirs
        The pipeline, and the store's.
    stored
        The store's fingerprint.
    """
    there, here = (pipeline.fixed | pipeline.distributions for pipeline in (theirs, ours))
    names = [", ".join(axis.name for axis in each.axes) or "none" for each in (theirs, ours)]
    pairs = [
        *changes(stored, fingerprint(ours)),
        ("axes", *names),
        *((f"axes.{axis.name}", theirs.axis(axis.name), axis) for axis in ours.axes
          if theirs.axis(axis.name)),
        # An axis of one of the two alone is in the list of its axes.
        *((name, there.get(name), here.get(name)) for name in sorted({*there, *here})
          if not (ours.axis_of(name) or theirs.axis_of(name))),
    ]
    lines = [
        f"{name}: the store has {_shown(other)}, this run {_shown(own)}"
        for name, other, own in pairs
        if _values(other) != _values(own)
    ]
    if problem := not_continued(ours.stopping, theirs.stopping):
        lines.append(problem)
    return lines


def _values(value: Any) -> Any:
    """Return a value to be compared: of an axis the values of each of its parameters."""
    if not isinstance(value, Axis):
        return value
    # Values that are listed may be those of a range; a longer one has no like but itself.
    return {name: list(column) if len(column) <= MAX_LISTED else column
            for name, column in value.columns.items()}


def _shown(value: Any) -> str:
    return excerpt(value.values) if isinstance(value, Axis) else str(value)


def excerpt(values: Any) -> str:
    """Return values, or the first and the last of many, as a text."""
    if len(values) <= 6:
        return ", ".join(str(value) for value in values)
    return f"{values[0]}, {values[1]}, ... {values[-1]} ({len(values):,} values)"


# --------------------------------------------------------------------------------------------------
# Which stores have cells of a new grid: the fingerprint and all values of parameters agree.
#
# Whether a parameter is fixed, an axis of its own, or goes together with others does not matter: a
# cell of the new grid gives every parameter a value, and these are looked up in the old grid, where
# a parameter that it keeps fixed is an axis of one value.

class Source(NamedTuple):
    """An old store, and the numbers of its committed blocks."""

    store: RunStore
    done: AbstractSet[int]


def _axes(pipeline: Pipeline, names: AbstractSet[str]) -> list[Axis]:
    """Return a pipeline's axes, stage by stage, and an axis of one value for each other name."""
    own = {name for axis in pipeline.axes for name in axis.columns}
    fixed = pipeline.fixed | {TRIAL: 0}
    return [*sorted(pipeline.axes, key=lambda axis: axis.stage),
            *(Axis(name, {name: (fixed.get(name),)}) for name in sorted(names - own))]


def both_axes(new: Pipeline, old: Pipeline) -> tuple[list[Axis], list[Axis]]:
    """Return the axes of two grids, each with those that only the other has."""
    names = {name for grid in (new, old) for axis in grid.axes for name in axis.columns}
    return _axes(new, names), _axes(old, names)


def match(pipeline: Pipeline, store: RunStore) -> Source:
    """Match a new grid to an old store's.

    Raises
    ------
    StoreError
        If no cell is reusable: another fingerprint, or parameters that never agree; or if chunks
        of committed blocks are missing.
    """
    old = store.pipeline
    mine, theirs = fingerprint(pipeline), store.fingerprint
    # A file or plug-in that only one of them refers to is a value that only one of them has.
    for part in ("files", "plugins"):
        shared = mine.get(part, {}).keys() & theirs.get(part, {}).keys()
        for stamp in (mine, theirs):
            stamp[part] = {name: stamp[part][name] for name in sorted(shared)}
    present = {variable.name for variable in store.variables}
    lacking = [variable.name for variable in pipeline.experiment.variables
               if variable.name not in present and not variable.drawn_as]
    source = Source(store, blocks.check_whole(store))
    # Ranges, as of trials, may be long: they are never written out.
    here, there = (
        {name: values if isinstance(values, range) else frozenset(values)
         for axis in axes for name, values in axis.columns.items()}
        for axes in both_axes(pipeline, old))
    agree = (
        not any(changes(theirs, mine)) and pipeline.distributions == old.distributions
        and all(pipeline.fixed[name] == old.fixed[name]
                for name in pipeline.fixed.keys() & old.fixed.keys())
        and all(any(value in there[name] for value in values) for name, values in here.items())
    )
    if lacking or not agree:
        lines = [f"{name}: not a variable of the store" for name in lacking]
        lines += differences(pipeline, old, store.fingerprint)
        raise StoreError("\n  ".join([f"{store.url}: no cell of it can be reused", *lines]))
    return source
