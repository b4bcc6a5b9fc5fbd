"""What a figure of a report is: when it applies, the table behind it, and how it is drawn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from sweep.analysis.quantiles import IntervalOf
from sweep.report.charts import Series
from sweep.report.report_data import Subject, labels_of
from sweep.report.table import Table
from sweep.report.theme import Panel
from sweep.typing import Floats


@dataclass(frozen=True, slots=True)
class RenderedFigure:
    """A figure of one store, ready to be put on a page.

    ``svg``, where there is one, is a whole drawing that stands in place of panels; its files are
    written by ``write``, which takes a path whose suffix is the format.
    """

    name: str
    title: str
    caption: str
    table: Table
    panels: Sequence[Panel] = ()
    svg: Callable[[str], str] | None = None
    write: Callable[[str], None] | None = None


@dataclass(frozen=True, slots=True)
class FigureKind:
    """A kind of figure: ``applies`` tells of which stores, ``show`` makes it of one of these.

    ``covers`` are the axes that need no other figure where it applies.
    """

    name: str
    applies: Callable[[Subject], bool]
    show: Callable[[Subject], RenderedFigure]
    covers: Callable[[Subject], Sequence[str]] = lambda _: ()


def middles(found: xr.Dataset, name: str) -> Floats:
    """Return where the groups of a numeric axis stand: its values, or the middles of bins."""
    if f"{name}_low" in found.coords:
        low, high = (
            np.asarray(found[f"{name}_{end}"], dtype=np.float64) for end in ("low", "high")
        )
        return np.asarray(np.where(low > 0, np.sqrt(np.abs(low * high)), (low + high) / 2))
    return np.asarray(found[name].values, dtype=np.float64)


def ends_of(found: xr.Dataset, name: str, scale: float = 1.0) -> tuple[Floats, Floats, Floats]:
    """Return a variable's values and the ends of its intervals, NaN where there are none."""
    value = np.asarray(found[name].values, dtype=np.float64)
    low, high = (
        np.asarray(found[f"{name}_{end}"].values, dtype=np.float64)
        if f"{name}_{end}" in found else np.full(value.shape, np.nan)
        for end in ("low", "high")
    )
    return scale * value, scale * low, scale * high


def series_of(
    found: xr.Dataset, along: str, name: str, by: str | None, scale: float = 1.0
) -> list[Series]:
    """Return a line of ``name`` along an axis for each value of ``by``; what is NaN is left out."""
    x = middles(found, along)
    order = np.argsort(x)
    parts = (
        [(f"{by.removesuffix('_deg')} {label}\u00b0" if by.endswith("_deg") else f"{label}",
          found.isel({by: k})) for k, label in enumerate(labels_of(found, by))]
        if by is not None else [("", found)]
    )
    lines = []
    for label, part in parts:
        value, low, high = ends_of(part, name, scale)
        there = order[~np.isnan(value[order])]
        lines.append(Series(label, x[there], value[there], low[there], high[there]))
    return lines


def on_intervals(found: xr.Dataset, *names: str, marks: str = "Bars") -> str:
    """Return what the drawn intervals are, or why there are none."""
    ends = [found[f"{name}_{end}"] for name in names for end in ("low", "high")
            if f"{name}_{end}" in found]
    if any(bool(np.isfinite(end).any()) for end in ends):
        return f"{marks} are 95 % intervals, of the random draws on this fixed grid."
    few = "median_interval" in found and bool(
        (found["median_interval"] == IntervalOf.too_few_draws).any())
    return "No intervals: too few draws." if few else (
        "No intervals: nothing was drawn at random.")


def of_how_many(found: xr.Dataset, name: str = "looked_for", what: str = "poses looked for") -> str:
    """Return the denominators in words: ``each of 40 to 200 poses looked for``."""
    counts = found[name].values[found[name].values > 0]
    if not counts.size:
        return f"No {what}."
    low, high = int(counts.min()), int(counts.max())
    which = f"{low:,}" if low == high else f"{low:,} to {high:,}"
    return f"Each value is of {which} {what}."


def lower(title: str) -> str:
    """Return a title as it stands within a sentence or on an axis."""
    return title[0].lower() + title[1:]


def sentences(*parts: str) -> str:
    """Join what is not empty."""
    return " ".join(part for part in parts if part)
