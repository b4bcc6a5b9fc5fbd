"""A value that users write, declared once: a dataclass field with unit, range and meaning.

Keys of tables are checked against the fields that declare them: of pipelines, of boards' files and
of the tables in them, of plug-ins' settings.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Mapping
from typing import Any, get_args, get_origin, get_type_hints

from sweep.messages import letters_of, nearest, plain, shown


@dataclasses.dataclass(frozen=True)
class Declared:
    """The declaration of a value: name, types, default, meaning, unit, allowed values.

    ``types`` are the value's without None; ``default`` is MISSING if it must be given.
    ``low`` and ``high`` are inclusive unless ``open_low`` excludes the lower end. ``drawable``
    parameters may be drawn from a distribution per trial. Numbers that are ``choices`` are all that
    there are; beside words, any number is allowed. ``lengths`` are those that a list of
    numbers may have, ``list_text`` says so in words. ``plugin`` is the kind of plug-in that may be
    named in place of a choice. ``abbreviated`` choices are known by their number and the letters
    before it, such as ``36h11`` and ``tag36h11`` of ``DICT_APRILTAG_36h11``. ``reads`` returns a
    value that is no choice in its type, or raises ValueError with what was expected, in place of
    the checks by type.
    """

    name: str
    types: tuple[type, ...]
    default: Any
    meaning: str
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    open_low: bool = False
    choices: tuple[Any, ...] = ()
    prefix: str = ""
    drawable: bool = False
    lengths: tuple[int, ...] = ()
    list_text: str = ""
    plugin: str = ""
    abbreviated: bool = False
    reads: Callable[[Any], Any] | None = None

    def range_text(self) -> str:
        """Return the allowed values in words, as error messages and the reference print them."""
        if self.choices:
            return "one of " + ", ".join(map(str, self.choices))
        # Whole bounds with all their digits: 2**63 - 1 is no round number.
        low, high = (f"{each:{'d' if isinstance(each, int) else 'g'}}"
                     for each in (self.low, self.high))
        above = f"{'above' if self.open_low else 'at least'} {low}"
        if math.isinf(self.low) or math.isinf(self.high):
            return above * math.isfinite(self.low) + f"at most {high}" * math.isfinite(self.high)
        return f"{above} and at most {high}" if self.open_low else f"from {low} to {high}"

    def choice(self, word: str) -> str | None:
        """Return the choice that a word names, however OpenCV or the user spells it, or None.

        Letters' cases do not count, nor do the module and the prefix of OpenCV's names. The empty
        word is one where it is the default.

        Examples
        --------
        >>> solver = Declared("solver", (str,), "ippe", "", choices=("ippe", "ippe_square"),
        ...                   prefix="SOLVEPNP_")
        >>> solver.choice("cv2.SOLVEPNP_IPPE_SQUARE"), solver.choice("Ippe"), solver.choice("p3p")
        ('ippe_square', 'ippe', None)
        """
        if word in self.choices or word == self.default == "":
            return word
        prefix = letters_of(self.prefix)
        wanted = letters_of(word.replace("::", ".").rpartition(".")[2]).removeprefix(prefix)
        spelled = {letters_of(choice).removeprefix(prefix): choice for choice in self.choices}
        # The one choice that is so, or that ends so, with its number whole.
        ends = self.abbreviated and not re.fullmatch("[a-z]*|[0-9]*", wanted)
        found = [each for each in spelled if re.fullmatch(f"{'[a-z]*' * ends}{wanted}", each)]
        return spelled[found[0]] if len(found) == 1 else None

    def admits(self, number: float) -> bool:
        """Return whether a finite number lies in the declared range, and is a choice."""
        numbers = [each for each in self.choices if not isinstance(each, str)] or [number]
        above = number > self.low if self.open_low else number >= self.low
        return above and number <= self.high and abs(number) < 1e300 and number in numbers

    def expected(self) -> str:
        """Return the allowed values in words."""
        if tuple in self.types:
            *counts, last = self.lengths or (0,)
            return self.list_text or (
                f"a list of {', '.join(map(str, counts))} or {last} finite numbers below 1e300")
        words = {float: "a number", int: "a whole number", bool: "true or false", str: "a string"}
        # A number last: the range behind it is its own.
        kind = "" if self.choices else " or ".join(words[kind] for kind in reversed(self.types))
        return f"{kind} {self.range_text()}".strip()

    def check(self, value: Any) -> Any:
        """Return ``value`` in the field's type; ValueError(expectation) if not allowed."""
        if self.reads is not None and value not in self.choices:
            return self.reads(value)
        match value:
            case bool():  # it is an int, too
                if bool in self.types:
                    return value
            case str() if str in self.types and (
                    word := self.choice(value) if self.choices or not value else value) is not None:
                return word
            case list() | tuple() if len(value) in self.lengths and all(map(_is_number, value)):
                return tuple(map(float, value))
            case int() if int in self.types and self.admits(value):
                return value
            case int() | float() if float in self.types and self.admits(value):
                return float(value)
        word = value.removeprefix(self.prefix) if isinstance(value, str) else ""
        raise ValueError(f"{self.expected()}{nearest(word, [*map(str, self.choices)])}")


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e300


