"""A camera's scene from a folder of photographs: its terms with intervals, its check, its file."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import tempfile
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.polynomial.chebyshev import chebvander
from scipy import special
from scipy.linalg import block_diag

from sweep.analysis import simulation_gap
from sweep.analysis.comparisons import GAP_STATISTICS
from sweep.analysis.estimator import TAIL
from sweep.errors import ArgumentError, texts_of
from sweep.execution.runner import execute
from sweep.experiment.document import document_text, read_document
from sweep.experiment.parameters import PHOTOGRAPHS
from sweep.experiment.photographs import SUFFIX, PhotographRecord
from sweep.experiment.pipeline import Pipeline
from sweep.fitting.photograph_fit import (
    CORNERS,
    MARKERS,
    OWN,
    SHARED,
    SQUARE,
    START,
    VARIANCE,
    MarkerState,
    PhotographFit,
    Views,
    fit_photograph,
    photograph_views,
    products,
)
from sweep.measure.flags import TruthSource
from sweep.measure.likelihood import QUANTISATION_VARIANCE
from sweep.measure.solver import marker_frame, of_board
from sweep.measure.surroundings import clear_modules
from sweep.messages import notice, plain
from sweep.model.sensor import displaced
from sweep.photographs import cameras, prepare
from sweep.photographs.prepare import PathName
from sweep.store.files import write_whole
from sweep.store.lifecycle import open_dataset
from sweep.typing import Floats, Integers, Masks

# --------------------------------------------------------------------------------------------------
# Means over photographs, each of which is one draw, and their intervals.

#: Photographs from which intervals are given: with three, Student's are 2.5 standard deviations of
#: a photograph wide on each side, and their spread is known to a factor of 6.
MIN_PHOTOGRAPHS = 4


class Estimate(NamedTuple):
    """A parameter of the camera.

    Attributes
    ----------
    value, low, high
        The mean over the photographs, and the ends of its 95 % interval; NaN with too few.
    """

    value: float = math.nan
    low: float = math.nan
    high: float = math.nan

    def excludes(self, absent: float) -> bool:
        """Return whether the interval excludes a value."""
        return self.high < absent or self.low > absent

    def mapped(self, function: Callable[[float], float]) -> Estimate:
        """Return the estimate of an increasing function of the parameter."""
        return Estimate(*map(function, self))


def estimate(values: Floats) -> Estimate:
    """Return the mean of a parameter's values (n,) in n photographs; the interval is Student's."""
    known = values[np.isfinite(values)]
    count = len(known)
    if not count:
        return Estimate()
    mean = float(known.mean())
    if count < MIN_PHOTOGRAPHS:
        return Estimate(mean)
    half = float(special.stdtrit(count - 1, 1 - TAIL) * known.std(ddof=1) / math.sqrt(count))
    return Estimate(mean, mean - half, mean + half)


# --------------------------------------------------------------------------------------------------
# A Gaussian field of shifts, of covariance s² exp(-d² / (2 l²)), as ``edge_px`` and ``geometry_px``
# in scenes.
#
# Two sums of a photograph's squares or products of shifts say s and l (the method of moments). The
# farther the field reaches, the larger is the second one beside the first. Estimates of s and l
# from few photographs are skew, but what each photograph's sums exceed their expectations by has
# the mean 0 at the true s and l: the intervals hold those values for which Hotelling's statistic
# of these means does not exclude 0, whatever the other one (Hansen, Heaton and Yaron,
# "Finite-sample properties of some alternative GMM estimators", 1996). They have no end where pose
# or noise hide the field.

#: Variances that are compared, over one that is about as large as the sums say.
VARIANCES = np.geomspace(1e-3, 1e3, 700)


class Field(NamedTuple):
    """A field of shifts: standard deviation, correlation length, and whether there is one.

    ``variance`` (px²) is the mean of unbiased estimates by each photograph: it may be below 0.
    """

    size_px: Estimate = Estimate()
    length_px: Estimate = Estimate()
    variance: Estimate = Estimate()


def field_of(known: Sequence[tuple[Floats, Floats]], lengths_px: Floats) -> Field:
    """Return the field that photographs' two sums of squares show; nothing without photographs.

    Parameters
    ----------
    known
        Of each photograph the sums (2,), px², and those (2, L) expected of fields of standard
        deviation 1 px and of L correlation lengths; the second over the first one rises with the
        length.
    lengths_px
        (L,) these lengths.
    """
    if not known:
        return Field()
    sums, shares = map(np.array, zip(*known, strict=True))
    at, found, expected = np.log(lengths_px), sums.sum(axis=0), shares.sum(axis=0)
    rising = np.maximum.accumulate(expected[1] / expected[0])
    length = float(np.interp(found[1] / max(found[0], 1e-12), rising, at))
    total = np.array([np.interp(length, at, each.sum(axis=0)) for each in shares])
    size, ends = math.sqrt(max(float(found.sum() / total.sum()), 0.0)), [(math.nan, math.nan)] * 2
    if len(sums) >= MIN_PHOTOGRAPHS:
        variances = VARIANCES * abs(sums).sum() / total.sum()
        misfit = _misfit(sums, shares, variances)
        limit = float(special.stdtrit(len(sums) - 2, 1 - TAIL)) ** 2
        ends = [_ends(np.sqrt(variances), misfit.min(axis=1) <= limit),
                _ends(lengths_px, misfit.min(axis=0) <= limit)]
    # The sums of all photographs, in which the largest weigh most, may lead beyond an interval.
    held = [Estimate(float(np.fmin(np.fmax(value, low), high)), low, high)
            for value, (low, high) in zip((size, math.exp(length)), ends, strict=True)]
    return Field(held[0], held[1], estimate(sums.sum(axis=1) / total.mean()))


def _misfit(sums: Floats, shares: Floats, variances: Floats) -> Floats:
    """Return Hotelling's statistic (V, L) of what the sums (n, 2) exceed their expectations by.

    Those are the shares (n, 2, L) of L correlation lengths times each of the variances (V,).
    """
    count, v = len(sums), variances[:, None, None, None]
    a, x = sums - sums.mean(axis=0), shares - shares.mean(axis=0)
    cross = np.einsum("ni,njl->lij", a, x)
    scatter = a.T @ a - v * (cross + cross.swapaxes(1, 2)) + v**2 * np.einsum("nil,njl->lij", x, x)
    excess = (sums.mean(axis=0) - v[..., 0] * shares.mean(axis=0).T)[..., None]
    # Photographs that do not differ, such as copies of one, limit nothing: no inverse, but 0.
    solved = np.linalg.pinv(scatter / (count * (count - 1)), hermitian=True) @ excess
    return np.asarray((excess * solved).sum(axis=(2, 3)))


def _ends(values: Floats, inside: Masks) -> tuple[float, float]:
    """Return the nearest of rising values around those that are inside, 0 and infinity beyond.

    NaN where none is: no field of these lengths has such sums.
    """
    around, at = np.array([0.0, *values, math.inf]), np.flatnonzero(inside)
    return (float(around[at[0]]), float(around[at[-1] + 2])) if len(at) else (math.nan, math.nan)


# --------------------------------------------------------------------------------------------------
# Shifts of single edges beside the marker's corners, from the residuals of pixels near edges.
#
# A module's edge that is shifted by d along the unit vector n leaves the residuals d (n · slope).
# Edges of both polarities that are shifted alike are a field of shifts. The shifts of a marker's
# edges are (1 - P) (field's means along modules + noise), P being the projection on the changes by
# the marker's own parameters, which took up much of what is smooth, and by its own bloom, which
# moves all edges towards white. Squares, and products of nearest parallel edges, say how far the
# field reaches: about a module. The nearest ones are the next ones on a line of modules, and those
# beside them on the next lines. A print whose lines lie at whole pixels of a printer or a screen
# moves the former alike and the latter apart, a field moves both alike.

#: Half widths across and along the edge of the pixels that say where a module's edge is.
REACH_MODULES, ALONG_MODULES = 0.5, 0.4

#: Share of the whole step from black to white from which pixels count as an edge.
STEP_SHARE = 0.6

#: Correlation lengths that are compared, in modules.
EDGE_LENGTHS = np.geomspace(0.25, 3.0, 60)

#: Lines of modules between edges of both directions, which are taken for independent.
FAR = 1000


def edge_field(fits: Sequence[PhotographFit]) -> Field:
    """Return the field of shifts of edges in photographs."""
    known = [edge_sums(fit) for fit in fits if np.isfinite(fit.noise).any()]
    return field_of([each for each in known if each[1].any()], EDGE_LENGTHS * module_px(fits))


def module_px(fits: Sequence[PhotographFit]) -> float:
    """Return the mean length of a module in photographs."""
    return float(np.mean([state.marker.module_px for fit in fits for state in fit.states]))


def edge_sums(fit: PhotographFit) -> tuple[Floats, Floats]:
    """Return sums (2,) of a photograph's edges' shifts, px², and the shares (2, L) of fields.

    Of their squares, and of the products of nearest parallel edges; the expected share of the
    pixels' noise is taken off.
    """
    variance = float(np.nanmean(fit.noise)) + QUANTISATION_VARIANCE
    sums, shares = np.zeros(2), np.zeros((2, len(EDGE_LENGTHS)))
    for state in fit.states:
        shifts, information, line, module, normal, own = map(
            np.concatenate, zip(_edges_along(state, 0), _edges_along(state, 1), strict=True)
        )
        if len(shifts) <= OWN + 1:
            continue
        weighted = own.T * information
        left = np.eye(len(own)) - own @ np.linalg.pinv(weighted @ own, hermitian=True) @ weighted
        alike = normal @ normal.T
        across, along = (np.abs(np.subtract.outer(each, each)) for each in (line, module))
        nearest = 0.5 * alike * (across + along == 1)
        correlations = [_along_modules(across, along, each) for each in EDGE_LENGTHS]
        for k, form in enumerate((left.T @ left, left.T @ nearest @ left)):
            sums[k] += shifts @ form @ shifts - (np.diag(form) * variance / information).sum()
            shares[k] += [(form * alike * each).sum() for each in correlations]
    return sums, shares


def _along_modules(across: Floats, along: Floats, length: float) -> Floats:
    """Return the correlation of means along modules' edges, at distances (n, n) in modules.

    Means are, nearly, the field smoothed by a Gaussian of their variance.
    """
    wide = length**2 + 2 * (2 * ALONG_MODULES) ** 2 / 12
    exponent = across**2 / length**2 + along**2 / wide
    return np.asarray(length / math.sqrt(wide) * np.exp(-0.5 * exponent))


def _edges_along(state: MarkerState, axis: int) -> tuple[Any, ...]:
    """Return the edges on lines of constant column (``axis`` 0) or row.

    Their shifts (n,) towards white in px, and the information of these; the numbers of line and
    module, of rows beyond those of columns; the directions (n, 2) towards white; and what the
    marker's own parameters, and its own bloom, change of the shifts (n, 11).
    """
    marker = state.marker
    across, along = marker.modules * marker.at[axis], marker.modules * marker.at[1 - axis]
    line, module = np.rint(across), np.floor(along)
    near = (
        (np.abs(across - line) < REACH_MODULES) & (np.abs(along - module - 0.5) < ALONG_MODULES)
        & (line >= 0) & (line <= marker.modules) & (module >= 0) & (module < marker.modules)
    )
    number = (line * marker.modules + module)[near].astype(np.int64)
    slope, residuals = state.slope[:, near], state.residuals[near]
    total = partial(np.bincount, number, minlength=(marker.modules + 1) * marker.modules)
    steps = np.stack([total(each) for each in slope])
    length = np.hypot(*steps)
    normal = steps / np.maximum(length, 1e-12)
    by_shift = (normal[:, number] * slope).sum(axis=0)
    whole = abs(state.levels[1]) * 2 * ALONG_MODULES * marker.module_px
    edge = np.flatnonzero(length > STEP_SHARE * whole)
    information = total(by_shift**2)[edge]
    shifts, *own = (
        total(by_shift * each)[edge] / information
        for each in (residuals, *state.jacobian[near, :OWN].T)
    )
    line, module = np.divmod(edge, marker.modules)
    return (
        shifts, information, line + FAR * axis, module, normal[:, edge].T,
        np.column_stack([*own, np.ones(len(edge))]),
    )


# --------------------------------------------------------------------------------------------------
# Shifts of markers beside the camera's model: how large they are, and how far they reach.
#
# The fitted corners of a photograph's markers minus the corners of the board's pose, which is
# fitted to them, are (1 - P) (shifts + noise), P being the projection on the changes by a pose and
# by the print's size. The two sums of squares are those of their corners beside the centres, which
# turn a pose, and of the markers' centres.

#: Correlation lengths that are compared, from so many modules to a share of the frame's width.
#: A pose takes up most of longer ones: their size cannot be said.
SHORTEST_MODULES, LONGEST_SHARE = 1.5, 0.4

#: Chebyshev's nodes along each side of a marker, at which fields of such lengths say all others.
NODES = 6

#: Markers of a photograph from which their shifts are seen beside the pose's.
MIN_SHIFTED_MARKERS = 3


def geometry_field(fits: Sequence[PhotographFit], edges: Field) -> Field:
    """Return the field of shifts of markers; nothing with too few photographs that say it.

    ``edges`` are shifts of single edges, which move corners as noise does.
    """
    lengths = np.geomspace(
        SHORTEST_MODULES * module_px(fits), LONGEST_SHARE * fits[0].states[0].marker.shown.width_px,
        60)
    known = [
        _geometry_sums(fit, edges, shifts, np.hstack([pose, free[:, :1]]), lengths) for fit in fits
        if len(fit.states) >= MIN_SHIFTED_MARKERS and np.isfinite(fit.noise).any()
        for shifts, pose, free in _beside_truth(fit.states)
    ]
    return field_of(known if len(known) >= MIN_PHOTOGRAPHS else [], lengths)


def _beside_truth(states: Sequence[MarkerState]) -> list[tuple[Floats, Floats, Floats]]:
    """Return the shifts (8 n,) of a photograph's corners beside the truth, and how they change.

    A list of one, or of none.
    By one pose of the board (8 n, 6), which is fitted to all corners, and which a file's exact
    poses do not have (8 n, 0); then by the print's size, and by the camera's numbers that are
    themselves estimates, those with standard deviations (8 n, 1 + c). Nothing without such a pose.
    """
    places = [state.marker.shown for state in states]
    first, shifts = places[0], np.concatenate([state.shifts for state in states])
    quads = np.array([state.marker.corners_px for state in states])
    size = (quads - quads.mean(axis=1, keepdims=True)).reshape(-1, 1)
    if first.source == TruthSource.poses_file:
        by_camera = np.vstack([each.projected(SQUARE)[2] for each in places])
        free = np.hstack([size, by_camera[:, :len(first.camera.sd)]])
        return [(shifts.ravel(), size[:, :0], free)]
    on_board = [each.on_board for each in places if each.on_board]
    corners = np.array([each.board.corners_m[each.number] for each in on_board])
    if len(corners) < MIN_SHIFTED_MARKERS:
        return []
    frames_px = np.array([[state.marker.frame_px] for state in states])
    pixels, points = (quads + frames_px).reshape(-1, 2) + shifts, corners.reshape(-1, 3)
    start = of_board(first.rotation, first.translation, marker_frame(corners[0])[1])
    pose = cameras.fit_pose(first.camera, points, pixels, *start, np.ones(len(points), dtype=bool))
    if pose is None:
        return []
    _, by_pose, by_camera = cameras.derivatives(first.camera, points, *pose[:2])
    free = np.hstack([size, by_camera[:, :len(first.camera.sd)]])
    return [(-pose.residuals.ravel(), by_pose, free)]


def print_size(fits: Sequence[PhotographFit]) -> Estimate:
    """Return the size of markers over the board's or the file's, by their fitted corners.

    By least squares of all photographs, beside a pose of each and, where the camera has standard
    deviations, beside its numbers; nothing with too few photographs. The corners that a detector
    finds are biased by blur, and so is the truth that they give of boards without a chessboard:
    it is not used. The interval is the jackknife's, by photograph (Efron and Stein, "The jackknife
    estimate of variance", 1981): the camera's error is in it.
    """
    # What is left of each photograph beside its pose, in as few rows as columns.
    known = [
        np.linalg.qr(np.column_stack([pose, free, shifts])).R[pose.shape[1]:, pose.shape[1]:]
        for fit in fits for shifts, pose, free in _beside_truth(fit.states)
    ]
    if len(known) < MIN_PHOTOGRAPHS:
        return Estimate()

    def size_by(photographs: Sequence[Floats]) -> float:
        rows = np.concatenate(photographs)
        return float(np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=None)[0][0])

    without = np.array([size_by(known[:k] + known[k + 1:]) for k in range(len(known))])
    return estimate(1.0 + size_by(known) + (len(known) - 1) * (without.mean() - without))


def _geometry_sums(
    fit: PhotographFit, edges: Field, shifts: Floats, explained: Floats, lengths_px: Floats
) -> tuple[Floats, Floats]:
    """Return a photograph's sums (2,) of squares, and the shares (2, L) of fields in them.

    The expected shares of the pixels' noise and of single edges are taken off. ``shifts`` (8 n,)
    and ``explained`` (8 n, k) are the corners' (:func:`_beside_truth`).
    """
    count, size = len(fit.states), CORNERS * len(fit.states)
    q, _ = np.linalg.qr(explained)
    residual = np.eye(size) - q @ q.T
    centres = np.kron(np.eye(count), np.tile(np.eye(2), 4) / 2)
    parts = (residual - centres.T @ centres @ residual, centres @ residual)
    variance = float(np.nanmean(fit.noise)) + QUANTISATION_VARIANCE
    own, points, *moved = zip(*(_corners(state, variance, edges) for state in fit.states),
                              strict=True)
    every = np.concatenate(points)
    squares = ((every[:, None] - every[None]) ** 2).sum(axis=2)
    covariance, right, down = (block_diag(*each) for each in (own, *moved))
    sums, shares = [], []
    for form in (part.T @ part for part in parts):
        at_nodes = right.T @ form @ right + down.T @ form @ down
        sums.append(shifts @ form @ shifts - (form * covariance).sum())
        shares.append([(at_nodes * np.exp(-0.5 * squares / each**2)).sum() for each in lengths_px])
    return np.array(sums), np.array(shares)


def _corners(state: MarkerState, variance: float, edges: Field) -> tuple[Floats, ...]:
    """Return how a marker's fitted corners follow from its pixels.

    Their covariance (8, 8), x and y in turn, by the pixels' ``variance`` and by the shifts of
    single edges, px², which do not reach from marker to marker. Nodes (n, 2) in px of the frame,
    and what a smooth field's shifts right and down there add, each (8, n).
    """
    marker, own = state.marker, state.jacobian[:, :OWN]
    influence = own @ np.linalg.pinv(products(own), hermitian=True)[:, :CORNERS]
    covariance = variance * products(influence)
    by_pixel = influence.T * state.slope[:, None]
    if edges.variance.value > 0:
        # Pixel by pixel: points of a module, or means over its area, would be too coarse.
        images = np.zeros((2, CORNERS, *marker.used.shape))
        images[..., marker.used] = by_pixel
        along_y, along_x = (
            np.exp(-0.5 * np.subtract.outer(each, each) ** 2 / edges.length_px.value**2)
            for each in map(np.arange, marker.used.shape)
        )
        covariance += edges.size_px.value**2 * np.einsum(
            "kayx,kbyx->ab", images, along_y @ images @ along_x)
    # Lagrange's polynomials at Chebyshev's nodes, by those of Chebyshev.
    reach, unit = np.abs(marker.at - 0.5).max(), np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES)
    polynomials = np.linalg.inv(chebvander(unit, NODES - 1))
    columns, rows = (
        chebvander((each - 0.5) / reach, NODES - 1) @ polynomials for each in marker.at
    )
    at_nodes = (columns[:, :, None] * rows[:, None, :]).reshape(-1, NODES**2)
    nodes = np.stack(np.meshgrid(unit, unit, indexing="ij"), axis=-1).reshape(-1, 2)
    return covariance, marker.shown.projected(0.5 + reach * nodes)[0], *(by_pixel @ at_nodes)


# --------------------------------------------------------------------------------------------------
# The terms of a scene: the estimate of each, and whether it is kept.

#: Significant digits of the values that are written.
DIGITS = 4

#: Why an effect is left out after the check on photographs that were not fitted.
NOT_NEEDED = "errors are clearly nearer to those of photographs that were not fitted without it"


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
    setting
        The pipeline's value in the place of the estimate's; None for the estimate's.
    """

    name: str
    parameter: str
    estimate: Estimate
    kept: bool = True
    reason: str = ""
    setting: Any = None

    @property
    def value(self) -> Any:
        """The value in a pipeline."""
        return shortened(self.estimate.value) if self.setting is None else self.setting

    def as_json(self) -> dict[str, Any]:
        """Return its names, numbers and decision, for JSON."""
        return {"name": self.name, "parameter": self.parameter, **self.estimate._asdict(),
                "kept": self.kept, "reason": self.reason}


