"""The Cramér-Rao bound of the exact image's pixels: the least error of any unbiased estimate."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled
from sweep.declaration import parameter
from sweep.measure.estimation import covariance_elsewhere
from sweep.measure.flags import BoundStatus
from sweep.measure.likelihood import (
    BACKGROUND_MARGIN_PX,
    DEPTH,
    GREY_LEVELS,
    MIN_NOISE,
    MIN_SPREAD_PX,
    SETTLED,
    SPREAD,
    MarkerView,
    Pixels,
    curvature,
    descend,
    marker_view,
    middle_m,
    mirrored_state,
    noise_variance,
    plane_of,
    pose_covariance,
    rotation_of,
    squares,
    state_of,
)
from sweep.model import coverage
from sweep.model.board import side_m
from sweep.model.coverage import POSE, work_space
from sweep.model.polygon import Projection
from sweep.model.renderers import beside_pixels
from sweep.model.scene import Scenes
from sweep.typing import Floats, Masks

# --------------------------------------------------------------------------------------------------
# The Cramér-Rao bound of the exact image's pixels: the least error of any unbiased estimate.

CLIPPING_DEVIATIONS = 2.0
"""Standard deviations of the noise by which every grey level must stay off the scale's ends."""

MIRROR_STEPS = 60
"""Most steps of the search for the mirrored minimum."""

MAX_MIRROR_DISTANCE = 100.0
"""Largest distance of a mirrored minimum that is searched for, in standard deviations."""

@dataclass(frozen=True, slots=True)
class BoundSetting:
    """Whether the accuracy bound is computed for the scenes."""

    bound: str = parameter(
        "none",
        "accuracy bound (Cramér-Rao) of each scene's pixels with unknown levels of black, white "
        "and background. none: not computed; known_blur: the point spread is known; unknown_blur: "
        "it is estimated, too",
        choices=("none", "known_blur", "unknown_blur"),
    )


@dataclass(frozen=True, slots=True)
class Bounds:
    """The bounds of N scenes; NaN unless ``status`` is ``given``.

    Attributes
    ----------
    status
        (N,) :class:`BoundStatus`.
    std
        (N, 6) least standard deviations of an unbiased estimate: rotation about the camera's x, y
        and z in radians, position along them in metres.
    kappa
        (N,) bias of the depth caused by the spread of the tilt, in standard deviations.
    mirror_distance
        (N,) distance in standard deviations between the pose and the other minimum of
        chi-square, near its mirror; NaN if there is none within :data:`MAX_MIRROR_DISTANCE`.
    """

    status: NDArray[np.uint8]
    std: Floats
    kappa: Floats
    mirror_distance: Floats


@compiled
def depth_nonlinearity(covariance: Floats, state: Floats) -> float:
    """Return κ = z (s₁² + s₂²) / (4 s_z), s₁ and s₂ those of the turns that tilt the normal.

    A tilt by a small angle foreshortens by half its square, which looks like depth: if the
    estimated tilt scatters, the depth is biased by about κ standard deviations.
    """
    rotation = rotation_of(state)
    tilting = 0.0
    for i in range(3):
        tilting += covariance[i, i]
        for j in range(3):
            tilting -= rotation[i, 2] * covariance[i, j] * rotation[j, 2]
    return float(abs(state[DEPTH]) * tilting / (4.0 * math.sqrt(covariance[5, 5])))


@compiled
def bound_of_scene(
    state: Floats, view: MarkerView, image: Floats, spread_free: bool
) -> tuple[Floats, bool, float, float]:
    """Return the bound of one scene, from its true state.

    ``image`` (height, width) is overwritten, but for its pixels that are NaN: they are left out.

    One function, since each that calls :func:`sweep.measure.likelihood.descend` takes a second to
    compile.

    Returns
    -------
    tuple
        The Cramér-Rao bound's covariance (6, 6) and whether it exists; κ; and the noise-free
        chi-square of the minimum that is reached from the mirrored pose, NaN for a target in
        several planes, if that minimum is the pose itself, if none is reached, or if it is so high
        that no noise leads there.
    """
    free = POSE + 1 if spread_free else POSE
    information, gradient = np.empty((free, free)), np.empty(free)
    height, width = image.shape
    work = work_space(height, width)
    curvature(image, state.copy(), view, work, spread_free, information, gradient)
    covariance, exists = pose_covariance(information, view.variance, abs(state[DEPTH]))
    for i in range(3):
        # Beyond half a turn rounding has made a singular problem a regular one.
        exists = exists and not covariance[i, i] > math.pi**2
    if not exists:
        return covariance, False, math.nan, math.nan
    kappa = depth_nonlinearity(covariance, state)
    if len(view.sheets.planes) > 0:
        return covariance, True, kappa, math.nan
    cover, levels = np.zeros((height, width + 2)), state[GREY_LEVELS]
    truth = Projection(plane_of(state, view), view.optics)
    coverage.accumulate(cover, view.edges, levels, truth, 0, 0, state[SPREAD])
    exact = np.empty((height, width))
    coverage.sum_levels(cover, levels[0], exact)
    for i in range(height):
        for j in range(width):
            image[i, j] += exact[i, j]
    mirror = mirrored_state(state)
    mirror[GREY_LEVELS] = 0.0
    square_sum, reached = descend(
        Pixels(image, squares(image), view), mirror, work, 1, MIRROR_STEPS, SETTLED,
        MAX_MIRROR_DISTANCE**2 * view.variance, information,
    )
    chi_square = square_sum / view.variance
    if not reached or chi_square < 1e-2:
        chi_square = math.nan
    return covariance, True, kappa, chi_square


