"""The data of a report: roles of axes, analyses by configuration, configurations compared."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy import special

from sweep.analysis import error_statistics, requirements
from sweep.analysis.comparisons import paired_tables
from sweep.analysis.dataset import QUANTITIES, SIZE_AXES, is_grid_axis, of_photographs, sections_of
from sweep.analysis.estimator import LEVEL
from sweep.analysis.requirements import ANGLE_AXES, SIZES_BESIDE, conditions, parse_requirements
from sweep.errors import texts_of
from sweep.execution.status import Totals, account_of
from sweep.experiment.experiment import distinct, used_settings, wrong_configurations
from sweep.experiment.grid import TRIAL
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.report.table import Column, Table, Value, axis_label, column, draws_text, number
from sweep.store.lifecycle import check_files, open_dataset, open_finished
from sweep.tradeoff import verdicts
from sweep.tradeoff.pareto import WRONG, conditions_of, configuration_label
from sweep.tradeoff.verdicts import BETTER, VERDICTS, WORSE, first_verdict, verdict
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# Groups of poses that a figure compares, and the labels of groups.

BOTH = (Stage.detection, Stage.estimation)
AREA = "marker_area_px"
IDS = "marker_id"
#: Dimension of tables that have a row for each configuration.
CONFIGURATION = "configuration"

#: Bins of the area, and of a drawn parameter.
DRAWN_BINS = 10


#: Axis, area or drawn parameter -> edges of the bins that are groups; None: each value is one.
Groups = Mapping[str, tuple[float, ...] | None]


def bins_of(values: Floats, most: int) -> tuple[float, ...]:
    """Return edges of bins of values (n,), of about as many each: at most so many, none empty.

    NaN, of trials that were not run, is left out.
    """
    edges = np.unique(np.nanquantile(values, np.linspace(0, 1, most + 1))).tolist()
    return (*edges[:-1], math.nextafter(edges[-1], math.inf))


# --------------------------------------------------------------------------------------------------
# The data of a report: a store's results, and the roles of its axes.

#: Results up to this size are read at once: many figures need the same values, and many small
#: chunks are slow to read.
MAX_READ_BYTES = 600_000_000

#: Areas vary if the largest exceeds the smallest by this factor.
AREA_RATIO = 2.0

Analysis = Callable[..., xr.Dataset]


@dataclass(frozen=True, eq=False)
class ReportData:
    """The results of a finished store, with the roles of its axes.

    Attributes
    ----------
    store
        Path or URL of the store.
    results
        Its dataset; lazy if it is large.
    pipeline
        The experiment.
    run_metadata
        Fingerprint, environment and dates of the run.
    trade
        The store's group ``cost/tradeoff``, or None.
    warnings
        Lines on cells that failed, or a run in which nothing was detected.
    require, per
        Requirements, as `sweep.analysis.check_requirements` takes them, and the conditions.
    command
        The command line that asked for the report; empty if none did.
    compared
        The configurations, by whether targets are told apart (`configurations`).
    """

    store: str
    results: xr.Dataset
    pipeline: Pipeline
    run_metadata: Mapping[str, Any]
    trade: xr.Dataset | None = None
    warnings: tuple[str, ...] = ()
    require: tuple[str, ...] = ()
    per: tuple[str, ...] = ()
    command: str = ""
    compared: dict[bool, Configurations] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        """Give a single pose, which has no axes, the one draw that it is."""
        if "detection" in self.results and not self.results["detection"].dims:
            object.__setattr__(self, "results", self.results.expand_dims({TRIAL: [0]}))

    # Roles of the axes.

    @property
    def size_axis(self) -> str | None:
        """The axis along which the marker's size in the image changes."""
        return next((name for name in SIZE_AXES if self.results.sizes.get(name, 1) > 1), None)

    @property
    def angle_axis(self) -> str | None:
        """The axis along which the marker is turned away: the tilt, or the viewing angle."""
        return next((name for name in ANGLE_AXES if self.results.sizes.get(name, 1) > 1), None)

    @functools.cached_property
    def areas(self) -> Floats:
        """Areas, px², of the poses that are seen (n,)."""
        values = np.ravel(self.results[AREA]).astype(np.float64)
        return np.asarray(values[np.isfinite(values) & (values > 0)])

    @property
    def size(self) -> str | None:
        """The measure of size: an axis, or the area if it varies, and not by an axis of angles."""
        if self.size_axis or self.angle_axis or not self.areas.size:
            return self.size_axis
        return AREA if self.areas.max() > AREA_RATIO * self.areas.min() else None

    @property
    def setting_axes(self) -> tuple[str, ...]:
        """Axes of the detector's and the estimator's settings that have several values."""
        return tuple(axis.name for axis in self.pipeline.axes_of(*BOTH) if len(axis) > 1)

    @property
    def scene_axes(self) -> tuple[str, ...]:
        """Axes of the scene that have several values, without the draws."""
        return tuple(
            axis.name for axis in self.pipeline.axes_of(Stage.scene)
            if len(axis) > 1 and axis.name != TRIAL
        )

    def label(self, name: str) -> str:
        """Return an axis' name with its unit, as on the axes of charts: ``distance, m``."""
        return axis_label(self.results, name)

    def words(self, name: str) -> str:
        """Return an axis' name without the unit, as in titles: ``distance``."""
        return self.label(name).partition(", ")[0]

    # Groups of poses.

    def along(self, name: str, most: int = 40) -> Groups:
        """Return the groups along an axis, the area, or a drawn parameter.

        A longer axis of numbers is binned, as the area and draws are.

        Raises
        ------
        KeyError
            If there is none of that name.
        """
        axis = self.pipeline.axis(name)
        if axis is not None and (len(axis) <= most or not axis.is_numeric):
            return {name: None}
        values = self.areas if name == AREA else np.ravel(self.results[name]).astype(np.float64)
        return {name: bins_of(values, DRAWN_BINS if axis is None else most)}

    def pooled(self, *kept: str) -> str:
        """Return a sentence that names the axes of the scene pooled over, all but ``kept``."""
        names = [name for name in self.scene_axes if name not in kept]
        return f"Pooled over {', '.join(names)}." if names else ""


