"""Results of scene cells: columns by variable, seconds, failures; and their layout on the grid."""

from __future__ import annotations

import dataclasses
import itertools
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.experiment.grid import Block
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import Variable
from sweep.typing import Floats


@dataclass(frozen=True, slots=True)
class Failure:
    """A cell whose computation raised, or whose process died.

    Attributes
    ----------
    scene
        Number of the scene in the block.
    stage
        "scene", "detection" or "estimation".
    text
        The traceback; of a process that died, how it ended.
    setting, estimator
        Number of the detector setting and of the estimator, if the stage has them.
    crashed
        Whether the process died.
    """

    scene: int
    stage: str
    text: str
    setting: int | None = None
    estimator: int | None = None
    crashed: bool = False


MAX_TRACEBACKS = 1000
"""Failures whose traceback is kept; of the others only the last line is."""


def exception_text(failures: int) -> str:
    """Return the text of the exception that is being handled, the next after ``failures``."""
    text = traceback.format_exc()
    return text if failures < MAX_TRACEBACKS else text.strip().rpartition("\n")[2]


@dataclass(slots=True)
class CellsResult:
    """Results of N scene cells.

    Attributes
    ----------
    columns
        Variable -> one array (N, ...) per configuration of its stage, the last axis fastest.
    seconds
        Time spent: "scene", then "detection" and "estimation" per configuration.
    row_seconds
        (N,) time spent on rendering and searching each scene.
    failures
        The exceptions that were raised; their cells are flagged ``failed``.
    """

    columns: dict[str, list[NDArray[Any]]]
    seconds: dict[str, list[float]]
    row_seconds: Floats
    failures: list[Failure] = field(default_factory=list)

    @staticmethod
    def not_run(pipeline: Pipeline, count: int) -> CellsResult:
        """Return the result of ``count`` cells of which nothing was computed."""
        return CellsResult(
            {
                variable.name: [
                    np.full((count, *variable.inner_shape), variable.fill, dtype=variable.dtype)
                    for _ in range(variable.configurations(pipeline))
                ]
                for variable in pipeline.experiment.variables
            },
            {
                "scene": [0.0],
                "detection": [0.0] * pipeline.size(Stage.detection),
                "estimation": [0.0] * pipeline.size(Stage.detection, Stage.estimation),
            },
            np.zeros(count),
        )


def concatenate(parts: Sequence[CellsResult]) -> CellsResult:
    """Return the results of several groups of scenes as those of one group."""
    starts = np.cumsum([0, *(len(part.row_seconds) for part in parts)]).tolist()

    def merge(pieces: Sequence[Any], join: Callable[[Sequence[Any]], Any]) -> dict[str, list[Any]]:
        return {
            name: [join(column) for column in zip(*(piece[name] for piece in pieces), strict=True)]
            for name in pieces[0]
        }

    return CellsResult(
        merge([part.columns for part in parts], np.concatenate),
        merge([part.seconds for part in parts], sum),
        np.concatenate([part.row_seconds for part in parts]),
        [
            dataclasses.replace(failure, scene=failure.scene + start)
            for start, part in zip(starts, parts, strict=False) for failure in part.failures
        ],
    )


def to_dataset_layout(
    variable: Variable, pipeline: Pipeline, block: Block, columns: Sequence[NDArray[Any]]
) -> NDArray[Any]:
    """Return a block of a variable in the dataset's dimensions and type.

    Parameters
    ----------
    variable, pipeline, block
        Which variable of which block of the grid.
    columns
        One array (N, ...) per configuration of the variable's stage; N scenes, the last scene
        axis fastest.
    """
    inner_axes = variable.configuration_axes(pipeline)
    stacked = np.stack(columns, axis=1).astype(variable.dtype)
    spread = stacked.reshape(
        (*block.shape, *(len(axis) for axis in inner_axes), *variable.inner_shape)
    )
    axes = itertools.chain(pipeline.axes_of(Stage.scene), inner_axes)
    names = [*(axis.name for axis in axes), *variable.inner]
    order = [names.index(name) for name in variable.dimensions(pipeline)]
    return spread.transpose(order).copy(order="C")
