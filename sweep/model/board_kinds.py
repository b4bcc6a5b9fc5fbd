"""The kinds of boards and their distractors: what a user declares of each, its rules."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from sweep.declaration import Declared, TablesError, check_table, declared_fields, parameter
from sweep.model import board, marker
from sweep.model.board import Board, Chessboard, Print
from sweep.model.coverage import joined
from sweep.model.marker import BLACK, OUTSIDE, WHITE
from sweep.model.pose import rotation_of_vector
from sweep.typing import Floats, Integers

# --------------------------------------------------------------------------------------------------
# Shared by the declarations of all kinds of boards: fields, and faults of their values.

#: The most markers of a board; a dictionary of OpenCV has 1,000, of AprilTag's most have fewer.
MAX_MARKERS = 4000

_DICTIONARY = declared_fields(marker.Marker)["dictionary"]


class Fault(NamedTuple):
    """A key whose value cannot be, and what was expected."""

    key: str
    value: Any
    expected: str


def table_reader(
    declared: Mapping[str, Declared], owner: str, expected: str = ""
) -> Callable[[Any], tuple[tuple[Any, ...], ...]]:
    """Return a reader of tables as tuples of the values of ``declared``, in its order.

    It raises ValueError if they are no tables, in words that are ``expected``, and
    `TablesError` for the faults in them, as `check_table` tells them.
    """
    expected = expected or f"tables with {', '.join(declared)}"

    def read(value: Any) -> tuple[tuple[Any, ...], ...]:
        if not isinstance(value, (list, tuple)) or not all(
                isinstance(table, Mapping) for table in value):
            raise ValueError(expected)
        checked = [check_table(declared, table, owner) for table in value]
        lines = [f"[{number}].{line}" for number, (_, faults) in enumerate(checked)
                 for line in faults]
        if lines:
            raise TablesError(*lines)
        return tuple(tuple(row.values()) for row, _ in checked)

    return read


def required(meaning: str, **declared: Any) -> Any:
    """Return a declared field without a default."""
    return parameter(dataclasses.MISSING, meaning, **declared)


def count_of(meaning: str, low: int = 1) -> Any:
    """Return the declared field of a number of things in a row or column."""
    return required(meaning, low=low, high=1000)


def dictionary_of_all() -> Any:
    """Return the declared field of the dictionary of all markers."""
    meaning = "the dictionary of all markers, as of a single marker"
    return dataclasses.field(
        metadata={"declaration": dataclasses.replace(_DICTIONARY, meaning=meaning)}
    )


def length(meaning: str) -> Any:
    """Return the declared field of a length that must be given."""
    return required(meaning, unit="m", low=0, high=1e6, open_low=True)


def place(meaning: str, default: Any = dataclasses.MISSING) -> Any:
    """Return the declared field of a coordinate."""
    return parameter(default, meaning, unit="m", low=-1e6, high=1e6)


def turn(meaning: str, most: float = 360) -> Any:
    """Return the declared field of an angle, 0 by default."""
    return parameter(0.0, meaning, unit="degree", low=-most, high=most)


def id_faults(key: str, ids: list[int], dictionary: str, written: Any = None) -> list[Fault]:
    """Return the faults of markers' IDs; ``written`` is what the key has if not these."""
    missing = marker.missing_package(dictionary)
    if missing is not None:
        return [Fault("dictionary", dictionary, f"one whose package is installed: {missing}")]
    written = ids if written is None else written
    if not 1 <= len(ids) <= MAX_MARKERS:
        return [Fault(key, ids, f"1 to {MAX_MARKERS} markers; these are {len(ids)}")]
    faults = []
    twice = [marker_id for marker_id, count in Counter(ids).items() if count > 1]
    if twice:
        faults.append(Fault(key, written, f"each ID once; {twice[0]} is listed more than once"))
    count = marker.marker_count(dictionary)
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

