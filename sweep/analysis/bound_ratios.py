"""How near the errors of estimates come to the accuracy bound."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from sweep.analysis.aggregate import aggregate
from sweep.analysis.binning import Bins
from sweep.analysis.described import describes
from sweep.analysis.dimensions import kept_dimensions
from sweep.analysis.means import RootMeanSquare
from sweep.analysis.pose_view import DEPTH, ERROR_INPUTS, Poses, norm_squared, pose_arrays, relative
from sweep.analysis.quantities import QUANTITIES, Quantity
from sweep.analysis.statistic import Output
from sweep.plan.variable import XYZ
from sweep.typing import Floats, Masks


@describes
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
    inputs = pose_arrays(results, ERROR_INPUTS) | bound_arrays(results)
    statistics = [statistic for ratio in RATIOS for statistic in ratio.statistics()]
    table = aggregate(results, inputs, kept, statistics, Poses, bins)
    variables: dict[str, xr.DataArray] = {}
    for ratio in RATIOS:
        bound, error = (statistic.name for statistic in ratio.statistics())
        for ending, other, words in (
            ("", "", ""), ("_low", "_high", "lower end of the 95 % interval: "),
            ("_high", "_low", "upper end of the 95 % interval: "),
        ):
            variables[f"{ratio.output.name}{ending}"] = (
                table[bound] / table[f"{error}{other}"]).assign_attrs(
                    long_name=f"{words}{ratio.output.meaning}", units="1")
    return xr.Dataset(variables, dict(table.coords))


def bound_arrays(results: xr.Dataset) -> dict[str, xr.DataArray]:
    """Return the bounds by the names that `BoundRatio` reads; NaN without ``bound_std``."""
    labels = [f"rotation_{axis}" for axis in XYZ]
    bound = results.get("bound_std", xr.DataArray(
        np.full(4, np.nan), {"pose_parameter": [*labels, "translation_z"]}, "pose_parameter"
    ))
    return {
        "rotation_bound": bound.sel(pose_parameter=labels),
        "depth_bound": bound.sel(pose_parameter="translation_z", drop=True),
    }


@dataclass(frozen=True)
class BoundRatio:
    """The RMS bound over the RMS error of a kind of error.

    Attributes
    ----------
    quantity
        The kind of error.
    bound_squared
        The squared bounds (...) of poses.
    """

    quantity: Quantity
    bound_squared: Callable[[Poses], Floats]

    @property
    def output(self) -> Output:
        """The ratio's name and meaning."""
        words = f"RMS bound over RMS {self.quantity.words}, solved and not flipped"
        return Output(f"{self.quantity.name}_efficiency", words, "1")

    def statistics(self) -> tuple[RootMeanSquare[Poses], RootMeanSquare[Poses]]:
        """Return the RMS bound and the RMS error of the poses that have both."""
        quantity = self.quantity
        return (
            RootMeanSquare(
                quantity.named("bound"), f"RMS bound of the {quantity.words}", quantity.units,
                lambda poses: self.bound_squared(poses)[..., None], self.used),
            RootMeanSquare(
                quantity.named("rmse"), f"RMS {quantity.words} of poses with a bound",
                quantity.units, quantity.squares, self.used),
        )

    def used(self, poses: Poses) -> Masks:
        """Return the poses that have a bound and are solved and not flipped."""
        return poses.unflipped & np.isfinite(self.bound_squared(poses))


RATIOS = (
    BoundRatio(QUANTITIES[0], lambda poses: norm_squared(np.degrees(poses["rotation_bound"]))),
    BoundRatio(QUANTITIES[1],
               lambda poses: (100.0 * relative(poses["depth_bound"], poses[DEPTH])) ** 2),
)
"""Of the rotation and of the depth."""
