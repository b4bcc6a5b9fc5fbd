"""What a run did, in one record."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sweep.errors import StoreError
from sweep.execution.finalize import lost
from sweep.execution.retry import Retry
from sweep.measure.flags import DetectionStatus
from sweep.plan.parameters import Stage
from sweep.plan.precision_rule import PrecisionRule
from sweep.store.blocks import committed
from sweep.store.outcome import FailureGroup, outcome_of_finished
from sweep.store.run_store import RunStore
from sweep.store.snapshot import missing_chunks


@dataclass(frozen=True, slots=True)
class Summary:
    """What a run did; ``sweep run --json`` prints it.

    Attributes
    ----------
    store
        The store as it was given, or the default.
    data
        What ``xarray.open_zarr`` opens.
    poses
        Cells of the grid's scene axes.
    results
        Estimates: poses times detector settings times estimators.
    detected
        Detections, over all detector settings.
    blocks
        Blocks of the store.
    computed_blocks, computed_scenes, computed_estimates
        What this run computed; the rest was committed before, or reused from other stores.
    seconds
        Duration of this run.
    crashed, failed
        Cells that are flagged so.
    nothing_computed
        Whether a stage was tried and failed on every cell; ``sweep run`` ends with status 1 then.
    failed_share
        Share of the cells that failed or crashed, of those that a stage was tried on.
    failures
        The same cells by reason, each with one that ``sweep repro --at`` takes.
    warnings
        The lines of ``sweep run`` on failures, and on a run in which nothing was detected.
    advice
        The command that recomputes a cell for each reason; empty without warnings.
    needed, conditions, unsettled
        Of a run in waves, the poses that were needed, the conditions, and those of them that would
        need more than ``max_trials``; None of a run of fixed trials.
    retried, recovered
        Failed and crashed cells that were tried again, and those that did not fail again.
    """

    store: str
    data: str
    poses: int
    results: int
    detected: int
    blocks: int
    computed_blocks: int
    computed_scenes: int
    computed_estimates: int
    seconds: float
    crashed: int = 0
    failed: int = 0
    nothing_computed: bool = False
    failed_share: float = 0.0
    failures: list[FailureGroup] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    advice: str = ""
    retried: int = 0
    recovered: int = 0
    needed: int | None = None
    conditions: int | None = None
    unsettled: int | None = None


def summary_of_complete(store: RunStore, started: float) -> Summary:
    """Return the summary of a run into a store that was finished before it began.

    Raises
    ------
    StoreError
        If blocks, or chunks of them, are missing.
    """
    whole = committed(store)
    done = len(whole) - len(missing_chunks(store, whole))
    if done != len(store.blocks):
        raise StoreError(
            f"{store.url}: damaged: finished, but {done:,} of {len(store.blocks):,} blocks are "
            "complete; repair it with `sweep verify --repair`"
        )
    return summary_of(store, {}, time.perf_counter() - started)


def summary_of(
    store: RunStore, computed: Mapping[str, int], seconds: float, retry: Retry | None = None
) -> Summary:
    """Return the summary of a finished store from the counts that it recorded."""
    retry = retry or Retry()
    counts = store.run_metadata["counts"]
    missing = lost(counts["detection"], counts["estimate"])
    outcome = outcome_of_finished(store)
    sampled = counts.get("sampled") or {}
    return Summary(
        store=store.url,
        data=store.data_url,
        poses=store.pipeline.size(Stage.scene),
        results=math.prod(len(axis) for axis in store.pipeline.axes),
        detected=counts["detection"][DetectionStatus.detected],
        blocks=len(store.blocks),
        computed_blocks=computed.get("blocks", 0),
        computed_scenes=computed.get("scenes", 0),
        computed_estimates=computed.get("estimates", 0),
        seconds=round(seconds, 3),
        **missing,
        nothing_computed=outcome.nothing_computed,
        failed_share=round(outcome.failed_share, 6),
        failures=outcome.failures,
        warnings=[*outcome.warnings, *_unsettled_lines(store, sampled)],
        advice=outcome.advice,
        retried=retry.cells,
        recovered=retry.recovered(store),
        needed=sampled.get("needed"),
        conditions=sampled.get("conditions"),
        unsettled=sampled.get("unsettled"),
    )


def _unsettled_lines(store: RunStore, sampled: Mapping[str, Any]) -> list[str]:
    """Return lines on the conditions that would need more than ``max_trials``; often none.

    A search says itself what it does not know.
    """
    count, rule = sampled.get("unsettled"), store.pipeline.stopping
    if not count or not isinstance(rule, PrecisionRule):
        return []
    of = f"{count:,} of {sampled['conditions']:,}"
    lines = [f"warning: {of} conditions are not settled after all {rule.max_trials:,} trials"]
    reached = sampled["reached"]
    lines += [
        f"  {at or 'all poses together'}{': ' if text else ''}{text}"
        for at, text in zip(sampled["at"], reached, strict=False)
    ]
    if count > len(reached):
        lines.append(f"  and {count - len(reached):,} more")
    return lines
