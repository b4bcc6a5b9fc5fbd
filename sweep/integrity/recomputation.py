"""Cells of a store recomputed, and compared within the tolerances of the processor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import StoreError
from sweep.experiment.grid import Block
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import SCHEMA, Tolerance, Variable
from sweep.model.pose import rotation_of_vector
from sweep.processor import processor
from sweep.store.blocks import RunStore, committed, missing_chunks, receipts
from sweep.store.provenance import differences

# --------------------------------------------------------------------------------------------------
# Values as a store holds them, and the pipeline with which they are recomputed.

StoredValues = dict[str, NDArray[Any]]


def stored_values(store: RunStore, index: Mapping[str, int | slice]) -> StoredValues:
    """Return every variable at an index along axes; axes that it does not name are whole."""
    return {
        variable.name: np.asarray(store.array(variable.name)[tuple(
            index.get(name, slice(None)) for name in variable.dimensions(store.pipeline))])
        for variable in store.variables
    }


def stored_cell(store: RunStore, index: Mapping[str, int]) -> tuple[StoredValues, bool] | None:
    """Return the cell at an index along each axis; None if its block is not committed.

    The second value tells whether a processor with the features of this one computed it.

    Raises
    ------
    StoreError
        If its receipt is damaged, or a chunk of it is missing.
    """
    corner = tuple(index[axis.name] for axis in store.pipeline.experiment.scene_axes)
    number = store.blocks.number(Block(corner, corner))
    if number not in committed(store):
        return None
    _, receipt = next(iter(receipts(store, [number])))
    for key in missing_chunks(store, [number]).values():
        raise StoreError(
            f"{store.url}: damaged: {key} is missing; `sweep verify --repair` repairs it")
    return stored_values(store, index), tuple(receipt.processors) == (processor(),)


def stored_scene(store: RunStore, number: int, scene: int) -> StoredValues:
    """Return a scene of a block with all its configurations; its scene axes have length 1."""
    axes, cell = store.pipeline.experiment.scene_axes, store.blocks[number].cell(scene)
    return stored_values(store, {
        axis.name: slice(k, k + 1) for axis, k in zip(axes, cell, strict=True)})


def current_pipeline(store: RunStore) -> tuple[Pipeline, list[str]]:
    """Return a store's pipeline with the files and versions of this machine, and what changed.

    Raises
    ------
    PipelineError
        If it cannot be computed at all, for want of a file, say.
    """
    stored = store.pipeline
    pipeline = Pipeline.from_text(
        stored.text, name=stored.name, source=store.url, folder=stored.folder,
    )
    return pipeline, differences(pipeline, stored, store.fingerprint)


def computable(store: RunStore) -> Pipeline:
    """Return a store's pipeline, to be computed on this machine.

    Raises
    ------
    StoreError
        If it would give other numbers.
    PipelineError
        If it cannot be computed at all, for want of a file, say.
    """
    pipeline, changes = current_pipeline(store)
    if changes:
        raise StoreError("\n".join(
            [f"{store.url}: cannot be recomputed on this machine:", *changes]
        ))
    return pipeline


# --------------------------------------------------------------------------------------------------
# Whether a recomputed scene agrees with the stored one.
#
# On a processor with the same features every bit agrees. On another one, OpenCV, NumPy and the
# mathematical library take other routines, and last bits differ; how far is the ``tolerance`` of
# each variable in :mod:`sweep.experiment.schema`, measured on 9,000 scenes with AVX-512, AVX2 and
# all of AVX switched off in turn. Without AVX, 0.02 % of ordinary scenes, and at most 4.4 %
# of those of a pipeline of extremes, lie outside them, because a last bit can decide between two
# minima.

Values = Mapping[str, NDArray[Any]]
"""Variable -> values of one scene, of its inner dimensions last."""


def compare(
    recomputed: Values, stored: Values, variables: Sequence[Variable] = SCHEMA, *,
    same_processor: bool,
) -> str:
    """Return how a recomputed scene differs from the stored one, in the variables that both have.

    Empty if it does not, else the first variable that differs: by a bit, or on another processor
    beyond its tolerance.

    Parameters
    ----------
    recomputed, stored
        The values by variable, of the same shapes. A tolerance of the kind "distance" needs
        ``true_tvec_m`` among the stored ones.
    variables
        Those that are compared, in this order.
    same_processor
        Whether both were computed by the same versions on processors with the same features, so
        that every bit must agree.

    Examples
    --------
    >>> stored = {"reprojection_error_px": np.array([0.2], dtype="f4")}
    >>> recomputed = {"reprojection_error_px": np.array([0.201], dtype="f4")}
    >>> compare(recomputed, stored, same_processor=False)
    ''
    >>> compare(recomputed, stored, same_processor=True)
    'reprojection_error_px 0.201000005, stored 0.200000003'
    """
    for variable in variables:
        if variable.name not in recomputed or variable.name not in stored:
            continue
        ours, theirs = recomputed[variable.name], stored[variable.name]
        if same_processor:
            differ = ~is_same(ours, theirs)
        elif variable.tolerance is None:
            continue
        else:
            distance = np.linalg.norm(stored["true_tvec_m"]) if "true_tvec_m" in stored else 0.0
            differ = _beyond(variable.tolerance, ours, theirs, float(distance))
        if differ.any():
            return f"{variable.name} {ours[differ][0]:.9g}, stored {theirs[differ][0]:.9g}"
    return ""


def is_same(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.bool_]:
    """Return where two arrays are equal or both NaN; also of integers."""
    return np.asarray((a == b) | ((a != a) & (b != b)))  # noqa: PLR0124  (NaN)


def _beyond(
    tolerance: Tolerance, recomputed: NDArray[Any], stored: NDArray[Any], distance_m: float
) -> NDArray[np.bool_]:
    """Return where recomputed values lie outside a tolerance, of the arrays' shape."""
    same = is_same(recomputed, stored)
    if tolerance.kind == "equal":
        return ~same
    a, b = recomputed.astype(np.float64), stored.astype(np.float64)
    if tolerance.kind == "rotation":
        # The norm of the difference of two rotations is sqrt(8) times the sine of half their angle.
        turned = [rotation_of_vector(vector.reshape(-1, 3)) for vector in (a, b)]
        angle = np.linalg.norm(turned[0] - turned[1], axis=(1, 2)) / np.sqrt(2)
        within = (angle <= tolerance.limit).reshape(a.shape[:-1])[..., None]
    elif tolerance.kind == "distance":
        within = np.linalg.norm(a - b, axis=-1, keepdims=True) <= tolerance.limit * distance_m
    elif tolerance.kind == "length":
        length = np.linalg.norm(b, axis=-1, keepdims=True)
        within = np.abs(a - b) <= tolerance.limit * length
    elif tolerance.kind == "relative":
        within = np.abs(a - b) <= tolerance.limit * np.abs(b)
    else:
        within = np.abs(a - b) <= tolerance.limit
    return np.asarray(~(same | within))
