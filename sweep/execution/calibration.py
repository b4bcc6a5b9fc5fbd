"""How long a scene takes, measured before a run: hence the size of blocks."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import MachineFaultError
from sweep.evaluation.block import run_cells
from sweep.evaluation.results import to_dataset_layout
from sweep.execution.limits import (
    BLOCK_S,
    BLOCKS_PER_S,
    BLOCKS_PER_WORKER,
    CALIBRATION_LIMIT_S,
    MAX_BLOCK_BYTES,
    MAX_BLOCK_S,
    MAX_BLOCK_SCENES,
    MAX_BLOCK_SHARE,
    MAX_BLOCKS,
    MIN_BLOCK_S,
    TIME_LIMIT_S,
    WAVE_BLOCK_S,
)
from sweep.isolation.child_process import Child, ChildDiedError, ChildRaisedError
from sweep.isolation.watchdog import compilation_s
from sweep.plan.axes import TRIAL, Axis
from sweep.plan.grid import Block, Blocks, block_indices, scene_axes
from sweep.plan.parameters import Stage
from sweep.plan.photographs import along_photographs, shows_photographs
from sweep.plan.pipeline import Pipeline
from sweep.plan.schema import bytes_per_block, variables_of
from sweep.sampling.rules import (
    GroupResults,
    Stopping,
    block_unit,
    condition_axes,
    in_order_of_results,
    make_rule,
)
from sweep.typing import Floats, Masks

# --------------------------------------------------------------------------------------------------
# What scenes cost, measured on a sample: for the size of blocks and for forecasts.

MAX_BATCH = 1536
"""Most scenes measured at a time."""

BATCH_S = 0.06
"""Batches that take as long are large enough: a call has a cost of its own."""

GROWTH = 8
"""By how much a batch may exceed the one before: a few scenes may cost far more than the others."""

MAX_BATCHES = 40

UNEVEN = 0.25
"""Axes whose two halves differ in cost by more than this share are not cut if possible."""

MIN_LIMIT_S = 1.0
"""Every batch gets as long, whatever those before took: on a busy machine all take longer."""

COMPILATION_LIMIT_S = 900.0
"""How long a measurement may compile; its own limit stands still meanwhile."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """The cost of scenes, from a sample of the grid.

    Attributes
    ----------
    scene_s
        Mean seconds a scene, all configurations included.
    error_s
        Standard error of that mean.
    sampled
        Scenes in the sample.
    unevenness
        For each scene axis, the difference of the mean costs of its two halves, as a share.
    over
        Whether the last scenes of the sample took too long and were abandoned, so that a scene
        takes more than ``scene_s``.
    """

    scene_s: float
    error_s: float
    sampled: int
    unevenness: tuple[float, ...]
    over: bool = False


@dataclass(frozen=True, slots=True)
class BatchCost:
    """What a batch of scenes cost.

    Attributes
    ----------
    spent_s
        Seconds of this thread's own time: others use the processors meanwhile.
    scene_s
        Seconds of each scene (N,).
    running_s
        Seconds on the clock, compilation not counted.
    """

    spent_s: float
    scene_s: NDArray[np.float64]
    running_s: float


Indices = list[NDArray[np.intp]]


def batch_cost(pipeline: Pipeline, indices: Indices) -> BatchCost:
    """Compute the scenes at ``indices``, an array (N,) for each scene axis, and return the cost."""
    compiled, wall, working = compilation_s(), time.perf_counter(), time.thread_time()
    result = run_cells(pipeline, indices)
    spent, wall = time.thread_time() - working, time.perf_counter() - wall
    own = result.row_seconds * (spent / wall)
    # Time that is not measured by scene (solving, projecting) is spread over the batch.
    rest = (spent - own.sum()) / len(own)
    return BatchCost(spent, own + rest, max(wall - (compilation_s() - compiled), 0.0))


def calibrate(
    pipeline: Pipeline, budget_s: float, cost: Callable[[Pipeline, Indices], BatchCost] = batch_cost
) -> Calibration:
    """Measure a seeded random sample of scenes for about ``budget_s`` seconds.

    One scene is computed first, so that code is compiled and caches are filled.

    Parameters
    ----------
    pipeline
        Measured on its own grid.
    budget_s
        Seconds.
    cost
        Computes a batch; it may raise ``TimeoutError`` with the seconds that it was given, to end
        the measurement.
    """
    axes = scene_axes(pipeline)
    generator = np.random.Generator(np.random.PCG64(0))
    costs: list[BatchCost] = []
    picks: list[Indices] = []
    batch, growing = 1, True
    indices = _sample(pipeline, generator, batch)
    try:
        cost(pipeline, indices)
        started = time.perf_counter()
        while len(costs) < MAX_BATCHES:
            indices = _sample(pipeline, generator, batch)
            costs.append(cost(pipeline, indices))
            picks.append(indices)
            left = budget_s - (time.perf_counter() - started)
            if left <= 0:
                break
            scene_s = max(sum(c.spent_s for c in costs) / sum(len(c.scene_s) for c in costs), 1e-9)
            wanted = min(max(int(BATCH_S / scene_s), 1), MAX_BATCH)
            if growing and wanted <= GROWTH * batch:
                # The batches so far were small: the cost of a call is much of theirs.
                growing = False
                costs.clear()
                picks.clear()
            batch = min(wanted, GROWTH * batch, max(int(left / scene_s), 1))
    except TimeoutError as error:
        over_s = error.args[0]
        count = len(indices[0]) if axes else 1
        costs.append(BatchCost(over_s, np.full(count, over_s / count), over_s))
        return _calibration(pipeline, [*picks, indices], costs, over=True)
    return _calibration(pipeline, picks, costs)


def _calibration(
    pipeline: Pipeline, picks: list[Indices], costs: list[BatchCost], *, over: bool = False
) -> Calibration:
    """Return what batches, at indices ``picks``, say of the grid."""
    cost = np.concatenate([one.scene_s for one in costs])
    unevenness = []
    for k, axis in enumerate(scene_axes(pipeline)):
        index = np.concatenate([chosen[k] for chosen in picks])
        low = index < len(axis) / 2
        if len(axis) < 2 or low.all() or not low.any():
            unevenness.append(0.0)
            continue
        a, b = cost[low].mean(), cost[~low].mean()
        unevenness.append(float(abs(a - b) / (a + b) * 2))
    error = float(cost.std(ddof=1) / math.sqrt(len(cost))) if len(cost) > 1 else 0.0
    mean = sum(one.spent_s for one in costs) / len(cost)
    return Calibration(mean, error, len(cost), tuple(unevenness), over)


UNMEASURED_S = 0.01
"""Assumed cost of a scene if the measurement crashed."""


def calibrate_isolated(
    child: Child, pipeline: Pipeline, budget_s: float, limit_s: float
) -> Calibration:
    """Call :func:`calibrate` with a child process, which a scene may crash.

    If it crashes or raises, :data:`UNMEASURED_S` is assumed, also if this machine is at fault:
    whether the workers' are is seen by their blocks. What takes longer than ``limit_s``
    seconds, or :data:`CALIBRATION_LIMIT_S`, compilation not counted, is abandoned, and the child
    ends.
    """
    try:
        return calibrate_in(child, pipeline, budget_s, min(limit_s, CALIBRATION_LIMIT_S))
    except (ChildDiedError, ChildRaisedError, MachineFaultError):
        return Calibration(UNMEASURED_S, 0.0, 0, (0.0,) * len(scene_axes(pipeline)))


def calibrate_in(child: Child, pipeline: Pipeline, budget_s: float, limit_s: float) -> Calibration:
    """Call :func:`calibrate` with a child process and a time limit.

    Raises
    ------
    ChildDiedError
        If a scene crashes the child.
    ChildRaisedError
        If a scene raises.
    """
    left = limit_s

    def cost(pipeline: Pipeline, indices: Indices) -> BatchCost:
        nonlocal left
        try:
            spent: BatchCost = child.call(
                batch_cost, pipeline, indices, limit_s=max(left, MIN_LIMIT_S),
                grace_s=COMPILATION_LIMIT_S,
            )
        except ChildDiedError as error:
            if error.timed_out:
                raise TimeoutError(max(left, MIN_LIMIT_S)) from None
            raise
        left -= spent.running_s
        return spent

    return calibrate(pipeline, budget_s, cost)


def sample(
    axes: tuple[Axis, ...], generator: np.random.Generator, count: int
) -> list[NDArray[np.intp]]:
    """Return random indices (count,) along each scene axis."""
    return [generator.integers(0, len(axis), count).astype(np.intp) for axis in axes]


def _sample(pipeline: Pipeline, generator: np.random.Generator, count: int) -> Indices:
    """Return the indices of a random sample of scenes: of photographs all markers of one."""
    axes = scene_axes(pipeline)
    if not shows_photographs(pipeline):
        return sample(axes, generator, count)
    each = [
        generator.integers(0, len(axis), 1) if along else np.arange(len(axis))
        for axis, along in zip(axes, along_photographs(axes), strict=True)
    ]
    return [grid.ravel().astype(np.intp) for grid in np.meshgrid(*each, indexing="ij")]


def block_work_s(total_s: float, workers: int, time_limit_s: float | None = None) -> float:
    """Return the seconds of work in a block of a run that takes ``total_s`` of one worker.

    About 2; more for large clusters and for long runs; less if there is little to do, or if the
    user gives a time limit of which it would be too large a share.
    """
    wanted = max(BLOCK_S, workers / BLOCKS_PER_S, total_s / MAX_BLOCKS)
    share = max(MIN_BLOCK_S, total_s / (workers * BLOCKS_PER_WORKER))
    return min(wanted, longest_block_s(time_limit_s), share)


def longest_block_s(time_limit_s: float | None) -> float:
    """Return the seconds of work that a block may take, under the user's time limit if any."""
    if time_limit_s is None:
        return MAX_BLOCK_S
    return min(max(BLOCK_S, MAX_BLOCK_SHARE * time_limit_s), MAX_BLOCK_S)


