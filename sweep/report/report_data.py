"""What a report is about: a store's results, and the part that each of its axes plays."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.analysis.detection_limits import SIZE_AXES
from sweep.analysis.pose_view import NOT_LOOKED_FOR
from sweep.errors import StoreError, SweepError
from sweep.model.camera import VIEW_PARAMETERS
from sweep.plan.axes import TRIAL, Axis
from sweep.plan.experiment import Pipeline
from sweep.plan.parameters import Stage

AREA = "marker_area_px"
TILT = "tilt_deg"
IDS = "marker_id"
AREA_BINS = 24
MANY_SIZES = 20
"""From so many sizes on, areas are many enough to be binned."""

SHORT = 5
"""Characters of a number that needs no rounding to be short."""

NEEDED = (
    "detection", "estimate", "flipped", "rotation_error_deg", "rotation_error_rad",
    "normal_error_deg", "reprojection_error_px", "translation_error_m", "true_tvec_m", AREA,
    "alternative_rotation_error_deg", "alternative_reprojection_error_px", "bound", "bound_std",
    "nees", "residual_variance_ratio",
)
"""The variables that a report needs."""

LOADED_BYTES = 200_000_000

Analysis = Callable[..., xr.Dataset]


@dataclass(frozen=True, slots=True)
class Grouping:
    """What is told apart: axes as they are, bins of an axis or of the area, or some values only.

    ``notes`` say, for the reader, where not every value is shown by itself.
    """

    per: tuple[str, ...] = ()
    bins: tuple[tuple[str, tuple[float, ...]], ...] = ()
    chosen: tuple[tuple[str, tuple[int, ...]], ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def dims(self) -> tuple[str, ...]:
        """Dimensions of what is found."""
        return self.per + tuple(name for name, _ in self.bins)

    def __add__(self, other: Grouping) -> Grouping:
        return Grouping(
            self.per + other.per, self.bins + other.bins, self.chosen + other.chosen,
            self.notes + other.notes,
        )


@dataclass(frozen=True, eq=False)
class Subject:
    """A finished store as a report sees it.

    Attributes
    ----------
    store
        Where it is.
    results
        Its dataset, lazy.
    pipeline, about
        What was run; fingerprint, environment and dates.
    trade
        Its group ``cost/tradeoff``, where it has one.
    """

    store: str
    results: xr.Dataset
    pipeline: Pipeline
    about: Mapping[str, Any]
    trade: xr.Dataset | None = None
    _found: dict[Any, xr.Dataset] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        """Give a single pose, which has no axes, the one draw that it is."""
        if "detection" in self.results and not self.results["detection"].dims:
            object.__setattr__(self, "results", self.results.expand_dims({TRIAL: [0]}))

    # The parts that axes play.

    def length(self, name: str) -> int:
        """Return the number of an axis' values; 0 where there is no such axis."""
        axis = self.pipeline.axis(name)
        return len(axis) if axis is not None else 0

    @property
    def size_axis(self) -> str | None:
        """The axis along which the marker's size changes."""
        return next((name for name in SIZE_AXES if self.length(name) > 1), None)

    @property
    def tilted(self) -> bool:
        """Whether tilts are compared."""
        return self.length(TILT) > 1

    @functools.cached_property
    def area_range(self) -> tuple[float, float]:
        """The smallest and the largest area, px², of what was looked for; NaN where nothing was."""
        settings = {
            axis.name: 0 for axis in self.pipeline.axes_of(Stage.detection)
        }
        detection = self.results["detection"].isel(settings)
        area = self.results[AREA]
        area = area.where(~detection.isin(NOT_LOOKED_FOR) & (area > 0))
        with reading(self.store):
            both = xr.Dataset({"low": area.min(), "high": area.max()}).compute()
        return float(both["low"]), float(both["high"])

    @property
    def areas_vary(self) -> bool:
        """Whether areas differ for other reasons than an axis of sizes or tilts."""
        reasons = {*VIEW_PARAMETERS, *SIZE_AXES, TILT, "size_m"}
        drawn = bool(reasons & self.pipeline.distributions.keys())
        axes = {axis.name for axis in self.pipeline.axes if len(axis) > 1}
        if not drawn and not axes & (reasons - {*SIZE_AXES, TILT}):
            return False
        low, high = self.area_range
        return high > 2 * low

    @property
    def size(self) -> str | None:
        """What tells sizes apart: an axis, or the area where it varies without one."""
        return self.size_axis or (AREA if self.areas_vary else None)

    @property
    def treatments(self) -> tuple[str, ...]:
        """Axes of the detector and of the estimator that have more than one value."""
        stages = (Stage.detection, Stage.estimation)
        return tuple(axis.name for axis in self.pipeline.axes_of(*stages) if len(axis) > 1)

    @property
    def scene_axes(self) -> tuple[str, ...]:
        """Axes of the scene, without the draws, that have more than one value."""
        return tuple(
            axis.name for axis in self.pipeline.axes_of(Stage.scene)
            if len(axis) > 1 and axis.name != TRIAL
        )

    def label(self, name: str) -> str:
        """Return an axis' name with its unit, as axes of figures have it: ``distance, m``."""
        return label_of(self.results, name)

    def in_memory(self) -> Subject:
        """Return the subject with what figures need of a small store loaded; of others itself.

        Many figures read the same values, and many small chunks are slow to read.
        """
        needed = self.results[[name for name in NEEDED if name in self.results]]
        if needed.nbytes > LOADED_BYTES:
            return self
        with reading(self.store):
            return dataclasses.replace(self, results=needed.load())

    # Groupings.

    def along(self, name: str, most: int = 40, *, binned: bool = True) -> Grouping:
        """Return the grouping by an axis, at most ``most`` groups, or by bins of the area.

        The values of a longer axis are put in bins where they are numbers and ``binned``, else
        some of them are chosen.
        """
        if name == AREA:
            low, high = self.area_range
            areas = np.geomspace(low, high, AREA_BINS + 1)
            areas[[0, -1]] = low, np.nextafter(high, np.inf)
            return Grouping(
                bins=((AREA, tuple(areas.tolist())),),
                notes=(f"Areas are in {AREA_BINS} bins of equal ratio.",),
            )
        axis = self.pipeline.axis(name)
        if axis is None:
            raise KeyError(name)
        if len(axis) <= most:
            return Grouping((name,))
        if binned and is_numeric(axis):
            edges = _edges(np.asarray(self.results[name].values, dtype=np.float64), most)
            note = f"The {len(axis):,} values of {name} are in {len(edges) - 1} bins."
            return Grouping(bins=((name, edges),), notes=(note,))
        chosen = tuple(np.linspace(0, len(axis) - 1, most).round().astype(int).tolist())
        note = f"{most} of the {len(axis):,} values of {name} are shown."
        return Grouping((name,), chosen=((name, chosen),), notes=(note,))

    def by_tilt(self, most: int = 6) -> Grouping:
        """Return the grouping by tilt, where tilts are compared."""
        return self.along(TILT, most) if self.tilted else Grouping()

    def by_treatment(self) -> Grouping:
        """Return the grouping by each combination of treatments."""
        return Grouping(self.treatments)

    def pooled(self, *kept: str) -> str:
        """Return what is pooled beside what is kept, in words."""
        names = [
            axis.name for axis in self.pipeline.axes if len(axis) > 1 and axis.name not in kept
        ]
        return f"Pooled over {', '.join(names)}." if names else ""

    # What is found.

    def of(self, analysis: Analysis, grouping: Grouping | None = None) -> xr.Dataset:
        """Return what an analysis finds, loaded; each is computed once.

        Parameters
        ----------
        analysis
            A function of `sweep.analysis` that takes results, per and bins.
        grouping
            Dimensions of what is returned, in this order; other dimensions follow.
        """
        grouping = grouping or Grouping()
        key = (analysis.__name__, grouping.per, grouping.bins, grouping.chosen)
        if key not in self._found:
            results = self.results.isel({name: list(some) for name, some in grouping.chosen})
            found = analysis(results, per=grouping.per, bins=dict(grouping.bins))
            with reading(self.store):
                self._found[key] = found.compute().transpose(*grouping.dims, ...)
        return self._found[key]

    def once(self, key: str, find: Callable[[], xr.Dataset]) -> xr.Dataset:
        """Return what ``find`` returns, loaded; it is called once."""
        if key not in self._found:
            found = find()
            with reading(self.store):
                self._found[key] = found.compute()
        return self._found[key]


