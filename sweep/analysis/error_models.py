"""Error models: bias and covariance of poses as functions of the condition."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import itemgetter
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from sweep.analysis.dataset import (
    DRAWS,
    axes_of,
    is_grid_axis,
    kept_dimensions,
    parameter_value,
    with_sampling,
)
from sweep.analysis.estimator import INTERVAL, Columns, arranged
from sweep.analysis.intervals import DEVIATIONS
from sweep.analysis.poses import (
    DEPTH,
    SIGNED_INPUTS,
    Poses,
    bearing_of,
    in_sight_frame,
    pose_arrays,
    sight_rotation,
    viewing_angle_of,
)
from sweep.errors import ArgumentError, DatasetError
from sweep.experiment.schema import cf_attributes
from sweep.measure.flags import Flag, flag
from sweep.model.camera import VIEW_PARAMETERS, intrinsics
from sweep.typing import Floats, Integers, Masks

# --------------------------------------------------------------------------------------------------
# Fits of an error's bias and standard deviation over knots of distance, side and viewing angle.
#
# Between knots the bias and the logarithm of the standard deviation are linear in ln(distance),
# ln(side) and the viewing angle. With two knots of the distance the standard deviation is a power
# of it: more knots are for curves that are no power law.

#: Smallest mean square of an error: its unit is a radian or a share of the distance.
FLOOR = 1e-18

#: Weight, relative to the mean knot's data, with which a knot follows its neighbours: those without
#: data do so entirely, others by 0.1 % of the difference.
RIDGE = 1e-3

#: Weight, relative to the same, that makes every system of equations regular.
REGULAR = 1e-9

ITERATIONS = 50
#: Largest step of ln(variance) at which the iteration ends.
CONVERGED = 1e-9

#: Log-likelihood that a knot must add: a bias that is off by 0.2 standard deviations in 100 poses,
#: or a standard deviation that is off by 10 %.
GAIN = 2.0

#: Numbers of knots of an axis that are tried.
KNOTS = (2, 3, 4, 6, 8)

#: Sums of the powers 1 to 4 of the errors are kept.
POWERS = 4


@dataclass(frozen=True)
class BinSums:
    """Sums over the poses of bins.

    Attributes
    ----------
    count
        Poses (bins,).
    at
        Their mean ln(distance), ln(side) and viewing angle (bins, 3); any number where there is no
        pose.
    powers
        Sums of the errors' powers 1 to 4, (bins, 4).
    """

    count: Floats
    at: Floats
    powers: Floats

    @classmethod
    def of(cls, moments: Floats, quantity: int) -> BinSums:
        """Return the sums of an error, of the bins that have poses.

        ``moments`` (bins, columns) are the numbers of poses, sums of their three coordinates, and
        of the powers of each error.
        """
        some = moments[moments[:, 0] > 0]
        start = 4 + POWERS * quantity
        return cls(some[:, 0], some[:, 1:4] / some[:, :1], some[:, start : start + POWERS])

    def power_mean(self, centre: Floats, power: int) -> Floats:
        """Return the mean 2nd or 4th power of the errors minus ``centre`` (bins,)."""
        n = np.maximum(self.count, 1.0)
        s1, s2, s3, s4 = self.powers.T / n
        if power == 2:
            return np.asarray(np.maximum(s2 - 2.0 * centre * s1 + centre**2, FLOOR))
        return np.asarray(np.maximum(
            s4 - 4.0 * centre * s3 + 6.0 * centre**2 * s2 - 4.0 * centre**3 * s1 + centre**4,
            FLOOR**2))


@dataclass(frozen=True)
class Fit:
    """Coefficients (coefficients,) of the bias and of ln(variance), with their covariances."""

    bias: Floats
    log_variance: Floats
    bias_covariance: Floats
    log_variance_covariance: Floats

    def score(self, sums: BinSums, basis: Floats) -> float:
        """Return the log-likelihood of normal errors of other poses, up to a constant."""
        log_variance = basis @ self.log_variance
        square = sums.power_mean(basis @ self.bias, 2)
        return float(-0.5 * (sums.count * (log_variance + square * np.exp(-log_variance))).sum())

    def at(self, basis: Floats) -> Fit:
        """Return the fit at other points: ``basis`` (points, coefficients) are the functions there.

        >>> fit = Fit(*np.array([[0.0, 2.0], [1.0, 1.0]]), np.eye(2), np.eye(2))
        >>> fit.at(np.array([[0.5, 0.5]])).bias.tolist(), fit.bias_error.tolist()
        ([1.0], [1.0, 1.0])
        """
        return Fit(
            basis @ self.bias, basis @ self.log_variance,
            basis @ self.bias_covariance @ basis.T,
            basis @ self.log_variance_covariance @ basis.T)

    @property
    def bias_error(self) -> Floats:
        """Standard errors of the bias."""
        return np.sqrt(np.maximum(np.diag(self.bias_covariance), 0.0))

    @property
    def log_variance_error(self) -> Floats:
        """Standard errors of ln(variance)."""
        return np.sqrt(np.maximum(np.diag(self.log_variance_covariance), 0.0))


def hat_basis(at: Floats, knots: Sequence[Floats]) -> Floats:
    """Return the products of hat functions (n, knots) at points (n, axes).

    Each hat is 1 at its knot, 0 at all others, and linear between; beyond the ends they are
    constant. The knots of the last axis vary fastest.

    Examples
    --------
    >>> hat_basis(np.array([[0.5, 3.0]]), [np.array([0.0, 1.0, 2.0]), np.array([3.0])]).tolist()
    [[0.5, 0.5, 0.0]]
    """
    parts = [
        np.stack([np.interp(at[:, k], each, row) for row in np.eye(len(each))], axis=-1)
        for k, each in enumerate(knots)
    ]
    return functools.reduce(
        lambda a, b: (a[:, :, None] * b[:, None, :]).reshape(len(at), a.shape[1] * b.shape[1]),
        parts)


def differences(knots: Sequence[Floats]) -> Floats:
    """Return DᵀD (knots, knots) of the differences between neighbouring knots along each axis.

    >>> differences([np.arange(2.0), np.arange(1.0)]).tolist()
    [[1.0, -1.0], [-1.0, 1.0]]
    """
    total = np.zeros((math.prod(map(len, knots)),) * 2)
    for axis, of_axis in enumerate(knots):
        step = np.diff(np.eye(len(of_axis)), axis=0)
        parts: list[Any] = [np.eye(len(each)) for each in knots]
        parts[axis] = step.T @ step
        total += functools.reduce(np.kron, parts)
    return total


def fit_error(sums: BinSums, basis: Floats, penalty: Floats) -> Fit:
    """Return the fit of an error's bias and spread to the sums over bins.

    Parameters
    ----------
    sums
        Of the poses.
    basis
        Hat functions (bins, knots) at the bins' mean coordinates.
    penalty
        `differences` (knots, knots), which ties knots without data to their neighbours.

    Notes
    -----
    Normal errors with mean X b and variance exp(X c) by maximum likelihood: weighted least squares
    for b, a gamma regression with logarithmic link of the squared residuals for c, in turns: Smyth,
    "Generalized linear models with varying dispersion", J. R. Stat. Soc. B 51, 1989. The variance
    is then multiplied by N / (N - knots). The standard errors of c are those of the sandwich
    A⁻¹ M A⁻¹ with the bins' own fourth moments, so that tails need not be normal: White, "Maximum
    likelihood estimation of misspecified models", Econometrica 50, 1982.
    """
    count = sums.count
    mean = sums.powers[:, 0] / np.maximum(count, 1.0)
    bias = _weighted(basis, penalty, count, mean)
    square = sums.power_mean(basis @ bias, 2)
    log_variance = _weighted(basis, penalty, count, np.log(square))
    for _ in range(ITERATIONS):
        ratio = sums.power_mean(basis @ bias, 2) * np.exp(-(basis @ log_variance))
        step = np.clip(_weighted(basis, penalty, count, ratio - 1.0, log_variance), -2.0, 2.0)
        log_variance = log_variance + step
        bias = _bias(basis, penalty, count, mean, log_variance)[0]
        if np.abs(step).max() < CONVERGED:
            break
    fitted = basis @ log_variance
    bias, bias_covariance = _bias(basis, penalty, count, mean, log_variance)
    kurtosis = sums.power_mean(basis @ bias, 4) * np.exp(-2.0 * fitted)
    ratio = sums.power_mean(basis @ bias, 2) * np.exp(-fitted)
    bread = np.linalg.inv(_normal(basis, penalty, count)).astype(np.float64)
    # Mean of (residual² / variance - 1)². A bin's own is too small as often as it has not seen
    # its tails: it is at least the variance of all.
    spread = np.maximum(kurtosis - 2.0 * ratio + 1.0, 0.0)
    spread = np.maximum(spread, (count * spread).sum() / count.sum())
    meat = (basis * (count * spread)[:, None]).T @ basis
    total, free = count.sum(), basis.shape[1]
    few = 1.0 + 2.0 / max(total / free - 2.0, 1.0)  # variance of Student's t of a knot's poses
    return Fit(
        bias, log_variance + np.log(total / max(total - free, 1.0)),
        np.asarray(bias_covariance * few), np.asarray(bread @ meat @ bread * few))


def _bias(
    basis: Floats, penalty: Floats, count: Floats, mean: Floats, log_variance: Floats
) -> tuple[Floats, Floats]:
    """Return the coefficients of the bias and their covariance, by weighted least squares.

    In units of the knots' standard deviations, so that the penalty is as weak at all.
    """
    scale = np.exp(0.5 * log_variance)
    design, weight = basis * scale, count * np.exp(-(basis @ log_variance))
    covariance = np.linalg.inv(_normal(design, penalty, weight)).astype(np.float64)
    coefficients = covariance @ ((design * weight[:, None]).T @ mean)
    return scale * coefficients, covariance * scale[:, None] * scale


def _normal(basis: Floats, penalty: Floats, weight: Floats) -> Floats:
    """Return the matrix of the normal equations, made regular by a small penalty."""
    matrix = (basis * weight[:, None]).T @ basis
    scale = max(float(np.trace(matrix)) / len(matrix), 1e-300)
    return np.asarray(matrix + scale * (RIDGE * penalty + REGULAR * np.eye(len(matrix))))


def _weighted(
    basis: Floats, penalty: Floats, weight: Floats, values: Floats, present: Floats | None = None,
) -> Floats:
    """Return the weighted least-squares coefficients; a step from ``present`` ones if given."""
    right = (basis * weight[:, None]).T @ values
    matrix = _normal(basis, penalty, weight)
    if present is not None:  # the penalty is on the coefficients, not on the step
        right -= (matrix - (basis * weight[:, None]).T @ basis) @ present
    return np.asarray(np.linalg.solve(matrix, right))


def choose_knots(values: Floats, count: int) -> Floats:
    """Return ``count`` of the sorted values as knots: both ends, and evenly between them.

    >>> choose_knots(np.array([0.0, 1.0, 2.0, 5.0, 9.0]), 3).tolist()
    [0.0, 2.0, 9.0]
    """
    numbers = np.unique(np.rint(np.linspace(0, len(values) - 1, count)).astype(int))
    return np.asarray(values[numbers])


def select_knots(
    first: BinSums, second: BinSums, values: Sequence[Floats], gain: float = GAIN
) -> list[Floats]:
    """Return the knots of each axis: the fewest that describe poses that were not fitted.

    Parameters
    ----------
    first, second
        An error's sums of two halves of the draws.
    values
        The sorted values (n,) of each axis that may be knots.
    gain
        By how much one more knot must raise the log-likelihood of each half by the fit to the other
        half, summed over the halves.
    """
    counts = [[count for count in KNOTS if count < len(each)] + (
        [len(each)] if len(each) <= KNOTS[-1] else []) for each in values]

    def tried(numbers: Sequence[int]) -> tuple[float, list[int], list[Floats]]:
        """Return how well numbers of knots, by their indices in ``counts``, describe the poses."""
        knots = [choose_knots(each, some[k])
                 for each, some, k in zip(values, counts, numbers, strict=True)]
        penalty = differences(knots)
        a, b = (hat_basis(each.at, knots) for each in (first, second))
        total = fit_error(first, a, penalty).score(second, b)
        total += fit_error(second, b, penalty).score(first, a)
        return total - gain * len(penalty), [*numbers], knots

    best = tried([0] * len(values))
    while True:
        chosen = best[1]
        steps = [tried([*chosen[:axis], number, *chosen[axis + 1:]])
                 for axis, some in enumerate(counts)
                 for number in range(chosen[axis] + 1, min(chosen[axis] + 3, len(some)))]
        if not steps or (better := max(steps, key=itemgetter(0)))[0] <= best[0]:
            return best[2]
        best = better


# --------------------------------------------------------------------------------------------------
# Conditions of error models: their bins in a dataset, and the joint region that was seen.

#: Distinct values up to which each has a bin of its own.
MAX_VALUES = 24

#: Values that differ by less, relatively (angles: in degrees / 100), are the same.
SAME = 1e-6

#: Smallest viewing angles and bearings up to here: the model begins at 0.
FRONTAL_DEG = 5.0

#: Poses that a cell should have, on average, where cells can be made wider.
POSES_A_CELL = 150

#: Cells along a drawn condition in which the seen region is told.
MAX_REGION_CELLS = 12

#: Poses that such a cell should have, on average, so that none is empty by chance.
POSES_A_REGION_CELL = 15

#: Shares of two conditions' ranges by which their sum and difference may leave the seen ones; to it
#: comes that of `CORNER`.
SLACK = 0.05

#: Of n draws uniform in a square none lies in a corner of area 3 / n with a probability of 5 %: by
#: the root of it sums and differences may leave the seen ones, too.
CORNER = 3.0


@dataclass(frozen=True)
class Condition:
    """A condition that errors depend on, or that was seen with others.

    Attributes
    ----------
    words, units
        What tables call it, and its unit.
    logarithmic
        Whether the model is linear in its logarithm.
    tolerance
        Ratio of the largest value to the smallest (angles: difference in degrees) from which on it
        varies.
    bins, cells
        Bins of the fit, and cells in which the fit is judged, into which values are put that are
        not a few.
    """

    words: str
    units: str
    logarithmic: bool
    tolerance: float
    bins: int = 0
    cells: int = 0

    def scaled(self, values: ArrayLike) -> Floats:
        """Return values as the model is linear in them."""
        return np.asarray(np.log(values) if self.logarithmic else values, dtype=np.float64)

    def wider(self, low: float, high: float) -> tuple[float, float]:
        """Return ends that are farther out by as much as counts as the same."""
        if self.logarithmic:
            return low / self.tolerance, high * self.tolerance
        return low - self.tolerance, high + self.tolerance

    def varies(self, values: Floats) -> bool:
        """Return whether the last of the sorted values is another than the first."""
        return bool(values[-1] > self.wider(values[0], values[0])[1])

    def middles(self, groups: Sequence[Floats] | Floats) -> Floats:
        """Return the values between neighbouring groups of sorted values."""
        last = np.array([group[-1] for group in groups[:-1]])
        first = np.array([group[0] for group in groups[1:]])
        return np.asarray(np.sqrt(last * first) if self.logarithmic else (last + first) / 2)

    def edges(self, values: Floats, count: int, *, single: bool) -> Floats:
        """Return edges of one bin a value, or of ``count`` bins of about as many values each.

        A ``single`` bin, of what does not vary, is as wide as what counts as the same. The ends of
        others are so far out that rounding puts no pose outside; angles that begin near 0 begin
        at 0.
        """
        if single:
            return np.maximum(self.wider(values[0], values[-1]), 0.0)
        inner = self.middles(values[:, None]) if len(values) <= MAX_VALUES else (
            np.unique(np.quantile(values, np.linspace(0.0, 1.0, count + 1)))[1:-1])
        ends = values[[0, -1]]
        margin = 2.0 * SAME * ends if self.logarithmic else 100.0 * SAME
        low, high = ends + np.array([-1.0, 1.0]) * margin
        if not self.logarithmic and low <= FRONTAL_DEG:
            low = 0.0
        return np.concatenate([[low], inner, [high]])

    def between(self, values: Floats) -> Floats | None:
        """Return the middles between the few values, None if there are many.

        Values that jitter spreads by no more than what counts as the same are one.

        >>> CONDITIONS["bearing_deg"].between(
        ...     np.array([*np.linspace(0.0, 0.1, 99), 20.0])).tolist()
        [10.05]
        """
        groups: Sequence[Floats] = list(values[:, None])
        if len(values) > MAX_VALUES:
            same = math.log(self.tolerance) if self.logarithmic else self.tolerance
            jumps = np.diff(self.scaled(values)) > same
            groups = np.split(values, np.flatnonzero(jumps) + 1)
            if len(groups) > MAX_VALUES or any(map(self.varies, groups)):
                return None
        return self.middles(groups)


#: Models do not depend on the last, but hold where it was seen.
CONDITIONS = {
    "distance_m": Condition("the distance along the optical axis", "m", True, 1.02, 16, 12),
    "side_px": Condition("the side of the black square, were it parallel to the image", "px",
                         True, 1.02, 8, 6),
    "viewing_angle_deg": Condition("the angle between the marker's normal and the line of sight",
                                   "degree", False, 1.0, 16, 12),
    "bearing_deg": Condition("the angle between the line of sight and the optical axis", "degree",
                             False, 1.0),
}

#: Conditions on which models depend.
PREDICTORS = ("distance_m", "side_px", "viewing_angle_deg")


@dataclass(frozen=True)
class Bins:
    """Edges of the bins of distance (m), side (px), viewing angle and, at will, bearing (degrees).

    A value at the last edge belongs to the last bin.
    """

    edges: tuple[Floats, ...]

    @property
    def shape(self) -> tuple[int, ...]:
        """Numbers of bins."""
        return tuple(len(each) - 1 for each in self.edges)

    def numbers(self, values: Sequence[Floats]) -> tuple[Integers, Masks]:
        """Return the flat numbers of the bins of points, and which points are in a bin."""
        inside = np.ones(values[0].shape, dtype=bool)
        flat = np.zeros(values[0].shape, dtype=np.int64)
        for each, edges in zip(values, self.edges, strict=False):
            number = np.searchsorted(edges, each, side="right") - 1
            number = np.where(each == edges[-1], len(edges) - 2, number)
            inside &= (number >= 0) & (number < len(edges) - 1)
            flat = flat * (len(edges) - 1) + np.clip(number, 0, len(edges) - 2)
        return flat, inside


def focal_size_of(results: xr.Dataset) -> xr.DataArray:
    """Return fx times the side of the black square, px · m, over the dimensions that it has.

    Raises
    ------
    DatasetError
        If a parameter is not known.
    """
    try:
        values = {name: parameter_value(results, name) for name in (*VIEW_PARAMETERS, "size_m")}
    except DatasetError:
        if "side_px" not in results.coords:
            raise
        product = results["side_px"] * results["true_tvec_m"].isel(xyz=2, drop=True)
    else:
        fx = intrinsics(*(values[name] for name in VIEW_PARAMETERS))[0]
        product = xr.DataArray(fx) * values["size_m"]
    return product.astype(np.float64).reset_coords(drop=True)


def bins_and_cells(
    found: Mapping[str, Floats], poses: int, *, collinear: bool
) -> tuple[Bins, Bins]:
    """Return the bins that models are fitted to, and the wider cells in which they are judged.

    Few distinct values, of an axis, have a bin and a cell each; others, which were drawn, have some
    of about as many poses each.

    Parameters
    ----------
    found
        The `distinct_values`.
    poses
        Scenes of the dataset.
    collinear
        Whether the side follows from the distance: then it has one bin, as what does not vary.
    """
    varying = [name for name in PREDICTORS if CONDITIONS[name].varies(found[name])]
    if collinear and "distance_m" in varying:
        varying = [name for name in varying if name != "side_px"]
    few = [name for name in varying if len(found[name]) <= MAX_VALUES]
    others = math.prod(len(found[name]) for name in few)
    many = max(2, int((poses / (POSES_A_CELL * others)) ** (
        1.0 / max(len(varying) - len(few), 1))))

    def bins(count: Callable[[Condition], int]) -> Bins:
        return Bins(tuple(
            CONDITIONS[name].edges(
                found[name], count(CONDITIONS[name]), single=name not in varying)
            for name in PREDICTORS))

    return bins(lambda each: each.bins), bins(lambda each: min(many, each.cells))


def region_cells(
    found: Mapping[str, Floats], poses: int, trials: int
) -> tuple[Bins, tuple[int, ...]]:
    """Return the cells of conditions that poses are in or not, and which conditions were drawn.

    Few distinct values, of an axis, have a cell each, also those that jitter spreads a little;
    others have some cells of about as many values each.
    """
    middles = [CONDITIONS[name].between(values) for name, values in found.items()]
    drawn = tuple(k for k, middle in enumerate(middles) if middle is None)
    # Values that go together along an axis make fewer combinations.
    others = min(math.prod(len(middle) + 1 for middle in middles if middle is not None),
                 poses // trials)
    many = poses / (POSES_A_REGION_CELL * others)
    count = min(max(1, int(many ** (1.0 / max(len(drawn), 1)))), MAX_REGION_CELLS)
    shares = np.linspace(0.0, 1.0, count + 1)[1:-1]
    return Bins(tuple(
        np.concatenate([[-np.inf], np.unique(np.quantile(values, shares))
                        if middle is None else middle, [np.inf]])
        for middle, values in zip(middles, found.values(), strict=True))), drawn


def region_directions(found: Mapping[str, Floats]) -> Floats:
    """Return directions (n, 4) along which the seen region has two ends, the four axes first.

    In ln(distance), ln(side), viewing angle and bearing. The fifth is ln(fx size); then follow, of
    two conditions that vary, sum and difference in units of their ranges.
    """
    unit, rows = np.eye(len(found)), [*np.eye(len(found)), np.eye(len(found))[:2].sum(axis=0)]
    ranges = [np.ptp(CONDITIONS[name].scaled(values)) for name, values in found.items()]
    varying = [k for k, (name, values) in enumerate(found.items())
               if CONDITIONS[name].varies(values)]
    for a, b in itertools.combinations(varying, 2):
        rows += [unit[a] / ranges[a] + sign * unit[b] / ranges[b] for sign in (1.0, -1.0)]
    return np.stack(rows)


def region_ends(directions: Floats, reach: Floats, draws: Floats) -> tuple[Floats, Floats]:
    """Return the ends (models, directions) of the region along directions, from `error_models`.

    An end has a margin for rounding; where there is hardly an extent, as wide as what counts as
    the same; of sums and differences `SLACK` and what so many ``draws`` (models,) in each cell of
    the grid may leave empty in a corner (`CORNER`). Angles that begin near 0 begin at 0.
    """
    high, low = np.split(reach * np.repeat([1.0, -1.0], len(directions)), 2, axis=-1)
    logarithmic = np.array([each.logarithmic for each in CONDITIONS.values()])
    same = np.array([math.log(each.tolerance) if each.logarithmic else each.tolerance
                     for each in CONDITIONS.values()])
    # Knots at the ends lie 2e-6 outside the poses.
    rounding = np.where(logarithmic, 3.0 * SAME, 200.0 * SAME)
    alone = [*range(len(same)), 0]  # ln(fx size) has the tolerance of ln(distance)
    count = len(alone)
    margin = np.repeat(SLACK + np.sqrt(CORNER / draws)[:, None], low.shape[1], axis=1)
    margin[:, :count] = np.where(
        high[:, :count] - low[:, :count] <= same[alone], same[alone], rounding[alone])
    margin[:, count - 1] = np.maximum(margin[:, count - 1], 2.0 * rounding[0])  # of two ends
    wider = (low - margin)[:, : len(same)]
    ends = np.where(~logarithmic & (wider <= FRONTAL_DEG), 0.0, wider)
    # Where an angle begins at 0, its sums and differences reach as much farther.
    margin[:, count:] += (low[:, : len(same)] - ends) @ np.abs(directions[count:]).T
    low, high = low - margin, high + margin
    low[:, : len(same)] = ends
    return low, high


def distinct_values(columns: Columns[SightErrors]) -> dict[str, Floats]:
    """Return the sorted values (n,) of each condition among the poses looked for, the same once.

    Raises
    ------
    DatasetError
        If no pose was looked for.
    """
    def of_block(poses: SightErrors, _: tuple[slice, ...]) -> list[Floats]:
        used = poses.looked_for & (poses.distance_m > 0)
        return [np.unique(poses.used(each, used)) for each in poses.conditions]

    found = {}
    for (name, condition), parts in zip(
            CONDITIONS.items(), zip(*columns.map(of_block), strict=True), strict=True):
        values = np.unique(np.concatenate(parts))
        values = values[np.isfinite(values)]
        if not len(values):
            raise DatasetError("no pose was looked for: there are no errors to model")
        least = SAME * values[1:] if condition.logarithmic else 100 * SAME
        found[name] = values[np.concatenate([[True], np.diff(values) > least])]
    return found


def knot_values(bins: Bins, moments: Floats) -> list[Floats]:
    """Return the values that may be knots: of each axis the means of its bins, and both ends.

    Where a bin is a single value that is the value itself. ``moments`` (bins, 4) are the numbers of
    poses and the sums of their coordinates.
    """
    knots = []
    columns = moments.reshape(*bins.shape, 4)
    for axis, (name, edges) in enumerate(zip(PREDICTORS, bins.edges, strict=True)):
        others = tuple(k for k in range(len(bins.shape)) if k != axis)
        count, total = np.moveaxis(columns[..., [0, 1 + axis]].sum(axis=others), -1, 0)
        middle = total[count > 0] / count[count > 0]
        if len(middle) > 1:
            low, high = CONDITIONS[name].scaled(edges[[0, -1]])
            middle = np.unique([low, *middle[1:-1], high])
        knots.append(middle)
    return knots


# --------------------------------------------------------------------------------------------------
# Error models: bias and standard deviation of a pose over distance, side and viewing angle.

#: Share of normal errors within two standard deviations.
NOMINAL = 0.9545

#: Shares of held-out errors within two standard deviations between which a model holds.
COVERAGE = (0.93, 0.97)

#: Held-out poses from which on a cell is judged.
MIN_JUDGED = 100

#: Share of flipped poses up to which a cell's errors are described without them: were they counted
#: as outside, 93 % of normal errors would still lie within two standard deviations.
MAX_FLIPS = 0.02

#: Share of solved poses down to which a cell's errors are described.
MIN_DETECTION = 0.9

#: Solved poses, not flipped, from which on a model is fitted.
MIN_POSES = 200

#: Distances at which every model is given, although it may need fewer knots.
SHOWN_DISTANCES = 6

#: Models up to which they are made together.
MAX_MODELS = 64


class Use(Flag):
    """Whether an error model may be used in a cell."""

    no_poses = flag(0, "The store has no poses there: must not be used.", counted=False)
    holds = flag(1, "93 to 97 % of held-out errors lie within two standard deviations.",
                 present=True)
    too_narrow = flag(2, "Fewer held-out errors than that do: must not be used.")
    too_wide = flag(3, "More do (errors are bounded, or mixed): too careful, else harmless.")
    few_draws = flag(4, "Fewer than 100 held-out poses: not judged, must not be used.")
    flips = flag(5, "More than 2 % of the poses are flipped: must not be used.")
    rarely_solved = flag(6, "Less than 90 % of the poses are solved: must not be used.")




def error_models(results: xr.Dataset) -> xr.Dataset:
    """Return models of the pose's error for each configuration, with intervals and a check.

    Parameters
    ----------
    results
        The dataset of a run with random draws: at least two trials. Axes of the camera and the
        pose, ``size_m`` and ``marker_id`` are pooled; every other axis (detector, solver,
        ``believed_*``, ``dictionary``, noise, ...) keeps its models apart.

    Returns
    -------
    xr.Dataset
        Dimensions: the axes that are kept apart; ``quantity``: ``x``, ``y``, ``z`` (m), and the
        rotation vector ``rotation_x``, ``rotation_y``, ``rotation_z`` (rad), estimated minus true,
        in the sight frame, which is the camera's frame turned so that z is the line of sight
        (`sweep.analysis.poses`; z is the error of the range); knots ``distance_m`` (along
        the optical axis), ``side_px`` and ``viewing_angle_deg``; and cells of these three.

        - ``sigma``, ``bias`` at the knots, with ``_low`` and ``_high``. Between knots ln(sigma) and
          the bias (of positions: over the distance) are linear in ln(distance), ln(side) and the
          angle. With two knots of the distance sigma is a power of it. A predictor that does not
          vary, or follows from the distance (``side_px``: one size and camera), has one knot.
        - ``exponent`` (quantity): of the distance (or the side, where only that varies), if sigma
          is a power of it at every angle, with its interval.
        - ``coverage`` (quantity, cells): share of errors within two sigma of the bias, by a model
          of the other half of the trials (even, odd); ``judged`` poses. ``camera_coverage``: the
          same along and about the camera's own axes.
        - ``use`` (quantity, cells): whether the model may be used there (`Use`): the coverage lies
          within 0.93 to 0.97, with a tolerance of a standard error, and that of each half of the
          trials with one of two.
        - ``region_low``, ``region_high`` (direction), ``region_seen`` (cells): the joint region of
          distance, side, viewing angle and bearing in which poses were looked for; outside it the
          model has no answer. In it are conditions whose weighted sums (``direction_weight``) lie
          between both ends, and that are in a cell with poses.
        - ``flip_rate``, ``solved_rate`` and ``looked_for`` (cells). Flipped and missing poses are
          in these, not in sigma.

    Raises
    ------
    DatasetError
        If nothing was drawn, if fewer than 200 poses of a configuration were solved, or if the
        dataset lacks variables or the parameters that the side follows from.

    Notes
    -----
    The knots of an error (their numbers: ``knots``) are the fewest that describe the other half of
    the trials: one more must raise their log-likelihood by 2. All errors are given at the knots of
    all. The fit: `fit_error`. Intervals are at 95 %, over the random draws, of each value alone.

    Examples
    --------
    >>> parts = [results.assign_coords(trial=results["trial"] + 8 * k) for k in range(40)]
    >>> models = error_models(xr.concat(parts, "trial"))
    >>> list(models["sigma"].dims)
    ['solver', 'quantity', 'distance_m', 'side_px', 'viewing_angle_deg']
    >>> [Use(flag).name for flag in models["use"].sel(quantity="z")[0].values.ravel()]
    ['too_narrow', 'rarely_solved', 'rarely_solved']
    """
    kept = [name for name in axes_of(results) if is_kept(name, results)]
    kept_dimensions(results, kept)
    inputs = pose_arrays(results, SIGNED_INPUTS)
    _check_drawn(results, kept)
    focal_size = focal_size_of(results)
    inputs |= {
        HALF: (results[DRAWS] % HALVES).astype(np.int64).reset_coords(drop=True).drop_vars(DRAWS),
        FOCAL_SIZE: focal_size}
    columns = Columns(arranged(results, inputs, kept)[0], SightErrors)
    found = distinct_values(columns)
    poses = math.prod(
        size for name, size in results["true_tvec_m"].sizes.items() if name != "xyz")
    least, most = float(focal_size.min()), float(focal_size.max())
    bins, cells = bins_and_cells(
        found, poses, collinear=most <= least * CONDITIONS["side_px"].tolerance)
    region, drawn = region_cells(found, poses, results.sizes[DRAWS])
    directions = region_directions(found)
    moments = columns.sums(functools.partial(_moments, bins))
    _check_solved(moments, results, kept)
    values = knot_values(bins, moments[..., :4].sum(axis=(0, 1)))
    selected = [[select_knots(BinSums.of(model[0], k), BinSums.of(model[1], k), values)
                 for k in range(len(QUANTITIES))] for model in moments]
    shown = [choose_knots(values[0], SHOWN_DISTANCES), *(each[:1] for each in values[1:])]
    # All errors are given at the knots of all: what is linear between some is so between all.
    knots = [np.unique(np.concatenate(each)) for each in zip(
        shown, *(own for model in selected for own in model), strict=True)]
    # The model of each half, by which the other is judged:
    # (models, halves, knots, quantities, 2).
    fitted = np.array([
        [[(fit.bias, fit.log_variance) for fit in _fits(half, own, knots)] for half in model]
        for model, own in zip(moments, selected, strict=True)]).transpose(0, 1, 4, 2, 3)
    judged = columns.sums(functools.partial(_within, cells, knots, fitted))
    seen = columns.sums(lambda poses, _: _add(region, poses, poses.looked_for, [1.0]))
    reach = columns.sums(lambda poses, _: _reach(directions, poses), np.maximum)
    whole = moments.sum(axis=1)
    table = {
        **_knot_variables([_fits(*each, knots) for each in zip(whole, selected, strict=True)],
                          knots),
        **_exponents(whole), **_cell_variables(judged, cells),
        **_region_variables(region, drawn, directions, seen.sum(axis=(1, 3)), reach),
        "knots": (("quantity", "predictor"), np.array(
            [[[*map(len, own)] for own in model] for model in selected]),
            cf_attributes("knots that the error needs", "1"))}
    shape = tuple(results.sizes[name] for name in kept)
    variables: dict[str, Any] = {
        name: ((*kept, *dims), array.reshape((*shape, *array.shape[1:])), attributes)
        for name, (dims, array, attributes) in table.items()}
    variables["direction_weight"] = (("direction", "condition"), directions, cf_attributes(
        "weights of ln(distance), ln(side), viewing angle and bearing", ""))
    coordinates: dict[str, Any] = {
        name: results[name].variable for name in kept if name in results.coords}
    coordinates |= {"quantity": list(QUANTITIES), "predictor": list(PREDICTORS),
                    "condition": list(CONDITIONS)}

    def described(name: str, words: str) -> dict[str, str]:
        return {"units": CONDITIONS[name].units, "long_name": f"{words} {CONDITIONS[name].words}"}

    for name, at_knots, edges in zip(PREDICTORS, knots, cells.edges, strict=True):
        # A knot at an end must not leave the domain by the rounding of its logarithm.
        plain = np.clip(np.exp(at_knots), edges[0], edges[-1]) if (
            CONDITIONS[name].logarithmic) else at_knots
        coordinates[name] = name, plain, described(name, "knots of")
        for ending, ends in (("low", edges[:-1]), ("high", edges[1:])):
            coordinates[f"cell_{name}_{ending}"] = (
                f"cell_{name}", ends, described(name, f"{ending} end of cells of"))
    for name, edges in zip(CONDITIONS, region.edges, strict=True):
        coordinates[f"region_{name}"] = (
            f"region_{name}", edges[:-1], described(name, "low end of cells of the region of"))
    return with_sampling(xr.Dataset(variables, coordinates, attrs={
        "focal_size_px_m": float(focal_size.mean()),
        "focal_size_varies": int(most > least * (1 + 1e-9)),
    }), results)


def _fits(
    moments: Floats, own: Sequence[Sequence[Floats]], knots: Sequence[Floats]
) -> list[Fit]:
    """Return the fits of the errors with their own knots, at the knots of all."""
    # Points of the grid of all knots, the last axis fastest.
    points = np.stack([each.ravel() for each in np.meshgrid(*knots, indexing="ij")], axis=-1)
    fits = []
    for quantity, of_error in enumerate(own):
        sums = BinSums.of(moments, quantity)
        fit = fit_error(sums, hat_basis(sums.at, of_error), differences(of_error))
        fits.append(fit.at(hat_basis(points, of_error)))
    return fits


def is_kept(name: str, results: xr.Dataset) -> bool:
    """Return whether an axis keeps models apart."""
    return name != DRAWS and (name == "dictionary" or not is_grid_axis(name, results))


def _check_drawn(results: xr.Dataset, kept: Sequence[str]) -> None:
    """Raise DatasetError unless there are two halves of draws, and not too many models."""
    count = int(np.prod([results.sizes[name] for name in kept], dtype=np.int64))
    if count > MAX_MODELS:
        raise DatasetError(f"{count:,} models, one for each value of {', '.join(kept)}: "
                           f"expected at most {MAX_MODELS}; choose values with results.sel")
    trials = results.sizes.get(DRAWS, 1)
    if trials < HALVES or len(set((np.asarray(results[DRAWS].values) % HALVES).tolist())) < HALVES:
        raise DatasetError(
            f"{DRAWS} has {'1 value' if trials == 1 else 'no even or no odd values'}: an error "
            "model is fitted to some random draws and checked on others; run with 50 trials or "
            "more, and with something drawn, such as azimuth_deg = { uniform = [0, 360] }")


#: Variables of one model: dimensions, values, attributes.
Table = dict[str, tuple[tuple[str, ...], NDArray[Any], dict[str, Any]]]


def _check_solved(moments: Floats, results: xr.Dataset, kept: Sequence[str]) -> None:
    """Raise DatasetError if a configuration has too few solved poses."""
    solved = moments[..., 0].sum(axis=2).min(axis=1).astype(int) * HALVES
    for number, count in enumerate(solved.tolist()):
        if count < MIN_POSES:
            index = np.unravel_index(number, [results.sizes[name] for name in kept])
            which = ", ".join(f"{name} = {results[name].values[k]}"
                              for name, k in zip(kept, index, strict=True))
            raise DatasetError(
                f"{which + ': ' if which else ''}{count:,} solved poses that are not flipped; an "
                f"error model needs {MIN_POSES} or more: more trials, or larger sides")


def _metres(distance_m: Floats) -> Floats:
    """Return the factors of errors (quantities, distances): of positions the distances."""
    scale = np.where(np.arange(len(QUANTITIES)) < 3, 1.0, 0.0)[:, None]
    return np.asarray(scale * distance_m + (1.0 - scale))


def _region_variables(
    region: Bins, drawn: Sequence[int], directions: Floats, counts: Floats, reach: Floats
) -> Table:
    """Return the joint region of the conditions that was seen.

    ``counts`` (models, cells) are the poses looked for, ``reach`` their projections.
    """
    cells = counts.reshape(-1, *region.shape)
    of_grid = cells.sum(axis=tuple(1 + k for k in drawn)).reshape(len(cells), -1)
    draws = np.where(of_grid > 0, of_grid, np.inf).min(axis=1)
    low, high = region_ends(directions, reach, draws)
    return {
        "region_low": (("direction",), low, cf_attributes(
            "smallest weighted sum of a direction in the region", "")),
        "region_high": (("direction",), high, cf_attributes(
            "largest weighted sum of a direction in the region", "")),
        "region_seen": (tuple(f"region_{name}" for name in CONDITIONS), cells > 0, cf_attributes(
            "whether a cell of the conditions has poses", "1")),
    }


def _knot_variables(fits: Sequence[Sequence[Fit]], knots: Sequence[Floats]) -> Table:
    """Return sigma and bias of each error at the knots, with their intervals."""
    shape = (-1, len(QUANTITIES), *map(len, knots))
    metres = _metres(np.exp(knots[0]))[:, :, None, None]
    bias, bias_error, log_variance, error = np.moveaxis(np.array([
        [(fit.bias, fit.bias_error, fit.log_variance, fit.log_variance_error) for fit in model]
        for model in fits]), 2, 0)
    table: Table = {}
    for (ending, words), side in zip(INTERVAL.items(), (0.0, -1.0, 1.0), strict=True):
        for name, meaning, values in (
            ("sigma", "standard deviation of the error",
             np.exp(0.5 * (log_variance + side * DEVIATIONS * error))),
            ("bias", "mean error, estimated minus true", bias + side * DEVIATIONS * bias_error),
        ):
            table[f"{name}{ending}"] = (
                ("quantity", *PREDICTORS), values.reshape(shape) * metres,
                cf_attributes(f"{words}{meaning}", "m, radian"))
    return table


def _cell_variables(halves: Floats, bins: Bins) -> Table:
    """Return whether models may be used in cells; ``halves`` (models, halves, cells, columns)."""
    sums = halves.sum(axis=1)
    looked_for, solved, flipped, n = np.moveaxis(
        np.rint(sums[..., : len(COUNTS)]).astype(np.int64), -1, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        within, camera = np.split(halves[..., len(COUNTS):], 2, axis=-1)
        coverage, in_camera = (each.sum(axis=1) / n[..., None] for each in (within, camera))
        flip_rate, solved_rate = flipped / solved, solved / looked_for
        judged = halves[..., [COUNTS.index("judged")]]
        spread, spread_of_half = (
            np.sqrt(NOMINAL * (1.0 - NOMINAL) / count) for count in (n[..., None], judged))
        of_half = within / judged
    # Limits are wider by a standard error, of each half by two.
    low, high = (
        (sign * (coverage - limit) > spread) | (
            sign * (of_half - limit) > 2.0 * spread_of_half).any(axis=1)
        for sign, limit in zip((-1.0, 1.0), COVERAGE, strict=True))
    use = np.select(
        [*(each[..., None] for each in (
            looked_for == 0, solved_rate < MIN_DETECTION, flip_rate > MAX_FLIPS, n < MIN_JUDGED)),
         low, high],
        [Use.no_poses, Use.rarely_solved, Use.flips, Use.few_draws, Use.too_narrow, Use.too_wide],
        Use.holds).astype(np.uint8)
    cells = tuple(f"cell_{name}" for name in PREDICTORS)
    table: Table = {
        name: (("quantity", *cells), np.moveaxis(values, -1, 1).reshape(
            -1, len(QUANTITIES), *bins.shape), attributes)
        for name, values, attributes in (
            ("coverage", coverage, cf_attributes(
                "share of held-out errors within two sigma of the bias", "1")),
            ("camera_coverage", in_camera, cf_attributes(
                "the same along and about the camera's own axes", "1")),
            ("use", use, cf_attributes("whether the model may be used", "", flags=Use)))}
    return table | {
        name: (cells, values.reshape(-1, *bins.shape), cf_attributes(meaning, "1"))
        for name, values, meaning in (
            ("judged", n, "held-out poses that were judged"),
            ("looked_for", looked_for, "poses looked for"),
            ("solved_rate", solved_rate, "solved of the poses looked for"),
            ("flip_rate", flip_rate, "nearer to the mirror of the truth, of the solved"))}


def _exponents(moments: Floats) -> Table:
    """Return the power of the distance, or of the side, with which sigma goes."""
    values = np.full((3, len(moments), len(QUANTITIES)), np.nan)
    for model, k in np.ndindex(*values.shape[1:]):
        sums = BinSums.of(moments[model], k)
        axis = 0 if np.ptp(sums.at[:, 0]) > 0.05 or np.ptp(sums.at[:, 1]) < 0.05 else 1
        if np.ptp(sums.at[:, axis]) < 0.05:
            continue
        angles = np.unique(np.quantile(sums.at[:, 2], [0, 0.25, 0.5, 0.75, 1]).round(3))
        design = np.concatenate([sums.at[:, [axis]], hat_basis(sums.at[:, [2]], [angles])], axis=1)
        fit = fit_error(sums, design, np.zeros([design.shape[1]] * 2))
        metres = 1.0 if axis == 0 and k < 3 else 0.0
        half = DEVIATIONS * 0.5 * fit.log_variance_error[0]
        values[:, model, k] = 0.5 * fit.log_variance[0] + metres + half * np.array([0.0, -1.0, 1.0])
    words = "power of the distance (of the side, if only that varies) with which sigma goes"
    return {f"exponent{ending}": (("quantity",), each, cf_attributes(text + words, "1"))
            for (ending, text), each in zip(INTERVAL.items(), values, strict=True)}


# --------------------------------------------------------------------------------------------------
# Sums of a block's poses, in bins: moments of errors, and how many lie within two sigma.

#: Errors in the sight frame: of the position (m), and the rotation vector (rad).
QUANTITIES = ("x", "y", "z", "rotation_x", "rotation_y", "rotation_z")

#: The even trials and the odd ones.
HALVES = 2

#: Names of a block's arrays: the half, fx times the marker's side.
HALF, FOCAL_SIZE = "half", "focal_size"

#: Columns that are judged before the shares.
COUNTS = ("looked_for", "solved", "flipped", "judged")


class SightErrors(Poses):
    """Poses with their errors in the sight frame."""

    @cached_property
    def distance_m(self) -> Floats:
        """True z of the marker's centre (...)."""
        return np.asarray(self[DEPTH], dtype=np.float64)

    @cached_property
    def conditions(self) -> tuple[Floats, ...]:
        """`CONDITIONS`, each (...); the side is fx · size / distance."""
        with np.errstate(divide="ignore", invalid="ignore"):
            side = np.asarray(self[FOCAL_SIZE] / self.distance_m, dtype=np.float64)
        return (self.distance_m, side, viewing_angle_of(self["true_rvec"], self["true_tvec_m"]),
                bearing_of(self["true_tvec_m"]))

    @cached_property
    def in_camera(self) -> Floats:
        """Errors (..., 6) along and about the camera's axes; positions over the distance."""
        position = self["translation_error_m"].astype(np.float64) / self.distance_m[..., None]
        return np.concatenate(
            [position, self["rotation_error_rad"].astype(np.float64)], axis=-1)

    @cached_property
    def in_sight(self) -> Floats:
        """The same in the sight frame."""
        parts = (self.in_camera[..., :3], self.in_camera[..., 3:])
        return np.concatenate(
            [in_sight_frame(part, self["true_tvec_m"]) for part in parts], axis=-1)

    def at(self, used: Masks) -> Floats:
        """Return ln(distance), ln(side), viewing angle and bearing of the used poses, (n, 4)."""
        distance, side, *angles = (self.used(each, used) for each in self.conditions)
        return np.stack([np.log(distance), np.log(side), *angles], axis=-1)

    @staticmethod
    def used(values: NDArray[Any], used: Masks) -> NDArray[Any]:
        """Return the values (n, ...) of the used poses."""
        return np.broadcast_to(values, (*used.shape, *values.shape[used.ndim:]))[used]


