"""Paired comparisons: configurations, renderers, stores, photographs and their simulation."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import special

from sweep.analysis import dataset, estimator
from sweep.analysis.dataset import DRAWS, ERROR_INPUTS, QUANTITIES, Poses, Quantity, axes_of
from sweep.analysis.estimator import INTERVAL, LEVEL, Bins, Columns, Count, Mean, Output, Statistic
from sweep.analysis.summaries import DETECTION_RATE
from sweep.errors import ArgumentError, DatasetError
from sweep.experiment.parameters import PARAMETERS, PHOTOGRAPHS, SIMULATED, Stage
from sweep.experiment.schema import LABELS, cf_attributes
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.messages import label, plain, shown
from sweep.model.pose import rotation_of_vector, vector_of_rotation
from sweep.typing import Floats, Integers, Masks

# --------------------------------------------------------------------------------------------------
# The same poses with two configurations, of a store or of two stores, as statistics read them.

#: Variables that are the same for both poses of a pair.
TRUTH = ("true_tvec_m", "true_rvec")

#: Name of the mask of the pairs whose truth differs.
DIFFERING = "differing"


class Pair:
    """The poses of two datasets, pose by pose.

    Parameters
    ----------
    arrays
        Arrays of `paired_arrays`, (groups, cells, draws, settings, ...).
    """

    def __init__(self, arrays: estimator.Arrays) -> None:
        self.first, self.second = Poses(arrays, "first "), Poses(arrays, "second ")
        self._arrays = arrays

    @property
    def run(self) -> Masks:
        """Poses that were run in both."""
        return self.first.run & self.second.run

    @property
    def compared(self) -> Masks:
        """Poses that were looked for in both."""
        return self.first.looked_for & self.second.looked_for

    @property
    def differing(self) -> Masks:
        """Poses whose truth differs."""
        return self._arrays[DIFFERING]

    @property
    def both_solved(self) -> Masks:
        """Poses that were solved in both."""
        return self.first.solved & self.second.solved


def paired_arrays(
    first: xr.Dataset, second: xr.Dataset, *names: str
) -> dict[str, xr.DataArray]:
    """Return variables of two datasets by the names that `Pair` gives them."""
    return {f"{side} {name}": array.reset_coords(drop=True)
            for side, results in (("first", first), ("second", second))
            for name, array in dataset.pose_arrays(results, names).items()}


def require_pairs(first: xr.Dataset, second: xr.Dataset) -> None:
    """Raise DatasetError unless two datasets are of the same scenes and draws."""
    for name, value in first.coords.items():
        other = second.get(name, value)
        if dataset.is_grid_axis(name, first) and not value.dims and not other.dims and (
                value.item() != other.item()):
            raise DatasetError(f"not the same scenes: {name} is {value.item()} and {other.item()}, "
                               "with other draws")
    axes, others = axes_of(first), axes_of(second)
    if set(axes) != set(others):
        raise DatasetError(f"not the same scenes: dimensions {', '.join(axes) or 'none'} "
                           f"and {', '.join(others) or 'none'}")
    for name in axes:
        if not np.array_equal(first[name].values, second[name].values):
            raise DatasetError(f"not the same scenes: the values of {name} differ")
    for key, unsaid, words in (("seed", None, "seeds"), ("sampling", "independent", "sampling")):
        ours, theirs = (dataset.fingerprint_of(side).get(key, unsaid) for side in (first, second))
        if None not in (ours, theirs) and ours != theirs:
            raise DatasetError(f"not the same draws: {words} {ours} and {theirs}")


# --------------------------------------------------------------------------------------------------
# Two configurations on the same scenes, pose by pose: what differs, and whether it is chance.

PairStatistic = Statistic[Pair]

ROTATION, _DEPTH = QUANTITIES[:2]


@dataset.describes
def compare(
    first: xr.Dataset, second: xr.Dataset, per: Sequence[str] = (), bins: Bins | None = None
) -> xr.Dataset:
    """Return the differences of two configurations on the same scenes, second minus first.

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
        Dimensions (*per, *bins).

        - ``compared``: poses that were looked for in both, and the ``draws`` they are worth.
          ``both_detected``, ``only_first_detected``, ``only_second_detected`` and
          ``neither_detected`` of them; the same four of ``solved``.
        - ``detection_difference`` of the rates, with its interval. ``detection_p_value``: how
          often chance alone makes the two discordant counts as unequal. ``solved_difference`` and
          ``solved_p_value`` likewise.
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
    kept = dataset.kept_dimensions(first, per)
    dataset.kept_dimensions(second, per)
    table, = paired_tables(first, second, kept, bins)
    return table.drop_vars("drawn")


