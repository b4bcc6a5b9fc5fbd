"""How often a pose is found, how large its errors are, and how sure that is, over a dataset's grid.

A dataset is pooled: dimensions that are named are kept, all others are summed over. Of these,
``trial`` counts random draws; the other dimensions of camera, marker and pose make cells, a fixed
grid; all others that are pooled (effects, levels, renderers, settings of detector and estimator)
see the same draws (`sweep.plan.draws`), so that their values together count as one draw.

Every interval has 95 % and speaks of other draws on the same grid: what happens between its points
it cannot tell. Where nothing was drawn, that is where no cell has two draws that count, it is NaN.

A variable that ``x`` has an interval has it in ``x_low`` and ``x_high``. Sums are in double
precision. What is needed of a lazy dataset is loaded at once, and turned into doubles one kept
combination at a time.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy import special

from sweep.analysis.intervals import wilson
from sweep.analysis.moments import Moments
from sweep.errors import StoreError
from sweep.measure.flags import Detection, Estimate, Flipped
from sweep.plan.parameters import GEOMETRY_SECTIONS, PARAMETERS
from sweep.plan.template import LABELS, TEMPLATE, XYZ

Floats = NDArray[np.float64]
Masks = NDArray[np.bool_]
Group = dict[str, NDArray[Any]]
"""What was measured at one kept combination: (cells, draws, settings, ...) by name."""
Row = dict[str, ArrayLike]
"""The variables of one kept combination, by name."""
Interval = tuple[float, float, float]
"""Value, low, high."""

LEVEL = 0.95
TAIL = (1.0 - LEVEL) / 2.0
PERCENTS = {"median": 50, "p95": 95, "p99": 99}
DEGREES_OF_FREEDOM = 6  # of a pose
TOLERANCE = 0.02  # by how much a trusted covariance's coverage may be off
FEWEST = 50  # from this many draws on a covariance can be trusted

_NOT_LOOKED_FOR = (Detection.not_run, Detection.not_visible, Detection.not_modelled)
_QUANTITIES = (  # name, unit in names, units, in words
    ("rotation", "deg", "degree", "rotation error"),
    ("range", "percent", "percent", "depth error of the true depth"),
)
_STATISTICS = {
    "bias": "mean {}, solved and not flipped",
    "rmse": "RMS {}, solved",
    "rmse_unflipped": "RMS {}, solved and not flipped",
    "median": "median of the absolute {}, not solved = infinite",
    "p95": "95 % quantile of the absolute {}, not solved = infinite",
    "p99": "99 % quantile of the absolute {}, not solved = infinite",
}
_MEANINGS: dict[str, tuple[str, str]] = {
    f"{quantity}_{statistic}_{unit}": (meaning.format(words), units)
    for quantity, unit, units, words in _QUANTITIES
    for statistic, meaning in _STATISTICS.items()
} | {
    "looked_for": ("poses that were run, visible and modelled", "1"),
    "detection_rate": ("detected of looked_for", "1"),
    "solved_rate": ("solved of looked_for", "1"),
    "flip_rate": ("nearer to the mirror of the truth, of solved", "1"),
    "rotation_bias_deg": ("length of the mean rotation error, solved and not flipped", "degree"),
    "rotation_efficiency": ("RMS bound over RMS rotation error, solved and not flipped", "1"),
    "range_efficiency": (
        "RMS bound over RMS depth error, both of the true depth, solved and not flipped", "1"),
    "nees_count": ("estimates with a normalised estimation error squared", "1"),
    "nees_mean": ("mean normalised estimation error squared, expected 6", "1"),
    "covariance_coverage": ("share of estimates within the covariance's region of a level", "1"),
    "covariance_trusted": ("whether the coverage is the level, at every level", "1"),
    "level": ("nominal probability of the covariance's region", "1"),
}
_PAIRED_MEANINGS: dict[str, tuple[str, str]] = {
    "compared": ("poses that were looked for with both renderers", "1"),
    "differing": ("poses detected with one of both renderers only", "1"),
    "detection_disagreement": ("differing of compared", "1"),
    "corner_shift_rms_px": ("RMS of a corner's coordinate minus the reference's", "px"),
    "range_bias_percent": (
        "mean depth error minus the reference's, of the true depth, both solved", "percent"),
    "rotation_shift_deg": (
        "RMS of the rotation error minus the reference's, both solved and not flipped", "degree"),
}


def summarise(
    results: xr.Dataset, treatments: Sequence[str], per: Sequence[str] = ()
) -> xr.Dataset:
    """Return rates, errors and their intervals, with dimensions (*per, *treatments).

    ``treatments`` are dimensions of settings, ``per`` dimensions of the scene; all others are
    pooled. ``results`` has the variables of `sweep.plan.template`.

    ``looked_for`` counts the poses (times pooled settings) whose detection is none of not_run,
    not_visible and not_modelled; ``detection_rate`` and ``solved_rate`` are of these,
    ``flip_rate`` of the solved. Their intervals are Wilson's, a little wide where the cells'
    rates differ.

    The rotation error is in degrees, the range error is that of z in percent of the true z.
    ``*_rmse_*`` is over the solved poses, ``*_rmse_unflipped_*`` and ``*_bias_*`` over those that
    are solved and not flipped. ``rotation_bias_deg`` is the length of the mean rotation vector:
    never negative, so it is above 0 by chance alone; then its low end is 0.

    The quantiles (``*_median_*``, ``*_p95_*``, ``*_p99_*``, absolute errors) are over the poses
    looked for, one that is not solved counting as infinite: an infinite quantile says that more
    than 50, 5 or 1 % were not solved. They are order statistics, the smallest value with at least
    that share at or below; so are their intervals, whose ends are NaN where n is too small.

    The interval of a mean is Student's, that of an RMSE Student's of the logarithm of the mean
    square: see `_mean` and `_rms`. Both need some 50 draws and tails not much heavier than normal;
    where a few cells have nearly all of the error, only their draws count.

    Raises ``StoreError`` for a dimension that is not there.
    """

    def row(group: Group) -> Row:
        draws, looked_for = _draws(group["detection"]), _looked_for(group["detection"])
        solved, unflipped = group["estimate"] == Estimate.solved, _unflipped(group)
        rotation = np.degrees(group["rotation"], dtype=np.float64)
        percent = 100.0 * _relative(group)
        squares = {"rotation": _norm_squared(rotation), "range": percent**2}
        found: Row = {"looked_for": looked_for.sum()}
        for name, successes, of in (
            ("detection_rate", group["detection"] == Detection.detected, looked_for),
            ("solved_rate", solved, looked_for),
            ("flip_rate", group["flipped"] == Flipped.flipped, solved),
        ):
            found |= _named(name, _rate(successes, of))
        found |= _named("rotation_bias_deg", _mean_length(rotation, unflipped, draws))
        found |= _named("range_bias_percent", _symmetric(*_mean(percent, unflipped, draws)))
        for quantity, unit, _, _ in _QUANTITIES:
            errors = {
                "rmse": _rms(squares[quantity], solved, draws),
                "rmse_unflipped": _rms(squares[quantity], unflipped, draws),
            } | _quantiles(np.sqrt(squares[quantity]), solved, looked_for)
            for statistic, interval in errors.items():
                found |= _named(f"{quantity}_{statistic}_{unit}", interval)
        return found

    return _table(results, _kept(results, (*per, *treatments)), [_estimates(results)], row)


def efficiency(
    results: xr.Dataset, treatments: Sequence[str], per: Sequence[str] = ()
) -> xr.Dataset:
    """Return how near the errors come to the bound, 1 being on it: dimensions (*per, *treatments).

    ``results`` has, beside the variables of the template, ``bound_std``: dimensions of the scene
    and ``pose_parameter``, labelled rotation_x, rotation_y, rotation_z (rad), translation_x,
    translation_y, translation_z (m), camera frame: the least standard deviation that an unbiased
    estimator can have (Cramér and Rao), NaN where there is none.

    ``rotation_efficiency`` is sqrt(mean of the sum of the three bounds squared) over the RMS norm
    of the rotation error. ``range_efficiency`` is the RMS of bound over true z, over that of error
    over true z: so distances weigh alike. Both over the poses that have a bound and are solved and
    not flipped: a flip is another minimum, of which the bound knows nothing. A biased estimator
    can be above 1. The intervals are those of the RMSE, `_rms`; the bound is taken as known.

    NaN where no such pose has a bound, and everywhere if there is no ``bound_std``. An error of
    exactly 0 gives infinity. Raises ``StoreError`` for a dimension that is not there.
    """
    labels = [f"rotation_{axis}" for axis in XYZ]
    bound = results.get("bound_std", xr.DataArray(
        np.full(4, np.nan), {"pose_parameter": [*labels, "translation_z"]}, "pose_parameter"
    ))
    needed = _estimates(results) | {
        "rotation_bound": bound.sel(pose_parameter=labels),
        "depth_bound": bound.sel(pose_parameter="translation_z", drop=True),
    }

    def row(group: Group) -> Row:
        found: Row = {}
        for name, bound_squared, error_squared in (
            ("rotation_efficiency", _norm_squared(group["rotation_bound"]),
             _norm_squared(group["rotation"])),
            ("range_efficiency", _relative(group, "depth_bound") ** 2, _relative(group) ** 2),
        ):
            used = _unflipped(group) & np.isfinite(bound_squared)
            rms, low, high = _rms(error_squared, used, _draws(group["detection"]))
            least = np.sqrt(bound_squared[used].mean()) if used.any() else np.float64(np.nan)
            with np.errstate(divide="ignore", invalid="ignore"):
                found |= _named(name, least / np.array([rms, high, low]))
        return found

    return _table(results, _kept(results, (*per, *treatments)), [needed], row)


def covariance_trust(
    results: xr.Dataset,
    treatments: Sequence[str],
    per: Sequence[str] = (),
    levels: Sequence[float] = (0.5, 0.9, 0.99),
    scale: xr.DataArray | None = None,
) -> xr.Dataset:
    """Return whether the estimates' own covariances tell the truth: (*per, *treatments[, level]).

    ``results`` has, beside the variables of the template, ``nees`` (dimensions of ``estimate``):
    the normalised estimation error squared e' C⁻¹ e of the six pose parameters, NaN where there is
    no covariance. Of a true covariance it is chi-squared with 6 degrees of freedom (Bar-Shalom, Li
    and Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, section 5.4).
    Every pose with a number counts, flipped ones too: who trusts a covariance does not know of
    flips.

    ``scale``, with axes of the dataset (the kept ones, as a rule) and their coordinates, multiplies
    ``nees`` first: with 1/k² the assumed corner noise becomes k times as large.

    ``nees_count`` are the estimates that have a number, ``nees_mean`` is expected to be 6, its
    interval is Student's of its logarithm. ``covariance_coverage`` (..., level) is the share of
    them within the region of that level, with Wilson's interval.
    ``covariance_trusted``: at every level the interval of the coverage, at 95 % for all levels
    together (Bonferroni), holds a share within 0.02 of the level, and there are at least 50
    draws. So False means wrong, or too little to tell. Without ``nees`` everything is NaN and
    nothing trusted.

    Raises ``StoreError`` for a dimension that is not there, ``ValueError`` for a level outside
    (0, 1) and for a ``scale`` whose coordinates are others.
    """
    nominal = np.array(levels, dtype=np.float64)
    if not (nominal.size and ((nominal > 0.0) & (nominal < 1.0)).all()):
        raise ValueError(f"levels = {tuple(levels)}: give numbers between 0 and 1")
    nees = results.get("nees", xr.DataArray(np.nan))
    if scale is not None:
        _kept(results, [str(name) for name in scale.dims])
        nees, scale = xr.align(nees, scale, join="exact")
        nees = nees * scale
    limits = special.chdtri(DEGREES_OF_FREEDOM, 1.0 - nominal)
    joint_level = 1.0 - (1.0 - LEVEL) / len(nominal)

    def row(group: Group) -> Row:
        nees = group["nees"].astype(np.float64)
        used = (group["estimate"] == Estimate.solved) & ~np.isnan(nees)
        mean = _exponential(*_mean(nees, used, _draws(group["detection"])))
        coverage = np.array([_rate(nees <= limit, used) for limit in limits])
        joint = np.array([_rate(nees <= limit, used, joint_level) for limit in limits])
        right = (joint[:, 1] - TOLERANCE <= nominal) & (nominal <= joint[:, 2] + TOLERANCE)
        enough = used.any(axis=2).sum() >= FEWEST
        found: Row = {"nees_count": used.sum(), "covariance_trusted": right.all() and enough}
        return found | _named("nees_mean", mean) | _named("covariance_coverage", coverage.T)

    needed = {"detection": results["detection"], "estimate": results["estimate"], "nees": nees}
    table = _table(results, _kept(results, (*per, *treatments)), [needed], row, ("level",))
    return table.assign_coords(level=("level", nominal, _attributes("level", _MEANINGS)))


def renderer_bias(results: xr.Dataset, reference: str = "exact") -> xr.Dataset:
    """Return what each renderer changes against ``reference``, paired scene by scene.

    Dimensions: renderer and those of the detector's settings; for the pose variables also those of
    the estimator's. All other dimensions are pooled; intervals as in `summarise`.

    - ``detection_disagreement``: share of the poses looked for with both (``compared``) that are
      detected with one of them only (``differing``).
    - ``corner_shift_rms_px``: RMS over poses detected with both, corners, x and y of the
      difference of the corners' errors.
    - ``range_bias_percent``: mean difference of the relative z errors, signed (above 0: farther
      than with the reference), poses solved with both.
    - ``rotation_shift_deg``: RMS norm of the difference of the rotation errors, poses solved and
      not flipped with both.

    Raises ``StoreError`` if there is no dimension renderer, or no such renderer.
    """
    _kept(results, ("renderer",))
    renderers = [str(name) for name in results["renderer"].values]
    if reference not in renderers:
        raise StoreError(f"reference = {reference}: the renderers are {', '.join(renderers)}")
    at_reference = results.isel(renderer=renderers.index(reference), drop=True)
    scene = _scene_dims(results)
    of_detector = ["renderer", *(n for n in _axes(results, "detection") if n not in scene)]
    of_estimator = ["renderer", *(n for n in _axes(results, "estimate") if n not in scene)]

    def corners(side: xr.Dataset) -> dict[str, xr.DataArray]:
        return {"detection": side["detection"], "corners": side["corner_error_px"]}

    def seen(group: Group, other: Group) -> Row:
        compared = _looked_for(group["detection"]) & _looked_for(other["detection"])
        detected, detected_too = (
            side["detection"] == Detection.detected for side in (group, other)
        )
        shift = np.subtract(group["corners"], other["corners"], dtype=np.float64)
        rms = _rms((shift**2).mean(axis=(-2, -1)), detected & detected_too,
                   _draws(group["detection"]) & _draws(other["detection"]))
        differing = compared & (detected != detected_too)
        found: Row = {"compared": compared.sum(), "differing": differing.sum()}
        found |= _named("detection_disagreement", _rate(differing, compared))
        return found | _named("corner_shift_rms_px", rms)

    def posed(group: Group, other: Group) -> Row:
        draws = _draws(group["detection"]) & _draws(other["detection"])
        solved = (group["estimate"] == Estimate.solved) & (other["estimate"] == Estimate.solved)
        percent = 100.0 * (_relative(group) - _relative(other))
        shift = np.subtract(group["rotation"], other["rotation"], dtype=np.float64)
        rms = _rms(_norm_squared(np.degrees(shift)), _unflipped(group) & _unflipped(other), draws)
        found = _named("range_bias_percent", _symmetric(*_mean(percent, solved, draws)))
        return found | _named("rotation_shift_deg", rms)

    sides = (results, at_reference)
    table = _table(results, of_detector, [corners(side) for side in sides], seen,
                   meanings=_PAIRED_MEANINGS)
    return table.assign(_table(results, of_estimator, [_estimates(side) for side in sides], posed,
                               meanings=_PAIRED_MEANINGS))


# Of a dataset.

def _axes(results: xr.Dataset, *names: str) -> list[str]:
    """Return the axes that these variables of the template have, all of them by default."""
    of = names or tuple(variable.name for variable in TEMPLATE)
    dims = [str(dim) for name in of if name in results for dim in results[name].dims]
    return [dim for dim in dict.fromkeys(dims) if dim not in LABELS]


def _scene_dims(results: xr.Dataset) -> list[str]:
    """Return the axes of the scene: those of the truth."""
    stage = min(variable.stage for variable in TEMPLATE)
    return _axes(results, *(v.name for v in TEMPLATE if v.stage == stage))


def _kept(results: xr.Dataset, names: Sequence[str]) -> tuple[str, ...]:
    """Return the dimensions to keep, each once, if all are there."""
    axes = _axes(results)
    missing = [name for name in names if name not in axes]
    if missing:
        raise StoreError(f"{', '.join(missing)}: no such dimension; there are {', '.join(axes)}")
    return tuple(dict.fromkeys(names))


def _estimates(results: xr.Dataset) -> dict[str, xr.DataArray]:
    """Return what tells the errors of the estimates; of positions only z, in the camera's frame."""
    z = XYZ.index("z")
    return {
        "detection": results["detection"],
        "estimate": results["estimate"],
        "flipped": results["flipped"],
        "rotation": results["rotation_error_rad"],
        "depth_error": results["translation_error_m"].isel(xyz=z, drop=True),
        "depth": results["true_tvec_m"].isel(xyz=z, drop=True),
    }


