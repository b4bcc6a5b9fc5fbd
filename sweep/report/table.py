"""Tables of a report, as HTML and as Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
import xarray as xr

from sweep.report.report_data import label_of, labels_of
from sweep.tradeoff.pareto import digits, interval

MAX_ROWS = 300
"""Rows that a page shows of a table."""

ONE_LINE = 28
"""Characters of words that stand in one line."""


@dataclass(frozen=True, slots=True)
class Table:
    """A table: the first ``stub`` columns name a row, the others hold its numbers, or words."""

    caption: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    stub: int = 1
    words: bool = False

    def html(self) -> str:
        """Return it as HTML in a box that scrolls by itself."""
        head = "".join(
            f'<th scope="col"{self._side(k)}>{escape(text)}</th>'
            for k, text in enumerate(self.headings)
        )
        body = "\n".join(
            "<tr>" + "".join(
                f'<th scope="row">{escape(text)}</th>' if k < self.stub
                else f"<td{self._side(k)}>{escape(text)}</td>"
                for k, text in enumerate(row)
            ) + "</tr>"
            for row in self.rows[:MAX_ROWS]
        )
        return (
            f'<div class="scroll" role="region" tabindex="0" aria-label="{escape(self.caption)}">'
            f"<table><caption>{escape(self._caption())}</caption>\n"
            f"<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody></table></div>"
        )

    def markdown(self) -> str:
        """Return it as a Markdown table, its caption before it."""
        lines = [
            [_cell(text) for text in self.headings],
            ["---:" if self._side(k).endswith('"n"') else "---" for k in range(len(self.headings))],
            *([_cell(text) for text in row] for row in self.rows[:MAX_ROWS]),
        ]
        table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
        return f"{markdown_text(self._caption())}\n\n{table}"

    def _side(self, column: int) -> str:
        """Return the class of a column's cells: numbers, or words that take several lines."""
        if column < self.stub:
            return ""
        if not self.words:
            return ' class="n"'
        long = any(len(row[column]) > ONE_LINE for row in self.rows)
        return ' class="text"' if long else ""

    def _caption(self) -> str:
        if len(self.rows) <= MAX_ROWS:
            return self.caption
        return f"{self.caption} (the first {MAX_ROWS} of {len(self.rows):,} rows)"


def markdown_text(text: str) -> str:
    """Return text of any kind so that Markdown shows it as it is."""
    shown = escape(" ".join(text.split()), quote=False)
    return "".join(f"\\{c}" if c in "\\`*_[]#|$~" else c for c in shown)


def _cell(text: str) -> str:
    return markdown_text(text) or " "


def table_of(
    found: xr.Dataset, caption: str, dims: Sequence[str],
    columns: Mapping[str, tuple[str, float]], sources: xr.Dataset | None = None,
) -> Table:
    """Return a table with a row for each combination of ``dims``.

    ``columns`` are headings, each with a variable and what it is multiplied by. A variable that
    ``found`` lacks is left out. Where a variable has an interval its ends stand behind it.
    ``sources`` has the units of the dimensions, if ``found`` has not.
    """
    there = {
        heading: column for heading, column in columns.items() if column[0] in found
    }
    labels = [labels_of(found, dim) for dim in dims]
    texts = {
        heading: cells(found.transpose(*dims, ...), name, scale)
        for heading, (name, scale) in there.items()
    }
    rows = [
        [*(some[k] for some, k in zip(labels, index, strict=True)),
         *(column[position] for column in texts.values())]
        for position, index in enumerate(np.ndindex(*(len(some) for some in labels)))
    ]
    headings = [label_of(sources if sources is not None else found, dim) for dim in dims]
    return Table(caption, [*headings, *there], rows, stub=len(dims))


def cells(found: xr.Dataset, name: str, scale: float = 1.0) -> list[str]:
    """Return a variable's values as text, each with its interval where it has one."""
    values = found[name]
    if values.dtype.kind in "biu":
        if values.dtype.kind == "b":
            return ["yes" if value else "no" for value in np.ravel(values)]
        return [f"{value:,}" for value in np.ravel(values).tolist()]
    low, high = interval(found, name)
    texts = []
    for value, a, b in zip(np.ravel(values), np.ravel(low), np.ravel(high), strict=True):
        text = number(scale * value)
        if not (np.isnan(a) and np.isnan(b)):
            text += f" ({number(scale * a)} to {number(scale * b)})"
        texts.append(text)
    return texts


def number(value: float) -> str:
    """Return a number with three significant digits; a dash for NaN, a lying eight for infinity."""
    if np.isnan(value):
        return "\u2013"
    if np.isinf(value):
        return "\u221e" if value > 0 else "\u2212\u221e"
    return digits(value).replace("-", "\u2212") if value < 0 else digits(value)
