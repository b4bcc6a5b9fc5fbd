"""The section [choose]: what is chosen so that the section [require] is met at all conditions.

::

    [require]
    all = ["detection >= 0.99", "range_p95_percent <= 1", "budget_ms <= 2"]
    per = ["tilt_deg", "distance_m"]    # conditions (default: every scene axis that is not chosen)

    [choose]
    smallest = "size_m"                 # or largest = "distance_m", or neither: the cheapest
    among = ["dictionary", "solver"]    # further choices; axes of configurations always are
    max_trials = 5000
    confidence = 0.95
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from sweep.plan.axes import TRIAL, Axis
from sweep.plan.parameters import Stage
from sweep.plan.reader import REQUIRE, Reading
from sweep.plan.required import without_budget

SECTION = "choose"
WISHES = ("smallest", "largest")
KEYS = (*WISHES, "among", "max_trials", "confidence")

CONFIDENCE = 0.95
"""Confidence if none is given."""


@dataclass(frozen=True, slots=True)
class ChoiceRule:
    """Trials come in waves until the choice is known.

    Attributes
    ----------
    along
        The axis whose smallest or largest value is sought; empty if the cheapest choice is.
    largest
        Whether the largest is.
    among
        The axes of which every combination of values, an alternative, is a choice of its own.
    requirements
        What must hold, as texts; without a budget, which no trial decides.
    per
        The scene axes of which every combination of values is a condition; others are pooled.
    max_trials
        The most trials of a condition; the length of the axis ``trial``.
    confidence
        Probability with which an answer meets the requirements.
    """

    along: str
    largest: bool
    among: tuple[str, ...]
    requirements: tuple[str, ...]
    per: tuple[str, ...]
    max_trials: int
    confidence: float
    section: ClassVar[str] = SECTION

    def looser(self, begun: ChoiceRule) -> str:
        """Return why a store begun for another choice is not continued; empty if it is."""
        for field in dataclasses.fields(self):
            ours, theirs = getattr(self, field.name), getattr(begun, field.name)
            if ours != theirs:
                shown = [", ".join(each) or "none" if isinstance(each, tuple) else each
                         for each in (theirs, ours)]
                return f"{SECTION}: {field.name}: the store has {shown[0]}, this run {shown[1]}"
        return ""


def read_choice(reading: Reading, table: Mapping[str, Any]) -> ChoiceRule | None:
    """Return what a table [choose] says; None if it has faults, which are noted."""
    known = len(reading.faults)
    for key in table:
        if key not in KEYS:
            reading.unknown(f"{SECTION}.{key}", f"unknown key; expected {', '.join(KEYS)}",
                            str(key), KEYS)
    wishes = [key for key in WISHES if key in table]
    if len(wishes) > 1:
        reading.fault(f"{SECTION}.largest", table["largest"], "smallest or largest, not both")
    along = _along(reading, wishes[0], table[wishes[0]]) if len(wishes) == 1 else None
    among = _among(reading, table.get("among", []), along.name if along else "")
    if not wishes and math.prod(len(reading.axes[name]) for name in among) < 2:
        reading.fault(SECTION, dict(table), (
            'something to choose: smallest = "size_m", with its values under [axes], or '
            'among = ["solver"], of which the cheapest is chosen'))
    confidence = table.get("confidence", CONFIDENCE)
    if isinstance(confidence, bool) or not isinstance(confidence, (int, float)) or not (
            0.5 <= confidence <= 0.9999):
        reading.fault(f"{SECTION}.confidence", confidence, "a number from 0.5 to 0.9999")
    chosen = {*among, *([along.name] if along else [])}
    requirements, per = _required(reading, chosen)
    if len(reading.faults) > known or TRIAL not in reading.axes:
        return None
    return ChoiceRule(
        along.name if along else "", "largest" in table, among, requirements, per,
        len(reading.axes[TRIAL]), float(confidence))


def _along(reading: Reading, wish: str, name: Any) -> Axis | None:
    """Return the axis along which the smallest or largest value is sought, or note a fault."""
    path = f"{SECTION}.{wish}"
    axis = _axis(reading, path, name)
    if axis is None:
        return None
    if axis.stage is not Stage.scene:
        reading.fault(path, name, "an axis of the scene; those of detector and estimator are "
                      "choices in any case, of which the cheapest is named")
    elif axis.zipped or not all(
            isinstance(value, (int, float)) and not isinstance(value, bool)
            for value in axis.values):
        reading.fault(path, name, f"an axis with numbers; {name} has no order: put it into among")
    elif len(axis) < 2:
        reading.fault(path, name, f"an axis of several values; {name} has one: there is nothing "
                      "to choose")
    else:
        return axis
    return None


def _among(reading: Reading, names: Any, along: str) -> tuple[str, ...]:
    """Return the axes of alternatives, those of configurations among them, in the grid's order."""
    path = f"{SECTION}.among"
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        reading.fault(path, names, 'a list of names of axes, such as ["dictionary", "solver"]')
        names = []
    if along and along in names:
        reading.fault(path, names, f"{along} once: it is sought along already")
    chosen = {axis.name for name in names
              if name != along and (axis := _axis(reading, path, name)) is not None}
    return tuple(axis.name for axis in reading.axes.values() if axis.name != TRIAL and (
        axis.name in chosen or axis.stage is not Stage.scene))


def _axis(reading: Reading, path: str, name: Any) -> Axis | None:
    """Return an axis by name, or note why there is none."""
    if isinstance(name, str) and name in reading.axes and name != TRIAL:
        return reading.axes[name]
    if not isinstance(name, str):
        reading.fault(path, name, 'the name of an axis, such as "size_m"')
    elif name == TRIAL:
        reading.fault(path, name, "an axis that can be chosen; trials are what is counted")
    elif name in reading.distributions:
        reading.fault(path, name, f"an axis; {name} is drawn: give it values under [axes]")
    elif (other := reading.axis_of(name)) is not None:
        reading.fault(path, name, f"{other.name}, the axis along which {name} goes with others")
    elif reading.names_axis(name):
        return None  # its own fault says why it is none
    elif name in reading.parameters:
        reading.fault(path, name, f"an axis; list the values of {name} under [axes]")
    else:
        reading.unknown(path, f"{name}: no such axis", name, [*reading.axes, *reading.parameters])
    return None


def _required(reading: Reading, chosen: set[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the requirements and the conditions; faults of the section are noted elsewhere."""
    table = reading.document.get(REQUIRE)
    table = table if isinstance(table, dict) else {}
    texts, per = table.get("all"), table.get("per")
    texts = [each for each in texts if isinstance(each, str)] if isinstance(texts, list) else []
    texts = without_budget(texts)
    if not texts:
        reading.faults.append(
            f"{reading.source}: {SECTION}: expected what must be met: [{REQUIRE}] "
            'all = ["detection >= 0.99"]')
    axes = [axis.name for axis in reading.axes.values()
            if axis.stage is Stage.scene and axis.name != TRIAL]
    if not isinstance(per, list):
        return tuple(texts), tuple(name for name in axes if name not in chosen)
    for name in chosen.intersection(each for each in per if isinstance(each, str)):
        reading.fault(f"{REQUIRE}.per", per, f"conditions; {name} is what [{SECTION}] chooses")
    return tuple(texts), tuple(name for name in axes if name in per)
