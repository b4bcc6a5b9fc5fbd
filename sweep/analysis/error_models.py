"""Error models: bias and covariance of poses as functions of the condition."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from sweep.analysis.dataset import DRAWS, axes_of, is_grid_axis, kept_dimensions, with_sampling
from sweep.analysis.error_model_fit import (
    CONDITIONS,
    PREDICTORS,
    Bins,
    BinSums,
    Fit,
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
    union,
)
from sweep.analysis.estimator import INTERVAL, Columns, arranged
from sweep.analysis.intervals import DEVIATIONS
from sweep.analysis.poses import (
    DEPTH,
    SIGNED_INPUTS,
    Poses,
    bearing_of,
    in_sight_frame,
    pose_arrays,
    sight_rotation,
    viewing_angle_of,
)
from sweep.errors import ArgumentError, DatasetError
from sweep.experiment.schema import cf_attributes
from sweep.measure.flags import Flag, flag
from sweep.typing import Floats, Masks

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




UNITS = {"distance_m": "m", "side_px": "px", "viewing_angle_deg": "degree",
         "bearing_deg": "degree"}
WORDS = {
    "distance_m": "the distance along the optical axis",
    "side_px": "the side of the black square, were it parallel to the image",
    "viewing_angle_deg": "the angle between the marker's normal and the line of sight",
    "bearing_deg": "the angle between the line of sight and the optical axis",
}


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
    inputs = pose_arrays(results, SIGNED_INPUTS) | {
        HALF: (results[DRAWS] % HALVES).astype(np.int64).reset_coords(drop=True).drop_vars(DRAWS),
        FOCAL_SIZE: focal_size}
    columns = Columns(arranged(results, inputs, kept)[1], SightErrors)
    moments = columns.sums(functools.partial(_moments, bins))
    _check_solved(moments, results, kept)
    values = knot_values(bins, moments[..., :4].sum(axis=(0, 1)))
    selected = [[select_knots(BinSums.of(model[0], k), BinSums.of(model[1], k), values)
                 for k in range(len(QUANTITIES))] for model in moments]
    shown = [choose_knots(values[0], SHOWN_DISTANCES), *(each[:1] for each in values[1:])]
    knots = union([each for model in selected for each in [*model, shown]])
    # The model of each half, by which the other is judged:
    # (models, halves, knots, quantities, 2).
    fitted = np.array([
        [[(fit.bias, fit.log_variance) for fit in _fits(half, own, knots)] for half in model]
        for model, own in zip(moments, selected, strict=True)]).transpose(0, 1, 4, 2, 3)
    judged = columns.sums(functools.partial(_within, cells, knots, fitted))
    seen = columns.sums(lambda poses, _: _counted(region, poses))
    reach = columns.sums(lambda poses, _: _reach(directions, poses), np.maximum)
    tables = []
    for number, (whole, own) in enumerate(zip(moments.sum(axis=1), selected, strict=True)):
        tables.append({
            **_knot_variables(_fits(whole, own, knots), knots), **_exponents(whole),
            **_cell_variables(judged[number], cells),
            **_region_variables(region, drawn, directions, seen[number], reach[number]),
            "knots": (("quantity", "predictor"), np.array([[*map(len, each)] for each in own]),
                      cf_attributes("knots that the error needs", "1"))})
    shape = tuple(results.sizes[name] for name in kept)
    variables: dict[str, Any] = {
        name: ((*kept, *dims), np.stack([table[name][1] for table in tables]).reshape(
            (*shape, *first.shape)), attributes)
        for name, (dims, first, attributes) in tables[0].items()}
    variables["direction_weight"] = (("direction", "condition"), directions, cf_attributes(
        "weights of ln(distance), ln(side), viewing angle and bearing", ""))
    coordinates: dict[str, Any] = {
        name: results[name].variable for name in kept if name in results.coords}
    coordinates |= {"quantity": list(QUANTITIES), "predictor": list(PREDICTORS),
                    "condition": list(CONDITIONS)}
    for (name, logarithmic), at_knots, edges in zip(
            PREDICTORS.items(), knots, cells.edges, strict=True):
        attributes = {"units": UNITS[name], "long_name": f"knots of {WORDS[name]}"}
        # A knot at an end must not leave the domain by the rounding of its logarithm.
        plain = at_knots
        if logarithmic:
            plain = np.clip(np.exp(at_knots), edges[0], edges[-1])
        coordinates[name] = (name, plain, attributes)
        for ending, ends in (("low", edges[:-1]), ("high", edges[1:])):
            coordinates[f"cell_{name}_{ending}"] = (f"cell_{name}", ends, {
                "units": UNITS[name], "long_name": f"{ending} end of cells of {WORDS[name]}"})
    for name, edges in zip(CONDITIONS, region.edges, strict=True):
        coordinates[f"region_{name}"] = (f"region_{name}", edges[:-1], {
            "units": UNITS[name], "long_name": f"low end of cells of the region of {WORDS[name]}"})
    focal = focal_size.astype(np.float64)
    return with_sampling(xr.Dataset(variables, coordinates, attrs={
        "focal_size_px_m": float(focal.mean()),
        "focal_size_varies": int(float(focal.max()) > float(focal.min()) * (1 + 1e-9)),
    }), results)


def _fits(
    moments: Floats, own: Sequence[Sequence[Floats]], knots: Sequence[Floats]
) -> list[Fit]:
    """Return the fits of the errors with their own knots, at those of all."""
    points, fits = grid_points(knots), []
    for quantity, of_error in enumerate(own):
        sums = BinSums.of(moments, quantity)
        fit = fit_error(sums, hat_basis(sums.at, of_error), differences(of_error))
        fits.append(fit.at(hat_basis(points, of_error)))
    return fits


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


Table = dict[str, tuple[tuple[str, ...], NDArray[Any], dict[str, Any]]]
"""Variables of one model: dimensions, values, attributes."""


def _check_solved(moments: Floats, results: xr.Dataset, kept: Sequence[str]) -> None:
    """Raise DatasetError if a configuration has too few solved poses."""
    solved = moments[..., 0].sum(axis=2).min(axis=1).astype(int) * HALVES
    for number, count in enumerate(solved.tolist()):
        if count < MIN_POSES:
            index = np.unravel_index(number, [results.sizes[name] for name in kept])
            which = ", ".join(f"{name} = {results[name].values[k]}"
                              for name, k in zip(kept, index, strict=True))
            raise DatasetError(
                f"{which + ': ' if which else ''}{count:,} solved poses that are not flipped; an "
                f"error model needs {MIN_POSES} or more: more trials, or larger sides")


def _region_variables(
    region: Bins, drawn: Sequence[int], directions: Floats, counts: Floats, reach: Floats
) -> Table:
    """Return the joint region of the conditions that was seen.

    ``counts`` (halves, cells, 1) are the poses looked for, ``reach`` their projections.
    """
    cells = counts.sum(axis=(0, 2)).reshape(region.shape)
    of_grid = cells.sum(axis=tuple(drawn))
    draws = np.where(of_grid > 0, of_grid, np.inf).min()
    low, high = region_ends(directions, reach[None], np.array([draws]))
    return {
        "region_low": (("direction",), low[0], cf_attributes(
            "smallest weighted sum of a direction in the region", "")),
        "region_high": (("direction",), high[0], cf_attributes(
            "largest weighted sum of a direction in the region", "")),
        "region_seen": (tuple(f"region_{name}" for name in CONDITIONS), cells > 0, cf_attributes(
            "whether a cell of the conditions has poses", "1")),
    }


def _metres(distance_m: Floats) -> Floats:
    """Return what errors (quantities, distances) are multiplied with: positions with distances."""
    scale = np.where(np.arange(len(QUANTITIES)) < 3, 1.0, 0.0)[:, None]
    return np.asarray(scale * distance_m + (1.0 - scale))


def _knot_variables(fits: Sequence[Fit], knots: Sequence[Floats]) -> Table:
    """Return sigma and bias of each error at the knots, with their intervals."""
    shape = (len(QUANTITIES), *map(len, knots))
    metres = _metres(np.exp(knots[0]))[:, :, None, None]
    table: Table = {}
    for (ending, words), side in zip(INTERVAL.items(), (0.0, -1.0, 1.0), strict=True):
        by_name = {
            "sigma": ("standard deviation of the error", [np.exp(0.5 * (
                fit.log_variance + side * DEVIATIONS * fit.log_variance_error)) for fit in fits]),
            "bias": ("mean error, estimated minus true", [
                fit.bias + side * DEVIATIONS * fit.bias_error for fit in fits])}
        table |= {f"{name}{ending}": (
            ("quantity", *PREDICTORS), np.stack(values).reshape(shape) * metres,
            cf_attributes(f"{words}{meaning}", "m, radian"))
            for name, (meaning, values) in by_name.items()}
    return table


def _cell_variables(halves: Floats, bins: Bins) -> Table:
    """Return whether the model may be used in cells; ``halves`` (halves, cells, columns)."""
    sums = halves.sum(axis=0)
    looked_for, solved, flipped, n = np.rint(sums[:, : len(COUNTS)]).astype(np.int64).T
    shown = slice(len(COUNTS), len(COUNTS) + len(QUANTITIES))
    with np.errstate(invalid="ignore", divide="ignore"):
        coverage, camera = np.split(sums[:, len(COUNTS):] / n[:, None], 2, axis=1)
        flip_rate, solved_rate = flipped / solved, solved / looked_for
        of_half = halves[..., shown] / halves[..., [COUNTS.index("judged")]]
        spread, spread_of_half = (np.sqrt(NOMINAL * (1.0 - NOMINAL) / count)[..., None]
                                  for count in (n, halves[..., COUNTS.index("judged")]))
    # Limits are wider by a standard error, of each half by two.
    low, high = (
        (sign * (coverage - limit) > spread) | (
            sign * (of_half - limit) > 2.0 * spread_of_half).any(axis=0)
        for sign, limit in zip((-1.0, 1.0), COVERAGE, strict=True))
    use = np.select(
        [(looked_for == 0)[:, None], (solved_rate < MIN_DETECTION)[:, None],
         (flip_rate > MAX_FLIPS)[:, None], (n < MIN_JUDGED)[:, None], low, high],
        [Use.no_poses, Use.rarely_solved, Use.flips, Use.few_draws, Use.too_narrow, Use.too_wide],
        Use.holds).astype(np.uint8)
    cells = tuple(f"cell_{name}" for name in PREDICTORS)
    by_quantity = {
        "coverage": (coverage, cf_attributes("share of held-out errors within two sigma of the "
                                             "bias", "1")),
        "camera_coverage": (camera, cf_attributes(
            "the same along and about the camera's own axes", "1")),
        "use": (use, cf_attributes("whether the model may be used", "", flags=Use))}
    by_cell = {
        "judged": (n, "held-out poses that were judged"),
        "looked_for": (looked_for, "poses looked for"),
        "solved_rate": (solved_rate, "solved of the poses looked for"),
        "flip_rate": (flip_rate, "nearer to the mirror of the truth, of the solved")}
    return {name: (("quantity", *cells), values.T.reshape(-1, *bins.shape), attributes)
            for name, (values, attributes) in by_quantity.items()} | {
        name: (cells, values.reshape(bins.shape), cf_attributes(meaning, "1"))
        for name, (values, meaning) in by_cell.items()}


def _exponents(moments: Floats) -> Table:
    """Return the power of the distance, or of the side, with which sigma goes."""
    values = np.full((3, len(QUANTITIES)), np.nan)
    for k in range(len(QUANTITIES)):
        sums = BinSums.of(moments, k)
        axis = 0 if np.ptp(sums.at[:, 0]) > 0.05 or np.ptp(sums.at[:, 1]) < 0.05 else 1
        if np.ptp(sums.at[:, axis]) < 0.05:
            continue
        angles = np.unique(np.quantile(sums.at[:, 2], [0, 0.25, 0.5, 0.75, 1]).round(3))
        design = np.concatenate([sums.at[:, [axis]], hat_basis(sums.at[:, [2]], [angles])], axis=1)
        fit = fit_error(sums, design, np.zeros([design.shape[1]] * 2))
        metres = 1.0 if axis == 0 and k < 3 else 0.0
        half = DEVIATIONS * 0.5 * fit.log_variance_error[0]
        values[:, k] = 0.5 * fit.log_variance[0] + metres + half * np.array([0.0, -1.0, 1.0])
    words = "power of the distance (of the side, if only that varies) with which sigma goes"
    return {f"exponent{ending}": (("quantity",), each, cf_attributes(text + words, "1"))
            for (ending, text), each in zip(INTERVAL.items(), values, strict=True)}


# --------------------------------------------------------------------------------------------------
# Sums of a block's poses, in bins: moments of errors, and how many lie within two sigma.

QUANTITIES = ("x", "y", "z", "rotation_x", "rotation_y", "rotation_z")
"""Errors in the sight frame: of the position (m), and the rotation vector (rad)."""

HALVES = 2
"""The even trials and the odd ones."""

HALF, FOCAL_SIZE = "half", "focal_size"
"""Names of a block's arrays: the half, fx times the marker's side."""

COUNTS = ("looked_for", "solved", "flipped", "judged")
"""Columns of what is judged before the shares."""


class SightErrors(Poses):
    """Poses with their errors in the sight frame."""

    @cached_property
    def distance_m(self) -> Floats:
        """True z of the marker's centre (...)."""
        return np.asarray(self[DEPTH], dtype=np.float64)

    @cached_property
    def side_px(self) -> Floats:
        """The black square's side (...), were it parallel to the image: fx · size / distance."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self[FOCAL_SIZE] / self.distance_m, dtype=np.float64)

    @cached_property
    def viewing_angle_deg(self) -> Floats:
        """Angle (...) between the marker's normal and the line of sight."""
        return viewing_angle_of(self["true_rvec"], self["true_tvec_m"])

    @cached_property
    def bearing_deg(self) -> Floats:
        """Angle (...) between the line of sight and the optical axis."""
        return bearing_of(self["true_tvec_m"])

    @property
    def conditions(self) -> tuple[Floats, ...]:
        """Distance, side, viewing angle and bearing, each (...)."""
        return self.distance_m, self.side_px, self.viewing_angle_deg, self.bearing_deg

    @cached_property
    def in_camera(self) -> Floats:
        """Errors (..., 6) along and about the camera's axes; positions over the distance."""
        position = self["translation_error_m"].astype(np.float64) / self.distance_m[..., None]
        return np.concatenate(
            [position, self["rotation_error_rad"].astype(np.float64)], axis=-1)

    @cached_property
    def in_sight(self) -> Floats:
        """The same in the sight frame."""
        parts = (self.in_camera[..., :3], self.in_camera[..., 3:])
        return np.concatenate(
            [in_sight_frame(part, self["true_tvec_m"]) for part in parts], axis=-1)

    def at(self, used: Masks) -> Floats:
        """Return ln(distance), ln(side), viewing angle and bearing of the used poses, (n, 4)."""
        distance, side, *angles = (self.used(each, used) for each in self.conditions)
        return np.stack([np.log(distance), np.log(side), *angles], axis=-1)

    @staticmethod
    def used(values: NDArray[Any], used: Masks) -> NDArray[Any]:
        """Return the values (n, ...) of the used poses."""
        return np.broadcast_to(values, (*used.shape, *values.shape[used.ndim:]))[used]