@contextlib.contextmanager
def reading(store: str) -> Iterator[None]:
    """Turn whatever goes wrong while a store is read into a ``StoreError`` of one line."""
    try:
        yield
    except SweepError:
        raise
    except Exception as error:
        # A damaged store fails within zarr, its codecs or xarray, each with errors of its own.
        reason = " ".join(str(error).split()) or type(error).__name__
        raise StoreError(f"{store}: cannot be read: {reason}") from None


def is_numeric(axis: Axis) -> bool:
    """Tell whether an axis' values are numbers, in an order that means something."""
    return not axis.labelled and not isinstance(axis.values[0], bool)


def label_of(results: xr.Dataset, name: str) -> str:
    """Return a coordinate's or variable's name in words with its unit."""
    words = {AREA: "area of the marker", "side_px": "side of the marker"}
    units = str(results[name].attrs.get("units", "")) if name in results.variables else ""
    plain = words.get(name, name)
    for ending in ("_deg", "_m", "_px", "_s", "_mm", "_e", "_m_s"):
        if units and plain == name and name.endswith(ending):
            plain = name.removesuffix(ending)
    shown = {"px2": "px²", "degree": "deg"}.get(units, units)
    plain = plain.replace("_", " ")
    return f"{plain}, {shown}" if shown else plain


