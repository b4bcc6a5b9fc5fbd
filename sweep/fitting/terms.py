"""The terms of a scene: what each was estimated to be, and whether it is kept."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from sweep.fitting.estimates import Estimate
from sweep.plan.parameters import PARAMETERS

DIGITS = 4
"""Significant digits of the values that are written."""


@dataclass(frozen=True, slots=True)
class Term:
    """One parameter of a scene.

    Attributes
    ----------
    name
        What it is, in words.
    parameter
        Its name in pipelines.
    estimate
        What it was estimated to be.
    kept
        Whether the scene has it.
    reason
        Why it is kept or left out.
    absent
        The value at which the effect is absent; None of what every scene has.
    of
        Parameter that switches the effect on, if that is another one: they are kept together.
    setting
        What a pipeline has in the place of a value or a distribution that follow from the
        estimate; None for these.
    """

    name: str
    parameter: str
    estimate: Estimate
    kept: bool = True
    reason: str = ""
    absent: float | None = None
    of: str = ""
    setting: Any = None

    @property
    def value(self) -> Any:
        """What a pipeline has: the mean, or a distribution of the spread between photographs."""
        return drawn(self.parameter, self.estimate) if self.setting is None else self.setting

    def as_json(self) -> dict[str, Any]:
        """Return it as JSON takes it; NaN as None."""
        one = self.estimate
        numbers = {
            name: value if math.isfinite(value) else None
            for name, value in (("value", one.value), ("low", one.low), ("high", one.high),
                                ("spread", one.spread))
        }
        return {"name": self.name, "parameter": self.parameter, **numbers, "kept": self.kept,
                "reason": self.reason}

    def left_out(self, reason: str) -> Term:
        """Return it as not kept."""
        return replace(self, kept=False, reason=reason)


def drawn(parameter: str, estimate: Estimate) -> Any:
    """Return the mean, or the uniform distribution of the same mean and standard deviation.

    Uniform, since a normal one has values that no scene can have, such as a blur below 0.
    """
    value = shortened(estimate.value)
    declared = PARAMETERS[parameter].declaration
    half = math.sqrt(3.0) * estimate.spread
    if not half > 0 or not declared.drawable:
        return value
    low, high = estimate.value - half, estimate.value + half
    if declared.low is not None:
        low = max(low, declared.low)
    if declared.high is not None:
        high = min(high, declared.high)
    low, high = shortened(low), shortened(high)
    return {"uniform": [low, high]} if low < high else value


def shortened(value: float) -> float:
    """Return a number with as many digits as are written."""
    return float(f"{value:.{DIGITS}g}")


def judged(
    name: str, parameter: str, estimate: Estimate, absent: float, test: Estimate | None = None,
    convert: Callable[[Estimate], Estimate] | None = None,
) -> Term:
    """Return a term that is kept if its interval excludes the value at which it is absent.

    ``test`` is the estimate that decides, if it is another one; ``convert`` makes of an estimate
    that of the parameter.
    """
    deciding = estimate if test is None else test
    shown = estimate if convert is None else convert(estimate)
    if not math.isfinite(deciding.value):
        return Term(name, parameter, shown, False, "no pixels that say it", absent)
    if not deciding.judged:
        return Term(
            name, parameter, shown, shown.value != absent, "too few photographs to judge", absent
        )
    if not deciding.excludes(absent):
        return Term(name, parameter, shown, False, f"95 % interval includes {absent:g}", absent)
    return Term(name, parameter, shown, True, f"95 % interval excludes {absent:g}", absent)
