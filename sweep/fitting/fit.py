"""A camera's scene from photographs of known markers: every term with its interval."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import special

from sweep.analysis.intervals import TAIL
from sweep.errors import ArgumentError
from sweep.fitting.photograph_fit import (
    ALONG_MODULES,
    AMOUNT,
    BLOOM,
    CORNERS,
    OWN,
    START,
    VARIANCE,
    EdgeShifts,
    MarkerState,
    PhotographFit,
    edge_shifts,
    fit_photograph,
    photograph_noise,
    products,
)
from sweep.fitting.views import FittedPhotograph, PhotographScenes, is_saturated, photograph_views
from sweep.measure.flags import TruthSource
from sweep.measure.likelihood import QUANTISATION_VARIANCE
from sweep.measure.solver import marker_frame
from sweep.model.board import Board
from sweep.photographs.pose_fit import fit_pose
from sweep.typing import Floats, Integers, Masks

# --------------------------------------------------------------------------------------------------
# Means over photographs, each of which is one draw, and their intervals.

#: Photographs from one line of progress to the next.
SAID = 5

#: Photographs from which intervals are given: with three, Student's are 2.5 standard deviations of
#: a photograph wide on each side, and their spread is known to a factor of 6.
MIN_PHOTOGRAPHS = 4


@dataclass(frozen=True, slots=True)
class Estimate:
    """A parameter of the camera.

    Attributes
    ----------
    value, low, high
        The mean over the photographs, and the ends of its 95 % interval; NaN with too few.
    """

    value: float
    low: float = math.nan
    high: float = math.nan

    @property
    def judged(self) -> bool:
        """Whether there is an interval."""
        return math.isfinite(self.low)

    def excludes(self, absent: float) -> bool:
        """Return whether the interval excludes a value."""
        return self.high < absent or self.low > absent

    def mapped(self, function: Callable[[float], float]) -> Estimate:
        """Return the estimate of an increasing function of the parameter."""
        return Estimate(function(self.value), function(self.low), function(self.high))


def estimate(values: Floats) -> Estimate:
    """Return the mean of a parameter's values (n,) in n photographs; the interval is Student's."""
    known = values[np.isfinite(values)]
    count = len(known)
    if not count:
        return Estimate(math.nan)
    mean = float(known.mean())
    if count < MIN_PHOTOGRAPHS:
        return Estimate(mean)
    half = float(special.stdtrit(count - 1, 1 - TAIL) * known.std(ddof=1) / math.sqrt(count))
    return Estimate(mean, mean - half, mean + half)


def jackknife(function: Callable[[Integers], Floats], count: int) -> list[Estimate]:
    """Return estimates of a function (k,) of photographs, by leaving each of them out.

    ``function`` takes the numbers of the photographs that count. Pseudo-values give the interval.
    """
    every = np.arange(count)
    whole = function(every)
    if count < MIN_PHOTOGRAPHS:
        return [Estimate(value) for value in whole.tolist()]
    without = np.array([function(np.delete(every, k)) for k in range(count)])
    spread = [estimate(each) for each in (count * whole - (count - 1) * without).T]
    return [
        Estimate(value, value + each.low - each.value, value + each.high - each.value)
        for value, each in zip(whole.tolist(), spread, strict=True)
    ]


# --------------------------------------------------------------------------------------------------
# The fits of all photographs: which effects there are.

@dataclass(frozen=True, slots=True, eq=False)
class CameraFit:
    """The fits of photographs, and the camera's parameters by them.

    Attributes
    ----------
    fits, tested_fits
        One of each photograph in which a marker could be fitted: with the kept effects, and with
        all effects.
    kept
        (3,) which of variance, amount and bloom are kept.
    """

    fits: tuple[PhotographFit, ...]
    tested_fits: tuple[PhotographFit, ...]
    kept: Masks

    @property
    def tested(self) -> list[Estimate]:
        """Estimates of (variance, amount, bloom) with all effects: they judge which are absent."""
        return [estimate(each) for each in np.transpose([fit.parameters for fit in
                                                         self.tested_fits])]

    @property
    def estimates(self) -> list[Estimate]:
        """Estimates of (variance, amount, bloom); of effects not kept those with all effects."""
        found = np.transpose([fit.parameters for fit in self.fits])
        return [
            estimate(each) if kept else tested
            for each, kept, tested in zip(found, self.kept, self.tested, strict=True)
        ]


#: Is told, in a line, how far a fit is.
Say = Callable[[str], None]


def fit_camera(
    photographs: Sequence[FittedPhotograph], without: Collection[int] = (),
    known: Sequence[PhotographFit] = (), say: Say = lambda _: None,
) -> CameraFit | None:
    """Return the fit of a camera's photographs; None if no marker fits.

    Parameters
    ----------
    photographs
        The pixels of markers that are fitted.
    without
        Parameters that are left out whatever their intervals: of AMOUNT and BLOOM.
    known
        Fits of all effects of these photographs, which are then not made again.
    say
        Gets a line for some of the photographs.
    """
    every = np.ones(len(START), dtype=bool)
    fits = tuple(known) or _fitted(photographs, every, START, say)
    if not fits:
        return None
    tested = CameraFit(fits, fits, every).tested
    kept = np.array([each.excludes(0.0) or not each.judged for each in tested])
    kept[list(without)] = False
    start = START.copy()
    if not (kept[VARIANCE] and tested[VARIANCE].value > 0):
        kept[VARIANCE], start[VARIANCE] = False, 0.0
    return CameraFit(fits if kept.all() else _fitted(photographs, kept, start, say), fits, kept)


def _fitted(
    photographs: Sequence[FittedPhotograph], moved: Masks, start: Floats, say: Say
) -> tuple[PhotographFit, ...]:
    fits = []
    for number, each in enumerate(photographs):
        if number % SAID == 0:
            say(f"fitting photograph {number + 1} of {len(photographs)}")
        fits.append(fit_photograph(each, moved, start))
    return tuple(each for each in fits if each is not None)


# --------------------------------------------------------------------------------------------------
# Shifts of single edges: a field whose reach is about a module.
#
# Its covariance is s² exp(-d² / (2 l²)), as of ``edge_px`` in scenes. An edge's shift is the
# field's mean along a module. Its variance, and the covariance with the next edge on the same line,
# say s and l.

@dataclass(frozen=True, slots=True)
class EdgeField:
    """The field of shifts of edges: its variance in px², and its correlation length."""

    variance: Estimate
    length_px: Estimate

    def covariance(self, distances: Floats, cell_px: float) -> Floats:
        """Return the covariance in px² of means over cells at squared distances (px²).

        Means over two squares are, nearly, the field smoothed by a Gaussian of their variance.
        """
        if not self.variance.value > 0:
            return np.zeros_like(distances)
        square = self.length_px.value**2
        wide = square + cell_px**2 / 6
        return np.asarray(
            self.variance.value * square / wide * np.exp(-0.5 * distances / wide)
        )


#: Correlation lengths that are compared, in modules.
EDGE_LENGTHS = np.geomspace(0.1, 3.0, 60)


def _edge_means() -> tuple[Floats, Floats]:
    """Return variance and covariance of the means along a module, and along it and the next one.

    For each of :data:`EDGE_LENGTHS`, for a field of variance 1.
    """
    t = ALONG_MODULES * ((np.arange(16) + 0.5) / 8 - 1)
    apart = np.array([0.0, 1.0])[:, None, None, None]
    correlation = np.exp(
        -0.5 * ((t[:, None] - t - apart) / EDGE_LENGTHS[:, None, None]) ** 2
    )
    variance, covariance = correlation.mean(axis=(2, 3))
    return variance, covariance


def edge_field(shifts: Sequence[EdgeShifts], module_px: float) -> EdgeField:
    """Return the field of shifts of n photographs' edges; ``module_px`` is a module's length."""
    sums = np.array([[each.squares, each.edges, each.products, each.pairs] for each in shifts])
    sums = sums[(sums[:, 1] > 0) & (sums[:, 3] > 0)]
    variance, covariance = _edge_means()

    if not len(sums):
        return EdgeField(Estimate(math.nan), Estimate(math.nan))

    def logarithm(rows: Integers) -> Floats:
        squares, edges, products, pairs = sums[rows].sum(axis=0).tolist()
        ratio = products / pairs / (squares / edges) if squares > 0 else 0.0
        return np.log([np.interp(ratio, covariance / variance, EDGE_LENGTHS)])

    (length,) = jackknife(logarithm, len(sums))
    length = length.mapped(math.exp)
    share = float(np.interp(length.value, EDGE_LENGTHS, variance))
    return EdgeField(
        estimate(sums[:, 0] / sums[:, 1] / share),
        length.mapped(lambda modules: max(modules * module_px, 1.0)),
    )


# --------------------------------------------------------------------------------------------------
# Shifts of markers beside the camera's model: how large they are, and how far they reach.
#
# The fitted corners of a photograph's markers minus the corners of the board's pose, which is
# fitted to them, are (1 - P) (shifts + noise), P being the projection on the changes by a pose. The
# shifts are a Gaussian field of covariance s² exp(-d² / (2 l²)), as
# ``geometry_px`` has it in scenes. Two sums of squares say s and l (the method of
# moments): one of the markers' centres, and one of their corners beside the centres, which turn
# a pose. The farther the field reaches, the smaller is the second one beside the first.
#
# The intervals are the jackknife's by photograph, of logarithms (Efron and Stein, "The jackknife
# estimate of variance", Annals of Statistics 9, 1981).

#: Correlation lengths that are compared, as shares of the frame's width. A pose takes up most of
#: longer ones: their size cannot be said.
LENGTHS = np.geomspace(0.01, 0.4, 24)

#: Cells along each side of a marker in which the field is taken as constant.
CELLS = 6

#: Markers of a photograph from which their shifts are seen beside the pose's.
MIN_SHIFTED_MARKERS = 3


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """Sums of squares of the shifts of one photograph's markers: of centres, and beside these.

    Attributes
    ----------
    squares
        (2,) px², less the expected share of the pixels' noise and of single edges.
    fields
        (2, lengths) the share of a field of standard deviation 1 px, for each of :data:`LENGTHS`.
    """

    squares: Floats
    fields: Floats


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


def _corners(state: MarkerState, noise: Floats) -> _Corners:
    """Return a marker's corners; ``noise`` (2,) has the variances of pixels on black and white."""
    marker = state.marker
    own = state.jacobian[:, :OWN]
    influence = own @ np.linalg.pinv(products(own), hermitian=True)[:, :CORNERS]
    black, white = np.where(np.isfinite(noise), noise, noise[::-1])
    share = np.clip(state.share, 0.0, 1.0)
    variance = np.maximum((1 - share) * black + share * white, 0.0) + QUANTISATION_VARIANCE
    cells = np.clip(state.at * CELLS, 0, CELLS - 1).astype(np.int64)
    number = cells[1] * CELLS + cells[0]
    weights = np.array([
        [np.bincount(number, one * each, minlength=CELLS**2) for each in state.slope]
        for one in influence.T
    ])
    # A cell's point is where its edges are, most of them at a side of the marker.
    edge = (state.slope**2).sum(axis=0) + 1e-12
    mass = np.bincount(number, edge, minlength=CELLS**2)
    rows, columns = np.nonzero(marker.used)
    points = np.array([
        np.bincount(number, edge * each, minlength=CELLS**2) for each in (columns, rows)
    ]) / np.maximum(mass, 1e-12)
    return _Corners(
        influence.T @ (influence * variance[:, None]), points.T + marker.frame_px, weights
    )


