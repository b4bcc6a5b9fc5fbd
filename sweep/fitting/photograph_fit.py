"""The fit of the simulator's own image to photographs: their pixels, and the noise by residuals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy import optimize

from sweep.errors import ArgumentError
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import TruthSource
from sweep.measure.likelihood import QUANTISATION_VARIANCE
from sweep.measure.photograph import add_plane, photograph_view, system
from sweep.measure.surroundings import BoardMarker, clear_modules, ring_modules
from sweep.model.board import Board, single_marker
from sweep.model.calibration import VIEW, Calibration
from sweep.model.coverage import MarkerEdges
from sweep.model.image_file import JPEG, photograph_image, read_image, reference
from sweep.model.marker import OUTSIDE, module_count, overhang
from sweep.model.polygon import Optics, Projection, side_lengths
from sweep.photographs.cameras import cameras_of, derivatives
from sweep.photographs.prepare import record_of
from sweep.typing import Floats, Grey, Integers, Masks

# --------------------------------------------------------------------------------------------------
# Pixels that are fitted: of some markers, well spread over each frame.

#: Markers of a photograph that are fitted: more of them narrow the intervals little, since
#: photographs differ by more than the estimates of one.
MARKERS = 12

#: Pixels that get more than this share from outside the print through that point spread are left
#: out: nothing is known of what lies there.
OUTSIDE_BLUR_PX, OUTSIDE_SHARE = 2.0, 1e-3

#: Level from which white is taken to be cut off; compression moves it a little.
SATURATED = 254.0

#: Side of a marker below which its pixels say too little.
MIN_SIDE_PX = 12.0

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


class Shown(NamedTuple):
    """A marker in a photograph: its true pose (3, 3), (3,) m, and where that comes from.

    ``marker`` is the marker alone, ``size_m`` its side, ``on_board`` its place on a board, None of
    a single one; ``width_px`` and ``jpeg_quality`` (:func:`quality_of`) are the photograph's.
    """

    rotation: Floats
    translation: Floats
    source: TruthSource
    camera: Calibration
    width_px: int
    marker: Board
    size_m: float
    on_board: BoardMarker | None
    jpeg_quality: float

    def projected(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the true images (n, 2) of columns and rows (n, 2), shares of the square's side.

        Their derivatives by pose and camera follow, as `sweep.photographs.cameras.derivatives` has
        them.
        """
        flat = (points - 0.5) * self.size_m * [1.0, -1.0]
        in_plane = np.column_stack([flat, np.zeros(len(flat))])
        return derivatives(self.camera, in_plane, self.rotation, self.translation)


class FittedMarker(NamedTuple):
    """The pixels of one marker in one photograph, with its true pose and print.

    Attributes
    ----------
    shown
        The marker and its true pose.
    used, levels
        (h, w) which pixels of a box are fitted, and the (n,) grey levels of those.
    ends, sides
        (E, 2, 2) start and end of the print's edges at its true pose, in px of the box,
        none longer than a module; (E, 2) the areas beside them. Black beyond.
    ends_at, at
        (E, 2, 2) of these points and (2, n) of the pixels: column and row as shares of the black
        square's side.
    corners_px
        (4, 2) the true corners of the black square in the box: TL, TR, BR, BL.
    modules, module_px
        Along the side of the black square, and the mean length of one in the image.
    reach
        How far the marker's own print reaches beyond the square, and half a module, as a share of
        its side.
    frame_px
        (2,) first pixel of the box in the frame.
    ground
        Median level around the marker and its own quiet zone.
    """

    shown: Shown
    used: Masks
    levels: Floats
    ends: Floats
    sides: Integers
    ends_at: Floats
    at: Floats
    corners_px: Floats
    modules: int
    module_px: float
    reach: float
    frame_px: Integers
    ground: float


#: Number of a photograph -> the markers in it that are fitted.
Views = dict[int, list[FittedMarker]]


