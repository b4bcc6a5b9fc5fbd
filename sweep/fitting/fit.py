"""A camera's scene from photographs of known markers: every term with its interval."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sweep.errors import ArgumentError
from sweep.fitting.camera_fit import CameraFit, fit_camera
from sweep.fitting.estimates import MIN_PHOTOGRAPHS, Estimate, estimate
from sweep.fitting.geometry import residuals_of, shifts_of
from sweep.fitting.light import (
    gradient_direction,
    gradient_size,
    gradient_square,
    photograph_light,
)
from sweep.fitting.marker_state import AMOUNT, BLOOM, CORNERS, RADIUS, VARIANCE
from sweep.fitting.noise import PhotographNoise, photograph_noise
from sweep.fitting.photograph_fit import PhotographFit
from sweep.fitting.scenes import PhotographScenes
from sweep.fitting.terms import Term, judged, shortened
from sweep.fitting.views import FittedPhotograph, is_saturated, photograph_views
from sweep.measure.flags import TruthSource
from sweep.model.board import Board
from sweep.model.derivatives import POSE
from sweep.photographs.board_truth import marker_frames
from sweep.photographs.pose_fit import fit_pose
from sweep.typing import Floats

MARKERS = 12
"""Markers of a photograph that are fitted: more of them narrow the intervals little, since
photographs differ by more than the estimates of one."""


FITTED = {"sharpening": AMOUNT, "bloom": BLOOM}
"""Effects that are absent unless needed -> their parameter of a photograph's fit."""


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
        What is to be said beside the terms.
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
    """Return what is fitted of photographs, and lines on what is not.

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
) -> SceneFit:
    """Return the scene of a camera from its photographs.

    Parameters
    ----------
    views
        What is fitted.
    taken, board
        As for :func:`scene_views`.
    without
        Switches of effects that are left out, and why.
    known
        Fits of all effects, of an earlier scene's (:attr:`SceneFit.tested_fits`).

    Raises
    ------
    ArgumentError
        If nothing can be fitted, in a line.
    """
    refused = without or {}
    numbers = {each.number for each in views}
    camera = fit_camera(
        views, [number for name, number in FITTED.items() if name in refused],
        [each for each in known if each.number in numbers],
    )
    if not camera.fits:
        raise ArgumentError(
            "folders", "no marker fits",
            "expected markers whose pixels are black and white at their true poses; check the "
            "board, the camera and the poses",
        )
    noises = [photograph_noise(fit.states) for fit in camera.fits]
    terms = [
        *_levels(camera, taken), *_optics(camera), *_light(camera, taken), *_noise(camera, noises),
        *_geometry(camera, noises, taken, board),
    ]
    terms = [
        each.left_out(refused[switch])
        if each.kept and (switch := each.of or each.parameter) in refused else each
        for each in terms
    ]
    return SceneFit(
        tuple(terms), len(camera.fits), sum(len(fit.states) for fit in camera.fits),
        tuple(_lines(camera, noises)), camera.tested_fits,
    )


def _levels(camera: CameraFit, taken: PhotographScenes) -> list[Term]:
    lights = [photograph_light(fit.states, taken.frame) for fit in camera.fits]
    own = np.array([each.variances for each in lights])
    grounds = np.array([
        np.median([state.marker.ground for state in fit.states]) for fit in camera.fits
    ])
    return [
        Term("black", "black", estimate(np.array([each.black for each in lights]), own[:, 0])),
        Term("white", "white", estimate(np.array([each.white for each in lights]), own[:, 1])),
        Term("around the marker", "background", estimate(grounds)),
    ]


def _optics(camera: CameraFit) -> list[Term]:
    none = Estimate(math.nan)
    variance, amount, bloom = (
        camera.estimates.get(k, test)
        for k, test in zip((VARIANCE, AMOUNT, BLOOM), camera.tested, strict=True)
    )
    blur = judged("blur", "blur_px", variance, 0.0, camera.tested[0], lambda v: v.mapped(_root))
    sharpening = judged("sharpening", "sharpening", amount, 0.0, camera.tested[1])
    radius = camera.estimates.get(RADIUS, none)
    return [
        blur, sharpening,
        Term("radius of sharpening", "sharpening_px", radius, sharpening.kept,
             "one for all photographs" if sharpening.kept else "no sharpening", of="sharpening"),
        judged("bloom (tone)", "bloom", bloom, 0.0, camera.tested[2]),
    ]


def _root(square: float) -> float:
    return math.sqrt(square) if square > 0 else (math.nan if math.isnan(square) else 0.0)


def _light(camera: CameraFit, taken: PhotographScenes) -> list[Term]:
    lights = [photograph_light(fit.states, taken.frame) for fit in camera.fits]
    gradient = judged(
        "light gradient", "illumination_gradient", gradient_size(lights), 0.0,
        gradient_square(lights),
    )
    direction = gradient_direction(lights)
    name, parameter = "direction of light", "illumination_deg"
    if direction is None:
        return [gradient, Term(
            name, parameter, Estimate(math.nan), gradient.kept, "any", of="illumination_gradient",
            setting={"uniform": [0.0, 360.0]},
        )]
    return [gradient, Term(name, parameter, direction, gradient.kept,
                           "" if gradient.kept else "no gradient", of="illumination_gradient")]


def _noise(camera: CameraFit, noises: Sequence[PhotographNoise]) -> list[Term]:
    """Return the noise as a table of two levels, and its correlation."""
    level = [
        estimate(np.array([
            np.mean([state.levels[0] + share * state.levels[1] for state in fit.states])
            for fit in camera.fits
        ])).value for share in (0.0, 1.0)
    ]
    variances = [
        estimate(np.array([getattr(each, name) for each in noises]))
        for name in ("black_variance", "white_variance")
    ]
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
    terms = [
        Term(each.name, "noise_table", deviation, kept, each.reason, 0.0, setting=table)
        for each, deviation in zip(terms, deviations, strict=True)
    ]
    correlation = judged(
        "correlation of noise", "noise_correlation",
        estimate(np.array([each.correlation for each in noises])), 0.0,
    )
    if correlation.kept and not kept:
        correlation = correlation.left_out("no noise")
    elif correlation.kept and correlation.estimate.value < 0:
        correlation = correlation.left_out("negative, which no scene has")
    return [*terms, correlation]


def _geometry(
    camera: CameraFit, noises: Sequence[PhotographNoise], taken: PhotographScenes,
    board: Board | None,
) -> list[Term]:
    sources = set(taken.source[taken.shown].tolist())
    names = ("geometry", "geometry_px"), ("reach of geometry", "geometry_length_px")
    known = {TruthSource.board_without_this_marker, TruthSource.poses_file}
    if not sources <= known or not np.isfinite(noises[0].edge_ratio):
        return [
            Term(*name, Estimate(math.nan), False, "only beside a board or exact poses", 0.0)
            for name in names
        ]
    residuals = []
    for fit, noise in zip(camera.fits, noises, strict=True):
        fixed = TruthSource.poses_file in sources
        compared = _beside_truth(fit) if fixed else _beside_board(fit, taken, board)
        one = None if compared is None else residuals_of(
            fit.states, noise, *compared, float(taken.frame[0])
        )
        if one is not None:
            residuals.append(one)
    if len(residuals) < MIN_PHOTOGRAPHS:
        return [
            Term(*name, Estimate(math.nan), False, "too few photographs or markers", 0.0)
            for name in names
        ]
    shifts = shifts_of(residuals, float(taken.frame[0]))
    term = judged("geometry", "geometry_px", shifts.size_px, 0.0, estimate(shifts.squares))
    if term.kept and estimate(shifts.squares).value < 0:
        term = term.left_out("smaller than the noise")
    return [term, Term(
        "reach of geometry", "geometry_length_px", shifts.length_px, term.kept,
        "" if term.kept else "no geometry", of="geometry_px",
    )]


def _beside_truth(fit: PhotographFit) -> tuple[Floats, Floats]:
    """Return the shifts (n, 4, 2) of corners beside poses that are exact."""
    shifts = [each.corners_px - each.marker.corners_px for each in fit.states]
    return np.array(shifts), np.empty((CORNERS * len(shifts), 0))


def _beside_board(
    fit: PhotographFit, taken: PhotographScenes, board: Board | None
) -> tuple[Floats, Floats] | None:
    """Return the shifts (n, 4, 2) of corners beside one pose of the board, fitted to all of them.

    And how the corners change with that pose, (8 n, 6). None without such a pose.
    """
    if board is None:
        return None
    scenes = taken.scenes
    rows = [state.marker.row for state in fit.states]
    numbers = [board.marker_ids.index(scenes.marker_id[row]) for row in rows]
    points = board.corners_m[numbers]
    pixels = np.array([state.corners_px + state.marker.frame_px for state in fit.states])
    axes, centre = marker_frames(board)[numbers[0]]
    rotation = scenes.rotation[rows[0]] @ axes.T
    camera = taken.lens(rows[0])
    pose = fit_pose(
        camera, points.reshape(-1, 3), pixels.reshape(-1, 2), rotation,
        scenes.translation[rows[0]] - rotation @ centre, np.ones(4 * len(points), dtype=bool),
    )
    if pose is None:
        return None
    explained = camera.derivatives(points.reshape(-1, 3), pose.rotation, pose.translation)[1]
    return -pose.residuals.reshape(-1, 4, 2), np.asarray(explained.reshape(-1, POSE))


def _lines(camera: CameraFit, noises: Sequence[PhotographNoise]) -> list[str]:
    lines = []
    if len(camera.fits) < MIN_PHOTOGRAPHS:
        lines.append(
            f"photographs that could be fitted: {len(camera.fits)}; from {MIN_PHOTOGRAPHS} on "
            "values have intervals, and effects that are not there are left out"
        )
    ratios = [each.edge_ratio for each in noises if math.isfinite(each.edge_ratio)]
    if ratios:
        lines.append(
            f"residuals of all pixels are {np.median(ratios):.2g} times those far from edges"
        )
    return lines
