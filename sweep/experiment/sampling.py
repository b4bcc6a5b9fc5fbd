"""The sections that control sampling: what is required of results, and what is searched."""

from __future__ import annotations

import json
import math
import operator
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sweep.experiment.axes import TRIAL, Axis, parse_trial
from sweep.experiment.draws import SAMPLINGS
from sweep.experiment.parameters import Stage
from sweep.experiment.reader import REQUIRE, Reading
from sweep.experiment.stopping import CHOICES, KINDS, SEARCH, StoppingRule
from sweep.messages import shown

# --------------------------------------------------------------------------------------------------
# A requirement as text: the name of a quantity, a relation, a number.

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


# --------------------------------------------------------------------------------------------------
# Keys of the sections: lists of texts, names of axes of the scene.

def unknown_keys(
    reading: Reading, section: str, table: Mapping[str, Any], known: Sequence[str]
) -> None:
    """Note the keys that a section does not have."""
    for key in table:
        if key not in known:
            reading.unknown_key(section, str(key), known, f"; expected {', '.join(known)}")


def texts(
    reading: Reading, section: str, table: Mapping[str, Any], key: str, example: str,
    *, needed: bool = False,
) -> list[str]:
    """Return a key's list of texts, which is not empty if it is ``needed``, or note a fault."""
    value = table.get(key, [])
    if isinstance(value, list) and all(isinstance(text, str) for text in value) and (
            value or not needed):
        return [str(text) for text in value]
    reading.fault(f"{section}.{key}", value, f"a list of texts, such as {example}")
    return []


def scene_axes(reading: Reading) -> list[Axis]:
    """Return the axes of the scene without ``trial``: those whose values can be conditions."""
    return [axis for axis in reading.axes.values()
            if axis.stage is Stage.scene and axis.name != TRIAL]


def axis_at(reading: Reading, path: str, name: str, *, scene: bool = True) -> Axis | None:
    """Return an axis, of the scene or any but ``trial``, by name, or note why there is none."""
    axis, together = reading.axes.get(name), reading.axis_of(name)
    if name == TRIAL:
        problem = "trials are what is counted"
    elif axis is not None and scene and axis.stage is not Stage.scene:
        problem = "each configuration has its own answer"
    elif axis is not None:
        return axis
    elif together is not None:
        problem = f"it goes with others along the axis {together.name}"
    elif name in reading.distributions:
        problem = f"it is drawn for each trial: give {name} values under [axes]"
    elif reading.names_axis(name):
        return None  # its own fault says why it is none
    elif name in reading.parameters:
        problem = f"it has one value: list the values of {name} under [axes]"
    else:
        known = scene_axes(reading) if scene else reading.axes.values()
        reading.unknown(path, f"{name}: no such axis", name, [axis.name for axis in known])
        return None
    where = "of the scene" if scene else "of the grid"
    reading.unknown(path, f"{name}: {problem}; expected an axis {where}", name, ())
    return None


def ordered_axis(reading: Reading, path: str, name: Any) -> str:
    """Return the name of a scene axis of several numbers; "" with a fault noted if it is none."""
    if not isinstance(name, str) or not name:
        reading.fault(path, name, "the axis that is searched, such as distance_m")
        return ""
    if (axis := axis_at(reading, path, name)) is None:
        return ""
    if axis.labelled or isinstance(axis.values[0], bool):
        reading.fault(path, name, f"an axis of numbers; {name} has no order")
    elif len(axis) < 2:
        reading.fault(path, name, f"an axis of several values, from easy to hard; {name} has one")
    else:
        return name
    return ""


def conditions(
    reading: Reading, table: Mapping[str, Any], along: str
) -> tuple[str, ...]:
    """Return the scene axes that ``per`` lists, in the grid's order; the others' faults are noted.

    All but the axis ``along`` by default. A fixed parameter is a condition of one value.
    """
    path, axes = f"{SEARCH}.per", [axis.name for axis in scene_axes(reading)]
    if "per" not in table:
        return tuple(name for name in axes if name != along)
    names = dict.fromkeys(texts(reading, SEARCH, table, "per", '["distance_m"]'))
    for name in names:
        if along and name == along:
            reading.fault(path, name, f"other axes than {along}, which is searched along")
        elif name not in reading.fixed or reading.parameters[name].stage is not Stage.scene:
            axis_at(reading, path, name)
    return tuple(name for name in axes if name in names and name != along)


