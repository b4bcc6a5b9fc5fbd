"""The likelihood of a target's pixels: fitted to an image, and how sharp it is at the truth."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numba.extending
import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled
from sweep.declaration import parameter
from sweep.measure.estimation import covariance_elsewhere, pose_covariance, solve_positive
from sweep.measure.flags import BoundStatus
from sweep.model import board, coverage
from sweep.model.board import Board
from sweep.model.coverage import LEVELS, POSE, MarkerEdges, Work, work_space
from sweep.model.polygon import Optics, Projection, flat_sheet
from sweep.model.pose import rotations, vectors
from sweep.model.renderers import beside_pixels
from sweep.model.scene import Scenes
from sweep.typing import Floats, Integers, Masks

# --------------------------------------------------------------------------------------------------
# The likelihood of a target's pixels: fitted to an image, and how sharp it is at the truth.
#
# Pixels are exact levels plus independent Gaussian noise. The pose (and the point spread, if it
# is free) is moved by Levenberg-Marquardt; the three grey levels enter linearly and are solved
# for at every step (Golub and Pereyra, "The differentiation of pseudo-inverses and nonlinear
# least squares problems whose variables separate", SIAM J. Numer. Anal. 10, 1973).

STATE_LENGTH = 18
ROTATION, POSITION = slice(0, 9), slice(9, 12)
DEPTH, SPREAD = 11, 12
GREY_LEVELS = slice(13, 16)
#: A state vector: rotation matrix (row by row), position in metres, of which the last is the depth,
#: standard deviation of the point spread in pixels, the levels of outside, black and white; and of
#: photographs, as shares of the contrast, the level outside and the tone curve, for which slopes
#: are computed (:mod:`sweep.measure.photograph`).
OUTSIDE, BLACK, WHITE, OUTSIDE_SHARE, TONE = 13, 14, 15, 16, 17

#: Smallest point spread that is estimated; a smaller one becomes 0 and stays so.
MIN_SPREAD_PX = 0.1

MAX_TURN = 0.3
#: Largest step: in radians, and as a share of the distance.
MAX_SHIFT = 0.1

#: Squared standard deviations of the last undamped step. Near a second minimum that has just
#: vanished steps get ever shorter: there the larger one suffices.
SETTLED, NEARLY_SETTLED = 1e-4, 1e-2

#: Noise in grey levels below which the rounding error is not uniform and independent.
MIN_NOISE = 0.5

#: Variance in squared grey levels added by rounding to whole levels.
QUANTISATION_VARIANCE = 1 / 12

#: Width of the background around the marker from which its level is estimated.
BACKGROUND_MARGIN_PX = 4

#: Abandon a start after more than this many consecutive steps that predict a chi-square above
#: ``worth``.
PATIENCE = 1


class Sheets(NamedTuple):
    """The P sheets of a target in several planes; of a flat one there are none.

    Attributes
    ----------
    first
        (P + 1,) which edges move with each sheet: from the first of them to that of the next.
    planes
        (P, 3, 3) takes (column, row, 1) of each sheet to the target's frame, in metres.
    radius_m
        Largest distance of what is printed from the frame's origin.
    """

    first: Integers
    planes: Floats
    radius_m: float


#: The sheets of a target in one plane, which is that of its pose.
FLAT = Sheets(np.zeros(1, dtype=np.int64), np.empty((0, 3, 3)), 0.0)


class MarkerView(NamedTuple):
    """An image's known parameters: the marker or board, its size, the camera and the noise.

    Attributes
    ----------
    edges
        The edges of all that is printed, in modules from the top left corner of the black square;
        of a board, from that of a square of its first marker's size around the board's middle. Of
        a target in several planes each in the coordinates of the sheet that it moves with.
    extent
        (4,) left, top, right and bottom of the outline, in the same coordinates.
    modules, size_m
        Modules along that square's side, and its length.
    optics
        The camera; its principal point is relative to the image's first pixel.
    variance
        Variance of a pixel's noise in squared grey levels; 0 if it is not known.
    least_spread_px
        Smallest point spread of a state.
    sheets
        Where the sheets of a target in several planes are.
    """

    edges: MarkerEdges
    extent: Floats
    modules: float
    size_m: float
    optics: Optics
    variance: float
    least_spread_px: float
    sheets: Sheets


def marker_view(
    target: Board, size_m: float, optics: Optics, corner: NDArray[np.int64], variance: float,
    seen_from: tuple[Floats, Floats] | None = None,
) -> MarkerView:
    """Return the view of a target in an image whose first pixel is ``corner`` (2,) of the frame.

    ``size_m`` is its first marker's side, and the pose is that of its middle, which
    :func:`middle_m` gives: its perspective and the pose's mirror are those of a marker there. Of a
    target in several planes the edges are those that are seen at the pose ``seen_from``.
    """
    outline, box = _around_middle(target)
    local = optics.intrinsics.copy()
    local[2:] -= corner
    modules, sheets = board.extent_of(target).modules, FLAT
    if seen_from is not None and not target.is_planar:
        outline, sheets = _seen_sheets(target, size_m / modules / board.unit_m(target), *seen_from)
    return MarkerView(
        outline, box, modules, float(size_m), Optics(local, optics.lens, optics.distorted),
        float(variance), 0.0, sheets,
    )


def _seen_sheets(
    target: Board, scale: float, rotation: Floats, translation: Floats
) -> tuple[MarkerEdges, Sheets]:
    """Return the edges of a target in several planes that are seen at a pose, by sheets.

    An edge at which a sheet hides another moves with the sheet in front.
    """
    planes, own = board.sheet_planes(target, rotation, translation, scale), board.own_sheets(target)
    groups = [
        group for seen in board.visible_prints(target, planes) if seen.number < own
        for group in board.moving_edges(seen, planes)
    ]
    in_frame = np.array([plane for _, plane in groups]).reshape(-1, 3, 3)
    in_frame[:, :, 2] -= translation
    radius = scale * float(np.linalg.norm(board.sheets_m(target)[:own], axis=2).max())
    first = np.cumsum([0, *(len(edges.ends) for edges, _ in groups)])
    sheets = Sheets(first, np.ascontiguousarray(rotation.T @ in_frame), radius)
    return coverage.joined([edges for edges, _ in groups]), sheets


def middle_m(target: Board) -> Floats:
    """Return the middle (3,) of a target's sheet in its frame, in metres.

    0 of a marker alone, and of a target in several planes.
    """
    if not target.is_planar:
        return np.zeros(3)
    extent = board.extent_of(target)
    across, down = (extent.middle - extent.origin).tolist()
    return np.array([across, -down, 0.0]) * board.unit_m(target)


@lru_cache(maxsize=8192)
def _around_middle(target: Board) -> tuple[MarkerEdges, Floats]:
    """Return edges and extent of a target as :class:`MarkerView` has them."""
    outline, extent = board.target_edges(target), board.extent_of(target)
    shift = np.tile(extent.modules / 2 - extent.middle, 2)
    return MarkerEdges(outline.ends + shift, outline.sides), extent.target + shift


def noise_variance(noise_grey: float) -> float:
    """Return the variance of a pixel in squared grey levels, from its noise and its rounding."""
    return noise_grey**2 + QUANTISATION_VARIANCE


def state_of(rotation: Floats, translation: Floats, spread_px: float, levels: Floats) -> Floats:
    """Return the state (18,) of a pose (3, 3), (3,), a point spread, and levels (3,)."""
    return np.concatenate([rotation.ravel(), translation, [spread_px], levels, np.zeros(2)])


@compiled
def rotation_of(state: Floats) -> Floats:
    """Return the rotation matrix (3, 3) of a state, a view of it."""
    return state[ROTATION].reshape(3, 3)


@compiled
def plane_of(state: Floats, view: MarkerView) -> Floats:
    """Return the marker's plane (3, 3) at a state, as :class:`sweep.model.scene.Scenes` has it."""
    module, half = view.size_m / view.modules, 0.5 * view.size_m
    rotation, position = rotation_of(state), state[POSITION]
    plane = np.empty((3, 3))
    for i in range(3):
        right, up = rotation[i, 0], rotation[i, 1]
        plane[i, 0], plane[i, 1] = right * module, -up * module
        plane[i, 2] = position[i] - (right - up) * half
    return plane


