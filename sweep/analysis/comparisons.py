"""Paired comparisons: configurations, renderers, and stores on the same images."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.analysis.dataset import (
    DRAWS,
    as_names,
    axes_of,
    configuration_axes,
    describes,
    fingerprint_of,
    is_grid_axis,
    is_sampling_stopped,
    kept_dimensions,
    require_dimension,
    require_poses,
    stored_pipeline,
)
from sweep.analysis.estimator import (
    INTERVAL,
    Arrays,
    Bins,
    Count,
    Mean,
    Rate,
    RootMeanSquare,
    RootMeanSquareRatio,
    Statistic,
    aggregate,
    newcombe_and_mcnemar,
    stopped_level,
)
from sweep.analysis.intervals import LEVEL
from sweep.analysis.poses import (
    DETECTION_INPUTS,
    ERROR_INPUTS,
    OF_MARKERS,
    QUANTITIES,
    SIGNED,
    Poses,
    Quantity,
    norm_squared,
    pose_arrays,
)
from sweep.errors import ArgumentError, DatasetError, SweepError
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import LABELS, cf_attributes
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.messages import plain
from sweep.model.pose import rotation_of_vector, vector_of_rotation
from sweep.typing import Floats, Integers, Masks

# --------------------------------------------------------------------------------------------------
# The same poses with two configurations, of a store or of two stores, as statistics read them.

TRUTH = ("true_tvec_m", "true_rvec")
"""Variables that are the same for both poses of a pair."""

DIFFERING = "differing"
"""Name of the mask of the pairs whose truth differs."""


class Pair:
    """The poses of two datasets, pose by pose.

    Parameters
    ----------
    arrays
        Those of `paired_arrays`, (groups, cells, draws, settings, ...).
    """

    def __init__(self, arrays: Arrays) -> None:
        self.first, self.second = Poses(arrays, "first "), Poses(arrays, "second ")
        self._arrays = arrays

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
        return self._arrays[DIFFERING]

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


# --------------------------------------------------------------------------------------------------
# How far corners and poses moved between two treatments of the same images, as statistics.

CORNERS = "corner_error_px"
OF_BOARDS = next(name for name, single in OF_MARKERS.items() if single == CORNERS)
ROTATION_VARIABLE = "rotation_error_rad"

_ROTATION, _DEPTH = QUANTITIES[:2]

_POSE_DIMENSIONS = 4
"""Groups, cells, draws and settings: what stands before the dimensions of a pose's corners."""


def corners_of(results: xr.Dataset) -> str:
    """Return the name of the corners' errors: a marker's, or those of a board's markers."""
    return OF_BOARDS if OF_BOARDS in results else CORNERS


def corner_shift(whose: str, corners: str) -> RootMeanSquare[Pair]:
    """Return the RMS of the second corners minus the first, ``whose`` in its description.

    ``corners`` as :func:`corners_of` returns it. Of a board the corners count that both found; one
    without any does not count.
    """
    def in_both(pair: Pair) -> Masks:
        shown = pair.compared & pair.first.detected & pair.second.detected
        return shown if corners == CORNERS else np.asarray(
            shown & np.isfinite(_corner_shift(pair, corners)[..., 0]))

    return RootMeanSquare(
        "corner_shift_rms_px", f"RMS of a corner's coordinate minus {whose}", "px",
        lambda pair: _corner_shift(pair, corners), in_both)


def pose_shifts(whose: str) -> list[Mean[Pair] | RootMeanSquare[Pair]]:
    """Return bias of the range and RMS of the rotation, second minus first, as `corner_shift`."""
    return [
        Mean("range_bias_percent",
             f"mean depth error minus {whose}, of the true depth, both solved", "percent",
             lambda pair: _DEPTH.vector(pair.second) - _DEPTH.vector(pair.first),
             lambda pair: pair.both_solved),
        RootMeanSquare(
            "rotation_shift_deg",
            f"RMS of the rotation error minus {whose}, both solved and not flipped",
            _ROTATION.units, _rotation_shift,
            lambda pair: pair.first.unflipped & pair.second.unflipped),
    ]


