"""The choice that meets requirements at all conditions: of a size, and among other settings.

What a choice is stands in `sweep.plan.choice_rule`, when one is answered in
`sweep.analysis.choice_walk`. Every alternative, a combination of the values of the axes ``among``,
has its own answer.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.analysis.choice_walk import Decisions, error_shares, needed, walk
from sweep.analysis.requirable import MIN_DRAWS
from sweep.analysis.requirements import (
    Decision,
    ErrorShares,
    Requirement,
    decide,
    parse_requirements,
)
from sweep.plan.choice_rule import ChoiceRule
from sweep.plan.experiment import Pipeline
from sweep.typing import Floats, Masks


@dataclass(frozen=True, slots=True)
class Cause:
    """A requirement at a condition: by which a choice fails, or only just does not.

    Attributes
    ----------
    requirement, units
        Its text, and the units of its numbers.
    condition
        Values by axis.
    decision, value, low, high, draws
        As `sweep.analysis.check_requirements` has them, at the levels of the search.
    draws_needed
        About how many draws would decide it, if the value stays; NaN if it is decided, infinite if
        no number would.
    """

    requirement: str
    units: str
    condition: Mapping[str, Any]
    decision: Decision
    value: float
    low: float
    high: float
    draws: int
    draws_needed: float = math.nan


@dataclass(frozen=True, slots=True)
class Nearest:
    """The value that is nearest to meeting all, where none does.

    Attributes
    ----------
    value
        The value, None without an axis.
    excess
        How far it is beyond the limit of a requirement, relative to it.
    cause
        That requirement and its condition.
    """

    value: float | None
    excess: float
    cause: Cause


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer of one alternative.

    Attributes
    ----------
    alternative
        Values by axis, of the axes ``among``.
    met
        Whether any choice meets the requirements.
    value
        The smallest (largest) value of the axis from which on all larger (smaller) ones of the
        grid meet them; None if there is no such axis, or no such value.
    tightest
        The requirement and condition at which the answer is nearest to failing.
    next, next_cause
        The next value, which fails or is undecided, and by what; None if all values meet them.
        Without an axis ``next`` is None, and ``next_cause`` that of the alternative itself.
    isolated
        Values that fail, or seem to, with others beyond that seem to meet all: (value, cause).
    passing
        Those values beyond.
    nearest
        If none is met: what is nearest to it.
    """

    alternative: Mapping[str, Any]
    met: bool
    value: float | None
    tightest: Cause | None = None
    next: float | None = None
    next_cause: Cause | None = None
    isolated: tuple[tuple[float, Cause], ...] = ()
    passing: tuple[float, ...] = ()
    nearest: Nearest | None = None


@dataclass(frozen=True, slots=True)
class ChoiceCells:
    """Decisions at each value and condition of each alternative.

    Attributes
    ----------
    table
        Of `sweep.analysis.requirements.decide`, dimensions (*among, along, *per, requirement), the
        values in the order of the walk; without the axis ``along`` if there is none.
    decision, keeps
        (alternatives, values, conditions): of all requirements together, and whether the estimates
        keep all limits.
    each, excess
        (alternatives, values, conditions, requirements): the decision, and how far the value is
        beyond the limit, relative to it; negative on the right side of it, infinite for no number.
    """

    table: xr.Dataset
    decision: Decisions
    keeps: Masks
    each: Decisions
    excess: Floats
    among: tuple[str, ...]
    per: tuple[str, ...]

    def needed(self) -> xr.DataArray:
        """Return which cells need more trials, dimensions (*among, along, *per)."""
        template = self.table["decision"].isel(requirement=0, drop=True)
        return template.copy(data=needed(self.decision, self.keeps).reshape(template.shape))


def choice_shares(pipeline: Pipeline, rule: ChoiceRule, waves: int) -> ErrorShares:
    """Return the shares of the error probability that each decision of a search may spend."""
    def size(names: Sequence[str]) -> int:
        axes = [axis for name in names if (axis := pipeline.axis(name)) is not None]
        return math.prod(map(len, axes))

    return error_shares(
        rule.confidence, waves=waves, alternatives=size(rule.among),
        values=size([rule.along] if rule.along else []), conditions=size(rule.per),
        requirements=len(rule.requirements))