@compiled
def product(left: Floats, right: Floats) -> Floats:
    """Return the product of two matrices, summed in the order of their rows."""
    product = np.zeros((left.shape[0], right.shape[1]))
    for i in range(left.shape[0]):
        for k in range(left.shape[1]):
            for j in range(right.shape[1]):
                product[i, j] += left[i, k] * right[k, j]
    return product


@compiled
def _sheet_plane(state: Floats, in_frame: Floats) -> Floats:
    """Return a sheet's plane (3, 3) at a state, from that in the target's frame."""
    plane = product(rotation_of(state), in_frame)
    for i in range(3):
        plane[i, 2] += state[POSITION][i]
    return plane


@compiled
def is_before_camera(state: Floats, view: MarkerView) -> bool:
    """Return whether the marker faces the camera with its whole outline in front of it."""
    if len(view.sheets.planes) > 0:
        return bool(state[DEPTH] > view.sheets.radius_m)
    plane = plane_of(state, view)
    rotation, position = rotation_of(state), state[POSITION]
    facing = 0.0
    for i in range(3):
        facing += rotation[i, 2] * position[i]
    left, top, right, bottom = view.extent
    nearest = min(
        plane[2, 0] * left + plane[2, 1] * top, plane[2, 0] * left + plane[2, 1] * bottom,
        plane[2, 0] * right + plane[2, 1] * top, plane[2, 0] * right + plane[2, 1] * bottom,
    ) + plane[2, 2]
    return facing < 0.0 and nearest > 0.0