def _corner_shift(pair: Pair, corners: str) -> Floats:
    """Return the mean squared difference (..., 1) of the corners that both found, else NaN."""
    moved = np.subtract(pair.second[corners], pair.first[corners], dtype=np.float64) ** 2
    if corners == CORNERS:
        return np.asarray(moved.mean(axis=(-2, -1))[..., None])
    inner = tuple(range(_POSE_DIMENSIONS, moved.ndim))
    found = np.isfinite(moved).sum(axis=inner)
    total = np.nansum(moved, axis=inner)
    return np.where(found > 0, total / np.maximum(found, 1), np.nan)[..., None]


def _rotation_shift(pair: Pair) -> Floats:
    moved = np.subtract(
        pair.second[ROTATION_VARIABLE], pair.first[ROTATION_VARIABLE], dtype=np.float64
    )
    return norm_squared(np.degrees(moved))[..., None]


# --------------------------------------------------------------------------------------------------
# Two configurations on the same scenes, pose by pose: what differs, and whether it is chance.

PairStatistic = Statistic[Pair]

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
    any cell has two draws, ``drawn``. ``level`` is that of all intervals.
    """
    stopped = is_sampling_stopped(first) or is_sampling_stopped(second)
    if stopped:
        first, second = _of_common_trials(first, second)
    require_pairs(first, second)
    own = [name for name, value in first.coords.items() if not value.dims
           and not (name in second.coords and value.equals(second.coords[name]))]
    first = first.drop_vars(own)  # such as the name of its solver
    names = dict.fromkeys(name for quantity in quantities for name in quantity.inputs)
    inputs = paired_arrays(*(
        pose_arrays(side, (*ERROR_INPUTS, *names)) for side in (first, second)))
    inputs[DIFFERING] = sum(
        ((first[name] != second[name]).any("xyz").reset_coords(drop=True)
         for name in TRUTH if name in first and name in second), xr.DataArray(False))
    statistics: list[PairStatistic] = [
        *_agreement("detected", lambda poses: poses.detected),
        *_agreement("solved", lambda poses: poses.solved),
        *_flipped_in_one(),
        Count("compared", "poses that were looked for in both",
                     lambda pair: pair.compared, "draws", "drawn"),
        Count("run_in_one", "poses that one of the two alone ran, which are not compared",
              lambda pair: pair.first.run != pair.second.run),
        Count("different_scenes", "compared poses whose truth differs, so that they are no pairs",
              lambda pair: pair.compared & pair.differing),
        *(statistic for quantity in quantities for statistic in _differences(quantity, level)),
    ]
    table = aggregate(first, inputs, kept, statistics, Pair, bins, stopped=stopped)
    return table.assign(_tested(table, stopped_level(level) if stopped else level))


def _of_common_trials(
    first: xr.Dataset, second: xr.Dataset
) -> tuple[xr.Dataset, xr.Dataset]:
    """Return two datasets with the trials that are on the axes of both."""
    if not all(DRAWS in side.dims for side in (first, second)):
        return first, second
    common = np.intersect1d(first[DRAWS].values, second[DRAWS].values)
    return first.sel({DRAWS: common}), second.sel({DRAWS: common})


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
                            "1", both_squares, solved, level),
    ]
    if quantity is not ROTATION:
        return differences
    return [*differences, RootMeanSquareRatio(
        f"{quantity.name}_rmse_unflipped_ratio",
        f"second RMS {words} over the first, flipped in neither", "1", both_squares,
        lambda pair: pair.first.unflipped & pair.second.unflipped, level)]


def _tested(table: xr.Dataset, level: float) -> dict[str, xr.DataArray]:
    """Return the differences of both rates with their intervals, and McNemar's tests."""
    tested: dict[str, xr.DataArray] = {}
    for rate, reached in (("detection", "detected"), ("solved", "solved")):
        counts = [table[f"{name}_{reached}"] for name in (
            "both", "only_first", "only_second", "neither")]
        arrays = xr.apply_ufunc(
            newcombe_and_mcnemar, *counts, table["draws"], table["drawn"],
            kwargs={"level": level}, output_core_dims=[[]] * 4)
        difference = f"{rate} rate, second minus first"
        meanings = {
            **{f"{rate}_difference{end}": words + difference for end, words in INTERVAL.items()},
            f"{rate}_p_value": f"chance that the discordant counts differ so much if the {rate} "
                               "rates are equal (McNemar, exact)",
        }
        tested |= {
            name: array.assign_attrs(long_name=meaning, units="1")
            for (name, meaning), array in zip(meanings.items(), arrays, strict=True)
        }
    return tested


