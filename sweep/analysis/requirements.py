"""Decisions: whether requirements are met, how far along an axis, which choice, how precisely."""

from __future__ import annotations

import functools
import itertools
import math
import operator
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import special

from sweep.analysis import dataset, estimator
from sweep.analysis.dataset import DRAWS, Poses, as_names, axes_of, describes, each_cell, stacked
from sweep.analysis.estimator import INTERVAL, LEVEL, Bins, Count, Rate, Statistic
from sweep.analysis.summaries import LOOKED_FOR, NEES_MEAN, RATIOS, quantiles_of, registered
from sweep.errors import ArgumentError, DatasetError, texts_of
from sweep.experiment.parameters import Stage
from sweep.experiment.sampling import RequirementText, StoppingRule, read_requirement
from sweep.experiment.schema import cf_attributes
from sweep.measure.flags import Flag, flag
from sweep.messages import label, nearest, plain, shown
from sweep.typing import Masks

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
    largest
        The largest value that exists.
    percent
        The percent of a quantile, else None.
    """

    name: str
    units: str
    statistic: Any
    largest: float = math.inf
    percent: int | None = None

    @property
    def is_rate(self) -> bool:
        """Whether it is a share of poses."""
        return isinstance(self.statistic, Rate)

    @property
    def exact(self) -> bool:
        """Whether the interval holds whatever the distribution."""
        return isinstance(self.statistic, Rate | estimator.Quantiles)

    @property
    def signed(self) -> bool:
        """Whether the value has a sign: its absolute value is required."""
        return type(self.statistic) is estimator.Mean

    def level(self, share: float = 1.0) -> float:
        """Return the level of the interval by which it is decided with a share of the error."""
        return 1.0 - (1.0 - (EXACT_LEVEL if self.exact else MEAN_LEVEL)) * share

    def statistics(self, level: float) -> list[Statistic[Poses]]:
        """Return the statistics for it, its poses (``used``) and their ``draws``.

        Rates have Clopper and Pearson's interval.
        """
        changes: dict[str, Any] = {"exact": True} if self.is_rate else {}
        return [replace(self.statistic, level=level, **changes),
                Count("used", "poses that count", self.statistic.used, "draws", "drawn")]

    def interval(self, table: xr.Dataset) -> tuple[xr.DataArray, xr.DataArray, xr.DataArray]:
        """Return value, low and high from the table of `statistics`."""
        value, low, high = (table[f"{self.name}{end}"] for end in INTERVAL)
        if not self.signed:
            return value, low, high
        nearest, farthest = (xr.apply_ufunc(end, abs(low), abs(high))
                             for end in (np.minimum, np.maximum))
        return abs(value), nearest.where(low * high > 0.0, 0.0).where(low.notnull()), farthest


def requirable_arrays(
    results: xr.Dataset, required: Sequence[Requirable]
) -> dict[str, xr.DataArray]:
    """Return the arrays that the statistics of some requirables read, by name.

    Raises
    ------
    DatasetError
        If the dataset lacks a variable, one line for each quantity.
    """
    lacking = [f"{each.name}: cannot be computed, for this store lacks {', '.join(missing)}"
               for each in required
               if (missing := [name for name in each.statistic.inputs if name not in results])]
    if lacking:
        raise DatasetError("\n".join(dict.fromkeys(lacking)))
    return dataset.pose_arrays(results, [
        *dataset.ESTIMATE_INPUTS, *(name for each in required for name in each.statistic.inputs)])


@functools.cache
def requirables() -> dict[str, Requirable]:
    """Return everything that can be required, by name.

    Examples
    --------
    >>> requirables()["rotation_p95_deg"].units, requirables()["detection_rate"].largest
    ('degree', 1.0)
    """
    signed = [each for group in dataset.SIGNED.values() for each in group]
    quantities = [*dataset.QUANTITIES, *signed]
    found = {}
    for statistic in (*registered(quantities), *map(quantiles_of, signed), NEES_MEAN, *RATIOS):
        outputs = {output.name: output for output in statistic.outputs()}
        for name, output in outputs.items():
            if f"{name}_low" not in outputs:
                continue  # it has no interval
            largest = next((each.bound for each in quantities if each.bound is not None and (
                name.startswith(f"{each.name}_") and name.endswith(f"_{each.unit}"))), math.inf)
            percent = next((percent for part, percent in estimator.PERCENTS.items()
                            if part in name.split("_")), None)
            found[name] = Requirable(
                name, output.units, statistic, 1.0 if isinstance(statistic, Rate) else largest,
                percent)
    return found


# --------------------------------------------------------------------------------------------------
# Faults of requirements: names, units, limits, contradictions, a line each.

#: Units that names end with.
UNITS = {"deg": "degrees", "rad": "radians", "m": "metres", "mm": "millimetres", "percent": "%",
         "px": "pixels", "cm": "centimetres"}


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
    for candidate in (short, f"{short}_rate", f"{short}_mean"):
        if candidate in known:
            return known[candidate]
    stem = re.sub(f"_({'|'.join(UNITS)})$", "", short)
    unit = next((other.removeprefix(f"{stem}_") for other in known
                 if other.rpartition("_")[0] == stem), "")
    if unit in UNITS:
        raise ValueError(f"its unit is {UNITS[unit]}: write {stem}_{unit}")
    if kinds := [other for other in known if other.startswith(f"{stem}_")]:
        raise ValueError(f"which statistic of it? There are {', '.join(kinds)}")
    hint = nearest(short, [*known]) or "; `sweep reference statistics` lists what has"
    raise ValueError(f"nothing of this name has an interval{hint}")


def fault_of(what: Requirable, given: RequirementText) -> str:
    """Return the fault of a limit and its unit; empty without one.

    A limit is above 0 and below the largest value: draws cannot show others, or they hold always.
    """
    if given.unit:
        ending = what.name.rpartition("_")[2]
        words = f"in {UNITS[ending]}" if ending in UNITS else "without a unit"
        if what.is_rate and given.unit in ("%", "percent"):
            words = f"a share from 0 to 1: write {given.limit / 100:g}"
        return f"{plain(given.unit)} after the limit: expected the number alone, {words}"
    if 0.0 < given.limit < what.largest:
        return ""
    below = f" and below {what.largest:g}" if math.isfinite(what.largest) else ""
    share = f": write {given.limit / 100:g} for {given.limit:g} %" if (
        what.is_rate and 2.0 <= given.limit < 100.0) else ""
    sign = " (of a bias the absolute value is required)" if what.signed else ""
    return f"expected a limit above 0{below}{share}{sign}"


def contradictions(given: Sequence[Requirement]) -> Iterator[tuple[str, str]]:
    """Yield the requirements on one quantity that cannot hold together, each a text and a line."""
    # Of two requirements on a quantity the lower limit comes first.
    for one, other in itertools.combinations(sorted(given, key=lambda each: not each.at_least), 2):
        if one.what == other.what and one.at_least == other.at_least:
            yield other.text, f"{other.what.name} has another such limit; delete one"
        elif one.what == other.what and one.limit >= other.limit:
            yield one.text, f"contradicts {other.text}: no result can be both"


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
    decision: NDArray[np.uint8], axis: int | tuple[int, ...] | None = None
) -> NDArray[np.uint8]:
    """Return the decision of all requirements and conditions over some axes together, or over all.

    Not met if any is not, met if all are that can be judged: not applicable ones are left out.
    Not applicable if none can be judged.
    """
    applicable = decision != Decision.not_applicable
    return np.select(
        [(decision == Decision.not_met).any(axis), ~applicable.any(axis),
         ((decision == Decision.met) | ~applicable).all(axis)],
        [Decision.not_met, Decision.not_applicable, Decision.met],
        Decision.undecided).astype(np.uint8)


class ErrorShares(NamedTuple):
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
    what
        The quantity: a variable of `sweep.analysis.error_statistics`, of `efficiency` or of
        `covariance_trust`. Of a bias with a sign the absolute value is required.
    relation
        One of ``>=``, ``<=``, ``>``, ``<``.
    limit
        The number, in the quantity's units.
    """

    what: Requirable
    relation: str
    limit: float

    @property
    def text(self) -> str:
        """As it is shown: "detection_rate >= 0.99"."""
        return f"{self.what.name} {self.relation} {self.limit:.12g}"

    @property
    def at_least(self) -> bool:
        """Whether the value must be large."""
        return self.relation in (">=", ">")

    @property
    def rare(self) -> float:
        """Share of the draws that are on the wrong side where the value is the limit; NaN of means.

        >>> [round(each.rare, 3) for each in parse_requirements(
        ...     ["detection >= 0.99", "flip_rate <= 0.02", "rotation_p95_deg <= 1"])]
        [0.01, 0.02, 0.05]
        """
        if not self.what.exact:
            return math.nan
        below = self.limit if self.what.percent is None else self.what.percent / 100.0
        return below if self.at_least == (self.what.percent is not None) else 1.0 - below

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
        raise ArgumentError("requirements", faults[0][0], "\n".join(
            [faults[0][1], *map(": ".join, faults[1:])]))
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
            if problem := fault_of(what, given):
                raise ValueError(problem)
            requirements.append(Requirement(what, given.relation, given.limit))
        except ValueError as error:
            faults.append((plain(text), str(error)))
    return requirements, [*faults, *contradictions(requirements)]


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
    to twice the largest that one did (`sweep.analysis.estimator.PositiveMean`): 100 draws
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
    return table.drop_vars(["looked_for", "solved", "keeps"]).assign(
        draws_needed=draws_needed(table, required))


