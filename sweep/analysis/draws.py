"""How draws are sampled: trials, photographs or Sobol' replicates, all of them or till a stop.

Intervals of every statistic follow from how it varies between independent units (`Design`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import special

from sweep.analysis.dataset import (
    DRAWS,
    axes_of,
    configuration_axes,
    fingerprint_of,
    is_sampling_stopped,
)
from sweep.analysis.poses import NOT_LOOKED_FOR
from sweep.errors import DatasetError
from sweep.experiment.draws import REPLICATES
from sweep.experiment.parameters import Stage
from sweep.experiment.schema import VARIABLES
from sweep.measure.flags import DetectionStatus
from sweep.typing import Floats, Integers, Masks

# --------------------------------------------------------------------------------------------------
# What is independent: a trial, a photograph with all its markers, a replicate of Sobol' points.
#
# A unit counts as one draw, whatever it holds: the pooled settings of a trial see the same images,
# the errors of the markers of a photograph are correlated, and the points of a replicate
# (`sweep.experiment.draws`) fill their space evenly; the replicates have scrambles of their own.
# Means follow from the sums of units, with Student's t of the spread between them; rates
# and quantiles have the intervals of a number of draws that they are worth.
#
# Owen, "Randomly permuted (t,m,s)-nets and (t,s)-sequences", 1995; L'Ecuyer and Lemieux, "Recent
# advances in randomized quasi-Monte Carlo methods", 2002, section 2 (replicates).

MIN_SPREAD = 5
"""Photographs with the rarer outcome from which the spread between photographs is estimated."""

MAX_DRAWS = 10**9
"""The most draws that a rate is said to be worth."""


class Unit(Enum):
    """What is drawn independently of all else."""

    trial = "trial"
    photograph = "photograph"
    replicate = "replicate"


@dataclass(frozen=True)
class Sample:
    """The poses that count, and the draws that they are of.

    ``used`` (groups, cells, draws) is the number of settings of each draw that count.
    """

    used: Integers

    @property
    def n(self) -> Integers:
        """Poses (groups,), times pooled settings."""
        return np.asarray(self.used.sum(axis=(1, 2), dtype=np.int64))

    @property
    def draws(self) -> Integers:
        """Number of draws (groups,) that the poses are worth.

        That is the number of draws with a pose that counts if each has equally many of them; else
        it is less, for those with more of them count more: the effective sample size,
        (Σ m)² / Σ m² of m poses a draw, rounded down (Kish, "Survey Sampling", 1965, section 11.7).
        """
        squares = np.square(self.used, dtype=np.float64).sum(axis=(1, 2))
        return whole(self.n.astype(np.float64) ** 2 / np.maximum(squares, 1.0))

    @property
    def freedom(self) -> Integers:
        """Degrees of freedom (groups,): the draws beyond the first of each cell."""
        return np.asarray(np.maximum((self.used > 0).sum(axis=2) - 1, 0).sum(axis=1))

    @property
    def drawn(self) -> Masks:
        """Whether any cell has two draws, so that intervals exist; (groups,)."""
        return np.asarray(self.freedom > 0)


def whole(draws: Floats) -> Integers:
    """Return numbers of draws rounded down, but for what rounding took from them."""
    return np.asarray(np.floor(draws * (1.0 + 1e-12)), dtype=np.int64)


@dataclass(frozen=True)
class Design:
    """How the draws of a table were sampled.

    Attributes
    ----------
    unit
        What is independent: its axis is that of the draws.
    points
        Pooled settings that see the same Sobol' point.
    stopped
        Whether sampling stopped when intervals were narrow, or a decision was sure.
    """

    unit: Unit = Unit.trial
    points: int = 1
    stopped: bool = False

    def level(self, level: float, tail_share: float | None = None) -> float:
        """Return the level of the interval that is to hold its value with that probability."""
        if not self.stopped:
            return level
        return stopped_level(level, TAIL_SHARE if tail_share is None else tail_share)

    def draws_of_rate(self, hits: Integers, used: Integers, level: float) -> Integers:
        """Return `worth`, rounded down to whole draws."""
        return whole(self.worth(hits, used, level))

    def worth(self, hits: Integers, used: Integers, level: float) -> Floats:
        """Return the number of independent draws (groups,) that a rate is worth.

        Of trials it is `Sample.draws`. Of photographs and replicates it is p (1 - p) over the
        variance of the ratio of sums between units, Σ (e - ē)² m / ((m - 1) N²) in each cell, with
        e = h - p n for h successes of n poses in each of m units, and N poses in all (Cochran,
        "Sampling Techniques", 1977, sections 3.12 and 5A.14), times (z / t)² for m - 1 degrees of
        freedom: Korn and Graubard, "Confidence intervals for proportions with small expected number
        of positive counts estimated from survey data", Survey Methodology 24, 1998. If successes or
        failures are too few to tell how they spread, it is no more than the number of draws.

        Parameters
        ----------
        hits, used
            Numbers of successes and of poses that count (groups, cells, draws).
        level
            Of the interval.
        """
        sample = Sample(used)
        if self.unit is Unit.trial:
            return sample.draws.astype(np.float64)
        of_points = self.unit is Unit.replicate
        n, successes = (each.sum(axis=(1, 2), dtype=np.float64) for each in (used, hits))
        counted = np.ones_like(used, dtype=bool) if of_points else used > 0
        units = counted.sum(axis=2).astype(np.float64)
        tail = (1.0 - level) / 2.0
        with np.errstate(all="ignore"):
            rate = successes / n
            rests = hits - rate[:, None, None] * used
            rests = rests - (rests.sum(axis=2) / units)[..., None]
            squares = np.square(np.where(counted, rests, 0.0)).sum(axis=2)
            variance = (squares * units / (units - 1.0)).sum(axis=1) / n**2
            freedom = np.maximum(units.max(axis=1, initial=0.0) - 1.0, 1.0)
            shrink = (special.ndtri(tail) / special.stdtrit(freedom, tail)) ** 2
            binomial = rate * (1.0 - rate)
            if of_points:
                draws, most = n / self.points, float(MAX_DRAWS)
                # The spread between replicates of p points is no finer than a point.
                variance = np.maximum(
                    variance, binomial / (draws * np.maximum(draws / REPLICATES, 1.0)))
                few = np.minimum(successes, n - successes) < 2 * REPLICATES * self.points
            else:
                draws, most = sample.draws, n
                few = np.minimum(*((each > 0).sum(axis=(1, 2)) for each in (hits, used - hits))
                                 ) < MIN_SPREAD
            worth = np.fmin(shrink * binomial / variance, most)
            worth = np.where(few, np.fmin(worth, draws), worth)
        return np.where(n > 0, np.maximum(np.nan_to_num(worth, nan=1.0), 1.0), 0.0)


# --------------------------------------------------------------------------------------------------
# Replicates of Sobol' points.

def is_replicated(results: xr.Dataset) -> bool:
    """Return whether the draws of a dataset are Sobol' points."""
    return fingerprint_of(results).get("sampling") == "sobol"


