"""Error models: bias and covariance of poses as functions of the condition."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from sweep.analysis.dataset import DRAWS, axes_of, is_grid_axis, kept_dimensions, with_sampling
from sweep.analysis.error_model_fit import (
    CONDITIONS,
    COUNTS,
    HALVES,
    PREDICTORS,
    QUANTITIES,
    BinMoments,
    Bins,
    BinSums,
    Coverage,
    Fit,
    Fitted,
    Moments,
    SeenRegion,
    bins_and_cells,
    choose_knots,
    differences,
    distinct_values,
    fit_error,
    focal_size_of,
    grid_points,
    hat_basis,
    knot_values,
    region_cells,
    region_directions,
    region_ends,
    select_knots,
    sums_of,
    union,
)
from sweep.analysis.intervals import DEVIATIONS
from sweep.analysis.poses import SIGNED_INPUTS, bearing_of, pose_arrays, sight_rotation
from sweep.analysis.statistic import INTERVAL
from sweep.errors import ArgumentError, DatasetError
from sweep.experiment.schema import cf_attributes
from sweep.measure.flags import Flag, flag
from sweep.typing import Floats, Integers, Masks

# --------------------------------------------------------------------------------------------------
# Error models: bias and standard deviation of a pose over distance, side and viewing angle.

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
        (`sweep.analysis.poses`; z is the error of the range); knots ``distance_m`` (along
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
        - ``region_low``, ``region_high`` (direction), ``region_seen`` (cells): the joint region of
          distance, side, viewing angle and bearing in which poses were looked for; outside it the
          model has no answer. In it are conditions whose weighted sums (``direction_weight``) lie
          between both ends, and that are in a cell with poses.
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
    found = distinct_values(results, focal_size)
    bins, cells = bins_and_cells(results, focal_size, found)
    (region, drawn), directions = region_cells(results, found), region_directions(found)
    sums = sums_of(results, kept, focal_size, BinMoments(bins), SeenRegion(region, directions))
    moments = [Moments(each) for each in sums["sums"]]
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
    judged = sums_of(results, kept, focal_size, Coverage(cells, fitted))["sums"]
    shape = tuple(results.sizes[name] for name in kept)
    table = _knot_variables(fits(None), knots, kept, shape)
    table |= _cell_variables(judged, cells, kept, shape)
    table |= _exponents(moments, kept, shape)
    table |= _region_variables(sums, region, drawn, directions, kept, shape)
    table["knots"] = ((*kept, "quantity", "predictor"), np.array(
        [[[len(each) for each in own] for own in model] for model in selected],
    ).reshape(*shape, len(QUANTITIES), -1), cf_attributes("knots that the error needs", "1"))
    coordinates: dict[str, Any] = {
        name: results[name].variable for name in kept if name in results.coords}
    coordinates |= {"quantity": list(QUANTITIES), "predictor": list(PREDICTORS),
                    "condition": list(CONDITIONS)}
    for (name, logarithmic), own, edges in zip(
            PREDICTORS.items(), knots, cells.edges, strict=True):
        attributes = {"units": UNITS[name], "long_name": f"knots of {WORDS[name]}"}
        # A knot at an end must not leave the domain by the rounding of its logarithm.
        plain = np.clip(np.exp(own), edges[0], edges[-1]) if logarithmic else own
        coordinates[name] = (name, plain, attributes)
        for ending, ends in (("low", edges[:-1]), ("high", edges[1:])):
            coordinates[f"cell_{name}_{ending}"] = (f"cell_{name}", ends, {
                "units": UNITS[name], "long_name": f"{ending} end of cells of {WORDS[name]}"})
    for name, edges in zip(CONDITIONS, region.edges, strict=True):
        coordinates[f"region_{name}"] = (f"region_{name}", edges[:-1], {
            "units": UNITS[name], "long_name": f"low end of cells of the region of {WORDS[name]}"})
    focal = focal_size.astype(np.float64)
    return with_sampling(xr.Dataset(table, coordinates, attrs={
        "focal_size_px_m": float(focal.mean()),
        "focal_size_varies": int(float(focal.max()) > float(focal.min()) * (1 + 1e-9)),
    }), results)


UNITS = {"distance_m": "m", "side_px": "px", "viewing_angle_deg": "degree",
         "bearing_deg": "degree"}
WORDS = {
    "distance_m": "the distance along the optical axis",
    "side_px": "the side of the black square, were it parallel to the image",
    "viewing_angle_deg": "the angle between the marker's normal and the line of sight",
    "bearing_deg": "the angle between the line of sight and the optical axis",
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


def _region_variables(
    sums: Mapping[str, Any], region: Bins, drawn: Sequence[int], directions: Floats,
    kept: Sequence[str], shape: tuple[int, ...],
) -> dict[str, Any]:
    """Return the joint region of the conditions that was seen, of each model."""
    counts = np.stack(sums["counts"]).reshape(-1, *region.shape)
    of_grid = counts.sum(axis=tuple(1 + k for k in drawn)).reshape(len(counts), -1)
    draws = np.where(of_grid > 0, of_grid, np.inf).min(axis=1)
    low, high = region_ends(directions, np.stack(sums["reach"]), draws)
    seen = (counts > 0).reshape(*shape, *region.shape)
    dims = (*kept, "direction")
    return {
        "direction_weight": (("direction", "condition"), directions, cf_attributes(
            "weights of ln(distance), ln(side), viewing angle and bearing", "")),
        "region_low": (dims, low.reshape(*shape, -1), cf_attributes(
            "smallest weighted sum of a direction in the region", "")),
        "region_high": (dims, high.reshape(*shape, -1), cf_attributes(
            "largest weighted sum of a direction in the region", "")),
        "region_seen": ((*kept, *(f"region_{name}" for name in CONDITIONS)), seen, cf_attributes(
            "whether a cell of the conditions has poses", "1")),
    }


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
    for (ending, words), side in zip(INTERVAL.items(), (0.0, -z, z), strict=True):
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
        for (ending, text), each in zip(INTERVAL.items(), values, strict=True)
    }


# --------------------------------------------------------------------------------------------------
# Values of an error model at poses: bias, standard deviation and covariance.

def model_errors(
    model: xr.Dataset, distance_m: ArrayLike, viewing_angle_deg: ArrayLike,
    side_px: ArrayLike | None = None, bearing_deg: ArrayLike | None = None,
) -> xr.Dataset:
    """Return bias and standard deviation of the pose's error at some conditions.

    Parameters
    ----------
    model
        One model of `error_models`: choose a configuration with ``models.isel(...)``.
    distance_m
        Distances (n,) along the optical axis.
    viewing_angle_deg
        Angles (n,) between the marker's normal and the line of sight.
    side_px
        Sides (n,) of the black square, were it parallel to the image; by default what follows from
        the distance, if the store has one size and one focal length.
    bearing_deg
        Angles (n,) between the line of sight and the optical axis; by default any that was seen
        with the other conditions.

    Returns
    -------
    xr.Dataset
        ``sigma``, ``bias`` (n, quantity), in metres and radians, in the sight frame; ``use`` (n,
        quantity), flags of `Use`; ``flip_rate``, ``solved_rate`` (n,) of the cell. Where the store
        has not seen the conditions together, all are NaN and ``use`` is ``no_poses``.

    Raises
    ------
    ArgumentError
        If there are several models, or no side where it does not follow.

    Notes
    -----
    ln(sigma) and the bias (of positions: over the distance) are linear between the knots of the
    model in ln(distance), ln(side) and the angle.

    Examples
    --------
    >>> parts = [results.assign_coords(trial=results["trial"] + 8 * k) for k in range(40)]
    >>> from sweep.analysis import error_models
    >>> models = error_models(xr.concat(parts, "trial"))
    >>> found = model_errors(models.isel(solver=0), [1.0, 99.0], 0.0)
    >>> found["sigma"].sel(quantity="z").round(5).values.tolist()
    [0.00076, nan]
    """
    if model["sigma"].dims != ("quantity", *PREDICTORS):
        others = [str(dim) for dim in model["sigma"].dims if dim not in ("quantity", *PREDICTORS)]
        raise ArgumentError("model", f"models for each {', '.join(others)}",
                            "expected one model; choose one with models.isel(...)")
    distance, angle = (np.atleast_1d(np.asarray(each, dtype=np.float64))
                       for each in (distance_m, viewing_angle_deg))
    if side_px is None:
        if model.attrs["focal_size_varies"]:
            raise ArgumentError("side_px", None, "expected the side: it varies in the store")
        with np.errstate(divide="ignore"):
            side_px = model.attrs["focal_size_px_m"] / distance
    bearing = np.atleast_1d(np.asarray(np.nan if bearing_deg is None else bearing_deg, dtype=float))
    distance, side, angle, bearing = np.broadcast_arrays(
        distance, np.atleast_1d(np.asarray(side_px, dtype=np.float64)), angle, bearing)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = np.stack([np.log(distance), np.log(side), angle, bearing], axis=-1)
    inside = _seen(model, at, any_bearing=bearing_deg is None)
    cell = np.ravel_multi_index(tuple(
        np.searchsorted(cell_edges(model, name)[1:-1], value, side="right")
        for name, value in zip(PREDICTORS, (distance, side, angle), strict=True)),
        model["flip_rate"].shape)
    knots = [np.log(model[name].values) if logarithmic else model[name].values
             for name, logarithmic in PREDICTORS.items()]
    basis = hat_basis(at[:, : len(knots)], knots)
    scale = np.where(np.arange(len(QUANTITIES)) < 3, 1.0, 0.0)[:, None]
    metres = scale * model["distance_m"].values + (1.0 - scale)
    bias = model["bias"].values / metres[:, :, None, None]
    flat = (len(QUANTITIES), -1)
    values = {
        "sigma": np.exp(basis @ np.log(model["sigma"].values).reshape(flat).T),
        "bias": basis @ bias.reshape(flat).T * (scale[:, 0] * distance[:, None] + 1 - scale[:, 0]),
    }
    use = model["use"].values.reshape(flat)[:, cell].T
    inside &= (use != Use.no_poses).all(axis=1)
    out: dict[str, Any] = {
        name: (("pose", "quantity"), np.where(inside[:, None], each, np.nan),
               {"units": "m, radian"}) for name, each in values.items()}
    out["use"] = (("pose", "quantity"), np.where(inside[:, None], use, Use.no_poses),
                  model["use"].attrs)
    for name in ("flip_rate", "solved_rate"):
        rate = model[name].values.ravel()[cell]
        out[name] = ("pose", np.where(inside, rate, np.nan), model[name].attrs)
    return xr.Dataset(out, {"quantity": list(QUANTITIES)})


def model_covariance(
    model: xr.Dataset, position_m: ArrayLike, viewing_angle_deg: ArrayLike,
    side_px: ArrayLike | None = None,
) -> xr.Dataset:
    """Return covariance and bias of the pose's error along and about the camera's axes.

    Parameters
    ----------
    model, viewing_angle_deg, side_px
        As in `model_errors`.
    position_m
        Positions (n, 3) of the marker in the camera's frame; estimated ones do.

    Returns
    -------
    xr.Dataset
        ``covariance`` (pose, row, column) and ``bias`` (pose, row) in the order x, y, z (m),
        rotation about x, y, z (rad): that of the message ``geometry_msgs/PoseWithCovariance`` of
        ROS, whose 36 numbers are the rows one after another. Subtract the bias from the estimate
        before the covariance describes what is left. ``use`` as in `model_errors`.

    Raises
    ------
    ArgumentError
        As in `model_errors`.

    Notes
    -----
    Q diag(sigma²) Qᵀ for position and rotation each, with Q of `sight_rotation`.

    Examples
    --------
    >>> parts = [results.assign_coords(trial=results["trial"] + 8 * k) for k in range(40)]
    >>> from sweep.analysis import error_models
    >>> models = error_models(xr.concat(parts, "trial"))
    >>> pose = model_covariance(models.isel(solver=0), [0.0, 0.0, 1.0], 0.0)
    >>> pose["covariance"].shape, bool(pose["covariance"][0, 2, 2] > 0)
    ((1, 6, 6), True)
    """
    position = np.atleast_2d(np.asarray(position_m, dtype=np.float64))
    values = model_errors(
        model, position[:, 2], viewing_angle_deg, side_px, bearing_of(position))
    turn = sight_rotation(position)
    covariance = np.zeros((len(position), 6, 6))
    bias = np.zeros((len(position), 6))
    for part in (slice(0, 3), slice(3, 6)):
        variance = values["sigma"].values[:, part] ** 2
        covariance[:, part, part] = np.einsum("nij,nj,nkj->nik", turn, variance, turn)
        bias[:, part] = np.einsum("nij,nj->ni", turn, values["bias"].values[:, part])
    return xr.Dataset({
        "covariance": (("pose", "row", "column"), covariance, {"units": "m2, m rad, rad2"}),
        "bias": (("pose", "row"), bias, {"units": "m, radian"}), "use": values["use"],
    })


def cell_edges(model: xr.Dataset, name: str) -> Floats:
    """Return the edges of a model's cells along a predictor."""
    low, high = (model[f"cell_{name}_{end}"].values for end in ("low", "high"))
    return np.append(low, high[-1])


def _seen(model: xr.Dataset, at: Floats, *, any_bearing: bool) -> Masks:
    """Return whether points (n, 4), in ln(distance), ln(side) and degrees, are in the region."""
    weights, low, high = (model[name].values for name in (
        "direction_weight", "region_low", "region_high"))
    cells = model["region_seen"].values
    if any_bearing:
        free = weights[:, -1] == 0
        at, weights, low, high = at[:, :-1], weights[free, :-1], low[free], high[free]
        cells = np.asarray(cells.any(axis=-1))
    plain = [np.exp(value) if logarithmic else value
             for value, logarithmic in zip(at.T, CONDITIONS.values(), strict=False)]
    numbers = tuple(
        np.searchsorted(model[f"region_{name}"].values[1:], value, side="right")
        for value, name in zip(plain, CONDITIONS, strict=False))
    with np.errstate(invalid="ignore"):
        projected = at @ weights.T
    return np.asarray(((low <= projected) & (projected <= high)).all(axis=1) & cells[numbers])
