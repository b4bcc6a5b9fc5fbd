"""Tables: data frames of values with units and intervals, and findings, with their printers."""

from __future__ import annotations

import base64
import dataclasses
import enum
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import xarray as xr

from sweep.messages import plain

#: Rows of a table that a page shows.
MAX_ROWS = 300

#: Characters of a line of plain text, and between columns.
MAX_WIDTH, GAP = 140, "  "

#: Characters of a cell that stand in one line.
MAX_LINE_CHARS = 28

#: Characters of a number that needs no rounding to be short.
MAX_SHORT = 5

#: Relative width of an interval below which its numbers have more than three digits, and how many
#: they have at most.
TIGHT, MAX_DIGITS = 0.01, 6

# --------------------------------------------------------------------------------------------------
# Numbers, coordinates and units as text.


def number(value: float, digits: int = 3) -> str:
    """Return a number with three significant digits and typographic signs; a dash for NaN.

    >>> number(0.31), number(-1234.0), number(float("inf")), number(float("nan"))
    ('0.310', '\u22121230', '\u221e', '\u2013')
    """
    if math.isnan(value):
        return "\u2013"
    rounded = float(f"{value:.{digits - 1}e}")
    whole = rounded == 0 or 10.0**digits <= abs(rounded) < 1e6
    text = f"{rounded:.0f}" if whole else f"{rounded:#.{digits}g}".rstrip(".")
    return text.replace("inf", "\u221e").replace("-", "\u2212")


def interval_text(low: float, high: float, unit: str = "", digits: int = 3) -> str:
    """Return the ends of an interval, with so many significant digits: ``0.5 to 1.5``.

    >>> interval_text(1.0, float("inf"), "\u00b0")
    '1.00 to \u221e\u00b0'
    """
    return f"{number(low, digits)} to {number(high, digits)}{unit}"


def coordinate(value: Any) -> str:
    """Return a coordinate as text: of a number at most six significant digits.

    >>> coordinate(0.30000000000000004), coordinate("exact")
    ('0.3', 'exact')
    """
    return f"{value:.6g}".replace("inf", "\u221e") if isinstance(value, float) else str(value)


def coordinates(values: Sequence[Any]) -> list[str]:
    """Return coordinates as text: long numbers with as few digits as keep them distinct.

    >>> coordinates([0.15, 0.208424, 1.5]), coordinates([12.25, 12.5])
    (['0.15', '0.208', '1.5'], ['12.25', '12.5'])
    """
    texts = [coordinate(value) for value in values]
    short = max(map(len, texts), default=0) <= MAX_SHORT
    if short or not all(isinstance(value, float) for value in values):
        return texts
    rounded = ([f"{value:.{figures}g}" for value in values] for figures in range(3, 6))
    return next((each for each in rounded if len(set(each)) == len(set(texts))), texts)


def plural(count: int, noun: str, plural_noun: str = "") -> str:
    """Return a count with its noun.

    >>> plural(1, "pose"), plural(2000, "pose"), plural(2, "axis", "axes")
    ('1 pose', '2,000 poses', '2 axes')
    """
    return f"{count:,} {noun if count == 1 else plural_noun or f'{noun}s'}"


#: Coordinates whose names are no words.
WORDS = {"marker_area_px": "area of the marker", "side_px": "side of the marker"}

ENDINGS = ("_deg", "_m", "_px", "_s", "_mm", "_e", "_m_s")
#: Unit of an attribute -> as headings have it.
UNITS = {"px2": "px\u00b2", "degree": "deg", "percent": "%", "1": ""}


def axis_label(results: xr.Dataset, name: str) -> str:
    """Return the name of a coordinate or variable in words, with its unit: ``distance, m``."""
    units = str(results[name].attrs.get("units", "")) if name in results.variables else ""
    words = WORDS.get(name, name)
    if units and words == name:
        words = next((name.removesuffix(end) for end in ENDINGS if name.endswith(end)), name)
    unit = UNITS.get(units, units)
    return f"{words.replace('_', ' ')}, {unit}" if unit else words.replace("_", " ")