@compiled
def curvature(
    image: Floats, state: Floats, view: MarkerView, work: Work, spread_free: bool,
    information: Floats, gradient: Floats,
) -> float:
    """Solve for the levels at a state; write the Fisher information of the other free parameters.

    The free parameters are the pose's six, ω in radians and τ as a share of the distance, and
    with ``spread_free`` the point spread's variance in px². Levels are eliminated: ``information``
    (free, free) is that of the others, times the noise's variance. ``gradient`` (free,) is that of
    half the squared residuals, downhill. ``state`` gets its levels; the slopes are for the levels
    that it had before. Returns vectorᵀ · levels: the explained part of the image's sum of squares.
    """
    free = information.shape[0]
    matrix, vector = np.empty((free + LEVELS, free + LEVELS)), np.empty(free + LEVELS)
    grey_levels = state[GREY_LEVELS]
    sheets, count = view.sheets, 0
    if len(sheets.planes) == 0:
        count = coverage.differentiate(
            work, view.edges, grey_levels, Projection(plane_of(state, view), view.optics),
            state[POSITION], state[SPREAD], 0,
        )
    for k in range(len(sheets.planes)):
        some = slice(sheets.first[k], sheets.first[k + 1])
        count = coverage.differentiate(
            work, MarkerEdges(view.edges.ends[some], view.edges.sides[some]), grey_levels,
            Projection(_sheet_plane(state, sheets.planes[k]), view.optics), state[POSITION],
            state[SPREAD], count,
        )
    distance = abs(state[DEPTH])
    for slot in range(count):
        for k in range(3, POSE):
            work.slopes[slot, k] *= distance
        if spread_free and state[SPREAD] > 0.0:
            work.slopes[slot, POSE] /= 2.0 * state[SPREAD]
    coverage.normal_equations(image, work, free, matrix, vector)
    explained = eliminate(matrix, vector, grey_levels, information, gradient)
    if spread_free and not state[SPREAD] > 0.0:
        # A point spread of 0 stays as it is.
        information[POSE, POSE] = 1.0
    return explained


