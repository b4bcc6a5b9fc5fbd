"""Photographs beside their simulation: how much of their errors a simulation has."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.analysis.dataset import (
    DRAWS,
    axes_of,
    configuration_axes,
    describes,
    image_sides,
    is_fixed,
    of_photographs,
    parameter_value,
    require_poses,
)
from sweep.analysis.estimator import (
    OVER_ALL,
    PREFIX,
    Arrays,
    Binning,
    Bins,
    Columns,
    Design,
    Rate,
    Unit,
    quantile_intervals,
    read_bins,
)
from sweep.analysis.intervals import (
    MIN_UNITS,
    percentile_interval,
    resampled_quantiles,
    unit_counts,
)
from sweep.analysis.poses import ERROR_INPUTS, INSIDE, QUANTITIES, Poses, pose_arrays
from sweep.analysis.rates import DETECTION_RATE, FLIP_RATE
from sweep.errors import DatasetError
from sweep.experiment.parameters import PARAMETERS, SIMULATED, Stage
from sweep.experiment.schema import LABELS, cf_attributes
from sweep.messages import label, shown
from sweep.typing import Floats, Integers, Masks

# --------------------------------------------------------------------------------------------------
# Two datasets as units of markers: photographs with theirs, and a simulation's scenes.
#
# Arrays are (configurations, 1, units, rows, ...), by the names of `Poses`: a unit is drawn with
# all its markers.

QUARTERS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Shares of the photographs' markers between which the default bins lie."""

SIDE = "side_px"

TRUTH_STD = "truth_std"

SEED = 21


@dataclass(frozen=True)
class PairedUnits:
    """Photographs and a simulation with the same configurations.

    Attributes
    ----------
    first, second
        Their arrays; units of the same index belong together if they are ``paired``.
    single
        Whether each unit of theirs has one marker.
    paired
        Whether the simulation is the photographs' twin.
    configurations, sizes, coordinates
        Names of the configurations' dimensions, their lengths and coordinates.
    binning
        The edges of the bins.
    binned
        The photographs' dataset, with what is binned.
    values
        What is binned of both: name -> (units, rows).
    """

    first: Arrays
    second: Arrays
    single: tuple[bool, bool]
    paired: bool
    configurations: tuple[str, ...]
    sizes: Mapping[str, int]
    coordinates: Mapping[str, Any]
    binning: Binning
    binned: xr.Dataset
    values: tuple[Mapping[str, Floats], Mapping[str, Floats]]

    def within(self, inside: Sequence[Masks]) -> list[Arrays]:
        """Return the arrays of both with the masks (units, rows) of the markers that count."""
        return [{**side, INSIDE: mask[None, None]}
                for side, mask in zip((self.first, self.second), inside, strict=True)]

    def bins(self) -> Iterator[tuple[Masks, Masks]]:
        """Yield which markers (units, rows) of both lie in each combination of bins."""
        for index in np.ndindex(*self.binning.shape):
            first, second = (
                np.logical_and.reduce(
                    [np.ones(side["detection"].shape[2:], dtype=bool)] + [
                        np.searchsorted(edges, values[name], side="right") - 1 == k
                        for (name, edges), k in zip(self.binning.edges.items(), index, strict=True)
                    ]
                )
                for side, values in zip((self.first, self.second), self.values, strict=True)
            )
            yield first, second