def decide(
    results: xr.Dataset, required: Sequence[Requirement], per: Sequence[str] = (),
    bins: Bins | None = None, shares: Sequence[ErrorShares] | None = None,
) -> xr.Dataset:
    """Return decisions as `check_requirements`, without ``draws_needed``.

    Parameters
    ----------
    results, required, per, bins
        As there.
    shares
        Shares of the error probability that a decision on each requirement may spend, of all looks
        of a search: where sampling was stopped, intervals are not widened for that again.

    Returns
    -------
    xr.Dataset
        As there, with ``keeps``: whether the value keeps its limit, and ``looked_for`` and
        ``solved``: poses of the condition (without ``requirement``).
    """
    configuration = dataset.configuration_axes(results)
    kept = dataset.kept_dimensions(results, (*configuration, *as_names(per)))
    dataset.require_draws(results, kept)
    count = len(required) * math.prod([
        *(len(edges) - 1 for edges in (bins or {}).values()),
        *(results.sizes[name] for name in kept if name not in configuration)])
    spent = shares or [ErrorShares(not_met=1.0 / count)] * len(required)
    quantities = [each.what for each in required]
    poses, *tables = estimator.aggregates(
        results, requirable_arrays(results, quantities), kept, [
            [Count("looked_for", "", lambda poses: poses.looked_for),
             Count("solved", "", lambda poses: poses.solved)],
            *([*map(estimator.guarded, each.statistics(each.level(share)))]
              for each, own in zip(quantities, spent, strict=True)
              for share in (own.met, own.not_met)),
        ], Poses, bins, stopped=None if shares is None else False)
    lacking = [each.name for each, table in zip(quantities, tables[::2], strict=True)
               if not table["used"].any() and poses["solved"].any()]
    if lacking and shares is None:
        raise DatasetError("\n".join(
            f"{name}: no pose of this store has such a number; require something else, or give the "
            "pipeline what computes it" for name in lacking))
    judged = [_judged(*parts, poses, dataset.is_replicated(results))
              for parts in zip(required, tables[::2], tables[1::2], strict=True)]
    out = stacked(judged, "requirement").assign_coords(
        requirement=xr.DataArray([each.text for each in required], dims="requirement", attrs={
            "long_name": "what is required"}),
        variable=("requirement", [each.name for each in quantities]),
        relation=("requirement", [each.relation for each in required]),
        limit=("requirement", [each.limit for each in required]),
        units=("requirement", [each.units for each in quantities]))
    return out.assign(looked_for=poses["looked_for"], solved=poses["solved"]).assign_attrs(
        configuration_dims=configuration)


def _judged(
    requirement: Requirement, one: xr.Dataset, every: xr.Dataset, poses: xr.Dataset,
    replicated: bool,
) -> xr.Dataset:
    """Return value, ends and decision of one requirement.

    ``one`` and ``every`` have its statistics at the level of one decision, and of all together.
    """
    what = requirement.what
    value, low, high = what.interval(one)
    # The end that shows it is met is of one decision, the other of all together.
    if requirement.at_least:
        high = refutes = what.interval(every)[2]
        shows = low
    else:
        low = refutes = what.interval(every)[1]
        shows = high
    enough = one["drawn"] if what.exact or replicated else one["drawn"] & (
        one["draws"] >= MIN_DRAWS)
    no_number = (one["used"] == 0) & ((poses["looked_for"] == 0) | (poses["solved"] > 0))
    decision = value.copy(data=np.select(
        [no_number, requirement.holds(shows) & enough,
         ~requirement.holds(refutes) & refutes.notnull() & enough],
        [Decision.not_applicable, Decision.met, Decision.not_met],
        Decision.undecided).astype(np.uint8))
    return xr.Dataset({
        name: array.assign_attrs(long_name=meaning, units=units)
        for name, array, meaning, units in (
            ("value", value, "value", ""),
            ("low", low, "lower end of the interval by which it is decided", ""),
            ("high", high, "upper end of the interval by which it is decided", ""),
            ("draws", one["draws"], "random draws that the value is worth", "1"))
    } | {"keeps": requirement.holds(value), "decision": decision.assign_attrs(
        cf_attributes("whether the requirement is met", flags=Decision))})


