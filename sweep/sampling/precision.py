"""The rule of [precision]: a condition needs trials until every interval is narrow enough."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sweep.measure.flags import DetectionStatus, uncounted_values
from sweep.messages import nearest, refusal
from sweep.plan.experiment import Pipeline
from sweep.plan.precision_rule import PrecisionRule
from sweep.sampling.stopping import GroupResults, condition_axes, unit_of, wave_ends
from sweep.typing import Masks

ALPHA = 0.035
"""Error of the interval of Clopper and Pearson that is looked at after each wave."""

RATES = ("detection_rate",)


@dataclass(frozen=True, slots=True)
class PrecisionSampling:
    """Attributes as `sweep.sampling.stopping.Stopping` has them."""

    ends: tuple[int, ...]
    variables: tuple[str, ...]
    coupled: tuple[str, ...]
    half_width: float

    def needed(self, results: GroupResults) -> Masks:
        """Return the scenes whose condition has a configuration with too wide an interval."""
        from scipy.special import betaincinv  # noqa: PLC0415  (slow to import)

        names = [axis.name for axis in condition_axes(results.pipeline)]
        pooled = tuple(k for k, name in enumerate(names) if name in self.coupled)
        flags = results.values["detection"]
        over = (*pooled, len(names))
        counted = ~np.isin(flags, uncounted_values(DetectionStatus))
        n = counted.sum(axis=over, keepdims=True).astype(np.float64)
        k = (flags == DetectionStatus.detected).sum(axis=over, keepdims=True).astype(np.float64)
        low = np.where(k > 0, betaincinv(np.maximum(k, 1.0), n - k + 1, ALPHA / 2), 0.0)
        high = np.where(k < n, betaincinv(k + 1, np.maximum(n - k, 1.0), 1 - ALPHA / 2), 1.0)
        wide = (high - low > 2 * self.half_width) & (n > 0)
        wide = wide.reshape((*wide.shape[: len(names)], -1)).any(axis=-1)
        return np.broadcast_to(wide, results.shape)


def precision_sampling(pipeline: Pipeline, rule: PrecisionRule) -> PrecisionSampling:
    """Return the rule of a pipeline's section [precision].

    Raises
    ------
    PipelineError
        One line for each name that no quantity has.
    """
    faults = [
        f"{pipeline.name}: precision.{name}: no quantity{nearest(name, RATES)}"
        for name, _ in rule.wanted if name not in RATES
    ]
    if faults:
        raise refusal(faults)
    axes = condition_axes(pipeline)
    coupled = tuple(axis.name for axis in axes if axis.name not in rule.per)
    pooled = math.prod(len(axis) for axis in axes if axis.name in coupled)
    return PrecisionSampling(
        wave_ends(rule.max_trials, unit_of(pooled)), ("detection",), coupled, rule.wanted[0][1]
    )