@compiled
def eliminate(
    matrix: Floats, vector: Floats, linear: Floats, information: Floats, gradient: Floats
) -> float:
    """Solve for the linear parameters, the last ones, of normal equations.

    ``matrix`` (n, n) and ``vector`` (n,) are JᵀJ and Jᵀ · image. ``linear`` gets the solution,
    ``information`` (free, free) and ``gradient`` (free,) those of the others with the linear ones
    eliminated. Returns the explained part of the image's sum of squares; 0 if they cannot be
    solved for.
    """
    free, count = len(gradient), len(linear)
    inner, right = np.empty((count, count)), np.empty((count, free + 1))
    for k in range(count):
        right[k, free] = vector[free + k]
        for m in range(count):
            inner[k, m] = matrix[free + k, free + m]
        if not inner[k, k] > 0.0:
            # An area that covers no pixel gets the level 0.
            inner[k, k] = 1.0
        for m in range(free):
            right[k, m] = matrix[free + k, m]
    if not solve_positive(inner, right):
        information[:] = 0.0
        gradient[:] = 0.0
        return 0.0
    explained = 0.0
    for k in range(count):
        linear[k] = right[k, free]
        explained += right[k, free] * vector[free + k]
    for i in range(free):
        gradient[i] = vector[i]
        for k in range(count):
            gradient[i] -= matrix[i, free + k] * right[k, free]
        for j in range(free):
            information[i, j] = matrix[i, j]
            for k in range(count):
                information[i, j] -= matrix[i, free + k] * right[k, j]
    return explained


@compiled
def moved_state(state: Floats, step: Floats, least_spread_px: float) -> Floats:
    """Return the state after a step, shortened to the largest turn and shift."""
    turn = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    shift = math.sqrt(step[3] ** 2 + step[4] ** 2 + step[5] ** 2)
    shrink = min(1.0, MAX_TURN / max(turn, 1e-300))
    shrink = min(shrink, MAX_SHIFT / max(shift, 1e-300))
    moved = state.copy()
    position, moved_position = state[POSITION], moved[POSITION]
    turn_by = (shrink * step[:3]).reshape(1, 3)
    overwrite(moved[ROTATION], product(rotations(turn_by)[0], rotation_of(state)).ravel())
    for i in range(3):
        moved_position[i] = position[i] + shrink * step[3 + i] * abs(state[DEPTH])
    if len(step) > POSE:
        squared = state[SPREAD] ** 2
        # At most to four times the variance, or a quarter of it, and a third of a pixel more.
        wanted = min(squared + shrink * step[POSE], 4.0 * squared + 0.1)
        wanted = max(wanted, 0.25 * squared)
        moved[SPREAD] = math.sqrt(wanted) if wanted >= MIN_SPREAD_PX**2 else 0.0
        moved[SPREAD] = max(moved[SPREAD], least_spread_px)
    return moved


@compiled
def overwrite(values: Floats, others: Floats) -> None:
    """Replace values (n,) by others (n,).

    A loop: assigning a slice makes Numba compile the text of an error, which takes seconds.
    """
    for k in range(len(values)):
        values[k] = others[k]


class Pixels(NamedTuple):
    """An image (height, width), NaN where a pixel is left out, its sum of squares, and its view."""

    levels: Floats
    square_sum: float
    marker: MarkerView


#: Type of pixels -> the function of its model that takes the place of :func:`squared_residuals`.
MODELS: dict[type, Callable[..., float]] = {}


def squared_residuals(
    seen: Any, state: Floats, work: Any, information: Floats, gradient: Floats
) -> float:
    """Return the sum of squared residuals at a state, with the linear parameters solved for.

    ``information`` (free, free) and ``gradient`` (free,) get JᵀJ and Jᵀ · residuals of the other
    parameters; ``state`` its levels, from which the next slopes are.
    """
    return MODELS[type(seen)](seen, state, work, information, gradient)