def _add(bins: Bins, poses: SightErrors, used: Masks, columns: Sequence[Any]) -> Floats:
    """Return sums (groups, halves, bins, columns) over the used poses that lie in a bin.

    ``used`` has the shape of the poses' flags; columns are (n,) of all used ones, or 1 each.
    """
    number, inside = bins.numbers(poses.conditions)
    groups, size = len(poses.detection), math.prod(bins.shape)
    flat = (np.arange(groups).reshape(-1, 1, 1, 1) * HALVES + poses[HALF]) * size + number
    at = np.broadcast_to(flat, used.shape)[used]
    within = np.broadcast_to(inside, used.shape)[used]
    sums = [np.bincount(at, np.where(within, each, 0.0), groups * HALVES * size)
            for each in columns]
    return np.stack(sums, axis=-1).reshape(groups, HALVES, size, len(columns)).astype(float)


def _reach(directions: Floats, poses: SightErrors) -> Floats:
    """Return how far the poses looked for reach, (groups, 2 x directions).

    That is the largest projection on each direction (directions, 4) in ln(distance), ln(side),
    viewing angle and bearing, then on its opposite.
    """
    shape = poses.looked_for.shape
    counted = poses.looked_for & (poses.distance_m > 0)
    of_group = np.broadcast_to(np.arange(shape[0]).reshape(-1, 1, 1, 1), shape)[counted]
    projected = poses.at(counted) @ directions.T
    reach = np.full((shape[0], 2 * len(directions)), -np.inf)
    np.maximum.at(reach, of_group, np.concatenate([projected, -projected], axis=-1))
    return reach