def residuals_of(
    states: Sequence[MarkerState], noise: Floats, edges: EdgeField, shifts: Floats,
    explained: Floats, width_px: float,
) -> Residuals | None:
    """Return the residuals of a photograph's n markers; None if they say nothing.

    Parameters
    ----------
    states, noise
        Of the photograph.
    edges
        Shifts of single edges, which move corners as noise does.
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
    moved = weights.reshape(2, size, -1)
    points = np.concatenate([each.points for each in corners])
    distances = ((points[:, None] - points[None]) ** 2).sum(axis=2)

    forms = [part.T @ part for part in parts]

    def sums(covariance: Floats) -> Floats:
        """Return the expected share of a field of shifts in both sums of squares."""
        shifted = sum(each @ covariance @ each.T for each in moved)
        return np.array([float((form * shifted).sum()) for form in forms])

    cell_px = float(np.mean([
        state.marker.modules * state.marker.module_px for state in states
    ])) / CELLS
    added = sums(edges.covariance(distances, cell_px)) + [
        float((form * noises.reshape(size, size)).sum()) for form in forms
    ]
    flat = shifts.ravel()
    return Residuals(
        np.array([flat @ form @ flat for form in forms]) - added,
        np.stack([
            sums(np.exp(-0.5 * distances / length**2)) for length in LENGTHS * width_px
        ], axis=1),
    )


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
    squares = np.array([each.squares for each in residuals])
    fields = np.array([each.fields for each in residuals])

    def matched(rows: Integers) -> Floats:
        return _matched(squares[rows].sum(axis=0), fields[rows].sum(axis=0))

    (size, length) = jackknife(matched, len(residuals))
    added = [np.interp(length.value, np.log(LENGTHS), each.sum(axis=0)) for each in fields]
    return Shifts(
        size.mapped(math.exp), length.mapped(lambda share: math.exp(share) * width_px),
        squares.sum(axis=1) / added,
    )


def _matched(squares: Floats, fields: Floats) -> Floats:
    """Return the logarithms of size in px and length, a share of the width, (2,)."""
    at = np.log(LENGTHS)
    ratio = np.log(fields[1] / fields[0])
    wanted = np.log(max(squares[1], 1e-12) / max(squares[0], 1e-12))
    # The ratio falls with the length.
    length = float(np.interp(-wanted, -ratio, at))
    total = np.interp(length, at, fields.sum(axis=0))
    return np.array([0.5 * math.log(max(float(squares.sum()), 1e-12) / total), length])


# --------------------------------------------------------------------------------------------------
# The terms of a scene: the estimate of each, and whether it is kept.

#: Significant digits of the values that are written.
DIGITS = 4


@dataclass(frozen=True, slots=True)
class Term:
    """One parameter of a scene.

    Attributes
    ----------
    name
        Its name in words.
    parameter
        Its name in pipelines.
    estimate
        Its value with an interval.
    kept
        Whether the scene has it.
    reason
        Why it is kept or left out.
    absent
        The value at which the effect is absent; None of what every scene has.
    of
        Parameter that switches the effect on, if that is another one: they are kept together.
    setting
        The pipeline's value in the place of the estimate's; None for the estimate's.
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
        """The value in a pipeline."""
        return shortened(self.estimate.value) if self.setting is None else self.setting

    def as_json(self) -> dict[str, Any]:
        """Return its names, numbers and decision, for JSON."""
        one = self.estimate
        return {"name": self.name, "parameter": self.parameter, "value": one.value,
                "low": one.low, "high": one.high, "kept": self.kept, "reason": self.reason}

    def left_out(self, reason: str) -> Term:
        """Return it as not kept."""
        return replace(self, kept=False, reason=reason)


