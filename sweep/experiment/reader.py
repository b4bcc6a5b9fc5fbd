"""Keys of a pipeline document: each is checked on its own, and all faults are gathered."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

from sweep.declaration import Declaration, Declared, TablesError
from sweep.experiment.axes import (
    MAX_LISTED,
    TRIAL,
    Axis,
    Distribution,
    parse_axis,
    parse_distribution,
    parse_trial,
    zipped_axis,
)
from sweep.experiment.draws import SAMPLINGS
from sweep.experiment.experiment import Grid
from sweep.experiment.parameters import (
    PARAMETERS,
    REMOVED,
    SECTIONS,
    Parameter,
    is_zip,
    places,
)
from sweep.experiment.plugins import EFFECTS_KEY, NAMED_BY, read_plugins, section_of_settings
from sweep.messages import MAX_FAULTS, nearest, plain, shown
from sweep.plugins.declared import DeclaredPlugin

MAX_TITLE_LENGTH = 200

MAX_HOMES = 3
"""Keys of an unknown section whose own sections are named."""

HEADER = ("title", "seed", "sampling", EFFECTS_KEY)
"""Keys that stand above the sections."""

REQUIRE = "require"
"""The section of what the results must fulfil (`sweep.experiment.sampling`)."""


class StoppingRule(Protocol):
    """What a section says: a frozen dataclass of plain values.

    Attributes
    ----------
    section
        The section's name.
    max_trials
        The most trials of a condition; the length of the axis ``trial``.
    """

    section: ClassVar[str]
    __dataclass_fields__: ClassVar[dict[str, Any]]

    def __hash__(self) -> int:
        """Return the hash of a frozen dataclass."""

    @property
    def max_trials(self) -> int:
        """The most trials of a condition."""

    def looser(self, begun: Any) -> str:
        """Return why a store that was begun under another rule of the section cannot be continued.

        Empty if this rule asks for at least as much of every condition, so that nothing that was
        computed is in vain.
        """


@dataclass(slots=True)
class Reading(Grid):
    """What a document says, as far as it could be read, and its faults.

    Attributes
    ----------
    document
        The document, as TOML has it: tables are dictionaries.
    source
        The name that messages begin with.
    folder
        Where relative paths start.
    known_files
        Path as written -> SHA-256, used instead of reading the files; None to read them.
    known_cameras
        The same of camera files alone, whose values the document has.
    known_plugins
        The plug-ins that a store has recorded, used instead of importing them; None to import.
    title, seed, sampling, fixed, distributions, axes, files, plugins
        As :class:`sweep.experiment.pipeline.Pipeline` has them; ``axes`` by name.
    given
        Names of the parameters that the document has, even with a value that cannot be.
    requirements, require_per, budget_ms, stopping
        As :class:`sweep.experiment.pipeline.Pipeline` has them.
    unread
        Parameters that name plug-ins that cannot be used, and the sections of their settings: any
        key may be theirs.
    stated
        Values that a camera file has, by parameter: they are written into the document's text.
    faults
        One line each: source, key, value, expectation.
    """

    document: Mapping[str, Any]
    source: str
    folder: str
    known_files: Mapping[str, str] | None = None
    known_cameras: Mapping[str, str] | None = None
    known_plugins: Sequence[DeclaredPlugin] | None = None
    title: str = ""
    seed: int = 0
    sampling: str = SAMPLINGS[0]
    fixed: dict[str, Any] = field(default_factory=dict)
    distributions: dict[str, Distribution] = field(default_factory=dict)
    axes: dict[str, Axis] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)
    given: set[str] = field(default_factory=set)
    requirements: tuple[str, ...] = ()
    require_per: tuple[str, ...] = ()
    stopping: StoppingRule | None = None
    budget_ms: float | None = None
    stated: dict[str, Any] = field(default_factory=dict)
    plugins: tuple[DeclaredPlugin, ...] = ()
    unread: set[str] = field(default_factory=set)
    faults: list[str] = field(default_factory=list)

    def fault(self, key: str, value: Any, expected: str) -> None:
        """Note a fault of a key's value."""
        self.note(f"{plain(key)} = {shown(value)}", f"expected {expected}")

    def note(self, key: str, problem: str) -> None:
        """Note a fault without a value."""
        self.faults.append(f"{self.source}: {key}: {problem}")

    def refuse(self, name: str, expected: str) -> None:
        """Note a fault of a parameter as the document has it."""
        parameter = self.parameters[name]
        path = next(iter(places(self.document, parameter)), f"{parameter.section}.{name}")
        self.fault(path, self.written(name), expected)

    def refuse_values(self, name: str, expected: str, wrong: Callable[[Any], bool]) -> None:
        """Note a fault of each value of a parameter on the grid that is wrong."""
        for value in dict.fromkeys(filter(wrong, self.values_of(name))):
            self.fault(f"{self.parameters[name].section}.{name}", value, expected)

    def unknown(self, key: str, problem: str, word: str, known: Sequence[str]) -> None:
        """Note an unknown key, with the nearest known one if the line will be printed."""
        hint = nearest(word, known) if len(self.faults) < MAX_FAULTS else ""
        self.note(plain(key), f"{problem}{removed(key.rpartition('.')[2]) or hint}")

    def unknown_key(self, section: str, key: str, known: Sequence[str], expected: str = "") -> None:
        """Note a key that a section does not have, with the section where it or a similar one is.

        ``known`` are the section's keys; ``expected`` says so in words.
        """
        homes = dict.fromkeys(known, "") | {
            name: home for name in (*self.parameters, TRIAL, *HEADER)
            if name not in known and (home := self.home_of(name))
        }
        hint = removed(key)
        if not hint and len(self.faults) < MAX_FAULTS:
            hint = f"; it belongs {homes[key]}" if homes.get(key) else (
                nearest(key, list(homes), 0.8) or nearest(key, known))
            similar = hint.removeprefix("; did you mean ").removesuffix("?")
            if homes.get(similar):
                hint = f"{hint[:-1]} {homes[similar]}?"
        self.note(plain(f"{section}.{key}"), f"unknown key{expected}{hint}")

    def home_of(self, name: str) -> str:
        """Return where a key belongs, in words; empty for an unknown one."""
        section = section_of(name, self.parameters)
        return f"under [{section}]" if section else (
            "at the top, above the sections" if name in HEADER else "")

    def is_active(self, switch: str) -> bool:
        """Return whether a switch has, or was meant to have, another than its neutral value."""
        values, off = self.values_of(switch), self.parameters[switch].default
        return any(value != off for value in values) if values else switch in self.given

    def names_axis(self, name: str) -> bool:
        """Return whether the table [axes] has a key, be it an axis or a fault."""
        table = self.document.get("axes")
        return isinstance(table, dict) and name in table

    def together(self, a: str, b: str) -> Iterator[tuple[Sequence[Any], Sequence[Any]]]:
        """Yield values of two parameters of which each of the one meets each of the other."""
        axis = self.axis_of(a)
        if axis is not None and b in axis.columns and a != b:
            for index in range(len(axis)):
                row = axis.at(index)
                yield (row[a],), (row[b],)
        else:
            yield self.values_of(a), self.values_of(b)

    def written(self, name: str) -> Any:
        """Return the value that the document gives a parameter, for messages."""
        given = places(self.document, self.parameters[name]).values()
        return next(iter(given), self.fixed.get(name))


