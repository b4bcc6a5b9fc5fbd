"""The section [limit]: how far along an axis requirements are met.

What a requirement may be of is known to the analysis alone; the rule that samples
(`sweep.sampling.limit`) checks the names.
"""

from __future__ import annotations

import json
import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from sweep.messages import shown
from sweep.plan.axes import MAX_VALUES, TRIAL, Axis
from sweep.plan.parameters import Stage
from sweep.plan.reader import Reading
from sweep.plan.requirement_text import read_requirement
from sweep.plan.wave_ends import wave_ends

SECTION = "limit"

COARSE_DRAWS = 40
"""Draws of a value in the coarse scan, about: all pooled cells together."""

KEYS = ("require", "along", "per", "at_all", "coarse_trials", "max_trials")
"""The keys of the section."""


@dataclass(frozen=True, slots=True)
class LimitRule:
    """Trials come in waves where they decide how far requirements are met.

    Attributes
    ----------
    require
        The requirements, as texts.
    along
        The scene axis that is searched.
    per
        The scene axes of which every combination of values has a limit of its own.
    at_all
        The scene axes at all of whose values the requirements must hold. The others are pooled.
    coarse_trials
        Trials of every cell in the first wave.
    max_trials
        The most trials of a cell; the length of the axis ``trial``.
    """

    require: tuple[str, ...]
    along: str
    per: tuple[str, ...]
    at_all: tuple[str, ...]
    coarse_trials: int
    max_trials: int
    section: ClassVar[str] = SECTION

    @property
    def ends(self) -> tuple[int, ...]:
        """Numbers of trials at which waves end, and decisions are made."""
        return wave_ends(self.max_trials, self.coarse_trials)

    def looser(self, begun: LimitRule) -> str:
        """Return why a store begun under another search is not continued; empty if it is."""
        for name in KEYS:
            ours, other = getattr(self, name), getattr(begun, name)
            if ours != other:
                return f"{SECTION}.{name}: the store has {_text(other)}, this run {_text(ours)}"
        return ""


def _text(value: Any) -> str:
    return (", ".join(value) or "none") if isinstance(value, tuple) else str(value)


def read_limit(reading: Reading, table: Mapping[str, Any]) -> LimitRule | None:
    """Return what a table [limit] says; None if it has faults, which are noted."""
    known = len(reading.faults)
    for key in table:
        if key not in KEYS:
            reading.unknown(f"{SECTION}.{key}", f"unknown key; expected {', '.join(KEYS)}",
                            str(key), KEYS)
    require = _requirements(reading, table)
    along = _along(reading, table)
    at_all = _axes(reading, table, "at_all", along)
    others = [axis.name for axis in _scene_axes(reading) if axis.name not in (along, *at_all)]
    per = _axes(reading, table, "per", along) if "per" in table else tuple(others)
    for name in sorted({*per} & {*at_all}):
        reading.fault(f"{SECTION}.at_all", name, f"{name} in per or in at_all, not in both")
    pooled = math.prod(len(axis) for axis in _scene_axes(reading)
                       if axis.name not in (along, *per, *at_all))
    coarse = _coarse_trials(reading, table, pooled)
    if TRIAL in reading.axes and "coarse_trials" in table and 1 < len(reading.axes[TRIAL]) < coarse:
        reading.fault(f"{SECTION}.coarse_trials", coarse,
                      f"at most max_trials, {len(reading.axes[TRIAL]):,}")
    if TRIAL not in reading.axes or len(reading.faults) > known:
        return None
    count = len(reading.axes[TRIAL])
    return LimitRule(require, along, per, at_all, min(coarse, count), count)


def _scene_axes(reading: Reading) -> list[Axis]:
    return [axis for axis in reading.axes.values()
            if axis.stage is Stage.scene and axis.name != TRIAL]