# --------------------------------------------------------------------------------------------------
# The section [require] of a pipeline: what its results must fulfil.
#
# It is no part of an experiment's identity: a store is continued, whatever is required of it.
# What a requirement may be of is known to the analysis alone (`sweep.analysis.requirements`),
# which checks the names.

REQUIRE_KEYS = ("all", "per")
"""Texts that all must hold, and the axes whose values are conditions at which they must."""

BUDGET = "budget_ms"
"""What may be required beside quantities where a choice is made: the time of a frame."""


def read_required(reading: Reading) -> None:
    """Read the section, and note its faults; the axes have been read."""
    table = reading.document.get(REQUIRE, {})
    if not isinstance(table, dict):
        reading.fault(REQUIRE, table, f"a table: [{REQUIRE}]")
        return
    unknown_keys(reading, REQUIRE, table, REQUIRE_KEYS)
    required = texts(reading, REQUIRE, table, "all", '["detection >= 0.99"]', needed="all" in table)
    for text in required:
        try:
            _read_budget(reading, read_requirement(text))
        except ValueError as error:
            reading.faults.append(f"{reading.source}: {REQUIRE}.all = {shown(text)}: {error}")
    if "per" in table and "all" not in table:
        reading.fault(REQUIRE, table, 'what is required, too: all = ["detection >= 0.99"]')
    names = texts(reading, REQUIRE, table, "per", '["distance_m"]')
    for name in names:
        if problem := _no_condition(reading, name):
            reading.unknown(f"{REQUIRE}.per", f"{name}: {problem}", name, [*_conditions(reading)])
    reading.requirements = tuple(without_budget(required))
    reading.require_per = tuple(dict.fromkeys(names))


def _read_budget(reading: Reading, given: RequirementText) -> None:
    """Note the budget, if a requirement is one; ValueError says what is wrong with it."""
    if given.name != BUDGET:
        return
    search = reading.document.get(SEARCH)
    if not isinstance(search, dict) or not any(key in search for key in CHOICES):
        raise ValueError("is the time of a choice: give [search] smallest, largest or cheapest, "
                         "or use `sweep tradeoff --budget-ms`")
    if given.relation not in ("<=", "<") or given.limit <= 0.0 or given.unit:
        raise ValueError(f"expected milliseconds of a frame: {BUDGET} <= 2")
    if reading.budget_ms is not None:
        raise ValueError("there is another budget; delete one")
    reading.budget_ms = given.limit


def without_budget(required: Iterable[str]) -> list[str]:
    """Return the texts of requirements that are no budget.

    >>> without_budget(["detection >= 0.99", "budget_ms<=2"])
    ['detection >= 0.99']
    """
    def is_budget(text: str) -> bool:
        try:
            return read_requirement(text).name == BUDGET
        except ValueError:
            return False

    return [text for text in required if not is_budget(text)]


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


# --------------------------------------------------------------------------------------------------
# The section [search]: trials come in waves until it is known
#
# - how far `along` an axis the section [require] is met, for each combination of `per`,
# - the `smallest` or `largest` value of an axis, or the `cheapest` configuration, that meets it at
#   all conditions, `among` further choices, or
# - a `precision`: the half-width of the intervals of quantities, at each combination of `per`.
#
# Conditions at all of which requirements must hold are [require] per. Names of quantities are known
# to the analysis alone; the rules that sample (`sweep.sampling.searches`) check them.

MAX_TRIALS = "max_trials"
"""The key with the most trials, the length of the axis ``trial``."""

SEARCH_KEYS = (*KINDS, "per", "among", MAX_TRIALS)

MIN_TRIALS = 2
"""The fewest that make an interval."""

NO_TRIALS = f"{MAX_TRIALS}, too: the most trials of a condition"
"""What is expected where nothing says how many trials there are at most."""

FIRST_DRAWS = 50
"""Draws of a condition in the first wave, about: all pooled cells together."""

COARSE_DRAWS = 40
"""The same of a value of the axis along which a limit is searched."""

