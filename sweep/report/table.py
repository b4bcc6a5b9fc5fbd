"""Tables: data frames of texts with units and intervals, and findings, with their printers."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from sweep.messages import columns, plain, to_json
from sweep.report.formatting import interval_text, number
from sweep.report.report_data import axis_label, group_labels
from sweep.tradeoff.pareto import interval

MAX_ROWS = 300
"""Rows of a table that a page shows."""

MAX_WIDTH, GAP = 140, "  "
"""Characters of a line of plain text, and between columns."""

Columns = dict[str, tuple[str, float]]
"""Heading -> variable of an analysis, and the factor by which it is multiplied."""

MAX_LINE_CHARS = 28
"""Characters of a cell that stand in one line."""


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """A table of text, and its printers: plain text, Markdown, JSON; a template makes HTML.

    Attributes
    ----------
    caption
        Subject of the table.
    frame
        Texts of the cells; the columns' names are headings with units, values have their intervals
        behind them.
    stub
        Number of leading columns that name a row.
    words
        Whether the other columns hold words instead of numbers.
    """

    caption: str
    frame: pd.DataFrame
    stub: int = 1
    words: bool = False

    @classmethod
    def of(
        cls, caption: str, headings: Sequence[str], rows: Sequence[Sequence[str]], *,
        stub: int = 1, words: bool = False,
    ) -> Table:
        """Return a table of rows."""
        return cls(caption, pd.DataFrame(
            [list(row) for row in rows], columns=list(headings), dtype=object), stub, words)

    @property
    def headings(self) -> list[str]:
        """The columns' headings."""
        return list(map(str, self.frame.columns))

    @property
    def rows(self) -> list[list[str]]:
        """The texts of all rows."""
        rows: list[list[str]] = self.frame.to_numpy().tolist()
        return rows

    @property
    def shown_rows(self) -> list[list[str]]:
        """The rows that a page shows."""
        return self.rows[:MAX_ROWS]

    @property
    def full_caption(self) -> str:
        """The caption, with the number of rows if not all are shown."""
        if len(self.frame) <= MAX_ROWS:
            return self.caption
        return f"{self.caption} (the first {MAX_ROWS} of {len(self.frame):,} rows)"

    @property
    def column_classes(self) -> list[str]:
        """CSS class of each column: ``n`` numbers, ``text`` long words, empty for others."""
        return ["" if k < self.stub else "n" if not self.words else
                "text" if any(len(row[k]) > MAX_LINE_CHARS for row in self.rows) else ""
                for k in range(len(self.headings))]

    def text(self) -> str:
        """Return it in aligned columns below its caption, for a terminal.

        Empty columns are left out; those beyond a line of `MAX_WIDTH` characters stand below,
        again beside the columns that name a row.
        """
        lines = [[plain(cell, len(cell)) for cell in row]
                 for row in (self.headings, *self.shown_rows)]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        used = [k for k in range(len(widths)) if k < self.stub or any(row[k] for row in lines[1:])]
        stub = used[: self.stub]
        parts = [stub[:]]
        for k in used[self.stub :]:
            width = sum(widths[j] + len(GAP) for j in parts[-1]) + widths[k]
            if width > MAX_WIDTH and len(parts[-1]) > len(stub):
                parts.append(stub[:])
            parts[-1].append(k)
        left = [k for k in range(len(widths)) if k < self.stub or self.words]
        return "\n\n".join([plain(self.full_caption, len(self.full_caption)), *(
            columns([[row[k] for k in part] for row in lines], gap=GAP,
                    right=[j for j, k in enumerate(part) if k not in left]) for part in parts)])

    def markdown(self) -> str:
        """Return it as a Markdown table behind its caption."""
        lines = [
            [_markdown_cell(text) for text in self.headings],
            ["---:" if name == "n" else "---" for name in self.column_classes],
            *([_markdown_cell(text) for text in row] for row in self.shown_rows),
        ]
        table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
        return f"{markdown_text(self.full_caption)}\n\n{table}"

    def html(self) -> str:
        """Return it as an HTML table."""
        table: str = self.frame.to_html(index=False, border=0, max_rows=MAX_ROWS)
        return f"<p>{escape(self.full_caption)}</p>{table}"

    def as_json(self) -> dict[str, Any]:
        """Return caption, headings and rows, with the minus sign of ASCII."""
        return {"caption": self.caption, "headings": self.headings,
                "rows": [[cell.replace("\u2212", "-") for cell in row] for row in self.rows]}


UNDECIDED = 3
"""Exit status where draws are too few to tell."""


@dataclass(frozen=True, slots=True, eq=False)
class Findings:
    """The answer to a question, which prints itself as text, Markdown, HTML or JSON.

    Attributes
    ----------
    parts
        Lines and tables, in order; empty tables are not printed.
    numbers
        The same as JSON values.
    data
        The dataset behind them, or None.
    status
        Exit status of the command.
    then
        The command to go on with, and what it does.
    """

    parts: Sequence[Table | str]
    numbers: Mapping[str, Any]
    data: xr.Dataset | None = None
    status: int = 0
    then: tuple[str, str] = ("", "")

    def __str__(self) -> str:
        return self._printed(Table.text, str)

    def markdown(self) -> str:
        """Return it as Markdown."""
        return self._printed(Table.markdown, markdown_text)

    def _repr_html_(self) -> str:
        return self._printed(Table.html, lambda line: f"<p>{escape(line)}</p>")

    def _printed(self, table: Callable[[Table], str], line: Callable[[str], str]) -> str:
        texts = [line(part) if isinstance(part, str) else f"{table(part)}\n"
                 for part in self.parts if isinstance(part, str) or len(part.frame)]
        return "\n".join(texts).rstrip("\n")

    def to_json(self) -> str:
        """Return its numbers as the text of a JSON object."""
        return to_json(self.numbers)


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
    wanted: Columns, sources: xr.Dataset | None = None,
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
    wanted
        Heading -> variable and the factor that it is multiplied by; a variable that ``summary``
        lacks is left out.
    sources
        A dataset with the units of ``dims``, if ``summary`` has none.
    """
    labels = [group_labels(summary, dim) for dim in dims]
    names = list(itertools.product(*labels))
    texts = column_texts(summary.transpose(*dims, ...), wanted)
    headings = [axis_label(sources if sources is not None else summary, dim) for dim in dims]
    rows = [[*name, *values] for name, *values in zip(names, *texts.values(), strict=True)]
    return Table.of(caption, [*headings, *texts], rows, stub=len(dims))


def each_cell(
    dataset: xr.Dataset, dims: Sequence[str]
) -> Iterator[tuple[dict[str, Any], xr.Dataset]]:
    """Yield the coordinates along some dimensions, and the part of a dataset, of each cell."""
    for index in np.ndindex(*(dataset.sizes[dim] for dim in dims)):
        cell = dataset.isel(dict(zip(dims, index, strict=True)))
        yield {dim: cell[dim].item() for dim in dims}, cell


def column_texts(summary: xr.Dataset, wanted: Columns) -> dict[str, list[str]]:
    """Return the cells of columns by heading, without variables that ``summary`` lacks."""
    return {heading: cells(summary, name, scale)
            for heading, (name, scale) in wanted.items() if name in summary}


def cells(summary: xr.Dataset, name: str, scale: float = 1.0) -> list[str]:
    """Return a variable's values as text, each with the ends of its interval if it has one."""
    values = summary[name]
    if values.dtype.kind == "b":
        return ["yes" if value else "no" for value in np.ravel(values)]
    if values.dtype.kind in "OU":
        return [str(value) for value in np.ravel(values)]
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
