"""The answer of a report: whether requirements are met, how far, and with which configuration."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import xarray as xr

from sweep.errors import DatasetError, StoreError
from sweep.plan.experiment import shows_boards, target_word
from sweep.report.comparison import Comparison, comparison, target_axes
from sweep.report.error_model_file import error_model_tables
from sweep.report.figure import sentences, values_with_ends
from sweep.report.formatting import interval_text, number
from sweep.report.limit_figure import as_json as limits_as_json
from sweep.report.report_data import CONFIGURATION, ReportData, configurations
from sweep.report.required import Required, required
from sweep.report.scene_figures import (
    board_tables,
    errors_table,
    signed_errors_table,
    size_errors_table,
)
from sweep.report.table import Table


@dataclass(frozen=True, slots=True)
class Tile:
    """One number, with its name above and a detail below it.

    Attributes
    ----------
    heading, value, detail
        Text.
    numbers
        The value, the ends of its interval, its unit: for JSON.
    """

    heading: str
    value: str
    detail: str = ""
    numbers: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Answer:
    """What a reader wants first.

    Attributes
    ----------
    headline
        One line.
    paragraph
        Warnings, and what the numbers do not tell.
    of
        The configuration that is named, of the tiles; empty if there is only one.
    tiles
        Its numbers over the whole grid.
    tables
        By configuration, shown at once.
    details
        Tables that stand further below.
    numbers
        The numbers behind the line, for JSON.
    """

    headline: str
    paragraph: str
    of: str
    tiles: tuple[Tile, ...]
    tables: tuple[Table, ...]
    details: tuple[Table, ...]
    numbers: Mapping[str, Any] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """Return it as JSON values: numbers, and tables of text as a page shows them."""
        return {
            "answer": self.headline, "text": self.paragraph, "configuration": self.of or None,
            "numbers": [
                {"name": tile.heading, "text": tile.value, "detail": tile.detail, **tile.numbers}
                for tile in self.tiles
            ],
            **self.numbers,
            "tables": [table.as_json() for table in (*self.tables, *self.details)],
        }


def answer(data: ReportData) -> Answer:
    """Return the answer: to what is required, else the comparison of the configurations.

    Raises
    ------
    ArgumentError
        For requirements, and conditions, that cannot be.
    StoreError
        If the store lacks what the requirements are of.
    """
    known = configurations(data)
    try:
        decided = required(data) if data.require else None
    except DatasetError as error:
        raise StoreError(f"{data.store}: {error}") from None
    compared = comparison(data, None if decided is None else (decided.best,))
    best = decided.best if decided is not None else next(
        k for k, each in enumerate(known.settings.combinations)
        if each.items() <= compared.indices[compared.best].items())
    one = compared.summary.isel({CONFIGURATION: compared.best})
    tiles = (
        _share_tile("detected", one, "detection_rate"),
        _share_tile("solved", one, "solved_rate"),
        _error_tile("rotation error, median", one, "rotation_median_deg", "\u00b0"),
        _error_tile("rotation error, RMSE", one, "rotation_rmse_deg", "\u00b0"),
        _error_tile("range error, RMSE", one, "range_rmse_percent", " %"),
        _error_tile("range bias", one, "range_bias_percent", " %"),
        _share_tile("flips", one, "flip_rate", "solved"),
    )
    name = compared.names[compared.best] if compared.several else ""
    return Answer(
        _headline(data, decided, compared, one), _notes(data), name, tiles,
        (*(decided.tables if decided is not None else ()), compared.table()),
        (*(decided.details if decided is not None else ()), *size_errors_table(data, best),
         *board_tables(data), errors_table(one, name), signed_errors_table(data),
         *error_model_tables(data)),
        _numbers(decided, compared),
    )


def _headline(
    data: ReportData, decided: Required | None, compared: Comparison, one: xr.Dataset
) -> str:
    """Return the answer in one line."""
    if not int(compared.summary["looked_for"].sum()):
        return (f"The {target_word(data.pipeline)} was looked for in no pose: it was visible and "
                "modelled in none.")
    if decided is not None:
        return decided.line
    if compared.line:
        return f"{compared.line}."
    errors = "".join(
        f"; {tile.heading} {tile.value}{f' ({tile.detail})' if tile.detail else ''}"
        for tile in (_error_tile("rotation error, median", one, "rotation_median_deg", "\u00b0"),
                     _error_tile("range error, RMSE", one, "range_rmse_percent", " %"))
        if math.isfinite(float(one["solved_rate"])) and float(one["solved_rate"]))
    detected = _share_tile("detected", one, "detection_rate")
    return f"Detected in {detected.value} ({detected.detail}){errors}."


def _notes(data: ReportData) -> str:
    """Return warnings, and what the numbers do not tell, as sentences."""
    warnings = "".join(f"{line.strip()[:1].upper()}{line.strip()[1:]}. " for line in data.warnings)
    return warnings + sentences(
        "A board counts as detected if at least one of its markers is."
        if shows_boards(data.pipeline) else "",
        *configurations(data).notes,
        data.pooled(*(() if data.require else target_axes(data))))


def _numbers(decided: Required | None, compared: Comparison) -> dict[str, Any]:
    """Return the numbers behind the line as JSON values."""
    numbers: dict[str, Any] = {"comparison": compared.as_json()}
    if decided is not None:
        numbers |= {
            "decision": decided.decision, "requirements": list(decided.verdicts),
            "limits": None if decided.limits is None else limits_as_json(decided.limits)}
    return numbers


def _share_tile(
    heading: str, summary: xr.Dataset, name: str, counted: str = "looked_for"
) -> Tile:
    value, low, high = (float(end) for end in values_with_ends(summary, name, 100))
    interval = f"{interval_text(low, high, ' %')}, " if math.isfinite(low) else ""
    count = int(summary[counted])
    return Tile(heading, "\u2013" if math.isnan(value) else f"{number(value)} %",
                f"{interval}of {count:,} {counted.replace('_', ' ')}",
                {"value": value, "low": low, "high": high, "unit": "%", counted: count})


def _error_tile(heading: str, summary: xr.Dataset, name: str, unit: str) -> Tile:
    value, low, high = (float(end) for end in values_with_ends(summary, name))
    numbers = {"value": value, "low": low, "high": high, "unit": unit.strip()}
    if math.isinf(value):
        return Tile(heading, "\u221e", "more than half not solved", numbers)
    text = f"{number(value)}{unit}" if math.isfinite(value) else "\u2013"
    known = math.isfinite(low) and not math.isnan(high)
    return Tile(heading, text, interval_text(low, high, unit) if known else "",
                numbers)
