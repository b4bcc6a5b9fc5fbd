"""Answers of other programs: their conventions, and their files."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sweep.errors import ArgumentError, PipelineError, StoreError
from sweep.messages import nearest, nearest_file, plain
from sweep.model.pose import rotation_of_vector
from sweep.plugins.recording import OF_TARGET, REJECTED
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
# The CSV file of a program, whichever it is: its rows, and the faults of each.

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

SEPARATORS = ",;\t"
"""The header has most of the one that separates; with semicolons, commas are decimal points."""

NUMBER = r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?"

MAX_PX = 1e7
MAX_M = 1e9
MAX_TURN = 1e6

MAX_FAULTS = 20
"""Faults that are listed; the others are counted."""

MAX_TOLD_COLUMNS = 12

_NAME = re.compile(r"(\d{6,})-[0-9a-f]{8}")


@dataclass(slots=True)
class _Faults:
    """The faults of a file: line, and text; those beyond the listed ones are counted."""

    source: str
    texts: list[str] = field(default_factory=list)
    count: int = 0

    def add(self, line: int, text: str) -> None:
        self.count += 1
        if self.count <= MAX_FAULTS:
            self.texts.append(f"{self.source}: line {line}: {plain(text, 300)}")

    def check(self) -> None:
        """Raise PipelineError if there are faults: a line each, in the order of the file."""
        if self.count > MAX_FAULTS:
            self.texts.append(f"... and {self.count - MAX_FAULTS:,} faults more")
        if self.count:
            raise PipelineError(self.texts)


def _text(path: Path, faults: _Faults) -> str:
    """Return a file's text in any encoding that a byte order mark names, else UTF-8."""
    try:
        content = path.read_bytes()
    except (OSError, ValueError) as error:
        reason = f"{plain(getattr(error, 'strerror', None) or error)}{nearest_file(path)}"
        raise StoreError(f"{faults.source}: cannot be read: {reason}") from None
    encoding = "utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError as error:
        faults.add(content[: error.start].count(b"\n") + 1, "not UTF-8 text; expected CSV")
        return ""
    if "\0" in text:
        faults.add(text[: text.index("\0")].count("\n") + 1, "not text: a zero byte")
    elif text.lstrip()[:1] in ("{", "["):
        faults.add(1, "JSON; expected CSV with a header such as image,id,x0,y0,x1,y1,...")
    return text


def _rows(text: str, faults: _Faults) -> list[tuple[int, dict[str, str]]]:
    """Return line and cells, by our names of columns, of the rows of a CSV text.

    Empty lines and lines that begin with ``#`` are left out. The header must have image and id, and
    all columns of the corners, of the pose, or of both.
    """
    numbered = [
        (number, line) for number, line in enumerate(re.split(r"\r\n|\n|\r", text), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not numbered:
        return []
    separator = max(SEPARATORS, key=numbered[0][1].count)
    (first, written), *rows = [
        (number, [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])])
        for number, line in numbered
    ]
    header = [ALIASES.get(name.lower(), name.lower()) for name in written]
    if fault := _header_fault(header, written):
        faults.add(first, fault)
        faults.check()
    for number, row in rows:
        if len(row) != len(header):
            faults.add(number, f"{len(row)} values; expected {len(header)}, as the header has")
    numbers = {*CORNER_COLUMNS, *VECTOR, *QUATERNION, *POSITION} if separator == ";" else ()
    return [
        (number, {
            name: cell.replace(",", ".") if name in numbers else cell
            for name, cell in zip(header, row, strict=True)
        })
        for number, row in rows if len(row) == len(header)
    ]


def _header_fault(header: Sequence[str], written: Sequence[str]) -> str:
    """Return what a header lacks, or has twice; ``written`` are the names as the file has them."""
    columns = set(header)
    repeated = next((name for name in header if name and header.count(name) > 1), None)
    if repeated is not None:
        return f"the column {repeated} is there twice"
    if columns & {"x4", "y4"}:
        return "columns of more than four corners; expected x0, y0 to x3, y3"
    angles = QUATERNION if columns & {*QUATERNION} else VECTOR
    has_pose = bool(columns & {*angles, *POSITION})
    has_corners = bool(columns & {*CORNER_COLUMNS})
    expected = [
        "image", "id", *(CORNER_COLUMNS if has_corners or not has_pose else ()),
        *((*angles, *POSITION) if has_pose else ()),
    ]
    missing = [name for name in expected if name not in columns]
    if not missing:
        return ""
    unknown = [name for name, ours in zip(written, header, strict=True) if ours not in expected]
    hint = nearest(unknown[0], missing) if unknown else ""
    poses = "" if has_pose or has_corners else ", or rx, ry, rz, tx, ty, tz of poses"
    found = ", ".join(plain(name, 40) for name in written[:MAX_TOLD_COLUMNS])
    listed = ", ".join(missing[:MAX_TOLD_COLUMNS])
    return f"no column {listed}{poses}; the header has {found}{hint}"


# --------------------------------------------------------------------------------------------------
# Answers of other programs: detections and poses, read with all their faults told.

class _Answer(NamedTuple):
    """One row: an image's index, an ID, corners (8,), angles (3 or 4) and position (3,)."""

    image: int
    marker_id: int
    corners: Sequence[float]
    angles: Sequence[float]
    position: Sequence[float]


