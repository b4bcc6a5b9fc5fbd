"""What stands beside a target and is no part of it: other markers, and plain black squares.

Each is printed on a sheet of its own, with a quiet zone as wide in its modules as that of
``[marker]``, in the target's frame and mostly in its plane.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from sweep.declaration import Declared, check_tables, declared_fields
from sweep.model.board import Board, Print, marker_print, rectangles_print, solid_print
from sweep.model.board_declaring import MAX_MARKERS, Fault
from sweep.model.board_overlap import sheets_overlap
from sweep.model.coverage import MarkerEdges
from sweep.model.marker import (
    BLACK,
    OUTSIDE,
    WHITE,
    Marker,
    marker_count,
    missing_package,
    module_count,
)
from sweep.model.marker_table import BoardMarker
from sweep.model.solid_board import own_sheets, sheets_m, sheets_of

_DICTIONARY = Marker.__dataclass_fields__["dictionary"].metadata["declaration"]

_KEYS = {
    **{name: dataclasses.replace(each, default=None) if name in ("marker_id", "size_m") else each
       for name, each in declared_fields(BoardMarker).items()},
    "dictionary": Declared("dictionary", (str,), None, _DICTIONARY),
}
"""Keys of a table [[board.distractors]]: those of a marker, none of whose IDs and sizes is needed,
and a dictionary."""


def listed_distractors(value: Any) -> tuple[tuple[Any, ...], ...]:
    """Return tables of distractors as tuples: as markers', without ID or size None; dictionary.

    ValueError or TablesError if they are not such tables.
    """
    expected = f"tables with {', '.join(_KEYS)}"
    return tuple(
        tuple(row.values()) for row in check_tables(_KEYS, value, "a distractor", expected)
    )


def with_distractors(
    board: Board, listed: Sequence[Sequence[Any]] | None, size_m: float, quiet_modules: float
) -> Board:
    """Return a board with what is ``listed`` beside it.

    ``size_m`` is the side of those that have no size, ``quiet_modules`` the width of the white
    around each, in its modules.
    """
    if not listed:
        return board
    prints = tuple(_print(row, board.dictionary, size_m, quiet_modules) for row in listed)
    return dataclasses.replace(board, distractors=prints)


def _print(row: Sequence[Any], dictionary: str, size_m: float, quiet_modules: float) -> Print:
    marker_id, x_m, y_m, own_size_m, roll_deg, z_m, tilt_deg, azimuth_deg, own = row
    dictionary = own or dictionary
    printed = marker_print(
        dictionary, marker_id or 0, size_m if own_size_m is None else own_size_m, quiet_modules,
        x_m, y_m, roll_deg,
    )
    if marker_id is None:
        square = _black_square(float(module_count(dictionary)), quiet_modules)
        printed = printed._replace(edges=square)
    if z_m == tilt_deg == 0.0:
        return printed
    return solid_print(printed, z_m, tilt_deg, azimuth_deg)[0]


def _black_square(modules: float, quiet_modules: float) -> MarkerEdges:
    """Return the edges of a black square as large as a marker's, on its white sheet."""
    low, high = -quiet_modules, modules + quiet_modules
    sheet = rectangles_print(np.array([[low, low, high, high]]), OUTSIDE, WHITE).edges
    square = rectangles_print(np.array([[0.0, 0.0, modules, modules]]), WHITE, BLACK).edges
    return MarkerEdges(
        np.concatenate([sheet.ends, square.ends]), np.concatenate([sheet.sides, square.sides])
    )


def listing_faults(
    listed: Sequence[Sequence[Any]] | None, dictionary: str
) -> list[Fault]:
    """Return what keeps single distractors beside a board of a dictionary from being printed."""
    if listed and len(listed) > MAX_MARKERS:
        return [Fault("distractors", len(listed), f"at most {MAX_MARKERS} of them")]
    for number, (marker_id, *_, own) in enumerate(listed or ()):
        missing = missing_package(own or dictionary)
        if missing is not None:
            expected = f"one whose package is installed: {missing}"
            return [Fault(f"distractors[{number}].dictionary", own or dictionary, expected)]
        count = marker_count(own or dictionary)
        if marker_id is not None and marker_id >= count:
            expected = f"an ID from 0 to {count - 1}, which is what {own or dictionary} has"
            return [Fault(f"distractors[{number}].marker_id", marker_id, expected)]
    return []


def overlap_faults(board: Board, listed: Sequence[Sequence[Any]]) -> list[Fault]:
    """Return the first overlap of a distractor with its board, or with another distractor."""
    sheets = sheets_of(board)
    corners = sheets_m(board)
    own = own_sheets(board)
    for number in range(len(sheets) - own):
        before = corners[: own + number]
        overlapping = np.flatnonzero(sheets_overlap(corners[own + number], before))
        if len(overlapping):
            other = int(overlapping[0]) - own
            name = f"distractors[{other}]" if other >= 0 else "the board"
            return [Fault(
                f"distractors[{number}].x_m", listed[number][1],
                f"no overlap with {name}, white quiet zones included; move it",
            )]
    return []
