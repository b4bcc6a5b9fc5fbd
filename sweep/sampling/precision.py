"""The rule of [precision]: a condition needs trials until every interval is narrow enough.

A condition is judged by the intervals that the analysis shows of it. It is settled when every
quantity of every configuration has an interval as narrow as is wanted, or cannot have one: no pose
was looked for, or so few have the number that all trials would not give enough
(`sweep.analysis.half_widths.Reached`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr

from sweep.analysis.half_widths import (
    Reached,
    WantedPrecision,
    evaluate,
    looked_for_and_run,
    wanted_precisions,
)
from sweep.analysis.layout import Layout
from sweep.analysis.pose_view import Poses
from sweep.analysis.requirable import requirable_arrays
from sweep.messages import refusal
from sweep.plan.axes import TRIAL, Axis
from sweep.plan.experiment import Pipeline
from sweep.plan.parameters import GEOMETRY_SECTIONS, Stage
from sweep.plan.precision_rule import PrecisionRule
from sweep.plan.schema import VARIABLES
from sweep.plan.variable import LABELS
from sweep.sampling.stopping import GroupResults, condition_axes, unit_of, wave_ends
from sweep.typing import Masks


@dataclass(frozen=True, slots=True)
class PrecisionSampling:
    """Attributes as `sweep.sampling.stopping.Stopping` has them, and what is wanted."""

    ends: tuple[int, ...]
    variables: tuple[str, ...]
    coupled: tuple[str, ...]
    wanted: tuple[WantedPrecision, ...]

    def needed(self, results: GroupResults) -> Masks:
        """Return the scenes whose condition has a configuration that is not known well enough."""
        inputs = requirable_arrays(dataset_of(results), [each.requirable for each in self.wanted])
        layout, sizes = _layout(results, self.coupled, inputs)
        poses = Poses(layout.arrange([array.values for array in inputs.values()], sizes))
        table = evaluate([*looked_for_and_run(), *(
            statistic for number, each in enumerate(self.wanted)
            for statistic in each.statistics(f"{number} "))], poses)
        total = math.prod(sizes[name] for name in (*layout.cells, *layout.settings))
        total *= self.ends[-1]
        needs = np.zeros(len(table["run"]), dtype=bool)
        for number, each in enumerate(self.wanted):
            *_, reached = each.judge(
                table, f"{number} ", table["looked_for"], table["run"], total)
            needs |= np.isin(reached, (Reached.not_run, Reached.not_reached))
        return _by_scene(needs, results, self.coupled)


def dataset_of(results: GroupResults) -> xr.Dataset:
    """Return the results of a group as a dataset, without coordinates of its axes."""
    scene = [*(axis.name for axis in condition_axes(results.pipeline)), TRIAL]
    variables = {}
    for name, values in results.values.items():
        variable = VARIABLES[name]
        own = [axis.name for axis in variable.configuration_axes(results.pipeline)]
        variables[name] = ((*scene, *own, *variable.inner), values)
    labels = {dim for dims, _ in variables.values() for dim in dims if dim in LABELS}
    return xr.Dataset(variables, {name: list(LABELS[name]) for name in sorted(labels)})


def _layout(
    results: GroupResults, coupled: tuple[str, ...], inputs: Mapping[str, xr.DataArray]
) -> tuple[Layout, dict[str, int]]:
    """Return how arrays become (conditions times configurations, cells, draws, settings)."""
    axes = condition_axes(results.pipeline)
    pooled = [axis for axis in axes if axis.name in coupled]
    configuration = results.pipeline.axes_of(Stage.detection, Stage.estimation)
    kept = [*(axis.name for axis in axes if axis.name not in coupled),
            *(axis.name for axis in configuration)]
    layout = Layout(
        {name: tuple(map(str, array.dims)) for name, array in inputs.items()}, tuple(kept),
        tuple(axis.name for axis in pooled if _makes_cells(axis)), (TRIAL,),
        tuple(axis.name for axis in pooled if not _makes_cells(axis)))
    sizes = dict(zip((axis.name for axis in axes), results.shape, strict=True))
    return layout, sizes | {TRIAL: results.trials} | {
        axis.name: len(axis) for axis in configuration}


def _makes_cells(axis: Axis) -> bool:
    """Return whether draws differ along an axis: as `sweep.analysis.dimensions.is_grid_axis`."""
    return any(axis.parameter(name).section in GEOMETRY_SECTIONS for name in axis.columns)


def _by_scene(needs: Masks, results: GroupResults, coupled: tuple[str, ...]) -> Masks:
    """Return for each scene whether any configuration of its condition needs more."""
    names = [axis.name for axis in condition_axes(results.pipeline)]
    shape = [1 if name in coupled else length
             for name, length in zip(names, results.shape, strict=True)]
    return np.array(np.broadcast_to(needs.reshape(*shape, -1).any(axis=-1), results.shape))


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
    variables = dict.fromkeys(
        name for each in wanted for name in ("detection", "estimate", "flipped", *each.variables))
    return PrecisionSampling(
        wave_ends(rule.max_trials, unit_of(pooled)), tuple(variables), coupled, wanted)