def photograph_views(pipeline: Pipeline, most: int = MARKERS) -> tuple[Views, list[str]]:
    """Return the fitted pixels of photographs, and lines on photographs left out.

    Parameters
    ----------
    pipeline
        The experiment of the photographs.
    most
        The most markers of a photograph that are fitted: those farthest from one another, beginning
        with the one nearest the frame's centre.

    Raises
    ------
    ArgumentError
        If nothing can be fitted, in a line.
    """
    record, fixed = record_of(pipeline), pipeline.fixed
    fx, fy, cx, cy = (fixed[name] for name in VIEW)
    distortion, sd = (tuple(fixed[name]) for name in ("distortion", "calibration_sd"))
    camera = Calibration(None, None, fx, fy, cx, cy, distortion, sd, ())
    views, count = Views(), 0
    on_board = record.on_board(record.marker_id)
    sizes = np.broadcast_to(pipeline.values_of("size_m"), len(on_board)).tolist()
    for number, (path, digest) in enumerate(zip(record.paths, record.digests, strict=True)):
        file = Path(pipeline.folder) / path
        image = photograph_image(reference(file, digest, record.part))
        quality = quality_of(read_image(str(file)))
        every = [
            Shown(
                record.rotation[number, k], record.translation[number, k],
                TruthSource(int(record.source[number, k])), camera, record.width_px,
                single_marker(
                    fixed["dictionary"], int(record.marker_id[k]), fixed["quiet_zone_modules"]
                ), sizes[k], on_board[k], quality,
            ) for k in np.flatnonzero(record.shown[number]).tolist()
        ]
        seen = [marker_view(shown, image) for shown in _spread(every, image.shape, most)]
        markers = [each for each in seen if each is not None]
        count += bool(markers)
        # Whether the brightest tenth of its pixels is cut off at 255.
        levels = np.concatenate([[0.0], *(each.levels for each in markers)])
        if markers and np.quantile(levels[1:], 0.9) < SATURATED:
            views[number] = markers
    if not views:
        raise ArgumentError("folders", *(
            (str(Path(pipeline.folder, record.paths[0]).parent),
             "white is saturated in all photographs: expose less, so that levels are seen")
            if count else
            ("no marker", "expected photographs of markers of at least 12 px a side")
        ))
    cut = count - len(views)
    line = f"left out {cut} of {count} photographs, in which white is saturated: expose less"
    return views, [line] if cut else []


def quality_of(encoded: bytes) -> float:
    """Return the quality, 1 to 100, at which OpenCV writes the luminance table of a JPEG file.

    NaN if the file has another table, or none.
    """
    blank, qualities = np.zeros((8, 8), dtype=np.uint8), {-1: np.nan}
    for quality in range(1, 101):
        _, code = cv2.imencode(".jpg", blank, [cv2.IMWRITE_JPEG_QUALITY, quality])
        # Behind marker and length: the number 0, and 64 bytes. A preview's table comes earlier.
        table = code.tobytes().partition(b"\xff\xdb\0\x43")[2][:65]
        qualities.setdefault(encoded.rfind(table), quality)
    return qualities[max(qualities)] if encoded.startswith(JPEG) else np.nan


def _spread(every: Sequence[Shown], shape: tuple[int, ...], most: int) -> list[Shown]:
    """Return at most ``most`` of the markers in a frame, the farthest from one another."""
    corners = [each.projected(SQUARE)[0] for each in every]
    large = [k for k, quad in enumerate(corners) if side_lengths(quad[None]).min() >= MIN_SIDE_PX]
    if len(large) <= most:
        return [every[k] for k in large]
    centres = np.array([corners[k].mean(axis=0) for k in large])
    chosen = [int(np.argmin(np.linalg.norm(centres - np.array(shape[::-1]) / 2, axis=1)))]
    while len(chosen) < most:
        distance = np.linalg.norm(centres[:, None] - centres[chosen], axis=2).min(axis=1)
        chosen.append(int(np.argmax(distance)))
    return [every[large[k]] for k in sorted(chosen)]


