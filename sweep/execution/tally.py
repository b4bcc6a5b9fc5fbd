"""What a run has done so far: its progress, counts of what was computed, failures by kind."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping
from collections.abc import Set as AbstractSet

from sweep.errors import RunError
from sweep.execution.limits import MAX_FAILED_BLOCKS
from sweep.execution.progress import Progress, ProgressReport
from sweep.execution.settled import condition_count
from sweep.execution.waiting import InWaves
from sweep.measure.flags import DetectionStatus
from sweep.plan.parameters import Stage
from sweep.store.blocks import receipts
from sweep.store.failures import MAX_ROWS
from sweep.store.receipt import Receipt
from sweep.store.run_store import RunStore


class Tally:
    """Counts the receipts of a run and the blocks that failed; reports progress.

    Parameters
    ----------
    store
        The store that is written.
    report
        Called with the progress after each block.
    """

    def __init__(self, store: RunStore, report: ProgressReport | None = None) -> None:
        self._store = store
        self._report = report
        self._progress = Progress(0, store.pipeline.size(Stage.scene), 0)
        self._waves: InWaves | None = None
        self._conditions = 0
        self._failures = Counter({"failed": 0, "crashed": 0})
        self._failed_blocks: list[str] = []
        self._machine_faults = 0
        self.computed: Counter[str] = Counter()
        """Blocks, scenes, detections and estimates that were computed and not reused."""

    def watch(self, waves: InWaves) -> None:
        """Report progress by conditions that are settled."""
        self._waves, self._conditions = waves, condition_count(self._store.pipeline)
        self._progress = dataclasses.replace(self._progress, needed=0)

    def begin(self, done: AbstractSet[int]) -> None:
        """Count the blocks that are committed already.

        Raises
        ------
        StoreError
            If a receipt is damaged.
        """
        for _, receipt in receipts(self._store, done):
            self._count(receipt)
        self._notify()

    def add(self, receipt: Receipt) -> None:
        """Count a block that was committed now."""
        self.computed.update({"blocks": 1, **receipt.computed})
        self._count(receipt)
        self._notify()

    def add_failed(self, reason: str, *, machine_fault: bool = False) -> None:
        """Note why a block failed: by a machine's fault, or because it raises."""
        self._failed_blocks.append(reason)
        self._machine_faults += machine_fault

    @property
    def hopeless(self) -> bool:
        """Whether so many blocks failed that no more are tried."""
        return len(self._failed_blocks) >= MAX_FAILED_BLOCKS

    def quota(self) -> Mapping[str, int]:
        """Return how many failures of each kind another receipt may list."""
        return {kind: max(MAX_ROWS - count, 0) for kind, count in self._failures.items()}

    def check(self) -> None:
        """Raise RunError if blocks failed: of one line if faults of machines are all there is."""
        count = len(self._failed_blocks)
        if count and count == self._machine_faults:
            more = f", and {count - 1} blocks more likewise" if count > 1 else ""
            raise RunError(f"{self._store.url}: {self._failed_blocks[0]}{more}")
        if self._failed_blocks:
            raise RunError(
                f"{self._store.url}: {len(self._failed_blocks)} blocks failed\n"
                + "\n".join(f"  {reason}" for reason in self._failed_blocks)
            )

    def _count(self, receipt: Receipt) -> None:
        self._failures.update(failure.kind for failure in receipt.failures)
        counts, detected = receipt.detection, DetectionStatus.detected
        needed = self._progress.needed
        self._progress = Progress(
            self._progress.done + receipt.scenes, self._progress.total,
            self._progress.detected + (counts[detected] if len(counts) > detected else 0),
            None if needed is None else needed + receipt.scenes_needed,
        )

    def _notify(self) -> None:
        if self._report is None:
            return
        if self._waves is not None:
            share = self._waves.settled / self._waves.cells
            self._progress = dataclasses.replace(
                self._progress, settled=int(share * self._conditions), conditions=self._conditions
            )
        self._report(self._progress)
