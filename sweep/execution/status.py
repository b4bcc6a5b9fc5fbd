"""The account of a run: what its receipts add up to, its end, its retry, its summary and status."""

from __future__ import annotations

import math
import re
import shlex
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.evaluation.block import bound_notes
from sweep.execution.waves import InWaves, condition_count, unsettled_count
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import selection_text
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flag, looked_for
from sweep.messages import plain
from sweep.processor import differing_processors
from sweep.store import blocks
from sweep.store.blocks import FailedCell, Receipt, RunStore
from sweep.store.lifecycle import open_store, reopen, write_groups
from sweep.store.lock import changing, is_written
from sweep.typing import Integers

if TYPE_CHECKING:
    import xarray as xr


# --------------------------------------------------------------------------------------------------
# Totals of a store's receipts.

#: Failed cells, and as many crashed ones, that are listed of a store; the flags count all.
MAX_ROWS = 1000


@dataclass(slots=True)
class Totals:
    """Receipts, added up.

    Attributes
    ----------
    blocks, scenes, needed
        Blocks, scenes of these, and how many of the scenes were needed.
    detection, estimate
        Counts of cells; the flag is the index.
    processors
        Blocks by the features of the processors that computed them.
    failed, crashed
        Such cells, at most :data:`MAX_ROWS` of each.
    """

    blocks: int = 0
    scenes: int = 0
    needed: int = 0
    detection: Integers = field(default_factory=lambda: np.zeros(len(DetectionStatus), np.int64))
    estimate: Integers = field(default_factory=lambda: np.zeros(len(EstimateStatus), np.int64))
    processors: Counter[str] = field(default_factory=Counter)
    failed: list[FailedCell] = field(default_factory=list)
    crashed: list[FailedCell] = field(default_factory=list)

    @staticmethod
    def of(receipts: Iterable[tuple[int, Receipt]]) -> Totals:
        """Return the totals of the receipts of blocks."""
        totals = Totals()
        for _, receipt in receipts:
            totals.add(receipt)
        return totals

    def add(self, receipt: Receipt) -> None:
        """Add the receipt of another block."""
        self.blocks += 1
        self.scenes += receipt.scenes
        self.needed += receipt.scenes_needed
        self.processors.update(receipt.processors)
        self.detection[: len(receipt.detection)] += receipt.detection
        self.estimate[: len(receipt.estimate)] += receipt.estimate
        for cell in receipt.failures:
            listed = self.failed if cell.kind == "failed" else self.crashed
            if len(listed) < MAX_ROWS:
                listed.append(cell)

    @staticmethod
    def of_finished(store: RunStore) -> Totals:
        """Return the counts that a finished store recorded; if cells failed, the listed ones.

        Raises
        ------
        StoreError
            If cells failed, and a receipt that may record them is damaged.
        """
        counts = store.run_metadata["counts"]
        totals = Totals(
            detection=np.array(counts["detection"]), estimate=np.array(counts["estimate"]),
            processors=Counter(counts["processors"]))
        if any(totals.lost.values()):
            listed = Totals.of(blocks.receipts(store, blocks.committed(store)))
            totals.failed, totals.crashed = listed.failed, listed.crashed
        return totals

    @property
    def lost(self) -> dict[str, int]:
        """How many cells crashed and failed."""
        return _lost(self.detection, self.estimate)


def _lost(detection: Iterable[int], estimate: Iterable[int]) -> dict[str, int]:
    """Return how many cells crashed and failed, from counts by flag."""
    both = _by_name(DetectionStatus, detection) + _by_name(EstimateStatus, estimate)
    return {kind: both[kind] for kind in ("crashed", "failed")}


def _by_name(flags: Iterable[Flag], counts: Iterable[int]) -> Counter[str]:
    """Return the counts of the flags that occur, by name."""
    return Counter({
        flag.name: int(count) for flag, count in zip(flags, counts, strict=False) if count})


# --------------------------------------------------------------------------------------------------
# The outcome of a run in words: what failed and why, and whether anything was computed.

#: Share of the cells that were tried, above which failures are told first.
LOUD_SHARE = 0.1

#: Groups of failures that are listed; the others are counted.
MAX_GROUPS = 5

MAX_REASON = 200

