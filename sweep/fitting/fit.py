"""A camera's scene from photographs of known markers: every term with its interval."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import interpolate, special

from sweep.analysis.intervals import LEVEL
from sweep.errors import ArgumentError
from sweep.fitting.estimates import MIN_PHOTOGRAPHS, Estimate, estimate, jackknife
from sweep.fitting.photograph_fit import (
    AMOUNT,
    BLOOM,
    CORNERS,
    HIGH,
    LOW,
    RADIUS,
    START,
    VARIANCE,
    MarkerState,
    PhotographFit,
    PhotographNoise,
    fit_photograph,
    kernel,
    photograph_noise,
    products,
    smoothed,
)
from sweep.fitting.views import FittedPhotograph, PhotographScenes, is_saturated, photograph_views
from sweep.measure.flags import TruthSource
from sweep.measure.likelihood import QUANTISATION_VARIANCE
from sweep.model.board import Board
from sweep.model.derivatives import POSE
from sweep.photographs.pose_fit import fit_pose
from sweep.photographs.truth import marker_frames
from sweep.plan.parameters import PARAMETERS
from sweep.typing import Floats, Masks

# --------------------------------------------------------------------------------------------------
# The fits of all photographs: which effects there are, and one radius of sharpening for all.

RADIUS_ROUNDS, MAX_RADIUS_FACTOR = 8, 1.5
"""Most rounds in which the common radius is moved, and the most by which one does so."""

SAME_RADIUS = 0.02
"""Change of the radius, as a share, at which it is the same."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraFit:
    """The fits of photographs, and what they say of the camera.

    Attributes
    ----------
    fits
        One of each photograph in which a marker could be fitted.
    tested
        Estimates of (variance, amount, bloom) while all of them were fitted, with a radius that
        was not: what is absent is judged by these.
    estimates
        Of the parameters that are kept: their number -> estimate.
    tested_fits
        The fits of which ``tested`` is.
    """

    fits: tuple[PhotographFit, ...]
    tested: tuple[Estimate, ...]
    estimates: dict[int, Estimate]
    tested_fits: tuple[PhotographFit, ...] = ()


def fit_camera(
    photographs: Sequence[FittedPhotograph], without: Collection[int] = (),
    known: Sequence[PhotographFit] = (),
) -> CameraFit:
    """Return the fit of a camera's photographs.

    Parameters
    ----------
    photographs
        What is fitted.
    without
        Parameters that are left out whatever their intervals: of AMOUNT and BLOOM.
    known
        Fits of all effects of these photographs, which are then not made again.
    """
    moved = np.array([True, True, True, False])
    fits = list(known) or _fitted(photographs, moved, START)
    if not fits:
        return CameraFit((), (), {})
    tested = tuple(_estimates(fits, moved)[k] for k in (VARIANCE, AMOUNT, BLOOM))
    kept = np.array([*(each.excludes(0.0) or not each.judged for each in tested), False])
    kept[list(without)] = False
    start = START.copy()
    if not (kept[VARIANCE] and tested[VARIANCE].value > 0):
        kept[VARIANCE], start[VARIANCE] = False, 0.0
    if kept[AMOUNT]:
        chosen, estimates = _with_radius(photographs, fits, kept)
    else:
        chosen = fits if np.array_equal(kept, moved) else _fitted(photographs, kept, start)
        estimates = _estimates(chosen, kept)
    return CameraFit(tuple(chosen), tested, estimates, tuple(fits))


def _fitted(
    photographs: Sequence[FittedPhotograph], moved: Masks, start: Floats,
    known: Sequence[PhotographFit] = (),
) -> list[PhotographFit]:
    """Return the fits of photographs; from earlier ones, if they are ``known``."""
    if not known:
        fits = [fit_photograph(each, moved, start) for each in photographs]
        return [each for each in fits if each is not None]
    by_number = {each.number: each for each in photographs}
    again = []
    for fit in known:
        begin = np.where(moved, np.clip(fit.parameters, LOW, HIGH), start)
        refitted = fit_photograph(by_number[fit.number], moved, begin, fit.states)
        if refitted is not None:
            again.append(refitted)
    return again


