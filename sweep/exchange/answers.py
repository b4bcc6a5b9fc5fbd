"""Answers of other programs: their conventions, and their files."""

from __future__ import annotations

import csv
import itertools
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import ArgumentError, PipelineError, StoreError
from sweep.messages import nearest, nearest_file, plain
from sweep.model.pose import rotation_of_vector
from sweep.plugins.recording import REJECTED
from sweep.typing import Floats, Integers

# --------------------------------------------------------------------------------------------------
# Conventions of other programs, and their detections and poses in those of OpenCV.

CORNERS = ("TL", "TR", "BR", "BL")

DIRECTIONS = {
    "right": (1, 0, 0), "left": (-1, 0, 0), "up": (0, 1, 0), "down": (0, -1, 0), "out": (0, 0, 1),
    "in": (0, 0, -1),
}
"""Directions of the marker as a viewer sees it upright -> in the marker frame of OpenCV's ArUco."""


@dataclass(frozen=True, slots=True)
class Conventions:
    """How a program writes what it found.

    Attributes
    ----------
    pixel_center
        The coordinate of the centre of the first pixel in x and y.
    corner_order
        Which corner comes at each of the four places.
    frame
        The directions of the marker's x, y and z, as a viewer sees the upright marker.

    Examples
    --------
    >>> Conventions.of("0.5", "TR TL BL BR", "right,down,in").corner_order
    ('TR', 'TL', 'BL', 'BR')
    """

    pixel_center: float = 0.0
    corner_order: tuple[str, ...] = CORNERS
    frame: tuple[str, ...] = ("right", "up", "out")

    @staticmethod
    def of(pixel_center: str | float, corner_order: str, frame: str) -> Conventions:
        """Return the conventions of words as the command line has them.

        Raises
        ------
        ArgumentError
            If one of them cannot be.
        """
        try:
            center = float(pixel_center)
        except ValueError:
            center = np.nan
        if not -1 <= center <= 1:
            raise ArgumentError("pixel_center", pixel_center, "expected 0 or 0.5")
        corners = tuple(_words(corner_order.upper()))
        if sorted(corners) != sorted(CORNERS):
            raise ArgumentError(
                "corner_order", repr(corner_order),
                "expected TL, TR, BR and BL, each once, in the program's order, as in "
                '"TR TL BL BR"',
            )
        directions = tuple(_words(frame.lower()))
        matrix = np.array([DIRECTIONS.get(word, (0, 0, 0)) for word in directions])
        if matrix.shape != (3, 3) or round(float(np.linalg.det(matrix))) != 1:
            raise ArgumentError(
                "frame", repr(frame), "expected the directions of x, y and z among right, left, "
                'up, down, out, in, of a right-handed frame, as in "right down in"',
            )
        return Conventions(center, corners, directions)

    def corners(self, theirs: Floats) -> Floats:
        """Return corners (N, 4, 2) in our order and pixels."""
        order = [self.corner_order.index(name) for name in CORNERS]
        return np.asarray(theirs[:, order] - self.pixel_center)

    def rotations(self, theirs: Floats) -> Floats:
        """Return rotations (N, 3, 3) of our marker frame, of those of theirs."""
        return np.asarray(theirs @ frame_axes(self.frame))


def frame_axes(frame: tuple[str, ...]) -> NDArray[np.float64]:
    """Return the rotation (3, 3) from our marker frame to one of given directions.

    Its rows are the frame's axes in ours: a point is ours = axesᵀ · theirs.
    """
    return np.array([DIRECTIONS[word] for word in frame], dtype=np.float64)


def _words(text: str) -> list[str]:
    return [word for word in re.split(r"[\s,;]+", text) if word]


# --------------------------------------------------------------------------------------------------
# What is read of a program's answers so far: names of columns, faults, and numbers as arrays.

CORNER_COLUMNS = tuple(f"{axis}{corner}" for corner in range(4) for axis in "xy")
VECTOR = ("rx", "ry", "rz")
QUATERNION = ("qw", "qx", "qy", "qz")
POSITION = ("tx", "ty", "tz")

ALIASES = {
    "file": "image", "filename": "image", "file_name": "image", "image_name": "image",
    "marker_id": "id", "markerid": "id", "tag_id": "id",
    **{f"rvec_{axis}": f"r{axis}" for axis in "xyz"},
    **{f"tvec_{axis}": f"t{axis}" for axis in "xyz"},
    **{f"{axis}_{corner}": f"{axis}{corner}" for corner in range(5) for axis in "xy"},
}
"""Other names of columns."""

NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")

MAX_PX = 1e7
MAX_M = 1e9

MAX_FAULTS = 20
"""Faults that are listed; the others are counted."""

MAX_TOLD_COLUMNS = 12


@dataclass(slots=True)
class Reading:
    """A file as far as it could be read, and its faults."""

    source: str
    images: Mapping[str, int]
    faults: list[str] = field(default_factory=list)
    count: int = 0

    def fault(self, line: int, text: str) -> None:
        """Note a fault of a line."""
        self.count += 1
        if len(self.faults) < MAX_FAULTS:
            self.faults.append(f"{self.source}: line {line}: {plain(text, 300)}")

    def check(self) -> None:
        """Raise PipelineError if there are faults."""
        if self.count > len(self.faults):
            self.faults.append(f"... and {self.count - len(self.faults):,} faults more")
        if self.faults:
            raise PipelineError(self.faults)


def finish(reading: Reading, line: int, answer: dict[str, Any]) -> bool:
    """Turn an answer's numbers into arrays; False with a fault if they cannot be."""
    pose = answer.pop("pose", None)
    if "corners" in answer:
        corners = np.array(answer["corners"]).reshape(4, 2)
        if np.abs(corners).max() > MAX_PX:
            reading.fault(line, f"corners beyond {MAX_PX:.0e} px; expected pixels of the image")
            return False
        answer["corners"] = corners
    if pose is not None:
        angles, position = np.array(pose[:-3]), np.array(pose[-3:])
        if np.abs(position).max() > MAX_M:
            reading.fault(line, f"a position beyond {MAX_M:.0e}; expected metres")
            return False
        if len(angles) == 4:
            length = float(np.linalg.norm(angles))
            if abs(length - 1) > 0.01:
                reading.fault(
                    line, f"a quaternion of length {length:.3g}; expected w, x, y, z of length 1"
                )
                return False
            w, x, y, z = angles / length
            half = math.atan2(math.hypot(x, y, z), w)
            sine = math.sin(half)
            angles = 2 * half * np.array([x, y, z]) / sine if sine else np.zeros(3)
        if np.abs(angles).max() > 1e6:
            reading.fault(line, "a rotation vector beyond 1e6; expected radians")
            return False
        answer["rotation"] = rotation_of_vector(angles[None])[0]
        answer["translation"] = position
    if "corners" not in answer and pose is None:
        reading.fault(line, "an ID without corners and without a pose")
        return False
    return True


# --------------------------------------------------------------------------------------------------
# Rows of a CSV file, whatever program wrote it: separators, line ends, comments.

SEPARATORS = ",;\t"


