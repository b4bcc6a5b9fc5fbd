"""The data of a report: a store's results, the roles of its axes, and analyses computed once."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
import xarray as xr

from sweep.analysis.conditions import conditions
from sweep.analysis.detection_limits import SIZE_AXES
from sweep.analysis.requirements import parse_requirements
from sweep.errors import StoreError, SweepError
from sweep.measure.flags import DetectionStatus, uncounted_values
from sweep.model.camera import VIEW_PARAMETERS
from sweep.plan.alternatives import WORLD
from sweep.plan.axes import TRIAL
from sweep.plan.experiment import Pipeline
from sweep.plan.parameters import Stage
from sweep.report.grouping import (
    ANGLES,
    AREA,
    Grouping,
    area_bins,
    axis_label,
    bins_of,
    chosen_of,
    drawn_bins,
    is_numeric,
)
from sweep.store.lifecycle import open_dataset, open_store
from sweep.store.outcome import outcome_of_finished
from sweep.store.snapshot import snapshot
from sweep.store.unfinished import unfinished_line

MAX_LOADED_BYTES = 600_000_000
"""Results up to this size are loaded at once: many figures read the same values, and many small
chunks are slow to read."""

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
        Its dataset, lazy.
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
    _analyses: dict[Any, xr.Dataset] = field(default_factory=dict, repr=False)
    _remembered: dict[str, Any] = field(default_factory=dict, repr=False)

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
    def angle(self) -> str:
        """The name of that axis in sentences; empty without one."""
        return ANGLES[self.angle_axis] if self.angle_axis else ""

    @functools.cached_property
    def area_range(self) -> tuple[float, float]:
        """The smallest and the largest area, px², of the poses looked for; NaN if there is none."""
        first = {axis.name: 0 for axis in self.pipeline.axes_of(Stage.detection)}
        detection = self.results["detection"].isel(first)
        area = self.results[AREA]
        area = area.where(~detection.isin(uncounted_values(DetectionStatus)) & (area > 0))
        with store_errors(self.store):
            ends = xr.Dataset({"low": area.min(), "high": area.max()}).compute()
        return float(ends["low"]), float(ends["high"])

    @property
    def areas_vary(self) -> bool:
        """Whether areas differ for other reasons than an axis of sizes or angles."""
        expected = {*SIZE_AXES, *ANGLES}
        reasons = {*VIEW_PARAMETERS, *expected, *WORLD, "yaw_deg", "pitch_deg", "size_m"}
        drawn = bool(reasons & self.pipeline.distributions.keys())
        axes = {axis.name for axis in self.pipeline.axes if len(axis) > 1}
        together = {name for axis in self.pipeline.axes for name, _ in axis.zipped}
        if not drawn and not axes & (reasons - expected) and not together & reasons:
            return False
        low, high = self.area_range
        return high > AREA_RATIO * low

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
            return area_bins(*self.area_range)
        if name in self.drawn_parameters:
            return drawn_bins(name, self.pipeline.distributions[name])
        axis = self.pipeline.axis(name)
        if axis is None:
            raise KeyError(name)
        if len(axis) <= most:
            return Grouping((name,))
        if binned and is_numeric(axis):
            return bins_of(name, np.asarray(self.results[name].values, dtype=np.float64), most)
        return chosen_of(name, len(axis), most)

    def by_angle(self, most: int = 6, *, binned: bool = True) -> Grouping:
        """Return the grouping by tilt or viewing angle, if one is an axis."""
        if not self.angle_axis:
            return Grouping()
        return self.along(self.angle_axis, most, binned=binned)

    def pooled(self, *kept: str) -> str:
        """Return a sentence that names the axes of the scene pooled over, all but ``kept``."""
        names = [
            axis.name for axis in self.pipeline.axes_of(Stage.scene)
            if len(axis) > 1 and axis.name not in kept
        ]
        return f"Pooled over {', '.join(names)}." if names else ""

    # Analyses.

    def in_memory(self) -> ReportData:
        """Return the data of a small store loaded; those of a large store stay lazy."""
        if self.results.nbytes > MAX_LOADED_BYTES:
            return self
        with store_errors(self.store):
            return dataclasses.replace(self, results=self.results.load())

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

    def remembered(self, key: str, make: Callable[[], T]) -> T:
        """Return what ``make`` returns; it is called once for each key."""
        if key not in self._remembered:
            self._remembered[key] = make()
        value: T = self._remembered[key]
        return value

    def once(self, key: Any, compute: Callable[[], xr.Dataset]) -> xr.Dataset:
        """Return what ``compute`` returns, loaded; it is called once for each key."""
        if key not in self._analyses:
            lazy = compute()
            with store_errors(self.store):
                self._analyses[key] = lazy.compute()
        return self._analyses[key]

    def known(self, key: Any) -> xr.Dataset | None:
        """Return what `once` has returned for a key; None if it was not called."""
        return self._analyses.get(key)


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
        conditions, by default those of `sweep.analysis.conditions`.
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
                snapshot(store), group="cost/tradeoff", consolidated=False, zarr_format=3
            ).load()
        results = open_dataset(store.url)
    required = tuple(require) or store.pipeline.requirements
    return ReportData(
        store.url, results, store.pipeline, store.run_metadata, trade,
        tuple(outcome_of_finished(store).warnings),
        tuple(each.text for each in parse_requirements(required)) if required else (),
        conditions(results, per, store.pipeline.require_per),
        command,
    )
