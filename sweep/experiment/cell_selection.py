"""A cell of a grid, selected by its coordinates: ``distance_m=0.3,tilt_deg=45``."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from typing import Any

from sweep.experiment.axes import TRIAL, Axis
from sweep.experiment.document import read_value
from sweep.experiment.parameters import PARAMETERS, Parameter
from sweep.experiment.pipeline import Pipeline, displaced_by
from sweep.messages import MAX_FAULTS, label, nearest, plain, refusal

_PART = re.compile(r"""(?:\[[^\]]*\]?|"[^"]*"?|[^,\["])+""")
"""A part between commas; commas within a list or within quotes do not separate."""


def cell(pipeline: Pipeline, at: str) -> Pipeline:
    """Return the pipeline with every axis but ``trial`` fixed, and a single trial.

    Parameters
    ----------
    pipeline
        The grid.
    at
        Coordinates as ``--at`` takes them; axes without one take their first value. Any value
        that a parameter admits is accepted, on the grid or not.

    Raises
    ------
    PipelineError
        One line for each invalid part of ``at``.
    """
    named = parse_selection(at, pipeline)
    chosen: dict[str, Any] = {}
    for axis in pipeline.axes:
        # Values that are not on the grid replace those of its first cell.
        index = axis.index_of(named) if axis.columns.keys() & named.keys() else 0
        chosen |= axis.at(index or 0)
    chosen |= named
    trial = chosen.pop(TRIAL, 0)
    axes = (Axis(TRIAL, {TRIAL: range(trial, trial + 1)}),)
    for other in displaced_by(named):
        chosen.pop(other, None)
    return dataclasses.replace(pipeline.fixed_at(chosen), axes=axes)


def parse_selection(at: str, pipeline: Pipeline | None = None) -> dict[str, Any]:
    """Return the values of the parameters that ``--at`` names.

    An axis of the pipeline along which parameters go together is named by one of its labels, in
    quotes, or by a number from 0.

    Raises
    ------
    PipelineError
        One line for each invalid part of ``at``.

    Examples
    --------
    >>> parse_selection("distance_m=0.3,solver=ippe")
    {'distance_m': 0.3, 'solver': 'ippe'}
    """
    faults: list[str] = []
    named: dict[str, Any] = {}
    axes = () if pipeline is None else pipeline.axes
    parameters = PARAMETERS if pipeline is None else pipeline.parameters
    together = {axis.name: axis for axis in axes if axis.zipped}
    for part in map(str, _PART.findall(at)):
        name, equals, written = (piece.strip() for piece in part.partition("="))
        try:
            if not equals or not written:
                raise ValueError("name=value, such as tilt_deg=45")
            if name in together:
                row = together[name].at(_row(together[name], written))
            elif name == TRIAL or name in parameters:
                row = {name: _value(parameters.get(name), written)}
            else:
                known = [*parameters, TRIAL, *together]
                hint = nearest(name, known) if len(faults) < MAX_FAULTS else ""
                faults.append(f"--at {plain(part)}: unknown parameter{hint}")
                continue
        except ValueError as error:
            faults.append(f"--at {plain(part)}: expected {error}")
            continue
        faults += [f"--at {plain(part)}: {other} is given twice" for other in row if other in named]
        named |= row
    if faults:
        raise refusal(faults)
    return named


def _row(axis: Axis, written: str) -> int:
    """Return the index along an axis that a label or a number names; ValueError for others."""
    try:
        value = read_value(written)
    except ValueError:
        value = written
    if isinstance(value, str) and value in axis.values:
        return axis.values.index(value)
    if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < len(axis):
        return value
    raise ValueError(f'a number from 0 to {len(axis) - 1}, or a label such as "{axis.values[0]}"')


def _value(parameter: Parameter | None, written: str) -> Any:
    try:
        value = read_value(written)
    except ValueError:
        value = written
    if parameter is not None:
        return parameter.check(value)
    if isinstance(value, int) and 0 <= value < 2**62:
        return value
    raise ValueError("a whole number, at least 0")


def selection_text(coordinates: Mapping[str, Any]) -> str:
    """Return a cell's coordinates as ``--at`` takes them.

    >>> selection_text({"distance_m": 0.3, "guarded": True, "distortion": (0.1, 0.0)})
    'distance_m=0.3,guarded=true,distortion=[0.1,0.0]'
    """
    return ",".join(f"{name}={_written(value)}" for name, value in coordinates.items())


def _written(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return label(value).replace(", ", ",") if isinstance(value, tuple) else label(value)


def coordinates_text(pipeline: Pipeline, chosen: Pipeline) -> str:
    """Return the coordinates of a cell on its grid, in words: "distance_m 0.3, tilt_deg 45"."""
    parts = []
    for name in (name for axis in pipeline.axes for name in axis.columns):
        value = chosen.axes[0].values[0] if name == TRIAL else chosen.fixed[name]
        shown = f"{value:.6g}" if isinstance(value, float) else str(value)
        parts.append(f"{name} {shown}")
    return ", ".join(parts)
