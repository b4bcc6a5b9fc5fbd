"""Answers of other programs: their conventions, and their files."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

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
# The table of a CSV file, whatever program wrote it, and the faults of its rows.

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

MAX_FAULTS = 20
"""Faults that are listed; the others are counted."""

MAX_TOLD_COLUMNS = 12


@dataclass(slots=True)
class _Table:
    """The rows of a file that have no fault so far, as texts, and the faults.

    Attributes
    ----------
    source
        What the lines of faults begin with.
    rows
        Columns by our names; the index is the line in the file.
    faults
        Line of the file and text; of each check no more than are listed.
    count
        All faults.
    """

    source: str
    rows: pd.DataFrame = field(default_factory=pd.DataFrame)
    faults: list[tuple[int, str]] = field(default_factory=list)
    count: int = 0

    def fault(self, line: int, text: str) -> None:
        """Note a fault of a line."""
        self.count += 1
        self.faults.append((line, text))

    def refuse(self, wrong: pd.Series, say: Callable[[pd.Series], str]) -> None:
        """Note a fault of each row that is ``wrong``, and leave it out from now on."""
        chosen = wrong.to_numpy(dtype=bool)
        for line, row in self.rows.loc[chosen].head(MAX_FAULTS).iterrows():
            self.faults.append((int(str(line)), say(row)))
        self.count += int(chosen.sum())
        self.rows = self.rows.loc[~chosen]

    def check(self) -> None:
        """Raise PipelineError if there are faults: a line each, in the order of the file."""
        told = [
            f"{self.source}: line {line}: {plain(text, 300)}"
            for line, text in sorted(self.faults, key=lambda fault: fault[0])[:MAX_FAULTS]
        ]
        if self.count > len(told):
            told.append(f"... and {self.count - len(told):,} faults more")
        if told:
            raise PipelineError(told)


def _text(path: Path, table: _Table) -> str:
    """Return a file's text in any encoding that a byte order mark names, else UTF-8."""
    try:
        content = path.read_bytes()
    except (OSError, ValueError) as error:
        reason = f"{plain(getattr(error, 'strerror', None) or error)}{nearest_file(path)}"
        raise StoreError(f"{table.source}: cannot be read: {reason}") from None
    encoding = "utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError as error:
        table.fault(content[: error.start].count(b"\n") + 1, "not UTF-8 text; expected CSV")
        return ""
    if "\0" in text:
        table.fault(text[: text.index("\0")].count("\n") + 1, "not text: a zero byte")
    elif text.lstrip()[:1] in ("{", "["):
        table.fault(1, "JSON; expected CSV with a header such as image,id,x0,y0,x1,y1,...")
    return text


def _read_rows(text: str, table: _Table) -> None:
    """Put the rows of a CSV text into a table; lines that begin with ``#`` are left out.

    The header must have image and id, and all columns of the corners, of the pose, or of both.
    """
    numbered = [
        (number, line) for number, line in enumerate(re.split(r"\r\n|\n|\r", text), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not numbered:
        table.rows = pd.DataFrame(columns=["image", "id", *CORNER_COLUMNS], dtype=object)
        return
    separator = max(SEPARATORS, key=numbered[0][1].count)
    (first, written), *rows = [
        (number, [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])])
        for number, line in numbered
    ]
    header = [ALIASES.get(name.lower(), name.lower()) for name in written]
    _check_header(table, first, header, written)
    table.check()
    for number, row in rows:
        if len(row) != len(header):
            table.fault(number, f"{len(row)} values; expected {len(header)}, as the header has")
    complete = [(number, row) for number, row in rows if len(row) == len(header)]
    table.rows = pd.DataFrame(
        [row for _, row in complete], [number for number, _ in complete], header, dtype=object)
    if separator == ";":
        numbers = table.rows.columns.intersection(
            [*CORNER_COLUMNS, *VECTOR, *QUATERNION, *POSITION])
        table.rows[numbers] = table.rows[numbers].map(lambda cell: cell.replace(",", "."))