def paired_tables(
    first: xr.Dataset, second: xr.Dataset, kept: Sequence[str], bins: Bins | None,
    quantities: Sequence[Quantity] = QUANTITIES, levels: Sequence[float] = (LEVEL,),
    more: Sequence[PairStatistic] = (),
) -> list[xr.Dataset]:
    """Return the table of `compare` of some kinds of error, for each level of the intervals.

    Beside it there is whether any cell has two draws, ``drawn``, and there are ``more`` statistics.
    """
    stopped = any(dataset.stopping_rule(side) is not None for side in (first, second))
    if stopped and DRAWS in first.dims and DRAWS in second.dims:
        first, second = xr.align(
            first, second, join="inner", exclude={*first.dims, *second.dims} - {DRAWS})
        dataset.require_poses(first)
    require_pairs(first, second)
    own = [name for name, value in first.coords.items() if not value.dims
           and not (name in second.coords and value.equals(second.coords[name]))]
    first = first.drop_vars(own)  # such as the name of its solver
    inputs = paired_arrays(first, second, *ERROR_INPUTS, *(
        name for quantity in quantities for name in quantity.inputs))
    # Compared while they are read: the truth of 10^7 poses has 480 MB.
    inputs[DIFFERING] = functools.reduce(operator.or_, (
        (first[name] != second[name]).any("xyz").reset_coords(drop=True)
        for name in TRUTH if name in first and name in second), xr.DataArray(False))
    statistics: list[PairStatistic] = [
        RateDifference("detection", "detected", lambda poses: poses.detected),
        RateDifference("solved", "solved", lambda poses: poses.solved),
        Count("only_first_flipped", "poses solved in both, flipped in the first alone",
              lambda pair: pair.both_solved & pair.first.flipped & ~pair.second.flipped),
        Count("only_second_flipped", "poses solved in both, flipped in the second alone",
              lambda pair: pair.both_solved & pair.second.flipped & ~pair.first.flipped),
        Count("compared", "poses that were looked for in both",
              lambda pair: pair.compared, "draws", "drawn"),
        Count("run_in_one", "poses that one of the two alone ran, which are not compared",
              lambda pair: pair.first.run != pair.second.run),
        Count("different_scenes", "compared poses whose truth differs, so that they are no pairs",
              lambda pair: pair.compared & pair.differing),
        *(statistic for quantity in quantities for statistic in _differences(quantity)), *more,
    ]
    return estimator.aggregates(first, inputs, kept, [
        [replace(each, level=level) for each in statistics] for level in levels],
        Pair, bins, stopped=stopped)


@dataclass(frozen=True)
class RateDifference(Statistic[Pair]):
    """The difference of a rate between both, second minus first, and the pairs that it is of.

    The interval: Newcombe, Statistics in Medicine 17 (1998), pages 2635-2650, method 10, with the
    continuity correction of the correlation; of pairs that are worth fewer draws it is that of so
    many. The p-value is McNemar's, the exact binomial test of the discordant pairs. Both are NaN if
    no cell has two draws. The name is the rate's, the meaning the word for poses that it counts.
    """

    reached: Callable[[Poses], Masks]

    def outputs(self) -> Sequence[Output]:
        """Return the four counts, the difference with its interval, and the p-value."""
        rate, ending = self.name, self.meaning
        return [
            *(Output(f"{name}_{ending}", f"compared poses, {ending} in {name.replace('_', ' ')}",
                     "1", "i8") for name in ("both", "only_first", "only_second", "neither")),
            *estimator.with_interval(f"{rate}_difference", f"{rate} rate, second minus first", "1"),
            Output(f"{rate}_p_value", "chance that the discordant counts differ so much if the "
                   f"{rate} rates are equal (McNemar, exact)", "1")]

    def arrays(self, columns: Columns[Pair], design: estimator.Design) -> Sequence[NDArray[Any]]:
        """Return these of the poses that were looked for in both."""
        def pairs(pair: Pair, _: slice) -> list[Masks]:
            first, second = self.reached(pair.first), self.reached(pair.second)
            return [pair.compared & each for each in (
                first & second, first & ~second, ~first & second, ~first & ~second, True)]

        *cases, compared = map(estimator.Sample, columns.by_draw(pairs))
        both, first, second, neither = counts = [each.n for each in cases]
        n, draws, level = compared.n, compared.draws, design.level(self.level)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = draws / np.maximum(n, 1)
            rates = [(both + one) / n for one in (second, first)]
            ends = [estimator.outward(estimator.wilson, both + one, n, draws, level)
                    for one in (second, first)]
            margins = ((both + first) * (second + neither)).astype(np.float64) * (
                (both + second) * (first + neither))
            cross = both.astype(np.float64) * neither - first.astype(np.float64) * second
            # Of counts scaled to draws.
            corrected = np.maximum(cross * scale**2 - draws / 2, 0.0)
            lessened = np.where(cross > 0, corrected, cross * scale**2)
            correlation = np.where(margins > 0, lessened / (np.sqrt(margins) * scale**2), 0.0)

            difference, low, high = difference_interval(
                (rates[1], *ends[1]), (rates[0], *ends[0]), correlation)
        _, fewer = estimator.scaled_to_draws(np.minimum(first, second), n, draws)
        discordant = np.maximum(estimator.scaled_to_draws(first + second, n, draws)[0], fewer)
        p_value = np.minimum(1.0, 2.0 * special.bdtr(fewer, discordant, 0.5))
        return [*counts, difference, *(
            np.where(compared.drawn, each, np.nan) for each in (low, high, p_value))]


def difference_interval(first: Any, second: Any, correlation: Any) -> tuple[Any, Any, Any]:
    """Return the difference of two estimates, second minus first, and the ends of its interval.

    It follows from their own intervals, ``first`` and ``second`` being (value, low, high), and the
    correlation of their errors: Newcombe, as above; of any estimates Zou, "Toward using confidence
    intervals to compare correlations", Psychological Methods 12, 2007.
    """
    def reach(up: Any, down: Any) -> Any:
        return np.sqrt(np.maximum(up**2 - 2 * correlation * up * down + down**2, 0.0))

    (value, low, high), (other, other_low, other_high) = first, second
    difference = other - value
    return (difference, difference - reach(other - other_low, high - value),
            difference + reach(other_high - other, value - low))