def _with_radius(
    photographs: Sequence[FittedPhotograph], fits: list[PhotographFit], kept: Masks,
) -> tuple[list[PhotographFit], dict[int, Estimate]]:
    """Return fits with sharpening, of the one radius that fits all photographs best."""
    start = np.where(kept, START, 0.0)
    radius, change = float(START[RADIUS]), 0.0
    for _ in range(RADIUS_ROUNDS):
        start[RADIUS] = radius
        fits = _fitted(photographs, kept, start, fits)
        pulls, weights = _radius_pulls(fits, kept)
        moved = radius + float(pulls.sum() / max(weights.sum(), 1e-12))
        moved = min(max(moved, radius / MAX_RADIUS_FACTOR), radius * MAX_RADIUS_FACTOR)
        moved = min(max(moved, LOW[RADIUS]), HIGH[RADIUS])
        change = moved - radius
        if abs(change) < SAME_RADIUS * radius:
            break
        radius = moved
    if len(fits) < MIN_PHOTOGRAPHS or start[RADIUS] in (LOW[RADIUS], HIGH[RADIUS]):
        return fits, _estimates(fits, kept) | {RADIUS: Estimate(float(start[RADIUS]))}
    return fits, _estimates(fits, kept, change)


def _radius_pulls(fits: Sequence[PhotographFit], kept: Masks) -> tuple[Floats, Floats]:
    """Return each photograph's gradient by the radius, and its information, others eliminated."""
    pulls, weights = [], []
    for fit in fits:
        gain = np.linalg.solve(
            fit.information[np.ix_(kept, kept)], fit.information[kept, RADIUS]
        )
        pulls.append(fit.gradient[RADIUS] - gain @ fit.gradient[kept])
        weights.append(fit.information[RADIUS, RADIUS] - gain @ fit.information[kept, RADIUS])
    return np.array(pulls), np.array(weights)


def _estimates(
    fits: Sequence[PhotographFit], kept: Masks, change: float | None = None
) -> dict[int, Estimate]:
    """Return the estimates of what is kept.

    ``change`` is the last step of the common radius; None if that was not fitted. It is common to
    all photographs. Without one of them it is another, and so is all that was fitted with it:
    intervals follow from the jackknife, whose estimates without a photograph are those of the
    quadratic approximations.
    """
    values = np.array([fit.parameters[kept] for fit in fits])
    variances = np.array([np.diag(fit.covariance)[kept] for fit in fits])
    numbers = np.flatnonzero(kept).tolist()
    if change is None:
        return {
            number: estimate(values[:, k], variances[:, k]) for k, number in enumerate(numbers)
        }
    by_radius = np.array([
        -np.linalg.solve(fit.information[np.ix_(kept, kept)], fit.information[kept, RADIUS])
        for fit in fits
    ])
    values = values + change * by_radius
    pulls, weights = _radius_pulls(fits, kept)
    pulls = pulls - weights * change
    moves = -pulls / (weights.sum() - weights)
    out = {}
    for k, number in enumerate(numbers):
        full = values[:, k].mean()
        without = np.array([
            np.delete(values[:, k] + by_radius[:, k] * move, p).mean()
            for p, move in enumerate(moves)
        ])
        spread = estimate(values[:, k], variances[:, k]).spread
        interval = estimate(jackknife(full, without))
        out[number] = Estimate(interval.value, interval.low, interval.high, spread)
    radius = float(fits[0].parameters[RADIUS]) + change
    without = np.log(np.clip(radius + moves, LOW[RADIUS], HIGH[RADIUS]))
    out[RADIUS] = estimate(jackknife(math.log(radius), without)).mapped(math.exp)
    return out


# --------------------------------------------------------------------------------------------------
# Shifts of markers beside the camera's model: how large they are, and how far they reach.
#
# The fitted corners of a photograph's markers minus those of the board's pose, fitted to the same
# corners, are (1 - P) (shifts + noise), P being the projection on what a pose explains. The
# shifts are a Gaussian field of covariance s² exp(-d² / (2 l²)), as
# :mod:`sweep.model.scene_sheet` draws it. Two sums of squares say s and l (the method of
# moments): that of the markers' centres, and that of their corners beside the centres, which turn
# a pose. The farther the field reaches, the smaller is the second one beside the first.
#
# Their covariance follows from the field, too: that of xᵀAx and xᵀBx is 2 tr(AVBV) for normal x
# of covariance V (Searle, "Linear Models", 1971, section 2.5). The interval has the sizes and
# lengths that the logarithms of the sums do not refuse. An interval from the spread of the sums
# would end too early where they are small: their spread is then small, too.

LENGTHS = np.geomspace(0.01, 0.4, 24)
"""Correlation lengths that are compared, as shares of the frame's width. A pose takes up most of
longer ones: their size cannot be said."""

SIZES_PX, FINER = np.geomspace(3e-3, 10.0, 400), 8
"""Sizes that are tried for the interval, and how many lengths from one of :data:`LENGTHS` to the
next."""

CELLS = 6
"""Cells along each side of a marker in which the field is taken as constant."""

