"""The fit of the simulator's own image to one photograph: noise and edges by its residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from sweep.fitting.views import FittedMarker, FittedPhotograph, drawn
from sweep.measure.likelihood import QUANTISATION_VARIANCE
from sweep.typing import Floats, Masks

# --------------------------------------------------------------------------------------------------
# The simulator's own image of one marker in a photograph, its residuals and derivatives.
#
# The level of a pixel of a marker is
#
#     y = b + c F(s),
#     F(s) = s + amount (s - s_wide) + bloom s (1 - s),
#
# s being the exact share of white through a Gaussian point spread, and s_wide that through one that
# is wider by the radius of the sharpening: the simulator's image of black, white, blur, sharpening
# and bloom before it adds noise. Each marker has its own corners and levels; point
# spread, amount and bloom are the photograph's. All are one vector: the shifts of the corners from
# their true places, right and down in turn, then b and c, then the photograph's.

#: Parameters of a marker: the shifts of its four corners, then b and c; with the photograph's.
CORNERS, OWN, ALL = 8, 10, 13

#: Parameters of a photograph: variance of the point spread in px², amount of sharpening, bloom.
VARIANCE, AMOUNT, BLOOM = range(3)

#: Radius of the sharpening: what ``sharpening_px`` is unless it is given.
RADIUS_PX = 1.0

#: Markers whose corners end farther than this from the truth are left out: they are covered, or
#: their true pose is wrong.
MAX_SHIFT_PX = 2.0

LOW = np.array([*[-2 * MAX_SHIFT_PX] * CORNERS, -np.inf, -np.inf, 0.02, -0.95, -0.95])
#: Range of the parameters.
HIGH = np.array([*[2 * MAX_SHIFT_PX] * CORNERS, np.inf, np.inf, 100.0, 10.0, 0.95])

#: The photograph's parameters at which a fit starts.
START = np.array([0.5, 0.0, 0.0])


@dataclass(frozen=True, slots=True, eq=False)
class MarkerState:
    """A marker's and its photograph's parameters, with residuals and slopes of the n fitted pixels.

    Attributes
    ----------
    marker
        The pixels of markers that are fitted.
    parameters
        (13,) of the marker, then of the photograph.
    residuals
        (n,) levels minus the model.
    share
        (n,) F(s).
    jacobian
        (n, 13) derivatives of the model's levels.
    slope
        (2, n) slopes of the level when the image is moved right and down, per px; 0 where it is
        cut off at 0 or 255.
    """

    marker: FittedMarker
    parameters: Floats
    residuals: Floats
    share: Floats
    jacobian: Floats
    slope: Floats

    @property
    def shifts(self) -> Floats:
        """Shifts of the corners from their true places, (4, 2) px."""
        return self.parameters[:CORNERS].reshape(4, 2)

    @property
    def levels(self) -> Floats:
        """Levels b and c, (2,)."""
        return self.parameters[CORNERS:OWN]

    @property
    def at(self) -> Floats:
        """Column and row of the pixels as shares of the square's side, (2, n)."""
        return self.marker.at[:, self.marker.used]

    @property
    def noise(self) -> float:
        """Standard deviation of the residuals."""
        freedom = max(len(self.residuals) - OWN, 1)
        return float(np.sqrt((self.residuals**2).sum() / freedom))


def _of_corners(at: Floats, reach: float) -> Floats:
    """Return the shares (..., 4) of the corners TL, TR, BR, BL in a shift at (..., 2).

    Print farther than ``reach`` from the square is not the marker's: it moves with the marker as a
    whole, and has no share in its size.
    """
    x, y = at[..., 0], at[..., 1]
    shares = np.stack([(1 - x) * (1 - y), x * (1 - y), x * y, (1 - x) * y], axis=-1)
    beyond = np.abs(at - 0.5).max(axis=-1, keepdims=True) > 0.5 + reach
    return np.where(beyond, 0.25, shares)


