"""A block of the grid computed in this process, in the dataset's layout."""

from dataclasses import dataclass
from typing import Any

from sweep.evaluation import block as cells_of_blocks
from sweep.evaluation.results import Failure, to_dataset_layout
from sweep.experiment.grid import Block


def whole(pipeline):
    """Return the block that is a pipeline's whole grid."""
    shape = tuple(len(axis) for axis in pipeline.experiment.scene_axes)
    return Block((0,) * len(shape), shape)


def run_cells(pipeline, indices, *needs):
    """Render, detect and estimate scene cells of a pipeline."""
    return cells_of_blocks.run_cells(pipeline.experiment, indices, *needs)


@dataclass
class BlockResult:
    """Variable -> array in the dataset's dimensions; seconds and failures as of the cells."""

    values: dict[str, Any]
    seconds: dict[str, list[float]]
    failures: list[Failure]


def run_block(pipeline, block):
    """Render, detect and estimate every scene of a block."""
    cells = run_cells(pipeline, block.indices())
    return BlockResult(
        {
            v.name: to_dataset_layout(v, pipeline, block, cells.columns[v.name])
            for v in pipeline.experiment.variables
        },
        cells.seconds,
        cells.failures,
    )