def removed(key: str) -> str:
    """Return what to do instead of a parameter of an earlier version; empty for others."""
    return f"; {REMOVED[key]}" if key in REMOVED else ""


def section_of(name: str, parameters: Mapping[str, Parameter] = PARAMETERS) -> str:
    """Return the section that a parameter belongs under; empty for an unknown name."""
    if name == TRIAL:
        return "axes"
    return parameters[name].section if name in parameters else ""


def read_keys(reading: Reading, others: Collection[str] = ()) -> None:
    """Read the keys of a document, each checked on its own.

    ``others`` are the names of sections that are read elsewhere.
    """
    _read_header(reading)
    known = [*HEADER, *SECTIONS, "axes", REQUIRE, *others]
    for key, value in reading.document.items():
        if key in HEADER or key == REQUIRE or key in others:
            continue
        if key == "axes" or key in SECTIONS:
            if not isinstance(value, dict):
                reading.fault(key, value, f"a table: [{key}]")
        elif home := section_of(key, reading.parameters):
            reading.fault(key, value, f"it under [{home}]")
        else:
            kind = "a section" if isinstance(value, dict) else "a key"
            homes = [f"{name} belongs under [{section_of(name, reading.parameters)}]"
                     for name in (value if isinstance(value, dict) else ())
                     if section_of(name, reading.parameters)][:MAX_HOMES]
            reading.unknown(key, "; ".join([
                f"unknown; expected {kind} of {', '.join(known)}",
                *([] if nearest(key, known) else homes)]), key, known)
    for section in SECTIONS:
        table = reading.document.get(section)
        for key, value in table.items() if isinstance(table, dict) else ():
            _read_key(reading, section, key, value)
    _read_axes(reading)
    for parameter in reading.parameters.values():
        if parameter.name not in reading.given:
            reading.fixed[parameter.name] = parameter.default


def _title(value: Any) -> str:
    if not isinstance(value, str) or len(value) > MAX_TITLE_LENGTH or not value.isprintable():
        raise ValueError(f"a string: one line of at most {MAX_TITLE_LENGTH} characters")
    return value


def _effects(value: Any) -> list[str]:
    if (
        not isinstance(value, list) or len({*map(str, value)}) < len(value)
        or not all(isinstance(name, str) and name for name in value)
    ):
        raise ValueError('a list of plug-ins, each once, such as ["haze"]')
    return value


_HEADER = (
    Declared("title", (str,), "", Declaration("title", reads=_title)),
    Declared("seed", (int,), 0, Declaration("seed of all draws", low=0, high=2**63 - 1)),
    Declared("sampling", (str,), SAMPLINGS[0], Declaration("sampling", choices=SAMPLINGS)),
    Declared(EFFECTS_KEY, (list,), [], Declaration("plug-ins", reads=_effects)),
)


