"""How well each condition of a store is known, against the precision that was wanted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis.aggregate import aggregate
from sweep.analysis.counts import Count
from sweep.analysis.described import describes
from sweep.analysis.dimensions import (
    as_names,
    configuration_axes,
    kept_dimensions,
    stored_pipeline,
)
from sweep.analysis.half_widths import (
    Reached,
    WantedPrecision,
    looked_for_and_run,
    wanted_precisions,
)
from sweep.analysis.pose_view import Poses
from sweep.analysis.requirable import requirable_arrays
from sweep.errors import ArgumentError, SweepError
from sweep.plan.precision_rule import PrecisionRule
from sweep.plan.variable import cf_attributes


@describes
def precision_reached(
    results: xr.Dataset, wanted: Mapping[str, float] | None = None,
    per: Sequence[str] | None = None,
) -> xr.Dataset:
    """Return how well each condition is known, against the precision that was wanted.

    Parameters
    ----------
    results
        The dataset of a run.
    wanted
        Half-widths of intervals by the name of the quantity, such as ``{"detection_rate": 0.02}``:
        of rates as they are, of a bias relative to the root mean square error, of all else
        relative to the value. By default those of the pipeline's [precision].
    per
        Dimensions whose values are conditions; by default those of the pipeline's [precision].
        Detector and estimator are always kept.

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
    squares and standard deviations (`sweep.analysis.stopped_sampling`), also of a store whose
    sampling was not stopped.

    Examples
    --------
    >>> table = precision_reached(results, {"detection_rate": 0.3}, per=["side_px"])
    >>> [Reached(flag).name for flag in table["reached"].isel(solver=0, quantity=0).values]
    ['reached', 'not_reached', 'reached']
    """
    rule = _rule_of(results)
    if wanted is None:
        if rule is None:
            raise ArgumentError("wanted", None, "this store's pipeline has no [precision]; give "
                                'half-widths, such as {"detection_rate": 0.02}')
        wanted = dict(rule.wanted)
    if per is None:
        per = rule.per if rule is not None else ()
    try:
        precisions = wanted_precisions(wanted)
    except ValueError as error:
        raise ArgumentError("wanted", wanted, str(error)) from None
    names = dict.fromkeys((*configuration_axes(results), *as_names(per)))
    kept = kept_dimensions(results, tuple(names))
    statistics = [
        *looked_for_and_run(),
        Count("poses", "poses that all trials are", lambda poses: np.ones_like(poses.run)),
        *(each for number, precision in enumerate(precisions)
          for each in precision.statistics(f"{number} ")),
    ]
    inputs = requirable_arrays(results, [each.requirable for each in precisions])
    table = aggregate(results, inputs, kept, statistics, Poses, stopped=True).compute()
    return _table(table, precisions, kept, [
        name for name in configuration_axes(results) if name in kept])


def _rule_of(results: xr.Dataset) -> PrecisionRule | None:
    try:
        rule = stored_pipeline(results).stopping
    except (KeyError, SweepError):
        return None
    return rule if isinstance(rule, PrecisionRule) else None


def _table(
    table: xr.Dataset, precisions: Sequence[WantedPrecision], kept: Sequence[str],
    configuration: Sequence[str],
) -> xr.Dataset:
    run, poses = (table[name].transpose(*kept) for name in ("run", "poses"))
    judged: dict[str, list[Any]] = {
        name: [] for name in ("value", "half_width", "reached", "used", "draws")}
    variables = {str(name): each.transpose(*kept).values for name, each in table.items()}
    for number, precision in enumerate(precisions):
        found = precision.judge(
            variables, f"{number} ", variables["looked_for"], variables["run"], variables["poses"])
        counts = (variables[f"{number} used"], variables[f"{number} draws"])
        for name, each in zip(judged, (*found, *counts), strict=True):
            judged[name].append(each)
    dims = (*kept, "quantity")
    words = {
        "value": "value", "half_width": "half-width of the interval, as was wanted",
        "used": "poses that the value is of", "draws": "random draws that these are worth",
    }
    out = {name: xr.DataArray(np.stack(judged[name], axis=-1), dims=dims).assign_attrs(
        cf_attributes(meaning, "1" if name in ("used", "draws") else ""))
        for name, meaning in words.items()}
    out["reached"] = xr.DataArray(np.stack(judged["reached"], axis=-1), dims=dims).assign_attrs(
        cf_attributes("whether the interval is as narrow as was wanted", flags=Reached))
    needs = out["reached"].isin((Reached.not_run, Reached.not_reached))
    out["settled"] = (~needs.any([*configuration, "quantity"])).assign_attrs(
        cf_attributes("whether no configuration and quantity needs more trials", "1"))
    out |= {"run": run, "poses": poses}
    coordinates = {name: each for name, each in table.coords.items() if set(each.dims) <= {*kept}}
    return xr.Dataset(out, coordinates).assign_coords(
        quantity=("quantity", [each.name for each in precisions]),
        wanted=("quantity", [each.half_width for each in precisions]),
        relative_to=("quantity", [each.relative_to for each in precisions]),
    ).assign_attrs(configuration_dims=list(configuration))