MIN_SHIFTED_MARKERS = 3
"""Markers of a photograph from which their shifts are seen beside the pose's."""


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """Sums of squares of the shifts of one photograph's markers: of centres, and beside these.

    Attributes
    ----------
    squares, noise
        (2,) px², and what the pixels' noise is expected to add to them.
    fields
        (2, lengths) what a field of standard deviation 1 px adds, for each of :data:`LENGTHS`.
    covariance
        (3, lengths, 2, 2) of both sums: of the noise alone, and the factors of s² and s⁴.
    """

    squares: Floats
    noise: Floats
    fields: Floats
    covariance: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _Corners:
    """How a marker's fitted corners follow from its pixels.

    Attributes
    ----------
    noise
        (8, 8) covariance of the corners, x and y in turn, by the pixels' noise, px².
    points, weights
        (n, 2) points in px of the frame, and (8, 2, n): what shifts there, right and down, add
        to the corners.
    """

    noise: Floats
    points: Floats
    weights: Floats


def _corners(state: MarkerState, noise: PhotographNoise) -> _Corners:
    """Return a marker's corners.

    The noise is that of flat pixels, raised to what the residuals of all pixels are.
    """
    marker, used = state.marker, state.marker.used
    inverse = np.linalg.pinv(products(state.own), hermitian=True)
    influence = state.own @ inverse[:, :CORNERS]
    share = np.clip(state.share[used], 0.0, 1.0)
    black, white = noise.black_variance, noise.white_variance
    black, white = (value if np.isfinite(value) else other
                    for value, other in ((black, white), (white, black)))
    variance = np.maximum((1 - share) * black + share * white, 0.0) + QUANTISATION_VARIANCE
    fields = np.zeros((CORNERS, *used.shape))
    fields[:, used] = influence.T * np.sqrt(variance) * max(noise.edge_ratio, 1.0)
    correlated = smoothed(fields, kernel(np.nan_to_num(noise.correlation)))
    cells = np.clip(marker.modules_at[:, used] * CELLS, 0, CELLS - 1).astype(np.int64)
    number = cells[1] * CELLS + cells[0]
    moved = (state.scale * state.slope)[:, used]
    weights = np.array([
        [np.bincount(number, one * each, minlength=CELLS**2) for each in moved]
        for one in influence.T
    ])
    # A cell's point is where its edges are, most of them at a side of the marker.
    edge = (moved**2).sum(axis=0) + 1e-12
    mass = np.bincount(number, edge, minlength=CELLS**2)
    rows, columns = np.nonzero(used)
    points = np.array([
        np.bincount(number, edge * each, minlength=CELLS**2) for each in (columns, rows)
    ]) / np.maximum(mass, 1e-12)
    return _Corners(
        np.tensordot(fields, correlated, axes=([1, 2], [1, 2])),
        points.T + marker.frame_px, weights,
    )


def residuals_of(
    states: Sequence[MarkerState], noise: PhotographNoise, shifts: Floats, explained: Floats,
    width_px: float,
) -> Residuals | None:
    """Return the residuals of a photograph's n markers; None if they say nothing.

    Parameters
    ----------
    states, noise
        Of the photograph.
    shifts
        (n, 4, 2) px of the fitted corners from the true ones.
    explained
        (8 n, m) how the corners, x and y in turn, change with what the truth was fitted to; (8 n,
        0) if it was not fitted to the photograph.
    width_px
        Of the frame.
    """
    count, size = len(states), CORNERS * len(states)
    if count < MIN_SHIFTED_MARKERS:
        return None
    q, _ = np.linalg.qr(explained)
    residual = np.eye(size) - q @ q.T
    centres = np.kron(np.eye(count), np.tile(np.eye(2), 4) / 2)
    parts = (centres @ residual, residual - centres.T @ centres @ residual)
    corners = [_corners(each, noise) for each in states]
    noises = np.zeros((count, CORNERS, count, CORNERS))
    weights = np.zeros((2, count, CORNERS, count, CELLS**2))
    for k, each in enumerate(corners):
        noises[k, :, k, :] = each.noise
        weights[:, k, :, k] = np.moveaxis(each.weights, 1, 0)
    added, moved = noises.reshape(size, size), weights.reshape(2, size, -1)
    points = np.concatenate([each.points for each in corners])
    distances = ((points[:, None] - points[None]) ** 2).sum(axis=2)
    forms = [part.T @ part for part in parts]
    by_noise = [form @ added for form in forms]
    fields, covariance = np.empty((2, len(LENGTHS))), np.empty((3, len(LENGTHS), 2, 2))
    for k, length in enumerate(LENGTHS * width_px):
        field = np.exp(-0.5 * distances / length**2)
        shifted = sum(each @ field @ each.T for each in moved)
        by_field = [form @ shifted for form in forms]
        fields[:, k] = [np.trace(each) for each in by_field]
        mixed = _traces(by_noise, by_field)
        covariance[:, k] = (
            _traces(by_noise, by_noise), mixed + mixed.T, _traces(by_field, by_field)
        )
    flat = shifts.ravel()
    return Residuals(
        np.array([flat @ form @ flat for form in forms]),
        np.array([np.trace(each) for each in by_noise]), fields, covariance,
    )


