"""One verdict for each requirement and configuration, from the decisions at all conditions."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis.requirements import Decision
from sweep.messages import label


@dataclass(frozen=True)
class Verdict:
    """Whether a configuration meets a requirement at all conditions.

    Attributes
    ----------
    requirement, units
        Its text, and the units of value and limit.
    configuration, condition
        Values by axis: of detector and estimator; of the condition that is farthest from being
        met, whose value, interval and draws follow.
    decision
        Not met if it is not met at any condition, met if it is at all that can be judged.
    value, low, high, draws
        At that condition.
    draws_needed
        About how many draws would decide all of them; NaN if it is decided, infinite if no number
        would do.
    counts
        Conditions by decision.
    """

    requirement: str
    units: str
    limit: float
    configuration: Mapping[str, Any]
    condition: Mapping[str, Any]
    decision: Decision
    value: float
    low: float
    high: float
    draws: int
    draws_needed: float
    counts: Mapping[Decision, int]

    @property
    def conditions(self) -> int:
        """Conditions that can be judged."""
        return sum(count for decision, count in self.counts.items()
                   if decision is not Decision.not_applicable)


def verdicts(table: xr.Dataset) -> list[Verdict]:
    """Return the verdicts of a table of `sweep.analysis.check_requirements`."""
    configuration = [str(name) for name in table.attrs["configuration_dims"]]
    conditions = [str(dim) for dim in table["decision"].dims
                  if dim not in (*configuration, "requirement")]
    found = []
    for at in np.ndindex(*(table.sizes[name] for name in configuration)):
        chosen = table.isel(dict(zip(configuration, at, strict=True)))
        found += [_verdict(chosen.isel(requirement=number), configuration, conditions)
                  for number in range(table.sizes["requirement"])]
    return found


def combined(found: Iterable[Verdict]) -> Decision:
    """Return the decision of all verdicts together."""
    decisions = [verdict.decision for verdict in found]
    for decision in (Decision.not_met, Decision.undecided, Decision.not_applicable):
        if decision in decisions:
            return Decision.undecided if decision is Decision.not_applicable else decision
    return Decision.met


def _verdict(
    one: xr.Dataset, configuration: Sequence[str], conditions: Sequence[str]
) -> Verdict:
    """Return the verdict of a table (*conditions) of one configuration and requirement."""
    decisions = one["decision"].transpose(*conditions).values
    counts = {each: count for each in Decision if (count := int((decisions == each).sum()))}
    order = (Decision.not_met, Decision.undecided, Decision.met, Decision.not_applicable)
    decision = next(each for each in order if each in counts)
    index = worst_condition(one.transpose(*conditions), decisions == decision)
    cell = one.isel(dict(zip(conditions, index, strict=True)))
    needed = one["draws_needed"].values[decisions == Decision.undecided]
    return Verdict(
        str(one["requirement"].item()), str(one["units"].item()), float(one["limit"]),
        {name: one[name].item() for name in configuration},
        {name: cell[name].item() for name in conditions}, decision,
        float(cell["value"]), float(cell["low"]), float(cell["high"]), int(cell["draws"]),
        float(np.nanmax(needed)) if decision is Decision.undecided and (
            np.isfinite(needed) | np.isinf(needed)).any() else math.nan, counts)


def worst_condition(one: xr.Dataset, among: np.ndarray[Any, Any]) -> tuple[int, ...]:
    """Return the index of the value that is farthest on the wrong side of the limit."""
    value, limit = one["value"].values, float(one["limit"])
    excess = limit - value if one["relation"].item() in (">=", ">") else value - limit
    excess = np.where(among, np.nan_to_num(excess, nan=np.inf, posinf=np.inf), -np.inf)
    return tuple(map(int, np.unravel_index(int(np.argmax(excess)), excess.shape)))


def described(values: Mapping[str, Any]) -> str:
    """Return values of axes as text.

    >>> described({"distance_m": 0.30000000000000004, "solver": "ippe"})
    'distance_m=0.3, solver=ippe'
    """
    return ", ".join(
        f"{name}={value:.6g}" if isinstance(value, float) else f"{name}={label(value)}"
        for name, value in values.items())
