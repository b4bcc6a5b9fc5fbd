"""The sections that control sampling: [require], [precision], [limit], [choose]."""

from __future__ import annotations

import dataclasses
import json
import math
import operator
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from typing import Any, ClassVar

from sweep.experiment.axes import MAX_VALUES, TRIAL, parse_trial
from sweep.experiment.draws import SAMPLINGS
from sweep.experiment.parameters import Stage
from sweep.experiment.reader import REQUIRE, Reading, StoppingRule
from sweep.experiment.section_keys import (
    axis_at,
    conditions,
    difference,
    number,
    ordered_axis,
    scene_axes,
    texts,
    unknown_keys,
)
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
# The section [precision]: how well each quantity is to be known at each condition.
#
# Names of quantities are known to the analysis alone; the rule that samples
# (`sweep.sampling.precision`) checks them.

_PERCENT = re.compile(r"\s*([0-9]+(?:\.[0-9]*)?|\.[0-9]+)\s*%\s*")

OWN = ("per", "max_trials")
"""Keys of the section that are no quantities."""


@dataclass(frozen=True, slots=True)
class PrecisionRule:
    """Trials come in waves until intervals are as narrow as is wanted.

    Attributes
    ----------
    wanted
        Name of each quantity, and the half-width of its interval: of a rate as it is, else
        relative to the value.
    per
        The scene axes of which every combination of values is a condition; the others are pooled.
    max_trials
        The most trials of a condition; the length of the axis ``trial``.
    """

    wanted: tuple[tuple[str, float], ...]
    per: tuple[str, ...]
    max_trials: int
    section: ClassVar[str] = "precision"

    def looser(self, begun: PrecisionRule) -> str:
        """Return why a store begun under another precision is not continued; empty if it is."""
        if problem := difference(self.section, self, begun, ("max_trials", "per")):
            return problem
        ours = dict(self.wanted)
        for name, width in begun.wanted:
            if ours.get(name, float("inf")) > width:
                own = f"{ours[name]:g}" if name in ours else "none"
                return f"precision.{name}: the store has {width:g}, this run {own}, which is looser"
        return ""


def read_precision(reading: Reading, table: Mapping[str, Any]) -> PrecisionRule | None:
    """Return what a table [precision] says; None if it has faults, which are noted."""
    known = len(reading.faults)
    for name in table.keys() & reading.parameters.keys():
        reading.unknown_key("precision", name, OWN)
    wanted = tuple(sorted(
        (str(name), width) for name, value in table.items()
        if name not in OWN and name not in reading.parameters
        and (width := _half_width(reading, str(name), value)) is not None
    ))
    if not wanted and len(reading.faults) == known:
        reading.fault(
            "precision", dict(table),
            "how well a quantity is to be known, such as detection_rate = 0.02",
        )
    per = conditions(reading, "precision", table, "per") if "per" in table else tuple(
        axis.name for axis in scene_axes(reading))
    if TRIAL not in reading.axes:
        return None  # a fault that is noted
    return PrecisionRule(wanted, per, len(reading.axes[TRIAL]))


def _half_width(reading: Reading, name: str, value: Any) -> float | None:
    """Return the half-width that a value says, or note why it is none."""
    percent = _PERCENT.fullmatch(value) if isinstance(value, str) else None
    number = float(percent[1]) / 100 if percent else value
    if isinstance(number, bool) or not isinstance(number, (int, float)) or not 0 < number < 1:
        reading.fault(
            f"precision.{name}", value,
            'the half-width of an interval, such as 0.02 or "5 %", above 0 and below 1',
        )
        return None
    return float(number)


# --------------------------------------------------------------------------------------------------
# The section [limit]: how far along an axis requirements are met.
#
# What a requirement may be of is known to the analysis alone; the rule that samples
# (`sweep.sampling.searches`) checks the names.

LIMIT = "limit"

COARSE_DRAWS = 40
"""Draws of a value in the coarse scan, about: all pooled cells together."""

LIMIT_KEYS = ("require", "along", "per", "at_all", "coarse_trials", "max_trials")
"""The keys of the section."""