def shortened(value: float) -> float:
    """Return a number with as many digits as are written."""
    return float(f"{value:.{DIGITS}g}")


def judged(
    refused: Collection[str], name: str, parameter: str, found: Estimate,
    test: Estimate | None = None, absent: float = 0.0, unknown: str = "no pixels that say it",
) -> Term:
    """Return a term that is kept if its interval excludes the value at which it is absent.

    Parameters
    ----------
    refused
        Parameters that are left out whatever their intervals.
    name, parameter, found
        The term's.
    test
        The estimate that decides, if it is another one.
    absent
        The value at which there is no effect.
    unknown
        Why there is no estimate, if there is none.
    """
    deciding = found if test is None else test
    if not math.isfinite(deciding.value):
        return Term(name, parameter, found, False, unknown)
    kept, reason = found.value != absent, "too few photographs to judge"
    if math.isfinite(deciding.low):
        kept = deciding.excludes(absent)
        reason = f"95 % interval {'excludes' if kept else 'includes'} {absent:g}"
    if kept and parameter in refused:
        kept, reason = False, NOT_NEEDED
    return Term(name, parameter, found, kept, reason)


class SceneFit(NamedTuple):
    """A camera's scene.

    Attributes
    ----------
    terms
        Every parameter with its interval, kept or left out.
    photographs, markers
        How many of them were fitted.
    views, tested_fits
        The pixels that were fitted, as if evenly spaced, and the fits with all effects, by the
        photograph's number.
    """

    terms: tuple[Term, ...]
    photographs: int
    markers: int
    views: Views
    tested_fits: Mapping[int, PhotographFit]

    @property
    def scene(self) -> dict[str, Any]:
        """Parameters of the section [scene] with the terms that are kept."""
        return {each.parameter: each.value for each in self.terms if each.kept}