#: Flags of cells on which a stage was not tried.
NOT_TRIED = (
    "not_run", "no_detection", DetectionStatus.not_visible.name, DetectionStatus.not_modelled.name,
    DetectionStatus.not_needed.name,
)

#: Parts of messages that differ from cell to cell: addresses and numbers.
_VARYING = re.compile(r"0x[0-9a-fA-F]+|[-+]?\d[\d_,]*(?:\.\d*)?(?:[eE][-+]?\d+)?")


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
    alike: dict[tuple[str, str, str], list[FailedCell]] = {}
    for cell in cells:
        key = cell.kind, cell.stage, _VARYING.sub("#", cell.reason)
        alike.setdefault(key, []).append(cell)
    groups = [
        FailureGroup(
            some[0].kind, some[0].stage, plain(some[0].reason, MAX_REASON), len(some), some[0].at)
        for some in alike.values()
    ]
    return sorted(groups, key=lambda group: -group.count)


def outcome_of(url: str, totals: Totals, first: str) -> dict[str, Any]:
    """Return the outcome of the cells that a store holds, as `Account` has it.

    Parameters
    ----------
    url
        The store, for the command that repeats failures.
    totals
        Totals of its receipts.
    first
        A cell to look at where nothing was detected, as ``--at`` takes it.
    """
    groups = failure_groups([*totals.failed, *totals.crashed])
    shares, warnings, advice = list[float](), list[str](), ""
    counts = {"detections": _by_name(DetectionStatus, totals.detection),
              "estimates": _by_name(EstimateStatus, totals.estimate)}
    for cells, flags in counts.items():
        kinds = [kind for kind in ("failed", "crashed") if flags[kind]]
        lost = sum(flags[kind] for kind in kinds)
        tried = flags.total() - sum(flags[name] for name in NOT_TRIED)
        share = lost / tried if lost else 0.0
        shares.append(share)
        if share == 1.0:
            warnings.append(f"nothing computed: all {lost:,} {cells} {' or '.join(kinds)}")
        elif lost:
            listed = " and ".join(f"{flags[kind]:,} {kind}" for kind in kinds)
            percent = f"{100 * share:.{2 if share < 0.995 else 4}g} %"
            warnings.append(f"{'warning: ' if share > LOUD_SHARE else ''}{listed} of "
                            f"{tried:,} {cells} ({percent})")
    warnings += [f"  {group.count:,} x {group.kind} in {group.stage}: {group.reason}"
                 for group in groups[:MAX_GROUPS]]
    if others := groups[MAX_GROUPS:]:
        rest = sum(group.count for group in others)
        warnings.append(f"  {rest:,} x for {len(others):,} other reasons")
    if groups:
        advice = repro_command(url, [group.at for group in groups])
    if 1.0 not in shares and (nothing := _nothing_found(*counts.values())):
        warnings.append(nothing)
        advice = advice or f"{repro_command(url, [first])} -o scene.png"
    warnings += differing_processors(totals.processors, "blocks")
    return {"nothing_computed": 1.0 in shares, "failed_share": round(max(shares), 6),
            "failures": groups, "warnings": warnings, "advice": advice}


def repro_command(url: str, cells: Sequence[str]) -> str:
    """Return the command that recomputes cells of a store.

    >>> repro_command("runs/a.zarr", ["trial=3", "dictionary=DICT_4X4_50"])
    'sweep repro runs/a.zarr --at trial=3 --at dictionary=DICT_4X4_50'
    """
    chosen = [f"--at {shlex.quote(at)}" for at in cells[:MAX_GROUPS] if at]
    return " ".join(["sweep repro", shlex.quote(url), *chosen])


def _nothing_found(detection: Counter[str], estimate: Counter[str]) -> str:
    """Return a line that says that nothing was detected, or no pose estimated; or nothing."""
    flags: type[Flag] = DetectionStatus
    counts, what = detection, "nothing was detected"
    if detection["detected"]:
        flags, counts, what = EstimateStatus, estimate, "no pose was estimated"
    needed = Counter({name: count for name, count in counts.items() if name != "not_needed"})
    if not needed or any(flags[name].present for name in needed):
        return ""
    ((name, count),) = needed.most_common(1)
    return f"warning: {what}: {count:,} {name} ({flags[name].meaning.rstrip('.')})"