_PERCENT = re.compile(r"\s*([0-9]+(?:\.[0-9]*)?|\.[0-9]+)\s*%\s*")


def read_stopping(reading: Reading) -> None:
    """Read the section, if there is one, and make the axis ``trial``; the axes have been read."""
    table = reading.document.get(SEARCH)
    if table is None:
        return
    if not isinstance(table, dict):
        reading.fault(SEARCH, table, f"a table: [{SEARCH}]")
        return
    _read_trials(reading, table)
    if reading.sampling != SAMPLINGS[0]:
        reading.fault(
            "sampling", reading.sampling,
            f"{SAMPLINGS[0]} beside [{SEARCH}]: points that are spread evenly over all trials say "
            "nothing of the first ones",
        )
    if TRIAL in reading.axes and len(reading.axes[TRIAL]) < MIN_TRIALS:
        reading.fault(f"{SEARCH}.{MAX_TRIALS}", len(reading.axes[TRIAL]),
                      f"at least {MIN_TRIALS}: intervals are over the draws")
    reading.stopping = _read_search(reading, table)


def _read_trials(reading: Reading, table: Mapping[str, Any]) -> None:
    """Make the axis of trials from ``max_trials``, or take the one that is given."""
    given = reading.axes.get(TRIAL)
    if MAX_TRIALS not in table:
        if given is None and not reading.names_axis(TRIAL):
            reading.fault(SEARCH, dict(table), NO_TRIALS)
        return
    try:
        axis = parse_trial(table[MAX_TRIALS])
    except ValueError as error:
        reading.fault(f"{SEARCH}.{MAX_TRIALS}", table[MAX_TRIALS], str(error))
        return
    if given is None:
        reading.axes[TRIAL] = axis
    elif len(given) != len(axis):
        reading.fault(
            f"{SEARCH}.{MAX_TRIALS}", table[MAX_TRIALS],
            f"{len(given)}, which axes.trial has, or axes.trial to be left out",
        )


def _read_search(reading: Reading, table: Mapping[str, Any]) -> StoppingRule | None:
    """Return what is searched; None if the section has faults, which are noted."""
    known = len(reading.faults)
    unknown_keys(reading, SEARCH, table, SEARCH_KEYS)
    kinds = [kind for kind in KINDS if kind in table]
    if len(kinds) != 1:
        found = f", not {' and '.join(kinds)}" if kinds else ""
        reading.fault(SEARCH, dict(table), f"one of {', '.join(KINDS)}{found}")
        return None
    kind, = kinds
    precision = _precision(reading, table["precision"]) if kind == "precision" else ()
    along = ordered_axis(reading, f"{SEARCH}.{kind}", table[kind]) if kind in (
        "along", "smallest", "largest") else ""
    axes = {axis.name: len(axis) for axis in scene_axes(reading)}
    if kind == "cheapest" and table[kind] is not True:
        reading.fault(f"{SEARCH}.{kind}", table[kind], "true")
    if kind in CHOICES:
        among = _among(reading, table, along)
        if not along and math.prod(len(reading.axes[name]) for name in among) < 2:
            reading.fault(SEARCH, dict(table), (
                'something to choose: smallest = "size_m", with its values under [axes], or '
                'among = ["solver"], of which the cheapest is chosen'))
        if "per" in table:
            reading.fault(f"{SEARCH}.per", table["per"],
                          f"conditions under [{REQUIRE}] per, where something is chosen")
        per: tuple[str, ...] = ()
    else:
        among = ()
        if "among" in table:
            reading.fault(f"{SEARCH}.among", table["among"],
                          f"it beside {', '.join(CHOICES)} alone")
        per = conditions(reading, table, along)
    requirements: tuple[str, ...] = ()
    at_all: tuple[str, ...] = ()
    if kind != "precision":
        requirements, wanted = _required(reading, {*among, along} if kind in CHOICES else set())
        if kind in CHOICES:
            at_all = tuple(name for name in axes if name not in (*among, along) and (
                wanted is None or name in wanted))
        else:
            given = per if "per" in table else ()
            at_all = tuple(name for name in axes if name in (wanted or ())
                           and name not in (*given, along))
            per = tuple(name for name in per if name not in at_all)
    if len(reading.faults) > known or TRIAL not in reading.axes:
        return None
    pooled = math.prod(length for name, length in axes.items()
                       if name not in (*per, *at_all, *among, along))
    trials = len(reading.axes[TRIAL])
    draws = COARSE_DRAWS if kind == "along" else FIRST_DRAWS
    return StoppingRule(kind, trials, min(max(2, math.ceil(draws / pooled)), trials), along, among,
                        per, at_all, requirements, precision)


