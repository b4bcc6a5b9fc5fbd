"""The account of a run: what its receipts add up to, its end, its retry, its summary and status."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

from sweep.evaluation.block import bound_notes
from sweep.evaluation.results import differing_processors
from sweep.execution.waves import InWaves, condition_count, unsettled_count
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import selection_text
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flag
from sweep.messages import plain, quoted
from sweep.store import blocks
from sweep.store.blocks import Receipt, RunStore
from sweep.store.lifecycle import open_store, write_groups
from sweep.store.lock import is_written

# --------------------------------------------------------------------------------------------------
# Totals of a store's receipts.

#: Failed cells, and as many crashed ones, that are listed of a store; the flags count all.
MAX_ROWS = 1000


@dataclass(slots=True)
class Totals:
    """Receipts, added up.

    Attributes
    ----------
    scenes, needed
        Scenes, and how many of them were needed.
    detection, estimate
        Counts of cells by the name of the flag.
    processors
        Blocks by the features of the processors that computed them.
    lost
        The cells that "crashed" and that "failed", at most :data:`MAX_ROWS` of each.
    """

    scenes: int = 0
    needed: int = 0
    detection: Counter[str] = field(default_factory=Counter)
    estimate: Counter[str] = field(default_factory=Counter)
    processors: Counter[str] = field(default_factory=Counter)
    lost: dict[str, list[Mapping[str, str]]] = field(
        default_factory=lambda: {"crashed": [], "failed": []})

    def add(self, receipt: Receipt) -> None:
        """Add the receipt of another block."""
        self.scenes += receipt.scenes
        self.needed += receipt.scenes_needed
        self.processors.update(receipt.processors)
        self.detection.update(receipt.detection)
        self.estimate.update(receipt.estimate)
        self._list(receipt.failures)

    def _list(self, failures: Iterable[Mapping[str, str]]) -> None:
        for cell in failures:
            if len(self.lost[cell["kind"]]) < MAX_ROWS:
                self.lost[cell["kind"]].append(cell)

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
            needed=counts.get("sampled", {}).get("needed", 0),
            detection=Counter(counts["detection"]), estimate=Counter(counts["estimate"]),
            processors=Counter(counts["processors"]))
        some = blocks.committed(store) if any(lost_counts(totals).values()) else ()
        for _, receipt in blocks.receipts(store, some):
            totals._list(receipt.failures)
        return totals


def lost_counts(counted: Totals | Receipt) -> dict[str, int]:
    """Return how many cells crashed and failed."""
    return {kind: counted.detection.get(kind, 0) + counted.estimate.get(kind, 0)
            for kind in ("crashed", "failed")}


# --------------------------------------------------------------------------------------------------
# What failed and why.

#: Share of the cells that were tried, above which failures are told first.
LOUD_SHARE = 0.1

#: Groups of failures that are listed; the others are counted.
MAX_GROUPS = 5

MAX_REASON = 200

#: Parts of messages that differ from cell to cell: addresses and numbers.
_VARYING = re.compile(r"0x[0-9a-fA-F]+|[-+]?\d[\d_,]*(?:\.\d*)?(?:[eE][-+]?\d+)?")


def failure_groups(cells: Iterable[Mapping[str, str]]) -> list[dict[str, Any]]:
    """Group failed cells by kind, stage, and message without its numbers; the largest first.

    Returns
    -------
    Of each group the ``kind``, "failed" or "crashed"; the ``stage``, "scene", "detection" or
    "estimation"; the ``reason``, type and message of the first cell's exception, or how its process
    died; the ``count`` of recorded cells, of which a store records 1,000 of each kind; and the
    first cell, ``at`` as ``sweep repro`` takes it.

    Examples
    --------
    >>> cells = [{"at": f"trial={n}", "kind": "failed", "stage": "scene",
    ...           "text": f"ValueError: {n} px"} for n in (3, 8)]
    >>> [(group["reason"], group["count"], group["at"]) for group in failure_groups(cells)]
    [('ValueError: 3 px', 2, 'trial=3')]
    """
    groups: dict[tuple[str, str, str], dict[str, Any]] = {}
    for cell in cells:
        kind, stage, reason = cell["kind"], cell["stage"], blocks.reason_of(cell["text"])
        group = groups.setdefault((kind, stage, _VARYING.sub("#", reason)), {
            "kind": kind, "stage": stage, "reason": plain(reason, MAX_REASON), "count": 0,
            "at": cell["at"]})
        group["count"] += 1
    return sorted(groups.values(), key=lambda group: -int(group["count"]))


# --------------------------------------------------------------------------------------------------
# Closing a complete store: a table of costs, and counts of flags.

def close(store: RunStore) -> None:
    """Close a store of which every block is committed.

    Its receipts are summed up in the group ``cost``, seconds of each block per stage and
    configuration, and in counts; then it is marked finished.

    Raises
    ------
    StoreError
        If a receipt is damaged, a chunk is missing, or the store cannot be written.
    """
    blocks.check_not_replaced(store)
    totals, costs = Totals(), {}
    for number, receipt in blocks.receipts(store, range(len(store.blocks))):
        totals.add(receipt)
        if any(receipt.seconds["scene"]):
            costs[number] = receipt.seconds
    counts: dict[str, Any] = {
        name: getattr(totals, name) for name in ("detection", "estimate", "processors")}
    if (rule := store.pipeline.stopping) is not None:
        counts["sampled"] = {"needed": totals.needed, "unsettled": unsettled_count(store, rule)}
    import xarray as xr  # noqa: PLC0415  (slow to import, and often not needed)

    settings = store.pipeline.axes_of(Stage.detection)
    both = [*settings, *store.pipeline.axes_of(Stage.estimation)]
    seconds = {
        f"{stage}_s": (("block", *(axis.name for axis in axes)), np.array(
            [each[stage] for each in costs.values()], dtype=np.float64,
        ).reshape(len(costs), *map(len, axes)))
        for stage, axes in (("scene", ()), ("detection", settings), ("estimation", both))
    }
    # Lists: xarray supports NumPy's strings of variable length in parts.
    coordinates = {axis.name: axis.coordinates().tolist() for axis in both}
    cost = xr.Dataset(seconds, {"block": list(costs), **coordinates},
                      {"long_name": "seconds per stage and treatment for each block"})
    write_groups(store, {"cost": cost}, counts)


# --------------------------------------------------------------------------------------------------
# Blocks that are computed again, as if they never had been: those in which cells failed, say.

def failed_blocks(store: RunStore, numbers: Iterable[int]) -> dict[int, int]:
    """Return the blocks, of some committed ones, in which cells failed or crashed; how many did.

    Raises
    ------
    StoreError
        If a receipt is damaged.
    """
    return {
        number: count for number, receipt in blocks.receipts(store, numbers)
        if (count := sum(lost_counts(receipt).values()))
    }


# --------------------------------------------------------------------------------------------------
# The totals of a store in one record: the summary of a run, and the status of a store.

def account_of(store: RunStore, totals: Totals) -> dict[str, Any]:
    """Return what a summary and a status have in common.

    Returns
    -------
    The ``store`` as it was given; ``poses`` and ``blocks`` of the grid; detections that are
    ``looked_for``, and so count in rates, over all detector settings: what is not visible, not
    modelled or not needed is not; of a run in waves, how many of the committed poses were
    ``needed``, and the number of ``conditions`` (None of a run of fixed trials).

    ``nothing_computed``: whether a stage was tried and failed on every cell; ``failed_share`` of
    the cells that a stage was tried on, the largest of the stages; ``failures`` by reason
    (:func:`failure_groups`). ``warnings``: the same for a reader; that nothing was detected, or no
    pose estimated; what may surprise of the pipeline. ``advice``: the command that recomputes one
    cell of each reason; empty where there is nothing to tell.
    """
    pipeline, rule = store.pipeline, store.pipeline.stopping
    groups, advice = failure_groups(totals.lost["failed"] + totals.lost["crashed"]), ""
    shares, warnings, nothing = [0.0], list[str](), list[str]()
    stages: tuple[tuple[type[Flag], Counter[str], str, str], ...] = (
        (DetectionStatus, totals.detection, "detections", "nothing was detected"),
        (EstimateStatus, totals.estimate, "estimates", "no pose was estimated"))
    for flags, counts, cells, none_present in stages:
        lost = {kind: counts[kind] for kind in ("failed", "crashed") if counts[kind]}
        tried = sum(count for name, count in counts.items()
                    if flags[name].counted and name != "no_detection")
        share = sum(lost.values()) / max(tried, 1)
        shares.append(share)
        if share == 1.0:
            warnings.append(f"nothing computed: all {tried:,} {cells} {' or '.join(lost)}")
        elif lost:
            listed = " and ".join(f"{count:,} {kind}" for kind, count in lost.items())
            warnings.append(f"{'warning: ' if share > LOUD_SHARE else ''}{listed} of "
                            f"{tried:,} {cells} ({100 * share:.4g} %)")
        needed = Counter({name: count for name, count in counts.items() if name != "not_needed"})
        if needed and not (nothing or 1.0 in shares or any(flags[name].present for name in needed)):
            ((name, count),) = needed.most_common(1)
            meaning = flags[name].meaning.rstrip(".")
            nothing = [f"warning: {none_present}: {count:,} {name} ({meaning})"]
    shown, others = groups[:MAX_GROUPS], groups[MAX_GROUPS:]
    warnings += [f"  {group['count']:,} x {group['kind']} in {group['stage']}: {group['reason']}"
                 for group in shown]
    if others:
        rest = sum(group["count"] for group in others)
        warnings.append(f"  {rest:,} x for {len(others):,} other reasons")
    if groups or nothing:
        places = [group["at"] for group in shown] or [
            selection_text(pipeline, {axis.name: 0 for axis in pipeline.axes})]
        words = [word for at in places if at for word in ("--at", at)]
        advice = quoted(
            "sweep", "repro", store.url, *words, *([] if groups else ["-o", "scene.png"]))
    warnings += [*nothing, *differing_processors(totals.processors, "blocks"),
                 *bound_notes(pipeline)]
    return {
        "store": store.url, "poses": pipeline.size(Stage.scene), "blocks": len(store.blocks),
        "looked_for": sum(count for name, count in totals.detection.items()
                          if DetectionStatus[name].counted),
        "needed": None if rule is None else totals.needed,
        "conditions": None if rule is None else condition_count(pipeline, rule),
        "nothing_computed": 1.0 in shares, "failed_share": round(max(shares), 6),
        "failures": groups, "warnings": warnings, "advice": advice,
    }


def summary_of(
    store: RunStore, computed: Mapping[str, int], seconds: float, retried: Mapping[int, int]
) -> SimpleNamespace:
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

    Returns
    -------
    As `account_of`, with ``crashed`` and ``failed`` cells, ``data`` that ``xarray.open_zarr``
    opens, the number of ``results`` (poses times detector settings times estimators), of markers
    ``detected`` over all settings; ``computed_blocks``, ``computed_scenes``,
    ``computed_estimates``, and the ``seconds`` that this run took; failed cells ``retried``, and
    those of them ``recovered``; of a run in waves, conditions ``unsettled`` that would need more
    than ``max_trials``.

    Raises
    ------
    StoreError
        If blocks, chunks of them, or receipts that tell of failures are missing.
    """
    totals, rule = Totals.of_finished(store), store.pipeline.stopping
    account = account_of(store, totals)
    unsettled = store.run_metadata["counts"].get("sampled", {}).get("unsettled")
    # A search says itself what it does not know.
    if unsettled and rule is not None and rule.precision:
        account["warnings"].append(
            f"warning: {unsettled:,} of {account['conditions']:,} conditions are not settled after "
            f"all {rule.max_trials:,} trials; the report's table of precision names them")
    tried = sum(retried.values())
    return SimpleNamespace(
        **account,
        **lost_counts(totals),
        **{f"computed_{what}": computed.get(what, 0) for what in ("blocks", "scenes", "estimates")},
        data=store.data_url,
        results=store.pipeline.size(*Stage),
        detected=totals.detection["detected"],
        seconds=round(seconds, 3),
        retried=tried,
        recovered=tried - sum(failed_blocks(store, retried).values()),
        unsettled=unsettled,
    )


