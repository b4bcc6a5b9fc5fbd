"""Axes and distributions: the forms in which a pipeline file gives more than one value."""

from __future__ import annotations

import collections
import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.experiment.parameters import PARAMETERS, Parameter, Stage
from sweep.messages import label, nearest, plain, shown
from sweep.typing import Floats

TRIAL = "trial"
"""The axis of repeated draws; a scene dimension with coordinates 0, 1, 2, ..."""

MAX_VALUES = 10**9
"""The longest axis (``range`` and ``trial``; they are never written out)."""

MAX_LISTED = 10**6
"""The longest axis of any other form; also the most values of all such axes together."""


@dataclass(frozen=True, slots=True)
class Axis:
    """A dimension of the grid.

    Attributes
    ----------
    name
        A parameter's, ``trial``, or a name of the user's own if parameters go together along it.
    values
        Its values, without repeats; labels if parameters go together.
    zipped
        The parameters that go together, each with its values; empty for an axis of one parameter.
    parameters
        Its parameters; none of ``trial``.
    """

    name: str
    values: Sequence[Any]
    zipped: tuple[tuple[str, Sequence[Any]], ...] = ()
    parameters: tuple[Parameter, ...] = field(default=(), compare=False)

    def __len__(self) -> int:
        return len(self.values)

    @property
    def columns(self) -> dict[str, Sequence[Any]]:
        """Parameter (or ``trial``) -> its values along the axis."""
        return dict(self.zipped) or {self.name: self.values}

    def at(self, index: int) -> dict[str, Any]:
        """Return the value of each of its parameters at an index."""
        return {name: values[index] for name, values in self.columns.items()}

    def index_of(self, wanted: Mapping[str, Any]) -> int | None:
        """Return the first index at which its parameters have the wanted values; None without."""
        columns = [
            (values, wanted[name]) for name, values in self.columns.items() if name in wanted
        ]
        if len(columns) == 1:
            values, value = columns[0]
            return values.index(value) if value in values else None
        rows = range(len(self))
        return next((i for i in rows if all(values[i] == value for values, value in columns)), None)

    def replaced(self, name: str, value: Any) -> Axis:
        """Return the axis with one value in place of all those of a parameter."""
        same = (value,) * len(self)
        if not self.zipped:
            return dataclasses.replace(self, values=same)
        return dataclasses.replace(self, zipped=tuple(
            (other, same if other == name else values) for other, values in self.zipped
        ))

    @property
    def stage(self) -> Stage:
        """The first stage that the axis touches."""
        return self.parameters[0].stage if self.parameters else Stage.scene

    @property
    def unit(self) -> str:
        """The unit of its values; empty if they have none."""
        return "" if self.zipped or not self.parameters else self.parameters[0].unit

    @property
    def meaning(self) -> str:
        """Meaning of the values, in words."""
        if self.zipped:
            return f"{', '.join(self.columns)}, which go together"
        return self.parameters[0].declaration.meaning if self.parameters else "number of the draw"

    @property
    def labelled(self) -> bool:
        """Whether its coordinates are strings: its values are not all numbers, or all booleans."""
        if self.zipped:
            return True
        if isinstance(self.values, range):
            return False
        return {type(value) for value in self.values} not in ({bool}, {int}, {float})

    @property
    def is_numeric(self) -> bool:
        """Whether its values are numbers, and not labels or switches."""
        return not self.labelled and not isinstance(self.values[0], bool)

    def coordinates(self, start: int = 0, stop: int | None = None) -> NDArray[Any]:
        """Return the values [start, stop) as coordinates: numbers, booleans or strings."""
        part = self.values[start:stop]
        if isinstance(part, range):
            return np.arange(part.start, part.stop, part.step, dtype=np.int64)
        if self.labelled:
            return np.array([label(value) for value in part], dtype=np.dtypes.StringDType())
        return np.array(part, dtype=type(self.values[0]))


MAX_DEVIATIONS = 8.3
"""The largest distance of a normal draw of 53 bits from its mean, in standard deviations."""

@dataclass(frozen=True, slots=True)
class Distribution:
    """A parameter that is drawn per trial: ``uniform`` on [a, b] or ``normal`` (mean a, sd b)."""

    kind: str
    a: float
    b: float

    def at(self, uniform: Floats) -> Floats:
        """Return the inverse CDF at uniform numbers in (0, 1), of any shape."""
        if self.kind == "uniform":
            return self.a + (self.b - self.a) * uniform
        from scipy.special import ndtri  # noqa: PLC0415  (slow to import, and seldom needed)

        return np.asarray(self.a + self.b * ndtri(uniform))

    @property
    def largest(self) -> float:
        """The largest number that a draw is added up from."""
        return max(abs(self.a), self.b * MAX_DEVIATIONS if self.kind == "normal" else abs(self.b))

    def __str__(self) -> str:
        return f"{self.kind}({self.a:.12g},{self.b:.12g})"


