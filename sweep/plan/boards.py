"""The boards of a pipeline: whether its scenes show boards, and how large they are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from sweep.model.board_values import ARRANGING, SINGLE, arranged
from sweep.model.marker_table import Markers
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


def target_word(pipeline: Pipeline) -> str:
    """Return what the scenes of a pipeline show, in a word: marker, board, or target if both."""
    if not shows_boards(pipeline):
        return "marker"
    return "target" if pipeline.any_value("kind", lambda kind: kind == SINGLE) else "board"


def largest_board(pipeline: Pipeline) -> tuple[int, int]:
    """Return the most markers and the most chessboard corners of a pipeline's boards."""
    markers, corners = zip(
        *(arranged(values).counts for values in _arrangements(pipeline, _SIZED_BY)), strict=True
    )
    return max(markers), max(corners)


def relative_sizes(pipeline: Pipeline) -> tuple[float, float]:
    """Return the least and the largest side of a marker over ``size_m``: listed ones have own."""
    listed = [
        each.size_m / values[ARRANGING.index("size_m")]
        for values in _arrangements(pipeline, ("kind", "size_m", "markers"))
        if isinstance(board := arranged(values), Markers) for each in board.markers
    ] if pipeline.any_value("markers", bool) else []
    return min(listed, default=1.0), max(listed, default=1.0)


def _arrangements(pipeline: Pipeline, names: Sequence[str]) -> list[list[Any]]:
    """Return the values of `ARRANGING` of each combination of the axes of some parameters."""
    any_board = {name: pipeline.values_of(name)[0] for name in ARRANGING}
    axes = [axis for axis in pipeline.axes if not set(axis.columns).isdisjoint(names)]
    boards = [any_board | chosen for chosen in combinations(axes)]
    return [[values[name] for name in ARRANGING] for values in boards]