# --------------------------------------------------------------------------------------------------
# About how many draws decide a requirement, if the value stays what it is.

#: Numbers of draws of which the first that decides a rate is taken.
POWERS = np.unique(np.ceil(1.1 ** np.arange(1, 218)))


def draws_needed(
    table: xr.Dataset, required: Sequence[Requirement], shares: Sequence[float] | None = None
) -> xr.DataArray:
    """Return about how many draws would decide requirements, infinite if no number would.

    NaN where it is decided, and without a value. For a rate it is the least n at which Clopper and
    Pearson's end for n times the rate reaches the limit. Other intervals narrow with the root of
    the number of draws (those of spreads on the scale of logarithms, on which they are made); a
    quantile needs as many as its interval's ends need to exist and, if its end is infinite for too
    few poses are solved, as many as decide whether enough are.

    Parameters
    ----------
    table, required
        The decisions (`decide`), and the requirements.
    shares
        Share of the error probability that a decision on each requirement may spend.
    """
    needed: xr.DataArray = xr.apply_ufunc(
        np.vectorize(_needed, otypes=[float]), *(
            xr.DataArray(np.array(each, dtype=object), dims="requirement")
            for each in (shares or [1.0] * len(required), required)),
        table["value"].where(table["decision"] == Decision.undecided), table["low"], table["high"],
        table["draws"].astype(np.float64),
        (table["solved"] / table["looked_for"]).where(table["looked_for"] > 0))
    return needed.transpose(..., "requirement").assign_attrs(
        long_name="draws that would decide it, if the value stays", units="1")


def _needed(
    share: float, requirement: Requirement, value: float, low: float, high: float, draws: float,
    solved: float,
) -> float:
    """Return the draws that one undecided requirement needs; ``solved`` is a share of poses."""
    what, limit, level = requirement.what, requirement.limit, requirement.what.level(share)
    if math.isnan(value):
        return math.nan
    if what.is_rate:
        return _of_rate(value, limit, level)
    good = value >= limit if requirement.at_least else value <= limit
    # The end that has to pass the limit.
    end, gap = low if good == requirement.at_least else high, abs(value - limit)
    least = float(MIN_DRAWS)
    if what.percent is not None:
        least = float(estimator.draws_to_see(1.0 - what.percent / 100.0, level))
        if math.inf in (end, value) and draws >= least:
            return max(least, _of_rate(solved, what.percent / 100.0, level))
    if not math.isfinite(end) or not math.isfinite(value):
        return max(least, 2.0 * draws)
    if gap == 0.0:
        return math.inf
    reach = (end - value) / gap
    # A spread without a largest value has an interval of the logarithm.
    if isinstance(what.statistic, estimator.RootMeanSquare) and math.isinf(what.largest) and (
            min(value, end) > 0.0):
        reach = math.log(end / value) / math.log(limit / value)
    if 2.0 <= draws < MIN_DRAWS and not what.exact:
        # Student's factor of so few draws is far above that of many.
        probability = (1.0 + level) / 2.0
        reach *= special.ndtri(probability) / special.stdtrit(draws - 1.0, probability)
    return rounded_draws(max(least, draws * reach ** 2))


def _of_rate(rate: float, limit: float, level: float) -> float:
    """Return the least power of about 1.1 at which the interval excludes the limit."""
    # Whole hits, rounded towards the limit.
    hits = np.floor(rate * POWERS) if rate > limit else np.ceil(rate * POWERS)
    low, high = estimator.clopper_pearson(hits, POWERS, level)
    decided = POWERS[low > limit if rate > limit else high < limit]
    return rounded_draws(decided[0]) if decided.size else math.inf


def rounded_draws(count: float) -> float:
    """Return a number of draws with two digits, rounded up; infinite if it is too large."""
    if count > estimator.MAX_DRAWS:
        return math.inf
    step = 10.0 ** max(0, math.floor(math.log10(max(count, 1.0))) - 1)
    return math.ceil(count / step) * step


# --------------------------------------------------------------------------------------------------
# The requirements in a pipeline's section [require], their names checked.

def quantity_faults(texts: Iterable[str], names: Iterable[str]) -> list[str]:
    """Return a line for each fault of a pipeline's requirements and of its precisions' names."""
    return [*(f"require.all = {shown(text)}: {problem}"
              for text, problem in read_requirements(texts)[1]),
            *(f"search.precision.{line}"
              for line in wanted_precisions(dict.fromkeys(names, 0.5))[1])]


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
    def of(cls, cells: xr.Dataset, conditions: Sequence[str], **more: Any) -> Self:
        """Return the cause of the cell, of a table, that fails worst, or is nearest to it."""
        decision = cells["decision"]
        worst = next(each for each in WORST_FIRST if (decision == each).any())
        cell = dataset.largest_cell(cells, excess_of(cells).where(decision == worst, -np.inf))
        numbers = ("requirement", "units", "value", "low", "high", "draws", "draws_needed")
        return cls(**{name: cell[name].item() for name in numbers} | {
            "decision": worst, "condition": {name: cell[name].item() for name in conditions},
            **more})


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


def verdicts(table: xr.Dataset) -> list[Verdict]:
    """Return the verdicts of a table of `sweep.analysis.check_requirements`."""
    configuration = table.attrs["configuration_dims"]
    conditions = [str(dim) for dim in table["decision"].dims
                  if dim not in (*configuration, "requirement")]
    found = []
    for at, one in each_cell(table, (*configuration, "requirement")):
        counts = {Decision(decision): int(count) for decision, count in zip(
            *np.unique(one["decision"], return_counts=True), strict=True)}
        # Where it fails somewhere, no number of draws mends it.
        needed = math.nan if Decision.not_met in counts else float(one["draws_needed"].max())
        found.append(Verdict.of(
            one, conditions, draws_needed=needed, limit=one["limit"].item(), counts=counts,
            configuration={name: at[name] for name in configuration}))
    return found