# --------------------------------------------------------------------------------------------------
# Pixels that are not evenly spaced: the camera took each from a larger image.

#: Pixels of the larger image for one of the frame that are tried.
DECIMATIONS = sorted({p / q for q in range(2, 6) for p in range(q + 1, 2 * q)})


def decimation_of(fits: Sequence[PhotographFit]) -> Term:
    """Return the term of the spacing of pixels that leaves the least squares of residuals.

    A spacing that is not the photographs' adds as much as it would explain.
    """
    states = [state for fit in fits for state in fit.states]
    squares = {
        each: sum(((one.residuals - _displacing(one, each)) ** 2).sum() for one in states)
        for each in (1.0, *DECIMATIONS)
    }
    best = min(squares, key=lambda each: squares[each])
    reason = "pixels are taken from a larger image: photograph in the camera's own resolution"
    return Term("spacing of pixels", "decimation", Estimate(best), best != 1.0,
                reason if best != 1.0 else "pixels are evenly spaced")


def _displacing(state: MarkerState, decimation: float) -> Floats:
    """Return by how much the levels (n,) differ from evenly spaced pixels', to first order."""
    places = np.argwhere(state.marker.used).T[::-1] + state.marker.frame_px[:, None]
    return np.asarray(-(displaced(places, decimation) * state.slope).sum(axis=0))