def _traces(first: Sequence[Floats], second: Sequence[Floats]) -> Floats:
    """Return twice the traces (2, 2) of the products of two matrices with two others."""
    return np.array([[2.0 * float((one * other.T).sum()) for other in second] for one in first])


@dataclass(frozen=True, slots=True, eq=False)
class Shifts:
    """Shifts of all photographs.

    Attributes
    ----------
    size_px, length_px
        Standard deviation and correlation length.
    squares
        (n,) unbiased estimates of the squared standard deviation by each photograph.
    """

    size_px: Estimate
    length_px: Estimate
    squares: Floats


def shifts_of(residuals: Sequence[Residuals], width_px: float) -> Shifts:
    """Return the field of shifts that has the sums of squares of n photographs' residuals."""
    total = Residuals(*(
        np.sum([getattr(each, name) for each in residuals], axis=0)
        for name in ("squares", "noise", "fields", "covariance")
    ))
    size, length = _matched(total.squares - total.noise, total.fields)
    first, last = np.log(LENGTHS[[0, -1]]).tolist()
    finer = np.linspace(first, last, FINER * (len(LENGTHS) - 1) + 1)
    expected, covariance = _expected(total, SIZES_PX[:, None], finer)
    refused = _distance(
        np.log(total.squares / expected),
        covariance / (expected[..., None] * expected[..., None, :]),
    ) / _excess(residuals, math.exp(size), length)
    limit = float(special.chdtri(1, 1 - LEVEL))
    sizes, lengths = (
        Estimate(value, *_ends(grid, refused.min(axis=axis), limit)).mapped(math.exp)
        for value, grid, axis in ((size, np.log(SIZES_PX), 1), (length, finer, 0))
    )
    return Shifts(sizes, lengths.mapped(lambda share: share * width_px), np.array([
        float((each.squares - each.noise).sum()) / np.interp(
            length, np.log(LENGTHS), each.fields.sum(axis=0)
        ) for each in residuals
    ]))


def _expected(
    sums: Residuals, size_px: Floats | float, length: Floats | float
) -> tuple[Floats, Floats]:
    """Return what sums of squares are (..., 2), and their covariance (..., 2, 2), with a field.

    ``length`` has the logarithms of shares of the width.
    """
    at, square = np.log(LENGTHS), np.asarray(size_px)[..., None] ** 2
    fields = interpolate.interp1d(at, sums.fields.T, axis=0)(length)
    none, mixed, both = interpolate.interp1d(at, sums.covariance, axis=1)(length)
    square2 = square[..., None]
    return sums.noise + square * fields, none + square2 * (mixed + square2 * both)


def _distance(deviations: Floats, covariance: Floats) -> Floats:
    """Return the squares (...) of deviations (..., 2), in units of their covariance."""
    first, second = deviations[..., 0], deviations[..., 1]
    one, both, other = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    return np.asarray(
        (first**2 * other - 2 * first * second * both + second**2 * one) / (one * other - both**2)
    )


def _excess(residuals: Sequence[Residuals], size_px: float, length: float) -> float:
    """Return how many times as much photographs vary as photographs with one field do; 1 or more.

    It is 1 if chance does it with more than 5 %.
    """
    total = 0.0
    for each in residuals:
        expected, covariance = _expected(each, size_px, length)
        total += float(_distance(each.squares - expected, covariance))
    freedom = 2 * len(residuals) - 2
    return total / freedom if total > special.chdtri(freedom, 1 - LEVEL) else 1.0


def _ends(grid: Floats, distance: Floats, limit: float) -> tuple[float, float]:
    """Return the first and the last point of a grid within the limit; where lines cross it."""
    inside = np.flatnonzero(distance <= limit)
    if not len(inside):
        return math.nan, math.nan
    ends = []
    for k, step in ((int(inside[0]), -1), (int(inside[-1]), 1)):
        if not 0 <= k + step < len(grid):
            ends.append(float(grid[k]))
            continue
        share = (limit - distance[k]) / (distance[k + step] - distance[k])
        ends.append(float(grid[k] + share * (grid[k + step] - grid[k])))
    return ends[0], ends[1]


def _matched(squares: Floats, fields: Floats) -> tuple[float, float]:
    """Return the logarithms of size in px and length, a share of the width."""
    at = np.log(LENGTHS)
    ratio = np.log(fields[1] / fields[0])
    wanted = np.log(max(squares[1], 1e-12) / max(squares[0], 1e-12))
    # The ratio falls with the length.
    length = float(np.interp(-wanted, -ratio, at))
    total = np.interp(length, at, fields.sum(axis=0))
    return 0.5 * math.log(max(float(squares.sum()), 1e-12) / total), length