def state_at(marker: FittedMarker, parameters: Floats) -> MarkerState:
    """Return a marker's residuals and derivatives at its and the photograph's parameters."""
    black, contrast, variance, amount, bloom = parameters[CORNERS:]
    used = marker.used
    shifts = parameters[:CORNERS].reshape(4, 2)
    ends = marker.ends + _of_corners(marker.ends_at, marker.reach) @ shifts
    sharp, wide = (
        np.stack(drawn(ends, marker.sides, used.shape, float(np.sqrt(variance + radius**2)))[:4])[
            :, used]
        for radius in (0.0, RADIUS_PX)
    )
    # Rounding may lead beyond black and white.
    bounded = np.clip(sharp[0], 0.0, 1.0)
    tone = bounded * (1 - bounded)
    share = sharp[0] + amount * (sharp[0] - wide[0]) + bloom * tone
    gain = 1 + amount + bloom * (1 - 2 * bounded)
    level = black + contrast * share
    inside = (level > 0.0) & (level < 255.0)
    scale = contrast * inside
    along = scale * (gain * sharp[1:] - amount * wide[1:])
    slope = -along[:2]
    corners = slope[:, :, None] * _of_corners(marker.at[:, used].T, marker.reach)
    return MarkerState(
        marker, parameters, marker.levels[used] - np.clip(level, 0.0, 255.0), share,
        np.column_stack([
            corners.transpose(1, 2, 0).reshape(-1, CORNERS), inside, share * inside, along[2],
            scale * (sharp[0] - wide[0]), scale * tone,
        ]),
        slope,
    )


def fresh_state(marker: FittedMarker, shared: Floats) -> MarkerState:
    """Return the state of a marker at its true corners, its levels by least squares."""
    parameters = np.concatenate([np.zeros(CORNERS), [0.0, 1.0], shared])
    share = state_at(marker, parameters).share
    design = np.stack([np.ones_like(share), share], axis=1)
    parameters[CORNERS:OWN] = np.linalg.lstsq(design, marker.levels[marker.used], rcond=None)[0]
    return state_at(marker, parameters)


def fitted_state(state: MarkerState, moved: Masks) -> MarkerState:
    """Return the state of least squares; ``moved`` (13,) says which parameters are moved."""
    at = state

    def residuals(values: Floats) -> Floats:
        nonlocal at
        parameters = state.parameters.copy()
        parameters[moved] = values
        at = state_at(state.marker, np.clip(parameters, LOW, HIGH))
        return -at.residuals

    # MINPACK: in one thread, unlike LAPACK's factors of so small matrices.
    found = optimize.least_squares(
        residuals, state.parameters[moved],
        lambda _: at.jacobian[:, moved],  # of the values for which residuals were computed last
        method="lm", x_scale="jac", ftol=1e-6, xtol=1e-6, max_nfev=MAX_STEPS,
    )
    residuals(found.x)
    return at


def products(columns: Floats) -> Floats:
    """Return the products (k, k) of columns (n, k), in one thread."""
    return np.asarray(np.einsum("ni,nj->ij", columns, columns))


# --------------------------------------------------------------------------------------------------
# The fit of one photograph: each marker by itself, then the photograph's parameters by Gauss-Newton
# steps with all markers' own ones eliminated.

#: Most steps of a marker's fit, and steps of the photograph's parameters.
MAX_STEPS, ROUNDS = 30, 2

#: Markers whose residuals are so many times the median marker's of the photograph are left out;
#: something lies on them.
OUTLIER = 2.5

#: Difference of white and black in grey levels below which there is no marker in the pixels.
MIN_CONTRAST = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class PhotographFit:
    """The fit of one photograph.

    Attributes
    ----------
    number
        The photograph's.
    parameters
        (3,) its parameters. Of those that were moved they are the minimum of the quadratic
        approximation, so that a variance of 0 may be below 0; shifts of parts of markers are
        eliminated in it, which would be taken for bloom.
    states
        Its markers.
    """

    number: int
    parameters: Floats
    states: tuple[MarkerState, ...]