# --------------------------------------------------------------------------------------------------
# Closing a complete store: tables of costs and failures, and counts of flags.

def close(store: RunStore) -> None:
    """Close a store of which every block is committed.

    Its receipts are summed up in the groups ``cost`` and ``failures``, which may be empty; then it
    is marked finished.

    Raises
    ------
    StoreError
        If a receipt is damaged, a chunk is missing, or the store cannot be written.
    """
    blocks.check_not_replaced(store)
    totals, costs = Totals(), {}
    for number, receipt in blocks.receipts(store, blocks.check_whole(store, finished=True)):
        totals.add(receipt)
        if receipt.seconds["scene"]:
            costs[number] = receipt.seconds
    counts: dict[str, Any] = {
        "detection": totals.detection.tolist(), "estimate": totals.estimate.tolist(),
        "processors": dict(totals.processors),
    }
    if (rule := store.pipeline.stopping) is not None:
        counts["sampled"] = {
            "needed": totals.needed, "conditions": condition_count(store.pipeline),
            "unsettled": unsettled_count(store, rule),
        }
    write_groups(store, {"cost": _cost(store, costs), "failures": _failure_table(totals)}, counts)


def _failure_table(totals: Totals) -> xr.Dataset:
    """Return the table of failures, with the total number of cells of each kind."""
    import xarray as xr  # noqa: PLC0415  (slow to import)

    cells = [*totals.failed, *totals.crashed]
    return xr.Dataset(
        {name: ("failure", np.array([getattr(cell, name) for cell in cells], dtype=object))
         for name in ("at", "kind", "stage", "text")},
        attrs={
            "long_name": "scenes that raised or ended their process",
            "rows_kept": f"at most {MAX_ROWS} of each kind, and {blocks.MAX_PER_BLOCK} of a block",
            **{f"{kind}_cells": count for kind, count in totals.lost.items()},
        },
    )


def _cost(store: RunStore, costs: Mapping[int, Mapping[str, Sequence[float]]]) -> xr.Dataset:
    """Return the cost group: seconds of each block per stage and configuration."""
    import xarray as xr  # noqa: PLC0415  (slow to import, and often not needed)

    settings = store.pipeline.axes_of(Stage.detection)
    both = [*settings, *store.pipeline.axes_of(Stage.estimation)]
    seconds = {
        f"{stage}_s": (("block", *(axis.name for axis in axes)), np.array(
            [each[stage] for each in costs.values()], dtype=np.float64,
        ).reshape(len(costs), *map(len, axes)))
        for stage, axes in (("scene", ()), ("detection", settings), ("estimation", both))
    }
    coordinates = {axis.name: axis.coordinates() for axis in both}
    return xr.Dataset(
        seconds,
        coords={"block": list(costs), **{
            name: values.astype(object) if values.dtype.kind == "T" else values
            for name, values in coordinates.items()}},
        attrs={"long_name": "seconds per stage and treatment for each block"},
    )


# --------------------------------------------------------------------------------------------------
# Failed cells, tried again: the blocks that hold them are computed as if they never had been.

def failed_blocks(store: RunStore, numbers: Iterable[int] | None = None) -> dict[int, int]:
    """Return the committed blocks in which cells failed or crashed, and how many did.

    ``numbers``: the blocks that are looked at, by default all.

    Raises
    ------
    StoreError
        If a receipt is damaged.
    """
    chosen = blocks.committed(store) if numbers is None else numbers
    return {
        number: count for number, receipt in blocks.receipts(store, chosen)
        if (count := sum(_lost(receipt.detection, receipt.estimate).values()))
    }


def drop_failed(store: RunStore) -> tuple[RunStore, dict[int, int]]:
    """Drop the committed blocks in which cells failed or crashed, so that a run computes them.

    A finished store is marked unfinished before. A kill at any instant leaves a store that another
    run continues: a block is either as it was, or computed anew as a whole.

    Returns
    -------
    The store as it is then; what was dropped, as :func:`failed_blocks` returns it.

    Raises
    ------
    StoreError
        If a receipt is damaged, another process writes the store, or it cannot be written.
    """
    with changing(store.url, store.storage):
        failed = failed_blocks(store)
        if failed and store.finished:
            reopen(store)
        for number in failed:
            blocks.drop_block(store, store.blocks[number])
    return open_store(store.url, "r+"), failed


