"""Photographs against a simulation: what of the errors in photographs the simulation has."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis.binning import Bins
from sweep.analysis.described import describes
from sweep.analysis.paired_units import PairedUnits, Units, paired_units
from sweep.analysis.photograph_quantiles import quantile_ends, quantile_of
from sweep.analysis.photograph_rates import PhotographRate
from sweep.analysis.resampling import (
    MIN_UNITS,
    percentile_interval,
    resampled_quantiles,
    unit_counts,
)
from sweep.plan.variable import cf_attributes
from sweep.typing import Floats, Masks

SOURCES = ("photographs", "simulated")

PERCENTS = {"median": 50, "p90": 90}


@dataclass(frozen=True, kw_only=True)
class Compared:
    """What is compared: by its ratio, or else by its difference."""

    name: str
    meaning: str
    units: str = "1"
    ratio: bool = False


@dataclass(frozen=True, kw_only=True)
class GapRate(Compared):
    """A rate of markers: fields of `Units`."""

    successes: str
    used: str


@dataclass(frozen=True, kw_only=True)
class GapQuantile(Compared):
    """A quantile of the errors of solved poses: a field of `Units`."""

    error: str
    percent: int = 50
    absolute: bool = True


RATES = (
    GapRate(name="detection_rate", meaning="detected of looked_for", successes="detected",
            used="looked_for"),
    GapRate(name="flip_rate", meaning="nearer to the mirror of the truth, of solved",
            successes="flipped", used="solved"),
)

QUANTILES = (
    GapQuantile(name="range_bias_percent", meaning="median depth error of the true depth, solved",
                units="percent", error="range_percent", absolute=False),
    *(
        GapQuantile(
            name=f"{name}_{statistic}_{unit}", units=units, error=f"{name}_{unit}", ratio=True,
            meaning=f"{percent} % quantile of the absolute {words}, solved", percent=percent,
        )
        for name, unit, units, words in (
            ("rotation", "deg", "degree", "rotation error"),
            ("range", "percent", "percent", "depth error of the true depth"),
        )
        for statistic, percent in PERCENTS.items()
    ),
)
"""What is compared, in the order of the table."""


@describes
def simulation_gap(
    photographs: xr.Dataset, simulated: xr.Dataset, bins: Bins | None = None
) -> xr.Dataset:
    """Return statistics of photographs beside those of a simulation, and the gap between them.

    Parameters
    ----------
    photographs
        The dataset of photographs, as `sweep.photos` returns it.
    simulated
        Their twins (`sweep.photographs.twins`), which are compared marker by marker, or any other
        simulation, which is compared bin by bin.
    bins
        Edges (n + 1,) of bins [low, high) of variables of the scene, by name. Default: none for
        twins; else the quarters of the photographs' ``side_px``.

    Returns
    -------
    xr.Dataset
        Dimensions: the settings of detector and estimator that both have (and what the twins'
        scenes vary), then the bins; of both sources also ``source``, "photographs" or "simulated".
        The interval of ``x`` is in ``x_low`` and ``x_high``.

        - ``looked_for``, ``solved``: markers, times repeats; ``units``: photographs, or scenes of
          a simulation, that have any.
        - ``detection_rate`` of ``looked_for``, ``flip_rate`` of ``solved``.
        - ``range_bias_percent``: median depth error of the solved; ``rotation_median_deg``,
          ``rotation_p90_deg``, ``range_median_percent``, ``range_p90_percent``: quantiles of their
          absolute errors.
        - ``x_gap`` of each: simulated minus photographs of rates and of the bias, simulated over
          photographs of quantiles of absolute errors.

    Raises
    ------
    ArgumentError
        For bins that cannot be.
    DatasetError
        If the first is not of photographs, if the second is the twin of other photographs, or if
        they have no setting in common.

    Notes
    -----
    The photographs' errors have the random error of their truth in them. To those of twins as much
    is added: a draw for each marker, of ``truth_std`` where it is known.

    95 % intervals in which a photograph with all its markers is the draw; NaN of errors in fewer
    than five photographs. Of rates and quantiles they are as in `sweep.analysis.error_statistics`;
    of differences of rates Newcombe's (Statistics in Medicine 17, 1998, method 10), which does not
    count on the pairing. Those of gaps of quantiles are of the bootstrap by photograph
    (`sweep.analysis.resampling`), in which twins are drawn together with their photographs; scenes
    of other simulations are drawn by themselves.

    Examples
    --------
    >>> files = ("trial", list("abcdefgh"))
    >>> shots = results.assign_coords(photographs="shots", photograph=files, sha256=files)
    >>> twins = shots.sel(solver=["ippe"]).assign_coords(simulated=True)
    >>> gap = simulation_gap(shots, twins)
    >>> gap["rotation_median_deg_gap"].values.tolist(), gap["solved"].values.tolist()
    ([1.0], [[13], [13]])
    """
    pair = paired_units(photographs, simulated, bins)
    gaps = [_gap(pair, mask) for mask in pair.bins()]
    shape = (*(pair.sizes[name] for name in pair.configurations), *pair.binning.shape)
    dims = (*pair.configurations, *pair.binning.edges)
    variables: dict[str, Any] = {}
    for name, attributes in _attributes().items():
        values = np.stack([gap[name] for gap in gaps], axis=-1)  # (..., configurations, bins)
        own = ("source", *dims) if values.ndim == 3 else dims
        variables[name] = (own, values.reshape(*values.shape[:-2], *shape), attributes)
    coordinates = {
        **pair.coordinates, **pair.binning.coordinates(pair.binned), "source": list(SOURCES),
    }
    return xr.Dataset(variables, coordinates, {"paired": int(pair.paired)})


def _attributes() -> dict[str, dict[str, Any]]:
    """Return the attributes of the variables by their names, in their order."""
    found = {
        "looked_for": cf_attributes("markers that were run, visible and modelled", "1"),
        "solved": cf_attributes("solved poses", "1"),
        "units": cf_attributes("photographs, or simulated scenes, with a marker", "1"),
    }
    compared: tuple[Compared, ...] = (*RATES, *QUANTILES)
    for each in compared:
        gap = "simulated over photographs" if each.ratio else "simulated minus photographs"
        for name, meaning, unit in (
            (each.name, each.meaning, each.units),
            (f"{each.name}_gap", f"{gap}: {each.meaning}", "1" if each.ratio else each.units),
        ):
            found[name] = cf_attributes(meaning, unit)
            for end, word in (("low", "lower"), ("high", "upper")):
                found[f"{name}_{end}"] = cf_attributes(
                    f"{word} end of the 95 % interval: {meaning}", unit
                )
    return found


def _gap(pair: PairedUnits, inside: tuple[Masks, Masks]) -> dict[str, Any]:
    """Return the variables of one bin: (sources, configurations) or (configurations,)."""
    sides = [
        side.within(mask) for side, mask in zip((pair.first, pair.second), inside, strict=True)
    ]
    table: dict[str, Any] = {
        name: np.stack([getattr(side, name).sum(axis=(1, 2)) for side in sides])
        for name in ("looked_for", "solved")
    }
    table["units"] = np.stack([side.looked_for.any(axis=2).sum(axis=1) for side in sides])
    for rate in RATES:
        table |= _rates(rate, sides)
    counts = [
        None if side.single else unit_counts(side.looked_for.shape[1]) for side in sides
    ]
    if pair.paired:
        counts = [counts[0], counts[0]]
    for each in QUANTILES:
        rows = [_quantiles(each, sides, counts, k) for k in range(len(table["units"][0]))]
        for name in rows[0]:
            table[name] = np.stack([row[name] for row in rows], axis=-1)
    return table


def _rates(rate: GapRate, sides: list[Units]) -> dict[str, Any]:
    """Return a rate of both, its difference, and their intervals."""
    statistic: PhotographRate[Mapping[str, Masks]] = PhotographRate(
        "rate", rate.meaning, lambda view: view["hit"], lambda view: view["used"]
    )
    found = []
    for side in sides:
        view = {
            name: getattr(side, source)[:, None] for name, source in
            (("hit", rate.successes), ("used", rate.used))
        }
        found.append(statistic.result(statistic.first_pass(view).fold()))
    value, low, high = (
        np.stack([each[name] for each in found]) for name in ("rate", "rate_low", "rate_high")
    )
    table = {rate.name: value, f"{rate.name}_low": low, f"{rate.name}_high": high}
    gap = value[1] - value[0]
    table[f"{rate.name}_gap"] = gap
    table[f"{rate.name}_gap_low"] = gap - np.hypot(value[1] - low[1], high[0] - value[0])
    table[f"{rate.name}_gap_high"] = gap + np.hypot(high[1] - value[1], value[0] - low[0])
    return table


def _quantiles(
    each: GapQuantile, sides: list[Units], counts: list[Any], configuration: int
) -> dict[str, Any]:
    """Return a quantile of both of one configuration, its gap, and their intervals."""
    values, ends, replicates, units = [], [], [], []
    for side, drawn in zip(sides, counts, strict=True):
        errors: Floats = getattr(side, each.error)[configuration]
        errors = np.abs(errors) if each.absolute else errors
        used = side.solved[configuration] & np.isfinite(errors)
        share = each.percent / 100.0
        values.append(quantile_of(np.sort(errors[used]), share))
        replicates.append(resampled_quantiles(errors, used, drawn, share))
        units.append(int(used.any(axis=1).sum()))
        ends.append(
            quantile_ends(errors[used], np.nonzero(used)[0], share) if units[-1] >= MIN_UNITS
            else (np.nan, np.nan)
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        gaps = replicates[1] / replicates[0] if each.ratio else replicates[1] - replicates[0]
        gap = np.divide(values[1], values[0]) if each.ratio else values[1] - values[0]
    low, high = percentile_interval(gaps, min(units))
    name = each.name
    return {
        name: np.array(values), f"{name}_low": np.array([end[0] for end in ends]),
        f"{name}_high": np.array([end[1] for end in ends]), f"{name}_gap": np.asarray(gap),
        f"{name}_gap_low": np.asarray(low), f"{name}_gap_high": np.asarray(high),
    }
