"""Error models: bias and covariance of poses as functions of the condition."""

from __future__ import annotations

import contextlib
import functools
import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from sweep.analysis import dataset
from sweep.analysis.dataset import DRAWS, Poses, axes_of, bearing_of, in_sight_frame, sight_rotation
from sweep.analysis.estimator import DEVIATIONS, INTERVAL, Columns, arranged
from sweep.errors import ArgumentError, DatasetError
from sweep.experiment.schema import cf_attributes
from sweep.measure.flags import Flag, flag
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
    """Sums over the poses of the bins that have any.

    Attributes
    ----------
    count
        Poses (bins,).
    at
        Their mean ln(distance), ln(side) and viewing angle (bins, 3).
    means
        Means of an error's powers 1 to 4, (bins, 4).
    """

    count: Floats
    at: Floats
    means: Floats

    @classmethod
    def of(cls, moments: Floats, quantity: int) -> BinSums:
        """Return the sums of an error; ``moments`` (*bins, columns) are those of `moments_of`."""
        some = moments[moments[..., 0] > 0]
        start, count = 4 + POWERS * quantity, some[:, :1]
        return cls(count[:, 0], some[:, 1:4] / count, some[:, start : start + POWERS] / count)

    def about(self, centre: Floats, power: int) -> Floats:
        """Return the mean squares, or fourth powers, of the errors minus ``centre`` (bins,)."""
        raw = [1.0, *self.means.T]
        terms = ((-1.0) ** k * math.comb(power, k) * centre**k * raw[power - k]
                 for k in range(power + 1))
        return np.asarray(np.maximum(sum(terms), FLOOR ** (power // 2)))


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
        square = sums.about(basis @ self.bias, 2)
        return float(-0.5 * (sums.count * (log_variance + square * np.exp(-log_variance))).sum())

    def at(self, basis: Floats) -> Floats:
        """Return bias, ln(variance) and their standard errors, (4, points).

        ``basis`` (points, coefficients) are the functions there.

        >>> fit = Fit(*np.array([[0.0, 2.0], [1.0, 1.0]]), np.eye(2), np.eye(2))
        >>> fit.at(np.array([[0.5, 0.5]])).round(3).tolist()
        [[1.0], [1.0], [0.707], [0.707]]
        """
        errors = (np.sqrt(np.maximum(np.diag(basis @ each @ basis.T), 0.0))
                  for each in (self.bias_covariance, self.log_variance_covariance))
        return np.stack([basis @ self.bias, basis @ self.log_variance, *errors])


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
    count, mean, none = sums.count, sums.means[:, 0], np.zeros(len(penalty))

    def squares(bias: Floats) -> Floats:
        return sums.about(basis @ bias, 2)

    bias, _ = _solved(basis, penalty, count, mean, none)
    log_variance, bread = _solved(basis, penalty, count, np.log(squares(bias)), none)
    for _ in range(ITERATIONS):
        ratio = squares(bias) * np.exp(-(basis @ log_variance))
        step = np.clip(
            _solved(basis, penalty, count, ratio - 1.0, log_variance)[0], -2.0, 2.0)
        log_variance = log_variance + step
        # In units of the knots' standard deviations, so that the penalty is as weak at all.
        scale = np.exp(0.5 * log_variance)
        bias, covariance = _solved(
            basis * scale, penalty, count * np.exp(-(basis @ log_variance)), mean, none)
        bias, covariance = scale * bias, covariance * scale[:, None] * scale
        if np.abs(step).max() < CONVERGED:
            break
    fitted = basis @ log_variance
    kurtosis = sums.about(basis @ bias, 4) * np.exp(-2.0 * fitted)
    ratio = squares(bias) * np.exp(-fitted)
    # Mean of (residual² / variance - 1)². A bin's own is too small as often as it has not seen
    # its tails: it is at least the variance of all.
    spread = np.maximum(kurtosis - 2.0 * ratio + 1.0, 0.0)
    spread = np.maximum(spread, (count * spread).sum() / count.sum())
    meat = (basis * (count * spread)[:, None]).T @ basis
    total, free = count.sum(), basis.shape[1]
    few = 1.0 + 2.0 / max(total / free - 2.0, 1.0)  # variance of Student's t of a knot's poses
    return Fit(
        bias, log_variance + np.log(total / max(total - free, 1.0)),
        np.asarray(covariance * few), np.asarray(bread @ meat @ bread * few))


def _solved(
    basis: Floats, penalty: Floats, weight: Floats, values: Floats, present: Floats
) -> tuple[Floats, Floats]:
    """Return weighted least-squares coefficients, as a step from present ones, and a covariance.

    A small penalty, on the coefficients and not on the step, makes the equations regular. The
    covariance is for weights that are inverse variances.
    """
    weighted = (basis * weight[:, None]).T
    matrix = weighted @ basis
    scale = max(float(np.trace(matrix)) / len(matrix), 1e-300)
    ridge = scale * (RIDGE * penalty + REGULAR * np.eye(len(matrix)))
    covariance = np.linalg.inv(matrix + ridge).astype(np.float64)
    return np.asarray(covariance @ (weighted @ values - ridge @ present)), covariance


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

    def tried(numbers: tuple[int, ...]) -> tuple[float, tuple[int, ...], list[Floats]]:
        """Return how well numbers of knots, by their indices in ``counts``, describe the poses."""
        knots = [choose_knots(each, some[k])
                 for each, some, k in zip(values, counts, numbers, strict=True)]
        penalty = differences(knots)
        a, b = (hat_basis(each.at, knots) for each in (first, second))
        total = fit_error(first, a, penalty).score(second, b)
        total += fit_error(second, b, penalty).score(first, a)
        return total - gain * len(penalty), numbers, knots

    best = tried((0,) * len(values))
    while True:
        steps = [best, *(tried((*best[1][:axis], number, *best[1][axis + 1 :]))
                         for axis, some in enumerate(counts)
                         for number in range(best[1][axis] + 1, min(best[1][axis] + 3, len(some))))]
        better = max(steps, key=lambda step: step[0])
        if better is best:
            return best[2]
        best = better


# --------------------------------------------------------------------------------------------------
# Conditions of error models: their bins in a dataset, and the joint region that was seen.

#: Distinct values up to which each has a bin of its own.
MAX_VALUES = 24

#: Smallest viewing angles and bearings up to here: the model begins at 0.
FRONTAL_DEG = 5.0

#: Poses that a cell should have, on average, where cells can be made wider.
POSES_A_CELL = 150

#: Shares of two conditions' ranges by which their sum and difference may leave the seen ones; to it
#: comes that of `CORNER`.
SLACK = 0.05

#: Of n draws uniform in a square none lies in a corner of area 3 / n with a probability of 5 %: by
#: the root of it sums and differences may leave the seen ones, too.
CORNER = 3.0


@dataclass(frozen=True)
class Condition:
    """A condition that errors depend on, or that was seen with others.

    Its values are scaled once, as the model is linear in them: distances and sides are logarithms.

    Attributes
    ----------
    words, units
        What tables call it, and its unit.
    logarithmic
        Whether the model is linear in its logarithm.
    tolerance
        Difference of the largest scaled value to the smallest from which on it varies.
    rounding
        Scaled values that differ by less are the same; bins reach twice as much beyond the ends.
    bins, cells
        Bins of the fit, and cells in which the fit is judged, into which values are put that are
        not a few.
    """

    words: str
    units: str
    logarithmic: bool
    tolerance: float
    rounding: float
    bins: int = 0
    cells: int = 0

    def scaled(self, values: ArrayLike) -> Floats:
        """Return values as the model is linear in them."""
        return np.asarray(np.log(values) if self.logarithmic else values, dtype=np.float64)

    def varies(self, values: Floats) -> bool:
        """Return whether the last of the sorted values is another than the first."""
        return bool(values[-1] - values[0] > self.tolerance)

    def distinct(self, values: Floats) -> Floats:
        """Return the sorted values, those that differ by rounding once."""
        values = np.unique(values[np.isfinite(values)])
        return np.asarray(values[np.diff(values, prepend=-np.inf) > self.rounding])

    def begins(self, low: Floats) -> Floats:
        """Return low ends; those of angles that begin near 0 begin at 0."""
        return low if self.logarithmic else np.where(low <= FRONTAL_DEG, 0.0, low)

    def edges(self, values: Floats, count: int, *, single: bool) -> Floats:
        """Return edges of one bin a value, or of ``count`` bins of about as many values each.

        A ``single`` bin, of what does not vary, is as wide as what counts as the same.
        """
        ends, outwards = values[[0, -1]], np.array([-1.0, 1.0])
        if single:
            ends = ends + outwards * self.tolerance
            return ends if self.logarithmic else np.maximum(ends, 0.0)
        inner = (values[1:] + values[:-1]) / 2 if len(values) <= MAX_VALUES else (
            np.unique(np.quantile(values, np.linspace(0.0, 1.0, count + 1)))[1:-1])
        low, high = ends + outwards * 2.0 * self.rounding
        return np.concatenate([[self.begins(low)], inner, [high]])


#: Models do not depend on the last, but hold where it was seen.
CONDITIONS = {
    "distance_m": Condition("the distance along the optical axis", "m", True,
                            math.log(1.02), 1e-6, 16, 12),
    "side_px": Condition("the side of the black square, were it parallel to the image", "px",
                         True, math.log(1.02), 1e-6, 8, 6),
    "viewing_angle_deg": Condition("the angle between the marker's normal and the line of sight",
                                   "degree", False, 1.0, 1e-4, 16, 12),
    "bearing_deg": Condition("the angle between the line of sight and the optical axis", "degree",
                             False, 1.0, 1e-4),
}

#: Conditions on which models depend.
PREDICTORS = ("distance_m", "side_px", "viewing_angle_deg")


# --------------------------------------------------------------------------------------------------
# Poses of a model in blocks, and their sums in bins.

#: Errors in the sight frame: of the position (m), and the rotation vector (rad).
QUANTITIES = ("x", "y", "z", "rotation_x", "rotation_y", "rotation_z")

#: The even trials and the odd ones.
HALVES = 2

#: Names of a block's arrays: the half, fx times the marker's side.
HALF, FOCAL_SIZE = "half", "focal_size"


@dataclass(frozen=True)
class Sights:
    """Some poses of a model that were looked for.

    Attributes
    ----------
    at
        `CONDITIONS`, scaled, (n, 4); the side is fx · size / distance.
    half
        Which half of the trials, (n,).
    solved, flipped
        Masks (n,).
    errors
        Errors (n, 6) in the sight frame; positions over the distance.
    """

    at: Floats
    half: Integers
    solved: Masks
    flipped: Masks
    errors: Floats

    @classmethod
    def of(cls, poses: Poses, _: tuple[slice, ...]) -> Sights:
        """Return those of a block."""
        used = poses.looked_for & (poses["true_tvec_m"][..., 2] > 0)

        def rows(values: NDArray[Any]) -> NDArray[Any]:
            return np.broadcast_to(values, (*used.shape, *values.shape[used.ndim :]))[used]

        position, rotation, focal_size, moved, turned = (
            rows(poses[name]).astype(np.float64) for name in (
                "true_tvec_m", "true_rvec", FOCAL_SIZE, "translation_error_m",
                "rotation_error_rad"))
        distance = position[:, 2]
        at = np.stack([condition.scaled(values) for condition, values in zip(
            CONDITIONS.values(), (distance, focal_size / distance, dataset.viewing_angle_of(
                rotation, position), bearing_of(position)), strict=True)], axis=-1)
        errors = np.concatenate([in_sight_frame(each, position) for each in (
            moved / distance[:, None], turned)], axis=-1)
        return cls(at, rows(poses[HALF]), rows(poses.solved), rows(poses.flipped), errors)

    @property
    def used(self) -> Masks:
        """Solved poses that are not flipped (n,)."""
        return self.solved & ~self.flipped


#: Edges of bins along the scaled `PREDICTORS`.
Edges = tuple[Floats, ...]


def binned(
    edges: Edges, poses: Sights, used: Masks, columns: Iterable[ArrayLike] = (1.0,)
) -> Floats:
    """Return sums (halves, *bins, columns) of columns (n,) over the used poses in each bin."""
    inside, at, shape = used.copy(), poses.half, (HALVES, *(len(each) - 1 for each in edges))
    for values, ends, count in zip(poses.at.T, edges, shape[1:], strict=False):
        number = np.searchsorted(ends, values, side="right") - 1
        inside &= (number >= 0) & (number < count)
        at = at * count + np.clip(number, 0, count - 1)
    found = [np.bincount(at[inside], np.broadcast_to(column, at.shape)[inside], math.prod(shape))
             for column in columns]
    return np.stack(found, axis=-1).reshape(*shape, -1).astype(np.float64)


def moments_of(bins: Edges, poses: Sights) -> Floats:
    """Return sums (halves, *bins, columns): poses, coordinates, powers 1 to 4 of each error."""
    def columns() -> Iterable[ArrayLike]:
        yield 1.0
        yield from poses.at[:, :3].T
        for error in poses.errors.T:
            yield from (error, error**2, error**2 * error, (error**2) ** 2)

    return binned(bins, poses, poses.used, columns())


def within_of(cells: Edges, knots: Sequence[Floats], fitted: Floats, poses: Sights) -> Floats:
    """Return sums (halves, *cells, 10) of how many errors lie within two sigma of the bias.

    The first four columns are poses looked for, solved, flipped and judged; then follow those
    within, for each error. Each half of the trials is judged by the model of the other: ``fitted``
    (halves, knots, quantities, 2) are bias and ln(variance).
    """
    basis = hat_basis(poses.at[:, :3], knots)
    of_halves = np.tensordot(basis, fitted, axes=(1, 1))[np.arange(len(basis)), 1 - poses.half]
    within = np.abs(poses.errors - of_halves[..., 0]) <= 2.0 * np.exp(0.5 * of_halves[..., 1])
    counts = [binned(cells, poses, mask) for mask in (
        np.ones_like(poses.solved), poses.solved, poses.flipped, poses.used)]
    return np.concatenate([*counts, binned(cells, poses, poses.used, within.T)], axis=-1)


# --------------------------------------------------------------------------------------------------
# Bins of a dataset, and the joint region of the conditions that was seen.

def bins_and_cells(
    found: Mapping[str, Floats], poses: int, *, collinear: bool
) -> tuple[Edges, Edges]:
    """Return the bins that models are fitted to, and the wider cells in which they are judged.

    Few distinct values, of an axis, have a bin and a cell each; others, which were drawn, have some
    of about as many poses each.

    Parameters
    ----------
    found
        The distinct values of each condition, scaled.
    poses
        Scenes of the dataset.
    collinear
        Whether the side follows from the distance: then it has one bin, as what does not vary.
    """
    varying = [name for name in PREDICTORS if CONDITIONS[name].varies(found[name])]
    if collinear and "distance_m" in varying:
        varying = [name for name in varying if name != "side_px"]
    few = [len(found[name]) for name in varying if len(found[name]) <= MAX_VALUES]
    many = max(2, int((poses / (POSES_A_CELL * math.prod(few))) ** (
        1.0 / max(len(varying) - len(few), 1))))

    def bins(count: Callable[[Condition], int]) -> Edges:
        return tuple(CONDITIONS[name].edges(
            found[name], count(CONDITIONS[name]), single=name not in varying)
            for name in PREDICTORS)

    return bins(lambda each: each.bins), bins(lambda each: min(many, each.cells))


def region_directions(found: Mapping[str, Floats]) -> Floats:
    """Return directions (n, 4) along which the seen region has two ends, the four axes first.

    In ln(distance), ln(side), viewing angle and bearing. The fifth is ln(fx size); then follow, of
    two conditions that vary, sum and difference in units of their ranges.
    """
    unit = np.eye(len(found))
    rows = [*unit, unit[:2].sum(axis=0)]
    ranges = {k: np.ptp(values) for k, (name, values) in enumerate(found.items())
              if CONDITIONS[name].varies(values)}
    for a, b in itertools.combinations(ranges, 2):
        rows += [unit[a] / ranges[a] + sign * unit[b] / ranges[b] for sign in (1.0, -1.0)]
    return np.stack(rows)


def knot_values(bins: Edges, moments: Floats) -> list[Floats]:
    """Return the values that may be knots: of each axis the means of its bins, and both ends.

    Where a bin is a single value that is the value itself. ``moments`` (*bins, 4) are numbers of
    poses and the sums of their coordinates.
    """
    knots = []
    for axis, edges in enumerate(bins):
        others = tuple(k for k in range(len(bins)) if k != axis)
        count, total = np.moveaxis(moments[..., [0, 1 + axis]].sum(axis=others), -1, 0)
        middle = total[count > 0] / count[count > 0]
        if len(middle) > 1:
            middle = np.unique([edges[0], *middle[1:-1], edges[-1]])
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


AT_KNOTS = ("quantity", *PREDICTORS)
CELLS = tuple(f"cell_{name}" for name in PREDICTORS)
OF_CELLS = ("quantity", *CELLS)

#: Variables of the models: dimensions beside those that keep models apart, meaning, units.
VARIABLES: dict[str, tuple[tuple[str, ...], str, str]] = {
    "sigma": (AT_KNOTS, "standard deviation of the error", "m, radian"),
    "bias": (AT_KNOTS, "mean error, estimated minus true", "m, radian"),
    "coverage": (OF_CELLS, "share of held-out errors within two sigma of the bias", "1"),
    "use": (OF_CELLS, "whether the model may be used", ""),
    "judged": (CELLS, "held-out poses that were judged", "1"),
    "looked_for": (CELLS, "poses looked for", "1"),
    "solved_rate": (CELLS, "solved of the poses looked for", "1"),
    "flip_rate": (CELLS, "nearer to the mirror of the truth, of the solved", "1"),
    "region_low": (("direction",), "smallest weighted sum of a direction in the region", ""),
    "region_high": (("direction",), "largest weighted sum of a direction in the region", ""),
    "knots": (("quantity", "predictor"), "knots that the error needs", "1"),
}

#: Values of variables of a model, by name.
Values = dict[str, NDArray[Any]]


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
        (`sweep.analysis.dataset`; z is the error of the range); knots ``distance_m`` (along
        the optical axis), ``side_px`` and ``viewing_angle_deg``; and cells of these three.

        - ``sigma``, ``bias`` at the knots, with ``_low`` and ``_high``. Between knots ln(sigma) and
          the bias (of positions: over the distance) are linear in ln(distance), ln(side) and the
          angle. With two knots of the distance sigma is a power of it. A predictor that does not
          vary, or follows from the distance (``side_px``: one size and camera), has one knot.
        - ``coverage`` (quantity, cells): share of errors within two sigma of the bias, by a model
          of the other half of the trials (even, odd); ``judged`` poses.
        - ``use`` (quantity, cells): whether the model may be used there (`Use`): the coverage lies
          within 0.93 to 0.97, with a tolerance of a standard error, and that of each half of the
          trials with one of two.
        - ``region_low``, ``region_high`` (direction): the joint region of distance, side, viewing
          angle and bearing in which poses were looked for; outside it, and in cells without poses,
          the model has no answer. In it are conditions whose weighted sums
          (``direction_weight``) lie between both ends.
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
    kept = [name for name in axes_of(results)
            if name != DRAWS and (name == "dictionary" or not dataset.is_grid_axis(name, results))]
    dataset.kept_dimensions(results, kept)
    inputs = dataset.pose_arrays(results, dataset.SIGNED_INPUTS)
    dataset.require_draws(results, kept)
    focal_size = dataset.focal_size_of(results)
    halves = (results[DRAWS] % HALVES).astype(np.int64).reset_coords(drop=True).drop_vars(DRAWS)
    columns = arranged(results, {**inputs, HALF: halves, FOCAL_SIZE: focal_size}, kept)[0]
    models = [
        Columns({name: each[k : k + 1] for name, each in columns.items()}, Poses).map(Sights.of)
        for k in range(math.prod(results.sizes[name] for name in kept))]
    found = {name: condition.distinct(np.concatenate(
        [block.at[:, k] for model in models for block in model]))
        for k, (name, condition) in enumerate(CONDITIONS.items())}
    if not all(map(len, found.values())):
        raise DatasetError("no pose was looked for: there are no errors to model")
    poses = results["true_tvec_m"].isel(xyz=0).size
    least, most = float(focal_size.min()), float(focal_size.max())
    bins, cells = bins_and_cells(found, poses, collinear=not CONDITIONS["side_px"].varies(
        np.log([least, most])))
    directions = region_directions(found)
    moments = np.stack([sum(moments_of(bins, block) for block in model) for model in models])
    _check_solved(moments, results, kept)
    possible = knot_values(bins, moments[..., :4].sum(axis=(0, 1)))
    selected = [[select_knots(BinSums.of(model[0], k), BinSums.of(model[1], k), possible)
                 for k in range(len(QUANTITIES))] for model in moments]
    shown = [choose_knots(possible[0], SHOWN_DISTANCES), *(each[:1] for each in possible[1:])]
    # All errors are given at the knots of all: what is linear between some is so between all.
    knots = [np.unique(np.concatenate(each)) for each in zip(
        shown, *(own for model in selected for own in model), strict=True)]
    tables = []
    for model, sums, own in zip(models, moments, selected, strict=True):
        # The model of each half, by which the other is judged: (halves, knots, quantities, 2).
        fitted = np.stack([_at_knots(half, own, knots)[:2].transpose(2, 1, 0) for half in sums])
        judged = sum(within_of(cells, knots, fitted, block) for block in model)
        tables.append({
            **_of_knots(_at_knots(sums.sum(axis=0), own, knots), knots),
            **_of_cells(np.asarray(judged)),
            **_of_region(model, directions, results.sizes[DRAWS]),
            "knots": np.array([[*map(len, each)] for each in own])})
    variables: dict[str, Any] = {"direction_weight": (
        ("direction", "condition"), directions,
        cf_attributes("weights of ln(distance), ln(side), viewing angle and bearing", ""))}
    for name, array in dataset.of_cells(tables, [results.sizes[each] for each in kept]).items():
        ending = next((each for each in INTERVAL if each and name.endswith(each)), "")
        ending = ending if name not in VARIABLES else ""
        dims, meaning, units = VARIABLES[name.removesuffix(ending)]
        variables[name] = (*kept, *dims), array, cf_attributes(
            INTERVAL[ending] + meaning, units, flags=Use if name == "use" else None)
    coordinates: dict[str, Any] = {
        name: results[name].variable for name in kept if name in results.coords}
    coordinates |= {"quantity": list(QUANTITIES), "predictor": list(PREDICTORS),
                    "condition": list(CONDITIONS)}
    for name, at, edges in zip(PREDICTORS, knots, cells, strict=True):
        condition, cell = CONDITIONS[name], f"cell_{name}"
        for coordinate, dim, values, words in (
                (name, name, at, "knots"), (f"{cell}_low", cell, edges[:-1], "low end of cells"),
                (f"{cell}_high", cell, edges[1:], "high end of cells")):
            coordinates[coordinate] = dim, np.exp(values) if condition.logarithmic else values, {
                "units": condition.units, "long_name": f"{words} of {condition.words}"}
    return xr.Dataset(variables, coordinates, attrs={
        "focal_size_px_m": float(focal_size.mean()),
        "focal_size_varies": int(most > least * (1 + 1e-9)),
    })


def _at_knots(
    moments: Floats, own: Sequence[Sequence[Floats]], knots: Sequence[Floats]
) -> Floats:
    """Return the fits of the errors with their own knots, at the knots of all.

    Bias, ln(variance) and their standard errors, (4, quantities, knots); the last axis' knots vary
    fastest.
    """
    points = np.stack([each.ravel() for each in np.meshgrid(*knots, indexing="ij")], axis=-1)
    fits = []
    for quantity, of_error in enumerate(own):
        sums = BinSums.of(moments, quantity)
        fit = fit_error(sums, hat_basis(sums.at, of_error), differences(of_error))
        fits.append(fit.at(hat_basis(points, of_error)))
    return np.stack(fits, axis=1)


def _check_solved(moments: Floats, results: xr.Dataset, kept: Sequence[str]) -> None:
    """Raise DatasetError if a configuration has too few solved poses."""
    solved = moments[..., 0].sum(axis=(2, 3, 4)).min(axis=1).astype(int) * HALVES
    for count, (at, _) in zip(
            solved.tolist(), dataset.each_cell(results[[*kept]], kept), strict=True):
        if count < MIN_POSES:
            which = ", ".join(f"{name} = {value}" for name, value in at.items())
            raise DatasetError(
                f"{which + ': ' if which else ''}{count:,} solved poses that are not flipped; an "
                f"error model needs {MIN_POSES} or more: more trials, or larger sides")


def _metres(distance_m: Floats) -> Floats:
    """Return the factors of errors (quantities, distances): of positions the distances."""
    return np.where(np.arange(len(QUANTITIES))[:, None] < 3, distance_m, 1.0)


def _of_region(model: Sequence[Sights], directions: Floats, trials: int) -> Values:
    """Return the joint region of the conditions that was seen.

    An end along a direction has a margin for rounding; where there is hardly an extent, as wide as
    what counts as the same; of sums and differences `SLACK` and what so many trials may leave empty
    in a corner (`CORNER`). Angles that begin near 0 begin at 0.
    """
    projected = np.concatenate([block.at for block in model]) @ directions.T
    low, high = projected.min(axis=0), projected.max(axis=0)
    listed = [*CONDITIONS.values()]
    axes, alone = slice(0, len(listed)), slice(0, len(listed) + 1)
    # Knots at the ends lie two roundings outside the poses; ln(fx size) is of two ends.
    same = np.array([each.tolerance for each in (*listed, listed[0])])
    rounding = np.array([*(3.0 * each.rounding for each in listed), 6.0 * listed[0].rounding])
    margin = np.full(len(low), SLACK + math.sqrt(CORNER / trials))
    margin[alone] = np.where(high[alone] - low[alone] <= same, same, rounding)
    ends = np.array([condition.begins(end) for condition, end in zip(
        listed, (low - margin)[axes], strict=True)])
    # Where an angle begins at 0, its sums and differences reach as much farther.
    margin[alone.stop :] += np.abs(directions[alone.stop :]) @ (low[axes] - ends)
    low, high = low - margin, high + margin
    low[axes] = ends
    return {"region_low": low, "region_high": high}


def _of_knots(fit: Floats, knots: Sequence[Floats]) -> Values:
    """Return sigma and bias at the knots; ``fit`` is (4, quantities, knots)."""
    metres = _metres(np.exp(knots[0]))[:, :, None, None]
    bias, log_variance, bias_error, error = fit.reshape(*fit.shape[:2], *map(len, knots))
    values = {}
    for ending, side in zip(INTERVAL, (0.0, -1.0, 1.0), strict=True):
        values[f"sigma{ending}"] = metres * np.exp(
            0.5 * (log_variance + side * DEVIATIONS * error))
        values[f"bias{ending}"] = metres * (bias + side * DEVIATIONS * bias_error)
    return values


def _of_cells(judged: Floats) -> Values:
    """Return whether a model may be used in cells; ``judged`` (halves, *cells, columns)."""
    looked_for, solved, flipped, n = np.moveaxis(
        np.rint(judged[..., :4].sum(axis=0)).astype(np.int64), -1, 0)
    within, of_halves = judged[..., 4:], judged[..., [3]]
    with np.errstate(invalid="ignore", divide="ignore"):
        coverage, of_half = within.sum(axis=0) / n[..., None], within / of_halves
        flip_rate, solved_rate = flipped / solved, solved / looked_for
        spread, spread_of_half = (
            np.sqrt(NOMINAL * (1.0 - NOMINAL) / count) for count in (n[..., None], of_halves))
    # Limits are wider by a standard error, of each half by two.
    low, high = (
        (sign * (coverage - limit) > spread) | (
            sign * (of_half - limit) > 2.0 * spread_of_half).any(axis=0)
        for sign, limit in zip((-1.0, 1.0), COVERAGE, strict=True))
    use = np.select(
        [*(each[..., None] for each in (
            looked_for == 0, solved_rate < MIN_DETECTION, flip_rate > MAX_FLIPS, n < MIN_JUDGED)),
         low, high],
        [Use.no_poses, Use.rarely_solved, Use.flips, Use.few_draws, Use.too_narrow, Use.too_wide],
        Use.holds).astype(np.uint8)
    return {"coverage": np.moveaxis(coverage, -1, 0), "use": np.moveaxis(use, -1, 0), "judged": n,
            "looked_for": looked_for, "solved_rate": solved_rate, "flip_rate": flip_rate}


# --------------------------------------------------------------------------------------------------
# Numbers of poses, as a user gives them.

def rows_of(**given: tuple[ArrayLike, int]) -> list[Floats]:
    """Return numbers of n poses as arrays (n,), or (n, width), by the names of arguments.

    Each is given with its width, in any shape that has it as the last dimension, or before a last
    one of 1, as OpenCV's vectors do. Numbers of one pose are repeated where others are of n.

    Raises
    ------
    ArgumentError
        One line on the first that is no such array, or of another number of poses.

    Examples
    --------
    >>> [rows.shape for rows in rows_of(rvec=([0, 0, 1], 3), ambiguity=([0.5, 0.25], 1))]
    [(2, 3), (2,)]
    """
    found = {}
    for name, (values, width) in given.items():
        shape, fits = (-1, width) if width > 1 else (-1,), False
        with contextlib.suppress(TypeError, ValueError, OverflowError):
            array = np.asarray(values, dtype=np.float64)
            ends = {array.shape[-1:], array.shape[-2:]}
            fits = width == 1 or not ends.isdisjoint({(width,), (width, 1), (0,)})
        if not fits:
            raise ArgumentError(name, values, f"expected numbers {shape}".replace("-1", "n"))
        found[name] = array.reshape(shape)
    count = next((len(rows) for rows in found.values() if len(rows) != 1), 1)
    for name, rows in found.items():
        if len(rows) not in (1, count):
            raise ArgumentError(name, "", f"{len(rows):,} poses: expected {count:,}, or one")
    return [np.broadcast_to(rows, (count, *rows.shape[1:])) for rows in found.values()]


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
        If there are several models, no side where it does not follow, or what is no number (n,).

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
    if model["sigma"].dims != AT_KNOTS:
        others = [str(dim) for dim in model["sigma"].dims if dim not in AT_KNOTS]
        raise ArgumentError("model", f"models for each {', '.join(others)}",
                            "expected one model; choose one with models.isel(...)")
    if side_px is None:
        if model.attrs["focal_size_varies"]:
            raise ArgumentError("side_px", None, "expected the side: it varies in the store")
        with np.errstate(divide="ignore"):
            side_px = model.attrs["focal_size_px_m"] / rows_of(distance_m=(distance_m, 1))[0]
    values = rows_of(
        distance_m=(distance_m, 1), side_px=(side_px, 1), viewing_angle_deg=(viewing_angle_deg, 1),
        bearing_deg=(np.nan if bearing_deg is None else bearing_deg, 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        at = np.stack([condition.scaled(each) for condition, each in zip(
            CONDITIONS.values(), values, strict=True)], axis=-1)
    cell = tuple(np.searchsorted(cell_edges(model, name)[1:-1], each, side="right")
                 for name, each in zip(PREDICTORS, values, strict=False))
    use = np.moveaxis(model["use"].values, 0, -1)[cell]
    inside = _seen(model, at, any_bearing=bearing_deg is None) & (use != Use.no_poses).all(axis=1)
    basis = hat_basis(at[:, : len(PREDICTORS)], [
        CONDITIONS[name].scaled(model[name].values) for name in PREDICTORS])

    def interpolated(values: NDArray[Any]) -> Floats:
        return np.asarray(basis @ values.reshape(len(QUANTITIES), -1).T)

    bias = model["bias"].values / _metres(model["distance_m"].values)[:, :, None, None]
    units = {"units": "m, radian"}
    found = xr.Dataset({
        "sigma": (("pose", "quantity"), np.exp(interpolated(np.log(model["sigma"].values))), units),
        "bias": (("pose", "quantity"), interpolated(bias) * _metres(values[0]).T, units),
        **{name: ("pose", model[name].values[cell], model[name].attrs)
           for name in ("flip_rate", "solved_rate")},
    }, {"quantity": list(QUANTITIES)}).where(xr.DataArray(inside, dims="pose"))
    return found.assign(use=(("pose", "quantity"), np.where(
        inside[:, None], use, Use.no_poses), model["use"].attrs))


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
    (position,) = rows_of(position_m=(position_m, 3))
    values = model_errors(
        model, position[:, 2], viewing_angle_deg, side_px, bearing_of(position))
    turn = np.kron(np.eye(2), sight_rotation(position))  # of position and rotation each
    sigma, bias = (values[name].values for name in ("sigma", "bias"))
    return xr.Dataset({
        "covariance": (
            ("pose", "row", "column"), np.einsum("nij,nj,nkj->nik", turn, sigma**2, turn),
            {"units": "m2, m rad, rad2"}),
        "bias": (("pose", "row"), np.einsum("nij,nj->ni", turn, bias), {"units": "m, radian"}),
        "use": values["use"],
    })


def cell_edges(model: xr.Dataset, name: str) -> Floats:
    """Return the edges of a model's cells along a predictor."""
    low, high = (model[f"cell_{name}_{end}"].values for end in ("low", "high"))
    return np.append(low, high[-1])


def _seen(model: xr.Dataset, at: Floats, *, any_bearing: bool) -> Masks:
    """Return whether points (n, 4), in ln(distance), ln(side) and degrees, are in the region."""
    weights, low, high = (model[name].values for name in (
        "direction_weight", "region_low", "region_high"))
    if any_bearing:
        free = weights[:, -1] == 0
        at, weights, low, high = at[:, :-1], weights[free, :-1], low[free], high[free]
    with np.errstate(invalid="ignore"):
        projected = at @ weights.T
    return np.asarray(((low <= projected) & (projected <= high)).all(axis=1))
