"""The data of a report: results, roles of axes, analyses computed once, groups."""

from __future__ import annotations

import contextlib
import functools
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.analysis import error_statistics
from sweep.analysis.dataset import SIZE_AXES, is_grid_axis, of_photographs
from sweep.analysis.requirements import SIZES_BESIDE, conditions, parse_requirements
from sweep.errors import StoreError, SweepError
from sweep.execution.status import Totals, account_of
from sweep.experiment.experiment import distinct, used_settings, wrong_configurations
from sweep.experiment.grid import TRIAL, Axis
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import DetectionStatus, uncounted_values
from sweep.report.table import axis_label
from sweep.store.lifecycle import open_dataset, open_store, unfinished_line
from sweep.tradeoff.pareto import WRONG, configuration_label
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# Groups of poses that a figure compares, and the labels of groups.

BOTH = (Stage.detection, Stage.estimation)
AREA = "marker_area_px"
#: Axes along which the marker is turned away.
ANGLES = ("tilt_deg", "view_angle_deg")

IDS = "marker_id"
#: Dimension of tables that have a row for each configuration.
CONFIGURATION = "configuration"

#: Bins of the area, and of a drawn parameter.
DRAWN_BINS = 10


#: Axis, area or drawn parameter -> edges of the bins that are groups; None: each value is one.
Groups = Mapping[str, tuple[float, ...] | None]


def bins_of(values: Floats, most: int) -> tuple[float, ...]:
    """Return edges of bins of values (n,), of about as many each: at most so many, none empty."""
    edges = np.unique(np.quantile(values, np.linspace(0, 1, most + 1)))
    edges[-1] = np.nextafter(edges[-1], np.inf)
    return tuple(edges.tolist())


# --------------------------------------------------------------------------------------------------
# The data of a report: a store's results, the roles of its axes, and analyses computed once.

#: Results up to this size are read at once: many figures need the same values, and many small
#: chunks are slow to read.
MAX_READ_BYTES = 600_000_000

#: Areas vary if the largest exceeds the smallest by this factor.
AREA_RATIO = 2.0

