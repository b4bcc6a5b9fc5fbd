"""Requirements: what may be required, and whether it is met, not met, or not decided."""

from __future__ import annotations

import bisect
import dataclasses
import functools
import itertools
import math
import operator
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import special

from sweep.analysis.dataset import (
    DRAWS,
    SIZE_AXES,
    as_names,
    axes_of,
    configuration_axes,
    describes,
    each_cell,
    is_replicated,
    kept_dimensions,
    largest_cell,
    stacked,
)
from sweep.analysis.estimator import (
    PERCENTS,
    Bins,
    Count,
    Mean,
    Quantiles,
    Rate,
    RootMeanSquare,
    Statistic,
    aggregate,
    draws_to_see,
    guarded,
)
from sweep.analysis.intervals import clopper_pearson
from sweep.analysis.poses import (
    ESTIMATE_INPUTS,
    QUANTITIES,
    SIGNED,
    Poses,
    Quantity,
    pose_arrays,
)
from sweep.analysis.summaries import NEES_MEAN, RATIOS, quantiles_of, registered
from sweep.errors import ArgumentError, DatasetError, PipelineError
from sweep.experiment.parameters import Stage
from sweep.experiment.sampling import RequirementText, read_requirement
from sweep.experiment.schema import cf_attributes
from sweep.measure.flags import Flag, flag
from sweep.messages import MAX_LINE_LENGTH, label, nearest, plain, shown

# --------------------------------------------------------------------------------------------------
# Quantities that can be required: every output of a statistic that has an interval.
#
# The names are those of `sweep.analysis.error_statistics` (all kinds of error), `efficiency` and
# `covariance_trust`, and quantiles of the absolute errors along axes and about angles; they come
# from the records there, so that a new statistic can be required, too.

#: Level of the intervals of rates and quantiles, whose ends hold whatever the distribution.
EXACT_LEVEL = 0.95

#: Level of the intervals of means, root mean squares and standard deviations.
#:
#: Their formulas are approximations: with 50 draws an end of 97.5 % is passed in 4.6 % (normal
#: errors) to 8.3 % (Laplace) of the samples, one of 99.5 % in 1.4 to 3.4 %.
MEAN_LEVEL = 0.99

#: Draws from which on means are decided; where draws are Sobol' points, any number.
MIN_DRAWS = 50


@dataclass(frozen=True)
class Requirable:
    """An output that can be required.

    Attributes
    ----------
    name, units
        Of the output.
    statistic
        What computes it.
    inputs
        Names of the arrays that it reads, as in `sweep.analysis.poses.pose_arrays`.
    largest
        The largest value that exists.
    percent
        The percent of a quantile, else None.
    """

    name: str
    units: str
    statistic: Any
    inputs: tuple[str, ...]
    largest: float = math.inf
    percent: int | None = None

    @property
    def is_rate(self) -> bool:
        """Whether it is a share of poses."""
        return isinstance(self.statistic, Rate)

    @property
    def exact(self) -> bool:
        """Whether the interval holds whatever the distribution."""
        return isinstance(self.statistic, Rate | Quantiles)

    @property
    def signed(self) -> bool:
        """Whether the value has a sign: its absolute value is required."""
        return type(self.statistic) is Mean

    @property
    def variables(self) -> list[str]:
        """The dataset's variables that it is computed of."""
        return [*self.inputs]

    def level(self, share: float = 1.0) -> float:
        """Return the level of the interval by which it is decided with a share of the error."""
        return 1.0 - (1.0 - (EXACT_LEVEL if self.exact else MEAN_LEVEL)) * share

    def computed(self, prefix: str, level: float) -> list[Statistic[Poses]]:
        """Return the statistics for it, its poses and draws; variables' names begin with a prefix.

        Rates have Clopper and Pearson's interval.
        """
        changes: dict[str, Any] = {"exact": True} if self.is_rate else {}
        return [
            dataclasses.replace(
                self.statistic, name=f"{prefix}{self.statistic.name}", level=level, **changes),
            Count(f"{prefix}used", "poses that count", self.statistic.used, f"{prefix}draws",
                  f"{prefix}drawn")]

    def interval(
        self, table: xr.Dataset, prefix: str
    ) -> tuple[xr.DataArray, xr.DataArray, xr.DataArray]:
        """Return value, low and high from the table of `computed`."""
        value, low, high = (table[f"{prefix}{self.name}{end}"] for end in ("", "_low", "_high"))
        if not self.signed:
            return value, low, high
        nearest, farthest = (xr.apply_ufunc(end, abs(low), abs(high))
                             for end in (np.minimum, np.maximum))
        return abs(value), nearest.where(low * high > 0.0, 0.0).where(low.notnull()), farthest