#: Seconds over which the rate is measured, up to the last block that was written.
RATE_S = 60.0

#: At least so many times the longest block is measured: with many workers, blocks come in waves.
RATE_BLOCKS = 10


def status(url: str) -> SimpleNamespace:
    """Return the status of a store, also while it is written.

    Returns
    -------
    As `account_of`, with the pipeline's ``title`` or name; whether every block is committed and the
    store is closed (``finished``), and whether a process writes it (``being_written``), on S3 also
    one that was killed less than two minutes ago; ``blocks_done`` and ``poses_done``; cells by flag
    of ``detection`` and ``estimate``, the most frequent first; ``poses_per_s`` over the last
    minute of work, and ``seconds_left`` at that rate, None if unknown and of a store that nobody
    writes; the cells that ``crashed`` and ``failed``, at most 1,000 of each; of a run in waves, the
    conditions ``settled`` that need no more trials; blocks by the features of the ``processors``
    that computed them, which the last digits of results depend on.

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
    account, settled = account_of(store, totals), None
    if sampled := store.finished and store.run_metadata["counts"].get("sampled"):
        settled = account["conditions"] - sampled["unsettled"]
    elif account["conditions"] is not None:
        settled = InWaves(store).settled
    writing = not store.finished and is_written(store.storage)
    rate, left = poses_per_second(written), account["poses"] - totals.scenes
    return SimpleNamespace(
        **account,
        **totals.lost,
        title=store.pipeline.heading,
        finished=store.finished,
        being_written=writing,
        blocks_done=len(written),
        poses_done=totals.scenes,
        detection=dict(totals.detection.most_common()),
        estimate=dict(totals.estimate.most_common()),
        poses_per_s=rate,
        seconds_left=left / rate if rate and writing and settled is None else None,
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
