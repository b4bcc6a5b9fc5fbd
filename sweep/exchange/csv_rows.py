"""Rows of a CSV file, whatever program wrote it: separators, line ends, comments."""

from __future__ import annotations

import csv
import itertools
import re
from collections.abc import Iterator

SEPARATORS = ",;\t"


def csv_rows(
    text: str,
) -> tuple[int, list[str], Iterator[tuple[int, list[str]]], bool] | None:
    r"""Return the header's line and names, the rows with their lines, whether commas are points.

    None if there is no header. Empty lines, and those that begin with ``#``, are left out. The
    separator is the one that the header has most of.

    Examples
    --------
    >>> line, header, rows, commas = csv_rows("# mine\r\nimage;x0\r\na;1,5\r\n")
    >>> line, header, list(rows), commas
    (2, ['image', 'x0'], [(3, ['a', '1,5'])], True)
    """
    lines = text_lines(text)
    start = next(
        (k for k, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")),
        None,
    )
    if start is None:
        return None
    separator = max(SEPARATORS, key=lines[start].count)

    def rows() -> Iterator[tuple[int, list[str]]]:
        for number, line in zip(itertools.count(start + 1), lines[start:], strict=False):
            if line.strip() and not line.lstrip().startswith("#"):
                try:
                    yield number, next(csv.reader([line], delimiter=separator), [])
                except csv.Error:
                    yield number, [line]

    each = rows()
    header_line, header = next(each)
    return header_line, header, each, separator == ";"


def text_lines(text: str) -> list[str]:
    r"""Return the lines of a text, ended as Unix, Windows or an old Mac does.

    >>> text_lines("a\r\nb\rc\u2028d\n")
    ['a', 'b', 'c\u2028d', '']
    """
    return re.split(r"\r\n|\n|\r", text)