@dataclass(frozen=True, slots=True)
class BoardMarker:
    """One of a table of markers."""

    marker_id: int = required("the marker's ID in its dictionary", low=0, high=10**6)
    x_m: float = place("its centre, right of the origin")
    y_m: float = place("its centre, above the origin")
    size_m: float = length("side of its black square")
    roll_deg: float = turn("its turn in its plane, from x to y")
    z_m: float = place(
        "height of its centre over the board's plane, positive towards who looks at it", 0.0
    )
    tilt_deg: float = turn("angle between its plane and the board's", 180)
    azimuth_deg: float = turn(
        "direction of the axis of this tilt in the board's plane, from x to y"
    )

    @property
    def is_flat(self) -> bool:
        """Whether it is in the board's plane."""
        return self.z_m == self.tilt_deg == 0.0

    def placed(
        self, dictionary: str, quiet_modules: float | None, solid: bool
    ) -> tuple[Print, Floats]:
        """Return its print and the corners (4, 3) of its square.

        ``solid``: on a plane of its own, tilted about the axis (cos azimuth, sin azimuth, 0) of the
        board after its roll. ``quiet_modules`` is as of :func:`sweep.model.board.marker_print`.
        """
        turn, azimuth = None, math.radians(self.azimuth_deg)
        if solid:
            axis = np.array([[math.cos(azimuth), math.sin(azimuth), 0.0]])
            (turn,) = rotation_of_vector(math.radians(self.tilt_deg) * axis)
        return board.marker_print(
            dictionary, self.marker_id, self.size_m, quiet_modules,
            (self.x_m, self.y_m, self.z_m), self.roll_deg, turn,
        )


_TABLES = "tables [[markers]]"


def _read_markers(value: Any) -> tuple[BoardMarker, ...]:
    rows = table_reader(declared_fields(BoardMarker), "a marker", _TABLES)(value)
    return tuple(BoardMarker(*row) for row in rows)


@dataclass(frozen=True, slots=True, kw_only=True)
class Markers:
    """A table of markers, each on a sheet of its own or, in one plane, all on one."""

    dictionary: str = dictionary_of_all()
    markers: tuple[BoardMarker, ...] = required(
        "one for each", list_text=_TABLES, reads=_read_markers
    )
    quiet_zone_modules: float | None = parameter(
        None, "width of the white that surrounds each marker on its own sheet (default: 1)", 0, 100
    )
    margin_m: float | None = parameter(
        None, "width of the one white sheet beyond all markers; without it each has its own", 0,
        1e6,
    )

    @property
    def counts(self) -> tuple[int, int]:
        """How many markers and chessboard corners it has."""
        return len(self.markers), 0

    @property
    def is_flat(self) -> bool:
        """Whether all markers are in the board's plane."""
        return all(each.is_flat for each in self.markers)

    def faults(self) -> list[Fault]:
        """Return the faults that keep the values from being a board."""
        faults = []
        if self.margin_m is not None and self.quiet_zone_modules is not None:
            faults.append(Fault(
                "margin_m", self.margin_m,
                "margin_m (one sheet) or quiet_zone_modules (a sheet each), not both; delete one "
                "of them",
            ))
        ids = [each.marker_id for each in self.markers]
        faults += id_faults("markers", ids, self.dictionary)
        if self.margin_m is not None and not self.is_flat:
            faults.append(Fault(
                "margin_m", self.margin_m, "no one sheet for markers in several planes; delete it"
            ))
        if not faults:
            pair = board.first_overlap(self._printed(self._placed()[1]))
            if pair is not None:
                quiet = "" if self.margin_m is not None else " with their quiet zones"
                faults.append(Fault(
                    "markers", [ids[i] for i in pair],
                    f"markers that do not overlap{quiet}; these two do",
                ))
        return faults

    def _placed(self) -> tuple[list[Print], Floats]:
        """Return the prints of the markers, and the corners (n, 4, 3) of their squares."""
        solid = not self.is_flat
        prints, corners = zip(
            *(each.placed(self.dictionary, self._quiet, solid) for each in self.markers),
            strict=True,
        )
        return list(prints), np.array(corners)

    def _printed(self, corners: Floats) -> Floats:
        """Return the corners (n, 4, 3) of all that is printed of each marker, its white included.

        ``corners`` (n, 4, 3) are those of its square.
        """
        around = marker.overhang(self.dictionary) + (self._quiet or 0.0)
        middle = corners.mean(axis=1, keepdims=True)
        return np.asarray(
            middle + (corners - middle) * (1 + 2 * around / marker.module_count(self.dictionary))
        )

    @property
    def _quiet(self) -> float | None:
        if self.margin_m is not None:
            return None
        return 1.0 if self.quiet_zone_modules is None else self.quiet_zone_modules

    def board(self) -> Board:
        """Return the board; it must have no faults."""
        prints, corners = self._placed()
        if self.margin_m is not None:
            printed = self._printed(corners)[..., :2].reshape(-1, 2) * [1.0, -1.0]
            box = [*(printed.min(axis=0) - self.margin_m), *(printed.max(axis=0) + self.margin_m)]
            prints.append(board.rectangles_print(np.array([box]), OUTSIDE, WHITE))
        return Board(
            self.dictionary, tuple(each.marker_id for each in self.markers), corners,
            tuple(prints), np.empty((0, 3)),
        )


