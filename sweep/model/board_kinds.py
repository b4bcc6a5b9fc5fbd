"""The kinds of boards and their distractors: what a user declares of each, its rules."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from sweep.declaration import Declared, check_tables, declared_fields, parameter
from sweep.model.board import (
    Board,
    Chessboard,
    Print,
    cells_print,
    corners_of,
    first_overlap,
    marker_print,
    own_sheets,
    rectangles_print,
    sheets_m,
    sheets_of,
    sheets_overlap,
    solid_print,
)
from sweep.model.coverage import MarkerEdges
from sweep.model.marker import (
    BLACK,
    OUTSIDE,
    WHITE,
    Marker,
    marker_count,
    missing_package,
    module_count,
    overhang,
)
from sweep.model.marker import Marker as SingleMarker
from sweep.typing import Floats, Integers

# --------------------------------------------------------------------------------------------------
# What declarations of all kinds of boards share: fields, and faults of their values.

MAX_MARKERS = 4000
"""The most markers of a board; a dictionary of OpenCV has 1,000, of AprilTag's most have fewer."""

_DICTIONARY = SingleMarker.__dataclass_fields__["dictionary"].metadata["declaration"]


class Fault(NamedTuple):
    """A key whose value cannot be, and what was expected."""

    key: str
    value: Any
    expected: str


def required(meaning: str, **declared: Any) -> Any:
    """Return a declared field without a default."""
    return parameter(dataclasses.MISSING, meaning, **declared)


def dictionary_of_all() -> Any:
    """Return the declared field of the dictionary of all markers."""
    return required(
        "the dictionary of all markers, as of a single marker", choices=_DICTIONARY.choices,
        prefix=_DICTIONARY.prefix,
        numbers=_DICTIONARY.numbers,
    )


def length(meaning: str) -> Any:
    """Return the declared field of a length that must be given."""
    return required(meaning, unit="m", low=0, high=1e6, open_low=True)


def margin(meaning: str) -> Any:
    """Return the declared field of a sheet's margin."""
    return parameter(None, meaning, unit="m", low=0, high=1e6)


def refuse(faults: Sequence[Fault]) -> None:
    """Raise ValueError with a line for each fault, if there are any."""
    if faults:
        raise ValueError(
            "\n".join(f"{key} = {value}: expected {expected}" for key, value, expected in faults)
        )


def id_faults(
    key: str, ids: list[int], dictionary: str, written: Any = None
) -> list[Fault]:
    """Return the faults of markers' IDs; ``written`` is what the key has if not these."""
    missing = missing_package(dictionary)
    if missing is not None:
        return [Fault("dictionary", dictionary, f"one whose package is installed: {missing}")]
    written = ids if written is None else written
    if not 1 <= len(ids) <= MAX_MARKERS:
        return [Fault(key, ids, f"1 to {MAX_MARKERS} markers; these are {len(ids)}")]
    faults = []
    twice = [marker_id for marker_id, count in Counter(ids).items() if count > 1]
    if twice:
        faults.append(Fault(key, written, f"each ID once; {twice[0]} is listed more than once"))
    count = marker_count(dictionary)
    if min(ids) < 0 or max(ids) >= count:
        faults.append(Fault(
            key, written,
            f"IDs from 0 to {count - 1}, which is what {dictionary} has; the board has "
            f"{len(ids)} markers with IDs up to {max(ids)}; take a larger dictionary, or fewer "
            "markers",
        ))
    return faults


# --------------------------------------------------------------------------------------------------
# A target that a table of markers declares: each has a size and a pose of its own.

@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class BoardMarker:
    """One of a table of markers."""

    marker_id: int = required("the marker's ID in its dictionary", low=0, high=10**6)
    x_m: float = required("its centre, right of the origin", unit="m", low=-1e6, high=1e6)
    y_m: float = required("its centre, above the origin", unit="m", low=-1e6, high=1e6)
    size_m: float = length("side of its black square")
    roll_deg: float = parameter(
        0.0, "its turn in its plane, from x to y", unit="degree", low=-360, high=360
    )
    z_m: float = parameter(
        0.0, "height of its centre over the board's plane, positive towards who looks at it",
        unit="m", low=-1e6, high=1e6,
    )
    tilt_deg: float = parameter(
        0.0, "angle between its plane and the board's", unit="degree", low=-180, high=180
    )
    azimuth_deg: float = parameter(
        0.0, "direction of the axis of this tilt in the board's plane, from x to y", unit="degree",
        low=-360, high=360,
    )

    @property
    def is_flat(self) -> bool:
        """Whether it is in the board's plane."""
        return self.z_m == self.tilt_deg == 0.0


