"""Stores whose sampling stopped when their intervals were narrow enough, or a decision was sure.

*Intervals.* Who looks at an interval again and again and stops when it is narrow finds it narrow by
chance, too: it then covers less than its level. So all intervals of such a store have smaller
tails, by `TAIL_SHARE` (root mean squares and standard deviations, whose intervals are
approximations: `SPREAD_TAIL_SHARE`), and those of rates are Clopper and Pearson's. By exact
enumeration (`sweep.sampling.stopped_rate`) those of rates then cover 95 % at least, whatever the
rate; the others by simulation (`tests/sampling/test_stopped_coverage.py`).

*Pooling.* Conditions that are hard to judge have more trials. A rate over conditions that counts
all of them would be one of mostly hard ones. So what is pooled is pooled over the trials that all
pooled cells have: each counts as it does in a store of equally many trials. Cells in which no pose
was looked for have nothing to count, and do not lessen these trials.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
import xarray as xr

from sweep.analysis.counts import Rate
from sweep.analysis.dimensions import (
    DRAWS,
    axes_of,
    configuration_axes,
    is_sampling_stopped,
)
from sweep.analysis.flip_mixture import FlipMixture
from sweep.analysis.means import RootMeanSquare
from sweep.analysis.pose_view import NOT_LOOKED_FOR
from sweep.analysis.statistic import Statistic, ViewT
from sweep.measure.flags import DetectionStatus
from sweep.plan.parameters import Stage
from sweep.plan.schema import VARIABLES

TAIL_SHARE = 0.6
"""Tails of intervals of stores whose sampling was stopped, of those that they would have.

The interval of 95 % is one of 97 %. The least coverage of a rate, over all rates, half-widths from
0.005 to 0.25, waves of 5 to 99 draws at first and any largest number of trials, is then 0.954.
"""

SPREAD_TAIL_SHARE = 0.4
"""The same of root mean squares and standard deviations: the interval of 95 % is one of 98 %."""

NOT_AVAILABLE = (DetectionStatus.not_run, DetectionStatus.not_needed)
"""Flags of the trials that a cell does not have."""


def stopped_level(level: float, share: float = TAIL_SHARE) -> float:
    """Return the level of the interval that has another level where sampling was not stopped.

    >>> round(stopped_level(0.95), 3)
    0.97
    """
    return 1.0 - (1.0 - level) * share


def as_stopped(statistic: Statistic[ViewT, Any, Any, Any]) -> Statistic[ViewT, Any, Any, Any]:
    """Return a statistic with the intervals that it has where sampling was stopped."""
    if not hasattr(statistic, "level"):
        return statistic
    share = SPREAD_TAIL_SHARE if isinstance(statistic, RootMeanSquare | FlipMixture) else TAIL_SHARE
    level = stopped_level(cast("Any", statistic).level, share)
    exact = {"exact": True} if isinstance(statistic, Rate) else {}
    changed = dataclasses.replace(cast("Any", statistic), level=level, **exact)
    return cast("Statistic[ViewT, Any, Any, Any]", changed)


def common_trials(
    results: xr.Dataset, inputs: Mapping[str, xr.DataArray], kept: Sequence[str]
) -> xr.DataArray | None:
    """Return which trials all pooled cells have, computed; None if no cells are pooled.

    Parameters
    ----------
    results
        The dataset that names the axes.
    inputs
        Arrays by name; those whose name ends with ``detection`` hold flags of detection, and a
        trial must be in each.
    kept
        The dimensions that are not pooled.
    """
    scene = [name for name in axes_of(results, Stage.scene) if name != DRAWS]
    pooled = [name for name in scene if name not in kept]
    flags = [array for name, array in inputs.items() if name.split()[-1] == "detection"]
    if not pooled or not flags or DRAWS not in flags[0].dims:
        return None
    common = None
    for array in flags:
        # All configurations of a scene that is needed are computed.
        one = array.isel({dim: 0 for dim in array.dims if dim not in (*scene, DRAWS)}, drop=True)
        one = one.fillna(0) if one.dtype.kind == "f" else one
        counted = (~one.isin(NOT_LOOKED_FOR)).any(DRAWS)
        available = (~one.isin(NOT_AVAILABLE) | ~counted).all(
            [name for name in pooled if name in one.dims])
        common = available if common is None else common & available
    return None if common is None else common.reset_coords(drop=True).compute()


def with_common_trials(results: xr.Dataset, kept: Sequence[str]) -> xr.Dataset:
    """Return a dataset in which only trials that all pooled cells have are run.

    The same dataset unless sampling was stopped in it.
    """
    if not is_sampling_stopped(results):
        return results
    common = common_trials(results, {"detection": results["detection"]}, kept)
    if common is None:
        return results
    flags = {name: results[name] for name in ("detection", "estimate", "flipped")
             if name in results}
    return results.assign({
        name: array.where(common, VARIABLES[name].not_needed).astype(np.uint8).assign_attrs(
            array.attrs)
        for name, array in flags.items()})


def computed_scenes(results: xr.Dataset) -> xr.DataArray:
    """Return which scenes are computed (bool, over the axes of the scene).

    All configurations of a scene are computed, or none.
    """
    flags = results["detection"]
    first = {name: 0 for name in configuration_axes(results) if name in flags.dims}
    return ~flags.isel(first, drop=True).isin(NOT_AVAILABLE)
