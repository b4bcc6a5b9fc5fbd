"""The figure of cost against accuracy of every configuration."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import xarray as xr
from markupsafe import Markup

from sweep.report.figure import FigureKind, RenderedFigure, sentences
from sweep.report.report_data import ReportData
from sweep.report.svg import inline_svg
from sweep.report.table import Table, cells
from sweep.report.theme import MATPLOTLIB_STYLE
from sweep.report.tradeoff_chart import draw_trade
from sweep.tradeoff.advice import advice, budget_advice
from sweep.tradeoff.pareto import CRITERIA, by_condition, mark_front

CRITERION = "rotation_p95_deg"
OTHER_CRITERION = "rotation_median_deg"
"""Used if the first is infinite or NaN for every configuration of some condition."""

COLUMNS = {
    "ms a frame": ("cost_ms", 1.0), "detected, %": ("detection_rate", 100.0),
    "flipped, %": ("flip_rate", 100.0), "rotation median, deg": ("rotation_median_deg", 1.0),
    "rotation p95, deg": ("rotation_p95_deg", 1.0),
    "range RMSE, %": ("range_rmse_percent", 1.0),
}
"""Heading -> variable, and the factor that it is multiplied by."""

CHART_STYLE: Any = {
    name: MATPLOTLIB_STYLE[name] for name in ("svg.fonttype", "svg.hashsalt", "text.parse_math")
} | {"savefig.transparent": True}


def trade_criterion(trade: xr.Dataset) -> str:
    """Return the error that ranks configurations: that asked for, if it is finite everywhere."""
    asked = str(trade.attrs.get("criterion", CRITERION))
    names = [name for name in (asked, CRITERION, OTHER_CRITERION)
             if name in CRITERIA and name in trade]
    return next(
        (name for name in names
         if np.isfinite(trade[name].values).any(axis=trade[name].dims.index("treatment")).all()),
        names[0],
    )


def _render(data: ReportData) -> RenderedFigure:
    if data.trade is None:
        raise KeyError("cost/tradeoff")
    trade = data.trade.drop_attrs(deep=False)  # the figure has a title of its own
    criterion, budget_ms = trade_criterion(data.trade), budget_of(data.trade)
    poses = int(data.trade.attrs.get("poses", 0))
    alt = f"Cost in milliseconds a frame against {criterion}, a panel for each condition."

    def write(path: str) -> None:
        with mpl.rc_context({"text.parse_math": False, "svg.hashsalt": "sweep"}):
            draw_trade(trade, criterion, path, budget_ms=budget_ms)

    def svg(prefix: str) -> Markup:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "trade.svg"
            with mpl.rc_context(CHART_STYLE):
                draw_trade(trade, criterion, path, budget_ms=budget_ms)
            return inline_svg(path.read_text(encoding="utf-8"), alt, prefix, clipped=True)

    return RenderedFigure(
        "trade", "Cost and accuracy",
        sentences(
            f"Cost of detection and estimation, ms a frame, against {criterion}, of each "
            "configuration on the same images, both logarithmic; bars are 95 % intervals; filled "
            "points form the Pareto front: no other configuration is both cheaper and better. "
            "Numbers are those of the legend.",
            f"The dotted line is the budget of {budget_ms:g} ms." if budget_ms else "",
            f"Of {poses:,} poses." if poses else "",
            *(f"{sentence}." for sentence in (
                budget_advice(trade, criterion, budget_ms) if budget_ms else [])),
            *(f"{sentence}." for sentence in advice(trade, criterion)),
        ),
        _table(trade, criterion), svg=svg, write=write,
    )


def budget_of(trade: xr.Dataset) -> float | None:
    """Return the budget, ms a frame, that the tradeoff was asked for; None for none."""
    budget = trade.attrs.get("budget_ms")
    return None if budget is None else float(budget)


def _table(trade: xr.Dataset, criterion: str) -> Table:
    columns = {heading: of for heading, of in COLUMNS.items() if of[0] in trade}
    return Table(
        "Cost and accuracy, the cheapest first, with 95 % intervals",
        ["configuration", "condition", "on the front", *columns],
        list(_rows(trade, criterion, list(columns.values()))), stub=2,
    )


def _rows(
    trade: xr.Dataset, criterion: str, columns: list[tuple[str, float]]
) -> Iterator[list[str]]:
    for label, condition in by_condition(mark_front(trade, criterion), criterion):
        cheapest_first = np.argsort(condition["cost_ms"].values, kind="stable")
        ordered = condition.isel(treatment=cheapest_first)
        texts = [cells(ordered, name, scale) for name, scale in columns]
        on_front = ordered["on_front"].values
        for k, name in enumerate(ordered["treatment"].values.tolist()):
            yield [str(name), label or "all", "yes" if on_front[k] else "",
                   *(text[k] for text in texts)]


TRADE = FigureKind("trade", lambda data: data.trade is not None, _render)
