"""How well quantities are known, against the precision that was asked for."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from sweep.analysis.aggregate import aggregate
from sweep.analysis.counts import Count
from sweep.analysis.dataset import (
    DRAWS,
    as_names,
    configuration_axes,
    describes,
    kept_dimensions,
    stacked,
    stopping_rule,
)
from sweep.analysis.draws import stopped_level
from sweep.analysis.intervals import LEVEL, clopper_pearson
from sweep.analysis.poses import Poses
from sweep.analysis.quantiles import draws_of_quantile
from sweep.analysis.rates import LOOKED_FOR
from sweep.analysis.requirements import Requirable, named, requirable_arrays, requirables
from sweep.analysis.statistic import INTERVAL, Statistic
from sweep.errors import ArgumentError
from sweep.experiment.schema import cf_attributes
from sweep.measure.flags import Flag, flag

# --------------------------------------------------------------------------------------------------
# Half-widths of intervals, by which sampling stops, and whether they are as small as is wanted.
#
# Of rates they are as they are, of a bias relative to the root mean square error, of all else
# relative to the value. The intervals are those that the analysis shows of a store whose sampling
# was stopped (`sweep.analysis.draws`).

PoseStatistic = Statistic[Poses]

MIN_DRAWS = 450
"""Draws below which no interval of a mean or a root mean square is narrow enough.

Their formulas need draws to tell how the errors spread: the interval of a lucky start is narrow.
"""

MIN_OF_RATE = 50
"""Poses that count below which a rate is not worth waiting for."""

NEVER_LEVEL = 0.999
"""Level of the interval that says that too few numbers will come."""


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
    requirable
        The quantity.
    half_width
        As the module says; above 0, below 1.
    """

    requirable: Requirable
    half_width: float

    @property
    def name(self) -> str:
        """Name of the quantity."""
        return self.requirable.name

    @property
    def relative_to(self) -> str:
        """What the half-width is a share of; empty for a rate."""
        if self.requirable.is_rate:
            return ""
        return "RMSE" if self._spread else "value"

    @property
    def _spread(self) -> str:
        """Of a bias the name of the standard deviation; else empty."""
        name = self.name.replace("_bias_", "_sd_")
        return name if name != self.name and name in requirables() else ""

    def statistics(self, prefix: str) -> list[PoseStatistic]:
        """Return what must be computed, the names of their variables beginning with a prefix.

        Their intervals are to be those of `sweep.analysis.draws.as_stopped`.
        """
        parts = list(self.requirable.computed(prefix, LEVEL))
        if self._spread:
            parts.append(requirables()[self._spread].renamed(f"{prefix}of ", LEVEL))
        return parts

    @property
    def variables(self) -> tuple[str, ...]:
        """The dataset's variables that it is computed of."""
        return tuple(dict.fromkeys(self.requirable.variables))

    @property
    def least_draws(self) -> int:
        """Draws with a number below which it is useless to go on.

        It does not depend on the half-width, so that a smaller one never needs fewer trials.
        """
        if self.requirable.is_rate:
            return MIN_OF_RATE
        if (percent := self.requirable.percent) is None:
            return MIN_DRAWS
        return draws_of_quantile(percent, stopped_level(LEVEL))

    @property
    def fewest_draws(self) -> int:
        """Draws below which no interval is narrow enough, whatever the results are."""
        if not self.requirable.is_rate:
            return self.least_draws
        if self.half_width >= 0.5:
            return 1
        # Without a success, Clopper and Pearson's end is 1 - tail^(1/n).
        tail = (1.0 - stopped_level(LEVEL)) / 2.0
        return math.ceil(math.log(tail) / math.log(1.0 - 2.0 * self.half_width))

    def judged(self, table: xr.Dataset, prefix: str, total: xr.DataArray) -> xr.Dataset:
        """Return value, half-width, a flag of `Reached`, and the poses and draws that it is of.

        Parameters
        ----------
        table
            The variables of `statistics`; ``looked_for`` and ``run``: poses that were.
        prefix
            As there.
        total
            Poses that all trials would be.
        """
        what = self.requirable
        ends = [table[f"{prefix}{self.name}{end}"] for end in INTERVAL]
        # Of a bias with its sign.
        value, low, high = ends if what.signed else what.interval(table, prefix)
        used, draws = table[f"{prefix}used"], table[f"{prefix}draws"]
        with np.errstate(all="ignore"):
            half = (high - low) / 2.0
            if not what.is_rate:
                scale = abs(value)
                if self._spread:
                    scale = xr.apply_ufunc(
                        np.hypot, value, table[f"{prefix}of {self._spread}"])
                half = (half / scale).where(half != 0.0, 0.0)
        # Too many poses are lost for a quantile: it is infinite, which is all there is to know.
        half = half.where(low != np.inf, 0.0)
        narrow = (half <= self.half_width) & (draws >= (1 if what.exact else MIN_DRAWS))
        reached = xr.full_like(used, Reached.not_reached)
        for where, flag_ in (
            (self._too_rare(used, draws, table["run"], total), Reached.too_rare),
            (narrow, Reached.reached), (table["looked_for"] == 0, Reached.not_applicable),
            (table["run"] == 0, Reached.not_run),
        ):
            reached = reached.where(~where, flag_)
        return xr.Dataset({"value": value, "half_width": half, "reached": reached.astype(np.uint8),
                           "used": used, "draws": draws})

    def _too_rare(
        self, used: xr.DataArray, draws: xr.DataArray, run: xr.DataArray, total: xr.DataArray
    ) -> xr.DataArray:
        """Return where even all trials give fewer draws with a number than `least_draws`.

        By the upper end of the share of poses that have one; ``used`` poses are worth ``draws``.
        """
        share = used.copy(data=clopper_pearson(used, np.maximum(run, used), NEVER_LEVEL)[1])
        worth = (draws / np.maximum(used, 1)).where(used > 0, 1.0)
        return (share * total * worth < self.least_draws) & (total >= self.least_draws)


