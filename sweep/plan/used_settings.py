"""The settings that a configuration uses: an axis may hold others, which change nothing for it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sweep.measure.detectors import OPENCV
from sweep.measure.estimators import SOLVERS
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import OPENCV_FIELDS

PIXEL_SETTINGS = {
    "photometric": frozenset({"refined_starts", "estimate_blur"}),
    "photometric_real": frozenset({
        "refined_starts", "estimate_light", "estimate_tone", "estimate_sharpening",
        "assumed_sharpening_px",
    }),
}
"""Solver on pixels -> the settings that it has beside those of all solvers."""


def used_settings(pipeline: Pipeline, values: Mapping[str, Any]) -> dict[str, Any]:
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
    parameters = dict(_parameters(pipeline, values))
    unused = {*_unused_by_detector(pipeline, _only(pipeline, "detector", parameters)),
              *_unused_by_solver(pipeline, _only(pipeline, "solver", parameters))}
    used = {}
    for name, value in values.items():
        axis = pipeline.axis(name)
        if axis is None or not unused.issuperset(axis.columns):
            used[name] = value
    return used


def distinct(pipeline: Pipeline, combinations: Sequence[Mapping[str, Any]]) -> list[int]:
    """Return the indices of the combinations of axes' values that no earlier one means, too."""
    first: dict[tuple[tuple[str, Any], ...], int] = {}
    for index, values in enumerate(combinations):
        first.setdefault(tuple(used_settings(pipeline, values).items()), index)
    return list(first.values())


def _parameters(pipeline: Pipeline, values: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield name and value of each parameter of some axes' values."""
    for name, value in values.items():
        axis = pipeline.axis(name)
        if axis is not None and value in list(axis.values):
            yield from axis.at(list(axis.values).index(value)).items()


def _only(pipeline: Pipeline, name: str, parameters: Mapping[str, Any]) -> Any:
    """Return the value of a parameter; None if the pipeline has several, and none is chosen."""
    if name in parameters:
        return parameters[name]
    values = set(pipeline.values_of(name))
    return values.pop() if len(values) == 1 else None


def _settings_of_plugins(pipeline: Pipeline, kind: str, name: str) -> set[str]:
    """Return the settings of the plug-ins of a kind that the one of this name does not have."""
    own = pipeline.plugin(kind, name)
    every = {each.name for plugin in pipeline.plugins if plugin.kind == kind
             for each in plugin.settings}
    return every - {each.name for each in own.settings} if own is not None else every


def _unused_by_detector(pipeline: Pipeline, detector: str | None) -> set[str]:
    if detector is None:
        return set()
    others = _settings_of_plugins(pipeline, "detector", detector)
    return others if detector == OPENCV else {*others, *OPENCV_FIELDS, "environment"}


def _unused_by_solver(pipeline: Pipeline, solver: str | None) -> set[str]:
    if solver is None:
        return set()
    others = _settings_of_plugins(pipeline, "estimator", solver)
    known = SOLVERS.get(solver)
    if known is None or not known.guarded:
        others.add("guarded")
    every = frozenset().union(*PIXEL_SETTINGS.values())
    return {*others, *(every - PIXEL_SETTINGS.get(solver, frozenset()))}
