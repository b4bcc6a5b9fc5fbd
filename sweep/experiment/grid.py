"""The grid: axes and distributions, the values of every parameter, blocks of scene cells."""

from __future__ import annotations

import collections
import itertools
import math
import operator
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from functools import cached_property, reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.experiment.parameters import ONE_VALUE, PARAMETERS, Parameter, Stage, parameters_with
from sweep.messages import label, nearest, plain, shown
from sweep.model.board_kinds import ARRANGING, SINGLE, Markers, arranged
from sweep.model.calibration import CalibrationError
from sweep.plugins.loading import DeclaredPlugin
from sweep.typing import Floats

#: The axis of repeated draws; a scene dimension with coordinates 0, 1, 2, ...
TRIAL = "trial"

#: The longest axis (``range`` and ``trial``; they are never written out).
MAX_VALUES = 10**9

#: The longest axis of any other form; also the most values of all such axes together.
MAX_LISTED = 10**6


@dataclass(frozen=True, slots=True)
class Axis:
    """A dimension of the grid.

    Attributes
    ----------
    name
        A parameter's, ``trial``, or a name of the user's own if parameters go together along it.
    columns
        Parameter (or ``trial``) -> its values along the axis.
    parameters
        Its parameters; none of ``trial``.
    labels
        A label of each combination of parameters that go together; empty for a single one.
    """

    name: str
    columns: Mapping[str, Sequence[Any]]
    parameters: tuple[Parameter, ...] = field(default=(), compare=False)
    labels: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.values)

    @property
    def zipped(self) -> bool:
        """Whether parameters go together along it."""
        return bool(self.labels)

    @property
    def values(self) -> Sequence[Any]:
        """Its values, without repeats; labels if parameters go together."""
        return self.labels or self.columns[self.name]

    def at(self, index: int) -> dict[str, Any]:
        """Return the value of each of its parameters at an index."""
        return {name: values[index] for name, values in self.columns.items()}

    def index_of(self, wanted: Mapping[str, Any]) -> int | None:
        """Return the first index at which its parameters have the wanted values; None without."""
        names = self.columns.keys() & wanted.keys()
        if names == {self.name}:  # also of a long range
            values = self.values
            return values.index(wanted[self.name]) if wanted[self.name] in values else None
        rows = range(len(self))
        return next(
            (i for i in rows if all(self.columns[name][i] == wanted[name] for name in names)), None)

    def rows(self, parameters: Collection[str], *, ends: bool) -> list[dict[str, Any]]:
        """Return the values of some parameters along it, each combination once (`Grid.rows`)."""
        columns = {name: values for name, values in self.columns.items() if name in parameters}
        numbers, *others = columns.values()
        if ends and not others and all(type(value) in (int, float) for value in (
                numbers[:1] if isinstance(numbers, range) else numbers)):
            columns = dict.fromkeys(columns, sorted({min(numbers), max(numbers)}))
        rows = dict.fromkeys(zip(*columns.values(), strict=True))
        return [dict(zip(columns, row, strict=True)) for row in rows]

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
        return self.parameters[0].meaning if self.parameters else "number of the draw"

    @property
    def kind(self) -> type:
        """Type of its coordinates: of its values, if all are booleans or numbers; else strings."""
        kinds = {int} if isinstance(self.values, range) else set(map(type, self.values))
        return kinds.pop() if kinds in ({bool}, {int}, {float}) else str

    @property
    def is_numeric(self) -> bool:
        """Whether its values are numbers, and not labels or switches."""
        return self.kind in (int, float)

    def coordinates(self, start: int = 0, stop: int | None = None) -> NDArray[Any]:
        """Return the values [start, stop) as coordinates: numbers, booleans or strings."""
        part = self.values[start:stop]
        if isinstance(part, range):
            return np.arange(part.start, part.stop, part.step, dtype=np.int64)
        if self.kind is str:
            return np.array([label(value) for value in part], dtype=np.dtypes.StringDType())
        return np.array(part, dtype=self.kind)


#: The largest distance of a normal draw of 53 bits from its mean, in standard deviations.
MAX_DEVIATIONS = 8.3

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


