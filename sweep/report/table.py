"""Tables of a report: their cells as text, and as Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
import xarray as xr

from sweep.report.formatting import interval_text, number
from sweep.report.grouping import axis_label, group_labels
from sweep.tradeoff.pareto import interval

MAX_ROWS = 300
"""Rows of a table that a page shows."""

MAX_LINE_CHARS = 28
"""Characters of a cell that stand in one line."""


@dataclass(frozen=True, slots=True)
class Table:
    """A table of text.

    Attributes
    ----------
    caption
        What the table holds.
    headings, rows
        Text of the columns' headings and of the cells.
    stub
        Number of leading columns that name a row.
    words
        Whether the other columns hold words instead of numbers.
    """

    caption: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    stub: int = 1
    words: bool = False

    @property
    def shown_rows(self) -> Sequence[Sequence[str]]:
        """The rows that a page shows."""
        return self.rows[:MAX_ROWS]

    @property
    def full_caption(self) -> str:
        """The caption, with the number of rows if not all are shown."""
        if len(self.rows) <= MAX_ROWS:
            return self.caption
        return f"{self.caption} (the first {MAX_ROWS} of {len(self.rows):,} rows)"

    @property
    def column_classes(self) -> list[str]:
        """CSS class of each column: ``n`` numbers, ``text`` long words, empty for others."""
        return [self._column_class(k) for k in range(len(self.headings))]

    def _column_class(self, column: int) -> str:
        if column < self.stub:
            return ""
        if not self.words:
            return "n"
        long = any(len(row[column]) > MAX_LINE_CHARS for row in self.rows)
        return "text" if long else ""

    def markdown(self) -> str:
        """Return it as a Markdown table behind its caption."""
        lines = [
            [_markdown_cell(text) for text in self.headings],
            ["---:" if name == "n" else "---" for name in self.column_classes],
            *([_markdown_cell(text) for text in row] for row in self.shown_rows),
        ]
        table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
        return f"{markdown_text(self.full_caption)}\n\n{table}"


def markdown_text(text: str) -> str:
    """Return arbitrary text escaped for Markdown, on one line.

    >>> markdown_text("a < b")
    'a &lt; b'
    """
    escaped = escape(" ".join(text.split()), quote=False)
    return "".join(f"\\{c}" if c in "\\`*_[]#|$~" else c for c in escaped)


def _markdown_cell(text: str) -> str:
    return markdown_text(text) or " "


def table_of(
    summary: xr.Dataset, caption: str, dims: Sequence[str],
    columns: Mapping[str, tuple[str, float]], sources: xr.Dataset | None = None,
) -> Table:
    """Return a table with a row for each combination of ``dims``.

    Parameters
    ----------
    summary
        Results of an analysis, with the ends of intervals as ``NAME_low`` and ``NAME_high``.
    caption
        What the table holds.
    dims
        Dimensions of ``summary``, all of them.
    columns
        Heading -> variable and the factor that it is multiplied by; a variable that ``summary``
        lacks is left out.
    sources
        A dataset with the units of ``dims``, if ``summary`` has none.
    """
    present = {heading: column for heading, column in columns.items() if column[0] in summary}
    labels = [group_labels(summary, dim) for dim in dims]
    texts = [
        cells(summary.transpose(*dims, ...), name, scale) for name, scale in present.values()
    ]
    rows = [
        [*(names[k] for names, k in zip(labels, index, strict=True)),
         *(column[position] for column in texts)]
        for position, index in enumerate(np.ndindex(*(len(names) for names in labels)))
    ]
    headings = [axis_label(sources if sources is not None else summary, dim) for dim in dims]
    return Table(caption, [*headings, *present], rows, stub=len(dims))


def cells(summary: xr.Dataset, name: str, scale: float = 1.0) -> list[str]:
    """Return a variable's values as text, each with the ends of its interval if it has one."""
    values = summary[name]
    if values.dtype.kind == "b":
        return ["yes" if value else "no" for value in np.ravel(values)]
    if values.dtype.kind in "iu":
        return [f"{value:,}" for value in np.ravel(values).tolist()]
    low, high = interval(summary, name)
    texts = []
    for value, a, b in zip(np.ravel(values), np.ravel(low), np.ravel(high), strict=True):
        text = number(scale * value)
        if not (np.isnan(a) and np.isnan(b)):
            text += f" ({interval_text(scale * a, scale * b)})"
        texts.append(text)
    return texts