def _differences(quantity: Quantity) -> list[PairStatistic]:
    """Return the mean difference and the ratio of a kind of error, of poses that both solved."""
    words = quantity.words

    def squares(pair: Pair) -> Floats:
        """Return the squared absolute errors (..., 2) of both poses."""
        return np.concatenate([quantity.squares(each) for each in (pair.first, pair.second)], -1)

    def ratio(ending: str, also: str, used: Callable[[Pair], Masks]) -> PairStatistic:
        return estimator.RootMeanSquareRatio(
            f"{quantity.name}_rmse{ending}_ratio", f"second RMS {words} over the first{also}",
            squares, used)

    return [
        Mean(quantity.named("difference"), f"mean difference of the absolute {words}",
             lambda pair: np.diff(np.sqrt(squares(pair))), lambda pair: pair.both_solved,
             units=quantity.units),
        ratio("", "", lambda pair: pair.both_solved),
        *([ratio("_unflipped", ", flipped in neither",
                 lambda pair: pair.first.unflipped & pair.second.unflipped)]
          if quantity is ROTATION else []),
    ]


# --------------------------------------------------------------------------------------------------
# Changes by a renderer against the exact one, paired scene by scene.

#: Variables of corners: of a single marker, or of a board's markers and of its chessboard.
CORNER_VARIABLES = ("corner_error_px", "marker_corner_error_px", "chessboard_corner_error_px")


@dataset.describes
def renderer_bias(results: xr.Dataset, reference: str = "exact") -> xr.Dataset:
    """Return each renderer's changes against ``reference``, paired scene by scene.

    Parameters
    ----------
    results
        The dataset of a run with a dimension ``renderer``.
    reference
        The renderer that the others are compared with.

    Returns
    -------
    xr.Dataset
        Dimensions: renderer and the settings of detector and estimator. All others are pooled. The
        interval of ``x`` is in ``x_low`` and ``x_high``.

        - ``detection_disagreement``: share of the poses looked for with both (``compared``) that
          are detected with one of them only (``differing``).
        - ``corner_shift_rms_px``: RMS over poses detected with both, corners (of boards those found
          with both), x and y of the difference of the corners' errors.
        - ``range_bias_percent``: mean difference of the relative z errors, signed (above 0:
          farther than with the reference), poses solved with both.
        - ``rotation_shift_deg``: RMS norm of the difference of the rotation errors, poses solved
          and not flipped with both.

    Raises
    ------
    ArgumentError
        If the dataset has no dimension ``renderer``, or not the renderer ``reference``.
    DatasetError
        If the dataset lacks variables of results, or has no poses.

    Notes
    -----
    95 % intervals over the random draws, conditional on the grid, as in `sweep.analysis.compare`.

    Examples
    --------
    >>> both = xr.concat([results, results], dim="renderer").assign_coords(
    ...     renderer=["exact", "area"])
    >>> renderer_bias(both)["detection_disagreement"].sel(solver="ippe").values.tolist()
    [0.0, 0.0]
    """
    dataset.kept_dimensions(results, ["renderer"])
    renderers = [str(name) for name in results["renderer"].values]
    if reference not in renderers:
        raise ArgumentError("reference", reference, f"the renderers are {', '.join(renderers)}")
    others = results.isel(renderer=renderers.index(reference), drop=True)
    single, of_boards, _ = CORNER_VARIABLES
    corners, whose = of_boards if of_boards in results else single, "minus the reference's"
    statistics: list[PairStatistic] = [
        estimator.Rate("detection_disagreement", "differing of compared",
             lambda pair: pair.first.detected != pair.second.detected, lambda pair: pair.compared,
             counts=(("compared", "poses that were looked for with both renderers"),
                     ("differing", "poses detected with one of both renderers only"))),
        estimator.RootMeanSquare(
            "corner_shift_rms_px", f"RMS of a corner's coordinate {whose}",
            lambda pair: _corner_shift(pair, corners),
            lambda pair: pair.compared & pair.first.detected & pair.second.detected, units="px"),
        Mean("range_bias_percent",
             f"mean depth error {whose}, of the true depth, both solved",
             lambda pair: _DEPTH.vector(pair.second) - _DEPTH.vector(pair.first),
             lambda pair: pair.both_solved, units=_DEPTH.units),
        estimator.RootMeanSquare(
            "rotation_shift_deg",
            f"RMS of the rotation error {whose}, both solved and not flipped",
            lambda pair: dataset.norm_squared(np.degrees(np.subtract(
                pair.second["rotation_error_rad"], pair.first["rotation_error_rad"],
                dtype=np.float64)))[..., None],
            lambda pair: pair.first.unflipped & pair.second.unflipped, units=ROTATION.units)]
    table, = estimator.aggregates(
        results, paired_arrays(others, results, *ERROR_INPUTS, corners),
        ["renderer", *dataset.configuration_axes(results)], [statistics], Pair)
    return table.drop_vars("draws")


def _corner_shift(pair: Pair, corners: str) -> Floats:
    """Return the mean squared difference (..., 1) of the corners that both found, else NaN.

    Of a board the corners count that both found; one without any does not count.
    """
    moved = np.subtract(pair.second[corners], pair.first[corners], dtype=np.float64) ** 2
    inner = tuple(range(4, moved.ndim))  # behind groups, cells, draws and settings
    found = np.isfinite(moved).sum(axis=inner)
    total = np.nansum(moved, axis=inner)
    return np.where(found > 0, total / np.maximum(found, 1), np.nan)[..., None]


# --------------------------------------------------------------------------------------------------
# Whether a new store's results are significantly worse than an older one's, pose by pose.

#: Part of the older store's mean absolute error by which errors may grow: less is no regression.
#:
#: Another version of a library changes last digits of all poses in one direction: that is
#: significant, and of no account.
MARGIN = 0.01


def _first_error(quantity: Quantity) -> PairStatistic:
    """Return the mean error of the first of the poses that both solved."""
    return Mean(quantity.named("first"), "", lambda pair: quantity.norm(pair.first)[..., None],
                lambda pair: pair.both_solved)