# --------------------------------------------------------------------------------------------------
# Levels of photographs, and how the light varies over the frame, from the levels of markers.

MIN_LIT_MARKERS = 4
"""Markers of a photograph from which the light's gradient follows, and how well."""

ONE_DIRECTION_DEG = 40.0
"""Standard deviation of the light's directions below which there is one."""


@dataclass(frozen=True, slots=True, eq=False)
class PhotographLight:
    """The levels of one photograph.

    Attributes
    ----------
    black, white
        At the middle of the frame.
    variances
        (2,) of these, from the spread of the markers.
    gradient
        (2,) relative change of the light across the frame's width, right and down; NaN with too
        few markers.
    gradient_variance
        Sum of the variances of both.
    """

    black: float
    white: float
    variances: Floats
    gradient: Floats
    gradient_variance: float


def photograph_light(states: Sequence[MarkerState], frame: Floats) -> PhotographLight:
    """Return the levels of a photograph; ``frame`` (2,) is the frame's width and height in px."""
    at = np.array([each.marker.centre_px for each in states])
    at = (at - (frame - 1) / 2) / frame[0]
    levels = np.array([each.levels[0] + np.array([0.0, each.levels[1]]) for each in states])
    count = len(states)
    none = np.full(2, np.nan)
    if count < MIN_LIT_MARKERS or np.linalg.matrix_rank(at - at.mean(axis=0), tol=1e-3) < 2:
        black, white = levels.mean(axis=0).tolist()
        return PhotographLight(black, white, none, none, math.nan)
    design = np.column_stack([np.ones(count), at])
    inverse = np.linalg.inv(design.T @ design)
    solution = inverse @ design.T @ levels[:, 1]
    residuals = levels[:, 1] - design @ solution
    variance = float(residuals @ residuals) / (count - 3)
    white, gradient = float(solution[0]), solution[1:] / solution[0]
    dark = levels[:, 0] / (1 + at @ gradient)
    own = np.array([dark.var(ddof=1) / count, variance * inverse[0, 0]])
    return PhotographLight(
        float(dark.mean()), white, own, gradient,
        variance * float(np.trace(inverse[1:, 1:])) / white**2,
    )


def gradient_square(lights: Sequence[PhotographLight]) -> Estimate:
    """Return the mean square of the light's gradient, without what errors of levels add."""
    return estimate(np.array([
        each.gradient @ each.gradient - each.gradient_variance for each in lights
    ]))


def gradient_size(lights: Sequence[PhotographLight]) -> Estimate:
    """Return the light's gradient: the root of the mean square, and its spread."""
    square = gradient_square(lights)
    lengths = np.array([np.linalg.norm(each.gradient) for each in lights])
    variances = np.array([each.gradient_variance / 2 for each in lights])
    spread = estimate(lengths, variances).spread
    value, low, high = (
        math.sqrt(max(end, 0.0)) if math.isfinite(end) else math.nan
        for end in (square.value, square.low, square.high)
    )
    return Estimate(value, low, high, spread)


def gradient_direction(lights: Sequence[PhotographLight]) -> Estimate | None:
    """Return the direction in which the light grows, in degrees; None if there is not one."""
    gradients = np.array([each.gradient for each in lights if np.isfinite(each.gradient).all()])
    if not len(gradients):
        return None
    units = gradients / np.linalg.norm(gradients, axis=1, keepdims=True)
    mean = math.degrees(math.atan2(*units.sum(axis=0)[::-1]))
    angles = np.degrees(np.arctan2(gradients[:, 1], gradients[:, 0]))
    deviations = (angles - mean + 180.0) % 360.0 - 180.0
    if not math.sqrt(float(np.mean(deviations**2))) < ONE_DIRECTION_DEG:
        return None
    errors = np.array([
        each.gradient_variance / 2 / max(float(each.gradient @ each.gradient), 1e-12)
        for each in lights if np.isfinite(each.gradient).all()
    ])
    around = estimate(deviations, np.degrees(np.sqrt(errors)) ** 2)
    return Estimate(mean + around.value, mean + around.low, mean + around.high, around.spread)


# --------------------------------------------------------------------------------------------------
# The terms of a scene: what each was estimated to be, and whether it is kept.

DIGITS = 4
"""Significant digits of the values that are written."""