_TABLES = "tables [[markers]]"


def _read_markers(value: Any) -> tuple[BoardMarker, ...]:
    rows = check_tables(declared_fields(BoardMarker), value, "a marker", _TABLES)
    return tuple(BoardMarker(**row) for row in rows)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Markers:
    """A table of markers, each on a sheet of its own or, in one plane, all on one."""

    dictionary: str = dictionary_of_all()
    markers: tuple[BoardMarker, ...] = required(
        "one for each", list_text=_TABLES, reads=_read_markers
    )
    quiet_zone_modules: float | None = parameter(
        None, "width of the white that surrounds each marker on its own sheet (default: 1)",
        unit="module", low=0, high=100,
    )
    margin_m: float | None = margin(
        "width of the one white sheet beyond all markers; without it each has its own"
    )

    @property
    def counts(self) -> tuple[int, int]:
        """How many markers and chessboard corners it has."""
        return len(self.markers), 0

    def faults(self) -> list[Fault]:
        """Return what keeps the values from being a board."""
        faults = []
        if self.margin_m is not None and self.quiet_zone_modules is not None:
            faults.append(Fault(
                "margin_m", self.margin_m,
                "margin_m (one sheet) or quiet_zone_modules (a sheet each), not both; delete one "
                "of them",
            ))
        ids = [each.marker_id for each in self.markers]
        faults += id_faults("markers", ids, self.dictionary)
        if self.margin_m is not None and not all(each.is_flat for each in self.markers):
            faults.append(Fault(
                "margin_m", self.margin_m, "no one sheet for markers in several planes; delete it"
            ))
        if not faults:
            pair = self._overlap()
            if pair is not None:
                quiet = "" if self.margin_m is not None else " with their quiet zones"
                faults.append(Fault(
                    "markers", [ids[i] for i in pair],
                    f"markers that do not overlap{quiet}; these two do",
                ))
        return faults

    def _overlap(self) -> tuple[int, int] | None:
        """Return the first two markers of the same plane that overlap, or None."""
        planes: dict[tuple[float, ...], list[int]] = {}
        centres = np.array([[each.x_m, each.y_m, each.z_m] for each in self.markers])
        for k, each in enumerate(self.markers):
            if not each.is_flat:
                printed, _ = solid_print(
                    self._print(each), each.z_m, each.tilt_deg, each.azimuth_deg
                )
                centres[k] = centres[k] @ printed.turn
            key = each.tilt_deg, each.azimuth_deg if each.tilt_deg else 0.0, round(centres[k, 2], 9)
            planes.setdefault(key, []).append(k)
        sides = self._sides()
        rolls = np.radians([each.roll_deg for each in self.markers])
        for some in planes.values():
            pair = first_overlap(centres[some, :2], sides[some], rolls[some])
            if pair is not None:
                return some[pair[0]], some[pair[1]]
        return None

    def _print(self, each: BoardMarker) -> Print:
        return marker_print(
            self.dictionary, each.marker_id, each.size_m, self._quiet, each.x_m, each.y_m,
            each.roll_deg,
        )

    def _sides(self) -> Floats:
        """Return the side (n,) of what is printed of each marker, with its quiet zone."""
        quiet = self._quiet or 0.0
        around = 1 + 2 * (overhang(self.dictionary) + quiet) / module_count(self.dictionary)
        return np.array([each.size_m * around for each in self.markers])

    @property
    def _quiet(self) -> float | None:
        if self.margin_m is not None:
            return None
        return 1.0 if self.quiet_zone_modules is None else self.quiet_zone_modules

    def board(self) -> Board:
        """Return the board; ValueError with its faults, a line each."""
        refuse(self.faults())
        prints = [self._print(each) for each in self.markers]
        corners = np.array([
            corners_of(each.size_m, each.x_m, each.y_m, each.roll_deg) for each in self.markers
        ])
        if not all(each.is_flat for each in self.markers):
            for k, each in enumerate(self.markers):
                prints[k], corners[k] = solid_print(
                    prints[k], each.z_m, each.tilt_deg, each.azimuth_deg
                )
        if self.margin_m is not None:
            printed = np.concatenate([
                corners_of(side, each.x_m, each.y_m, each.roll_deg)[:, :2] * [1.0, -1.0]
                for each, side in zip(self.markers, self._sides().tolist(), strict=True)
            ])
            box = [*(printed.min(axis=0) - self.margin_m), *(printed.max(axis=0) + self.margin_m)]
            prints.append(rectangles_print(np.array([box]), OUTSIDE, WHITE))
        return Board(
            self.dictionary, tuple(each.marker_id for each in self.markers), corners,
            tuple(prints), np.empty((0, 3)),
        )


