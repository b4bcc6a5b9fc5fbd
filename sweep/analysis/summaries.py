"""Rates, rankings, errors and thresholds by condition; errors against covariance and bound."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy import special, stats

from sweep.analysis import dataset, estimator
from sweep.analysis.dataset import DRAWS, QUANTITIES, Poses, Quantity, as_names, describes, stacked
from sweep.analysis.estimator import FLIP_RATE, INTERVAL, LEVEL, Bins, Count, Mean, Rate, Statistic
from sweep.errors import ArgumentError
from sweep.experiment.schema import POSE_PARAMETERS, cf_attributes
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flag, flag, outcomes
from sweep.typing import Floats, Masks

# --------------------------------------------------------------------------------------------------
# How often a marker is detected, where its poses are lost, and how often a pose is mirrored.

LOOKED_FOR = ("looked_for", "poses that were run, visible and modelled")
SOLVED = ("solved", "solved poses")
FLIPPED = ("flipped", "solved poses that are nearer to the mirror of the truth")

DETECTION_RATE: Rate[Poses] = Rate(
    "detection_rate", "detected of looked_for", lambda poses: poses.detected,
    lambda poses: poses.looked_for, inputs=dataset.DETECTION_INPUTS)
SOLVED_RATE: Rate[Poses] = Rate(
    "solved_rate", "solved of looked_for", lambda poses: poses.solved,
    lambda poses: poses.looked_for, inputs=dataset.ESTIMATE_INPUTS)


@describes
def detection_rate(
    results: xr.Dataset, per: Sequence[str] = (), bins: Bins | None = None
) -> xr.Dataset:
    """Return how often the marker is detected.

    Parameters
    ----------
    results
        The dataset of a run, as `sweep.open` and `sweep.run` return it.
    per
        Dimensions that are kept; all others are pooled.
    bins
        Edges (n + 1,) of bins [low, high) of variables or coordinates of the scene, by name:
        ``{"marker_area_px": [100, 1000, 10000]}``. Each gives a dimension of that name, with the
        middle of each bin as its coordinate and the edges in ``marker_area_px_low`` and
        ``marker_area_px_high``. Poses outside all bins are left out.

    Returns
    -------
    xr.Dataset
        Dimensions (*per, *bins).

        - ``looked_for``: poses whose detection is none of not_run, not_visible, not_modelled, and
          ``detected`` of these.
        - ``draws``: the random draws that they are worth, since pooled settings see the same ones
          (`sweep.analysis.estimator.Sample.draws`).
        - ``detection_rate`` with Wilson's interval in ``detection_rate_low`` and
          ``detection_rate_high``.

    Raises
    ------
    ArgumentError
        For a dimension that does not exist, and for bins that cannot be.
    DatasetError
        If the dataset lacks variables of results, or has no poses.

    Notes
    -----
    95 % intervals over the random draws, conditional on the grid; NaN if no cell has two draws.
    See `sweep.analysis.estimator` for the formulas and their sources.

    Examples
    --------
    >>> table = detection_rate(results, per=["side_px"])
    >>> table["detected"].values.tolist(), table["looked_for"].values.tolist()
    ([0, 5, 8], [8, 8, 8])
    >>> table["detection_rate_low"].round(3).values.tolist()
    [0.0, 0.306, 0.676]
    """
    rate = replace(DETECTION_RATE, counts=(LOOKED_FOR, ("detected", "detected poses")))
    return _table(results, per, bins, [rate])


@describes
def flip_rate(
    results: xr.Dataset, per: Sequence[str] = (), bins: Bins | None = None
) -> xr.Dataset:
    """Return how often a solution is nearer to the mirror of the truth than to the truth.

    Parameters
    ----------
    results, per, bins
        As in `detection_rate`.

    Returns
    -------
    xr.Dataset
        Dimensions (*per, *bins). ``flipped`` of ``solved`` poses, the
        ``draws`` that these are worth, and ``flip_rate`` with intervals as in `detection_rate`.

    Raises
    ------
    ArgumentError, DatasetError
        As in `detection_rate`.

    Notes
    -----
    It means nothing for frontal markers, whose mirrored pose is the pose itself. The two minima of
    a planar pose: Schweighofer and Pinz, "Robust Pose Estimation from a Planar Target", IEEE TPAMI
    28(12), 2006.

    Examples
    --------
    >>> table = flip_rate(results, per=["solver"])
    >>> table["solver"].values.tolist(), table["flipped"].values.tolist()
    (['ippe', 'iterative'], [0, 3])
    >>> table["flip_rate"].round(3).values.tolist()
    [0.0, 0.231]
    """
    rate = replace(FLIP_RATE, counts=(SOLVED, FLIPPED))
    return _table(results, per, bins, [rate])


#: Outcomes of a pose: solved, or the step at which it was lost.
OUTCOMES = (*outcomes(counted=True), *outcomes(counted=False))


def ends_as(outcome: str, poses: Poses) -> Masks:
    """Return which poses have an outcome.

    It is the flag of detection if the marker was not detected, that of the estimate if it was.
    """
    ends = np.zeros(poses.estimate.shape, dtype=bool)
    if outcome in DetectionStatus.__members__:
        ends |= poses.inside & (poses.detection == DetectionStatus[outcome])
    if outcome in EstimateStatus.__members__:
        ends |= poses.detected & (poses.estimate == EstimateStatus[outcome])
    return ends


@describes
def failure_composition(
    results: xr.Dataset, per: Sequence[str] = (), bins: Bins | None = None
) -> xr.Dataset:
    """Return how poses end: solved, or at which step they are lost.

    Parameters
    ----------
    results, per, bins
        As in `detection_rate`.

    Returns
    -------
    xr.Dataset
        Dimensions (*per, *bins, outcome).

        - ``outcome``: solved, then the flags of detection and estimation with which a pose ends
          (`sweep.measure.flags.outcomes`).
        - ``count``: poses with that outcome.
        - ``share`` of the poses looked for, with Wilson's interval in ``share_low`` and
          ``share_high``; the shares add up to 1. NaN for not_visible, not_modelled and not_run,
          whose poses are not looked for.

    Raises
    ------
    ArgumentError, DatasetError
        As in `detection_rate`.

    Notes
    -----
    95 % intervals over the random draws, conditional on the grid, each for itself.

    Examples
    --------
    >>> table = failure_composition(results, per=["side_px"])
    >>> table["count"].sel(outcome=["solved", "no_candidate"]).values.tolist()
    [[0, 16], [10, 6], [16, 0]]
    >>> table["share"].sel(outcome="solved").values.tolist()
    [0.0, 0.625, 1.0]
    """
    kept = dataset.kept_dimensions(results, per)
    ends = [functools.partial(ends_as, outcome) for outcome in OUTCOMES]
    inputs = dataset.pose_arrays(results, dataset.ESTIMATE_INPUTS)
    tables = estimator.aggregates(results, inputs, kept, [[
        Count("count", "poses that ended so", end),
        Rate("share", "share of the poses looked for", end, lambda poses: poses.looked_for),
    ] for end in ends], Poses, bins)
    shares = [f"share{end}" for end in INTERVAL]
    tables = [table.assign(table[shares].where(outcome in outcomes(counted=True)))
              for table, outcome in zip(tables, OUTCOMES, strict=True)]
    return stacked(tables, "outcome").assign_coords(
        outcome=("outcome", list(OUTCOMES), {"long_name": "what became of the pose"}))


# --------------------------------------------------------------------------------------------------
# Which marker IDs are weak: each against the others, corrected for their number.

#: Chance that any ID at all is called weak, or strong, if all are alike.
SIGNIFICANCE = 0.05


@describes
def marker_ranking(results: xr.Dataset, per: Sequence[str] = ()) -> xr.Dataset:
    """Return how each marker ID compares with the others.

    Parameters
    ----------
    results
        The dataset of a run with a dimension ``marker_id``.
    per
        Dimensions that are kept; all others are pooled. Dictionaries hold different markers: a
        dimension ``dictionary`` is always kept. Trials are the draws and cannot be kept.

    Returns
    -------
    xr.Dataset
        Dimensions (*per, marker_id).

        - ``looked_for`` and ``detection_rate`` with its interval, as in
          `sweep.analysis.detection_rate`.
        - ``expected_rate``: what the ID's cells would give if in each of them all IDs were alike.
        - ``p_value`` of the ID against the others, stratified by cell; ``p_adjusted`` is corrected
          for all comparisons in the table.
        - ``weak``: below its expected rate with ``p_adjusted`` below 0.05.

    Raises
    ------
    ArgumentError
        If ``per`` names trials or a dimension that does not exist, or ``marker_id`` is none.
    DatasetError
        If the dataset lacks variables of results, or has no poses.

    Notes
    -----
    The test: Cochran, Mantel and Haenszel, J. Natl. Cancer Inst. 22 (1959), 719-748.
    Under the hypothesis the ID's detections in a cell are hypergeometric; the tails of their sum
    are taken from the gamma distribution (Pearson's type III) with the same mean, variance and
    skewness, with a continuity correction of 1/2, so that they are right if misses are rare. Draws
    that are Sobol' points (``sampling = "sobol"``) are not independent: no p-values, none weak. The
    correction is Holm's: Scandinavian Journal of Statistics 6 (1979), 65-70. If no cell has two
    draws there are no intervals and no p-values, and no ID is weak.

    Examples
    --------
    >>> markers = xr.concat([results, results], dim="marker_id").assign_coords(marker_id=[3, 7])
    >>> table = marker_ranking(markers)
    >>> table["detection_rate"].round(3).values.tolist(), table["weak"].values.tolist()
    ([0.542, 0.542], [False, False])
    """
    own = [*{"dictionary"}.intersection(dataset.axes_of(results)), "marker_id"]
    kept = dataset.kept_dimensions(
        results, (*(name for name in as_names(per) if name != "marker_id"), *own))
    if DRAWS in kept:
        raise ArgumentError("per", DRAWS, "the ranking is over the trials; they cannot be kept")
    cells = [name for name in dataset.axes_of(results) if name in results["detection"].dims
             and name not in (*kept, DRAWS) and dataset.is_grid_axis(name, results)]
    inputs = dataset.pose_arrays(results, dataset.DETECTION_INPUTS)
    if dataset.stopping_rule(results) is not None:
        inputs[dataset.COMMON] = dataset.common_trials(results, inputs, kept)
    rate = replace(DETECTION_RATE, counts=(LOOKED_FOR, ("detected", "")))
    (table,), (counts,) = (estimator.aggregates(results, inputs, names, [[rate]], Poses)
                           for names in (kept, (*kept, *cells)))
    table = table.drop_vars(["detected", "draws"])
    n = counts["draws"].astype(np.float64)
    hits = (counts["detected"] * n / counts["looked_for"]).where(n > 0, 0.0)
    moments = xr.apply_ufunc(
        hypergeometric_moments, n, n.sum("marker_id"), hits.sum("marker_id"),
        output_core_dims=[[]] * 3)
    n, hits, expected, variance, third = (
        each.sum(cells).transpose(*kept) for each in (n, hits, *moments))
    # The test is of independent draws.
    drawn = table["detection_rate_low"].notnull() & (not dataset.is_replicated(results))
    p_value = xr.apply_ufunc(two_sided, hits - expected, variance, third).where(drawn)
    adjusted = xr.apply_ufunc(holm, p_value)
    expected_rate = expected / n
    below = table["detection_rate"] < expected_rate
    return table.assign({name: array.assign_attrs(long_name=meaning, units="1")
                         for name, array, meaning in (
        ("expected_rate", expected_rate, "detection rate if all IDs were alike in each cell"),
        ("p_value", p_value, "chance of a rate so far from it if they were alike"),
        ("p_adjusted", adjusted, "the same for the whole table (Holm)"),
        ("weak", below & (adjusted < SIGNIFICANCE),
         "whether the rate is below the expected one, p_adjusted < 0.05"))})


def hypergeometric_moments(
    n: Floats, total: Floats, all_hits: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return mean, variance and third central moment of the hits of ``n`` draws of ``total``.

    ``all_hits`` are those of all. Johnson, Kemp and Kotz, "Univariate Discrete Distributions",
    3rd ed. 2005, section 6.3.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = n * all_hits / total
        variance = mean * (total - all_hits) * (total - n) / (total * (total - 1.0))
        third = variance * (total - 2 * all_hits) * (total - 2 * n) / (total * (total - 2.0))
    # Of too few draws they are 0 over 0.
    return np.nan_to_num(mean), np.nan_to_num(variance), np.nan_to_num(third)


def two_sided(deviation: Floats, variance: Floats, third: Floats) -> Floats:
    """Return twice the smaller tail of a sum of counts beyond its deviation from the mean.

    Of Pearson's type III with that variance and third central moment, shifted to mean 0; with a
    continuity correction of 1/2.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        shape = third / variance**1.5, 0.0, np.sqrt(variance)
        tail = np.minimum(stats.pearson3.sf(deviation - 0.5, *shape),
                          stats.pearson3.cdf(deviation + 0.5, *shape))
    return np.where(variance > 0, np.minimum(1.0, 2.0 * tail), 1.0)


def holm(p_values: Floats) -> Floats:
    """Return p-values corrected for the number of those that are not NaN."""
    flat = p_values.ravel()
    order = np.argsort(flat)  # NaN last
    factors = np.count_nonzero(~np.isnan(flat)) - np.arange(flat.size)
    adjusted = np.empty(flat.shape)
    adjusted[order] = np.maximum.accumulate(np.minimum(1.0, flat[order] * factors))
    return adjusted.reshape(p_values.shape)


# --------------------------------------------------------------------------------------------------
# The statistics of `sweep.analysis.error_statistics`, a record each.

#: What a table calls a statistic of errors -> its part of the variables' names, ``rmse`` of
#: ``rotation_rmse_deg``.
ERROR_HEADINGS = {
    "median (not solved: infinite)": "median", "95 % quantile (p95)": "p95",
    "99 % quantile (p99)": "p99", "RMSE of the solved": "rmse",
    "RMSE without flips": "rmse_unflipped", "bias without flips": "bias",
    "standard deviation without flips": "sd",
}

#: Counts and rates of the poses.
POSE_STATISTICS: tuple[Statistic[Poses], ...] = (
    Count(*LOOKED_FOR, lambda poses: poses.looked_for, inputs=dataset.DETECTION_INPUTS),
    Count(*SOLVED, lambda poses: poses.solved, inputs=dataset.ESTIMATE_INPUTS),
    DETECTION_RATE, SOLVED_RATE, FLIP_RATE,
)


def quantiles_of(quantity: Quantity) -> Statistic[Poses]:
    """Return the quantiles of a kind of error, also of one with a sign: of the absolute values."""
    return estimator.Quantiles(
        quantity.named("{}"), f"absolute {quantity.words}", quantity.norm,
        lambda poses: poses.solved, lambda poses: poses.looked_for,
        units=quantity.units, inputs=quantity.inputs)


def statistics_of(quantity: Quantity) -> list[Statistic[Poses]]:
    """Return the statistics of a kind of error; of `SIGNED` ones the last two."""
    words, unflipped = f"{quantity.words}, solved and not flipped", attrgetter("unflipped")
    # A mean error is signed if the error is, else it is the mean vector's length. Flips make most
    # of a rotation's RMSE, and it is bounded.
    mean, of = (Mean, "mean") if quantity.signed else (estimator.MeanLength, "length of the mean")
    square: Callable[..., Statistic[Poses]] = estimator.RootMeanSquare
    if quantity.bound is not None:
        square = functools.partial(estimator.FlipMixture, bound=quantity.bound)

    def part(kind: Callable[..., Statistic[Poses]], name: str, *args: Any) -> Statistic[Poses]:
        return kind(quantity.named(name), *args, units=quantity.units, inputs=quantity.inputs)

    found = [
        part(mean, "bias", f"{of} {words}", quantity.vector, unflipped),
        part(estimator.StandardDeviation, "sd", f"standard deviation of the {words}",
             quantity.vector, unflipped)]
    return found if quantity not in QUANTITIES else [
        quantiles_of(quantity),
        part(square, "rmse", f"RMS {quantity.words}, solved", quantity.squares,
             attrgetter("solved")),
        part(estimator.RootMeanSquare, "rmse_unflipped", f"RMS {words}", quantity.squares,
             unflipped),
        *found]


def registered(quantities: Sequence[Quantity] = QUANTITIES) -> list[Statistic[Poses]]:
    """Return all statistics, with the ones of some kinds of error."""
    return [*POSE_STATISTICS, *(
        statistic for quantity in quantities for statistic in statistics_of(quantity))]


# --------------------------------------------------------------------------------------------------
# How large the errors of estimates are: bias, spread, root mean squares and quantiles.

@describes
def error_statistics(
    results: xr.Dataset, per: Sequence[str] = (), bins: Bins | None = None,
    quantities: Sequence[str] | None = None,
) -> xr.Dataset:
    """Return rates, errors and their intervals.

    Parameters
    ----------
    results, per, bins
        As in `sweep.analysis.detection_rate`.
    quantities
        Kinds of error; by default ``rotation``, ``range`` and ``position``. Others have a sign,
        estimated minus true; of these bias and standard deviation are computed. By groups:

        - ``camera_frame``: ``x``, ``y``, ``z`` of the marker's position in the camera's frame
          (right, down, forward), in metres.
        - ``marker_frame``: the same error along the axes of the true marker (right, up, out):
          ``marker_frame_x``, ``marker_frame_y``, ``marker_frame_z``.
        - ``camera_in_marker``: of the camera's position in the marker's frame, as a robot has it
          that localises on the marker: ``camera_in_marker_x``, ``_y``, ``_z``. It has the error
          of the rotation times the distance in it.
        - ``yaw_pitch_roll``: ``yaw``, ``pitch``, ``roll``, the differences of the angles of
          R = Ry(yaw) · Rx(pitch) · Rz(roll) · Rx(180°), those of a pipeline's pose, in degrees.
        - ``angles``: ``tilt`` (to the image plane) and ``viewing_angle`` (to the line of sight),
          which are never negative, so that errors of frontal markers are above 0 on average; and
          ``in_plane``, the rotation error about the true normal (counter-clockwise seen from the
          camera is positive).

    Returns
    -------
    xr.Dataset
        Dimensions (*per, *bins). The interval of ``x`` is in ``x_low`` and
        ``x_high``. The rotation error is in degrees, the range error is that of z in percent of
        the true z, the position error in metres.

        - ``looked_for``: poses (times pooled settings) whose detection is none of not_run,
          not_visible and not_modelled; ``solved`` of these. ``detection_rate`` and
          ``solved_rate`` are of ``looked_for``, ``flip_rate`` is of ``solved``.
        - ``*_median_*``, ``*_p95_*``, ``*_p99_*``: quantiles of the absolute error over the poses
          looked for. A pose that is not solved counts as infinite, so an infinite quantile says
          that more than 50, 5 or 1 % were not solved. An end of the interval is NaN if no cell
          has two draws, and if it lies beyond the smallest or the largest draw.
        - ``*_rmse_*``: over the solved poses; ``*_rmse_unflipped_*`` without flipped ones.
        - ``*_bias_*``: of rotation and position the length of the mean vector, of the others the
          signed mean; solved and not flipped. A length is never negative, so it is above 0 by
          chance alone; then its low end is 0.
        - ``*_sd_*``: standard deviation of all components about that mean together (n - 1).

    Raises
    ------
    ArgumentError, DatasetError
        As in `sweep.analysis.detection_rate`; also for a kind of error that does not exist.

    Notes
    -----
    95 % intervals over the random draws, conditional on the grid; NaN if no cell has two draws
    that count. Intervals of rates are Wilson's, a little wide if the cells' rates differ; of a
    mean Student's, of an RMSE or a standard deviation Student's of the logarithm of the
    mean square (`sweep.analysis.estimator`): they need some 50 draws and tails not much heavier
    than normal, for no sample tells of what it has not seen; if a few
    cells have nearly all of the error, only their draws count. That of ``rotation_rmse_deg``
    counts the flips that the sample may have missed, with 180 degrees each
    (`sweep.analysis.estimator`): it holds if flips are rare, and is wide (0.5 of 0.4 to 48
    without a flip in 50 draws). ``rotation_rmse_unflipped_deg`` with ``flip_rate``, and the
    quantiles, say more; Wilson's interval of 1 % in 50 covers 0.91.

    Quantiles are order statistics, the smallest value (in single precision) with at least that
    share at or below; so are their intervals' ends, NaN if n is too small.

    The statistics are the records of `sweep.analysis.summaries`.

    Examples
    --------
    >>> table = error_statistics(results, per=["solver"])
    >>> table["rotation_rmse_unflipped_deg"].round(3).values.tolist()
    [0.365, 0.735]
    >>> table["rotation_median_deg"].round(3).values.tolist()
    [0.376, 0.752]
    >>> table["rotation_p95_deg"].values.tolist()  # 11 of 24 poses are not solved
    [inf, inf]
    >>> table = error_statistics(results, quantities=["camera_in_marker", "yaw"])
    >>> float(table["camera_in_marker_x_sd_m"].round(4)), float(table["yaw_sd_deg"].round(2))
    (0.0074, 0.32)
    """
    return _table(results, per, bins, registered(dataset.chosen_quantities(quantities)))


def guarded_error_statistics(results: xr.Dataset, per: Sequence[str] = ()) -> xr.Dataset:
    """Return `error_statistics` with the intervals by which configurations are preferred.

    Upper ends of root mean squares and standard deviations hold rare errors that no draw showed, as
    those of requirements do (`sweep.analysis.estimator.PositiveMean`).
    """
    return _table(results, per, None, [*map(estimator.guarded, registered())])


def _table(
    results: xr.Dataset, per: Sequence[str], bins: Bins | None,
    statistics: Sequence[Statistic[Poses]],
) -> xr.Dataset:
    """Return some statistics, (*per, *bins)."""
    kept = dataset.kept_dimensions(results, per)
    inputs = dataset.pose_arrays(results, [name for each in statistics for name in each.inputs])
    table, = estimator.aggregates(results, inputs, kept, [statistics], Poses, bins)
    return table


# --------------------------------------------------------------------------------------------------
# Whether the covariances that estimates come with describe their errors.

#: By how much the coverage of a trusted covariance may differ from the level.
TOLERANCE = 0.02

#: Draws from which on a covariance can be trusted.
MIN_DRAWS = 50


def _nees(poses: Poses) -> Floats:
    return poses["nees"].astype(np.float64)


def _with_nees(poses: Poses) -> Masks:
    return poses.solved & ~np.isnan(_nees(poses))


#: The mean of ``nees``.
NEES_MEAN: Statistic[Poses] = estimator.PositiveMean(
    "nees_mean", "mean normalised estimation error squared, expected 6",
    lambda poses: _nees(poses)[..., None], _with_nees, inputs=(*dataset.ESTIMATE_INPUTS, "nees"))


@describes
def covariance_trust(
    results: xr.Dataset, per: Sequence[str] = (), levels: Sequence[float] = (0.5, 0.9, 0.99),
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

    Returns
    -------
    xr.Dataset
        Dimensions (*per[, level]). Without ``nees`` all is NaN and nothing
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
        For a dimension that does not exist, and a level outside (0, 1).
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
    kept = dataset.kept_dimensions(results, per)
    limits = special.chdtri(len(POSE_PARAMETERS), 1.0 - nominal).tolist()
    inputs = dataset.pose_arrays(results, dataset.ESTIMATE_INPUTS) | {
        "nees": results.get("nees", xr.DataArray(np.nan))}
    table, *tables = estimator.aggregates(results, inputs, kept, [
        [NEES_MEAN], *(_within(limit, len(limits)) for limit in limits)], Poses)
    at_levels = stacked(tables, "level").assign_coords(level=("level", nominal, {
        "long_name": "nominal probability of the covariance's region", "units": "1"}))
    level = at_levels["level"]
    right = ((at_levels["joint_low"] - TOLERANCE <= level)
             & (level <= at_levels["joint_high"] + TOLERANCE)).all("level")
    one = at_levels.isel(level=-1, drop=True)
    trusted = (right & (one["draws"] >= MIN_DRAWS)).assign_attrs(
        long_name="whether the coverage is the level, at every level", units="1")
    return table.assign(nees_count=one["nees_count"], covariance_trusted=trusted).assign(
        at_levels[[f"covariance_coverage{end}" for end in INTERVAL]])


def _within(limit: float, levels: int) -> list[Statistic[Poses]]:
    """Return the share below a limit, with its interval and one of several levels together."""
    def within(poses: Poses) -> Masks:
        return np.asarray(_nees(poses) <= limit)

    words = "share of estimates within the covariance's region of a level"
    return [
        Rate("covariance_coverage", words, within, _with_nees, counts=(
            ("nees_count", "estimates with a normalised estimation error squared"), ("hits", ""))),
        Rate("joint", "", within, _with_nees, level=1.0 - (1.0 - LEVEL) / levels)]


# --------------------------------------------------------------------------------------------------
# How near the errors of estimates come to the accuracy bound.

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
        Dimensions (*per, *bins).

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
    are the RMSE's; the bound is taken as known. Kay, "Fundamentals of Statistical Signal
    Processing: Estimation Theory", 1993, chapter 3.

    Examples
    --------
    >>> table = efficiency(results, per=["solver"])
    >>> table["rotation_efficiency"].round(3).values.tolist()
    [0.544, 0.27]
    """
    if "bound_std" not in results:
        results = results.assign(bound_std=xr.DataArray(
            np.nan, {"pose_parameter": list(POSE_PARAMETERS)}, ["pose_parameter"]))
    return _table(results, per, bins, RATIOS)


@dataclass(frozen=True)
class BoundRatio(estimator.RootMeanSquare[Poses]):
    """The RMS bound over the RMS error, of the poses that have both; ``values`` are of the error.

    Attributes
    ----------
    bound
        The squared bounds (...) of poses.
    """

    bound: Callable[[Poses], Floats]

    def interval(
        self, columns: estimator.Columns[Poses], design: estimator.Design, level: float
    ) -> estimator.Interval:
        """Return the ratio; its interval is the error's."""
        value, low, high = super().interval(columns, design, level)
        squares: Mean[Poses] = Mean("", "", lambda poses: self.bound(poses)[..., None], self.used)
        with np.errstate(divide="ignore", invalid="ignore"):
            bound = np.sqrt(squares.sums(columns).mean[:, 0])
            return bound / value, bound / high, bound / low


def _of_bound(quantity: Quantity, bound: Callable[[Poses], Floats]) -> Statistic[Poses]:
    return BoundRatio(
        f"{quantity.name}_efficiency",
        f"RMS bound over RMS {quantity.words}, solved and not flipped", quantity.squares,
        lambda poses: poses.unflipped & np.isfinite(bound(poses)), bound,
        inputs=dataset.BOUND_INPUTS)


#: Of the rotation and of the depth.
RATIOS = (
    _of_bound(QUANTITIES[0],
              lambda poses: dataset.norm_squared(np.degrees(poses["bound_std"][..., :3]))),
    _of_bound(QUANTITIES[1],
              lambda poses: poses.percent_of_depth(poses["bound_std"][..., 5]) ** 2),
)

# --------------------------------------------------------------------------------------------------
# Poses and flips that a threshold on the ambiguity of planar poses keeps.
#
# The ratio of a pose is its reprojection error over that of the other planar solution: the
# "ambiguity" that users compare with a fixed number such as 0.2.

#: Thresholds that are tried by default; the infinite one keeps all poses.
THRESHOLDS = (
    0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, np.inf)

MAX_THRESHOLDS = 200

RATIO_INPUTS = (
    *dataset.ESTIMATE_INPUTS, "reprojection_error_px", "alternative_reprojection_error_px")


class ThresholdChoice(Flag):
    """Whether a threshold keeps the wanted flip rate."""

    not_run = flag(0, "No pose was solved.", counted=False)
    found = flag(1, "A threshold keeps the wanted flip rate.", present=True)
    not_needed = flag(2, "All poses together have the wanted flip rate.", present=True)
    too_few_draws = flag(3, "The draws show neither that a threshold keeps it nor that none does.")
    none = flag(4, "No threshold keeps it: at each the flip rate is shown to be higher.")
    nothing_drawn = flag(5, "No cell has two draws: nothing can be shown.")


def ambiguity_ratio(reprojection_px: ArrayLike, alternative_px: ArrayLike) -> Floats:
    """Return the ratio (...) of reprojection errors, the pose's over the other solution's.

    0 if there is no other solution (NaN), so that every threshold keeps the pose; 1 if both are 0,
    since nothing tells them apart; infinite if only the other's is 0. Above 1 the solver did not
    return the solution with the smaller error.

    Parameters
    ----------
    reprojection_px, alternative_px
        RMS reprojection errors (...) in pixels.

    Examples
    --------
    >>> ambiguity_ratio([0.1, 0.1, 0.0, 0.1], [0.4, np.nan, 0.0, 0.0]).tolist()
    [0.25, 0.0, 1.0, inf]
    """
    error = np.asarray(reprojection_px, dtype=np.float64)
    other = np.asarray(alternative_px, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = error / other
    ratio = np.where((error == 0) & (other == 0), 1.0, ratio)
    return np.where(np.isnan(other), 0.0, ratio)


class AmbiguousPoses(Poses):
    """Poses of a block with the ratios of their reprojection errors."""

    @functools.cached_property
    def ratio(self) -> Floats:
        """Ratios (groups, cells, draws, settings), as `ambiguity_ratio` defines them."""
        return ambiguity_ratio(
            self["reprojection_error_px"], self["alternative_reprojection_error_px"])


@describes
def ambiguity(
    results: xr.Dataset, per: Sequence[str] = (), bins: Bins | None = None, *,
    thresholds: Iterable[float] = THRESHOLDS, flip_rate: float = 0.01, min_kept: float = 0.05,
) -> xr.Dataset:
    """Return the poses that thresholds on the ratio of reprojection errors keep, and which to take.

    A threshold keeps the solved poses with ``reprojection_error_px /
    alternative_reprojection_error_px`` of at most itself. A pose without another solution is
    always kept, one with two solutions of error 0 has the ratio 1 (`ambiguity_ratio`).

    Parameters
    ----------
    results, bins
        As in `sweep.analysis.detection_rate`.
    per
        Dimensions that are kept beside the detector's and the estimator's: configurations
        are never pooled.
    thresholds
        What to try, numbers of at least 0; infinity, which keeps all, is always among them.
    flip_rate
        The wanted share of flips among the kept poses, above 0 and below 1.
    min_kept
        Smallest share of the solved poses, 0 to 1, that a threshold must keep to be of use.

    Returns
    -------
    xr.Dataset
        Dimensions (*per, *configuration, *bins). Intervals are in
        ``x_low`` and ``x_high``.

        - ``solved``, ``flipped``, ``without_alternative``: solved poses, those of them that are
          nearer to the mirror of the truth, and those without another solution.
        - Along ``threshold``, increasing: ``kept`` and ``kept_flipped`` poses; ``kept_rate``, of
          the solved; ``kept_flip_rate``, flips of the kept; ``flips_kept_rate``, kept of the
          flips; ``right_rejected_rate``, rejected of the poses that are not flipped;
          ``rejected_right_rate``, not flipped of the rejected.
        - ``choice``: whether any threshold keeps the wanted flip rate (`ThresholdChoice`), and
          ``chosen_threshold``, the largest that is shown to; NaN if none is, infinite if none is
          needed. At it: ``chosen_kept_rate``, ``chosen_flip_rate``,
          ``chosen_right_rejected_rate``, and ``chosen_flip_rate_bound``, which the flip rate
          exceeds with a probability of 2.5 % at most, the choice included.

    Raises
    ------
    ArgumentError, DatasetError
        As in `sweep.analysis.detection_rate`; also for thresholds and rates that cannot be.

    Notes
    -----
    Each interval has 95 % for itself, over the random draws, conditional on the grid: Clopper and
    Pearson's (`sweep.analysis.estimator.clopper_pearson`), NaN if no cell has two draws. A
    threshold that was chosen because few flips were seen below it would look better than it is:
    it is therefore chosen by the upper ends of all thresholds together (Bonferroni: a tail of
    2.5 % over their number), so that a choice whose true flip rate is above the wanted one has a
    probability of 2.5 % at most, whatever the dependence between thresholds. Fewer ``thresholds``
    need fewer draws. ``none`` is said if at every threshold of use the lower end of the interval
    lies above the wanted rate; that all of them do by chance is no likelier than that one does.

    Flips mean nothing for frontal markers, whose mirrored pose is the pose itself.

    Examples
    --------
    >>> table = ambiguity(results, thresholds=[0.2, 0.5], flip_rate=0.4)
    >>> table["solver"].values.tolist(), table["kept"].values.tolist()
    (['ippe', 'iterative'], [[8, 13, 13], [13, 13, 13]])
    >>> [ThresholdChoice(choice).name for choice in table["choice"].values]
    ['not_needed', 'too_few_draws']
    """
    tried = np.array([*thresholds], dtype=np.float64)
    if not (0 < tried.size <= MAX_THRESHOLDS and (tried >= 0).all()):
        raise ArgumentError("thresholds", thresholds, "expected numbers of at least 0, "
                            f"{MAX_THRESHOLDS} at most, such as 0.2, 0.4")
    if not 0.0 < flip_rate < 1.0:
        raise ArgumentError(
            "flip_rate", flip_rate, "expected a number above 0 and below 1, such as 0.01")
    if not 0.0 <= min_kept <= 1.0:
        raise ArgumentError("min_kept", min_kept, "expected a number from 0 to 1, such as 0.05")
    kept = dataset.kept_dimensions(
        results, (*as_names(per), *dataset.configuration_axes(results)))
    counts: list[Statistic[AmbiguousPoses]] = [
        Count(*SOLVED, lambda poses: poses.solved),
        Count(*FLIPPED, lambda poses: poses.flipped),
        Count("without_alternative", "solved poses without another solution", lambda poses:
              poses.solved & np.isnan(poses["alternative_reprojection_error_px"]))]
    levels = np.unique([*tried, np.inf])
    inputs = dataset.pose_arrays(results, RATIO_INPUTS)
    together = 1.0 - (1.0 - LEVEL) / len(levels)
    table, *at_levels = estimator.aggregates(
        results, inputs, kept, [counts, *(_rates_at(each, together) for each in levels)],
        AmbiguousPoses, bins)
    table = table.assign(stacked(at_levels, "threshold")).assign_coords(
        threshold=("threshold", levels, cf_attributes(
            "largest ratio of both reprojection errors that is kept", "1")))
    useful = (table["kept_rate"] >= min_kept) | np.isinf(table["threshold"])
    low = table["kept_flip_rate_low"]
    meets = useful & (table["bound_high"] <= flip_rate)
    of_all = {"threshold": -1}
    choice = table["solved"].copy(data=np.select(
        [table["kept"].isel(of_all) == 0, low.isel(of_all).isnull(), meets.isel(of_all),
         meets.any("threshold"), ((low > flip_rate) | ~useful).all("threshold")],
        [ThresholdChoice.not_run, ThresholdChoice.nothing_drawn, ThresholdChoice.not_needed,
         ThresholdChoice.found, ThresholdChoice.none],
        ThresholdChoice.too_few_draws).astype(np.uint8))
    # The largest threshold that meets.
    at = (meets * np.arange(table.sizes["threshold"])).argmax("threshold")
    columns = table.isel(threshold=at).reset_coords("threshold").where(meets.any("threshold"))
    chosen = {f"chosen_{name}": columns[source].assign_attrs(cf_attributes(meaning, "1"))
              for name, (source, meaning) in CHOSEN.items()}
    chosen["choice"] = choice.assign_attrs(
        cf_attributes("whether a threshold keeps the wanted flip rate", flags=ThresholdChoice))
    return table.drop_vars([f"bound{end}" for end in INTERVAL]).assign(chosen).assign_attrs(
        flip_rate=flip_rate, min_kept=min_kept)


def _rates_at(threshold: float, together: float) -> list[Rate[AmbiguousPoses]]:
    """Return the rates at a threshold, and one with an interval for all thresholds together."""
    def kept(poses: AmbiguousPoses) -> Masks:
        return np.asarray(poses.solved & (poses.ratio <= threshold))

    def rejected(poses: AmbiguousPoses) -> Masks:
        return np.asarray(poses.solved & ~kept(poses))

    counts = (("kept", "poses that the threshold keeps"),
              ("kept_flipped", "flips that the threshold keeps"))
    return [
        Rate(name, meaning, hits, of, exact=True, counts=counts if of is kept else ())
        for name, meaning, hits, of in (
            ("kept_rate", "kept of the solved poses", kept, attrgetter("solved")),
            ("kept_flip_rate", "flips of the kept poses", attrgetter("flipped"), kept),
            ("flips_kept_rate", "kept of the flips", kept, attrgetter("flipped")),
            ("right_rejected_rate", "rejected of the poses that are not flipped", rejected,
             attrgetter("unflipped")),
            ("rejected_right_rate", "not flipped of the rejected poses", attrgetter("unflipped"),
             rejected))
    ] + [Rate("bound", "", attrgetter("flipped"), kept, exact=True, level=together)]


#: Variables at the chosen threshold: name there -> description.
CHOSEN = {
    "threshold": ("threshold", "largest threshold that is shown to keep the wanted flip rate"),
    "kept_rate": ("kept_rate", "kept of the solved poses, at the chosen threshold"),
    "flip_rate": ("kept_flip_rate", "flips of the kept poses, at the chosen threshold"),
    "flip_rate_bound": ("bound_high", "upper bound of the flip rate at the chosen threshold"),
    "right_rejected_rate": (
        "right_rejected_rate", "rejected of the poses not flipped, at the chosen threshold"),
}
