"""Images that wait for a detector in another environment: many go there and back together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sweep.evaluation.machine_faults import local_fault
from sweep.evaluation.results import Failure
from sweep.measure.detector import DetectorOutput
from sweep.measure.foreign_detector import ForeignDetector, detector_output
from sweep.typing import Grey

BATCH_PX = 1 << 22
"""Pixels that go together: 4 MB, 14 frames of 640 x 480. A way there and back takes about 0.1 ms,
and more if other processes want the processor."""


@dataclass(slots=True)
class ForeignSearch:
    """The search of scenes by a detector in another environment.

    Attributes
    ----------
    find
        The detector.
    setting
        The number of its setting, for failures.
    dictionary, sides
        Of all scenes: the dictionary, and the larger side of the frame in pixels.
    row_s
        Of all scenes: seconds spent on each; those of the searches are added.
    failures
        Searches that raised, or that ended their process, are appended.
    candidates, failed, crashed
        What was found by row, and the rows of which the search raised, or ended its process.
    """

    find: ForeignDetector
    setting: int
    dictionary: Sequence[str]
    sides: Sequence[int]
    row_s: list[float]
    failures: list[Failure]
    candidates: list[tuple[int, *DetectorOutput]]
    failed: list[int]
    crashed: list[int]
    _waiting: list[tuple[int, Grey]] = field(default_factory=list)
    _waiting_px: int = 0

    def add(self, row: int, image: Grey) -> None:
        """Let the image (h, w) of a row wait; search if enough do."""
        # A view would keep all that was rendered with it.
        self._waiting.append((row, np.ascontiguousarray(image)))
        self._waiting_px += image.size
        if self._waiting_px >= BATCH_PX:
            self.search()

    def search(self) -> None:
        """Search the images that wait.

        Raises
        ------
        MachineFaultError
            If memory was too little there, or the process was ended by a signal from outside.
        """
        waiting, self._waiting, self._waiting_px = self._waiting, [], 0
        if not waiting:
            return
        answers = self.find.search_all(
            [image for _, image in waiting], [self.dictionary[row] for row, _ in waiting],
            [self.sides[row] for row, _ in waiting],
        )
        for (row, _), answer in zip(waiting, answers, strict=True):
            self.row_s[row] += answer.seconds
            if answer.of_the_machine:
                raise local_fault(answer.error)
            if answer.error:
                self.failures.append(
                    Failure(row, "detection", answer.error, self.setting, crashed=answer.died)
                )
                (self.crashed if answer.died else self.failed).append(row)
            else:
                self.candidates.append((row, *detector_output(answer)))
