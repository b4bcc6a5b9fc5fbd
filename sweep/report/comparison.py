"""The configurations of a store compared on the same images, and the one that is named best."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from sweep.analysis.comparisons import paired_tables
from sweep.analysis.dataset import QUANTITIES
from sweep.analysis.intervals import LEVEL
from sweep.report.report_data import CONFIGURATION, Configurations, ReportData, configurations
from sweep.report.table import Column, Table, Value, number
from sweep.tradeoff.pareto import WRONG, conditions_of

#: Poses flipped in one of two configurations alone from which an RMSE with flips is compared.
MIN_FLIPPED = 10

#: Numbers of each configuration, and of the named one in the report's cards.
CARDS = (
    Column("detected, %", "detection_rate", 100), Column("solved, %", "solved_rate", 100),
    Column("rotation median, deg", "rotation_median_deg"),
    Column("rotation RMSE, deg", "rotation_rmse_deg"),
    Column("range RMSE, %", "range_rmse_percent"),
    Column("range bias without flips, %", "range_bias_percent"),
    Column("flips, %", "flip_rate", 100),
)

# Of two equal configurations differences are 0, where large is good, and ratios 1.
DETECTION = Column("detection difference, points", "detection_difference", 100.0, 0.0)
SOLVED = Column("solved difference, points", "solved_difference", 100.0, 0.0)
ROTATION = Column("rotation RMSE ratio", "rotation_rmse_ratio", 1.0, 1.0)
UNFLIPPED = Column(
    "rotation RMSE ratio without flips", "rotation_rmse_unflipped_ratio", 1.0, 1.0)
RANGE = Column("range RMSE ratio", "range_rmse_ratio", 1.0, 1.0)
PAIRED = (DETECTION, SOLVED, ROTATION, RANGE)

#: Level of the intervals that decide: two equal configurations are told apart by any of the four
#: quantities with a probability of 5 % at most (Bonferroni). Intervals of 95 % are shown.
DECIDING_LEVEL = 1.0 - (1.0 - LEVEL) / len(PAIRED)

VERDICTS = {1: "better", 0: "not decided", -1: "worse"}


class Difference(NamedTuple):
    """One quantity of the best configuration against another one, on the images of both.

    Attributes
    ----------
    column, numbers
        The quantity, and its value with its 95 % interval, NaN without one.
    verdict
        1: the best one is better; -1: it is worse; 0: not decided.
    """

    column: Column
    numbers: Value
    verdict: int

    @property
    def text(self) -> str:
        """All as text: ``range RMSE ratio 0.540 (0.520 to 0.560): better``."""
        words, _, unit = self.column.heading.partition(", ")
        return f"{words} {self.numbers}{f' {unit}' if unit else ''}: {VERDICTS[self.verdict]}"

    def as_json(self) -> dict[str, Any]:
        """Return it as JSON values."""
        words, _, unit = self.column.heading.partition(", ")
        return {"quantity": words, **self.numbers._asdict(), "unit": unit,
                "verdict": VERDICTS[self.verdict]}


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
    """

    known: Configurations
    best: int
    differences: list[tuple[Difference, ...]]

    @property
    def name(self) -> str:
        """Label of the configuration that is named best."""
        return self.known.names[self.best]

    def verdict(self, k: int) -> int:
        """Return whether the best one is better than another: by the first decided quantity."""
        return overall(self.differences[k])

    @property
    def line(self) -> str:
        """The best configuration against the one that comes nearest to it, in one line."""
        known = self.known
        others = [k for k in range(len(known.names)) if k != self.best]
        if not others:
            return ""
        # The cost of a wrong belief is the question if nothing else varies.
        others = [k for k in others if not known.wrong[k]] or others
        rival = min(others, key=self.verdict)
        pair = self.differences[rival]
        shown = [each for each in pair if each.verdict] or [
            next((each for each in pair[2:] if not np.isnan(each.numbers.value)), pair[0])]
        counts = Counter(map(self.verdict, others))
        words = ", ".join(f"{VERDICTS[verdict]} {counts[verdict]}" for verdict in VERDICTS
                          if counts[verdict])
        return (f"{self.name} against {known.names[rival]}: "
                + "; ".join(each.text for each in shown)
                + (f" (of {len(others)} others: {words})" if len(others) > 1 else ""))

    def table(self) -> Table:
        """Return a row for each configuration, with the best one's paired differences."""
        known, columns = self.known, [Column("n", "looked_for"), *CARDS]
        caption, headings = "Configurations, with 95 % intervals", [CONFIGURATION]
        cells = [each.cells(known.summary) for each in columns]
        if known.several:
            best = all(self.verdict(k) > 0 or known.wrong[k]
                       for k in range(len(known.names)) if k != self.best)
            verdicts = [verdict_words(pair) for pair in self.differences]
            verdicts[self.best] = "best" if best else "named"
            nothing = [None] * len(PAIRED)
            pairs = [[each.numbers for each in pair] or nothing for pair in self.differences]
            headings.append("verdict")
            cells = [verdicts, *cells, *map(list, zip(*pairs, strict=True))]
            columns += PAIRED
            few = any(each.column is UNFLIPPED for pair in self.differences for each in pair)
            caption += (
                f"; differences, ratios and verdict: {self.name} against each, on the same images"
                + "; rotation without flips where few poses differ by them" * few)
        return Table.of(caption, [*headings, *(each.heading for each in columns)],
                        list(zip(known.names, *cells, strict=True)), stub=len(headings))

    def as_json(self) -> list[dict[str, Any]]:
        """Return the differences of the best configuration from each, as JSON values."""
        return [{"configuration": self.name, "against": name,
                 "verdict": VERDICTS[self.verdict(k)],
                 "differences": [each.as_json() for each in self.differences[k]]}
                for k, name in enumerate(self.known.names) if k != self.best]