def _precision(reading: Reading, value: Any) -> tuple[tuple[str, float], ...]:
    """Return the half-widths of quantities, or note why they are none."""
    path = f"{SEARCH}.precision"
    if not isinstance(value, dict) or not value:
        reading.fault(path, value,
                      "how well quantities are to be known, such as { detection_rate = 0.02 }")
        return ()
    for name in value.keys() & reading.parameters.keys():
        reading.unknown_key(path, name, ())
    return tuple(sorted(
        (str(name), width) for name, written in value.items() if name not in reading.parameters
        and (width := _half_width(reading, f"{path}.{name}", written)) is not None))


def _half_width(reading: Reading, path: str, value: Any) -> float | None:
    """Return the half-width that a value says, or note why it is none."""
    percent = _PERCENT.fullmatch(value) if isinstance(value, str) else None
    number = float(percent[1]) / 100 if percent else value
    if isinstance(number, bool) or not isinstance(number, (int, float)) or not 0 < number < 1:
        reading.fault(
            path, value,
            'the half-width of an interval, such as 0.02 or "5 %", above 0 and below 1',
        )
        return None
    return float(number)


def _among(reading: Reading, table: Mapping[str, Any], along: str) -> tuple[str, ...]:
    """Return the axes of alternatives, those of configurations among them, in the grid's order."""
    path = f"{SEARCH}.among"
    names = texts(reading, SEARCH, table, "among", '["dictionary", "solver"]')
    if along and along in names:
        reading.fault(path, names, f"{along} once: it is sought along already")
    chosen = {axis.name for name in names
              if name != along and (axis := axis_at(reading, path, name, scene=False)) is not None}
    return tuple(axis.name for axis in reading.axes.values() if axis.name != TRIAL and (
        axis.name in chosen or axis.stage is not Stage.scene))


def _required(
    reading: Reading, chosen: set[str]
) -> tuple[tuple[str, ...], list[str] | None]:
    """Return the requirements and the conditions (None without); others note their faults."""
    table = reading.document.get(REQUIRE)
    table = table if isinstance(table, dict) else {}
    required, per = texts_in(reading.document), table.get("per")
    if not required:
        reading.faults.append(
            f"{reading.source}: {SEARCH}: expected what must be met: [{REQUIRE}] "
            'all = ["detection >= 0.99"]')
    if not isinstance(per, list):
        return tuple(required), None
    names = [name for name in per if isinstance(name, str)]
    for name in chosen.intersection(names):
        reading.fault(f"{REQUIRE}.per", per, f"conditions; {name} is what [{SEARCH}] chooses")
    return tuple(required), names


def search_settings(
    require: Sequence[str] = (), along: str = "", per: Sequence[str] | None = None,
    at_all: Sequence[str] | None = None, max_trials: int | None = None,
) -> list[str]:
    """Return a search along an axis as settings of the sections, as ``--set`` takes them.

    >>> search_settings(["detection >= 0.9"], "distance_m", max_trials=600)
    ['require.all=["detection >= 0.9"]', 'search.along="distance_m"', 'search.max_trials=600']
    """
    given = {
        f"{REQUIRE}.all": _listed(require) or None, f"{SEARCH}.along": along or None,
        f"{SEARCH}.per": None if per is None else _listed(per),
        f"{REQUIRE}.per": None if at_all is None else _listed(at_all),
        f"{SEARCH}.{MAX_TRIALS}": max_trials,
    }
    return [f"{key}={json.dumps(value, ensure_ascii=False, default=_whole)}"
            for key, value in given.items() if value is not None]


def _listed(texts: Sequence[str]) -> list[str]:
    return [texts] if isinstance(texts, str) else list(texts)


def _whole(value: Any) -> int | str:
    """Return a whole number of NumPy's; of anything else its text, which is refused as such."""
    return operator.index(value) if hasattr(value, "__index__") else str(value)
