"""Error models: bias and standard deviation of a pose over distance, side and viewing angle."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis.described import with_sampling
from sweep.analysis.dimensions import DRAWS, axes_of, is_grid_axis, kept_dimensions
from sweep.analysis.error_model_bins import PREDICTORS, bins_and_cells, focal_size_of, knot_values
from sweep.analysis.error_model_fit import (
    BinSums,
    Fit,
    choose_knots,
    differences,
    fit_error,
    grid_points,
    hat_basis,
    select_knots,
    union,
)
from sweep.analysis.error_model_sums import (
    COUNTS,
    HALVES,
    QUANTITIES,
    BinMoments,
    Bins,
    Coverage,
    Fitted,
    Moments,
    sums_of,
)
from sweep.analysis.intervals import DEVIATIONS
from sweep.analysis.pose_view import SIGNED_INPUTS, pose_arrays
from sweep.errors import DatasetError
from sweep.measure.flags import Flag, flag
from sweep.plan.variable import cf_attributes
from sweep.typing import Floats, Integers

NOMINAL = 0.9545
"""Share of normal errors within two standard deviations."""

COVERAGE = (0.93, 0.97)
"""Shares of held-out errors within two standard deviations between which a model holds."""

MIN_JUDGED = 100
"""Held-out poses from which on a cell is judged."""

MAX_FLIPS = 0.02
"""Share of flipped poses up to which a cell's errors are described without them: were they counted
as outside, 93 % of normal errors would still lie within two standard deviations."""

MIN_DETECTION = 0.9
"""Share of solved poses down to which a cell's errors are described."""

MIN_POSES = 200
"""Solved poses, not flipped, from which on a model is fitted."""

SHOWN_DISTANCES = 6
"""Distances at which every model is given, although it may need fewer knots."""

MAX_MODELS = 64
"""Models up to which they are made together."""


class Use(Flag):
    """Whether an error model may be used in a cell."""

    no_poses = flag(0, "The store has no poses there: must not be used.", counted=False)
    holds = flag(1, "93 to 97 % of held-out errors lie within two standard deviations.",
                 present=True)
    too_narrow = flag(2, "Fewer held-out errors than that do: must not be used.")
    too_wide = flag(3, "More do (errors are bounded, or mixed): too careful, else harmless.")
    few_draws = flag(4, "Fewer than 100 held-out poses: not judged, must not be used.")
    flips = flag(5, "More than 2 % of the poses are flipped: must not be used.")
    rarely_solved = flag(6, "Less than 90 % of the poses are solved: must not be used.")