AXIS_FORMS = {
    "range": "[start, stop] or [start, stop, step], whole numbers, half-open",
    "arange": "[start, stop, step], half-open",
    "linspace": "[first, last, count], both inclusive",
    "geom": "[first, last, count], both inclusive, above 0",
    "values": "a list",
}
DISTRIBUTION_FORMS = {"uniform": "[a, b] with a < b", "normal": "[mean, sd] with sd > 0"}


def parse_distribution(parameter: Parameter, table: dict[str, Any]) -> Distribution:
    """Return the distribution of a table such as ``{ uniform = [a, b] }``.

    Raises
    ------
    ValueError
        The expectation, if the table is not a distribution of the parameter.
    """
    forms = " or ".join(f"{{ {kind} = {form} }}" for kind, form in DISTRIBUTION_FORMS.items())
    if len(table) != 1 or next(iter(table)) not in DISTRIBUTION_FORMS:
        if next(iter(table), None) in AXIS_FORMS:
            raise ValueError("one value here; more than one goes under [axes]")
        raise ValueError(f"{parameter.expected()}, or {forms}")
    kind, ends = next(iter(table.items()))
    if not parameter.declaration.drawable:
        drawable = ", ".join(p.name for p in PARAMETERS.values() if p.declaration.drawable)
        raise ValueError(f"a fixed value; only these can be drawn: {drawable}")
    sound = isinstance(ends, list) and len(ends) == 2 and _are_numbers(ends)
    if not sound or not ends[1] > (ends[0] if kind == "uniform" else 0):
        raise ValueError(f"{kind} = {DISTRIBUTION_FORMS[kind]}")
    a, b = map(float, ends)
    if kind == "uniform":
        parameter.check(a)
        parameter.check(b)
    elif not all(parameter.declaration.admits(a + side * MAX_DEVIATIONS * b) for side in (-1, 1)):
        extent = parameter.declaration.range_text()
        raise ValueError(f"mean - {MAX_DEVIATIONS} sd and mean + {MAX_DEVIATIONS} sd {extent}")
    return Distribution(kind, a, b)


def _are_numbers(values: Sequence[Any]) -> bool:
    return all(isinstance(value, (int, float)) and not isinstance(value, bool)
               and abs(value) < 1e300 for value in values)


def parse_trial(value: Any) -> Axis:
    """Return the axis of ``trial = N``; ValueError with the expectation if N is not a count."""
    if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= MAX_VALUES:
        raise ValueError(f"a whole number from 1 to {MAX_VALUES:,}: how many draws")
    return Axis(TRIAL, range(value))


def parse_axis(
    parameter: Parameter, given: Any, quota: int = MAX_LISTED, *, repeats: bool = False
) -> Axis:
    """Return the axis of a list or of a table such as ``{ geom = [0.05, 1, 40] }``.

    Parameters
    ----------
    parameter
        The parameter that varies along the axis.
    given
        The list or table of the document.
    quota
        The most values that are listed; a ``range`` is not.
    repeats
        Whether a value may be repeated.

    Raises
    ------
    ValueError
        The expectation, if it is not an axis of the parameter.

    Examples
    --------
    >>> parse_axis(PARAMETERS["tilt_deg"], {"linspace": [0, 60, 3]}).values
    (0.0, 30.0, 60.0)
    """
    forms = ", ".join(AXIS_FORMS)
    if isinstance(given, list):
        form, ends = "values", given
    elif isinstance(given, dict) and len(given) == 1:
        form, ends = next(iter(given.items()))
    else:
        raise ValueError(f"a list, or a table with one of {forms}")
    if form == "zip":
        raise ValueError(
            f"an axis of {parameter.name} alone; parameters that go together need a name of "
            "your own, such as pair = { zip = { ... } }"
        )
    if form not in AXIS_FORMS:
        if form in DISTRIBUTION_FORMS:
            raise ValueError(f"an axis; a distribution goes under [{parameter.section}]")
        raise ValueError(f"a list, or a table with one of {forms}{nearest(form, [*AXIS_FORMS])}")
    if not isinstance(ends, list):
        raise ValueError(f"{form} = {AXIS_FORMS[form]}")  # noqa: TRY004  (a fault of the file)
    values = ends if form == "values" else _expand(form, ends, quota)
    if len(values) == 0:
        raise ValueError("at least one value")
    if isinstance(values, range) and parameter.types == (int,):
        for end in (values[0], values[-1]):
            parameter.check(end)
        return Axis(parameter.name, values, parameters=(parameter,))
    if len(values) > quota:
        raise _too_many()
    if form != "values" and float in parameter.types:
        # All are numbers: if the least and the largest are admitted, all are.
        for end in (min(values), max(values)):
            _checked(parameter, end)
        checked = list(map(float, values))
    else:
        checked = [_checked(parameter, value) for value in values]
    counts = collections.Counter(checked)
    if not repeats and len(counts) < len(checked):
        raise ValueError(f"each value once ({shown(counts.most_common(1)[0][0])} is repeated)")
    return Axis(parameter.name, tuple(checked), parameters=(parameter,))