def fit_photograph(
    photograph: FittedPhotograph, moved: Masks, start: Floats = START
) -> PhotographFit | None:
    """Return the fit of a photograph; None if no marker fits.

    Parameters
    ----------
    photograph
        The pixels of markers that are fitted.
    moved
        (3,) which of the photograph's parameters are moved; the others stay as at the start.
    start
        (3,) the parameters at which it starts.
    """
    own, shared = np.arange(ALL) < OWN, start.copy()
    states = [fresh_state(each, shared) for each in photograph.markers]
    states = _good([
        fitted_state(each, np.append(own[:OWN], moved)) for each in states
        if abs(each.levels[1]) > MIN_CONTRAST
    ])
    if not states:
        return None
    shared[moved] = np.median([state.parameters[OWN:][moved] for state in states], axis=0)
    for _ in range(ROUNDS if moved.any() else 0):
        states = [_with_shared(state, shared, own) for state in states]
        shared[moved] += _shared_step(states, moved)
        shared = np.clip(shared, LOW[OWN:], HIGH[OWN:])
    states = [_with_shared(state, shared, own) for state in states]
    result = shared.copy()
    if moved.any():
        result[moved] += _shared_step(states, moved, uneven=True)
    return PhotographFit(photograph.number, result, tuple(states))


def _with_shared(state: MarkerState, shared: Floats, own: Masks) -> MarkerState:
    """Return the fit of a marker's own parameters at the photograph's ones."""
    parameters = np.concatenate([state.parameters[:OWN], shared])
    return fitted_state(state_at(state.marker, parameters), own)


def _shared_step(
    states: Sequence[MarkerState], moved: Masks, *, uneven: bool = False
) -> Floats:
    """Return the step of the photograph's moved parameters, the markers' own ones eliminated.

    ``uneven`` shifts of parts of markers are eliminated, too: those that grow with the square of
    the position, which corners cannot take up.
    """
    size = int(moved.sum())
    information, gradient = np.zeros((size, size)), np.zeros(size)
    for state in states:
        own = state.jacobian[:, :OWN]
        if uneven:
            own = np.hstack([own, *((state.slope * at * (1 - at)).T for at in state.at)])
        count = own.shape[1]
        sums = products(np.column_stack([own, state.jacobian[:, OWN:][:, moved], state.residuals]))
        inner, outer = sums[:count, count:], sums[count:, count:]
        rest = outer - inner.T @ np.linalg.lstsq(sums[:count, :count], inner, rcond=None)[0]
        information += rest[:-1, :-1]
        gradient += rest[:-1, -1]
    return np.asarray(np.linalg.lstsq(information, gradient, rcond=None)[0])


def _good(states: Sequence[MarkerState]) -> list[MarkerState]:
    """Return the states of markers that are no outliers."""
    limit = OUTLIER * float(np.median([each.noise for each in states])) if states else 0.0
    return [
        each for each in states
        if each.noise <= max(limit, 1.0) and abs(each.levels[1]) > MIN_CONTRAST
        and np.abs(each.shifts).max() < MAX_SHIFT_PX
    ]


# --------------------------------------------------------------------------------------------------
# Noise of photographs, from the residuals of pixels far from edges.
#
# A fit takes a part of the noise into its parameters: of a pixel the share that its derivatives
# explain, the diagonal of QQᵀ with their orthonormal columns Q. It is computed and added.

#: Slope of the share of white, and its distance from 0 or 1, below which a pixel is flat.
FLAT_PER_PX, FLAT_SHARE = 5e-3, 0.03

#: Flat pixels of a photograph, of one colour, from which its noise is estimated.
MIN_PIXELS = 100


def photograph_noise(states: Sequence[MarkerState]) -> Floats:
    """Return the variances (2,) of pixels on black and on white, from a photograph's markers.

    In squared grey levels, without the variance of rounding; NaN where too few pixels are flat.
    """
    squares, counts, freedom = np.zeros(2), np.zeros(2), np.zeros(2)
    for state in states:
        inverse = np.linalg.pinv(products(state.jacobian), hermitian=True)
        explained = np.einsum("ni,ij,nj->n", state.jacobian, inverse, state.jacobian)
        steepness = np.hypot(*state.slope) / abs(state.levels[1])
        flat = (steepness < FLAT_PER_PX) & state.jacobian[:, CORNERS].astype(bool)
        for k in range(2):
            area = flat & (np.abs(state.share - k) < FLAT_SHARE)
            squares[k] += (state.residuals[area] ** 2).sum()
            counts[k] += area.sum()
            freedom[k] += area.sum() - explained[area].sum()
    variance = squares / np.maximum(freedom, 1.0) - QUANTISATION_VARIANCE
    return np.where(counts >= MIN_PIXELS, variance, np.nan)


