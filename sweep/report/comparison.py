"""The configurations of a store compared on the same images, and the one that is named best."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.analysis import compare, error_statistics
from sweep.experiment.parameters import PARAMETERS
from sweep.report.figure import values_with_ends
from sweep.report.formatting import interval_text, number
from sweep.report.report_data import (
    CONFIGURATION,
    Configurations,
    ReportData,
    by_configuration,
    configurations,
    is_numeric,
    settings_of,
)
from sweep.report.table import Columns, Table, column_texts

MIN_FLIPPED = 10
"""Poses flipped in one of two configurations alone from which an RMSE with flips is compared."""

COLUMNS: Columns = {
    "n": ("looked_for", 1.0),
    "detected, %": ("detection_rate", 100.0),
    "solved, %": ("solved_rate", 100.0),
    "rotation median, deg": ("rotation_median_deg", 1.0),
    "rotation RMSE, deg": ("rotation_rmse_deg", 1.0),
    "range RMSE, %": ("range_rmse_percent", 1.0),
    "range bias, %": ("range_bias_percent", 1.0),
    "flips, %": ("flip_rate", 100.0),
}
"""Heading -> variable of `sweep.analysis.error_statistics`, and its factor."""

TARGET_SECTIONS = ("marker", "board", "target")
"""Sections of a pipeline whose parameters tell targets apart."""


class Quantity(NamedTuple):
    """A paired quantity by which one configuration is better than another.

    Attributes
    ----------
    words, variable, scale, unit
        Text, variable of `sweep.analysis.compare`, its factor and unit.
    equal
        Value of two equal configurations.
    large_is_good
        Whether values above ``equal`` are better.
    """

    words: str
    variable: str
    scale: float = 1.0
    unit: str = ""
    equal: float = 1.0
    large_is_good: bool = False


DETECTION = Quantity("detection difference", "detection_difference", 100.0, "points", 0.0, True)
SOLVED = Quantity("solved difference", "solved_difference", 100.0, "points", 0.0, True)
ROTATION = Quantity("rotation RMSE ratio", "rotation_rmse_ratio")
UNFLIPPED = Quantity("rotation RMSE ratio without flips", "rotation_rmse_unflipped_ratio")
RANGE = Quantity("range RMSE ratio", "range_rmse_ratio")

PAIRED = ("detection difference, points", "solved difference, points", "rotation RMSE ratio",
          "range RMSE ratio")
"""Headings of the paired quantities."""

VERDICTS = {1: "better", 0: "not decided", -1: "worse"}


@dataclass(frozen=True)
class Difference:
    """One quantity of the best configuration against another one, on the images of both.

    Attributes
    ----------
    quantity
        Its words.
    value, low, high, unit
        Value with its 95 % interval, NaN without one.
    verdict
        1: the best one is better; -1: it is worse; 0: not decided.
    """

    quantity: str
    value: float
    low: float
    high: float
    unit: str
    verdict: int

    @property
    def numbers(self) -> str:
        """Value and interval as text."""
        interval = "" if np.isnan(self.low) and np.isnan(self.high) else (
            f" ({interval_text(self.low, self.high)})")
        return number(self.value) + interval

    @property
    def text(self) -> str:
        """All as text: ``range RMSE ratio 0.540 (0.520 to 0.560): better``."""
        unit = f" {self.unit}" if self.unit else ""
        return f"{self.quantity} {self.numbers}{unit}: {self.verdict_text}"

    @property
    def verdict_text(self) -> str:
        """The verdict as a word."""
        return VERDICTS[self.verdict]


@dataclass(frozen=True, eq=False)
class Comparison:
    """The configurations, and the best of them against each.

    Attributes
    ----------
    names, wrong
        The n labels, and whether the estimator has a wrong belief.
    summary
        `sweep.analysis.error_statistics` by configuration (n,).
    indices
        Index along each axis, of every configuration.
    best
        Number of the configuration that is named best.
    differences
        (n,) the best one against each: detection, solved, rotation, range; none against itself.
    """

    names: list[str]
    wrong: NDArray[np.bool_]
    summary: xr.Dataset
    indices: list[dict[str, int]]
    best: int
    differences: list[tuple[Difference, ...]]

    @property
    def several(self) -> bool:
        """Whether there is more than one."""
        return len(self.names) > 1

    def verdict(self, k: int) -> int:
        """Return whether the best one is better than another: by the first decided quantity."""
        return overall(self.differences[k])

    @property
    def line(self) -> str:
        """The best configuration against the one that comes nearest to it, in one line."""
        others = [k for k in range(len(self.names)) if k != self.best and not self.wrong[k]]
        if not others:
            return ""
        order = preferred(self.summary, self.wrong)
        rival = min(others, key=lambda k: (self.verdict(k), order.index(k)))
        pair = self.differences[rival]
        shown = [each for each in pair if each.verdict] or [
            next((each for each in pair[2:] if not np.isnan(each.value)), pair[0])]
        line = f"{self.names[self.best]} against {self.names[rival]}: " + "; ".join(
            each.text for each in shown)
        if len(others) > 1:
            counts = {verdict: sum(self.verdict(k) == verdict for k in others)
                      for verdict in VERDICTS}
            line += f" (of {len(others)} others: " + ", ".join(
                f"{VERDICTS[verdict]} {'against' if not verdict else 'than'} {count}"
                for verdict, count in counts.items() if count) + ")"
        return line

    def table(self) -> Table:
        """Return a row for each configuration, with the best one's paired differences."""
        texts = column_texts(self.summary, COLUMNS)
        caption = "Configurations, with 95 % intervals"
        rows = [[name, *values] for name, *values in zip(
            self.names, *texts.values(), strict=True)]
        if not self.several:
            return Table.of(caption, [CONFIGURATION, *texts], rows)
        beaten = any(self.verdict(k) < 0 and not self.wrong[k] for k in range(len(rows)))
        for k, pair in enumerate(self.differences):
            rows[k] += [each.numbers + " without flips" * (each.quantity == UNFLIPPED.words)
                        for each in pair] or [""] * len(PAIRED)
            rows[k].insert(1, verdict_words(pair) if k != self.best else
                           "named" if beaten else "best")
        return Table.of(
            f"{caption}; differences, ratios and verdict: {self.names[self.best]} against each, "
            "on the same images", [CONFIGURATION, "verdict", *texts, *PAIRED], rows, stub=2)

    def as_json(self) -> list[dict[str, Any]]:
        """Return the differences of the best configuration from each, as JSON values."""
        return [{"configuration": self.names[self.best], "against": name,
                 "verdict": VERDICTS[self.verdict(k)],
                 "differences": [dataclasses.asdict(each) | {"verdict": each.verdict_text}
                                 for each in self.differences[k]]}
                for k, name in enumerate(self.names) if k != self.best]


