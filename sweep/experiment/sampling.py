"""The sections that control sampling: what is required of results, and what is searched."""

from __future__ import annotations

import dataclasses
import json
import math
import operator
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from typing import Any

from sweep.declaration import TablesError
from sweep.experiment.axes import TRIAL, Axis, parse_trial
from sweep.experiment.document import REQUIRE, SEARCH, Reading
from sweep.experiment.draws import SAMPLINGS
from sweep.experiment.parameters import Stage
from sweep.messages import plain, shown

# --------------------------------------------------------------------------------------------------
# Numbers of trials at which waves end: after each, it is decided what else is needed.

GROWTH = 4
"""A wave has about one trial for so many of those before it, at least one unit."""


def wave_ends(max_trials: int, unit: int) -> tuple[int, ...]:
    """Return the numbers of trials at which waves end: multiples of a unit, and ``max_trials``.

    Examples
    --------
    >>> wave_ends(600, 50)
    (50, 100, 150, 200, 250, 350, 450, 600)
    >>> wave_ends(30, 50), wave_ends(120, 50)
    ((30,), (50, 100, 120))
    """
    ends: list[int] = []
    end = unit
    while end < max_trials:
        ends.append(end)
        end += unit * max(1, math.ceil(end / unit / GROWTH))
    return (*ends, max_trials)


# --------------------------------------------------------------------------------------------------
# What a search is for. None of it is part of the identity of a cell: the draws of a trial depend
# on its number alone, and a search decides only which trials are computed.

CHOICES = ("smallest", "largest", "cheapest")
KINDS = ("along", *CHOICES, "precision")
"""Keys that say what is searched, one in a section."""


@dataclass(frozen=True, slots=True)
class StoppingRule:
    """Trials come in waves until what is searched is known.

    Attributes
    ----------
    kind
        One of `KINDS`: how far along an axis requirements are met, the smallest or largest value
        of an axis or the cheapest configuration that meets them, or intervals of a width.
    max_trials
        The most trials of a condition; the length of the axis ``trial``.
    unit
        Trials of every cell in the first wave.
    along
        The scene axis that is searched along; empty for the cheapest, and for a precision.
    among
        The axes of which every combination of values, an alternative, is a choice of its own.
    per
        The scene axes of which every combination of values has an answer of its own: a limit, or a
        precision. What stands in none of ``along``, ``among``, ``per``, ``at_all`` is pooled.
    at_all
        The scene axes at every combination of whose values the requirements must hold.
    requirements
        What must hold, as texts; without a budget, which no trial decides.
    precision
        Name of each quantity, and the half-width of its interval: of a rate as it is, else
        relative to the value.
    """

    kind: str
    max_trials: int
    unit: int
    along: str = ""
    among: tuple[str, ...] = ()
    per: tuple[str, ...] = ()
    at_all: tuple[str, ...] = ()
    requirements: tuple[str, ...] = ()
    precision: tuple[tuple[str, float], ...] = ()

    @property
    def is_choice(self) -> bool:
        """Whether something is chosen."""
        return self.kind in CHOICES

    @property
    def largest(self) -> bool:
        """Whether the largest value of the axis is chosen."""
        return self.kind == "largest"

    @property
    def ends(self) -> tuple[int, ...]:
        """Numbers of trials at which waves end, and decisions are made."""
        return wave_ends(self.max_trials, self.unit)

    def looser(self, begun: StoppingRule) -> str:
        """Return why a store that was begun under another rule cannot be continued.

        Empty if this rule asks for at least as much of every condition, so that nothing that was
        computed is in vain.
        """
        ours = dict(self.precision)
        for field in dataclasses.fields(self):
            here, there = getattr(self, field.name), getattr(begun, field.name)
            if here != there and field.name != "precision":
                return (f"{SEARCH}.{field.name}: the store has {_text(there)}, "
                        f"this run {_text(here)}")
        for name, width in begun.precision:
            if ours.get(name, math.inf) > width:
                own = f"{ours[name]:g}" if name in ours else "none"
                return (f"{SEARCH}.precision.{name}: the store has {width:g}, this run {own}, "
                        "which is looser")
        return ""


