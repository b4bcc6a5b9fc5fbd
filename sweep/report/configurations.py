"""The configurations of a store, their order, and the beliefs that are not the truth.

A configuration is a combination of detector and estimator settings. They are compared, never
pooled; of a store with very many some are chosen.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.analysis import error_statistics
from sweep.plan.parameters import Stage
from sweep.plan.same_meaning import wrong_configurations
from sweep.plan.used_settings import distinct, used_settings
from sweep.report.formatting import plural
from sweep.report.grouping import Grouping, by_configuration
from sweep.report.report_data import ReportData
from sweep.tradeoff.labels import WRONG, configuration_label

MAX_CONFIGURATIONS = 30
"""Configurations that a table or a figure of all of them compares."""

MAX_LINES = 7
"""Configurations that have a line of their own in a chart."""

BOTH = (Stage.detection, Stage.estimation)


@dataclass(frozen=True)
class Settings:
    """Combinations of the values of some axes of settings.

    Attributes
    ----------
    axes
        Axis -> indices of its values.
    grouping
        Of analyses that keep them apart.
    kept
        Which of all combinations, the last axis fastest, are configurations of their own: the first
        of those that differ in settings alone which they do not use.
    """

    axes: dict[str, tuple[int, ...]]
    grouping: Grouping
    kept: tuple[int, ...]

    @property
    def combinations(self) -> list[dict[str, int]]:
        """The index along each axis, of every configuration; one that is empty without axes."""
        every = list(itertools.product(*self.axes.values()))
        return [dict(zip(self.axes, every[k], strict=True)) for k in self.kept]


def settings_of(
    data: ReportData, stages: Sequence[Stage] = BOTH, without: Sequence[str] = (),
    most: int = MAX_CONFIGURATIONS,
) -> Settings:
    """Return the combinations of the settings of some stages, about ``most`` if there are more.

    Then values of the longest axes are chosen, evenly spaced. ``without`` are axes that are left
    out, since a figure is along them.
    """
    lengths = {
        axis.name: len(axis) for axis in data.pipeline.axes_of(*stages)
        if len(axis) > 1 and axis.name not in without
    }
    chosen = dict(lengths)
    while math.prod(chosen.values()) > most and max(chosen.values()) > 2:
        chosen[max(chosen, key=lambda name: chosen[name])] -= 1
    axes, grouping = {}, Grouping()
    for name, length in chosen.items():
        part = data.along(name, length, binned=False)
        axes[name] = dict(part.chosen).get(name, tuple(range(length)))
        grouping += part
    values = [[data.results[name].values.tolist()[k] for k in some] for name, some in axes.items()]
    kept = distinct(data.pipeline, [
        dict(zip(axes, each, strict=True)) for each in itertools.product(*values)])
    return Settings(axes, grouping, tuple(kept))


@dataclass(frozen=True, eq=False)
class Configurations:
    """The configurations that a report compares.

    Attributes
    ----------
    settings
        What tells them apart.
    names
        Their n labels.
    wrong
        (n,) whether the estimator believes what is known not to be true; nowhere if that holds for
        all of them.
    summary
        `sweep.analysis.error_statistics` by configuration (n,).
    order
        (n,) indices: right beliefs first, of these the smallest median rotation error first.
    """

    settings: Settings
    names: list[str]
    wrong: NDArray[np.bool_]
    summary: xr.Dataset
    order: tuple[int, ...]

    @property
    def several(self) -> bool:
        """Whether there is more than one."""
        return len(self.names) > 1

    @property
    def choices(self) -> int:
        """How many there are without a wrong belief."""
        return int((~self.wrong).sum())

    def spoken(self, k: int) -> str:
        """Return a label as it stands in a sentence: ``none`` behind the name of its setting."""
        parts = self.names[k].split(" \u00b7 ")
        return " \u00b7 ".join(
            f"{axis} {part}" if part == "none" else part
            for axis, part in zip(self.settings.axes, parts, strict=True)
        ) if len(parts) == len(self.settings.axes) else self.names[k]

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on values of settings that are not shown."""
        return self.settings.grouping.notes


def configurations(data: ReportData) -> Configurations:
    """Return the configurations of a store, in order."""
    return data.remembered("configurations", lambda: _configurations(data))


def _configurations(data: ReportData) -> Configurations:
    settings = settings_of(data)
    names, summary = by_configuration(
        data.pipeline, data.analysed(error_statistics, settings.grouping), settings.grouping.dims)
    axes = [axis for axis in data.pipeline.axes_of(*BOTH) if axis.name in settings.axes]
    flags = np.array(wrong_configurations(data.pipeline, axes)).reshape(
        [len(axis) for axis in axes])
    wrong = flags[np.ix_(*settings.axes.values())].reshape(-1) if axes else flags.reshape(-1)
    wrong = wrong[list(settings.kept)]
    names = [name + WRONG * bool(flag) for name, flag in zip(names, wrong, strict=True)]
    median = summary["rotation_median_deg"].values.astype(np.float64)
    solved = np.nan_to_num(summary["solved_rate"].values.astype(np.float64))
    order = np.lexsort((-solved, np.where(np.isnan(median), np.inf, median), wrong))
    return Configurations(settings, names, wrong, summary, tuple(order.tolist()))


def most_exact_first(data: ReportData, settings: Settings) -> list[int]:
    """Return the combinations of some settings in the order of their best configurations."""
    known = configurations(data)
    all_of_them = known.settings.combinations

    def rank_of(each: dict[str, int]) -> int:
        return next((
            rank for rank, k in enumerate(known.order)
            if all(all_of_them[k].get(name, index) == index for name, index in each.items())
        ), len(known.order))

    ranks = [rank_of(each) for each in settings.combinations]
    return sorted(range(len(ranks)), key=lambda k: (ranks[k], k))


def shown_lines(data: ReportData, settings: Settings, most: int = MAX_LINES) -> list[int]:
    """Return which combinations a chart shows: the first in order, as they stand in the grid."""
    return sorted(most_exact_first(data, settings)[:most])


def shown_note(shown: Sequence[int], count: int) -> str:
    """Return a sentence that says which of the configurations a chart shows, if not all."""
    if len(shown) == count:
        return ""
    return (f"Drawn: the {len(shown):,} of {plural(count, 'configuration')} with the smallest "
            "median rotation error; the table has all.")


def first_detector(data: ReportData) -> tuple[dict[str, int], str]:
    """Return the detector's settings of the first configuration in order, and their label."""
    known = configurations(data)
    best = known.settings.combinations[known.order[0]]
    names = {axis.name for axis in data.pipeline.axes_of(Stage.detection)}
    index = {name: k for name, k in best.items() if name in names}
    values = {name: data.results[name].values.tolist()[k] for name, k in index.items()}
    return index, configuration_label(used_settings(data.pipeline, values)) if index else ""