def outside_model(scenes: Scenes, row: int) -> BoundStatus:
    """Return why the model of the bound does not hold for a scene's values; ``given`` if it does.

    The pose does not matter to it.
    """
    effects = scenes.effects.of(row)
    noise, levels = effects["noise_grey"], scenes.levels[row] * effects["gain"]
    margin = CLIPPING_DEVIATIONS * noise
    if isinstance(scenes.background[row], str) or any(
        not each.in_bound for each in scenes.effects.active_in(row)
    ):
        return BoundStatus.not_in_model
    if noise < MIN_NOISE:
        return BoundStatus.no_noise
    if levels.min() < margin or levels.max() > 255 - margin:
        return BoundStatus.clipped
    return BoundStatus.given


def bounds(
    scenes: Scenes, boxes: NDArray[np.int64], asked: NDArray[np.str_], visible: Masks
) -> Bounds:
    """Return the bounds of N scenes with the prints' ``boxes`` (N, 4).

    ``asked`` (N,) are values of :class:`BoundSetting`, ``visible`` (N,) the scenes that can have
    one.

    The bound is that of the exact image, after its gain, whichever renderer draws it: of the pixels
    in ``boxes`` and of up to :data:`~sweep.measure.likelihood.BACKGROUND_MARGIN_PX` around them, as
    far as the frame goes, which are those that solver ``photometric`` has. The rest of the frame
    knows only the background's level: N more pixels add N to that level's diagonal element of
    the Fisher information (times the noise's variance). With all of a frame of 320 x 240 px the
    bound would be lower by at most 1.0 %, of markers that the frame cuts by 1.3 %
    (``tests/measure/test_bound.py``).
    Of a board, ``std`` is of its pose, and κ is that of the depth of its middle; pixels that show
    something beside it are left out. Of one in several planes, κ is what it would be of a flat one
    with the same covariance, and there is no mirrored minimum.
    Levels of black, white and background are unknown; with ``unknown_blur`` the point spread is,
    too. From Kay, "Fundamentals of statistical signal processing: estimation theory" (1993),
    section 3.9, with analytic derivatives (:mod:`sweep.model.coverage`).
    """
    count = len(scenes)
    status = np.where(asked == "none", BoundStatus.not_run, BoundStatus.not_visible)
    status = status.astype(np.uint8)
    std, kappa, mirror = np.full((count, POSE), np.nan), *np.full((2, count), np.nan)
    low = np.maximum(boxes[:, :2] - BACKGROUND_MARGIN_PX, 0)
    high = np.minimum(boxes[:, 2:] + BACKGROUND_MARGIN_PX, scenes.frame)
    for row in np.flatnonzero(visible & (asked != "none")).tolist():
        status[row] = outside_model(scenes, row)
        if status[row] != BoundStatus.given:
            continue
        effects, rotation = scenes.effects.of(row), scenes.rotation[row]
        target, translation = scenes.targets[row], scenes.translation[row]
        view = marker_view(
            target, side_m(target, float(scenes.size_m[row])), scenes.cameras.optics(row),
            low[row], noise_variance(effects["noise_grey"]), (rotation, translation),
        )
        arm = rotation @ middle_m(target)
        state = state_of(
            rotation, translation + arm, effects["blur_px"], scenes.levels[row] * effects["gain"]
        )
        width, height = (high[row] - low[row]).tolist()
        unknown_blur = bool(asked[row] == "unknown_blur")
        if unknown_blur:
            state[SPREAD] = max(state[SPREAD], MIN_SPREAD_PX)
        image = np.zeros((height, width))
        if target.distractors:
            left, top = low[row].tolist()
            box = left, top, left + width, top + height
            image[beside_pixels(scenes, row, box)] = np.nan
        covariance, exists, kappa[row], mirror_chi_square = bound_of_scene(
            state, view, image, unknown_blur
        )
        if not exists:
            status[row] = BoundStatus.no_contrast
            continue
        if arm.any():
            covariance = covariance_elsewhere(covariance, -arm)
        std[row] = np.sqrt(np.diag(covariance))
        mirror[row] = math.sqrt(mirror_chi_square)
    return Bounds(status, std, kappa, mirror)
