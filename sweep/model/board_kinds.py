"""The kinds of boards: what a user writes of each, what it must fulfil, and its layout.

The layouts are those of ``cv2.aruco.CharucoBoard`` (today's and the legacy pattern) and
``cv2.aruco.GridBoard``, with the black squares of Kalibr's AprilGrid if wanted. The board's origin
is the middle of the chessboard or of the grid; of a table of markers it is the table's own.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from sweep.declaration import parameter
from sweep.model.board import (
    Board,
    Chessboard,
    Print,
    cells_print,
    corners_of,
    marker_print,
    rectangles_print,
)
from sweep.model.board_declaring import (
    MAX_MARKERS,
    Fault,
    dictionary_of_all,
    id_faults,
    length,
    margin,
    refuse,
    required,
)
from sweep.model.marker import (
    BLACK,
    OUTSIDE,
    WHITE,
    module_count,
    overhang,
)
from sweep.model.marker_table import Markers
from sweep.typing import Floats, Integers


def _first_id() -> Any:
    return parameter(
        None, "ID of the first marker, from which they count in reading order (default: 0)",
        low=0, high=10**6,
    )


def _ids() -> Any:
    return parameter(
        None, "IDs of all markers in reading order, in place of first_id", list_text=_LIST_OF_IDS,
        reads=_read_ids,
    )


_LIST_OF_IDS = "a list of whole numbers from 0 on"


def _read_ids(value: Any) -> tuple[int, ...]:
    if not isinstance(value, list) or not all(
        isinstance(item, int) and not isinstance(item, bool) and 0 <= item <= 10**6
        for item in value
    ):
        raise ValueError(_LIST_OF_IDS)
    return tuple(value)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Charuco:
    """A chessboard with markers in its white squares."""

    dictionary: str = dictionary_of_all()
    squares_x: int = required("squares in a row", low=2, high=1000)
    squares_y: int = required("squares in a column", low=2, high=1000)
    square_m: float = length("side of a square")
    marker_m: float = length("side of a marker's black square")
    first_id: int | None = _first_id()
    ids: tuple[int, ...] | None = _ids()
    legacy_pattern: bool = parameter(
        False, "the pattern before OpenCV 4.6: an even number of squares_y begins with white at "
        "the top left",
    )
    margin_m: float | None = margin(
        "width of the white sheet beyond the chessboard (default: one module of a marker)"
    )

    @property
    def _begins_white(self) -> bool:
        return self.legacy_pattern and self.squares_y % 2 == 0

    def _codes(self) -> Integers:
        row, column = np.indices((self.squares_y, self.squares_x))
        black = (row + column + self._begins_white) % 2 == 0
        return np.where(black, BLACK, WHITE).astype(np.int64)

    @property
    def counts(self) -> tuple[int, int]:
        """How many markers and chessboard corners it has."""
        return int((self._codes() == WHITE).sum()), (self.squares_x - 1) * (self.squares_y - 1)

    def faults(self) -> list[Fault]:
        """Return what keeps the values from being a board."""
        whole = _printed_side(self.dictionary, self.marker_m)
        faults = []
        if whole >= self.square_m:
            faults.append(Fault(
                "marker_m", self.marker_m,
                f"below square_m = {self.square_m:g}{_with_overhang(self.dictionary, whole)}",
            ))
        return faults + _id_faults(self, self.counts[0])

    def board(self) -> Board:
        """Return the board; ValueError with its faults, a line each."""
        refuse(self.faults())
        codes = self._codes()
        rows, columns = np.nonzero(codes == WHITE)
        middle = np.array([self.squares_x, self.squares_y]) / 2 * self.square_m
        centres = (np.stack([columns, rows], axis=1) + 0.5) * self.square_m - middle
        inner = np.indices((self.squares_y - 1, self.squares_x - 1)).reshape(2, -1)[::-1].T + 1
        chessboard = (inner * self.square_m - middle) * [1.0, -1.0]
        board = _on_sheet(
            self.dictionary, _ids_of(self, len(rows)), centres * [1.0, -1.0], self.marker_m,
            [cells_print(codes, self.square_m)], middle, self.margin_m, chessboard,
        )
        return dataclasses.replace(board, chessboard=Chessboard(
            self.squares_x, self.squares_y, self.square_m, self.marker_m, self.legacy_pattern
        ))


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Grid:
    """Markers in rows and columns: ArUco's GridBoard, Kalibr's AprilGrid."""

    dictionary: str = dictionary_of_all()
    rows: int = required("rows of markers", low=1, high=1000)
    columns: int = required("markers in a row", low=1, high=1000)
    marker_m: float = length("side of a marker's black square")
    gap_m: float = required(
        "distance between the black squares of neighbours", unit="m", low=0, high=1e6
    )
    first_id: int | None = _first_id()
    ids: tuple[int, ...] | None = _ids()
    corner_squares: bool = parameter(
        False, "black squares of the gap's size at the corners of every marker, as an AprilGrid "
        "has them",
    )
    margin_m: float | None = margin(
        "width of the white sheet beyond the markers and squares (default: one module of a marker)"
    )

    @property
    def counts(self) -> tuple[int, int]:
        """How many markers and chessboard corners it has."""
        return self.rows * self.columns, 0

    def faults(self) -> list[Fault]:
        """Return what keeps the values from being a board."""
        whole = _printed_side(self.dictionary, self.marker_m)
        faults = []
        if self.marker_m + self.gap_m < whole:
            faults.append(Fault(
                "gap_m", self.gap_m,
                f"at least {whole - self.marker_m:g}{_with_overhang(self.dictionary, whole)}",
            ))
        if self.corner_squares and self.gap_m == 0:
            faults.append(Fault("gap_m", self.gap_m, "above 0 beside corner_squares = true"))
        if self.corner_squares and whole > self.marker_m:
            faults.append(Fault(
                "corner_squares", self.corner_squares,
                f"false: the markers of {self.dictionary} have modules where the squares are",
            ))
        return faults + _id_faults(self, self.counts[0])

    def board(self) -> Board:
        """Return the board; ValueError with its faults, a line each."""
        refuse(self.faults())
        step = self.marker_m + self.gap_m
        row, column = np.indices((self.rows, self.columns)).reshape(2, -1)
        shape = np.array([self.columns, self.rows])
        middle = (shape * step - self.gap_m) / 2
        centres = np.stack([column, row], axis=1) * step + self.marker_m / 2 - middle
        others = []
        half = middle
        if self.corner_squares:
            row, column = np.indices((self.rows + 1, self.columns + 1)).reshape(2, -1)
            low = np.stack([column, row], axis=1) * step - self.gap_m - middle
            others = [rectangles_print(np.hstack([low, low + self.gap_m]), WHITE, BLACK)]
            half = middle + self.gap_m
        return _on_sheet(
            self.dictionary, _ids_of(self, len(centres)), centres * [1.0, -1.0], self.marker_m,
            others, half, self.margin_m, np.empty((0, 2)),
        )


KINDS: dict[str, type[Charuco | Grid | Markers]] = {
    "charuco": Charuco, "grid": Grid, "markers": Markers,
}
"""The kinds of boards by the names that files have for them."""


def _printed_side(dictionary: str, marker_m: float) -> float:
    """Return the side of all modules of a marker, those beyond its square included."""
    return marker_m * (1 + 2 * overhang(dictionary) / module_count(dictionary))


def _with_overhang(dictionary: str, whole_m: float) -> str:
    if not overhang(dictionary):
        return ""
    return f": markers of {dictionary} have modules beyond their square, {whole_m:g} m in all"


def _id_faults(kind: Charuco | Grid, count: int) -> list[Fault]:
    """Return the faults of IDs in reading order, of which ``count`` are needed."""
    if kind.ids is not None and kind.first_id is not None:
        return [Fault("first_id", kind.first_id, "ids or first_id, not both; delete one of them")]
    if count > MAX_MARKERS:
        key = "squares_x" if isinstance(kind, Charuco) else "rows"
        return [Fault(
            key, getattr(kind, key), f"a board of at most {MAX_MARKERS} markers; it has {count}"
        )]
    if kind.ids is None:
        first = kind.first_id or 0
        key = "first_id" if kind.first_id is not None else "dictionary"
        return id_faults(
            key, list(range(first, first + count)), kind.dictionary, getattr(kind, key)
        )
    if len(kind.ids) != count:
        return [Fault("ids", list(kind.ids), f"{count} IDs, one for each marker in reading order")]
    return id_faults("ids", list(kind.ids), kind.dictionary)


def _ids_of(kind: Charuco | Grid, count: int) -> tuple[int, ...]:
    first = kind.first_id or 0
    return kind.ids if kind.ids is not None else tuple(range(first, first + count))


def _on_sheet(
    dictionary: str, ids: tuple[int, ...], centres_m: Floats, marker_m: float,
    others: list[Print], half_m: Floats, margin_m: float | None, chessboard_m: Floats,
) -> Board:
    """Return markers of one size at ``centres_m`` (n, 2) with other prints on one sheet.

    The sheet extends ``half_m`` (2,) and the margin from the origin.
    """
    margin = marker_m / module_count(dictionary) if margin_m is None else margin_m
    prints = [
        marker_print(dictionary, marker_id, marker_m, None, x, y)
        for marker_id, (x, y) in zip(ids, centres_m.tolist(), strict=True)
    ]
    sheet = rectangles_print(np.array([[*(-half_m - margin), *(half_m + margin)]]), OUTSIDE, WHITE)
    corners = np.array([corners_of(marker_m, x, y) for x, y in centres_m.tolist()])
    return Board(
        dictionary, ids, corners, (*prints, *others, sheet),
        np.column_stack([chessboard_m, np.zeros(len(chessboard_m))]),
    )

