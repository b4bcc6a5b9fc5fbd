"""Text for users: messages of few, short, printable lines.

Messages quote names and values of files that may be anyone's. Quotes are cut and their control
characters escaped, so that they neither forge a line nor control a terminal.
"""

from __future__ import annotations

import contextlib
import difflib
import glob
import itertools
import json
import os
import re
import shlex
import sys
from collections.abc import Collection
from pathlib import Path
from typing import Any

MAX_QUOTE_LENGTH = 120
MAX_LINE_LENGTH = 1000


def plain(text: object, most: int = MAX_QUOTE_LENGTH) -> str:
    r"""Return text on one line without control characters, cut to ``most`` characters.

    >>> plain("two\nlines"), plain("long" * 99, 9)
    ('two\\nlines', 'longlo...')
    """
    text = str(text)
    cut = text if len(text) <= most else text[: most - 3] + "..."
    return "".join(c if c.isprintable() else json.dumps(c)[1:-1] for c in cut)


def exception_line(error: BaseException) -> str:
    """Return an exception as one line: its type, and the first line of its message."""
    return ": ".join([type(error).__name__, *str(error).strip().splitlines()[:1]])


def notice(*lines: str) -> None:
    """Write lines to stderr about what goes on, without control characters; errors follow apart.

    Nobody may listen: lines that cannot be written are left out.
    """
    with contextlib.suppress(OSError, ValueError, AttributeError):
        sys.stderr.writelines(f"{plain(line, MAX_LINE_LENGTH)}\n" for line in lines)


def shown(value: Any) -> str:
    """Return a value as TOML, cut if it is long.

    >>> shown({"uniform": [0, 4.5]})
    '{uniform = [0, 4.5]}'
    """
    return plain(_toml(value))


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key} = {_toml(item)}' for key, item in value.items())}}}"
    if isinstance(value, (list, tuple)):  # no more than so many items are shown
        return f"[{', '.join(map(_toml, value[:MAX_QUOTE_LENGTH]))}]"
    if isinstance(value, (str, bool)):
        return json.dumps(value, ensure_ascii=False)
    # Python writes no more than 4300 decimal digits.
    large = isinstance(value, int) and value.bit_length() >= 10_000
    return f"{value:#x}" if large else str(value)


def label(value: Any) -> str:
    """Return a value as a coordinate of strings shows it.

    >>> label((-0.3, 0.1)), label("ippe"), label(True)
    ('[-0.3, 0.1]', 'ippe', 'True')
    """
    return str(list(value) if isinstance(value, tuple) else value)


#: Longer words are not compared with known ones, nor is a name with more files of its folder.
MAX_WORD_LENGTH, MAX_FILES = 60, 10_000


def similar(word: str, known: Collection[str], cutoff: float = 0.6) -> str:
    """Return the known word that a word is a part of, else the most similar one; "" without.

    Letters' cases, underscores and hyphens do not count. ``cutoff``: least share of equal letters.
    The word itself is never suggested: it is known, and wrong for another reason.
    """
    if not isinstance(word, str) or len(word) > MAX_WORD_LENGTH:
        return ""
    letters, simple = letters_of(word), {letters_of(n): n for n in known if n != word}
    longer = [each for each in simple if len(letters) > 1 and letters in each]
    close = longer or difflib.get_close_matches(letters, list(simple), n=1, cutoff=cutoff)
    return simple[min(close, key=len)] if close else ""


def nearest(word: str, known: Collection[str]) -> str:
    """Return "; did you mean ...?" with the most similar known word, or "".

    >>> nearest("tilt", ["roll_deg", "tilt_deg"]), nearest("4x4", ["DICT_5X5_50", "DICT_4X4_50"])
    ('; did you mean tilt_deg?', '; did you mean DICT_4X4_50?')
    """
    close = similar(word, known)
    return f"; did you mean {close}?" if close else ""


def nearest_file(path: str | os.PathLike[str]) -> str:
    """Return "; did you mean ...?" for a missing path, or "".

    It is the path's name in a folder beside it, or the most similar name in its folder.
    """
    near = wanted = Path(path)
    with contextlib.suppress(OSError, ValueError):
        if not wanted.exists():
            names = [each.name for each in itertools.islice(wanted.parent.iterdir(), MAX_FILES)]
            beside = wanted.with_name(similar(wanted.name, names, 0.8) or wanted.name)
            near = next(wanted.parent.glob(f"*/{glob.escape(wanted.name)}"), beside)
    return "" if near == wanted else f"; did you mean {plain(near, 300)}?"


def letters_of(word: str) -> str:
    """Return the letters and digits by which a word is known, in lower case."""
    return re.sub(r"[\W_]", "", word.casefold())


def quoted(*words: str) -> str:
    """Return words of a command, quoted for a shell on one line.

    >>> print(quoted("a b", "c"))
    'a b' c
    """
    return shlex.join(plain(word, len(word)) for word in words)