def excess_of(table: xr.Dataset) -> xr.DataArray:
    """Return how far the values of a table are beyond the limits, relative to these.

    It is infinite for no number, finite and negative on the right side of the limit.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = table["value"] / table["limit"]
        at_least = table["relation"].isin([">=", ">"])
        excess = (1.0 - ratio).where(at_least, 1.0 - 1.0 / ratio)
    return excess.clip(min=-sys.float_info.max).fillna(np.inf)


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

#: Sections of which an axis without numbers has targets: dictionaries, boards.
TARGETS = {"marker", "board"}


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
        one with numbers, that of angles, and those of dictionaries and boards, if there are
        several: what holds of them together holds of none that someone puts up. IDs of markers are
        no conditions.
    """
    if per is not None:
        return dataset.kept_dimensions(results, per)
    if found := tuple(name for name in required_per if name in results.dims):
        return found
    axes = [name for name in axes_of(results, Stage.scene)
            if name != DRAWS and results.sizes[name] > 1]
    numeric = [name for name in axes if name in results.coords
               and name not in ("marker_id", *ANGLE_AXES) and results[name].dtype.kind in "fiu"]
    targets = [name for name in axes if results[name].dtype.kind not in "fiu"
               and not TARGETS.isdisjoint(dataset.sections_of(name, results))]
    usual = [next((name for name in names if name in axes), "") for names in (
        (*dataset.SIZE_AXES, *SIZES_BESIDE, *numeric), ANGLE_AXES)]
    return tuple(dict.fromkeys(filter(None, [*usual, *targets])))


Decisions = NDArray[np.uint8]

# --------------------------------------------------------------------------------------------------
# One course along an axis, whose values stand in an order: of a limit from easy to hard, of the
# smallest size that will do from the largest down. Values at which nothing can be judged, such as
# sizes that do not fit into the image, are left out; a value beyond one that fails, on the other
# side of a dip, ends nothing.
#
# That makes the error of what is decided that of a single decision: it is wrong only if, at the
# first value that truly fails, the condition at which it fails is decided as met. Neither the
# number of values nor that of conditions counts (Berger, "Multiparameter hypothesis testing and
# acceptance sampling", Technometrics 24, 1982: an intersection-union test; Marcus, Peritz and
# Gabriel, Biometrika 63, 1976: tests in a fixed order); the numbers of waves, after each of which a
# decision is made, and of alternatives do (Bonferroni).

class Course(NamedTuple):
    """How far requirements are met along an axis: indices of its values.

    Attributes
    ----------
    met
        The last value at which, and at all judged ones before it, all is decided to be met.
    possible
        The same of values at which nothing is decided not to be met.
    kept
        The same of values whose estimates keep all limits; each -1 for none.
    unmet
        The first judged value that is not met, or undecided.
    failing
        The first judged value whose estimates do not keep a limit; each the number of values if
        there is none.
    """

    met: int
    possible: int
    kept: int
    unmet: int
    failing: int


def course(decision: Decisions, keeps: Masks, start: int = 0) -> Course:
    """Return how far requirements are met.

    Parameters
    ----------
    decision
        (values, ...) of `Decision`, in the order of the course, at all conditions.
    keeps
        Of the same shape: where the estimates keep all limits.
    start
        The first value that counts.

    Examples
    --------
    >>> met, failed = Decision.met, Decision.not_met
    >>> decision = np.array([[met], [met], [failed], [met], [failed]], np.uint8)
    >>> course(decision, decision == met)
    Course(met=1, possible=1, kept=1, unmet=2, failing=2)
    """
    value, keep = of_values(decision, keeps)
    judged = (value != Decision.not_applicable) & (np.arange(len(value)) >= start)

    def ends(holds: Masks) -> tuple[int, int]:
        """Return the last judged value up to which it holds, and the first where it does not."""
        fails = np.flatnonzero(judged & ~holds)
        first = int(fails[0]) if fails.size else len(value)
        before = np.flatnonzero(judged[:first])
        return int(before[-1]) if before.size else -1, first

    (met, unmet), (kept, failing) = ends(value == Decision.met), ends(keep)
    return Course(met, ends(value != Decision.not_met)[0], kept, unmet, failing)


def of_values(decision: Decisions, keeps: Masks) -> tuple[Decisions, Masks]:
    """Return the decision on each value (values,), and where its estimates keep all limits.

    ``decision`` and ``keeps`` are (values, ...): what cannot be judged is left out.
    """
    inner = tuple(range(1, decision.ndim))
    return combined_decision(decision, inner), np.asarray(
        (keeps | (decision == Decision.not_applicable)).all(inner))


def search_shares(
    required: Sequence[Requirement], ends: Sequence[int], values: int, alternatives: int = 1
) -> list[ErrorShares]:
    """Return the shares of the error probability that decisions of a search may spend.

    Parameters
    ----------
    required
        The requirements: each has shares of its own.
    ends
        Draws of a cell at each look.
    values
        Cells that are decided at once for one answer: any false "not met" shortens it.
    alternatives
        Answers, each of which can be wrong.
    """
    def share(requirement: Requirement, side: float, count: int) -> float:
        error = (1.0 - requirement.what.level(1.0 / count)) / 2.0
        return 1.0 / (count * estimator.looks_factor(tuple(ends), side, error))

    return [ErrorShares(share(each, 1.0 - each.rare, alternatives),
                        share(each, each.rare, alternatives * values * len(required)))
            for each in required]


# --------------------------------------------------------------------------------------------------
# How far requirements are met along an axis: "up to 2.25 m (2.0 to 2.5)".

class Reach(Flag):
    """How far the requirements are met along the axis."""

    not_run = flag(0, "Nothing could be judged.", counted=False)
    found = flag(1, "They are met up to a value within the grid.", present=True)
    never = flag(2, "They are not met at the easiest value.")
    always = flag(3, "They are met at all values: the limit may lie beyond.", present=True)
    within = flag(4, "They are met between two values, but not at the easiest.", present=True)


#: Variables of limits: name -> meaning, units (those of the axis if they are None), and flags.
LIMITS: dict[str, tuple[Any, ...]] = {
    "value": ("{} up to which all requirements are met", None),
    "low": ("lower end of the interval: {} up to which all are met", None),
    "high": ("upper end of the interval: {} up to which all are met", None),
    "start": ("{} from which all requirements are met", None),
    "fails_at": ("first {} at which one is not", None),
    "farthest_beyond": ("farthest {} beyond it at which all are met again", None),
    "failing_value": ("value of the requirement that fails there", ""),
    "met_beyond": ("values beyond it at which all are met again", "1"),
    "limited_by": ("requirement that fails", ""),
    "fails_where": ("where it fails", ""),
    "reach": ("how far the requirements are met", "", Reach),
    "settled": ("whether the interval is a single value of the grid", "1"),
    "decision": ("whether all requirements are met", "", Decision),
    "keeps": ("whether all values keep their limits", "1"),
    "trials": ("trials of a cell, the most at this value", "1"),
    "poses": ("scenes that were computed, of all values", "1"),
}


