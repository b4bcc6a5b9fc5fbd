"""Photographs beside their simulation: how much of their errors a simulation has."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.analysis.dataset import (
    DRAWS,
    Labelled,
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
    Bins,
    Columns,
    Count,
    Design,
    Output,
    Rate,
    Statistic,
    aggregate,
    arranged,
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
from sweep.analysis.poses import (
    ERROR_INPUTS,
    INSIDE,
    QUANTITIES,
    REQUIRED_VARIABLES,
    Poses,
    pose_arrays,
)
from sweep.analysis.summaries import DETECTION_RATE, FLIP_RATE
from sweep.errors import DatasetError
from sweep.experiment.parameters import PARAMETERS, PHOTOGRAPHS, SIMULATED, Stage
from sweep.messages import label, shown
from sweep.typing import Floats, Integers

# --------------------------------------------------------------------------------------------------
# Two datasets whose trials are units of markers: photographs, and a simulation's scenes.

#: Shares of the photographs' markers between which the default bins lie.
QUARTERS = (0.0, 0.25, 0.5, 0.75, 1.0)

SIDE = "side_px"

TRUTH_STD = "truth_std"

#: Dimension of the trials of a twin that are of one photograph.
REPEAT = "repeat"

SEED = 21


class Sides(NamedTuple):
    """Photographs and a simulation with the same configurations.

    Attributes
    ----------
    datasets
        Both; a trial is a photograph, or a scene of the simulation. Trials of the same index belong
        together if they are ``paired``.
    kept
        Axes of the configurations.
    bins
        Edges of the bins, by name.
    paired
        Whether the simulation is the photographs' twin.
    single
        Whether each unit of the simulation has one marker.
    """

    datasets: tuple[xr.Dataset, xr.Dataset]
    kept: tuple[str, ...]
    bins: Bins
    paired: bool
    single: bool

    def poses(self) -> list[Poses]:
        """Return the poses within the bins of both, (configurations, 1, units, markers)."""
        found = []
        for side in self.datasets:
            inside = xr.DataArray(True)
            for name, edges in self.bins.items():
                inside = inside & (side[name] >= edges[0]) & (side[name] < edges[-1])
            inputs = pose_arrays(side, ERROR_INPUTS) | {INSIDE: inside}
            found.append(Poses(arranged(side, inputs, self.kept, stopped=False)[0]))
        return found


def matched_sides(
    photographs: xr.Dataset, simulated: xr.Dataset, bins: Bins | None = None
) -> Sides:
    """Return photographs and a simulation at their common configurations.

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
    paired, single = is_twin(simulated), not of_photographs(simulated)
    first, second, kept = _same_configurations(photographs, simulated, paired=paired)
    if bins is None:
        bins = {} if paired else {SIDE: _quarters(first)}
    read_bins(first, kept, bins)
    scene = [name for name in axes_of(second, Stage.scene) if name not in kept]
    std = second.get(TRUTH_STD)
    first, second = (side[list(REQUIRED_VARIABLES)].assign({
        name: _binned(side, name) for name in bins}).drop_attrs() for side in (first, second))
    if paired:
        trials = _trials_of(photographs, simulated)
        some = np.flatnonzero((trials >= 0).any(axis=1))
        at = xr.DataArray(trials[some], dims=(DRAWS, REPEAT))
        first, second = first.isel({DRAWS: some}), _gathered(second, at)
        if std is not None:
            second = _with_uncertain_truth(second, _gathered(std, at), kept)
    elif single and scene:
        # Each scene counts as a photograph.
        second = second.drop_vars(DRAWS, errors="ignore").stack(
            unit=sorted(scene, key=lambda name: name != DRAWS), create_index=False)
        second = second.rename(unit=DRAWS).assign_coords({PHOTOGRAPHS: ""})
    return Sides((first, second), kept, bins, paired, single)


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

    Twins are also at their common values of the scene; axes of it that they alone have are kept.
    """
    names = [*dict.fromkeys([*configuration_axes(first), *configuration_axes(second)])]
    for name in names:
        first, second = _with_axis(first, second, name), _with_axis(second, first, name)
    scenes = [[name for name in axes_of(side, Stage.scene) if name != DRAWS and paired]
              for side in (first, second)]
    common = {*names, *scenes[0]} & {*names, *scenes[1]}
    ours, theirs = xr.align(
        first, second, join="inner", exclude={*first.dims, *second.dims} - common)
    for name in names:
        if not ours.sizes[name]:
            raise DatasetError(
                f"no common {name}: {shown(first[name].values.tolist())} and "
                f"{shown(second[name].values.tolist())}; measure both with the same settings")
    own = [name for name in scenes[1] if name not in scenes[0]]
    ours = ours.drop_vars(own, errors="ignore").expand_dims(
        {name: theirs[name].values for name in own})
    return ours, theirs, (*names, *own)


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


def _gathered(results: Labelled, trials: xr.DataArray) -> Labelled:
    """Return the trials (photographs, repeats) of a twin; of -1 all is NaN: not run."""
    return results.drop_vars(DRAWS, errors="ignore").isel(
        {DRAWS: trials.clip(0)}).where(trials >= 0)


def _with_uncertain_truth(
    results: xr.Dataset, std: xr.DataArray, kept: Sequence[str]
) -> xr.Dataset:
    """Return twins whose errors have the truth's random error in them, as far as it is known.

    The photographs' errors are differences to a truth that has such an error, the twins' to an
    exact one. A draw is of a marker, the same for all its configurations.
    """
    one = std.isel({name: 0 for name in kept if name in std.dims}, drop=True)
    drawn = one.copy(data=np.random.default_rng(SEED).normal(size=one.shape)) * std.fillna(0.0)
    parts = {"rotation_error_rad": slice(3), "translation_error_m": slice(3, None)}
    return results.assign({
        name: results[name] + drawn.isel(pose_parameter=part).rename(pose_parameter="xyz")
        .drop_vars("xyz", errors="ignore") for name, part in parts.items()})


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


class ComparedRate(Rate[Poses]):
    """A rate that is compared by its difference."""

    ratio = False

    def gap(self, first: xr.Dataset, second: xr.Dataset) -> tuple[xr.DataArray, ...]:
        """Return the difference of two tables' rates, with its interval."""
        (value, low, high), (other, other_low, other_high) = (
            [table[f"{self.name}{end}"] for end in INTERVAL] for table in (first, second))
        gap = other - value
        return (gap, gap - np.hypot(other - other_low, high - value),
                gap + np.hypot(other_high - other, value - low))