def _read_header(reading: Reading) -> None:
    """Read the keys above the sections, and the plug-ins that the document names."""
    for declared in _HEADER:
        value = reading.document.get(declared.name, declared.default)
        try:
            checked = declared.check(value)
            if declared.name != EFFECTS_KEY:  # plug-ins of all kinds follow
                setattr(reading, declared.name, checked)
        except ValueError as error:
            reading.fault(declared.name, value, str(error))
    plugins, faults = read_plugins(reading.document, reading.folder, reading.known_plugins)
    for kind, key, name, expected in faults:
        reading.fault(key, name, expected)
        reading.unread.add(section_of_settings(kind))
        if kind in NAMED_BY:
            reading.unread.add(NAMED_BY[kind].name)
    reading.plugins = tuple(plugins)
    reading.files.update({each.file: each.digest for each in plugins if each.file})


def _read_key(reading: Reading, section: str, key: str, value: Any) -> None:
    """Read a key of a section: a value, or a distribution."""
    path = f"{section}.{key}"
    parameter = reading.parameters.get(key)
    if parameter is None or parameter.section != section:
        if section in reading.unread and not section_of(key, reading.parameters):
            return
        if is_zip(value):
            reading.fault(path, value, "parameters that go together under [axes]")
        else:
            reading.unknown_key(section, key, [
                each.name for each in reading.parameters.values() if each.section == section])
        return
    reading.given.add(key)
    try:
        if isinstance(value, dict):
            reading.distributions[key] = parse_distribution(parameter, value)
        else:
            reading.fixed[key] = parameter.check(value)
    except TablesError as error:
        reading.faults += [f"{reading.source}: {path}{line}" for line in error.lines]
    except ValueError as error:
        if key not in reading.unread:
            axis = "; several values are an axis: they go under [axes]" if (
                isinstance(value, list) and tuple not in parameter.types) else ""
            reading.fault(path, value, f"{error}{axis}")


def _read_axes(reading: Reading) -> None:
    table = reading.document.get("axes", {})
    quota = MAX_LISTED
    for key, value in table.items() if isinstance(table, dict) else ():
        if key not in reading.parameters and key != TRIAL and is_zip(value):
            axis = _read_zip(reading, key, value["zip"], quota)
        else:
            axis = _read_axis(reading, key, value, quota)
        if axis is not None:
            reading.axes[key] = axis
            listed = [v for v in axis.columns.values() if not isinstance(v, range)]
            quota -= len(axis) * len(listed)


def _read_axis(reading: Reading, key: str, value: Any, quota: int, table: str = "") -> Axis | None:
    """Return the axis of one parameter, or note why there is none.

    Of a parameter that goes together with others, ``table`` is the name of their axis.
    """
    path = f"axes.{table}.{key}" if table else f"axes.{key}"
    try:
        if key == TRIAL and not table:
            return parse_trial(value)
        if key == TRIAL:
            reading.fault(path, value, "it as an axis of its own: every cell has the same trials")
        elif key in HEADER:
            reading.unknown_key("axes", key, ())
        elif key in reading.given:
            other = next((other for other in places(reading.document, reading.parameters[key])
                          if other != path), "it")
            reading.fault(path, value, f"it once: {other} is given too; delete one of them")
        elif key in reading.parameters:
            reading.given.add(key)
            return parse_axis(reading.parameters[key], value, quota, repeats=bool(table))
        elif isinstance(value, dict) and not value.keys().isdisjoint(("zip", *reading.parameters)):
            reading.fault(
                path, value, "parameters that go together as "
                "{ zip = { fx_px = [600, 800], fy_px = [600, 805] } }, with nothing beside zip",
            )
        elif not reading.unread:
            reading.unknown(path, "unknown parameter", key, [*reading.parameters, TRIAL])
    except ValueError as error:
        if key not in reading.unread:
            reading.fault(path, value, str(error))
    return None


def _read_zip(reading: Reading, key: str, members: dict[str, Any], quota: int) -> Axis | None:
    """Return the axis of parameters that go together, or note why there is none."""
    path = f"axes.{key}"
    if not key.isidentifier():
        reading.note(plain(path), "expected a name of letters, digits and underscores")
        return None
    columns: dict[str, Sequence[Any]] = {}
    quota //= max(len(members), 1)
    for name, value in members.items():
        axis = _read_axis(reading, name, value, quota, key)
        if axis is not None and len(axis) > quota:
            reading.fault(f"{path}.{name}", value, "at most 10^6 values, all axes together")
        elif axis is not None:
            columns[name] = axis.values
    if len(members) < 2:
        reading.fault(path, {"zip": members}, "at least two parameters that go together")
    if len(columns) < max(len(members), 2):
        return None
    try:
        return zipped_axis(key, columns, reading.parameters)
    except ValueError as error:
        reading.note(path, f"expected {error}")
        return None