def choice_cells(results: xr.Dataset, rule: ChoiceRule, shares: ErrorShares) -> ChoiceCells:
    """Return the decisions of a dataset, of a whole store or of some of its alternatives.

    Raises
    ------
    ArgumentError, DatasetError
        As `sweep.analysis.check_requirements`.
    """
    required = parse_requirements(rule.requirements)
    kept = [*rule.among, *([rule.along] if rule.along else []), *rule.per]
    table = decide(results, required, kept, shares=shares)
    table = table.transpose(*kept, "requirement", missing_dims="ignore")
    if rule.along:
        values = table[rule.along].to_numpy()
        order = np.argsort(values, kind="stable")
        table = table.isel({rule.along: order if rule.largest else order[::-1]})
    conditions = math.prod(table.sizes[name] for name in rule.per)
    shape = (-1, table.sizes[rule.along] if rule.along else 1, conditions, len(required))

    def cells(name: str) -> NDArray[Any]:
        values = table[name].to_numpy().reshape((*table[name].shape[:len(kept)], -1))
        return np.broadcast_to(values, table["value"].shape).reshape(shape)

    # Where so few poses count that max_trials will not have enough, there is nothing to learn.
    poses = cells("looked_for").astype(np.float64)
    pooled = math.prod(results.sizes[str(name)] for name in results["true_tvec_m"].dims if
                       name not in (*kept, "trial", "xyz"))
    with np.errstate(invalid="ignore"):
        coming = cells("draws") / poses * rule.max_trials * pooled
    hopeless = (poses >= MIN_DRAWS) & (coming < MIN_DRAWS)
    each = np.where(hopeless & (cells("decision") == Decision.undecided),
                    Decision.not_met, cells("decision")).astype(np.uint8)
    excess = np.stack([_excess(one, cells("value")[..., k]) for k, one in enumerate(required)], -1)
    excess = np.where(each == Decision.not_applicable, -np.inf, excess)
    applicable = each != Decision.not_applicable
    decision = np.where((each == Decision.not_met).any(-1), Decision.not_met, np.where(
        ((each == Decision.met) | ~applicable).all(-1), Decision.met, Decision.undecided))
    decision = np.where(applicable.any(-1), decision, Decision.not_applicable).astype(np.uint8)
    return ChoiceCells(
        table, decision, np.asarray((excess <= 0.0).all(-1)), each, excess, rule.among, rule.per)


def _excess(requirement: Requirement, value: Floats) -> Floats:
    """Return how far values are beyond the limit, relative to it; a limit is never 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = value / requirement.limit
        excess = 1.0 - ratio if requirement.at_least else 1.0 - 1.0 / ratio
    excess = np.where(np.isnan(value), np.inf, excess)
    if requirement.relation in (">", "<"):  # at the limit it is not kept
        return np.where(excess == 0.0, np.finfo(float).tiny, excess)
    return np.asarray(excess)


def answers(cells: ChoiceCells, along: str) -> list[Answer]:
    """Return the answer of each alternative, in the order of the table's dimensions.

    Parameters
    ----------
    cells
        Of `choice_cells`.
    along
        The axis that is sought along; empty for none.
    """
    names = [name for name in cells.among if name in cells.table.dims]
    lengths = [cells.table.sizes[name] for name in names]
    values = cells.table[along].to_numpy().tolist() if along else [None]
    found = []
    for k, index in enumerate(np.ndindex(*lengths)):
        alternative = {name: cells.table[name].isel({name: at}).item()
                       for name, at in zip(names, index, strict=True)}
        found.append(_answer(cells, k, values, alternative))
    return found


def _answer(
    cells: ChoiceCells, k: int, values: Sequence[float | None], alternative: Mapping[str, Any]
) -> Answer:
    """Return the answer of alternative number ``k``."""
    came = walk(cells.decision[k], cells.keeps[k])
    tightest = None if came.answer < 0 else _cause(cells, k, came.answer)
    after, cause = None, None
    if came.next < len(values):
        after, cause = values[came.next], _cause(cells, k, came.next)
    nearest = None
    if came.answer < 0:
        worst = cells.excess[k].max(axis=(1, 2))
        judged = (cells.decision[k] != Decision.not_applicable).any(axis=1)
        best = int(np.argmin(np.where(judged, worst, np.inf)))
        nearest = Nearest(values[best], float(worst[best]), _cause(cells, k, best))
    return Answer(
        alternative, came.answer >= 0, values[came.answer] if came.answer >= 0 else None, tightest,
        after, cause,
        tuple((_number(values[at]), _cause(cells, k, at)) for at in came.isolated),
        tuple(_number(values[at]) for at in came.passing), nearest)


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _cause(cells: ChoiceCells, k: int, at: int) -> Cause:
    """Return the requirement and condition by which a value fails worst, or is nearest to it."""
    each, excess = cells.each[k, at], cells.excess[k, at]
    among = next((mask for decision in (Decision.not_met, Decision.undecided, Decision.met)
                  if (mask := each == decision).any()), np.ones(each.shape, bool))
    flat = int(np.argmax(np.where(among, excess, -np.inf)))
    condition, requirement = np.unravel_index(flat, each.shape)
    table, names = cells.table, [str(name) for name in cells.table["decision"].dims][:-1]
    position = np.ravel_multi_index((k, at, int(condition)), cells.decision.shape)
    index = np.unravel_index(position, [table.sizes[name] for name in names]) if names else ()
    one = table.isel(dict(zip(names, map(int, index), strict=True))).isel(
        requirement=int(requirement))
    cause = Cause(
        str(one["requirement"].item()), str(one["units"].item()),
        {name: one[name].item() for name in cells.per},
        Decision(int(each.reshape(-1)[flat])), float(one["value"]), float(one["low"]),
        float(one["high"]), int(one["draws"]))
    if cause.decision is not Decision.undecided:
        return cause
    return replace(cause, draws_needed=_draws_needed(cause))


def _draws_needed(cause: Cause) -> float:
    """Return about how many draws would decide: intervals narrow with the root of their number."""
    required = parse_requirements([cause.requirement])[0]
    gap = abs(cause.value - required.limit)
    good = (cause.value >= required.limit) == required.at_least
    end = cause.low if good == required.at_least else cause.high
    if gap == 0.0:
        return math.inf
    if not math.isfinite(end) or not math.isfinite(cause.value):
        return 2.0 * cause.draws
    return float(f"{cause.draws * max(1.1, abs(end - cause.value) / gap) ** 2:.2g}")