def shortened(value: float) -> float:
    """Return a number with as many digits as are written."""
    return float(f"{value:.{DIGITS}g}")


def judged(
    name: str, parameter: str, estimate: Estimate, absent: float, test: Estimate | None = None,
    convert: Callable[[Estimate], Estimate] | None = None,
) -> Term:
    """Return a term that is kept if its interval excludes the value at which it is absent.

    ``test`` is the estimate that decides, if it is another one; ``convert`` takes an estimate to
    the parameter's.
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

#: Markers of a photograph that are fitted: more of them narrow the intervals little, since
#: photographs differ by more than the estimates of one.
MARKERS = 12


#: Effects that are absent unless needed -> their parameter of a photograph's fit.
FITTED = {"sharpening": AMOUNT, "bloom": BLOOM}


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
        Lines for the user beside the terms.
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
    """Return the pixels of photographs that are fitted, and lines on photographs left out.

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
    say: Say = lambda _: None,
) -> SceneFit:
    """Return the scene of a camera from its photographs.

    Parameters
    ----------
    views
        The pixels of markers that are fitted.
    taken, board
        As for :func:`scene_views`.
    without
        Switches of effects that are left out, and why.
    known
        Fits of all effects, of an earlier scene's (:attr:`SceneFit.tested_fits`).
    say
        Gets lines of progress.

    Raises
    ------
    ArgumentError
        If nothing can be fitted, in a line.
    """
    refused = without or {}
    numbers = {each.number for each in views}
    camera = fit_camera(
        views, [number for name, number in FITTED.items() if name in refused],
        [each for each in known if each.number in numbers], say,
    )
    if camera is None:
        raise ArgumentError(
            "folders", "no marker fits",
            "expected markers whose pixels are black and white at their true poses; check the "
            "board, the camera and the poses",
        )
    noises = [photograph_noise(fit.states) for fit in camera.fits]
    module_px = float(np.mean([
        state.marker.module_px for fit in camera.fits for state in fit.states
    ]))
    edges = edge_field(
        [edge_shifts(fit.states, noise) for fit, noise in zip(camera.fits, noises, strict=True)],
        module_px,
    )
    ragged = _edges(edges)
    # The mean profile of edges that are shifted is wider by the variance of their shifts.
    widened = edges.variance.value if ragged[0].kept and "edge_px" not in refused else 0.0
    terms = [
        *_levels(camera), *_optics(camera, widened), *_noise(camera, noises), *ragged,
        *_geometry(camera, noises, edges, taken, board),
    ]
    terms = [
        each.left_out(refused[switch])
        if each.kept and (switch := each.of or each.parameter) in refused else each
        for each in terms
    ]
    return SceneFit(
        tuple(terms), len(camera.fits), sum(len(fit.states) for fit in camera.fits),
        tuple(_lines(camera, terms)), camera.tested_fits,
    )


