"""The section [precision]: how well each quantity is to be known at each condition.

Names of quantities are known to the analysis alone; the rule that samples
(`sweep.sampling.precision`) checks them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from sweep.plan.axes import TRIAL
from sweep.plan.parameters import Stage
from sweep.plan.reader import Reading

_PERCENT = re.compile(r"\s*([0-9]+(?:\.[0-9]*)?|\.[0-9]+)\s*%\s*")

OWN = ("per", "max_trials")
"""Keys of the section that are no quantities."""


@dataclass(frozen=True, slots=True)
class PrecisionRule:
    """Trials come in waves until intervals are as narrow as is wanted.

    Attributes
    ----------
    wanted
        Name of each quantity, and the half-width of its interval: of a rate as it is, else
        relative to the value.
    per
        The scene axes of which every combination of values is a condition; the others are pooled.
    max_trials
        The most trials of a condition; the length of the axis ``trial``.
    """

    wanted: tuple[tuple[str, float], ...]
    per: tuple[str, ...]
    max_trials: int
    section: ClassVar[str] = "precision"

    def looser(self, begun: PrecisionRule) -> str:
        """Return why a store begun under another precision is not continued; empty if it is."""
        if self.max_trials != begun.max_trials:
            return (
                f"precision.max_trials: the store has {begun.max_trials}, this run "
                f"{self.max_trials}"
            )
        if self.per != begun.per:
            return (
                f"precision.per: the store has {', '.join(begun.per) or 'no axis'}, this run "
                f"{', '.join(self.per) or 'no axis'}"
            )
        ours = dict(self.wanted)
        for name, width in begun.wanted:
            if ours.get(name, float("inf")) > width:
                own = f"{ours[name]:g}" if name in ours else "none"
                return f"precision.{name}: the store has {width:g}, this run {own}, which is looser"
        return ""


def read_precision(reading: Reading, table: Mapping[str, Any]) -> PrecisionRule | None:
    """Return what a table [precision] says; None if it has faults, which are noted."""
    known = len(reading.faults)
    wanted = tuple(sorted(
        (str(name), width) for name, value in table.items() if name not in OWN
        and (width := _half_width(reading, str(name), value)) is not None
    ))
    if not wanted and len(reading.faults) == known:
        reading.fault(
            "precision", dict(table),
            "how well a quantity is to be known, such as detection_rate = 0.02",
        )
    per = read_conditions(reading, "precision", table)
    if TRIAL not in reading.axes:
        return None  # a fault that is noted
    return PrecisionRule(wanted, per, len(reading.axes[TRIAL]))


def _half_width(reading: Reading, name: str, value: Any) -> float | None:
    """Return the half-width that a value says, or note why it is none."""
    percent = _PERCENT.fullmatch(value) if isinstance(value, str) else None
    number = float(percent[1]) / 100 if percent else value
    if isinstance(number, bool) or not isinstance(number, (int, float)) or not 0 < number < 1:
        reading.fault(
            f"precision.{name}", value,
            'the half-width of an interval, such as 0.02 or "5 %", above 0 and below 1',
        )
        return None
    return float(number)


def read_conditions(reading: Reading, section: str, table: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the scene axes that a section's ``per`` names; all of them without it."""
    axes = tuple(
        axis.name for axis in reading.axes.values()
        if axis.stage is Stage.scene and axis.name != TRIAL
    )
    if "per" not in table:
        return axes
    names, path = table["per"], f"{section}.per"
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        reading.fault(path, names, 'a list of names of axes, such as ["distance_m"]')
        return axes
    for name in names:
        if problem := _no_condition(reading, name, axes):
            reading.unknown(path, f"{name}: {problem}", name, axes)
    return tuple(name for name in axes if name in names)


def _no_condition(reading: Reading, name: str, axes: tuple[str, ...]) -> str:
    """Return why a name is no condition of the grid; empty if it is one, or is fixed."""
    if name in axes:
        return ""
    if name == TRIAL:
        return "trials are what is counted; expected an axis of the scene"
    axis = reading.axis_of(name)
    if axis is not None and axis.stage is Stage.scene:
        return f"it goes with others along the axis {axis.name}; expected that name"
    parameter = reading.parameters.get(name)
    if axis is not None or (parameter is not None and parameter.stage is not Stage.scene):
        return "every configuration reaches the precision by itself; expected an axis of the scene"
    if name in reading.distributions:
        return "it is drawn for each trial; expected an axis of the scene"
    return "" if parameter is not None else "no such axis"
