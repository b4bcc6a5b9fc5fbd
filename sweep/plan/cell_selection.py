"""One cell of a grid, chosen by its coordinates: ``distance_m=0.3,tilt_deg=45``."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from typing import Any

from sweep.messages import MAX_FAULTS, label, nearest, plain, refusal
from sweep.plan.axes import TRIAL, Axis
from sweep.plan.experiment import Pipeline
from sweep.plan.parameters import PARAMETERS
from sweep.plan.toml_text import read_value

_PART = re.compile(r"(?:\[[^\]]*\]?|[^,\[])+")
"""What stands between commas; those of a list do not count."""


def cell(pipeline: Pipeline, at: str) -> Pipeline:
    """Return the pipeline with every axis fixed: as ``at`` says, the others at their first value.

    Any value that a parameter admits may be asked for, on the grid or not.

    Raises
    ------
    PipelineError
        One line for each part of ``at`` that cannot be.
    """
    named = places(at)
    chosen = {axis.name: axis.values[0] for axis in pipeline.axes} | named
    trial = chosen.pop(TRIAL, 0)
    axes = (Axis(TRIAL, range(trial, trial + 1)),)
    for name, other in (("distance_m", "side_px"), ("side_px", "distance_m")):
        if name in named and other not in named:
            chosen.pop(other, None)
    return dataclasses.replace(pipeline.fixed_at(chosen), axes=axes)


def places(at: str) -> dict[str, Any]:
    """Return the parameters that ``--at`` names, with their values.

    Raises
    ------
    PipelineError
        One line for each part of ``at`` that cannot be.
    """
    faults: list[str] = []
    named: dict[str, Any] = {}
    for part in map(str, _PART.findall(at)):
        name, equals, written = (piece.strip() for piece in part.partition("="))
        if not equals or not written:
            faults.append(f"--at {plain(part)}: expected name=value, such as tilt_deg=45")
        elif name != TRIAL and name not in PARAMETERS:
            known = [*PARAMETERS, TRIAL]
            hint = nearest(name, known) if len(faults) < MAX_FAULTS else ""
            faults.append(f"--at {plain(part)}: unknown parameter{hint}")
        elif name in named:
            faults.append(f"--at {plain(part)}: {name} is given twice")
        else:
            try:
                named[name] = _value(name, written)
            except ValueError as error:
                faults.append(f"--at {plain(part)}: expected {error}")
    if faults:
        raise refusal(faults)
    return named


def _value(name: str, written: str) -> Any:
    try:
        value = read_value(written)
    except ValueError:
        value = written
    if name != TRIAL:
        return PARAMETERS[name].check(value)
    if isinstance(value, int) and 0 <= value < 2**62:
        return value
    raise ValueError("a whole number, at least 0")


def at_text(place: Mapping[str, Any]) -> str:
    """Return a cell's coordinates as ``--at`` takes them: "distance_m=0.3,tilt_deg=45.0"."""
    return ",".join(f"{name}={_written(value)}" for name, value in place.items())


def _written(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return label(value).replace(", ", ",") if isinstance(value, tuple) else label(value)


def coordinates_text(pipeline: Pipeline, chosen: Pipeline) -> str:
    """Return where a cell lies on its grid, in words: "distance_m 0.3, tilt_deg 45"."""
    parts = []
    for axis in pipeline.axes:
        value = chosen.axes[0].values[0] if axis.name == TRIAL else chosen.fixed[axis.name]
        shown = f"{value:.6g}" if isinstance(value, float) else str(value)
        parts.append(f"{axis.name} {shown}")
    return ", ".join(parts)