@dataclass(slots=True)
class Answers:
    """What a program found in exported images.

    Attributes
    ----------
    image
        (M,) indices into the names of the images.
    marker_id
        (M,) IDs; :data:`sweep.plugins.recording.REJECTED` for candidates that were not decoded,
        :data:`sweep.plugins.recording.OF_TARGET` for poses of a board, or of any target, as such.
    corners
        (M, 4, 2) px of the image; NaN where none were given.
    rotation, translation
        (M, 3, 3) and (M, 3); NaN where no pose was given.
    """

    image: Integers
    marker_id: Integers
    corners: Floats
    rotation: Floats
    translation: Floats


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
    faults = _Faults(plain(path, 300))
    text = _text(path, faults)
    faults.check()
    answers: list[_Answer] = []
    lines: dict[tuple[int, int], int] = {}
    angles = 3
    for line, row in _rows(text, faults):
        try:
            answer = _answer(row, images)
            if answer is None:
                continue
            key = answer.image, answer.marker_id
            if doubled == "refuse" and answer.marker_id != REJECTED and key in lines:
                what = "a pose without an ID" if key[1] == OF_TARGET else f"ID {key[1]}"
                raise ValueError(
                    f"image {row['image']} has {what} twice, here and in line {lines[key]}; delete "
                    "one, or pass --doubled nearest: the one nearest to the truth counts, as of "
                    "detectors that run here"
                )
            lines[key] = line
            angles = len(answer.angles)
            answers.append(answer)
        except ValueError as error:
            faults.add(line, str(error))
    faults.check()
    image, marker_id, corners, turns, position = (
        np.array([answer[k] for answer in answers]) for k in range(5)
    )
    turns = turns.reshape(-1, angles).astype(np.float64)
    known = np.isfinite(turns).all(axis=1)
    rotation = np.full((len(turns), 3, 3), np.nan)
    rotation[known] = (
        rotation_of_vector(turns[known]) if angles == 3
        else Rotation.from_quat(np.roll(turns[known], -1, axis=1)).as_matrix()
    )
    return Answers(
        image.astype(np.int64), marker_id.astype(np.int64),
        conventions.corners(corners.reshape(-1, 4, 2).astype(np.float64)),
        conventions.rotations(rotation), position.reshape(-1, 3).astype(np.float64),
    )


def _answer(row: Mapping[str, str], images: Mapping[str, int]) -> _Answer | None:
    """Return what a row says; None of an image that was searched in vain. ValueError: a fault."""
    if not row["image"]:
        raise ValueError("no image; expected the name of one")
    stem = re.sub(r"^.*[/\\]|\.[A-Za-z0-9]{1,5}$", "", row["image"])
    if stem not in images:
        raise ValueError(
            f"image {plain(row['image'])} is not among those that were exported"
            + ("; it is of another export" if _NAME.fullmatch(stem) else
               f"; expected a name such as {next(iter(images), '')}.png")
        )
    angle_names = QUATERNION if QUATERNION[0] in row else VECTOR
    if not any(row.get(name) for name in ("id", *CORNER_COLUMNS, *angle_names, *POSITION)):
        return None
    corners = _numbers(row, "corners", CORNER_COLUMNS)
    pose = _numbers(row, "pose", (*angle_names, *POSITION))
    angles, position = pose[:-3], pose[-3:]
    marker_id = OF_TARGET
    if row["id"] or math.isnan(position[0]) or not math.isnan(corners[0]):
        number = float(row["id"]) if re.fullmatch(NUMBER, row["id"]) else math.nan
        if not (number.is_integer() and REJECTED <= number < 2**31):
            raise ValueError(
                f"id {plain(row['id'])}: expected a whole number, or -1 for a candidate that was "
                "not decoded; none beside the pose of a board"
            )
        marker_id = int(number)
    if math.isnan(corners[0]) and math.isnan(position[0]):
        raise ValueError("an ID without corners and without a pose")
    if any(abs(number) > MAX_PX for number in corners):
        raise ValueError(f"corners beyond {MAX_PX:.0e} px; expected pixels of the image")
    if any(abs(number) > MAX_M for number in position):
        raise ValueError(f"a position beyond {MAX_M:.0e}; expected metres")
    if angle_names is QUATERNION and abs(math.hypot(*angles) - 1) > 0.01:
        raise ValueError(
            f"a quaternion of length {math.hypot(*angles):.3g}; expected w, x, y, z of length 1")
    if any(abs(number) > MAX_TURN for number in angles):
        raise ValueError(f"a rotation vector beyond {MAX_TURN:.0e}; expected radians")
    return _Answer(images[stem], marker_id, corners, angles, position)


def _numbers(row: Mapping[str, str], what: str, names: Sequence[str]) -> list[float]:
    """Return the numbers of columns; NaN if a row has none of them, or the file no column."""
    missing = [name for name in names if not row.get(name)]
    if len(missing) == len(names):
        return [math.nan] * len(names)
    if missing:
        raise ValueError(f"no {', '.join(missing)}; expected all numbers of the {what}, or none")
    for name in names:
        if not re.fullmatch(NUMBER, row[name]):
            raise ValueError(f"{name} = {plain(row[name])}: expected a finite number")
    return [float(row[name]) for name in names]