# --------------------------------------------------------------------------------------------------
# A camera's scene from photographs of known markers: every term with its interval.

def fit_scene(
    views: Views, refused: Collection[str] = (), known: SceneFit | None = None
) -> SceneFit:
    """Return the scene of a camera from its photographs.

    Parameters
    ----------
    views
        The pixels of markers that are fitted.
    refused
        Switches of effects that are left out, for errors are nearer without them.
    known
        An earlier scene of these views and others, whose fits of all effects are taken.

    Raises
    ------
    ArgumentError
        If nothing can be fitted, in a line.
    """
    all_moved = np.ones(len(START), dtype=bool)
    every = _fitted(views, all_moved, START) if known is None else known.tested_fits
    decimation = decimation_of(list(every.values())) if known is None else known.terms[0]
    if known is None and decimation.kept:
        views = {number: [
            each.marker._replace(levels=each.marker.levels - _displacing(each, decimation.value))
            for each in fit.states
        ] for number, fit in every.items()}
        every = _fitted(views, all_moved, START)
    tested_fits = {number: fit for number, fit in every.items() if number in views}
    if not tested_fits:
        raise ArgumentError(
            "folders", "no marker fits",
            "expected markers whose pixels are black and white at their true poses; check the "
            "board, the camera and the poses",
        )
    tested = _optics(tested_fits)
    kept = np.array([each.excludes(0.0) or not math.isfinite(each.low) for each in tested])
    kept &= [name not in refused for name in SHARED]
    start = START.copy()
    if not (kept[VARIANCE] and tested[VARIANCE].value > 0):
        kept[VARIANCE], start[VARIANCE] = False, 0.0
    found = tested_fits if kept.all() else _fitted(views, kept, start)
    # Of effects that are not kept, the estimates with all effects are shown.
    optics = [
        each if keep else test
        for each, keep, test in zip(_optics(found), kept, tested, strict=True)
    ]
    fits = list(found.values())
    terms = _terms(fits, optics, tested, refused, decimation)
    return SceneFit(
        tuple(terms), len(fits), sum(len(fit.states) for fit in fits), views, tested_fits)


