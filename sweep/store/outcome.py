"""What became of a run's cells: counts of flags, and failures."""

from __future__ import annotations

import re
import shlex
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.experiment.grid import Block
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline, selection_text
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flag
from sweep.messages import plain
from sweep.processor import differing_processors
from sweep.store.blocks import RunStore, committed, receipts
from sweep.store.receipt import FailedCell

if TYPE_CHECKING:
    import xarray as xr


# --------------------------------------------------------------------------------------------------
# Cells whose computation raised or whose process died: their coordinates, and the reason.

MAX_ROWS = 1000
"""Rows of each kind (failed, crashed) that a store keeps; the flags count all of them."""

MAX_PER_BLOCK = 100

MAX_CHARACTERS = 4000
"""Characters that are kept of a traceback: its end."""


def recorded(
    pipeline: Pipeline, block: Block, failures: Sequence[Any], rows: Sequence[int],
    quota: Mapping[str, int],
) -> tuple[FailedCell, ...]:
    """Return the failures that a block's receipt keeps: at most ``quota`` of each kind.

    ``rows`` gives the number within the block of each scene that was computed.
    """
    kept: list[FailedCell] = []
    left = {kind: min(count, MAX_PER_BLOCK) for kind, count in quota.items()}
    for failure in failures:
        kind = "crashed" if failure.crashed else "failed"
        if left[kind] <= 0:
            continue
        left[kind] -= 1
        kept.append(FailedCell(
            selected(pipeline, block.cell(rows[failure.scene]), failure), kind, failure.stage,
            failure.text[-MAX_CHARACTERS:],
        ))
    return tuple(kept)


def selected(pipeline: Pipeline, cell: Sequence[int], failure: Any) -> str:
    """Return the coordinates of a failure's cell, as ``sweep repro --at`` takes them."""
    indices = {axis.name: k for axis, k in zip(pipeline.experiment.scene_axes, cell, strict=True)}
    for number, stage in (
        (failure.setting, Stage.detection), (failure.estimator, Stage.estimation),
    ):
        axes = pipeline.axes_of(stage)
        if number is not None and axes:
            index = np.unravel_index(number, [len(axis) for axis in axes])
            indices |= {axis.name: int(k) for axis, k in zip(axes, index, strict=True)}
    return selection_text(pipeline, indices)


def failure_table(cells: Sequence[FailedCell], counts: Mapping[str, int]) -> xr.Dataset:
    """Return the table of failures, with the total number of cells of each kind."""
    import xarray as xr  # noqa: PLC0415  (slow to import)

    def column(name: str) -> tuple[tuple[str], Any]:
        return ("failure",), np.array([getattr(cell, name) for cell in cells], dtype=object)

    return xr.Dataset(
        {name: column(name) for name in ("at", "kind", "stage", "text")},
        attrs={
            "long_name": "scenes that raised or ended their process",
            "rows_kept": f"at most {MAX_ROWS} of each kind, and {MAX_PER_BLOCK} of a block",
            **{f"{kind}_cells": count for kind, count in counts.items()},
        },
    )


# --------------------------------------------------------------------------------------------------
# The outcome of a run in words: what failed and why, and whether anything was computed.

LOUD_SHARE = 0.1
"""Share of the cells that were tried, above which failures are told first."""

MAX_GROUPS = 5
"""Groups of failures that are listed; the others are counted."""

MAX_REASON = 200

NOT_TRIED = (
    "not_run", "no_detection", DetectionStatus.not_visible.name, DetectionStatus.not_modelled.name,
    DetectionStatus.not_needed.name,
)
"""Flags of cells on which a stage was not tried."""

_VARYING = re.compile(r"0x[0-9a-fA-F]+|[-+]?\d[\d_,]*(?:\.\d*)?(?:[eE][-+]?\d+)?")
"""Parts of messages that differ from cell to cell: addresses and numbers."""


@dataclass(frozen=True, slots=True)
class FailureGroup:
    """Cells that failed for the same reason.

    Attributes
    ----------
    kind
        "failed" (an exception was raised) or "crashed" (the process died).
    stage
        "scene", "detection" or "estimation".
    reason
        Type and message of the first cell's exception, or how its process died.
    count
        Recorded cells; a store records 1,000 of each kind.
    at
        The first cell, as ``sweep repro --at`` takes it.
    """

    kind: str
    stage: str
    reason: str
    count: int
    at: str


