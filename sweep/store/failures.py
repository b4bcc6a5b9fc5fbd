"""Cells whose computation raised or whose process died: their coordinates, and the reason."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.plan.axes import Axis
from sweep.plan.cell_selection import selection_text
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import Block, scene_axes
from sweep.plan.parameters import Stage
from sweep.store.receipt import Receipt, RecordedFailure
from sweep.store.run_store import RunStore

if TYPE_CHECKING:
    import xarray as xr

MAX_ROWS = 1000
"""Rows of each kind (failed, crashed) that a store keeps; the flags count all of them."""

MAX_PER_BLOCK = 100

MAX_CHARACTERS = 4000
"""Characters that are kept of a traceback: its end."""


@dataclass(frozen=True, slots=True)
class FailedCell:
    """One row of the table of failures: a scene, or a scene with a configuration.

    Attributes
    ----------
    at
        Its coordinates, as ``sweep repro --at`` takes them.
    kind
        "failed" (it raised) or "crashed" (its process died).
    stage
        "scene", "detection" or "estimation".
    text
        The traceback, or how the process died.
    """

    at: str
    kind: str
    stage: str
    text: str

    @property
    def reason(self) -> str:
        """The first line of the exception's message in a traceback; of other texts the last."""
        lines = self.text.strip().splitlines()
        frames = [number for number, line in enumerate(lines) if line.startswith('  File "')]
        raised = (line for line in lines[frames[-1] + 1 :] if not line[:1].isspace()) \
            if frames else iter(())
        return next(raised, lines[-1] if lines else "")


def recorded(
    failures: Sequence[Any], rows: Sequence[int], quota: Mapping[str, int]
) -> tuple[RecordedFailure, ...]:
    """Return the failures that a block's receipt keeps: at most ``quota`` of each kind.

    ``rows`` gives the number within the block of each scene that was computed.
    """
    kept: list[RecordedFailure] = []
    left = {kind: min(count, MAX_PER_BLOCK) for kind, count in quota.items()}
    for failure in failures:
        kind = "crashed" if failure.crashed else "failed"
        if left[kind] <= 0:
            continue
        left[kind] -= 1
        kept.append(RecordedFailure(
            int(rows[failure.scene]), kind, failure.stage, failure.setting, failure.estimator,
            failure.text[-MAX_CHARACTERS:],
        ))
    return tuple(kept)


def failed_cells(store: RunStore, number: int, receipt: Receipt) -> Iterator[FailedCell]:
    """Yield the failures that a block's receipt holds."""
    if not receipt.failures:
        return
    block = store.blocks[number]
    for failure in receipt.failures:
        coordinates = _coordinates(store.pipeline, block, failure)
        yield FailedCell(selection_text(coordinates), failure.kind, failure.stage, failure.text)


def _coordinates(
    pipeline: Pipeline, block: Block, failure: RecordedFailure
) -> dict[str, Any]:
    """Return the values that vary, in the order of the axes, of a failure's cell."""
    indices = {
        axis.name: index
        for axis, index in zip(scene_axes(pipeline), block.cell(failure.scene), strict=True)
    }
    for number, stage in (
        (failure.setting, Stage.detection), (failure.estimator, Stage.estimation),
    ):
        if number is not None:
            indices |= _configuration(pipeline.axes_of(stage), number)
    return pipeline.cell_at(indices)


def _configuration(axes: Sequence[Axis], number: int) -> dict[str, int]:
    """Return the index along each axis of a configuration."""
    if not axes:
        return {}
    index = np.unravel_index(number, [len(axis) for axis in axes])
    return {axis.name: int(i) for axis, i in zip(axes, index, strict=True)}


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