def _requirements(reading: Reading, table: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the texts of what is required, noting what has not the form of such."""
    value = table.get("require", [])
    if not isinstance(value, list) or not value or not all(isinstance(t, str) for t in value):
        reading.fault(f"{SECTION}.require", value, 'a list of texts, such as ["detection >= 0.9"]')
        return ()
    for text in value:
        try:
            parts = read_requirement(text)
        except ValueError as error:
            reading.faults.append(f"{reading.source}: {SECTION}.require = {shown(text)}: {error}")
            continue
        if parts.name == "budget_ms":
            reading.faults.append(
                f"{reading.source}: {SECTION}.require = {shown(text)}: the cost is that of a "
                "configuration, wherever the marker is; ask sweep size or sweep tradeoff for it")
    return tuple(value)


def _along(reading: Reading, table: Mapping[str, Any]) -> str:
    """Return the axis that is searched, noting why a name is none that can be."""
    name = table.get("along", "")
    if isinstance(name, str) and name and not (problem := _no_order(reading, name)):
        return name
    if not isinstance(name, str) or not name:
        reading.fault(f"{SECTION}.along", name, "the axis that is searched, such as distance_m")
        return ""
    candidates = [axis.name for axis in _scene_axes(reading) if _is_ordered(axis)]
    known = [*candidates] if problem == "no such axis" else []
    reading.unknown(f"{SECTION}.along", f"{name}: {problem}", name, known)
    return ""


def _is_ordered(axis: Axis) -> bool:
    return not axis.labelled and not isinstance(axis.values[0], bool) and len(axis) > 1


def _no_order(reading: Reading, name: str) -> str:
    """Return why an axis cannot be searched along; empty if it can be."""
    axis = reading.axes.get(name)
    if name == TRIAL:
        return "trials are what is counted; expected an axis of the scene with numbers"
    if name in reading.distributions:
        return (f"it is drawn for each trial; expected an axis: {name} = [...] under [axes]")
    if axis is None:
        together = reading.axis_of(name)
        if together is not None:
            return (f"it goes with others along the axis {together.name}, which has no order; "
                    "expected an axis of its own")
        return "no such axis" if name not in reading.parameters else (
            f"it has one value; expected an axis: {name} = [...] under [axes]")
    if axis.stage is not Stage.scene:
        return "each configuration has its own limit; expected an axis of the scene"
    if axis.labelled or isinstance(axis.values[0], bool):
        return "its values have no order; expected an axis of numbers"
    return "" if len(axis) > 1 else "it has one value; expected several, from easy to hard"


def _axes(reading: Reading, table: Mapping[str, Any], key: str, along: str) -> tuple[str, ...]:
    """Return the scene axes that a list names, in the order of the grid."""
    names, path = table.get(key, []), f"{SECTION}.{key}"
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        reading.fault(path, names, 'a list of names of axes, such as ["tilt_deg"]')
        return ()
    axes = [axis.name for axis in _scene_axes(reading)]
    for name in dict.fromkeys(names):
        if name == along:
            reading.fault(path, name, f"other axes than {along}, which is searched along")
        elif name not in axes:
            axis = reading.axis_of(name)
            problem = "no such axis of the scene" if axis is None else (
                "trials are what is counted; expected an axis of the scene" if name == TRIAL else
                f"it goes with others along the axis {axis.name}; expected that name"
                if axis.stage is Stage.scene else
                "each configuration has its own limit; expected an axis of the scene")
            reading.unknown(path, f"{name}: {problem}", name, axes if axis is None else [])
    return tuple(name for name in axes if name in names and name != along)


def _coarse_trials(reading: Reading, table: Mapping[str, Any], pooled: int) -> int:
    """Return the trials of the coarse scan: those given, or as many as make `COARSE_DRAWS`."""
    usual = max(2, math.ceil(COARSE_DRAWS / pooled))
    value = table.get("coarse_trials", usual)
    if isinstance(value, bool) or not isinstance(value, int) or not 2 <= value <= MAX_VALUES:
        reading.fault(f"{SECTION}.coarse_trials", value,
                      f"a whole number from 2 on, such as {usual}")
        return usual
    return value


def limit_settings(
    require: Sequence[str] = (), along: str = "", per: Sequence[str] | None = None,
    at_all: Sequence[str] | None = None, coarse_trials: int | None = None,
    max_trials: int | None = None,
) -> list[str]:
    """Return what is given as settings of the section, as ``--set`` takes them.

    >>> limit_settings(["detection >= 0.9"], "distance_m", max_trials=600)
    ['limit.require=["detection >= 0.9"]', 'limit.along="distance_m"', 'limit.max_trials=600']
    """
    given = {
        "require": _listed(require) or None, "along": along or None,
        "per": None if per is None else _listed(per),
        "at_all": None if at_all is None else _listed(at_all),
        "coarse_trials": coarse_trials, "max_trials": max_trials,
    }
    return [f"{SECTION}.{key}={json.dumps(value, ensure_ascii=False, default=_whole)}"
            for key, value in given.items() if value is not None]


def _listed(texts: Sequence[str]) -> list[str]:
    return [texts] if isinstance(texts, str) else list(texts)


def _whole(value: Any) -> int | str:
    """Return a whole number of NumPy's; of anything else its text, which is refused as such."""
    return operator.index(value) if hasattr(value, "__index__") else str(value)
