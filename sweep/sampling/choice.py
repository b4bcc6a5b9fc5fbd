"""The rule of [choose]: trials where they decide what the smallest, or the cheapest, choice is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import xarray as xr

from sweep.analysis.choice_faults import choice_faults
from sweep.analysis.choices import ChoiceCells, choice_cells, choice_shares
from sweep.analysis.pose_view import ESTIMATE_INPUTS
from sweep.analysis.requirements import ErrorShares, parse_requirements
from sweep.messages import refusal
from sweep.plan.choice_rule import ChoiceRule
from sweep.plan.experiment import Pipeline
from sweep.plan.parameters import Stage
from sweep.sampling.group_dataset import group_dataset
from sweep.sampling.stopping import GroupResults, condition_axes, unit_of, wave_ends
from sweep.typing import Masks


@dataclass(frozen=True, slots=True)
class ChoiceSampling:
    """Attributes as `sweep.sampling.stopping.Stopping` has them.

    Attributes
    ----------
    rule, shares
        What is sought, and the shares of the error probability that a decision may spend.
    """

    rule: ChoiceRule
    shares: ErrorShares
    ends: tuple[int, ...]
    variables: tuple[str, ...]
    coupled: tuple[str, ...]

    def needed(self, results: GroupResults) -> Masks:
        """Return the scenes of the cells that `sweep.analysis.choice_walk.needed` names."""
        dataset = group_dataset(results)
        cells = choice_cells(dataset, self.rule, self.shares).needed()
        pipeline = results.pipeline
        configurations = [axis.name for axis in pipeline.axes_of(Stage.detection, Stage.estimation)]
        wanted = cells.any([name for name in configurations if name in cells.dims])
        if self.rule.along:
            wanted = wanted.sel({self.rule.along: dataset[self.rule.along]})
        names = [axis.name for axis in condition_axes(pipeline)]
        pooled = tuple(k for k, name in enumerate(names) if name not in wanted.dims)
        along = wanted.transpose(*(name for name in names if name in wanted.dims)).to_numpy()
        return np.broadcast_to(np.expand_dims(along, pooled), results.shape)


def choice_sampling(pipeline: Pipeline, rule: ChoiceRule) -> ChoiceSampling:
    """Return the rule of a pipeline's section [choose].

    Raises
    ------
    PipelineError
        One line for each requirement that cannot be judged, or not within ``max_trials``.
    """
    ends = choice_ends(pipeline, rule)
    shares = choice_shares(pipeline, rule, len(ends))
    if faults := choice_faults(pipeline, rule, shares):
        raise refusal([f"{pipeline.source}: {line}" for line in faults])
    read = [name for each in parse_requirements(rule.requirements)
            for name in each.requirable.variables]
    coupled = tuple(axis.name for axis in condition_axes(pipeline) if axis.name not in rule.among)
    return ChoiceSampling(
        rule, shares, ends, tuple(dict.fromkeys((*ESTIMATE_INPUTS, *read))), coupled)


def choice_ends(pipeline: Pipeline, rule: ChoiceRule) -> tuple[int, ...]:
    """Return the numbers of trials at which waves end, and decisions are made."""
    kept = {*rule.among, rule.along, *rule.per}
    pooled = math.prod(
        len(axis) for axis in condition_axes(pipeline) if axis.name not in kept)
    return wave_ends(rule.max_trials, unit_of(pooled))


def store_cells(results: xr.Dataset, pipeline: Pipeline, rule: ChoiceRule) -> ChoiceCells:
    """Return the decisions of a store's whole dataset, as the search made the last ones."""
    ends = choice_ends(pipeline, rule)
    return choice_cells(results, rule, choice_shares(pipeline, rule, len(ends)))
