"""The search of the cheapest choice, and what it costs."""

from __future__ import annotations

import contextlib
import itertools
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Unpack

import numpy as np

from sweep.analysis.dataset import DRAWS, computed_scenes
from sweep.analysis.requirements import Answer, Decision, answers
from sweep.errors import PipelineError, check_positive
from sweep.execution.progress import RunOptions, StageReport, stage_display, taking_run_options
from sweep.execution.runner import execute
from sweep.experiment.document import SEARCH
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.sampling import CHOICES, StoppingRule
from sweep.isolation.child_process import Interrupts
from sweep.messages import notice
from sweep.sampling.searches import choice_shares, product_of
from sweep.store.lifecycle import open_dataset, read_pipeline, store_of
from sweep.tradeoff.costs import measure, median_interval, sample_scenes
from sweep.tradeoff.pareto import pareto_front

# --------------------------------------------------------------------------------------------------
# The cost of each alternative of a choice: the time of a frame at its answer, measured in turns.

#: Conditions of each answer that are measured; of more, so many from all over the grid.
MAX_CONDITIONS = 24


@dataclass(frozen=True, slots=True)
class Cost:
    """The time of a frame, detection and estimation, at the condition where it is longest.

    Attributes
    ----------
    ms, low, high
        The median, and the ends of its 95 % interval, in milliseconds.
    condition
        Values by axis.
    """

    ms: float
    low: float
    high: float
    condition: Mapping[str, Any]