def requirable_arrays(
    results: xr.Dataset, required: Iterable[Requirable]
) -> dict[str, xr.DataArray]:
    """Return the arrays that the statistics of some requirables read, by name.

    Raises
    ------
    DatasetError
        If the dataset lacks a variable, one line for each requirable.
    """
    required = list(required)
    lacking = {each.name: missing for each in required
               if (missing := [name for name in each.variables if name not in results])}
    if lacking:
        raise DatasetError("\n".join(
            f"{name}: cannot be computed, for this store lacks {', '.join(missing)}"
            for name, missing in lacking.items()))
    return pose_arrays(
        results, [*ESTIMATE_INPUTS, *(name for each in required for name in each.inputs)])


@functools.cache
def requirables() -> dict[str, Requirable]:
    """Return everything that can be required, by name.

    Examples
    --------
    >>> requirables()["rotation_p95_deg"].units, requirables()["detection_rate"].largest
    ('degree', 1.0)
    """
    signed = [each for group in SIGNED.values() for each in group]
    quantities = [*QUANTITIES, *signed]
    records = [*registered(quantities), *map(quantiles_of, signed), NEES_MEAN, *RATIOS]
    return {each.name: each for record in records for each in _of_record(record, quantities)}


def _of_record(
    statistic: Statistic[Poses], quantities: Sequence[Quantity]
) -> list[Requirable]:
    """Return the outputs of a statistic that have an interval."""
    outputs = {output.name: output for output in statistic.outputs()}
    found = []
    for name, output in outputs.items():
        if f"{name}_low" not in outputs:
            continue
        largest = next((each.bound for each in quantities if each.bound is not None and (
            name.startswith(f"{each.name}_") and name.endswith(f"_{each.unit}"))), math.inf)
        percent = next((PERCENTS[part] for part in name.split("_") if part in PERCENTS), None)
        found.append(Requirable(
            name, output.units, statistic, statistic.inputs,
            1.0 if isinstance(statistic, Rate) else largest, percent))
    return found


# --------------------------------------------------------------------------------------------------
# Faults of requirements: names, units, limits, contradictions, a line each.

#: Units that names end with.
UNITS = {"deg": "degrees", "rad": "radians", "m": "metres", "mm": "millimetres", "percent": "%",
         "px": "pixels", "cm": "centimetres"}

#: Middle parts of the names of statistics of errors.
STATISTICS = (*PERCENTS, "bias", "sd", "rmse")

#: Endings of names that may be left out.
ENDINGS = ("_rate", "_mean")


def named(name: str) -> Requirable:
    """Return the quantity that a name stands for.

    Raises
    ------
    ValueError
        If it is no such name.

    Examples
    --------
    >>> named("detection").name, named("range_error_p95_percent").name
    ('detection_rate', 'range_p95_percent')
    """
    known = requirables()
    short = re.sub("_errors?(?=_|$)", "", name.lower())
    for candidate in (short, *(f"{short}{ending}" for ending in ENDINGS)):
        if candidate in known:
            return known[candidate]
    head, _, tail = short.rpartition("_")
    stem = head if tail in UNITS else short
    ending = next((other.rpartition("_")[2] for other in known
                   if other.rpartition("_")[0] == stem), "")
    kinds = [other for other in known if other.startswith(f"{stem}_") and any(
        f"_{each}_" in other for each in STATISTICS)]
    if ending in UNITS:
        problem = f"its unit is {UNITS[ending]}: write {stem}_{ending}"
    elif f"{stem}_rate" in known:
        problem = f"is a share from 0 to 1: write {stem}_rate"
    elif kinds:
        problem = f"which statistic of it? There are {', '.join(kinds)}"
    elif short in {"looked_for", "detected", "count", "draws"}:
        problem = "is a count, which has no interval; expected a rate or an error"
    else:
        hint = nearest(short, [*known]) or (
            f"; there are {', '.join(EXAMPLES)} and the other variables of error_statistics, in "
            "the guide sweep/analysis/README.md")
        problem = f"nothing of this name has an interval{hint}"
    raise ValueError(problem)