def regressions(
    old: xr.Dataset, new: xr.Dataset, variables: Iterable[str] = (), per: Sequence[str] = (),
) -> list[dict[str, Any]]:
    """Return how the detection rate and the errors that ``variables`` are of have changed.

    Parameters
    ----------
    old, new
        Two stores over the same scenes and configurations, with the same seed.
    variables
        Names of required quantities; without any, rotation and range are compared.
    per
        Axes whose values are conditions; others of the scene are pooled.

    Returns
    -------
    list of dict
        The detection rate and each kind of error, for each configuration the worst condition:
        ``quantity``, "detection_rate" or a mean error in words; ``configuration`` and ``condition``
        (values by axis); ``difference``, new minus old, with its interval ``low`` to ``high`` at a
        level for all comparisons together (Bonferroni), in ``units``; ``worse``: whether it is
        significantly worse at any condition.
        The rate is worse if McNemar's exact test says so. An error is, if the lower end of the
        interval of its paired mean difference, on the poses that both solved, lies above `MARGIN`
        of the old mean. False "worse" of any has a probability below 0.05.

    Raises
    ------
    ArgumentError, DatasetError
        As in `sweep.analysis.compare`.
    """
    quantities = [each for each in dataset.ALL_QUANTITIES.values() if any(
        name.startswith(f"{each.name}_") and name.endswith(f"_{each.unit}") for name in variables)]
    quantities = quantities or list(QUANTITIES[:2])
    configuration = dataset.configuration_axes(new)
    kept = dataset.kept_dimensions(new, (*configuration, *dataset.as_names(per)))
    count = math.prod(new.sizes[name] for name in kept) * (1 + len(quantities))
    level = 1.0 - (1.0 - LEVEL) / count
    table, = paired_tables(
        old, new, kept, None, quantities, [level], [*map(_first_error, quantities)])
    if int(table["different_scenes"].sum()):
        raise DatasetError("the scenes of the two stores differ, so that nothing can be paired; "
                           "compare stores of one pipeline")
    rate = table["detection_difference"]
    compared = [("detection_rate", "detection_difference", "", -rate,
                 (rate < 0.0) & (table["detection_p_value"] <= 1.0 - level))]
    for each in quantities:
        name = each.named("difference")
        compared.append((f"mean absolute {each.words}", name, each.units, table[name],
                         table[f"{name}_low"] > MARGIN * table[each.named("first")]))
    conditions = [name for name in kept if name not in configuration]
    found = []
    for quantity, name, units, excess, worse in compared:
        # The worst condition is one that is significantly worse, if any is.
        columns = table[[f"{name}{end}" for end in INTERVAL]].assign(
            worse=worse, excess=excess.fillna(-np.inf).where(
                worse | ~worse.any(conditions), -np.inf))
        for at, one in dataset.each_cell(columns, configuration):
            cell = dataset.largest_cell(one, one["excess"].transpose(*conditions))
            difference, low, high = (float(cell[f"{name}{end}"]) for end in INTERVAL)
            found.append({
                "quantity": quantity, "configuration": at,
                "condition": {dim: cell[dim].item() for dim in conditions},
                "difference": difference, "low": low, "high": high, "units": units,
                "worse": bool(one["worse"].any())})
    return found


# --------------------------------------------------------------------------------------------------
# Differences between two stores of one pipeline, such as two versions of OpenCV made.

#: Coordinates of the dimension ``statistic`` -> share of the differences up to it.
STATISTICS = {"median": 0.5, "p99": 0.99, "worst": 1.0}

#: Differences of true poses up to which they are one: other processors round otherwise.
SAME_TRUTH = {"rtol": 1e-9, "atol": 1e-12, "equal_nan": True}

#: Variables of `store_differences`: meaning, units.
DIFFERENCES = {
    "computed_once": ("poses that one store computed and the other did not", "1"),
    "detections_compared": ("poses computed in both", "1"),
    "detections": ("poses by their flags in the first and in the second store", "1"),
    "detections_differing": ("poses computed in both, with another flag", "1"),
    "estimates": ("poses by their flags in the first and in the second store", "1"),
    "estimates_differing": ("poses computed in both, with another flag", "1"),
    "corners_compared": ("corners that both found", "1"),
    "corners_found_once": ("corners that one of both found", "1"),
    "corners_differing": ("corners with another coordinate", "1"),
    "corner_shift_px": ("distance of corners that differ", "px"),
    "poses_compared": ("poses that both solved", "1"),
    "poses_differing": ("poses with another position or rotation", "1"),
    "position_shift_m": ("distance of positions that differ", "m"),
    "rotation_shift_deg": ("angle of rotations that differ", "degree"),
    "fingerprint": ("what the results depend on and differs between the stores", ""),
}


