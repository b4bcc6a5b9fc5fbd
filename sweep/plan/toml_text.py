"""TOML read within bounds (any text gives a document or a reason, and soon), and written."""

from __future__ import annotations

import datetime as dt
import json
import os
import re
import tomllib
from collections.abc import Mapping
from typing import Any

import numpy as np

from sweep.messages import plain

MAX_BYTES = 250_000
"""The largest text that is read."""

MAX_PARTS = 8
"""The most parts of a dotted key: reading it takes time that grows with their square."""

_PART = r"""(?:[A-Za-z0-9_-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(
    rf"(?<![A-Za-z0-9_\\-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{MAX_PARTS}}}"
)
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_BARE = re.compile(r"[A-Za-z][A-Za-z0-9_.+-]*(/[A-Za-z0-9_.+-]+)*(:[A-Za-z_][A-Za-z0-9_]*)?")


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
    """Return a bare word, such as a solver's name, as a TOML string; anything else as it is."""
    if _BARE.fullmatch(written) and written not in ("true", "false", "inf", "nan"):
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
    'seed = 1\n\n[axes]\ntrial = 3\nmarker_id = { range = [0, 5, 1] }\n'
    """
    faults: list[str] = []
    head: list[str] = []
    tables: list[str] = []
    for key, value in mapping.items():
        if isinstance(value, Mapping):
            lines = [_line(f"{key}.", name, item, faults) for name, item in value.items()]
            tables += ["", f"[{key_text(str(key))}]", *lines]
        else:
            head.append(_line("", key, value, faults))
    if faults:
        raise ValueError("\n".join(faults))
    return "\n".join(head + tables if head else tables[1:]) + "\n"


def _line(table: str, key: Any, value: Any, faults: list[str]) -> str:
    """Return "key = value"; add a fault if there is no such line in TOML."""
    path = plain(f"{table}{key}")
    if not isinstance(key, str):
        faults.append(f"{path}: expected a string as key")
        return ""
    try:
        return f"{key_text(key)} = {_value_text(value)}"
    except TypeError as error:
        faults.append(f"{path} = {plain(repr(value))}: expected {error}")
    except RecursionError:
        faults.append(f"{path}: nested too deeply")
    return ""


def _value_text(value: Any) -> str:
    """Return a value as TOML; TypeError with the expectation if TOML has no such value."""
    if isinstance(value, (np.generic, np.ndarray)):
        value = value.tolist()
    if isinstance(value, os.PathLike):
        value = os.fspath(value)
    if isinstance(value, range):
        value = {"range": [value.start, value.stop, value.step]}
    if isinstance(value, Mapping):
        pairs = [f"{key_text(str(key))} = {_value_text(item)}" for key, item in value.items()]
        return f"{{ {', '.join(pairs)} }}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_value_text, value))}]"
    if isinstance(value, str):
        return string_text(value)
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int):
        # Python writes no more than 4300 decimal digits.
        return str(int(value)) if value.bit_length() < 10_000 else f"{value:#x}"
    if isinstance(value, float):
        return repr(float(value))
    if isinstance(value, (dt.date, dt.time)):
        return value.isoformat()
    raise TypeError("a string, a number, true, false, a list or a table")


def string_text(text: str) -> str:
    r"""Return text as a basic string of TOML.

    >>> print(string_text('C:\\a "b"'))
    "C:\\a \"b\""
    """
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def key_text(key: str) -> str:
    """Return a key of TOML, bare if it can be.

    >>> key_text("tilt_deg"), key_text("a key")
    ('tilt_deg', '"a key"')
    """
    return key if _BARE_KEY.fullmatch(key) else string_text(key)
