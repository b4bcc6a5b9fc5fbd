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
from sweep.analysis.requirements import (
    SIZES_BESIDE,
    conditions,
    parse_requirements,
    usual_conditions,
)
from sweep.errors import StoreError, SweepError
from sweep.evaluation.block import bound_notes
from sweep.experiment.experiment import distinct, used_settings, wrong_configurations
from sweep.experiment.grid import TRIAL, Axis
from sweep.experiment.parameters import WORLD, Stage
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import DetectionStatus, uncounted_values
from sweep.model.camera import VIEW_PARAMETERS
from sweep.report.table import axis_label
from sweep.store.lifecycle import open_dataset, open_store, unfinished_line
from sweep.store.outcome import outcome_of_finished
from sweep.tradeoff.pareto import WRONG, configuration_label
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# Groups of poses that a figure compares, and the labels of groups.

AREA = "marker_area_px"
ANGLES = ("tilt_deg", "view_angle_deg")
"""Axes along which the marker is turned away."""

IDS = "marker_id"
CONFIGURATION = "configuration"
"""Dimension of tables that have a row for each configuration."""

DRAWN_BINS = 10
"""Bins of the area, and of a drawn parameter."""


@dataclass(frozen=True, slots=True)
class Grouping:
    """How the poses are grouped.

    Attributes
    ----------
    per
        Axes whose values are groups.
    bins
        Axes, or the area, with the edges of bins that are groups.
    chosen
        Axes of which only the values at these indices are kept.
    notes
        Sentences for the reader about bins and chosen values.
    """

    per: tuple[str, ...] = ()
    bins: tuple[tuple[str, tuple[float, ...]], ...] = ()
    chosen: tuple[tuple[str, tuple[int, ...]], ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def dims(self) -> tuple[str, ...]:
        """Dimensions of an analysis of these groups."""
        return self.per + tuple(name for name, _ in self.bins)

    def __add__(self, other: Grouping) -> Grouping:
        return Grouping(
            self.per + other.per, self.bins + other.bins, self.chosen + other.chosen,
            self.notes + other.notes,
        )


def bins_of(name: str, values: Floats, most: int) -> Grouping:
    """Return the grouping of values (n,) into ``most`` bins of about as many each, none empty."""
    edges = np.unique(np.quantile(values, np.linspace(0, 1, most + 1)))
    edges[-1] = np.nextafter(edges[-1], np.inf)
    note = f"Values of {name} are grouped into {len(edges) - 1} bins of about as many each."
    return Grouping(bins=((name, tuple(edges.tolist())),), notes=(note,))


def chosen_of(name: str, length: int, most: int) -> Grouping:
    """Return the grouping by ``most`` of the ``length`` values of an axis, evenly spaced."""
    chosen = tuple(np.linspace(0, length - 1, most).round().astype(int).tolist())
    note = f"{most} of the {length:,} values of {name} are shown."
    return Grouping((name,), chosen=((name, chosen),), notes=(note,))


# --------------------------------------------------------------------------------------------------
# The data of a report: a store's results, the roles of its axes, and analyses computed once.

MAX_READ_BYTES = 600_000_000
"""Results up to this size are read at once: many figures need the same values, and many small
chunks are slow to read."""

MAX_AREAS = 1_000_000
"""Areas by which bins are made."""

AREA_RATIO = 2.0
"""Areas vary if the largest exceeds the smallest by this factor."""

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
        What is required, as `sweep.analysis.check_requirements` takes it, and the conditions.
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

    def length(self, name: str) -> int:
        """Return the number of an axis' values; 0 if the axis does not exist."""
        axis = self.pipeline.axis(name)
        return len(axis) if axis is not None else 0

    @property
    def size_axis(self) -> str | None:
        """The axis along which the marker's size in the image changes."""
        return next((name for name in SIZE_AXES if self.length(name) > 1), None)

    @property
    def angle_axis(self) -> str | None:
        """The axis along which the marker is turned away: the tilt, or the viewing angle."""
        return next((name for name in ANGLES if self.length(name) > 1), None)

    @property
    def size_axes(self) -> list[str]:
        """The axes of size and angle that there are."""
        return [name for name in (self.size_axis, self.angle_axis) if name]

    @functools.cached_property
    def areas(self) -> Floats:
        """Areas, px², of the poses looked for (n,), or of a part of very many."""
        first = {axis.name: 0 for axis in self.pipeline.axes_of(Stage.detection)}
        detection, area = (self.results[name].isel(first, missing_dims="ignore")
                           for name in ("detection", AREA))
        with store_errors(self.store):
            counted = ~detection.isin(uncounted_values(DetectionStatus)) & (area > 0)
            values = np.ravel(area.where(counted)).astype(np.float64)
        known: Floats = values[np.isfinite(values)]
        return known[:: max(1, known.size // MAX_AREAS)]

    @property
    def areas_vary(self) -> bool:
        """Whether areas differ for other reasons than an axis of sizes or angles."""
        expected = {*SIZE_AXES, *ANGLES}
        reasons = {*VIEW_PARAMETERS, *WORLD, *expected, "yaw_deg", "pitch_deg", "size_m"}
        varied = {axis.name for axis in self.pipeline.axes if len(axis) > 1} - expected
        varied |= {name for axis in self.pipeline.axes if axis.zipped for name in axis.columns}
        if not (varied | self.pipeline.distributions.keys()) & reasons or not self.areas.size:
            return False
        return bool(self.areas.max() > AREA_RATIO * self.areas.min())

    @property
    def size(self) -> str | None:
        """The measure of size: an axis, or the area if it varies without such an axis."""
        return self.size_axis or (AREA if self.areas_vary else None)

    @property
    def setting_axes(self) -> tuple[str, ...]:
        """Axes of the detector's and the estimator's settings that have several values."""
        stages = (Stage.detection, Stage.estimation)
        return tuple(axis.name for axis in self.pipeline.axes_of(*stages) if len(axis) > 1)

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
        """Parameters that are drawn from a distribution, and whose draws the store has.

        A drawn size of the image is shown by the area.
        """
        return tuple(
            name for name in self.pipeline.distributions
            if name in self.results.variables and name not in SIZE_AXES
        )

    def label(self, name: str) -> str:
        """Return an axis' name with its unit, as on the axes of charts: ``distance, m``."""
        return axis_label(self.results, name)

    # Groupings.

    def along(self, name: str, most: int = 40, *, binned: bool = True) -> Grouping:
        """Return the grouping by an axis into at most ``most`` groups, or by bins of the area.

        The draws of a parameter are binned, too. If an axis is longer, its values are binned if
        they are numeric and ``binned`` is set; otherwise some of them are chosen.

        Raises
        ------
        KeyError
            If the axis does not exist.
        """
        if name == AREA:
            return bins_of(name, self.areas, DRAWN_BINS)
        if name in self.drawn_parameters:
            return bins_of(name, np.ravel(self.results[name]).astype(np.float64), DRAWN_BINS)
        axis = self.pipeline.axis(name)
        if axis is None:
            raise KeyError(name)
        if len(axis) <= most:
            return Grouping((name,))
        if binned and axis.is_numeric:
            return bins_of(name, np.asarray(self.results[name].values, dtype=np.float64), most)
        return chosen_of(name, len(axis), most)

    def pooled(self, *kept: str) -> str:
        """Return a sentence that names the axes of the scene pooled over, all but ``kept``."""
        names = [
            axis.name for axis in self.pipeline.axes_of(Stage.scene)
            if len(axis) > 1 and axis.name not in (*kept, TRIAL)
        ]
        return f"Pooled over {', '.join(names)}." if names else ""

    # Analyses.

    def analysed(self, analysis: Analysis, grouping: Grouping | None = None) -> xr.Dataset:
        """Return the result of an analysis, loaded; each is computed once.

        Parameters
        ----------
        analysis
            A function of `sweep.analysis` that takes results, per and bins.
        grouping
            Its groups are the first dimensions of the result, in this order.

        Raises
        ------
        StoreError
            If the store cannot be read.
        """
        grouping = grouping or Grouping()

        def compute() -> xr.Dataset:
            results = self.results.isel({name: list(some) for name, some in grouping.chosen})
            return analysis(results, per=grouping.per, bins=dict(grouping.bins))

        key = (analysis.__name__, grouping.per, grouping.bins, grouping.chosen)
        return self.once(key, compute).transpose(*grouping.dims, ...)

    def once(self, key: Any, make: Callable[[], T]) -> T:
        """Return what ``make`` returns, a dataset loaded; it is called once for each key."""
        if key not in self.made:
            with store_errors(self.store):
                made = make()
                self.made[key] = made.compute() if isinstance(made, xr.Dataset) else made
        found: T = self.made[key]
        return found


def course_of(
    data: ReportData, per: Sequence[str] | None = None
) -> tuple[str | None, tuple[str, ...]]:
    """Return how requirements are followed over conditions, by default the usual ones.

    Returns
    -------
    The axis along which a limit is looked for, None if there is none; and the other axes of
    conditions, those of angles first.
    """
    axes = {axis.name: axis for axis in data.pipeline.axes}
    per = usual_conditions(data.results) if per is None else per
    conditions = [name for name in per if name not in data.setting_axes]
    ordered = [name for name in conditions
               if name in data.scene_axes and axes[name].is_numeric]
    ordered.sort(key=lambda name: (
        name != data.size_axis, name not in SIZES_BESIDE, name in ANGLES))
    along = ordered[0] if ordered else None
    others = [name for name in conditions if name != along]
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
        What is required, by default by the pipeline, and the dimensions whose values are
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
        (*outcome_of_finished(store).warnings, *bound_notes(store.pipeline)),
        tuple(each.text for each in parse_requirements(required)) if required else (),
        conditions(results, per, store.pipeline.require_per),
        command,
    )


# --------------------------------------------------------------------------------------------------
# The configurations of a store, their order, and the beliefs that are not the truth.
#
# A configuration is a combination of detector and estimator settings. They are compared, never
# pooled; of a store with very many some are chosen.

MAX_CONFIGURATIONS = 30
"""Configurations that a table or a figure of all of them compares."""

BOTH = (Stage.detection, Stage.estimation)


@dataclass(frozen=True)
class Settings:
    """Combinations of the values of some axes of settings and targets.

    Attributes
    ----------
    axes
        Axis -> indices of its values.
    grouping
        Of analyses that keep them apart.
    kept
        Which of all combinations, the last axis fastest, are configurations of their own: the first
        of those that differ in settings alone which they do not use.
    names
        The labels of those.
    """

    axes: dict[str, tuple[int, ...]]
    grouping: Grouping
    kept: tuple[int, ...]
    names: tuple[str, ...]

    @property
    def combinations(self) -> list[dict[str, int]]:
        """The index along each axis, of every configuration; one that is empty without axes."""
        every = list(itertools.product(*self.axes.values()))
        return [dict(zip(self.axes, every[k], strict=True)) for k in self.kept]

    def stacked(self, table: xr.Dataset) -> xr.Dataset:
        """Return a table by these axes with the dimension ``configuration`` in their place."""
        dims = list(self.axes)
        flat = table.stack({CONFIGURATION: dims}, create_index=False) if dims else (
            table.expand_dims(CONFIGURATION))
        flat = flat.isel({CONFIGURATION: list(self.kept)}).drop_vars(dims, errors="ignore")
        named = flat.assign_coords({CONFIGURATION: list(self.names)})
        return named.transpose(CONFIGURATION, ...).assign_attrs(table.attrs)


def settings_of(
    data: ReportData, stages: Sequence[Stage] = BOTH, without: Sequence[str] = (), *,
    scene: Sequence[Axis] | None = None,
) -> Settings:
    """Return the combinations of the settings of some stages, and of axes of the scene.

    If there are more than `MAX_CONFIGURATIONS`, values of the longest axes are chosen, evenly
    spaced. ``without`` are axes that are left out, since a figure is along them. ``scene`` are
    those of targets by default.
    """
    scene = data.pipeline.experiment.target_axes if scene is None else scene
    chosen = {axis.name: len(axis) for axis in (*scene, *data.pipeline.axes_of(*stages))
              if len(axis) > 1 and axis.name not in without}
    while math.prod(chosen.values()) > MAX_CONFIGURATIONS and max(chosen.values()) > 2:
        chosen[max(chosen, key=lambda name: chosen[name])] -= 1
    axes, grouping = {}, Grouping()
    for name, length in chosen.items():
        part = data.along(name, length, binned=False)
        axes[name] = dict(part.chosen).get(name, tuple(range(length)))
        grouping += part
    values = [[data.results[name].values.tolist()[k] for k in some] for name, some in axes.items()]
    every = [dict(zip(axes, each, strict=True)) for each in itertools.product(*values)]
    kept = distinct(data.pipeline, every)
    names = (configuration_label(used_settings(data.pipeline, every[k])) for k in kept)
    return Settings(axes, grouping, tuple(kept), tuple(names))


@dataclass(frozen=True, eq=False)
class Configurations:
    """The configurations that a report compares.

    Attributes
    ----------
    settings
        What tells them apart.
    names
        Their n labels.
    wrong
        (n,) whether the estimator believes what is known not to be true; nowhere if that holds for
        all of them.
    summary
        `sweep.analysis.error_statistics` by configuration (n,).
    order
        (n,) indices: right beliefs first, of these by detection and solved rate, then by the RMSE
        of rotation and range.
    """

    settings: Settings
    names: list[str]
    wrong: NDArray[np.bool_]
    summary: xr.Dataset
    order: tuple[int, ...]

    @property
    def several(self) -> bool:
        """Whether there is more than one."""
        return len(self.names) > 1


def configurations(data: ReportData, *, targets: bool = True) -> Configurations:
    """Return the configurations of a store, in order, by targets, too, or with them pooled.

    Of a store with neither settings nor targets to compare, by the values of its effects.
    """
    return data.once(
        ("configurations", targets), lambda: _configurations(data, targets=targets))


def _configurations(data: ReportData, *, targets: bool) -> Configurations:
    settings = settings_of(data, scene=data.pipeline.experiment.target_axes if targets else ())
    if targets and not settings.axes:
        # Nothing else varies on the same draws: the values of an effect are what is compared.
        settings = settings_of(data, scene=data.effect_axes)
    summary = settings.stacked(data.analysed(error_statistics, settings.grouping))
    axes = [axis for axis in data.pipeline.axes_of(*BOTH) if axis.name in settings.axes]
    flags = np.array(wrong_configurations(data.pipeline, axes)).reshape(
        [len(axis) for axis in axes])
    flags = flags[np.ix_(*(settings.axes[axis.name] for axis in axes))] if axes else flags
    lengths = [len(some) for some in settings.axes.values()]  # those of targets stand first
    wrong = np.broadcast_to(flags, lengths).reshape(-1)[list(settings.kept)]
    names = [name + WRONG * bool(flag) for name, flag in zip(settings.names, wrong, strict=True)]

    def column(name: str, missing: float) -> NDArray[np.float64]:
        values = summary[name].values.astype(np.float64)
        return np.where(np.isnan(values), missing, values)

    order = np.lexsort((
        column("range_rmse_percent", np.inf), column("rotation_rmse_deg", np.inf),
        -column("solved_rate", -1.0), -column("detection_rate", -1.0), wrong))
    return Configurations(
        settings, names, wrong, summary.assign_coords({CONFIGURATION: names}),
        tuple(order.tolist()))


def best_first(data: ReportData, settings: Settings) -> list[int]:
    """Return the combinations of some settings in the order of their best configurations."""
    known = configurations(data)
    ordered = [known.settings.combinations[k] for k in known.order]

    def rank_of(each: dict[str, int]) -> int:
        return next((rank for rank, one in enumerate(ordered) if each.items() <= one.items()),
                    len(ordered))

    ranks = [rank_of(each) for each in settings.combinations]
    return sorted(range(len(ranks)), key=lambda k: (ranks[k], k))
