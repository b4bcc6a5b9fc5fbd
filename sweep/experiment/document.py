"""The document of a pipeline: TOML read within bounds and written, and its keys, each checked."""

from __future__ import annotations

import contextlib
import datetime as dt
import os
import re
import tomllib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
import tomlkit.items

from sweep.declaration import Declared, TablesError, check_table
from sweep.errors import MAX_FAULTS, PipelineError
from sweep.experiment import grid, parameters
from sweep.experiment.draws import SAMPLINGS
from sweep.experiment.grid import TRIAL, Axis, Grid
from sweep.messages import plain, shown, similar
from sweep.model.image_file import read_regular
from sweep.plugins.loading import DeclaredPlugin

# --------------------------------------------------------------------------------------------------
# TOML: any text gives a document or a reason, and soon.

#: The largest text that is read.
MAX_BYTES = 250_000

#: The most parts of a dotted key: reading it takes memory that grows with their square.
MAX_PARTS = 8

_PART = r"""(?:[A-Za-z0-9_-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(
    rf"(?<![A-Za-z0-9_\\-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{MAX_PARTS}}}"
)
_BARE = re.compile(
    r"(?=.*[A-Za-z])[A-Za-z0-9][A-Za-z0-9_.+-]*(/[A-Za-z0-9_.+-]+)*(:[A-Za-z_][A-Za-z0-9_]*)?"
)


@contextlib.contextmanager
def refusing(source: str) -> Iterator[None]:
    """Raise the PipelineError of a ValueError: its lines, each beginning with ``source``."""
    try:
        yield
    except ValueError as error:
        raise PipelineError([f"{source}: {line}" for line in str(error).split("\n")]) from None


def file_text(path: str | os.PathLike[str], most: int = MAX_BYTES) -> str:
    """Return the text of a file of at most so many bytes; ValueError says why it cannot be read."""
    try:
        return read_regular(Path(path), most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"expected UTF-8: byte {error.start} is not") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ValueError(f"cannot be read: {reason}") from None


def read_document(text: str) -> dict[str, Any]:
    """Return a TOML document.

    Raises
    ------
    ValueError
        Says what was expected, or why it is no TOML.
    """
    if not isinstance(text, str):
        raise ValueError("expected TOML as text")  # noqa: TRY004
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
    except RecursionError:
        raise ValueError("not TOML: nested too deeply") from None
    except ValueError as error:  # also if a number has more digits than Python reads
        raise ValueError(f"not TOML: {plain(error, 300)}") from None


def read_value(written: str) -> Any:
    """Return a value of a command line; ValueError with what was expected if it is not one.

    It is written as in TOML. Python's ``True`` and ``False`` count too, and a bare word, such as
    a solver's name, counts as a string.

    >>> read_value("[0, 4.5]"), read_value("True"), read_value("36h11"), read_value("1e3")
    ([0, 4.5], True, '36h11', 1000.0)
    """
    if written in ("True", "False"):
        return written == "True"
    document = {"value": written} if _BARE.fullmatch(written) else {}
    with contextlib.suppress(ValueError):
        document = read_document(f"value = {written}")
    if len(document) != 1:
        raise ValueError("a TOML value, such as [0, 45] or 'text'")
    return document["value"]


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
    if not isinstance(mapping, Mapping):
        raise ValueError("expected a mapping of keys and sections")  # noqa: TRY004
    faults: list[str] = []
    document = tomlkit.document()
    tables = {key: value for key, value in mapping.items() if isinstance(value, Mapping)}
    above = {key: value for key, value in mapping.items() if key not in tables}
    for path, items in [("", above), *((f"{home}.", items) for home, items in tables.items())]:
        table = document.setdefault(path[:-1], tomlkit.table()) if path else document
        for key, value in items.items():
            try:
                table[key] = toml_item(value)
            except (TypeError, ValueError, RecursionError):
                faults.append(f"{plain(f'{path}{key}')} = {plain(repr(value))}: expected a string, "
                              "a number, true, false, a list or a table")
    if faults:
        raise ValueError("\n".join(faults))
    return tomlkit.dumps(document)


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


# --------------------------------------------------------------------------------------------------
# The keys of a document. All faults are gathered: a value that cannot be is left out of the grid.

#: The section of requirements on the results (`sweep.experiment.sampling`).
REQUIRE = "require"

#: The section of the search (`sweep.experiment.sampling`).
SEARCH = "search"

MAX_TITLE_LENGTH = 200


def _title(value: Any) -> str:
    if not isinstance(value, str) or len(value) > MAX_TITLE_LENGTH or not value.isprintable():
        raise ValueError(f"a string: one line of at most {MAX_TITLE_LENGTH} characters")
    return value


def _effects(value: Any) -> list[str]:
    named = isinstance(value, list) and all(isinstance(name, str) and name for name in value)
    if not named or len(set(value)) < len(value):
        raise ValueError('a list of plug-ins, each once, such as ["haze"]')
    return [*value]


#: Keys that stand above the sections.
HEADER = {
    declared.name: declared for declared in (
        Declared("title", (str,), "", "title", reads=_title),
        Declared("seed", (int,), 0, "seed of all draws", low=0, high=2**63 - 1),
        Declared("sampling", (str,), SAMPLINGS[0], "sampling", choices=SAMPLINGS),
        Declared(parameters.EFFECTS_KEY, (list,), (), "plug-ins", reads=_effects),
    )
}


def section_of(name: str, known: Mapping[str, parameters.Parameter] = parameters.PARAMETERS) -> str:
    """Return the section that a parameter belongs under; empty for an unknown name."""
    if name == TRIAL:
        return "axes"
    return known[name].section if name in known else ""


@dataclass(frozen=True)
class Reading(Grid):
    """The content of a document, as far as it could be read, and its faults.

    Attributes
    ----------
    document
        The document, as TOML has it: tables are dictionaries.
    source
        The name that messages begin with.
    title
        As the document says.
    recorded
        Path as written -> SHA-256 of the files of a store, which are not read: they may have
        moved. None if the document is no store's.
    written
        Parameter -> where the document has it, and the value that stands there.
    unread
        Parameters that name plug-ins that cannot be used, and the sections of their settings: any
        key may be theirs.
    stated
        Values that a camera file has, by parameter: they are written into the document's text.
    faults
        One line each, once: source, key, value, expectation.
    """

    axes: list[Axis]
    document: Mapping[str, Any]
    source: str
    title: str
    recorded: Mapping[str, str] | None
    written: dict[str, tuple[str, Any]]
    unread: set[str] = field(default_factory=set)
    stated: dict[str, Any] = field(default_factory=dict)
    faults: dict[str, None] = field(default_factory=dict)

    def tell(self, lines: Iterable[str]) -> None:
        """Note faults, each a line without the source."""
        self.faults.update((f"{self.source}: {line}", None) for line in lines)

    def note(self, key: str, problem: str) -> None:
        """Note a fault without a value."""
        self.tell([f"{key}: {problem}"])

    def fault(self, key: str, value: Any, expected: str) -> None:
        """Note a fault of a key's value."""
        self.note(f"{plain(key)} = {shown(value)}", f"expected {expected}")

    def refuse(self, name: str, expected: str, *value: Any) -> None:
        """Note a fault of a parameter as the document has it, or of one ``value`` of it."""
        path = f"{self.parameters[name].section}.{name}"
        written = self.written.get(name, (path, self.fixed.get(name)))
        path, own = (path, value[0]) if value else written
        self.fault(path, own, expected)

    @contextlib.contextmanager
    def noting(self, path: str, key: str, value: Any) -> Iterator[None]:
        """Note the fault of a key's value that its reader raises as ValueError."""
        try:
            yield
        except TablesError as error:
            self.tell(f"{path}{line}" for line in error.args)
        except ValueError as error:
            if key not in self.unread:
                self.fault(path, value, str(error))

    def unknown_key(
        self, section: str, key: str, known: Collection[str], expected: str = ""
    ) -> None:
        """Note a key that a section does not have, with the place of it or of a similar one.

        ``known`` are the section's keys; ``expected`` says so in words.
        """
        hint = ""
        if len(self.faults) < MAX_FAULTS:
            homes = dict.fromkeys(HEADER, " at the top, above the sections") | {
                name: f" under [{section_of(name, self.parameters)}]"
                for name in (*self.parameters, TRIAL)} | dict.fromkeys(known, "")
            close = similar(key, homes, 0.8) or similar(key, known)
            hint = f"; it belongs{homes[key]}" if homes.get(key) else (
                f"; did you mean {close}{homes[close]}?" if close else "")
        path = f"{section}.{key}" if section else key
        self.note(plain(path), f"unknown key{expected}{hint}")

    def table(self, name: str) -> Mapping[str, Any]:
        """Return a table of the document; an empty one where it is missing, or no table."""
        table = self.document.get(name)
        return table if isinstance(table, dict) else {}

    def is_active(self, switch: str) -> bool:
        """Return whether a switch has, or was meant to have, another than its neutral value."""
        values, off = self.values_of(switch), self.parameters[switch].default
        return any(value != off for value in values) if values else switch in self.given

    def meeting(self, *names: str) -> Iterator[tuple[Any, ...]]:
        """Yield values of some parameters that meet on the grid; none if one is at fault or drawn.

        Of numbers that vary by themselves the least and the largest.
        """
        for row in self.rows(names, ends=True):
            if len(row) == len(names):
                yield tuple(row[name] for name in names)