def draws_text(draws: int, needed: float) -> str:
    """Return the draws of what is not decided, and about how many would decide it.

    >>> draws_text(60, 4300.0)
    '60 draws, about 4,300 would decide'
    """
    if math.isinf(needed):
        return f"{draws:,} draws, no number would decide so small a difference"
    return f"{draws:,} draws, about {needed:,.0f} would decide"


# --------------------------------------------------------------------------------------------------
# The cells of tables that are more than a word or a number.


class Value(NamedTuple):
    """A number with the ends of its interval, NaN without one."""

    value: float
    low: float = math.nan
    high: float = math.nan

    def __str__(self) -> str:
        if math.isnan(self.low) and math.isnan(self.high):
            return number(self.value)
        # As many digits as tell its ends apart: 0.9992 (0.9988 to 0.9996).
        width, digits = (self.high - self.low) / abs(self.value or math.nan), 3
        if 0.0 < width < TIGHT:
            digits = min(1 - math.floor(math.log10(width)), MAX_DIGITS)
        return f"{number(self.value, digits)} ({interval_text(self.low, self.high, '', digits)})"


class Bin(NamedTuple):
    """The ends of a bin of an axis."""

    low: float
    high: float

    def __str__(self) -> str:
        return "\u2013".join(f"{end:.3g}" if abs(end) < 1000 else f"{end:.0f}" for end in self)

    @property
    def middle(self) -> float:
        """The geometric mean of the ends if both are positive, else the arithmetic one."""
        return math.sqrt(self.low * self.high) if self.low > 0 else (self.low + self.high) / 2


class Column(NamedTuple):
    """A variable of an analysis, as a column of tables and on the axis of figures.

    Attributes
    ----------
    heading
        Words, with the unit behind a comma.
    variable
        Its name; the ends of its interval are ``NAME_low`` and ``NAME_high``.
    scale
        Factor by which it is multiplied; 100 for shares, which are drawn from 0 to 100 %.
    level
        Where a figure has a dashed line, such as at 0 for a bias; None for none.
    """

    heading: str
    variable: str
    scale: float = 1.0
    level: float | None = None

    def cells(self, summary: xr.Dataset | pd.DataFrame) -> list[Any]:
        """Return the cells of all values of a dataset or a frame, in its order."""
        values = np.ravel(summary[self.variable]).tolist()
        if summary[self.variable].dtype.kind != "f":
            return values
        ends = (np.ravel(summary[name]).tolist() if name in summary else [math.nan] * len(values)
                for name in (f"{self.variable}_low", f"{self.variable}_high"))
        return [Value(*(self.scale * end for end in each))
                for each in zip(values, *ends, strict=True)]


#: Last word of a variable's name -> unit of its column, and factor to the unit.
COLUMN_UNITS = {"rate": ("%", 100.0), "percent": ("%", 1.0), "deg": ("deg", 1.0), "m": ("mm", 1e3)}
#: Word of a variable's name -> in a heading.
HEADING_WORDS = {"detection": "detected", "flip": "flips", "rmse": "RMSE", "sd": "SD",
                 "unflipped": "without flips"}
#: Word of a variable's name -> where its figure has a dashed line.
LEVELS = {"bias": 0.0, "efficiency": 1.0}


def column(variable: str) -> Column:
    """Return the column of a variable of an analysis, whose name tells its words and its unit.

    >>> column("position_rmse_unflipped_m")[:3]
    ('position RMSE without flips, mm', 'position_rmse_unflipped_m', 1000.0)
    """
    *words, last = variable.split("_")
    unit, scale = COLUMN_UNITS.get(last, ("", 1.0))
    words += [] if unit else [last]
    heading = " ".join(HEADING_WORDS.get(word, word) for word in words)
    level = next((LEVELS[word] for word in words if word in LEVELS), None)
    return Column(f"{heading}, {unit}" if unit else heading, variable, scale, level)