#: Ending of a field's name -> its unit, unless it declares another one; the first that fits.
UNITS = {
    "_m_s": "m/s", "_deg_s": "degree/s", "_per_m": "1/m", "_px": "px", "_mm": "mm", "_um": "um",
    "_deg": "degree", "_s": "s", "_m": "m", "_e": "e-", "_modules": "module",
}


def parameter(
    default: Any, meaning: str, low: float = -math.inf, high: float = math.inf, **declared: Any
) -> Any:
    """Return a dataclass field that carries its :class:`Declared` (keywords as its fields)."""
    declaration = Declared("", (), default, meaning, low=low, high=high, **declared)
    return dataclasses.field(default=default, metadata={"declaration": declaration})


def drawn(default: Any, meaning: str, low: float, high: float = math.inf, **declared: Any) -> Any:
    """As :func:`parameter`, of a number that may be drawn from a distribution per trial."""
    return parameter(default, meaning, low, high, drawable=True, **declared)


def declared_fields(declaring: type) -> dict[str, Declared]:
    """Return the fields that a dataclass declares, by name."""
    hints, declared = get_type_hints(declaring), {}
    for field in dataclasses.fields(declaring):
        declaration = field.metadata["declaration"]
        unit = declaration.unit or next(
            (unit for end, unit in UNITS.items() if field.name.endswith(end)), "")
        kinds = tuple(get_origin(each) or each  # tuple[float, ...] is a tuple
                      for each in get_args(hints[field.name] | None) if each is not type(None))
        default = (float(field.default) if kinds == (float,) and type(field.default) is int
                   else field.default)
        declared[field.name] = dataclasses.replace(
            declaration, name=field.name, types=kinds, default=default, unit=unit)
    return declared


class TablesError(ValueError):
    """Faults of several tables: lines that begin with what follows the name of the tables."""


def check_table(
    declared: Mapping[str, Declared], table: Mapping[str, Any], owner: str
) -> tuple[dict[str, Any], list[str]]:
    """Return the values of a table's keys, defaults included, and a line for each fault.

    ``owner`` says in messages what has the keys.
    """
    values = {name: each.default for name, each in declared.items()}
    lines = []
    for key, value in table.items():
        if key not in declared:
            lines.append(
                f"{plain(key)}: unknown; expected a key of {owner}: {', '.join(declared)}"
                f"{nearest(key, declared)}"
            )
            continue
        try:
            values[key] = declared[key].check(value)
        except TablesError as faults:
            lines += [f"{key}{line}" for line in faults.args]
        except ValueError as error:
            lines.append(f"{plain(key)} = {shown(value)}: expected {error}")
    lines += [
        f"{name}: missing; expected {each.expected()}: {each.meaning}"
        for name, each in declared.items()
        if each.default is dataclasses.MISSING and name not in table
    ]
    return values, lines