def marker_view(shown: Shown, image: Grey) -> FittedMarker | None:
    """Return the pixels of a marker in a photograph (height, width); None if they are few."""
    marker, corners = shown.marker, shown.projected(SQUARE)[0]
    modules = module_count(marker.dictionary)
    optics = cameras_of(shown.camera, 1).optics(0)
    box = photograph_view(
        marker, shown.on_board, shown.size_m, corners, optics, image, np.zeros(2, dtype=np.int64),
        toned=False,
    )
    if box is None:
        return None
    frame_px = np.rint(optics.intrinsics[2:] - box.marker.optics.intrinsics[2:]).astype(np.int64)
    columns, ring = np.arange(box.levels.shape[1]), ring_modules(marker, shown.on_board)
    used = (columns >= box.spans[:, :1]) & (columns < box.spans[:, 1:])
    pieces, sides = _split(box.marker.edges)
    ends_at = pieces / modules
    ends = shown.projected(ends_at.reshape(-1, 2))[0].reshape(-1, 2, 2) - frame_px
    if (sides == OUTSIDE).any():
        used &= drawn(ends, sides, used.shape, OUTSIDE_BLUR_PX)[4] < OUTSIDE_SHARE
    if used.sum() < MIN_SIDE_PX**2:
        return None
    clear = marker.margin or 0.0 if shown.on_board is None else clear_modules(shown.on_board)
    beyond = SQUARE + (clear + 1.0) / modules * (2.0 * SQUARE - 1.0)
    return FittedMarker(
        shown, used, box.levels[used], ends, sides, ends_at,
        0.5 + (0.5 + ring / modules) * box.at[:, used],
        corners - frame_px, modules, float(side_lengths(corners[None]).mean()) / modules,
        (overhang(marker.dictionary) + 0.5) / modules, frame_px,
        _along(image, shown.projected(beyond)[0]),
    )


def _split(edges: MarkerEdges) -> tuple[Floats, Integers]:
    """Return the pieces (E, 2, 2) of edges, none longer than a module, and their sides (E, 2)."""
    start, stop = edges.ends[:, :2], edges.ends[:, 2:]
    count = np.ceil(np.linalg.norm(stop - start, axis=1)).astype(np.int64).clip(min=1)
    edge = np.repeat(np.arange(len(count)), count)
    number = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    t = np.stack([number, number + 1], axis=1) / count[edge, None]
    pieces = start[edge, None] + t[..., None] * (stop - start)[edge, None]
    return pieces, np.ascontiguousarray(edges.sides[edge])


def _along(image: Grey, outline: Floats) -> float:
    """Return the median level along an outline (4, 2) in pixels; NaN outside the image."""
    line = np.zeros_like(image)
    cv2.polylines(line, [np.rint(outline).astype(np.int32)], isClosed=True, color=1)
    return float(np.median(image[line > 0])) if line.any() else np.nan


# --------------------------------------------------------------------------------------------------
# The image of printed edges in pixels, and its slopes.

#: Values of outside, black and white in the image of the share of white.
WHITE_SHARE = np.array([0.0, 0.0, 1.0])

#: The projection of edges that are given in pixels.
IN_PIXELS = Projection(
    np.eye(3), Optics(np.array([1.0, 1.0, 0.0, 0.0]), np.zeros(24), distorted=False)
)


def drawn(ends: Floats, sides: Integers, size: tuple[int, int], sigma_px: float) -> Floats:
    """Return images (5, height, width) of edges in pixels, (E, 2, 2), through a point spread.

    They are the share of white, its slopes along x, along y and by the point spread's variance,
    and the share of the area outside the print.
    """
    height, width = size
    space = system(height, width)
    edges = MarkerEdges(np.ascontiguousarray(ends.reshape(-1, 4)), sides)
    add_plane(space, edges, WHITE_SHARE, IN_PIXELS, sigma_px)
    rates = np.moveaxis(space.rates.reshape(height, width + 1, 4)[:, :width], 2, 0)
    white = np.cumsum(rates[0], axis=1)
    outside = np.cumsum(space.outside[:, :width], axis=1)
    return np.stack([white, *rates[1:], outside])


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

