"""Statistics as they are computed of photographs: the markers of one are not independent."""

from __future__ import annotations

import dataclasses
from typing import Any, cast

from sweep.analysis.counts import Rate
from sweep.analysis.flip_mixture import FlipMixture
from sweep.analysis.photograph_quantiles import PhotographQuantiles
from sweep.analysis.photograph_rates import PhotographRate
from sweep.analysis.quantiles import Quantiles
from sweep.analysis.statistic import Statistic, ViewT


def by_photograph(statistic: Statistic[ViewT, Any, Any, Any]) -> Statistic[ViewT, Any, Any, Any]:
    """Return a statistic as it is computed of photographs."""
    changed: Any = statistic
    if isinstance(statistic, Rate):
        changed = PhotographRate(**_fields(statistic))
    elif isinstance(statistic, Quantiles):
        changed = PhotographQuantiles(**_fields(statistic))
    elif isinstance(statistic, FlipMixture):
        flips = PhotographRate(**_fields(statistic.flips))
        changed = dataclasses.replace(statistic, flips=flips)
    return cast("Statistic[ViewT, Any, Any, Any]", changed)


def _fields(statistic: Any) -> dict[str, Any]:
    return {field.name: getattr(statistic, field.name) for field in dataclasses.fields(statistic)}
