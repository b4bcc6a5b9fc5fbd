"""One cell of a report's store, and how a recomputation of it differs."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sweep.compilation import processor
from sweep.integrity.stored_values import Values, current_pipeline
from sweep.integrity.tolerances import compare
from sweep.plan.grid import Block, scene_axes
from sweep.plan.schema import variables_of
from sweep.report.report_data import ReportData, store_errors
from sweep.store.blocks import receipts
from sweep.store.lifecycle import open_store


def stored_cell(data: ReportData, index: Mapping[str, int]) -> Values:
    """Return the stored values of the cell at an index along each axis, by variable.

    Raises
    ------
    StoreError
        If the store cannot be read.
    """
    variables = variables_of(data.pipeline)
    names = [variable.name for variable in variables if variable.name in data.results.variables]
    with store_errors(data.store):
        cell = data.results[names].isel(index).load()
    return {name: np.asarray(cell[name].values) for name in names}


def difference_from_store(
    data: ReportData, recomputed: Values, stored: Values, index: Mapping[str, int]
) -> str:
    """Return how recomputed values differ from the stored ones; empty if they agree.

    As in `sweep verify`, every bit must agree if the stored ones were computed by the same
    versions on a processor with the same features; otherwise they must lie within the tolerances.

    Raises
    ------
    StoreError
        If the store cannot be read.
    PipelineError
        If a file of the pipeline is missing.
    """
    exact = _computed_alike(data, index)
    variables = variables_of(data.pipeline)
    difference = compare(recomputed, stored, variables, same_processor=exact).difference
    if not difference or exact:
        return difference
    return f"{difference}, outside the tolerance for another processor or version"


def _computed_alike(data: ReportData, index: Mapping[str, int]) -> bool:
    """Return whether a cell was computed by these versions, on a processor with these features."""
    with store_errors(data.store):
        store = open_store(data.store)
        corner = tuple(index[axis.name] for axis in scene_axes(store.pipeline))
        number = store.blocks.number(Block(corner, corner))
        _, receipt = next(iter(receipts(store, [number])))
    return receipt.processor == processor() and not current_pipeline(store)[1]
