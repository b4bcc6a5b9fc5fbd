"""A board as a pipeline declares it: how the markers of [marker] are arranged."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from sweep.declaration import check_tables, declared_fields, parameter
from sweep.model.board import Board
from sweep.model.board_declaring import Fault
from sweep.model.board_kinds import Charuco, Grid
from sweep.model.distractors import (
    listed_distractors,
    listing_faults,
    overlap_faults,
    with_distractors,
)
from sweep.model.marker import module_count
from sweep.model.marker_table import BoardMarker, Markers

SINGLE = "none"
"""The kind of a marker without a board."""


_LISTED = {name: each if name != "size_m" else dataclasses.replace(each, default=None)
           for name, each in declared_fields(BoardMarker).items()}
"""Keys of a table [[board.markers]]."""


def listed_markers(value: Any) -> tuple[tuple[Any, ...], ...]:
    """Return tables of markers as tuples: ID, x, y, size or None, roll, z, tilt, azimuth.

    ValueError or TablesError if they are not such tables.
    """
    expected = f"tables with {', '.join(_LISTED)}"
    return tuple(tuple(row.values()) for row in check_tables(_LISTED, value, "a marker", expected))


@dataclass(frozen=True, slots=True)
class BoardValues:
    """The board's parameters, beside those of [marker]: dictionary, first ID, size, quiet zone."""

    kind: str = parameter(
        SINGLE, "none: one marker; grid: rows and columns of markers (GridBoard, AprilGrid); "
        "charuco: a chessboard with markers in its white squares; diamond: a ChArUco diamond of "
        "3 x 3 squares; markers: those that [[board.markers]] lists",
        choices=(SINGLE, "grid", "charuco", "diamond", "markers"),
    )
    rows: int | None = parameter(None, "rows of markers of a grid", low=1, high=1000)
    columns: int | None = parameter(None, "markers in a row of a grid", low=1, high=1000)
    gap_m: float | None = parameter(
        None, "distance between the black squares of a grid's neighbours", unit="m", low=0,
        high=1e6,
    )
    corner_squares: bool = parameter(
        False, "black squares of the gap's size at the corners of a grid's markers, as an "
        "AprilGrid has them",
    )
    squares_x: int | None = parameter(None, "squares in a row of a charuco", low=2, high=1000)
    squares_y: int | None = parameter(None, "squares in a column of a charuco", low=2, high=1000)
    square_m: float | None = parameter(
        None, "side of a square of a charuco or diamond", unit="m", low=0, high=1e6, open_low=True
    )
    legacy_pattern: bool = parameter(
        False, "charuco: the pattern before OpenCV 4.6; with an even number of squares_y it begins "
        "with white at the top left",
    )
    markers: tuple[tuple[float, ...], ...] | None = parameter(
        None, "the markers of kind = markers, each marker_id, x_m, y_m and, if wanted, size_m, "
        "roll_deg, z_m, and tilt_deg about an axis at azimuth_deg",
        list_text="tables [[board.markers]]", reads=listed_markers,
    )
    distractors: tuple[tuple[Any, ...], ...] | None = parameter(
        None, "what stands beside the board, or beside the marker, and is no part of it: the same "
        "keys as of markers; without marker_id a black square; dictionary if it is another one",
        list_text="tables [[board.distractors]]", reads=listed_distractors,
    )


NEEDED: dict[str, tuple[str, ...]] = {
    SINGLE: (),
    "grid": ("rows", "columns", "gap_m"),
    "charuco": ("squares_x", "squares_y", "square_m"),
    "diamond": ("square_m",),
    "markers": ("markers",),
}
"""Kind -> the parameters that it must have."""

OPTIONAL: dict[str, tuple[str, ...]] = {
    "grid": ("corner_squares",), "charuco": ("legacy_pattern",),
}
"""Kind -> the parameters that it may have."""

FROM_MARKER = ("dictionary", "marker_id", "size_m", "quiet_zone_modules")
"""Parameters of [marker] that a board takes."""

PIPELINE_NAMES = {
    "marker_m": "size_m", "first_id": "marker_id", "margin_m": "quiet_zone_modules",
}
"""Key of a board's file -> the parameter of a pipeline that says the same."""


def arranged(values: Sequence[Any]) -> Charuco | Grid | Markers:
    """Return the board that values of :data:`ARRANGING` declare, unchecked."""
    (kind, dictionary, marker_id, size_m, quiet, rows, columns, gap_m, corner_squares, squares_x,
     squares_y, square_m, legacy_pattern, markers, _) = values
    margin_m = quiet * size_m / module_count(dictionary)
    # Along an axis, numbers are floating-point.
    counts: list[Any] = [
        None if each is None else int(each)
        for each in (marker_id, rows, columns, squares_x, squares_y)
    ]
    marker_id, rows, columns, squares_x, squares_y = counts
    if kind == "grid" and (rows, columns, corner_squares) != (1, 1, False):
        return Grid(
            dictionary=dictionary, rows=rows, columns=columns, marker_m=size_m, gap_m=gap_m,
            first_id=marker_id, corner_squares=corner_squares, margin_m=margin_m,
        )
    if kind in ("charuco", "diamond"):
        across, down = (3, 3) if kind == "diamond" else (squares_x, squares_y)
        return Charuco(
            dictionary=dictionary, squares_x=across, squares_y=down, square_m=square_m,
            marker_m=size_m, first_id=marker_id, legacy_pattern=legacy_pattern, margin_m=margin_m,
        )
    listed = markers if kind == "markers" else ((marker_id, 0.0, 0.0, size_m, 0.0, 0.0, 0.0, 0.0),)
    return Markers(
        dictionary=dictionary, quiet_zone_modules=quiet,
        markers=tuple(
            BoardMarker(
                marker_id=int(number), x_m=x, y_m=y, size_m=size_m if side is None else side,
                roll_deg=roll, z_m=z, tilt_deg=tilt, azimuth_deg=azimuth,
            )
            for number, x, y, side, roll, z, tilt, azimuth in listed
        ),
    )


def used_by(kind: Any) -> tuple[str, ...]:
    """Return the parameters of [board] that a kind uses; () of what is no kind."""
    if not isinstance(kind, str):
        return ()
    return (*NEEDED.get(kind, ()), *OPTIONAL.get(kind, ()), "distractors")


ARRANGING = ("kind", *FROM_MARKER, "rows", "columns", "gap_m", "corner_squares", "squares_x",
             "squares_y", "square_m", "legacy_pattern", "markers", "distractors")
"""The parameters that :func:`arranged_board` takes, in its order."""


def arrangement_faults(values: Sequence[Any]) -> list[Fault]:
    """Return what keeps values of :data:`ARRANGING` from being a board, by pipelines' names."""
    _, dictionary, *_, listed = values
    faults = arranged(values).faults() + listing_faults(listed, dictionary)
    if listed and not faults:
        faults = overlap_faults(arranged_board(*values), listed)
    return [
        Fault(PIPELINE_NAMES.get(fault.key, fault.key), fault.value, fault.expected)
        for fault in faults
    ]


@lru_cache(maxsize=1024)
def arranged_board(*values: Any) -> Board:
    """Return the board that values of :data:`ARRANGING` declare, the same for the same values."""
    _, _, _, size_m, quiet_modules, *_, listed = values
    return with_distractors(arranged(values).board(), listed, size_m, quiet_modules)


def is_solid(listed: Sequence[Sequence[Any]] | None) -> bool:
    """Return whether listed markers or distractors are not all in the board's plane."""
    return any(z != 0.0 or tilt != 0.0 for *_, z, tilt, _ in (row[:8] for row in listed or ()))