def _check_header(
    table: _Table, line: int, header: Sequence[str], written: Sequence[str]
) -> None:
    """Note what a header lacks, or has twice; ``written`` are the names as the file has them."""
    columns = set(header)
    repeated = next((name for name in header if name and header.count(name) > 1), None)
    if repeated is not None:
        table.fault(line, f"the column {repeated} is there twice")
    elif columns & {"x4", "y4"}:
        table.fault(line, "columns of more than four corners; expected x0, y0 to x3, y3")
    else:
        angles = _angles(columns)
        has_pose = bool(columns & {*angles, *POSITION})
        has_corners = bool(columns & {*CORNER_COLUMNS})
        expected = [
            "image", "id", *(CORNER_COLUMNS if has_corners or not has_pose else ()),
            *((*angles, *POSITION) if has_pose else ()),
        ]
        if missing := [name for name in expected if name not in columns]:
            listed = ", ".join(missing[:MAX_TOLD_COLUMNS])
            unknown = [name for name, ours in zip(written, header, strict=True)
                       if ours not in expected]
            hint = nearest(unknown[0], missing) if unknown else ""
            poses = "" if has_pose or has_corners else ", or rx, ry, rz, tx, ty, tz of poses"
            found = ", ".join(plain(name, 40) for name in written[:MAX_TOLD_COLUMNS])
            table.fault(line, f"no column {listed}{poses}; the header has {found}{hint}")


def _angles(columns: set[str]) -> tuple[str, ...]:
    """Return the names of the columns of the rotation, as a quaternion if there is part of one."""
    return QUATERNION if columns & {*QUATERNION} else VECTOR


# --------------------------------------------------------------------------------------------------
# Answers of other programs: detections and poses, read with all their faults told.

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
    table = _Table(plain(path, 300))
    text = _text(path, table)
    table.check()
    _read_rows(text, table)
    _check_images(table, images)
    angles = _angles({*table.rows})
    numbers = [*table.rows.columns.intersection([*CORNER_COLUMNS, *angles, *POSITION])]
    # A row with nothing but the image: it was searched, and nothing was found.
    table.rows = table.rows.loc[(table.rows[["id", *numbers]] != "").any(axis=1)]
    table.refuse(
        table.rows["id"].map(lambda text: not _is_marker_id(text)),
        lambda row: f"id {plain(row['id'])}: expected a whole number, or -1 for a candidate that "
        "was not decoded",
    )
    corners = _numbers(table, "corners", CORNER_COLUMNS)
    table.refuse(
        (corners.abs() > MAX_PX).any(axis=1),
        lambda _: f"corners beyond {MAX_PX:.0e} px; expected pixels of the image",
    )
    pose = _numbers(table, "pose", (*angles, *POSITION))
    table.refuse(
        (pose[[*POSITION]].abs() > MAX_M).any(axis=1),
        lambda _: f"a position beyond {MAX_M:.0e}; expected metres",
    )
    rotation = _rotations(table, pose[[*angles]])
    corners = corners.loc[table.rows.index]
    position = pose.loc[table.rows.index, [*POSITION]]
    table.refuse(
        corners.isna().any(axis=1) & position.isna().any(axis=1),
        lambda _: "an ID without corners and without a pose",
    )
    ids = table.rows["id"].astype(np.float64).astype(np.int64)
    if doubled == "refuse":
        _refuse_doubled(table, ids)
    table.check()
    count = len(table.rows)
    return Answers(
        table.rows["index"].to_numpy(np.int64), ids.to_numpy(),
        conventions.corners(corners.to_numpy(np.float64).reshape(count, 4, 2)),
        conventions.rotations(rotation), position.to_numpy(np.float64),
    )