# --------------------------------------------------------------------------------------------------
# Prints beside a target that are no part of it: other markers, and plain black squares.
#
# Each is printed on a sheet of its own, with a quiet zone as wide in its modules as that of
# ``[marker]``, in the target's frame and mostly in its plane.

_MARKER = declared_fields(BoardMarker)

#: Keys of a table [[board.markers]].
_LISTED = _MARKER | {"size_m": dataclasses.replace(_MARKER["size_m"], default=None)}

#: Keys of a table [[board.distractors]]: none of their IDs and sizes is needed.
_BESIDE = _LISTED | {
    "marker_id": dataclasses.replace(_MARKER["marker_id"], default=None),
    "dictionary": dataclasses.replace(_DICTIONARY, default=None),
}


def with_distractors(
    target: Board, listed: Sequence[Sequence[Any]] | None, size_m: float, quiet_modules: float
) -> Board:
    """Return a board with what is ``listed`` beside it, rows of the values of a table's keys.

    ``size_m`` is the side of those that have no size, ``quiet_modules`` the width of the white
    around each, in its modules.
    """
    prints = []
    for marker_id, x_m, y_m, own_size_m, *pose, own in listed or ():
        dictionary = own or target.dictionary
        size = size_m if own_size_m is None else own_size_m
        each = BoardMarker(marker_id or 0, x_m, y_m, size, *pose)
        printed, _ = each.placed(dictionary, quiet_modules, not each.is_flat)
        if marker_id is None:
            # A black square as large as a marker's, on its white sheet.
            modules = marker.module_count(dictionary)
            printed = printed._replace(edges=joined([
                marker.square_edges(-quiet_modules, modules + quiet_modules, OUTSIDE, WHITE),
                marker.square_edges(0, modules, WHITE, BLACK),
            ]))
        prints.append(printed)
    return dataclasses.replace(target, distractors=tuple(prints)) if prints else target


def listing_faults(listed: Sequence[Sequence[Any]] | None, dictionary: str) -> list[Fault]:
    """Return the faults that keep distractors beside a board of a dictionary from being printed."""
    if listed and len(listed) > MAX_MARKERS:
        return [Fault("distractors", len(listed), f"at most {MAX_MARKERS} of them")]
    for number, (marker_id, *_, own) in enumerate(listed or ()):
        missing = marker.missing_package(own or dictionary)
        if missing is not None:
            expected = f"one whose package is installed: {missing}"
            return [Fault(f"distractors[{number}].dictionary", own or dictionary, expected)]
        count = marker.marker_count(own or dictionary)
        if marker_id is not None and marker_id >= count:
            expected = f"an ID from 0 to {count - 1}, which is what {own or dictionary} has"
            return [Fault(f"distractors[{number}].marker_id", marker_id, expected)]
    return []


# --------------------------------------------------------------------------------------------------
# The kinds of boards on one sheet: what a user writes of each, what it must fulfil, its layout.
#
# The layouts are those of ``cv2.aruco.CharucoBoard`` (today's and the legacy pattern),
# ``cv2.aruco.GridBoard``, with black squares at the markers' corners if wanted, and Kalibr's
# AprilGrid. The board's origin is the middle of the chessboard or of the grid; of a table of
# markers it is the table's own.

_LIST_OF_IDS = "a list of whole numbers from 0 on"


def _read_ids(value: Any) -> tuple[int, ...]:
    if not isinstance(value, list) or not all(
        isinstance(item, int) and not isinstance(item, bool) and 0 <= item <= 10**6
        for item in value
    ):
        raise ValueError(_LIST_OF_IDS)
    return tuple(value)


