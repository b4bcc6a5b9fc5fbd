"""Posterior odds of causes: linear Gaussian evidence of each way in which a cause is undone."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sweep.diagnosis.causes import (
    AGREE,
    CAUSES,
    FLIPS,
    PAIRS_PRIOR,
    STRAIGHT,
    Cause,
    Correction,
    straight_differs,
)
from sweep.diagnosis.observations import Observations
from sweep.typing import Floats, Integers

PAIRED = ("size", "focal_length", STRAIGHT, "offset", "axes", "half_pixel", "refinement", "motion",
          FLIPS)
"""Causes that are also looked for two at a time."""

CLEAR_ODDS = 20.0
"""Posterior odds from which on one explanation is told from another: 0.95 to 0.05."""

SIDE_LIMITS_PX = (8.0, 2000.0)
"""Sides between which the refinement's bias and noise are expected."""

FLIP_SHARE = 0.5
"""Prior share of rows that are flipped, where flips are the cause."""

ROTATION_SD_DEG = 3.0
"""Standard deviation of an estimated yaw."""


class Predicted(NamedTuple):
    """What the tape should have read (c, d), how columns change it, and its variance (c, d)."""

    mean: Floats
    columns: Floats
    variance: Floats


@dataclass(frozen=True)
class Explanation:
    """One cause, or two, fitted to observations.

    Attributes
    ----------
    causes
        One or two.
    log_evidence
        Logarithm of the prior weight times the marginal likelihood.
    correction
        The ways (c,) in which it is undone.
    way_share
        Posterior probability of each way (c,).
    numbers, covariance
        Posterior mean (c, k) and covariance (c, k, k) of the columns' numbers, in prior standard
        deviations: the causes' own first, then bias and zero points.
    misfit
        Squared distance (c,) of what was measured from each way's prediction, in standard
        deviations, with all that is unknown.
    yaw_evidence
        Log-likelihood of the measured yaws.
    predicted
        What the tape should have read.
    """

    causes: tuple[Cause, ...]
    log_evidence: float
    correction: Correction
    way_share: Floats
    numbers: Floats
    covariance: Floats
    misfit: Floats
    yaw_evidence: float
    predicted: Predicted

    @property
    def names(self) -> frozenset[str]:
        """Names of the causes; empty if the numbers agree."""
        return frozenset(cause.name for cause in self.causes) - {AGREE}

    @property
    def best(self) -> int:
        """Number of the likeliest way."""
        return int(np.argmax(self.way_share))

    @property
    def fitted(self) -> Floats:
        """What the tape should have read (d,), by the likeliest way."""
        k = self.best
        return np.asarray(self.predicted.mean[k] + self.predicted.columns[k] @ self.numbers[k])


def measured(rows: Observations) -> tuple[Integers, Integers, Floats]:
    """Return what was measured (d,): row, component (0 to 2: x, y, z; 3: straight), and metres."""
    table = np.concatenate([rows.position, rows.tape[:, None]], axis=1)
    row, component = np.nonzero(np.isfinite(table))
    return row, component, np.asarray(table[row, component])


def predict(rows: Observations, causes: Sequence[Cause], correction: Correction) -> Predicted:
    """Return what the tape should read by each way (c,) of undoing causes."""
    points = np.einsum("cij,nj->cni", correction.matrix, rows.said)
    side = np.clip(rows.side_px * correction.square[:, None], *SIDE_LIMITS_PX)[..., None]
    bias, bias_sd, noise, lateral = rows.expected
    points = points * (1.0 - bias / side)
    sight = points / np.linalg.norm(points, axis=-1, keepdims=True)
    row, component, _ = measured(rows)
    straight = (component == 3)[:, None]
    # Change of what is measured with the position: a component, or along the line of sight.
    plain_z = rows.compared == "z" and straight_differs(rows) and all(
        cause.name != STRAIGHT for cause in causes)
    onto = np.where(straight, np.eye(3)[2] if plain_z else sight[:, row],
                    np.eye(4)[component][:, :3])
    onto = np.broadcast_to(onto, (len(points), len(row), 3))
    mean = (points[:, row] * onto).sum(axis=-1)
    nuisance = np.zeros((*points.shape, 1))
    nuisance[..., 0] = -bias_sd / side * points
    columns = np.concatenate([
        *(cause.columns(rows, points, spread) for cause, spread in zip(
            causes, correction.spread.T, strict=True)), nuisance], axis=-1)
    seen = np.einsum("cdi,cdik->cdk", onto, columns[:, row])
    zeros = rows.zero_sd_m * np.eye(4)[component]
    seen = np.concatenate(
        [seen, np.broadcast_to(zeros, (len(points), *zeros.shape))[..., np.unique(component)]],
        axis=-1)
    # Noise grows with the distance as measured: with that of the points a factor that brings them
    # near would explain many rows by less noise.
    known = np.where(np.isfinite(rows.tape), rows.tape, rows.position[:, 2])
    distance = np.where(np.isfinite(known), np.abs(known), np.linalg.norm(points, axis=-1))[:, row]
    focal = rows.camera.fx_px if rows.camera is not None else 1000.0
    along = (onto * sight[:, row]).sum(axis=-1)
    tape = np.where(component == 3, rows.tape_sd[row], rows.position_sd[row])
    variance = tape**2 + distance**2 * (
        (along * noise / side[:, row, 0]) ** 2 + (1.0 - along**2) * (lateral / focal) ** 2)
    return Predicted(mean, seen, variance)