@numba.extending.overload(squared_residuals)
def _choose_model(*args: Any) -> Any:
    """Return the choice of compiled callers, by the first argument, a NamedTuple."""
    chosen = MODELS[args[0].instance_class]

    def call(*args: Any) -> Any:
        return chosen(*args)

    return call


@compiled
def _squares_of_pixels(
    pixels: Pixels, state: Floats, work: Work, information: Floats, gradient: Floats
) -> float:
    """As :func:`squared_residuals`, by the exact image."""
    spread_free, explained = len(gradient) > POSE, 0.0
    # Slopes need levels.
    for _ in range(1 if state[GREY_LEVELS].any() else 2):
        explained = curvature(
            pixels.levels, state, pixels.marker, work, spread_free, information, gradient
        )
    return pixels.square_sum - explained


MODELS[Pixels] = _squares_of_pixels


@compiled
def unit_of(view: MarkerView, squares: float, freedom: int) -> float:
    """Return the noise's variance; of residuals as noise, where it is not known."""
    return view.variance if view.variance > 0.0 else squares / freedom


@compiled
def descend(
    seen: Any, state: Floats, work: Any, freedom: int, most_steps: int, settled: float,
    worth: float, information: Floats,
) -> tuple[float, bool]:
    """Move ``state`` to the nearest minimum of the sum of squared residuals.

    Levenberg-Marquardt with :func:`squared_residuals`.

    Parameters
    ----------
    seen, work
        Pixels, whose ``marker`` is a :class:`MarkerView`, and scratch space.
    state
        Where it starts; gets where it ends.
    freedom
        Pixels less parameters.
    most_steps
        Steps after which it ends.
    settled
        Squared standard deviations of the last undamped step.
    worth
        It is abandoned if undamped steps predict a sum above this.
    information
        (free, free) at the last state; its inverse times the variance is the covariance.

    Returns
    -------
    tuple
        The sum, and whether the minimum was reached: the undamped step is shorter than
        ``settled``, and is taken; or shorter than ``NEARLY_SETTLED`` after ``most_steps``, or when
        no step decreases the sum.
    """
    view = seen.marker
    free = len(information)
    gradient = np.empty(free)
    trial_information, trial_gradient = np.empty((free, free)), np.empty(free)
    squares = squared_residuals(seen, state, work, information, gradient)
    damping = 1e-3
    above = 0
    decrement = math.inf
    for _ in range(most_steps):
        unit = unit_of(view, squares, freedom)
        newton = gradient.copy().reshape(free, 1)
        regular = solve_positive(information, newton)
        decrement = math.inf
        if regular:
            decrement = 0.0
            for k in range(free):
                decrement += gradient[k] * newton[k, 0]
            above = above + 1 if squares - decrement > worth else 0
            if above > PATIENCE:
                return squares, False
            if decrement < settled * unit:
                moved = moved_state(state, newton[:, 0], view.least_spread_px)
                if is_before_camera(moved, view):
                    overwrite(state, moved)
                return squares, True
        accepted = False
        for _attempt in range(10):
            damped = information.copy()
            step = gradient.copy().reshape(free, 1)
            for k in range(free):
                damped[k, k] += damping * information[k, k] + 1e-300
            if solve_positive(damped, step):
                trial = moved_state(state, step[:, 0], view.least_spread_px)
                if is_before_camera(trial, view):
                    trial_squares = squared_residuals(
                        seen, trial, work, trial_information, trial_gradient
                    )
                    if trial_squares < squares:
                        accepted = True
                        break
            damping = max(8.0 * damping, 1e-3)
        if not accepted:
            break
        squares = trial_squares
        overwrite(state, trial)
        overwrite(gradient, trial_gradient)
        for k in range(free):
            overwrite(information[k], trial_information[k])
        damping *= 0.1
    return squares, decrement < NEARLY_SETTLED * unit_of(view, squares, freedom)