def verdict_words(differences: Sequence[Difference]) -> str:
    """Return by what one configuration is better or worse: ``better: detection; worse: range``."""
    first = overall(differences)
    parts = [f"{VERDICTS[verdict]}: {', '.join(names)}" for verdict in (first, -first) if (
        names := [each.column.heading.split()[0] for each in differences
                  if each.verdict == verdict])]
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
        Numbers of the configurations, with targets pooled, of which one may be the best, such as
        those that reach as far in what is required; by default all, by target.
    """
    return data.once(f"comparison {among}", lambda: _comparison(data, among))


def _comparison(data: ReportData, among: Sequence[int] | None) -> Comparison:
    known = configurations(data, targets=among is None)
    usable = [k for k in range(len(known.names)) if among is None or k in among]
    results = data.results.isel(known.axes)
    tried: dict[int, list[tuple[Difference, ...]]] = {}

    def differences(k: int, best: int) -> tuple[Difference, ...]:
        one, other = (results.isel(known.combinations[at], drop=True) for at in (k, best))
        return () if k == best else data.once(
            ("differences", *known.axes, k, best), lambda: differences_of(one, other))

    def better_than(best: int) -> list[int]:
        return [k for k in usable
                if overall(tried[best][k]) < 0 and known.wrong[k] <= known.wrong[best]]

    left, best = list(usable), usable[0]
    while known.several and left:
        best = left.pop(0)
        tried[best] = [differences(k, best) for k in range(len(known.names))]
        better = better_than(best)
        if not better:
            break
        left = [k for k in better if k in left] + [k for k in left if k not in better]
    else:
        # In a circle each is worse than another one: the one that is worse than the fewest.
        best = min(tried, default=best, key=lambda k: len(better_than(k)))
    return Comparison(known, best, tried.get(best, [()]))


def differences_of(first: xr.Dataset, second: xr.Dataset) -> tuple[Difference, ...]:
    """Return how the second of two configurations differs from the first, on the same images.

    If few poses are flipped in one of the two alone, the rotation is compared without flips.
    """
    shown, deciding = paired_tables(
        first, second, (), None, QUANTITIES[:2], (LEVEL, DECIDING_LEVEL))
    flipped = int(shown["only_first_flipped"]) + int(shown["only_second_flipped"])
    rotation = UNFLIPPED if 0 < flipped < MIN_FLIPPED else ROTATION
    out = []
    for each in (DETECTION, SOLVED, rotation, RANGE):
        (numbers,), (ends,) = each.cells(shown), each.cells(deciding)
        verdict = int(ends.low > each.level) - int(ends.high < each.level)
        out.append(Difference(each, numbers, -verdict if each.level else verdict))
    return tuple(out)


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
        here = dataclasses.replace(data, results=results.isel(keep), made={})
        known = configurations(here, targets=False)
        cost = part["cost_ms"].reindex(treatment=known.names).values.tolist()
        usable = [k for k, name in enumerate(known.names)
                  if WRONG not in name and np.isfinite(cost[k])]
        within = [k for k in usable if budget_ms is None or cost[k] <= budget_ms]
        start = f"{label}: " if label else ""
        if not within:
            near = min(usable, key=lambda k: cost[k], default=None)
            lines.append(f"{start}nothing fits {budget_ms or 0:g} ms a frame" + (
                "" if near is None else
                f"; the nearest is {known.names[near]}, {number(cost[near])} ms"))
            continue
        found = comparison(here, tuple(within))
        equal = [k for k in within if k == found.best or found.verdict(k) <= 0]
        cheapest = min(equal, key=lambda k: cost[k])
        budget = "" if budget_ms is None else f"within {budget_ms:g} ms a frame: "
        line = f"{start}{budget}{found.name}, {number(cost[found.best])} ms a frame"
        if cheapest != found.best:
            line += (f"; not shown to be worse and cheaper is {known.names[cheapest]}, "
                     f"{number(cost[cheapest])} ms")
        lines.append(line + (f"; {found.line}" if found.line else ""))
    return lines
