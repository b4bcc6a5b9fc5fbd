"""Answers of other programs: their conventions, and their files."""

from __future__ import annotations

import csv
import functools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from sweep.errors import ArgumentError, PipelineError, StoreError
from sweep.messages import nearest, nearest_file, plain, refusal
from sweep.model.pose import rotation_of_vector
from sweep.plugins.recording import OF_TARGET, REJECTED
from sweep.typing import Floats, Integers

# --------------------------------------------------------------------------------------------------
# Conventions of other programs, and their detections and poses in OpenCV's conventions.

CORNERS = ("TL", "TR", "BR", "BL")

#: Directions of the marker as a viewer sees it upright -> in the marker frame of OpenCV's ArUco.
DIRECTIONS = {
    "right": (1, 0, 0), "left": (-1, 0, 0), "up": (0, 1, 0), "down": (0, -1, 0), "out": (0, 0, 1),
    "in": (0, 0, -1),
}


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
        """Return rotations (N, 3, 3) of our marker frame from rotations of the program's."""
        # Rows are their axes in our frame: a point in ours is axesᵀ times theirs.
        axes = np.array([DIRECTIONS[word] for word in self.frame], dtype=np.float64)
        return np.asarray(theirs @ axes)


def _words(text: str) -> list[str]:
    return [word for word in re.split(r"[\s,;]+", text) if word]


# --------------------------------------------------------------------------------------------------
# The CSV file of a program, whichever it is: its rows, and the faults of each.

CORNER_COLUMNS = tuple(f"{axis}{corner}" for corner in range(4) for axis in "xy")
VECTOR = ("rx", "ry", "rz")
QUATERNION = ("qw", "qx", "qy", "qz")
POSITION = ("tx", "ty", "tz")

#: Other names of columns.
ALIASES = {
    "file": "image", "filename": "image", "file_name": "image", "image_name": "image",
    "marker_id": "id", "markerid": "id", "tag_id": "id",
    **{f"rvec_{axis}": f"r{axis}" for axis in "xyz"},
    **{f"tvec_{axis}": f"t{axis}" for axis in "xyz"},
    **{f"{axis}_{corner}": f"{axis}{corner}" for corner in range(5) for axis in "xy"},
}

#: The header has most of the one that separates; with semicolons, commas are decimal points.
SEPARATORS = ",;\t"

#: Parts of an image's name that are left out: folders, and the suffix.
STEM = r"^.*[/\\]|\.[A-Za-z0-9]{1,5}$"

NUMBER = r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?"

MAX_PX = 1e7
MAX_M = 1e9
MAX_TURN = 1e6

MAX_TOLD_COLUMNS = 12

_NAME = re.compile(r"(\d{6,})-[0-9a-f]{8}")

#: Line of the file -> its first fault.
Faults = dict[int, str]


def _refused(source: str, faults: Faults) -> PipelineError:
    """Return the error that lists faults in the order of the file."""
    return refusal([
        f"{source}: line {line}: {plain(faults[line], 300)}" for line in sorted(faults)])


def _text(path: Path, source: str) -> str:
    """Return a file's text in any encoding that a byte order mark names, else UTF-8."""
    try:
        content = path.read_bytes()
    except (OSError, ValueError) as error:
        reason = f"{plain(getattr(error, 'strerror', None) or error)}{nearest_file(path)}"
        raise StoreError(f"{source}: cannot be read: {reason}") from None
    encoding = "utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise _refused(source, {line: "not UTF-8 text; expected CSV"}) from None
    if "\0" in text:
        line = text[: text.index("\0")].count("\n") + 1
        raise _refused(source, {line: "not text: a zero byte"})
    if text.lstrip()[:1] in ("{", "["):
        raise _refused(
            source, {1: "JSON; expected CSV with a header such as image,id,x0,y0,x1,y1,..."})
    return text


def _table(text: str, source: str, faults: Faults) -> pd.DataFrame:
    """Return the cells of a CSV text as text, by our names of columns and by line.

    Empty lines and lines that begin with ``#`` are left out. The header must have image and id, and
    all columns of the corners, of the pose, or of both.
    """
    lines = {
        number: line for number, line in enumerate(re.split(r"\r\n|\n|\r", text), 1)
        if line.strip() and not line.lstrip().startswith("#")
    }
    separator = max(SEPARATORS, key=next(iter(lines.values()), "").count)
    rows = {number: [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]
            for number, line in lines.items()}
    first = next(iter(rows), 0)
    written = rows.pop(first, ["image", "id", *CORNER_COLUMNS])
    header = [ALIASES.get(name.lower(), name.lower()) for name in written]
    if fault := _header_fault(header, written):
        raise _refused(source, {first: fault})
    faults |= {number: f"{len(row)} values; expected {len(header)}, as the header has"
               for number, row in rows.items() if len(row) != len(header)}
    table = pd.DataFrame.from_dict(
        {number: row for number, row in rows.items() if number not in faults},
        orient="index", columns=header, dtype=str)
    if separator == ";":
        numbers = table.columns != "image"
        table.loc[:, numbers] = table.loc[:, numbers].replace(",", ".", regex=True)
    return table