@dataclass(frozen=True, slots=True)
class LimitRule:
    """Trials come in waves where they decide how far requirements are met.

    Attributes
    ----------
    require
        The requirements, as texts.
    along
        The scene axis that is searched.
    per
        The scene axes of which every combination of values has a limit of its own.
    at_all
        The scene axes at all of whose values the requirements must hold. The others are pooled.
    coarse_trials
        Trials of every cell in the first wave.
    max_trials
        The most trials of a cell; the length of the axis ``trial``.
    """

    require: tuple[str, ...]
    along: str
    per: tuple[str, ...]
    at_all: tuple[str, ...]
    coarse_trials: int
    max_trials: int
    section: ClassVar[str] = LIMIT

    @property
    def ends(self) -> tuple[int, ...]:
        """Numbers of trials at which waves end, and decisions are made."""
        return wave_ends(self.max_trials, self.coarse_trials)

    def looser(self, begun: LimitRule) -> str:
        """Return why a store begun under another search is not continued; empty if it is."""
        return difference(LIMIT, self, begun, LIMIT_KEYS)


def read_limit(reading: Reading, table: Mapping[str, Any]) -> LimitRule | None:
    """Return what a table [limit] says; None if it has faults, which are noted."""
    known = len(reading.faults)
    unknown_keys(reading, LIMIT, table, LIMIT_KEYS)
    require = _requirements(reading, table)
    along = ordered_axis(reading, f"{LIMIT}.along", table.get("along", ""))
    at_all = conditions(reading, LIMIT, table, "at_all", along)
    axes = {axis.name: len(axis) for axis in scene_axes(reading) if axis.name != along}
    per = conditions(reading, LIMIT, table, "per", along) if "per" in table else tuple(
        name for name in axes if name not in at_all)
    for name in sorted({*per} & {*at_all}):
        reading.fault(f"{LIMIT}.at_all", name, f"{name} in per or in at_all, not in both")
    pooled = math.prod(length for name, length in axes.items() if name not in (*per, *at_all))
    usual = max(2, math.ceil(COARSE_DRAWS / pooled))
    coarse = number(reading, LIMIT, table, "coarse_trials", usual, 2, MAX_VALUES)
    if TRIAL in reading.axes and "coarse_trials" in table and 1 < len(reading.axes[TRIAL]) < coarse:
        reading.fault(f"{LIMIT}.coarse_trials", coarse,
                      f"at most max_trials, {len(reading.axes[TRIAL]):,}")
    if TRIAL not in reading.axes or len(reading.faults) > known:
        return None
    count = len(reading.axes[TRIAL])
    return LimitRule(require, along, per, at_all, min(coarse, count), count)


