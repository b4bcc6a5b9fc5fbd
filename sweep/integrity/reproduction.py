"""Reproduction of one cell of a store: recomputed, compared with the stored one, and drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sweep.errors import RunError
from sweep.evaluation.inspection import SceneInspection, inspect_scene, scene_image
from sweep.evaluation.results import Failure
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline, cell, parse_selection, selection_text
from sweep.experiment.schema import Variable
from sweep.integrity.recomputation import StoredValues, compare, current_pipeline, stored_cell
from sweep.isolation.child_process import Child, ChildDiedError, ChildRaisedError
from sweep.isolation.crash_isolation import run_cells_isolated
from sweep.measure.flags import DetectionStatus
from sweep.messages import nearest, plain, refusal
from sweep.store.lifecycle import open_store


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
        Whether the image is that of the whole frame, and not of the marker's surroundings.
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
                result = child.call(
                    partial(function, cell_pipeline, whole_frame=whole_frame), limit_s=limit_s
                )
        except (ChildDiedError, ChildRaisedError, RunError):
            continue
        return (result, result.image) if function is inspect_scene else (None, result)
    return None, None
