"""The section [require] of a pipeline: what its results must fulfil.

It is no part of an experiment's identity: a store is continued, whatever is required of it. What a
requirement may be of is known to the analysis alone (`sweep.analysis.requirements`), which checks
the names.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from sweep.messages import shown
from sweep.plan.axes import TRIAL
from sweep.plan.parameters import Stage
from sweep.plan.reader import REQUIRE, Reading
from sweep.plan.requirement_text import RequirementText, read_requirement

KEYS = ("all", "per")
"""Texts that all must hold, and the axes whose values are conditions at which they must."""

BUDGET = "budget_ms"
"""What may be required beside quantities where a choice is made: the time of a frame."""


def read_required(reading: Reading) -> None:
    """Read the section, and note its faults; the axes have been read."""
    table = reading.document.get(REQUIRE, {})
    if not isinstance(table, dict):
        reading.fault(REQUIRE, table, f"a table: [{REQUIRE}]")
        return
    for key in table:
        if key not in KEYS:
            reading.unknown(f"{REQUIRE}.{key}", f"unknown key; expected {' or '.join(KEYS)}",
                            str(key), KEYS)
    texts = _strings(reading, table, "all", 'texts, such as ["detection >= 0.99"]')
    for text in texts:
        try:
            _read_budget(reading, read_requirement(text))
        except ValueError as error:
            reading.faults.append(f"{reading.source}: {REQUIRE}.all = {shown(text)}: {error}")
    if "per" in table and "all" not in table:
        reading.fault(REQUIRE, table, 'what is required, too: all = ["detection >= 0.99"]')
    names = _strings(reading, table, "per", 'names of axes, such as ["distance_m"]')
    for name in names:
        if problem := _no_condition(reading, name):
            reading.unknown(f"{REQUIRE}.per", f"{name}: {problem}", name, [*_conditions(reading)])
    reading.requirements = tuple(without_budget(texts))
    reading.require_per = tuple(dict.fromkeys(names))


def _read_budget(reading: Reading, given: RequirementText) -> None:
    """Note the budget, if a requirement is one; ValueError says what is wrong with it."""
    if given.name != BUDGET:
        return
    if "choose" not in reading.document:
        raise ValueError("is the time of a choice: give [choose], or use `sweep tradeoff "
                         "--budget-ms`")
    if given.relation not in ("<=", "<") or given.limit <= 0.0 or given.unit:
        raise ValueError(f"expected milliseconds of a frame: {BUDGET} <= 2")
    if reading.budget_ms is not None:
        raise ValueError("there is another budget; delete one")
    reading.budget_ms = given.limit


def without_budget(texts: Iterable[str]) -> list[str]:
    """Return the texts of requirements that are no budget.

    >>> without_budget(["detection >= 0.99", "budget_ms<=2"])
    ['detection >= 0.99']
    """
    def is_budget(text: str) -> bool:
        try:
            return read_requirement(text).name == BUDGET
        except ValueError:
            return False

    return [text for text in texts if not is_budget(text)]


def _strings(reading: Reading, table: dict[str, Any], key: str, expected: str) -> list[str]:
    value = table.get(key, [])
    if not isinstance(value, list) or not all(isinstance(each, str) for each in value) or (
        key == "all" and key in table and not value
    ):
        reading.fault(f"{REQUIRE}.{key}", value, f"a list of {expected}")
        return []
    return [str(each) for each in value]


def _no_condition(reading: Reading, name: str) -> str:
    """Return why a name is no condition; empty if it is one."""
    if name == TRIAL:
        return "intervals are over the draws; expected an axis of the scene"
    parameter = reading.parameters.get(name)
    if parameter is not None and parameter.stage is not Stage.scene:
        return "configurations are always told apart; expected an axis of the scene"
    if name not in _conditions(reading):
        return "no such axis"
    return ""


def _conditions(reading: Reading) -> Iterator[str]:
    """Yield the names that may be conditions, on this grid or on one that `--set` makes."""
    yield from (name for name in reading.axes if name != TRIAL)
    yield from (each.name for each in reading.parameters.values() if each.stage is Stage.scene)


def texts_in(document: Mapping[str, Any]) -> list[str]:
    """Return the requirements' texts of a document that may have faults elsewhere."""
    table = document.get(REQUIRE)
    listed = table.get("all") if isinstance(table, dict) else None
    return without_budget(
        each for each in listed if isinstance(each, str)) if isinstance(listed, list) else []
