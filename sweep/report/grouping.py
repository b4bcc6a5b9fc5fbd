"""Groups of poses that a figure compares, and the labels of groups."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from sweep.plan.axes import Axis, Distribution
from sweep.plan.experiment import Pipeline
from sweep.plan.used_settings import distinct, used_settings
from sweep.report.formatting import bin_text, coordinates
from sweep.tradeoff.labels import configuration_label
from sweep.typing import Floats

AREA = "marker_area_px"
ANGLES = {"tilt_deg": "tilt", "view_angle_deg": "viewing angle"}
"""Axes along which the marker is turned away, and their names in sentences."""

IDS = "marker_id"
CONFIGURATION = "configuration"
"""Dimension of tables that have a row for each configuration."""

AREA_BINS = 24

DRAWN_BINS = 10
"""Bins of a drawn parameter."""


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


def area_bins(low: float, high: float) -> Grouping:
    """Return the grouping by bins of the area, of equal ratio, between two areas in px²."""
    areas = np.geomspace(low, high, AREA_BINS + 1)
    areas[[0, -1]] = low, np.nextafter(high, np.inf)
    return Grouping(
        bins=((AREA, tuple(areas.tolist())),),
        notes=(f"Areas are grouped into {AREA_BINS} bins of equal ratio.",),
    )


def drawn_bins(name: str, distribution: Distribution) -> Grouping:
    """Return the grouping of a drawn parameter by bins of equal probability."""
    edges = distribution.at(np.arange(1, DRAWN_BINS) / DRAWN_BINS)
    ends = (-np.inf, np.inf)
    if distribution.kind == "uniform":
        ends = (distribution.a, float(np.nextafter(distribution.b, np.inf)))
    note = f"The draws of {name} are grouped into {DRAWN_BINS} bins of equal probability."
    return Grouping(bins=((name, (ends[0], *edges.tolist(), ends[1])),), notes=(note,))


def equal_bins(name: str, low: float, high: float, width: float) -> Grouping:
    """Return the grouping by bins of equal width between multiples of it, around two values."""
    first, last = np.floor(low / width), max(np.ceil(high / width), np.floor(low / width) + 1)
    edges = width * np.arange(first, last + 1)
    edges[-1] = max(edges[-1], np.nextafter(high, np.inf))
    return Grouping(bins=((name, tuple(edges.tolist())),))


def bins_of(name: str, values: Floats, most: int) -> Grouping:
    """Return the grouping of an axis' values (n,) into ``most`` bins of about as many each."""
    groups = np.array_split(np.sort(values), most)
    between = [float(a[-1] + b[0]) / 2 for a, b in itertools.pairwise(groups)]
    edges = (float(groups[0][0]), *between, float(np.nextafter(groups[-1][-1], np.inf)))
    note = f"The {len(values):,} values of {name} are grouped into {len(edges) - 1} bins."
    return Grouping(bins=((name, edges),), notes=(note,))


def chosen_of(name: str, length: int, most: int) -> Grouping:
    """Return the grouping by ``most`` of the ``length`` values of an axis, evenly spaced."""
    chosen = tuple(np.linspace(0, length - 1, most).round().astype(int).tolist())
    note = f"{most} of the {length:,} values of {name} are shown."
    return Grouping((name,), chosen=((name, chosen),), notes=(note,))


def is_numeric(axis: Axis) -> bool:
    """Return whether an axis' values are numbers, and not labels or switches."""
    return not axis.labelled and not isinstance(axis.values[0], bool)


def axis_label(results: xr.Dataset, name: str) -> str:
    """Return the name of a coordinate or variable in words, with its unit: ``distance, m``."""
    names = {AREA: "area of the marker", "side_px": "side of the marker"}
    units = str(results[name].attrs.get("units", "")) if name in results.variables else ""
    words = names.get(name, name)
    for ending in ("_deg", "_m", "_px", "_s", "_mm", "_e", "_m_s"):
        if units and words == name and name.endswith(ending):
            words = name.removesuffix(ending)
    unit = {"px2": "px²", "degree": "deg"}.get(units, units)
    words = words.replace("_", " ")
    return f"{words}, {unit}" if unit else words


def group_labels(table: xr.Dataset, name: str) -> list[str]:
    """Return the values of a dimension as text; of bins their ends."""
    if f"{name}_low" in table.coords:
        ends = zip(table[f"{name}_low"].values, table[f"{name}_high"].values, strict=True)
        return [bin_text(low, high) for low, high in ends]
    return coordinates(table[name].values.tolist())


def by_configuration(
    pipeline: Pipeline, table: xr.Dataset, dims: Sequence[str]
) -> tuple[list[str], xr.Dataset]:
    """Return the labels of all combinations of the settings ``dims``, and the table by them.

    In the table the dimension ``configuration`` stands in place of ``dims``; without any it has
    one row. Combinations that differ in settings alone which they do not use are one.
    """
    values = [table[dim].values.tolist() for dim in dims]
    combinations = [dict(zip(dims, chosen, strict=True)) for chosen in itertools.product(*values)]
    kept = distinct(pipeline, combinations)
    labels = [configuration_label(used_settings(pipeline, combinations[k])) for k in kept]
    stacked = table.stack({CONFIGURATION: list(dims)}, create_index=False) if dims else (
        table.expand_dims(CONFIGURATION))
    stacked = stacked.isel({CONFIGURATION: kept}).drop_vars([*dims], errors="ignore")
    stacked = stacked.assign_coords({CONFIGURATION: labels})
    return labels, stacked.transpose(CONFIGURATION, ...)
