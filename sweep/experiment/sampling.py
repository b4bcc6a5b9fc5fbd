"""The sections that control sampling: requirements on results, and searches."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from typing import Any

from sweep import experiment
from sweep.declaration import Declared, TablesError, check_table
from sweep.errors import texts_of
from sweep.experiment.document import REQUIRE, SEARCH, Reading, toml_item
from sweep.experiment.draws import SAMPLINGS
from sweep.experiment.grid import TRIAL, Axis, trial_numbers
from sweep.experiment.parameters import Stage
from sweep.messages import nearest, shown

# --------------------------------------------------------------------------------------------------
# Numbers of trials at which waves end: after each, it is decided what else is needed.

#: A wave has about one trial for so many of those before it, at least one unit.
GROWTH = 4


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
# Searches. None of this is part of the identity of a cell: the draws of a trial depend
# on its number alone, and a search decides only which trials are computed.

CHOICES = ("smallest", "largest", "cheapest")
#: Keys of the kinds of search, one in a section.
KINDS = ("along", *CHOICES, "precision")


@dataclass(frozen=True, slots=True)
class StoppingRule:
    """Trials come in waves until the answer of a search is known.

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
    def largest(self) -> bool:
        """Whether the largest value of the axis is chosen."""
        return self.kind == "largest"

    @property
    def ends(self) -> tuple[int, ...]:
        """Numbers of trials at which waves end, and decisions are made."""
        return wave_ends(self.max_trials, self.unit)


def digest_of(rule: StoppingRule) -> str:
    """Return the digest that tells a rule from others: receipts hold it.

    >>> digest_of(StoppingRule("precision", 2400, 50, precision=(("detection_rate", 0.02),)))
    'db369f7a'
    """
    return sha256(json.dumps(dataclasses.asdict(rule), sort_keys=True).encode()).hexdigest()[:8]


def not_continued(ours: StoppingRule | None, begun: StoppingRule | None) -> str:
    """Return why a run cannot continue a store that was begun under another rule.

    Empty if it can: ours asks for at least as much of every condition, so that nothing that was
    computed is in vain.
    """
    if ours is None or begun is None:
        names = [f"[{SEARCH}]" if rule is not None else "a fixed number of trials"
                 for rule in (begun, ours)]
        return "" if ours is begun else f"trials: the store has {names[0]}, this run {names[1]}"
    widths = dict(ours.precision)
    for name, width in begun.precision:
        if not widths.get(name, math.inf) <= width:
            return f"{SEARCH}.precision.{name}: this run is looser than the store"
    here, there = ({
        name: (", ".join(value) or "none") if isinstance(value, tuple) else str(value)
        for name, value in dataclasses.asdict(rule).items() if name != "precision"
    } for rule in (ours, begun))
    return next((f"{SEARCH}.{name}: the store has {there[name]}, this run {here[name]}"
                 for name in there if here[name] != there[name]), "")


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
        The required quantity, as it was given.
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
        Says on one line what was expected.

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
# Keys of the sections, each with a reader of its value, which raises ValueError(expectation).

#: A requirement beside quantities where a choice is made: the time of a frame.
BUDGET = "budget_ms"

#: The key with the most trials, the length of the axis ``trial``.
MAX_TRIALS = "max_trials"

#: Expectation where nothing says how many trials there are at most.
NO_TRIALS = f"{MAX_TRIALS}, too: the most trials of a condition"

#: Draws of a condition in the first wave, about: all pooled cells together.
FIRST_DRAWS = 50

#: Draws of a value of the axis along which a limit is searched, in the first wave.
COARSE_DRAWS = 40

_PERCENT = re.compile(r"\s*([0-9]+(?:\.[0-9]*)?|\.[0-9]+)\s*%\s*")


def _texts(example: str, least: int = 0) -> Callable[[Any], list[str]]:
    """Return the reader of a list of texts; of at least one, what reads each text checks it."""
    def read(value: Any) -> list[str]:
        if not isinstance(value, list) or len(value) < least or not (least or all(
                isinstance(text, str) for text in value)):
            raise ValueError(f"a list of texts, such as {example}")
        return value

    return read