def course_of(data: ReportData) -> tuple[str | None, tuple[str, ...]]:
    """Return how requirements are followed over the conditions.

    Returns
    -------
    The axis along which a limit is looked for, None if there is none; and the other axes of
    conditions, angles first.
    """
    conditions = [name for name in data.per if name not in data.setting_axes]
    numeric = {axis.name for axis in data.pipeline.axes if axis.is_numeric} & {*data.scene_axes}
    along = min((name for name in conditions if name in numeric), default=None, key=lambda name: (
        name != data.size_axis, name not in SIZES_BESIDE, name in ANGLE_AXES))
    others = (name for name in conditions if name != along)
    return along, tuple(sorted(others, key=lambda name: name not in ANGLE_AXES))


def read_report_data(
    url: str, require: Sequence[str] = (), per: Sequence[str] | None = None, command: str = ""
) -> ReportData:
    """Open a finished store for its report.

    Parameters
    ----------
    url
        Path or URL of the store.
    require, per
        Requirements, by default the pipeline's, and the dimensions whose values are
        conditions, by default those of `sweep.analysis.requirements`.
    command
        The command line that asked for the report.

    Raises
    ------
    ArgumentError
        For what cannot be required.
    StoreError
        If there is no store, it is not finished, or it cannot be read.
    """
    store = open_finished(url)
    trade = None
    if "cost/tradeoff/zarr.json" in store.run_metadata["files"]:
        check_files(store, tables=True)
        trade = xr.open_zarr(
            store.group.store, group="cost/tradeoff", consolidated=False, zarr_format=3
        ).load()
    results = open_dataset(store.url, MAX_READ_BYTES)
    required = texts_of("require", require) or store.pipeline.requirements
    return ReportData(
        store.url, results, store.pipeline, store.run_metadata, trade,
        tuple(account_of(store, Totals.of_finished(store))["warnings"]),
        tuple(each.text for each in parse_requirements(required)) if required else (),
        conditions(results, per, store.pipeline.require_per),
        command,
    )


