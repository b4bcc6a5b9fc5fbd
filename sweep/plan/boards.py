"""The boards of a pipeline: whether its scenes show boards, and how large they are."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.model.board_values import SINGLE

if TYPE_CHECKING:
    from sweep.plan.experiment import Pipeline

_SIZED_BY = ("kind", "rows", "columns", "squares_x", "squares_y", "legacy_pattern", "markers")


def shows_boards(pipeline: Pipeline) -> bool:
    """Return whether the scenes of a pipeline show boards; single markers count as boards then."""
    return pipeline.any_value("kind", lambda kind: kind != SINGLE)


def largest_board(pipeline: Pipeline) -> tuple[int, int]:
    """Return the most markers and the most chessboard corners of a pipeline's boards."""
    axes = [axis for axis in pipeline.axes if not set(axis.columns).isdisjoint(_SIZED_BY)]
    most, corners = 1, 0
    for index in itertools.product(*(range(len(axis)) for axis in axes)):
        values: dict[str, Any] = {name: pipeline.fixed.get(name) for name in _SIZED_BY}
        for axis, number in zip(axes, index, strict=True):
            values |= axis.at(number)
        kind = values["kind"]
        if kind == "grid":
            most = max(most, math.prod((values["rows"], values["columns"])))
        elif kind == "markers":
            most = max(most, len(values["markers"]))
        elif kind != SINGLE:
            across, down = (
                (3, 3) if kind == "diamond" else (values["squares_x"], values["squares_y"])
            )
            begins_white = bool(values["legacy_pattern"]) and down % 2 == 0
            row, column = np.indices((down, across))
            most = max(most, int(((row + column + begins_white) % 2).sum()))
            corners = max(corners, (across - 1) * (down - 1))
    return most, corners
