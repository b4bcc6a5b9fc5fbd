"""Pose from the pixels of a real image: what else is printed, light and camera are in the model.

Least squares on the pixels of the marker and of its own quiet zone
(:mod:`sweep.measure.photograph_fit`). Starts are both planar solutions of the detected corners;
each is first fitted to the means of 2 x 2 pixels with the levels and the point spread alone, the
best is fitted to the pixels, and so is its mirror unless the coarse fits rule it out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sweep.compilation import compiled
from sweep.measure.estimation import Detections, Estimates
from sweep.measure.flags import EstimateStatus
from sweep.measure.likelihood import (
    POSITION,
    SPREAD,
    is_before_camera,
    mirrored_state,
    noise_variance,
    overwrite,
    rotation_of,
    turn_between,
)
from sweep.measure.photograph_box import binned_photograph, photograph_view
from sweep.measure.photograph_fit import fit_photograph
from sweep.measure.photograph_model import (
    CONTRAST,
    MOVED,
    STATE_LENGTH,
    Nuisances,
    PhotographView,
    draw,
    linear_count,
    pixel_count,
    system,
)
from sweep.measure.photograph_noise import Judgement, judge
from sweep.measure.photometric import refined_corners
from sweep.measure.quadrilaterals import from_unit_square
from sweep.measure.solver import both_planar_solutions, reprojection_errors_px
from sweep.model.marker import OUTSIDE
from sweep.typing import Floats

COARSE_STEPS, FINE_STEPS = 10, 30
SETTLED, COARSELY_SETTLED = 16.0, 4.0
"""Squared standard deviations of the last undamped step, of the pixels and of their means. The step
is taken: near the minimum the one after it is a hundredth as long, or with sharpening a quarter.
Poses on boards of 50 px differ by 0.02 standard deviations, root mean square, from those of a fit
that goes on to the end."""

FIRST_SPREAD_PX = 0.7
"""Point spread at which fits start."""

SAME_TURN_RAD = 1e-3
"""Poses whose rotations differ by less than this are the same."""

CONTEST = 50.0
"""Excess of chi-square over the best coarse fit's above which a mirrored pose is given up. Of poses
on photographs of boards, fits of all pixels chose the mirror at an excess of at most 44."""

MIN_CONTRAST = 1.0
"""Difference of white and black in grey levels below which there is no marker in the pixels."""

MAX_MISFIT_PX = 0.5
"""Standard deviation of the shifts of the marker's parts above which a pose is not explained."""


class Located(NamedTuple):
    """The pose at which a fit ended.

    Attributes
    ----------
    state, other
        The best state, and that of the next minimum; NaN if there is none.
    squares
        Sum of squared residuals; infinite without a pose.
    reached
        Whether the minimum was.
    freedom
        Fitted pixels less parameters.
    contrast
        White minus black in grey levels.
    judgement
        What the residuals say.
    """

    state: Floats
    other: Floats
    squares: float
    reached: bool
    freedom: int
    contrast: float
    judgement: Judgement