def paired_units(
    photographs: xr.Dataset, simulated: xr.Dataset, bins: Bins | None = None
) -> PairedUnits:
    """Return photographs and a simulation as units.

    Raises
    ------
    ArgumentError, DatasetError
        As in `sweep.analysis.simulation_gap`.
    """
    if not is_measured(photographs):
        raise DatasetError(
            "the first dataset: expected photographs, as `sweep photos` measures them; two "
            "simulations are compared by sweep.analysis.compare"
        )
    for side in (photographs, simulated):
        require_poses(side)
    paired = is_twin(simulated)
    first, second, names = _same_configurations(photographs, simulated, paired=paired)
    if paired:
        first, second = _same_scenes(first, second)
    if bins is None:
        bins = {} if paired else {SIDE: _quarters(first)}
    binning, _ = read_bins(first, names, bins)
    single = (not of_photographs(first), not of_photographs(second))
    arrays = []
    for side, one in zip((first, second), single, strict=True):
        columns = pose_arrays(side, ERROR_INPUTS) | {
            f"{PREFIX}{name}": _binned(side, name) for name in binning.edges
        }
        if paired and side is second and TRUTH_STD in side:
            columns[TRUTH_STD] = side[TRUTH_STD]
        arrays.append(_in_units(side, columns, names, single=one))
    if paired:
        trials = _trials_of(first, second)
        kept = np.flatnonzero((trials >= 0).any(axis=1))
        arrays = [{name: array[:, :, kept] for name, array in arrays[0].items()},
                  {name: _gathered(array, trials[kept]) for name, array in arrays[1].items()}]
        _blur_truth(arrays[1])
        single = (False, False)
    values = [
        {name: side.pop(f"{PREFIX}{name}")[0, 0] for name in binning.edges} for side in arrays
    ]
    return PairedUnits(
        arrays[0], arrays[1], single, paired, names,
        {name: first.sizes[name] for name in names},
        {name: first[name].variable for name in names}, binning, first, (values[0], values[1]),
    )


def is_measured(results: xr.Dataset) -> bool:
    """Return whether a dataset is measured in photographs."""
    return of_photographs(results) and not is_twin(results)


def is_twin(results: xr.Dataset) -> bool:
    """Return whether a dataset is simulated at the poses of photographs."""
    return of_photographs(results) and SIMULATED in results.coords and bool(results[SIMULATED])


def _same_configurations(
    first: xr.Dataset, second: xr.Dataset, *, paired: bool
) -> tuple[xr.Dataset, xr.Dataset, tuple[str, ...]]:
    """Return both at their common settings, and the names of the axes of these.

    Axes of the scene that twins alone have are kept, too.
    """
    names = list(dict.fromkeys([*configuration_axes(first), *configuration_axes(second)]))
    for name in names:
        first, second = _with_axis(first, second, name), _with_axis(second, first, name)
        common = [each for each in first[name].values if each in second[name].values]
        if not common:
            raise DatasetError(
                f"no common {name}: {shown(first[name].values.tolist())} and "
                f"{shown(second[name].values.tolist())}; measure both with the same settings"
            )
        first, second = first.sel({name: common}), second.sel({name: common})
    if paired:
        own = [name for name in axes_of(second, Stage.scene)
               if name not in axes_of(first, Stage.scene)]
        for name in own:
            first = first.drop_vars(name, errors="ignore").expand_dims({name: second[name].values})
        names += own
    return first, second, tuple(names)


def _with_axis(results: xr.Dataset, other: xr.Dataset, name: str) -> xr.Dataset:
    """Return a dataset with an axis of its one value, if it has none and the other has one."""
    if name in results.dims:
        return results
    value = parameter_value(results, name) if name in PARAMETERS else None
    if isinstance(value, xr.DataArray):
        value = value.item()
    if value is None:
        raise DatasetError(f"{name}: one of both does not have this axis; measure both with it")
    if other[name].dtype.kind in "OU":
        value = label(value)
    return results.drop_vars(name, errors="ignore").expand_dims({name: [value]})


def _same_scenes(first: xr.Dataset, second: xr.Dataset) -> tuple[xr.Dataset, xr.Dataset]:
    """Return photographs and their twins with the markers that both have."""
    for name in axes_of(first, Stage.scene):
        if name == DRAWS or name not in second.dims:
            continue
        common = [each for each in first[name].values if each in second[name].values]
        first, second = first.sel({name: common}), second.sel({name: common})
    return first, second


def _trials_of(first: xr.Dataset, second: xr.Dataset) -> Integers:
    """Return the indices (photographs, repeats) of the trials of each photograph; -1 for none.

    Raises
    ------
    DatasetError
        If none is of these photographs.
    """
    files = [_files(each) for each in (first, second)]
    trials: dict[tuple[str, str], list[int]] = {each: [] for each in files[0]}
    for trial, each in enumerate(files[1]):
        if each in trials:
            trials[each].append(trial)
    most = max(map(len, trials.values()))
    if not most:
        raise DatasetError("the simulation is the twin of other photographs")
    return np.array([
        some + [-1] * (most - len(some)) for some in (trials[each] for each in files[0])
    ])