def _levels(camera: CameraFit) -> list[Term]:
    black, contrast = (
        np.array([np.mean([state.levels[k] for state in fit.states]) for fit in camera.fits])
        for k in range(2)
    )
    grounds = np.array([
        np.median([state.marker.ground for state in fit.states]) for fit in camera.fits
    ])
    return [
        Term("black", "black", estimate(black)),
        Term("white", "white", estimate(black + contrast)),
        Term("around the marker", "background", estimate(grounds)),
    ]


def _optics(camera: CameraFit, widened: float) -> list[Term]:
    """Return blur, sharpening and bloom; ``widened`` px² of the point spread's variance is none."""
    variance, amount, bloom = camera.estimates
    of_variance, of_amount, of_bloom = camera.tested
    return [
        judged("blur", "blur_px", variance, 0.0, of_variance,
               lambda each: each.mapped(lambda square: _root(square - widened))),
        judged("sharpening", "sharpening", amount, 0.0, of_amount),
        judged("bloom (tone)", "bloom", bloom, 0.0, of_bloom),
    ]


def _root(square: float) -> float:
    return math.sqrt(square) if square > 0 else (math.nan if math.isnan(square) else 0.0)


def _noise(camera: CameraFit, noises: Sequence[Floats]) -> list[Term]:
    """Return the noise as a table of two levels."""
    level = [
        estimate(np.array([
            np.mean([state.levels[0] + share * state.levels[1] for state in fit.states])
            for fit in camera.fits
        ])).value for share in (0.0, 1.0)
    ]
    variances = [estimate(each) for each in np.transpose(noises)]
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
    return [
        Term(each.name, "noise_table", deviation, kept, each.reason, 0.0, setting=table)
        for each, deviation in zip(terms, deviations, strict=True)
    ]