@compiled
def locate_photograph(
    view: PhotographView, starts: Floats, tried: int, nuisances: Nuisances, covariance: Floats
) -> Located:
    """Fit a view's pixels; ``covariance`` (6, 6) gets the pose's in radians and metres.

    ``starts`` (K, STATE_LENGTH) are states: the first ``tried`` are, the others if none of those
    comes to a minimum.
    """
    best, other = np.full(STATE_LENGTH, math.nan), np.full(STATE_LENGTH, math.nan)
    judgement = Judgement(False, math.nan, math.nan, math.nan, math.nan)
    freedom = pixel_count(view) - MOVED - linear_count(nuisances)
    if freedom < 1:
        return Located(best, other, math.inf, False, freedom, 0.0, judgement)
    coarse = binned_photograph(view)
    coarse_work = system(coarse.levels.shape[0], coarse.levels.shape[1])
    work = system(view.levels.shape[0], view.levels.shape[1])
    simple = Nuisances(nuisances.outside, False, nuisances.tone, nuisances.sharpening,
                       0.5 * nuisances.radius_px)
    information = np.empty((MOVED, MOVED))
    plain = Nuisances(nuisances.outside, False, False, False, 1.0)
    coarse_linear, plain_linear = np.empty(linear_count(simple)), np.empty(linear_count(plain))
    linear, trial_linear = np.empty(linear_count(nuisances)), np.empty(linear_count(nuisances))

    def coarse_fit(state: Floats) -> tuple[float, bool]:
        """Fit a state to the means of 2 x 2 pixels, whose point spread is half as wide."""
        state[SPREAD] *= 0.5
        start = state.copy()
        level, settled = fit_photograph(
            coarse, state, simple, coarse_work, COARSE_STEPS, COARSELY_SETTLED, information,
            coarse_linear,
        )
        if not settled:
            # Far from the pose, sharpening and tone lead astray.
            overwrite(state, start)
            fit_photograph(
                coarse, state, plain, coarse_work, COARSE_STEPS, COARSELY_SETTLED, information,
                plain_linear,
            )
            level, settled = fit_photograph(
                coarse, state, simple, coarse_work, COARSE_STEPS, COARSELY_SETTLED, information,
                coarse_linear,
            )
        state[SPREAD] *= 2.0
        return level, settled

    first, lowest, any_settled = best.copy(), math.inf, False
    contrast = _first_contrast(view)
    for k in range(len(starts)):
        if k >= tried and any_settled:
            break
        if is_before_camera(starts[k], view.marker):
            state = starts[k].copy()
            state[CONTRAST] = contrast
            level, settled = coarse_fit(state)
            any_settled = any_settled or settled
            if level < lowest:
                lowest = level
                overwrite(first, state)
    if not lowest < math.inf:
        return Located(best, other, math.inf, False, freedom, 0.0, judgement)
    rival = mirrored_state(first)
    excess = math.inf
    if is_before_camera(rival, view.marker):
        away = turn_between(rival, first)
        level, _ = coarse_fit(rival)
        if turn_between(rival, first) > 0.5 * away:
            excess = (level / lowest - 1.0) * pixel_count(coarse)
            if level < lowest:
                excess = (lowest / level - 1.0) * pixel_count(coarse)
                state = first.copy()
                overwrite(first, rival)
                overwrite(rival, state)
    overwrite(best, first)
    squares, reached = fit_photograph(
        view, best, nuisances, work, FINE_STEPS, SETTLED, information, linear
    )
    if excess < math.inf:
        overwrite(other, rival)
    if excess < CONTEST:
        level, rival_reached = fit_photograph(
            view, rival, nuisances, work, FINE_STEPS, SETTLED, information, trial_linear
        )
        overwrite(other, np.full(STATE_LENGTH, math.nan))
        draw(view, best, nuisances, work)
        if turn_between(rival, best) > SAME_TURN_RAD:
            overwrite(other, rival)
            if level < squares and (rival_reached or not reached):
                overwrite(other, best)
                overwrite(best, rival)
                overwrite(linear, trial_linear)
                squares, reached = level, rival_reached
                draw(view, best, nuisances, work)
    if reached:
        judgement = judge(view, best, nuisances, work, covariance)
    return Located(best, other, squares, reached, freedom, linear[1], judgement)


