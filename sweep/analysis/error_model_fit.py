"""The fit of error models: sums over draws, bins, and weighted least squares."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.analysis.dataset import DRAWS, parameter_value
from sweep.analysis.poses import (
    bearing_of,
    viewing_angle_of,
)
from sweep.errors import DatasetError
from sweep.measure.flags import DetectionStatus, uncounted_values
from sweep.model.camera import VIEW_PARAMETERS, intrinsics
from sweep.typing import Floats, Integers

# --------------------------------------------------------------------------------------------------
# Fits of an error's bias and standard deviation over knots of distance, side and viewing angle.
#
# Between knots the bias and the logarithm of the standard deviation are linear in ln(distance),
# ln(side) and the viewing angle. With two knots of the distance the standard deviation is a power
# of it: more knots are for what is no power law.

FLOOR = 1e-18
"""Smallest mean square of an error: its unit is a radian or a share of the distance."""

RIDGE = 1e-3
"""Weight, relative to the mean knot's data, with which a knot follows its neighbours: those without
data do so entirely, others by 0.1 % of the difference."""

REGULAR = 1e-9
"""Weight, relative to the same, that makes every system of equations regular."""

ITERATIONS = 50
CONVERGED = 1e-9
"""Largest step of ln(variance) at which the iteration ends."""

GAIN = 2.0
"""Log-likelihood that a knot must add: a bias that is off by 0.2 standard deviations in 100 poses,
or a standard deviation that is off by 10 %."""

KNOTS = (2, 3, 4, 6, 8)
"""Numbers of knots of an axis that are tried."""

POWERS = 4
"""Sums of the powers 1 to 4 of the errors are kept."""


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
    shape = [len(each) for each in knots]
    numbers = np.arange(np.prod(shape)).reshape(shape)
    total = np.zeros((numbers.size, numbers.size))
    for axis in range(len(shape)):
        a, b = (np.take(numbers, range(first, shape[axis] - 1 + first), axis).ravel()
                for first in (0, 1))
        np.add.at(total, (a, a), 1.0)
        np.add.at(total, (b, b), 1.0)
        np.add.at(total, (a, b), -1.0)
        np.add.at(total, (b, a), -1.0)
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
    # its tails: it is at least that of all.
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


def candidate_counts(most: int) -> list[int]:
    """Return numbers of knots to try, up to one a value.

    >>> candidate_counts(1), candidate_counts(7), candidate_counts(20)
    ([1], [2, 3, 4, 6, 7], [2, 3, 4, 6, 8])
    """
    return [count for count in KNOTS if count < most] + ([most] if most <= KNOTS[-1] else [])


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
    counts = [candidate_counts(len(each)) for each in values]

    def knots_at(numbers: Sequence[int]) -> list[Floats]:
        return [choose_knots(each, some[k])
                for each, some, k in zip(values, counts, numbers, strict=True)]

    def score(numbers: Sequence[int]) -> float:
        knots = knots_at(numbers)
        penalty = differences(knots)
        a, b = (hat_basis(each.at, knots) for each in (first, second))
        total = fit_error(first, a, penalty).score(second, b)
        total += fit_error(second, b, penalty).score(first, a)
        return total - gain * len(penalty)

    chosen = [0] * len(values)
    best = score(chosen)
    while True:
        tried = [
            [*chosen[:axis], number, *chosen[axis + 1:]]
            for axis, some in enumerate(counts)
            for number in range(chosen[axis] + 1, min(chosen[axis] + 3, len(some)))
        ]
        scores = [score(numbers) for numbers in tried]
        if not scores or max(scores) <= best:
            return knots_at(chosen)
        best = max(scores)
        chosen = tried[scores.index(best)]


def union(knots: Sequence[Sequence[Floats]]) -> list[Floats]:
    """Return, of each axis, the knots of all; what is linear between some is so between all.

    >>> [each.tolist() for each in union([[np.array([0, 2])], [np.array([0, 1, 2])]])]
    [[0, 1, 2]]
    """
    return [np.unique(np.concatenate(each)) for each in zip(*knots, strict=True)]


def grid_points(knots: Sequence[Floats]) -> Floats:
    """Return the points (n, axes) of a grid, the last axis fastest."""
    return np.stack([each.ravel() for each in np.meshgrid(*knots, indexing="ij")], axis=-1)


# --------------------------------------------------------------------------------------------------
# Conditions of error models: their bins in a dataset, and the joint region that was seen.

PREDICTORS = {"distance_m": True, "side_px": True, "viewing_angle_deg": False}
"""Name of a predictor -> whether its logarithm is what the model is linear in."""

CONDITIONS = PREDICTORS | {"bearing_deg": False}
"""The predictors, and the bearing: models do not depend on it, but hold where it was seen."""

MAX_BINS = {"distance_m": 16, "side_px": 8, "viewing_angle_deg": 16}
"""Bins of the fit into which values are put that are not a few."""

MAX_CELLS = {"distance_m": 12, "side_px": 6, "viewing_angle_deg": 12}
"""The same of the cells in which the fit is judged."""

MAX_VALUES = 24
"""Distinct values up to which each has a bin of its own."""

SAME = 1e-6
"""Values that differ by less, relatively (angles: in degrees / 100), are the same."""

VARIES = {"distance_m": 1.02, "side_px": 1.02, "viewing_angle_deg": 1.0, "bearing_deg": 1.0}
"""Ratio of the largest value to the smallest (angles: difference in degrees) from which on a
predictor varies."""

FRONTAL_DEG = 5.0
"""Smallest viewing angles and bearings up to here: the model begins at 0."""

POSES_A_CELL = 150
"""Poses that a cell should have, on average, where cells can be made wider."""

MAX_REGION_CELLS = 12
"""Cells along a drawn condition in which the seen region is told."""

POSES_A_REGION_CELL = 15
"""Poses that such a cell should have, on average, so that none is empty by chance."""

SLACK = 0.05
"""Shares of two conditions' ranges by which their sum and difference may leave the seen ones; to it
comes that of `CORNER`."""

CORNER = 3.0
"""Of n draws uniform in a square none lies in a corner of area 3 / n with a probability of 5 %:
by the root of it sums and differences may leave the seen ones, too."""


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

    def numbers(self, *values: Floats) -> tuple[Integers, NDArray[np.bool_]]:
        """Return the flat numbers of the bins of points, and which points are in a bin."""
        inside = np.ones(values[0].shape, dtype=bool)
        flat = np.zeros(values[0].shape, dtype=np.int64)
        for each, edges in zip(values, self.edges, strict=True):
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
    results: xr.Dataset, focal_size: xr.DataArray, found: Mapping[str, Floats]
) -> tuple[Bins, Bins]:
    """Return the bins that models are fitted to, and the wider cells in which they are judged.

    Few distinct values, of an axis, have a bin and a cell each; others, which were drawn, have some
    of about as many poses each. ``found``: the `distinct_values`.
    """
    found = {name: found[name] for name in PREDICTORS}
    collinear = float(focal_size.max()) <= float(focal_size.min()) * VARIES["side_px"]
    # The side that follows from the distance has one bin, as what does not vary.
    single = {name for name, values in found.items() if not _varies(name, values)}
    if collinear and "distance_m" not in single:
        single.add("side_px")
    drawn = [name for name, values in found.items()
             if name not in single and len(values) > MAX_VALUES]
    poses = _pose_count(results)
    others = math.prod(len(values) for name, values in found.items()
                       if name not in single and name not in drawn)
    many = max(2, int((poses / (POSES_A_CELL * others)) ** (1.0 / max(len(drawn), 1))))
    bins, cells = (
        Bins(tuple(
            _domain(name, values) if name in single
            else _with_margin(name, _edges(name, values, min(most, limits[name])))
            for name, values in found.items()
        )) for most, limits in ((max(MAX_BINS.values()), MAX_BINS), (many, MAX_CELLS)))
    return bins, cells


def region_cells(
    results: xr.Dataset, found: Mapping[str, Floats]
) -> tuple[Bins, tuple[int, ...]]:
    """Return the cells of conditions that poses are in or not, and which conditions were drawn.

    Few distinct values, of an axis, have a cell each, also those that jitter spreads a little;
    others have some cells of about as many values each.
    """
    middles = {name: _between(name, values) for name, values in found.items()}
    drawn = [name for name, middle in middles.items() if middle is None]
    others = math.prod(len(middle) + 1 for middle in middles.values() if middle is not None)
    # Values that go together along an axis make fewer combinations.
    others = min(others, _pose_count(results) // results.sizes.get(DRAWS, 1))
    many = _pose_count(results) / (POSES_A_REGION_CELL * others)
    count = min(max(1, int(many ** (1.0 / max(len(drawn), 1)))), MAX_REGION_CELLS)
    edges = []
    for name, values in found.items():
        middle = middles[name]
        if middle is None:
            middle = np.unique(np.quantile(values, np.linspace(0.0, 1.0, count + 1))[1:-1])
        edges.append(np.concatenate([[-np.inf], middle, [np.inf]]))
    return Bins(tuple(edges)), tuple(k for k, name in enumerate(found) if name in drawn)


def _pose_count(results: xr.Dataset) -> int:
    return math.prod(results.sizes[name] for name in results["true_tvec_m"].dims if name != "xyz")


def _between(name: str, values: Floats) -> Floats | None:
    """Return the middles between the few values of a condition, None if it has many.

    Values that jitter spreads by no more than what counts as the same are one.

    >>> _between("bearing_deg", np.array([*np.linspace(0.0, 0.1, 99), 20.0])).tolist()
    [10.05]
    """
    logarithmic, same = CONDITIONS[name], VARIES[name]
    if len(values) <= MAX_VALUES:
        last, first = values[:-1], values[1:]
    else:
        jumps = np.diff(np.log(values)) > math.log(same) if logarithmic else np.diff(values) > same
        groups = np.split(values, np.flatnonzero(jumps) + 1)
        if len(groups) > MAX_VALUES or any(_varies(name, group) for group in groups):
            return None
        last, first = (np.array([group[k] for group in some])
                       for some, k in ((groups[:-1], -1), (groups[1:], 0)))
    return np.asarray(np.sqrt(last * first) if logarithmic else (last + first) / 2)


def region_directions(found: Mapping[str, Floats]) -> Floats:
    """Return directions (n, 4) along which the seen region has two ends, the four axes first.

    In ln(distance), ln(side), viewing angle and bearing. The fifth is ln(fx size); then follow, of
    two conditions that vary, sum and difference in units of their ranges.
    """
    ranges = [np.ptp(np.log(values) if CONDITIONS[name] else values)
              for name, values in found.items()]
    unit = np.eye(len(ranges))
    rows = [*unit, unit[0] + unit[1]]
    varying = [k for k, (name, values) in enumerate(found.items()) if _varies(name, values)]
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
    same = np.array([math.log(VARIES[name]) if logarithmic else VARIES[name]
                     for name, logarithmic in CONDITIONS.items()])
    # Knots at the ends lie 2e-6 outside the poses.
    rounding = np.where(list(CONDITIONS.values()), 3.0 * SAME, 200.0 * SAME)
    alone = [*range(len(same)), 0]  # ln(fx size) has the tolerance of ln(distance)
    count = len(alone)
    margin = np.repeat(SLACK + np.sqrt(CORNER / draws)[:, None], low.shape[1], axis=1)
    margin[:, :count] = np.where(
        high[:, :count] - low[:, :count] <= same[alone], same[alone], rounding[alone])
    margin[:, count - 1] = np.maximum(margin[:, count - 1], 2.0 * rounding[0])  # of two ends
    wider = low - margin
    frontal = ~np.array(list(CONDITIONS.values())) & (wider[:, : len(same)] <= FRONTAL_DEG)
    ends = np.where(frontal, 0.0, wider[:, : len(same)])
    # Where an angle begins at 0, its sums and differences reach as much farther.
    margin[:, count:] += (low[:, : len(same)] - ends) @ np.abs(directions[count:]).T
    low, high = low - margin, high + margin
    low[:, : len(same)] = ends
    return low, high


def _domain(name: str, values: Floats) -> Floats:
    """Return the ends of the domain of what does not vary: as wide as what counts as the same."""
    low, high = values[0], values[-1]
    if PREDICTORS[name]:
        return np.array([low / VARIES[name], high * VARIES[name]])
    return np.array([max(low - VARIES[name], 0.0), high + VARIES[name]])


def _with_margin(name: str, edges: Floats) -> Floats:
    """Return edges whose ends are so far out that rounding puts no pose outside.

    Viewing angles that begin near 0 begin at 0.
    """
    ends = edges[[0, -1]]
    margin = 2.0 * SAME * ends if PREDICTORS[name] else 100.0 * SAME
    low, high = ends + np.array([-1.0, 1.0]) * margin
    if name == "viewing_angle_deg" and low <= FRONTAL_DEG:
        low = 0.0
    return np.concatenate([[low], edges[1:-1], [high]])


def distinct_values(results: xr.Dataset, focal_size: xr.DataArray) -> dict[str, Floats]:
    """Return the distinct values (n,) of each condition among the poses looked for.

    Raises
    ------
    DatasetError
        If no pose was looked for.
    """
    position = results["true_tvec_m"].reset_coords(drop=True).compute()
    distance = position.isel(xyz=2, drop=True)
    angle = xr.apply_ufunc(
        viewing_angle_of, results["true_rvec"].reset_coords(drop=True).compute(), position,
        input_core_dims=[["xyz"], ["xyz"]])
    bearing = xr.apply_ufunc(bearing_of, position, input_core_dims=[["xyz"]])
    seen = results["detection"].reset_coords(drop=True)
    counted = ~seen.isin(uncounted_values(DetectionStatus)) & (distance > 0)
    counted = counted.any([dim for dim in counted.dims if dim not in position.dims])
    with np.errstate(divide="ignore", invalid="ignore"):
        side = focal_size / distance
    found = {
        "distance_m": _distinct(distance.where(counted)),
        "side_px": _distinct(side.where(counted)),
        "viewing_angle_deg": _distinct(angle.where(counted), absolute=True),
        "bearing_deg": _distinct(bearing.where(counted), absolute=True),
    }
    if not all(len(values) for values in found.values()):
        raise DatasetError("no pose was looked for: there are no errors to model")
    return found


def _distinct(values: xr.DataArray, *, absolute: bool = False) -> Floats:
    """Return the sorted values, those that are the same once."""
    flat = np.unique(values.to_numpy())
    flat = flat[np.isfinite(flat)]
    if not len(flat):
        return np.asarray(flat)
    step = np.diff(flat)
    return np.asarray(
        flat[np.concatenate([[True], step > (100 * SAME if absolute else SAME * flat[1:])])])


def _varies(name: str, values: Floats) -> bool:
    """Return whether the last of the sorted values is another than the first."""
    low, high, least = values[0], values[-1], VARIES[name]
    return bool(high > low * least if CONDITIONS[name] else high - low > least)


def _edges(name: str, values: Floats, count: int) -> Floats:
    """Return edges of one bin a value, or of bins of about as many distinct values each."""
    if len(values) <= MAX_VALUES:
        middle = np.sqrt(values[:-1] * values[1:]) if PREDICTORS[name] else (
            (values[:-1] + values[1:]) / 2)
        return np.concatenate([values[:1], middle, values[-1:]])
    return np.unique(np.quantile(values, np.linspace(0.0, 1.0, count + 1)))


def knot_values(bins: Bins, moments: Floats) -> list[Floats]:
    """Return the values that may be knots: of each axis the means of its bins, and both ends.

    Where a bin is a single value that is the value itself. ``moments`` (bins, 4) are the numbers of
    poses and the sums of their coordinates.
    """
    knots = []
    columns = moments.reshape(*bins.shape, 4)
    for axis, (logarithmic, edges) in enumerate(
            zip(PREDICTORS.values(), bins.edges, strict=True)):
        others = tuple(k for k in range(len(bins.shape)) if k != axis)
        count, total = np.moveaxis(columns[..., [0, 1 + axis]].sum(axis=others), -1, 0)
        middle = total[count > 0] / count[count > 0]
        ends = np.log(edges[[0, -1]]) if logarithmic else edges[[0, -1]]
        if len(middle) > 1:
            middle = np.unique(np.concatenate([ends[:1], middle[1:-1], ends[1:]]))
        knots.append(middle)
    return knots