@dataset.describes
def store_differences(first: xr.Dataset, second: xr.Dataset) -> xr.Dataset:
    """Return how detections, corners and poses of two stores of one pipeline differ.

    Parameters
    ----------
    first, second
        The datasets of two runs of the same pipeline, with other versions of OpenCV, NumPy, Numba,
        of a plug-in, or on other processors: draws and images are the same, so that each pose is
        compared with itself.

    Returns
    -------
    xr.Dataset
        Dimensions: the detector's settings, for estimates and poses also the
        estimator's; ``statistic``: median, p99 and worst. Scenes are pooled.

        - ``detections`` and ``estimates`` (..., first_flag, second_flag): poses by their flag in
          the first store and in the second; ``detections_compared``: those computed in both;
          ``detections_differing`` and ``estimates_differing``: those whose flag differs.
          ``computed_once``: poses that just one of the two computed.
        - ``corners_compared``: corners that both found; ``corners_found_once``: those that one
          found; ``corners_differing``: those of which x or y is another number, however near;
          ``corner_shift_px``: how far these are apart.
        - ``poses_compared``: poses that both solved; ``poses_differing``: those of which a
          component of position or rotation is another number; ``position_shift_m`` and
          ``rotation_shift_deg``: how far these are apart. NaN where none differs.
        - ``fingerprint`` (entry, store): versions, builds and files that differ, as text.

    Raises
    ------
    DatasetError
        In one line, if the datasets are not of one pipeline with the same axes, draws and seed.

    Notes
    -----
    Counts and quantiles describe the poses that were computed; they are no estimates and have
    no intervals. `sweep.analysis.compare` tells whether rates and errors differ beyond chance.

    Examples
    --------
    >>> moved = results.assign(corner_error_px=results["corner_error_px"] + 0.5)
    >>> table = store_differences(results, moved)
    >>> int(table["detections_differing"]), int(table["corners_differing"])
    (0, 96)
    >>> table["corner_shift_px"].values.round(4).tolist()
    [0.7071, 0.7071, 0.7071]
    """
    _require_one_pipeline(first, second)
    scene = axes_of(first, Stage.scene)
    read = [name for name in (*ERROR_INPUTS, *TRUTH, *CORNER_VARIABLES)
            if name in first and name in second]
    sides = [side[read].drop_vars([*side[read].coords]).compute() for side in (first, second)]
    for name in TRUTH:
        if name in read and not xr.apply_ufunc(
                np.isclose, *(side[name] for side in sides), kwargs=SAME_TRUTH).all():
            raise DatasetError(f"not the same true poses: {name} differs")
    once, *detections = _by_flags(DetectionStatus, "detection", sides, scene)
    _, _, *estimates = _by_flags(EstimateStatus, "estimate", sides, scene)
    computed = ~functools.reduce(operator.or_, (
        side["detection"].fillna(0).isin(dataset.NOT_AVAILABLE) for side in sides))
    corners = _apart([[side[name].where(computed) for name in CORNER_VARIABLES if name in read]
                      for side in sides], "xy", scene, _distance)
    shared, _, *moved = _apart([
        [xr.concat([side["translation_error_m"], side["rotation_error_rad"]], "xyz").where(
            side["estimate"] == EstimateStatus.solved)] for side in sides],
        "xyz", scene, _distance, _turn)
    changes = list(_changes(dataset.fingerprint_of(first), dataset.fingerprint_of(second)))
    fingerprint = xr.DataArray(
        np.array([pair for _, *pair in changes], dtype=object).reshape(-1, 2),
        dims=("entry", "store"))
    return xr.Dataset(
        {name: array.assign_attrs(cf_attributes(*described)) for (name, described), array in zip(
            DIFFERENCES.items(),
            [once, *detections, *estimates, *corners, shared, *moved, fingerprint], strict=True)},
        {**{dim: first[dim] for dim in axes_of(first) if dim not in scene and dim in first.coords},
         "statistic": list(STATISTICS), "store": ["first", "second"],
         "entry": np.array([entry for entry, _, _ in changes], dtype=object)})


def _by_flags(
    kind: type[IntEnum], stage: str, sides: Sequence[xr.Dataset], scene: Sequence[str]
) -> list[xr.DataArray]:
    """Return numbers of poses that one store computed, and of those that both computed.

    Of the latter: all, by their two flags (settings, flags, flags), those whose flags differ.
    """
    values, labels = np.array(list(kind)), [f"first_{stage}", f"second_{stage}"]

    def counts(*flags: Integers) -> Integers:
        codes = np.ravel_multi_index([np.searchsorted(values, each).ravel() for each in flags],
                                     [len(values)] * 2)
        return np.bincount(codes, minlength=len(values) ** 2).reshape([len(values)] * 2)

    # A dataset that was cut or joined has NaN where nothing was run.
    table = xr.apply_ufunc(
        counts, *(side[stage].fillna(0).astype(np.uint8) for side in sides),
        input_core_dims=[scene] * 2, output_core_dims=[labels], vectorize=True,
    ).assign_coords({label: [each.name for each in kind] for label in labels})
    done = [~table[label].isin(["not_run", "not_needed"]) for label in labels]
    both = table.where(done[0] & done[1], 0)
    return [table.where(done[0] ^ done[1], 0).sum(labels), both.sum(labels), both,
            both.where(table[labels[0]] != table[labels[1]], 0).sum(labels)]


def _apart(
    sides: Sequence[Sequence[xr.DataArray]], across: str, scene: Sequence[str],
    *lengths: Callable[[Floats, Floats], Floats],
) -> Sequence[xr.DataArray]:
    """Return how many vectors both stores have, one has and differ, and how far these are apart.

    Parameters
    ----------
    sides
        Of each store arrays of vectors along ``across``, NaN where there is none; they are pooled
        over scenes and labels.
    lengths
        Each between vectors (n, components) of both stores: the result has its `STATISTICS`.
    """
    def compared(first: Floats, second: Floats) -> tuple[Any, ...]:
        there = [~np.isnan(each).any(axis=1) for each in (first, second)]
        both = there[0] & there[1]
        differ = both & (first != second).any(axis=1)
        return (both.sum(), (there[0] ^ there[1]).sum(), differ.sum(), *(
            np.quantile(length(first[differ], second[differ]) if differ.any() else [np.nan],
                        [*STATISTICS.values()]) for length in lengths))

    listed = [xr.concat([array.astype(np.float64).stack(
        item=[dim for dim in (*scene, *LABELS) if dim in array.dims and dim != across],
        create_index=False) for array in side], "item") for side in sides]
    found: Sequence[xr.DataArray] = xr.apply_ufunc(
        compared, *listed, input_core_dims=[["item", across]] * 2,
        output_core_dims=[[]] * 3 + [["statistic"]] * len(lengths), vectorize=True)
    return found


