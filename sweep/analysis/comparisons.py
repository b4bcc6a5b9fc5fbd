"""Two configurations on the same scenes, pose by pose: what differs, and whether it is chance."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis.aggregate import aggregate
from sweep.analysis.binning import Bins
from sweep.analysis.counts import Count, CountOfDraws
from sweep.analysis.described import describes
from sweep.analysis.dimensions import DRAWS, is_sampling_stopped, kept_dimensions
from sweep.analysis.intervals import LEVEL
from sweep.analysis.means import Mean, RootMeanSquareRatio
from sweep.analysis.paired_rates import newcombe_and_mcnemar
from sweep.analysis.pose_pairs import TRUTH, Pair, paired_arrays, require_pairs
from sweep.analysis.pose_view import ERROR_INPUTS, Poses, norm_squared, pose_arrays
from sweep.analysis.quantities import QUANTITIES, Quantity
from sweep.analysis.statistic import Statistic
from sweep.analysis.stopped_sampling import stopped_level
from sweep.typing import Floats, Masks

PairStatistic = Statistic[Pair, Any, Any, Any]

ROTATION = QUANTITIES[0]


@describes
def compare(
    first: xr.Dataset, second: xr.Dataset, per: Sequence[str] = (), bins: Bins | None = None
) -> xr.Dataset:
    """Return what differs between two configurations on the same scenes, second minus first.

    Parameters
    ----------
    first, second
        Two configurations of one store, such as ``results.sel(solver="ippe")`` and
        ``results.sel(solver="sqpnp")``, or two stores over the same scenes, with the same
        dimensions and coordinates.
    per, bins
        As in `sweep.analysis.detection_rate`; bins are of a variable of ``first``.

    Returns
    -------
    xr.Dataset
        Dimensions (*per, *bins); lazy if the datasets are.

        - ``compared``: poses that were looked for in both, and the ``draws`` they are worth.
          ``both_detected``, ``only_first_detected``, ``only_second_detected`` and
          ``neither_detected`` of them; the same four of ``solved``.
        - ``detection_difference`` of the rates, with its interval. ``detection_p_value``: how
          often chance alone makes the two discordant counts as unequal.
        - ``run_in_one``: poses that one of the two alone ran, as in stores whose sampling stopped
          after different trials: only trials that both have are compared.
        - ``different_scenes``: compared poses whose truth differs, as in stores with other
          distributions. Unless it is 0 nothing is paired, and the test compares two samples.
        - Of the poses solved in both: ``*_difference_*``, the mean difference of the absolute
          errors, and ``*_rmse_ratio``, the second's RMSE over the first's. They do not include
          the poses that one configuration alone solved, which as a rule are the hard ones: see
          the counts. ``rotation_rmse_unflipped_ratio`` is of those flipped in neither.

    Raises
    ------
    ArgumentError
        As in `sweep.analysis.detection_rate`.
    DatasetError
        If dimensions, coordinates or seeds of the two differ, or one lacks variables of results.

    Notes
    -----
    95 % intervals over the random draws, paired, conditional on the grid; with pooled settings
    counts are scaled to draws. NaN, as is the p-value, if no cell has two draws. The difference of
    rates: Newcombe, Statistics in Medicine 17, 1998, method 10. The test is McNemar's, exact:
    Psychometrika 12, 1947.

    ``rotation_difference_deg`` and ``rotation_rmse_ratio`` include flips, which make most of both
    where there are any: their intervals hold only if some ten poses are flipped in one of the two
    (``only_first_flipped`` and ``only_second_flipped`` count them), for no sample says how large a
    rare flip that it does not have is. ``rotation_rmse_unflipped_ratio`` does not depend on flips.

    Examples
    --------
    >>> table = compare(results.sel(solver="ippe"), results.sel(solver="iterative"))
    >>> int(table["compared"]), int(table["both_solved"]), float(table["detection_difference"])
    (24, 13, 0.0)
    >>> table["rotation_rmse_ratio"].round(3).item()
    2.0
    """
    kept = kept_dimensions(first, per)
    kept_dimensions(second, per)
    table = paired_table(first, second, kept, bins)
    return table.drop_vars([
        "drawn", *(quantity.named("first") for quantity in QUANTITIES),
        *(f"{quantity.named('first')}{end}" for quantity in QUANTITIES
          for end in ("_low", "_high"))])


def paired_table(
    first: xr.Dataset, second: xr.Dataset, kept: Sequence[str], bins: Bins | None,
    quantities: Sequence[Quantity] = QUANTITIES, level: float = LEVEL,
) -> xr.Dataset:
    """Return the table of `compare` of some kinds of error.

    Beside it there is the first's mean absolute error of the poses that both solved, and whether
    any cell has two draws, ``drawn``. ``level`` is that of the intervals of errors.
    """
    stopped = is_sampling_stopped(first) or is_sampling_stopped(second)
    if stopped:
        first, second = _of_common_trials(first, second)
    require_pairs(first, second)
    own = [name for name, value in first.coords.items() if not value.dims
           and not (name in second.coords and value.equals(second.coords[name]))]
    first = first.drop_vars(own)  # such as the name of its solver
    names = dict.fromkeys(name for quantity in quantities for name in quantity.inputs)
    inputs = paired_arrays(*(_errors_and_truth(side, names) for side in (first, second)))
    statistics: list[PairStatistic] = [
        *_agreement("detected", lambda poses: poses.detected),
        *_agreement("solved", lambda poses: poses.solved),
        *_flipped_in_one(),
        CountOfDraws("compared", "poses that were looked for in both",
                     lambda pair: pair.compared),
        Count("run_in_one", "poses that one of the two alone ran, which are not compared",
              lambda pair: pair.first.run != pair.second.run),
        Count("different_scenes", "compared poses whose truth differs, so that they are no pairs",
              lambda pair: pair.compared & pair.differing),
        *(statistic for quantity in quantities for statistic in _differences(quantity, level)),
    ]
    table = aggregate(first, inputs, kept, statistics, Pair, bins, stopped=stopped)
    return table.assign(_tested(table, stopped_level(LEVEL) if stopped else LEVEL))


def _of_common_trials(
    first: xr.Dataset, second: xr.Dataset
) -> tuple[xr.Dataset, xr.Dataset]:
    """Return two datasets with the trials that are on the axes of both."""
    if not all(DRAWS in side.dims for side in (first, second)):
        return first, second
    common = np.intersect1d(first[DRAWS].values, second[DRAWS].values)
    return first.sel({DRAWS: common}), second.sel({DRAWS: common})


def _errors_and_truth(results: xr.Dataset, names: Iterable[str]) -> dict[str, xr.DataArray]:
    truth = (name for name in TRUTH if name in results)
    return pose_arrays(results, (*ERROR_INPUTS, *names, *truth))


def _agreement(ending: str, reached: Callable[[Poses], Masks]) -> list[PairStatistic]:
    """Return the four counts of compared poses that both, one or none of the two reached."""
    statistics: list[PairStatistic] = []
    for name, in_first, in_second in (("both", True, True), ("only_first", True, False),
                                      ("only_second", False, True), ("neither", False, False)):
        def agree(pair: Pair, in_first: bool = in_first, in_second: bool = in_second) -> Masks:
            same = (reached(pair.first) == in_first) & (reached(pair.second) == in_second)
            return np.asarray(pair.compared & same)

        words = f"compared poses, {ending} in {name.replace('_', ' ')}"
        statistics.append(Count(f"{name}_{ending}", words, agree))
    return statistics


def _flipped_in_one() -> list[PairStatistic]:
    """Return how many of the poses that both solved one of the two alone has flipped."""
    words = "poses solved in both, flipped in the {} alone"
    return [
        Count("only_first_flipped", words.format("first"),
              lambda pair: pair.both_solved & pair.first.flipped & ~pair.second.flipped),
        Count("only_second_flipped", words.format("second"),
              lambda pair: pair.both_solved & pair.second.flipped & ~pair.first.flipped),
    ]


def _differences(quantity: Quantity, level: float) -> list[PairStatistic]:
    def both_squares(pair: Pair) -> Floats:
        sides = (pair.first, pair.second)
        return np.stack([norm_squared(quantity.vector(side)) for side in sides], axis=-1)

    def solved(pair: Pair) -> Masks:
        return pair.both_solved

    words = quantity.words
    differences: list[PairStatistic] = [
        Mean(quantity.named("difference"), f"mean difference of the absolute {words}",
             quantity.units, lambda pair: np.diff(np.sqrt(both_squares(pair))), solved, level),
        Mean(quantity.named("first"), f"first mean absolute {words}", quantity.units,
             lambda pair: np.sqrt(both_squares(pair)[..., :1]), solved),
        RootMeanSquareRatio(f"{quantity.name}_rmse_ratio", f"second RMS {words} over the first",
                            "1", both_squares, solved),
    ]
    if quantity is not ROTATION:
        return differences
    return [*differences, RootMeanSquareRatio(
        f"{quantity.name}_rmse_unflipped_ratio",
        f"second RMS {words} over the first, flipped in neither", "1", both_squares,
        lambda pair: pair.first.unflipped & pair.second.unflipped)]


def _tested(table: xr.Dataset, level: float) -> dict[str, xr.DataArray]:
    """Return the difference of the detection rates with its interval, and McNemar's test."""
    counts = [table[f"{name}_detected"] for name in (
        "both", "only_first", "only_second", "neither")]
    arrays = xr.apply_ufunc(
        newcombe_and_mcnemar, *counts, table["draws"], table["drawn"], kwargs={"level": level},
        output_core_dims=[[]] * 4, dask="parallelized", output_dtypes=[np.float64] * 4,
    )
    difference = "detection rate, second minus first"
    meanings = {
        "detection_difference": difference,
        "detection_difference_low": f"lower end of the 95 % interval: {difference}",
        "detection_difference_high": f"upper end of the 95 % interval: {difference}",
        "detection_p_value": "chance that the discordant counts differ so much if the detection "
                             "rates are equal (McNemar, exact)",
    }
    return {
        name: array.assign_attrs(long_name=meaning, units="1")
        for (name, meaning), array in zip(meanings.items(), arrays, strict=True)
    }