def _fitted(views: Views, moved: Masks, start: Floats) -> dict[int, PhotographFit]:
    """Return the fits of photographs by number, of those in which a marker can be fitted."""
    fits = {}
    for count, (number, markers) in enumerate(views.items()):
        if count % 5 == 0:  # a line of progress for each five
            notice(f"fitting photograph {count + 1} of {len(views)}")
        if (fit := fit_photograph(markers, moved, start)) is not None:
            fits[number] = fit
    return fits


def _optics(fits: Mapping[int, PhotographFit]) -> list[Estimate]:
    """Return variance, amount and bloom."""
    return [estimate(each) for each in np.transpose([fit.parameters for fit in fits.values()])]


def _terms(
    fits: Sequence[PhotographFit], optics: Sequence[Estimate], tested: Sequence[Estimate],
    refused: Collection[str], decimation: Term,
) -> list[Term]:
    """Return the terms of fitted photographs, ``decimation`` first.

    ``optics`` and ``tested`` are variance, amount and bloom as found, and as they are judged.
    """
    def with_reach(name: str, parameter: str, field: Field, unknown: str) -> list[Term]:
        """Return the term of a field of shifts, and the term of its reach, kept with it."""
        term = judge(name, parameter, field.size_px, field.variance, unknown=unknown)
        if term.kept and not field.variance.value > 0:
            term = replace(term, kept=False, reason="smaller than the noise")
        return [term, Term(
            f"reach of {name}", parameter.replace("_px", "_length_px"), field.length_px, term.kept,
            "" if term.kept else f"no {name}",
        )]

    judge = partial(judged, refused)
    black, white = (estimate(each) for each in np.transpose([fit.levels for fit in fits]))
    grounds = [np.median([state.marker.ground for state in fit.states]) for fit in fits]
    variances = [estimate(each) for each in np.transpose([fit.noise for fit in fits])]
    deviations = [each.mapped(lambda square: math.sqrt(max(square, 0.0))) for each in variances]
    noise = [
        judge(f"noise on {colour}", "noise_table", deviation, variance)
        for colour, deviation, variance in zip(("black", "white"), deviations, variances,
                                               strict=True)
    ]
    noisy = any(each.kept and each.estimate.value > 0 for each in noise)
    table = [
        shortened(number)
        for level, each in sorted(zip((black.value, white.value), deviations, strict=True))
        if math.isfinite(each.value) for number in (level, each.value)
    ]
    edges = edge_field(fits)
    ragged = with_reach("ragged edges", "edge_px", edges, "no pixels that say it")
    # The mean profile of edges that are shifted is wider by the variance of their shifts, and of
    # displaced pixels, which were evened to first order, by theirs: 60 are whole periods of all.
    widened = edges.size_px.value**2 if ragged[0].kept else 0.0
    widened += float(displaced(np.arange(60), decimation.estimate.value).var())
    variance, amount, bloom = zip(optics, tested, strict=True)
    blur = variance[0].mapped(lambda square: math.sqrt(max(square - widened, 0.0)))
    unknown = "expected 4 photographs with 3 markers of a board, or exact poses"
    # Noise is measured behind the compression, which at edges adds about what it takes from noise
    # in flat areas.
    quality = estimate(np.array([fit.states[0].marker.shown.jpeg_quality for fit in fits]))
    jpeg = judge("JPEG", "jpeg_quality", quality, unknown="no JPEG files with OpenCV's tables")
    return [
        decimation,
        Term("black", "black", black), Term("white", "white", white),
        Term("around the marker", "background", estimate(np.array(grounds))),
        judge("blur", "blur_px", blur, variance[1]),
        judge("sharpening", "sharpening", *amount), judge("bloom (tone)", "bloom", *bloom),
        *(replace(each, kept=noisy, setting=table) for each in noise), *ragged,
        judge("print's size", "marker_scale", print_size(fits), absent=1.0, unknown=unknown),
        *with_reach("geometry", "geometry_px", geometry_field(fits, edges), unknown),
        replace(jpeg, setting=round(np.nan_to_num(quality.value))),
    ]