def _text(value: Any) -> str:
    return (", ".join(value) or "none") if isinstance(value, tuple) else str(value)


def digest_of(rule: StoppingRule) -> str:
    """Return what tells a rule from others: receipts hold it.

    >>> digest_of(StoppingRule("precision", 2400, 50, precision=(("detection_rate", 0.02),)))
    'db369f7a'
    """
    return sha256(json.dumps(dataclasses.asdict(rule), sort_keys=True).encode()).hexdigest()[:8]


def not_continued(ours: StoppingRule | None, begun: StoppingRule | None) -> str:
    """Return why a run cannot continue a store begun under another rule; empty if it can."""
    if ours == begun:
        return ""
    if ours is None or begun is None:
        names: Sequence[str] = [f"[{SEARCH}]" if rule is not None else "a fixed number of trials"
                                for rule in (begun, ours)]
        return f"trials: the store has {names[0]}, this run {names[1]}"
    return ours.looser(begun)


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
# Keys of the sections, each with what reads its value, or raises ValueError with what is expected.

BUDGET = "budget_ms"
"""What may be required beside quantities where a choice is made: the time of a frame."""

MAX_TRIALS = "max_trials"
"""The key with the most trials, the length of the axis ``trial``."""

NO_TRIALS = f"{MAX_TRIALS}, too: the most trials of a condition"
"""What is expected where nothing says how many trials there are at most."""

MIN_TRIALS = 2
"""The fewest that make an interval."""

FIRST_DRAWS = 50
"""Draws of a condition in the first wave, about: all pooled cells together."""

COARSE_DRAWS = 40
"""The same of a value of the axis along which a limit is searched."""

_PERCENT = re.compile(r"\s*([0-9]+(?:\.[0-9]*)?|\.[0-9]+)\s*%\s*")


def _texts(example: str, least: int = 0) -> Callable[[Any], list[str]]:
    """Return the reader of a list of at least so many texts."""
    def read(value: Any) -> list[str]:
        if not isinstance(value, list) or len(value) < least or not all(
                isinstance(text, str) for text in value):
            raise ValueError(f"a list of texts, such as {example}")
        return value

    return read


def _axis_name(value: Any) -> str:
    if not isinstance(value, str) or not value:
        raise ValueError("the axis that is searched, such as distance_m")
    return value


def _true(value: Any) -> bool:
    if value is not True:
        raise ValueError("true")
    return value


def _precision(value: Any) -> tuple[tuple[str, float], ...]:
    """Return the half-widths of quantities: numbers, or per cent as texts."""
    if not isinstance(value, dict) or not value:
        raise ValueError("how well quantities are to be known, such as { detection_rate = 0.02 }")
    widths, lines = [], []
    for name, written in sorted(value.items()):
        percent = _PERCENT.fullmatch(written) if isinstance(written, str) else None
        number = float(percent[1]) / 100 if percent else written
        if isinstance(number, (int, float)) and number is not True and 0 < number < 1:
            widths.append((name, float(number)))
        else:
            lines.append(f".{plain(name)} = {shown(written)}: expected the half-width of an "
                         'interval, such as 0.02 or "5 %", above 0 and below 1')
    if lines:
        raise TablesError("half-widths", lines)
    return tuple(widths)


Keys = Mapping[str, Callable[[Any], Any]]

REQUIRE_KEYS: Keys = {
    "all": _texts('["detection >= 0.99"]', least=1), "per": _texts('["distance_m"]'),
}
"""Texts that all must hold, and the axes whose values are conditions at which they must."""

SEARCH_KEYS: Keys = {
    "along": _axis_name, "smallest": _axis_name, "largest": _axis_name, "cheapest": _true,
    "precision": _precision, "per": _texts('["distance_m"]'),
    "among": _texts('["dictionary", "solver"]'), MAX_TRIALS: parse_trial,
}


