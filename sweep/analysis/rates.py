"""Rates of detection and their rankings."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from scipy import special, stats

from sweep.analysis.dataset import (
    DRAWS,
    as_names,
    axes_of,
    describes,
    is_grid_axis,
    is_replicated,
    kept_dimensions,
    require_dimension,
    stacked,
    with_common_trials,
)
from sweep.analysis.estimator import INTERVAL, Bins, Rate, aggregate
from sweep.analysis.poses import DETECTION_INPUTS, ESTIMATE_INPUTS, Poses, pose_arrays
from sweep.errors import ArgumentError
from sweep.measure.flags import DetectionStatus, EstimateStatus, outcomes
from sweep.typing import Floats, Masks

# --------------------------------------------------------------------------------------------------
# How often a marker is detected, where its poses are lost, and how often a pose is mirrored.

@dataclass(frozen=True)
class PoseRate:
    """A rate of poses.

    Attributes
    ----------
    rate
        The statistic, without its counts.
    counts
        Names and meanings of the number of poses used and of the successes.
    inputs
        Names of the arrays that it reads.
    """

    rate: Rate[Poses]
    counts: tuple[tuple[str, str], tuple[str, str]]
    inputs: tuple[str, ...]

    def table(self, results: xr.Dataset, per: Sequence[str], bins: Bins | None) -> xr.Dataset:
        """Return the rate with both intervals and its counts, (*per, *bins)."""
        kept = kept_dimensions(results, per)
        full = replace(self.rate, counts=self.counts, with_jeffreys=True)
        return aggregate(results, pose_arrays(results, self.inputs), kept, [full], Poses, bins)


LOOKED_FOR = ("looked_for", "poses that were run, visible and modelled")
SOLVED = ("solved", "solved poses")
FLIPPED = ("flipped", "solved poses that are nearer to the mirror of the truth")

DETECTION_RATE = PoseRate(
    Rate("detection_rate", "detected of looked_for", lambda poses: poses.detected,
         lambda poses: poses.looked_for),
    (LOOKED_FOR, ("detected", "detected poses")), DETECTION_INPUTS,
)
SOLVED_RATE = PoseRate(
    Rate("solved_rate", "solved of looked_for", lambda poses: poses.solved,
         lambda poses: poses.looked_for),
    (LOOKED_FOR, SOLVED), ESTIMATE_INPUTS,
)
FLIP_RATE = PoseRate(
    Rate("flip_rate", "nearer to the mirror of the truth, of solved",
         lambda poses: poses.flipped, lambda poses: poses.solved),
    (SOLVED, FLIPPED), ESTIMATE_INPUTS,
)


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
          ``detection_rate_high``, and Jeffreys' in ``detection_rate_jeffreys_low`` and
          ``detection_rate_jeffreys_high``.

    Raises
    ------
    ArgumentError
        For a dimension that does not exist, and for bins that cannot be.
    DatasetError
        If the dataset lacks variables of results, or has no poses.

    Notes
    -----
    95 % intervals over the random draws, conditional on the grid; NaN if no cell has two draws.
    See `sweep.analysis.intervals` for the formulas and their sources.

    Examples
    --------
    >>> table = detection_rate(results, per=["side_px"])
    >>> table["detected"].values.tolist(), table["looked_for"].values.tolist()
    ([0, 5, 8], [8, 8, 8])
    >>> table["detection_rate_low"].round(3).values.tolist()
    [0.0, 0.306, 0.676]
    """
    return DETECTION_RATE.table(results, per, bins)


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
    return FLIP_RATE.table(results, per, bins)


OUTCOMES = (*outcomes(counted=True), *outcomes(counted=False))
"""What a pose can end as: solved, or the step at which it was lost."""


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


def _share_of(outcome: str) -> Rate[Poses]:
    """Return the share of an outcome; of those that are not counted, only the number matters."""
    ends = functools.partial(ends_as, outcome)
    counted = outcome in outcomes(counted=True)
    return Rate(
        f"share {outcome}", f"{outcome} of looked_for", ends,
        (lambda poses: poses.looked_for) if counted else ends,
        counts=((f"of {outcome}", ""), (f"count {outcome}", "")))


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
    kept = kept_dimensions(results, per)
    table = aggregate(results, pose_arrays(results, ESTIMATE_INPUTS), kept,
                      [_share_of(outcome) for outcome in OUTCOMES], Poses, bins)
    is_counted = xr.DataArray(
        [outcome in outcomes(counted=True) for outcome in OUTCOMES], dims="outcome")
    variables = {}
    for name, begin, end, meaning in (
        ("count", "count ", "", "poses that ended so"),
        ("share", "share ", "", "share of the poses looked for"),
        ("share_low", "share ", "_low", f"{INTERVAL['_low']}share"),
        ("share_high", "share ", "_high", f"{INTERVAL['_high']}share"),
    ):
        values = stacked([table[f"{begin}{outcome}{end}"] for outcome in OUTCOMES], "outcome")
        if name != "count":
            values = values.where(is_counted)
        variables[name] = values.assign_attrs(long_name=meaning, units="1")
    coordinates = {"outcome": ("outcome", list(OUTCOMES), {"long_name": "what became of the pose"})}
    return xr.Dataset(variables, dict(table.coords)).assign_coords(coordinates)


# --------------------------------------------------------------------------------------------------
# Which marker IDs are weak: each against the others, corrected for their number.