#: Forms in which the values of an axis are generated -> their numbers, in words.
AXIS_FORMS = {
    "range": "[start, stop] or [start, stop, step], whole numbers, half-open",
    "arange": "[start, stop, step], half-open",
    "linspace": "[first, last, count], both inclusive",
    "geom": "[first, last, count], both inclusive, above 0",
}

DISTRIBUTION_FORMS = {"uniform": "[a, b] with a < b", "normal": "[mean, sd] with sd > 0"}


def parse_distribution(parameter: Parameter, table: dict[str, Any]) -> Distribution:
    """Return the distribution of a table such as ``{ uniform = [a, b] }``.

    Raises
    ------
    ValueError
        The expectation, if the table is not a distribution of the parameter.
    """
    kind, ends = next(iter(table.items()), ("", []))
    if len(table) != 1 or kind not in DISTRIBUTION_FORMS:
        if kind in (*AXIS_FORMS, "values"):
            raise ValueError("one value here; more than one goes under [axes]")
        forms = " or ".join(f"{{ {each} = {form} }}" for each, form in DISTRIBUTION_FORMS.items())
        raise ValueError(f"{parameter.expected()}, or {forms}")
    if not parameter.drawable:
        drawable = ", ".join(p.name for p in PARAMETERS.values() if p.drawable)
        raise ValueError(f"a fixed value; only these can be drawn: {drawable}")
    if not _are_numbers(ends, 2) or not ends[1] > (ends[0] if kind == "uniform" else 0):
        raise ValueError(f"{kind} = {DISTRIBUTION_FORMS[kind]}")
    a, b = map(float, ends)
    if kind == "uniform":
        parameter.check(a)
        parameter.check(b)
    elif not all(parameter.admits(a + side * MAX_DEVIATIONS * b) for side in (-1, 1)):
        extent = parameter.range_text()
        raise ValueError(f"mean - {MAX_DEVIATIONS} sd and mean + {MAX_DEVIATIONS} sd {extent}")
    return Distribution(kind, a, b)


def _are_numbers(values: Any, *lengths: int) -> bool:
    """Return whether a value of the document is a list of numbers of one of some lengths."""
    return isinstance(values, list) and len(values) in lengths and all(
        type(value) in (int, float) and abs(value) < 1e300 for value in values)


def trial_numbers(value: Any) -> range:
    """Return the values of ``trial = N``; ValueError with the expectation if N is not a count."""
    if type(value) is not int or not 1 <= value <= MAX_VALUES:
        raise ValueError(f"a whole number from 1 to {MAX_VALUES:,}: how many draws")
    return range(value)


def axis_values(
    parameter: Parameter, given: Any, quota: int = MAX_LISTED, *, repeats: bool = False
) -> Sequence[Any]:
    """Return the values of a list or of a table such as ``{ geom = [0.05, 1, 40] }``.

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
    >>> axis_values(PARAMETERS["tilt_deg"], {"linspace": [0, 60, 3]})
    (0.0, 30.0, 60.0)
    """
    table = {"values": given} if isinstance(given, list) else given
    form, ends = next(iter(table.items()), ("", [])) if isinstance(table, dict) else ("", [])
    if parameter.name in ONE_VALUE:
        raise ValueError(f"one value under [{parameter.section}]: it cannot be an axis")
    if form == "zip":
        raise ValueError(f"an axis of {parameter.name} alone; parameters that go together need a "
                         "name of your own, such as pair = { zip = { ... } }")
    if form in DISTRIBUTION_FORMS:
        raise ValueError(f"an axis; a distribution goes under [{parameter.section}]")
    known = [*AXIS_FORMS, "values"]
    if form not in known or len(table) != 1:
        raise ValueError(f"a list, or a table with one of {', '.join(known)}{nearest(form, known)}")
    if form in AXIS_FORMS:
        values = _generated(parameter, form, ends, quota)
    elif not isinstance(ends, list):
        raise ValueError(f"{form} = a list")
    elif not 0 < len(ends) <= quota:
        raise ValueError(TOO_MANY if ends else "at least one value")
    else:
        values = tuple(_checked(parameter, value) for value in ends)
    if not repeats and not isinstance(values, range):
        value, count = collections.Counter(values).most_common(1)[0]
        if count > 1:
            raise ValueError(f"each value once ({shown(value)} is repeated)")
    return values