def _read_section(reading: Reading, section: str, keys: Keys) -> dict[str, Any]:
    """Return the values of a section's keys; those at fault are noted and left out."""
    table = reading.document.get(section, {})
    values: dict[str, Any] = {}
    if not isinstance(table, dict):
        reading.fault(section, table, f"a table: [{section}]")
        return values
    for key, value in table.items():
        if key not in keys:
            reading.unknown_key(section, key, [*keys], f"; expected {', '.join(keys)}")
            continue
        try:
            values[key] = keys[key](value)
        except TablesError as error:
            for line in error.lines:
                reading.note(f"{section}.{key}{line.partition(': ')[0]}", line.partition(": ")[2])
        except ValueError as error:
            reading.fault(f"{section}.{key}", value, str(error))
    return values


def _scene_axes(reading: Reading) -> list[Axis]:
    """Return the axes of the scene without ``trial``: those whose values can be conditions."""
    return [axis for axis in reading.axes_of(Stage.scene) if axis.name != TRIAL]


def _is_of_scene(reading: Reading, name: str) -> bool:
    """Return whether a name is a parameter of the scene."""
    return name in reading.parameters and reading.parameters[name].stage is Stage.scene


_NO_CONDITION = {
    REQUIRE: ("intervals are over the draws", "configurations are always told apart"),
    SEARCH: ("trials are what is counted", "each configuration has its own answer"),
}
"""Section -> why neither ``trial`` nor an axis of configurations is one of its conditions."""


def _axis_at(reading: Reading, path: str, name: str, *, scene: bool = True) -> Axis | None:
    """Return an axis, of the scene or any but ``trial``, by name, or note why there is none."""
    axis, together = reading.axis(name), reading.axis_of(name)
    of_trials, of_settings = _NO_CONDITION[path.partition(".")[0]]
    where = f"expected an axis of the {'scene' if scene else 'grid'}"
    if name == TRIAL:
        problem = of_trials
    elif scene and (axis.stage is not Stage.scene if axis is not None
                    else name in reading.parameters and not _is_of_scene(reading, name)):
        problem = of_settings
    elif axis is not None:
        return axis
    elif together is not None:
        problem = f"it goes with others along the axis {together.name}"
    elif name in reading.distributions:
        problem = f"it is drawn for each trial: give {name} values under [axes]"
    elif name in reading.table("axes"):
        return None  # its own fault says why it is none
    elif name in reading.parameters:
        problem = f"it has one value: list the values of {name} under [axes]"
    else:
        known = [each.name for each in (_scene_axes(reading) if scene else reading.axes)]
        if path == f"{REQUIRE}.per":  # an axis of this grid, or of one that --set makes
            known += [each for each in reading.parameters if _is_of_scene(reading, each)]
        reading.unknown(path, f"{name}: no such axis", name, known)
        return None
    reading.note(path, f"{name}: {problem}; {where}")
    return None


def _ordered_axis(reading: Reading, path: str, name: str) -> str:
    """Return the name of a scene axis of several numbers; "" with a fault noted if it is none."""
    axis = _axis_at(reading, path, name) if name else None
    if axis is None:
        return ""
    if not axis.is_numeric:
        reading.fault(path, name, f"an axis of numbers; {name} has no order")
    elif len(axis) < 2:
        reading.fault(path, name, f"an axis of several values, from easy to hard; {name} has one")
    else:
        return name
    return ""


# --------------------------------------------------------------------------------------------------
# The section [require] of a pipeline: what its results must fulfil.
#
# It is no part of an experiment's identity: a store is continued, whatever is required of it.
# What a requirement may be of is known to the analysis alone (`sweep.analysis.requirements`),
# which checks the names.

@dataclass(frozen=True, slots=True)
class Required:
    """What the results must fulfil.

    Attributes
    ----------
    requirements
        Texts that all must hold; no budget.
    per
        Names of the axes whose values are conditions at which they must; None if none are listed.
    budget_ms
        The most milliseconds of a frame; None without a budget.
    """

    requirements: tuple[str, ...] = ()
    per: tuple[str, ...] | None = None
    budget_ms: float | None = None


