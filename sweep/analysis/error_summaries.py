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

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy import special

from sweep.analysis.draw_intervals import (
    LEVEL,
    exponential,
    mean_length,
    mean_of,
    quantiles_of,
    rate_of,
    rms_of,
    symmetric,
)
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
    square: see `mean_of` and `rms_of`. Both need some 50 draws and tails not much heavier than
    normal; where a few cells have nearly all of the error, only their draws count.

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
            found |= _named(name, rate_of(successes, of))
        found |= _named("rotation_bias_deg", mean_length(rotation, unflipped, draws))
        found |= _named("range_bias_percent", symmetric(*mean_of(percent, unflipped, draws)))
        for quantity, unit, _, _ in _QUANTITIES:
            errors = {
                "rmse": rms_of(squares[quantity], solved, draws),
                "rmse_unflipped": rms_of(squares[quantity], unflipped, draws),
            } | quantiles_of(np.sqrt(squares[quantity]), solved, looked_for)
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
    can be above 1. The intervals are those of the RMSE, `rms_of`; the bound is taken as known.

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
            rms, low, high = rms_of(error_squared, used, _draws(group["detection"]))
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
        mean = exponential(*mean_of(nees, used, _draws(group["detection"])))
        coverage = np.array([rate_of(nees <= limit, used) for limit in limits])
        joint = np.array([rate_of(nees <= limit, used, joint_level) for limit in limits])
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
        rms = rms_of((shift**2).mean(axis=(-2, -1)), detected & detected_too,
                   _draws(group["detection"]) & _draws(other["detection"]))
        differing = compared & (detected != detected_too)
        found: Row = {"compared": compared.sum(), "differing": differing.sum()}
        found |= _named("detection_disagreement", rate_of(differing, compared))
        return found | _named("corner_shift_rms_px", rms)

    def posed(group: Group, other: Group) -> Row:
        draws = _draws(group["detection"]) & _draws(other["detection"])
        solved = (group["estimate"] == Estimate.solved) & (other["estimate"] == Estimate.solved)
        percent = 100.0 * (_relative(group) - _relative(other))
        shift = np.subtract(group["rotation"], other["rotation"], dtype=np.float64)
        rms = rms_of(_norm_squared(np.degrees(shift)), _unflipped(group) & _unflipped(other), draws)
        found = _named("range_bias_percent", symmetric(*mean_of(percent, solved, draws)))
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