@dataclass(frozen=True, slots=True)
class Term:
    """One parameter of a scene.

    Attributes
    ----------
    name
        What it is, in words.
    parameter
        Its name in pipelines.
    estimate
        What it was estimated to be.
    kept
        Whether the scene has it.
    reason
        Why it is kept or left out.
    absent
        The value at which the effect is absent; None of what every scene has.
    of
        Parameter that switches the effect on, if that is another one: they are kept together.
    setting
        What a pipeline has in the place of a value or a distribution that follow from the
        estimate; None for these.
    """

    name: str
    parameter: str
    estimate: Estimate
    kept: bool = True
    reason: str = ""
    absent: float | None = None
    of: str = ""
    setting: Any = None

    @property
    def value(self) -> Any:
        """What a pipeline has: the mean, or a distribution of the spread between photographs."""
        return drawn(self.parameter, self.estimate) if self.setting is None else self.setting

    def as_json(self) -> dict[str, Any]:
        """Return its names, numbers and decision, for JSON."""
        one = self.estimate
        return {"name": self.name, "parameter": self.parameter, "value": one.value,
                "low": one.low, "high": one.high, "spread": one.spread, "kept": self.kept,
                "reason": self.reason}

    def left_out(self, reason: str) -> Term:
        """Return it as not kept."""
        return replace(self, kept=False, reason=reason)


def drawn(parameter: str, estimate: Estimate) -> Any:
    """Return the mean, or the uniform distribution of the same mean and standard deviation.

    Uniform, since a normal one has values that no scene can have, such as a blur below 0.
    """
    value = shortened(estimate.value)
    declared = PARAMETERS[parameter].declaration
    half = math.sqrt(3.0) * estimate.spread
    if not half > 0 or not declared.drawable:
        return value
    low, high = estimate.value - half, estimate.value + half
    if declared.low is not None:
        low = max(low, declared.low)
    if declared.high is not None:
        high = min(high, declared.high)
    low, high = shortened(low), shortened(high)
    return {"uniform": [low, high]} if low < high else value


def shortened(value: float) -> float:
    """Return a number with as many digits as are written."""
    return float(f"{value:.{DIGITS}g}")


def judged(
    name: str, parameter: str, estimate: Estimate, absent: float, test: Estimate | None = None,
    convert: Callable[[Estimate], Estimate] | None = None,
) -> Term:
    """Return a term that is kept if its interval excludes the value at which it is absent.

    ``test`` is the estimate that decides, if it is another one; ``convert`` makes of an estimate
    that of the parameter.
    """
    deciding = estimate if test is None else test
    shown = estimate if convert is None else convert(estimate)
    if not math.isfinite(deciding.value):
        return Term(name, parameter, shown, False, "no pixels that say it", absent)
    if not deciding.judged:
        return Term(
            name, parameter, shown, shown.value != absent, "too few photographs to judge", absent
        )
    if not deciding.excludes(absent):
        return Term(name, parameter, shown, False, f"95 % interval includes {absent:g}", absent)
    return Term(name, parameter, shown, True, f"95 % interval excludes {absent:g}", absent)


# --------------------------------------------------------------------------------------------------
# A camera's scene from photographs of known markers: every term with its interval.

MARKERS = 12
"""Markers of a photograph that are fitted: more of them narrow the intervals little, since
photographs differ by more than the estimates of one."""


