"""How well quantities are known, against the precision that was asked for."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import xarray as xr

from sweep.analysis.aggregate import aggregate
from sweep.analysis.counts import Count, CountOfDraws
from sweep.analysis.dataset import (
    DRAWS,
    as_names,
    configuration_axes,
    describes,
    kept_dimensions,
    stored_pipeline,
)
from sweep.analysis.draws import stopped_level
from sweep.analysis.intervals import LEVEL, clopper_pearson
from sweep.analysis.poses import Poses
from sweep.analysis.quantiles import interval_ranks
from sweep.analysis.requirements import Requirable, named, requirable_arrays, requirables
from sweep.analysis.statistic import Statistic
from sweep.errors import ArgumentError, SweepError
from sweep.measure.flags import Flag, flag
from sweep.plan.sampling import PrecisionRule
from sweep.plan.schema import cf_attributes
from sweep.typing import Floats, Masks

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

    @functools.cached_property
    def least_draws(self) -> int:
        """Draws with a number below which it is useless to go on.

        It does not depend on the half-width, so that a smaller one never needs fewer trials.
        """
        if self.requirable.is_rate:
            return MIN_OF_RATE
        if (percent := self.requirable.percent) is None:
            return MIN_DRAWS
        n = 1
        while not _has_ends(n, percent, stopped_level(LEVEL)):
            n += 1
        return n

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

    def judge(
        self, table: Mapping[str, Any], prefix: str, looked_for: Any, run: Any, total: Any
    ) -> tuple[Any, Any, Any]:
        """Return the value, its half-width and a flag of `Reached`, each (...).

        Parameters
        ----------
        table
            The variables of `statistics`, each (...).
        prefix
            As there.
        looked_for, run, total
            Poses that were looked for, that were run, and that all trials would be, each (...).
        """
        value, low, high = (np.asarray(each, dtype=np.float64)
                            for each in self._interval(table, prefix))
        with np.errstate(all="ignore"):
            half = (high - low) / 2.0
            if self._spread:
                spread = np.asarray(table[f"{prefix}of {self._spread}"], dtype=np.float64)
                half = np.where(half == 0.0, 0.0, half / np.hypot(value, spread))
            elif not self.requirable.is_rate:
                half = np.where(half == 0.0, 0.0, half / np.abs(value))
        # Too many poses are lost for a quantile: it is infinite, which is all there is to know.
        half = np.where(np.isposinf(low), 0.0, half)
        draws, used = (np.asarray(table[f"{prefix}{name}"]) for name in ("draws", "used"))
        enough = draws >= (1 if self.requirable.exact else MIN_DRAWS)
        narrow = (half <= self.half_width) & enough
        rare = ~narrow & self._too_rare(draws, used, np.asarray(run), np.asarray(total))
        flags = np.select(
            [np.asarray(run) == 0, np.asarray(looked_for) == 0, narrow, rare],
            [Reached.not_run, Reached.not_applicable, Reached.reached, Reached.too_rare],
            Reached.not_reached)
        return value, half, flags.astype(np.uint8)

    def _interval(self, table: Mapping[str, Any], prefix: str) -> Sequence[Any]:
        """Return value, low and high; of a bias with its sign."""
        if self.requirable.signed:
            return [table[f"{prefix}{self.name}{end}"] for end in ("", "_low", "_high")]
        return self.requirable.interval(cast("Any", table), prefix)

    def _too_rare(self, draws: Any, used: Any, run: Any, total: Any) -> Masks:
        """Return where even all trials give fewer draws with a number than `least_draws`.

        By the upper end of the share of poses that have one; ``used`` poses are worth ``draws``.
        """
        run = np.maximum(run, used)
        share: Floats = clopper_pearson(used, run, NEVER_LEVEL)[1]
        worth = np.where(used > 0, draws / np.maximum(used, 1), 1.0)
        return np.asarray((share * total * worth < self.least_draws) & (total >= self.least_draws))


def _has_ends(n: int, percent: int, level: float) -> bool:
    low, high = interval_ranks(n, percent, level)
    return low >= 1 and high <= n


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


def looked_for_and_run() -> list[PoseStatistic]:
    """Return what counts the poses that were looked for, and those that were run."""
    return [
        CountOfDraws("looked_for", "poses that were run, visible and modelled",
                     lambda poses: poses.looked_for, "draws", "drawn"),
        CountOfDraws("run", "poses that were run", lambda poses: poses.run, "run draws",
                     "run drawn"),
    ]


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
    squares and standard deviations (`sweep.analysis.draws`), also of a store whose
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
    return precision_table(results, precisions, as_names(per))


def _rule_of(results: xr.Dataset) -> PrecisionRule | None:
    try:
        rule = stored_pipeline(results).stopping
    except (KeyError, SweepError):
        return None
    return rule if isinstance(rule, PrecisionRule) else None


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
        *looked_for_and_run(),
        Count("poses", "poses that all trials are", lambda poses: np.ones_like(poses.run)),
        *(each for number, precision in enumerate(precisions)
          for each in precision.statistics(f"{number} ")),
    ]
    inputs = requirable_arrays(results, [each.requirable for each in precisions])
    table = aggregate(results, inputs, kept, statistics, Poses, stopped=True)
    run, poses = (table[name].transpose(*kept) for name in ("run", "poses"))
    judged: dict[str, list[Any]] = {
        name: [] for name in ("value", "half_width", "reached", "used", "draws")}
    variables = {str(name): each.transpose(*kept).values for name, each in table.items()}
    total = variables["poses"]
    if trials is not None:
        total = total // results.sizes[DRAWS] * trials
    for number, precision in enumerate(precisions):
        found = precision.judge(
            variables, f"{number} ", variables["looked_for"], variables["run"], total)
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