def _add(bins: Bins, poses: SightErrors, used: Masks, columns: Sequence[Any]) -> Floats:
    """Return sums (groups, halves, bins, columns) over the used poses that lie in a bin.

    ``used`` has the shape of the poses' flags; columns are (n,) of all used ones, or 1 each.
    """
    number, inside = bins.numbers(*poses.conditions[: len(bins.edges)])
    groups, size = len(poses.detection), math.prod(bins.shape)
    flat = (np.arange(groups).reshape(-1, 1, 1, 1) * HALVES + poses[HALF]) * size + number
    at = np.broadcast_to(flat, used.shape)[used]
    within = np.broadcast_to(inside, used.shape)[used]
    sums = [np.bincount(at, np.where(within, each, 0.0), groups * HALVES * size)
            for each in columns]
    return np.stack(sums, axis=-1).reshape(groups, HALVES, size, len(columns)).astype(float)


def _counted(bins: Bins, poses: SightErrors) -> Floats:
    """Return the numbers of poses looked for, (groups, halves, bins, 1)."""
    return _add(bins, poses, poses.looked_for, [1.0])


def _reach(directions: Floats, poses: SightErrors) -> Floats:
    """Return how far the poses looked for reach, (groups, 2 x directions).

    That is the largest projection on each direction (directions, 4) in ln(distance), ln(side),
    viewing angle and bearing, then on its opposite.
    """
    shape = poses.looked_for.shape
    counted = poses.looked_for & (poses.distance_m > 0)
    of_group = np.broadcast_to(np.arange(shape[0]).reshape(-1, 1, 1, 1), shape)[counted]
    projected = poses.at(counted) @ directions.T
    reach = np.full((shape[0], 2 * len(directions)), -np.inf)
    np.maximum.at(reach, of_group, np.concatenate([projected, -projected], axis=-1))
    return reach


