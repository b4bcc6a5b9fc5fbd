"""A requirement as text: the name of a quantity, a relation, a number."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

RELATIONS = (">=", "<=", ">", "<")

_FORM = re.compile(
    r"\s*(?P<name>[A-Za-z_]\w*)\s*(?P<relation>[<>=!≥≤~]+)\s*"
    r"(?P<limit>[+-]?(?:\d[\d_]*\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(?P<unit>.*?)\s*", re.DOTALL)

_TYPED = {"≥": ">=", "≤": "<=", "=>": ">=", "=<": "<="}

EXPECTED = "expected NAME >= NUMBER or NAME <= NUMBER, in quotes, such as 'detection >= 0.95'"


@dataclass(frozen=True, slots=True)
class RequirementText:
    """The parts of a requirement's text.

    Attributes
    ----------
    name
        What is required of, as it was given.
    relation
        One of `RELATIONS`.
    limit
        The number.
    unit
        What stands behind the number; empty, if nothing does.
    """

    name: str
    relation: str
    limit: float
    unit: str = ""


def read_requirement(text: object) -> RequirementText:
    """Return the parts of a requirement's text.

    Raises
    ------
    ValueError
        What was expected, on one line.

    Examples
    --------
    >>> read_requirement("range_p95_percent <= 1")
    RequirementText(name='range_p95_percent', relation='<=', limit=1.0, unit='')
    """
    if not isinstance(text, str) or (form := _FORM.fullmatch(text)) is None:
        raise ValueError(EXPECTED)
    relation = _TYPED.get(form["relation"], form["relation"])
    if relation not in RELATIONS:
        raise ValueError(f"{form['relation']} is no relation of a requirement; "
                         f"there are {', '.join(RELATIONS)}")
    limit = float(form["limit"])
    if not math.isfinite(limit):
        raise ValueError("expected a finite number")
    return RequirementText(form["name"], relation, limit, form["unit"])