@describes
def requirement_limits(
    results: xr.Dataset, require: Sequence[str] = (), along: str = "",
    per: Sequence[str] | None = None, at_all: Sequence[str] | None = None,
) -> xr.Dataset:
    """Return how far along an axis all requirements are met, for each condition by itself.

    Parameters
    ----------
    results
        The dataset of a run, of `sweep.limit` or with equally many trials everywhere.
    require, along, per, at_all
        As `sweep.limit` takes them; by default those that the run was made for.

        ``along`` is an axis of the scene with numbers, such as ``distance_m``. It is read from easy
        to hard: one that changes the size in the image towards smaller markers; another from the
        end at which the requirements are met at more of the conditions, upwards if that is
        undecided. ``per`` are dimensions that are kept: a limit for each of their values; without a
        word all axes of the scene, while an empty list pools them. ``at_all`` are dimensions at all
        of whose values the requirements must hold for a value of ``along`` to count, such as
        ``tilt_deg`` for "up to 2.25 m at tilts up to 45 degrees".

    Returns
    -------
    xr.Dataset
        Dimensions (*configuration, *per), computed.

        - ``value``: the last value of the axis up to which, without a gap, the values of all
          requirements keep their limits; NaN for never. ``start``: the value from which they do,
          which is the easiest, or the first of the longest run of values if they do not there:
          near 0 tilt poses flip, near the camera a marker is cut off.
        - ``low``, ``high``: ends of its interval, in the axis' unit, which covers the limit of each
          condition with 95 %, however often it was decided anew. Up to the end nearer to the easy
          values they are decided to be met, beyond the other end a requirement is decided not to be
          met. -inf or inf: the limit may lie beyond the grid's end. ``settled``: whether the
          interval is a single value of the grid.
        - ``reach`` (`Reach`).
        - ``limited_by``: the requirement that first fails beyond ``value``, "" for none;
          ``fails_at`` the value of the axis there; ``fails_where``: the values of ``at_all`` at
          which it fails worst, as text "tilt_deg = 45"; ``failing_value``: the quantity's value
          there.
        - ``met_beyond``: at how many values beyond ``fails_at`` all requirements keep their limits
          again; ``farthest_beyond`` the farthest of them, NaN for none. Detection is not
          monotonic: above 0 there is a dip, which ends ``value``.
        - ``poses`` (*per): how many scenes were computed for the condition, of all values.

        With the dimension ``along``, for each of its values: ``decision`` (`Decision`) of all
        requirements together; ``keeps``: whether all values keep their limits; ``trials`` (*per,
        along): the most that a cell has there.

    Raises
    ------
    ArgumentError, DatasetError
        As in `sweep.analysis.check_requirements`; also if nothing says what is searched, and for an
        axis without an order.

    Notes
    -----
    Requirements must hold at all values of ``at_all`` and are judged at each value along the axis
    after each wave: an end of the interval is wrong with 0.025 at most, of all these decisions
    together (Bonferroni over values and requirements; `looks_factor` over waves). ``low`` (of a
    limit upwards) is too large with the error probability of one decision: only the first value at
    which a requirement fails could make it so.

    Examples
    --------
    >>> limit = requirement_limits(results, ["detection >= 0.6"], "side_px").sel(solver="ippe")
    >>> limit["value"].item(), limit["low"].item(), limit["high"].item()
    (20.0, 20.0, 40.0)
    >>> limit["limited_by"].item(), limit["fails_at"].item()
    ('detection_rate >= 0.6', 10.0)
    """
    rule, require = dataset.stopping_rule(results), texts_of(
        "require", () if require is None else require)
    ends: tuple[int, ...] = (results.sizes.get(DRAWS, 1),)
    if rule is not None and rule.kind == "along":
        ends = rule.ends
        require, along = require or [*rule.requirements], along or rule.along
        if along == rule.along:
            per = rule.per if per is None else per
            at_all = rule.at_all if at_all is None else at_all
    required = parse_requirements(require)
    require_order(results, along)
    together = [name for name in as_names(() if at_all is None else at_all) if name != along]
    names = [name for name in (as_names(per) if per is not None else axes_of(results, Stage.scene))
             if name != along and (per is not None or name not in (DRAWS, *together))]
    if overlap := [name for name in together if name in names]:
        raise ArgumentError("at_all", ", ".join(overlap), "is in per, too; name it in one of them")
    pooled = cells_along(results, {*axes_of(results, Stage.scene)} - {
        DRAWS, along, *names, *together})
    table = decide(results, required, [*names, *together, along], shares=search_shares(
        required, [end * pooled for end in ends], cells_along(results, (along, *together))))
    table = table.sortby(along)
    upwards = is_harder_upwards(along, table["keeps"].transpose(along, ...).to_numpy())
    table = table.isel({along: slice(None, None, 1 if upwards else -1)})
    inner = (along, *together, "requirement")
    kept = [str(dim) for dim in table["decision"].dims if dim not in inner]
    rows = [_limit(part.transpose(along, ...), along, together, upwards=upwards)
            for _, part in each_cell(table, kept)]
    columns = {name: ([*kept, along][: column.ndim], column) for name, column in dataset.of_cells(
        rows, [table.sizes[dim] for dim in kept]).items()}
    computed = dataset.computed_scenes(results)
    cells = [name for name in computed.dims if name not in (*names, along, DRAWS)]
    trials = computed.sum(DRAWS).compute()
    coordinates = table.drop_dims([*together, "requirement"]).coords
    found = xr.Dataset(columns, coordinates).sel({along: results[along].to_numpy()}).assign(
        trials=trials.max(cells), poses=trials.sum([*cells, along]))
    units = results[along].attrs.get("units", "")
    for name, (meaning, own, *flags) in LIMITS.items():
        found[name].attrs = cf_attributes(
            meaning.format(along), units if own is None else own, *flags)
    return found.assign_attrs(
        along=along, harder="upwards" if upwards else "downwards",
        configuration_dims=table.attrs["configuration_dims"],
        per=[*names], at_all=together, require=require)


def cells_along(results: xr.Dataset, names: Iterable[str]) -> int:
    """Return how many combinations the values of some dimensions have; others are none."""
    return math.prod(results.sizes.get(name, 1) for name in names)


