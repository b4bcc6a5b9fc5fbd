"""The same poses with two configurations, of a store or of two stores, as statistics read them."""

from __future__ import annotations

import numpy as np
import xarray as xr

from sweep.analysis.dimensions import axes_of, fingerprint_of, is_grid_axis
from sweep.analysis.layout import Arrays
from sweep.analysis.pose_view import Poses
from sweep.errors import DatasetError
from sweep.typing import Masks

TRUTH = ("true_tvec_m", "true_rvec")
"""Variables that are the same for both poses of a pair."""


class Pair:
    """The poses of two datasets, pose by pose.

    Parameters
    ----------
    arrays
        Those of `paired_arrays`, (groups, cells, draws, settings, ...).
    """

    def __init__(self, arrays: Arrays) -> None:
        self.first, self.second = Poses(arrays, "first "), Poses(arrays, "second ")

    @property
    def draws(self) -> Masks:
        """Which draws were run in both: (groups, cells, draws)."""
        return self.first.draws & self.second.draws

    @property
    def compared(self) -> Masks:
        """Poses that were looked for in both."""
        return self.first.looked_for & self.second.looked_for

    @property
    def differing(self) -> Masks:
        """Poses whose truth differs."""
        names = [name for name in TRUTH if name in self.first and name in self.second]
        differ = [(self.first[name] != self.second[name]).any(axis=-1) for name in names]
        return np.asarray(np.any(differ, axis=0))

    @property
    def both_solved(self) -> Masks:
        """Poses that were solved in both."""
        return self.first.solved & self.second.solved


def paired_arrays(
    first: dict[str, xr.DataArray], second: dict[str, xr.DataArray]
) -> dict[str, xr.DataArray]:
    """Return the arrays of two datasets by the names that `Pair` gives them."""
    return {f"{side} {name}": array.reset_coords(drop=True)
            for side, arrays in (("first", first), ("second", second))
            for name, array in arrays.items()}


def require_pairs(first: xr.Dataset, second: xr.Dataset) -> None:
    """Raise DatasetError unless two datasets are of the same scenes and draws."""
    for name, value in first.coords.items():
        if (is_grid_axis(name, first) and not value.dims
                and name in second.coords and not second[name].dims):
            values = value.item(), second[name].item()
            if values[0] != values[1]:
                raise DatasetError(f"not the same scenes: {name} is {values[0]} and {values[1]}, "
                                   "with other draws")
    axes, others = axes_of(first), axes_of(second)
    if set(axes) != set(others):
        raise DatasetError(f"not the same scenes: dimensions {', '.join(axes) or 'none'} "
                           f"and {', '.join(others) or 'none'}")
    for name in axes:
        if not np.array_equal(first[name].values, second[name].values):
            raise DatasetError(f"not the same scenes: the values of {name} differ")
    seeds = [fingerprint_of(side).get("seed") for side in (first, second)]
    if None not in seeds and seeds[0] != seeds[1]:
        raise DatasetError(f"not the same draws: seeds {seeds[0]} and {seeds[1]}")
    sampling = [fingerprint_of(side).get("sampling", "independent") for side in (first, second)]
    if sampling[0] != sampling[1]:
        raise DatasetError(f"not the same draws: sampling {sampling[0]} and {sampling[1]}")