def block_time_limit_s(time_limit_s: float | None, work_s: float) -> float:
    """Return the timeout of blocks of ``work_s``: the user's if there is one, else 600 s or more.

    >>> block_time_limit_s(None, 2.0), block_time_limit_s(None, 500.0), block_time_limit_s(40, 2.0)
    (600.0, 5000.0, 40)
    """
    return max(TIME_LIMIT_S, work_s / MAX_BLOCK_SHARE) if time_limit_s is None else time_limit_s


def block_extents(
    pipeline: Pipeline, calibration: Calibration, workers: int, block_s: float | None = None,
    time_limit_s: float | None = None,
) -> tuple[int, ...]:
    """Return the scenes of a block along each scene axis.

    Axes along which the cost changes are not cut if possible, so that blocks are even; of the
    others, the first axis of the file is cut first.

    Parameters
    ----------
    pipeline, calibration
        The grid, and what its scenes cost.
    workers
        Threads that share the work.
    block_s
        Seconds of work in a block (default: :func:`block_work_s`).
    time_limit_s
        Block timeout in seconds, if the user gave one.
    """
    axes = scene_axes(pipeline)
    if shows_photographs(pipeline):  # each is searched once, for all its markers
        return tuple(
            1 if along else len(axis)
            for axis, along in zip(axes, along_photographs(axes), strict=True)
        )
    total_s = pipeline.size(Stage.scene) * calibration.scene_s
    rule = make_rule(pipeline)
    if rule is not None:
        # What is written of a block costs as much if few of its scenes are needed.
        total_s = max(total_s * rule.ends[0] / rule.ends[-1], WAVE_BLOCK_S * BLOCKS_PER_WORKER)
    work_s = block_work_s(total_s, workers, time_limit_s) if block_s is None else block_s
    most = min(MAX_BLOCK_SCENES, MAX_BLOCK_BYTES // bytes_per_block(pipeline, 1))
    target = max(min(int(work_s / calibration.scene_s), most), 1)
    extents = _cut(pipeline, calibration, target, rule)
    if block_s is None:
        # Blocks that fit into the axes are smaller than wanted, so that there may be more.
        most = min(most, int(longest_block_s(time_limit_s) / calibration.scene_s))
        while target < most and _count(pipeline, extents) > MAX_BLOCKS:
            target = min(math.ceil(LARGER * target), most)
            extents = _cut(pipeline, calibration, target, rule)
    return extents


LARGER = 1.2
"""By how much blocks are made larger until there are few enough."""


def _count(pipeline: Pipeline, extents: tuple[int, ...]) -> int:
    return len(Blocks(tuple(len(axis) for axis in scene_axes(pipeline)), extents))


def _cut(
    pipeline: Pipeline, calibration: Calibration, target: int, rule: Stopping | None = None
) -> tuple[int, ...]:
    """Return the extents of blocks of at most ``target`` scenes.

    With a rule, the trials of a block are those of a wave, or an equal part of them.
    """
    axes = scene_axes(pipeline)
    order = sorted(
        range(len(axes)),
        key=lambda k: (max(calibration.unevenness[k] - UNEVEN, 0.0), k),
        reverse=True,
    )
    extents = [1] * len(axes)
    if rule is not None:
        trial = next(k for k, axis in enumerate(axes) if axis.name == TRIAL)
        unit = block_unit(rule.ends)
        extents[trial] = max(k for k in range(1, min(unit, target) + 1) if unit % k == 0)
        order = [k for k in order if k != trial and axes[k].name in rule.coupled] + [
            k for k in order if k != trial and axes[k].name not in rule.coupled]
        if extents[trial] < unit:
            order = []
    for k in order:
        most = max(target // math.prod(extents), 1)
        length = len(axes[k])
        if most >= length:
            extents[k] = length
            continue
        # Equal parts rather than a short last one.
        extents[k] = -(-length // -(-length // most))
        break
    return tuple(extents)


# --------------------------------------------------------------------------------------------------
# What a run in waves will need, from a small pilot: some conditions, their first wave.
#
# The trials of the pilot are drawn again and again (the bootstrap) in the place of those to come,
# and the rule of stopping is applied wave by wave. So it is one method for every rule.

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
