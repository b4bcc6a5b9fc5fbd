"""The rule of [precision]: a condition needs trials until every interval is narrow enough.

A condition is judged by the intervals that the analysis shows of it. It is settled when every
quantity of every configuration has an interval as narrow as is wanted, or cannot have one: no pose
was looked for, or so few have the number that all trials would not give enough
(`sweep.analysis.precision.Reached`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sweep.analysis.precision import WantedPrecision, precision_table, wanted_precisions
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.sampling import PrecisionRule, wave_ends
from sweep.messages import refusal
from sweep.sampling.rules import GroupResults, condition_axes, unit_of
from sweep.sampling.searches import group_dataset, with_flags
from sweep.typing import Masks


@dataclass(frozen=True, slots=True)
class PrecisionSampling:
    """Attributes as `sweep.sampling.rules.Stopping` has them, and what is wanted."""

    ends: tuple[int, ...]
    variables: tuple[str, ...]
    coupled: tuple[str, ...]
    wanted: tuple[WantedPrecision, ...]

    def needed(self, results: GroupResults) -> Masks:
        """Return the scenes whose condition has a configuration that is not known well enough."""
        names = [axis.name for axis in condition_axes(results.pipeline)]
        dataset = group_dataset(results)
        per = [name for name in names if name not in self.coupled]
        table = precision_table(dataset, self.wanted, per, trials=self.ends[-1])
        needs = (~table["settled"]).expand_dims({
            name: dataset.sizes[name] for name in self.coupled})
        return np.asarray(needs.transpose(*names).values)


def precision_sampling(pipeline: Pipeline, rule: PrecisionRule) -> PrecisionSampling:
    """Return the rule of a pipeline's section [precision].

    Raises
    ------
    PipelineError
        One line for each name that no quantity has, or each whose interval cannot be as narrow
        within ``max_trials``.
    """
    try:
        wanted = wanted_precisions(dict(rule.wanted))
    except ValueError as error:
        raise refusal([f"{pipeline.source}: precision.{line}"
                       for line in str(error).splitlines()]) from None
    axes = condition_axes(pipeline)
    coupled = tuple(axis.name for axis in axes if axis.name not in rule.per)
    pooled = math.prod(len(axis) for axis in axes if axis.name in coupled)
    if too_few := [
        f"{pipeline.source}: precision.max_trials = {rule.max_trials}: expected at least "
        f"{least:,}: with fewer no interval of {each.name} has a half-width of {each.half_width:g}"
        for each in wanted
        if rule.max_trials < (least := math.ceil(each.fewest_draws / pooled))
    ]:
        raise refusal(too_few)
    variables = with_flags(name for each in wanted for name in each.variables)
    return PrecisionSampling(
        wave_ends(rule.max_trials, unit_of(pooled)), variables, coupled, wanted)