def _generated(parameter: Parameter, form: str, ends: Any, quota: int) -> Sequence[Any]:
    """Return the values of a form that generates them; a ``range`` is not written out."""
    numbers = _are_numbers(ends, *((2, 3) if form == "range" else (3,)))
    integers = numbers and all(type(end) is int and abs(end) < 2**62 for end in ends)
    spaced: Any = {"linspace": np.linspace, "geom": np.geomspace}.get(form)
    count = 0
    if spaced is not None:
        sound = numbers and type(ends[2]) is int and (form == "linspace" or min(ends) > 0)
        count = ends[2] if sound else 0
    elif integers and 0 not in ends[2:]:
        count = len(range(*ends))
    elif numbers and form == "arange" and ends[2]:
        steps = (float(ends[1]) - float(ends[0])) / ends[2]
        # Half-open also if the last step misses the stop only by rounding.
        count = math.ceil(min(max(steps, 0.0), 2.0 * MAX_VALUES) - 1e-9)
    if count < 1:
        raise ValueError(f"{form} = {AXIS_FORMS[form]}, at least one value")
    whole = parameter.types == (int,)
    if count > (MAX_VALUES if whole and form == "range" else quota):
        raise ValueError(f"at most {MAX_VALUES:,} values" if form == "range" else TOO_MANY)
    values: Any = spaced(*ends) if spaced is not None else range(*ends) if integers else [
        float(ends[0]) + float(ends[2]) * index for index in range(count)]
    # All are numbers: if the least and the largest are admitted, all are.
    for end in (values[0], values[-1]):
        _checked(parameter, end)
    return values if whole else tuple(map(float, values))


TOO_MANY = f"at most {MAX_LISTED:,} values, all axes together"


def axis_along(
    name: str, columns: Mapping[str, Sequence[Any]],
    parameters: Mapping[str, Parameter] = PARAMETERS, *, together: bool = True,
) -> Axis:
    """Return the axis of the values of one parameter, or of several that go together.

    Raises
    ------
    ValueError
        The expectation, if their values are not equally many, they belong to different stages, or
        a combination is repeated.

    Examples
    --------
    >>> axis_along("lens", {"fx_px": (600.0, 800.0), "fy_px": (600.0, 802.5)}).values
    ('600, 600', '800, 802.5')
    """
    members = tuple(parameters[key] for key in columns if key != TRIAL)
    if not together:
        return Axis(name, columns, members)
    if len({len(values) for values in columns.values()}) > 1:
        counts = ", ".join(f"{key} has {len(values):,}" for key, values in columns.items())
        raise ValueError(f"equally many values of each parameter: {counts}")
    if len({each.stage for each in members}) > 1:
        listed = ", ".join(f"{each.name} is of the {each.stage.name}" for each in members)
        raise ValueError(f"parameters of one stage: {listed}")
    rows = list(zip(*columns.values(), strict=True))
    labels = tuple(", ".join(map(_short, row)) for row in rows)
    row, count = collections.Counter(rows).most_common(1)[0]
    if count > 1:
        raise ValueError(f"each combination once ({plain(labels[rows.index(row)])} is repeated)")
    if len(set(labels)) < len(labels):
        labels = tuple(f"{k}: {text}" for k, text in enumerate(labels))
    return Axis(name, {key: tuple(values) for key, values in columns.items()}, members, labels)


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


# --------------------------------------------------------------------------------------------------
# Common to a document and the pipeline that is read from it: values on a grid.