def csv_rows(
    text: str,
) -> tuple[int, list[str], Iterator[tuple[int, list[str]]], bool] | None:
    r"""Return the header's line and names, the rows with their lines, whether commas are points.

    None if there is no header. Empty lines, and those that begin with ``#``, are left out. The
    separator is the one that the header has most of.

    Examples
    --------
    >>> line, header, rows, commas = csv_rows("# mine\r\nimage;x0\r\na;1,5\r\n")
    >>> line, header, list(rows), commas
    (2, ['image', 'x0'], [(3, ['a', '1,5'])], True)
    """
    lines = text_lines(text)
    start = next(
        (k for k, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")),
        None,
    )
    if start is None:
        return None
    separator = max(SEPARATORS, key=lines[start].count)

    def rows() -> Iterator[tuple[int, list[str]]]:
        for number, line in zip(itertools.count(start + 1), lines[start:], strict=False):
            if line.strip() and not line.lstrip().startswith("#"):
                try:
                    yield number, next(csv.reader([line], delimiter=separator), [])
                except csv.Error:
                    yield number, [line]

    each = rows()
    header_line, header = next(each)
    return header_line, header, each, separator == ";"


def text_lines(text: str) -> list[str]:
    r"""Return the lines of a text, ended as Unix, Windows or an old Mac does.

    >>> text_lines("a\r\nb\rc\u2028d\n")
    ['a', 'b', 'c\u2028d', '']
    """
    return re.split(r"\r\n|\n|\r", text)


# --------------------------------------------------------------------------------------------------
# Answers in a CSV file: a row a marker, the columns in any order.

def csv_answers(text: str, reading: Reading) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield the line and content of each row of a CSV file."""
    table = csv_rows(text)
    if table is None:
        return
    header_line, written, rows, decimal_comma = table
    header = [_column(name) for name in written]
    usable = _check_header(reading, header_line, header, written)
    if usable is None:
        return
    has_corners, angles = usable
    wanted = [*(CORNER_COLUMNS if has_corners else ()), *angles, *(POSITION if angles else ())]
    for line, cells in rows:
        if len(cells) != len(header):
            reading.fault(
                line, f"{len(cells)} values; expected {len(header)}, as the header has"
            )
            continue
        row = dict(zip(header, (cell.strip() for cell in cells), strict=True))
        answer: dict[str, Any] = {"image": row["image"]}
        if not any(row[name] for name in (*wanted, "id")):
            yield line, answer
            continue
        answer["id"] = row["id"]
        if decimal_comma:
            row |= {name: row[name].replace(",", ".") for name in wanted}
        complete = _numbers(reading, line, row, answer, "corners", CORNER_COLUMNS) \
            if has_corners else True
        if complete and angles:
            complete = _numbers(reading, line, row, answer, "pose", (*angles, *POSITION))
        if complete and finish(reading, line, answer):
            yield line, answer


def _column(name: str) -> str:
    bare = name.strip().lower()
    return ALIASES.get(bare, bare)


def _check_header(
    reading: Reading, line: int, header: list[str], written: list[str]
) -> tuple[bool, tuple[str, ...]] | None:
    """Return whether there are corners, and the columns of the rotation; None with a fault."""
    repeated = next((name for name in header if name and header.count(name) > 1), None)
    if repeated is not None:
        reading.fault(line, f"the column {repeated} is there twice")
        return None
    if "x4" in header or "y4" in header:
        reading.fault(line, "columns of more than four corners; expected x0, y0 to x3, y3")
        return None
    columns = set(header)
    angles = QUATERNION if columns & {*QUATERNION} else VECTOR if columns & {*VECTOR} else ()
    has_pose = bool(angles or columns & {*POSITION})
    has_corners = bool(columns & {*CORNER_COLUMNS})
    expected = ["image", "id"]
    if has_corners or not has_pose:
        expected += CORNER_COLUMNS
    if has_pose:
        expected += [*(angles or VECTOR), *POSITION]
    if missing := [name for name in expected if name not in columns]:
        listed = ", ".join(missing[:MAX_TOLD_COLUMNS])
        unknown = [name for name in written if _column(name) not in expected]
        hint = nearest(unknown[0].strip(), missing) if unknown else ""
        poses = "" if has_pose or has_corners else ", or rx, ry, rz, tx, ty, tz of poses"
        found = ", ".join(plain(name, 40) for name in written[:MAX_TOLD_COLUMNS])
        reading.fault(line, f"no column {listed}{poses}; the header has {found}{hint}")
        return None
    return has_corners, tuple(angles)


def _numbers(
    reading: Reading, line: int, row: Mapping[str, str], answer: dict[str, Any], what: str,
    names: tuple[str, ...],
) -> bool:
    """Put the numbers of columns into an answer, none where all are empty; False with a fault."""
    empty = [name for name in names if not row[name]]
    if len(empty) == len(names):
        return True
    if empty:
        reading.fault(line, f"no {', '.join(empty)}; expected all numbers of the {what}, or none")
        return False
    for name in names:
        if not NUMBER.fullmatch(row[name]):
            reading.fault(line, f"{name} = {plain(row[name])}: expected a finite number")
            return False
    answer[what] = [float(row[name]) for name in names]
    return True


# --------------------------------------------------------------------------------------------------
# Answers of other programs: files of detections and poses, read with all their faults told.

_NAME = re.compile(r"(\d{6,})-[0-9a-f]{8}")


@dataclass(slots=True)
class Answers:
    """What a program found in exported images.

    Attributes
    ----------
    image
        (M,) indices into the names of the images.
    marker_id
        (M,) IDs, :data:`sweep.plugins.recording.REJECTED` for candidates that were not decoded.
    corners
        (M, 4, 2) px of the image; NaN where none were given.
    rotation, translation
        (M, 3, 3) and (M, 3); NaN where no pose was given.
    line
        (M,) lines of the file.
    named
        Images that the file names, found in or not.
    """

    image: Integers
    marker_id: Integers
    corners: Floats
    rotation: Floats
    translation: Floats
    line: Integers
    named: set[int]


def read_answers(
    path: Path, images: Mapping[str, int], conventions: Conventions, doubled: str = "refuse"
) -> Answers:
    """Return the answers of a CSV file, in our conventions.

    Parameters
    ----------
    path
        The file.
    images
        Name of each exported image, without a suffix -> its index.
    conventions
        The program's.
    doubled
        "refuse" where an image has an ID twice, or "nearest": the one nearest to the truth counts.

    Raises
    ------
    PipelineError
        One line for each fault, with the line of the file.
    StoreError
        If the file cannot be read.
    """
    reading = Reading(plain(path, 300), images)
    text = _text(path, reading)
    reading.check()
    image: list[int] = []
    ids: list[int] = []
    corners: list[Any] = []
    rotation: list[Any] = []
    translation: list[Any] = []
    lines: list[int] = []
    named: set[int] = set()
    first: dict[tuple[int, int], int] = {}
    no_corners, no_rotation = np.full((4, 2), np.nan), np.full((3, 3), np.nan)
    for line, row in csv_answers(text, reading):
        where = _image(reading, line, row.get("image"))
        if where is None:
            continue
        named.add(where)
        if row.keys() <= {"image"}:
            continue  # it was searched, and nothing was found
        marker = _marker_id(reading, line, row.get("id"))
        if marker is None:
            continue
        if marker != REJECTED and doubled == "refuse":
            before = first.setdefault((where, marker), line)
            if before != line:
                reading.fault(
                    line, f"image {row['image']} has ID {marker} twice, here and in line {before}; "
                    "delete one, or pass --doubled nearest: the one nearest to the truth counts, "
                    "as of detectors that run here",
                )
                continue
        image.append(where)
        ids.append(marker)
        corners.append(row.get("corners", no_corners))
        rotation.append(row.get("rotation", no_rotation))
        translation.append(row.get("translation", (np.nan,) * 3))
        lines.append(line)
    reading.check()
    count = len(image)
    return Answers(
        np.array(image, dtype=np.int64), np.array(ids, dtype=np.int64),
        conventions.corners(np.array(corners, dtype=np.float64).reshape(count, 4, 2)),
        conventions.rotations(np.array(rotation, dtype=np.float64).reshape(count, 3, 3)),
        np.array(translation, dtype=np.float64).reshape(count, 3),
        np.array(lines, dtype=np.int64), named,
    )


def _text(path: Path, reading: Reading) -> str:
    """Return a file's text in any encoding that a byte order mark names, else UTF-8."""
    try:
        content = path.read_bytes()
    except (OSError, ValueError) as error:
        reason = f"{plain(getattr(error, 'strerror', None) or error)}{nearest_file(path)}"
        raise StoreError(f"{reading.source}: cannot be read: {reason}") from None
    encoding = "utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError as error:
        reading.fault(
            content[: error.start].count(b"\n") + 1, "not UTF-8 text; expected CSV"
        )
        return ""
    if "\0" in text:
        reading.fault(text[: text.index("\0")].count("\n") + 1, "not text: a zero byte")
    elif text.lstrip()[:1] in ("{", "["):
        reading.fault(1, "JSON; expected CSV with a header such as image,id,x0,y0,x1,y1,...")
    return text


def _image(reading: Reading, line: int, name: object) -> int | None:
    """Return the index of a named image; None with a fault if there is none."""
    if not isinstance(name, str) or not name.strip():
        reading.fault(line, "no image; expected the name of one")
        return None
    stem = re.sub(r"\.[A-Za-z0-9]{1,5}$", "", name.strip().replace("\\", "/").rpartition("/")[2])
    found = reading.images.get(stem)
    if found is None:
        hint = "; it is of another export" if _NAME.fullmatch(stem) else (
            f"; expected a name such as {next(iter(reading.images), '')}.png"
        )
        reading.fault(line, f"image {plain(name)} is not among those that were exported{hint}")
    return found


def _marker_id(reading: Reading, line: int, value: object) -> int | None:
    """Return an ID; None with a fault if it is none."""
    written = isinstance(value, str) and NUMBER.fullmatch(value.strip())
    counts = isinstance(value, (int, float)) and not isinstance(value, bool)
    number = float(str(value)) if written or counts else math.nan
    if not (math.isfinite(number) and number.is_integer() and REJECTED <= number < 2**31):
        reading.fault(
            line, f"id {plain(value)}: expected a whole number, or -1 for a candidate that was not "
            "decoded",
        )
        return None
    return int(number)
