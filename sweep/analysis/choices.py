"""Which value, smallest, largest or cheapest, meets requirements at all conditions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.analysis.requirements import (
    ERROR_PROBABILITY,
    MIN_DRAWS,
    Decision,
    ErrorShares,
    Requirement,
    combined_decision,
    decide,
    excess_of,
    kept_by,
    parse_requirements,
    read_requirements,
)
from sweep.experiment.axes import TRIAL
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.stopping import SEARCH, StoppingRule
from sweep.messages import shown
from sweep.typing import Floats, Masks

# --------------------------------------------------------------------------------------------------
# What is wrong with a choice before anything is computed, a line each.

def choice_faults(pipeline: Pipeline, rule: StoppingRule, shares: ErrorShares) -> list[str]:
    """Return what makes a choice impossible.

    Those are requirements that cannot be, and those that ``max_trials`` cannot show to be met even
    if no trial fails.
    """
    required, faults = read_requirements(rule.requirements)
    lines = [f"require.all = {shown(text)}: {problem}" for text, problem in faults]
    kept = {TRIAL, rule.along, *rule.among, *rule.at_all}
    pooled = math.prod(len(axis) for axis in pipeline.axes if axis.name not in kept)
    for each in required:
        least = math.ceil(least_draws(each, shares.met) / pooled)
        if least > rule.max_trials:
            lines.append(
                f"{SEARCH}.max_trials = {rule.max_trials}: expected at least {least:,}: fewer "
                f"cannot show {each.text} with {100 * CONFIDENCE:g} % confidence, even if all "
                "meet it")
    return lines


def least_draws(requirement: Requirement, share: float) -> int:
    """Return the draws below which a requirement cannot be decided as met.

    Of a rate, with no failure Clopper and Pearson's end is the tail's n-th root; a quantile needs
    an order statistic beyond; means are not decided below `MIN_DRAWS`.

    Examples
    --------
    >>> from sweep.analysis.requirements import parse_requirement
    >>> least_draws(parse_requirement("detection >= 0.99"), 1.0)
    368
    """
    what = requirement.requirable
    tail = (1.0 - what.level) * share / 2.0
    if what.is_rate:
        good = requirement.limit if requirement.at_least else 1.0 - requirement.limit
        return math.ceil(math.log(tail) / math.log(good)) if 0.0 < good < 1.0 else 1
    if what.percent is not None:
        share_below = what.percent / 100.0
        return math.ceil(math.log(tail) / math.log(
            1.0 - share_below if requirement.at_least else share_below))
    return MIN_DRAWS


# --------------------------------------------------------------------------------------------------
# The walk from the safe end of an axis to the wanted one: what is answered, what is needed still.
#
# The values of the axis stand in the order of the walk: for the smallest size that will do, from
# the largest down. Each value's conditions are decided one by one. The answer is the last value
# of the walk that meets the requirements, as all values before it do that can be judged: so a
# value beyond one that fails, on the other side of a dip, is no answer. Values at which nothing
# can be judged, such as sizes that do not fit into the image, are left out.
#
# That makes the error of the answer that of a single decision: it is wrong only if, at the first
# value of the walk that truly fails, the condition at which it fails is decided as met. Neither
# the number of values nor that of conditions counts (Berger, "Multiparameter hypothesis testing
# and acceptance sampling", Technometrics 24, 1982: an intersection-union test; Marcus, Peritz and
# Gabriel, Biometrika 63, 1976: tests in a fixed order); the numbers of waves, after each of which
# a decision is made, and of alternatives do (Bonferroni).

Decisions = NDArray[np.uint8]

CONFIDENCE = 0.95
"""Probability with which an answer meets the requirements."""


def error_shares(
    confidence: float, *, waves: int, alternatives: int, values: int, conditions: int,
    requirements: int,
) -> ErrorShares:
    """Return the shares of the error probability that each decision of a search may spend.

    Parameters
    ----------
    confidence
        Probability with which no answer fails, and, again, with which no value that is told to
        fail meets all.
    waves
        How often a decision is made at most: once after each wave.
    alternatives, values, conditions, requirements
        How many there are. "Met" is corrected for waves and alternatives, "not met" for all.

    Examples
    --------
    >>> error_shares(0.9, waves=10, alternatives=2, values=5, conditions=2, requirements=1)
    ErrorShares(met=0.1, not_met=0.01)
    """
    met = (1.0 - confidence) / ERROR_PROBABILITY / waves / alternatives
    not_met = met / (values * conditions * requirements)
    return ErrorShares(float(f"{met:.12g}"), float(f"{not_met:.12g}"))


def needed(decision: Decisions, keeps: Masks) -> Masks:
    """Return which cells need more trials, (..., values, conditions).

    Those are the undecided conditions of the values up to the first that fails, or seems to: of
    that one, only the conditions at which it seems to fail. What lies beyond it waits until it is
    decided, and is never needed if it does fail.

    Parameters
    ----------
    decision
        (..., values, conditions) of `sweep.analysis.requirements.Decision`, in the order of the
        walk.
    keeps
        Of the same shape: where the estimates keep all limits.
    """
    undecided = decision == Decision.undecided
    seems = undecided & ~keeps
    value = combined_decision(decision, -1)
    stops = (value == Decision.not_met) | seems.any(axis=-1)
    before = np.cumsum(stops, axis=-1) == 0
    first = stops & (np.cumsum(stops, axis=-1) == 1) & (value == Decision.undecided)
    return np.asarray((undecided & before[..., None]) | (seems & first[..., None]))


@dataclass(frozen=True, slots=True)
class Walk:
    """How far a walk came; indices along the walk.

    Attributes
    ----------
    answer
        The last value before which, and at which, all is met; -1 for none.
    next
        The first value that is not met or undecided; the number of values if there is none.
    isolated
        Values from ``next`` on that fail, or seem to, and beyond which another seems to meet all:
        failures that a search by halving would have stepped over.
    passing
        The values beyond that seem to meet all, or do.
    """

    answer: int
    next: int
    isolated: tuple[int, ...]
    passing: tuple[int, ...]


def walk(decision: Decisions, keeps: Masks) -> Walk:
    """Return how far a walk comes, of one alternative.

    Parameters
    ----------
    decision, keeps
        (values, conditions), as in `needed`.

    Examples
    --------
    >>> met, failed = Decision.met, Decision.not_met
    >>> decision = np.array([[met], [met], [failed], [met], [failed]], np.uint8)
    >>> walk(decision, decision == met)
    Walk(answer=1, next=2, isolated=(2,), passing=(3,))
    """
    value = combined_decision(decision, -1)
    judged = value != Decision.not_applicable
    stops = np.flatnonzero(judged & (value != Decision.met))
    after = int(stops[0]) if stops.size else len(value)
    met = np.flatnonzero(value[:after] == Decision.met)
    applicable = decision != Decision.not_applicable
    seems = (keeps | ~applicable).all(axis=-1) & judged & (value != Decision.not_met)
    passing = [k for k in range(after + 1, len(value)) if seems[k]]
    isolated = [k for k in range(after, passing[-1])
                if judged[k] and (not seems[k] or k == after)] if passing else []
    return Walk(int(met[-1]) if met.size else -1, after, tuple(isolated), tuple(passing))


# --------------------------------------------------------------------------------------------------
# The choice that meets requirements at all conditions: of a size, and among other settings.
#
# What a choice is stands in `sweep.experiment.stopping`, when one is answered in
# `sweep.analysis.choices`. Every alternative, a combination of the values of the axes ``among``,
# has its own answer.

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
    is_open
        Whether it is undecided what the answer is: the next value may meet them, too.
    possible
        The last value that may do so: none before it is decided to fail.
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
    is_open: bool = False
    possible: float | None = None


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
    hopeless
        (alternatives, values, conditions): undecided, and no number of trials will tell.
    """

    table: xr.Dataset
    decision: Decisions
    keeps: Masks
    each: Decisions
    excess: Floats
    hopeless: Masks
    among: tuple[str, ...]
    per: tuple[str, ...]

    def needed(self) -> xr.DataArray:
        """Return which cells need more trials, dimensions (*among, along, *per)."""
        template = self.table["decision"].isel(requirement=0, drop=True)
        decision = np.where(self.hopeless, np.uint8(Decision.not_met), self.decision)
        return template.copy(data=needed(decision, self.keeps).reshape(template.shape))


