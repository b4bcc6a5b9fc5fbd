"""What each alternative of a choice costs: the time of a frame at its answer, measured in turns."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sweep.analysis.choices import Answer
from sweep.execution.progress import StageReport
from sweep.isolation.interrupts import Interrupts
from sweep.plan.choice_rule import ChoiceRule
from sweep.plan.experiment import Pipeline
from sweep.plan.parameters import Stage
from sweep.tradeoff.configuration_costs import measure
from sweep.tradeoff.paired_timing import median_interval
from sweep.tradeoff.scene_sample import sample_scenes

MAX_CONDITIONS = 24
"""Conditions of each answer that are measured; of more, so many from all over the grid."""


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
    pipeline: Pipeline, rule: ChoiceRule, found: Sequence[Answer], limit_s: float,
    report: StageReport,
) -> list[Cost | None]:
    """Return the cost of each alternative, at its answer; None for one without an answer.

    Where no value is sought along an axis, those that meet nothing are measured, too: an answer is
    the cheapest then, and they are what is cheaper.

    Parameters
    ----------
    pipeline, rule
        The experiment and what is chosen.
    found
        The answers, in the order of the combinations of the axes ``rule.among``.
    limit_s
        Seconds of the measurement, about.
    report
        Called with what is being done, and the share of it that is done.
    """
    axes = {axis.name: axis for axis in pipeline.axes}
    conditions = _conditions(pipeline, rule)
    samples: dict[tuple[tuple[str, int], ...], list[int]] = {}
    for k, answer in enumerate(found):
        if rule.along and answer.value is None:
            continue
        scene = {name: _position(axes[name].values, value)
                 for name, value in answer.alternative.items()
                 if axes[name].stage is Stage.scene}
        if rule.along:
            scene[rule.along] = _position(axes[rule.along].values, answer.value)
        samples.setdefault(tuple(scene.items()), []).append(k)
    if not samples:
        return [None] * len(found)
    count = len(samples) * len(conditions)
    drawn = [sample_scenes(pipeline, {**dict(scene), **condition}, count)
             for scene in samples for condition in conditions]
    words = f"measuring the cost of {len(found):,} alternative{'s' if len(found) > 1 else ''}"
    report(words, 0.0)
    with Interrupts() as interrupts:
        costs = measure(
            pipeline, drawn, limit_s, interrupts, lambda share: report(words, share))
    # (conditions, detector settings * estimators)
    ends = [np.asarray(end).reshape(count, -1) for end in median_interval(1e3 * costs.total)]
    settings = [axis.name for stage in (Stage.detection, Stage.estimation)
                for axis in pipeline.axes_of(stage)]
    lengths = [len(axes[name]) for name in settings]
    out: list[Cost | None] = [None] * len(found)
    for number, members in enumerate(samples.values()):
        rows = slice(number * len(conditions), (number + 1) * len(conditions))
        for k in members:
            index = [_position(axes[name].values, found[k].alternative[name]) for name in settings]
            column = int(np.ravel_multi_index(index, lengths)) if settings else 0
            ms = ends[0][rows, column]
            if np.isnan(ms).all():
                continue
            worst = int(np.nanargmax(ms))
            at = conditions[worst]
            median, low, high = (float(end[rows, column][worst]) for end in ends)
            out[k] = Cost(
                median, low, high, {name: axes[name].values[i] for name, i in at.items()})
    return out


def _position(values: Sequence[Any], value: Any) -> int:
    """Return the index of a value, which a dataset may have as another type of number."""
    return next(k for k, each in enumerate(values) if each == value)


def _conditions(pipeline: Pipeline, rule: ChoiceRule) -> list[dict[str, int]]:
    """Return the indices along the axes of conditions, of all, or of some from all over them."""
    lengths = {axis.name: len(axis) for axis in pipeline.axes if axis.name in rule.per}
    total = math.prod(lengths.values())
    count = min(total, MAX_CONDITIONS)
    numbers = (k * (total - 1) // max(count - 1, 1) for k in range(count))
    return [
        dict(zip(lengths, map(int, np.unravel_index(k, tuple(lengths.values()))), strict=True))
        if lengths else {} for k in numbers]