def error_models(results: xr.Dataset) -> xr.Dataset:
    """Return models of the pose's error for each configuration, with intervals and a check.

    Parameters
    ----------
    results
        The dataset of a run with random draws: at least two trials. Axes of the camera and the
        pose, ``size_m`` and ``marker_id`` are pooled; every other axis (detector, solver,
        ``believed_*``, ``dictionary``, noise, ...) keeps its models apart.

    Returns
    -------
    xr.Dataset
        Dimensions: the axes that are kept apart; ``quantity``: ``x``, ``y``, ``z`` (m), and the
        rotation vector ``rotation_x``, ``rotation_y``, ``rotation_z`` (rad), estimated minus true,
        in the sight frame, which is the camera's frame turned so that z is the line of sight
        (`sweep.analysis.sight_frame`; z is the error of the range); knots ``distance_m`` (along
        the optical axis), ``side_px`` and ``viewing_angle_deg``; and cells of these three.

        - ``sigma``, ``bias`` at the knots, with ``_low`` and ``_high``. Between knots ln(sigma) and
          the bias (of positions: over the distance) are linear in ln(distance), ln(side) and the
          angle. With two knots of the distance sigma is a power of it. A predictor that does not
          vary, or follows from the distance (``side_px``: one size and camera), has one knot.
        - ``exponent`` (quantity): of the distance (or the side, where only that varies), if sigma
          is a power of it at every angle, with its interval.
        - ``coverage`` (quantity, cells): share of errors within two sigma of the bias, by a model
          of the other half of the trials (even, odd); ``judged`` poses. ``camera_coverage``: the
          same along and about the camera's own axes.
        - ``use`` (quantity, cells): whether the model may be used there (`Use`): the coverage lies
          within 0.93 to 0.97, with a tolerance of a standard error, and that of each half of the
          trials with one of two.
        - ``flip_rate``, ``solved_rate`` and ``looked_for`` (cells). Flipped and missing poses are
          in these, not in sigma.

    Raises
    ------
    DatasetError
        If nothing was drawn, if fewer than 200 poses of a configuration were solved, or if the
        dataset lacks variables or the parameters that the side follows from.

    Notes
    -----
    The knots of an error (their numbers: ``knots``) are the fewest that describe the other half of
    the trials: one more must raise their log-likelihood by 2. All errors are given at the knots of
    all. The fit: `fit_error`. Intervals are at 95 %, over the random draws, of each value alone.

    Examples
    --------
    >>> parts = [results.assign_coords(trial=results["trial"] + 8 * k) for k in range(40)]
    >>> models = error_models(xr.concat(parts, "trial"))
    >>> list(models["sigma"].dims)
    ['solver', 'quantity', 'distance_m', 'side_px', 'viewing_angle_deg']
    >>> [Use(flag).name for flag in models["use"].sel(quantity="z")[0].values.ravel()]
    ['too_narrow', 'rarely_solved', 'rarely_solved']
    """
    kept = [name for name in axes_of(results) if is_kept(name, results)]
    kept_dimensions(results, kept)
    pose_arrays(results, SIGNED_INPUTS)
    _check_drawn(results, kept)
    focal_size = focal_size_of(results)
    bins, cells = bins_and_cells(results, focal_size)
    moments = [Moments(each) for each in sums_of(results, kept, focal_size, BinMoments(bins))]
    _check_solved(moments, results, kept)
    values = knot_values(bins, moments)
    selected = [[select_knots(each.of(k, 0), each.of(k, 1), values) for k in range(len(QUANTITIES))]
                for each in moments]
    shown = [choose_knots(values[0], SHOWN_DISTANCES), *(each[:1] for each in values[1:])]
    knots = union([each for model in selected for each in [*model, shown]])
    points = grid_points(knots)

    def fits(half: int | None) -> list[list[Fit]]:
        return [[_fit(each.of(k, half), own[k], points) for k in range(len(QUANTITIES))]
                for each, own in zip(moments, selected, strict=True)]

    halves = [fits(half) for half in range(HALVES)]
    fitted = Fitted(knots, *(
        np.array([[[getattr(fit, name) for fit in half[model]] for half in halves]
                  for model in range(len(moments))]).transpose(0, 1, 3, 2)
        for name in ("bias", "log_variance")))
    judged = sums_of(results, kept, focal_size, Coverage(cells, fitted))
    shape = tuple(results.sizes[name] for name in kept)
    table = _knot_variables(fits(None), knots, kept, shape)
    table |= _cell_variables(judged, cells, kept, shape)
    table |= _exponents(moments, kept, shape)
    table["knots"] = ((*kept, "quantity", "predictor"), np.array(
        [[[len(each) for each in own] for own in model] for model in selected],
    ).reshape(*shape, len(QUANTITIES), -1), cf_attributes("knots that the error needs", "1"))
    coordinates: dict[str, Any] = {
        name: results[name].variable for name in kept if name in results.coords}
    coordinates |= {"quantity": list(QUANTITIES), "predictor": list(PREDICTORS)}
    for (name, logarithmic), own, edges in zip(
            PREDICTORS.items(), knots, cells.edges, strict=True):
        attributes = {"units": UNITS[name], "long_name": f"knots of {WORDS[name]}"}
        # A knot at an end must not leave the domain by the rounding of its logarithm.
        plain = np.clip(np.exp(own), edges[0], edges[-1]) if logarithmic else own
        coordinates[name] = (name, plain, attributes)
        for ending, ends in (("low", edges[:-1]), ("high", edges[1:])):
            coordinates[f"cell_{name}_{ending}"] = (f"cell_{name}", ends, {
                "units": UNITS[name], "long_name": f"{ending} end of cells of {WORDS[name]}"})
    focal = focal_size.astype(np.float64)
    return with_sampling(xr.Dataset(table, coordinates, attrs={
        "focal_size_px_m": float(focal.mean()),
        "focal_size_varies": int(float(focal.max()) > float(focal.min()) * (1 + 1e-9)),
    } | _extent(results)), results)


UNITS = {"distance_m": "m", "side_px": "px", "viewing_angle_deg": "degree"}
WORDS = {
    "distance_m": "the distance along the optical axis",
    "side_px": "the side of the black square, were it parallel to the image",
    "viewing_angle_deg": "the angle between the marker's normal and the line of sight",
}


