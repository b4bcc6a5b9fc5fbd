"""What is wrong with requirements: names, units, limits, contradictions, a line each."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from sweep.analysis.quantiles import PERCENTS
from sweep.analysis.quantities import QUANTITIES, SIGNED
from sweep.analysis.requirable import Requirable, requirables
from sweep.messages import nearest, plain
from sweep.plan.requirement_text import RequirementText

UNITS = {"deg": "degrees", "rad": "radians", "m": "metres", "mm": "millimetres", "percent": "%",
         "px": "pixels", "cm": "centimetres"}
"""Units that names end with."""

STATISTICS = (*PERCENTS, "bias", "sd", "rmse")
"""What names of statistics of errors have in the middle."""

ENDINGS = ("_rate", "_mean")
"""Endings of names that may be left out."""


def named(name: str) -> Requirable:
    """Return what a name means.

    Raises
    ------
    ValueError
        If it is no such name.

    Examples
    --------
    >>> named("detection").name, named("range_error_p95_percent").name
    ('detection_rate', 'range_p95_percent')
    """
    known = requirables()
    short = re.sub("_errors?(?=_|$)", "", name.lower())
    for candidate in (short, *(f"{short}{ending}" for ending in ENDINGS)):
        if candidate in known:
            return known[candidate]
    head, _, tail = short.rpartition("_")
    stem = head if tail in UNITS else short
    same = [other for other in known if other.rpartition("_")[0] == stem]
    if same and (ending := same[0].rpartition("_")[2]) in UNITS:
        problem = f"its unit is {UNITS[ending]}: write {same[0]}"
        raise ValueError(problem)
    if f"{stem}_rate" in known:
        problem = f"is a share from 0 to 1: write {stem}_rate"
        raise ValueError(problem)
    if kinds := [other for other in known if other.startswith(f"{stem}_") and any(
            f"_{each}_" in other for each in STATISTICS)]:
        problem = f"which statistic of it? There are {', '.join(kinds)}"
        raise ValueError(problem)
    counted = {"looked_for", "detected", "count", "draws"}
    if short in counted:
        raise ValueError("is a count, which has no interval; expected a rate or an error")
    hint = nearest(short, [*known])
    raise ValueError(f"{name}: nothing of this name has an interval{hint}" + (
        "" if hint else f"; there are {', '.join(_examples())} and the other variables of "
        "error_statistics, in the guide sweep/analysis/README.md"))


def _examples() -> tuple[str, ...]:
    return ("detection_rate", "solved_rate", "flip_rate", "rotation_p95_deg", "range_p95_percent",
            "position_rmse_m", "yaw_bias_deg", "x_sd_m")


def fault_of(what: Requirable, given: RequirementText) -> str:
    """Return what is wrong with a limit and its unit; empty if nothing is."""
    limit, more = given.limit, given.relation in (">=", ">")
    if given.unit:
        return _wrong_unit(what, given)
    if what.is_rate and not 0.0 <= limit <= 1.0:
        share = f": write {limit / 100:g} for {limit:g} %" if 2.0 <= limit <= 100.0 else ""
        return f"a share is from 0 to 1{share}"
    if limit < 0.0:
        sign = " (of a bias the absolute value is required)" if what.signed else ""
        return f"{what.name} is never negative{sign}: expected a limit above 0"
    if limit > what.largest:
        return f"{what.name} is never above {what.largest:g} {what.units}"
    if more and limit == 0.0:
        return "holds always: expected a limit above 0"
    if not more and limit == what.largest:
        return f"holds always: expected a limit below {what.largest:g}"
    if more and what.is_rate and limit == 1.0:
        return "no number of draws can show a rate of 1: write 0.99, for instance"
    if not more and limit == 0.0:
        low = 0.01 if what.is_rate else None
        return "no number of draws can show 0: expected a limit above it" + (
            f", such as {low}" if low else "")
    return ""


def _wrong_unit(what: Requirable, given: RequirementText) -> str:
    if decimal := re.fullmatch(r",(\d+)", given.unit):
        return f"a comma in a number: write {given.limit:g}.{decimal[1]}"
    unit = "percent" if given.unit == "%" else given.unit
    if what.is_rate and unit == "percent":
        return f"the limit is a share from 0 to 1: write {given.limit / 100:g}"
    ending = what.name.rpartition("_")[2]
    words = f"in {UNITS[ending]}" if ending in UNITS else "without a unit"
    more = "; each requirement is a text of its own" if re.search(r"[<>≤≥]", unit) else ""
    return f"{plain(given.unit)} after the limit: expected the number alone, {words}{more}"


@dataclass(frozen=True, slots=True)
class Side:
    """One side of what a variable may be: at least a limit, or at most."""

    text: str
    variable: str
    at_least: bool
    limit: float


def contradictions(given: Sequence[Side]) -> list[tuple[str, str]]:
    """Return the requirements that cannot hold together, each as its text and a line.

    What is implied counts: a median is at most the 95 % quantile, a solved pose was detected, and
    where a 95 % quantile is finite, 95 % of the poses were solved.
    """
    faults = []
    for number, side in enumerate(given):
        if any((side.variable, side.at_least) == (other.variable, other.at_least)
               for other in given[:number]):
            faults.append((side.text, f"{side.variable} has another such limit; delete one"))
    solved = [Side(side.text, "solved_rate", at_least=True, limit=share / 100.0) for side in given
              if not side.at_least and (share := requirables()[side.variable].percent)]
    for least in (*(side for side in given if side.at_least), *solved):
        for most in given:
            if most.at_least or least.limit < most.limit:
                continue
            if (least.variable, most.variable) in ORDERED or least.variable == most.variable:
                faults.append((least.text, f"contradicts {most.text}: no result can be both"))
    return faults


def _ordered() -> frozenset[tuple[str, str]]:
    pairs = {("solved_rate", "detection_rate")}
    for quantity in (*QUANTITIES, *(each for group in SIGNED.values() for each in group)):
        names = [quantity.named(each) for each in PERCENTS]
        pairs |= {(a, b) for k, a in enumerate(names) for b in names[k + 1 :]}
        pairs.add((quantity.named("bias"), quantity.named("rmse_unflipped")))
    return frozenset(pairs)


ORDERED = _ordered()
"""Names of which the first's value is never above the second's."""