def _table(
    results: xr.Dataset,
    kept: Sequence[str],
    sides: Sequence[Mapping[str, xr.DataArray]],
    row: Callable[..., Row],
    inner: Sequence[str] = (),
    meanings: Mapping[str, tuple[str, str]] = _MEANINGS,
) -> xr.Dataset:
    """Return the dataset of ``row``, called for each combination of the kept dimensions.

    ``row`` gets a group of arrays of each side. What it returns are numbers, or arrays with the
    dimensions ``inner``.
    """
    rows = [row(*groups) for groups in _groups(results, kept, sides)]
    shape = tuple(results.sizes[name] for name in kept)
    found = {name: np.array([each[name] for each in rows]) for name in rows[0]}
    return xr.Dataset(
        {
            name: ((*kept, *inner)[: len(shape) + values.ndim - 1],
                   values.reshape(shape + values.shape[1:]), _attributes(name, meanings))
            for name, values in found.items()
        },
        {name: coordinate for name, coordinate in results.coords.items()
         if set(coordinate.dims) <= set(kept)},
    )


def _groups(
    results: xr.Dataset, kept: Sequence[str], sides: Sequence[Mapping[str, xr.DataArray]]
) -> Iterator[list[Group]]:
    """Yield the group of each side, for each combination of the kept dimensions, the last fastest.

    All is loaded at once, but arrays are given the dimensions that they lack without a copy.
    """
    loaded = xr.Dataset({
        f"{name} {number}": array.reset_coords(drop=True)
        for number, side in enumerate(sides) for name, array in side.items()
    }).compute()
    inner = [name for name in loaded.dims if name in {*LABELS, "pose_parameter"}]
    arrays = xr.broadcast(
        *loaded.values(), *(results[name].reset_coords(drop=True) for name in kept), exclude=inner
    )
    if "trial" in kept or "trial" not in arrays[0].dims:
        arrays = tuple(array.expand_dims("one_draw") for array in arrays)
    sizes = {str(name): n for name, n in arrays[0].sizes.items() if name not in inner}
    draw = "one_draw" if "one_draw" in sizes else "trial"
    scene = _scene_dims(results)
    pooled = [name for name in sizes if name not in {*kept, draw}]
    cells = [
        name for name in pooled
        if name in scene and PARAMETERS[name].section in GEOMETRY_SECTIONS
    ]
    settings = [name for name in pooled if name not in cells]
    views = {
        name: array.transpose(*kept, *cells, draw, *settings, ...).values
        for name, array in zip([*loaded, *kept], arrays, strict=True)
    }
    shape = [math.prod(sizes[name] for name in names) for names in (cells, [draw], settings)]

    def joined(array: NDArray[Any]) -> NDArray[Any]:
        """Return an array of all pooled dimensions as (cells, draws, settings, ...)."""
        return array.reshape(*shape, *array.shape[len(pooled) + 1:])

    for index in np.ndindex(*(sizes[name] for name in kept)):
        yield [
            {name: joined(views[f"{name} {number}"][index]) for name in side}
            for number, side in enumerate(sides)
        ]