def _moments(bins: Bins, poses: SightErrors, _: slice) -> Floats:
    """Return numbers of poses, sums of their coordinates and of the powers of each error."""
    used = poses.unflipped & poses.looked_for
    errors = poses.used(poses.in_sight, used)
    columns = [1.0, *poses.at(used)[:, :3].T]
    for error in errors.T:
        columns += [error, error**2, error**2 * error, (error**2) ** 2]
    return _add(bins, poses, used, columns)


def _within(
    bins: Bins, knots: Sequence[Floats], fitted: Floats, poses: SightErrors, groups: slice
) -> Floats:
    """Return how many errors lie within two standard deviations of the bias.

    The columns are `COUNTS`; those within, for each error in the sight frame; the same along and
    about the camera's axes. Each half of the trials is judged by the model of the other: ``fitted``
    (models, halves, knots, quantities, 2) are bias and ln(variance).
    """
    used = poses.unflipped & poses.looked_for
    half = poses.used(poses[HALF], used)
    model = poses.used(
        groups.start + np.arange(len(poses.detection)).reshape(-1, 1, 1, 1), used)
    basis = hat_basis(poses.at(used)[:, :3], knots)
    bias, log_variance = np.moveaxis(
        np.einsum("nk,nkqv->nqv", basis, fitted[model, 1 - half]), -1, 0)
    sigma = np.exp(0.5 * log_variance)
    sight, camera = (poses.used(each, used) for each in (poses.in_sight, poses.in_camera))
    turn = sight_rotation(poses.used(poses["true_tvec_m"], used))
    columns = [*(np.abs(sight - bias) <= 2.0 * sigma).T]
    for part in (slice(0, 3), slice(3, 6)):
        mean = np.einsum("nij,nj->ni", turn, bias[:, part])
        spread = np.sqrt(np.einsum("nij,nj->ni", turn**2, sigma[:, part] ** 2))
        columns += [*(np.abs(camera[:, part] - mean) <= 2.0 * spread).T]
    counts = [_add(bins, poses, mask & poses.looked_for, [1.0])
              for mask in (poses.looked_for, poses.solved, poses.flipped, poses.unflipped)]
    return np.concatenate([*counts, _add(bins, poses, used, columns)], axis=-1)