def require_order(results: xr.Dataset, along: str) -> None:
    """Raise ArgumentError unless an axis of the scene has numbers, each once."""
    axes = [name for name in axes_of(results, Stage.scene)
            if name != DRAWS and name in results.coords and results[name].dtype.kind in "fiu"
            and 0 < results.sizes[name] == results.get_index(name).nunique()]
    if along not in axes:
        raise ArgumentError("along", along, "expected an axis of the scene with numbers, each "
                            f"once; there are {', '.join(axes) or 'none'}")


#: Whether markers are smaller in the image at large values of an axis that changes their size.
SMALLER_UPWARDS = {
    **dict.fromkeys(("distance_m", "hfov_deg", "vfov_deg", "dfov_deg", "pixel_size_um",
                     "sensor_width_mm", "sensor_height_mm"), True),
    **dict.fromkeys(("side_px", "size_m", "focal_length_mm", "fx_px", "width_px"), False)}


def is_harder_upwards(along: str, keeps: NDArray[Any]) -> bool:
    """Return whether large values of an axis are the hard ones.

    Of an axis that does not change the size in the image they are, unless requirements are kept at
    more conditions there; ``keeps`` (values, ...), from small to large, is true where they are.
    """
    return SMALLER_UPWARDS.get(along, bool(np.sum(keeps[0]) >= np.sum(keeps[-1])))


def _limit(
    part: xr.Dataset, along: str, together: Sequence[str], *, upwards: bool
) -> dict[str, Any]:
    """Return the limit of one condition, a part of the table of `decide`, from easy to hard.

    It has the variables of `LIMITS` but those of trials.
    """
    values = part[along].to_numpy().astype(np.float64)
    decision, keeps = of_values(part["decision"].to_numpy(), part["keeps"].to_numpy())
    judged, index = decision != Decision.not_applicable, np.arange(len(values))
    row = dict.fromkeys(("value", "low", "high", "start", "fails_at", "farthest_beyond",
                         "failing_value", "met_beyond"), np.nan) | {
        "limited_by": "", "fails_where": "", "decision": decision, "keeps": keeps & judged,
        "settled": False, "reach": np.uint8(Reach.not_run)}
    if not judged.any():
        return row
    # Where the easiest values fail, the limit is the end of the longest run of values that do not.
    start = kept_from(keeps, judged)
    found = course(decision, keeps, start or 0)
    none, beyond = (-np.inf, np.inf) if upwards else (np.inf, -np.inf)
    met, possible = (values[k] if k >= 0 else none for k in (found.met, found.possible))
    if (decision[start or 0 :] != Decision.not_met).all():
        possible = beyond
    low, high = sorted((met, possible))
    row |= {"low": low, "high": high, "settled": low == high, "met_beyond": 0.0,
            "reach": np.uint8(Reach.never)}
    if start is not None:
        row |= {"start": values[start], "value": values[found.kept], "reach": np.uint8(
            Reach.within if judged[:start].any() else
            Reach.always if found.failing == len(values) else Reach.found)}
    if found.failing == len(values):
        return row
    again = np.flatnonzero(judged & keeps & (index > found.failing))
    cell = part.isel({along: found.failing})
    failing = ~cell["keeps"] & (cell["decision"] != Decision.not_applicable)
    worst = dataset.largest_cell(cell, excess_of(cell).where(failing, -np.inf))
    return row | {
        "fails_at": values[found.failing], "met_beyond": float(len(again)),
        "farthest_beyond": values[again[-1]] if again.size else np.nan,
        "limited_by": str(worst["requirement"].item()),
        "fails_where": described({name: worst[name].item() for name in together}, " = "),
        "failing_value": float(worst["value"])}


def kept_from(keeps: Masks, judged: Masks) -> int | None:
    """Return the first index of the run of values that are kept, without a gap.

    It is that from the first judged value on, or, if that is not kept, the longest; of several the
    first. Values that are not judged (n,) neither count nor make a gap. None without any.

    >>> kept_from(np.array([0, 1, 0, 1, 1], bool), np.ones(5, bool))
    3
    """
    at = np.flatnonzero(judged)
    # Runs begin and end where the mask changes.
    edges = np.flatnonzero(np.diff(np.concatenate([[False], keeps[at], [False]])))
    if not edges.size:
        return None
    runs = edges.reshape(-1, 2)
    longest = 0 if runs[0, 0] == 0 else int(np.argmax(runs[:, 1] - runs[:, 0]))
    return int(at[runs[longest, 0]])


# --------------------------------------------------------------------------------------------------
# The choice that meets requirements at all conditions: of a size, and among other settings.
#
# What a choice is stands in `sweep.experiment.sampling`. Every alternative, a combination of the
# values of the axes ``among``, has its own answer: the course of the values from the safe end on.

#: Probability with which an answer meets the requirements.
CONFIDENCE = 0.95