def _attributes(name: str, meanings: Mapping[str, tuple[str, str]]) -> dict[str, str]:
    for end, words in (("_low", "lower end of the 95 % interval: "),
                       ("_high", "upper end of the 95 % interval: ")):
        if name not in meanings and name.endswith(end):
            meaning, units = meanings[name.removesuffix(end)]
            return {"long_name": words + meaning, "units": units}
    meaning, units = meanings[name]
    return {"long_name": meaning, "units": units}


def _named(name: str, interval: Sequence[ArrayLike] | Floats) -> Row:
    value, low, high = interval
    return {name: value, f"{name}_low": low, f"{name}_high": high}


# Of poses: arrays (cells, draws, settings).

def _draws(detection: NDArray[Any]) -> Masks:
    """Return which draws were run, (cells, draws)."""
    return np.asarray((detection != Detection.not_run).any(axis=2))


def _looked_for(detection: NDArray[Any]) -> Masks:
    return ~np.isin(detection, _NOT_LOOKED_FOR)


def _unflipped(group: Group) -> Masks:
    solved = group["estimate"] == Estimate.solved
    return np.asarray(solved & (group["flipped"] != Flipped.flipped))


def _relative(group: Group, name: str = "depth_error") -> Floats:
    """Return a length over the true z."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(group[name] / group["depth"], dtype=np.float64)


def _norm_squared(vectors: NDArray[Any]) -> Floats:
    """Return the squared norms of (..., xyz)."""
    return np.asarray(np.square(vectors, dtype=np.float64).sum(axis=-1))


def _freedom(used: Masks) -> int:
    """Return how many draws with a used value there are beyond the first of each cell."""
    return int(np.maximum(used.any(axis=2).sum(axis=1) - 1, 0).sum())


def _rate(successes: Masks, used: Masks, level: float = LEVEL) -> Interval:
    """Return the share of ``used`` that are ``successes``, with Wilson's interval.

    Pooled settings see the same draws: n is the number of draws, and the successes are rounded
    outwards to whole draws.
    """
    n, draws = int(used.sum()), int(used.any(axis=2).sum())
    hits = int((successes & used).sum())
    if n == 0 or _freedom(used) == 0:
        return hits / n if n else np.nan, np.nan, np.nan
    low, high = wilson([hits * draws // n, -(-hits * draws // n)], draws, level)
    return hits / n, float(low[0]), float(high[1])


def _mean(values: Floats, used: Masks, draws: Masks) -> Interval:
    """Return the mean of the used values, its standard error, and the degrees of freedom of that.

    The mean is a ratio of two sums over a stratified sample, the cells being the strata and the
    draws the sample: of the values, and of what counts. So its variance is that of the sum of
    ``used · (value - mean)`` over n², each cell's from its own draws: Cochran, "Sampling
    Techniques", 3rd ed. 1977, sections 6.11 and 5A.14. Where all draws count it is the sum of
    n_c s_c² over n²; where some do not, it also knows that which ones do is random. A cell with a
    single draw cannot tell its variance and gets the pooled one.

    The degrees of freedom are Welch's (Biometrika 34, 1947, the form with f + 2): a few cells
    with the largest errors can make most of the variance. They are no more than the draws with a
    used value beyond the first of each cell; 0 of these: standard error NaN.
    """
    if not used.any():
        return np.nan, np.nan, np.nan
    mean, n = float(values[used].mean()), int(used.sum())
    most = _freedom(used)
    if most == 0:
        return mean, np.nan, np.nan
    with np.errstate(all="ignore"):
        deviations = np.where(used, values - mean, 0.0).sum(axis=2)
        within = Moments.of(np.where(draws, deviations, np.nan), axis=1)
        repeated = within.count > 1
        m2, freedom = within.m2[repeated], within.count[repeated] - 1.0
        terms = (freedom + 1.0) * m2 / freedom
        alone = (within.count == 1).sum() * m2.sum() / freedom.sum()
        spread = terms.sum()
        welch = spread**2 / (terms**2 / (freedom + 2.0)).sum() - 2.0
        return mean, float(np.sqrt(spread + alone) / n), float(np.fmin(most, welch))


def _symmetric(mean: float, error: float, freedom: float) -> Interval:
    """Return Student's interval of a mean."""
    half = error * special.stdtrit(freedom, 1.0 - TAIL)
    return mean, float(mean - half), float(mean + half)


