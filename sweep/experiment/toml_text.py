"""TOML read within bounds (any text gives a document or a reason, and soon), and written."""

from __future__ import annotations

import datetime as dt
import os
import re
import tomllib
from collections.abc import Mapping
from typing import Any

import numpy as np
import tomlkit
import tomlkit.items

from sweep.messages import plain

MAX_BYTES = 250_000
"""The largest text that is read."""

MAX_PARTS = 8
"""The most parts of a dotted key: reading it takes time that grows with their square."""

_PART = r"""(?:[A-Za-z0-9_-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(
    rf"(?<![A-Za-z0-9_\\-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{MAX_PARTS}}}"
)
_BARE = re.compile(
    r"(?=.*[A-Za-z])[A-Za-z0-9][A-Za-z0-9_.+-]*(/[A-Za-z0-9_.+-]+)*(:[A-Za-z_][A-Za-z0-9_]*)?"
)


def read_document(text: str) -> dict[str, Any]:
    """Return a TOML document.

    Raises
    ------
    ValueError
        What was expected, or why it is no TOML.
    """
    try:
        size = len(text.encode())
    except UnicodeEncodeError as error:
        raise ValueError(f"expected UTF-8: character {error.start} is not") from None
    if size > MAX_BYTES:
        raise ValueError(f"expected at most {MAX_BYTES:,} bytes")
    if _LONG_KEY.search(text):
        raise ValueError(f"not TOML: expected keys of at most {MAX_PARTS} parts")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"not TOML: {plain(error, 300)}") from None
    except RecursionError:
        raise ValueError("not TOML: nested too deeply") from None
    except ValueError:
        # Python reads no more than 4300 digits.
        raise ValueError("not TOML: a number of too many digits") from None


def read_value(written: str) -> Any:
    """Return a TOML value; ValueError if the text is not exactly one.

    >>> read_value("[0, 4.5]")
    [0, 4.5]
    """
    document = read_document(f"value = {written}")
    value = document.pop("value")
    if document:
        raise ValueError("expected one value")
    return value


def python_boolean(written: str) -> str:
    """Return ``True`` and ``False`` as TOML writes them; anything else as it is."""
    return written.lower() if written in ("True", "False") else written


def quoted_if_bare(written: str) -> str:
    """Return a bare word, such as a solver's name, as a TOML string; anything else as it is.

    >>> quoted_if_bare("ippe"), quoted_if_bare("36h11"), quoted_if_bare("1e3")
    ('"ippe"', '"36h11"', '1e3')
    """
    if not _BARE.fullmatch(written):
        return written
    try:
        read_value(written)
    except ValueError:
        return f'"{written}"'
    return written


def document_text(mapping: Mapping[str, Any]) -> str:
    r"""Return the TOML text of a document: keys, then a table for each mapping.

    Values are what TOML has; tuples and NumPy's arrays count as lists, NumPy's numbers as
    numbers, paths as strings, and a ``range`` as the axis ``{ range = [start, stop, step] }``.

    Raises
    ------
    ValueError
        One line for each key that TOML cannot hold, or whose value it cannot.

    Examples
    --------
    >>> document_text({"seed": 1, "axes": {"trial": 3, "marker_id": range(5)}})
    'seed = 1\n\n[axes]\ntrial = 3\nmarker_id = {range = [0, 5, 1]}\n'
    """
    faults: list[str] = []
    document = tomlkit.document()
    tables: dict[str, tomlkit.items.Table] = {}
    for key, value in mapping.items():
        if isinstance(value, Mapping):
            table = tables[str(key)] = tomlkit.table()
            for name, item in value.items():
                _add(table, f"{key}.", name, item, faults)
        else:
            _add(document, "", key, value, faults)
    document.update(tables)
    if faults:
        raise ValueError("\n".join(faults))
    return tomlkit.dumps(document)


def _add(
    table: tomlkit.TOMLDocument | tomlkit.items.Table, home: str, key: Any, value: Any,
    faults: list[str],
) -> None:
    """Add a key to a table; add a fault if TOML has no such key or value."""
    path = plain(f"{home}{key}")
    if not isinstance(key, str):
        faults.append(f"{path}: expected a string as key")
        return
    try:
        table[key] = toml_item(value)
    except TypeError:
        faults.append(f"{path} = {plain(repr(value))}: expected a string, a number, true, false, "
                      "a list or a table")
    except ValueError:
        faults.append(f"{path}: expected a number of fewer digits")
    except RecursionError:
        faults.append(f"{path}: nested too deeply")


def toml_item(value: Any) -> tomlkit.items.Item:
    """Return a value as tomlkit's, tables in one line; TypeError if TOML has no such value."""
    if isinstance(value, (np.generic, np.ndarray)):
        value = value.tolist()
    if isinstance(value, os.PathLike):
        value = os.fspath(value)
    if isinstance(value, range):
        value = {"range": [value.start, value.stop, value.step]}
    if isinstance(value, Mapping):
        inline = tomlkit.inline_table()
        inline.update({str(key): toml_item(item) for key, item in value.items()})
        return inline
    if isinstance(value, (list, tuple)):
        # Made at once: tomlkit's arrays take time that grows with the square of what is appended.
        parts = [part for item in value for part in (tomlkit.ws(", "), toml_item(item))]
        return tomlkit.items.Array(parts[1:], tomlkit.items.Trivia())
    if isinstance(value, (str, bool, int, float, dt.date, dt.time)):
        return tomlkit.item(value)
    raise TypeError(type(value).__name__)