# --------------------------------------------------------------------------------------------------
# The totals of a store in one record: the summary of a run, and the status of a store.

@dataclass(frozen=True, slots=True, kw_only=True)
class Account:
    """What a summary and a status have in common.

    Attributes
    ----------
    store
        The store as it was given, or the default.
    poses, blocks
        Cells of the grid's scene axes; blocks of the store.
    looked_for
        Detections that count in rates, over all detector settings: what is not visible, not
        modelled or not needed is not looked for.
    needed, conditions
        Of a run in waves, how many of the committed poses were needed, and the conditions; None of
        a run of fixed trials.
    nothing_computed
        Whether a stage was tried and failed on every cell.
    failed_share
        Share of the cells that failed or crashed, of those that a stage was tried on; the largest
        of the stages.
    failures
        The cells that failed or crashed, by reason.
    warnings
        The same for a reader; that nothing was detected, or no pose estimated; and what may
        surprise of the pipeline. Empty if there is nothing to tell.
    advice
        The command that recomputes one cell of each reason; empty where there is nothing to tell.
    """

    store: str
    poses: int
    blocks: int
    looked_for: int
    needed: int | None
    conditions: int | None
    nothing_computed: bool
    failed_share: float
    failures: list[FailureGroup]
    warnings: list[str]
    advice: str