def _distance(first: Floats, second: Floats) -> Floats:
    """Return the distances of corners, or of the positions of poses."""
    return np.asarray(np.sqrt(((second - first)[:, :3] ** 2).sum(axis=1)))


def _turn(first: Floats, second: Floats) -> Floats:
    """Return the angles between the rotations of poses, degrees."""
    # Errors are rotations from the true one: R2 R1ᵀ = (R2 Rᵀ)(R1 Rᵀ)ᵀ.
    ours, theirs = (rotation_of_vector(each[:, 3:]) for each in (first, second))
    turned = vector_of_rotation(theirs @ np.swapaxes(ours, -1, -2))
    return np.asarray(np.degrees(np.linalg.norm(turned, axis=-1)))


def _require_one_pipeline(first: xr.Dataset, second: xr.Dataset) -> None:
    """Raise DatasetError unless two datasets are of one pipeline."""
    for side in (first, second):
        dataset.require_poses(side)
        dataset.pose_arrays(side, ERROR_INPUTS)  # raises for the markers of boards
    require_pairs(first, second)
    ours, theirs = map(_parameters, (first, second))
    for name, *values in _changes(ours, theirs) if ours and theirs else ():
        raise DatasetError(f"not one pipeline: {name} is {' and '.join(values)}")


def _parameters(results: xr.Dataset) -> dict[str, Any]:
    """Return each parameter's value, distribution or values; of a file its content's digest.

    Nothing of a dataset that was cut or joined: its coordinates are compared.
    """
    pipeline = dataset.stored_pipeline(results)
    if pipeline is None:
        return {}

    def content(value: Any) -> Any:
        return pipeline.files.get(value, value) if isinstance(value, str) else value

    listed = {name: tuple(map(content, values))
              for axis in pipeline.axes for name, values in axis.columns.items()}
    values = pipeline.fixed | pipeline.distributions | listed
    return {name: content(value) for name, value in values.items()}


def _changes(
    first: Mapping[str, Any], second: Mapping[str, Any], prefix: str = ""
) -> Iterator[tuple[str, str, str]]:
    """Yield name and both values of each entry in which nested mappings differ."""
    for key in sorted({*first, *second}):
        ours, theirs = first.get(key, {}), second.get(key, {})
        if isinstance(ours, Mapping) and isinstance(theirs, Mapping):
            yield from _changes(ours, theirs, f"{prefix}{key}.")
        elif ours != theirs:
            old, new = (plain("none" if each == {} else each) for each in (ours, theirs))
            yield f"{prefix}{key}", old, new


# --------------------------------------------------------------------------------------------------
# Two datasets whose trials are units of markers: photographs, and a simulation's scenes.

SIDE = "side_px"

TRUTH_STD = "truth_std"

def is_measured(results: xr.Dataset) -> bool:
    """Return whether a dataset is measured in photographs."""
    return dataset.of_photographs(results) and not is_twin(results)


def is_twin(results: xr.Dataset) -> bool:
    """Return whether a dataset is simulated at the poses of photographs."""
    return dataset.of_photographs(results) and bool(results.coords.get(SIMULATED, False))


def _same_configurations(
    first: xr.Dataset, second: xr.Dataset, *, paired: bool
) -> tuple[xr.Dataset, xr.Dataset, tuple[str, ...]]:
    """Return both at their common settings, and the names of the axes of these.

    Twins are also at their common values of the scene; axes of it that they alone have are kept.
    """
    names = [*dict.fromkeys(
        name for side in (first, second) for name in dataset.configuration_axes(side))]
    for name in names:
        first, second = _with_axis(first, second, name), _with_axis(second, first, name)
    scenes = [[name for name in axes_of(side, Stage.scene) if name != DRAWS and paired]
              for side in (first, second)]
    common = {*names, *scenes[0]} & {*names, *scenes[1]}
    ours, theirs = xr.align(
        first, second, join="inner", exclude={*first.dims, *second.dims} - common)
    for name in names:
        if not ours.sizes[name]:
            raise DatasetError(
                f"no common {name}: {shown(first[name].values.tolist())} and "
                f"{shown(second[name].values.tolist())}; measure both with the same settings")
    own = [name for name in scenes[1] if name not in scenes[0]]
    ours = ours.drop_vars(own, errors="ignore").expand_dims(
        {name: theirs[name].values for name in own})
    return ours, theirs, (*names, *own)


def _with_axis(results: xr.Dataset, other: xr.Dataset, name: str) -> xr.Dataset:
    """Return a dataset with an axis of its one value, if it has none and the other has one."""
    if name in results.dims:
        return results
    if name not in PARAMETERS:
        raise DatasetError(f"{name}: one of both does not have this axis; measure both with it")
    value = np.asarray(dataset.parameter_value(results, name)).item()
    if other[name].dtype.kind in "OU":
        value = label(value)
    return results.drop_vars(name, errors="ignore").expand_dims({name: [value]})


def _trials_of(first: xr.Dataset, second: xr.Dataset) -> Integers:
    """Return the indices (photographs, repeats) of the trials of each photograph; -1 for none.

    Raises
    ------
    DatasetError
        If none is of these photographs.
    """
    files = [list(zip(*(side[name].values if name in side.coords else np.empty(0)
                        for name in ("photograph", "sha256")), strict=True))
             for side in (first, second)]
    trials = [[k for k, other in enumerate(files[1]) if other == each] for each in files[0]]
    most = max(map(len, trials))
    if not most:
        raise DatasetError("the simulation is the twin of other photographs")
    return np.array([some + [-1] * (most - len(some)) for some in trials])