def failure_groups(cells: Iterable[FailedCell]) -> list[FailureGroup]:
    """Group failed cells by kind, stage, and message without its numbers; the largest first.

    Examples
    --------
    >>> cells = [FailedCell(f"trial={n}", "failed", "scene", f"ValueError: {n} px") for n in (3, 8)]
    >>> [(group.reason, group.count, group.at) for group in failure_groups(cells)]
    [('ValueError: 3 px', 2, 'trial=3')]
    """
    first: dict[tuple[str, str, str], FailedCell] = {}
    counts: dict[tuple[str, str, str], int] = {}
    for cell in cells:
        key = cell.kind, cell.stage, _VARYING.sub("#", cell.reason)
        first.setdefault(key, cell)
        counts[key] = counts.get(key, 0) + 1
    groups = [
        FailureGroup(cell.kind, cell.stage, plain(cell.reason, MAX_REASON), counts[key], cell.at)
        for key, cell in first.items()
    ]
    return sorted(groups, key=lambda group: -group.count)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of the cells of a store.

    Attributes
    ----------
    nothing_computed
        Whether a stage was tried and failed on every cell.
    failed_share
        Share of the cells that failed or crashed, of those that a stage was tried on; the largest
        of the stages.
    failures
        The cells that failed or crashed, by reason.
    warnings
        The same for a reader; and that nothing was detected, or no pose estimated. Empty if there
        is nothing to tell.
    advice
        The command that recomputes one cell of each reason; empty where there is nothing to tell.
    """

    nothing_computed: bool
    failed_share: float
    failures: list[FailureGroup]
    warnings: list[str]
    advice: str


def outcome_of(
    url: str, detection: Sequence[int], estimate: Sequence[int], cells: Iterable[FailedCell],
    first: str = "",
) -> Outcome:
    """Return the outcome of the cells that a store holds.

    Parameters
    ----------
    url
        The store, for the command that repeats failures.
    detection, estimate
        Counts of cells; the flag is the index.
    cells
        The recorded failures.
    first
        A cell to look at where nothing was detected, as ``--at`` takes it.
    """
    groups = failure_groups(cells)
    stages = _by_name(DetectionStatus, detection), _by_name(EstimateStatus, estimate)
    shares, lines = zip(*map(_lost, ("detections", "estimates"), stages), strict=True)
    warnings = list(filter(None, lines))
    advice = ""
    if groups:
        warnings += _listed(groups)
        advice = repro_command(url, [group.at for group in groups])
    if 1.0 not in shares and (nothing := _nothing_found(*stages)):
        warnings.append(nothing)
        advice = advice or f"{repro_command(url, [first])} -o scene.png"
    return Outcome(1.0 in shares, max(shares), groups, warnings, advice)


def outcome_of_finished(store: RunStore) -> Outcome:
    """Return what became of the cells of a finished store.

    Raises
    ------
    StoreError
        If cells failed, and a receipt that may record them is damaged.
    """
    detection, estimate = (store.run_metadata["counts"][name] for name in ("detection", "estimate"))
    any_lost = any(
        _by_name(flags, counts)[kind] for kind in ("failed", "crashed")
        for flags, counts in ((DetectionStatus, detection), (EstimateStatus, estimate))
    )
    cells = [
        cell for _, receipt in receipts(store, committed(store)) for cell in receipt.failures
    ] if any_lost else []
    found = outcome_of(store.url, detection, estimate, cells, first_cell(store))
    processors = store.run_metadata["counts"].get("processors") or {}
    found.warnings.extend(differing_processors(processors, "blocks"))
    return found


def first_cell(store: RunStore) -> str:
    """Return the first cell of a store's grid, as ``sweep repro --at`` takes it."""
    return selection_text(store.pipeline, {axis.name: 0 for axis in store.pipeline.axes})


def _by_name(flags: Iterable[Flag], counts: Iterable[int]) -> Counter[str]:
    """Return the counts of the flags that occur, by name."""
    return Counter({
        flag.name: count for flag, count in zip(flags, counts, strict=False) if count})


def _lost(cells: str, counts: Counter[str]) -> tuple[float, str]:
    """Return the share of ``cells`` that failed or crashed, and a line on them if there are any."""
    kinds = [kind for kind in ("failed", "crashed") if counts[kind]]
    lost = counts["failed"] + counts["crashed"]
    tried = counts.total() - sum(counts[flag] for flag in NOT_TRIED)
    if not lost:
        return 0.0, ""
    if lost == tried:
        return 1.0, f"nothing computed: all {lost:,} {cells} {' or '.join(kinds)}"
    share = lost / tried
    loud = "warning: " if share > LOUD_SHARE else ""
    listed = " and ".join(f"{counts[kind]:,} {kind}" for kind in kinds)
    percent = f"{100 * share:.{2 if share < 0.995 else 4}g} %"
    return share, f"{loud}{listed} of {tried:,} {cells} ({percent})"


def _listed(groups: Sequence[FailureGroup]) -> list[str]:
    lines = [
        f"  {group.count:,} x {group.kind} in {group.stage}: {group.reason}"
        for group in groups[:MAX_GROUPS]
    ]
    if len(groups) > MAX_GROUPS:
        rest = sum(group.count for group in groups[MAX_GROUPS:])
        lines.append(f"  {rest:,} x for {len(groups) - MAX_GROUPS:,} other reasons")
    return lines


def repro_command(url: str, cells: Sequence[str]) -> str:
    """Return the command that recomputes cells of a store.

    >>> repro_command("runs/a.zarr", ["trial=3", "dictionary=DICT_4X4_50"])
    'sweep repro runs/a.zarr --at trial=3 --at dictionary=DICT_4X4_50'
    """
    chosen = [f"--at {shlex.quote(at)}" for at in cells[:MAX_GROUPS] if at]
    return " ".join(["sweep repro", shlex.quote(url), *chosen])


def _nothing_found(detection: Counter[str], estimate: Counter[str]) -> str:
    """Return a line that says that nothing was detected, or no pose estimated; or nothing."""
    if not detection["detected"]:
        flags: type[Flag] = DetectionStatus
        counts, what = detection, "nothing was detected"
    elif not any(estimate[flag.name] for flag in EstimateStatus if flag.present):
        flags, counts, what = EstimateStatus, estimate, "no pose was estimated"
    else:
        return ""
    needed = Counter({name: count for name, count in counts.items() if name != "not_needed"})
    if not needed:
        return ""
    ((name, count),) = needed.most_common(1)
    return f"warning: {what}: {count:,} {name} ({flags[name].meaning.rstrip('.')})"
