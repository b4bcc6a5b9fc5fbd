"""Tables of cost and accuracy of every configuration: plain text, Markdown and JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from sweep.tradeoff.labels import digits, heading_of, unit_of
from sweep.tradeoff.pareto import UNITS, by_condition, interval, mark_front

MAX_WIDTH = 140
"""Characters of a line; groups of columns that do not fit side by side are put below each other."""

GAP = "  "

STATISTICS = {
    "bias": "bias", "RMSE": "rmse", "unflipped": "rmse_unflipped", "median": "median",
    "p95": "p95", "p99": "p99",
}
"""Heading -> statistic in the names of the variables of rotation and range."""

WINDOWS = {
    "auto": "searched: the marker's surroundings",
    "full": "searched: the whole frame",
    "mixed": "searched: the whole frame or the marker's surroundings, as each setting needs",
}


class Column(NamedTuple):
    """A heading and a cell for each configuration."""

    heading: str
    cells: list[str]

    @property
    def width(self) -> int:
        """Characters of the widest cell."""
        return max(map(len, (self.heading, *self.cells)))


class Group(NamedTuple):
    """Columns under one heading."""

    heading: str
    columns: list[Column]

    @property
    def width(self) -> int:
        """Characters of the columns with the gaps between them, at least those of the heading."""
        columns = sum(column.width for column in self.columns) + len(GAP) * (len(self.columns) - 1)
        return max(columns, len(self.heading))


def table_text(trade: xr.Dataset, criterion: str) -> str:
    """Return plain tables for each condition, the cheapest configuration first.

    Times are in ms a frame, rotations in degrees, ranges in percent. Configurations on the front
    of cost and criterion have a star; costs and the criterion have their 95 % intervals. Columns
    whose variables ``trade`` lacks are left out. Lines have at most :data:`MAX_WIDTH` characters
    unless a label has more than about 60.

    Raises
    ------
    KeyError
        If ``trade`` lacks ``cost_ms``, ``cost_ratio`` or the criterion.
    """
    lines = _headlines(trade)
    for label, condition in _sorted_conditions(trade, criterion):
        stars = np.where(condition["on_front"], "* ", "  ")
        names = condition["treatment"].to_numpy()
        first = Group("", [Column(
            "  configuration", [f"{star}{name}" for star, name in zip(stars, names, strict=True)]
        )])
        lines += ["", label] if label else []
        for groups in _side_by_side(first, _groups(condition, criterion)):
            lines += ["", *_lines(groups)]
    return "\n".join([*lines, "", _legend(criterion)])


def table_markdown(trade: xr.Dataset, criterion: str) -> str:
    """Return a Markdown table for each condition: cheapest configuration first, front in bold.

    Costs with their intervals, the rates, the criterion with its interval and, for the other
    quantity, the same statistic.

    Raises
    ------
    KeyError
        As :func:`table_text`.
    """
    quantity, statistic = unit_of(criterion)[0].split("_", 1)
    other = next(name for name in UNITS if name != quantity)
    beside = f"{other}_{statistic}_{UNITS[other]}"
    lines = []
    for label, condition in _sorted_conditions(trade, criterion):
        names = [
            f"**{name}**" if on_front else f"{name}"
            for name, on_front in zip(
                condition["treatment"].to_numpy(), condition["on_front"].to_numpy(), strict=True
            )
        ]
        columns = [
            Column("configuration", names), *_cost_columns(condition), *_rate_columns(condition),
            _with_interval(condition, criterion, heading_of(criterion)),
            *_columns(condition, {heading_of(beside): beside}),
        ]
        lines += [f"**{label}**", ""] if label else []
        lines += [
            _row(column.heading for column in columns),
            "| --- |" + " ---: |" * (len(columns) - 1),
            *(_row(cells) for cells in zip(*(column.cells for column in columns), strict=True)),
            "",
        ]
    legend = f"bold: no other configuration is both cheaper and better in {criterion}."
    return "\n".join([*lines, "; ".join([*_headlines(trade)[1:], legend])])


def as_json(trade: xr.Dataset) -> dict[str, Any]:
    """Return all of ``trade`` as JSON values: ``attrs``, ``coords`` and ``data_vars`` by name.

    Each variable has ``dims`` and ``data``, nested lists in the shape of its dimensions. Infinity
    is the string ``infinite`` or ``-infinite``, NaN is null.
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
    """Return the title and the facts of the measurement."""
    attrs = trade.attrs
    facts = {
        "poses": f"{attrs.get('poses')} poses",
        "window": WINDOWS.get(str(attrs.get("window")), f"searched: {attrs.get('window')}"),
        "baseline": f"baseline: {attrs.get('baseline')}",
    }
    return [
        str(attrs.get("title", "")),
        "ms a frame: detection and estimation",
        *(text for name, text in facts.items() if name in attrs),
    ]


