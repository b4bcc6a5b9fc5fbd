"""Text of messages: few, short, printable lines.

Messages quote names and values of files that may be anyone's. Quotes are cut and their control
characters escaped, so that they neither forge a line nor control a terminal.
"""

from __future__ import annotations

import contextlib
import difflib
import itertools
import sys
from collections.abc import Iterator, Sequence
from typing import Any

from sweep.errors import PipelineError

MAX_FAULTS = 20
"""Faults that are listed; the others are counted."""

MAX_QUOTE_LENGTH = 120
MAX_LINE_LENGTH = 1000


def refusal(faults: Sequence[str]) -> PipelineError:
    """Return the error that lists ``faults``, a line each."""
    lines = [plain(fault, MAX_LINE_LENGTH) for fault in faults[:MAX_FAULTS]]
    if len(faults) > MAX_FAULTS:
        lines.append(f"... and {len(faults) - MAX_FAULTS:,} faults more")
    return PipelineError(lines)


def plain(text: object, most: int = MAX_QUOTE_LENGTH) -> str:
    r"""Return text on one line without control characters, cut to ``most`` characters.

    >>> plain("two\nlines"), plain("long" * 99, 9)
    ('two\\nlines', 'longlo...')
    """
    text = str(text)
    cut = text if len(text) <= most else text[: most - 3] + "..."
    if cut.isprintable():
        return cut
    return "".join(c if c.isprintable() else _escape(c) for c in cut)


def notice(line: str) -> None:
    """Write a line to stderr about what goes on, without control characters; errors follow apart.

    Nobody may listen: a line that cannot be written is left out.
    """
    with contextlib.suppress(OSError, ValueError, AttributeError):
        sys.stderr.write(f"{plain(line, MAX_LINE_LENGTH)}\n")
        sys.stderr.flush()


def _escape(character: str) -> str:
    short = {"\n": "\\n", "\t": "\\t", "\r": "\\r"}.get(character)
    code = ord(character)
    return short or (f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}")


def shown(value: Any) -> str:
    """Return a value as TOML, cut if it is long; the rest is not even formatted.

    >>> shown({"uniform": [0, 4.5]})
    '{uniform = [0, 4.5]}'
    """
    text = ""
    for piece in _pieces(value):
        text += piece
        if len(text) > MAX_QUOTE_LENGTH:
            break
    return plain(text)


def _pieces(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        yield "{"
        for number, (key, item) in enumerate(value.items()):
            yield f"{', ' if number else ''}{_key(str(key))} = "
            yield from _pieces(item)
        yield "}"
    elif isinstance(value, (list, tuple)):
        yield "["
        for number, item in enumerate(value):
            yield ", " if number else ""
            yield from _pieces(item)
        yield "]"
    elif isinstance(value, str):
        yield _quoted(value)
    elif isinstance(value, bool):
        yield str(value).lower()
    elif isinstance(value, int):
        # Python writes no more than 4300 decimal digits.
        yield str(value) if value.bit_length() < 10_000 else f"{value:#x}"
    elif hasattr(value, "isoformat"):
        yield value.isoformat().replace("+00:00", "Z")
    else:
        yield str(value)


def _quoted(text: str) -> str:
    short = itertools.islice(text, MAX_QUOTE_LENGTH + 1)
    return '"' + "".join("\\" + c if c in '"\\' else plain(c) for c in short) + '"'


def _key(key: str) -> str:
    return key if key.isascii() and key.replace("-", "_").isidentifier() else _quoted(key)


def label(value: Any) -> str:
    """Return a value as a coordinate of strings shows it.

    >>> label((-0.3, 0.1)), label("ippe"), label(True)
    ('[-0.3, 0.1]', 'ippe', 'True')
    """
    if isinstance(value, tuple):
        return "[" + ", ".join(f"{item!r}" for item in value) + "]"
    return value if isinstance(value, str) else repr(value)


MAX_WORD_LENGTH = 60
"""Longer words are not compared with known ones."""


def nearest(word: str, known: Sequence[str]) -> str:
    """Return "; did you mean ...?" with the most similar known word, or "" if none is similar.

    Letters' cases, underscores and hyphens do not count.

    >>> nearest("tilt", ["roll_deg", "tilt_deg"]), nearest("MarkerID", ["marker_id"])
    ('; did you mean tilt_deg?', '; did you mean marker_id?')
    """
    if len(word) > MAX_WORD_LENGTH:
        return ""
    close = [name for name in known if _letters(name) == _letters(word)]
    close = close or [name for name in known if word and name.startswith(word)]
    simple = {_letters(name): name for name in known}
    close = close or [
        simple[each]
        for each in difflib.get_close_matches(_letters(word), list(simple), n=1, cutoff=0.6)
    ]
    close = close or difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    return f"; did you mean {close[0]}?" if close else ""


def _letters(word: str) -> str:
    return word.casefold().replace("_", "").replace("-", "")


BYTE_UNITS = ("bytes", "kB", "MB", "GB", "TB", "PB")


def byte_count(count: int) -> str:
    """Return a number of bytes with a decimal prefix.

    >>> byte_count(999), byte_count(332_000), byte_count(10**9)
    ('999 bytes', '332 kB', '1 GB')
    """
    power = min((len(str(count)) - 1) // 3, len(BYTE_UNITS) - 1)
    return f"{count / 1000**power:.3g} {BYTE_UNITS[power]}"


def duration(seconds: float) -> str:
    """Return a time in the largest unit of which there are at least two.

    >>> duration(90.0), duration(150.0), duration(1e6)
    ('90.0 s', '2.5 min', '11.6 days')
    """
    for unit, length in (("days", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.1f} s"