# --------------------------------------------------------------------------------------------------
# What a renderer changes against the exact one, paired scene by scene.

@describes
def renderer_bias(results: xr.Dataset, reference: str = "exact") -> xr.Dataset:
    """Return what each renderer changes against ``reference``, paired scene by scene.

    Parameters
    ----------
    results
        The dataset of a run with a dimension ``renderer``.
    reference
        The renderer that the others are compared with.

    Returns
    -------
    xr.Dataset
        Dimensions: renderer and those of the detector's settings; for the pose variables also
        those of the estimator's. All others are pooled. The interval of
        ``x`` is in ``x_low`` and ``x_high``.

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
        If ``reference`` is not a renderer of the dataset.
    DatasetError
        If the dataset has no dimension ``renderer``, lacks variables of results, or has no poses.

    Notes
    -----
    95 % intervals over the random draws, conditional on the grid, as in `sweep.analysis.compare`.

    Examples
    --------
    >>> both = xr.concat([results, results], dim="renderer").assign_coords(
    ...     renderer=["exact", "area"])
    >>> renderer_bias(both)["detection_disagreement"].values.tolist()
    [0.0, 0.0]
    """
    require_dimension(results, "renderer")
    renderers = [str(name) for name in results["renderer"].values]
    if reference not in renderers:
        raise ArgumentError("reference", reference, f"the renderers are {', '.join(renderers)}")
    others = results.isel(renderer=renderers.index(reference), drop=True)
    scene = axes_of(results, Stage.scene)

    def kept(name: str) -> list[str]:
        return ["renderer", *(str(dim) for dim in results[name].dims if dim not in scene)]

    def pairs(*names: str) -> dict[str, xr.DataArray]:
        return paired_arrays(pose_arrays(others, names), pose_arrays(results, names))

    corners = corners_of(results)
    detections = aggregate(
        results, pairs(*DETECTION_INPUTS, corners), kept("detection"),
        [
            Rate("detection_disagreement", "differing of compared",
                 lambda pair: pair.first.detected != pair.second.detected,
                 lambda pair: pair.compared,
                 counts=(("compared", "poses that were looked for with both renderers"),
                         ("differing", "poses detected with one of both renderers only"))),
            corner_shift("the reference's", corners),
        ],
        Pair,
    )
    poses = aggregate(
        results, pairs(*ERROR_INPUTS), kept("estimate"), pose_shifts("the reference's"), Pair)
    return detections.drop_vars("draws").assign(poses)


# --------------------------------------------------------------------------------------------------
# Whether a new store's results are significantly worse than an older one's, pose by pose.

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
    table = paired_table(old, new, kept, None, quantities, level)
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


# --------------------------------------------------------------------------------------------------
# Differences between two stores of one pipeline, such as two versions of OpenCV made.

CORNER_VARIABLES = ("corner_error_px", "marker_corner_error_px", "chessboard_corner_error_px")
"""Variables of corners: of a single marker, or of a board's markers and of its chessboard."""

STATISTICS = ("median", "p99", "worst")
"""Coordinates of the dimension ``statistic``."""