#: First of a photograph's parameters: variance of the point spread in px², amount of sharpening,
#: bloom.
VARIANCE = 0

#: The effects of a photograph's parameters, by their names in pipelines.
SHARED = ("blur_px", "sharpening", "bloom")

#: Radius of the sharpening: what ``sharpening_px`` is unless it is given.
RADIUS_PX = 1.0

#: Markers whose corners end farther than this from the truth are left out: they are covered, or
#: their true pose is wrong.
MAX_SHIFT_PX = 2.0

LOW = np.array([*[-2 * MAX_SHIFT_PX] * CORNERS, -np.inf, -np.inf, 0.02, -0.95, -0.95])
#: Range of the parameters.
HIGH = np.array([*[2 * MAX_SHIFT_PX] * CORNERS, np.inf, np.inf, 100.0, 10.0, 0.95])

#: The photograph's parameters at which a fit starts, and the shares of a marker's pixels below the
#: levels of black and white at which it starts.
START, START_SHARES = np.array([0.5, 0.0, 0.0]), (0.1, 0.9)


class MarkerState(NamedTuple):
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
        drawn(ends, marker.sides, used.shape, float(np.sqrt(variance + radius**2)))[:4, used]
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
    corners = slope[:, :, None] * _of_corners(marker.at.T, marker.reach)
    return MarkerState(
        marker, parameters, marker.levels - np.clip(level, 0.0, 255.0), share,
        np.column_stack([
            corners.transpose(1, 2, 0).reshape(-1, CORNERS), inside, share * inside, along[2],
            scale * (sharp[0] - wide[0]), scale * tone,
        ]),
        slope,
    )