def _exponential(mean: float, error: float, freedom: float) -> Interval:
    """Return the interval of a positive mean: Student's of its logarithm, by the delta method."""
    if mean == 0.0:
        return _symmetric(mean, error, freedom)
    with np.errstate(over="ignore", invalid="ignore"):
        factor = np.exp(error / mean * special.stdtrit(freedom, 1.0 - TAIL))
        return mean, float(mean / factor), float(mean * factor)


def _rms(squares: Floats, used: Masks, draws: Masks) -> Interval:
    """Return the root of the mean of the used squares.

    Squares are skewed, and a mean square's error goes with its size: Student's interval is right
    for the logarithm. With 50 normal errors in 1, 5, 10 or 25 cells it covers 0.938 to 0.954,
    without the logarithm 0.92 to 0.95; with Laplace's tails 0.90 to 0.94.
    """
    mean, low, high = np.sqrt(_exponential(*_mean(squares, used, draws)))
    return float(mean), float(low), float(high)


def _mean_length(vectors: Floats, used: Masks, draws: Masks) -> Interval:
    """Return the length of the mean of the used vectors (..., xyz).

    Along its own direction the mean vector is a plain mean, and the upper end is Student's. The
    mean's length grows by chance, so the lower end is Scheffé's: the length minus
    sqrt(3 d / (d - 2) · F(3, d - 2)) standard errors, d degrees of freedom, at least 0. By the
    Cauchy-Schwarz inequality this holds a bias of 0 whenever Hotelling's T² does, in 95 % at
    least. With 50 normal errors it covers 0.97 (a large bias) to 0.995 (a bias of its error).
    """
    if not used.any():
        return np.nan, np.nan, np.nan
    centre = vectors[used].mean(axis=0)
    length = np.linalg.norm(centre)
    direction = centre / length if length > 0.0 else np.array([1.0, 0.0, 0.0])
    along, error, freedom = _mean((vectors * direction).sum(axis=-1), used, draws)
    _, _, high = _symmetric(along, error, freedom)
    rest = freedom - (len(XYZ) - 1)
    if np.isnan(error):
        return along, np.nan, np.nan
    if rest <= 0.0:
        return along, 0.0, high
    scheffe = np.sqrt(len(XYZ) * freedom / rest * special.fdtri(len(XYZ), rest, LEVEL))
    return along, max(0.0, float(along - scheffe * error)), high


