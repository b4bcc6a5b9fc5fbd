"""Values and settings that mean the same, or change nothing."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

from sweep.experiment.axes import Axis
from sweep.experiment.experiment import OPENCV_FIELDS
from sweep.experiment.grid import Grid
from sweep.experiment.parameters import STATED
from sweep.experiment.pipeline import Pipeline
from sweep.measure.detectors import OPENCV
from sweep.measure.estimators import SOLVERS
from sweep.model.camera import VIEW_PARAMETERS, canonical_distortion

# --------------------------------------------------------------------------------------------------
# The settings that a configuration uses: an axis may hold others, which change nothing for it.

PIXEL_SETTINGS = {
    "photometric": frozenset({"refined_starts", "estimate_blur"}),
    "photometric_real": frozenset({"refined_starts", "estimate_tone"}),
}
"""Solver on pixels -> the settings that it has beside those of all solvers."""


def used_settings(pipeline: Grid, values: Mapping[str, Any]) -> dict[str, Any]:
    r"""Return those of some axes' values that the detector and the solver among them have.

    ``values`` has an axis' name -> its value, or its label if parameters go together.

    Examples
    --------
    >>> pipeline = Pipeline.from_text(
    ...     "seed = 1\n[pose]\nside_px = 40\n[axes]\n"
    ...     'solver = ["ippe", "sqpnp"]\nestimate_blur = [false, true]\n')
    >>> used_settings(pipeline, {"solver": "ippe", "estimate_blur": True})
    {'solver': 'ippe'}
    """
    chosen = {
        name: several[0] for name in ("detector", "solver")
        if len(several := list(set(pipeline.values_of(name)))) == 1
    }
    axes = {name: pipeline.axis(name) for name in values}
    for name, axis in axes.items():
        if axis is not None and values[name] in list(axis.values):
            chosen |= axis.at(list(axis.values).index(values[name]))
    unused: set[str] = set()
    for name, table in _settings_of(pipeline).items():
        if name in chosen:
            unused |= set().union(*table.values()) - table.get(chosen[name], set())
    return {name: value for name, value in values.items()
            if (axis := axes[name]) is None or not unused.issuperset(axis.columns)}


def _settings_of(pipeline: Grid) -> dict[str, dict[str, set[str]]]:
    """Return the settings that each detector and each solver has, of those that others lack."""
    plugged: dict[str, dict[str, set[str]]] = {"detector": {}, "estimator": {}}
    for plugin in pipeline.plugins:
        plugged.setdefault(plugin.kind, {})[plugin.name] = {each.name for each in plugin.settings}
    return {
        "detector": {OPENCV: {*OPENCV_FIELDS}, **plugged["detector"]},
        "solver": {name: {*PIXEL_SETTINGS.get(name, ()), *["guarded"] * solver.guarded}
                   for name, solver in SOLVERS.items()} | plugged["estimator"],
    }


def distinct(pipeline: Grid, combinations: Sequence[Mapping[str, Any]]) -> list[int]:
    """Return the indices of the combinations of axes' values that no earlier one means, too."""
    first: dict[tuple[tuple[str, Any], ...], int] = {}
    for index, values in enumerate(combinations):
        first.setdefault(tuple(used_settings(pipeline, values).items()), index)
    return list(first.values())


# --------------------------------------------------------------------------------------------------
# Values that mean the same in two pipelines: a belief that is not given, and the truth.

def alike(first: Pipeline, second: Pipeline) -> tuple[Pipeline, Pipeline]:
    """Return two pipelines with fixed values that are equal where they mean the same.

    A belief that is not given is the truth, if this is a single value in one of the pipelines:
    cells that both have are its. A camera's values may be given in other words, or by a file.
    """
    pair = first, second
    truth: dict[str, Any] = next((each.truth for each in pair if each.view is not None), {})
    ignored: dict[str, Any] = {"camera_file": None}
    if first.view is not None and first.view == second.view:
        ignored |= {name: first.fixed[name] for name in VIEW_PARAMETERS
                    if name not in ("width_px", "height_px")}
    if first.calibration is None and second.calibration is None:
        ignored |= dict.fromkeys(STATED, ())
    changed = []
    for pipeline in pair:
        fixed = {name: ignored.get(name, value) for name, value in pipeline.fixed.items()}
        for name in fixed.keys() & {"distortion", "believed_distortion"}:
            if fixed[name] is not None:
                fixed[name] = canonical_distortion(fixed[name])
        fixed |= {name: truth[name] for name in fixed.keys() & truth.keys() if fixed[name] is None}
        changed.append(dataclasses.replace(pipeline, fixed=fixed))
    return changed[0], changed[1]


def wrong_beliefs(pipeline: Pipeline, axis: Axis) -> tuple[bool, ...]:
    r"""Return for each value of an axis whether it makes the estimator believe what is not true.

    A belief whose truth varies over the grid is right somewhere, and counts as not wrong.

    Examples
    --------
    >>> pipeline = Pipeline.from_text(
    ...     "seed = 1\n[pose]\nside_px = 40\n[axes]\nbelieved_focal_scale = [0.99, 1.0]\n")
    >>> wrong_beliefs(pipeline, pipeline.axes[0])
    (True, False)
    """
    truths = pipeline.truth | {"believed": "truth"}
    return tuple(
        any(_differs(axis.at(k)[name], truths[name]) for name in axis.columns if name in truths)
        for k in range(len(axis))
    )


def wrong_configurations(pipeline: Pipeline, axes: Sequence[Axis]) -> list[bool]:
    """Return for each combination of axes' values, the last fastest, whether a belief is wrong.

    Nowhere, if that is so for all of them: then none is the true one that others differ from.
    """
    wrong = [any(flags) for flags in itertools.product(
        *(wrong_beliefs(pipeline, axis) for axis in axes))]
    return [False] * len(wrong) if all(wrong) else wrong


def _differs(believed: Any, truth: Any) -> bool:
    """Return whether a belief is known to differ from the truth, beyond rounding."""
    if believed is None or truth is None:
        return False
    if isinstance(believed, tuple):
        believed = canonical_distortion(believed)
    if not isinstance(believed, (int, float)):
        return bool(believed != truth)
    return not math.isclose(believed, truth, rel_tol=1e-9)