def verdict_words(differences: Sequence[Difference]) -> str:
    """Return by what one configuration is better or worse: ``better: detection; worse: range``."""
    first = overall(differences)
    parts = [f"{VERDICTS[verdict]}: {', '.join(names)}" for verdict in (first, -first) if (
        names := [each.quantity.split()[0] for each in differences if each.verdict == verdict])]
    return "; ".join(parts) if first else VERDICTS[0]


def overall(differences: Sequence[Difference]) -> int:
    """Return the verdict of the first quantity that is decided; 0 if none is."""
    return next((each.verdict for each in differences if each.verdict), 0)


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
        Numbers of `configurations` of which one may be the best, as those that reach as far in
        what is required; by default all. Targets are then pooled as there.
    """
    return data.once(f"comparison {among}", lambda: _comparison(data, among))


def target_axes(data: ReportData) -> tuple[str, ...]:
    """Return the axes of the scene along which targets differ by more than a number."""
    return tuple(
        axis.name for axis in data.pipeline.axes
        if axis.name in data.scene_axes and not is_numeric(axis) and any(
            PARAMETERS[name].section in TARGET_SECTIONS for name in axis.columns
            if name in PARAMETERS))


def _comparison(data: ReportData, among: Sequence[int] | None) -> Comparison:
    known = configurations(data)
    settings, names, wrong, summary = known.settings, known.names, known.wrong, known.summary
    targets = target_axes(data) if among is None else ()
    if targets:
        settings = settings_of(data, also=targets)
        names, summary = by_configuration(
            data.pipeline, data.analysed(error_statistics, settings.grouping),
            settings.grouping.dims)
        wrong = np.array([_is_wrong(known, each) for each in settings.combinations])
    indices = settings.combinations
    usable = [k for k in preferred(summary, wrong) if among is None or k in among]
    tried: dict[int, list[tuple[Difference, ...]]] = {}
    left, best = list(usable), usable[0]
    while len(indices) > 1 and left:
        best = left.pop(0)
        tried[best] = _against_each(data, indices, best, settings.grouping)
        better = _better(tried[best], usable, wrong, best)
        if not better:
            break
        left = [k for k in better if k in left] + [k for k in left if k not in better]
    else:
        # In a circle each is worse than another one: the one that is worse than the fewest.
        best = min(tried, default=best, key=lambda k: len(_better(tried[k], usable, wrong, k)))
    return Comparison(names, wrong, summary, indices, best, tried.get(best, [()]))


def _better(
    differences: Sequence[Sequence[Difference]], usable: Sequence[int], wrong: NDArray[np.bool_],
    best: int,
) -> list[int]:
    """Return the configurations that are better than one, and may be named in its place."""
    return [k for k in usable if overall(differences[k]) < 0 and wrong[k] <= wrong[best]]


def _is_wrong(known: Configurations, at: Mapping[str, int]) -> bool:
    """Return whether a configuration of one target has a wrong belief."""
    return any(
        bool(known.wrong[k]) and all(at.get(name, index) == index for name, index in each.items())
        for k, each in enumerate(known.settings.combinations))


def preferred(summary: xr.Dataset, wrong: NDArray[np.bool_]) -> list[int]:
    """Return the configurations by detection rate, then rotation RMSE, then range RMSE."""
    def column(name: str, missing: float) -> NDArray[np.float64]:
        values = summary[name].values.astype(np.float64)
        return np.where(np.isnan(values), missing, values)

    order = np.lexsort((
        column("range_rmse_percent", np.inf), column("rotation_rmse_deg", np.inf),
        -column("solved_rate", -1.0), -column("detection_rate", -1.0), wrong))
    listed: list[int] = order.tolist()
    return listed


def _against_each(
    data: ReportData, indices: Sequence[Mapping[str, int]], best: int, grouping: Any
) -> list[tuple[Difference, ...]]:
    """Return the differences of one configuration from each, of no quantity from itself."""
    chosen = {name: list(some) for name, some in grouping.chosen}
    reference = with_configuration(data.results, indices[best]).isel(chosen)
    table = data.once(("against", tuple(indices[best].items()), grouping), lambda: compare(
        data.results.isel(chosen), reference, grouping.dims))
    _, rows = by_configuration(data.pipeline, table, grouping.dims)
    return [() if k == best else _differences(rows.isel({CONFIGURATION: k}))
            for k in range(len(indices))]


def _differences(row: xr.Dataset) -> tuple[Difference, ...]:
    flipped = int(row["only_first_flipped"]) + int(row["only_second_flipped"])
    rotation = UNFLIPPED if 0 < flipped < MIN_FLIPPED else ROTATION
    out = []
    for each in (DETECTION, SOLVED, rotation, RANGE):
        value, low, high = (
            float(end) for end in values_with_ends(row, each.variable, each.scale))
        above, below = low > each.equal, high < each.equal
        verdict = int(above) - int(below) if each.large_is_good else int(below) - int(above)
        out.append(Difference(each.words, value, low, high, each.unit, verdict))
    return tuple(out)


def with_configuration(results: xr.Dataset, at: Mapping[str, int]) -> xr.Dataset:
    """Return results in which every configuration has the values of one.

    ``at`` has the index of that one along each axis of configurations.
    """
    replaced = {}
    for name, variable in results.data_vars.items():
        dims = {dim: index for dim, index in at.items() if dim in variable.dims}
        if dims:
            one = variable.isel(dims, drop=True)
            replaced[name] = one.expand_dims({dim: results[dim] for dim in dims}).transpose(
                *variable.dims)
    return results.assign(replaced)
