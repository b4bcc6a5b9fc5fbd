"""Cells of a store recomputed, compared with what it holds, and one of them reproduced."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import RunError, StoreError
from sweep.evaluation.inspection import SceneInspection, inspect_scene, scene_image
from sweep.evaluation.results import Failure
from sweep.experiment.grid import Block
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline, cell, parse_selection, selection_text
from sweep.experiment.schema import SCHEMA, Tolerance, Variable
from sweep.isolation.child_process import Child, ChildError
from sweep.isolation.crash_isolation import run_cells_isolated
from sweep.measure.flags import DetectionStatus
from sweep.messages import nearest, plain, refusal
from sweep.model.pose import rotation_of_vector
from sweep.processor import processor
from sweep.store.blocks import RunStore, committed, missing_chunks, receipts
from sweep.store.lifecycle import open_store
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

#: Variable -> values of one scene, of its inner dimensions last.
Values = Mapping[str, NDArray[Any]]


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


# --------------------------------------------------------------------------------------------------
# One cell of a store: recomputed, compared with the stored one, and drawn.

@dataclass(frozen=True, slots=True)
class Reproduction:
    """A cell that was recomputed.

    Attributes
    ----------
    at
        Its value of every axis, as text.
    variables
        Those of the store.
    recomputed, stored
        Variable -> value, of the dimensions that are no axes; ``stored`` is None if the block is
        not committed.
    difference
        How the two differ; empty if they do not, or nothing is stored.
    exact
        Whether every bit had to agree: on a processor with the same features, and without
        ``changes``. Else the tolerances apply.
    seconds
        Stage -> seconds that it took.
    failures
        Exceptions that were raised, and deaths of the process.
    changes
        Versions and files that have changed since the store was created.
    pipeline, cell_pipeline
        The store's pipeline, and the same with every axis fixed at the cell.
    inspection
        The inspected scene; None if its inspection raises or ends its process.
    image
        (h, w) grey levels; None if rendering raises or ends its process.
    unneeded
        Whether the block is committed and the trial was not needed: nothing of it is stored.
    """

    at: str
    variables: tuple[Variable, ...]
    recomputed: StoredValues
    stored: StoredValues | None
    difference: str
    exact: bool
    seconds: dict[str, float]
    failures: list[Failure]
    changes: list[str]
    pipeline: Pipeline
    cell_pipeline: Pipeline
    inspection: SceneInspection | None
    image: NDArray[np.uint8] | None
    unneeded: bool = False


def reproduce(
    url: str, at: str, *, whole_frame: bool = False, time_limit_s: float = 60.0
) -> Reproduction:
    """Recompute one cell of a store in a child process, and compare it with the stored one.

    Parameters
    ----------
    url
        The store.
    at
        A value of each axis, such as "distance_m=0.3,solver=ippe"; the first one of axes that it
        does not name.
    whole_frame
        Whether the image shows the whole frame, not the marker's surroundings alone.
    time_limit_s
        Timeout in seconds.

    Raises
    ------
    PipelineError
        If ``at`` is not on the store's grid.
    StoreError
        If there is no store.
    """
    store = open_store(url)
    pipeline, changes = current_pipeline(store)
    index = _index(pipeline, at)
    setting, estimator = (
        _number(pipeline, stage, index) for stage in (Stage.detection, Stage.estimation)
    )
    axes = pipeline.experiment.scene_axes
    need = np.zeros(
        (1, pipeline.size(Stage.detection), pipeline.size(Stage.estimation)), dtype=bool
    )
    need[0, setting, estimator] = True
    scene = [np.array([index[axis.name]], dtype=np.intp) for axis in axes]
    cells = run_cells_isolated(pipeline, scene, need, time_limit_s)
    configuration = {
        Stage.scene: 0, Stage.detection: setting,
        Stage.estimation: setting * need.shape[2] + estimator,
    }
    recomputed = {
        v.name: cells.columns[v.name][configuration[v.stage]][0].astype(v.dtype)
        for v in store.variables
    }
    stored, same_processor = stored_cell(store, index) or (None, False)
    unneeded = stored is not None and bool(stored["detection"] == DetectionStatus.not_needed)
    stored = None if unneeded else stored
    exact = stored is not None and same_processor and not changes
    difference = "" if stored is None else compare(
        recomputed, stored, store.variables, same_processor=exact
    )
    full_at = selection_text(pipeline, index)
    cell_pipeline = cell(pipeline, full_at)
    inspected, image = _inspected(cell_pipeline, whole_frame, time_limit_s)
    return Reproduction(
        full_at, store.variables, recomputed, stored, difference, exact,
        {"scene": cells.seconds["scene"][0], "detection": cells.seconds["detection"][setting],
         "estimation": cells.seconds["estimation"][configuration[Stage.estimation]]},
        cells.failures, changes, pipeline, cell_pipeline, inspected, image, unneeded,
    )


def check_selection(url: str, chosen: Sequence[str]) -> None:
    """Check that cells are on a store's grid, before any is computed.

    Raises
    ------
    PipelineError
        If one is not.
    StoreError
        If there is no store.
    """
    pipeline = open_store(url).pipeline
    for at in chosen:
        _index(pipeline, at)


def _index(pipeline: Pipeline, at: str) -> dict[str, int]:
    """Return the index of a cell along each axis."""
    index = {axis.name: 0 for axis in pipeline.axes}
    faults = []
    named = parse_selection(at, pipeline)
    for name, value in named.items():
        axis = pipeline.axis_of(name)
        if axis is None:
            names = [name for other in pipeline.axes for name in other.columns]
            advice = nearest(name, names) or f"; its axes are {', '.join(names) or 'none'}"
            faults.append(f"--at {name}: not an axis of the store{advice}")
        elif (row := axis.index_of(named)) is not None:
            index[axis.name] = row
        else:
            known = ", ".join(f"({each})" if axis.zipped else str(each) for each in axis.values[:6])
            more = f", ... {axis.values[-1]}" if len(axis) > 6 else ""
            faults.append(
                f"--at {name}={plain(value)}: not on the grid; its values are {known}{more}"
            )
    if faults:
        raise refusal(faults)
    return index


def _number(pipeline: Pipeline, stage: Stage, index: dict[str, int]) -> int:
    """Return the number of a stage's configuration at an index."""
    number = 0
    for axis in pipeline.axes_of(stage):
        number = number * len(axis) + index[axis.name]
    return number


def _inspected(
    cell_pipeline: Pipeline, whole_frame: bool, limit_s: float
) -> tuple[SceneInspection | None, NDArray[np.uint8] | None]:
    """Return the inspected scene and its image; None for one that raises or ends its process."""
    for function in (inspect_scene, scene_image):
        try:
            with Child() as child:
                result: Any = child.call(
                    partial(function, cell_pipeline, whole_frame=whole_frame), limit_s=limit_s
                )
        except (ChildError, RunError):
            continue
        return (result, result.image) if function is inspect_scene else (None, result)
    return None, None