def _with_reach(term: Term, length_px: Estimate) -> list[Term]:
    """Return the term of a field of shifts, and the term of its reach, which is kept with it."""
    if term.kept and not term.estimate.value > 0:
        term = term.left_out("smaller than the noise")
    return [term, Term(
        f"reach of {term.name}", term.parameter.replace("_px", "_length_px"), length_px, term.kept,
        "" if term.kept else f"no {term.name}", of=term.parameter,
    )]


def _edges(edges: EdgeField) -> list[Term]:
    term = judged(
        "ragged edges", "edge_px", edges.variance, 0.0, convert=lambda each: each.mapped(_root)
    )
    return _with_reach(term, edges.length_px)


def _geometry(
    camera: CameraFit, noises: Sequence[Floats], edges: EdgeField, taken: PhotographScenes,
    board: Board | None,
) -> list[Term]:
    """Return the print's size beside the file's, and the field of shifts of markers."""
    sources = set(taken.source[taken.shown].tolist())
    unknown = Estimate(math.nan)
    names = ("geometry", "geometry_px"), ("reach of geometry", "geometry_length_px")
    if not sources <= {TruthSource.board_without_this_marker, TruthSource.poses_file}:
        return [
            Term(*name, unknown, False, "only beside a board or exact poses", 0.0)
            for name in (("print's size", "marker_scale"), *names)
        ]
    scales = np.array([np.mean([_scale(state) for state in fit.states]) for fit in camera.fits])
    size = judged("print's size", "marker_scale", estimate(scales), 1.0)
    residuals = []
    for fit, noise in zip(camera.fits, noises, strict=True):
        fixed = TruthSource.poses_file in sources
        compared = _beside_truth(fit) if fixed else _beside_board(
            fit, taken, board, float(scales.mean()))
        if compared is None or not np.isfinite(noise).any():
            continue
        one = residuals_of(fit.states, noise, edges, *compared, float(taken.frame[0]))
        if one is not None:
            residuals.append(one)
    if len(residuals) < MIN_PHOTOGRAPHS:
        return [size, *(
            Term(*name, unknown, False, "too few photographs or markers", 0.0) for name in names
        )]
    shifts = shifts_of(residuals, float(taken.frame[0]))
    squares = estimate(shifts.squares)
    term = judged("geometry", "geometry_px", shifts.size_px, 0.0, squares)
    if term.kept and squares.value < 0:
        term = term.left_out("smaller than the noise")
    return [size, *_with_reach(term, shifts.length_px)]


