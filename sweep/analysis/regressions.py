"""Whether a new store's results are significantly worse than an older one's, pose by pose."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis.comparisons import paired_table
from sweep.analysis.dimensions import as_names, configuration_axes, kept_dimensions
from sweep.analysis.intervals import LEVEL
from sweep.analysis.quantities import QUANTITIES, SIGNED, Quantity
from sweep.errors import DatasetError

MARGIN = 0.01
"""Part of the older store's mean absolute error by which errors may grow: less is no regression.

Another version of a library changes last digits of all poses in one direction: that is
significant, and of no account.
"""


@dataclass(frozen=True)
class Regression:
    """A comparison at one configuration: the condition at which it is worst.

    Attributes
    ----------
    quantity
        "detection_rate", or a kind of error: the mean of its absolute value.
    configuration, condition
        Values by axis.
    difference, low, high
        New minus old with its interval, at a level for all comparisons together (Bonferroni).
    units
        Of these.
    worse
        Whether it is significantly worse at any condition.
    """

    quantity: str
    configuration: Mapping[str, Any]
    condition: Mapping[str, Any]
    difference: float
    low: float
    high: float
    units: str
    worse: bool


def regressions(
    old: xr.Dataset, new: xr.Dataset, variables: Iterable[str] = (), per: Sequence[str] = (),
) -> list[Regression]:
    """Return how the detection rate and the errors that ``variables`` are of have changed.

    Parameters
    ----------
    old, new
        Two stores over the same scenes and configurations, with the same seed.
    variables
        Names of what is required; without any, rotation and range are compared.
    per
        Axes whose values are conditions; others of the scene are pooled.

    Returns
    -------
    list of Regression
        The detection rate and each kind of error, for each configuration the worst condition.
        The rate is worse if McNemar's exact test says so. An error is, if the lower end of the
        interval of its paired mean difference, on the poses that both solved, lies above `MARGIN`
        of the old mean. False "worse" of any has a probability below 0.05.

    Raises
    ------
    ArgumentError, DatasetError
        As in `sweep.analysis.compare`.
    """
    known = [*QUANTITIES, *(each for group in SIGNED.values() for each in group)]
    quantities = [each for each in known if any(
        name.startswith(f"{each.name}_") and name.endswith(f"_{each.unit}") for name in variables)]
    quantities = quantities or list(QUANTITIES[:2])
    configuration = configuration_axes(new)
    kept = kept_dimensions(new, tuple(dict.fromkeys((*configuration, *as_names(per)))))
    count = math.prod(new.sizes[name] for name in kept) * (1 + len(quantities))
    level = 1.0 - (1.0 - LEVEL) / count
    table = paired_table(old, new, kept, None, quantities, level).compute()
    if int(table["different_scenes"].sum()):
        raise DatasetError("the scenes of the two stores differ, so that nothing can be paired; "
                           "compare stores of one pipeline")
    tests = [_rate_test(table, 1.0 - level), *(_error_test(table, each) for each in quantities)]
    return [found for test in tests for found in _worst(test, configuration)]


def _rate_test(table: xr.Dataset, error: float) -> xr.Dataset:
    """Return difference, low, high and worse of the detection rate."""
    difference = table["detection_difference"]
    return xr.Dataset({
        "difference": difference, "low": table["detection_difference_low"],
        "high": table["detection_difference_high"],
        "worse": (difference < 0.0) & (table["detection_p_value"] <= error),
        "excess": -difference,
    }).assign_attrs(quantity="detection_rate", units="")


def _error_test(table: xr.Dataset, quantity: Quantity) -> xr.Dataset:
    name = quantity.named("difference")
    return xr.Dataset({
        "difference": table[name], "low": table[f"{name}_low"], "high": table[f"{name}_high"],
        "worse": table[f"{name}_low"] > MARGIN * table[quantity.named("first")],
        "excess": table[name],
    }).assign_attrs(quantity=f"mean absolute {quantity.words}", units=quantity.units)


def _worst(test: xr.Dataset, configuration: Sequence[str]) -> Iterator[Regression]:
    conditions = [str(dim) for dim in test["worse"].dims if dim not in configuration]
    for at in np.ndindex(*(test.sizes[name] for name in configuration)):
        one = test.isel(dict(zip(configuration, at, strict=True))).transpose(*conditions)
        worse = one["worse"].values
        excess = np.nan_to_num(one["excess"].values, nan=-np.inf)
        excess = np.where(worse, excess, -np.inf) if worse.any() else excess
        index = np.unravel_index(int(np.argmax(excess)), excess.shape)
        cell = one.isel({name: int(k) for name, k in zip(conditions, index, strict=True)})
        yield Regression(
            test.attrs["quantity"], {name: one[name].item() for name in configuration},
            {name: cell[name].item() for name in conditions},
            float(cell["difference"]), float(cell["low"]), float(cell["high"]),
            test.attrs["units"], bool(worse.any()))