def _header_fault(header: Sequence[str], written: Sequence[str]) -> str:
    """Return the columns that a header lacks, or has twice; ``written`` has the file's spelling."""
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

@dataclass(slots=True)
class Answers:
    """Detections and poses of a program in exported images.

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
    source, faults = plain(path, 300), Faults()
    table = _table(_text(path, source), source, faults)

    def judge(wrong: pd.Series, words: Callable[[pd.Series], str]) -> None:
        """Note a fault of the lines that are wrong and have none yet."""
        for line in wrong.index[wrong]:
            faults.setdefault(line, words(table.loc[line]))

    def unknown_image(row: pd.Series) -> str:
        other = _NAME.fullmatch(re.sub(STEM, "", row["image"]))
        return f"image {plain(row['image'])} is not among those that were exported" + (
            "; it is of another export" if other else
            f"; expected a name such as {next(iter(images), '')}.png")

    def lacking(row: pd.Series, what: str, names: Sequence[str]) -> str:
        missing = ", ".join(name for name in names if not row.get(name))
        return f"no {missing}; expected all numbers of the {what}, or none"

    def no_number(row: pd.Series) -> str:
        name = next(name for name in cells if row.get(name) and np.isnan(numbers[name][row.name]))
        return f"{name} = {plain(row[name])}: expected a finite number"

    judge(table["image"] == "", lambda _: "no image; expected the name of one")
    stems = table["image"].str.replace(STEM, "", regex=True)
    judge(~stems.isin(images.keys()), unknown_image)
    turns = list(QUATERNION if QUATERNION[0] in table else VECTOR)
    corner_names, pose_names = list(CORNER_COLUMNS), [*turns, *POSITION]
    cells = table.reindex(columns=[*corner_names, *pose_names], fill_value="")
    # An image without an ID and without numbers was searched in vain.
    some = (table["id"] != "") | (cells != "").any(axis=1)
    table, cells, stems = table[some], cells[some], stems[some]
    for what, names in (("corners", corner_names), ("pose", pose_names)):
        empty = cells[names] == ""
        judge(empty.any(axis=1) & ~empty.all(axis=1),
              functools.partial(lacking, what=what, names=names))
    numbers = cells.apply(_numbers).astype(np.float64)
    judge(((cells != "") & numbers.isna()).any(axis=1), no_number)
    corners, angles, position = (
        numbers[names] for names in (corner_names, turns, list(POSITION)))
    has_corners, has_pose = (each.notna().all(axis=1) for each in (corners, position))
    of_target = (table["id"] == "") & has_pose & ~has_corners
    marker_id = _numbers(table["id"]).where(~of_target, OF_TARGET)
    judge(~of_target & ~((marker_id % 1 == 0) & marker_id.between(REJECTED, 2**31 - 1)),
          lambda row: f"id {plain(row['id'])}: expected a whole number, or -1 for a candidate that "
          "was not decoded; none beside the pose of a board")
    judge(~has_corners & ~has_pose, lambda _: "an ID without corners and without a pose")
    judge((corners.abs() > MAX_PX).any(axis=1),
          lambda _: f"corners beyond {MAX_PX:.0e} px; expected pixels of the image")
    judge((position.abs() > MAX_M).any(axis=1),
          lambda _: f"a position beyond {MAX_M:.0e}; expected metres")
    length = np.sqrt((angles**2).sum(axis=1))
    if len(turns) == 4:
        judge(has_pose & ((length - 1).abs() > 0.01), lambda row: (
            f"a quaternion of length {length[row.name]:.3g}; expected w, x, y, z of length 1"))
    judge((angles.abs() > MAX_TURN).any(axis=1),
          lambda _: f"a rotation vector beyond {MAX_TURN:.0e}; expected radians")
    if doubled == "refuse":
        first = pd.Series(table.index, table.index).groupby([stems, marker_id]).transform("first")
        judge((first != table.index) & (marker_id != REJECTED), lambda row: (
            f"image {row['image']} has "
            f"{'a pose without an ID' if of_target[row.name] else 'ID ' + row['id']} twice, here "
            f"and in line {first[row.name]}; delete one, or pass --doubled nearest: the one "
            "nearest to the truth counts, as of detectors that run here"))
    if faults:
        raise _refused(source, faults)
    rotation = np.full((len(table), 3, 3), np.nan)
    known = has_pose.to_numpy()
    given = angles.to_numpy()[known]
    rotation[known] = rotation_of_vector(given) if len(turns) == 3 else (
        Rotation.from_quat(np.roll(given, -1, axis=1)).as_matrix())
    return Answers(
        stems.map(images).to_numpy(np.int64), marker_id.to_numpy(np.int64),
        conventions.corners(corners.to_numpy().reshape(-1, 4, 2)),
        conventions.rotations(rotation), position.to_numpy())


def _numbers(texts: pd.Series) -> pd.Series:
    """Return the numbers of texts; NaN for others."""
    return texts.where(texts.str.fullmatch(NUMBER), "nan").astype(np.float64)