# --------------------------------------------------------------------------------------------------
# Values of an error model at poses: bias, standard deviation and covariance.

def model_errors(
    model: xr.Dataset, distance_m: ArrayLike, viewing_angle_deg: ArrayLike,
    side_px: ArrayLike | None = None, bearing_deg: ArrayLike | None = None,
) -> xr.Dataset:
    """Return bias and standard deviation of the pose's error at some conditions.

    Parameters
    ----------
    model
        One model of `error_models`: choose a configuration with ``models.isel(...)``.
    distance_m
        Distances (n,) along the optical axis.
    viewing_angle_deg
        Angles (n,) between the marker's normal and the line of sight.
    side_px
        Sides (n,) of the black square, were it parallel to the image; by default what follows from
        the distance, if the store has one size and one focal length.
    bearing_deg
        Angles (n,) between the line of sight and the optical axis; by default any that was seen
        with the other conditions.

    Returns
    -------
    xr.Dataset
        ``sigma``, ``bias`` (n, quantity), in metres and radians, in the sight frame; ``use`` (n,
        quantity), flags of `Use`; ``flip_rate``, ``solved_rate`` (n,) of the cell. Where the store
        has not seen the conditions together, all are NaN and ``use`` is ``no_poses``.

    Raises
    ------
    ArgumentError
        If there are several models, or no side where it does not follow.

    Notes
    -----
    ln(sigma) and the bias (of positions: over the distance) are linear between the knots of the
    model in ln(distance), ln(side) and the angle.

    Examples
    --------
    >>> parts = [results.assign_coords(trial=results["trial"] + 8 * k) for k in range(40)]
    >>> from sweep.analysis import error_models
    >>> models = error_models(xr.concat(parts, "trial"))
    >>> found = model_errors(models.isel(solver=0), [1.0, 99.0], 0.0)
    >>> found["sigma"].sel(quantity="z").round(5).values.tolist()
    [0.00076, nan]
    """
    if model["sigma"].dims != ("quantity", *PREDICTORS):
        others = [str(dim) for dim in model["sigma"].dims if dim not in ("quantity", *PREDICTORS)]
        raise ArgumentError("model", f"models for each {', '.join(others)}",
                            "expected one model; choose one with models.isel(...)")
    if side_px is None:
        if model.attrs["focal_size_varies"]:
            raise ArgumentError("side_px", None, "expected the side: it varies in the store")
        with np.errstate(divide="ignore"):
            side_px = model.attrs["focal_size_px_m"] / np.asarray(distance_m, dtype=np.float64)
    values = np.broadcast_arrays(*(np.atleast_1d(np.asarray(each, dtype=np.float64)) for each in (
        distance_m, side_px, viewing_angle_deg, np.nan if bearing_deg is None else bearing_deg)))
    with np.errstate(divide="ignore", invalid="ignore"):
        at = np.stack([condition.scaled(each) for condition, each in zip(
            CONDITIONS.values(), values, strict=True)], axis=-1)
    cell = np.ravel_multi_index(tuple(
        np.searchsorted(cell_edges(model, name)[1:-1], each, side="right")
        for name, each in zip(PREDICTORS, values, strict=False)), model["flip_rate"].shape)
    basis = hat_basis(at[:, : len(PREDICTORS)], [
        CONDITIONS[name].scaled(model[name].values) for name in PREDICTORS])
    flat = (len(QUANTITIES), -1)
    use = model["use"].values.reshape(flat)[:, cell].T
    inside = _seen(model, at, any_bearing=bearing_deg is None) & (use != Use.no_poses).all(axis=1)
    bias = model["bias"].values / _metres(model["distance_m"].values)[:, :, None, None]
    found = {
        "sigma": np.exp(basis @ np.log(model["sigma"].values).reshape(flat).T),
        "bias": basis @ bias.reshape(flat).T * _metres(values[0]).T,
    }
    out: dict[str, Any] = {
        name: (("pose", "quantity"), np.where(inside[:, None], each, np.nan),
               {"units": "m, radian"}) for name, each in found.items()}
    out["use"] = (("pose", "quantity"), np.where(inside[:, None], use, Use.no_poses),
                  model["use"].attrs)
    for name in ("flip_rate", "solved_rate"):
        rate = model[name].values.ravel()[cell]
        out[name] = ("pose", np.where(inside, rate, np.nan), model[name].attrs)
    return xr.Dataset(out, {"quantity": list(QUANTITIES)})


