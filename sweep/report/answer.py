"""The answer: whether what is required is met, and the numbers of the best configuration."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import xarray as xr

from sweep.analysis.registry import error_headings
from sweep.errors import DatasetError, StoreError
from sweep.plan.parameters import Stage
from sweep.report.ambiguity_sentence import threshold_sentence
from sweep.report.board_text import board_sentence, board_tables
from sweep.report.choice import belief_sentence, belief_table, choice_sentence, choice_table
from sweep.report.configurations import configurations
from sweep.report.environment_differences import environment_tables
from sweep.report.error_model_table import error_model_tables
from sweep.report.figure import sentences, values_with_ends
from sweep.report.formatting import interval_text, number, plural
from sweep.report.grouping import CONFIGURATION
from sweep.report.report_data import ReportData
from sweep.report.signed_errors_table import signed_errors_table
from sweep.report.size_errors_table import size_errors_table
from sweep.report.table import Table, cells
from sweep.report.tile import Tile
from sweep.report.tradeoff_figure import trade_criterion
from sweep.report.verdict import verdict
from sweep.tradeoff.advice import advice

MAX_ADVICE = 2
"""Conditions whose advice on cost stands in the answer; that of all is below the figure."""


@dataclass(frozen=True, slots=True)
class Answer:
    """What a reader wants first.

    Attributes
    ----------
    headline
        One sentence.
    paragraph
        What limits it, which configuration, and what went wrong.
    of
        The configuration of the tiles; empty if there is only one.
    tiles
        Its numbers over the whole grid.
    tables
        By configuration and by size, shown at once.
    details
        Tables that stand further below.
    """

    headline: str
    paragraph: str
    of: str
    tiles: tuple[Tile, ...]
    tables: tuple[Table, ...]
    details: tuple[Table, ...]

    def as_json(self) -> dict[str, Any]:
        """Return it as JSON values."""
        return {
            "answer": self.headline, "text": self.paragraph, "configuration": self.of or None,
            "numbers": [{"name": tile.heading, "value": tile.value, "detail": tile.detail}
                        for tile in self.tiles],
            "tables": [{"caption": table.caption, "headings": list(table.headings),
                        "rows": [list(row) for row in table.rows]}
                       for table in (*self.tables, *self.details)],
        }


def answer(data: ReportData) -> Answer:
    """Return the answer to what is required, or to how far and how well a pose is known.

    Raises
    ------
    ArgumentError
        For requirements, and conditions, that cannot be.
    StoreError
        If the store lacks what the requirements are of.
    """
    try:
        found = verdict(data)
    except DatasetError as error:
        raise StoreError(f"{data.store}: {error}") from None
    known = configurations(data)
    best = known.order[0] if found.best is None else found.best
    one = known.summary.isel({CONFIGURATION: best})
    tiles = (
        _share_tile("detected", one, "detection_rate"),
        _share_tile("solved", one, "solved_rate"),
        _error_tile("rotation error, median", one, "rotation_median_deg", "\u00b0"),
        _error_tile("rotation error, p95", one, "rotation_p95_deg", "\u00b0"),
        _error_tile("range error, p95", one, "range_p95_percent", " %"),
        _error_tile("range bias", one, "range_bias_percent", " %"),
    )
    warnings = "".join(f"{line.strip()[:1].upper()}{line.strip()[1:]}. " for line in data.warnings)
    return Answer(
        found.headline,
        warnings + sentences(found.reasons, choice_sentence(data),
                             belief_sentence(data, best),
                             threshold_sentence(data, best), _cost(data), _size(data),
                             board_sentence(data)),
        known.spoken(best) if known.several else "", tiles,
        (*found.tables, *belief_table(data, best), *size_errors_table(data, best),
         *choice_table(data), *environment_tables(data)),
        (*found.details, *board_tables(data),
         _errors_table(one, known.names[best] if known.several else ""),
         signed_errors_table(data), *error_model_tables(data)),
    )


def _cost(data: ReportData) -> str:
    """Return the advice of the tradeoff, if it was measured, for few conditions."""
    if data.trade is None:
        return ""
    lines = advice(data.trade, trade_criterion(data.trade))
    if len(lines) > MAX_ADVICE:
        return "What each configuration costs is in the figure of cost and accuracy."
    return " ".join(f"{line[0].upper()}{line[1:]}." for line in lines)


def _size(data: ReportData) -> str:
    """Return how many poses and configurations there are, as a sentence."""
    poses = data.pipeline.size(Stage.scene)
    count = data.pipeline.size(Stage.detection, Stage.estimation)
    known = configurations(data)
    if math.prod(map(len, known.settings.axes.values())) == count:
        count = len(known.names)  # without those that are the same
    each = f", each with {plural(count, 'configuration')}" if count > 1 else ""
    return f"{plural(poses, 'pose')}{each}."


def _share_tile(heading: str, summary: xr.Dataset, name: str) -> Tile:
    value, low, high = (float(end) for end in values_with_ends(summary, name, 100))
    interval = f"{interval_text(low, high, ' %')}, " if math.isfinite(low) else ""
    return Tile(heading, "\u2013" if math.isnan(value) else f"{number(value)} %",
                f"{interval}of {int(summary['looked_for']):,}")


def _error_tile(heading: str, summary: xr.Dataset, name: str, unit: str) -> Tile:
    value, low, high = (float(end) for end in values_with_ends(summary, name))
    if math.isinf(value):
        missed = "half" if "median" in name else "5 %"
        return Tile(heading, "\u221e", f"more than {missed} not solved")
    text = f"{number(value)}{unit}" if math.isfinite(value) else "\u2013"
    known = math.isfinite(low) and not math.isnan(high)
    return Tile(heading, text, interval_text(low, high, unit) if known else "")


QUANTITIES = {"rotation": ("rotation", "deg"), "range": ("range (depth)", "percent"),
              "position": ("position", "m")}
"""Quantity in the names of errors -> its name in words, and its unit in those names."""


def _errors_table(errors: xr.Dataset, name: str) -> Table:
    quantities = {
        f"{words}, {'%' if unit == 'percent' else unit}": f"{quantity}_{{}}_{unit}"
        for quantity, (words, unit) in QUANTITIES.items()
    }
    rows = [
        [heading, *(
            cells(errors, each.format(statistic))[0] if each.format(statistic) in errors else ""
            for each in quantities.values())]
        for heading, statistic in error_headings().items()
    ]
    whose = f", with {name}" if name else ""
    return Table(f"Errors over the whole grid{whose}, with 95 % intervals",
                 ["statistic", *quantities], rows)