# --------------------------------------------------------------------------------------------------
# What stands beside a target and is no part of it: other markers, and plain black squares.
#
# Each is printed on a sheet of its own, with a quiet zone as wide in its modules as that of
# ``[marker]``, in the target's frame and mostly in its plane.

_DICTIONARY_DISTRACTORS = Marker.__dataclass_fields__["dictionary"].metadata["declaration"]

_KEYS = {
    **{name: dataclasses.replace(each, default=None) if name in ("marker_id", "size_m") else each
       for name, each in declared_fields(BoardMarker).items()},
    "dictionary": Declared("dictionary", (str,), None, _DICTIONARY_DISTRACTORS),
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


# --------------------------------------------------------------------------------------------------
# The kinds of boards: what a user writes of each, what it must fulfil, and its layout.
#
# The layouts are those of ``cv2.aruco.CharucoBoard`` (today's and the legacy pattern),
# ``cv2.aruco.GridBoard``, with black squares at the markers' corners if wanted, and Kalibr's
# AprilGrid. The board's origin is the middle of the chessboard or of the grid; of a table of
# markers it is the table's own.

def _first_id() -> Any:
    return parameter(
        None, "ID of the first marker, from which they count in reading order (default: 0)",
        low=0, high=10**6,
    )


def list_of_ids(meaning: str) -> Any:
    """Return the declared field of a list of IDs, none by default."""
    return parameter(None, meaning, list_text=_LIST_OF_IDS, reads=_read_ids)


def _ids() -> Any:
    return list_of_ids("IDs of all markers in reading order, in place of first_id")


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
        "has them (kind = \"aprilgrid\": also in Kalibr's order)",
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
        return _grid_board(
            self, (self.rows, self.columns), self.marker_m, self.gap_m, self.corner_squares
        )


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class AprilGrid:
    """Kalibr's AprilGrid, in the words of its target files, and in its order.

    IDs count from the bottom left to the right, then upwards. Kalibr prints each tag turned by
    180 degrees against OpenCV's dictionary, so that a marker's first corner is its lower right one.
    """

    dictionary: str = dictionary_of_all()
    tagCols: int = required("tags in a row", low=1, high=1000)
    tagRows: int = required("tags in a column", low=1, high=1000)
    tagSize: float = length("side of a tag's black square")
    tagSpacing: float = required(
        "distance between the black squares of neighbours, relative to tagSize", low=0, high=1,
        open_low=True,
    )
    first_id: int | None = parameter(
        None, "ID of the tag at the bottom left (default: 0)", low=0, high=10**6
    )
    ids: tuple[int, ...] | None = list_of_ids(
        "IDs of all tags from the bottom left to the right, then upwards, in place of first_id"
    )
    margin_m: float | None = margin(
        "width of the white sheet beyond the corner squares (default: one module of a tag)"
    )

    @property
    def counts(self) -> tuple[int, int]:
        """How many markers and chessboard corners it has."""
        return self.tagRows * self.tagCols, 0

    def faults(self) -> list[Fault]:
        """Return what keeps the values from being a board."""
        if overhang(self.dictionary):
            return [Fault(
                "dictionary", self.dictionary,
                "another one: its markers have modules where an AprilGrid has squares",
            )]
        return _id_faults(self, self.counts[0])

    def board(self) -> Board:
        """Return the board; ValueError with its faults, a line each."""
        refuse(self.faults())
        gap_m = self.tagSize * self.tagSpacing
        return _grid_board(self, (self.tagRows, self.tagCols), self.tagSize, gap_m, True)


def _grid_board(
    kind: Grid | AprilGrid, shape: tuple[int, int], marker_m: float, gap_m: float, squares: bool
) -> Board:
    """Return rows and columns of markers, with black ``squares`` between them if wanted.

    In reading order; of an AprilGrid from the bottom left upwards, each turned by 180 degrees.
    """
    kalibr = isinstance(kind, AprilGrid)
    step = marker_m + gap_m
    row, column = np.indices(shape).reshape(2, -1)
    middle = (np.array(shape[::-1]) * step - gap_m) / 2
    centres = np.stack([column, row], axis=1) * step + marker_m / 2 - middle
    others, half = [], middle
    if squares:
        row, column = np.indices((shape[0] + 1, shape[1] + 1)).reshape(2, -1)
        low = np.stack([column, row], axis=1) * step - gap_m - middle
        others = [rectangles_print(np.hstack([low, low + gap_m]), WHITE, BLACK)]
        half = middle + gap_m
    return _on_sheet(
        kind.dictionary, _ids_of(kind, len(centres)),
        centres if kalibr else centres * [1.0, -1.0], marker_m, others, half, kind.margin_m,
        np.empty((0, 2)), 180.0 if kalibr else 0.0,
    )


Kind = Charuco | Grid | AprilGrid | Markers

KINDS: dict[str, type[Kind]] = {
    "charuco": Charuco, "grid": Grid, "aprilgrid": AprilGrid, "markers": Markers,
}
"""The kinds of boards by the names that files have for them."""


def _printed_side(dictionary: str, marker_m: float) -> float:
    """Return the side of all modules of a marker, those beyond its square included."""
    return marker_m * (1 + 2 * overhang(dictionary) / module_count(dictionary))


def _with_overhang(dictionary: str, whole_m: float) -> str:
    if not overhang(dictionary):
        return ""
    return f": markers of {dictionary} have modules beyond their square, {whole_m:g} m in all"


def _id_faults(kind: Charuco | Grid | AprilGrid, count: int) -> list[Fault]:
    """Return the faults of IDs in the kind's order, of which ``count`` are needed."""
    if kind.ids is not None and kind.first_id is not None:
        return [Fault("first_id", kind.first_id, "ids or first_id, not both; delete one of them")]
    if count > MAX_MARKERS:
        key = {Charuco: "squares_x", Grid: "rows", AprilGrid: "tagRows"}[type(kind)]
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
        order = "from the bottom left" if isinstance(kind, AprilGrid) else "in reading order"
        return [Fault("ids", list(kind.ids), f"{count} IDs, one for each marker {order}")]
    return id_faults("ids", list(kind.ids), kind.dictionary)


def _ids_of(kind: Charuco | Grid | AprilGrid, count: int) -> tuple[int, ...]:
    first = kind.first_id or 0
    return kind.ids if kind.ids is not None else tuple(range(first, first + count))


def _on_sheet(
    dictionary: str, ids: tuple[int, ...], centres_m: Floats, marker_m: float,
    others: list[Print], half_m: Floats, margin_m: float | None, chessboard_m: Floats,
    roll_deg: float = 0.0,
) -> Board:
    """Return markers of one size and roll at ``centres_m`` (n, 2) with other prints on one sheet.

    The sheet extends ``half_m`` (2,) and the margin from the origin.
    """
    margin = marker_m / module_count(dictionary) if margin_m is None else margin_m
    prints = [
        marker_print(dictionary, marker_id, marker_m, None, x, y, roll_deg)
        for marker_id, (x, y) in zip(ids, centres_m.tolist(), strict=True)
    ]
    sheet = rectangles_print(np.array([[*(-half_m - margin), *(half_m + margin)]]), OUTSIDE, WHITE)
    corners = np.array([corners_of(marker_m, x, y, roll_deg) for x, y in centres_m.tolist()])
    return Board(
        dictionary, ids, corners, (*prints, *others, sheet),
        np.column_stack([chessboard_m, np.zeros(len(chessboard_m))]),
    )


# --------------------------------------------------------------------------------------------------
# A board as a pipeline declares it: how the markers of [marker] are arranged.

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
        SINGLE, "none: one marker; grid: rows and columns of markers (GridBoard); aprilgrid: "
        "Kalibr's, marker_id at the bottom left; "
        "charuco: a chessboard with markers in its white squares; diamond: a ChArUco diamond of "
        "3 x 3 squares; markers: those that [[board.markers]] lists",
        choices=(SINGLE, "grid", "aprilgrid", "charuco", "diamond", "markers"),
    )
    ids: tuple[int, ...] | None = list_of_ids(
        "IDs of all markers of a grid, charuco or diamond in reading order, of an aprilgrid from "
        "the bottom left; without it they count from marker_id on"
    )
    tagCols: int | None = parameter(None, "tags in a row of an aprilgrid", low=1, high=1000)
    tagRows: int | None = parameter(None, "tags in a column of an aprilgrid", low=1, high=1000)
    tagSpacing: float | None = parameter(
        None, "distance between the black squares of an aprilgrid's neighbours, relative to their "
        "side (Kalibr's tagSize, here size_m of [marker])", low=0, high=1, open_low=True,
    )
    rows: int | None = parameter(None, "rows of markers of a grid", low=1, high=1000)
    columns: int | None = parameter(None, "markers in a row of a grid", low=1, high=1000)
    gap_m: float | None = parameter(
        None, "distance between the black squares of a grid's neighbours", unit="m", low=0,
        high=1e6,
    )
    corner_squares: bool = parameter(
        False, "black squares of the gap's size at the corners of a grid's markers, as an "
        "aprilgrid has them",
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


FROM_MARKER = ("dictionary", "marker_id", "size_m", "quiet_zone_modules")
"""Parameters of [marker] that a board takes."""

PIPELINE_NAMES = {
    "marker_m": "size_m", "tagSize": "size_m", "first_id": "marker_id",
    "margin_m": "quiet_zone_modules",
}
"""Key of a board's file -> the parameter of a pipeline that says the same."""

_DECLARED = {kind: declared_fields(declaring) for kind, declaring in KINDS.items()}

DIAMOND = {"squares_x": 3, "squares_y": 3, "legacy_pattern": False}
"""What makes a ChArUco diamond of a charuco."""


def _own_keys(kind: str, needed: bool) -> tuple[str, ...]:
    """Return the keys of a kind of board that [board] has, those that it needs or the others."""
    declared = _DECLARED["charuco" if kind == "diamond" else kind].items()
    return tuple(
        name for name, each in declared if (each.default is dataclasses.MISSING) == needed
        and PIPELINE_NAMES.get(name, name) not in FROM_MARKER
        and not (kind == "diamond" and name in DIAMOND)
    )


_ARRANGED = ("grid", "aprilgrid", "charuco", "diamond", "markers")

NEEDED = {SINGLE: (), **{kind: _own_keys(kind, needed=True) for kind in _ARRANGED}}
"""Kind -> the parameters that it must have."""

OPTIONAL = {kind: _own_keys(kind, needed=False) for kind in _ARRANGED}
"""Kind -> the parameters that it may have."""


def arranged(values: Sequence[Any]) -> Kind:
    """Return the board that values of :data:`ARRANGING` declare, unchecked."""
    given = dict(zip(ARRANGING, values, strict=True))
    kind, ids, size_m = given["kind"], given["ids"], given["size_m"]
    cell = given["rows"], given["columns"], given["corner_squares"], ids
    if kind in (SINGLE, "markers") or (kind == "grid" and cell == (1, 1, False, None)):
        alone = ((given["marker_id"], 0.0, 0.0, None, 0.0, 0.0, 0.0, 0.0),)
        return Markers(
            dictionary=given["dictionary"], quiet_zone_modules=given["quiet_zone_modules"],
            markers=tuple(
                BoardMarker(
                    marker_id=int(number), x_m=x, y_m=y, size_m=size_m if side is None else side,
                    roll_deg=roll, z_m=z, tilt_deg=tilt, azimuth_deg=azimuth,
                )
                for number, x, y, side, roll, z, tilt, azimuth
                in (given["markers"] if kind == "markers" else alone)
            ),
        )
    if kind == "diamond":
        kind, given = "charuco", given | DIAMOND
    made: dict[str, Any] = {}
    for name, declared in _DECLARED[kind].items():
        value = given[PIPELINE_NAMES.get(name, name)]
        # Along an axis, numbers are floating-point.
        made[name] = int(value) if int in declared.types and value is not None else value
    made["margin_m"] = given["quiet_zone_modules"] * size_m / module_count(given["dictionary"])
    if ids is not None:
        made["first_id"] = None
    return KINDS[kind](**made)


def used_by(kind: Any) -> tuple[str, ...]:
    """Return the parameters of [board] that a kind uses; () of what is no kind."""
    if not isinstance(kind, str):
        return ()
    return (*NEEDED.get(kind, ()), *OPTIONAL.get(kind, ()), "distractors")


ARRANGING = ("kind", *FROM_MARKER, "rows", "columns", "gap_m", "corner_squares", "squares_x",
             "squares_y", "square_m", "legacy_pattern", "ids", "tagCols", "tagRows", "tagSpacing",
             "markers", "distractors")
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
