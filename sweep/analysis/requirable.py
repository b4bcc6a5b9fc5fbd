"""What can be required of results: every output of a statistic that has an interval.

The names are those of `sweep.analysis.error_statistics` (all kinds of error), `efficiency` and
`covariance_trust`, and quantiles of the absolute errors along axes and about angles; they come from
the records there, so that a new statistic can be required, too.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import xarray as xr

from sweep.analysis.bound_ratios import RATIOS, BoundRatio, bound_arrays
from sweep.analysis.counts import CountOfDraws, Rate
from sweep.analysis.covariances import NEES_MEAN
from sweep.analysis.flip_mixture import FlipMixture
from sweep.analysis.means import Mean
from sweep.analysis.pose_view import DEPTH, ERROR_INPUTS, ESTIMATE_INPUTS, Poses, pose_arrays
from sweep.analysis.quantiles import PERCENTS, Quantiles
from sweep.analysis.quantities import QUANTITIES, SIGNED, Quantity
from sweep.analysis.registry import PoseStatistic, quantiles_of, registered
from sweep.analysis.statistic import Output, Statistic
from sweep.errors import DatasetError
from sweep.typing import Masks

EXACT_LEVEL = 0.95
"""Level of the intervals of rates and quantiles, whose ends hold whatever the distribution."""

MEAN_LEVEL = 0.99
"""Level of the intervals of means, root mean squares and standard deviations.

Their formulas are approximations: with 50 draws an end of 97.5 % is passed in 4.6 % (normal
errors) to 8.3 % (Laplace) of the samples, one of 99.5 % in 1.4 to 3.4 %.
"""

BOUND = "bound_std"
"""The variable that bounds are read from."""

MIN_DRAWS = 50
"""Draws from which on means are decided; where draws are Sobol' points, any number."""


@dataclass(frozen=True)
class Requirable:
    """An output that can be required.

    Attributes
    ----------
    output
        Its name, meaning and units.
    statistics
        The statistics that it is computed of, their variables' names beginning with a prefix.
    inputs
        Names of the arrays that they read, as in `sweep.analysis.pose_view.pose_arrays`.
    used
        The poses that count.
    exact
        Whether the interval holds whatever the distribution.
    largest
        The largest value that exists.
    signed
        Whether the value has a sign: its absolute value is required.
    numerator
        Of a ratio of a bound to an error, the name of the bound; else empty.
    """

    output: Output
    statistics: Callable[[str, float], Sequence[Statistic[Poses, Any, Any, Any]]]
    inputs: tuple[str, ...]
    used: Callable[[Poses], Masks]
    exact: bool
    largest: float
    signed: bool = False
    numerator: str = ""
    denominator: str = ""

    @property
    def name(self) -> str:
        """The output's name."""
        return self.output.name

    @property
    def units(self) -> str:
        """The output's units."""
        return self.output.units

    @property
    def is_rate(self) -> bool:
        """Whether it is a share of poses."""
        return self.exact and self.largest == 1.0

    @property
    def is_of_logarithm(self) -> bool:
        """Whether its interval is one of the logarithm: a spread's without a largest value."""
        parts = self.name.split("_")
        return ("sd" in parts or "rmse" in parts) and math.isinf(self.largest)

    @property
    def percent(self) -> int | None:
        """The percent of a quantile."""
        parts = self.name.split("_")
        return next((PERCENTS[part] for part in parts if part in PERCENTS), None) \
            if self.exact else None

    @property
    def variables(self) -> list[str]:
        """The dataset's variables that it is computed of."""
        return ["true_tvec_m" if name == DEPTH else name for name in self.inputs]

    @property
    def level(self) -> float:
        """Level of the interval by which one condition is decided."""
        return EXACT_LEVEL if self.exact else MEAN_LEVEL

    def computed(self, prefix: str, level: float) -> list[Statistic[Poses, Any, Any, Any]]:
        """Return the statistics, their variables' names beginning with a prefix."""
        return [*self.statistics(prefix, level), CountOfDraws(
            f"{prefix}used", "poses that count", self.used, f"{prefix}draws", f"{prefix}drawn")]

    def interval(
        self, table: xr.Dataset, prefix: str
    ) -> tuple[xr.DataArray, xr.DataArray, xr.DataArray]:
        """Return value, low and high from the table of `computed`."""
        if self.numerator:
            least, error = table[prefix + self.numerator], prefix + self.denominator
            return (least / table[error], least / table[f"{error}_high"],
                    least / table[f"{error}_low"])
        value, low, high = (table[f"{prefix}{self.name}{end}"] for end in ("", "_low", "_high"))
        if not self.signed:
            return value, low, high
        ends = abs(low), abs(high)
        nearest = ends[0].where(ends[0] <= ends[1], ends[1]).where(low * high > 0.0, 0.0)
        farthest = ends[0].where(ends[0] >= ends[1], ends[1])
        return abs(value), nearest.where(low.notnull()), farthest


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
    names = dict.fromkeys(name for each in required for name in each.inputs if name != BOUND)
    bounds = any(BOUND in each.inputs for each in required)
    return pose_arrays(results, [*ESTIMATE_INPUTS, *names]) | (
        bound_arrays(results) if bounds else {})


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
    records = [*registered(quantities), *map(quantiles_of, signed), NEES_MEAN]
    found = [each for record in records for each in _of_record(record, quantities)]
    found += [_of_ratio(ratio) for ratio in RATIOS]
    return {each.name: each for each in found}


def _of_record(record: PoseStatistic, quantities: Sequence[Quantity]) -> list[Requirable]:
    """Return what a record gives with an interval."""
    statistic = record.statistic
    outputs = {output.name: output for output in statistic.outputs()}
    quantity = next((each for each in quantities if any(
        name.startswith(f"{each.name}_") and name.endswith(f"_{each.unit}") for name in outputs)),
        None)
    used = statistic.flips.used if isinstance(statistic, FlipMixture) else (
        getattr(statistic, "used", None))
    if used is None:
        return []
    exact, largest = isinstance(statistic, Rate | Quantiles), math.inf
    if isinstance(statistic, Rate):
        largest = 1.0
    elif quantity is not None and quantity.bound is not None:
        largest = quantity.bound
    signed = type(statistic) is Mean
    return [Requirable(
        output, functools.partial(_renamed, statistic), record.inputs, used, exact, largest, signed)
        for name, output in outputs.items() if f"{name}_low" in outputs]


def _renamed(
    statistic: Statistic[Poses, Any, Any, Any], prefix: str, level: float
) -> list[Statistic[Poses, Any, Any, Any]]:
    """Return a statistic with another name and level; rates have Clopper and Pearson's interval."""
    if isinstance(statistic, Rate):
        return [dataclasses.replace(
            statistic, name=f"{prefix}{statistic.name}", level=level, exact=True)]
    if isinstance(statistic, Quantiles):
        return [dataclasses.replace(
            statistic, name=f"{prefix}{statistic.name}", level=level, with_reason=False)]
    if isinstance(statistic, FlipMixture | Mean):
        return [dataclasses.replace(statistic, name=f"{prefix}{statistic.name}", level=level)]
    raise TypeError(statistic)


def _of_ratio(ratio: BoundRatio) -> Requirable:
    bound, error = ratio.statistics()

    def statistics(prefix: str, level: float) -> list[Statistic[Poses, Any, Any, Any]]:
        return [*_renamed(bound, prefix, level), *_renamed(error, prefix, level)]

    return Requirable(
        ratio.output, statistics, (*ERROR_INPUTS, BOUND), error.used, exact=False, largest=math.inf,
        numerator=bound.name, denominator=error.name)