# --------------------------------------------------------------------------------------------------
# A fitted scene against photographs that were not used to fit it.
#
# The markers of the held-out photographs are simulated at their poses with the scene that the
# others gave, and with each of its effects left out in turn. The pixels of the fitted photographs
# show each effect, so one is left out only where the gap between the errors of photographs and
# simulation is clearly narrower without it, and without all such effects together.

#: Held-out photographs from which errors have intervals.
MIN_HELD_OUT = 5

#: Simulations of each photograph, with all its markers. With one, the simulation's own random
#: errors decide whether an effect narrows the gap.
REPEATS = 2

#: Half-widths of the intervals by which the mean gap is narrower without an effect that is left
#: out: a standard deviation of the photographs' own random errors. Of rendered photographs, gaps
#: were narrower by 0.11 and 0.15 without a sharpening and a bloom with which they had been
#: rendered.
CLEARLY = 0.5

#: Effects that are kept where the errors of photographs that were not fitted say so.
SWITCHES = ("sharpening", "bloom", "geometry_px", "edge_px", "marker_scale", "jpeg_quality")


def gap_size(gap: xr.Dataset, widths: xr.Dataset) -> float:
    """Return the mean size of all statistics' gaps, in half-widths of the intervals of ``widths``.

    Of ratios the logarithms count. NaN if nothing has an interval.
    """
    sizes = []
    for each in GAP_STATISTICS:
        value, low, high = (
            np.asarray(source[f"{each.name}_gap{end}"].values, dtype=np.float64)
            for source, end in ((gap, ""), (widths, "_low"), (widths, "_high"))
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            if each.ratio:
                value, low, high = np.log(value), np.log(low), np.log(high)
            sizes.append((np.abs(value) / (0.5 * (high - low))).ravel())
    return estimate(np.concatenate(sizes)).value


def needed(whole: xr.Dataset, without: Mapping[str, xr.Dataset]) -> dict[str, bool]:
    """Return which effects the gap is not clearly narrower without.

    ``whole`` is the gap with the whole scene, ``without`` that without each effect.
    """
    least = gap_size(whole, whole) - CLEARLY
    return {switch: gap_size(gap, whole) > least for switch, gap in without.items()}


def held_out(pipeline: Pipeline, numbers: Integers, folder: Path) -> Pipeline:
    """Return the pipeline of some of the photographs, by number; their record goes to a folder."""
    record, name = prepare.record_of(pipeline), "held-out"
    chosen = dataclasses.replace(
        record, **{
            each: getattr(record, each)[numbers]
            for each in ("rotation", "translation", "std", "source")
        },
        paths=tuple(str((Path(pipeline.folder) / record.paths[k]).resolve()) for k in numbers),
        digests=tuple(record.digests[k] for k in numbers),
    )
    write_whole(folder / f"{name}{SUFFIX}", chosen.content())
    document = read_document(pipeline.to_toml())
    document["scene"][PHOTOGRAPHS] = f"{name}{SUFFIX}"
    document["axes"]["trial"] = len(numbers)
    return Pipeline.from_dict(document, name=name, source="held out", folder=folder)


def checked(found: SceneFit, pipeline: Pipeline, home: Path) -> tuple[SceneFit, xr.Dataset]:
    """Return the scene with what moves errors of held-out photographs, and the gap that is left.

    Every other photograph is held out, and the scene of the others simulated; stores go to
    ``home``.
    """
    views, numbers = found.views, list(found.views)
    others, held = {number: views[number] for number in numbers[::2]}, np.array(numbers[1::2])
    notice(f"measuring {len(held)} photographs that the scene of the others is compared with")
    photographs = held_out(pipeline, held, home)

    def measured(experiment: Pipeline, name: str) -> xr.Dataset:
        store = str(home / f"{name.replace(' ', '-')}.zarr")
        execute(experiment, store, overwrite=True)
        return open_dataset(store)

    def gap_with(scene: Mapping[str, Any], name: str) -> xr.Dataset:
        notice(f"simulating them with {name}")
        twins = prepare.twin_pipeline(photographs, scene, REPEATS)
        return simulation_gap(results, measured(twins, name)).load()

    results = measured(photographs, photographs.name)
    half = fit_scene(others, known=found).scene
    gap = gap_with(half, "the whole scene")
    kept = needed(gap, {
        switch: gap_with(fit_scene(others, [switch], found).scene, f"all but {switch}")
        for switch in SWITCHES if switch in half
    })
    refused = [switch for switch, keep in kept.items() if not keep]
    if refused:
        rest = gap_with(fit_scene(others, refused, found).scene, "what is kept")
        if gap_size(rest, gap) <= gap_size(gap, gap):
            return fit_scene(views, refused, found), rest
    return found, gap


# --------------------------------------------------------------------------------------------------
# The file of a fitted scene: a whole pipeline of the camera, as TOML with its intervals.

CAMERA = ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px", "distortion")


def scene_document(pipeline: Pipeline, views: Views, found: SceneFit) -> dict[str, Any]:
    """Return a pipeline of the fitted camera, with poses as in the photographs."""
    record, fixed = prepare.record_of(pipeline), pipeline.fixed
    first = next(iter(views.values()))[0].shown
    marker = {
        "dictionary": first.marker.dictionary, "marker_id": first.marker.marker_ids[0],
        "size_m": first.size_m,
    }
    on_board = [each for each in record.on_board(record.marker_id) if each is not None]
    if on_board:
        marker["quiet_zone_modules"] = shortened(min(10.0, *map(clear_modules, on_board)))
    rotation, translation = record.rotation[record.shown], record.translation[record.shown]
    tilt = np.degrees(np.arccos(np.clip(-rotation[:, 2, 2], -1, 1)))
    # Not all of the photographs' bearings, lest markers be cut by the frame.
    bearing = np.degrees(np.arctan(0.8 * translation[:, :2] / translation[:, 2:]))
    turned = {"uniform": [0.0, 360.0]}
    pose = {
        "distance_m": _between(translation[:, 2]), "tilt_deg": _between(tilt),
        "azimuth_deg": turned, "roll_deg": turned,
        "bearing_x_deg": _between(bearing[:, 0]), "bearing_y_deg": _between(bearing[:, 1]),
    }
    return {
        "title": f"The camera of {plain(pipeline.name)}",
        "camera": {name: fixed[name] for name in CAMERA},
        "marker": marker,
        "pose": pose,
        "scene": found.scene,
        "axes": {"trial": 200, "cornerRefinementMethod": ["none", "subpix"]},
    }


def _between(values: Floats) -> Any:
    """Return a uniform distribution between the quantiles 5 and 95 %."""
    low, high = (shortened(each) for each in np.quantile(values, [0.05, 0.95]).tolist())
    return {"uniform": [low, high]} if low < high else low


def scene_text(
    document: dict[str, Any], found: SceneFit, record: PhotographRecord, name: str,
    lines: Sequence[str] = (),
) -> str:
    """Return the content of the file: its source, the terms, and the pipeline."""
    digest = hashlib.sha256("".join(record.digests).encode()).hexdigest()
    head = [
        f"Fitted to {found.markers} markers in {found.photographs} photographs ({plain(name)}),",
        f"SHA-256 of their digests {digest[:16]}. Value, 95 % interval by photograph:",
        *(f"  {each.parameter}: {in_words(each.estimate)}" for each in found.terms if each.kept),
        *(f"  left out: {each.name}: {each.reason}" for each in found.terms if not each.kept),
        *lines,
    ]
    return "".join(f"# {plain(line, 200)}\n" for line in head) + "\n" + document_text(document)


def in_words(one: Estimate) -> str:
    """Return an estimate as a text."""
    if not math.isfinite(one.value):
        return "not known"
    interval = f" [{one.low:.4g}, {one.high:.4g}]" if math.isfinite(one.low) else ""
    return f"{one.value:.4g}{interval}"


# --------------------------------------------------------------------------------------------------
# From a folder of photographs to a fitted scene and its file.

#: Detector settings that the check compares unless others are given.
COMPARED = 'cornerRefinementMethod=["none", "subpix"]'


class FittedScene(NamedTuple):
    """A camera's scene from photographs.

    Attributes
    ----------
    found
        Its terms.
    pipeline
        A pipeline of this camera, with poses as in the photographs.
    text
        The pipeline's file, with intervals and left-out terms in its comments.
    lines
        Lines on the photographs for the user.
    gap
        Half of the photographs beside a simulation with the scene that the others gave
        (:func:`sweep.analysis.simulation_gap`); None without a check.
    """

    found: SceneFit
    pipeline: Pipeline
    text: str
    lines: tuple[str, ...]
    gap: xr.Dataset | None


def fit(
    *folders: PathName, camera: PathName | None = None, board: PathName | None = None,
    poses: PathName | None = None, stereo: PathName | None = None, settings: Sequence[str] = (),
    markers: int = MARKERS, check: bool = True,
) -> FittedScene:
    """Estimate a camera's scene: blur, sharpening, tone, noise, geometry, and the print's size.

    Parameters
    ----------
    folders, camera, board, poses, stereo
        As for `sweep.photos`; of a stereo camera the left one's scene is fitted.
    settings
        "key=value" for the dictionary and size_m of single markers, and for the detectors and
        estimators whose errors are compared.
    markers
        The most markers of a photograph that are fitted, well spread over the frame.
    check
        Whether half of the photographs are held out: effects without which simulated errors come
        clearly nearer to theirs are left out, and the gap that is left is in ``gap``.

    Returns
    -------
    FittedScene
        The terms with their intervals (``found.terms``), what the section [scene] has
        (``found.scene``), a pipeline of this camera (``pipeline``) and its file (``text``).

    Raises
    ------
    ArgumentError, PipelineError, StoreError
        As for `sweep.photos`; photographs to which nothing can be fitted are told in a line.

    Examples
    --------
    >>> found = sweep.fit(
    ...     folder / "shots", camera=folder / "camera.json", board=folder / "board.toml",
    ...     markers=2, check=False)
    >>> round(found.found.scene["blur_px"], 1)
    0.6
    """
    if markers not in range(1, 1001):
        raise ArgumentError("markers", markers, "expected a whole number from 1 to 1000")
    settings = texts_of("settings", settings)
    settings += [COMPARED] * ({*map(prepare.setting_name, settings)} <= {"dictionary", "size_m"})
    with tempfile.TemporaryDirectory() as written:
        home = Path(written).resolve()
        prepared = prepare.prepare(
            folders, camera, board=board, poses=poses, stereo=stereo, settings=settings, home=home,
            one_camera=True,
        )
        pipeline, name = prepared.pipeline, prepare.name_of(Path(folders[0]))
        views, lines = photograph_views(pipeline, markers)
        found, gap = fit_scene(views), None
        if check and len(views) >= 2 * MIN_HELD_OUT:
            found, gap = checked(found, pipeline, home)
        elif check:
            lines.append(
                f"fewer than {2 * MIN_HELD_OUT} photographs: no half of them is held out, to see "
                "which effects move errors"
            )
        document = scene_document(pipeline, views, found)
        text = scene_text(document, found, prepare.record_of(pipeline), name, lines)
    notice(*prepared.lines, *lines)
    return FittedScene(
        found, Pipeline.from_dict(document, name=name, source="scene"), text,
        (*prepared.lines, *lines), gap,
    )
