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
    POSITION,
    SETTLED,
    SPREAD,
    MarkerView,
    curvature,
    fit,
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
from sweep.model.board import moving_edges, own_sheets, side_m, visible_prints
from sweep.model.derivatives import (
    LEVELS,
    POSE,
    differentiate,
    normal_equations,
    work_space,
)
from sweep.model.effects import IN_BOUND
from sweep.model.exposure import solid_planes
from sweep.model.polygon import Optics, Projection
from sweep.model.renderers import beside_pixels
from sweep.model.scene import Scenes
from sweep.typing import Floats, Integers

# --------------------------------------------------------------------------------------------------
# The Cramér-Rao bound of the pixels of a target in several planes.

def solid_covariance(
    scenes: Scenes, row: int, state: Floats, corner: Integers, image: Floats, variance: float,
    *, spread_free: bool,
) -> tuple[Floats, bool]:
    """Return the bound's covariance (6, 6) of one scene, and whether it exists.

    The slopes of all that is seen are summed; an edge at which a sheet hides another moves with
    the sheet in front. Levels are eliminated, as is the point spread with ``spread_free``.

    Parameters
    ----------
    scenes, row
        The scene.
    state
        (16,) its true state, as :mod:`sweep.measure.likelihood` has it.
    corner, image
        (2,) the first pixel of a box, and its pixels: NaN for those that are left out.
    variance
        Of a pixel, in squared grey levels.
    """
    board, planes = scenes.target(row), solid_planes(scenes, row)
    optics = scenes.cameras.optics(row)
    local = optics.intrinsics.copy()
    local[2:] -= corner
    local_optics = Optics(local, optics.lens, optics.distorted)
    work, count = work_space(*image.shape), 0
    for seen in visible_prints(board, planes):
        if seen.number >= own_sheets(board):
            continue
        for edges, plane in moving_edges(seen, planes):
            count = differentiate(
                work, edges, state[GREY_LEVELS], Projection(plane, local_optics), state[POSITION],
                state[SPREAD], count,
            )
    free = POSE + 1 if spread_free else POSE
    matrix, vector = np.empty((free + LEVELS, free + LEVELS)), np.empty(free + LEVELS)
    normal_equations(image, work, free, matrix, vector)
    covers = np.flatnonzero(np.diag(matrix)[free:] > 0) + free
    mixed = matrix[:free, covers]
    information = matrix[:free, :free] - mixed @ np.linalg.solve(
        matrix[np.ix_(covers, covers)], mixed.T
    )
    covariance, exists = pose_covariance(np.ascontiguousarray(information), variance, 1.0)
    # Beyond half a turn rounding has made a singular problem a regular one.
    return covariance, bool(exists) and not (np.diag(covariance)[:3] > np.pi**2).any()


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

    One function, since each that calls :func:`sweep.measure.likelihood.fit` takes a second to
    compile.

    Returns
    -------
    tuple
        The Cramér-Rao bound's covariance (6, 6) and whether it exists; κ; and the noise-free
        chi-square of the minimum that is reached from the mirrored pose, NaN if that minimum is
        the pose itself, if none is reached, or if it is so high that no noise leads there.
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
    cover, levels = np.zeros((height, width + 2)), state[GREY_LEVELS]
    truth = Projection(plane_of(state, view), view.optics)
    coverage.accumulate(cover, view.edges, levels, truth, 0, 0, state[SPREAD])
    exact = np.empty((height, width))
    coverage.sum_levels(cover, levels[0], exact)
    for i in range(height):
        for j in range(width):
            image[i, j] += exact[i, j]
    chi_square, reached = fit(
        image, squares(image), mirrored_state(state), view, work,
        MIRROR_STEPS, SETTLED, MAX_MIRROR_DISTANCE**2, information,
    )
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
        each.switch not in IN_BOUND for each in scenes.effects.active_in(row)
    ):
        return BoundStatus.not_in_model
    if noise < MIN_NOISE:
        return BoundStatus.no_noise
    if levels.min() < margin or levels.max() > 255 - margin:
        return BoundStatus.clipped
    return BoundStatus.given


def bounds(
    scenes: Scenes, rows: NDArray[np.intp], boxes: NDArray[np.int64], unknown_blur: bool
) -> Bounds:
    """Return the bounds of visible scenes ``rows`` (n,) with the prints' ``boxes`` (n, 4).

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
    section 3.9, with analytic derivatives (:mod:`sweep.model.derivatives`).
    """
    count = len(rows)
    status = np.full(count, BoundStatus.given, dtype=np.uint8)
    std, kappa, mirror = np.full((count, POSE), np.nan), *np.full((2, count), np.nan)
    frames = scenes.frame[rows]
    low = np.maximum(boxes[:, :2] - BACKGROUND_MARGIN_PX, 0)
    high = np.minimum(boxes[:, 2:] + BACKGROUND_MARGIN_PX, frames)
    for i, row in enumerate(rows.tolist()):
        noise, gain, blur = (
            scenes.effects.of(row)[name]
            for name in ("noise_grey", "gain", "blur_px")
        )
        levels = scenes.levels[row] * gain
        status[i] = outside_model(scenes, row)
        if status[i] != BoundStatus.given:
            continue
        target = scenes.target(row)
        view = marker_view(
            target, side_m(target, float(scenes.size_m[row])), scenes.cameras.optics(row), low[i],
            noise_variance(noise),
        )
        arm = scenes.rotation[row] @ middle_m(target)
        state = state_of(scenes.rotation[row], scenes.translation[row] + arm, blur, levels)
        width, height = (high[i] - low[i]).tolist()
        if unknown_blur:
            state[SPREAD] = max(state[SPREAD], MIN_SPREAD_PX)
        image = np.zeros((height, width))
        if target.distractors:
            left, top = low[i].tolist()
            box = left, top, left + width, top + height
            image[beside_pixels(scenes, row, box)] = np.nan
        if not target.is_planar:
            state[POSITION] = scenes.translation[row]
            covariance, exists = solid_covariance(
                scenes, row, state, low[i], image, view.variance, spread_free=unknown_blur
            )
            if exists:
                kappa[i], arm = depth_nonlinearity(covariance, state), np.zeros(3)
            mirror_chi_square = math.nan
        else:
            covariance, exists, kappa[i], mirror_chi_square = bound_of_scene(
                state, view, image, unknown_blur
            )
        if not exists:
            status[i] = BoundStatus.no_contrast
            continue
        if arm.any():
            covariance = covariance_elsewhere(covariance, -arm)
        std[i] = np.sqrt(np.diag(covariance))
        mirror[i] = math.sqrt(mirror_chi_square)
    return Bounds(status, std, kappa, mirror)