def text_of(value: Any) -> str:
    """Return a coordinate's value as text: six significant digits at most."""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def labels_of(table: xr.Dataset, name: str) -> list[str]:
    """Return the values of a dimension as text; of bins their ends."""
    if f"{name}_low" in table.coords:
        ends = zip(table[f"{name}_low"].values, table[f"{name}_high"].values, strict=True)
        return [f"{_end(low)}\u2013{_end(high)}" for low, high in ends]
    return texts_of(table[name].values.tolist())


def _end(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def texts_of(values: Sequence[Any]) -> list[str]:
    """Return coordinates as text: long numbers with as few digits as tell them apart.

    >>> texts_of([0.15, 0.208424, 1.5]), texts_of([12.25, 12.5]), texts_of(["exact", "warp"])
    (['0.15', '0.208', '1.5'], ['12.25', '12.5'], ['exact', 'warp'])
    """
    plain = [text_of(value) for value in values]
    if max(map(len, plain), default=0) <= SHORT or not all(isinstance(v, float) for v in values):
        return plain
    for figures in range(3, 6):
        shorter = [f"{value:.{figures}g}" for value in values]
        if len(set(shorter)) == len(shorter):
            return shorter
    return plain


def stacked(table: xr.Dataset, dims: Sequence[str]) -> tuple[list[str], xr.Dataset]:
    """Return labels of all combinations of ``dims``, and the table with them as ``treatment``."""
    names = [labels_of(table, dim) for dim in dims]
    index = np.indices([len(some) for some in names]).reshape(len(names), -1)
    labels = [
        " \u00b7 ".join(some[k] for some, k in zip(names, position, strict=True))
        for position in index.T.tolist()
    ]
    together = table.stack(treatment=list(dims), create_index=False)
    return labels, together.drop_vars([*dims], errors="ignore")


def _edges(values: NDArray[np.float64], most: int) -> tuple[float, ...]:
    """Return the edges of at most ``most`` bins of about as many grid values each."""
    groups = np.array_split(np.sort(values), most)
    between = [float(a[-1] + b[0]) / 2 for a, b in itertools.pairwise(groups)]
    return (float(groups[0][0]), *between, float(np.nextafter(groups[-1][-1], np.inf)))
