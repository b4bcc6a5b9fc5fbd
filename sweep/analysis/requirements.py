"""Requirements of results, and whether they are met: a decision for each condition.

A requirement is met if the interval's end lies on its right side: "detection >= 0.99" if the lower
end is at least 0.99. The probability of a false "met" is below `ERROR_PROBABILITY`; that of rates
and quantiles is at most half of it, whatever the distribution.

Each combination of the dimensions that ``per`` names is a condition, at which the requirement must
hold; scene axes that it does not name are pooled; configurations are never pooled.

That a requirement is met at all of several conditions needs no correction for their number (Berger,
"Multiparameter hypothesis testing and acceptance sampling", Technometrics 24, 1982: an
intersection-union test), that it is not met at any of them does: it is decided by the interval's
other end at the error probability over the number of conditions and requirements (Bonferroni).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from sweep.analysis.aggregate import aggregate
from sweep.analysis.binning import Bins
from sweep.analysis.counts import Count
from sweep.analysis.described import describes
from sweep.analysis.dimensions import DRAWS, as_names, configuration_axes, kept_dimensions
from sweep.analysis.draws_needed import draws_needed
from sweep.analysis.pose_view import Poses
from sweep.analysis.replicates import is_replicated
from sweep.analysis.requirable import MIN_DRAWS, Requirable, requirable_arrays, requirables
from sweep.analysis.requirement_faults import Side, contradictions, fault_of, named
from sweep.errors import ArgumentError, DatasetError
from sweep.measure.flags import Flag, flag
from sweep.messages import plain
from sweep.plan.requirement_text import read_requirement
from sweep.plan.variable import cf_attributes

ERROR_PROBABILITY = 0.05
"""Probability below which a decision is wrong: a false "met", or any false "not met"."""


class Decision(Flag):
    """Whether a requirement is met."""

    not_run = flag(0, "Nothing was computed.", counted=False)
    met = flag(1, "The interval lies on the right side of the limit.", present=True)
    not_met = flag(2, "The interval lies on the wrong side of the limit.", present=True)
    undecided = flag(3, "The limit lies in the interval: too few draws to tell.", present=True)
    not_applicable = flag(
        4, "There is nothing to judge: no pose was looked for, or estimates have no such number.",
        counted=False)


@dataclass(frozen=True, slots=True)
class ErrorShares:
    """Shares of `ERROR_PROBABILITY` that single decisions may spend.

    Attributes
    ----------
    met
        Of a false "met"; less than 1 where several looks or choices could go wrong.
    not_met
        Of a false "not met".
    """

    met: float = 1.0
    not_met: float = 1.0


@dataclass(frozen=True)
class Requirement:
    """What is required of a quantity.

    Attributes
    ----------
    text
        As it is shown: "detection_rate >= 0.99".
    variable
        The quantity's name: a variable of `sweep.analysis.error_statistics`, of `efficiency` or of
        `covariance_trust`. Of a bias with a sign the absolute value is required.
    relation
        One of ``>=``, ``<=``, ``>``, ``<``.
    limit
        The number, in the quantity's units.
    """

    text: str
    variable: str
    relation: str
    limit: float

    @property
    def requirable(self) -> Requirable:
        """What is required."""
        return requirables()[self.variable]

    @property
    def at_least(self) -> bool:
        """Whether the value must be large."""
        return self.relation in (">=", ">")

    def holds(self, value: xr.DataArray) -> xr.DataArray:
        """Return where values fulfil it; NaN does not."""
        compare = {">=": value >= self.limit, "<=": value <= self.limit,
                   ">": value > self.limit, "<": value < self.limit}
        return compare[self.relation]


def parse_requirements(texts: str | Iterable[str]) -> tuple[Requirement, ...]:
    """Return the requirements of some texts.

    Parameters
    ----------
    texts
        Each a name, a relation and a number: "range_error_p95_percent <= 1". Names are those of
        the variables of `sweep.analysis.error_statistics`, of all kinds of error, and of
        `efficiency` and `covariance_trust`, as far as they have an interval; ``_rate`` and
        ``_mean`` at the end and ``_error`` within may be left out or put in: ``detection``,
        ``nees``, ``range_error_p95_percent``.

    Raises
    ------
    ArgumentError
        One line for each fault: a name that does not exist, another unit, a limit that nothing can
        fail, meet or show, requirements that contradict each other.

    Examples
    --------
    >>> [each.text for each in parse_requirements(["detection>=0.99", "yaw_bias_deg < 0.1"])]
    ['detection_rate >= 0.99', 'yaw_bias_deg < 0.1']
    """
    given = [texts] if isinstance(texts, str) else list(texts)
    requirements, faults = read_requirements(given)
    if not given:
        faults.append(("[]", "expected at least one, such as 'detection >= 0.95'"))
    if faults:
        first, *others = faults
        raise ArgumentError("requirements", first[0], "\n".join(
            [first[1], *(f"{text}: {problem}" for text, problem in others)]))
    return tuple(requirements)


def parse_requirement(text: str) -> Requirement:
    """Return the requirement of a text; ArgumentError as `parse_requirements`."""
    return parse_requirements([text])[0]


def read_requirements(
    texts: Iterable[str]
) -> tuple[list[Requirement], list[tuple[str, str]]]:
    """Return the requirements of some texts, and their faults: texts and what is wrong."""
    requirements, faults = [], []
    for text in texts:
        try:
            requirement = _parsed(text)
        except ValueError as error:
            faults.append((plain(text), str(error)))
        else:
            requirements.append(requirement)
    faults += contradictions([
        Side(each.text, each.variable, each.at_least, each.limit) for each in requirements])
    return requirements, faults


def _parsed(text: str) -> Requirement:
    """Return a requirement; ValueError says what is wrong."""
    parts = read_requirement(text)
    what = named(parts.name)
    if problem := fault_of(what, parts):
        raise ValueError(problem)
    return Requirement(
        f"{what.name} {parts.relation} {parts.limit:.12g}", what.name, parts.relation, parts.limit)


@describes
def check_requirements(
    results: xr.Dataset, requirements: Iterable[Requirement | str], per: Sequence[str] = (),
    bins: Bins | None = None,
) -> xr.Dataset:
    """Return whether requirements are met, by configuration and condition.

    Parameters
    ----------
    results
        The dataset of a run with random draws.
    requirements
        Of `parse_requirements`, or their texts.
    per
        Dimensions whose values are conditions, at each of which the requirements must hold. Other
        axes of the scene are pooled. Axes of detector and estimator (configurations) are always
        kept, whether they are named or not.
    bins
        As in `sweep.analysis.detection_rate`; each bin is a condition.

    Returns
    -------
    xr.Dataset
        Dimensions (*configuration, *per, *bins, requirement), computed.

        - ``value``; of a bias with a sign the absolute value. ``low`` and ``high``: the ends by
          which it is decided, of a 95 % interval (99 % for means) on the side of "met", on the
          other side of one for all conditions and requirements together.
        - ``decision`` (`Decision`); ``decision.attrs`` has its flags.
        - ``draws``: the random draws that the value is worth; ``draws_needed``: about how many
          would decide it, if the value stays; NaN unless it is undecided, infinite if no number
          would do.
        - ``limit``, ``relation``, ``variable``, ``units`` (requirement).

    Raises
    ------
    ArgumentError
        For texts that are no requirements, and a dimension that does not exist.
    DatasetError
        If the dataset lacks a variable, has no poses, or nothing was drawn in it: then no interval
        exists.

    Notes
    -----
    Rates have Clopper and Pearson's interval and quantiles order statistics: both hold whatever
    the distribution. Means (bias, standard deviation, root mean square, efficiency, nees) have the
    intervals of `sweep.analysis.error_statistics` with 99 %, and are undecided below 50 draws. By
    simulation at the limit a false "met" has a probability below 0.025 for rates and quantiles,
    below 0.05 for means (`pytest -m long tests/analysis/test_requirements_at_the_limit.py`).

    A missed marker is an infinite error in every quantile. Where poses were looked for and none
    was solved, what is required of solved poses is undecided.

    Examples
    --------
    >>> table = check_requirements(results, ["detection >= 0.6"], per=["side_px"])
    >>> [Decision(each).name for each in table["decision"].isel(solver=0, requirement=0).values]
    ['not_met', 'undecided', 'met']
    """
    required = _requirements(requirements)
    out = decide(results, required, per, bins)
    table = out.drop_vars(["looked_for", "solved"])
    share = (out["solved"] / out["looked_for"]).where(out["looked_for"] > 0)
    needed = [
        draws_needed(each, one["value"], one["low"], one["high"], one["draws"], share,
                     one["decision"] == Decision.undecided)
        for number, each in enumerate(required) for one in [table.isel(requirement=number)]]
    return table.assign(draws_needed=xr.concat(
        needed, "requirement", coords="minimal", compat="override").transpose(
        *table["value"].dims).assign_attrs(
        long_name="draws that would decide it, if the value stays", units="1"))


def decide(
    results: xr.Dataset, required: Sequence[Requirement], per: Sequence[str] = (),
    bins: Bins | None = None, shares: ErrorShares | None = None,
) -> xr.Dataset:
    """Return decisions as `check_requirements`, without ``draws_needed``, at other levels.

    Parameters
    ----------
    results, required, per, bins
        As there.
    shares
        Shares of the error probability that a decision may spend, of all looks of a search: where
        sampling was stopped, intervals are not widened for that again.

    Returns
    -------
    xr.Dataset
        As there, with ``looked_for`` and ``solved``: poses of the condition (without
        ``requirement``).
    """
    dims = (*configuration_axes(results), *as_names(per))
    kept = kept_dimensions(results, tuple(dict.fromkeys(dims)))
    require_draws(results, kept)
    count = math.prod(results.sizes[name] for name in kept if name not in
                      configuration_axes(results))
    count *= math.prod(len(edges) - 1 for edges in (bins or {}).values()) * len(required)
    spent = shares or ErrorShares(not_met=1.0 / count)
    inputs = requirable_arrays(results, [each.requirable for each in required])
    statistics = [
        Count("looked_for", "", lambda poses: poses.looked_for),
        Count("solved", "", lambda poses: poses.solved),
        *(statistic for number, each in enumerate(required) for prefix, share in (
            (f"{number} one ", spent.met), (f"{number} all ", spent.not_met))
          for statistic in each.requirable.computed(
              prefix, 1.0 - (1.0 - each.requirable.level) * share)),
    ]
    stopped = None if shares is None else False
    table = aggregate(results, inputs, kept, statistics, Poses, bins, stopped=stopped).compute()
    if shares is None:
        _require_numbers(table, required)
    replicated = is_replicated(results)
    judged = [_judged(table, number, each, replicated) for number, each in enumerate(required)]
    index = xr.DataArray([each.text for each in required], dims="requirement", attrs={
        "long_name": "what is required"})
    out = xr.concat(
        judged, "requirement", coords="minimal", compat="override").assign_coords(
        requirement=index,
        variable=("requirement", [each.variable for each in required]),
        relation=("requirement", [each.relation for each in required]),
        limit=("requirement", [each.limit for each in required]),
        units=("requirement", [each.requirable.units for each in required]))
    out = out.transpose(..., "requirement")
    out.attrs["configuration_dims"] = [
        name for name in configuration_axes(results) if name in out.dims]
    return out.assign(looked_for=table["looked_for"], solved=table["solved"])


def _requirements(given: Iterable[Requirement | str]) -> tuple[Requirement, ...]:
    """Return requirements, those given as texts parsed, all checked together."""
    listed = [given] if isinstance(given, str | Requirement) else list(given)
    return parse_requirements([
        each.text if isinstance(each, Requirement) else each for each in listed])


def require_draws(results: xr.Dataset, kept: Sequence[str]) -> None:
    """Raise unless there are draws to make intervals of."""
    if DRAWS in kept:
        raise ArgumentError("per", DRAWS, "intervals are over the draws; they cannot be kept")
    if results.sizes.get(DRAWS, 1) < 2:
        raise DatasetError(
            "trial: this store has a single draw of each pose, so that nothing tells how far its "
            "numbers are chance; give the pipeline something drawn (jitter_px = 0.5, noise_grey) "
            "and trial = 100 under [axes], and run it again")


def _require_numbers(table: xr.Dataset, required: Sequence[Requirement]) -> None:
    """Raise if poses were solved and what is required has no number at all."""
    lacking = [each.variable for number, each in enumerate(required)
               if not table[f"{number} one used"].any() and table["solved"].any()]
    if lacking:
        raise DatasetError("\n".join(
            f"{name}: no pose of this store has such a number; require something else, or give the "
            "pipeline what computes it" for name in lacking))


def _judged(
    table: xr.Dataset, number: int, requirement: Requirement, replicated: bool
) -> xr.Dataset:
    """Return value, ends and decision of one requirement."""
    what = requirement.requirable
    value, low, high = what.interval(table, f"{number} one ")
    _, joint_low, joint_high = what.interval(table, f"{number} all ")
    low, high = (low, joint_high) if requirement.at_least else (joint_low, high)
    draws, drawn = table[f"{number} one draws"], table[f"{number} one drawn"]
    enough = drawn if what.exact or replicated else drawn & (draws >= MIN_DRAWS)
    met = requirement.holds(low if requirement.at_least else high) & enough
    possible = requirement.holds(high if requirement.at_least else low)
    known = (high if requirement.at_least else low).notnull()
    not_met = ~possible & known & enough
    no_number = (table[f"{number} one used"] == 0) & (
        (table["looked_for"] == 0) | (table["solved"] > 0))
    decision = (xr.full_like(value, Decision.undecided).where(~not_met, Decision.not_met)
                .where(~met, Decision.met).where(~no_number, Decision.not_applicable))
    words = {
        "value": (value, "value"),
        "low": (low, "lower end of the interval by which it is decided"),
        "high": (high, "upper end of the interval by which it is decided"),
        "draws": (draws, "random draws that the value is worth"),
    }
    out = {name: array.assign_attrs(long_name=meaning, units="1" if "draws" in name else "")
           for name, (array, meaning) in words.items()}
    out["decision"] = decision.astype(np.uint8).assign_attrs(
        cf_attributes("whether the requirement is met", flags=Decision))
    return xr.Dataset(out)
