"""A camera's scene from photographs of known markers: every term with its interval."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sweep.errors import ArgumentError
from sweep.experiment.pipeline import Pipeline
from sweep.fitting.photograph_fit import (
    AMOUNT,
    BLOOM,
    START,
    VARIANCE,
    MarkerState,
    PhotographFit,
    Views,
    fit_photograph,
    is_saturated,
    photograph_views,
)
from sweep.fitting.shifts import (
    MIN_PHOTOGRAPHS,
    UNKNOWN,
    Estimate,
    Field,
    edge_field,
    estimate,
    geometry_field,
)
from sweep.measure.flags import TruthSource
from sweep.typing import Floats, Masks

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
    of
        Parameter that switches the effect on, if that is another one: they are kept together.
    setting
        The pipeline's value in the place of the estimate's; None for the estimate's.
    """

    name: str
    parameter: str
    estimate: Estimate = UNKNOWN
    kept: bool = True
    reason: str = ""
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
    name: str, parameter: str, found: Estimate, test: Estimate | None = None, absent: float = 0.0
) -> Term:
    """Return a term that is kept if its interval excludes the value at which it is absent.

    ``test`` is the estimate that decides, if it is another one.
    """
    deciding = found if test is None else test
    if not math.isfinite(deciding.value):
        return Term(name, parameter, found, False, "no pixels that say it")
    if not math.isfinite(deciding.low):
        return Term(
            name, parameter, found, found.value != absent, "too few photographs to judge"
        )
    kept = deciding.excludes(absent)
    reason = f"95 % interval {'excludes' if kept else 'includes'} {absent:g}"
    return Term(name, parameter, found, kept, reason)


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
        The fits with all effects, by the photograph's number.
    """

    terms: tuple[Term, ...]
    photographs: int
    markers: int
    lines: tuple[str, ...]
    tested_fits: Mapping[int, PhotographFit]

    @property
    def scene(self) -> dict[str, Any]:
        """Parameters of the section [scene] with the terms that are kept."""
        return {each.parameter: each.value for each in self.terms if each.kept}


# --------------------------------------------------------------------------------------------------
# A camera's scene from photographs of known markers: every term with its interval.

#: Markers of a photograph that are fitted: more of them narrow the intervals little, since
#: photographs differ by more than the estimates of one.
MARKERS = 12

#: Photographs from one line of progress to the next.
SAID = 5

#: Effects that are absent unless needed -> their parameter of a photograph's fit.
FITTED = {"sharpening": AMOUNT, "bloom": BLOOM}

#: Is told, in a line, how far a fit is.
Say = Callable[[str], None]


def scene_views(pipeline: Pipeline, markers: int = MARKERS) -> tuple[Views, list[str]]:
    """Return the pixels of photographs that are fitted, and lines on photographs left out.

    Parameters
    ----------
    pipeline
        The experiment of the photographs.
    markers
        The most markers of a photograph that are fitted, well spread over the frame.

    Raises
    ------
    ArgumentError
        If nothing can be fitted, in a line.
    """
    views = photograph_views(pipeline, markers)
    if not views:
        raise ArgumentError(
            "folders", "no marker", "expected photographs of markers of at least 12 px a side"
        )
    good = {number: each for number, each in views.items() if not is_saturated(each)}
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
    views: Views, without: Mapping[str, str] | None = None,
    known: Mapping[int, PhotographFit] | None = None, say: Say = lambda _: None,
) -> SceneFit:
    """Return the scene of a camera from its photographs.

    Parameters
    ----------
    views
        The pixels of markers that are fitted.
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
    every = np.ones(len(START), dtype=bool)
    tested_fits = _fitted(views, every, START, say) if known is None else {
        number: fit for number, fit in known.items() if number in views
    }
    if not tested_fits:
        raise ArgumentError(
            "folders", "no marker fits",
            "expected markers whose pixels are black and white at their true poses; check the "
            "board, the camera and the poses",
        )
    tested = [estimate(each) for each in _parameters(tested_fits)]
    kept = np.array([each.excludes(0.0) or not math.isfinite(each.low) for each in tested])
    kept[[number for name, number in FITTED.items() if name in refused]] = False
    start = START.copy()
    if not (kept[VARIANCE] and tested[VARIANCE].value > 0):
        kept[VARIANCE], start[VARIANCE] = False, 0.0
    found = tested_fits if kept.all() else _fitted(views, kept, start, say)
    # Of effects that are not kept, the estimates with all effects are shown.
    optics = [
        estimate(each) if keep else test
        for each, keep, test in zip(_parameters(found), kept, tested, strict=True)
    ]
    fits = list(found.values())
    terms = [
        each.left_out(refused[switch])
        if each.kept and (switch := each.of or each.parameter) in refused else each
        for each in _terms(fits, optics, tested, refused)
    ]
    return SceneFit(
        tuple(terms), len(fits), sum(len(fit.states) for fit in fits),
        tuple(_lines(len(fits), terms)), tested_fits,
    )


def _fitted(
    views: Views, moved: Masks, start: Floats, say: Say
) -> dict[int, PhotographFit]:
    """Return the fits of photographs by number, of those in which a marker can be fitted."""
    fits = {}
    for count, (number, markers) in enumerate(views.items()):
        if count % SAID == 0:
            say(f"fitting photograph {count + 1} of {len(views)}")
        fits[number] = fit_photograph(markers, moved, start)
    return {number: fit for number, fit in fits.items() if fit is not None}