def explain(rows: Observations, causes: tuple[Cause, ...], log_prior: float) -> Explanation:
    """Return an explanation by one cause or two, with its evidence.

    Notes
    -----
    What was measured is normal with mean m + J v and independent errors S, v standard normal; the
    marginal likelihood is N(m, S + J Jᵀ), by Woodbury's identity (Rasmussen and Williams, "Gaussian
    processes for machine learning", 2006, appendix A.3). Ways are summed.
    """
    correction = causes[0].ways(rows)
    for cause in causes[1:]:
        correction = correction.times(cause.ways(rows))
    predicted = predict(rows, causes, correction)
    residual = measured(rows)[2] - predicted.mean
    weighted = predicted.columns / predicted.variance[..., None]
    precision = np.eye(predicted.columns.shape[-1]) + np.einsum(
        "cdk,cdl->ckl", predicted.columns, weighted)
    covariance = np.linalg.inv(precision)
    slope = np.einsum("cdk,cd->ck", weighted, residual)
    numbers = np.einsum("ckl,cl->ck", covariance, slope)
    # As a sum of squares: the shorter difference of two large numbers came out below zero.
    left = residual - np.einsum("cdk,ck->cd", predicted.columns, numbers)
    misfit = (left**2 / predicted.variance).sum(axis=-1) + (numbers**2).sum(axis=-1)
    likelihood = -0.5 * (
        misfit + np.log(2.0 * math.pi * predicted.variance).sum(axis=-1)
        + np.linalg.slogdet(precision)[1])
    joint = correction.log_weight + likelihood
    total = float(np.logaddexp.reduce(joint))
    yaw = _yaw_evidence(rows, flips=any(cause.name == FLIPS for cause in causes))
    return Explanation(
        causes, total + log_prior + yaw, correction,
        np.exp(joint - total), numbers, covariance, misfit, yaw, predicted)


def _yaw_evidence(rows: Observations, *, flips: bool) -> float:
    """Return the log-likelihood of the measured yaws: each as said, or as said or mirrored."""
    known = np.isfinite(rows.yaw * rows.yaw_said)
    spread = np.hypot(rows.yaw_sd, ROTATION_SD_DEG)[known]

    def normal(said: Floats) -> Floats:
        # A marker seen from behind or turned by 180 degrees is some other mistake: no tail is
        # thinner than a uniform share of 1 %.
        off = (rows.yaw - said)[known]
        off = (off + 180.0) % 360.0 - 180.0
        return np.asarray(0.99 * np.exp(-0.5 * (off / spread) ** 2) / (
            spread * math.sqrt(2.0 * math.pi)) + 0.01 / 360.0)

    share = FLIP_SHARE if flips else 0.0
    return float(np.log((1.0 - share) * normal(rows.yaw_said)
                        + share * normal(rows.yaw_mirrored)).sum())


@dataclass(frozen=True)
class Ranking:
    """Explanations by posterior probability, the likeliest first.

    Attributes
    ----------
    explanations
        All of them.
    probability
        Posterior probability of each.
    missing
        Title of a cause that was not looked for -> what observations lack for it.
    """

    explanations: tuple[Explanation, ...]
    probability: Floats
    missing: dict[str, str]

    @property
    def rivals(self) -> tuple[Explanation, ...]:
        """Explanations that the first is not told from; a cause beside the first is none."""
        first = self.explanations[0]
        return tuple(
            each for each, share in zip(self.explanations[1:], self.probability[1:], strict=True)
            if first.names and not first.names < each.names
            and share * CLEAR_ODDS > self.probability[0])


