"""The boards of a pipeline: whether its scenes show boards, and how large they are."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sweep.model.board_values import ARRANGING, SINGLE, arranged
from sweep.plan.axes import combinations

if TYPE_CHECKING:
    from sweep.plan.experiment import Pipeline

_SIZED_BY = ("kind", "rows", "columns", "squares_x", "squares_y", "legacy_pattern", "markers")
"""The parameters that a board's numbers of markers and corners depend on."""


def shows_boards(pipeline: Pipeline) -> bool:
    """Return whether the scenes of a pipeline show boards; single markers count as boards then.

    Markers with something beside them do, too.
    """
    return bool(pipeline.values_of("distractors")[0]) or pipeline.any_value(
        "kind", lambda kind: kind != SINGLE
    )


def largest_board(pipeline: Pipeline) -> tuple[int, int]:
    """Return the most markers and the most chessboard corners of a pipeline's boards."""
    any_board = {name: pipeline.values_of(name)[0] for name in ARRANGING}
    axes = [axis for axis in pipeline.axes if not set(axis.columns).isdisjoint(_SIZED_BY)]
    boards = [any_board | chosen for chosen in combinations(axes)]
    markers, corners = zip(
        *(arranged([values[name] for name in ARRANGING]).counts for values in boards), strict=True
    )
    return max(markers), max(corners)
