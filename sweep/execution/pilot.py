"""What a run in waves will need, from a small pilot: some conditions, their first wave.

The trials of the pilot are drawn again and again (the bootstrap) in the place of those to come, and
the rule of stopping is applied wave by wave. So it is one method for every rule.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.evaluation.cells import run_cells
from sweep.evaluation.results import to_dataset_layout
from sweep.execution.calibration import COMPILATION_LIMIT_S
from sweep.isolation.child_process import Child, ChildDiedError
from sweep.plan.axes import TRIAL, Axis
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import Block, block_indices, scene_axes
from sweep.plan.schema import variables_of
from sweep.sampling.deciding import in_order_of_results
from sweep.sampling.rules import make_rule
from sweep.sampling.stopping import GroupResults, Stopping, condition_axes
from sweep.typing import Floats, Masks

MAX_CONDITIONS = 40
"""Conditions of the pilot; pooled cells are a condition together."""

LIMIT_S = 8.0
"""Seconds after which a pilot is ended: its rule may be slow to decide."""

REPETITIONS, REPETITIONS_S = 8, 1.0
"""How often the trials are drawn for the range, unless that takes so many seconds."""

MAX_VALUES = 20_000_000
"""Values of a variable that are simulated: with many trials or configurations, fewer conditions."""


@dataclass(frozen=True, slots=True)
class Pilot:
    """What a run in waves is expected to need.

    Attributes
    ----------
    conditions
        Conditions that were sampled.
    share, share_low, share_high
        Share of the grid's poses that is needed; two standard errors below and above, from the
        spread between conditions that were sampled and between repetitions of their draws.
    unsettled
        Share of the conditions that need more than ``max_trials``.
    """

    conditions: int
    share: float
    share_low: float
    share_high: float
    unsettled: float


def pilot(pipeline: Pipeline, scene_s: float, budget_s: float) -> Pilot | None:
    """Compute the first wave of some conditions and return what a run is expected to need.

    Parameters
    ----------
    pipeline
        One with a rule of stopping.
    scene_s
        Seconds that a scene takes.
    budget_s
        Seconds of computation; None is returned if they are too short for one condition.
    """
    whole = make_rule(pipeline)
    if whole is None:
        raise TypeError(pipeline.stopping)
    configurations = math.prod(len(axis) for axis in pipeline.axes) // math.prod(
        len(axis) for axis in scene_axes(pipeline))
    pooled = math.prod(
        len(axis) for axis in condition_axes(pipeline) if axis.name in whole.coupled)
    most = min(
        budget_s / (scene_s * whole.ends[0] * pooled), MAX_CONDITIONS,
        MAX_VALUES / (whole.ends[-1] * pooled * configurations),
    )
    if most < 1:
        return None
    part = _part(pipeline, whole, int(most))
    rule = make_rule(part)
    if rule is None:
        raise TypeError(part.stopping)
    first = _first_wave(part, rule)
    coupled = tuple(
        k for k, axis in enumerate(condition_axes(part)) if axis.name in rule.coupled)
    generator = np.random.Generator(np.random.PCG64(0))
    means: list[float] = []
    started = time.perf_counter()
    while not means or (
        len(means) < REPETITIONS and time.perf_counter() - started < REPETITIONS_S
    ):
        trials, mask = _simulated(part, rule, first, generator, again=bool(means))
        if not means:
            shares = (trials.mean(axis=coupled) / rule.ends[-1]).ravel()
            unsettled = float(mask.any(axis=coupled).mean())
        means.append(float(trials.mean()) / rule.ends[-1])
    sampled, count = len(shares), math.prod(
        len(axis) for axis in condition_axes(pipeline) if axis.name not in rule.coupled)
    between = float(shares.var(ddof=1)) / sampled if sampled > 1 else float(shares[0]) ** 2
    within = 0.0 if len(means) < REPETITIONS else float(np.var(means, ddof=1))
    # Of conditions that are all sampled, only the trials to come are unknown.
    error = 2 * math.sqrt(between * (1 - sampled / count if within else 1.0) + within)
    mean = float(shares.mean())
    low = max(mean - error, rule.ends[0] / rule.ends[-1])
    return Pilot(sampled, mean, low, min(mean + error, 1.0), unsettled)


def pilot_in(child: Child, pipeline: Pipeline, scene_s: float, budget_s: float) -> Pilot | None:
    """Return a pilot that is made in a child process; None also if its rule takes too long.

    Raises
    ------
    ChildDiedError, ChildRaisedError
        If a scene crashes the process, or raises.
    """
    try:
        found: Pilot | None = child.call(
            pilot, pipeline, scene_s, budget_s, limit_s=LIMIT_S, grace_s=COMPILATION_LIMIT_S)
    except ChildDiedError as error:
        if not error.timed_out:
            raise
        child.restart()
        return None
    return found


def _part(pipeline: Pipeline, rule: Stopping, most: int) -> Pipeline:
    """Return a pipeline with some values of the axes that are not coupled, evenly spread."""
    counts = {axis.name: len(axis) for axis in condition_axes(pipeline)
              if axis.name not in rule.coupled}
    while math.prod(counts.values()) > most:
        longest = max(counts, key=lambda name: counts[name])
        counts[longest] -= 1
    return dataclasses.replace(pipeline, axes=tuple(
        _some(axis, counts[axis.name]) if axis.name in counts else axis for axis in pipeline.axes
    ))


def _some(axis: Axis, count: int) -> Axis:
    """Return an axis with so many of its values: the middles of equal parts."""
    chosen = [int((k + 0.5) * len(axis) / count) for k in range(count)]

    def taken(values: Sequence[Any]) -> tuple[Any, ...]:
        return tuple(values[k] for k in chosen)

    return dataclasses.replace(
        axis, values=taken(axis.values),
        zipped=tuple((name, taken(values)) for name, values in axis.zipped),
    )


def _first_wave(pipeline: Pipeline, rule: Stopping) -> dict[str, NDArray[Any]]:
    """Return the results of the first wave of all conditions."""
    axes = scene_axes(pipeline)
    block = Block((0,) * len(axes), tuple(
        rule.ends[0] if axis.name == TRIAL else len(axis) for axis in axes))
    cells = run_cells(pipeline, block_indices(block))
    return {
        variable.name: in_order_of_results(pipeline, variable, to_dataset_layout(
            variable, pipeline, block, cells.columns[variable.name]))
        for variable in variables_of(pipeline)
        if variable.name in {"detection", *rule.variables}
    }


def _simulated(
    pipeline: Pipeline, rule: Stopping, first: dict[str, NDArray[Any]],
    generator: np.random.Generator, *, again: bool,
) -> tuple[Floats, Masks]:
    """Return the trials that each scene needs, and which need more; over the condition axes.

    ``again``: the trials of the first wave are drawn, too.
    """
    names = [axis.name for axis in condition_axes(pipeline)]
    shape, along = tuple(len(axis) for axis in condition_axes(pipeline)), len(names)
    drawn = generator.integers(0, rule.ends[0], rule.ends[-1])
    if not again:
        drawn[: rule.ends[0]] = np.arange(rule.ends[0])
    variables = {variable.name: variable for variable in variables_of(pipeline)}
    values = {name: np.take(array, drawn, axis=along) for name, array in first.items()}
    trials = np.full(shape, float(rule.ends[0]))
    mask = np.ones(shape, dtype=bool)
    for wave in range(1, len(rule.ends) + 1):
        done = rule.ends[wave - 1]
        results = GroupResults(
            pipeline, (0,) * along, shape, wave, done,
            {name: np.take(values[name], range(done), axis=along) for name in rule.variables},
        )
        mask = np.array(rule.needed(results), dtype=bool)
        if wave == len(rule.ends) or not mask.any():
            break
        trials[mask] += rule.ends[wave] - done
        for name, array in values.items():
            array[:] = np.where(
                _between(~mask, done, rule.ends[wave], array), variables[name].not_needed, array
            )
    return trials, mask


def _between(scenes: Masks, start: int, stop: int, array: NDArray[Any]) -> Masks:
    """Return a mask for an array of results: the trials [start, stop) of scenes."""
    trials = np.arange(array.shape[scenes.ndim])
    mask = scenes[..., None] & (trials >= start) & (trials < stop)
    return mask.reshape(mask.shape + (1,) * (array.ndim - mask.ndim))