def _half_width(written: Any) -> float:
    percent = _PERCENT.fullmatch(written) if isinstance(written, str) else None
    number = float(percent[1]) / 100 if percent else written
    if isinstance(number, (int, float)) and number is not True and 0 < number < 1:
        return float(number)
    raise ValueError('the half-width of an interval, such as 0.02 or "5 %", above 0 and below 1')


def _precision(value: Any) -> tuple[tuple[str, float], ...]:
    """Return the half-widths of quantities: numbers, or per cent as texts."""
    if not isinstance(value, dict) or not value:
        raise ValueError("how well quantities are to be known, such as { detection_rate = 0.02 }")
    widths, lines = check_table(_keys(**dict.fromkeys(value, _half_width)), value, "")
    if lines:
        raise TablesError(*(f".{line}" for line in lines))
    return tuple(sorted(widths.items()))


def _keys(**readers: Callable[[Any], Any]) -> dict[str, Declared]:
    """Return keys by their names, each with what reads its value."""
    return {name: Declared(name, (), None, name, reads=reads)
            for name, reads in readers.items()}


#: Texts that all must hold, and the axes whose values are conditions at which they must.
REQUIRE_KEYS = _keys(all=_texts('["detection >= 0.99"]', least=1), per=_texts('["distance_m"]'))

SEARCH_KEYS = {
    **{name: Declared(name, (str,), None, "an axis") for name in ("along", "smallest", "largest")},
    "cheapest": Declared("cheapest", (bool,), None, "whether the cheapest is chosen"),
    **_keys(precision=_precision, per=_texts('["distance_m"]'),
            among=_texts('["dictionary", "solver"]'), max_trials=trial_numbers),
}


def _read_section(reading: Reading, section: str, keys: Mapping[str, Declared]) -> dict[str, Any]:
    """Return the values of a section's keys; those at fault are noted and left out."""
    table = reading.table(section)
    for key in table:
        if key not in keys:
            reading.unknown_key(section, key, [*keys], f"; expected {', '.join(keys)}")
    values, lines = check_table(
        keys, {key: value for key, value in table.items() if key in keys}, "")
    reading.tell(f"{section}.{line}" for line in lines)
    return {key: value for key, value in values.items() if value is not None}


def _is_of_scene(reading: Reading, name: str) -> bool:
    """Return whether a name is a parameter of the scene."""
    return name in reading.parameters and reading.parameters[name].stage is Stage.scene


def _axis_at(reading: Reading, path: str, name: str, *, scene: bool = True) -> Axis | None:
    """Return an axis, of the scene or any but ``trial``, by name, or note that there is none."""
    axes = {axis.name: axis for axis in reading.axes
            if axis.name != TRIAL and (axis.stage is Stage.scene or not scene)}
    if name not in axes:
        known = [*axes, *(each for each in reading.parameters
                          if not scene or _is_of_scene(reading, each))]
        hint = "" if name in reading.parameters else nearest(name, known)
        reading.note(path, f"{name}: no such axis{hint}; expected one under [axes] of the "
                     f"{'scene' if scene else 'grid'}: {', '.join(axes) or 'there is none'}")
    return axes.get(name)


# --------------------------------------------------------------------------------------------------
# The section [require] of a pipeline: what its results must fulfil.
#
# It is no part of an experiment's identity: a store is continued, whatever is required of it.
# The quantities of requirements are known to the analysis alone (`sweep.analysis.requirements`),
# which checks the names.

