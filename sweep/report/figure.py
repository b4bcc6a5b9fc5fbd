"""Figures of a report: for which stores they are made, their tables, panels and captions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from markupsafe import Markup

from sweep.analysis.dimensions import of_photographs
from sweep.analysis.quantiles import IntervalOf
from sweep.report.grouping import group_labels
from sweep.report.report_data import ReportData
from sweep.report.scales import Series
from sweep.report.svg import Panel
from sweep.report.table import Table
from sweep.typing import Floats


@dataclass(frozen=True, slots=True)
class RenderedFigure:
    """A figure of one store.

    Attributes
    ----------
    name
        Its anchor on the page, and the name of its files.
    title, caption
        Text above and below it.
    table
        The numbers that it shows.
    panels
        Its drawings.
    svg
        Returns one drawing in place of panels as inline SVG; takes a prefix for its identifiers.
    write
        Writes that drawing into a file; the suffix of the path is the format.
    """

    name: str
    title: str
    caption: str
    table: Table
    panels: Sequence[Panel] = ()
    svg: Callable[[str], Markup] | None = None
    write: Callable[[str], None] | None = None


@dataclass(frozen=True, slots=True)
class FigureKind:
    """A kind of figure.

    Attributes
    ----------
    name
        Name of its figures.
    applies
        Whether a store has such a figure.
    render
        Makes the figure of a store to which the kind applies.
    covers
        The axes that need no figure of their own if the kind applies.
    """

    name: str
    applies: Callable[[ReportData], bool]
    render: Callable[[ReportData], RenderedFigure]
    covers: Callable[[ReportData], Sequence[str]] = lambda _: ()


def group_positions(summary: xr.Dataset, name: str) -> Floats:
    """Return the positions (n,) of groups on a numeric axis: values, or the middles of bins.

    The middle of a bin is the geometric mean of its ends if both are positive.
    """
    if f"{name}_low" in summary.coords:
        low, high = (
            np.asarray(summary[f"{name}_{end}"], dtype=np.float64) for end in ("low", "high")
        )
        return np.asarray(np.where(low > 0, np.sqrt(np.abs(low * high)), (low + high) / 2))
    return np.asarray(summary[name].values, dtype=np.float64)


def values_with_ends(
    summary: xr.Dataset, name: str, scale: float = 1.0
) -> tuple[Floats, Floats, Floats]:
    """Return a variable's values and the ends of its intervals, NaN without an interval."""
    value = np.asarray(summary[name].values, dtype=np.float64)
    low, high = (
        np.asarray(summary[f"{name}_{end}"].values, dtype=np.float64)
        if f"{name}_{end}" in summary else np.full(value.shape, np.nan)
        for end in ("low", "high")
    )
    return scale * value, scale * low, scale * high


def dots_of(summary: xr.Dataset, name: str, scale: float = 1.0) -> Series:
    """Return a variable (n,) and its intervals as the dots of n rows."""
    value, low, high = values_with_ends(summary, name, scale)
    return Series("", value, value, low, high)


def lines_of(
    summary: xr.Dataset, along: str, name: str, by: str | None, scale: float = 1.0
) -> list[Series]:
    """Return a line of ``name`` along an axis for each value of ``by``, without NaN."""
    x = group_positions(summary, along)
    order = np.argsort(x)
    parts = (
        [(f"{by.removesuffix('_deg')} {label}\u00b0" if by.endswith("_deg") else f"{label}",
          summary.isel({by: k})) for k, label in enumerate(group_labels(summary, by))]
        if by is not None else [("", summary)]
    )
    lines = []
    for label, part in parts:
        value, low, high = values_with_ends(part, name, scale)
        known = order[~np.isnan(value[order])]
        lines.append(Series(label, x[known], value[known], low[known], high[known]))
    return lines


def interval_sentence(
    data: ReportData, summary: xr.Dataset, *names: str, marks: str = "Bars"
) -> str:
    """Return a sentence that says what the drawn intervals are, or why there are none."""
    ends = [summary[f"{name}_{end}"] for name in names for end in ("low", "high")
            if f"{name}_{end}" in summary]
    photographs = of_photographs(data.results)
    if any(bool(np.isfinite(end).any()) for end in ends):
        drawn = (
            "photographs, each with all its markers one draw" if photographs
            else "random draws, conditional on the grid"
        )
        return f"{marks} are 95 % intervals over the {drawn}."
    if photographs:
        return "No intervals: too few photographs."
    few = "median_interval" in summary and bool(
        (summary["median_interval"] == IntervalOf.too_few_draws).any())
    return "No intervals: too few draws." if few else (
        "No intervals: nothing was drawn at random.")


def denominators(
    summary: xr.Dataset, name: str = "looked_for", what: str = "poses looked for"
) -> str:
    """Return a sentence with the denominators: ``Each value is of 40 to 200 poses ...``."""
    counts = summary[name].values[summary[name].values > 0]
    if not counts.size:
        return f"No {what}."
    low, high = int(counts.min()), int(counts.max())
    span = f"{low:,}" if low == high else f"{low:,} to {high:,}"
    return f"Each value is of {span} {what}."


def uncapitalised(title: str) -> str:
    """Return a title as it stands within a sentence or on an axis."""
    return title[0].lower() + title[1:]


def sentences(*parts: str) -> str:
    """Return the parts that are not empty, joined by spaces."""
    return " ".join(part for part in parts if part)
