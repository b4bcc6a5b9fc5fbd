"""Whether the covariances that estimates come with describe their errors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from scipy import special

from sweep.analysis.aggregate import aggregate
from sweep.analysis.counts import Rate
from sweep.analysis.described import describes
from sweep.analysis.dimensions import axes_of, kept_dimensions
from sweep.analysis.intervals import LEVEL
from sweep.analysis.means import PositiveMean
from sweep.analysis.pose_view import ESTIMATE_INPUTS, Poses, pose_arrays
from sweep.analysis.registry import PoseStatistic
from sweep.analysis.statistic import Statistic
from sweep.errors import ArgumentError
from sweep.plan.variable import POSE_PARAMETERS
from sweep.typing import Floats, Masks

TOLERANCE = 0.02
"""By how much the coverage of a trusted covariance may differ from the level."""

MIN_DRAWS = 50
"""Draws from which on a covariance can be trusted."""


def _nees(poses: Poses) -> Floats:
    return poses["nees"].astype(np.float64)


def _with_nees(poses: Poses) -> Masks:
    return poses.solved & ~np.isnan(_nees(poses))


NEES_MEAN = PoseStatistic(
    PositiveMean("nees_mean", "mean normalised estimation error squared, expected 6", "1",
                 lambda poses: _nees(poses)[..., None], _with_nees),
    (*ESTIMATE_INPUTS, "nees"))
"""The mean of ``nees``."""


@describes
def covariance_trust(
    results: xr.Dataset,
    per: Sequence[str] = (),
    levels: Sequence[float] = (0.5, 0.9, 0.99),
    scale: xr.DataArray | None = None,
) -> xr.Dataset:
    """Return whether the estimates' own covariances describe their errors.

    Parameters
    ----------
    results
        The dataset of a run, with its variable ``nees``: the normalised estimation error squared
        e' C⁻¹ e of the six pose parameters, NaN if the estimate has no covariance.
    per
        Dimensions that are kept; all others are pooled.
    levels
        Probabilities of the covariance's regions, between 0 and 1.
    scale
        Factors of ``nees``, with axes of the dataset (the kept ones, as a rule) and their
        coordinates: with 1/k² the assumed corner noise becomes k times as large.

    Returns
    -------
    xr.Dataset
        Dimensions (*per[, level]); lazy if ``results`` is. Without ``nees`` all is NaN and nothing
        trusted.

        - ``nees_count``: estimates with a number. ``nees_mean``, expected to be 6, with Student's
          interval of its logarithm.
        - ``covariance_coverage`` (..., level): share of them within the region of that level, with
          Wilson's interval.
        - ``covariance_trusted``: at every level the interval of the coverage, at 95 % for all
          levels together (Bonferroni), holds a share within 0.02 of the level, and there are at
          least 50 draws. False means wrong, or too few draws to know.

    Raises
    ------
    ArgumentError
        For a dimension that does not exist, a level outside (0, 1), and a ``scale`` whose
        coordinates differ from the dataset's.
    DatasetError
        As in `sweep.analysis.detection_rate`.

    Notes
    -----
    With a true covariance ``nees`` is chi-squared with 6 degrees of freedom: Bar-Shalom, Li and
    Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, section 5.4.
    Every pose with a number counts, flipped ones too: who trusts a covariance does not know of
    flips.

    Examples
    --------
    >>> table = covariance_trust(results, levels=[0.5, 0.9])
    >>> int(table["nees_count"]), round(float(table["nees_mean"]), 3)
    (26, 5.97)
    >>> table["covariance_coverage"].round(3).values.tolist()
    [0.5, 0.885]
    >>> bool(table["covariance_trusted"])  # fewer than 50 draws
    False
    """
    nominal = np.atleast_1d(np.array(levels, dtype=np.float64))
    if not (nominal.size and ((nominal > 0.0) & (nominal < 1.0)).all()):
        raise ArgumentError("levels", levels, "expected numbers between 0 and 1")
    kept = kept_dimensions(results, per)
    nees = results.get("nees", xr.DataArray(np.nan))
    if scale is not None:
        nees = _scaled(results, nees, scale)
    limits = special.chdtri(len(POSE_PARAMETERS), 1.0 - nominal).tolist()
    inputs = pose_arrays(results, ESTIMATE_INPUTS) | {"nees": nees}
    table = aggregate(results, inputs, kept, _nees_statistics(limits), Poses)
    level = xr.DataArray(nominal, dims="level", attrs={
        "long_name": "nominal probability of the covariance's region", "units": "1"})

    def over_levels(name: str) -> xr.DataArray:
        parts = [table[name.format(at)] for at in range(len(limits))]
        return xr.concat(parts, dim="level").transpose(..., "level")

    right = ((over_levels("joint {}_low") - TOLERANCE <= level)
             & (level <= over_levels("joint {}_high") + TOLERANCE)).all("level")
    variables = {name: table[name] for name in (
        "nees_mean", "nees_mean_low", "nees_mean_high", "nees_count")}
    variables["covariance_trusted"] = (right & (table["draws"] >= MIN_DRAWS)).assign_attrs(
        long_name="whether the coverage is the level, at every level", units="1")
    for ending, words in (("", ""), ("_low", "lower end of the 95 % interval: "),
                          ("_high", "upper end of the 95 % interval: ")):
        variables[f"covariance_coverage{ending}"] = over_levels(
            f"coverage {{}}{ending}").assign_attrs(
                long_name=f"{words}share of estimates within the covariance's region of a level",
                units="1")
    return xr.Dataset(variables, dict(table.coords)).assign_coords(level=level)


def _scaled(results: xr.Dataset, nees: xr.DataArray, scale: xr.DataArray) -> xr.DataArray:
    """Return ``nees`` times ``scale``, if their coordinates agree."""
    described, axes = f"array over {', '.join(map(str, scale.dims))}", axes_of(results)
    if not set(scale.dims) <= set(axes):
        raise ArgumentError("scale", described,
                            f"no such dimension; there are {', '.join(axes) or 'none'}")
    try:
        nees, scale = xr.align(nees, scale, join="exact")
    except ValueError as error:
        raise ArgumentError(
            "scale", described, "expected the dataset's coordinates") from error
    return nees * scale


def _nees_statistics(limits: Sequence[float]) -> list[Statistic[Poses, Any, Any, Any]]:
    """Return the mean of ``nees``, and the shares below each limit with two intervals.

    "coverage 0" has the interval of its level alone, "joint 0" that of all levels together.
    """
    joint = 1.0 - (1.0 - LEVEL) / len(limits)

    statistics: list[Statistic[Poses, Any, Any, Any]] = [NEES_MEAN.statistic]
    for at, limit in enumerate(limits):
        def within(poses: Poses, most: float = limit) -> Masks:
            return np.asarray(_nees(poses) <= most)

        statistics += [
            Rate(f"coverage {at}", "within the region of used", within, _with_nees,
                 counts=(("nees_count", "estimates with a normalised estimation error squared"),
                         (f"hits {at}", ""))),
            Rate(f"joint {at}", "within the region of used", within, _with_nees, joint),
        ]
    return statistics