Analysis = Callable[..., xr.Dataset]
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class ReportData:
    """The results of a finished store, with the roles of its axes.

    Attributes
    ----------
    store
        Path or URL of the store.
    results
        Its dataset; lazy if it is large.
    pipeline
        The experiment.
    run_metadata
        Fingerprint, environment and dates of the run.
    trade
        The store's group ``cost/tradeoff``, or None.
    warnings
        Lines on cells that failed, or a run in which nothing was detected.
    require, per
        Requirements, as `sweep.analysis.check_requirements` takes them, and the conditions.
    command
        The command line that asked for the report; empty if none did.
    made
        What `once` has returned, by key.
    """

    store: str
    results: xr.Dataset
    pipeline: Pipeline
    run_metadata: Mapping[str, Any]
    trade: xr.Dataset | None = None
    warnings: tuple[str, ...] = ()
    require: tuple[str, ...] = ()
    per: tuple[str, ...] = ()
    command: str = ""
    made: dict[Any, Any] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        """Give a single pose, which has no axes, the one draw that it is."""
        if "detection" in self.results and not self.results["detection"].dims:
            object.__setattr__(self, "results", self.results.expand_dims({TRIAL: [0]}))

    # Roles of the axes.

    @property
    def size_axis(self) -> str | None:
        """The axis along which the marker's size in the image changes."""
        return next((name for name in SIZE_AXES if self.results.sizes.get(name, 1) > 1), None)

    @property
    def angle_axis(self) -> str | None:
        """The axis along which the marker is turned away: the tilt, or the viewing angle."""
        return next((name for name in ANGLES if self.results.sizes.get(name, 1) > 1), None)

    @functools.cached_property
    def areas(self) -> Floats:
        """Areas, px², of the poses looked for (n,), by the first of the detector's settings."""
        first = {axis.name: 0 for axis in self.pipeline.axes_of(Stage.detection)}
        detection, area = (self.results[name].isel(first, missing_dims="ignore")
                           for name in ("detection", AREA))
        with store_errors(self.store):
            counted = ~detection.isin(uncounted_values(DetectionStatus)) & (area > 0)
            values = np.ravel(area.where(counted)).astype(np.float64)
        return np.asarray(values[np.isfinite(values)])

    @property
    def size(self) -> str | None:
        """The measure of size: an axis, or the area if it varies, and not by an axis of angles."""
        if self.size_axis or self.angle_axis or not self.areas.size:
            return self.size_axis
        return AREA if self.areas.max() > AREA_RATIO * self.areas.min() else None

    @property
    def setting_axes(self) -> tuple[str, ...]:
        """Axes of the detector's and the estimator's settings that have several values."""
        return tuple(axis.name for axis in self.pipeline.axes_of(*BOTH) if len(axis) > 1)

    @property
    def effect_axes(self) -> tuple[Axis, ...]:
        """Axes of the scene whose values see the same draws, such as noise or JPEG quality."""
        if of_photographs(self.results):
            return ()
        return tuple(axis for axis in self.pipeline.axes
                     if axis.name in self.scene_axes and not is_grid_axis(axis.name, self.results))

    @property
    def scene_axes(self) -> tuple[str, ...]:
        """Axes of the scene that have several values, without the draws."""
        return tuple(
            axis.name for axis in self.pipeline.axes_of(Stage.scene)
            if len(axis) > 1 and axis.name != TRIAL
        )

    @property
    def drawn_parameters(self) -> tuple[str, ...]:
        """Parameters that are drawn from a distribution, and whose draws the store has."""
        return tuple(name for name in self.pipeline.distributions
                     if name in self.results.variables)

    def label(self, name: str) -> str:
        """Return an axis' name with its unit, as on the axes of charts: ``distance, m``."""
        return axis_label(self.results, name)

    def words(self, name: str) -> str:
        """Return an axis' name without the unit, as in titles: ``distance``."""
        return self.label(name).partition(", ")[0]

    # Groups of poses.

    def along(self, name: str, most: int = 40) -> Groups:
        """Return the groups along an axis, the area, or a drawn parameter.

        A longer axis of numbers is binned, as the area and draws are.

        Raises
        ------
        KeyError
            If there is none of that name.
        """
        axis = self.pipeline.axis(name)
        if axis is not None and (len(axis) <= most or not axis.is_numeric):
            return {name: None}
        values = self.areas if name == AREA else np.ravel(self.results[name]).astype(np.float64)
        return {name: bins_of(values, DRAWN_BINS if axis is None else most)}

    def pooled(self, *kept: str) -> str:
        """Return a sentence that names the axes of the scene pooled over, all but ``kept``."""
        names = [name for name in self.scene_axes if name not in kept]
        return f"Pooled over {', '.join(names)}." if names else ""

    # Analyses.

    def once(self, key: Any, make: Callable[[], T]) -> T:
        """Return the result of ``make``, a dataset loaded; it is called once for each key."""
        if key not in self.made:
            with store_errors(self.store):
                made = make()
                self.made[key] = made.compute() if isinstance(made, xr.Dataset) else made
        found: T = self.made[key]
        return found


def course_of(data: ReportData) -> tuple[str | None, tuple[str, ...]]:
    """Return how requirements are followed over the conditions.

    Returns
    -------
    The axis along which a limit is looked for, None if there is none; and the other axes of
    conditions, angles first.
    """
    conditions = [name for name in data.per if name not in data.setting_axes]
    numeric = {axis.name for axis in data.pipeline.axes if axis.is_numeric} & {*data.scene_axes}
    along = min((name for name in conditions if name in numeric), default=None, key=lambda name: (
        name != data.size_axis, name not in SIZES_BESIDE, name in ANGLES))
    others = (name for name in conditions if name != along)
    return along, tuple(sorted(others, key=lambda name: name not in ANGLES))


@contextlib.contextmanager
def store_errors(store: str) -> Iterator[None]:
    """Translate every error while a store is read into a ``StoreError`` of one line."""
    try:
        yield
    except SweepError:
        raise
    except Exception as error:
        # A damaged store fails within zarr, its codecs or xarray, each with errors of its own.
        reason = " ".join(str(error).split()) or type(error).__name__
        raise StoreError(f"{store}: cannot be read: {reason}") from None


