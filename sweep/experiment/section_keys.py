"""Keys of the sections that control sampling: numbers in a range, names of axes of the scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from sweep.declaration import Declaration, Declared
from sweep.experiment.axes import TRIAL, Axis
from sweep.experiment.parameters import Stage
from sweep.experiment.reader import Reading


def unknown_keys(
    reading: Reading, section: str, table: Mapping[str, Any], known: Sequence[str]
) -> None:
    """Note the keys that a section does not have."""
    for key in table:
        if key not in known:
            reading.unknown_key(section, str(key), known, f"; expected {', '.join(known)}")


def number(
    reading: Reading, section: str, table: Mapping[str, Any], key: str, default: float,
    low: float, high: float,
) -> Any:
    """Return a key's number in [low, high], of the default's type, or note why it is none."""
    declared = Declared(key, (type(default),), default, Declaration("", low=low, high=high))
    try:
        return declared.check(table.get(key, default))
    except ValueError as error:
        reading.fault(f"{section}.{key}", table[key], str(error))
        return default


def texts(
    reading: Reading, section: str, table: Mapping[str, Any], key: str, example: str,
    *, needed: bool = False,
) -> list[str]:
    """Return a key's list of texts, which is not empty if it is ``needed``, or note a fault."""
    value = table.get(key, [])
    if isinstance(value, list) and all(isinstance(text, str) for text in value) and (
            value or not needed):
        return [str(text) for text in value]
    reading.fault(f"{section}.{key}", value, f"a list of texts, such as {example}")
    return []


def scene_axes(reading: Reading) -> list[Axis]:
    """Return the axes of the scene without ``trial``: those whose values can be conditions."""
    return [axis for axis in reading.axes.values()
            if axis.stage is Stage.scene and axis.name != TRIAL]


def axis_at(reading: Reading, path: str, name: str, *, scene: bool = True) -> Axis | None:
    """Return an axis, of the scene or any but ``trial``, by name, or note why there is none."""
    axis, together = reading.axes.get(name), reading.axis_of(name)
    if name == TRIAL:
        problem = "trials are what is counted"
    elif axis is not None and scene and axis.stage is not Stage.scene:
        problem = "each configuration has its own answer"
    elif axis is not None:
        return axis
    elif together is not None:
        problem = f"it goes with others along the axis {together.name}"
    elif name in reading.distributions:
        problem = f"it is drawn for each trial: give {name} values under [axes]"
    elif reading.names_axis(name):
        return None  # its own fault says why it is none
    elif name in reading.parameters:
        problem = f"it has one value: list the values of {name} under [axes]"
    else:
        known = scene_axes(reading) if scene else reading.axes.values()
        reading.unknown(path, f"{name}: no such axis", name, [axis.name for axis in known])
        return None
    where = "of the scene" if scene else "of the grid"
    reading.unknown(path, f"{name}: {problem}; expected an axis {where}", name, ())
    return None


def ordered_axis(reading: Reading, path: str, name: Any) -> str:
    """Return the name of a scene axis of several numbers; "" with a fault noted if it is none."""
    if not isinstance(name, str) or not name:
        reading.fault(path, name, "the axis that is searched, such as distance_m")
        return ""
    if (axis := axis_at(reading, path, name)) is None:
        return ""
    if axis.labelled or isinstance(axis.values[0], bool):
        reading.fault(path, name, f"an axis of numbers; {name} has no order")
    elif len(axis) < 2:
        reading.fault(path, name, f"an axis of several values, from easy to hard; {name} has one")
    else:
        return name
    return ""


def conditions(
    reading: Reading, section: str, table: Mapping[str, Any], key: str, along: str = "",
) -> tuple[str, ...]:
    """Return the scene axes that a key lists, in the grid's order; the others' faults are noted.

    A fixed parameter is a condition of one value. The axis ``along`` is not among them.
    """
    path = f"{section}.{key}"
    names = dict.fromkeys(texts(reading, section, table, key, '["distance_m"]'))
    for name in names:
        if along and name == along:
            reading.fault(path, name, f"other axes than {along}, which is searched along")
        elif name not in reading.fixed or reading.parameters[name].stage is not Stage.scene:
            axis_at(reading, path, name)
    return tuple(axis.name for axis in scene_axes(reading)
                 if axis.name in names and axis.name != along)


def difference(section: str, ours: Any, begun: Any, names: Sequence[str] = ()) -> str:
    """Return the first field in which two rules of a section differ, in words; "" if none does."""
    for name in names or [field.name for field in dataclasses.fields(ours)]:
        here, there = getattr(ours, name), getattr(begun, name)
        if here != there:
            return f"{section}.{name}: the store has {_text(there)}, this run {_text(here)}"
    return ""


def _text(value: Any) -> str:
    return (", ".join(value) or "none") if isinstance(value, tuple) else str(value)
