"""Fits of an error's bias and standard deviation over knots of distance, side and viewing angle.

Between knots the bias and the logarithm of the standard deviation are linear in ln(distance),
ln(side) and the viewing angle. With two knots of the distance the standard deviation is a power of
it: more knots are for what is no power law.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sweep.typing import Floats

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

    def filled(self) -> BinSums:
        """Return the sums of the bins that have poses."""
        some = self.count > 0
        return BinSums(self.count[some], self.at[some], self.powers[some])

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
        lambda a, b: (a[:, :, None] * b[:, None, :]).reshape(len(at), -1), parts)


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
