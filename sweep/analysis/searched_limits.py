"""Limits that a search decided: how far along an axis requirements are met, per condition."""

from __future__ import annotations

import math
from collections.abc import Sequence

import xarray as xr

from sweep.analysis.described import describes
from sweep.analysis.dimensions import (
    DRAWS,
    as_names,
    axes_of,
    configuration_axes,
    stored_pipeline,
)
from sweep.analysis.farthest import farthest_met
from sweep.analysis.repeated_looks import looks_factor
from sweep.analysis.requirements import ErrorShares
from sweep.analysis.stopped_sampling import computed_scenes
from sweep.errors import ArgumentError, SweepError
from sweep.plan.limit_rule import LimitRule


def error_shares(decisions: int, times: int) -> ErrorShares:
    """Return the shares of the error probability of each decision of a search.

    Parameters
    ----------
    decisions
        How many are made for one limit: a false "not met" of any shortens it.
    times
        How often each is made.
    """
    factor = looks_factor(times)
    return ErrorShares(met=1.0 / factor, not_met=1.0 / (factor * decisions))


@describes
def requirement_limits(
    results: xr.Dataset, require: Sequence[str] = (), along: str = "",
    per: Sequence[str] | None = None, at_all: Sequence[str] | None = None,
) -> xr.Dataset:
    """Return how far along an axis requirements are met, for each condition by itself.

    Parameters
    ----------
    results
        The dataset of a run, of `sweep.limit` or with equally many trials everywhere.
    require, along, per, at_all
        As `sweep.limit` takes them; by default those that the run was made for.

    Returns
    -------
    xr.Dataset
        As `sweep.analysis.farthest_met`, dimensions (*configuration, *per), whose interval
        ``low`` to ``high`` covers the limit of each condition with 95 %, however often it was
        decided anew. Also

        - ``settled``: whether the interval is a single value of the grid.
        - ``trials`` (*per, along): the most that a cell has there; ``poses`` (*per): how many
          scenes were computed for the condition, with those of all values.

    Raises
    ------
    ArgumentError, DatasetError
        As in `sweep.analysis.farthest_met`; also if nothing says what is searched.

    Notes
    -----
    Requirements must hold at all values of ``at_all`` and are judged at each value along the axis
    after each wave: an end of the interval is wrong with 0.025 at most, of all these decisions
    together (Bonferroni over values and requirements; `looks_factor` over waves).

    Examples
    --------
    >>> limit = requirement_limits(results, ["detection >= 0.6"], "side_px").sel(solver="ippe")
    >>> limit["value"].item(), limit["low"].item(), limit["high"].item()
    (20.0, 20.0, 40.0)
    """
    rule = _searched(results)
    require = [require] if isinstance(require, str) and require else require
    if not require or not along:
        if rule is None:
            raise ArgumentError("require" if not require else "along", along,
                                "this store was not made by sweep limit, so that nothing says it")
        require, along = require or rule.require, along or rule.along
    if rule is not None and along == rule.along:
        per = rule.per if per is None else per
        at_all = rule.at_all if at_all is None else at_all
    scene = [name for name in axes_of(results) if name not in configuration_axes(results)]
    at_all = [name for name in as_names(at_all or ()) if name != along]
    if per is None:
        per = [name for name in scene if name not in (DRAWS, along, *at_all)]
    per = as_names(per)
    count = len([*require]) * math.prod(results.sizes.get(name, 1) for name in (along, *at_all))
    found = farthest_met(
        results, require, along, per, at_all, error_shares(count, len(rule.ends) if rule else 1))
    found["settled"] = (found["low"] == found["high"]).assign_attrs(
        long_name="whether the interval is a single value of the grid", units="1")
    computed = computed_scenes(results)
    cells = [name for name in computed.dims if name not in (*per, along)]
    found["trials"] = computed.sum(DRAWS).max(
        [name for name in cells if name != DRAWS]).compute().assign_attrs(
        long_name="trials of a cell, the most at this value", units="1")
    found["poses"] = computed.sum([*cells, along]).compute().assign_attrs(
        long_name="scenes that were computed, of all values", units="1")
    return found.assign_attrs(per=[*per], at_all=at_all, require=[*require])


def _searched(results: xr.Dataset) -> LimitRule | None:
    """Return the search that a dataset is of; None if it is of none."""
    try:
        rule = stored_pipeline(results).stopping
    except (KeyError, SweepError):
        return None
    return rule if isinstance(rule, LimitRule) else None