def _fit(sums: BinSums, knots: Sequence[Floats], points: Floats) -> Fit:
    """Return the fit with some knots, at points (n, 3)."""
    fit = fit_error(sums, hat_basis(sums.at, knots), differences(knots))
    return fit.at(hat_basis(points, knots))


def is_kept(name: str, results: xr.Dataset) -> bool:
    """Return whether an axis keeps models apart."""
    return name != DRAWS and (name == "dictionary" or not is_grid_axis(name, results))


def _check_drawn(results: xr.Dataset, kept: Sequence[str]) -> None:
    """Raise DatasetError unless there are two halves of draws, and not too many models."""
    count = int(np.prod([results.sizes[name] for name in kept], dtype=np.int64))
    if count > MAX_MODELS:
        raise DatasetError(f"{count:,} models, one for each value of {', '.join(kept)}: "
                           f"expected at most {MAX_MODELS}; choose values with results.sel")
    trials = results.sizes.get(DRAWS, 1)
    if trials < HALVES or len(set((np.asarray(results[DRAWS].values) % HALVES).tolist())) < HALVES:
        raise DatasetError(
            f"{DRAWS} has {'1 value' if trials == 1 else 'no even or no odd values'}: an error "
            "model is fitted to some random draws and checked on others; run with 50 trials or "
            "more, and with something drawn, such as azimuth_deg = { uniform = [0, 360] }")


def _check_solved(
    moments: Sequence[Moments], results: xr.Dataset, kept: Sequence[str]
) -> None:
    """Raise DatasetError if a configuration has too few solved poses."""
    for number, each in enumerate(moments):
        solved = min(int(each.of(0, half).count.sum()) for half in range(HALVES)) * HALVES
        if solved < MIN_POSES:
            index = np.unravel_index(number, [results.sizes[name] for name in kept])
            which = ", ".join(f"{name} = {results[name].values[k]}"
                              for name, k in zip(kept, index, strict=True))
            raise DatasetError(
                f"{which + ': ' if which else ''}{solved:,} solved poses that are not flipped; an "
                f"error model needs {MIN_POSES} or more: more trials, or larger sides")


def _extent(results: xr.Dataset) -> dict[str, float]:
    """Return the largest bearing of the poses, in degrees."""
    position = results["true_tvec_m"]
    x, y, z = (position.isel(xyz=k, drop=True) for k in range(3))
    tangent: xr.DataArray = ((x**2 + y**2) ** 0.5) / z
    return {"max_bearing_deg": float(np.degrees(np.arctan(tangent.where(z > 0).max().compute())))}


def _unscaled(values: Floats, distance_m: Floats) -> Floats:
    """Return values (quantities, distances, sides, angles) of positions in metres."""
    scale = np.where(np.arange(len(QUANTITIES)) < 3, 1.0, 0.0)[:, None]
    factors = scale * distance_m + (1.0 - scale)
    return np.asarray(values * factors[:, :, None, None])


def _knot_variables(
    fits: Sequence[Sequence[Fit]], knots: Sequence[Floats], kept: Sequence[str],
    shape: tuple[int, ...],
) -> dict[str, Any]:
    grid, z = [len(each) for each in knots], DEVIATIONS
    distance = np.exp(knots[0])
    dims = (*kept, "quantity", *PREDICTORS)

    def stacked(value: Any) -> Floats:
        return np.stack([
            _unscaled(np.stack([value(fit).reshape(grid) for fit in each]), distance)
            for each in fits]).reshape(*shape, len(QUANTITIES), *grid)

    variables = {}
    for ending, side in (("", 0.0), ("_low", -z), ("_high", z)):
        words = {"": "", "_low": "lower end of the 95 % interval: ",
                 "_high": "upper end of the 95 % interval: "}[ending]
        variables[f"sigma{ending}"] = (dims, stacked(
            lambda fit, side=side: np.exp(
                0.5 * (fit.log_variance + side * fit.log_variance_error))),
            cf_attributes(f"{words}standard deviation of the error", "m, radian"))
        variables[f"bias{ending}"] = (dims, stacked(
            lambda fit, side=side: fit.bias + side * fit.bias_error),
            cf_attributes(f"{words}mean error, estimated minus true", "m, radian"))
    return variables