def _parameters(fits: Mapping[int, PhotographFit]) -> Floats:
    """Return variance, amount and bloom of each photograph, (3, n)."""
    return np.transpose([fit.parameters for fit in fits.values()])


def _terms(
    fits: Sequence[PhotographFit], optics: Sequence[Estimate], tested: Sequence[Estimate],
    refused: Mapping[str, str],
) -> list[Term]:
    """Return the terms of fitted photographs.

    ``optics`` and ``tested`` are variance, amount and bloom as found, and as they are judged.
    """
    def of_photographs(
        function: Callable[[MarkerState], float], middle: Callable[[Any], Any] = np.mean
    ) -> Estimate:
        return estimate(np.array([middle(list(map(function, fit.states))) for fit in fits]))

    black = of_photographs(lambda state: state.levels[0])
    white = of_photographs(lambda state: state.levels.sum())
    ground = of_photographs(lambda state: state.marker.ground, np.median)
    edges = edge_field(fits)
    ragged = _field_terms("ragged edges", "edge_px", edges)
    # The mean profile of edges that are shifted is wider by the variance of their shifts.
    widened = edges.size_px.value**2 if ragged[0].kept and "edge_px" not in refused else 0.0
    return [
        Term("black", "black", black), Term("white", "white", white),
        Term("around the marker", "background", ground),
        judged("blur", "blur_px", optics[VARIANCE].mapped(lambda square: _root(square - widened)),
               tested[VARIANCE]),
        judged("sharpening", "sharpening", optics[AMOUNT], tested[AMOUNT]),
        judged("bloom (tone)", "bloom", optics[BLOOM], tested[BLOOM]),
        *_noise((black.value, white.value), np.transpose([fit.noise for fit in fits])), *ragged,
        *_geometry(fits, edges, of_photographs(_scale)),
    ]


def _root(square: float) -> float:
    return math.sqrt(square) if square > 0 else (math.nan if math.isnan(square) else 0.0)


def _noise(levels: tuple[float, float], noises: Floats) -> list[Term]:
    """Return the noise (2, n) on black and on white as a table of two levels."""
    variances = [estimate(each) for each in noises]
    deviations = [each.mapped(_root) for each in variances]
    table = [
        shortened(number) for level, each in sorted(zip(levels, deviations, strict=True),
                                                    key=lambda pair: pair[0])
        if math.isfinite(each.value) for number in (level, each.value)
    ]
    terms = [
        judged(f"noise on {colour}", "noise_table", deviation, variance)
        for colour, deviation, variance in zip(("black", "white"), deviations, variances,
                                               strict=True)
    ]
    kept = any(each.kept and each.estimate.value > 0 for each in terms)
    return [replace(each, kept=kept, setting=table) for each in terms]


def _field_terms(name: str, parameter: str, field: Field) -> list[Term]:
    """Return the term of a field of shifts, and the term of its reach, which is kept with it."""
    term = judged(name, parameter, field.size_px, field.variance_px)
    if term.kept and not field.variance_px.value > 0:
        term = term.left_out("smaller than the noise")
    return [term, Term(
        f"reach of {name}", parameter.replace("_px", "_length_px"), field.length_px, term.kept,
        "" if term.kept else f"no {name}", of=parameter,
    )]


def _scale(state: MarkerState) -> float:
    """Return the size of a marker over the board's or the file's, by its corners."""
    arms = state.marker.corners_px - state.marker.corners_px.mean(axis=0)
    return 1.0 + float((state.shifts * arms).sum() / (arms**2).sum())


def _geometry(fits: Sequence[PhotographFit], edges: Field, scale: Estimate) -> list[Term]:
    """Return the print's size beside the file's, and the field of shifts of markers."""
    size = judged("print's size", "marker_scale", scale, absent=1.0)
    first, field = fits[0].states[0].marker.shown, None
    reason = "too few photographs or markers"
    if first.source in (TruthSource.board_without_this_marker, TruthSource.poses_file):
        field = geometry_field(fits, edges, scale.value)
    else:
        reason = "only beside a board or exact poses"
        size = Term(size.name, size.parameter).left_out(reason)
    if field is not None:
        return [size, *_field_terms("geometry", "geometry_px", field)]
    return [size, *(each.left_out(reason) for each in _field_terms(
        "geometry", "geometry_px", Field()))]


def _lines(photographs: int, terms: Sequence[Term]) -> list[str]:
    lines = []
    if photographs < MIN_PHOTOGRAPHS:
        lines.append(
            f"photographs that could be fitted: {photographs}; from {MIN_PHOTOGRAPHS} on "
            "values have intervals, and effects that are not there are left out"
        )
    size = next(each for each in terms if each.parameter == "marker_scale")
    if size.kept and math.isfinite(size.estimate.low):
        low, value, high = (
            100.0 * (each - 1.0)
            for each in (size.estimate.low, size.estimate.value, size.estimate.high)
        )
        lines.append(
            f"markers are larger than their file says by {value:.2f} % [{low:.2f}, {high:.2f}]: "
            "measure the print"
        )
    return lines