def _legend(criterion: str) -> str:
    return (
        f"* no other configuration is both cheaper and better in {criterion}\n"
        "low..high: 95 % intervals; RMSE and bias: of the solved poses; "
        "median, p95, p99: a pose that is not solved counts as an infinite error"
    )


def _sorted_conditions(trade: xr.Dataset, criterion: str) -> Iterator[tuple[str, xr.Dataset]]:
    """Yield the conditions with ``on_front``, each with its cheapest configuration first."""
    for label, condition in by_condition(mark_front(trade, criterion), criterion):
        order = np.argsort(condition["cost_ms"].to_numpy(), kind="stable")
        yield label, condition.isel(treatment=order)


def _groups(condition: xr.Dataset, criterion: str) -> list[Group]:
    decision = [
        *_cost_columns(condition), *_rate_columns(condition),
        _with_interval(condition, criterion, heading_of(criterion)),
    ]
    groups = [Group("cost and criterion", decision)]
    for quantity, unit in UNITS.items():
        names = {
            heading: f"{quantity}_{statistic}_{unit}"
            for heading, statistic in STATISTICS.items()
        }
        columns = _columns(condition, names | {"efficiency": f"{quantity}_efficiency"})
        groups.append(Group(heading_of(f"{quantity}_{unit}"), columns))
    covariance = _columns(condition, {"NEES": "nees_mean"})
    if "covariance_coverage" in condition:
        covered = 100 * condition["covariance_coverage"].transpose("treatment", "level")
        levels = "/".join(f"{100 * level:g}" for level in condition["level"].to_numpy())
        cells = ["/".join(map(digits, row)) for row in covered.to_numpy()]
        covariance.append(Column(f"{levels} % cover", cells))
    if "covariance_trusted" in condition:
        trusted = condition["covariance_trusted"].to_numpy()
        covariance.append(Column("", [
            ("trusted" if calibrated else "not trusted") if count else "-"
            for calibrated, count in zip(trusted, condition["nees_count"].to_numpy(), strict=True)
        ]))
    groups.append(Group("covariance", covariance))
    return [group for group in groups if group.columns]


def _cost_columns(condition: xr.Dataset) -> list[Column]:
    return [
        _with_interval(condition, "cost_ms", "ms a frame"),
        _with_interval(condition, "cost_ratio", "x baseline"),
    ]


def _rate_columns(condition: xr.Dataset) -> list[Column]:
    return _columns(condition, {"detected %": "detection_rate", "flips %": "flip_rate"}, 100)


def _columns(condition: xr.Dataset, names: dict[str, str], scale: float = 1) -> list[Column]:
    """Return the columns, by heading, of the variables that exist."""
    return [
        Column(heading, [digits(scale * value) for value in condition[name].to_numpy()])
        for heading, name in names.items() if name in condition
    ]


def _with_interval(condition: xr.Dataset, name: str, heading: str) -> Column:
    """Return a column of values, each with the ends of its interval if both are known."""
    values = zip(condition[name].to_numpy(), *interval(condition, name), strict=True)
    return Column(heading, [
        f"{digits(value)} ({digits(low)}..{digits(high)})"
        if np.isfinite(value) and not np.isnan([low, high]).any() else digits(value)
        for value, low, high in values
    ])


def _side_by_side(first: Group, groups: list[Group]) -> list[list[Group]]:
    """Return the groups of each table: ``first``, then as many as fit into a line."""
    tables = [[first]]
    for group in groups:
        width = sum(held.width + 2 * len(GAP) for held in tables[-1]) + group.width
        if width > MAX_WIDTH and len(tables[-1]) > 1:
            tables.append([first])
        tables[-1].append(group)
    return tables


def _lines(groups: list[Group]) -> list[str]:
    """Return a table's lines: headings of groups and columns, then a line a configuration."""
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