def read_keys(
    document: Mapping[str, Any], source: str, folder: str,
    recorded: Mapping[str, str] | None = None, stored: Sequence[DeclaredPlugin] | None = None,
) -> Reading:
    """Return the content of a document: its keys, each checked on its own.

    ``recorded`` files and ``stored`` plug-ins are those of a store, which are not read. Files that
    it names, and the sections of requirements and of a search, are read elsewhere.
    """
    header, lines = check_table(
        HEADER, {key: value for key, value in document.items() if key in HEADER}, "")
    plugins, faults = parameters.read_plugins(document, folder, stored)
    written: dict[str, tuple[str, Any]] = {}
    reading = Reading(
        seed=header["seed"], sampling=header["sampling"], title=header["title"], fixed={},
        given=written.keys(), written=written, distributions={}, axes=[], plugins=tuple(plugins),
        folder=folder, files={each.file: each.digest for each in plugins if each.file} | dict(
            recorded or {}),
        document=document, source=source, recorded=recorded,
    )
    reading.tell(lines)
    for kind, key, name, expected in faults:
        reading.fault(key, name, expected)
        reading.unread.add(parameters.section_of_settings(kind))
        if kind in parameters.NAMED_BY:
            reading.unread.add(parameters.NAMED_BY[kind].name)
    known = [*HEADER, *parameters.SECTIONS, "axes", REQUIRE, SEARCH]
    for key, value in document.items():
        if key not in known:
            kind = "a section" if isinstance(value, dict) else "a key"
            reading.unknown_key("", key, known, f"; expected {kind} of {', '.join(known)}")
        elif key not in HEADER and not isinstance(value, dict):
            reading.fault(key, value, f"a table: [{key}]")
    for section in parameters.SECTIONS:
        for key, value in reading.table(section).items():
            _read_key(reading, section, key, value)
    for key, value in reading.table("axes").items():
        together = parameters.is_zip(value) and key not in (*reading.parameters, TRIAL)
        _read_axis(reading, key, value["zip"] if together else {key: value}, together=together)
    reading.fixed.update({name: each.default for name, each in reading.parameters.items()
                          if name not in reading.given})
    return reading