FITTED = {"sharpening": AMOUNT, "bloom": BLOOM}
"""Effects that are absent unless needed -> their parameter of a photograph's fit."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneFit:
    """A camera's scene.

    Attributes
    ----------
    terms
        Every parameter with its interval, kept or left out.
    photographs, markers
        How many of them were fitted.
    lines
        What is to be said beside the terms.
    tested_fits
        The fits of the photographs with all effects.
    """

    terms: tuple[Term, ...]
    photographs: int
    markers: int
    lines: tuple[str, ...]
    tested_fits: tuple[PhotographFit, ...] = ()

    @property
    def scene(self) -> dict[str, Any]:
        """Parameters of the section [scene] with the terms that are kept."""
        return {each.parameter: each.value for each in self.terms if each.kept}


def scene_views(
    taken: PhotographScenes, board: Board | None, markers: int = MARKERS
) -> tuple[list[FittedPhotograph], list[str]]:
    """Return what is fitted of photographs, and lines on what is not.

    Parameters
    ----------
    taken
        The photographs.
    board
        The board that is in them; None for single markers.
    markers
        The most markers of a photograph that are fitted, well spread over the frame.

    Raises
    ------
    ArgumentError
        If nothing can be fitted, in a line.
    """
    views = photograph_views(taken, board, markers)
    if not views:
        raise ArgumentError(
            "folders", "no marker", "expected photographs of markers of at least 12 px a side"
        )
    good = [each for each in views if not is_saturated(each)]
    if not good:
        raise ArgumentError(
            "folders", "white at level 255",
            "white is saturated in all photographs: expose less, so that levels are seen",
        )
    cut = len(views) - len(good)
    return good, [
        f"left out {cut} of {len(views)} photographs, in which white is saturated: expose less"
    ] if cut else []


def fit_scene(
    views: Sequence[FittedPhotograph], taken: PhotographScenes, board: Board | None,
    without: Mapping[str, str] | None = None, known: Sequence[PhotographFit] = (),
) -> SceneFit:
    """Return the scene of a camera from its photographs.

    Parameters
    ----------
    views
        What is fitted.
    taken, board
        As for :func:`scene_views`.
    without
        Switches of effects that are left out, and why.
    known
        Fits of all effects, of an earlier scene's (:attr:`SceneFit.tested_fits`).

    Raises
    ------
    ArgumentError
        If nothing can be fitted, in a line.
    """
    refused = without or {}
    numbers = {each.number for each in views}
    camera = fit_camera(
        views, [number for name, number in FITTED.items() if name in refused],
        [each for each in known if each.number in numbers],
    )
    if not camera.fits:
        raise ArgumentError(
            "folders", "no marker fits",
            "expected markers whose pixels are black and white at their true poses; check the "
            "board, the camera and the poses",
        )
    noises = [photograph_noise(fit.states) for fit in camera.fits]
    terms = [
        *_levels(camera, taken), *_optics(camera), *_light(camera, taken), *_noise(camera, noises),
        *_geometry(camera, noises, taken, board),
    ]
    terms = [
        each.left_out(refused[switch])
        if each.kept and (switch := each.of or each.parameter) in refused else each
        for each in terms
    ]
    return SceneFit(
        tuple(terms), len(camera.fits), sum(len(fit.states) for fit in camera.fits),
        tuple(_lines(camera, noises)), camera.tested_fits,
    )


def _levels(camera: CameraFit, taken: PhotographScenes) -> list[Term]:
    lights = [photograph_light(fit.states, taken.frame) for fit in camera.fits]
    own = np.array([each.variances for each in lights])
    grounds = np.array([
        np.median([state.marker.ground for state in fit.states]) for fit in camera.fits
    ])
    return [
        Term("black", "black", estimate(np.array([each.black for each in lights]), own[:, 0])),
        Term("white", "white", estimate(np.array([each.white for each in lights]), own[:, 1])),
        Term("around the marker", "background", estimate(grounds)),
    ]


def _optics(camera: CameraFit) -> list[Term]:
    none = Estimate(math.nan)
    variance, amount, bloom = (
        camera.estimates.get(k, test)
        for k, test in zip((VARIANCE, AMOUNT, BLOOM), camera.tested, strict=True)
    )
    blur = judged("blur", "blur_px", variance, 0.0, camera.tested[0], lambda v: v.mapped(_root))
    sharpening = judged("sharpening", "sharpening", amount, 0.0, camera.tested[1])
    radius = camera.estimates.get(RADIUS, none)
    return [
        blur, sharpening,
        Term("radius of sharpening", "sharpening_px", radius, sharpening.kept,
             "one for all photographs" if sharpening.kept else "no sharpening", of="sharpening"),
        judged("bloom (tone)", "bloom", bloom, 0.0, camera.tested[2]),
    ]


def _root(square: float) -> float:
    return math.sqrt(square) if square > 0 else (math.nan if math.isnan(square) else 0.0)


def _light(camera: CameraFit, taken: PhotographScenes) -> list[Term]:
    lights = [photograph_light(fit.states, taken.frame) for fit in camera.fits]
    gradient = judged(
        "light gradient", "illumination_gradient", gradient_size(lights), 0.0,
        gradient_square(lights),
    )
    direction = gradient_direction(lights)
    name, parameter = "direction of light", "illumination_deg"
    if direction is None:
        return [gradient, Term(
            name, parameter, Estimate(math.nan), gradient.kept, "any", of="illumination_gradient",
            setting={"uniform": [0.0, 360.0]},
        )]
    return [gradient, Term(name, parameter, direction, gradient.kept,
                           "" if gradient.kept else "no gradient", of="illumination_gradient")]


def _noise(camera: CameraFit, noises: Sequence[PhotographNoise]) -> list[Term]:
    """Return the noise as a table of two levels, and its correlation."""
    level = [
        estimate(np.array([
            np.mean([state.levels[0] + share * state.levels[1] for state in fit.states])
            for fit in camera.fits
        ])).value for share in (0.0, 1.0)
    ]
    variances = [
        estimate(np.array([getattr(each, name) for each in noises]))
        for name in ("black_variance", "white_variance")
    ]
    deviations = [each.mapped(_root) for each in variances]
    table: list[float] = []
    for at, each in sorted(zip(level, deviations, strict=True), key=lambda pair: pair[0]):
        if math.isfinite(each.value):
            table += [shortened(at), shortened(each.value)]
    terms = [
        judged(f"noise on {colour}", "noise_table", each, 0.0)
        for colour, each in zip(("black", "white"), variances, strict=True)
    ]
    kept = any(each.kept and each.estimate.value > 0 for each in terms)
    terms = [
        Term(each.name, "noise_table", deviation, kept, each.reason, 0.0, setting=table)
        for each, deviation in zip(terms, deviations, strict=True)
    ]
    correlation = judged(
        "correlation of noise", "noise_correlation",
        estimate(np.array([each.correlation for each in noises])), 0.0,
    )
    if correlation.kept and not kept:
        correlation = correlation.left_out("no noise")
    elif correlation.kept and correlation.estimate.value < 0:
        correlation = correlation.left_out("negative, which no scene has")
    return [*terms, correlation]


def _geometry(
    camera: CameraFit, noises: Sequence[PhotographNoise], taken: PhotographScenes,
    board: Board | None,
) -> list[Term]:
    sources = set(taken.source[taken.shown].tolist())
    names = ("geometry", "geometry_px"), ("reach of geometry", "geometry_length_px")
    known = {TruthSource.board_without_this_marker, TruthSource.poses_file}
    if not sources <= known or not np.isfinite(noises[0].edge_ratio):
        return [
            Term(*name, Estimate(math.nan), False, "only beside a board or exact poses", 0.0)
            for name in names
        ]
    residuals = []
    for fit, noise in zip(camera.fits, noises, strict=True):
        fixed = TruthSource.poses_file in sources
        compared = _beside_truth(fit) if fixed else _beside_board(fit, taken, board)
        one = None if compared is None else residuals_of(
            fit.states, noise, *compared, float(taken.frame[0])
        )
        if one is not None:
            residuals.append(one)
    if len(residuals) < MIN_PHOTOGRAPHS:
        return [
            Term(*name, Estimate(math.nan), False, "too few photographs or markers", 0.0)
            for name in names
        ]
    shifts = shifts_of(residuals, float(taken.frame[0]))
    term = judged("geometry", "geometry_px", shifts.size_px, 0.0, estimate(shifts.squares))
    if term.kept and estimate(shifts.squares).value < 0:
        term = term.left_out("smaller than the noise")
    return [term, Term(
        "reach of geometry", "geometry_length_px", shifts.length_px, term.kept,
        "" if term.kept else "no geometry", of="geometry_px",
    )]


def _beside_truth(fit: PhotographFit) -> tuple[Floats, Floats]:
    """Return the shifts (n, 4, 2) of corners beside poses that are exact."""
    shifts = [each.corners_px - each.marker.corners_px for each in fit.states]
    return np.array(shifts), np.empty((CORNERS * len(shifts), 0))


def _beside_board(
    fit: PhotographFit, taken: PhotographScenes, board: Board | None
) -> tuple[Floats, Floats] | None:
    """Return the shifts (n, 4, 2) of corners beside one pose of the board, fitted to all of them.

    And how the corners change with that pose, (8 n, 6). None without such a pose.
    """
    if board is None:
        return None
    scenes = taken.scenes
    rows = [state.marker.row for state in fit.states]
    numbers = [board.marker_ids.index(scenes.marker_id[row]) for row in rows]
    points = board.corners_m[numbers]
    pixels = np.array([state.corners_px + state.marker.frame_px for state in fit.states])
    axes, centre = marker_frames(board)[numbers[0]]
    rotation = scenes.rotation[rows[0]] @ axes.T
    camera = taken.lens(rows[0])
    pose = fit_pose(
        camera, points.reshape(-1, 3), pixels.reshape(-1, 2), rotation,
        scenes.translation[rows[0]] - rotation @ centre, np.ones(4 * len(points), dtype=bool),
    )
    if pose is None:
        return None
    explained = camera.derivatives(points.reshape(-1, 3), pose.rotation, pose.translation)[1]
    return -pose.residuals.reshape(-1, 4, 2), np.asarray(explained.reshape(-1, POSE))


def _lines(camera: CameraFit, noises: Sequence[PhotographNoise]) -> list[str]:
    lines = []
    if len(camera.fits) < MIN_PHOTOGRAPHS:
        lines.append(
            f"photographs that could be fitted: {len(camera.fits)}; from {MIN_PHOTOGRAPHS} on "
            "values have intervals, and effects that are not there are left out"
        )
    ratios = [each.edge_ratio for each in noises if math.isfinite(each.edge_ratio)]
    if ratios:
        lines.append(
            f"residuals of all pixels are {np.median(ratios):.2g} times those far from edges"
        )
    return lines