def read_required(reading: Reading) -> dict[str, Any]:
    """Return the section as fields of a pipeline, and note its faults.

    The axes have been read.
    """
    table = _read_section(reading, REQUIRE, REQUIRE_KEYS)
    budget_ms, named = None, []
    for text in table.get("all", ()):
        try:
            given = read_requirement(text)
            if given.name == BUDGET and reading.table(SEARCH).keys().isdisjoint(CHOICES):
                raise ValueError("is the time of a choice: give [search] smallest, largest or "
                                 "cheapest, or use `sweep tradeoff --budget-ms`")
            if given.name == BUDGET and (
                    given.relation not in ("<=", "<") or given.limit <= 0.0 or given.unit):
                raise ValueError(f"expected milliseconds of a frame: {BUDGET} <= 2")
            if given.name == BUDGET and budget_ms is not None:
                raise ValueError("there is another budget; delete one")
            budget_ms = given.limit if given.name == BUDGET else budget_ms
            named += [text] if given.name != BUDGET else []
        except ValueError as error:
            reading.note(f"{REQUIRE}.all = {shown(text)}", str(error))
    _tell_of_quantities(reading, named, [])
    conditions = tuple(dict.fromkeys(table.get("per", ())))
    for name in conditions:
        if not _is_of_scene(reading, name):
            _axis_at(reading, f"{REQUIRE}.per", name)
    return {"requirements": tuple(texts_in(reading.document)), "require_per": conditions,
            "budget_ms": budget_ms}


def _tell_of_quantities(
    reading: Reading, texts: Sequence[str], names: Collection[str]
) -> None:
    """Note faults of requirements and of names of precisions; a store has none."""
    if reading.recorded is None and (texts or names):
        reading.tell(experiment.quantity_faults(texts, names))


def texts_in(document: Mapping[str, Any]) -> list[str]:
    """Return the requirements of a document that may have faults, as texts, without a budget.

    >>> texts_in({"require": {"all": ["detection >= 0.99", "budget_ms<=2"]}})
    ['detection >= 0.99']
    """
    table = document.get(REQUIRE)
    listed = table.get("all") if isinstance(table, dict) else None
    texts = [each for each in (listed if isinstance(listed, list) else ()) if isinstance(each, str)]
    return [text for text in texts
            if (form := _FORM.fullmatch(text)) is None or form["name"] != BUDGET]


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

def read_search(reading: Reading, required: Mapping[str, Any]) -> StoppingRule | None:
    """Return the search, and make the axis ``trial``; the other axes have been read.

    ``required`` is what :func:`read_required` returned. None without the section, or with faults
    in it, which are noted.
    """
    if not isinstance(reading.document.get(SEARCH), dict):
        return None
    faults, given = len(reading.faults), reading.table(SEARCH)
    table = _read_section(reading, SEARCH, SEARCH_KEYS)
    _make_trials(reading, table)
    if isinstance(given.get("precision"), dict):
        _tell_of_quantities(reading, [], given["precision"])
    kinds = [kind for kind in KINDS if given.get(kind, False) is not False]
    if len(kinds) != 1:
        others = f", not {' and '.join(kinds)}" if kinds else ""
        reading.fault(SEARCH, given, f"one of {', '.join(KINDS)}{others}")
        return None
    kind, = kinds
    value = table.get(kind)
    axis = _axis_at(reading, f"{SEARCH}.{kind}", value) if isinstance(value, str) else None
    if axis is not None and (not axis.is_numeric or len(axis) < 2):
        reading.fault(f"{SEARCH}.{kind}", value, "an axis of several numbers, from easy to hard")
        axis = None
    if kind != "precision" and not required["requirements"]:
        reading.note(SEARCH, f'expected what must be met: [{REQUIRE}] all = ["detection >= 0.99"]')
    listed, misplaced, elsewhere = (
        "among", "per", f"conditions under [{REQUIRE}] per, where something is chosen"
    ) if kind in CHOICES else ("per", "among", f"it beside {', '.join(CHOICES)} alone")
    if misplaced in given:
        reading.fault(f"{SEARCH}.{misplaced}", given[misplaced], elsewhere)
    for name in dict.fromkeys(table.get(listed, ())):
        # A fixed parameter is a condition of one value.
        if listed == "among" or name not in reading.fixed or not _is_of_scene(reading, name):
            _axis_at(reading, f"{SEARCH}.{listed}", name, scene=listed == "per")
    along = "" if axis is None else axis.name
    conditions = required["require_per"] if "per" in reading.table(REQUIRE) else None
    roles = _roles(reading, table, kind, along, conditions)
    chosen = {along, *roles["among"]} if listed == "among" else set[str]()
    for name in chosen.intersection(conditions or ()):
        reading.fault(f"{REQUIRE}.per", list(conditions or ()),
                      f"conditions; {name} is what [{SEARCH}] chooses")
    trial = reading.axis(TRIAL)
    if len(reading.faults) > faults or trial is None:
        return None
    named = {along, TRIAL}.union(*roles.values())
    pooled = math.prod(
        len(axis) for axis in reading.axes_of(Stage.scene) if axis.name not in named)
    draws = COARSE_DRAWS if kind == "along" else FIRST_DRAWS
    return StoppingRule(
        kind, len(trial), min(max(2, math.ceil(draws / pooled)), len(trial)), along, **roles,
        requirements=required["requirements"] if kind != "precision" else (),
        precision=value if kind == "precision" and value else ())


