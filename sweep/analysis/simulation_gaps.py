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
    INTERVAL,
    OVER_ALL,
    PREFIX,
    Arrays,
    Binning,
    Bins,
    Columns,
    Design,
    Layout,
    Output,
    Rate,
    Unit,
    Variables,
    quantile_intervals,
    read_bins,
    with_interval,
)
from sweep.analysis.intervals import (
    MIN_UNITS,
    percentile_interval,
    resampled_quantiles,
    unit_counts,
)
from sweep.analysis.poses import ERROR_INPUTS, INSIDE, QUANTITIES, Poses, pose_arrays
from sweep.analysis.summaries import DETECTION_RATE, FLIP_RATE
from sweep.errors import DatasetError
from sweep.experiment.parameters import PARAMETERS, SIMULATED, Stage
from sweep.messages import label, shown
from sweep.typing import Floats, Integers, Masks

# --------------------------------------------------------------------------------------------------
# Two datasets as units of markers: photographs with theirs, and a simulation's scenes.
#
# Arrays are (configurations, 1, units, rows, ...), by the names of `Poses`: a unit is drawn with
# all its markers.

#: Shares of the photographs' markers between which the default bins lie.
QUARTERS = (0.0, 0.25, 0.5, 0.75, 1.0)

SIDE = "side_px"

TRUTH_STD = "truth_std"

SEED = 21


@dataclass(frozen=True)
class PairedUnits:
    """Photographs and a simulation with the same configurations.

    Attributes
    ----------
    sides
        Their arrays; units of the same index belong together if they are ``paired``.
    single
        Whether each unit of theirs has one marker.
    paired
        Whether the simulation is the photographs' twin.
    coordinates
        Coordinates of the configurations by the names of their dimensions.
    binning, bin_coordinates
        The edges of the bins, and the bins' coordinates.
    values
        Binned variables of both: name -> (units, rows).
    """

    sides: Sequence[Arrays]
    single: Sequence[bool]
    paired: bool
    coordinates: Mapping[str, xr.Variable]
    binning: Binning
    bin_coordinates: Mapping[str, Any]
    values: Sequence[Mapping[str, Floats]]

    @property
    def configurations(self) -> tuple[str, ...]:
        """Names of the configurations' dimensions."""
        return tuple(self.coordinates)

    def within(self, inside: Sequence[Masks]) -> list[Arrays]:
        """Return the arrays of both with the masks (units, rows) of the markers that count."""
        return [{**side, INSIDE: mask[None, None]}
                for side, mask in zip(self.sides, inside, strict=True)]

    def bins(self) -> Iterator[tuple[Masks, ...]]:
        """Yield which markers (units, rows) of both lie in each combination of bins."""
        shapes = [side["detection"].shape[2:4] for side in self.sides]
        for masks in zip(*map(self.binning.masks, self.values), strict=True):
            yield tuple(map(np.broadcast_to, masks, shapes))


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
        for name in axes_of(first, Stage.scene):
            if name != DRAWS and name in second.dims:
                first, second = _common(first, second, name)
    if bins is None:
        bins = {} if paired else {SIDE: _quarters(first)}
    binning, _ = read_bins(first, names, bins)
    single = [not of_photographs(side) for side in (first, second)]
    arrays = []
    for side, one in zip((first, second), single, strict=True):
        columns = pose_arrays(side, ERROR_INPUTS) | {
            f"{PREFIX}{name}": _binned(side, name) for name in binning.edges}
        if paired and side is second and TRUTH_STD in side:
            columns[TRUTH_STD] = side[TRUTH_STD]
        scene = [name for name in axes_of(side, Stage.scene) if name not in names]
        scene.sort(key=lambda name: name != DRAWS)
        units, rows = (scene, []) if one else (scene[:1], scene[1:])
        sizes = {name: side.sizes[name] for name in (*names, *scene)}
        layout = Layout(sizes, names, (), tuple(units), tuple(rows))
        arrays.append({name: layout.arranged(array) for name, array in columns.items()})
    if paired:
        trials = _trials_of(first, second)
        kept = np.flatnonzero((trials >= 0).any(axis=1))
        arrays = [{name: array[:, :, kept] for name, array in arrays[0].items()},
                  {name: _gathered(array, trials[kept]) for name, array in arrays[1].items()}]
        _blur_truth(arrays[1])
        single = [False, False]
    values = [{name: side.pop(f"{PREFIX}{name}")[0, 0] for name in binning.edges}
              for side in arrays]
    return PairedUnits(arrays, single, paired, {name: first[name].variable for name in names},
                       binning, binning.coordinates(first), values)


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
        ours, theirs = _with_axis(first, second, name), _with_axis(second, first, name)
        first, second = _common(ours, theirs, name)
        if not first.sizes[name]:
            raise DatasetError(
                f"no common {name}: {shown(ours[name].values.tolist())} and "
                f"{shown(theirs[name].values.tolist())}; measure both with the same settings")
    if paired:
        own = [name for name in axes_of(second, Stage.scene)
               if name not in axes_of(first, Stage.scene)]
        for name in own:
            first = first.drop_vars(name, errors="ignore").expand_dims({name: second[name].values})
        names += own
    return first, second, tuple(names)