def _moments(bins: Bins, poses: SightErrors, _: slice) -> Floats:
    """Return numbers of poses, sums of their coordinates and of the powers of each error."""
    used = poses.unflipped & poses.looked_for
    errors = poses.used(poses.in_sight, used)
    columns = [1.0, *poses.at(used)[:, :3].T]
    for error in errors.T:
        columns += [error, error**2, error**2 * error, (error**2) ** 2]
    return _add(bins, poses, used, columns)


def _within(
    bins: Bins, knots: Sequence[Floats], fitted: Floats, poses: SightErrors, groups: slice
) -> Floats:
    """Return how many errors lie within two standard deviations of the bias.

    The columns are `COUNTS`; those within, for each error in the sight frame; the same along and
    about the camera's axes. Each half of the trials is judged by the model of the other: ``fitted``
    (models, halves, knots, quantities, 2) are bias and ln(variance).
    """
    used = poses.unflipped & poses.looked_for
    half = poses.used(poses[HALF], used)
    model = poses.used(
        groups.start + np.arange(len(poses.detection)).reshape(-1, 1, 1, 1), used)
    basis = hat_basis(poses.at(used)[:, :3], knots)
    bias, log_variance = np.moveaxis(
        np.einsum("nk,nkqv->nqv", basis, fitted[model, 1 - half]), -1, 0)
    sigma = np.exp(0.5 * log_variance)
    sight, camera = (poses.used(each, used) for each in (poses.in_sight, poses.in_camera))
    turn = sight_rotation(poses.used(poses["true_tvec_m"], used))
    columns = [*(np.abs(sight - bias) <= 2.0 * sigma).T]
    for part in (slice(0, 3), slice(3, 6)):
        mean = np.einsum("nij,nj->ni", turn, bias[:, part])
        spread = np.sqrt(np.einsum("nij,nj->ni", turn**2, sigma[:, part] ** 2))
        columns += [*(np.abs(camera[:, part] - mean) <= 2.0 * spread).T]
    counts = [_add(bins, poses, mask & poses.looked_for, [1.0])
              for mask in (poses.looked_for, poses.solved, poses.flipped, poses.unflipped)]
    return np.concatenate([*counts, _add(bins, poses, used, columns)], axis=-1)


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
    bias = model["bias"].values / _metres(model["distance_m"].values)[:, :, None, None]
    flat = (len(QUANTITIES), -1)
    values = {
        "sigma": np.exp(basis @ np.log(model["sigma"].values).reshape(flat).T),
        "bias": basis @ bias.reshape(flat).T * _metres(distance).T,
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