def _scale(state: MarkerState) -> float:
    """Return the size of a marker over the board's or the file's, by its corners."""
    arms = state.marker.corners_px - state.marker.corners_px.mean(axis=0)
    return 1.0 + float((state.shifts * arms).sum() / (arms**2).sum())


def _beside_truth(fit: PhotographFit) -> tuple[Floats, Floats]:
    """Return the shifts (n, 4, 2) of corners beside poses that are exact."""
    return (
        np.array([state.shifts for state in fit.states]), np.empty((CORNERS * len(fit.states), 0))
    )


def _beside_board(
    fit: PhotographFit, taken: PhotographScenes, board: Board | None, scale: float
) -> tuple[Floats, Floats] | None:
    """Return the shifts (n, 4, 2) of corners beside one pose of the board, fitted to all of them.

    Its markers are ``scale`` times as large. And how the corners change with that pose, (8 n, 6).
    None without such a pose.
    """
    if board is None:
        return None
    scenes = taken.scenes
    rows = [state.marker.row for state in fit.states]
    numbers = [board.marker_ids.index(scenes.marker_id[row]) for row in rows]
    centres = board.corners_m[numbers].mean(axis=1, keepdims=True)
    points = centres + scale * (board.corners_m[numbers] - centres)
    pixels = np.array([
        state.marker.corners_px + state.shifts + state.marker.frame_px for state in fit.states
    ])
    _, (axes, centre) = marker_frame(board.corners_m[numbers[0]])
    rotation = scenes.rotation[rows[0]] @ axes.T
    camera = taken.lens(rows[0])
    pose = fit_pose(
        camera, points.reshape(-1, 3), pixels.reshape(-1, 2), rotation,
        scenes.translation[rows[0]] - rotation @ centre, np.ones(4 * len(points), dtype=bool),
    )
    if pose is None:
        return None
    explained = camera.derivatives(points.reshape(-1, 3), pose.rotation, pose.translation)[1]
    return -pose.residuals.reshape(-1, 4, 2), explained


def _lines(camera: CameraFit, terms: Sequence[Term]) -> list[str]:
    lines = []
    if len(camera.fits) < MIN_PHOTOGRAPHS:
        lines.append(
            f"photographs that could be fitted: {len(camera.fits)}; from {MIN_PHOTOGRAPHS} on "
            "values have intervals, and effects that are not there are left out"
        )
    size = next(each for each in terms if each.parameter == "marker_scale")
    if size.kept and size.estimate.judged:
        low, value, high = (
            100.0 * (each - 1.0)
            for each in (size.estimate.low, size.estimate.value, size.estimate.high)
        )
        lines.append(
            f"markers are larger than their file says by {value:.2f} % [{low:.2f}, {high:.2f}]: "
            "measure the print"
        )
    return lines
