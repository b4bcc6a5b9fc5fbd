"""A requirement in, a decision out: the search for the choice of a pipeline's section [choose]."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis.choices import Answer, answers
from sweep.analysis.dimensions import DRAWS
from sweep.analysis.requirements import Decision
from sweep.analysis.stopped_sampling import computed_scenes
from sweep.execution.progress import ProgressReport, StageReport
from sweep.execution.runner import execute
from sweep.isolation.child_process import Child
from sweep.messages import refusal
from sweep.plan.choice_rule import SECTION, ChoiceRule
from sweep.plan.experiment import Pipeline
from sweep.sampling.choice import store_cells
from sweep.store.lifecycle import open_dataset
from sweep.tradeoff.choice_costs import Cost, choice_costs
from sweep.tradeoff.pareto import pareto_front

SECONDS = 20.0
"""Time limit of the measurement of costs, in seconds."""


@dataclass(frozen=True, slots=True)
class Choice:
    """What a search found.

    Attributes
    ----------
    store
        The store of the search.
    rule, budget_ms
        What was sought, and the most milliseconds of a frame, if there is a budget.
    conditions
        How many conditions there are.
    answers, costs
        Of each alternative; a cost is None where it was not measured.
    best
        The number of the alternative that is chosen; None if none meets everything.
    next
        The number of the alternative that would be better and fails; None if there is none.
    front
        Numbers of the alternatives than which no other is as good and cheaper.
    poses, cells, most_trials
        Poses that were computed; scenes of the grid without its trials, and the most trials that
        one of them took: their product is what a grid of equally many trials takes.
    notes
        The run's warnings.
    """

    store: str
    rule: ChoiceRule
    budget_ms: float | None
    conditions: int
    answers: tuple[Answer, ...]
    costs: tuple[Cost | None, ...]
    best: int | None
    next: int | None
    front: tuple[int, ...]
    poses: int
    cells: int
    most_trials: int
    notes: tuple[str, ...] = ()

    @property
    def grid_poses(self) -> int:
        """Poses of a grid with as many trials everywhere as the cell that took most."""
        return self.cells * self.most_trials

    @property
    def is_undecided(self) -> bool:
        """Whether no choice is known to meet the requirements, and one is not known not to."""
        return not any(answer.met for answer in self.answers) and any(
            answer.next_cause is not None and answer.next_cause.decision is Decision.undecided
            for answer in self.answers)

    def within_budget(self, k: int) -> bool:
        """Return whether an alternative's cost is within the budget, with its interval."""
        cost = self.costs[k]
        return self.budget_ms is None or (cost is not None and cost.high <= self.budget_ms)


def search_choice(
    pipeline: Pipeline, store: str | os.PathLike[str] | None = None, *,
    limit_s: float = SECONDS, progress: ProgressReport | None = None,
    stage: StageReport | None = None, child: Child | None = None, **options: Any,
) -> Choice:
    """Search the choice of a pipeline's section [choose], and measure what alternatives cost.

    Parameters
    ----------
    pipeline
        With the sections [require] and [choose].
    store
        Of the search (default: ``runs/NAME.zarr``); one that is finished answers at once.
    limit_s
        Seconds of the measurement of costs; it is made only where there is something to compare,
        or a budget.
    progress, stage
        Called after each block of the run, and while costs are measured.
    child
        As `sweep.execution.runner.execute` takes it, with ``options``.

    Raises
    ------
    PipelineError
        If the pipeline has no section [choose].
    SweepError
        As `sweep.execution.runner.execute` and `sweep.analysis.check_requirements`.
    """
    rule = chosen_by(pipeline)
    summary = execute(pipeline, store, progress=progress, child=child, **options)
    results = open_dataset(summary.store)
    cells = store_cells(results, pipeline, rule)
    found = tuple(answers(cells, rule.along))
    costs: Sequence[Cost | None] = [None] * len(found)
    if len(found) > 1 or pipeline.budget_ms is not None:
        costs = choice_costs(
            pipeline, rule, found, limit_s, stage or (lambda _what, _share: None))
    poses, count, most = _poses(results)
    good = [k for k, answer in enumerate(found) if answer.met and (
        pipeline.budget_ms is None
        or ((cost := costs[k]) is not None and cost.high <= pipeline.budget_ms))]
    best = min(good, key=lambda k: _rank(found[k], costs[k], rule), default=None)
    return Choice(
        summary.store, rule, pipeline.budget_ms, cells.decision.shape[2], found, tuple(costs), best,
        _next(found, costs, rule, best), _front(found, costs, rule), poses, count, most,
        tuple(summary.warnings))


def chosen_by(pipeline: Pipeline) -> ChoiceRule:
    """Return what a pipeline chooses; PipelineError if it has no section [choose]."""
    rule = pipeline.stopping
    if isinstance(rule, ChoiceRule):
        return rule
    example = 'smallest = "size_m", max_trials = 5000'
    raise refusal([f"{pipeline.source}: expected what is chosen: [{SECTION}] {example}"])


def _rank(answer: Answer, cost: Cost | None, rule: ChoiceRule) -> tuple[float, float]:
    """Return what is smaller for a better answer: the value that is sought, then the cost."""
    value = 0.0 if answer.value is None else -answer.value if rule.largest else answer.value
    return value, math.inf if cost is None else cost.ms


def _next(
    found: Sequence[Answer], costs: Sequence[Cost | None], rule: ChoiceRule, best: int | None
) -> int | None:
    """Return the alternative whose next value fails nearest to the answer."""
    if best is None:
        return None
    if rule.along:
        return best if found[best].next is not None else None
    chosen = _rank(found[best], costs[best], rule)
    cheaper = [k for k, answer in enumerate(found)
               if not answer.met and _rank(answer, costs[k], rule) < chosen]
    return max(cheaper, key=lambda k: _rank(found[k], costs[k], rule), default=None)


def _front(
    found: Sequence[Answer], costs: Sequence[Cost | None], rule: ChoiceRule
) -> tuple[int, ...]:
    """Return the alternatives than which no other is as good and cheaper."""
    known = [(k, cost) for k, cost in enumerate(costs) if found[k].met and cost is not None]
    if not known:
        return ()
    values = np.array([_rank(found[k], cost, rule)[0] for k, cost in known])
    on_front = pareto_front(np.array([cost.ms for _, cost in known]), values - values.min() + 1.0)
    return tuple(k for (k, _), is_on in zip(known, on_front, strict=True) if is_on)


def _poses(results: xr.Dataset) -> tuple[int, int, int]:
    """Return the poses that were computed, the scenes without trials, and the most trials."""
    trials = computed_scenes(results).sum(DRAWS).compute()
    return int(trials.sum()), trials.size, int(trials.max())
