"""How well a pose can be known at all: the Cramér-Rao bound of the exact image's pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled
from sweep.measure.flags import BoundStatus
from sweep.measure.likelihood import (
    BACKGROUND_MARGIN_PX,
    FIRST_LEVEL,
    MIN_NOISE,
    MIN_SPREAD_PX,
    SETTLED,
    SPREAD,
    MarkerView,
    curvature,
    fit,
    mirrored_state,
    noise_variance,
    plane_of,
    pose_covariance,
    sight_of,
    squares,
    state_of,
    work_space,
)
from sweep.model import coverage
from sweep.model.declaration import parameter
from sweep.model.derivatives import POSE
from sweep.model.effects import NEUTRAL
from sweep.model.scene import Scenes
from sweep.typing import Floats

CLIPPING_DEVIATIONS = 2.0
"""Standard deviations that every grey level must keep from the ends of the scale."""

MIRROR_STEPS = 60

FARTHEST_MIRROR = 100.0
"""Standard deviations from which on a second minimum is not looked for."""

MODELLED = ("blur_px", "gain", "noise_grey")
"""The effects that the bound's model of an image has."""


@dataclass(frozen=True, slots=True)
class BoundSetting:
    """Whether the accuracy bound is computed beside the scenes."""

    bound: str = parameter(
        "none",
        "accuracy bound (Cramér-Rao) of each scene's pixels, black, white and background levels "
        "unknown: none; known_blur: the point spread is known; unknown_blur: it is estimated too",
        choices=("none", "known_blur", "unknown_blur"),
    )


@dataclass(frozen=True, slots=True)
class Bounds:
    """The bounds of N scenes; NaN where ``status`` is not given.

    Attributes
    ----------
    status
        (N,) :class:`BoundStatus`.
    std
        (N, 6) least standard deviations of an unbiased estimate: rotation about the camera's x, y
        and z in radians, position along them in metres.
    kappa
        (N,) the depth's bias by the bound's own spread of the tilt, in standard deviations.
    mirror_distance
        (N,) standard deviations between the pose and the other minimum of chi-square, near its
        mirror; NaN where there is none within :data:`FARTHEST_MIRROR`.
    """

    status: NDArray[np.uint8]
    std: Floats
    kappa: Floats
    mirror_distance: Floats


@compiled
def curvature_at_truth(
    state: Floats, sight: MarkerView, height: int, width: int, spread_free: bool
) -> tuple[Floats, bool]:
    """Return the Cramér-Rao bound's covariance (6, 6), and whether there is one."""
    free = POSE + 1 if spread_free else POSE
    information, gradient = np.empty((free, free)), np.empty(free)
    curvature(
        np.zeros((height, width)), state.copy(), sight, work_space(height, width), spread_free,
        information, gradient,
    )
    return pose_covariance(information, sight.variance, abs(state[11]))


@compiled
def depth_nonlinearity(covariance: Floats, state: Floats) -> float:
    """Return κ = z (s₁² + s₂²) / (4 s_z), s₁ and s₂ those of the turns that tilt the normal.

    A tilt by a small angle foreshortens by half its square, which looks like depth: an estimate
    whose tilt scatters has a depth that is off by about κ standard deviations.
    """
    tilting = 0.0
    for i in range(3):
        tilting += covariance[i, i]
        for j in range(3):
            tilting -= state[3 * i + 2] * covariance[i, j] * state[3 * j + 2]
    return float(abs(state[11]) * tilting / (4.0 * math.sqrt(covariance[5, 5])))


@compiled
def mirror_chi_square(
    state: Floats, sight: MarkerView, height: int, width: int, spread_free: bool
) -> float:
    """Return the noise-free chi-square of the minimum that is reached from the mirrored pose.

    NaN where that is the pose itself, or none is reached; and where it is so far above that no
    noise leads there.
    """
    cover, image = np.zeros((height, width + 2)), np.empty((height, width))
    coverage.accumulate(
        cover, sight.ends, sight.sides, state[FIRST_LEVEL:], plane_of(state, sight),
        sight.intrinsics, sight.lens, sight.distorted, 0, 0, state[SPREAD],
    )
    coverage.sum_levels(cover, state[FIRST_LEVEL], image)
    free = POSE + 1 if spread_free else POSE
    mirror = mirrored_state(state)
    chi_square, reached = fit(
        image, squares(image), mirror, sight, work_space(height, width), spread_free,
        MIRROR_STEPS, SETTLED, FARTHEST_MIRROR**2, np.empty((free, free)),
    )
    if not reached or chi_square < 1e-2:
        return math.nan
    return chi_square


def bounds(
    scenes: Scenes, rows: NDArray[np.intp], boxes: NDArray[np.int64], unknown_blur: bool
) -> Bounds:
    """Return the bounds of scenes ``rows`` (n,), visible ones with the marker's ``boxes`` (n, 4).

    The bound is that of the exact image, whichever renderer draws it, after its gain, in the
    frame. Levels of black, white and background are unknown; so is the point spread where
    ``unknown_blur``. From Kay, "Fundamentals of statistical signal processing: estimation theory"
    (1993), section 3.9, with analytic derivatives (:mod:`sweep.model.derivatives`).
    """
    count = len(rows)
    status = np.full(count, BoundStatus.given, dtype=np.uint8)
    std, kappa, mirror = np.full((count, POSE), np.nan), *np.full((2, count), np.nan)
    frames = scenes.frame[rows]
    low = np.maximum(boxes[:, :2] - BACKGROUND_MARGIN_PX, 0)
    high = np.minimum(boxes[:, 2:] + BACKGROUND_MARGIN_PX, frames)
    for i, row in enumerate(rows.tolist()):
        noise, gain, blur = (
            (scenes.effect(row) if scenes.affected[row] else NEUTRAL)[name]
            for name in ("noise_grey", "gain", "blur_px")
        )
        levels = scenes.levels[row] * gain
        margin = CLIPPING_DEVIATIONS * noise
        unmodelled = isinstance(scenes.background[row], str) or any(
            name not in MODELLED for name in scenes.active(row)
        )
        if unmodelled:
            status[i] = BoundStatus.not_in_model
        elif noise < MIN_NOISE:
            status[i] = BoundStatus.no_noise
        elif levels.min() < margin or levels.max() > 255 - margin:
            status[i] = BoundStatus.clipped
        if status[i] != BoundStatus.given:
            continue
        cameras = scenes.cameras
        sight = sight_of(
            scenes.markers[scenes.marker[row]], scenes.size_m[row], cameras.view[row],
            cameras.lenses[row], cameras.distorted[row], low[i], noise_variance(noise),
        )
        state = state_of(scenes.rotation[row], scenes.translation[row], blur, levels)
        width, height = (high[i] - low[i]).tolist()
        if unknown_blur:
            state[SPREAD] = max(state[SPREAD], MIN_SPREAD_PX)
        covariance, found = curvature_at_truth(state, sight, height, width, unknown_blur)
        # Half a turn is no knowledge: rounding has made a singular problem a regular one.
        if not found or np.diag(covariance)[:3].max() > math.pi**2:
            status[i] = BoundStatus.no_contrast
            continue
        std[i] = np.sqrt(np.diag(covariance))
        kappa[i] = depth_nonlinearity(covariance, state)
        mirror[i] = math.sqrt(mirror_chi_square(state, sight, height, width, unknown_blur))
    return Bounds(status, std, kappa, mirror)