EXAMPLES = ("detection_rate", "solved_rate", "flip_rate", "rotation_p95_deg", "range_p95_percent",
            "position_rmse_m", "yaw_bias_deg", "x_sd_m")


def fault_of(what: Requirable, given: RequirementText) -> str:
    """Return the fault of a limit and its unit; empty without one."""
    limit, more = given.limit, given.relation in (">=", ">")
    share = f": write {limit / 100:g} for {limit:g} %" if 2.0 <= limit <= 100.0 else ""
    sign = " (of a bias the absolute value is required)" if what.signed else ""
    example = ", such as 0.01" if what.is_rate else ""
    faults = (
        (given.unit, _wrong_unit(what, given)),
        (what.is_rate and not 0.0 <= limit <= 1.0, f"a share is from 0 to 1{share}"),
        (limit < 0.0, f"{what.name} is never negative{sign}: expected a limit above 0"),
        (limit > what.largest, f"{what.name} is never above {what.largest:g} {what.units}"),
        (more and limit == 0.0, "holds always: expected a limit above 0"),
        (not more and limit == what.largest,
         f"holds always: expected a limit below {what.largest:g}"),
        (more and what.is_rate and limit == 1.0,
         "no number of draws can show a rate of 1: write 0.99, for instance"),
        (not more and limit == 0.0,
         f"no number of draws can show 0: expected a limit above it{example}"),
    )
    return next((text for is_so, text in faults if is_so), "")


def _wrong_unit(what: Requirable, given: RequirementText) -> str:
    if decimal := re.fullmatch(r",(\d+)", given.unit):
        return f"a comma in a number: write {given.limit:g}.{decimal[1]}"
    unit = "percent" if given.unit == "%" else given.unit
    if what.is_rate and unit == "percent":
        return f"the limit is a share from 0 to 1: write {given.limit / 100:g}"
    ending = what.name.rpartition("_")[2]
    words = f"in {UNITS[ending]}" if ending in UNITS else "without a unit"
    more = "; each requirement is a text of its own" if re.search(r"[<>≤≥]", unit) else ""
    return f"{plain(given.unit)} after the limit: expected the number alone, {words}{more}"


def contradictions(given: Sequence[Requirement]) -> list[tuple[str, str]]:
    """Return the requirements on one quantity that cannot hold together, each a text and a line."""
    faults = []
    for one, other in itertools.combinations(given, 2):
        if one.variable != other.variable:
            continue
        least, most = (one, other) if one.at_least else (other, one)
        if one.at_least == other.at_least:
            faults.append((other.text, f"{other.variable} has another such limit; delete one"))
        elif least.limit >= most.limit:
            faults.append((least.text, f"contradicts {most.text}: no result can be both"))
    return faults


# --------------------------------------------------------------------------------------------------
# Requirements of results, and whether they are met: a decision for each condition.
#
# A requirement is met if the interval's end lies on its right side: "detection >= 0.99" if the
# lower end is at least 0.99. The probability of a false "met" is below `ERROR_PROBABILITY`; that
# of rates and quantiles is at most half of it, whatever the distribution.
#
# Each combination of the dimensions that ``per`` names is a condition, at which the requirement
# must hold; scene axes that it does not name are pooled; configurations are never pooled.
#
# That a requirement is met at all of several conditions needs no correction for their number
# (Berger, "Multiparameter hypothesis testing and acceptance sampling", Technometrics 24, 1982: an
# intersection-union test), that it is not met at any of them does: it is decided by the
# interval's other end at the error probability over the number of conditions and requirements
# (Bonferroni).