@dataclass(frozen=True)
class Grid:
    """The value, the axis or the distribution of every parameter.

    Attributes
    ----------
    seed, sampling
        The seed of all random draws, and how those of a cell's trials relate
        (:data:`sweep.experiment.draws.SAMPLINGS`).
    fixed
        Value of every parameter that is neither an axis nor drawn.
    given
        Names of the parameters that the document has, even with a value that cannot be.
    distributions
        Distribution of every parameter that is drawn per trial.
    axes
        The grid's dimensions, in the document's order.
    plugins
        The plug-ins that the document names.
    files
        Path as written -> SHA-256 of every file that the document refers to.
    folder
        Where relative paths start.
    """

    seed: int
    sampling: str
    fixed: dict[str, Any]
    given: AbstractSet[str]
    distributions: dict[str, Distribution]
    axes: Sequence[Axis]
    plugins: tuple[DeclaredPlugin, ...]
    files: dict[str, str]
    folder: str

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """Every parameter by its name: our own, and the settings of its plug-ins."""
        return parameters_with(self.plugins)

    def plugin(self, kind: str, name: str) -> DeclaredPlugin | None:
        """Return the plug-in of a kind by its name; None if it is not one of the document's."""
        return next((p for p in self.plugins if (p.kind, p.name) == (kind, name)), None)

    def axis(self, name: str) -> Axis | None:
        """Return an axis by name."""
        return next((axis for axis in self.axes if axis.name == name), None)

    def axis_of(self, parameter: str) -> Axis | None:
        """Return the axis along which a parameter varies, alone or together with others."""
        return next(iter(self.axes_with([parameter])), None)

    def axes_with(self, parameters: Iterable[str]) -> list[Axis]:
        """Return the axes along which some parameters vary, in the document's order."""
        return [axis for axis in self.axes if not axis.columns.keys().isdisjoint(parameters)]

    def rows(self, parameters: Collection[str], *, ends: bool = False) -> Iterator[dict[str, Any]]:
        """Yield the values of some parameters at all combinations of their axes, the last fastest.

        One that is drawn, or at fault, has none. ``ends``: of numbers that vary by themselves the
        least and the largest alone.
        """
        fixed = {name: self.fixed[name] for name in parameters if name in self.fixed}
        rows = (axis.rows(parameters, ends=ends) for axis in self.axes_with(parameters))
        return (reduce(operator.or_, chosen, fixed) for chosen in itertools.product(*rows))

    def axes_of(self, *stages: Stage) -> tuple[Axis, ...]:
        """Return the axes that bind to the given stages, in the document's order."""
        return tuple(axis for axis in self.axes if axis.stage in stages)

    def size(self, *stages: Stage) -> int:
        """Return the number of grid points over the axes of the given stages."""
        return math.prod(len(axis) for axis in self.axes_of(*stages))

    def values_of(self, name: str) -> Sequence[Any]:
        """Return the values of a parameter on the grid; empty if it is drawn, or at fault."""
        if (axis := self.axis_of(name)) is not None:
            return axis.columns[name]
        return (self.fixed[name],) if name in self.fixed else ()

    def any_value(self, name: str, condition: Callable[[Any], bool]) -> bool:
        """Return whether a parameter takes a value for which ``condition`` holds."""
        return any(condition(value) for value in self.values_of(name) if value is not None)

    @property
    def calibration(self) -> CalibrationError | None:
        """The error of the calibration that an estimator believes; None if none does."""
        if "calibration" not in self.values_of("believed"):
            return None
        sd, covariance = self.fixed["calibration_sd"], self.fixed["calibration_covariance"]
        count = len(sd) or round(len(covariance) ** 0.5)
        return CalibrationError.of(sd, covariance, count - 4)

    def arrangements(self) -> Iterator[tuple[Any, ...]]:
        """Yield the values of `ARRANGING` of each combination of their axes."""
        for row in self.rows(ARRANGING):
            yield tuple(row[name] for name in ARRANGING)

    @property
    def shows_boards(self) -> bool:
        """Whether scenes show boards, or something beside a marker; all markers are boards then."""
        return any(self.values_of("distractors")) or self.any_value(
            "kind", lambda kind: kind != SINGLE)

    @property
    def target_word(self) -> str:
        """The targets of the scenes, in a word: marker, board, or target if both."""
        if not self.shows_boards:
            return "marker"
        return "target" if self.any_value("kind", lambda kind: kind == SINGLE) else "board"

    @cached_property
    def largest_board(self) -> tuple[int, int]:
        """The most markers and the most chessboard corners of a target."""
        counts = [arranged(values).counts for values in self.arrangements()
                  ] if self.shows_boards else [(1, 0)]
        return max(markers for markers, _ in counts), max(corners for _, corners in counts)

    @property
    def relative_sizes(self) -> tuple[float, float]:
        """The least and the largest side of a marker over ``size_m``: listed ones have own."""
        listed = [
            each.size_m / values[ARRANGING.index("size_m")]
            for values in self.arrangements()
            if isinstance(board := arranged(values), Markers) for each in board.markers
        ] if self.any_value("markers", bool) else []
        return min(listed, default=1.0), max(listed, default=1.0)

    @property
    def is_simulated(self) -> bool:
        """Whether images are simulated at the poses of photographs."""
        return self.fixed.get("simulated") is True

    @property
    def shows_photographs(self) -> bool:
        """Whether the images are photographs, not simulated at their poses."""
        return "photographs" in self.given and not self.is_simulated