def _roles(
    reading: Reading, table: Mapping[str, Any], kind: str, along: str,
    conditions: Sequence[str] | None,
) -> dict[str, tuple[str, ...]]:
    """Return the axes of each role of a search that :class:`StoppingRule` has.

    ``conditions`` are those of the section [require]; None if it lists none. An axis that nothing
    names is a condition of a precision or a limit (``per``), and one at which what is chosen must
    meet the requirements (``at_all``).
    """
    scene = {axis.name for axis in reading.axes_of(Stage.scene)} - {TRIAL, along}
    among, per, at_all = set[str](), set[str](), scene.intersection(conditions or ())
    if kind in CHOICES:
        settings = {axis.name for axis in reading.axes_of(Stage.detection, Stage.estimation)}
        among = settings | {*table.get("among", ())} - {along}
        at_all = (scene if conditions is None else at_all) - among
    else:
        at_all = at_all if kind == "along" else set()
        per = scene.intersection(table.get("per", scene - at_all))
        at_all -= per
    return {role: tuple(axis.name for axis in reading.axes if axis.name in names)
            for role, names in (("among", among), ("per", per), ("at_all", at_all))}


def _make_trials(reading: Reading, table: Mapping[str, Any]) -> None:
    """Make the axis of trials from ``max_trials``, or take the one that is given."""
    wanted: range | None = table.get(MAX_TRIALS)
    if wanted is not None and reading.axis(TRIAL) is None:
        reading.axes.append(Axis(TRIAL, {TRIAL: wanted}))
    elif wanted is not None:
        reading.fault(f"{SEARCH}.{MAX_TRIALS}", len(wanted),
                      "it or axes.trial, not both; delete one of them")
    if MAX_TRIALS not in reading.table(SEARCH) and TRIAL not in reading.table("axes"):
        reading.fault(SEARCH, reading.table(SEARCH), NO_TRIALS)
    if reading.sampling != SAMPLINGS[0]:
        reading.fault(
            "sampling", reading.sampling,
            f"{SAMPLINGS[0]} beside [{SEARCH}]: points that are spread evenly over all trials say "
            "nothing of the first ones")


def search_settings(
    require: Sequence[str] = (), along: str = "", per: Sequence[str] | None = None,
    at_all: Sequence[str] | None = None, max_trials: int | None = None,
) -> list[str]:
    """Return a search along an axis as settings of the sections, as ``--set`` takes them.

    >>> search_settings(["detection >= 0.9"], "distance_m", max_trials=600)
    ['require.all=["detection >= 0.9"]', 'search.along="distance_m"', 'search.max_trials=600']
    """
    given: dict[str, Any] = {
        f"{REQUIRE}.all": texts_of("require", () if require is None else require) or None,
        f"{SEARCH}.along": str(along) if along else None,
        f"{SEARCH}.per": None if per is None else texts_of("per", per),
        f"{REQUIRE}.per": None if at_all is None else texts_of("at_all", at_all),
        f"{SEARCH}.{MAX_TRIALS}": max_trials}
    return [f"{key}={toml_item(value).as_string()}"
            for key, value in given.items() if value is not None]