def read_required(reading: Reading) -> Required:
    """Return what the section says, and note its faults; the axes have been read."""
    table = _read_section(reading, REQUIRE, REQUIRE_KEYS)
    budgets: list[float] = []
    for text in table.get("all", ()):
        try:
            given = read_requirement(text)
            if given.name == BUDGET:
                budgets.append(_budget(reading, given))
            if len(budgets) > 1:
                raise ValueError("there is another budget; delete one")
        except ValueError as error:
            reading.note(f"{REQUIRE}.all = {shown(text)}", str(error))
    if "per" in table and "all" not in reading.table(REQUIRE):
        reading.fault(REQUIRE, reading.table(REQUIRE),
                      'what is required, too: all = ["detection >= 0.99"]')
    for name in table.get("per", ()):
        if not _is_of_scene(reading, name):
            _axis_at(reading, f"{REQUIRE}.per", name)
    return Required(
        tuple(without_budget(table.get("all", ()))),
        tuple(dict.fromkeys(table["per"])) if "per" in table else None,
        budgets[0] if budgets else None,
    )


def _budget(reading: Reading, given: RequirementText) -> float:
    """Return the milliseconds of a budget; ValueError says what is wrong with it."""
    if reading.table(SEARCH).keys().isdisjoint(CHOICES):
        raise ValueError("is the time of a choice: give [search] smallest, largest or cheapest, "
                         "or use `sweep tradeoff --budget-ms`")
    if given.relation not in ("<=", "<") or given.limit <= 0.0 or given.unit:
        raise ValueError(f"expected milliseconds of a frame: {BUDGET} <= 2")
    return given.limit


def without_budget(required: Iterable[str]) -> list[str]:
    """Return the texts of requirements that are no budget.

    >>> without_budget(["detection >= 0.99", "budget_ms<=2"])
    ['detection >= 0.99']
    """
    return [text for text in required
            if (form := _FORM.fullmatch(text)) is None or form["name"] != BUDGET]


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

def read_search(reading: Reading, required: Required) -> StoppingRule | None:
    """Return what is searched, and make the axis ``trial``; the other axes have been read.

    None without the section, or with faults in it, which are noted.
    """
    if SEARCH not in reading.document:
        return None
    faults = len(reading.faults)
    table, given = _read_section(reading, SEARCH, SEARCH_KEYS), reading.table(SEARCH)
    if reading.document[SEARCH] is not given:
        return None  # it is no table
    kinds = [kind for kind in KINDS if kind in given]
    _make_trials(reading, table)
    if len(kinds) != 1:
        others = f", not {' and '.join(kinds)}" if kinds else ""
        reading.fault(SEARCH, given, f"one of {', '.join(KINDS)}{others}")
        return None
    kind, = kinds
    value = table.get(kind)
    along = _ordered_axis(reading, f"{SEARCH}.{kind}", value) if isinstance(value, str) else ""
    precision = value if kind == "precision" and value else ()
    for name in given["precision"] if kind == "precision" and value else ():
        if name in reading.parameters:
            reading.unknown_key(f"{SEARCH}.precision", name, ())
    if kind != "precision" and not required.requirements:
        reading.note(SEARCH, f'expected what must be met: [{REQUIRE}] all = ["detection >= 0.99"]')
    axes = [axis.name for axis in _scene_axes(reading)]
    among: tuple[str, ...] = ()
    per: tuple[str, ...] = ()
    if kind in CHOICES:
        among = _among(reading, table, along, required.per or ())
        at_all = [name for name in axes if required.per is None or name in required.per]
        if "per" in given:
            reading.fault(f"{SEARCH}.per", given["per"],
                          f"conditions under [{REQUIRE}] per, where something is chosen")
    else:
        per = _conditions(reading, table, along)
        at_all = [name for name in axes if kind != "precision" and name in (required.per or ())
                  and not ("per" in given and name in per)]
        if "among" in given:
            reading.fault(
                f"{SEARCH}.among", given["among"], f"it beside {', '.join(CHOICES)} alone")
    at_all = [name for name in at_all if name not in (*among, along)]
    per = tuple(name for name in per if name not in at_all)
    trial = reading.axis(TRIAL)
    if len(reading.faults) > faults or trial is None:
        return None
    pooled = math.prod(len(axis) for axis in _scene_axes(reading)
                       if axis.name not in (*per, *at_all, *among, along))
    draws = COARSE_DRAWS if kind == "along" else FIRST_DRAWS
    return StoppingRule(
        kind, len(trial), min(max(2, math.ceil(draws / pooled)), len(trial)), along, among, per,
        tuple(at_all), required.requirements if kind != "precision" else (), precision)