def replicate_order(results: xr.Dataset, draws: Sequence[str]) -> NDArray[np.intp] | None:
    """Return the indices of the trials, those of each replicate together; None if not replicated.

    ``draws`` are the pooled dimensions of draws.

    Raises
    ------
    DatasetError
        If the dataset does not have equally many trials of each replicate.
    """
    if not is_replicated(results) or DRAWS not in draws:
        return None
    trials = results[DRAWS].to_numpy().astype(np.int64)
    replicate = trials % REPLICATES
    counts = np.bincount(replicate, minlength=REPLICATES)
    if len(set(counts.tolist())) > 1:
        raise DatasetError(
            f"{DRAWS}: not equally many of each of the {REPLICATES} replicates of Sobol' points "
            f"(sampling = sobol); keep a multiple of {REPLICATES} in a row, from a multiple of "
            f"{REPLICATES} on"
        )
    return np.argsort(replicate, kind="stable")


# --------------------------------------------------------------------------------------------------
# Stores whose sampling stopped when their intervals were narrow enough, or a decision was sure.
#
# *Intervals.* Who looks at an interval again and again and stops when it is narrow finds it
# narrow by chance, too: it then covers less than its level. So all intervals of such a store have
# smaller tails, by `TAIL_SHARE` (root mean squares and standard deviations, whose intervals are
# approximations: `SPREAD_TAIL_SHARE`), and those of rates are Clopper and Pearson's. By exact
# enumeration (`tests/support/stopped_rate.py`) those of rates then cover 95 % at least, whatever
# the rate; the others by simulation (`tests/sampling/test_stopped_coverage.py`).
#
# *Pooling.* Conditions that are hard to judge have more trials. A rate over conditions that
# counts all of them would be one of mostly hard ones. So what is pooled is pooled over the trials
# that all pooled cells have: each counts as it does in a store of equally many trials. Cells in
# which no pose was looked for have nothing to count, and do not lessen these trials.