def cell_text(cell: Any) -> str:
    """Return a cell of a table as text.

    >>> cell_text(1200), cell_text(True), cell_text(Value(0.5, 0.25, math.inf)), cell_text(None)
    ('1,200', 'yes', '0.500 (0.250 to \u221e)', '')
    """
    if cell is None:
        return ""
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    if isinstance(cell, int):
        return f"{cell:,}"
    return number(cell) if isinstance(cell, float) else str(cell)


def group_cells(table: xr.Dataset | pd.DataFrame, name: str) -> list[Any]:
    """Return the groups along a dimension, or in a column: words, numbers, or bins."""
    if f"{name}_low" in table:
        return list(map(Bin, *(table[f"{name}_{end}"].to_numpy().tolist() for end in (
            "low", "high"))))
    values: list[Any] = table[name].to_numpy().tolist()
    return [str(value) if isinstance(value, bool) else value for value in values]


# --------------------------------------------------------------------------------------------------
# The table, and what an answer consists of.


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """A table, and its printers: plain text, Markdown, JSON; a template makes HTML.

    Attributes
    ----------
    caption
        Subject of the table.
    frame
        Cells: words, numbers, `Value`, `Bin`, or None; the columns' names are headings with units.
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
        cls, caption: str, headings: Sequence[str], rows: Sequence[Sequence[Any]], *,
        stub: int = 1, words: bool = False,
    ) -> Table:
        """Return a table of rows."""
        frame = pd.DataFrame(list(map(list, rows)), columns=list(headings), dtype=object)
        return cls(caption, frame, stub, words)

    @property
    def headings(self) -> list[str]:
        """The columns' headings."""
        return list(map(str, self.frame.columns))

    @property
    def rows(self) -> list[list[str]]:
        """The texts of all rows."""
        texts = self.frame.map(cell_text)
        for k in range(self.stub):
            texts.isetitem(k, coordinates(self.frame.iloc[:, k].tolist()))
        rows: list[list[str]] = texts.to_numpy().tolist()
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
        rows = self.shown_rows
        return ["" if k < self.stub else "n" if not self.words else
                "text" if any(len(row[k]) > MAX_LINE_CHARS for row in rows) else ""
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
        aligned = [
            [cell.ljust(width) if k < self.stub or self.words else cell.rjust(width)
             for k, (cell, width) in enumerate(zip(row, widths, strict=True))] for row in lines]
        return "\n\n".join([plain(self.full_caption, len(self.full_caption)), *(
            "\n".join(GAP.join(row[k] for k in part).rstrip() for row in aligned)
            for part in parts)])

    def markdown(self) -> str:
        """Return it as a Markdown table behind its caption."""
        lines = [
            [markdown_text(text) or " " for text in self.headings],
            ["---:" if name == "n" else "---" for name in self.column_classes],
            *([markdown_text(text) or " " for text in row] for row in self.shown_rows),
        ]
        table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
        return f"{markdown_text(self.full_caption)}\n\n{table}"

    def as_json(self) -> dict[str, Any]:
        """Return its caption, and its rows by heading as numbers."""
        cells = self.frame.map(
            lambda cell: cell._asdict() if isinstance(cell, Value | Bin) else cell)
        return {"caption": self.caption, "rows": cells.to_dict("records")}


#: Exit status where draws are too few to tell.
UNDECIDED = 3


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
        parts = template("parts.html").module
        return self._printed(parts.table, lambda line: f"<p>{escape(line)}</p>")

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


def table_of(
    summary: xr.Dataset, caption: str, dims: Sequence[str], wanted: Sequence[Column],
    sources: xr.Dataset | None = None, *, counted: str = "",
) -> Table:
    """Return a table with a row for each combination of ``dims``.

    Parameters
    ----------
    summary
        Results of an analysis, with the ends of intervals as ``NAME_low`` and ``NAME_high``.
    caption
        The rows and columns.
    dims
        Dimensions of the columns' variables, all of them; those that lack some are repeated.
    wanted
        The columns; one whose variable ``summary`` lacks is left out.
    sources
        A dataset with the units of ``dims``, if ``summary`` has none.
    counted
        Variable of ``summary`` without which, where it is 0, there is no row.
    """
    wanted = [each for each in wanted if each.variable in summary]
    names = dict.fromkeys(name for each in (*(each.variable for each in wanted), counted)
                          for end in ("", "_low", "_high") if (name := f"{each}{end}") in summary)
    # Without dimensions there is one row.
    frame = summary[[*names]].expand_dims("row").to_dataframe(["row", *dims]).reset_index()
    if counted in frame and dims:
        frame = frame[frame[counted] > 0]
    units = sources if sources is not None else summary
    cells = {axis_label(units, dim): group_cells(frame, dim) for dim in dims}
    cells |= {each.heading: each.cells(frame) for each in wanted}
    return Table(caption, pd.DataFrame(cells, dtype=object), len(dims))


# --------------------------------------------------------------------------------------------------
# JSON: what every command prints with ``--json``, and files of error models.

def to_json(content: Mapping[str, Any], indent: int | None = 2) -> str:
    r"""Return the text of a JSON object: what every command prints with ``--json``.

    Dataclasses, enumerations (by name), paths, NumPy's arrays and numbers count as what JSON has.
    A number that does not exist (NaN) is ``null``. So is an infinite one, and a key NAME_flag
    beside its NAME says ``"infinite"`` or ``"-infinite"``; beside a list, NAME_flag is a list of
    that shape with ``null`` for its other items.

    >>> to_json({"low": 0.5, "high": math.inf, "median": math.nan}, None)
    '{"low": 0.5, "high": null, "high_flag": "infinite", "median": null}'
    >>> to_json({"errors": [1.0, -math.inf]}, None)
    '{"errors": [1.0, null], "errors_flag": [null, "-infinite"]}'
    """
    return json.dumps(_json_value(content)[0], indent=indent, allow_nan=False)


def _json_value(value: Any) -> tuple[Any, Any]:
    """Return a value as JSON has it, and its flag: None if no number in it is infinite."""
    if isinstance(value, enum.Enum):
        return value.name, None
    if dataclasses.is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    elif hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, Mapping):
        found = {}
        for name, item in value.items():
            key = str(getattr(name, "name", name))
            found[key], flag = _json_value(item)
            if flag is not None:
                found[f"{key}_flag"] = flag
        return found, None
    if isinstance(value, (list, tuple, set, frozenset)):
        pairs = [_json_value(item) for item in value]
        flags = [flag for _, flag in pairs]
        return [item for item, _ in pairs], flags if any(flags) else None
    if isinstance(value, float) and not math.isfinite(value):
        return None, None if math.isnan(value) else "infinite" if value > 0 else "-infinite"
    return value if isinstance(value, (str, bool, int, float, type(None))) else str(value), None


# --------------------------------------------------------------------------------------------------
# The templates of pages, their parts, and captions.


def base64_text(content: bytes | str) -> str:
    """Return bytes, or a text in UTF-8, in base64."""
    return base64.b64encode(content.encode() if isinstance(content, str) else content).decode()


@cache
def template(name: str) -> Any:
    """Return a template: of pages, of their tables, figures and scenes, or of captions."""
    import jinja2  # noqa: PLC0415  (slow to import)

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("sweep.report"), undefined=jinja2.StrictUndefined,
        autoescape=jinja2.select_autoescape(["html"]), trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"base64": base64_text, "md": markdown_text}
    return environment.get_template(name)


def caption_of(name: str, **values: object) -> str:
    """Return the text of a figure, on one line; pages escape it."""
    return " ".join(str(getattr(template("captions.jinja").module, name)(**values)).split())


def sentences(*parts: str) -> str:
    """Return the parts that are not empty, joined by spaces."""
    return " ".join(part for part in parts if part)