def _common(
    first: xr.Dataset, second: xr.Dataset, name: str
) -> tuple[xr.Dataset, xr.Dataset]:
    """Return both at the values of an axis that both have."""
    common = [each for each in first[name].values if each in second[name].values]
    return first.sel({name: common}), second.sel({name: common})


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


def _trials_of(first: xr.Dataset, second: xr.Dataset) -> Integers:
    """Return the indices (photographs, repeats) of the trials of each photograph; -1 for none.

    Raises
    ------
    DatasetError
        If none is of these photographs.
    """
    files = [list(zip(*(side[name].values if name in side.coords else np.empty(0)
                        for name in ("photograph", "sha256")), strict=True))
             for side in (first, second)]
    trials = [[k for k, other in enumerate(files[1]) if other == each] for each in files[0]]
    most = max(map(len, trials))
    if not most:
        raise DatasetError("the simulation is the twin of other photographs")
    return np.array([some + [-1] * (most - len(some)) for some in trials])


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
    """Return an array of trials (c, 1, t, rows, ...) as one of photographs (c, 1, p, rows, ...).

    ``trials`` is (p, repeats); of -1 nothing counts, and flags are 0.
    """
    taken = array[:, :, np.maximum(trials, 0)]
    absent = (trials < 0).reshape(1, 1, *trials.shape, *(1,) * (array.ndim - 3))
    filler = np.nan if array.dtype.kind == "f" else 0
    taken = np.where(absent, np.asarray(filler, dtype=array.dtype), taken)
    return taken.reshape(*taken.shape[:3], -1, *array.shape[4:])


def _binned(results: xr.Dataset, name: str) -> xr.DataArray:
    """Return the binned quantity of a dataset: a variable, or one computed from others."""
    if name in results.variables and not is_fixed(results[name]):
        return results[name].reset_coords(drop=True)
    if name == SIDE:
        return image_sides(results)
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

#: A photograph, or a scene of a simulation, is the draw.
BY_PHOTOGRAPH = Design(Unit.photograph)


@dataclass(frozen=True)
class Compared:
    """A compared statistic: a rate, or a quantile of the errors (...) of solved poses.

    By its ratio, or else by its difference.
    """

    name: str
    meaning: str
    units: str
    rate: Rate[Poses] = DETECTION_RATE
    error: Callable[[Poses], Floats] = QUANTITIES[0].norm
    percent: int = 50
    ratio: bool = False


RATES = tuple(Compared(rate.name, rate.meaning, "1", rate) for rate in (DETECTION_RATE, FLIP_RATE))

#: Compared statistics, in the order of the table.
QUANTILES = (
    Compared("range_bias_percent", "median depth error of the true depth, solved", "percent",
             error=lambda poses: poses.range_percent[..., 0]),
    *(Compared(quantity.named(statistic),
               f"{percent} % quantile of the absolute {quantity.words}, solved", quantity.units,
               error=quantity.norm, percent=percent, ratio=True)
      for quantity in QUANTITIES[:2] for statistic, percent in PERCENTS.items()),
)