SIGNIFICANCE = 0.05
"""Chance that any ID at all is called weak, or strong, if all are alike."""

MIN_SKEWNESS = 1e-6
"""Below it the gamma distribution is normal to 1e-6, and its functions lose digits."""


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
        - ``rank``: 1 has the lowest share of its expected rate.

    Raises
    ------
    ArgumentError
        If ``per`` names trials, or a dimension that does not exist.
    DatasetError
        If the dataset has no dimension ``marker_id``, lacks variables of results, or has no poses.

    Notes
    -----
    The test is that of Cochran, Mantel and Haenszel: J. Natl. Cancer Inst. 22 (1959), 719-748.
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
    require_dimension(results, "marker_id")
    dictionaries = ["dictionary"] if "dictionary" in axes_of(results) else []
    kept = kept_dimensions(results, (*as_names(per), *dictionaries, "marker_id"))
    kept = (*(name for name in kept if name != "marker_id"), "marker_id")
    if DRAWS in kept:
        raise ArgumentError("per", DRAWS, "the ranking is over the trials; they cannot be kept")
    cells = [name for name in axes_of(results) if name in results["detection"].dims
             and name not in (*kept, DRAWS) and is_grid_axis(name, results)]
    results = with_common_trials(results, kept)
    table = detection_rate(results, kept)[
        ["looked_for", "detection_rate", "detection_rate_low", "detection_rate_high"]]
    counts = detection_rate(results, (*kept, *cells))
    n = counts["draws"].astype(np.float64)
    hits = (counts["detected"] * n / counts["looked_for"]).where(n > 0, 0.0)
    strata = [n, n.sum("marker_id"), hits.sum("marker_id")]
    expected, variance, third = xr.apply_ufunc(
        hypergeometric_moments, *strata, output_core_dims=[[]] * 3)
    sums = {name: array.sum(cells).transpose(*kept) for name, array in (
        ("n", n), ("hits", hits), ("expected", expected), ("variance", variance),
        ("third", third))}
    # The test is of independent draws.
    drawn = table["detection_rate_low"].notnull() & (not is_replicated(results))
    p_value = xr.apply_ufunc(
        two_sided, sums["hits"] - sums["expected"], sums["variance"], sums["third"],
    ).where(drawn)
    adjusted = xr.apply_ufunc(holm, p_value)
    expected_rate = sums["expected"] / sums["n"]
    share = table["detection_rate"] / expected_rate
    rank = xr.apply_ufunc(
        _rank, share, input_core_dims=[["marker_id"]], output_core_dims=[["marker_id"]])
    below = table["detection_rate"] < expected_rate
    meanings = {
        "expected_rate": (expected_rate, "detection rate if all IDs were alike in each cell"),
        "p_value": (p_value, "chance of a rate so far from it if they were alike"),
        "p_adjusted": (adjusted, "the same for the whole table (Holm)"),
        "weak": (below & (adjusted < SIGNIFICANCE),
                 "whether the rate is below the expected one, p_adjusted < 0.05"),
        "rank": (rank, "1 has the lowest share of its expected rate"),
    }
    return table.assign({
        name: array.assign_attrs(long_name=meaning, units="1")
        for name, (array, meaning) in meanings.items()
    })


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
    return (np.where(total > 0, mean, 0.0), np.where(total > 1, variance, 0.0),
            np.where(total > 2, third, 0.0))


def two_sided(deviation: Floats, variance: Floats, third: Floats) -> Floats:
    """Return twice the smaller tail of a sum of counts beyond its deviation from the mean.

    Of the gamma distribution with that variance and third central moment, shifted to mean 0; with
    a continuity correction of 1/2. Without skewness it is the normal distribution.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        # In units in which the skewness is not negative.
        sign = np.where(third < 0, -1.0, 1.0)
        skewness = np.abs(third) / variance**1.5
        shape, scale = 4.0 / skewness**2, np.sqrt(variance) * skewness / 2.0
        upper, lower = sign * deviation - 0.5, sign * deviation + 0.5
        symmetric = skewness < MIN_SKEWNESS
        above = np.where(
            symmetric, special.ndtr(-upper / np.sqrt(variance)),
            special.gammaincc(shape, np.maximum(upper, -shape * scale) / scale + shape))
        below = np.where(
            symmetric, special.ndtr(lower / np.sqrt(variance)),
            special.gammainc(shape, np.maximum(lower, -shape * scale) / scale + shape))
    p_value = np.minimum(1.0, 2.0 * np.minimum(above, below))
    return np.where(variance > 0, p_value, 1.0)


def holm(p_values: Floats) -> Floats:
    """Return p-values corrected for the number of those that are not NaN."""
    flat = p_values.ravel()
    order = np.argsort(flat)  # NaN last
    count = int((~np.isnan(flat)).sum())
    factors = np.arange(count, 0, -1)
    adjusted = np.full(flat.shape, np.nan)
    stepped = np.maximum.accumulate(np.minimum(1.0, flat[order[:count]] * factors))
    adjusted[order[:count]] = stepped
    return adjusted.reshape(p_values.shape)


def _rank(share: Floats) -> Floats:
    """Return the ranks along the last axis, from 1; equal values share the lowest, NaN has NaN."""
    ranks = stats.rankdata(np.nan_to_num(share, nan=np.inf), method="min", axis=-1)
    return np.where(np.isnan(share), np.nan, ranks)