def account_of(store: RunStore, totals: Totals, needed: int = 0) -> dict[str, Any]:
    """Return the fields of an account; ``needed`` is of a run in waves."""
    pipeline, in_waves = store.pipeline, store.pipeline.stopping is not None
    first = selection_text(pipeline, {axis.name: 0 for axis in pipeline.axes})
    outcome = outcome_of(store.url, totals, first)
    outcome["warnings"] += bound_notes(pipeline)
    return {
        "store": store.url, "poses": pipeline.size(Stage.scene), "blocks": len(store.blocks),
        "looked_for": looked_for(totals.detection.tolist()),
        "needed": needed if in_waves else None,
        "conditions": condition_count(pipeline) if in_waves else None, **outcome,
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary(Account):
    """The result of a run; ``sweep run --json`` prints it.

    Attributes
    ----------
    data
        What ``xarray.open_zarr`` opens.
    results
        Estimates: poses times detector settings times estimators.
    detected
        Markers that were detected, over all detector settings.
    computed_blocks, computed_scenes, computed_estimates
        What this run computed; the rest was committed before, or reused from other stores.
    seconds
        Duration of this run.
    crashed, failed
        Cells that are flagged so.
    retried, recovered
        Failed and crashed cells that were tried again, and those that did not fail again.
    unsettled
        Of a run in waves, conditions that would need more than ``max_trials``.
    """

    data: str
    results: int
    detected: int
    computed_blocks: int
    computed_scenes: int
    computed_estimates: int
    seconds: float
    crashed: int
    failed: int
    retried: int
    recovered: int
    unsettled: int | None

    @property
    def detected_line(self) -> str:
        """Detections among the markers that were looked for, in words."""
        return f"detected {self.detected:,} of {self.looked_for:,} looked for"


def summary_of(
    store: RunStore, computed: Mapping[str, int], seconds: float, retried: Mapping[int, int]
) -> Summary:
    """Return the summary of a finished store from the counts that it recorded.

    Parameters
    ----------
    store
        The store.
    computed
        Blocks, scenes and estimates that this run computed; none of a store that was finished.
    seconds
        Duration of this run.
    retried
        Blocks that were computed again, and how many of their cells had failed.

    Raises
    ------
    StoreError
        If blocks, chunks of them, or receipts that tell of failures are missing.
    """
    totals, rule = Totals.of_finished(store), store.pipeline.stopping
    sampled = store.run_metadata["counts"].get("sampled", {})
    account = account_of(store, totals, sampled.get("needed", 0))
    unsettled = sampled.get("unsettled")
    # A search says itself what it does not know.
    if unsettled and rule is not None and rule.precision:
        account["warnings"].append(
            f"warning: {unsettled:,} of {account['conditions']:,} conditions are not settled after "
            f"all {rule.max_trials:,} trials; the report's table of precision names them")
    tried = sum(retried.values())
    account |= {f"computed_{what}": computed.get(what, 0)
                for what in ("blocks", "scenes", "estimates")}
    return Summary(
        **account | totals.lost,
        data=store.data_url,
        results=math.prod(len(axis) for axis in store.pipeline.axes),
        detected=int(totals.detection[DetectionStatus.detected]),
        seconds=round(seconds, 3),
        retried=tried,
        recovered=tried - sum(failed_blocks(store, retried).values()),
        unsettled=unsettled,
    )


#: Seconds over which the rate is measured, up to the last block that was written.
RATE_S = 60.0

#: At least so many times the longest block is measured: with many workers, blocks come in waves.
RATE_BLOCKS = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class Status(Account):
    """A store's status, from the receipts of its committed blocks.

    Attributes
    ----------
    title
        The pipeline's title or name.
    finished
        Whether every block is committed and the store is closed.
    being_written
        Whether a process writes it; on S3 also one that was killed less than two minutes ago.
    blocks_done, poses_done
        How many blocks and poses are committed.
    detection, estimate
        Cells by flag; flags without cells are left out.
    poses_per_s, seconds_left
        Rate over the last minute of work; time to the end at that rate. None if unknown, and of a
        store that nobody writes.
    crashed, failed
        Cells whose process died and cells that raised, at most 1,000 of each.
    settled
        Of a run in waves, how many of the conditions need no more trials.
    processors
        Blocks by the features of the processors that computed them: where there are several, the
        last digits of results differ from a uniform run's.
    """

    title: str
    finished: bool
    being_written: bool
    blocks_done: int
    poses_done: int
    detection: dict[str, int]
    estimate: dict[str, int]
    poses_per_s: float | None
    seconds_left: float | None
    crashed: list[FailedCell]
    failed: list[FailedCell]
    settled: int | None
    processors: dict[str, int]


def status(url: str) -> Status:
    """Return the status of a store, also while it is written.

    Raises
    ------
    StoreError
        If there is no store, or it cannot be read.
    """
    store = open_store(url)
    totals, written = Totals(), []
    for _, receipt in blocks.receipts(store, blocks.check_whole(store)):
        totals.add(receipt)
        written.append((receipt.written, receipt.wall_s, receipt.scenes_needed))
    account, settled = account_of(store, totals, totals.needed), None
    if sampled := store.finished and store.run_metadata["counts"].get("sampled"):
        settled = account["conditions"] - sampled["unsettled"]
    elif account["conditions"] is not None:
        settled = int(InWaves(store).settled_share * account["conditions"])
    writing = not store.finished and is_written(store.storage)
    rate = poses_per_second(written)
    left = account["poses"] - totals.scenes
    return Status(
        **account,
        title=store.pipeline.heading,
        finished=store.finished,
        being_written=writing,
        blocks_done=totals.blocks,
        poses_done=totals.scenes,
        detection=dict(_by_name(DetectionStatus, totals.detection)),
        estimate=dict(_by_name(EstimateStatus, totals.estimate)),
        poses_per_s=rate,
        seconds_left=left / rate if rate and writing and settled is None else None,
        crashed=totals.crashed,
        failed=totals.failed,
        settled=settled,
        processors=dict(totals.processors),
    )


def poses_per_second(written: Sequence[tuple[float, float, int]]) -> float | None:
    """Return the rate at the last of some committed blocks, in any order; None if it is not known.

    Parameters
    ----------
    written
        For each block, when it was written (s since 1970), the seconds it took, its scenes.

    Examples
    --------
    >>> poses_per_second([(at, 2.0, 100) for at in (12.0, 14.0, 9000.0, 9002.0)])
    50.0
    """
    if not written:
        return None
    at, took_s, scenes = np.array(written).T
    last = at.max()
    window_s = max(RATE_S, RATE_BLOCKS * took_s[at > last - RATE_S].max())
    recent = at > last - window_s
    begin = max((at - took_s)[recent].min(), last - window_s)
    return float(scenes[recent].sum() / (last - begin)) if last > begin else None