def _files(results: xr.Dataset) -> list[tuple[str, str]]:
    columns = [results[name].values if name in results.coords else np.empty(0)
               for name in ("photograph", "sha256")]
    return [(str(name), str(digest)) for name, digest in zip(*columns, strict=True)]


def _in_units(
    results: xr.Dataset, arrays: Mapping[str, xr.DataArray], configurations: tuple[str, ...], *,
    single: bool,
) -> dict[str, NDArray[Any]]:
    """Return arrays as (configurations, 1, units, rows, ...)."""
    scene = [name for name in axes_of(results, Stage.scene) if name not in configurations]
    if DRAWS in scene:
        scene = [DRAWS, *(name for name in scene if name != DRAWS)]
    dims = (*configurations, *scene)
    count = int(np.prod([results.sizes[name] for name in configurations]))
    units = int(np.prod([results.sizes[name] for name in (scene if single else scene[:1])]))
    laid_out = {}
    for name, array in arrays.items():
        inner = [str(dim) for dim in array.dims if dim in LABELS]
        missing = {dim: results.sizes[dim] for dim in dims if dim not in array.dims}
        values = array.reset_coords(drop=True).drop_vars(array.indexes, errors="ignore")
        values = values.expand_dims(missing).transpose(*dims, *inner)
        shape = tuple(values.sizes[dim] for dim in inner)
        laid_out[name] = np.asarray(values).reshape(count, 1, units, -1, *shape)
    return laid_out


def _blur_truth(arrays: dict[str, NDArray[Any]]) -> None:
    """Add the truth's random error, as far as it is known, to errors of twins.

    The photographs' errors are differences to a truth that has such an error, the twins' to an
    exact one. A draw is of a marker, the same for all its configurations.
    """
    std = arrays.pop(TRUTH_STD, None)
    if std is None:
        return
    drawn = np.random.default_rng(SEED).normal(size=std.shape[1:]) * np.nan_to_num(std)
    for name, part in (("rotation_error_rad", drawn[..., :3]),
                       ("translation_error_m", drawn[..., 3:])):
        arrays[name] = arrays[name] + part


def _gathered(array: NDArray[Any], trials: Integers) -> NDArray[Any]:
    """Return an array (c, 1, t, rows, ...) of trials as that of photographs (c, 1, p, rows, ...).

    ``trials`` is (p, repeats); of -1 nothing counts, and flags are 0.
    """
    taken = array[:, :, np.maximum(trials, 0)]
    absent = (trials < 0).reshape(1, 1, *trials.shape, *(1,) * (array.ndim - 3))
    filler = np.nan if array.dtype.kind == "f" else 0
    taken = np.where(absent, np.asarray(filler, dtype=array.dtype), taken)
    return taken.reshape(*taken.shape[:3], -1, *array.shape[4:])


def _binned(results: xr.Dataset, name: str) -> xr.DataArray:
    """Return what is binned of a dataset: a variable, or what follows from others."""
    if name in results.variables and not is_fixed(results[name]):
        return results[name].reset_coords(drop=True)
    if name == SIDE:
        return image_sides(results, {})
    if name == "distance_m":
        return results["true_tvec_m"].isel(xyz=2, drop=True)
    raise DatasetError(f"{name}: both datasets need it for bins; one has "
                       f"{', '.join(map(str, results.variables))}")


def _quarters(photographs: xr.Dataset) -> list[float]:
    """Return edges between the quarters of the photographs' sides, of two significant digits."""
    sides = photographs[SIDE].values
    edges = np.quantile(sides[np.isfinite(sides)], QUARTERS)
    rounded = [float(f"{edge:.2g}") for edge in edges]
    rounded[0], rounded[-1] = float(np.floor(edges[0])), float(np.floor(edges[-1]) + 1)
    return sorted(set(rounded))


# --------------------------------------------------------------------------------------------------
# Photographs against a simulation: what of the errors in photographs the simulation has.

SOURCES = ("photographs", "simulated")

PERCENTS = {"median": 50, "p90": 90}

BY_PHOTOGRAPH = Design(Unit.photograph)
"""A photograph, or a scene of a simulation, is the draw."""