def _gathered(results: dataset.Labelled, trials: xr.DataArray) -> dataset.Labelled:
    """Return the trials (photographs, repeats) of a twin; of -1 all is NaN: not run."""
    return results.drop_vars(DRAWS, errors="ignore").isel(
        {DRAWS: trials.clip(0)}).where(trials >= 0)


def _with_uncertain_truth(
    results: xr.Dataset, std: xr.DataArray, kept: Sequence[str]
) -> xr.Dataset:
    """Return twins whose errors have the truth's random error in them, as far as it is known.

    The photographs' errors are differences to a truth that has such an error, the twins' to an
    exact one. A draw is of a marker, the same for all its configurations.
    """
    one = std.isel({name: 0 for name in kept if name in std.dims}, drop=True)
    drawn = one.copy(data=np.random.default_rng(21).normal(size=one.shape)) * std.fillna(0.0)
    parts = {"rotation_error_rad": slice(3), "translation_error_m": slice(3, None)}
    return results.assign({
        name: results[name] + drawn.isel(pose_parameter=part).rename(pose_parameter="xyz")
        .drop_vars("xyz", errors="ignore") for name, part in parts.items()})


def _binned(results: xr.Dataset, name: str) -> xr.DataArray:
    """Return the binned quantity of a dataset: a variable, or one computed from others."""
    if name in results.variables and not dataset.is_fixed(results[name]):
        return results[name].reset_coords(drop=True)
    distance = results["true_tvec_m"].isel(xyz=2, drop=True)
    if name == SIDE:
        return (dataset.focal_size_of(results) / distance.drop_attrs()).assign_attrs(units="px")
    if name == "distance_m":
        return distance
    raise DatasetError(f"{name}: both datasets need it for bins; one has "
                       f"{', '.join(map(str, results.variables))}")


def _quarters(photographs: xr.Dataset) -> list[float]:
    """Return edges between the quarters of the photographs' sides, of two significant digits."""
    sides = photographs[SIDE].values
    edges = np.quantile(sides[np.isfinite(sides)], np.linspace(0.0, 1.0, 5))
    rounded = [float(f"{edge:.2g}") for edge in edges]
    rounded[0], rounded[-1] = float(np.floor(edges[0])), float(np.floor(edges[-1]) + 1)
    return sorted(set(rounded))


# --------------------------------------------------------------------------------------------------
# Photographs against a simulation: what of the errors in photographs the simulation has.

PERCENTS = {"median": 50, "p90": 90}

#: Photographs from which errors have intervals.
MIN_UNITS = 5

#: The dimension of photographs, or simulated scenes.
UNIT = "unit"


class ComparedRate(estimator.Rate[Poses]):
    """A rate that is compared by its difference."""

    ratio = False


@dataclass(frozen=True)
class SolvedQuantile(Statistic[Poses]):
    """A quantile of the errors (...) of solved poses.

    Attributes
    ----------
    percent
        Of the errors, at or below it.
    ratio
        Whether it is compared by its ratio, or else by its difference.
    """

    error: Callable[[Poses], Floats]
    percent: int = 50
    ratio: bool = False

    def outputs(self) -> Sequence[Output]:
        """Return the quantile with its interval, and what each unit has below it.

        That is the number of errors (unit,) at or below it, minus the expected number.
        """
        return [*super().outputs(), Output(f"{self.name}_below", "", "1", dims=(UNIT,))]

    def arrays(self, columns: Columns[Poses], design: estimator.Design) -> Sequence[NDArray[Any]]:
        """Return these; without an interval of fewer than `MIN_UNITS` units."""
        def solved(poses: Poses, _: slice) -> list[Floats]:
            errors = self.error(poses)
            return [np.where(poses.solved & np.isfinite(errors), errors, np.nan)]

        errors, = columns.joined(solved)  # a single cell; none if there is nothing
        used = (~np.isnan(errors)).sum(axis=3)
        interval = estimator.quantile_intervals(errors, used, [self.percent], design)[:, 0]
        interval[(used > 0).sum(axis=(1, 2)) < MIN_UNITS, 1:] = np.nan
        below = (errors <= interval[:, :1, None, None]).sum(axis=3) - self.percent / 100.0 * used
        return [*interval.T, below.sum(axis=1)]


#: All, in the order of the table.
GAP_STATISTICS: tuple[ComparedRate | SolvedQuantile, ...] = (
    *(ComparedRate(each.name, each.meaning, each.successes, each.used)
      for each in (DETECTION_RATE, estimator.FLIP_RATE)),
    SolvedQuantile("range_bias_median_percent", "median depth error of the true depth, solved",
                   lambda poses: poses.range_percent[..., 0], units="percent"),
    *(SolvedQuantile(
        quantity.named(statistic), f"{percent} % quantile of the absolute {quantity.words}, solved",
        quantity.norm, percent, ratio=True, units=quantity.units)
      for quantity in QUANTITIES[:2] for statistic, percent in PERCENTS.items()),
)

COUNTS: tuple[Statistic[Poses], ...] = (
    Count("looked_for", "markers that were run, visible and modelled",
          lambda poses: poses.looked_for),
    Count("solved", "solved poses", lambda poses: poses.solved),
    Count("units", "photographs, or simulated scenes, with a marker",
          lambda poses: np.asarray(poses.looked_for.any(axis=(1, 3), keepdims=True))),
)