# --------------------------------------------------------------------------------------------------
# Pieces of the grid: blocks of scene cells, and every parameter's values on them.

@dataclass(frozen=True, slots=True, order=True)
class Block:
    """A box of scene cells: half-open index ranges along the scene axes, in their order.

    It identifies a piece of the grid in tasks, receipts, logs and errors.

    >>> str(Block((0, 10), (5, 20)))
    '0-5,10-20'
    """

    starts: tuple[int, ...]
    stops: tuple[int, ...]

    @property
    def shape(self) -> tuple[int, ...]:
        """Cells along each scene axis."""
        return tuple(b - a for a, b in zip(self.starts, self.stops, strict=True))

    def __len__(self) -> int:
        return math.prod(self.shape)

    def indices(self, scenes: NDArray[np.intp] | None = None) -> list[NDArray[np.intp]]:
        """Return the indices (N,) along each scene axis of its scenes, by default of all.

        ``scenes`` (N,) are their numbers in the block, in which the last axis counts fastest.
        """
        numbers = np.arange(len(self)) if scenes is None else scenes
        within = np.unravel_index(numbers, self.shape) if self.shape else ()
        return [start + index for start, index in zip(self.starts, within, strict=True)]

    def cell(self, scene: int) -> tuple[int, ...]:
        """Return the indices of its scene number ``scene`` along each scene axis."""
        return tuple(int(index[0]) for index in self.indices(np.array([scene])))

    def __str__(self) -> str:
        pairs = zip(self.starts, self.stops, strict=True)
        return ",".join(f"{a}-{b}" for a, b in pairs) or "all"


@dataclass(frozen=True)
class Blocks:
    """The grid of scene cells cut into equal boxes, which are made on demand."""

    lengths: tuple[int, ...]
    extents: tuple[int, ...]

    @cached_property
    def counts(self) -> tuple[int, ...]:
        """Blocks along each scene axis."""
        return tuple(-(-a // b) for a, b in zip(self.lengths, self.extents, strict=True))

    def __len__(self) -> int:
        return math.prod(self.counts)

    def __iter__(self) -> Iterator[Block]:
        return (self[number] for number in range(len(self)))

    def index(self, number: int) -> tuple[int, ...]:
        """Return a block's indices along the scene axes by its number; the last counts fastest."""
        found = []
        for count in reversed(self.counts):
            number, at = divmod(number, count)
            found.append(at)
        return tuple(reversed(found))

    def __getitem__(self, number: int) -> Block:
        """Return a block by its number."""
        starts = tuple(map(operator.mul, self.index(number), self.extents))
        stops = map(operator.add, starts, self.extents)
        return Block(starts, tuple(map(min, stops, self.lengths)))

    def number(self, block: Block) -> int:
        """Return the number of a block."""
        if not self.counts:
            return 0
        index = np.floor_divide(block.starts, self.extents)
        return int(np.ravel_multi_index(index.tolist(), self.counts))