def _make_trials(reading: Reading, table: Mapping[str, Any]) -> None:
    """Make the axis of trials from ``max_trials``, or take the one that is given."""
    path = f"{SEARCH}.{MAX_TRIALS}"
    wanted: Axis | None = table.get(MAX_TRIALS)
    axis = reading.axis(TRIAL)
    if axis is None and wanted is not None:
        axis = wanted
        reading.axes.append(wanted)
    elif axis is not None and wanted is not None and len(axis) != len(wanted):
        reading.fault(path, len(wanted),
                      f"{len(axis)}, which axes.trial has, or axes.trial to be left out")
    if MAX_TRIALS not in reading.table(SEARCH) and TRIAL not in reading.table("axes"):
        reading.fault(SEARCH, reading.table(SEARCH), NO_TRIALS)
    if axis is not None and len(axis) < MIN_TRIALS:
        reading.fault(path, len(axis), f"at least {MIN_TRIALS}: intervals are over the draws")
    if reading.sampling != SAMPLINGS[0]:
        reading.fault(
            "sampling", reading.sampling,
            f"{SAMPLINGS[0]} beside [{SEARCH}]: points that are spread evenly over all trials say "
            "nothing of the first ones",
        )


def _conditions(reading: Reading, table: Mapping[str, Any], along: str) -> tuple[str, ...]:
    """Return the scene axes that ``per`` lists, in the grid's order; the others' faults are noted.

    All but the axis ``along`` by default. A fixed parameter is a condition of one value.
    """
    path, axes = f"{SEARCH}.per", [axis.name for axis in _scene_axes(reading)]
    names = table.get("per", axes if "per" not in reading.table(SEARCH) else [])
    for name in dict.fromkeys(names if "per" in table else ()):
        if along and name == along:
            reading.fault(path, name, f"other axes than {along}, which is searched along")
        elif name not in reading.fixed or not _is_of_scene(reading, name):
            _axis_at(reading, path, name)
    return tuple(name for name in axes if name in names and name != along)


def _among(
    reading: Reading, table: Mapping[str, Any], along: str, conditions: Sequence[str]
) -> tuple[str, ...]:
    """Return the axes of alternatives, those of configurations among them, in the grid's order."""
    path, names = f"{SEARCH}.among", table.get("among", ())
    if along and along in names:
        reading.fault(path, names, f"{along} once: it is sought along already")
    for name in names:
        if name != along:
            _axis_at(reading, path, name, scene=False)
    chosen = [axis for axis in reading.axes if axis.name != TRIAL and (
        axis.name in names or axis.stage is not Stage.scene)]
    if "cheapest" in table and math.prod(map(len, chosen)) < 2:
        reading.fault(SEARCH, reading.table(SEARCH), (
            'something to choose: smallest = "size_m", with its values under [axes], or '
            'among = ["solver"], of which the cheapest is chosen'))
    for name in conditions:
        if name in (along, *(axis.name for axis in chosen)):
            reading.fault(f"{REQUIRE}.per", list(conditions),
                          f"conditions; {name} is what [{SEARCH}] chooses")
    return tuple(axis.name for axis in chosen)


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
