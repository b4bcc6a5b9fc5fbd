"""One parameter of an experiment, declared once: a dataclass field with unit, range and meaning."""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Declaration:
    """The declaration of a parameter: meaning, unit, allowed values.

    ``low`` and ``high`` are inclusive unless ``open_low`` excludes the lower end. ``drawable``
    parameters may be drawn from a distribution per trial. ``lengths`` are those that a list of
    numbers may have, ``list_text`` says so in words. ``plugin`` is the kind of plug-in that may be
    named in place of a choice.
    """

    meaning: str
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    open_low: bool = False
    choices: tuple[str, ...] = ()
    prefix: str = ""
    numbers: tuple[tuple[str, int], ...] = ()
    drawable: bool = False
    lengths: tuple[int, ...] = ()
    list_text: str = ""
    plugin: str = ""

    def range_text(self) -> str:
        """Return the allowed values in words, as error messages and the reference print them."""
        if self.choices:
            return "one of " + ", ".join(self.choices)
        low, high = f"{self.low:g}", f"{self.high:g}"
        if math.isfinite(self.low) and math.isfinite(self.high):
            return f"above {low} and at most {high}" if self.open_low else f"from {low} to {high}"
        if math.isfinite(self.low):
            return f"above {low}" if self.open_low else f"at least {low}"
        if math.isfinite(self.high):
            return f"at most {high}"
        return ""

    def choice(self, word: str) -> str | None:
        """Return the choice that a word names, however OpenCV or the user spells it, or None.

        Letters' cases do not count, nor do the module and the prefix of OpenCV's names.

        Examples
        --------
        >>> solver = Declaration("", choices=("ippe", "ippe_square"), prefix="SOLVEPNP_")
        >>> solver.choice("cv2.SOLVEPNP_IPPE_SQUARE"), solver.choice("Ippe"), solver.choice("p3p")
        ('ippe_square', 'ippe', None)
        """
        if word in self.choices:
            return word
        bare = self._bare(word.strip().replace("::", ".").rpartition(".")[2])
        return next((choice for choice in self.choices if self._bare(choice) == bare), None)

    def _bare(self, word: str) -> str:
        return word.casefold().removeprefix(self.prefix.casefold())

    def of_number(self, number: int) -> str:
        """Return the choice that OpenCV has a number for; empty if there is none."""
        return next((name for name, constant in self.numbers if constant == number), "")

    def admits(self, number: float) -> bool:
        """Return whether a finite number lies in the declared range."""
        above = number > self.low if self.open_low else number >= self.low
        return above and number <= self.high and abs(number) < 1e300


def parameter(default: Any, meaning: str, **declared: Any) -> Any:
    """Return a dataclass field that carries its :class:`Declaration` (keywords as its fields)."""
    declaration = Declaration(meaning, **declared)
    return dataclasses.field(default=default, metadata={"declaration": declaration})


def plain_types(hint: Any) -> tuple[type, ...]:
    """Return the plain types of an annotation, without None.

    >>> plain_types(float | None), plain_types(tuple[float, ...])
    ((<class 'float'>,), (<class 'tuple'>,))
    """
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
        kinds = [plain_types(part) for part in typing.get_args(hint) if part is not type(None)]
        return tuple(kind for group in kinds for kind in group)
    return (typing.get_origin(hint) or hint,)
