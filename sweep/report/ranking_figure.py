"""The figure of marker IDs, ordered by their detection rates."""

from __future__ import annotations

import numpy as np
import xarray as xr

from sweep.analysis import marker_ranking
from sweep.report.charts import draw_dots, draw_lines, rows_height
from sweep.report.configurations import first_detector
from sweep.report.figure import (
    FigureKind,
    RenderedFigure,
    denominators,
    dots_of,
    interval_sentence,
    sentences,
)
from sweep.report.grouping import IDS, axis_label
from sweep.report.report_data import ReportData
from sweep.report.scales import Series
from sweep.report.svg import Panel
from sweep.report.table import Table, cells

WEAKEST = 24
"""Marker IDs that have a row of their own in the chart."""


def _render(data: ReportData) -> RenderedFigure:
    first, whose = first_detector(data)
    summary = data.once("marker_ranking", lambda: marker_ranking(data.results.isel(first)))
    dims = [name for name in ("dictionary", IDS) if name in summary["detection_rate"].dims]
    ranked = _weakest_first(summary, dims)
    names = [
        " ".join(str(ranked[dim].values[k]) for dim in dims) for k in range(ranked.sizes["marker"])
    ]
    count = int(ranked["weak"].sum())
    return RenderedFigure(
        "ranking", "Marker IDs, the weakest first" + (f": {whose}" if whose else ""),
        sentences(
            f"Detection rate of each ID{' of each dictionary' if len(dims) > 1 else ''}; the small "
            "upright line is the rate expected from its scenes if all IDs were alike.",
            f"{count:,} of {len(names):,} IDs are weak (diamonds): below the expected rate, "
            "with an adjusted p-value under 0.05." if count else
            f"None of {len(names):,} IDs is weak (adjusted p-value under 0.05).",
            interval_sentence(data, summary, "detection_rate"), denominators(summary),
            data.pooled(*dims),
        ),
        Table(
            "IDs by detection rate, with 95 % intervals",
            [*(axis_label(summary, dim) for dim in dims), "looked for", "detected, %",
             "expected, %", "p, adjusted", "weak"],
            [list(row) for row in zip(
                *([str(value) for value in ranked[dim].values.tolist()] for dim in dims),
                cells(ranked, "looked_for"), cells(ranked, "detection_rate", 100),
                cells(ranked, "expected_rate", 100), cells(ranked, "p_adjusted"),
                cells(ranked, "weak"), strict=True)],
            stub=len(dims),
        ),
        _panels(ranked, names),
    )


def _weakest_first(summary: xr.Dataset, dims: list[str]) -> xr.Dataset:
    """Return the IDs that were looked for, along ``marker``: weak ones first, then by rate."""
    ranked = summary.stack(marker=dims, create_index=False)
    ranked = ranked.isel(marker=np.flatnonzero(ranked["looked_for"].values > 0))
    order = np.lexsort(
        (ranked[IDS].values, ranked["detection_rate"].values, ~ranked["weak"].values))
    return ranked.isel(marker=order)


def _panels(ranked: xr.Dataset, names: list[str]) -> list[Panel]:
    weakest = ranked.isel(marker=slice(0, WEAKEST))
    dots = dots_of(weakest, "detection_rate", 100)
    expected = 100 * weakest["expected_rate"].values.astype(np.float64)
    weak = weakest["weak"].values.astype(bool)
    panels = [Panel(
        "Weakest IDs", "Rows of the weakest IDs with their detection rates in percent.",
        lambda axes: draw_dots(axes, names[:WEAKEST], dots, "detected, %", share=True,
                               marked=weak, ticks=expected),
        height=rows_height(len(names[:WEAKEST])),
    )]
    if len(names) > WEAKEST:
        rates = np.sort(100 * ranked["detection_rate"].values.astype(np.float64))
        rank = np.arange(1, len(rates) + 1, dtype=np.float64)
        line = Series("", rank, rates, rates * np.nan, rates * np.nan)
        panels.append(Panel(
            "All IDs", "Line of the detection rates of all IDs, in increasing order.",
            lambda axes: draw_lines(axes, [line], ("rank", "detected, %"), share=True)))
    return panels


RANKING = FigureKind("ranking", lambda data: data.length(IDS) > 1, _render, lambda _: (IDS,))
