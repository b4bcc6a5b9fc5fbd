"""One scene of a store computed again, here, and compared with what the store holds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import processor
from sweep.errors import RunError
from sweep.evaluation.inspection import SceneInspection, inspect_scene, scene_image
from sweep.evaluation.results import Failure
from sweep.integrity.tolerances import departure, difference, outside
from sweep.isolation.child_process import Child, ChildDiedError, ChildRaisedError
from sweep.isolation.crash_isolation import run_cells_isolated
from sweep.messages import nearest, plain, refusal
from sweep.plan.cell_selection import at_text, cell, places
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import Block, scene_axes
from sweep.plan.parameters import Stage
from sweep.plan.schema import SCHEMA
from sweep.store.blocks import committed, receipts
from sweep.store.lifecycle import open_store
from sweep.store.provenance import differences
from sweep.store.run_store import RunStore

Values = dict[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class Reproduction:
    """What a scene gave when it was computed again.

    Attributes
    ----------
    at
        Its coordinates, all of them.
    here, stored
        Variable -> value, of the dimensions of the template that are no axes; ``stored`` is None
        where the block is not committed.
    verdict
        In what the two differ; empty where in nothing, or there is nothing to compare with.
    exact
        Whether every bit was compared, as the processor's features are those of then.
    seconds
        Stage -> what it took here.
    failures
        What raised, or ended the process.
    others
        What is otherwise here than when the store was begun: versions, files.
    pipeline, one
        The store's, and the same with every axis fixed at the cell.
    look
        A close look at the scene; None where that could not be had.
    image
        Its image (h, w) where there is one.
    """

    at: str
    here: Values
    stored: Values | None
    verdict: str
    exact: bool
    seconds: dict[str, float]
    failures: list[Failure]
    others: list[str]
    pipeline: Pipeline
    one: Pipeline
    look: SceneInspection | None
    image: NDArray[np.uint8] | None


def reproduce(
    url: str, at: str, *, whole_frame: bool = False, time_limit_s: float = 60.0
) -> Reproduction:
    """Compute one cell of a store again in a child process, and compare.

    ``at`` names a value of each axis, as "distance_m=0.3,solver=ippe"; axes that are not named
    take their first.

    Raises
    ------
    PipelineError
        Where ``at`` is not on the store's grid.
    StoreError
        Where there is no store.
    """
    store = open_store(url)
    stored = store.pipeline
    pipeline = Pipeline.from_text(
        stored.text, name=stored.name, source=store.url, folder=stored.folder
    )
    others = differences(pipeline, stored, store.fingerprint)
    index = _index(pipeline, at)
    setting, estimator = (
        _number(pipeline, stage, index) for stage in (Stage.detection, Stage.estimation)
    )
    axes = scene_axes(pipeline)
    need = np.zeros(
        (1, pipeline.size(Stage.detection), pipeline.size(Stage.estimation)), dtype=bool
    )
    need[0, setting, estimator] = True
    scene = [np.array([index[axis.name]], dtype=np.intp) for axis in axes]
    cells = run_cells_isolated(pipeline, scene, need, time_limit_s)
    treatment = {
        Stage.scene: 0, Stage.detection: setting,
        Stage.estimation: setting * need.shape[2] + estimator,
    }
    here = {
        v.name: cells.columns[v.name][treatment[v.stage]][0].astype(v.dtype) for v in SCHEMA
    }
    there, same_processor = _stored(store, index)
    exact = same_processor and not others
    verdict = ""
    if there is not None:
        verdict = difference(here, there) if exact else (
            departure(here, there) or outside(here, there)
        )
    full_at = at_text({axis.name: axis.values[index[axis.name]] for axis in pipeline.axes})
    one = cell(pipeline, full_at)
    seen, image = _looked(one, whole_frame, time_limit_s)
    return Reproduction(
        full_at, here, there, verdict, exact,
        {"scene": cells.seconds["scene"][0], "detection": cells.seconds["detection"][setting],
         "estimation": cells.seconds["estimation"][treatment[Stage.estimation]]},
        cells.failures, others, pipeline, one, seen, image,
    )


def _index(pipeline: Pipeline, at: str) -> dict[str, int]:
    """Return where a cell lies along each axis."""
    index = {axis.name: 0 for axis in pipeline.axes}
    faults = []
    for name, value in places(at).items():
        axis = pipeline.axis(name)
        if axis is None:
            names = [other.name for other in pipeline.axes]
            told = nearest(name, names) or f"; there are {', '.join(names) or 'none'}"
            faults.append(f"--at {name}: no axis of the store{told}")
        elif value in axis.values:
            index[name] = axis.values.index(value)
        else:
            known = ", ".join(str(each) for each in axis.values[:6])
            more = f", ... {axis.values[-1]}" if len(axis) > 6 else ""
            faults.append(
                f"--at {name}={plain(value)}: not on the grid, which has {known}{more}"
            )
    if faults:
        raise refusal(faults)
    return index


def _number(pipeline: Pipeline, stage: Stage, index: dict[str, int]) -> int:
    """Return which of a stage's treatments an index is of."""
    number = 0
    for axis in pipeline.axes_of(stage):
        number = number * len(axis) + index[axis.name]
    return number


def _stored(store: RunStore, index: dict[str, int]) -> tuple[Values | None, bool]:
    """Return a store's values of a cell, and whether they are of a processor like this one."""
    at = tuple(index[axis.name] for axis in scene_axes(store.pipeline))
    number = store.blocks.number(Block(at, at))
    if number not in committed(store):
        return None, False
    _, receipt = next(iter(receipts(store, [number])))
    values = {}
    for variable in SCHEMA:
        where = tuple(
            index.get(name, slice(None)) for name in variable.dimensions(store.pipeline)
        )
        values[variable.name] = np.asarray(store.array(variable.name)[where])
    return values, receipt.processor == processor()


def _looked(
    one: Pipeline, whole_frame: bool, limit_s: float
) -> tuple[SceneInspection | None, NDArray[np.uint8] | None]:
    """Return a close look and the image; None for what ends its process or raises."""
    for function in (inspect_scene, scene_image):
        try:
            with Child() as child:
                seen = child.call(
                    partial(function, one, whole_frame=whole_frame), limit_s=limit_s
                )
        except (ChildDiedError, ChildRaisedError, RunError):
            continue
        return (seen, seen.image) if function is inspect_scene else (None, seen)
    return None, None