@dataclass(frozen=True)
class SolvedQuantile(Statistic[Poses]):
    """A quantile of the errors (...) of solved poses, with the replicates of its bootstrap.

    Attributes
    ----------
    percent
        Of the errors, at or below it.
    ratio
        Whether it is compared by its ratio, or else by its difference.
    single
        Whether each unit has one marker at most.
    """

    error: Callable[[Poses], Floats]
    percent: int = 50
    ratio: bool = False
    single: bool = False

    def outputs(self) -> Sequence[Output]:
        """Return the quantile with its interval, its units, and the replicates."""
        return [*super().outputs(), Output(f"{self.name}_units", "", "1", "i8"),
                Output(f"{self.name}_replicates", "", self.units, dims=("replicate",))]

    def arrays(self, columns: Columns[Poses], design: Design) -> Sequence[NDArray[Any]]:
        """Return these; without an interval of fewer than `MIN_UNITS` units."""
        def solved(poses: Poses, _: slice) -> list[Floats]:
            errors = self.error(poses)
            return [np.where(poses.solved & np.isfinite(errors), errors, np.nan)]

        errors, = columns.joined(solved)  # without cells if there is nothing
        errors = errors.reshape(len(errors), errors.shape[2], errors.shape[1] * errors.shape[3])
        used = ~np.isnan(errors)
        units = used.any(axis=2).sum(axis=1)
        interval = quantile_intervals(
            errors[:, None], used.sum(axis=2)[:, None], [self.percent], design)[:, 0]
        interval[units < MIN_UNITS, 1:] = np.nan
        counts = None if self.single else unit_counts(errors.shape[1])
        replicates = [resampled_quantiles(*each, counts, self.percent / 100.0)
                      for each in zip(errors, used, strict=True)]
        return [*interval.T, units, np.array(replicates)]

    def gap(self, first: xr.Dataset, second: xr.Dataset) -> tuple[xr.DataArray, ...]:
        """Return the ratio or the difference of two tables' quantiles, with its interval."""
        compared = np.divide if self.ratio else np.subtract
        value, replicates = (compared(second[name], first[name])
                             for name in (self.name, f"{self.name}_replicates"))
        units = np.minimum(first[f"{self.name}_units"], second[f"{self.name}_units"])
        return (value, *xr.apply_ufunc(
            percentile_interval, replicates, units, input_core_dims=[["replicate"], []],
            output_core_dims=[[], []], vectorize=True))


RATES = tuple(ComparedRate(each.name, each.meaning, each.successes, each.used)
              for each in (DETECTION_RATE, FLIP_RATE))

QUANTILES = (
    SolvedQuantile("range_bias_percent", "median depth error of the true depth, solved",
                   lambda poses: poses.range_percent[..., 0], units="percent"),
    *(SolvedQuantile(
        quantity.named(statistic), f"{percent} % quantile of the absolute {quantity.words}, solved",
        quantity.norm, percent, ratio=True, units=quantity.units)
      for quantity in QUANTITIES[:2] for statistic, percent in PERCENTS.items()),
)

#: All, in the order of the table.
GAP_STATISTICS: tuple[ComparedRate | SolvedQuantile, ...] = (*RATES, *QUANTILES)

COUNTS: tuple[Statistic[Poses], ...] = (
    Count("looked_for", "markers that were run, visible and modelled",
          lambda poses: poses.looked_for),
    Count("solved", "solved poses", lambda poses: poses.solved),
    Count("units", "photographs, or simulated scenes, with a marker",
          lambda poses: np.asarray(poses.looked_for.any(axis=(1, 3), keepdims=True))),
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
    sides = matched_sides(photographs, simulated, bins)
    tables = [
        aggregate(side, pose_arrays(side, ERROR_INPUTS), sides.kept, [
            *COUNTS, *RATES, *(replace(each, single=single) for each in QUANTILES)],
            Poses, sides.bins, stopped=False)
        for side, single in zip(sides.datasets, (False, sides.single), strict=True)]
    tables = [table.drop_vars([name for name, value in table.coords.items() if not value.dims])
              for table in tables]
    gaps: dict[str, xr.DataArray] = {}
    for each in GAP_STATISTICS:
        words = "simulated over photographs" if each.ratio else "simulated minus photographs"
        outputs = with_interval(f"{each.name}_gap", f"{words}: {each.meaning}",
                                "1" if each.ratio else each.units)
        with np.errstate(divide="ignore", invalid="ignore"):
            gaps |= {output.name: array.assign_attrs(output.attributes())
                     for output, array in zip(outputs, each.gap(*tables), strict=True)}
    both = xr.concat(tables, "source", coords="minimal", compat="override", join="override")
    return both.drop_vars([
        f"{each.name}_{more}" for each in QUANTILES for more in ("units", "replicates")],
    ).assign(gaps).assign_coords(source=list(SOURCES)).assign_attrs(paired=int(sides.paired))