@compiled
def halve(image: Floats, share: float, out: Floats) -> None:
    """Write the sums of 2 x 2 pixels, times ``share``; an odd last row or column is left out."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = share * (
                image[2 * i, 2 * j] + image[2 * i, 2 * j + 1]
                + image[2 * i + 1, 2 * j] + image[2 * i + 1, 2 * j + 1]
            )


@compiled
def binned_view(view: MarkerView) -> MarkerView:
    """Return the view for an image of 2 x 2 pixels' means: the exact model holds for it, too."""
    intrinsics = np.empty(4)
    for k in range(2):
        intrinsics[k] = 0.5 * view.optics.intrinsics[k]
        intrinsics[2 + k] = 0.5 * (view.optics.intrinsics[2 + k] + 0.5) - 0.5
    return MarkerView(
        view.edges, view.extent, view.modules, view.size_m,
        Optics(intrinsics, view.optics.lens, view.optics.distorted), 0.25 * view.variance,
        view.least_spread_px, view.sheets,
    )


@compiled
def mirrored_state(state: Floats) -> Floats:
    """Return the state with the other planar solution's rotation, as ``pose.mirrored``."""
    mirror = state.copy()
    rotation, position, turned = rotation_of(state), state[POSITION], rotation_of(mirror)
    length = math.sqrt(position[0] ** 2 + position[1] ** 2 + position[2] ** 2)
    for j in range(3):
        sign = -1.0 if j == 2 else 1.0
        along = 0.0
        for k in range(3):
            along += position[k] / length * sign * rotation[k, j]
        for i in range(3):
            turned[i, j] = sign * rotation[i, j] - 2.0 * position[i] / length * along
    return mirror


@compiled
def squares(image: Floats) -> float:
    """Return the sum of squared levels of the pixels that are not NaN."""
    total = 0.0
    for i in range(image.shape[0]):
        for j in range(image.shape[1]):
            total += 0.0 if math.isnan(image[i, j]) else image[i, j] * image[i, j]
    return total


@compiled
def turn_between(state: Floats, other: Floats) -> float:
    """Return the angle between two states' rotations in radians, stable for small angles."""
    turn = vectors(product(rotation_of(state), rotation_of(other).T).reshape(1, 3, 3))[0]
    return math.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)


# --------------------------------------------------------------------------------------------------
# The best minimum and the next one, from several starts.
#
# The sum of squares of a small image has several minima: the two planar solutions, and poses with
# edges on wrong pixels. So there are several starts. Each is first fitted to the means of 2 x 2
# pixels, for which the model holds as well and whose minima are wider. Starts that end far above
# the best are dropped, the others are fitted to the pixels; the best is compared with the minimum
# that is reached from its mirror. If none explains the pixels, the starts are fitted to them
# directly.

COARSE_STEPS, FINE_STEPS = 15, 30

#: Fits whose rotations differ by less than this are the same.
SAME_TURN_RAD = 1e-3

#: Deviation of the residuals' variance, in its standard deviations, above which the model does not
#: explain the pixels.
EXCESS = 5.0


class Search(NamedTuple):
    """How far fits go.

    Attributes
    ----------
    coarsely_settled, settled
        Squared standard deviations of the last undamped step, of means of 2 x 2 pixels and of
        pixels.
    hopeless
        Excess of chi-square over the best coarse fit's above which a start is abandoned.
    """

    coarsely_settled: float
    settled: float
    hopeless: float


EXACT = Search(NEARLY_SETTLED, SETTLED, 100.0)

@compiled
def is_settled(levels: Floats, most: float, states: Floats, k: int) -> bool:
    """Return whether the k-th coarse fit is hopeless, or the same as an earlier one."""
    if not levels[k] < most:
        return True
    for m in range(k):
        if turn_between(states[k], states[m]) < SAME_TURN_RAD and levels[m] < most:
            return True
    return False


