"""How large the errors of estimates are, how near they come to the bound, and whether they know it.

Every interval has 95 % and speaks of other draws on the same grid: what happens between its points
it cannot tell. Where nothing was drawn, that is where no cell has two draws that count, it is NaN.
A variable that ``x`` has an interval has it in ``x_low`` and ``x_high``. Which dimensions are
cells, draws and settings, `sweep.analysis.blocks` tells.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import special

from sweep.analysis.blocks import Bins, aggregate, kept_of
from sweep.analysis.pose_view import QUANTITIES, Poses, Quantity, errors, norm_squared, relative
from sweep.analysis.rates import DETECTION_RATE, FLIP_RATE, SOLVED_RATE
from sweep.analysis.statistics import (
    LEVEL,
    Count,
    Length,
    Mean,
    PositiveMean,
    Quantiles,
    Rate,
    RootMeanSquare,
    StandardDeviation,
    Statistic,
)
from sweep.plan.schema import XYZ
from sweep.typing import Floats

Masks = NDArray[np.bool_]

DEGREES_OF_FREEDOM = 6  # of a pose
TOLERANCE = 0.02  # by how much a trusted covariance's coverage may be off
FEWEST = 50  # from this many draws on a covariance can be trusted


def statistics_of(quantity: Quantity, *, with_reason: bool = False) -> list[Statistic]:
    """Return the statistics of an error."""
    vector, words, units = quantity.vector, quantity.words, quantity.units

    def squares(poses: Poses) -> Floats:
        return norm_squared(vector(poses))[..., None]

    def solved(poses: Poses) -> NDArray[np.bool_]:
        return poses.solved

    def unflipped(poses: Poses) -> NDArray[np.bool_]:
        return poses.unflipped

    mean, of = (Mean, "mean") if quantity.name == "range" else (Length, "length of the mean")
    return [
        mean(quantity.named("bias"), f"{of} {words}, solved and not flipped", units, vector,
             unflipped),
        StandardDeviation(
            quantity.named("sd"), f"standard deviation of the {words}, solved and not flipped",
            units, vector, unflipped),
        RootMeanSquare(quantity.named("rmse"), f"RMS {words}, solved", units, squares, solved),
        RootMeanSquare(
            quantity.named("rmse_unflipped"), f"RMS {words}, solved and not flipped", units,
            squares, unflipped),
        Quantiles(quantity.named("{}"), f"absolute {words}", units, quantity.norm, solved,
                  lambda poses: poses.looked_for, with_reason=with_reason),
    ]


def error_statistics(
    results: xr.Dataset, per: Sequence[str] = (), bins: Bins | None = None
) -> xr.Dataset:
    """Return rates, errors and their intervals, with dimensions (*per, *bins).

    ``per`` and ``bins`` as in `sweep.analysis.rates.detection_rate`. ``looked_for`` counts the
    poses (times pooled settings) whose detection is none of not_run, not_visible and
    not_modelled; ``detection_rate`` and ``solved_rate`` are of these, ``flip_rate`` of the
    ``solved``. Their intervals are Wilson's, a little wide where the cells' rates differ.

    The rotation error is in degrees, the range error is that of z in percent of the true z, the
    position error in metres. ``*_rmse_*`` is over the solved poses; ``*_rmse_unflipped_*``,
    ``*_bias_*`` and ``*_sd_*`` over those that are solved and not flipped. The bias of rotation
    and position is the length of the mean vector: never negative, so it is above 0 by chance
    alone; then its low end is 0. The standard deviation is that of all components about that mean
    together (n - 1).

    The quantiles (``*_median_*``, ``*_p95_*``, ``*_p99_*``, absolute errors) are over the poses
    looked for, one that is not solved counting as infinite: an infinite quantile says that more
    than 50, 5 or 1 % were not solved. They are order statistics, the smallest value (in single
    precision) with at least that share at or below; so are their intervals. An end is NaN where n
    is too small, of which ``median_interval``, ``p95_interval`` and ``p99_interval`` tell
    (`IntervalOf`).

    The interval of a mean is Student's, that of an RMSE or a standard deviation Student's of the
    logarithm of the mean square: see `sweep.analysis.statistics`. They need some 50 draws and
    tails not much heavier than normal; where a few cells have nearly all of the error, only their
    draws count.

    Lazy where ``results`` is. Raises ``StoreError`` for a dimension that is not there.
    """
    statistics: list[Statistic] = [
        Count("looked_for", "poses that were run, visible and modelled",
              lambda poses: poses.looked_for),
        Count("solved", "solved poses", lambda poses: poses.solved),
        DETECTION_RATE, SOLVED_RATE, FLIP_RATE,
    ]
    for quantity in QUANTITIES:
        statistics += statistics_of(quantity, with_reason=quantity is QUANTITIES[0])
    kept = kept_of(results, per)
    return aggregate(results, errors(results), kept, statistics, bins)


def efficiency(
    results: xr.Dataset, per: Sequence[str] = (), bins: Bins | None = None
) -> xr.Dataset:
    """Return how near the errors come to the bound, 1 being on it: dimensions (*per, *bins).

    ``results`` has, beside the variables of the template, ``bound_std``: dimensions of the scene
    and ``pose_parameter``, labelled rotation_x, rotation_y, rotation_z (rad), translation_x,
    translation_y, translation_z (m), camera frame: the least standard deviation that an unbiased
    estimator can have (Cramér and Rao), NaN where there is none.

    ``rotation_efficiency`` is sqrt(mean of the sum of the three bounds squared) over the RMS norm
    of the rotation error. ``range_efficiency`` is the RMS of bound over true z, over that of error
    over true z: so distances weigh alike. Both over the poses that have a bound and are solved and
    not flipped: a flip is another minimum, of which the bound knows nothing. A biased estimator
    can be above 1. The intervals are those of the RMSE; the bound is taken as known.

    NaN where no such pose has a bound, and everywhere if there is no ``bound_std``. An error of
    exactly 0 gives infinity. Raises ``StoreError`` for a dimension that is not there.
    """
    kept = kept_of(results, per)
    labels = [f"rotation_{axis}" for axis in XYZ]
    bound = results.get("bound_std", xr.DataArray(
        np.full(4, np.nan), {"pose_parameter": [*labels, "translation_z"]}, "pose_parameter"
    ))
    needed = errors(results) | {
        "rotation_bound": bound.sel(pose_parameter=labels),
        "depth_bound": bound.sel(pose_parameter="translation_z", drop=True),
    }
    rotation, depth = QUANTITIES[:2]
    bounds: dict[Quantity, Callable[[Poses], Floats]] = {
        rotation: lambda poses: norm_squared(np.degrees(poses["rotation_bound"])),
        depth: lambda poses: (100.0 * relative(poses["depth_bound"], poses["depth"])) ** 2,
    }
    statistics = [statistic for quantity, bound_squared in bounds.items()
                  for statistic in _with_its_bound(quantity, bound_squared)]
    table = aggregate(results, needed, kept, statistics, bins)
    found: dict[str, xr.DataArray] = {}
    for quantity in bounds:
        least, meaning = table[quantity.named("bound")], f"RMS bound over RMS {quantity.words}"
        name, error = f"{quantity.name}_efficiency", quantity.named("rmse")
        for ending, other, words in (
            ("", "", ""), ("_low", "_high", "lower end of the 95 % interval: "),
            ("_high", "_low", "upper end of the 95 % interval: "),
        ):
            ratio = least / table[f"{error}{other}"]
            found[f"{name}{ending}"] = ratio.assign_attrs(
                long_name=f"{words}{meaning}, solved and not flipped", units="1")
    return xr.Dataset(found, dict(table.coords))


def _with_its_bound(
    quantity: Quantity, bound_squared: Callable[[Poses], Floats]
) -> list[Statistic]:
    """Return the RMS bound and the RMS error of the poses that have both."""
    def used(poses: Poses) -> Masks:
        return poses.unflipped & np.isfinite(bound_squared(poses))

    return [
        RootMeanSquare(
            quantity.named("bound"), f"RMS bound of the {quantity.words}", quantity.units,
            lambda poses: bound_squared(poses)[..., None], used),
        RootMeanSquare(
            quantity.named("rmse"), f"RMS {quantity.words} where there is a bound",
            quantity.units, lambda poses: norm_squared(quantity.vector(poses))[..., None], used),
    ]


def covariance_trust(
    results: xr.Dataset,
    per: Sequence[str] = (),
    levels: Sequence[float] = (0.5, 0.9, 0.99),
    scale: xr.DataArray | None = None,
) -> xr.Dataset:
    """Return whether the estimates' own covariances tell the truth: dimensions (*per[, level]).

    ``results`` has, beside the variables of the template, ``nees`` (dimensions of ``estimate``):
    the normalised estimation error squared e' C⁻¹ e of the six pose parameters, NaN where there is
    no covariance. Of a true covariance it is chi-squared with 6 degrees of freedom (Bar-Shalom, Li
    and Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, section 5.4).
    Every pose with a number counts, flipped ones too: who trusts a covariance does not know of
    flips.

    ``scale``, with axes of the dataset (the kept ones, as a rule) and their coordinates, multiplies
    ``nees`` first: with 1/k² the assumed corner noise becomes k times as large.

    ``nees_count`` are the estimates that have a number, ``nees_mean`` is expected to be 6, its
    interval is Student's of its logarithm. ``covariance_coverage`` (..., level) is the share of
    them within the region of that level, with Wilson's interval.
    ``covariance_trusted``: at every level the interval of the coverage, at 95 % for all levels
    together (Bonferroni), holds a share within 0.02 of the level, and there are at least 50
    draws. So False means wrong, or too little to tell. Without ``nees`` everything is NaN and
    nothing trusted.

    Raises ``StoreError`` for a dimension that is not there, ``ValueError`` for a level outside
    (0, 1) and for a ``scale`` whose coordinates are others.
    """
    nominal = np.atleast_1d(np.array(levels, dtype=np.float64))
    if not (nominal.size and ((nominal > 0.0) & (nominal < 1.0)).all()):
        raise ValueError(f"levels = {levels}: give numbers between 0 and 1")
    kept = kept_of(results, per)
    nees = results.get("nees", xr.DataArray(np.nan))
    if scale is not None:
        kept_of(results, [str(name) for name in scale.dims])
        nees, scale = xr.align(nees, scale, join="exact")
        nees = nees * scale
    limits = special.chdtri(DEGREES_OF_FREEDOM, 1.0 - nominal).tolist()
    joint = 1.0 - (1.0 - LEVEL) / len(limits)

    def values(poses: Poses) -> Floats:
        return poses["nees"].astype(np.float64)

    def used(poses: Poses) -> Masks:
        return poses.solved & ~np.isnan(values(poses))

    statistics: list[Statistic] = [
        PositiveMean("nees_mean", "mean normalised estimation error squared, expected 6", "1",
                     lambda poses: values(poses)[..., None], used),
    ]
    for at, limit in enumerate(limits):
        def within(poses: Poses, most: float = limit) -> Masks:
            return np.asarray(values(poses) <= most)

        statistics += [
            Rate(f"coverage {at}", "within the region of used", within, used,
                 counts=(("nees_count", "estimates with a normalised estimation error squared"),
                         (f"hits {at}", ""))),
            Rate(f"joint {at}", "within the region of used", within, used, joint),
        ]
    needed = errors(results) | {"nees": nees}
    table = aggregate(results, needed, kept, statistics)
    level = xr.DataArray(nominal, dims="level", attrs={
        "long_name": "nominal probability of the covariance's region", "units": "1"})

    def over_levels(name: str) -> xr.DataArray:
        parts = [table[name.format(at)] for at in range(len(limits))]
        return xr.concat(parts, dim="level").transpose(..., "level")

    right = ((over_levels("joint {}_low") - TOLERANCE <= level)
             & (level <= over_levels("joint {}_high") + TOLERANCE)).all("level")
    found = {name: table[name] for name in ("nees_mean", "nees_mean_low", "nees_mean_high")}
    found["nees_count"] = table["nees_count"]
    found["covariance_trusted"] = (right & (table["draws"] >= FEWEST)).assign_attrs(
        long_name="whether the coverage is the level, at every level", units="1")
    for ending, words in (("", ""), ("_low", "lower end of the 95 % interval: "),
                          ("_high", "upper end of the 95 % interval: ")):
        found[f"covariance_coverage{ending}"] = over_levels(f"coverage {{}}{ending}").assign_attrs(
            long_name=f"{words}share of estimates within the covariance's region of a level",
            units="1")
    return xr.Dataset(found, dict(table.coords)).assign_coords(level=level)