def fitted_state(marker: FittedMarker, start: Floats, moved: Masks) -> MarkerState:
    """Return the state of least squares; ``moved`` (13,) says which parameters are moved."""
    at = state_at(marker, np.clip(start, LOW, HIGH))

    def residuals(values: Floats) -> Floats:
        nonlocal at
        parameters = start.copy()
        parameters[moved] = values
        at = state_at(marker, np.clip(parameters, LOW, HIGH))
        return -at.residuals

    # MINPACK: in one thread, unlike LAPACK's factors of so small matrices.
    found = optimize.least_squares(
        residuals, start[moved],
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


class PhotographFit(NamedTuple):
    """The fit of one photograph.

    Attributes
    ----------
    parameters
        (3,) its parameters. Of those that were moved they are the minimum of the quadratic
        approximation, so that a variance of 0 may be below 0.
    states
        Its markers.
    levels, noise
        (2,) mean and variance of pixels on black and on white (:func:`flat_pixels`).
    """

    parameters: Floats
    states: tuple[MarkerState, ...]
    levels: Floats
    noise: Floats


def fit_photograph(
    markers: Sequence[FittedMarker], moved: Masks, start: Floats = START
) -> PhotographFit | None:
    """Return the fit of a photograph; None if no marker fits.

    Parameters
    ----------
    markers
        The photograph's markers.
    moved
        (3,) which of the photograph's parameters are moved; the others stay as at the start.
    start
        (3,) the parameters at which it starts.
    """
    own, shared = np.arange(ALL) < OWN, start.copy()
    levels = [np.quantile(each.levels, START_SHARES) for each in markers]
    starts = [np.array([*[0.0] * CORNERS, low, high - low, *shared]) for low, high in levels]
    states = _good([
        fitted_state(marker, start, np.append(own[:OWN], moved))
        for marker, start in zip(markers, starts, strict=True)
        if start[CORNERS + 1] > MIN_CONTRAST
    ])
    if not states:
        return None
    shared[moved] = np.median([state.parameters[OWN:][moved] for state in states], axis=0)
    for number in range(1 + ROUNDS if moved.any() else 1):
        if number:
            shared[moved] += _shared_step(states, moved)
            shared = np.clip(shared, LOW[OWN:], HIGH[OWN:])
        # Each marker's own parameters at the photograph's ones.
        states = [
            fitted_state(each.marker, np.concatenate([each.parameters[:OWN], shared]), own)
            for each in states
        ]
    shared[moved] += _shared_step(states, moved)
    return PhotographFit(shared, tuple(states), *flat_pixels(states))


def _shared_step(states: Sequence[MarkerState], moved: Masks) -> Floats:
    """Return the step of the photograph's moved parameters, the markers' own ones eliminated.

    Uneven shifts of parts of markers are eliminated, too: those that grow with the square of the
    position, which corners cannot take up, and which would be taken for bloom.
    """
    size = int(moved.sum())
    information, gradient = np.zeros((size, size)), np.zeros(size)
    for state in states:
        uneven = ((state.slope * at * (1 - at)).T for at in state.marker.at)
        own = np.hstack([state.jacobian[:, :OWN], *uneven])
        count = own.shape[1]
        sums = products(np.column_stack([own, state.jacobian[:, OWN:][:, moved], state.residuals]))
        inner, outer = sums[:count, count:], sums[count:, count:]
        rest = outer - inner.T @ np.linalg.lstsq(sums[:count, :count], inner, rcond=None)[0]
        information += rest[:-1, :-1]
        gradient += rest[:-1, -1]
    return np.asarray(np.linalg.lstsq(information, gradient, rcond=None)[0])


def _good(states: Sequence[MarkerState]) -> list[MarkerState]:
    """Return the states of markers that are no outliers."""
    limit = OUTLIER * float(np.median([each.residuals.std() for each in states])) if states else 0.0
    return [
        each for each in states
        if each.residuals.std() <= max(limit, 1.0) and abs(each.levels[1]) > MIN_CONTRAST
        and np.abs(each.shifts).max() < MAX_SHIFT_PX
    ]


# --------------------------------------------------------------------------------------------------
# Levels and noise of photographs, from pixels far from edges.
#
# Shifts of single edges are far larger than noise: they move the levels that are fitted with them.
# A fit takes a part of the noise into its parameters: of a pixel the share that its derivatives
# explain, the diagonal of QQᵀ with their orthonormal columns Q. It is computed and added.

#: Slope of the share of white, and its distance from 0 or 1, below which a pixel is flat.
FLAT_PER_PX, FLAT_SHARE = 5e-3, 0.03

#: Flat pixels of a photograph, of one colour, from which its noise is estimated.
MIN_PIXELS = 100


def flat_pixels(states: Sequence[MarkerState]) -> tuple[Floats, Floats]:
    """Return the mean levels (2,) of black and of white, and the variances (2,) of pixels on them.

    In grey levels, and squared ones without the variance of rounding. With too few flat pixels the
    levels are those of the fit, and the variances NaN.
    """
    fitted = np.mean([[state.levels[0], state.levels.sum()] for state in states], axis=0)
    sums, squares, counts, freedom = np.zeros((4, 2))
    for state in states:
        inverse = np.linalg.pinv(products(state.jacobian), hermitian=True)
        explained = np.einsum("ni,ij,nj->n", state.jacobian, inverse, state.jacobian)
        steepness = np.hypot(*state.slope) / abs(state.levels[1])
        flat = (steepness < FLAT_PER_PX) & state.jacobian[:, CORNERS].astype(bool)
        for k in range(2):
            area = flat & (np.abs(state.share - k) < FLAT_SHARE)
            sums[k] += state.residuals[area].sum()
            squares[k] += (state.residuals[area] ** 2).sum()
            counts[k] += area.sum()
            freedom[k] += area.sum() - explained[area].sum()
    enough = counts >= MIN_PIXELS
    variance = squares / np.maximum(freedom, 1.0) - QUANTISATION_VARIANCE
    return (fitted + np.where(enough, sums / np.maximum(counts, 1.0), 0.0),
            np.where(enough, variance, np.nan))