def _requirements(reading: Reading, table: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the texts of what is required, noting what has not the form of such."""
    required = texts(reading, LIMIT, table, "require", '["detection >= 0.9"]', needed=True)
    for text in required:
        try:
            parts = read_requirement(text)
        except ValueError as error:
            reading.faults.append(f"{reading.source}: {LIMIT}.require = {shown(text)}: {error}")
            continue
        if parts.name == "budget_ms":
            reading.faults.append(
                f"{reading.source}: {LIMIT}.require = {shown(text)}: the cost is that of a "
                "configuration, wherever the marker is; ask sweep size or sweep tradeoff for it")
    return tuple(required)


def limit_settings(
    require: Sequence[str] = (), along: str = "", per: Sequence[str] | None = None,
    at_all: Sequence[str] | None = None, coarse_trials: int | None = None,
    max_trials: int | None = None,
) -> list[str]:
    """Return what is given as settings of the section, as ``--set`` takes them.

    >>> limit_settings(["detection >= 0.9"], "distance_m", max_trials=600)
    ['limit.require=["detection >= 0.9"]', 'limit.along="distance_m"', 'limit.max_trials=600']
    """
    given = {
        "require": _listed(require) or None, "along": along or None,
        "per": None if per is None else _listed(per),
        "at_all": None if at_all is None else _listed(at_all),
        "coarse_trials": coarse_trials, "max_trials": max_trials,
    }
    return [f"{LIMIT}.{key}={json.dumps(value, ensure_ascii=False, default=_whole)}"
            for key, value in given.items() if value is not None]


def _listed(texts: Sequence[str]) -> list[str]:
    return [texts] if isinstance(texts, str) else list(texts)


def _whole(value: Any) -> int | str:
    """Return a whole number of NumPy's; of anything else its text, which is refused as such."""
    return operator.index(value) if hasattr(value, "__index__") else str(value)


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
    if "choose" not in reading.document:
        raise ValueError("is the time of a choice: give [choose], or use `sweep tradeoff "
                         "--budget-ms`")
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
# The section [choose]: what is chosen so that the section [require] is met at all conditions.
#
# [require] has what must hold at each condition, such as "detection >= 0.99" and a budget_ms;
# [choose] has `smallest` or `largest` with an axis, or neither for the cheapest, `among` with
# further choices, `max_trials` and `confidence`.

CHOOSE = "choose"
WISHES = ("smallest", "largest")
CHOOSE_KEYS = (*WISHES, "among", "max_trials", "confidence")

CONFIDENCE = 0.95
"""Confidence if none is given."""


@dataclass(frozen=True, slots=True)
class ChoiceRule:
    """Trials come in waves until the choice is known.

    Attributes
    ----------
    along
        The axis whose smallest or largest value is sought; empty if the cheapest choice is.
    largest
        Whether the largest is.
    among
        The axes of which every combination of values, an alternative, is a choice of its own.
    requirements
        What must hold, as texts; without a budget, which no trial decides.
    per
        The scene axes of which every combination of values is a condition; others are pooled.
    max_trials
        The most trials of a condition; the length of the axis ``trial``.
    confidence
        Probability with which an answer meets the requirements.
    """

    along: str
    largest: bool
    among: tuple[str, ...]
    requirements: tuple[str, ...]
    per: tuple[str, ...]
    max_trials: int
    confidence: float
    section: ClassVar[str] = CHOOSE

    def looser(self, begun: ChoiceRule) -> str:
        """Return why a store begun for another choice is not continued; empty if it is."""
        return difference(CHOOSE, self, begun)


def read_choice(reading: Reading, table: Mapping[str, Any]) -> ChoiceRule | None:
    """Return what a table [choose] says; None if it has faults, which are noted."""
    known = len(reading.faults)
    unknown_keys(reading, CHOOSE, table, CHOOSE_KEYS)
    wishes = [key for key in WISHES if key in table]
    if len(wishes) > 1:
        reading.fault(f"{CHOOSE}.largest", table["largest"], "smallest or largest, not both")
    along = "" if len(wishes) != 1 else ordered_axis(
        reading, f"{CHOOSE}.{wishes[0]}", table[wishes[0]])
    among = _among(reading, table, along)
    if not wishes and math.prod(len(reading.axes[name]) for name in among) < 2:
        reading.fault(CHOOSE, dict(table), (
            'something to choose: smallest = "size_m", with its values under [axes], or '
            'among = ["solver"], of which the cheapest is chosen'))
    confidence = number(reading, CHOOSE, table, "confidence", CONFIDENCE, 0.5, 0.9999)
    chosen = {*among, *([along] if along else [])}
    requirements, per = _required(reading, chosen)
    if len(reading.faults) > known or TRIAL not in reading.axes:
        return None
    return ChoiceRule(
        along, "largest" in table, among, requirements, per,
        len(reading.axes[TRIAL]), confidence)


def _among(reading: Reading, table: Mapping[str, Any], along: str) -> tuple[str, ...]:
    """Return the axes of alternatives, those of configurations among them, in the grid's order."""
    path = f"{CHOOSE}.among"
    names = texts(reading, CHOOSE, table, "among", '["dictionary", "solver"]')
    if along and along in names:
        reading.fault(path, names, f"{along} once: it is sought along already")
    chosen = {axis.name for name in names
              if name != along and (axis := axis_at(reading, path, name, scene=False)) is not None}
    return tuple(axis.name for axis in reading.axes.values() if axis.name != TRIAL and (
        axis.name in chosen or axis.stage is not Stage.scene))


def _required(reading: Reading, chosen: set[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the requirements and the conditions; faults of the section are noted elsewhere."""
    table = reading.document.get(REQUIRE)
    table = table if isinstance(table, dict) else {}
    required, per = texts_in(reading.document), table.get("per")
    if not required:
        reading.faults.append(
            f"{reading.source}: {CHOOSE}: expected what must be met: [{REQUIRE}] "
            'all = ["detection >= 0.99"]')
    axes = [axis.name for axis in scene_axes(reading)]
    if not isinstance(per, list):
        return tuple(required), tuple(name for name in axes if name not in chosen)
    for name in chosen.intersection(each for each in per if isinstance(each, str)):
        reading.fault(f"{REQUIRE}.per", per, f"conditions; {name} is what [{CHOOSE}] chooses")
    return tuple(required), tuple(name for name in axes if name in per)


# --------------------------------------------------------------------------------------------------
# When sampling stops: the sections of a pipeline by which trials come in waves until all is
# known.
#
# At most one of them stands in a pipeline. None is part of the identity of a cell: the draws of a
# trial depend on its number alone, and a section decides only which trials are computed.

MAX_TRIALS = "max_trials"
"""The key of every section: the most trials, the length of the axis ``trial``."""

MIN_TRIALS = 2
"""The fewest that make an interval."""

NO_TRIALS = f"{MAX_TRIALS}, too: the most trials of a condition"
"""What is expected where nothing says how many trials there are at most."""


STOPPING_SECTIONS: Mapping[str, Callable[[Reading, dict[str, Any]], StoppingRule | None]] = {
    "limit": read_limit,
    "precision": read_precision,
    "choose": read_choice,
}
"""Section -> the function that reads its table and notes faults: the one entry of a rule here.

Its results are sampled by the entry of the rule's class in `sweep.sampling.rules.RULES`.
"""


def read_stopping(reading: Reading) -> None:
    """Read the section by which sampling stops, if there is one; the axes have been read.

    It makes the axis ``trial``.
    """
    present = [name for name in STOPPING_SECTIONS if name in reading.document]
    for name in present[1:]:
        reading.fault(name, reading.document[name], f"[{present[0]}] or [{name}], not both")
    if not present:
        return
    name = present[0]
    table = reading.document[name]
    if not isinstance(table, dict):
        reading.fault(name, table, f"a table: [{name}]")
        return
    _read_trials(reading, name, table)
    if reading.sampling != SAMPLINGS[0]:
        reading.fault(
            "sampling", reading.sampling,
            f"{SAMPLINGS[0]} beside [{name}]: points that are spread evenly over all trials say "
            "nothing of the first ones",
        )
    if TRIAL in reading.axes and len(reading.axes[TRIAL]) < MIN_TRIALS:
        reading.fault(f"{name}.{MAX_TRIALS}", len(reading.axes[TRIAL]),
                      f"at least {MIN_TRIALS}: intervals are over the draws")
    reading.stopping = STOPPING_SECTIONS[name](reading, table)


def _read_trials(reading: Reading, name: str, table: Mapping[str, Any]) -> None:
    """Make the axis of trials from ``max_trials``, or take the one that is given."""
    given = reading.axes.get(TRIAL)
    if MAX_TRIALS not in table:
        if given is None and not reading.names_axis(TRIAL):
            reading.fault(name, dict(table), NO_TRIALS)
        return
    try:
        axis = parse_trial(table[MAX_TRIALS])
    except ValueError as error:
        reading.fault(f"{name}.{MAX_TRIALS}", table[MAX_TRIALS], str(error))
        return
    if given is None:
        reading.axes[TRIAL] = axis
    elif len(given) != len(axis):
        reading.fault(
            f"{name}.{MAX_TRIALS}", table[MAX_TRIALS],
            f"{len(given)}, which axes.trial has, or axes.trial to be left out",
        )


def digest_of(rule: StoppingRule) -> str:
    """Return what tells a rule from others: receipts hold it.

    >>> from sweep.experiment.sampling import PrecisionRule
    >>> digest_of(PrecisionRule((("detection_rate", 0.02),), ("tilt_deg",), 2400))
    'd5d0ebe8'
    """
    content = {"section": rule.section, **dataclasses.asdict(rule)}
    return sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:8]


def not_continued(ours: StoppingRule | None, begun: StoppingRule | None) -> str:
    """Return why a run cannot continue a store begun under another rule; empty if it can."""
    if ours == begun:
        return ""
    if ours is None or begun is None or ours.section != begun.section:
        names = [f"[{rule.section}]" if rule is not None else "a fixed number of trials"
                 for rule in (begun, ours)]
        return f"trials: the store has {names[0]}, this run {names[1]}"
    return ours.looser(begun)
