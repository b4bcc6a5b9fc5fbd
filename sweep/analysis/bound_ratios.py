"""How near the errors of estimates come to the accuracy bound."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import xarray as xr

from sweep.analysis.aggregate import aggregate
from sweep.analysis.binning import Bins
from sweep.analysis.dimensions import kept_dimensions
from sweep.analysis.means import RootMeanSquare
from sweep.analysis.pose_view import DEPTH, ERROR_INPUTS, Poses, norm_squared, pose_arrays, relative
from sweep.analysis.quantities import QUANTITIES, Quantity
from sweep.plan.schema import XYZ
from sweep.typing import Floats, Masks


def efficiency(
    results: xr.Dataset, per: Sequence[str] = (), bins: Bins | None = None
) -> xr.Dataset:
    """Return how near the errors come to the accuracy bound, 1 being on it.

    Parameters
    ----------
    results
        The dataset of a run, with its variable ``bound_std``: the least standard deviation of an
        unbiased estimate (Cramér and Rao), NaN if the scene has none. Dimensions of the scene and
        ``pose_parameter``: rotation_x, rotation_y, rotation_z (rad), translation_x,
        translation_y, translation_z (m), camera frame.
    per, bins
        As in `sweep.analysis.detection_rate`.

    Returns
    -------
    xr.Dataset
        Dimensions (*per, *bins); lazy if ``results`` is.

        - ``rotation_efficiency``: sqrt(mean of the sum of the three bounds squared) over the RMS
          norm of the rotation error.
        - ``range_efficiency``: RMS of bound over true z, over that of error over true z, so that
          all distances weigh alike.

        Each has its interval in ``*_low`` and ``*_high``. NaN if no pose that counts has a bound,
        and everywhere without ``bound_std``; infinite if the errors are exactly 0.

    Raises
    ------
    ArgumentError, DatasetError
        As in `sweep.analysis.detection_rate`.

    Notes
    -----
    Both are over the poses that have a bound and are solved and not flipped: a flip is another
    minimum, which the bound does not describe. A biased estimator can be above 1. The intervals
    are those of the RMSE; the bound is taken as known. Kay, "Fundamentals of Statistical Signal
    Processing: Estimation Theory", 1993, chapter 3.

    Examples
    --------
    >>> table = efficiency(results, per=["solver"])
    >>> table["rotation_efficiency"].round(3).values.tolist()
    [0.544, 0.27]
    """
    kept = kept_dimensions(results, per)
    labels = [f"rotation_{axis}" for axis in XYZ]
    bound = results.get("bound_std", xr.DataArray(
        np.full(4, np.nan), {"pose_parameter": [*labels, "translation_z"]}, "pose_parameter"
    ))
    inputs = pose_arrays(results, ERROR_INPUTS) | {
        "rotation_bound": bound.sel(pose_parameter=labels),
        "depth_bound": bound.sel(pose_parameter="translation_z", drop=True),
    }
    rotation, depth = QUANTITIES[:2]
    bounds: dict[Quantity, Callable[[Poses], Floats]] = {
        rotation: lambda poses: norm_squared(np.degrees(poses["rotation_bound"])),
        depth: lambda poses: (100.0 * relative(poses["depth_bound"], poses[DEPTH])) ** 2,
    }
    statistics = [statistic for quantity, bound_squared in bounds.items()
                  for statistic in _bound_and_error(quantity, bound_squared)]
    table = aggregate(results, inputs, kept, statistics, Poses, bins)
    variables: dict[str, xr.DataArray] = {}
    for quantity in bounds:
        least, meaning = table[quantity.named("bound")], f"RMS bound over RMS {quantity.words}"
        name, error = f"{quantity.name}_efficiency", quantity.named("rmse")
        for ending, other, words in (
            ("", "", ""), ("_low", "_high", "lower end of the 95 % interval: "),
            ("_high", "_low", "upper end of the 95 % interval: "),
        ):
            ratio = least / table[f"{error}{other}"]
            variables[f"{name}{ending}"] = ratio.assign_attrs(
                long_name=f"{words}{meaning}, solved and not flipped", units="1")
    return xr.Dataset(variables, dict(table.coords))


def _bound_and_error(
    quantity: Quantity, bound_squared: Callable[[Poses], Floats]
) -> list[RootMeanSquare[Poses]]:
    """Return the RMS bound and the RMS error of the poses that have both."""
    def used(poses: Poses) -> Masks:
        return poses.unflipped & np.isfinite(bound_squared(poses))

    return [
        RootMeanSquare(
            quantity.named("bound"), f"RMS bound of the {quantity.words}", quantity.units,
            lambda poses: bound_squared(poses)[..., None], used),
        RootMeanSquare(
            quantity.named("rmse"), f"RMS {quantity.words} of poses with a bound",
            quantity.units, quantity.squares, used),
    ]
