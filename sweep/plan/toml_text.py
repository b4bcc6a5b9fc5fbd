"""TOML read within bounds: any text gives a document or a reason, and soon."""

from __future__ import annotations

import re
import tomllib
from typing import Any

from sweep.messages import plain

MAX_BYTES = 250_000
"""The largest text that is read."""

MAX_PARTS = 8
"""The most parts of a dotted key: reading them takes time that grows with their square."""

_PART = r"""(?:[A-Za-z0-9_-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(
    rf"(?<![A-Za-z0-9_\\-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{MAX_PARTS}}}"
)
_BARE = re.compile(r"[A-Za-z][A-Za-z0-9_.+-]*(/[A-Za-z0-9_.+-]+)*")


def read_document(text: str) -> dict[str, Any]:
    """Return a TOML document; ValueError with what was expected, or why it is none."""
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
    """Return the one TOML value that is written; ValueError where it is none."""
    document = read_document(f"value = {written}")
    value = document.pop("value")
    if document:
        raise ValueError("expected one value")
    return value


def quoted_if_bare(written: str) -> str:
    """Return a bare word, such as a solver's name, as a TOML string; anything else as it is."""
    if _BARE.fullmatch(written) and written not in ("true", "false", "inf", "nan"):
        return f'"{written}"'
    return written
