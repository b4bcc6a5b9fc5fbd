"""What accuracy costs, as plain text, as Markdown and as JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from sweep.tradeoff.pareto import (
    UNITS,
    by_regime,
    digits,
    heading_of,
    interval,
    mark_front,
    unit_of,
)

WIDEST = 140
"""Columns of a terminal; groups that do not fit beside each other go below each other."""

GAP = "  "

STATISTICS = {
    "bias": "bias", "RMSE": "rmse", "unflipped": "rmse_unflipped", "median": "median",
    "p95": "p95", "p99": "p99",
}
"""Headings, and what the variables of rotation and range call them."""

WINDOWS = {
    "auto": "searched: the marker's surroundings",
    "full": "searched: the whole frame",
    "mixed": "searched: the whole frame or the marker's surroundings, as each setting needs",
}


class Column(NamedTuple):
    """A heading and a cell for each treatment."""

    heading: str
    cells: list[str]

    @property
    def width(self) -> int:
        """Characters of the widest cell."""
        return max(map(len, (self.heading, *self.cells)))


class Group(NamedTuple):
    """Columns that stand under one heading."""

    heading: str
    columns: list[Column]

    @property
    def width(self) -> int:
        """Characters of the columns and the gaps between them, at least those of the heading."""
        columns = sum(column.width for column in self.columns) + len(GAP) * (len(self.columns) - 1)
        return max(columns, len(self.heading))


def table_text(trade: xr.Dataset, criterion: str) -> str:
    """Return plain tables for each regime, at most 140 characters wide, cheapest treatment first.

    Times are in ms a frame, rotations in degrees, ranges in percent. Treatments on the front of
    cost and criterion have a star; costs and the criterion have their 95 % intervals. Columns
    whose variables ``trade`` lacks are left out; a label longer than some 60 characters makes
    the tables wider. Raises ``KeyError`` if ``trade`` lacks ``cost_ms``, ``cost_ratio`` or the
    criterion.
    """
    lines = _headlines(trade)
    for label, regime in _sorted_regimes(trade, criterion):
        stars = np.where(regime["on_front"], "* ", "  ")
        names = regime["treatment"].to_numpy()
        first = Group("", [Column(
            "  treatment", [f"{star}{name}" for star, name in zip(stars, names, strict=True)]
        )])
        lines += ["", label] if label else []
        for groups in _side_by_side(first, _groups(regime, criterion)):
            lines += ["", *_lines(groups)]
    return "\n".join([*lines, "", _legend(criterion)])


def table_markdown(trade: xr.Dataset, criterion: str) -> str:
    """Return a Markdown table for each regime, cheapest treatment first, the front in bold.

    Costs with their intervals, the rates, the criterion with its interval and, for the other
    quantity, the same statistic. Raises ``KeyError`` as `table_text` does.
    """
    quantity, statistic = unit_of(criterion)[0].split("_", 1)
    other = next(name for name in UNITS if name != quantity)
    beside = f"{other}_{statistic}_{UNITS[other]}"
    lines = []
    for label, regime in _sorted_regimes(trade, criterion):
        names = [
            f"**{name}**" if on_front else f"{name}"
            for name, on_front in zip(
                regime["treatment"].to_numpy(), regime["on_front"].to_numpy(), strict=True
            )
        ]
        columns = [
            Column("treatment", names), *_cost_columns(regime), *_finding_columns(regime),
            _with_interval(regime, criterion, heading_of(criterion)),
            *_columns(regime, {heading_of(beside): beside}),
        ]
        lines += [f"**{label}**", ""] if label else []
        lines += [
            _row(column.heading for column in columns),
            "| --- |" + " ---: |" * (len(columns) - 1),
            *(_row(cells) for cells in zip(*(column.cells for column in columns), strict=True)),
            "",
        ]
    return "\n".join([*lines, "; ".join(_headlines(trade)[1:]) + "; bold: no other treatment is "
                      f"both cheaper and better in {criterion}."])


def as_json(trade: xr.Dataset) -> dict[str, Any]:
    """Return all of ``trade`` as what JSON can hold: attrs, coords and data_vars by name.

    Each variable has ``dims`` and ``data``, nested lists of the shape of its dimensions. Infinity
    is the string ``infinite`` (``-infinite``), NaN is null.
    """
    content: dict[str, Any] = _json_safe(trade.to_dict())
    return content


def _json_safe(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _json_safe(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _json_safe(value.tolist())
    if isinstance(value, list | tuple):
        return [_json_safe(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else "infinite" if value > 0 else "-infinite"
    return value if isinstance(value, bool | int | float | str | None) else str(value)


def _headlines(trade: xr.Dataset) -> list[str]:
    """Return the title, and what was measured."""
    attrs = trade.attrs
    told = {
        "poses": f"{attrs.get('poses')} poses",
        "window": WINDOWS.get(str(attrs.get("window")), f"searched: {attrs.get('window')}"),
        "baseline": f"baseline: {attrs.get('baseline')}",
    }
    return [
        str(attrs.get("title", "")),
        "ms a frame: detection and estimation",
        *(text for name, text in told.items() if name in attrs),
    ]


def _legend(criterion: str) -> str:
    return (
        f"* no other treatment is both cheaper and better in {criterion}\n"
        "low..high: 95 % intervals; RMSE and bias: of what was solved; "
        "median, p95, p99: a miss is infinite"
    )


def _sorted_regimes(trade: xr.Dataset, criterion: str) -> Iterator[tuple[str, xr.Dataset]]:
    """Yield the regimes with ``on_front``, each with its cheapest treatment first."""
    for label, regime in by_regime(mark_front(trade, criterion), criterion):
        order = np.argsort(regime["cost_ms"].to_numpy(), kind="stable")
        yield label, regime.isel(treatment=order)


def _groups(regime: xr.Dataset, criterion: str) -> list[Group]:
    decision = [
        *_cost_columns(regime), *_finding_columns(regime),
        _with_interval(regime, criterion, heading_of(criterion)),
    ]
    groups = [Group("cost and criterion", decision)]
    for quantity, unit in UNITS.items():
        names = {
            heading: f"{quantity}_{statistic}_{unit}"
            for heading, statistic in STATISTICS.items()
        }
        columns = _columns(regime, names | {"efficiency": f"{quantity}_efficiency"})
        groups.append(Group(heading_of(f"{quantity}_{unit}"), columns))
    covariance = _columns(regime, {"NEES": "nees_mean"})
    if "covariance_coverage" in regime:
        covered = 100 * regime["covariance_coverage"].transpose("treatment", "level")
        levels = "/".join(f"{100 * level:g}" for level in regime["level"].to_numpy())
        cells = ["/".join(map(digits, row)) for row in covered.to_numpy()]
        covariance.append(Column(f"{levels} % cover", cells))
    if "covariance_trusted" in regime:
        trusted = regime["covariance_trusted"].to_numpy()
        covariance.append(Column("", [
            ("trusted" if one else "not trusted") if number else "-"
            for one, number in zip(trusted, regime["nees_count"].to_numpy(), strict=True)
        ]))
    groups.append(Group("covariance", covariance))
    return [group for group in groups if group.columns]


def _cost_columns(regime: xr.Dataset) -> list[Column]:
    return [
        _with_interval(regime, "cost_ms", "ms a frame"),
        _with_interval(regime, "cost_ratio", "x baseline"),
    ]


def _finding_columns(regime: xr.Dataset) -> list[Column]:
    return _columns(regime, {"found %": "detection_rate", "flips %": "flip_rate"}, 100)


def _columns(regime: xr.Dataset, names: dict[str, str], scale: float = 1) -> list[Column]:
    """Return the columns, by heading, of those variables that are there."""
    return [
        Column(heading, [digits(scale * value) for value in regime[name].to_numpy()])
        for heading, name in names.items() if name in regime
    ]


def _with_interval(regime: xr.Dataset, name: str, heading: str) -> Column:
    """Return a column of values, each with the ends of its interval where they tell something."""
    values = zip(regime[name].to_numpy(), *interval(regime, name), strict=True)
    return Column(heading, [
        f"{digits(value)} ({digits(low)}..{digits(high)})"
        if np.isfinite(value) and not np.isnan([low, high]).any() else digits(value)
        for value, low, high in values
    ])


def _side_by_side(first: Group, groups: list[Group]) -> list[list[Group]]:
    """Return the groups of each table: as many as fit, each table beginning with ``first``."""
    tables = [[first]]
    for group in groups:
        width = sum(one.width + 2 * len(GAP) for one in tables[-1]) + group.width
        if width > WIDEST and len(tables[-1]) > 1:
            tables.append([first])
        tables[-1].append(group)
    return tables


def _lines(groups: list[Group]) -> list[str]:
    """Return a table's lines: headings of the groups, of the columns, and the treatments."""
    between = 2 * GAP
    headings = between.join(
        f"{group.heading} ".ljust(group.width, "-" if group.heading else " ") for group in groups
    )
    rows = [headings, *(
        between.join(
            GAP.join(_aligned(column, k, left=group is groups[0]) for column in group.columns)
            .ljust(group.width)
            for group in groups
        )
        for k in range(-1, len(groups[0].columns[0].cells))
    )]
    return [row.rstrip() for row in rows]


def _aligned(column: Column, k: int, *, left: bool) -> str:
    """Return cell ``k``, or the heading for -1, as wide as the column."""
    text = column.heading if k < 0 else column.cells[k]
    return text.ljust(column.width) if left else text.rjust(column.width)


def _row(cells: Sequence[str] | Iterator[str]) -> str:
    return "| " + " | ".join(cells) + " |"