@dataset.describes
def simulation_gap(
    photographs: xr.Dataset, simulated: xr.Dataset, bins: Bins | None = None
) -> xr.Dataset:
    """Return statistics of photographs and of a simulation, and the gap between them.

    Parameters
    ----------
    photographs
        The dataset of photographs, as `sweep.photos` returns it.
    simulated
        Their twins (`sweep.twins`), which are compared marker by marker, or any other
        simulation, which is compared bin by bin.
    bins
        Edges (n + 1,) of bins [low, high) of variables of the scene, by name. Default: none for
        twins; else the quarters of the photographs' ``side_px``.

    Returns
    -------
    xr.Dataset
        Dimensions: the settings of detector and estimator that both have (and what the twins'
        scenes vary), then the bins; of both sources also ``source``, "photographs" or "simulated".
        The interval of ``x`` is in ``x_low`` and ``x_high``.

        - ``looked_for``, ``solved``: markers, times repeats; ``units``: photographs, or scenes of
          a simulation, that have any.
        - ``detection_rate`` of ``looked_for``, ``flip_rate`` of ``solved``.
        - ``range_bias_median_percent``: median depth error of the solved; ``rotation_median_deg``,
          ``rotation_p90_deg``, ``range_median_percent``, ``range_p90_percent``: quantiles of their
          absolute errors.
        - ``x_gap`` of each: simulated minus photographs of rates and of the bias, simulated over
          photographs of quantiles of absolute errors.

    Raises
    ------
    ArgumentError
        For bins that cannot be.
    DatasetError
        If the first is not of photographs, if the second is the twin of other photographs, or if
        they have no setting in common.

    Notes
    -----
    The photographs' errors have the random error of their truth in them. To those of twins as much
    is added: a draw for each marker, of ``truth_std`` where it is known.

    95 % intervals in which a photograph with all its markers is the draw; NaN of errors in fewer
    than five photographs. Of rates and quantiles they are as in `sweep.analysis.error_statistics`;
    of gaps they follow from both of these (Newcombe, Statistics in Medicine 17, 1998; of ratios
    from their logarithms). Gaps of rates do not count on the pairing; of quantiles of twins the
    errors of both are correlated as their numbers of errors below them, photograph by photograph.

    Examples
    --------
    >>> files = ("trial", list("abcdefgh"))
    >>> shots = results.assign_coords(photographs="shots", photograph=files, sha256=files)
    >>> twins = shots.sel(solver=["ippe"]).assign_coords(simulated=True)
    >>> gap = simulation_gap(shots, twins)
    >>> gap["rotation_median_deg_gap"].values.tolist(), gap["solved"].values.tolist()
    ([1.0], [[13], [13]])
    """
    if not is_measured(photographs):
        raise DatasetError(
            "the first dataset: expected photographs, as `sweep photos` measures them; two "
            "simulations are compared by sweep.analysis.compare"
        )
    for side in (photographs, simulated):
        dataset.require_poses(side)
    paired = is_twin(simulated)
    first, second, kept = _same_configurations(photographs, simulated, paired=paired)
    if bins is None:
        bins = {} if paired else {SIDE: _quarters(first)}
    estimator.read_bins(first, kept, bins)
    scene = [name for name in axes_of(second, Stage.scene) if name not in kept]
    std = second.get(TRUTH_STD)
    first, second = (
        side[list(ERROR_INPUTS)].assign({name: _binned(side, name) for name in bins})
        .drop_attrs(deep=False) for side in (first, second))
    if paired:
        # Trials of the same index are then of the same photograph.
        trials = _trials_of(photographs, simulated)
        some = np.flatnonzero((trials >= 0).any(axis=1))
        at = xr.DataArray(trials[some], dims=(DRAWS, "repeat"))  # of one photograph
        first, second = first.isel({DRAWS: some}), _gathered(second, at)
        if std is not None:
            second = _with_uncertain_truth(second, _gathered(std, at), kept)
    elif scene and not dataset.of_photographs(simulated):
        # Each scene counts as a photograph.
        second = second.drop_vars(DRAWS, errors="ignore").stack(
            unit=sorted(scene, key=lambda name: name != DRAWS), create_index=False)
        second = second.rename(unit=DRAWS).assign_coords({PHOTOGRAPHS: ""})
    tables = [table for side in (first, second) for table in estimator.aggregates(
        side, dataset.pose_arrays(side, ERROR_INPUTS), kept, [[*COUNTS, *GAP_STATISTICS]],
        Poses, bins, stopped=False)]
    first, second = (table.drop_vars([
        name for name, value in table.coords.items() if not value.dims]) for table in tables)
    gaps: dict[str, xr.DataArray] = {}
    for each in GAP_STATISTICS:
        words = "simulated over photographs" if each.ratio else "simulated minus photographs"
        outputs = estimator.with_interval(
            f"{each.name}_gap", f"{words}: {each.meaning}", "1" if each.ratio else each.units)
        with np.errstate(divide="ignore", invalid="ignore"):
            gaps |= {output.name: array.assign_attrs(cf_attributes(output.meaning, output.units))
                     for output, array in zip(outputs, _gap(
                         each, first, second, paired=paired), strict=True)}
    both = xr.concat([first.drop_dims(UNIT), second.drop_dims(UNIT)], "source", coords="minimal",
                     compat="override", join="override")
    return both.assign(gaps).assign_coords(source=["photographs", "simulated"]).assign_attrs(
        paired=int(paired))


def _gap(
    each: ComparedRate | SolvedQuantile, first: xr.Dataset, second: xr.Dataset, *, paired: bool
) -> Sequence[xr.DataArray]:
    """Return the difference or ratio of a statistic in two tables, with its interval."""
    below, correlation = f"{each.name}_below", xr.DataArray(0.0)
    if paired and below in first:
        correlation = xr.corr(first[below], second[below], UNIT).fillna(0.0)
    one, other = ([table[f"{each.name}{end}"] for end in INTERVAL] for table in (first, second))
    if not each.ratio:
        return difference_interval(one, other, correlation)
    found = difference_interval([*map(np.log, one)], [*map(np.log, other)], correlation)
    return [np.exp(end) for end in found]