TRUTH_RTOL = 1e-9
"""Relative difference of true poses up to which they are one: other processors round otherwise."""

_NOT_COMPUTED = (DetectionStatus.not_run, DetectionStatus.not_needed)


@describes
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
        Dimensions: those of the detector's settings, for estimates and poses also those of the
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
    Counts and quantiles are those of the poses that were computed; they are no estimates and have
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
    found = [dim for dim in axes_of(first, Stage.scene, Stage.detection) if dim not in scene]
    solved = [dim for dim in axes_of(first) if dim not in scene]
    corners = [name for name in CORNER_VARIABLES if name in first and name in second]
    sides = (first, second)
    _require_equal_truths(first, second, scene)
    flags = [_column(side, "detection", scene, found) for side in sides]
    computed = [~np.isin(each, _NOT_COMPUTED) for each in flags]
    both = computed[0] & computed[1]
    once = (computed[0] ^ computed[1]).sum(axis=0)
    detections = _flag_counts(DetectionStatus, flags, both)
    shifts = _total([_corner_shifts(sides, name, scene, found, both) for name in corners],
                    both.shape[1])
    flags = [_column(side, "estimate", scene, solved) for side in sides]
    estimates = _flag_counts(EstimateStatus, flags, np.logical_and(*(
        ~np.isin(each, (EstimateStatus.not_run, EstimateStatus.not_needed)) for each in flags)))
    motions = _total([_motions(sides, scene, solved, np.logical_and(*(
        each == EstimateStatus.solved for each in flags)))], flags[0].shape[1])
    table = xr.Dataset(coords={
        **{dim: first[dim] for dim in solved if dim in first.coords},
        "statistic": list(STATISTICS),
    })
    sizes = {dim: first.sizes[dim] for dim in solved}
    for name, dims, values, meaning, units in (
        ("detections_compared", found, detections.sum(axis=(1, 2)), "poses computed in both", "1"),
        ("detections_differing", found, _differing(detections),
         "of them, poses with another flag of detection", "1"),
        ("computed_once", found, once, "poses that one store computed and the other did not", "1"),
        ("corners_compared", found, shifts.compared, "corners that both found", "1"),
        ("corners_found_once", found, shifts.once, "corners that one of both found", "1"),
        ("corners_differing", found, shifts.differing, "corners with another coordinate", "1"),
        ("corner_shift_px", found, shifts.statistics[0], "distance of corners that differ", "px"),
        ("estimates_differing", solved, _differing(estimates),
         "poses with another flag of the estimate", "1"),
        ("poses_compared", solved, motions.compared, "poses that both solved", "1"),
        ("poses_differing", solved, motions.differing,
         "poses with another position or rotation", "1"),
        ("position_shift_m", solved, motions.statistics[0], "distance of positions that differ",
         "m"),
        ("rotation_shift_deg", solved, motions.statistics[1], "angle of rotations that differ",
         "degree"),
    ):
        shape = [sizes[dim] for dim in dims]
        inner = ["statistic"] if units != "1" else []
        table[name] = (
            (*dims, *inner), np.reshape(values, (*shape, *(len(STATISTICS) for _ in inner))),
            cf_attributes(meaning, units),
        )
    for name, dims, counts, flag in (
        ("detections", found, detections, DetectionStatus),
        ("estimates", solved, estimates, EstimateStatus),
    ):
        kinds = [each.name for each in flag]
        labels = [f"{side}_{name.removesuffix('s')}" for side in ("first", "second")]
        table = table.assign_coords(dict.fromkeys(labels, kinds))
        table[name] = (
            (*dims, *labels), counts.reshape(*(sizes[dim] for dim in dims), *[len(kinds)] * 2),
            cf_attributes("poses by their flags in the first and in the second store", "1"),
        )
    differences = list(_fingerprint_differences(fingerprint_of(first), fingerprint_of(second)))
    table = table.assign_coords(
        entry=np.array([entry for entry, _, _ in differences], dtype=object),
        store=["first", "second"],
    )
    table["fingerprint"] = (
        ("entry", "store"),
        np.array([pair for _, *pair in differences], dtype=object).reshape(-1, 2),
        cf_attributes("what the results depend on and differs between the stores"),
    )
    return table


