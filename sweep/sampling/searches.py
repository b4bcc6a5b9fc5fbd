"""Searches: of limits along an axis, of a choice, and for a precision."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.analysis import requirements as decisions
from sweep.analysis.dataset import ERROR_INPUTS, ESTIMATE_INPUTS
from sweep.analysis.estimator import draws_to_see
from sweep.analysis.requirements import Decision, ErrorShares, Requirable, Requirement
from sweep.errors import PipelineError
from sweep.experiment.document import SEARCH
from sweep.experiment.grid import TRIAL, Block
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.sampling import CHOICES, MAX_TRIALS, StoppingRule
from sweep.experiment.schema import LABELS, VARIABLES
from sweep.sampling.rules import Stopping
from sweep.typing import Masks

# --------------------------------------------------------------------------------------------------
# The results of a group of scenes as a dataset, as the analysis reads them.

def group_dataset(
    pipeline: Pipeline, group: Block, values: Mapping[str, NDArray[Any]]
) -> xr.Dataset:
    """Return the results of a group of scenes as a dataset with coordinates of its axes.

    ``values`` are of variables, in their own dimensions. Other variables that every dataset of
    results has are NaN.
    """
    scene = [axis.name for axis in pipeline.experiment.scene_axes]
    parts = dict(zip(scene, zip(group.starts, group.stops, strict=True), strict=True))
    coordinates = {
        axis.name: (axis.name, axis.coordinates(*parts.get(axis.name, ())),
                    {"zip": " ".join(axis.columns)} if axis.zipped else {})
        for axis in pipeline.axes}
    sizes = {name: len(labels) for name, labels in LABELS.items()} | {
        name: len(listed) for name, (_, listed, _) in coordinates.items()}
    dims = {name: VARIABLES[name].dimensions(pipeline) for name in (*ERROR_INPUTS, *values)}
    return xr.Dataset({
        name: (own, values.get(name, np.broadcast_to(np.float32(np.nan), [
            sizes[dim] for dim in own]))) for name, own in dims.items()}, coordinates)


# --------------------------------------------------------------------------------------------------
# Where trials decide how far along an axis a requirement is met.
#
# Rates are not monotonic along an axis: they have dips. So all values have a coarse scan, and no
# value is judged by its neighbours. More trials are needed by
#
# - the values that are met as it seems, up to the last before the first that is decided not to
# be:
#   each must be decided, for a dip at any of them would be the limit;
# - values between these that seem to fail: isolated failures, or dips;
# - the next two beyond, at which it ends: with the first alone, a rate that is all but the limit
#   would leave open where it surely fails.
#
# What is decided needs no more, and what lies beyond the first value that is decided to fail says
# nothing of the limit.

#: Values beyond the last that is met, as it seems, that are decided.
BEYOND = 2


def wanted_values(keeps: Masks, met: Masks, not_met: Masks, judged: Masks) -> Masks:
    """Return the values (n,) along an axis, from easy to hard, at which trials decide its limit.

    Parameters
    ----------
    keeps
        Where the values of all requirements keep their limits.
    met, not_met
        Where that is decided.
    judged
        Where there is anything to judge.

    Examples
    --------
    Four that keep, the second undecided; the fifth fails and is undecided, the last surely fails:

    >>> keeps = np.array([1, 1, 1, 1, 0, 0, 0], bool)
    >>> met = np.array([1, 0, 1, 1, 0, 0, 0], bool)
    >>> not_met = np.array([0, 0, 0, 0, 0, 0, 1], bool)
    >>> wanted_values(keeps, met, not_met, np.ones(7, bool)).astype(int).tolist()
    [0, 1, 0, 0, 1, 1, 0]
    """
    at = np.flatnonzero(judged)
    keeps, met, not_met = keeps[at], met[at], not_met[at]
    index = np.arange(len(at))
    start = decisions.kept_from(keeps, np.ones(len(at), dtype=bool)) or 0
    ends = np.flatnonzero(not_met & (index >= start))
    end = ends[0] if len(ends) else len(at)
    last = np.flatnonzero(keeps & (index < end))
    before = np.flatnonzero(not_met & (index < start))
    first = max(start - BEYOND, before[-1] + 1 if len(before) else 0)
    inner = (index >= first) & (index < end) & (
        index <= (last[-1] if len(last) else start - 1) + BEYOND)
    wanted = np.zeros(len(judged), dtype=bool)
    wanted[at] = inner & ~met & ~not_met
    return wanted


# --------------------------------------------------------------------------------------------------
# A rule: what the results of earlier waves decide, and where more trials decide the rest.

def search_rule(pipeline: Pipeline, rule: StoppingRule) -> Stopping:
    """Return the rule of a pipeline's search.

    Raises
    ------
    PipelineError
        One line for each requirement that is none or cannot be judged within ``max_trials``, for
        those that contradict each other, and for each quantity whose interval cannot be as narrow.
    """
    scene = [axis.name for axis in pipeline.experiment.scene_axes]
    make = {"precision": _precision, "along": _limit}.get(rule.kind, _choice)
    quantities, open_cells = make(pipeline, rule)
    variables = [name for each in quantities for name in each.statistic.inputs]
    free = rule.among if rule.kind in CHOICES else rule.per

    def needed(group: Block, values: Mapping[str, NDArray[Any]]) -> Masks:
        dataset = group_dataset(pipeline, group, values)
        wanted = open_cells(dataset)  # over some axes of the scene, and of settings
        wanted = wanted.any([name for name in wanted.dims if name not in scene])
        pooled = {name: 1 if name == TRIAL else dataset.sizes[name]
                  for name in scene if name not in wanted.dims}
        if rule.along:
            wanted = wanted.sel({rule.along: dataset[rule.along]})
        return np.asarray(wanted.expand_dims(pooled).transpose(*scene).values)

    return Stopping(rule.ends, tuple(dict.fromkeys([*ESTIMATE_INPUTS, *variables])),
                    tuple(name for name in scene if name not in (*free, TRIAL)), needed)


#: The quantities that a search reads, and what tells the undecided cells of a dataset.
Search = tuple[list[Requirable], Callable[[xr.Dataset], xr.DataArray]]


def product_of(pipeline: Pipeline, names: Iterable[str]) -> int:
    """Return how many combinations the values of some axes have; other names are no axes."""
    return math.prod(len(axis) for axis in pipeline.axes if axis.name in {*names})


def pooled_cells(pipeline: Pipeline, rule: StoppingRule) -> int:
    """Return how many cells are pooled: those along axes that have no role in the search."""
    roles = {TRIAL, rule.along, *rule.among, *rule.per, *rule.at_all}
    return product_of(pipeline, {axis.name for axis in pipeline.experiment.scene_axes} - roles)


def _limit(pipeline: Pipeline, rule: StoppingRule) -> Search:
    """Return a search of the values of the axis at which trials decide the limit."""
    required = decisions.parse_requirements(rule.requirements)
    ends = [end * pooled_cells(pipeline, rule) for end in rule.ends]
    shares = decisions.search_shares(
        required, ends, product_of(pipeline, (rule.along, *rule.at_all)))
    cells = [rule.along, *rule.at_all, "requirement"]

    def open_cells(dataset: xr.Dataset) -> xr.DataArray:
        table = decisions.decide(
            dataset, required, (*rule.per, *rule.at_all, rule.along), shares=shares)
        table = table.sortby(rule.along)
        wanted: xr.DataArray = xr.apply_ufunc(
            functools.partial(_of_row, rule.along), table["decision"], table["keeps"],
            may_be_decided(table, required, ends[-1]), vectorize=True,
            input_core_dims=[cells] * 3, output_core_dims=[cells])
        return wanted

    return [each.what for each in required], open_cells


#: Standard errors of half an interval that decides, about.
WIDTH = 2.7


def may_be_decided(table: xr.Dataset, required: Sequence[Requirement], most: int) -> xr.DataArray:
    """Return where there are draws, and ``most`` of them may decide.

    Rates that are all but the limit need more: the interval must shrink to the distance from
    the limit, which is taken for a standard error larger than it seems. In simulated searches
    that saves a fifth of the poses, and the intervals stay as they were.
    """
    value, draws, limit = table["value"], table["draws"], table["limit"]
    width = (value - table["low"]).where(value >= limit, table["high"] - value)
    shrinks = width / (abs(value - limit) + width / WIDTH)
    of_rates = xr.DataArray([each.what.is_rate for each in required], dims="requirement")
    possible: xr.DataArray = (draws > 0) & ((draws * shrinks**2 <= most) | ~of_rates)
    return possible


def _of_row(
    along: str, decision: NDArray[np.uint8], keeps: Masks, possible: Masks
) -> Masks:
    """Return which decisions (values, *at_all, requirement) along an axis need trials."""
    step = slice(None, None, 1 if decisions.is_harder_upwards(along, keeps) else -1)
    value, value_keeps = decisions.of_values(decision, keeps)
    wanted = wanted_values(
        value_keeps[step], value[step] == Decision.met, value[step] == Decision.not_met,
        value[step] != Decision.not_applicable)[step]
    wanted, all_keep = (np.expand_dims(each, tuple(range(1, decision.ndim)))
                        for each in (wanted, value_keeps))
    # Where something fails, it is that which decides.
    return np.asarray(
        (decision == Decision.undecided) & possible & wanted & (all_keep | ~keeps))


def choice_shares(pipeline: Pipeline, rule: StoppingRule) -> list[ErrorShares]:
    """Return the shares of the error probability that each decision of a choice may spend."""
    return decisions.search_shares(
        decisions.parse_requirements(rule.requirements),
        [end * pooled_cells(pipeline, rule) for end in rule.ends],
        product_of(pipeline, (rule.along, *rule.at_all)), product_of(pipeline, rule.among))


def least_draws(requirement: Requirement, share: float) -> int:
    """Return the draws below which a requirement cannot be decided as met.

    Of a rate, with no failure Clopper and Pearson's end is the tail's n-th root; a quantile needs
    an order statistic beyond; means are not decided below `MIN_DRAWS`.

    Examples
    --------
    >>> least_draws(decisions.parse_requirements("detection >= 0.99")[0], 1.0)
    368
    """
    if not requirement.what.exact:
        return decisions.MIN_DRAWS
    rare = requirement.rare
    return draws_to_see(rare, requirement.what.level(share)) if 0.0 < rare < 1.0 else 1


def _choice(pipeline: Pipeline, rule: StoppingRule) -> Search:
    """Return a search of the cells that decide the smallest, or the cheapest, choice."""
    shares = choice_shares(pipeline, rule)
    required = decisions.parse_requirements(rule.requirements)
    _check_trials(pipeline, rule, [
        (least_draws(each, share.met), (
            f"fewer cannot show {each.text} with {100 * decisions.CONFIDENCE:g} % confidence, "
            "even if all meet it"))
        for each, share in zip(required, shares, strict=True)])
    return [each.what for each in required], lambda dataset: decisions.choice_needed(
        decisions.choice_table(dataset, rule, shares), rule)


# A condition is judged by the intervals that the analysis shows of it. It is settled when every
# quantity of every configuration has an interval as narrow as is wanted, or cannot have one: no
# pose was looked for, or so few have the number that all trials would not give enough
# (`sweep.analysis.requirements.Reached`).

def _precision(pipeline: Pipeline, rule: StoppingRule) -> Search:
    """Return a search of the conditions at which an interval is wider than was wanted."""
    widths = dict(rule.precision)
    wanted, _ = decisions.wanted_precisions(widths)
    _check_trials(pipeline, rule, [
        (each.fewest_draws, (f"with fewer no interval of {each.what.name} has a half-width of "
                             f"{each.half_width:g}")) for each in wanted])
    return [each.what for each in wanted], lambda dataset: ~decisions.precision_reached(
        dataset, widths, rule.per, rule.max_trials)["settled"]


def _check_trials(
    pipeline: Pipeline, rule: StoppingRule, needed: Iterable[tuple[int, str]]
) -> None:
    """Raise PipelineError if ``max_trials`` are fewer than needed draws, each with the reason."""
    pooled = pooled_cells(pipeline, rule)
    lines = [f"{pipeline.source}: {SEARCH}.{MAX_TRIALS} = {rule.max_trials}: expected at least "
             f"{least:,}: {why}" for draws, why in needed
             if (least := math.ceil(draws / pooled)) > rule.max_trials]
    if lines:
        raise PipelineError(lines)
