"""Two treatments of the same scenes, pose by pose: what differs, and whether that is chance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import special

from sweep.analysis.blocks import Arrays, Bins, aggregate, axes_of, fingerprint_of, kept_of
from sweep.analysis.intervals import wilson
from sweep.analysis.pose_view import QUANTITIES, Poses, Quantity, errors, norm_squared
from sweep.analysis.statistics import (
    Count,
    Draws,
    Mean,
    Rate,
    RootMeanSquare,
    RootMeanSquareRatio,
    Statistic,
    in_draws,
)
from sweep.errors import StoreError
from sweep.plan.parameters import GEOMETRY_SECTIONS, PARAMETERS, Stage
from sweep.plan.schema import SCHEMA
from sweep.typing import Floats

Integers = NDArray[np.int64]
Masks = NDArray[np.bool_]


TRUTH = ("true_tvec_m", "true_rvec")


class Pair:
    """The same poses, treated in two ways."""

    def __init__(self, arrays: Arrays) -> None:
        self.first, self.second = Poses(arrays, "first "), Poses(arrays, "second ")

    @property
    def draws(self) -> Masks:
        """Which draws were run in both: (groups, cells, draws)."""
        return self.first.draws & self.second.draws

    @property
    def compared(self) -> Masks:
        """Poses that were looked for in both."""
        return self.first.looked_for & self.second.looked_for

    @property
    def differing(self) -> Masks:
        """Poses whose truth differs."""
        names = [name for name in TRUTH if name in self.first and name in self.second]
        differ = [(self.first[name] != self.second[name]).any(axis=-1) for name in names]
        return np.asarray(np.any(differ, axis=0))

    @property
    def both_solved(self) -> Masks:
        """Poses that were solved in both."""
        return self.first.solved & self.second.solved


def compare(
    first: xr.Dataset, second: xr.Dataset, per: Sequence[str] = (), bins: Bins | None = None
) -> xr.Dataset:
    """Return what differs between two treatments of the same scenes: dimensions (*per, *bins).

    ``first`` and ``second`` are two treatments of one store, such as
    ``results.sel(solver="ippe")`` and ``results.sel(solver="sqpnp")``, or two stores over the same
    scenes, with the same dimensions and coordinates. ``per`` and ``bins`` (of a variable of
    ``first``) as in `sweep.analysis.rates.detection_rate`. Differences are second minus first.

    - ``compared`` poses were looked for in both; ``both_detected``, ``only_first_detected``,
      ``only_second_detected``, ``neither_detected`` of them. ``detection_difference`` of the rates
      has the interval of Newcombe (Statistics in Medicine 17, 1998, method 10).
      ``detection_p_value``: McNemar's test, exact: how often chance alone makes the two discordant
      counts as unequal.
    - ``different_scenes``: compared poses whose truth differs, as those of stores with other
      distributions. Where there are any, nothing is paired, and the test compares two samples.
    - ``both_solved``, ``only_first_solved``, ``only_second_solved``, ``neither_solved``.
    - Of the poses solved in both: ``*_difference_*``, the mean difference of the absolute errors,
      and ``*_rmse_ratio``, the second's RMSE over the first's. They say nothing of the poses that
      one treatment alone solved, which as a rule are the hard ones: see the counts.

    Intervals are of the draws, paired, on a fixed grid; with pooled settings counts are scaled to
    draws. Where nothing was drawn there is none, and no p-value.

    Lazy where the datasets are. Raises ``StoreError`` where their dimensions, coordinates or seeds
    differ, and for a dimension that is not there.
    """
    kept = kept_of(first, per)
    kept_of(second, per)
    _see_that_they_pair(first, second)
    alone = [name for name, value in first.coords.items() if not value.dims
             and not (name in second.coords and value.equals(second.coords[name]))]
    first = first.drop_vars(alone)  # such as the name of its solver
    needed = _both(_with_truth(first), _with_truth(second))
    statistics: list[Statistic] = []
    for what, seen in (("detected", lambda poses: poses.detected),
                       ("solved", lambda poses: poses.solved)):
        for name, one, other in (("both", True, True), ("only_first", True, False),
                                 ("only_second", False, True), ("neither", False, False)):
            def ended(
                pair: Pair, seen: Any = seen, one: bool = one, other: bool = other
            ) -> Masks:
                agree = (seen(pair.first) == one) & (seen(pair.second) == other)
                return np.asarray(pair.compared & agree)

            words = f"compared poses, {what} in {name.replace('_', ' ')}"
            statistics.append(Count(f"{name}_{what}", words, ended))
    statistics.append(Draws("compared", "poses that were looked for in both",
                            lambda pair: pair.compared))
    statistics.append(Count(
        "different_scenes", "compared poses whose truth differs, so that they are no pairs",
        lambda pair: pair.compared & pair.differing))
    for quantity in QUANTITIES:
        statistics += _differences(quantity)
    table = aggregate(first, needed, kept, statistics, bins, Pair)
    return table.assign(_tested(table)).drop_vars("drawn")


def _differences(quantity: Quantity) -> list[Statistic]:
    def both_squares(pair: Pair) -> Floats:
        sides = (pair.first, pair.second)
        return np.stack([norm_squared(quantity.vector(side)) for side in sides], axis=-1)

    def solved(pair: Pair) -> Masks:
        return pair.both_solved

    words = quantity.words
    return [
        Mean(quantity.named("difference"), f"mean difference of the absolute {words}",
             quantity.units, lambda pair: np.diff(np.sqrt(both_squares(pair))), solved),
        RootMeanSquareRatio(f"{quantity.name}_rmse_ratio", f"second RMS {words} over the first",
                            "1", both_squares, solved),
    ]


def _see_that_they_pair(first: xr.Dataset, second: xr.Dataset) -> None:
    """Raise StoreError where two datasets are not of the same scenes."""
    for name, value in first.coords.items():
        here = name in PARAMETERS and PARAMETERS[str(name)].section in GEOMETRY_SECTIONS
        if here and not value.dims and name in second.coords and not second[name].dims:
            values = value.item(), second[name].item()
            if values[0] != values[1]:
                raise StoreError(f"not the same scenes: {name} is {values[0]} and {values[1]}, "
                                 "of which the draws are others")
    one, other = axes_of(first), axes_of(second)
    if set(one) != set(other):
        raise StoreError(f"not the same scenes: dimensions {', '.join(one) or 'none'} "
                         f"and {', '.join(other) or 'none'}")
    for name in one:
        if not np.array_equal(first[name].values, second[name].values):
            raise StoreError(f"not the same scenes: the values of {name} differ")
    seeds = [fingerprint_of(side).get("seed") for side in (first, second)]
    if None not in seeds and seeds[0] != seeds[1]:
        raise StoreError(f"not the same draws: seeds {seeds[0]} and {seeds[1]}")


def _with_truth(results: xr.Dataset) -> dict[str, xr.DataArray]:
    """Return what tells the errors, and the true poses."""
    return errors(results) | {name: results[name] for name in TRUTH if name in results}


def _both(
    first: dict[str, xr.DataArray], second: dict[str, xr.DataArray]
) -> dict[str, xr.DataArray]:
    return {f"{side} {name}": array.reset_coords(drop=True)
            for side, arrays in (("first", first), ("second", second))
            for name, array in arrays.items()}


def _tested(table: xr.Dataset) -> dict[str, xr.DataArray]:
    """Return the difference of the detection rates with its interval, and McNemar's test."""
    counts = [table[f"{name}_detected"] for name in (
        "both", "only_first", "only_second", "neither")]
    found = xr.apply_ufunc(
        newcombe_and_mcnemar, *counts, table["draws"], table["drawn"],
        output_core_dims=[[]] * 4, dask="parallelized", output_dtypes=[np.float64] * 4,
    )
    difference = "detection rate, second minus first"
    meanings = {
        "detection_difference": difference,
        "detection_difference_low": f"lower end of the 95 % interval: {difference}",
        "detection_difference_high": f"upper end of the 95 % interval: {difference}",
        "detection_p_value": "chance that the discordant counts differ so much if the detection "
                             "rates are equal (McNemar, exact)",
    }
    return {
        name: array.assign_attrs(long_name=meaning, units="1")
        for (name, meaning), array in zip(meanings.items(), found, strict=True)
    }