# --------------------------------------------------------------------------------------------------
# The configurations of a store, the best first, and the beliefs that are not the truth.
#
# A configuration is a combination of detector and estimator settings, and of targets. They are
# compared, never pooled; of a store with very many some are chosen.

#: Configurations that a table or a figure of all of them compares.
MAX_CONFIGURATIONS = 30


@dataclass(frozen=True, eq=False)
class Configurations:
    """The n configurations that a report compares, the best first.

    Right beliefs stand first, of these the highest detection and solved rate, then the smallest
    RMSE of rotation and range.

    Attributes
    ----------
    axes
        Axis that tells them apart -> indices of the values that are compared.
    combinations
        Of each configuration, its place among these indices, by axis. Of those that differ only in
        settings that they do not use there is one.
    names
        Labels.
    wrong
        (n,) whether the estimator believes what is known not to be true; nowhere if that holds for
        all of them.
    summary
        `sweep.analysis.error_statistics` by configuration (n,).
    """

    axes: Mapping[str, list[int]]
    combinations: list[dict[str, int]]
    names: list[str]
    wrong: list[bool]
    summary: xr.Dataset


#: What tells configurations apart, and whether more of it is better.
RANKS = {"detection_rate": False, "solved_rate": False, "rotation_rmse_deg": True,
         "range_rmse_percent": True}


def configurations(data: ReportData, *, targets: bool = True) -> Configurations:
    """Return the configurations of a store, by targets, too, or with them pooled.

    If there are more than `MAX_CONFIGURATIONS`, values of the longest axes are chosen, evenly
    spaced. Of a store with neither settings nor targets to compare, by the values of its effects;
    without effects, by those of what else varies but poses and IDs.
    """
    if targets in data.compared:
        return data.compared[targets]
    settings = [axis for axis in data.pipeline.axes_of(*BOTH) if len(axis) > 1]
    several = [*(data.pipeline.experiment.target_axes if targets else ()), *settings]
    if targets and not several and not of_photographs(data.results):
        # Nothing else varies on the same draws: the values of an effect, such as noise or JPEG
        # quality, are compared; else those of a quiet zone, or a lens, whose draws are their own.
        others = [axis for axis in data.pipeline.axes if axis.name in data.scene_axes
                  and axis.name != IDS and "pose" not in sections_of(axis.name, data.results)]
        several = [axis for axis in others if not is_grid_axis(axis.name, data.results)] or others
    counts = {axis.name: len(axis) for axis in several}
    while math.prod(counts.values()) > MAX_CONFIGURATIONS and max(counts.values()) > 2:
        counts[max(counts, key=counts.__getitem__)] -= 1
    axes = {axis.name: np.linspace(0, len(axis) - 1, counts[axis.name]).round().astype(int).tolist()
            for axis in several}
    kept, summary = _of_each(data, axes, error_statistics, {})
    flags = np.reshape(wrong_configurations(data.pipeline, settings), list(map(len, settings)))
    wrong = [bool(flags[tuple(axes[axis.name][each[axis.name]] for axis in settings)])
             for each in kept]
    names = [label + WRONG * flag
             for label, flag in zip(summary[CONFIGURATION].values.tolist(), wrong, strict=True)]
    ranked = summary[[*RANKS]].to_dataframe().reset_index().assign(wrong=wrong)
    order = ranked.sort_values(
        ["wrong", *RANKS], ascending=[True, *RANKS.values()], kind="stable").index.tolist()
    data.compared[targets] = Configurations(
        axes, [kept[k] for k in order], [names[k] for k in order], [wrong[k] for k in order],
        summary.assign_coords({CONFIGURATION: names}).isel({CONFIGURATION: order}))
    return data.compared[targets]