def rank(rows: Observations) -> Ranking:
    """Return all explanations of observations, by posterior probability."""
    missing = {cause.title: lack for cause in CAUSES if (lack := cause.lacks(rows))}
    found = [cause for cause in CAUSES if cause.title not in missing]
    total = sum(cause.prior for cause in found)
    chosen: list[tuple[tuple[Cause, ...], float]] = [
        ((cause,), cause.prior / total) for cause in found]
    chosen += [
        ((a, b), PAIRS_PRIOR * a.prior * b.prior / total**2)
        for a, b in itertools.combinations([each for each in found if each.name in PAIRED], 2)]
    explanations = [explain(rows, causes, math.log(prior)) for causes, prior in chosen]
    evidence = np.array([each.log_evidence for each in explanations])
    order = np.argsort(-evidence, kind="stable")
    share = np.exp(evidence - np.logaddexp.reduce(evidence))[order]
    return Ranking(tuple(explanations[k] for k in order), share, missing)


# --------------------------------------------------------------------------------------------------
# The next measurement: where two explanations differ most, in standard deviations.

DIRECTIONS_DEG = (0.0, 20.0)
"""Angles of a new marker to the optical axis."""

FEWEST_PX, MOST_SHARE = 20.0, 0.6
"""Sides of the square, in pixels and as a share of the frame's height, at which it is measured."""

DECIDES = 2.0
"""Difference in standard deviations from which on one more row is worth taking."""


class Measurement(NamedTuple):
    """A row to measure next.

    Attributes
    ----------
    distance_m, bearing_deg
        Where the marker is to stand.
    component
        What is measured: "distance" along the line of sight, "x" to the right, "z" along the axis.
    difference
        Difference of both predictions, in standard deviations.
    """

    distance_m: float
    bearing_deg: float
    component: str
    difference: float


def next_measurement(rows: Observations, a: Explanation, b: Explanation) -> Measurement:
    """Return the row at which two explanations differ most relative to their uncertainty."""
    reach = np.linalg.norm(np.einsum("ij,nj->ni", a.correction.matrix[a.best], rows.said), axis=1)
    near, far = reach.min() / 3.0, reach.max() * 3.0
    if rows.camera is not None and np.isfinite(rows.size_m):
        true = reach * rows.side_px  # focal length times size, as the image shows it
        near = max(near, float(np.median(true)) / (
            MOST_SHARE * (rows.camera.height_px or 2.0 * rows.camera.cy_px)))
        far = max(min(far, float(np.median(true)) / FEWEST_PX), near * 1.5)
    count = 15
    distance = np.tile(np.geomspace(near, far, count), len(DIRECTIONS_DEG))
    bearing = np.radians(np.repeat(DIRECTIONS_DEG, count))
    truth = distance[:, None] * np.stack(
        [np.sin(bearing), np.zeros_like(bearing), np.cos(bearing)], axis=-1)
    # What the program would say if a were right.
    said = truth @ np.linalg.inv(a.correction.matrix[a.best]).T
    said[:, 2] = np.maximum(said[:, 2], 1e-3)
    n, some = len(said), np.full(len(said), np.nan)
    spread = np.maximum(0.002, 0.005 * np.linalg.norm(truth, axis=1))
    position = np.where([True, False, True], truth, np.nan)
    moves = np.nan_to_num(rows.speed).any()
    speed = np.full(n, np.nanmean([*rows.speed, 0.0]) if moves else np.nan)
    new = dataclasses.replace(
        rows, said=said, lateral=True, tape=np.linalg.norm(truth, axis=1), tape_sd=spread,
        position=position, position_sd=spread, yaw=some, yaw_said=some, yaw_mirrored=some,
        yaw_sd=some, speed=speed)
    row, which, _ = measured(new)
    means, variances = [], []
    for each in (a, b):
        predicted = predict(new, each.causes, each.correction.one(each.best))
        # The unknown zero points are those of the new row alone where it measures a new component.
        own = each.numbers.shape[-1] - len(np.unique(measured(rows)[1]))
        numbers = each.numbers[each.best][:own]
        columns = predicted.columns[0, :, :own]
        means.append(predicted.mean[0] + columns @ numbers)
        variances.append(np.einsum(
            "dk,kl,dl->d", columns, each.covariance[each.best][:own, :own], columns)
            + predicted.variance[0] / 2.0 + 0.5 * rows.zero_sd_m**2)
    difference = np.abs(means[0] - means[1]) / np.sqrt(variances[0] + variances[1])
    # Of rows that decide well enough the one that is nearest to those measured.
    enough = difference >= min(float(difference.max()), 2.0 * DECIDES)
    effort = np.abs(np.log(np.linalg.norm(truth[row], axis=1) / np.median(reach)))
    k = int(np.argmin(np.where(enough, effort, np.inf)))
    return Measurement(
        float(np.linalg.norm(truth[row[k]])),
        float(np.degrees(np.arctan2(truth[row[k], 0], truth[row[k], 2]))),
        {0: "x", 2: "z", 3: "distance"}[int(which[k])], float(difference[k]))