def _quantiles(errors: Floats, solved: Masks, looked_for: Masks) -> dict[str, Interval]:
    """Return the quantiles of `PERCENTS` over ``looked_for``; not solved is infinite.

    The interval's ends are order statistics of the pooled sample: David and Nagaraja, "Order
    Statistics", 3rd ed. 2003, section 7.1. Where cells differ, the count below the quantile varies
    less than binomially (Hoeffding, Annals of Mathematical Statistics 27, 1956): it then covers
    more. Pooled settings see the same draws: ranks are counted in draws.
    """
    ordered = np.sort(np.where(solved, errors, np.inf)[looked_for])
    n, draws = len(ordered), int(looked_for.any(axis=2).sum())
    found = {}
    for name, percent in PERCENTS.items():
        value, low, high = np.nan, np.nan, np.nan
        if n > 0:
            value = ordered[-(-n * percent // 100) - 1]
        if _freedom(looked_for) > 0:
            first, last = _ranks(draws, percent)
            low = ordered[first * n // draws - 1] if first >= 1 else np.nan
            high = ordered[-(-last * n // draws) - 1] if last <= draws else np.nan
        found[name] = float(value), float(low), float(high)
    return found


@functools.lru_cache(maxsize=4096)
def _ranks(n: int, percent: int) -> tuple[int, int]:
    """Return the ranks, from 1, between which the quantile lies, beyond each with 2.5 % at most.

    0 and n + 1 stand for ends that the sample does not have.
    """
    p = percent / 100.0
    reach = 10.0 * np.sqrt(n * p * (1.0 - p)) + 10.0
    below = np.arange(max(0, int(n * p - reach)), min(n, int(n * p + reach)) + 1)
    chance = special.bdtr(below, n, p)
    first = below[np.searchsorted(chance, TAIL)]
    last = below[np.searchsorted(chance, 1.0 - TAIL)] + 1
    return int(first), int(last)