def read_report_data(
    url: str, require: Sequence[str] = (), per: Sequence[str] | None = None, command: str = ""
) -> ReportData:
    """Open a finished store for its report.

    Parameters
    ----------
    url
        Path or URL of the store.
    require, per
        Requirements, by default the pipeline's, and the dimensions whose values are
        conditions, by default those of `sweep.analysis.requirements`.
    command
        The command line that asked for the report.

    Raises
    ------
    ArgumentError
        For what cannot be required.
    StoreError
        If there is no store, it is not finished, or it cannot be read.
    """
    store = open_store(url)
    if not store.finished:
        raise StoreError(unfinished_line(store))
    trade = None
    with store_errors(store.url):
        if "cost/tradeoff" in store.group:
            trade = xr.open_zarr(
                store.storage, group="cost/tradeoff", consolidated=False, zarr_format=3
            ).load()
        results = open_dataset(store.url, MAX_READ_BYTES)
    required = tuple(require) or store.pipeline.requirements
    return ReportData(
        store.url, results, store.pipeline, store.run_metadata, trade,
        tuple(account_of(store, Totals.of_finished(store))["warnings"]),
        tuple(each.text for each in parse_requirements(required)) if required else (),
        conditions(results, per, store.pipeline.require_per),
        command,
    )


# --------------------------------------------------------------------------------------------------
# The configurations of a store, the best first, and the beliefs that are not the truth.
#
# A configuration is a combination of detector and estimator settings, and of targets. They are
# compared, never pooled; of a store with very many some are chosen.

#: Configurations that a table or a figure of all of them compares.
MAX_CONFIGURATIONS = 30


@dataclass(frozen=True, eq=False)
class Configurations:
    """The n configurations that a report compares, the best first.

    Right beliefs stand first, of these the highest detection and solved rate, then the smallest
    RMSE of rotation and range.

    Attributes
    ----------
    axes
        Axis that tells them apart -> indices of the values that are compared.
    combinations
        Of each configuration, its place among these indices, by axis. Of those that differ only in
        settings that they do not use there is one.
    names
        Labels.
    wrong
        (n,) whether the estimator believes what is known not to be true; nowhere if that holds for
        all of them.
    summary
        `sweep.analysis.error_statistics` by configuration (n,).
    """

    axes: Mapping[str, list[int]]
    combinations: list[dict[str, int]]
    names: list[str]
    wrong: NDArray[np.bool_]
    summary: xr.Dataset

    @property
    def several(self) -> bool:
        """Whether there is more than one."""
        return len(self.names) > 1


def configurations(data: ReportData, *, targets: bool = True) -> Configurations:
    """Return the configurations of a store, by targets, too, or with them pooled.

    If there are more than `MAX_CONFIGURATIONS`, values of the longest axes are chosen, evenly
    spaced. Of a store with neither settings nor targets to compare, by the values of its effects.
    """
    return data.once(
        ("configurations", targets), lambda: _configurations(data, targets=targets))


def _configurations(data: ReportData, *, targets: bool) -> Configurations:
    settings = [axis for axis in data.pipeline.axes_of(*BOTH) if len(axis) > 1]
    several = [*(data.pipeline.experiment.target_axes if targets else ()), *settings]
    if targets and not several:
        # Nothing else varies on the same draws: the values of an effect are compared.
        several = list(data.effect_axes)
    counts = {axis.name: len(axis) for axis in several}
    while math.prod(counts.values()) > MAX_CONFIGURATIONS and max(counts.values()) > 2:
        counts[max(counts, key=counts.__getitem__)] -= 1
    axes = {axis.name: np.linspace(0, len(axis) - 1, counts[axis.name]).round().astype(int).tolist()
            for axis in several}
    every = [dict(zip(axes, index, strict=True))
             for index in itertools.product(*map(range, counts.values()))]
    kept, summary = _of_each(data, axes, every, error_statistics, {})
    flags = np.reshape(wrong_configurations(data.pipeline, settings), list(map(len, settings)))
    wrong = np.array([flags[tuple(axes[axis.name][each[axis.name]] for axis in settings)]
                      for each in kept])
    names = [str(label) + WRONG * bool(flag)
             for label, flag in zip(summary[CONFIGURATION].values, wrong, strict=True)]

    def column(name: str, missing: float) -> NDArray[np.float64]:
        return np.asarray(summary[name].fillna(missing), dtype=np.float64)

    order = np.lexsort((
        column("range_rmse_percent", np.inf), column("rotation_rmse_deg", np.inf),
        -column("solved_rate", -1.0), -column("detection_rate", -1.0), wrong)).tolist()
    return Configurations(
        axes, [kept[k] for k in order], [names[k] for k in order], wrong[order],
        summary.assign_coords({CONFIGURATION: names}).isel({CONFIGURATION: order}))