def _of_each(
    data: ReportData, axes: Mapping[str, list[int]], analysis: Analysis, groups: Groups,
) -> tuple[list[dict[str, int]], xr.Dataset]:
    """Return the combinations that differ in settings that they use, and an analysis of each.

    It has the dimension ``configuration``, by label, in place of the axes.
    """
    every = [dict(zip(axes, index, strict=True)) for index in np.ndindex(*map(len, axes.values()))]
    values = {name: data.results[name].values[some].tolist() for name, some in axes.items()}
    settings = [{name: values[name][k] for name, k in each.items()} for each in every]
    kept = distinct(data.pipeline, settings)
    labels = [configuration_label(used_settings(data.pipeline, settings[k])) for k in kept]
    per = [*axes, *(name for name, edges in groups.items() if edges is None)]
    bins = {name: edges for name, edges in groups.items() if edges is not None}
    table = analysis(data.results.isel(axes), per=per, bins=bins)
    # Axes of settings with a single value tell nothing apart.
    single = [axis.name for axis in data.pipeline.axes_of(*BOTH) if len(axis) == 1]
    table = table.isel(dict.fromkeys(single, 0), missing_dims="ignore", drop=True)
    flat = table.stack({CONFIGURATION: [*axes]}, create_index=False) if axes else (
        table.expand_dims(CONFIGURATION))
    flat = flat.drop_vars([*axes], errors="ignore").isel({CONFIGURATION: kept})
    return [every[k] for k in kept], flat.assign_coords(
        {CONFIGURATION: labels}).transpose(CONFIGURATION, *groups, ...)


def grouped(
    data: ReportData, analysis: Analysis, groups: Groups | None = None,
    stages: Sequence[Stage] = BOTH,
) -> xr.Dataset:
    """Return an analysis by configuration and groups of poses.

    Parameters
    ----------
    data
        The store.
    analysis
        A function of `sweep.analysis` that takes results, per and bins.
    groups
        Its groups are dimensions of the result behind the configurations, in this order.
    stages
        Those whose settings make a difference: of the detection rate the detector's.

    Raises
    ------
    StoreError
        If the store cannot be read.
    """
    known, groups = configurations(data), groups or {}
    compared = {axis.name for axis in (
        *data.pipeline.experiment.target_axes, *data.pipeline.axes_of(*stages))} - groups.keys()
    axes = {name: some for name, some in known.axes.items() if name in compared}
    combinations, table = _of_each(data, axes, analysis, groups)
    # In the order of the configurations, the best first.
    ranked = [{name: each[name] for name in axes} for each in known.combinations]
    order = np.argsort([ranked.index(each) for each in combinations], kind="stable")
    return table.isel({CONFIGURATION: order})


def notes_of(data: ReportData, groups: Groups) -> str:
    """Return sentences for the reader about bins, and configurations that are left out."""
    return " ".join([*(
        f"{len(some)} of the {data.results.sizes[name]:,} values of {name} are shown."
        for name, some in configurations(data).axes.items()
        if len(some) < data.results.sizes[name] and name not in groups), *(
        f"Values of {name} are grouped into {len(edges) - 1} bins of about as many each."
        for name, edges in groups.items() if edges is not None)])


# --------------------------------------------------------------------------------------------------
# The configurations compared on the same images, and the one that is named best.

#: Poses flipped in one of two configurations alone from which an RMSE with flips is compared.
MIN_FLIPPED = 10

#: Numbers of each configuration, and of the named one in the report's cards.
CARDS = (
    *map(column, ("detection_rate", "solved_rate", "rotation_median_deg", "rotation_rmse_deg",
                  "range_rmse_percent")),
    Column("range bias without flips, %", "range_bias_percent", level=0.0), column("flip_rate"))

#: Differences, of two equal configurations 0, where large is good; and ratios, of these 1.
PAIRED = (
    Column("detection difference, points", "detection_difference", 100.0, 0.0),
    Column("solved difference, points", "solved_difference", 100.0, 0.0),
    Column("rotation RMSE ratio", "rotation_rmse_ratio", 1.0, 1.0),
    Column("range RMSE ratio", "range_rmse_ratio", 1.0, 1.0))