def needed(decision: Decisions, keeps: Masks) -> Masks:
    """Return which cells need more trials, (values, ...).

    Those are the undecided conditions of the values up to the first that fails, or seems to: of
    that one, only the conditions at which it seems to fail. What lies beyond it waits until it is
    decided, and is never needed if it does fail.

    Parameters
    ----------
    decision
        (values, ...) of `Decision`, in the order of the course, at all conditions.
    keeps
        Of the same shape: where the estimates keep all limits.
    """
    inner = tuple(range(1, decision.ndim))
    undecided = decision == Decision.undecided
    seems = undecided & ~keeps
    value = combined_decision(decision, inner)
    stops = (value == Decision.not_met) | seems.any(inner)
    number = np.cumsum(stops)
    before = np.expand_dims(number == 0, inner)
    first = np.expand_dims(stops & (number == 1) & (value == Decision.undecided), inner)
    return np.asarray((undecided & before) | (seems & first))


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
    next, next_cause
        The next value, which fails or is undecided, and by what; None if all values meet them.
        Without an axis ``next`` is None, and ``next_cause`` that of the alternative itself.
    passing
        Values beyond the next one that seem to meet all.
    nearest
        If none is met: the nearest alternative.
    is_open
        Whether it is undecided what the answer is: the next value may meet them, too.
    possible
        The last value that may do so: none before it is decided to fail.
    """

    alternative: Mapping[str, Any]
    met: bool
    value: float | None
    next: float | None
    next_cause: Cause | None
    passing: tuple[float, ...]
    nearest: Nearest | None
    is_open: bool
    possible: float | None


#: The dimension of the values of a choice that is searched along no axis: there is one.
CHOICE = "choice"


def choice_table(
    results: xr.Dataset, rule: StoppingRule, shares: Sequence[ErrorShares]
) -> xr.Dataset:
    """Return the decisions that make a choice, of a whole store or of some of its alternatives.

    Returns
    -------
    xr.Dataset
        As `decide`, dimensions (*among, along, *at_all, requirement), the values in the order of
        the course, with ``hopeless``: undecided, and no number of trials will tell.

    Raises
    ------
    ArgumentError, DatasetError
        As `sweep.analysis.check_requirements`.
    """
    kept = [*rule.among, *filter(None, [rule.along]), *rule.at_all]
    table = decide(results, parse_requirements(rule.requirements), kept, shares=shares)
    table = table.sortby(rule.along, ascending=rule.largest) if rule.along else (
        table.expand_dims(CHOICE))
    table = table.transpose(*rule.among, rule.along or CHOICE, *rule.at_all, "requirement")
    # Where so few poses count that max_trials will not have enough, there is nothing to learn.
    pooled = cells_along(results, {*axes_of(results, Stage.scene)} - {*kept, DRAWS})
    coming = table["draws"] / table["looked_for"] * rule.max_trials * pooled
    few = (table["looked_for"] >= MIN_DRAWS) & (coming < MIN_DRAWS)
    return table.assign(hopeless=few & (table["decision"] == Decision.undecided))


def choice_needed(table: xr.Dataset, rule: StoppingRule) -> xr.DataArray:
    """Return which cells of a choice need more trials, dimensions (*among, along, *at_all)."""
    cells = [rule.along or CHOICE, *rule.at_all]
    decision = table["decision"].where(~table["hopeless"], np.uint8(Decision.not_met))
    keeps = (table["keeps"] | (decision == Decision.not_applicable)).all("requirement")
    decision = xr.apply_ufunc(combined_decision, decision, kwargs={"axis": -1},
                              input_core_dims=[["requirement"]])
    wanted: xr.DataArray = xr.apply_ufunc(
        needed, decision, keeps, vectorize=True, input_core_dims=[cells] * 2,
        output_core_dims=[cells])
    return wanted if rule.along else wanted.isel({CHOICE: 0})


def answers(
    results: xr.Dataset, rule: StoppingRule, shares: Sequence[ErrorShares]
) -> list[Answer]:
    """Return the answer of each alternative, in the order of the axes ``among``."""
    table = choice_table(results, rule, shares)
    table = table.assign(draws_needed=draws_needed(
        table, parse_requirements(rule.requirements), [each.met for each in shares]))
    return [_answer(*part, rule) for part in each_cell(table, rule.among)]


def _answer(alternative: Mapping[str, Any], part: xr.Dataset, rule: StoppingRule) -> Answer:
    """Return the answer of an alternative, a part of the table."""
    values: list[Any] = part[rule.along].to_numpy().tolist() if rule.along else [None]
    decision, keeps = (part[name].to_numpy() for name in ("decision", "keeps"))
    found, (value, keep) = course(decision, keeps), of_values(decision, keeps)
    judged = value != Decision.not_applicable
    excess = excess_of(part).where(part["decision"] != Decision.not_applicable, -np.inf).max(
        [*rule.at_all, "requirement"]).to_numpy()
    best = int(np.argmin(np.where(judged, excess, np.inf)))

    def cause(at: int) -> Cause:
        """Return the requirement and condition by which a value fails worst, or is nearest."""
        return Cause.of(part.isel({rule.along or CHOICE: at}), rule.at_all)

    met, after = found.met >= 0, found.unmet < len(values)
    return Answer(
        alternative, met, values[found.met] if met else None,
        values[found.unmet] if after else None, cause(found.unmet) if after else None,
        tuple(value for k, value in enumerate(values)
              if k > found.unmet and judged[k] and keep[k]),
        None if met else Nearest(values[best], float(excess[best]), cause(best)),
        bool((value[: found.possible + 1] == Decision.undecided).any()),
        None if found.possible < 0 else values[found.possible])


# --------------------------------------------------------------------------------------------------
# Half-widths of intervals, by which sampling stops, and whether they are as small as is wanted.
#
# Of rates they are as they are, of a bias relative to the root mean square error, of all else
# relative to the value. The intervals are those that the analysis shows of a store whose sampling
# was stopped (`sweep.analysis.estimator`).

#: Draws below which no interval of a mean or a root mean square is narrow enough.
#:
#: Their formulas need draws to tell how the errors spread: the interval of a lucky start is narrow.
MIN_MEAN_DRAWS = 450

#: Poses that count below which a rate is not worth waiting for.
MIN_OF_RATE = 50

#: Level of the interval that says that too few numbers will come.
NEVER_LEVEL = 0.999


class Reached(Flag):
    """Whether a quantity is known as well as was wanted."""

    not_run = flag(0, "Nothing was computed.", counted=False)
    reached = flag(1, "The interval is as narrow as was wanted.", present=True)
    not_reached = flag(2, "The interval is wider than was wanted.", present=True)
    too_rare = flag(
        3, "Poses that have such a number are too rare for an interval as narrow as was wanted.")
    not_applicable = flag(4, "No pose was looked for.", counted=False)


@dataclass(frozen=True)
class WantedPrecision:
    """The half-width that is wanted of the interval of a quantity.

    Attributes
    ----------
    what
        The quantity.
    half_width
        As the comment above says; above 0, below 1.
    """

    what: Requirable
    half_width: float

    @property
    def spread(self) -> Requirable | None:
        """Of a bias the standard deviation; else None."""
        bias = self.what.name
        return requirables()[bias.replace("_bias_", "_sd_")] if "_bias_" in bias else None

    @property
    def least_draws(self) -> int:
        """Draws with a number below which it is useless to go on.

        It does not depend on the half-width, so that a smaller one never needs fewer trials.
        """
        if self.what.is_rate:
            return MIN_OF_RATE
        if (percent := self.what.percent) is None:
            return MIN_MEAN_DRAWS
        return estimator.draws_to_see(1.0 - percent / 100.0, estimator.stopped_level(LEVEL))

    @property
    def fewest_draws(self) -> int:
        """Draws below which no interval is narrow enough, whatever the results are."""
        if not self.what.is_rate:
            return self.least_draws
        # An interval of half of all shares, or more, has a single draw.
        return estimator.draws_to_see(
            min(2.0 * self.half_width, 0.999), estimator.stopped_level(LEVEL))

    def judged(self, table: xr.Dataset, total: xr.DataArray) -> xr.Dataset:
        """Return value, half-width, a flag of `Reached`, and the poses and draws that it is of.

        Parameters
        ----------
        table
            The statistics of the quantity; ``looked_for`` and ``run``: poses that were.
        total
            Poses that all trials would be.
        """
        what, run, used, draws = self.what, table["run"], table["used"], table["draws"]
        value, low, high = (table[f"{what.name}{end}"] for end in INTERVAL)
        with np.errstate(all="ignore"):
            half = (high - low) / 2.0
            if not what.is_rate:
                scale = abs(value) if self.spread is None else xr.apply_ufunc(
                    np.hypot, value, table[self.spread.name])
                half = (half / scale).where(half != 0.0, 0.0)
        # Too many poses are lost for a quantile: it is infinite, which is all there is to know.
        half = half.where(low != np.inf, 0.0)
        # Even the upper end of the share of poses with a number gives too few draws of all trials.
        most = np.maximum(run, used)
        share = used.copy(data=estimator.clopper_pearson(used, most, NEVER_LEVEL)[1])
        worth = (draws / np.maximum(used, 1)).where(used > 0, 1.0)
        too_rare = (share * total * worth < self.least_draws) & (total >= self.least_draws)
        narrow = (half <= self.half_width) & (draws >= (1 if what.exact else MIN_MEAN_DRAWS))
        reached = np.select(
            [run == 0, table["looked_for"] == 0, narrow, too_rare],
            [Reached.not_run, Reached.not_applicable, Reached.reached, Reached.too_rare],
            Reached.not_reached)
        return xr.Dataset({
            name: array.drop_attrs().assign_attrs(cf_attributes(*words))
            for name, array, *words in (
                ("value", value, "value"),
                ("half_width", half, "half-width of the interval, as was wanted"),
                ("used", used, "poses that the value is of", "1"),
                ("draws", draws, "random draws that these are worth", "1"),
                ("reached", used.copy(data=reached.astype(np.uint8)),
                 "whether the interval is as narrow as was wanted", "", Reached))})


def wanted_precisions(wanted: Mapping[str, float]) -> tuple[list[WantedPrecision], list[str]]:
    """Return the precisions that names and half-widths ask for, and lines of faults.

    Names are as in requirements (`sweep.analysis.requirements.parse_requirements`). Faults are
    names that do not exist or mean what another one means, and half-widths that cannot be.

    Examples
    --------
    >>> [(each.what.name, each.half_width) for each in wanted_precisions({"detection": 0.02})[0]]
    [('detection_rate', 0.02)]
    """
    precisions: dict[str, WantedPrecision] = {}
    faults = []
    for name, half_width in wanted.items():
        try:
            what = named(name)
            if not 0.0 < half_width < 1.0:
                raise ValueError("expected the half-width of an interval, above 0 and below 1")
            if what.name in precisions:
                raise ValueError(f"{what.name} has another half-width; delete one")
            precisions[what.name] = WantedPrecision(what, float(half_width))
        except ValueError as error:
            faults.append(f"{name}: {error}")
    return [*precisions.values()], faults


@describes
def precision_reached(
    results: xr.Dataset, wanted: Mapping[str, float] | None = None,
    per: Sequence[str] | None = None, max_trials: int | None = None,
) -> xr.Dataset:
    """Return how well each condition is known, against the precision that was wanted.

    Parameters
    ----------
    results
        The dataset of a run.
    wanted
        Half-widths of intervals by the name of the quantity, such as ``{"detection_rate": 0.02}``:
        of rates as they are, of a bias relative to the root mean square error, of all else
        relative to the value. By default as in the pipeline's [search].
    per
        Dimensions whose values are conditions; by default as in the pipeline's [search].
        Detector and estimator are always kept.
    max_trials
        The most trials that there may be; by default as many as there are.

    Returns
    -------
    xr.Dataset
        Dimensions (*configuration, *per, quantity), computed.

        - ``value`` and ``half_width`` of its interval, in the terms of ``wanted``.
        - ``reached``: whether it is as narrow as was wanted (`Reached`).
        - ``used``: poses that the value is of; ``draws``: the random draws that these are worth.
        - ``run`` (*configuration, *per): poses that were run, of ``poses`` that all trials are.
        - ``settled`` (*per): whether no configuration and quantity of the condition needs more.
        - ``wanted`` (quantity).

    Raises
    ------
    ArgumentError
        For names and half-widths that cannot be, and a dimension that does not exist.
    DatasetError
        If the dataset lacks a variable, or has no poses.

    Notes
    -----
    The intervals are those by which sampling stops: at 97 % for 95 %, and 98 % for root mean
    squares and standard deviations (`sweep.analysis.estimator`), also of a store whose
    sampling was not stopped.

    Examples
    --------
    >>> table = precision_reached(results, {"detection_rate": 0.3}, per=["side_px"])
    >>> [Reached(flag).name for flag in table["reached"].isel(solver=0, quantity=0).values]
    ['reached', 'not_reached', 'reached']
    """
    rule = dataset.stopping_rule(results)
    own = {} if rule is None else dict(rule.precision)
    wanted = own if wanted is None else wanted
    if not wanted:
        raise ArgumentError("wanted", None, "this store's pipeline searches no precision; "
                            'give half-widths, such as {"detection_rate": 0.02}')
    if per is None:
        per = rule.per if rule is not None and own else ()
    precisions, faults = wanted_precisions(wanted)
    if faults:
        raise ArgumentError("wanted", wanted, "\n".join(faults))
    configuration = dataset.configuration_axes(results)
    kept = dataset.kept_dimensions(results, (*configuration, *as_names(per)))
    poses, *tables = estimator.aggregates(
        results, requirable_arrays(results, [each.what for each in precisions]), kept, [
            [Count(*LOOKED_FOR, lambda poses: poses.looked_for),
             Count("run", "poses that were run", lambda poses: poses.run),
             Count("poses", "poses that all trials are", lambda poses: np.ones_like(poses.run))],
            *(each.what.statistics(LEVEL)
              + (each.spread.statistics(LEVEL)[:1] if each.spread else []) for each in precisions),
        ], Poses, stopped=True)
    total = poses["poses"]
    if max_trials is not None:
        total = total // results.sizes[DRAWS] * max_trials
    out = stacked([each.judged(table.assign(poses.data_vars), total)
                   for each, table in zip(precisions, tables, strict=True)], "quantity")
    needs = out["reached"].drop_attrs().isin((Reached.not_run, Reached.not_reached))
    settled = (~needs.any([*configuration, "quantity"])).assign_attrs(
        long_name="whether no configuration and quantity needs more trials", units="1")
    return out.assign(settled=settled, run=poses["run"], poses=poses["poses"]).assign_coords(
        quantity=("quantity", [each.what.name for each in precisions]),
        wanted=("quantity", [each.half_width for each in precisions]),
    ).assign_attrs(configuration_dims=configuration)