#: Probability below which a decision is wrong: a false "met", or any false "not met".
ERROR_PROBABILITY = 0.05


class Decision(Flag):
    """Whether a requirement is met."""

    not_run = flag(0, "Nothing was computed.", counted=False)
    met = flag(1, "The interval lies on the right side of the limit.", present=True)
    not_met = flag(2, "The interval lies on the wrong side of the limit.", present=True)
    undecided = flag(3, "The limit lies in the interval: too few draws to tell.", present=True)
    not_applicable = flag(
        4, "There is nothing to judge: no pose was looked for, or estimates have no such number.",
        counted=False)


def combined_decision(
    decision: NDArray[np.uint8], axis: int | tuple[int, ...]
) -> NDArray[np.uint8]:
    """Return the decision of all requirements and conditions over some axes together.

    Not met if any is not, met if all are that can be judged: not applicable ones are left out.
    Not applicable if none can be judged.
    """
    applicable = decision != Decision.not_applicable
    return np.select(
        [(decision == Decision.not_met).any(axis), ~applicable.any(axis),
         ((decision == Decision.met) | ~applicable).all(axis)],
        [Decision.not_met, Decision.not_applicable, Decision.met],
        Decision.undecided).astype(np.uint8)


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
    """A requirement on a quantity.

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
        """The requirement in words."""
        return requirables()[self.variable]

    @property
    def at_least(self) -> bool:
        """Whether the value must be large."""
        return self.relation in (">=", ">")

    def holds(self, value: xr.DataArray) -> xr.DataArray:
        """Return where values fulfil it; NaN does not."""
        fulfils: xr.DataArray = RELATIONS[self.relation](value, self.limit)
        return fulfils


RELATIONS = {">=": operator.ge, "<=": operator.le, ">": operator.gt, "<": operator.lt}


def parse_requirements(
    texts: str | Iterable[str | Requirement]
) -> tuple[Requirement, ...]:
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
    given = [texts] if isinstance(texts, str) else [
        each.text if isinstance(each, Requirement) else each for each in texts]
    requirements, faults = read_requirements(given)
    if not given:
        faults.append(("[]", "expected at least one, such as 'detection >= 0.95'"))
    if faults:
        first, *others = faults
        raise ArgumentError("requirements", first[0], "\n".join(
            [first[1], *(f"{text}: {problem}" for text, problem in others)]))
    return tuple(requirements)


def read_requirements(
    texts: Iterable[str]
) -> tuple[list[Requirement], list[tuple[str, str]]]:
    """Return the requirements of some texts, and pairs of a faulty text and its fault."""
    requirements, faults = [], []
    for text in texts:
        try:
            given = read_requirement(text)
            what = named(given.name)
            problem = fault_of(what, given)
        except ValueError as error:
            problem = str(error)
        if problem:
            faults.append((plain(text), problem))
        else:
            requirements.append(Requirement(
                f"{what.name} {given.relation} {given.limit:.12g}", what.name, given.relation,
                given.limit))
    return requirements, faults + contradictions(requirements)


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
    intervals of `sweep.analysis.error_statistics` with 99 %, and are undecided below 50 draws. The
    upper ends of those of squares (all but the bias) also hold rare errors that no draw showed, up
    to twice the largest that one did (`sweep.analysis.estimator.with_unseen_tail`): 100 draws
    of normal errors decide a root mean square that is below 0.6 of its limit, 400 one below 0.75.
    By simulation at the limit a false "met" has a probability below 0.025 for rates and quantiles,
    below 0.05 for means (`pytest -m evidence tests/analysis/test_requirements_at_the_limit.py`), of
    normal errors, of tails as of Student's t with 4 degrees of freedom and of lognormal errors, and
    of drawn tilts. Where few poses make most of the squares, quantiles (median, p95) are decided
    with fewer draws.

    A missed marker is an infinite error in every quantile. Where poses were looked for and none
    was solved, requirements on solved poses are undecided.

    Examples
    --------
    >>> table = check_requirements(results, ["detection >= 0.6"], per=["side_px"])
    >>> [Decision(each).name for each in table["decision"].isel(solver=0, requirement=0).values]
    ['not_met', 'undecided', 'met']
    """
    required = parse_requirements(requirements)
    table = decide(results, required, per, bins)
    solved = (table["solved"] / table["looked_for"]).where(table["looked_for"] > 0)
    needed = [draws_needed(each, table.isel(requirement=number), solved)
              for number, each in enumerate(required)]
    return table.drop_vars(["looked_for", "solved"]).assign(
        draws_needed=stacked(needed, "requirement").assign_attrs(
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
    configuration = configuration_axes(results)
    kept = kept_dimensions(results, tuple(dict.fromkeys((*configuration, *as_names(per)))))
    require_draws(results, kept)
    bin_counts = [len(edges) - 1 for edges in (bins or {}).values()]
    count = len(required) * math.prod(
        [*bin_counts, *(results.sizes[name] for name in kept if name not in configuration)])
    spent = shares or ErrorShares(not_met=1.0 / count)
    inputs = requirable_arrays(results, [each.requirable for each in required])
    statistics = [
        Count("looked_for", "", lambda poses: poses.looked_for),
        Count("solved", "", lambda poses: poses.solved),
        *(guarded(statistic) for number, each in enumerate(required) for prefix, share in (
            (f"{number} one ", spent.met), (f"{number} all ", spent.not_met))
          for statistic in each.requirable.computed(prefix, each.requirable.level(share))),
    ]
    stopped = None if shares is None else False
    table = aggregate(results, inputs, kept, statistics, Poses, bins, stopped=stopped)
    lacking = [each.variable for number, each in enumerate(required)
               if not table[f"{number} one used"].any() and table["solved"].any()]
    if lacking and shares is None:
        raise DatasetError("\n".join(
            f"{name}: no pose of this store has such a number; require something else, or give the "
            "pipeline what computes it" for name in lacking))
    judged = [_judged(table, number, each, is_replicated(results))
              for number, each in enumerate(required)]
    out = stacked(judged, "requirement").assign_coords(
        requirement=xr.DataArray([each.text for each in required], dims="requirement", attrs={
            "long_name": "what is required"}),
        variable=("requirement", [each.variable for each in required]),
        relation=("requirement", [each.relation for each in required]),
        limit=("requirement", [each.limit for each in required]),
        units=("requirement", [each.requirable.units for each in required]))
    out.attrs["configuration_dims"] = [name for name in configuration if name in out.dims]
    return out.assign(looked_for=table["looked_for"], solved=table["solved"])


def require_draws(results: xr.Dataset, kept: Sequence[str]) -> None:
    """Raise unless there are draws to make intervals of."""
    if DRAWS in kept:
        raise ArgumentError("per", DRAWS, "intervals are over the draws; they cannot be kept")
    if results.sizes.get(DRAWS, 1) < 2:
        raise DatasetError(
            "trial: this store has a single draw of each pose, so that nothing tells how far its "
            "numbers are chance; give the pipeline something drawn (jitter_px = 0.5, noise_grey) "
            "and trial = 100 under [axes], and run it again")


def _judged(
    table: xr.Dataset, number: int, requirement: Requirement, replicated: bool
) -> xr.Dataset:
    """Return value, ends and decision of one requirement."""
    what = requirement.requirable
    value, low, high = what.interval(table, f"{number} one ")
    _, joint_low, joint_high = what.interval(table, f"{number} all ")
    # The end that shows it is met is of one decision, the other of all together.
    low, high = (low, joint_high) if requirement.at_least else (joint_low, high)
    shows, refutes = (low, high) if requirement.at_least else (high, low)
    draws, drawn = table[f"{number} one draws"], table[f"{number} one drawn"]
    enough = drawn if what.exact or replicated else drawn & (draws >= MIN_DRAWS)
    met = requirement.holds(shows) & enough
    not_met = ~requirement.holds(refutes) & refutes.notnull() & enough
    no_number = (table[f"{number} one used"] == 0) & (
        (table["looked_for"] == 0) | (table["solved"] > 0))
    decision = value.copy(data=np.select(
        [no_number, met, not_met], [Decision.not_applicable, Decision.met, Decision.not_met],
        Decision.undecided).astype(np.uint8))
    return xr.Dataset({
        name: array.assign_attrs(long_name=meaning, units=units)
        for name, array, meaning, units in (
            ("value", value, "value", ""),
            ("low", low, "lower end of the interval by which it is decided", ""),
            ("high", high, "upper end of the interval by which it is decided", ""),
            ("draws", draws, "random draws that the value is worth", "1"))
    } | {"decision": decision.assign_attrs(
        cf_attributes("whether the requirement is met", flags=Decision))})


# --------------------------------------------------------------------------------------------------
# About how many draws decide a requirement, if the value stays what it is.

#: More draws than this are none that anyone waits for.
MAX_DRAWS = 1e9


def draws_needed(
    requirement: Requirement, table: xr.Dataset, solved: xr.DataArray | float, share: float = 1.0
) -> xr.DataArray:
    """Return about how many draws would decide a requirement, infinite if no number would.

    NaN where it is decided, and without a value. For a rate it is the least n at which Clopper and
    Pearson's end for n times the rate reaches the limit. Other intervals narrow with the root of
    the number of draws (those of spreads on the scale of logarithms, on which they are made); a
    quantile needs as many as its interval's ends need to exist and, if its end is infinite for too
    few poses are solved, as many as decide whether enough are.

    Parameters
    ----------
    requirement, table
        The requirement, and its decisions (`decide`).
    solved
        Share of the solved poses.
    share
        Share of the error probability that the decision may spend.
    """
    what, limit = requirement.requirable, requirement.limit
    level = what.level(share)

    def needed(value: float, low: float, high: float, draws: float, solved: float) -> float:
        if math.isnan(value):
            return math.nan
        if what.is_rate:
            return _of_rate(value, limit, level)
        good = value >= limit if requirement.at_least else value <= limit
        # The end that has to pass the limit.
        end, gap = low if good == requirement.at_least else high, abs(value - limit)
        least = float(MIN_DRAWS)
        if what.percent is not None:
            least = float(draws_to_see(1.0 - what.percent / 100.0, level))
            if math.inf in (end, value) and draws >= least:
                return max(least, _of_rate(solved, what.percent / 100.0, level))
        if not math.isfinite(end) or not math.isfinite(value):
            return max(least, 2.0 * draws)
        if gap == 0.0:
            return math.inf
        reach = (end - value) / gap
        # A spread without a largest value has an interval of the logarithm.
        if isinstance(what.statistic, RootMeanSquare) and math.isinf(what.largest) and (
                min(value, end) > 0.0):
            reach = math.log(end / value) / math.log(limit / value)
        if 2.0 <= draws < MIN_DRAWS and not what.exact:
            # Student's factor of so few draws is far above that of many.
            probability = (1.0 + level) / 2.0
            reach *= special.ndtri(probability) / special.stdtrit(draws - 1.0, probability)
        return _rounded(max(least, draws * reach ** 2))

    found: xr.DataArray = xr.apply_ufunc(
        np.vectorize(needed, otypes=[float]),
        table["value"].where(table["decision"] == Decision.undecided), table["low"], table["high"],
        table["draws"].astype(np.float64), solved)
    return found


def _of_rate(rate: float, limit: float, level: float) -> float:
    """Return the least power of about 1.1 at which the interval excludes the limit."""
    if rate == limit:
        return math.inf
    counts = np.unique(np.ceil(1.1 ** np.arange(1, 218)))

    def is_decided(n: float) -> bool:
        # Whole hits, rounded towards the limit.
        hits = math.floor(rate * n) if rate > limit else math.ceil(rate * n)
        low, high = clopper_pearson(hits, n, level)
        return bool(low > limit) if rate > limit else bool(high < limit)

    first = bisect.bisect_left(counts, True, key=is_decided)
    return _rounded(float(counts[first])) if first < len(counts) else math.inf


def _rounded(count: float) -> float:
    """Return a number of draws with two digits, rounded up; infinite if it is too large."""
    if count > MAX_DRAWS:
        return math.inf
    step = 10.0 ** max(0, math.floor(math.log10(max(count, 1.0))) - 1)
    return math.ceil(count / step) * step


# --------------------------------------------------------------------------------------------------
# The requirements in a pipeline's section [require], their names checked.

def check_required(
    texts: Iterable[str], source: str, others: PipelineError | None = None
) -> None:
    """Check the requirements of a pipeline, by what can be required (`requirables`).

    Parameters
    ----------
    texts
        The requirements, which have the form of such.
    source
        The name that lines begin with.
    others
        The faults that the pipeline has besides.

    Raises
    ------
    PipelineError
        One line for each fault.
    """
    known = () if others is None else others.faults
    faults = [*known, *(
        plain(line, MAX_LINE_LENGTH) for text, problem in read_requirements(texts)[1]
        if (line := f"{source}: require.all = {shown(text)}: {problem}") not in known)]
    if faults:
        raise PipelineError(faults)


# --------------------------------------------------------------------------------------------------
# One verdict for each requirement and configuration, from the decisions at all conditions.

WORST_FIRST = (Decision.not_met, Decision.undecided, Decision.met, Decision.not_applicable)


@dataclass(frozen=True)
class Cause:
    """A requirement at the condition by which it fails, or is nearest to it.

    Attributes
    ----------
    requirement, units
        Its text, and the units of its numbers.
    condition
        Values by axis.
    decision, value, low, high, draws
        As `check_requirements` has them.
    draws_needed
        About how many draws would decide it; NaN if it is decided, infinite if no number would do.
    """

    requirement: str
    units: str
    condition: Mapping[str, Any]
    decision: Decision
    value: float
    low: float
    high: float
    draws: int
    draws_needed: float

    @classmethod
    def at(cls, cell: xr.Dataset, conditions: Sequence[str], **more: Any) -> Self:
        """Return the cause of one cell of a table of `decide`."""
        return cls(
            str(cell["requirement"].item()), str(cell["units"].item()),
            {name: cell[name].item() for name in conditions}, Decision(int(cell["decision"])),
            float(cell["value"]), float(cell["low"]), float(cell["high"]), int(cell["draws"]),
            **more)


@dataclass(frozen=True)
class Verdict(Cause):
    """Whether a configuration meets a requirement at all conditions.

    Attributes
    ----------
    requirement, units, condition, value, low, high, draws
        At the condition that is farthest from being met.
    decision
        Not met if it is not met at any condition, met if it is at all that can be judged.
    draws_needed
        About how many draws would decide all of them; NaN if it is decided, infinite if no number
        would do.
    limit, configuration
        The limit, and values by axis of detector and estimator.
    counts
        Conditions by decision.
    """

    limit: float
    configuration: Mapping[str, Any]
    counts: Mapping[Decision, int]

    @property
    def conditions(self) -> int:
        """Conditions that can be judged."""
        return sum(count for decision, count in self.counts.items()
                   if decision is not Decision.not_applicable)


def worst_cell(table: xr.Dataset) -> xr.Dataset:
    """Return the cell of a table of `decide` that fails worst, or is nearest to it."""
    decision = table["decision"]
    worst = next(each for each in WORST_FIRST if (decision == each).any())
    return largest_cell(table, excess_of(table).where(decision == worst, -np.inf))


def verdicts(table: xr.Dataset) -> list[Verdict]:
    """Return the verdicts of a table of `sweep.analysis.check_requirements`."""
    configuration = [str(name) for name in table.attrs["configuration_dims"]]
    conditions = [str(dim) for dim in table["decision"].dims
                  if dim not in (*configuration, "requirement")]
    found = []
    for at, one in each_cell(
            table.transpose(*configuration, "requirement", *conditions),
            (*configuration, "requirement")):
        counts = {each: int((one["decision"] == each).sum()) for each in Decision}
        needed = one["draws_needed"].where(one["decision"] == Decision.undecided)
        cell = worst_cell(one)
        is_open = cell["decision"] == Decision.undecided
        found.append(Verdict.at(
            cell, conditions, limit=float(one["limit"]),
            draws_needed=float(needed.max()) if is_open else math.nan,
            configuration={name: at[name] for name in configuration},
            counts={each: count for each, count in counts.items() if count}))
    return found


def combined(found: Iterable[Verdict]) -> Decision:
    """Return the decision of all verdicts together; without anything to judge it is undecided."""
    decisions = {verdict.decision for verdict in found}
    if Decision.not_met in decisions:
        return Decision.not_met
    return Decision.undecided if decisions - {Decision.met} else Decision.met


def excess_of(table: xr.Dataset) -> xr.DataArray:
    """Return how far the values of a table are beyond the limits, relative to these.

    It is infinite for no number, finite and negative on the right side of the limit.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = table["value"] / table["limit"]
        at_least = table["relation"].isin([">=", ">"])
        excess = (1.0 - ratio).where(at_least, 1.0 - 1.0 / ratio)
    return excess.clip(min=-sys.float_info.max).fillna(np.inf)


def kept_by(table: xr.Dataset, required: Sequence[Requirement]) -> xr.DataArray:
    """Return where the values of a table (..., requirement) keep their limits."""
    keeps = [each.holds(table["value"].isel(requirement=k)) for k, each in enumerate(required)]
    return stacked(keeps, "requirement").transpose(*table["value"].dims)


def described(values: Mapping[str, Any], equals: str = "=") -> str:
    """Return values of axes as text.

    >>> described({"distance_m": 0.30000000000000004, "solver": "ippe"})
    'distance_m=0.3, solver=ippe'
    """
    return ", ".join(
        f"{name}{equals}{f'{value:.6g}' if isinstance(value, float) else label(value)}"
        for name, value in values.items())


# --------------------------------------------------------------------------------------------------
# The conditions at which requirements must hold, where none are named.

#: Axes along which the marker is turned away.
ANGLE_AXES = ("tilt_deg", "view_angle_deg")

#: Axes along which the size in the image changes, too.
SIZES_BESIDE = ("size_m", "hfov_deg", "focal_length_mm", "fx_px", "width_px")

IDS = "marker_id"

#: The parameter by which boards differ, on an axis of its own or with others.
BOARDS = "kind"


def conditions(
    results: xr.Dataset, per: Sequence[str] | None, required_per: Sequence[str] = ()
) -> tuple[str, ...]:
    """Return the dimensions at each of whose values requirements must hold.

    Parameters
    ----------
    results
        The dataset of a run.
    per
        Those that were asked for, none among them; None if nothing was said.
    required_per
        Those that the pipeline names; one with a single value is none.

    Returns
    -------
    tuple
        ``per``, else the pipeline's, else the axis of the size in the image, or the first other
        one with numbers, that of angles, and that of boards, if there are several: what holds of
        them together holds of none that someone puts up. IDs of markers are no conditions.
    """
    if per is not None:
        return tuple(per)
    if found := tuple(name for name in required_per if name in results.dims):
        return found
    axes = [name for name in axes_of(results, Stage.scene)
            if name != DRAWS and results.sizes[name] > 1]
    numeric = [name for name in axes if name in results.coords and name not in (IDS, *ANGLE_AXES)
               and results[name].dtype.kind in "fiu"]
    boards = [name for name in axes if BOARDS in results.coords and results[BOARDS].dims == (name,)]
    usual = [next((name for name in names if name in axes), "") for names in (
        (*SIZE_AXES, *SIZES_BESIDE, *numeric), ANGLE_AXES, boards)]
    return tuple(dict.fromkeys(filter(None, usual)))