def _cell_variables(
    judged: Sequence[Floats], bins: Bins, kept: Sequence[str], shape: tuple[int, ...],
) -> dict[str, Any]:
    cells = tuple(f"cell_{name}" for name in PREDICTORS)
    halves = np.stack(judged)  # (models, halves, cells, columns)
    sums = halves.sum(axis=1)
    counts = {name: np.rint(sums[..., k]).astype(np.int64) for k, name in enumerate(COUNTS)}
    n = counts["judged"]
    with np.errstate(invalid="ignore", divide="ignore"):
        shares = sums[..., len(COUNTS):] / n[..., None]
        flip_rate = counts["flipped"] / counts["solved"]
        solved_rate = counts["solved"] / counts["looked_for"]
        low, high = _limits(n)
        half_low, half_high = _limits(halves[..., COUNTS.index("judged")], 2.0)
        of_half = halves[..., len(COUNTS) : len(COUNTS) + len(QUANTITIES)] / (
            halves[..., [COUNTS.index("judged")]])
    coverage, camera = shares[..., : len(QUANTITIES)], shares[..., len(QUANTITIES):]
    use = np.select(
        [(counts["looked_for"] == 0)[..., None], (solved_rate < MIN_DETECTION)[..., None],
         (flip_rate > MAX_FLIPS)[..., None], (n < MIN_JUDGED)[..., None],
         (coverage < low) | (of_half < half_low).any(axis=1),
         (coverage > high) | (of_half > half_high).any(axis=1)],
        [Use.no_poses, Use.rarely_solved, Use.flips, Use.few_draws, Use.too_narrow, Use.too_wide],
        Use.holds)

    def by_cell(values: Any, meaning: str, units: str = "1", **options: Any) -> Any:
        attributes = cf_attributes(meaning, units, **options)
        if values.ndim == 2:
            return (*kept, *cells), values.reshape(*shape, *bins.shape), attributes
        values = np.moveaxis(values, -1, 1).reshape(*shape, len(QUANTITIES), *bins.shape)
        return (*kept, "quantity", *cells), values, attributes

    return {
        "coverage": by_cell(coverage, "share of held-out errors within two sigma of the bias"),
        "camera_coverage": by_cell(
            camera, "the same along and about the camera's own axes"),
        "use": by_cell(use.astype(np.uint8), "whether the model may be used", "", flags=Use),
        "judged": by_cell(n, "held-out poses that were judged"),
        "looked_for": by_cell(counts["looked_for"], "poses looked for"),
        "solved_rate": by_cell(solved_rate, "solved of the poses looked for"),
        "flip_rate": by_cell(flip_rate, "nearer to the mirror of the truth, of the solved"),
    }


def _limits(n: Integers | Floats, errors: float = 1.0) -> tuple[Floats, Floats]:
    """Return the limits of the coverage of n errors (..., 1): wider by some standard errors."""
    with np.errstate(divide="ignore"):
        spread = errors * np.sqrt(NOMINAL * (1.0 - NOMINAL) / n)[..., None]
    return COVERAGE[0] - spread, COVERAGE[1] + spread


def _exponents(
    moments: Sequence[Moments], kept: Sequence[str], shape: tuple[int, ...]
) -> dict[str, Any]:
    """Return the power of the distance, or of the side, with which sigma goes."""
    z, values = DEVIATIONS, np.full((3, len(moments), len(QUANTITIES)), np.nan)
    for model, each in enumerate(moments):
        for k in range(len(QUANTITIES)):
            sums = each.of(k)
            some = sums.at[sums.count > 0]
            axis = 0 if np.ptp(some[:, 0]) > 0.05 or np.ptp(some[:, 1]) < 0.05 else 1
            if np.ptp(some[:, axis]) < 0.05:
                continue
            angles = np.unique(np.quantile(some[:, 2], [0, 0.25, 0.5, 0.75, 1]).round(3))
            design = np.concatenate(
                [sums.at[:, [axis]], hat_basis(sums.at[:, [2]], [angles])], axis=1)
            fit = fit_error(sums, design, np.zeros([design.shape[1]] * 2))
            metres = 1.0 if axis == 0 and k < 3 else 0.0
            slope, error = 0.5 * fit.log_variance[0] + metres, 0.5 * fit.log_variance_error[0]
            values[:, model, k] = slope, slope - z * error, slope + z * error
    words = "power of the distance (of the side, if only that varies) with which sigma goes"
    return {
        f"exponent{ending}": ((*kept, "quantity"), each.reshape(*shape, -1),
                              cf_attributes(text + words, "1"))
        for (ending, text), each in zip(
            (("", ""), ("_low", "lower end of the 95 % interval: "),
             ("_high", "upper end of the 95 % interval: ")), values, strict=True)
    }