@compiled
def locate(
    seen: Any, work: Any, freedom: int, coarse: Any, coarse_work: Any, starts: Floats,
    search: Search, information: Floats,
) -> tuple[Floats, float, bool, Floats]:
    """Return the best minimum of the sum of squared residuals, and the next one.

    Parameters
    ----------
    seen, work, freedom
        As :func:`descend` takes them.
    coarse, coarse_work
        The means of 2 x 2 pixels.
    starts
        (K, 18) states; those behind the camera are skipped.
    search
        How far fits go.
    information
        Overwritten, as by :func:`descend`.

    Returns
    -------
    tuple
        The state (18,), its sum of squares, infinite without a pose, whether the minimum was
        reached, and the state of the next best minimum; NaN if there is none.
    """
    count, free = len(starts), len(information)
    coarse_freedom = max(freedom // 4, 1)
    states = starts.copy()
    trial_information = np.empty((free, free))

    def coarse_fit(state: Floats, worth: float) -> float:
        """Fit a state to the means of 2 x 2 pixels, whose point spread is half as wide."""
        state[SPREAD] *= 0.5
        state[GREY_LEVELS] = 0.0
        level, _ = descend(
            coarse, state, coarse_work, coarse_freedom, COARSE_STEPS,
            search.coarsely_settled, worth, trial_information,
        )
        state[SPREAD] *= 2.0
        return level

    def most_of(levels: Floats) -> float:
        """Return the sum of squares from which a coarse fit is hopeless."""
        lowest = float(levels.min())
        return lowest + search.hopeless * unit_of(coarse.marker, lowest, coarse_freedom)

    levels = np.full(count, math.inf)
    for k in range(count):
        if is_before_camera(states[k], seen.marker):
            levels[k] = coarse_fit(states[k], most_of(levels))
    most = most_of(levels)
    best, other = np.full(STATE_LENGTH, math.nan), np.full(STATE_LENGTH, math.nan)
    lowest = next_lowest = math.inf
    reached = False
    likely = freedom + EXCESS * math.sqrt(2.0 * freedom)
    for k in range(2 * count + 1):
        unit = unit_of(seen.marker, lowest, freedom)
        worth = lowest + search.hopeless * unit
        if k < count:
            if is_settled(levels, most, states, k):
                continue
            state = states[k].copy()
        elif k == count:
            state = mirrored_state(best)
            if not is_before_camera(state, seen.marker):
                continue
            # Not worth a fit if it was reached before, or if the coarse pixels rule it out.
            away = turn_between(state, best)
            if turn_between(state, other) < 0.5 * away:
                continue
            tried = state.copy()
            if not coarse_fit(tried, most) < most:
                continue
            if turn_between(tried, best) > 0.5 * away:
                state = tried
        else:
            # The coarse fits misled all starts, or the model is wrong.
            if lowest <= likely * unit:
                break
            state, worth = starts[k - count - 1].copy(), math.inf
        if not is_before_camera(state, seen.marker):
            continue
        state[GREY_LEVELS] = 0.0
        level, converged = descend(
            seen, state, work, freedom, FINE_STEPS, search.settled, worth,
            trial_information,
        )
        same = turn_between(state, best) < SAME_TURN_RAD
        if level < lowest:
            if not same:
                overwrite(other, best)
                next_lowest = lowest
            overwrite(best, state)
            lowest, reached = level, converged
            for m in range(free):
                overwrite(information[m], trial_information[m])
        elif not same and level < next_lowest:
            overwrite(other, state)
            next_lowest = level
    return best, lowest, reached, other


@compiled
def locate_exactly(
    image: Floats, starts: Floats, view: MarkerView, information: Floats
) -> tuple[Floats, float, bool, Floats, int]:
    """Return the result of :func:`locate` by the exact image (height, width), and the freedom."""
    freedom = int((~np.isnan(image)).sum()) - len(information) - LEVELS
    small = np.empty((image.shape[0] // 2, image.shape[1] // 2))
    halve(image, 0.25, small)
    found = locate(
        Pixels(image, squares(image), view),
        work_space(image.shape[0], image.shape[1]), freedom,
        Pixels(small, squares(small), binned_view(view)),
        work_space(small.shape[0], small.shape[1]), starts, EXACT, information,
    )
    return *found, freedom


class InSight(NamedTuple):
    """As :class:`sweep.measure.likelihood.Pixels`, of a target in several planes.

    What sheets hide of others depends on the pose: ``seen_from`` determines it again at each state;
    of ``marker`` only what does not depend on it is used.
    """

    levels: Floats
    square_sum: float
    marker: MarkerView
    seen_from: Callable[[tuple[Floats, Floats]], MarkerView]


def _squares_in_sight(
    seen: InSight, state: Floats, work: Work, information: Floats, gradient: Floats
) -> float:
    """As :func:`sweep.measure.likelihood.squared_residuals`, with what is seen at the state."""
    view = seen.seen_from((rotation_of(state), state[POSITION]))
    pixels = Pixels(seen.levels, seen.square_sum, view)
    return squared_residuals(pixels, state, work, information, gradient)


MODELS[InSight] = _squares_in_sight

#: The same steps without compilation: what is seen is determined in Python.
_descend_in_sight = getattr(descend, "py_func", descend)


def locate_in_sight(
    image: Floats, starts: Floats, view: MarkerView,
    seen_from: Callable[[tuple[Floats, Floats]], MarkerView], information: Floats,
) -> tuple[Floats, float, bool, Floats, int]:
    """As :func:`locate_exactly`, of a target in several planes, from each start."""
    free, square_sum, work = len(information), squares(image), work_space(*image.shape)
    freedom = int((~np.isnan(image)).sum()) - free - LEVELS
    missing, found = np.full(STATE_LENGTH, math.nan), np.empty((free, free))
    fits = [(missing, math.inf, False), (missing, math.inf, False)]
    for start in starts:
        state, level, reached = start.copy(), math.inf, False
        if is_before_camera(state, view):
            level, reached = _descend_in_sight(
                InSight(image, square_sum, view, seen_from), state, work, freedom, FINE_STEPS,
                SETTLED, math.inf, found,
            )
        if level < fits[0][1]:
            information[:] = found
        if all(not turn_between(state, each[0]) < SAME_TURN_RAD for each in fits):
            fits.append((state, level, reached))
        fits = sorted(fits, key=lambda fit: fit[1])
    (state, level, reached), (other, _, _), *_ = fits
    return state, level, reached, other, freedom


def explains(chi_square: float, freedom: int, noise_grey: float) -> bool:
    """Return whether residuals of an expected chi-square ``freedom`` are those of the noise.

    Within :data:`EXCESS` standard deviations, sqrt(2 · freedom). Without noise the residuals are
    those of rounding, which are smaller if the levels are whole numbers: only an excess counts.
    """
    deviation = (chi_square / freedom - 1.0) * math.sqrt(freedom / 2.0)
    return abs(deviation) <= EXCESS if noise_grey >= MIN_NOISE else deviation <= EXCESS


# --------------------------------------------------------------------------------------------------
# The Cramér-Rao bound of the exact image's pixels: the least error of any unbiased estimate.

#: Standard deviations of the noise by which every grey level must stay off the scale's ends.
CLIPPING_DEVIATIONS = 2.0

#: Most steps of the search for the mirrored minimum.
MIRROR_STEPS = 60

#: Largest distance of a mirrored minimum that is searched for, in standard deviations.
MAX_MIRROR_DISTANCE = 100.0

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

    One function, since each that calls :func:`descend` takes a second to
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
    coverage.accumulate(cover, view.edges, levels, truth, 0, 0, state[SPREAD], flat_sheet())
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
            target, board.side_m(target, float(scenes.size_m[row])), scenes.cameras.optics(row),
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