def newcombe_and_mcnemar(
    both: Integers, first: Integers, second: Integers, neither: Integers, draws: Integers,
    drawn: Masks,
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the difference of two paired rates, its interval's ends, and McNemar's p-value.

    ``both``, ``first`` (alone), ``second`` (alone) and ``neither`` are counts of pairs, scaled to
    ``draws`` where these are fewer; where not ``drawn`` there is no interval and no p-value.
    Newcombe, Statistics in Medicine 17 (1998), pages 2635-2650, method 10, with the continuity
    correction of the correlation; the test is the exact binomial one of the discordant pairs.
    """
    n = both + first + second + neither
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = draws / np.maximum(n, 1)
        rates, lows, highs = [], [], []
        for hits in (both + second, both + first):
            rates.append(hits / n)
            fewest, most = in_draws(hits, n, draws)
            lows.append(wilson(fewest, draws)[0])
            highs.append(wilson(most, draws)[1])
        margins = ((both + first) * (second + neither)).astype(np.float64) * (
            (both + second) * (first + neither))
        cross = both.astype(np.float64) * neither - first.astype(np.float64) * second
        # Of counts scaled to draws.
        corrected = np.maximum(cross * scale**2 - draws / 2, 0.0)
        lessened = np.where(cross > 0, corrected, cross * scale**2)
        correlation = np.where(margins > 0, lessened / (np.sqrt(margins) * scale**2), 0.0)

        def reach(up: Floats, down: Floats) -> Floats:
            squares = up**2 - 2 * correlation * up * down + down**2
            return np.sqrt(np.maximum(squares, 0.0))

        difference = rates[0] - rates[1]
        low = difference - reach(rates[0] - lows[0], highs[1] - rates[1])
        high = difference + reach(highs[0] - rates[0], rates[1] - lows[1])
        _, fewer = in_draws(np.minimum(first, second), n, draws)
        discordant = np.maximum(in_draws(first + second, n, draws)[0], fewer)
        p_value = np.minimum(1.0, 2.0 * special.bdtr(fewer, discordant, 0.5))
    low, high, p_value = (np.where(drawn, each, np.nan) for each in (low, high, p_value))
    return difference, low, high, p_value


def renderer_bias(results: xr.Dataset, reference: str = "exact") -> xr.Dataset:
    """Return what each renderer changes against ``reference``, paired scene by scene.

    Dimensions: renderer and those of the detector's settings; for the pose variables also those of
    the estimator's. All other dimensions are pooled; intervals as in `compare`.

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
    kept_of(results, ("renderer",))
    renderers = [str(name) for name in results["renderer"].values]
    if reference not in renderers:
        raise StoreError(f"reference = {reference}: the renderers are {', '.join(renderers)}")
    others = results.isel(renderer=renderers.index(reference), drop=True)

    def kept(name: str) -> list[str]:
        scene = {str(dim) for v in SCHEMA if v.stage is Stage.scene and v.name in results
                 for dim in results[v.name].dims}
        return ["renderer", *(str(dim) for dim in results[name].dims if dim not in scene)]

    def corners(side: xr.Dataset) -> dict[str, xr.DataArray]:
        return {"detection": side["detection"], "corners": side["corner_error_px"]}

    def shift(pair: Pair) -> Floats:
        moved = np.subtract(pair.second["corners"], pair.first["corners"], dtype=np.float64)
        return np.asarray((moved**2).mean(axis=(-2, -1))[..., None])

    rotation, depth = QUANTITIES[:2]

    def turned(pair: Pair) -> Floats:
        moved = np.subtract(pair.second["rotation"], pair.first["rotation"], dtype=np.float64)
        return norm_squared(np.degrees(moved))[..., None]

    table = aggregate(
        results, _both(corners(others), corners(results)), kept("detection"),
        [
            Rate("detection_disagreement", "differing of compared",
                 lambda pair: pair.first.detected != pair.second.detected,
                 lambda pair: pair.compared,
                 counts=(("compared", "poses that were looked for with both renderers"),
                         ("differing", "poses detected with one of both renderers only"))),
            RootMeanSquare(
                "corner_shift_rms_px", "RMS of a corner's coordinate minus the reference's", "px",
                shift, lambda pair: pair.first.detected & pair.second.detected),
        ],
        view=Pair,
    )
    return table.drop_vars("draws").assign(aggregate(
        results, _both(errors(others), errors(results)), kept("estimate"),
        [
            Mean("range_bias_percent",
                 "mean depth error minus the reference's, of the true depth, both solved",
                 "percent", lambda pair: depth.vector(pair.second) - depth.vector(pair.first),
                 lambda pair: pair.both_solved),
            RootMeanSquare(
                "rotation_shift_deg",
                "RMS of the rotation error minus the reference's, both solved and not flipped",
                rotation.units, turned, lambda pair: pair.first.unflipped & pair.second.unflipped),
        ],
        view=Pair,
    ))
