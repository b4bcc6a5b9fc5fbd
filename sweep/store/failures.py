"""Scenes that raised or ended their process: where they lie on the grid, and why."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.plan.axes import Axis
from sweep.plan.cell_selection import at_text
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import Block, scene_axes
from sweep.plan.parameters import Stage
from sweep.store.lifecycle import RunStore

if TYPE_CHECKING:
    import xarray as xr

MAX_ROWS = 1000
"""Rows of each kind (failed, crashed) that a store keeps; beyond, they are counted by flags."""

MAX_PER_BLOCK = 100

MAX_CHARACTERS = 4000
"""Of a traceback, of which the end is kept."""


@dataclass(frozen=True, slots=True)
class FailedCell:
    """One row of the table: a scene, or a treatment of it.

    Attributes
    ----------
    at
        Its coordinates, as ``sweep repro --at`` takes them.
    kind
        "failed" (it raised) or "crashed" (it ended its process).
    stage
        "scene", "detection" or "estimation".
    text
        The traceback, or how the process ended.
    """

    at: str
    kind: str
    stage: str
    text: str

    @property
    def reason(self) -> str:
        """The text's last line."""
        lines = self.text.strip().splitlines()
        return lines[-1] if lines else ""


def recorded(failures: Sequence[Any], rows: Sequence[int], room: Mapping[str, int]) -> list[Any]:
    """Return what a receipt keeps of a block's failures: at most ``room`` of each kind.

    ``rows`` gives the scene of the block for each scene that was computed.
    """
    kept: list[dict[str, Any]] = []
    left = {kind: min(count, MAX_PER_BLOCK) for kind, count in room.items()}
    for failure in failures:
        kind = "crashed" if failure.crashed else "failed"
        if left[kind] <= 0:
            continue
        left[kind] -= 1
        kept.append(
            {
                "scene": int(rows[failure.scene]), "kind": kind, "stage": failure.stage,
                "setting": failure.setting, "estimator": failure.estimator,
                "text": failure.text[-MAX_CHARACTERS:],
            }
        )
    return kept


def failed_cells(store: RunStore, number: int, receipt: Mapping[str, Any]) -> Iterator[FailedCell]:
    """Yield what a block's receipt tells of its failures."""
    block = store.blocks[number]
    for failure in receipt["failures"]:
        yield FailedCell(
            at_text(_place(store.pipeline, block, failure)), failure["kind"], failure["stage"],
            failure["text"],
        )


def _place(pipeline: Pipeline, block: Block, failure: Mapping[str, Any]) -> dict[str, Any]:
    """Return the value along each axis that a failure's cell has."""
    place = {
        axis.name: axis.values[index]
        for axis, index in zip(scene_axes(pipeline), block.cell(failure["scene"]), strict=True)
    }
    for key, stage in (("setting", Stage.detection), ("estimator", Stage.estimation)):
        if failure[key] is not None:
            place |= _treatment(pipeline.axes_of(stage), failure[key])
    return {axis.name: place[axis.name] for axis in pipeline.axes if axis.name in place}


def _treatment(axes: Sequence[Axis], number: int) -> dict[str, Any]:
    if not axes:
        return {}
    index = np.unravel_index(number, [len(axis) for axis in axes])
    return {axis.name: axis.values[int(i)] for axis, i in zip(axes, index, strict=True)}


def failure_table(cells: Sequence[FailedCell], counts: Mapping[str, int]) -> xr.Dataset:
    """Return the table of failures, and how many cells of each kind there are in all."""
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
