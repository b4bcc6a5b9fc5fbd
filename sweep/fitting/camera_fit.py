"""The fits of all photographs: which effects there are, and one radius of sharpening for all."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from sweep.fitting.estimates import MIN_PHOTOGRAPHS, Estimate, estimate, jackknife
from sweep.fitting.marker_state import AMOUNT, BLOOM, RADIUS, VARIANCE
from sweep.fitting.photograph_fit import HIGH, LOW, START, PhotographFit, fit_photograph
from sweep.fitting.views import FittedPhotograph
from sweep.typing import Floats, Masks

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