TAIL_SHARE = 0.6
"""Tails of intervals of stores whose sampling was stopped, of those that they would have.

The interval of 95 % is one of 97 %. The least coverage of a rate, over all rates, half-widths from
0.005 to 0.25, waves of 5 to 99 draws at first and any largest number of trials, is then 0.954.
"""

SPREAD_TAIL_SHARE = 0.4
"""The same of root mean squares and standard deviations: the interval of 95 % is one of 98 %."""

def stopped_level(level: float, share: float = TAIL_SHARE) -> float:
    """Return the level of the interval that has another level where sampling was not stopped.

    >>> round(stopped_level(0.95), 3)
    0.97
    """
    return 1.0 - (1.0 - level) * share


# --------------------------------------------------------------------------------------------------
# Trials that all pooled cells have, where sampling was stopped, and scenes that were computed.

NOT_AVAILABLE = (DetectionStatus.not_run, DetectionStatus.not_needed)
"""Flags of the trials that a cell does not have."""


def common_trials(
    results: xr.Dataset, inputs: Mapping[str, xr.DataArray], kept: Sequence[str]
) -> xr.DataArray | None:
    """Return which trials all pooled cells have, computed; None if no cells are pooled.

    Parameters
    ----------
    results
        The dataset that names the axes.
    inputs
        Arrays by name; those whose name ends with ``detection`` hold flags of detection, and a
        trial must be in each.
    kept
        The dimensions that are not pooled.
    """
    scene = [name for name in axes_of(results, Stage.scene) if name != DRAWS]
    pooled = [name for name in scene if name not in kept]
    flags = [array for name, array in inputs.items() if name.split()[-1] == "detection"]
    if not pooled or not flags or DRAWS not in flags[0].dims:
        return None
    common = None
    for array in flags:
        # All configurations of a scene that is needed are computed.
        one = array.isel({dim: 0 for dim in array.dims if dim not in (*scene, DRAWS)}, drop=True)
        one = one.fillna(0) if one.dtype.kind == "f" else one
        counted = (~one.isin(NOT_LOOKED_FOR)).any(DRAWS)
        available = (~one.isin(NOT_AVAILABLE) | ~counted).all(
            [name for name in pooled if name in one.dims])
        common = available if common is None else common & available
    return None if common is None else common.reset_coords(drop=True).compute()


def with_common_trials(results: xr.Dataset, kept: Sequence[str]) -> xr.Dataset:
    """Return a dataset in which only trials that all pooled cells have are run.

    The same dataset unless sampling was stopped in it.
    """
    if not is_sampling_stopped(results):
        return results
    common = common_trials(results, {"detection": results["detection"]}, kept)
    if common is None:
        return results
    flags = {name: results[name] for name in ("detection", "estimate", "flipped")
             if name in results}
    return results.assign({
        name: array.where(common, VARIABLES[name].not_needed).astype(np.uint8).assign_attrs(
            array.attrs)
        for name, array in flags.items()})


def computed_scenes(results: xr.Dataset) -> xr.DataArray:
    """Return which scenes are computed (bool, over the axes of the scene).

    All configurations of a scene are computed, or none.
    """
    flags = results["detection"]
    first = {name: 0 for name in configuration_axes(results) if name in flags.dims}
    return ~flags.isel(first, drop=True).isin(NOT_AVAILABLE)
