"""Values of one cell as lines of text, with the stored values beside them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from sweep.plan.schema import SCHEMA, Variable

NAME_WIDTH, VALUE_WIDTH = 34, 44


def value_lines(
    here: Mapping[str, NDArray[Any]], stored: Mapping[str, NDArray[Any]] | None
) -> list[str]:
    """Return a line for each variable: its value here, its unit, and the store's if it differs."""
    lines = []
    for variable in SCHEMA:
        value = here[variable.name]
        line = f"  {variable.name:{NAME_WIDTH}} {_text(variable, value):{VALUE_WIDTH}}"
        line += f" {variable.units}"
        if stored is not None and value.tobytes() != stored[variable.name].tobytes():
            there = _text(variable, stored[variable.name])
            if there != _text(variable, value):
                line = f"{line.rstrip()}  (stored: {there})"
            elif not ((value != value) & (stored[variable.name] != stored[variable.name])).all():  # noqa: PLR0124
                line = f"{line.rstrip()}  (stored: other last digits)"
        lines.append(line.rstrip())
    return lines


def _text(variable: Variable, value: NDArray[Any]) -> str:
    if variable.flags is not None:
        return str(variable.flags(int(value)).name)
    return " ".join(f"{number:.6g}" for number in value.ravel().tolist())