def zipped_axis(
    name: str, columns: Mapping[str, Sequence[Any]],
    parameters: Mapping[str, Parameter] = PARAMETERS,
) -> Axis:
    """Return the axis along which parameters go together, of ``parameters`` by their names.

    Raises
    ------
    ValueError
        The expectation, if their values are not equally many, they belong to different stages, or
        a combination is repeated.

    Examples
    --------
    >>> zipped_axis("lens", {"fx_px": (600.0, 800.0), "fy_px": (600.0, 802.5)}).values
    ('600, 600', '800, 802.5')
    """
    lengths = {parameter: len(values) for parameter, values in columns.items()}
    if len(set(lengths.values())) > 1:
        counts = ", ".join(f"{parameter} has {length:,}" for parameter, length in lengths.items())
        raise ValueError(f"equally many values of each parameter: {counts}")
    stages = {parameter: parameters[parameter].stage.name for parameter in columns}
    if len(set(stages.values())) > 1:
        listed = ", ".join(f"{parameter} is of the {stage}" for parameter, stage in stages.items())
        raise ValueError(f"parameters of one stage: {listed}")
    rows = collections.Counter(zip(*columns.values(), strict=True))
    labels = tuple(", ".join(map(_short, row)) for row in rows)
    if len(rows) < next(iter(lengths.values())):
        repeated = labels[list(rows.values()).index(max(rows.values()))]
        raise ValueError(f"each combination once ({plain(repeated)} is repeated)")
    if len(set(labels)) < len(labels):
        labels = tuple(f"{k}: {text}" for k, text in enumerate(labels))
    return Axis(
        name, labels, tuple((key, tuple(values)) for key, values in columns.items()),
        tuple(parameters[key] for key in columns),
    )


def _short(value: Any) -> str:
    """Return a value as a label; a whole number without its decimals."""
    whole = isinstance(value, float) and value == int(value) and abs(value) < 1e15
    return str(int(value)) if whole else label(value)


def _checked(parameter: Parameter, value: Any) -> Any:
    try:
        return parameter.check(value)
    except ValueError as error:
        expected, semicolon, hint = str(error).partition("; did you mean")
        raise ValueError(f"{expected} (not {shown(value)}){semicolon}{hint}") from None


def _too_many() -> ValueError:
    return ValueError(f"at most {MAX_LISTED:,} values, all axes together")


def _expand(form: str, ends: list[Any], quota: int) -> Sequence[Any]:
    """Return the values of a form that generates them."""
    sound = len(ends) in ((2, 3) if form == "range" else (3,)) and _are_numbers(ends)
    if not sound or not _SOUND[form](*ends):
        raise ValueError(f"{form} = {AXIS_FORMS[form]}")
    if form == "range":
        if len(values := range(*ends)) > MAX_VALUES:
            raise ValueError(f"at most {MAX_VALUES:,} values")
        return values
    if form == "arange":
        start, stop, step = (float(end) for end in ends)
        steps = (stop - start) / step
        if steps > quota:
            raise _too_many()
        # Half-open also if the last step misses the stop only by rounding.
        count = math.ceil(steps - 1e-9) if steps > 0 else 0
        if all(isinstance(end, int) for end in ends):
            return range(*ends)
        return [start + step * i for i in range(count)]
    if ends[2] > quota:
        raise _too_many()
    spaced = np.linspace if form == "linspace" else np.geomspace
    return list(map(float, spaced(*ends)))


_SOUND: dict[str, Callable[..., bool]] = {
    "range": lambda *ends: ends[2:] != (0,) and all(
        isinstance(end, int) and abs(end) <= 2**62 for end in ends),
    "arange": lambda _start, _stop, step: step != 0,
    "linspace": lambda _first, _last, count: isinstance(count, int) and count >= 1,
    "geom": lambda first, last, count: (
        isinstance(count, int) and count >= 1 and first > 0 and last > 0),
}
"""Form of an axis -> whether its numbers, as many as it has, can be."""


def combinations(axes: Sequence[Axis]) -> list[dict[str, Any]]:
    """Return the parameters' values at all combinations of axes, the last axis fastest."""
    rows = ([axis.at(index) for index in range(len(axis))] for axis in axes)
    return [
        {name: value for row in chosen for name, value in row.items()}
        for chosen in itertools.product(*rows)
    ]