def _read_key(reading: Reading, section: str, key: str, value: Any) -> None:
    """Read a key of a section: a value, or a distribution."""
    path = f"{section}.{key}"
    parameter = reading.parameters.get(key)
    if parameter is None or parameter.section != section:
        if parameters.is_zip(value):
            reading.fault(path, value, "parameters that go together under [axes]")
        elif section not in reading.unread or section_of(key, reading.parameters):
            reading.unknown_key(section, key, [
                each.name for each in reading.parameters.values() if each.section == section])
        return
    reading.written[key] = path, value
    with reading.noting(path, key, value):
        if isinstance(value, dict):
            reading.distributions[key] = grid.parse_distribution(parameter, value)
        elif isinstance(value, list) and tuple not in parameter.types and not parameter.reads:
            raise ValueError(f"{parameter.expected()}; several values are an axis: they go under "
                             "[axes]")
        else:
            reading.fixed[key] = parameter.check(value)


def _read_axis(reading: Reading, key: str, members: Mapping[str, Any], *, together: bool) -> None:
    """Add the axis of a parameter, or of several that go together, or note why there is none."""
    path = f"axes.{key}" if together else "axes"
    if together and not key.isidentifier():
        reading.note(plain(path), "expected a name of letters, digits and underscores")
        return
    columns: dict[str, Sequence[Any]] = {}
    listed = sum(len(values) for axis in reading.axes for values in axis.columns.values()
                 if not isinstance(values, range))
    quota = (grid.MAX_LISTED - listed) // max(len(members), 1)
    for name, value in members.items():
        with reading.noting(f"{path}.{name}", name, value):
            if name == TRIAL and together:
                raise ValueError("it as an axis of its own: every cell has the same trials")
            if name == TRIAL:
                columns[name] = grid.trial_numbers(value)
            elif name in reading.given:
                other, _ = reading.written[name]
                raise ValueError(f"it once: {other} is given too; delete one of them")
            elif name in reading.parameters:
                reading.written[name] = f"{path}.{name}", value
                values = grid.axis_values(reading.parameters[name], value, quota, repeats=together)
                if together and len(values) > quota:
                    raise ValueError("at most 10^6 values, all axes together")
                columns[name] = values
            elif isinstance(value, dict) and not value.keys().isdisjoint((
                    "zip", *reading.parameters)):
                raise ValueError(
                    "parameters that go together as "
                    "{ zip = { fx_px = [600, 800], fy_px = [600, 805] } }, with nothing beside zip")
            elif not reading.unread or name in HEADER:
                reading.unknown_key(path, name, [*reading.parameters, TRIAL])
    if together and len(members) < 2:
        reading.fault(path, {"zip": members}, "at least two parameters that go together")
    if len(columns) < max(len(members), 1 + together):
        return
    try:
        reading.axes.append(grid.axis_along(key, columns, reading.parameters, together=together))
    except ValueError as error:
        reading.note(path, f"expected {error}")