def choice_shares(pipeline: Pipeline, rule: StoppingRule) -> ErrorShares:
    """Return the shares of the error probability that each decision of a search may spend."""
    def size(names: Sequence[str]) -> int:
        axes = [axis for name in names if (axis := pipeline.axis(name)) is not None]
        return math.prod(map(len, axes))

    return error_shares(
        CONFIDENCE, waves=len(rule.ends), alternatives=size(rule.among),
        values=size([rule.along] if rule.along else []), conditions=size(rule.at_all),
        requirements=len(rule.requirements))


def choice_cells(results: xr.Dataset, rule: StoppingRule, shares: ErrorShares) -> ChoiceCells:
    """Return the decisions of a dataset, of a whole store or of some of its alternatives.

    Raises
    ------
    ArgumentError, DatasetError
        As `sweep.analysis.check_requirements`.
    """
    required = parse_requirements(rule.requirements)
    kept = [*rule.among, *([rule.along] if rule.along else []), *rule.at_all]
    table = decide(results, required, kept, shares=shares)
    table = table.transpose(*kept, "requirement", missing_dims="ignore")
    if rule.along:
        values = table[rule.along].to_numpy()
        order = np.argsort(values, kind="stable")
        table = table.isel({rule.along: order if rule.largest else order[::-1]})
    conditions = math.prod(table.sizes[name] for name in rule.at_all)
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
    each = cells("decision").astype(np.uint8)
    hopeless = (poses >= MIN_DRAWS) & (coming < MIN_DRAWS) & (each == Decision.undecided)
    decision = combined_decision(each, -1)
    table = table.assign(excess=excess_of(table), keeps=kept_by(table, required))
    excess = np.where(each == Decision.not_applicable, -np.inf, cells("excess"))
    keeps = cells("keeps") | (each == Decision.not_applicable)
    return ChoiceCells(
        table, decision, np.asarray(keeps.all(-1)), each, excess,
        hopeless.any(-1) & (decision == Decision.undecided), rule.among, rule.at_all)


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
    value = combined_decision(cells.decision[k], -1)
    failing = np.flatnonzero(value == Decision.not_met)
    before = value[: failing[0] if failing.size else len(value)]
    possible = np.flatnonzero(before != Decision.not_applicable)
    is_open = bool((before == Decision.undecided).any())
    return Answer(
        alternative, came.answer >= 0, values[came.answer] if came.answer >= 0 else None, tightest,
        after, cause,
        tuple((_number(values[at]), _cause(cells, k, at)) for at in came.isolated),
        tuple(_number(values[at]) for at in came.passing), nearest, is_open,
        values[possible[-1]] if possible.size else None)


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