def _flag_counts(
    kind: type[IntEnum], flags: Sequence[NDArray[Any]], both: Masks
) -> Integers:
    """Return the poses that both computed by their two flags: (configurations, flags, flags)."""
    values = np.array(list(kind))
    size, count = len(values), both.shape[1]
    codes = np.searchsorted(values, flags[0]) * size + np.searchsorted(values, flags[1])
    codes = codes + np.arange(count) * size**2
    counts = np.bincount(codes[both].ravel(), minlength=count * size**2)
    return counts.reshape(count, size, size)


def _differing(counts: Integers) -> Integers:
    """Return the poses (configurations,) with two different flags."""
    return np.asarray(counts.sum(axis=(1, 2)) - np.trace(counts, axis1=1, axis2=2))


class _Shift(NamedTuple):
    """Which items (scenes, configurations, items) both have, one has, and which differ.

    ``distances`` (differing items,) are how far these are apart, in one unit or more.
    """

    both: Masks
    once: Masks
    differ: Masks
    distances: tuple[Floats, ...]


class _Total(NamedTuple):
    """Numbers of items (configurations,), and `STATISTICS` (configurations, 3) of distances."""

    compared: Integers
    once: Integers
    differing: Integers
    statistics: list[Floats]


def _total(shifts: Sequence[_Shift], configurations: int) -> _Total:
    """Return the sums over shifts of several kinds of items."""
    none = np.zeros(configurations, dtype=np.int64)
    compared, once, differing = (
        none + sum(mask.sum(axis=(0, 2)) for mask in masks) for masks in (
            [each.both for each in shifts], [each.once for each in shifts],
            [each.differ for each in shifts]))
    numbers = [np.nonzero(each.differ)[1] for each in shifts]
    units = zip(*(each.distances for each in shifts), strict=True) if shifts else [()]
    statistics = []
    for distances in units:
        values = [
            np.concatenate([np.empty(0), *(
                each[number == k] for each, number in zip(distances, numbers, strict=True))])
            for k in range(configurations)]
        statistics.append(np.array([
            [*np.quantile(each, (0.5, 0.99)), each.max()] if each.size
            else [np.nan] * len(STATISTICS) for each in values]))
    return _Total(compared, once, differing, statistics)


def _column(
    results: xr.Dataset, name: str, scene: Sequence[str], settings: Sequence[str]
) -> NDArray[Any]:
    """Return a variable as (scenes, configurations, ...); 0 for flags that are missing."""
    array = results[name]
    inner = [str(dim) for dim in array.dims if dim in LABELS]
    values = array.transpose(*scene, *settings, *inner).to_numpy()
    lengths = [int(np.prod([array.sizes[dim] for dim in dims])) for dims in (scene, settings)]
    values = values.reshape(*lengths, *(array.sizes[dim] for dim in inner))
    return values if inner else np.nan_to_num(values, nan=0.0)


def _corner_shifts(
    pair: Sequence[xr.Dataset], name: str, scene: Sequence[str], settings: Sequence[str],
    computed: Masks,
) -> _Shift:
    """Return how corners differ; the distance is in pixels."""
    first, second = (_column(side, name, scene, settings) for side in pair)
    first, second = (each.reshape(*each.shape[:2], -1, 2) for each in (first, second))
    has_first, has_second = (np.isfinite(each).all(axis=-1) for each in (first, second))
    both = has_first & has_second & computed[..., None]
    once = (has_first ^ has_second) & computed[..., None]
    differ = both & (first != second).any(axis=-1)
    moved = np.subtract(second[differ], first[differ], dtype=np.float64)
    return _Shift(both, once, differ, (np.linalg.norm(moved, axis=-1),))


