"""Values of one cell as lines of text, with the stored values beside them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.plan.variable import Variable
from sweep.report.formatting import coordinate

NAME_WIDTH, VALUE_WIDTH = 34, 44


def value_lines(
    variables: Sequence[Variable], recomputed: Mapping[str, NDArray[Any]],
    stored: Mapping[str, NDArray[Any]] | None,
) -> list[str]:
    """Return a line for each of the variables.

    Each has the recomputed value with its unit, and the stored value if that differs.
    """
    lines = []
    for variable in variables:
        value = recomputed[variable.name]
        text = _text(variable, value)
        line = f"  {variable.name:{NAME_WIDTH}} {text:{VALUE_WIDTH}} {variable.units}".rstrip()
        if stored is not None and variable.name in stored:
            line += _difference(variable, text, value, stored[variable.name])
        lines.append(line)
    return lines


def _difference(
    variable: Variable, text: str, value: NDArray[Any], stored: NDArray[Any]
) -> str:
    """Return a remark on the stored value; empty if it is the same."""
    stored_text = _text(variable, stored)
    if stored_text != text:
        return f"  (stored: {stored_text})"
    same = np.array_equal(value, stored, equal_nan=variable.flags is None)
    return "" if same else "  (stored: other last digits)"


MAX_NUMBERS = 12
"""Numbers of a variable that are written out; of more, as of boards' corners, a summary is."""


def _text(variable: Variable, value: NDArray[Any]) -> str:
    if variable.flags is not None:
        names = Counter(variable.flags(int(flag)).name for flag in np.ravel(value))
        return next(iter(names)) if np.ndim(value) == 0 else ", ".join(
            f"{count} {name}" for name, count in names.items())
    if value.size > MAX_NUMBERS:
        known = value[np.isfinite(value)]
        if not known.size:
            return f"{value.size} x nan"
        return (f"RMS {coordinate(float(np.sqrt(np.mean(known**2))))}, largest "
                f"{coordinate(float(np.abs(known).max()))} of {known.size} numbers")
    return " ".join(coordinate(float(number)) for number in value.ravel())