@dataclass(frozen=True, slots=True, kw_only=True)
class _OnSheet:
    """A board of markers of one size and roll on one white sheet."""

    dictionary: str = dictionary_of_all()
    first_id: int | None = parameter(
        None, "ID of the first marker (of an aprilgrid at the bottom left), from which they count "
        "(default: 0)", 0, 10**6,
    )
    ids: tuple[int, ...] | None = parameter(
        None, "IDs of all markers in reading order, of an aprilgrid from the bottom left to the "
        "right, then upwards; without it they count from the first on", list_text=_LIST_OF_IDS,
        reads=_read_ids,
    )
    margin_m: float | None = parameter(
        None, "width of the white sheet beyond all that is black (default: one module of a "
        "marker)", 0, 1e6,
    )

    def _id_faults(self, count: int, sized_by: str, order: str = "in reading order") -> list[Fault]:
        """Return the faults of ``count`` IDs, a number that depends on the key ``sized_by``."""
        if self.ids is not None and self.first_id is not None:
            expected = "ids or first_id, not both; delete one of them"
            return [Fault("first_id", self.first_id, expected)]
        if count > MAX_MARKERS:
            expected = f"a board of at most {MAX_MARKERS} markers; it has {count}"
            return [Fault(sized_by, getattr(self, sized_by), expected)]
        if self.ids is None:
            key = "first_id" if self.first_id is not None else "dictionary"
            return id_faults(key, [*self._numbered(count)], self.dictionary, getattr(self, key))
        if len(self.ids) != count:
            return [Fault("ids", list(self.ids), f"{count} IDs, one for each marker {order}")]
        return id_faults("ids", list(self.ids), self.dictionary)

    def _numbered(self, count: int) -> tuple[int, ...]:
        first = self.first_id or 0
        return tuple(range(first, first + count)) if self.ids is None else self.ids

    def _on_sheet(
        self, centres_m: Floats, marker_m: float, others: Sequence[Print], half_m: Floats,
        roll_deg: float = 0.0, squares_m: float = 0.0,
    ) -> Board:
        """Return markers at ``centres_m`` (n, 2) with other prints, such as ``squares_m``.

        The sheet extends ``half_m`` (2,) and the margin from the origin.
        """
        ids = self._numbered(len(centres_m))
        module_m = marker_m / marker.module_count(self.dictionary)
        beyond = half_m + (module_m if self.margin_m is None else self.margin_m)
        prints, corners = zip(
            *(board.marker_print(self.dictionary, marker_id, marker_m, None, (x, y, 0.0), roll_deg)
              for marker_id, (x, y) in zip(ids, centres_m.tolist(), strict=True)),
            strict=True,
        )
        sheet = board.rectangles_print(np.array([[*-beyond, *beyond]]), OUTSIDE, WHITE)
        return Board(
            self.dictionary, ids, np.array(corners), (*prints, *others, sheet),
            np.empty((0, 3)), squares_m=squares_m,
        )


    def _in_rows(
        self, shape: tuple[int, int], marker_m: float, gap_m: float, *, squares: bool,
        kalibr: bool = False,
    ) -> Board:
        """Return rows and columns of markers, with black ``squares`` between them if wanted.

        In reading order; ``kalibr``: from the bottom left upwards, each turned by 180 degrees.
        """
        step = marker_m + gap_m
        row, column = np.indices(shape).reshape(2, -1)
        middle = (np.array(shape[::-1]) * step - gap_m) / 2
        centres = np.stack([column, row], axis=1) * step + marker_m / 2 - middle
        centres, roll_deg = (centres, 180.0) if kalibr else (centres * [1.0, -1.0], 0.0)
        if not squares:
            return self._on_sheet(centres, marker_m, [], middle, roll_deg)
        row, column = np.indices((shape[0] + 1, shape[1] + 1)).reshape(2, -1)
        low = np.stack([column, row], axis=1) * step - gap_m - middle
        others = [board.rectangles_print(np.hstack([low, low + gap_m]), WHITE, BLACK)]
        return self._on_sheet(centres, marker_m, others, middle + gap_m, roll_deg, gap_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class Charuco(_OnSheet):
    """A chessboard with markers in its white squares."""

    squares_x: int = count_of("squares in a row of a charuco", 2)
    squares_y: int = count_of("squares in a column of a charuco", 2)
    square_m: float = length("side of a square of a charuco or diamond")
    marker_m: float = length("side of a marker's black square")
    legacy_pattern: bool = parameter(
        False, "charuco: the pattern before OpenCV 4.6; with an even number of squares_y it begins "
        "with white at the top left",
    )

    def _codes(self) -> Integers:
        row, column = np.indices((self.squares_y, self.squares_x))
        begins_white = self.legacy_pattern and self.squares_y % 2 == 0
        return np.where((row + column + begins_white) % 2 == 0, BLACK, WHITE).astype(np.int64)

    @property
    def counts(self) -> tuple[int, int]:
        """How many markers and chessboard corners it has."""
        return int((self._codes() == WHITE).sum()), (self.squares_x - 1) * (self.squares_y - 1)

    def faults(self) -> list[Fault]:
        """Return the faults that keep the values from being a board."""
        whole, beyond = _printed_side(self.dictionary, self.marker_m)
        faults = []
        if whole >= self.square_m:
            expected = f"below square_m = {self.square_m:g}{beyond}"
            faults.append(Fault("marker_m", self.marker_m, expected))
        return faults + self._id_faults(self.counts[0], "squares_x")

    def board(self) -> Board:
        """Return the board; it must have no faults."""
        codes = self._codes()
        rows, columns = np.nonzero(codes == WHITE)
        middle = np.array([self.squares_x, self.squares_y]) / 2 * self.square_m
        centres = (np.stack([columns, rows], axis=1) + 0.5) * self.square_m - middle
        inner = np.indices((self.squares_y - 1, self.squares_x - 1)).reshape(2, -1)[::-1].T + 1
        chessboard = (inner * self.square_m - middle) * [1.0, -1.0]
        plain = self._on_sheet(
            centres * [1.0, -1.0], self.marker_m, [board.cells_print(codes, self.square_m)], middle
        )
        return dataclasses.replace(
            plain, chessboard_m=np.column_stack([chessboard, np.zeros(len(chessboard))]),
            chessboard=Chessboard(
                self.squares_x, self.squares_y, self.square_m, self.marker_m, self.legacy_pattern
            ),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Grid(_OnSheet):
    """Markers in rows and columns: ArUco's GridBoard, Kalibr's AprilGrid."""

    rows: int = count_of("rows of markers of a grid")
    columns: int = count_of("markers in a row of a grid")
    marker_m: float = length("side of a marker's black square")
    gap_m: float = required(
        "distance between the black squares of a grid's neighbours", unit="m", low=0, high=1e6
    )
    corner_squares: bool = parameter(
        False, "black squares of the gap's size at the corners of a grid's markers, as an "
        "aprilgrid has them",
    )

    @property
    def counts(self) -> tuple[int, int]:
        """How many markers and chessboard corners it has."""
        return self.rows * self.columns, 0

    def faults(self) -> list[Fault]:
        """Return the faults that keep the values from being a board."""
        whole, beyond = _printed_side(self.dictionary, self.marker_m)
        faults = []
        if self.marker_m + self.gap_m < whole:
            expected = f"at least {whole - self.marker_m:g}{beyond}"
            faults.append(Fault("gap_m", self.gap_m, expected))
        if self.corner_squares and self.gap_m == 0:
            faults.append(Fault("gap_m", self.gap_m, "above 0 beside corner_squares = true"))
        if self.corner_squares and whole > self.marker_m:
            faults.append(Fault(
                "corner_squares", self.corner_squares,
                f"false: the markers of {self.dictionary} have modules where the squares are",
            ))
        return faults + self._id_faults(self.counts[0], "rows")

    def board(self) -> Board:
        """Return the board; it must have no faults."""
        shape = self.rows, self.columns
        return self._in_rows(shape, self.marker_m, self.gap_m, squares=self.corner_squares)


@dataclass(frozen=True, slots=True, kw_only=True)
class AprilGrid(_OnSheet):
    """Kalibr's AprilGrid, in the words of its target files, and in its order.

    IDs count from the bottom left to the right, then upwards. Kalibr prints each tag turned by
    180 degrees against OpenCV's dictionary, so that a marker's first corner is its lower right one.
    """

    tagCols: int = count_of("tags in a row of an aprilgrid")
    tagRows: int = count_of("tags in a column of an aprilgrid")
    tagSize: float = length("side of a tag's black square")
    tagSpacing: float = required(
        "distance between the black squares of an aprilgrid's neighbours, relative to their side "
        "(Kalibr's tagSize, in pipelines size_m of [marker])", low=0, high=1, open_low=True,
    )

    @property
    def counts(self) -> tuple[int, int]:
        """How many markers and chessboard corners it has."""
        return self.tagRows * self.tagCols, 0

    def faults(self) -> list[Fault]:
        """Return the faults that keep the values from being a board."""
        if marker.overhang(self.dictionary):
            return [Fault(
                "dictionary", self.dictionary,
                "another one: its markers have modules where an AprilGrid has squares",
            )]
        return self._id_faults(self.counts[0], "tagRows", "from the bottom left")

    def board(self) -> Board:
        """Return the board; it must have no faults."""
        shape, gap_m = (self.tagRows, self.tagCols), self.tagSize * self.tagSpacing
        return self._in_rows(shape, self.tagSize, gap_m, squares=True, kalibr=True)


def _printed_side(dictionary: str, marker_m: float) -> tuple[float, str]:
    """Return the side of all modules of a marker, and a note if some are beyond its square."""
    whole = marker_m * (1 + 2 * marker.overhang(dictionary) / marker.module_count(dictionary))
    note = f": markers of {dictionary} have modules beyond their square, {whole:g} m in all"
    return whole, note if marker.overhang(dictionary) else ""


Kind = Charuco | Grid | AprilGrid | Markers

#: The kinds of boards by the names that files have for them.
KINDS: dict[str, type[Kind]] = {
    "charuco": Charuco, "grid": Grid, "aprilgrid": AprilGrid, "markers": Markers,
}


# --------------------------------------------------------------------------------------------------
# A board as a pipeline declares it: how the markers of [marker] are arranged.

#: The kind of a marker without a board.
SINGLE = "none"

#: Parameters of [marker] that a board takes.
FROM_MARKER = ("dictionary", "marker_id", "size_m", "quiet_zone_modules")

#: Key of a board's file -> the parameter of a pipeline that says the same.
PIPELINE_NAMES = {
    "marker_m": "size_m", "tagSize": "size_m", "first_id": "marker_id",
    "margin_m": "quiet_zone_modules",
}

#: Values that make a ChArUco diamond of a charuco.
DIAMOND = {"squares_x": 3, "squares_y": 3, "legacy_pattern": False}

_DECLARED = {kind: declared_fields(declaring) for kind, declaring in KINDS.items()}

_OWN = {
    kind: {
        name: each for name, each in _DECLARED[kind].items()
        if PIPELINE_NAMES.get(name, name) not in FROM_MARKER
    }
    for kind in ("grid", "aprilgrid", "charuco", "markers")
}
#: Kind -> the keys of its file that [board] has, too.
_OWN["diamond"] = {name: each for name, each in _OWN["charuco"].items() if name not in DIAMOND}

#: Kind -> the parameters that it must have.
NEEDED = {
    SINGLE: (), **{
        kind: tuple(name for name, each in keys.items() if each.default is dataclasses.MISSING)
        for kind, keys in _OWN.items()
    },
}


@dataclass(frozen=True)
class _Arrangement:
    kind: str = parameter(
        SINGLE, "none: one marker; grid: rows and columns of markers (GridBoard); aprilgrid: "
        "Kalibr's, marker_id at the bottom left; charuco: a chessboard with markers in its white "
        "squares; diamond: a ChArUco diamond of 3 x 3 squares; markers: those that "
        "[[board.markers]] lists",
        choices=(SINGLE, "grid", "aprilgrid", "charuco", "diamond", "markers"),
    )
    markers: tuple[tuple[float, ...], ...] | None = parameter(
        None, "the markers of kind = markers, each marker_id, x_m, y_m and, if wanted, size_m, "
        "roll_deg, z_m, and tilt_deg about an axis at azimuth_deg",
        list_text="tables [[board.markers]]", reads=table_reader(_LISTED, "a marker"),
    )
    distractors: tuple[tuple[Any, ...], ...] | None = parameter(
        None, "what stands beside the board, or beside the marker, and is no part of it: the same "
        "keys as of markers; without marker_id a black square; dictionary if it is another one",
        list_text="tables [[board.distractors]]", reads=table_reader(_BESIDE, "a distractor"),
    )


#: The board's parameters, beside those of [marker]: dictionary, first ID, size, quiet zone.
BoardValues: type = dataclasses.make_dataclass(
    "BoardValues",
    [
        (each.name, each.types[0], dataclasses.field(
            default=None if each.default is dataclasses.MISSING else each.default,
            metadata={"declaration": each},
        ))
        for each in {name: each for keys in _OWN.values() for name, each in keys.items()}.values()
        if each.name != "markers"
    ],
    bases=(_Arrangement,), frozen=True,
)

#: The parameters that :func:`arranged_board` takes, in its order.
ARRANGING = (*FROM_MARKER, *(field.name for field in dataclasses.fields(BoardValues)))


def arranged(values: Sequence[Any]) -> Kind:
    """Return the board that values of :data:`ARRANGING` declare, unchecked."""
    given = dict(zip(ARRANGING, values, strict=True))
    kind, ids, size_m = given["kind"], given["ids"], given["size_m"]
    cell = given["rows"], given["columns"], given["corner_squares"], ids
    if kind in (SINGLE, "markers") or (kind == "grid" and cell == (1, 1, False, None)):
        alone = ((given["marker_id"], 0.0, 0.0, None),)
        return Markers(
            dictionary=given["dictionary"], quiet_zone_modules=given["quiet_zone_modules"],
            markers=tuple(
                BoardMarker(int(number), x, y, size_m if side is None else side, *pose)
                for number, x, y, side, *pose in (given["markers"] if kind == "markers" else alone)
            ),
        )
    if kind == "diamond":
        kind, given = "charuco", given | DIAMOND
    made: dict[str, Any] = {}
    for name, declared in _DECLARED[kind].items():
        value = given[PIPELINE_NAMES.get(name, name)]
        # Along an axis, numbers are floating-point.
        made[name] = int(value) if int in declared.types and value is not None else value
    modules = marker.module_count(given["dictionary"])
    made["margin_m"] = given["quiet_zone_modules"] * size_m / modules
    if ids is not None:
        made["first_id"] = None
    return KINDS[kind](**made)


def used_by(kind: Any) -> tuple[str, ...]:
    """Return the parameters of [board] that a kind uses; () of what is no kind."""
    return (*_OWN.get(kind, ()), "distractors") if isinstance(kind, str) else ()


def arrangement_faults(values: Sequence[Any]) -> list[Fault]:
    """Return the faults of values of :data:`ARRANGING` as a board, by pipelines' names."""
    given = dict(zip(ARRANGING, values, strict=True))
    listed = given["distractors"]
    faults = arranged(values).faults() + listing_faults(listed, given["dictionary"])
    if listed and not faults:
        # The first overlap of a distractor with its board, or with another distractor.
        target = arranged_board(*values)
        pair = board.first_overlap(board.sheets_m(target))
        if pair is not None:
            other, number = (sheet - board.own_sheets(target) for sheet in pair)
            name = f"distractors[{other}]" if other >= 0 else "the board"
            faults.append(Fault(
                f"distractors[{number}].x_m", listed[number][1],
                f"no overlap with {name}, white quiet zones included; move it",
            ))
    return [fault._replace(key=PIPELINE_NAMES.get(fault.key, fault.key)) for fault in faults]


@lru_cache(maxsize=1024)
def arranged_board(*values: Any) -> Board:
    """Return the board that values of :data:`ARRANGING` declare, the same for the same values."""
    given = dict(zip(ARRANGING, values, strict=True))
    return with_distractors(
        arranged(values).board(), given["distractors"], given["size_m"],
        given["quiet_zone_modules"],
    )


def is_solid(listed: Sequence[Sequence[Any]] | None) -> bool:
    """Return whether listed markers or distractors are not all in the board's plane."""
    return any(z != 0.0 or tilt != 0.0 for *_, z, tilt, _ in (row[:8] for row in listed or ()))