UNFLIPPED = Column("rotation RMSE ratio without flips", "rotation_rmse_unflipped_ratio", 1.0, 1.0)

#: Level of the intervals that decide: two equal configurations are told apart by any of the four
#: quantities with a probability of 5 % at most (Bonferroni). Intervals of 95 % are shown.
DECIDING_LEVEL = 1.0 - (1.0 - LEVEL) / len(PAIRED)


class Difference(NamedTuple):
    """One quantity of the best configuration against another one, on the images of both.

    Attributes
    ----------
    column, numbers
        The quantity, and its value with its 95 % interval, NaN without one.
    deciding
        The same with the interval that decides.
    draws
        Draws that both have.
    """

    column: Column
    numbers: Value
    deciding: Value
    draws: int

    @property
    def verdict(self) -> str:
        """One of `VERDICTS`: how the best one is."""
        return verdict(self.deciding.low, self.deciding.high, self.column.level or 0.0)

    @property
    def draws_needed(self) -> list[float]:
        """About how many draws would tell the two apart, and show that they are equivalent.

        Intervals (of ratios that of the logarithm) narrow with the root of the number of draws.
        The difference may be a standard error nearer to the bound than it seems, so that most runs
        with so many draws decide (`pytest -m evidence tests/report/test_trade_report.py`).
        """
        equal = self.column.level or 0.0
        with np.errstate(all="ignore"):
            ends = np.array([*self.deciding, *verdicts.EQUIVALENT_WITHIN[equal]])
            value, low, high, least, most = (np.log(ends) if equal else ends).tolist()
        half = max(value - low, high - value)  # the longer side: more than there are so far
        nearer = half / special.ndtri((1.0 + DECIDING_LEVEL) / 2.0)
        return [self.draws * (half / room) ** 2 if (room := gap - nearer) > 0.0 else math.inf
                for gap in (abs(value), min(value - least, most - value))]

    def as_json(self) -> dict[str, Any]:
        """Return it as JSON values."""
        words, _, unit = self.column.heading.partition(", ")
        return {"quantity": words, **self.numbers._asdict(), "unit": unit, "verdict": self.verdict}

    def __str__(self) -> str:
        words, _, unit = self.column.heading.partition(", ")
        return f"{words} {self.numbers}{f' {unit}' if unit else ''}: {self.verdict}"