def wanted_precisions(wanted: Mapping[str, float]) -> tuple[WantedPrecision, ...]:
    """Return what some names and half-widths want.

    Names are those of requirements (`sweep.analysis.requirements.parse_requirements`).

    Raises
    ------
    ValueError
        One line for each name that does not exist, each half-width that cannot be, and each
        quantity that is named twice.

    Examples
    --------
    >>> [(each.name, each.half_width) for each in wanted_precisions({"detection": 0.02})]
    [('detection_rate', 0.02)]
    """
    precisions: dict[str, WantedPrecision] = {}
    faults = []
    for name, half_width in wanted.items():
        try:
            what = named(name)
        except ValueError as error:
            text = str(error)
            faults.append(text if text.startswith(f"{name}:") else f"{name}: {text}")
            continue
        if not 0.0 < half_width < 1.0:
            faults.append(f"{name}: expected the half-width of an interval, above 0 and below 1")
        elif what.name in precisions:
            faults.append(f"{name}: {what.name} has another half-width; delete one")
        else:
            precisions[what.name] = WantedPrecision(what, float(half_width))
    if faults:
        raise ValueError("\n".join(faults))
    return tuple(precisions.values())


# --------------------------------------------------------------------------------------------------
# How well each condition of a store is known, against the precision that was wanted.

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
        relative to the value. By default those of the pipeline's [search].
    per
        Dimensions whose values are conditions; by default those of the pipeline's [search].
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
    squares and standard deviations (`sweep.analysis.draws`), also of a store whose
    sampling was not stopped.

    Examples
    --------
    >>> table = precision_reached(results, {"detection_rate": 0.3}, per=["side_px"])
    >>> [Reached(flag).name for flag in table["reached"].isel(solver=0, quantity=0).values]
    ['reached', 'not_reached', 'reached']
    """
    rule = stopping_rule(results)
    if wanted is None:
        if rule is None or not rule.precision:
            raise ArgumentError("wanted", None, "this store's pipeline searches no precision; "
                                'give half-widths, such as {"detection_rate": 0.02}')
        wanted = dict(rule.precision)
    if per is None:
        per = rule.per if rule is not None and rule.precision else ()
    try:
        precisions = wanted_precisions(wanted)
    except ValueError as error:
        raise ArgumentError("wanted", wanted, str(error)) from None
    return precision_table(results, precisions, as_names(per))


def precision_table(
    results: xr.Dataset, precisions: Sequence[WantedPrecision], per: Sequence[str],
    trials: int | None = None,
) -> xr.Dataset:
    """Return the table of `precision_reached`.

    ``trials`` are the most that there may be; by default as many as there are.
    """
    configuration = configuration_axes(results)
    kept = kept_dimensions(results, tuple(dict.fromkeys((*configuration, *per))))
    configuration = [name for name in configuration if name in kept]
    statistics = [
        Count(*LOOKED_FOR, lambda poses: poses.looked_for),
        Count("run", "poses that were run", lambda poses: poses.run),
        Count("poses", "poses that all trials are", lambda poses: np.ones_like(poses.run)),
        *(each for number, precision in enumerate(precisions)
          for each in precision.statistics(f"{number} ")),
    ]
    inputs = requirable_arrays(results, [each.requirable for each in precisions])
    table = aggregate(results, inputs, kept, statistics, Poses, stopped=True)
    total = table["poses"]
    if trials is not None:
        total = total // results.sizes[DRAWS] * trials
    judged = [each.judged(table, f"{number} ", total) for number, each in enumerate(precisions)]
    out = {str(name): stacked([each[name] for each in judged], "quantity").reset_coords(drop=True)
           for name in judged[0]}
    for name, meaning, units in (
        ("value", "value", ""), ("half_width", "half-width of the interval, as was wanted", ""),
        ("used", "poses that the value is of", "1"),
        ("draws", "random draws that these are worth", "1"),
    ):
        out[name].attrs = cf_attributes(meaning, units)
    out["reached"].attrs = cf_attributes(
        "whether the interval is as narrow as was wanted", flags=Reached)
    needs = out["reached"].isin((Reached.not_run, Reached.not_reached))
    out["settled"] = (~needs.any([*configuration, "quantity"])).assign_attrs(
        cf_attributes("whether no configuration and quantity needs more trials", "1"))
    out |= {"run": table["run"], "poses": table["poses"]}
    coordinates = {name: each for name, each in table.coords.items() if set(each.dims) <= {*kept}}
    return xr.Dataset(out, coordinates).assign_coords(
        quantity=("quantity", [each.name for each in precisions]),
        wanted=("quantity", [each.half_width for each in precisions]),
        relative_to=("quantity", [each.relative_to for each in precisions]),
    ).assign_attrs(configuration_dims=list(configuration))