@describes
def simulation_gap(
    photographs: xr.Dataset, simulated: xr.Dataset, bins: Bins | None = None
) -> xr.Dataset:
    """Return statistics of photographs and of a simulation, and the gap between them.

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
    shape = (*map(len, pair.coordinates.values()), *pair.binning.shape)
    dims = (*pair.configurations, *pair.binning.edges)
    variables: dict[str, Any] = {}
    for name, attributes in _attributes().items():
        values = np.stack([gap[name] for gap in gaps], axis=-1)  # (..., configurations, bins)
        own = ("source", *dims) if values.ndim == 3 else dims
        variables[name] = (own, values.reshape((*values.shape[:-2], *shape)), attributes)
    return xr.Dataset(
        variables, {**pair.coordinates, **pair.bin_coordinates, "source": list(SOURCES)},
        {"paired": int(pair.paired)})


def _attributes() -> dict[str, dict[str, Any]]:
    """Return the attributes of the variables by their names, in their order."""
    outputs = [Output("looked_for", "markers that were run, visible and modelled", "1"),
               Output("solved", "solved poses", "1"),
               Output("units", "photographs, or simulated scenes, with a marker", "1")]
    for each in (*RATES, *QUANTILES):
        gap = "simulated over photographs" if each.ratio else "simulated minus photographs"
        outputs += with_interval(each.name, each.meaning, each.units)
        outputs += with_interval(f"{each.name}_gap", f"{gap}: {each.meaning}",
                                 "1" if each.ratio else each.units)
    return {output.name: output.attributes() for output in outputs}


def _gap(pair: PairedUnits, inside: Sequence[Masks]) -> Variables:
    """Return the variables of one bin: (sources, configurations) or (configurations,)."""
    arrays = pair.within(inside)
    sides = [Poses(each) for each in arrays]
    table: Variables = {
        name: np.stack([getattr(side, name).sum(axis=OVER_ALL) for side in sides])
        for name in ("looked_for", "solved")
    }
    table["units"] = np.stack([side.looked_for.any(axis=(1, 3)).sum(axis=1) for side in sides])
    for each in RATES:
        table |= _rates(each.rate, arrays)
    counts = [None if single else unit_counts(side.looked_for.shape[2])
              for side, single in zip(sides, pair.single, strict=True)]
    for each in QUANTILES:
        table |= _quantiles(each, sides, counts[:1] * 2 if pair.paired else counts)
    return table


def _named(name: str, interval: Sequence[Any]) -> Variables:
    """Return a value and the ends of its interval by their names."""
    return {f"{name}{end}": each for end, each in zip(INTERVAL, interval, strict=True)}


def _rates(rate: Rate[Poses], arrays: Sequence[Arrays]) -> Variables:
    """Return a rate of both, its difference, and their intervals."""
    value, low, high = map(np.stack, zip(*(
        rate.arrays(Columns(each, Poses), BY_PHOTOGRAPH) for each in arrays), strict=True))
    gap = value[1] - value[0]
    return _named(rate.name, (value, low, high)) | _named(
        f"{rate.name}_gap", (gap, gap - np.hypot(value[1] - low[1], high[0] - value[0]),
                             gap + np.hypot(high[1] - value[1], value[0] - low[0])))


def _quantiles(each: Compared, sides: Sequence[Poses], counts: Sequence[Any]) -> Variables:
    """Return a quantile of both, its gap, and their intervals; ``counts`` are of the bootstrap."""
    intervals, replicates, units = [], [], []
    for side, drawn in zip(sides, counts, strict=True):
        errors = each.error(side)
        used = side.solved & np.isfinite(errors)
        units.append(used.any(axis=(1, 3)).sum(axis=1))
        interval = quantile_intervals(
            np.where(used, errors, np.nan), used.sum(axis=3), [each.percent], BY_PHOTOGRAPH)[:, 0]
        interval[units[-1] < MIN_UNITS, 1:] = np.nan
        intervals.append(interval)
        replicates.append(np.stack([
            resampled_quantiles(values[0], some[0], drawn, each.percent / 100.0)
            for values, some in zip(errors, used, strict=True)]))
    with np.errstate(divide="ignore", invalid="ignore"):
        compare = np.divide if each.ratio else np.subtract
        gaps, values = compare(replicates[1], replicates[0]), np.moveaxis(
            np.array(intervals), -1, 0)
        ends = np.array([percentile_interval(row, least)
                         for row, least in zip(gaps, np.minimum(*units).tolist(), strict=True)])
        return _named(each.name, [*values]) | _named(
            f"{each.name}_gap", (compare(values[0][1], values[0][0]), ends[:, 0], ends[:, 1]))