def choice_costs(
    pipeline: Pipeline, rule: StoppingRule, found: Sequence[Answer], limit_s: float,
    report: StageReport,
) -> list[Cost | None]:
    """Return the cost of each alternative, at its answer; None for one without an answer.

    Where no value is sought along an axis, those that meet nothing are measured, too: an answer is
    the cheapest then, and they are what is cheaper.

    Parameters
    ----------
    pipeline, rule
        The experiment and the choice.
    found
        The answers, in the order of the combinations of the axes ``rule.among``.
    limit_s
        Seconds of the measurement, about.
    report
        Called with the current step, and the share of it that is done.
    """
    axes = {axis.name: axis for axis in pipeline.axes}
    settings = [axis.name for axis in (
        *pipeline.axes_of(Stage.detection), *pipeline.axes_of(Stage.estimation))]
    every = list(itertools.product(*(range(len(axes[name])) for name in rule.at_all)))
    count = min(len(every), MAX_CONDITIONS)
    conditions = [every[k * (len(every) - 1) // max(count - 1, 1)] for k in range(count)]
    # The indices along all axes of the alternatives that are measured; alternatives that differ in
    # settings alone share their scenes.
    places: dict[int, dict[str, int]] = {}
    for k, answer in enumerate(found):
        if not rule.along or answer.value is not None:
            chosen = {**answer.alternative, **({rule.along: answer.value} if rule.along else {})}
            places[k] = {name: [each == value for each in axes[name].values].index(True)
                         for name, value in chosen.items()}
    scenes = {k: tuple((name, i) for name, i in place.items() if name not in settings)
              for k, place in places.items()}
    samples = list(dict.fromkeys(scenes.values()))
    if not samples:
        return [None] * len(found)
    drawn = [
        sample_scenes(pipeline, {**dict(scene), **dict(zip(rule.at_all, condition, strict=True))},
                      len(samples) * len(conditions))
        for scene in samples for condition in conditions]
    words = f"measuring the cost of alternatives ({len(found):,})"
    report(words, 0.0)
    with Interrupts() as interrupts:
        costs = measure(
            pipeline, drawn, limit_s, interrupts, lambda share: report(words, share))
    ends = np.stack(median_interval(1e3 * costs.total)).reshape(
        3, len(samples), len(conditions), *(len(axes[name]) for name in settings))
    out: list[Cost | None] = [None] * len(found)
    for k, place in places.items():
        of_one = np.moveaxis(ends, (0, 2), (-2, -1))[
            (samples.index(scenes[k]), *(place[name] for name in settings))]
        if not np.isnan(of_one[0]).all():
            worst = int(np.nanargmax(of_one[0]))
            ms, low, high = of_one[:, worst].tolist()
            out[k] = Cost(ms, low, high, {
                name: axes[name].values[i]
                for name, i in zip(rule.at_all, conditions[worst], strict=True)})
    return out


# --------------------------------------------------------------------------------------------------
# A requirement in, a decision out: the search for the choice of a pipeline's section [search].


@dataclass(frozen=True)
class Choice:
    """The result of a search.

    Attributes
    ----------
    store
        The store of the search.
    rule, budget_ms
        The search, and the most milliseconds of a frame, if there is a budget.
    conditions
        How many conditions there are.
    answers, costs
        Of each alternative; a cost is None where it was not measured.
    poses, cells, most_trials
        Poses that were computed; scenes of the grid without its trials, and the most trials that
        one of them took: their product is what a grid of equally many trials takes.
    notes
        The run's warnings.
    """

    store: str
    rule: StoppingRule
    budget_ms: float | None
    conditions: int
    answers: tuple[Answer, ...]
    costs: tuple[Cost | None, ...]
    poses: int
    cells: int
    most_trials: int
    notes: tuple[str, ...]

    @property
    def grid_poses(self) -> int:
        """Poses of a grid with as many trials everywhere as the cell that took most."""
        return self.cells * self.most_trials

    def rank(self, k: int, *, possible: bool = False) -> tuple[float, float]:
        """Return a key that is smaller for a better alternative: the sought value, then the cost.

        ``possible``: with the last value that it may have.
        """
        answer, cost = self.answers[k], self.costs[k]
        value = (answer.possible if possible and answer.is_open else answer.value) or 0.0
        return -value if self.rule.largest else value, math.inf if cost is None else cost.ms

    @cached_property
    def best(self) -> int | None:
        """The number of the alternative that is chosen; None if none meets everything."""
        good = [k for k, answer in enumerate(self.answers) if answer.met and self.within_budget(k)]
        return min(good, key=self.rank, default=None)

    @cached_property
    def front(self) -> tuple[int, ...]:
        """Numbers of the alternatives than which no other is as good and cheaper."""
        known = [k for k, answer in enumerate(self.answers) if answer.met and self.costs[k]]
        value, ms = np.array([self.rank(k) for k in known]).reshape(-1, 2).T
        return tuple(itertools.compress(known, pareto_front(ms, value)))

    @property
    def is_undecided(self) -> bool:
        """Whether it is undecided what the answer is: a better one may meet the requirements."""
        return any(map(self.may_be_better, range(len(self.answers))))

    @property
    def decision(self) -> Decision:
        """Whether the answer is decided (met), there is surely none (not met), or neither."""
        if self.is_undecided:
            return Decision.undecided
        return Decision.not_met if self.best is None else Decision.met

    def may_be_better(self, k: int) -> bool:
        """Return whether an alternative may be better than the answer, which is undecided."""
        answer, cost, budget = self.answers[k], self.costs[k], self.budget_ms
        too_dear = cost is not None and budget is not None and cost.low > budget
        open_cost = answer.met and not self.within_budget(k)
        if too_dear or not (answer.is_open or open_cost):
            return False
        return self.best is None or self.rank(k, possible=True) < self.rank(self.best)

    def within_budget(self, k: int) -> bool:
        """Return whether an alternative's cost is within the budget, with its interval."""
        cost = self.costs[k]
        return self.budget_ms is None or (cost is not None and cost.high <= self.budget_ms)


@taking_run_options
def size(
    pipeline: Pipeline | Mapping[str, Any] | str | os.PathLike[str],
    *,
    store: str | os.PathLike[str] | None = None,
    limit_s: float = 20.0,
    **options: Unpack[RunOptions],
) -> Choice:
    """Search the smallest, or the cheapest, choice that meets requirements at all conditions.

    Parameters
    ----------
    pipeline
        As for `sweep.run`, with the sections [require] and [search].
    store, workers, client, scheduler, reuse, overwrite, retry_failed, yes, progress, time_limit_s
        As for `sweep.run`.
    limit_s
        Seconds of the measurement of costs, where there are alternatives or a budget.

    Returns
    -------
    Choice
        The answer of each alternative (``answers``), the number of the chosen one (``best``, None
        if none meets everything), costs, the front, and the poses that it took.

    Raises
    ------
    ArgumentError, PipelineError, StoreError, RunError
        As for `sweep.run`; a choice that cannot be made is told in a line for each fault.

    Examples
    --------
    >>> found = sweep.size({
    ...     "pose": {"jitter_px": 0.5}, "axes": {"side_px": [4, 40]},
    ...     "require": {"all": ["detection >= 0.5"]},
    ...     "search": {"smallest": "side_px", "max_trials": 60},
    ... }, store=folder / "smallest.zarr")
    >>> found.answers[found.best].value, found.answers[found.best].next
    (40.0, 4.0)
    """
    check_positive(  # also refuses None
        "limit_s", "" if limit_s is None else limit_s, "expected a finite number above 0")
    read = read_pipeline(pipeline)
    rule = read.stopping
    if rule is None or rule.kind not in CHOICES:
        example = 'smallest = "size_m", max_trials = 5000'
        raise PipelineError([f"{read.source}: expected what is chosen: [{SEARCH}] {example}"])
    summary = execute(read, store_of(pipeline, store), **options)
    results = open_dataset(summary.store)
    found = tuple(answers(results, rule, choice_shares(read, rule)))
    costs: Sequence[Cost | None] = [None] * len(found)
    if len(found) > 1 or read.budget_ms is not None:
        with stage_display() if options["progress"] else contextlib.nullcontext() as stage:
            costs = choice_costs(read, rule, found, limit_s, stage or (lambda _what, _share: None))
    trials = computed_scenes(results).sum(DRAWS).compute()
    notice(*summary.warnings)
    return Choice(
        summary.store, rule, read.budget_ms, product_of(read, rule.at_all), found,
        tuple(costs), int(trials.sum()), trials.size, int(trials.max()), tuple(summary.warnings))
