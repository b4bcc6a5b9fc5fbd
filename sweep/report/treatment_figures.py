"""Figures of the treatments, the settings of detector and estimator: how good, at what cost."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import xarray as xr

from sweep.analysis import compare, efficiency, error_statistics
from sweep.measure.flags import BoundStatus
from sweep.report.charts import Series, draw_dots, draw_map, rows_height
from sweep.report.figure import (
    FigureKind,
    RenderedFigure,
    ends_of,
    lower,
    of_how_many,
    on_intervals,
    sentences,
)
from sweep.report.report_data import TILT, Grouping, Subject, labels_of, stacked
from sweep.report.scene_figures import ERRORS
from sweep.report.table import Table, cells
from sweep.report.theme import STYLE, Panel, inline
from sweep.report.trade_figure import draw_trade
from sweep.tradeoff.pareto import advice, by_regime, mark_front

MAX_TREATMENTS = 30
SIZE_COLUMNS = 12

CRITERION = "rotation_p95_deg"
OTHER_CRITERION = "rotation_median_deg"


def treatment_grouping(subject: Subject) -> Grouping:
    """Return the grouping by treatment; of too many, that of the axes with the fewest values."""
    kept: list[str] = []
    count = 1
    for name in sorted(subject.treatments, key=subject.length):
        if count * subject.length(name) > MAX_TREATMENTS and kept:
            break
        kept.append(name)
        count *= subject.length(name)
    ordered = [name for name in subject.treatments if name in kept]
    if len(ordered) < len(subject.treatments):
        rest = [name for name in subject.treatments if name not in kept]
        note = f"There are too many combinations to show each: {', '.join(rest)} is pooled."
        grouping = Grouping(notes=(note,))
    else:
        grouping = Grouping()
    for name in ordered:
        grouping += subject.along(name, MAX_TREATMENTS, binned=False)
    return grouping


def _dot_panel(
    found: xr.Dataset, names: list[str], name: str, title: str, unit: str, *,
    scale: float = 1.0, share: bool = False, level: float | None = None,
) -> Panel:
    value, low, high = ends_of(found, name, scale)
    return Panel(
        title, f"Rows of {lower(title)} in {unit or 'one'} for each treatment.",
        lambda axes: draw_dots(axes, names, Series("", value, value, low, high),
                               f"{lower(title)}{', ' if unit else ''}{unit}", share=share,
                               level=level),
        height=rows_height(len(names)),
    )


def _treatments(subject: Subject) -> RenderedFigure:
    grouping = treatment_grouping(subject)
    names, found = stacked(subject.of(error_statistics, grouping), grouping.dims)
    panels = [
        _dot_panel(found, names, "solved_rate", "Solved", "%", scale=100, share=True),
        _dot_panel(found, names, "rotation_median_deg", "Rotation error, median", "deg"),
        _dot_panel(found, names, "range_median_percent", "Range error, median", "%"),
    ]
    if found["solved"].sum() > 0:
        panels.append(
            _dot_panel(found, names, "flip_rate", "Flipped", "%", scale=100, share=True))
    notes = list(grouping.notes)
    if subject.size_axis is not None:
        panel, note = _map_by_size(subject, grouping)
        panels.append(panel)
        notes += note
    columns = {"looked for": ("looked_for", 1.0)} | ERRORS
    return RenderedFigure(
        "treatments", f"Treatments compared: {', '.join(grouping.dims)}",
        sentences(
            "Share of the poses looked for that are solved, and the median errors, of each "
            "treatment on the same images; a pose that was not solved counts as an infinite "
            "error (right edge, \u221e).",
            on_intervals(found, "solved_rate"), of_how_many(found), *notes,
            subject.pooled(*grouping.dims),
        ),
        _table("Treatments, with 95 % intervals", names, found,
               columns | {"flipped, %": ("flip_rate", 100.0)}),
        panels,
    )


def _map_by_size(subject: Subject, grouping: Grouping) -> tuple[Panel, tuple[str, ...]]:
    """Return a map of the median rotation error over size and treatment."""
    axis = str(subject.size_axis)
    sizes = subject.along(axis, SIZE_COLUMNS)
    table = subject.of(error_statistics, grouping + sizes)
    names, found = stacked(table, grouping.dims)
    values = found["rotation_median_deg"].transpose("treatment", axis).values
    columns = labels_of(found, axis)
    return Panel(
        "Rotation error, median, deg",
        f"Map of the median rotation error over {axis} and treatment.",
        lambda axes: draw_map(axes, names[::-1], columns, values[::-1],
                              (subject.label(axis), "")),
        wide=len(columns) > 6, height=rows_height(len(names)) + 0.3,
    ), sizes.notes


def _table(
    caption: str, names: list[str], found: xr.Dataset,
    columns: Mapping[str, tuple[str, float]],
) -> Table:
    there = {heading: of for heading, of in columns.items() if of[0] in found}
    texts = [cells(found, name, scale) for name, scale in there.values()]
    rows = [[name, *(column[k] for column in texts)] for k, name in enumerate(names)]
    return Table(caption, ["treatment", *there], rows)


# Paired with the first.

PAIRED = {
    "compared": ("compared", 1.0),
    "found by it only": ("only_second_detected", 1.0),
    "found by the first only": ("only_first_detected", 1.0),
    "detection difference, points": ("detection_difference", 100.0),
    "p (McNemar)": ("detection_p_value", 1.0),
    "both solved": ("both_solved", 1.0),
    "rotation difference, deg": ("rotation_difference_deg", 1.0),
    "rotation RMSE ratio": ("rotation_rmse_ratio", 1.0),
    "range difference, %": ("range_difference_percent", 1.0),
    "range RMSE ratio": ("range_rmse_ratio", 1.0),
}


def _paired(subject: Subject) -> RenderedFigure:
    grouping = treatment_grouping(subject)
    results = subject.results.isel({name: list(some) for name, some in grouping.chosen})
    found = subject.once("paired", lambda: compare(
        _first_everywhere(results, grouping.dims), results, grouping.dims))
    names, together = stacked(found, grouping.dims)
    others = together.isel(treatment=slice(1, None))
    return RenderedFigure(
        "paired", f"Each treatment against the first: {names[0]}",
        sentences(
            f"Differences from {names[0]}, on the same scenes: detection rate in percentage "
            "points (to the right: found more often), and the ratio of the rotation's RMSE over "
            "scenes that both solve (below 1: smaller errors).",
            on_intervals(others, "detection_difference"),
            of_how_many(others, "compared", "pairs"), *grouping.notes,
            subject.pooled(*grouping.dims),
        ),
        _table(f"Against {names[0]}, with 95 % intervals", names[1:], others, PAIRED),
        [_dot_panel(others, names[1:], "detection_difference", "Detection, difference",
                    "points", scale=100, level=0.0),
         _dot_panel(others, names[1:], "rotation_rmse_ratio", "Rotation RMSE, ratio", "",
                    level=1.0),
         _dot_panel(others, names[1:], "range_rmse_ratio", "Range RMSE, ratio", "", level=1.0)],
    )


def _first_everywhere(results: xr.Dataset, treatments: Sequence[str]) -> xr.Dataset:
    """Return results in which each treatment has what the first has."""
    replaced = {}
    for name, variable in results.data_vars.items():
        dims = [dim for dim in treatments if dim in variable.dims]
        if dims:
            first = variable.isel(dict.fromkeys(dims, 0), drop=True)
            replaced[name] = first.expand_dims({dim: results[dim] for dim in dims}).transpose(
                *variable.dims)
    return results.assign(replaced)


# Against the bound.

def _has_bound(subject: Subject) -> bool:
    if "bound" not in subject.results:
        return False
    found = subject.once("bound given", lambda: xr.Dataset(
        {"given": (subject.results["bound"] == BoundStatus.given).any()}))
    return bool(found["given"])


def _bound(subject: Subject) -> RenderedFigure:
    grouping = treatment_grouping(subject)
    along = subject.size_axis or (TILT if subject.tilted else None)
    sizes = subject.along(along, SIZE_COLUMNS) if along else Grouping()
    treatments, per = list(grouping.dims), list(sizes.dims)
    ratio = _over_bound(subject.of(efficiency, grouping + sizes))
    if treatments:
        names, found = stacked(ratio, treatments)
    else:
        names, found = ["all"], ratio.expand_dims("treatment")
    columns = labels_of(found, along) if along else ["all"]
    label = subject.label(along) if along else ""

    def panel(name: str, title: str) -> Panel:
        values = found[name].transpose("treatment", *per).values.reshape(len(names), -1)[::-1]
        return Panel(
            title, f"Map of {lower(title)} over {label or 'all poses'} and treatment.",
            lambda axes: draw_map(axes, names[::-1], columns, values, (label, "")),
            wide=len(columns) > 6, height=rows_height(len(names)) + 0.5,
        )

    rows = [
        [name, *(column,) * bool(along), *(
            cells(found.isel({"treatment": k} | ({along: j} if along else {})), key)[0]
            for key in ("rotation_over_bound", "range_over_bound"))]
        for k, name in enumerate(names) for j, column in enumerate(columns)
    ]
    return RenderedFigure(
        "bound", "How far from the accuracy bound",
        sentences(
            "RMSE over the Cram\u00e9r-Rao bound, of the solved poses that are not flipped and "
            "have a bound: 1 is the best that an unbiased estimate can do, 10 is ten times that.",
            on_intervals(found, "rotation_over_bound", marks="In the table there"),
            *grouping.notes, *sizes.notes, subject.pooled(*treatments, *per),
        ),
        Table("RMSE over the bound, with 95 % intervals",
              ["treatment", *([label] if along else []), "rotation", "range"], rows,
              stub=1 + bool(along)),
        [panel("rotation_over_bound", "Rotation RMSE over the bound"),
         panel("range_over_bound", "Range RMSE over the bound")],
    )


def _over_bound(found: xr.Dataset) -> xr.Dataset:
    ratios: dict[str, Any] = {}
    for quantity in ("rotation", "range"):
        for end, other in (("", ""), ("_low", "_high"), ("_high", "_low")):
            ratios[f"{quantity}_over_bound{end}"] = 1 / found[f"{quantity}_efficiency{other}"]
    return xr.Dataset(ratios, found.coords)


# What accuracy costs.

def _trade(subject: Subject) -> RenderedFigure:
    if subject.trade is None:
        raise KeyError("cost/tradeoff")
    trade = subject.trade.drop_attrs(deep=False)  # the page says the title
    criterion = next(
        (name for name in (CRITERION, OTHER_CRITERION)
         if np.isfinite(trade[name].values).any(axis=trade[name].dims.index("treatment")).all()),
        CRITERION,
    )
    poses = int(subject.trade.attrs.get("poses", 0))
    alt = f"Cost in milliseconds a frame against {criterion}, a panel for each regime."
    columns = {
        "ms a frame": ("cost_ms", 1.0), "detected, %": ("detection_rate", 100.0),
        "flipped, %": ("flip_rate", 100.0), "rotation median, deg": ("rotation_median_deg", 1.0),
        "rotation p95, deg": ("rotation_p95_deg", 1.0),
        "range RMSE, %": ("range_rmse_percent", 1.0),
    }
    columns = {heading: of for heading, of in columns.items() if of[0] in trade}
    rows = []
    for label, regime in by_regime(mark_front(trade, criterion), criterion):
        ordered = regime.isel(treatment=np.argsort(regime["cost_ms"].values, kind="stable"))
        texts = [cells(ordered, *of) for of in columns.values()]
        best = ordered["on_front"].values
        rows += [
            [str(name), label or "all", "yes" if best[k] else "", *(text[k] for text in texts)]
            for k, name in enumerate(ordered["treatment"].values.tolist())
        ]

    def write(path: str) -> None:
        with mpl.rc_context({"text.parse_math": False, "svg.hashsalt": "sweep"}):
            draw_trade(trade, criterion, path)

    def svg(prefix: str) -> str:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "trade.svg"
            look: Any = {name: STYLE[name] for name in ("svg.fonttype", "svg.hashsalt",
                                                   "text.parse_math")}
            with mpl.rc_context({**look, "savefig.transparent": True}):
                draw_trade(trade, criterion, path)
            return inline(path.read_text(encoding="utf-8"), alt, prefix, clipped=True)

    return RenderedFigure(
        "trade", "What accuracy costs",
        sentences(
            f"Cost of detection and estimation, ms a frame, against {criterion}, of each "
            "treatment on the same images, both logarithmic; bars are 95 % intervals; filled "
            "points are the best for their cost.",
            f"Of {poses:,} poses." if poses else "",
            *(f"{sentence}." for sentence in advice(trade, criterion)),
        ),
        Table("Cost and accuracy, the cheapest first, with 95 % intervals",
              ["treatment", "regime", "on the front", *columns], rows, stub=2),
        svg=svg, write=write,
    )


def _covered(subject: Subject) -> tuple[str, ...]:
    return treatment_grouping(subject).dims


TREATMENTS = FigureKind("treatments", lambda s: bool(s.treatments), _treatments, _covered)
COMPARED = FigureKind("paired", lambda s: bool(s.treatments), _paired)
BOUND = FigureKind("bound", _has_bound, _bound)
TRADE = FigureKind("trade", lambda s: s.trade is not None, _trade)