def _of_each(
    data: ReportData, axes: Mapping[str, list[int]], combinations: list[dict[str, int]],
    analysis: Analysis, groups: Groups,
) -> tuple[list[dict[str, int]], xr.Dataset]:
    """Return the combinations that differ in settings that they use, and an analysis of each.

    It has the dimension ``configuration``, by label, in place of the axes; it is computed once.
    """
    values = {name: data.results[name].values[some].tolist() for name, some in axes.items()}
    every = [{name: values[name][k] for name, k in each.items()} for each in combinations]
    kept = distinct(data.pipeline, every)
    labels = [configuration_label(used_settings(data.pipeline, every[k])) for k in kept]
    per = [*axes, *(name for name, edges in groups.items() if edges is None)]
    bins = {name: edges for name, edges in groups.items() if edges is not None}
    table = data.once((analysis.__name__, *axes, *groups.items()), lambda: analysis(
        data.results.isel(axes), per=per, bins=bins))
    # Axes of settings with a single value tell nothing apart.
    places: dict[str, Any] = {
        axis.name: 0 for axis in data.pipeline.axes_of(*BOTH) if len(axis) == 1}
    places |= {name: xr.DataArray([combinations[k][name] for k in kept], dims=CONFIGURATION)
               for name in axes}
    flat = table.isel(places, missing_dims="ignore").drop_vars([*places], errors="ignore")
    flat = flat if axes else flat.expand_dims(CONFIGURATION)
    return [combinations[k] for k in kept], flat.assign_coords(
        {CONFIGURATION: labels}).transpose(CONFIGURATION, *groups, ...)


def grouped(
    data: ReportData, analysis: Analysis, groups: Groups | None = None,
    stages: Sequence[Stage] = BOTH,
) -> xr.Dataset:
    """Return an analysis by configuration and groups of poses, loaded; each is computed once.

    Parameters
    ----------
    data
        The store.
    analysis
        A function of `sweep.analysis` that takes results, per and bins.
    groups
        Its groups are dimensions of the result behind the configurations, in this order.
    stages
        Those whose settings make a difference: of the detection rate the detector's.

    Raises
    ------
    StoreError
        If the store cannot be read.
    """
    known, groups = configurations(data), groups or {}
    compared = {axis.name for axis in (
        *data.pipeline.experiment.target_axes, *data.pipeline.axes_of(*stages))} - groups.keys()
    axes = {name: some for name, some in known.axes.items() if name in compared}
    places = dict.fromkeys(tuple(each[name] for name in axes) for each in known.combinations)
    combinations = [dict(zip(axes, each, strict=True)) for each in places]
    return _of_each(data, axes, combinations, analysis, groups)[1]


def notes_of(data: ReportData, groups: Groups) -> str:
    """Return sentences for the reader about bins, and configurations that are left out."""
    return " ".join([*(
        f"{len(some)} of the {data.results.sizes[name]:,} values of {name} are shown."
        for name, some in configurations(data).axes.items()
        if len(some) < data.results.sizes[name] and name not in groups), *(
        f"Values of {name} are grouped into {len(edges) - 1} bins of about as many each."
        for name, edges in groups.items() if edges is not None)])