def model_covariance(
    model: xr.Dataset, position_m: ArrayLike, viewing_angle_deg: ArrayLike,
    side_px: ArrayLike | None = None,
) -> xr.Dataset:
    """Return covariance and bias of the pose's error along and about the camera's axes.

    Parameters
    ----------
    model, viewing_angle_deg, side_px
        As in `model_errors`.
    position_m
        Positions (n, 3) of the marker in the camera's frame; estimated ones do.

    Returns
    -------
    xr.Dataset
        ``covariance`` (pose, row, column) and ``bias`` (pose, row) in the order x, y, z (m),
        rotation about x, y, z (rad): that of the message ``geometry_msgs/PoseWithCovariance`` of
        ROS, whose 36 numbers are the rows one after another. Subtract the bias from the estimate
        before the covariance describes what is left. ``use`` as in `model_errors`.

    Raises
    ------
    ArgumentError
        As in `model_errors`.

    Notes
    -----
    Q diag(sigma²) Qᵀ for position and rotation each, with Q of `sight_rotation`.

    Examples
    --------
    >>> parts = [results.assign_coords(trial=results["trial"] + 8 * k) for k in range(40)]
    >>> from sweep.analysis import error_models
    >>> models = error_models(xr.concat(parts, "trial"))
    >>> pose = model_covariance(models.isel(solver=0), [0.0, 0.0, 1.0], 0.0)
    >>> pose["covariance"].shape, bool(pose["covariance"][0, 2, 2] > 0)
    ((1, 6, 6), True)
    """
    position = np.atleast_2d(np.asarray(position_m, dtype=np.float64))
    values = model_errors(
        model, position[:, 2], viewing_angle_deg, side_px, bearing_of(position))
    turn = sight_rotation(position)
    covariance = np.zeros((len(position), 6, 6))
    bias = np.zeros((len(position), 6))
    for part in (slice(0, 3), slice(3, 6)):
        variance = values["sigma"].values[:, part] ** 2
        covariance[:, part, part] = np.einsum("nij,nj,nkj->nik", turn, variance, turn)
        bias[:, part] = np.einsum("nij,nj->ni", turn, values["bias"].values[:, part])
    return xr.Dataset({
        "covariance": (("pose", "row", "column"), covariance, {"units": "m2, m rad, rad2"}),
        "bias": (("pose", "row"), bias, {"units": "m, radian"}), "use": values["use"],
    })


def cell_edges(model: xr.Dataset, name: str) -> Floats:
    """Return the edges of a model's cells along a predictor."""
    low, high = (model[f"cell_{name}_{end}"].values for end in ("low", "high"))
    return np.append(low, high[-1])


def _seen(model: xr.Dataset, at: Floats, *, any_bearing: bool) -> Masks:
    """Return whether points (n, 4), in ln(distance), ln(side) and degrees, are in the region."""
    weights, low, high = (model[name].values for name in (
        "direction_weight", "region_low", "region_high"))
    cells = model["region_seen"].values
    if any_bearing:
        free = weights[:, -1] == 0
        at, weights, low, high = at[:, :-1], weights[free, :-1], low[free], high[free]
        cells = np.asarray(cells.any(axis=-1))
    numbers = tuple(
        np.searchsorted(model[f"region_{name}"].values[1:], np.exp(value) if (
            condition.logarithmic) else value, side="right")
        for value, (name, condition) in zip(at.T, CONDITIONS.items(), strict=False))
    with np.errstate(invalid="ignore"):
        projected = at @ weights.T
    return np.asarray(((low <= projected) & (projected <= high)).all(axis=1) & cells[numbers])
