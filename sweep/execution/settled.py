"""What a run in waves came to: poses that were needed, and conditions that are not settled."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from sweep.plan.cell_selection import selection_text
from sweep.plan.experiment import Pipeline
from sweep.plan.precision_rule import PrecisionRule
from sweep.sampling.deciding import Decider, Decision
from sweep.sampling.stopping import condition_axes
from sweep.store.lifecycle import open_dataset
from sweep.store.run_store import RunStore

MAX_LISTED = 1000
"""Conditions that are recorded by name."""

MAX_REACHED = 3
"""Conditions of which is recorded what was reached."""


@dataclass(frozen=True, slots=True)
class SampledConditions:
    """The conditions of a finished run in waves.

    Attributes
    ----------
    needed
        Poses that were needed; those that were not are the rest of the grid.
    conditions
        How many there are.
    unsettled
        How many of them would need more than ``max_trials``.
    at
        The first of these, as ``--at`` takes them.
    reached
        Of the first of them, what was reached: the quantity that is farthest from what was wanted.
    """

    needed: int
    conditions: int
    unsettled: int
    at: list[str]
    reached: list[str]

    def to_json(self) -> dict[str, Any]:
        """Return what a store records."""
        return asdict(self)


def conditions_of(pipeline: Pipeline) -> tuple[str, ...]:
    """Return the names of the axes of which every combination of values is a condition."""
    per = getattr(pipeline.stopping, "per", None)
    return tuple(axis.name for axis in condition_axes(pipeline) if per is None or axis.name in per)


def condition_count(pipeline: Pipeline) -> int:
    """Return the number of conditions."""
    names = conditions_of(pipeline)
    return math.prod(len(axis) for axis in condition_axes(pipeline) if axis.name in names)


def sampled_conditions(store: RunStore, needed: Mapping[int, int]) -> SampledConditions | None:
    """Return what a complete store in waves came to; None for one of fixed trials.

    Parameters
    ----------
    store
        A store of which every block is committed.
    needed
        Block -> how many of its scenes were needed.
    """
    pipeline, rule = store.pipeline, store.pipeline.stopping
    if rule is None:
        return None
    decider = Decider.of(store, rule)
    waves, axes, kept = decider.waves, condition_axes(pipeline), conditions_of(pipeline)
    last = len(waves.ends) - 1
    count = 0
    listed: list[str] = []
    first: list[dict[str, int]] = []
    for group in range(waves.groups):
        numbers = list(waves.numbers(group, last))
        if not any(needed[number] for number in numbers):
            continue
        span = waves.span(store.blocks[numbers[0]])
        mask = decider.of_group(span, Decision(rule, last + 1, tuple(range(last + 1))))
        pooled = tuple(k for k, axis in enumerate(axes) if axis.name not in kept)
        mask = np.asarray(mask.any(axis=pooled, keepdims=True))
        count += int(mask.sum())
        starts = [span.starts[k] for k in range(len(span.starts)) if k != waves.trial]
        first += [
            {axis.name: start + k for axis, start, k in zip(axes, starts, index, strict=True)
             if axis.name in kept}
            for index in np.argwhere(mask)[: MAX_REACHED - len(first)].tolist()
        ]
        listed += [
            selection_text({
                axis.name: axis.values[start + k]
                for axis, start, k in zip(axes, starts, index, strict=True) if axis.name in kept
            })
            for index in np.argwhere(mask)[: MAX_LISTED - len(listed)].tolist()
        ]
    return SampledConditions(
        sum(needed.values()), condition_count(pipeline), count, listed,
        [_reached(store, index) for index in first],
    )


def _reached(store: RunStore, index: Mapping[str, int]) -> str:
    """Return what was reached at a condition, of the quantity that is farthest from its wish."""
    if not isinstance(store.pipeline.stopping, PrecisionRule):
        return ""
    from sweep.analysis.half_widths import Reached  # noqa: PLC0415  (slow to import)
    from sweep.analysis.precision import precision_reached  # noqa: PLC0415

    results = open_dataset(store.url).isel({name: [k] for name, k in index.items()})
    table = precision_reached(results)
    short = (table["half_width"] / table["wanted"]).where(
        table["reached"] == Reached.not_reached, -np.inf).fillna(np.inf)
    worst = table.isel(short.argmax(...))
    return (
        f"{worst['quantity'].item()} {worst['value'].item():.4g}, half-width "
        f"{worst['half_width'].item():.3g} of {worst['wanted'].item():g} wanted"
    )