def _check_images(table: _Table, images: Mapping[str, int]) -> None:
    """Put the index of each row's image into the column ``index``, and refuse unknown ones."""
    table.refuse(table.rows["image"] == "", lambda _: "no image; expected the name of one")
    stems = table.rows["image"].str.replace(
        r"^.*[/\\]|\.[A-Za-z0-9]{1,5}$", "", regex=True)
    table.rows = table.rows.assign(stem=stems, index=stems.map(images.get))
    table.refuse(
        table.rows["index"].isna(),
        lambda row: f"image {plain(row['image'])} is not among those that were exported"
        + ("; it is of another export" if _NAME.fullmatch(row["stem"]) else
           f"; expected a name such as {next(iter(images), '')}.png"),
    )


def _is_marker_id(text: str) -> bool:
    if not re.fullmatch(NUMBER, text):
        return False
    number = float(text)
    return number.is_integer() and REJECTED <= number < 2**31


def _numbers(table: _Table, what: str, names: Sequence[str]) -> pd.DataFrame:
    """Return the numbers of columns, NaN where a row has none of them, or the file no column.

    Rows with some of them, or with what is no finite number, are refused.
    """
    if not {*names} <= {*table.rows}:
        return pd.DataFrame(np.nan, table.rows.index, [*names])
    names = [*names]
    empty = table.rows[names] == ""
    table.refuse(
        empty.any(axis=1) & ~empty.all(axis=1),
        lambda row: f"no {', '.join(name for name in names if not row[name])}; expected all "
        f"numbers of the {what}, or none",
    )

    def wrong(row: pd.Series) -> str:
        return next((name for name in names
                     if row[name] and not re.fullmatch(NUMBER, row[name])), "")

    texts = table.rows[names]
    is_number = texts.map(lambda cell: not cell or bool(re.fullmatch(NUMBER, cell)))
    table.refuse(
        ~is_number.all(axis=1),
        lambda row: f"{wrong(row)} = {plain(row[wrong(row)])}: expected a finite number",
    )
    return table.rows[names].replace("", "nan").astype(np.float64)


def _rotations(table: _Table, angles: pd.DataFrame) -> Floats:
    """Return the rotations (n, 3, 3) of rotation vectors or quaternions; NaN where there are none.

    Rows with what is none of them are refused.
    """
    given = angles.loc[table.rows.index]
    is_quaternion = tuple(given) == QUATERNION
    if is_quaternion:
        length = np.sqrt((given ** 2).sum(axis=1, skipna=False))
        table.refuse(
            (length - 1).abs() > 0.01,
            lambda row: f"a quaternion of length {length[row.name]:.3g}; expected w, x, y, z of "
            "length 1",
        )
        given = given.loc[table.rows.index]
    table.refuse(
        (given.abs() > 1e6).any(axis=1), lambda _: "a rotation vector beyond 1e6; expected radians")
    numbers = given.loc[table.rows.index].to_numpy(np.float64)
    rotations = np.full((len(numbers), 3, 3), np.nan)
    known = np.isfinite(numbers).all(axis=1)
    if is_quaternion:
        w, xyz = numbers[known, :1], numbers[known, 1:]
        rotations[known] = Rotation.from_quat(np.hstack([xyz, w])).as_matrix()
    else:
        rotations[known] = rotation_of_vector(numbers[known])
    return rotations


def _refuse_doubled(table: _Table, ids: pd.Series) -> None:
    """Refuse rows whose image has the same ID in an earlier row."""
    decoded = table.rows.assign(number=ids)[ids != REJECTED]
    first = decoded.index.to_series().groupby([decoded["index"], decoded["number"]]).transform(
        "first")
    again = pd.Series(False, table.rows.index)
    again[first.index[first != first.index]] = True
    table.refuse(
        again,
        lambda row: f"image {row['image']} has ID {ids[row.name]} twice, here and in line "
        f"{first[row.name]}; delete one, or pass --doubled nearest: the one nearest to the truth "
        "counts, as of detectors that run here",
    )