@dataclass(frozen=True, eq=False)
class Comparison:
    """The configurations, and the best of them against each.

    Attributes
    ----------
    known
        The n configurations.
    best
        Number of the configuration that is named best.
    differences
        (n,) the best one against each: detection, solved, rotation, range; none against itself.
    circle
        Whether each that might be named is worse than another one of them.
    """

    known: Configurations
    best: int
    differences: list[tuple[Difference, ...]]
    circle: bool

    @property
    def name(self) -> str:
        """Label of the configuration that is named best."""
        return self.known.names[self.best]

    @property
    def verdicts(self) -> list[str]:
        """Whether the best one is better than each (n,): `overall`."""
        return [overall(pair) for pair in self.differences]

    @property
    def line(self) -> str:
        """The best configuration against the one that comes nearest to it, in one line."""
        names, wrong = self.known.names, self.known.wrong
        others = [k for k in range(len(names)) if k != self.best]
        if not others:
            return ""
        # The cost of a wrong belief is the question if nothing else varies.
        others = [k for k in others if not wrong[k]] or others
        rival = max(others, key=lambda k: VERDICTS.index(self.verdicts[k]))
        pair = self.differences[rival]
        shown = [each for each in pair if each.verdict in (BETTER, WORSE)] or [
            next((each for each in (*pair[2:], *pair) if each.verdict == self.verdicts[rival]
                  and not np.isnan(each.numbers.value)), pair[0])]
        words = "; ".join(filter(None, (*map(str, shown), more_draws(pair))))
        line = f"{'None is best: ' * self.circle}{self.name} against {names[rival]}: {words}"
        told = [self.verdicts[k] for k in others]
        words = ", ".join(f"{word} {told.count(word)}" for word in VERDICTS if word in told)
        return line if len(others) == 1 else f"{line} (of {len(others)} others: {words})"

    def table(self) -> Table:
        """Return a row for each configuration, with the best one's paired differences."""
        known, columns = self.known, [Column("n", "looked_for"), *CARDS]
        caption, headings = "Configurations, with 95 % intervals", [CONFIGURATION]
        cells = [each.cells(known.summary) for each in columns]
        if len(known.names) > 1:
            words = [verdict_words(pair) for pair in self.differences]
            words[self.best] = "best" if all(
                word == BETTER or known.wrong[k] for k, word in enumerate(self.verdicts)
                if k != self.best) else "named"
            pairs: list[list[Any]] = [[each.numbers for each in pair] or [None] * len(PAIRED)
                                      for pair in self.differences]
            headings.append("verdict")
            cells = [words, *cells, *map(list, zip(*pairs, strict=True))]
            columns += PAIRED
            caption += (
                f"; differences, ratios: {self.name} against each; verdict: each "
                "against it (equivalent: within 1 point of a rate, 5 % of an RMSE); rotation "
                "without flips where few poses differ by them")
        return Table.of(caption, [*headings, *(each.heading for each in columns)],
                        list(zip(known.names, *cells, strict=True)), stub=len(headings))

    def as_json(self) -> list[dict[str, Any]]:
        """Return the differences of the best configuration from each, as JSON values."""
        return [{"configuration": self.name, "against": name, "verdict": self.verdicts[k],
                 "draws_needed": draws_to_decide(self.differences[k]),
                 "differences": [each.as_json() for each in self.differences[k]]}
                for k, name in enumerate(self.known.names) if k != self.best]


def verdict_words(differences: Sequence[Difference]) -> str:
    """Return by what the other one is better or worse: ``worse: detection; better: range``."""
    first, other = overall(differences), {BETTER: WORSE, WORSE: BETTER}
    if first not in other:
        return ": ".join(filter(None, (first, more_draws(differences))))
    parts = [f"{other[verdict]}: {', '.join(names)}" for verdict in (first, other[first]) if (
        names := [each.column.heading.split()[0] for each in differences
                  if each.verdict == verdict])]
    return "; ".join(parts)


def draws_to_decide(differences: Sequence[Difference]) -> float:
    """Return about how many draws would decide on all quantities together.

    NaN if it is decided, and without intervals. They would show one of the quantities to be better
    or worse, or all to be equivalent.
    """
    without = np.isnan([each.deciding.low for each in differences]).all()  # a single draw, or none
    if without or overall(differences) != verdicts.NOT_DECIDED:
        return math.nan
    apart, within = zip(*(each.draws_needed for each in differences), strict=True)
    return requirements.rounded_draws(min(*apart, max(within)))


def more_draws(differences: Sequence[Difference]) -> str:
    """Return the draws of a comparison that is not decided, and how many would decide it."""
    needed = draws_to_decide(differences)
    return "" if math.isnan(needed) else draws_text(differences[0].draws, needed)


def overall(differences: Sequence[Difference]) -> str:
    """Return the verdict on all quantities together."""
    return first_verdict([each.verdict for each in differences])