# --------------------------------------------------------------------------------------------------
# Shifts of single edges beside the marker's corners, from the residuals of pixels near edges.
#
# A module's edge that is shifted by d along the unit vector n leaves the residuals d (n · slope).
# Edges of both polarities that are shifted alike are a field of shifts; edges that all move
# towards white are the marker's own bloom, which is taken off.

#: Half widths across and along the edge of the pixels that say where a module's edge is.
REACH_MODULES, ALONG_MODULES = 0.5, 0.4

#: Share of the whole step from black to white from which pixels count as an edge.
STEP_SHARE = 0.6


@dataclass(frozen=True, slots=True)
class EdgeShifts:
    """Sums of products of the shifts of a photograph's edges, in px².

    Attributes
    ----------
    squares, edges
        Sum of squares less the share of the pixels' noise, and the degrees of freedom.
    products, pairs
        Sum of products of two edges on one line of modules that follow on each other, and their
        number.
    """

    squares: float
    edges: float
    products: float
    pairs: float


def edge_shifts(states: Sequence[MarkerState], noise: Floats) -> EdgeShifts:
    """Return the shifts of edges; ``noise`` (2,) is the variance on black and on white."""
    variance = float(np.nanmean(noise)) + QUANTISATION_VARIANCE
    sums = np.zeros(4)
    for state in states:
        shifts = [_edges_along(state, axis) for axis in range(2)]
        bright = np.concatenate([each[0].ravel() for each in shifts])
        information = np.concatenate([each[2].ravel() for each in shifts])
        if np.isfinite(bright).sum() <= OWN:
            continue
        own, count = float(np.nanmean(bright)), int(np.isfinite(bright).sum())
        # Corners and bloom took up as much of the squares as of independent shifts' ones, and,
        # being smooth, about as much of the products of neighbours.
        taken = (CORNERS + 1) / count
        squares = float(np.nansum((bright - own) ** 2 - variance / information))
        sums[:2] += squares, count * (1 - taken)
        for towards_white, direction, _ in shifts:
            shifted = (towards_white - own) * direction
            products = shifted[:, :-1] * shifted[:, 1:]
            pairs = np.isfinite(products).sum()
            sums[2:] += (
                np.nansum(products) + pairs * taken * squares / (count * (1 - taken)), pairs
            )
    return EdgeShifts(*sums.tolist())


def _edges_along(state: MarkerState, axis: int) -> tuple[Floats, Floats, Floats]:
    """Return the edges on lines of constant column (``axis`` 0) or row of a marker.

    (lines, modules) each, NaN where there is no edge: shifts towards white in px, the sign of that
    direction along the axis, and the information of the shifts.
    """
    marker = state.marker
    across, along = marker.modules * state.at[axis], marker.modules * state.at[1 - axis]
    line, module = np.rint(across), np.floor(along)
    near = (
        (np.abs(across - line) < REACH_MODULES) & (np.abs(along - module - 0.5) < ALONG_MODULES)
        & (line >= 0) & (line <= marker.modules) & (module >= 0) & (module < marker.modules)
    )
    shape = marker.modules + 1, marker.modules
    number = (line * marker.modules + module)[near].astype(np.int64)
    slope, residuals = state.slope[:, near], state.residuals[near]

    def total(values: Floats) -> Floats:
        return np.asarray(np.bincount(number, values, shape[0] * shape[1]), dtype=np.float64)

    steps = np.stack([total(each) for each in slope])
    length = np.hypot(*steps)
    normal = steps / np.maximum(length, 1e-12)
    by_shift = (normal[:, number] * slope).sum(axis=0)
    information = total(by_shift**2)
    whole = abs(state.levels[1]) * 2 * ALONG_MODULES * marker.module_px
    edge = length > STEP_SHARE * whole
    with np.errstate(invalid="ignore", divide="ignore"):
        shifts = np.where(edge, total(by_shift * residuals) / information, np.nan)
    corners = marker.corners_px
    positive = corners[1] - corners[0] if axis == 0 else corners[3] - corners[0]
    return tuple(  # type: ignore[return-value]
        np.where(edge, each, np.nan).reshape(shape)
        for each in (shifts, np.sign(positive @ normal), information)
    )
