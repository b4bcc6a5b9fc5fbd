"""One cell of a grid, chosen by its coordinates: ``distance_m=0.3,tilt_deg=45``."""

from __future__ import annotations

import dataclasses
import re
import tomllib
from typing import Any

from sweep.errors import PipelineError
from sweep.plan.axes import TRIAL, Axis, nearest
from sweep.plan.parameters import PARAMETERS
from sweep.plan.pipeline import Pipeline, fixed_at

_SEPARATOR = re.compile(r",(?![^\[]*\])")


def cell(pipeline: Pipeline, at: str) -> Pipeline:
    """Return the pipeline with every axis fixed: as ``at`` says, the others at their first value.

    Any value that a parameter admits may be asked for, on the grid or not.

    Raises
    ------
    PipelineError
        One line for each part of ``at`` that cannot be.
    """
    faults: list[str] = []
    chosen: dict[str, Any] = {axis.name: axis.values[0] for axis in pipeline.axes}
    named: set[str] = set()
    for part in filter(None, _SEPARATOR.split(at)):
        name, equals, written = (piece.strip() for piece in part.partition("="))
        if not equals or not written:
            faults.append(f"--at {part}: expected name=value, such as tilt_deg=45")
        elif name != TRIAL and name not in PARAMETERS:
            known = [*PARAMETERS, TRIAL]
            faults.append(f"--at {part}: unknown parameter{nearest(name, known)}")
        else:
            if name in named:
                faults.append(f"--at {part}: {name} is given twice")
            named.add(name)
            try:
                chosen[name] = _value(name, written)
            except ValueError as error:
                faults.append(f"--at {part}: expected {error}")
    if faults:
        raise PipelineError(faults)
    trial = chosen.pop(TRIAL, 0)
    axes = (Axis(TRIAL, range(trial, trial + 1)),)
    for name, other in (("distance_m", "side_px"), ("side_px", "distance_m")):
        if name in named and other not in named:
            chosen.pop(other, None)
    return dataclasses.replace(fixed_at(pipeline, chosen), axes=axes)


def _value(name: str, written: str) -> Any:
    try:
        value = tomllib.loads(f"value = {written}")["value"]
    except tomllib.TOMLDecodeError:
        value = written
    if name != TRIAL:
        return PARAMETERS[name].check(value)
    if isinstance(value, int) and 0 <= value < 2**62:
        return value
    raise ValueError("a whole number, at least 0")


def coordinates_text(pipeline: Pipeline, chosen: Pipeline) -> str:
    """Return where a cell lies on its grid, in words: "distance_m 0.3, tilt_deg 45"."""
    parts = []
    for axis in pipeline.axes:
        value = chosen.axes[0].values[0] if axis.name == TRIAL else chosen.fixed[axis.name]
        shown = f"{value:.6g}" if isinstance(value, float) else str(value)
        parts.append(f"{axis.name} {shown}")
    return ", ".join(parts)