@dataclass(frozen=True, slots=True)
class PhotometricReal:
    """Least squares on the pixels of real images as a pose estimator.

    Attributes
    ----------
    refined
        Whether it also starts from the corners after ``cv2.cornerSubPix``.
    light, tone, sharpening
        Whether light that varies linearly, the tone curve and sharpening are estimated.
    radius_px
        Radius of the sharpening.
    """

    refined: bool
    light: bool
    tone: bool
    sharpening: bool
    radius_px: float

    @property
    def needs_images(self) -> bool:
        """Whether detections must carry their images: yes."""
        return True

    def __call__(self, detections: Detections) -> Estimates:
        """Return the poses, with covariances from the residuals."""
        count = len(detections.corners)
        out = Estimates.none(count, EstimateStatus.solver_failed)
        sets = [detections.corners]
        if self.refined:
            sets.append(refined_corners(detections))
        poses = [
            both_planar_solutions(corners, detections.cameras, detections.size_m)
            for corners in sets
        ]
        turns = np.concatenate([rotation for rotation, _ in poses], axis=1)
        shifts = np.concatenate([translation for _, translation in poses], axis=1)
        positions = np.full((count, 2, 3), np.nan)
        with np.errstate(invalid="ignore", divide="ignore"):  # three corners on a line
            squares = from_unit_square(detections.corners)
        # The first of the two solutions of each set of corners, then the others.
        order = np.argsort(np.arange(turns.shape[1]) % 2, kind="stable")
        reach = math.ceil(3 * self.radius_px) if self.sharpening else 0
        for i in range(count):
            starts = _starts(turns[i, order], shifts[i, order])
            view = photograph_view(detections, i, squares[i], reach) if len(starts) else None
            if view is not None:
                self._estimate(detections, i, view, starts, len(sets), out, positions)
        for turn, position, error in (
            (out.rotation, positions[:, 0], out.reprojection_px),
            (out.alternative_rotation, positions[:, 1], out.alternative_reprojection_px),
        ):
            known = np.flatnonzero(np.isfinite(position).all(axis=1))
            if len(known):
                error[known] = reprojection_errors_px(
                    turn[known], position[known], detections.size_m[known],
                    detections.corners[known], detections.cameras.take(known),
                )
        return out

    def _estimate(
        self, detections: Detections, i: int, view: PhotographView, starts: Floats, tried: int,
        out: Estimates, positions: Floats,
    ) -> None:
        """Write the estimate of one detection to ``out``, and the positions of both poses."""
        outside = bool((view.marker.edges.sides == OUTSIDE).any())
        nuisances = Nuisances(outside, self.light, self.tone, self.sharpening, self.radius_px)
        covariance = np.empty((6, 6))
        found = locate_photograph(view, starts, tried, nuisances, covariance)
        if not math.isfinite(found.squares):
            return
        if not found.reached:
            out.status[i] = EstimateStatus.not_converged
            return
        judgement = found.judgement
        largest = covariance.diagonal()[:3].max() if judgement.exists else math.inf
        if abs(found.contrast) < MIN_CONTRAST or not largest < math.pi**2:
            return
        out.status[i] = (
            EstimateStatus.not_explained if judgement.misfit_px > MAX_MISFIT_PX
            else EstimateStatus.solved
        )
        out.rotation[i], out.translation[i] = rotation_of(found.state), found.state[POSITION]
        out.alternative_rotation[i] = rotation_of(found.other)
        positions[i] = found.state[POSITION], found.other[POSITION]
        out.covariance[i] = covariance
        out.misfit_px[i] = judgement.misfit_px
        out.residual_ratio[i] = found.squares / (
            noise_variance(float(detections.noise_grey[i])) * found.freedom
        )


@compiled
def _first_contrast(view: PhotographView) -> float:
    """Return a contrast to begin with: twice the standard deviation, as if half were white."""
    total = squares = 0.0
    for i in range(len(view.spans)):
        for j in range(view.spans[i, 0], view.spans[i, 1]):
            total += view.levels[i, j]
            squares += view.levels[i, j] ** 2
    count = pixel_count(view)
    return 2.0 * math.sqrt(max(squares / count - (total / count) ** 2, 0.0)) + 1e-3


def _starts(rotation: Floats, translation: Floats) -> Floats:
    """Return the states (K, STATE_LENGTH) of the finite ones of M poses (M, 3, 3), (M, 3)."""
    states = np.zeros((len(rotation), STATE_LENGTH))
    states[:, :9], states[:, POSITION] = rotation.reshape(-1, 9), translation
    states[:, SPREAD] = FIRST_SPREAD_PX
    return np.asarray(states[np.isfinite(states).all(axis=1)])