@dataclass(frozen=True, kw_only=True)
class Compared:
    """What is compared: by its ratio, or else by its difference."""

    name: str
    meaning: str
    units: str = "1"
    ratio: bool = False


@dataclass(frozen=True, kw_only=True)
class GapRate(Compared):
    """A rate of markers."""

    rate: Rate[Poses]


@dataclass(frozen=True, kw_only=True)
class GapQuantile(Compared):
    """A quantile of the errors (...) of solved poses."""

    error: Callable[[Poses], Floats]
    percent: int = 50


RATES = tuple(GapRate(name=each.rate.name, meaning=each.rate.meaning, rate=each.rate)
              for each in (DETECTION_RATE, FLIP_RATE))

QUANTILES = (
    GapQuantile(name="range_bias_percent", meaning="median depth error of the true depth, solved",
                units="percent", error=lambda poses: poses.range_percent[..., 0]),
    *(
        GapQuantile(
            name=quantity.named(statistic), units=quantity.units, ratio=True, error=quantity.norm,
            meaning=f"{percent} % quantile of the absolute {quantity.words}, solved",
            percent=percent)
        for quantity in QUANTITIES[:2] for statistic, percent in PERCENTS.items()
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
    (`sweep.analysis.intervals`), in which twins are drawn together with their photographs; scenes
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
        variables[name] = (own, values.reshape((*values.shape[:-2], *shape)), attributes)
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
    arrays = pair.within(inside)
    sides = [Poses(each) for each in arrays]
    table: dict[str, Any] = {
        name: np.stack([getattr(side, name).sum(axis=OVER_ALL) for side in sides])
        for name in ("looked_for", "solved")
    }
    table["units"] = np.stack([side.looked_for.any(axis=(1, 3)).sum(axis=1) for side in sides])
    for each in RATES:
        table |= _rates(each.rate, arrays)
    counts = [None if single else unit_counts(side.looked_for.shape[2])
              for side, single in zip(sides, pair.single, strict=True)]
    if pair.paired:
        counts = [counts[0], counts[0]]
    for what in QUANTILES:
        errors = [what.error(side) for side in sides]
        rows = [_quantiles(what, [error[k, 0] for error in errors],
                           [side.solved[k, 0] for side in sides], counts)
                for k in range(len(errors[0]))]
        for name in rows[0]:
            table[name] = np.stack([row[name] for row in rows], axis=-1)
    return table


def _rates(rate: Rate[Poses], arrays: Sequence[Arrays]) -> dict[str, Any]:
    """Return a rate of both, its difference, and their intervals."""
    found = [rate.variables(Columns(each, Poses), BY_PHOTOGRAPH) for each in arrays]
    names = rate.name, f"{rate.name}_low", f"{rate.name}_high"
    value, low, high = (np.stack([each[name] for each in found]) for name in names)
    table = dict(zip(names, (value, low, high), strict=True))
    gap = value[1] - value[0]
    table[f"{rate.name}_gap"] = gap
    table[f"{rate.name}_gap_low"] = gap - np.hypot(value[1] - low[1], high[0] - value[0])
    table[f"{rate.name}_gap_high"] = gap + np.hypot(high[1] - value[1], value[0] - low[0])
    return table


def _quantiles(
    each: GapQuantile, errors: Sequence[Floats], solved: Sequence[Masks], counts: Sequence[Any],
) -> dict[str, Any]:
    """Return a quantile of both of one configuration, its gap, and their intervals.

    ``errors`` and ``solved`` are (units, rows) of each.
    """
    values, ends, replicates, units = [], [], [], []
    for error, some, drawn in zip(errors, solved, counts, strict=True):
        used, share = some & np.isfinite(error), each.percent / 100.0
        interval = quantile_intervals(
            np.where(used, error, np.nan)[None, None], used.sum(axis=1)[None, None],
            [each.percent], BY_PHOTOGRAPH)[0, 0].tolist()
        values.append(interval[0])
        replicates.append(resampled_quantiles(error, used, drawn, share))
        units.append(int(used.any(axis=1).sum()))
        ends.append(interval[1:] if units[-1] >= MIN_UNITS else (np.nan, np.nan))
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