def comparison(data: ReportData, among: Sequence[int] | None = None) -> Comparison:
    """Return the comparison of the configurations of a store.

    Targets along an axis are told apart, too; their scenes may be draws of their own, which makes
    the intervals of differences wider. The best configuration is one that no other is better than
    on the same images; it is looked for from the highest detection rate on, then the smallest RMSE
    of the rotation and of the range. None with a wrong belief is the best if there is another.

    Parameters
    ----------
    data
        The store.
    among
        Numbers of the configurations, with targets pooled, of which one may be the best, such as
        those that reach as far in what is required; by default all, by target.
    """
    known = configurations(data, targets=among is None)
    left = [k for k in range(len(known.names)) if among is None or k in among]
    results, usable = data.results.isel(known.axes), left[:]

    def differences(k: int, best: int) -> tuple[Difference, ...]:
        one, other = (results.isel(known.combinations[at], drop=True) for at in (k, best))
        return () if k == best else differences_of(one, other)

    tried: dict[int, list[tuple[Difference, ...]]] = {}
    beaten: dict[int, int] = {}
    while left and 0 not in beaten.values():
        best = left.pop(0)
        tried[best] = [differences(k, best) for k in range(len(known.names))]
        better = {k for k in usable
                  if overall(tried[best][k]) == WORSE and known.wrong[k] <= known.wrong[best]}
        beaten[best] = len(better)
        left.sort(key=lambda k: k not in better)
    # In a circle each is worse than another one: the one that is worse than the fewest.
    best = min(beaten, key=beaten.__getitem__)
    return Comparison(known, best, tried[best], beaten[best] > 0)


def differences_of(first: xr.Dataset, second: xr.Dataset) -> tuple[Difference, ...]:
    """Return how the second of two configurations differs from the first, on the same images.

    If few poses are flipped in one of the two alone, the rotation is compared without flips.
    """
    shown, deciding = paired_tables(
        first, second, (), None, QUANTITIES[:2], (LEVEL, DECIDING_LEVEL))
    few = 0 < int(shown["only_first_flipped"] + shown["only_second_flipped"]) < MIN_FLIPPED
    return tuple(
        Difference(each, numbers, ends, int(shown["draws"]))
        for each in (*PAIRED[:2], UNFLIPPED if few else PAIRED[2], PAIRED[3])
        for numbers, ends in zip(each.cells(shown), each.cells(deciding), strict=True))


# --------------------------------------------------------------------------------------------------
# Which configuration a measured trade recommends: the comparison, and what each costs.


def trade_lines(data: ReportData, trade: xr.Dataset, budget_ms: float | None = None) -> list[str]:
    """Return a line for each condition: the best configuration, and the cheapest as good.

    Parameters
    ----------
    data
        The store that was measured.
    trade
        With ``cost_ms`` by condition and configuration.
    budget_ms
        Most milliseconds a frame that a recommendation may take.
    """
    results = data.results
    if "renderer" in results.dims:
        results = results.isel(renderer=[results["renderer"].values.tolist().index("exact")])
    lines = []
    for label, at, part in conditions_of(trade):
        keep = {name: np.flatnonzero(results[name].values == value) for name, value in at.items()}
        here = dataclasses.replace(data, results=results.isel(keep), compared={})
        known = configurations(here, targets=False)
        # By pandas: NumPy 2.1 cannot copy an array of strings, as xarray does.
        names, cost = known.names, part["cost_ms"].to_series().reindex(known.names).tolist()
        usable = [k for k in np.argsort(cost, kind="stable").tolist()
                  if not known.wrong[k] and np.isfinite(cost[k])]
        within = [k for k in usable if budget_ms is None or cost[k] <= budget_ms]
        if within:
            found = comparison(here, within)
            cheapest = next(k for k in within if found.verdicts[k] != BETTER)
            budget = "" if budget_ms is None else f"within {budget_ms:g} ms a frame: "
            parts = [
                f"{budget}{found.name}, {number(cost[found.best])} ms a frame",
                f"not shown to be worse and cheaper is {names[cheapest]}, "
                f"{number(cost[cheapest])} ms" if cheapest != found.best else "", found.line]
        else:
            parts = [
                "nothing to recommend" if budget_ms is None else
                f"nothing fits {budget_ms:g} ms a frame",
                *(f"the nearest is {names[k]}, {number(cost[k])} ms" for k in usable[:1])]
        lines.append(": ".join(filter(None, (label, "; ".join(filter(None, parts))))))
    return lines