def _motions(
    pair: Sequence[xr.Dataset], scene: Sequence[str], settings: Sequence[str], both: Masks
) -> _Shift:
    """Return how poses that both solved differ; distances are in metres and in degrees."""
    positions, rotations = (
        [_column(side, name, scene, settings) for side in pair]
        for name in ("translation_error_m", "rotation_error_rad")
    )
    differ = both & np.logical_or(*(
        (first != second).any(axis=-1) for first, second in (positions, rotations)
    ))
    first, second = (each[differ].astype(np.float64) for each in positions)
    distance = np.linalg.norm(second - first, axis=-1)
    # Errors are rotations from the true one: R2 R1ᵀ = (R2 Rᵀ)(R1 Rᵀ)ᵀ.
    first, second = (rotation_of_vector(each[differ].astype(np.float64)) for each in rotations)
    relative = vector_of_rotation(second @ np.swapaxes(first, -1, -2))
    turned = np.degrees(np.linalg.norm(relative, axis=-1))
    return _Shift(
        both[..., None], np.zeros_like(both)[..., None], differ[..., None], (distance, turned))


def _require_one_pipeline(first: xr.Dataset, second: xr.Dataset) -> None:
    """Raise DatasetError unless two datasets are of one pipeline."""
    for side in (first, second):
        require_poses(side)
        pose_arrays(side, ERROR_INPUTS)  # raises for the markers of boards
    require_pairs(first, second)
    settings = [set(axes_of(side)) - set(axes_of(side, Stage.scene)) for side in (first, second)]
    if settings[0] != settings[1]:
        names = ", ".join(sorted(settings[0] ^ settings[1]))
        raise DatasetError(f"not one pipeline: just one of the two has the axis {names}")
    for name in sorted(settings[0]):
        if not np.array_equal(first[name].values, second[name].values):
            raise DatasetError(f"not one pipeline: the values of {name} differ")
    try:
        ours, theirs = (_parameters(stored_pipeline(side)) for side in (first, second))
    except (KeyError, SweepError):
        return  # they were cut or joined: their coordinates have been compared
    for name in sorted({*ours, *theirs}):
        if ours.get(name) != theirs.get(name):
            values = (plain(each.get(name, "not given")) for each in (ours, theirs))
            raise DatasetError(f"not one pipeline: {name} is {' and '.join(values)}")


def _parameters(pipeline: Pipeline) -> dict[str, Any]:
    """Return each parameter's value, distribution or values; of a file its content's digest."""
    def content(value: Any) -> Any:
        return pipeline.files.get(value, value) if isinstance(value, str) else value

    listed = {
        name: tuple(map(content, values))
        for axis in pipeline.axes for name, values in axis.columns.items()
    }
    fixed = {name: content(value) for name, value in pipeline.fixed.items()}
    return {**fixed, **pipeline.distributions, **listed}


def _require_equal_truths(first: xr.Dataset, second: xr.Dataset, scene: Sequence[str]) -> None:
    """Raise DatasetError unless the true poses are the same, but for rounding."""
    for name in TRUTH:
        if name not in first or name not in second:
            continue
        ours, theirs = (_column(side, name, scene, ()) for side in (first, second))
        if not np.allclose(ours, theirs, TRUTH_RTOL, 1e-3 * TRUTH_RTOL, equal_nan=True):
            raise DatasetError(f"not the same true poses: {name} differs")


def _fingerprint_differences(
    first: Mapping[str, Any], second: Mapping[str, Any], prefix: str = ""
) -> Iterator[tuple[str, str, str]]:
    """Yield name and both values of each entry in which two fingerprints differ."""
    for key in sorted({*first, *second}):
        ours, theirs = first.get(key, {}), second.get(key, {})
        if isinstance(ours, Mapping) and isinstance(theirs, Mapping):
            yield from _fingerprint_differences(ours, theirs, f"{prefix}{key}.")
        elif ours != theirs:
            yield f"{prefix}{key}", plain(ours or "none"), plain(theirs or "none")
