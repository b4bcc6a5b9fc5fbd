"""Answers of other programs: their conventions, and their files."""

from __future__ import annotations

import csv
import itertools
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from sweep.errors import ArgumentError, PipelineError, StoreError
from sweep.experiment.document import file_text
from sweep.messages import nearest, plain
from sweep.model.pose import rotation_of_vector
from sweep.plugins.loading import OF_TARGET, REJECTED
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
    >>> Conventions(0.5, "tr TL BL BR", "right,down,in").corners
    ['TR', 'TL', 'BL', 'BR']
    """

    pixel_center: float = 0.0
    corner_order: str = " ".join(CORNERS)
    frame: str = "right up out"

    def __post_init__(self) -> None:
        """Refuse conventions that cannot be: ArgumentError."""
        if not -1 <= self.pixel_center <= 1:
            raise ArgumentError("pixel_center", self.pixel_center, "expected 0 or 0.5")
        if sorted(self.corners) != sorted(CORNERS):
            raise ArgumentError(
                "corner_order", repr(self.corner_order),
                "expected TL, TR, BR and BL, each once, in the program's order, as in "
                '"TR TL BL BR"',
            )
        if self.axes.shape != (3, 3) or round(float(np.linalg.det(self.axes))) != 1:
            raise ArgumentError(
                "frame", repr(self.frame), "expected the directions of x, y and z among right, "
                'left, up, down, out, in, of a right-handed frame, as in "right down in"',
            )

    @property
    def corners(self) -> list[str]:
        """The names of the program's corners."""
        return re.findall("[A-Z]+", self.corner_order.upper())

    @property
    def axes(self) -> Floats:
        """(3, 3) the axes of the program's marker frame, a row each, in ours."""
        words = re.findall("[a-z]+", self.frame.lower())
        return np.array([DIRECTIONS.get(word, (0, 0, 0)) for word in words], dtype=np.float64)


# --------------------------------------------------------------------------------------------------
# The CSV file of a program, whichever it is: a table of texts, by our names of columns.

CORNER_COLUMNS = tuple(f"{axis}{corner}" for corner in range(4) for axis in "xy")
VECTOR = ("rx", "ry", "rz")
QUATERNION = ("qw", "qx", "qy", "qz")
POSITION = ("tx", "ty", "tz")

#: Other names of columns.
ALIASES = {
    "file": "image", "filename": "image", "file_name": "image", "image_name": "image",
    "marker_id": "id", "markerid": "id", "tag_id": "id",
    **{f"{part}vec_{axis}": f"{part}{axis}" for part in "rt" for axis in "xyz"},
    **{f"{axis}_{corner}": f"{axis}{corner}" for corner in range(4) for axis in "xy"},
}

#: The header has most of the one that separates; with semicolons, commas are decimal points.
SEPARATORS = ",;\t"

#: Parts of an image's name that are left out: folders, and the suffix.
STEM = r"^.*[/\\]|\.[A-Za-z0-9]{1,5}$"

NUMBER = r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?"

#: Largest number of pixels, metres or radians, and largest ID.
MOST = 1e6

#: The largest file of answers.
MAX_BYTES = 10**9


def _table(text: str, source: str, faults: dict[int, str]) -> pd.DataFrame:
    """Return the cells of a CSV text as text, by our names of columns and by line.

    ``faults`` gets the lines whose number of values is wrong, or of which one is longer than the
    csv module takes. Empty lines and lines that begin with ``#`` are left out. The header must have
    image and id, and all columns of the corners, of the pose, or of both; further columns are left
    out.

    Raises
    ------
    PipelineError
        If the header is at fault.
    """
    lines = {number: line for number, line in enumerate(re.split(r"\r\n|\n|\r", text), 1)
             if line.strip() and not line.lstrip().startswith("#")}
    first, rows = next(iter(lines), 0), dict[int, list[str]]()
    separator = max(SEPARATORS, key=lines.get(first, "").count)
    for number, line in lines.items():
        try:
            rows[number] = [*map(str.strip, next(csv.reader([line], delimiter=separator)))]
        except csv.Error as error:  # a value that is too long
            faults[number] = f"{error}; expected shorter values; leave the column out"
    written = rows.pop(first, ["image", "id", *CORNER_COLUMNS])
    header = [ALIASES.get(name.lower(), name.lower()) for name in written]
    turns = QUATERNION if QUATERNION[0] in header else VECTOR
    groups = [group for group in (CORNER_COLUMNS, (*turns, *POSITION)) if {*group} & {*header}]
    expected = ["image", "id", *itertools.chain.from_iterable(groups or [CORNER_COLUMNS])]
    missing = [name for name in expected if name not in header]
    if text.lstrip()[:1] in ("{", "["):
        fault = "JSON; expected CSV with a header such as image,id,x0,y0,x1,y1,..."
    elif missing:
        unknown = [name for name, ours in zip(written, header, strict=True) if ours not in expected]
        hint = nearest(unknown[0], missing) if unknown else ""
        poses = "" if groups else ", or rx, ry, rz, tx, ty, tz of poses"
        fault = (
            f"no column {', '.join(missing)}{poses}; the header has, between commas, semicolons or "
            f"tabs, {', '.join(plain(name, 40) for name in written)}{hint}")
    elif more := [name for name in written if re.fullmatch("[xy]_?[4-9]", name.lower())]:
        fault = f"the column {plain(more[0])}: expected four corners, x0, y0 to x3, y3"
    elif repeated := [name for name in expected if header.count(name) > 1]:
        fault = f"the column {repeated[0]} is there twice"
    else:
        fault = faults.get(first, "")
    if fault:
        raise PipelineError([f"{source}: line {first}: {plain(fault, 300)}"])
    faults |= {number: f"{len(row)} values; expected {len(header)}, as the header has"
               for number, row in rows.items() if len(row) != len(header)}
    table = pd.DataFrame.from_dict(
        {number: row for number, row in rows.items() if number not in faults},
        orient="index", columns=header, dtype=str)[expected]
    if separator == ";":
        table.iloc[:, 1:] = table.iloc[:, 1:].replace(",", ".", regex=True)
    return table.reindex(
        columns=["image", "id", *CORNER_COLUMNS, *turns, *POSITION], fill_value="")


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
        (M,) IDs; :data:`sweep.plugins.loading.REJECTED` for candidates that were not decoded,
        :data:`sweep.plugins.loading.OF_TARGET` for poses of a board, or of any target, as such.
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
    ArgumentError
        If ``doubled`` is another word.
    PipelineError
        One line for each fault, with the line of the file.
    StoreError
        If the file cannot be read.
    """
    if doubled not in ("refuse", "nearest"):
        raise ArgumentError("doubled", doubled, "expected refuse or nearest")
    source, faults = plain(path, 300), dict[int, str]()
    try:
        text = file_text(path, MAX_BYTES)
    except ValueError as error:
        raise StoreError(f"{source}: {error}") from None
    table = _table(text, source, faults)

    def judge(wrong: pd.Series, words: str, **more: pd.Series) -> None:
        """Note a fault, in words about a line's values, of lines that are wrong and had none."""
        for line in wrong.index[wrong]:
            values = table.loc[line].map(plain).to_dict()
            faults.setdefault(line, words.format_map(
                values | {name: each[line] for name, each in more.items()}))

    stems = table["image"].str.replace(STEM, "", regex=True)
    judge(~stems.isin(images.keys()), "image {image} is not among the images; "
          "expected a name such as {known}", known=pd.Series(next(iter(images), ""), stems.index))
    # An image without an ID and without numbers was searched in vain.
    table = table[(table.iloc[:, 1:] != "").any(axis=1)]
    stems = stems[table.index]
    numbers = table.iloc[:, 2:].apply(_numbers).astype(np.float64)
    corners, poses = numbers.iloc[:, :8], numbers.iloc[:, 8:]
    for group in (corners, poses):
        texts, column = table[group.columns], group.isna().to_numpy().argmax(axis=1)
        judge(
            group.isna().any(axis=1) & (texts != "").any(axis=1),
            f"{{name}} = {{value}}: expected a finite number of at most {MOST:g}, as all of "
            "corners or pose have, or none",
            name=pd.Series(group.columns[column], group.index),
            value=pd.Series(texts.to_numpy()[np.arange(len(texts)), column], group.index).replace(
                "", "nothing"))
    has_corners, has_pose = (group.notna().all(axis=1) for group in (corners, poses))
    of_target = (table["id"] == "") & has_pose & ~has_corners
    marker_id = _numbers(table["id"]).where(~of_target, OF_TARGET)
    judge(~of_target & ~((marker_id % 1 == 0) & (marker_id >= REJECTED)),
          f"id {{id}}: expected a whole number up to {MOST:g}, or -1 for a candidate that was not "
          "decoded; none beside the pose of a board")
    judge(~has_corners & ~has_pose, "an ID without corners and without a pose")
    turns, position = poses.iloc[:, :-3], poses.iloc[:, -3:]
    length = (turns**2).sum(axis=1) ** 0.5
    if turns.shape[1] == 4:
        judge(has_pose & ((length - 1).abs() > 0.01),
              "a quaternion of length {length:.3g}; expected w, x, y, z of length 1", length=length)
    if doubled == "refuse":
        first = pd.Series(table.index, table.index).groupby([stems, marker_id]).transform("first")
        judge((first != table.index) & (marker_id != REJECTED),
              "image {image} has {what} twice, here and in line {first}; delete one, or pass "
              "--doubled nearest: the one nearest to the truth counts, as of detectors that run "
              "here", first=first, what=("ID " + table["id"]).where(
                  ~of_target, "a pose without an ID"))
    if faults:
        raise PipelineError([
            f"{source}: line {line}: {plain(faults[line], 300)}" for line in sorted(faults)])
    rotation = np.full((len(table), 3, 3), np.nan)
    known = has_pose.to_numpy()
    given = turns.to_numpy()[known]
    rotation[known] = rotation_of_vector(given) if given.shape[1] == 3 else (
        Rotation.from_quat(np.roll(given, -1, axis=1)).as_matrix())
    order = [conventions.corners.index(name) for name in CORNERS]
    pixels = corners.to_numpy().reshape(-1, 4, 2)[:, order] - conventions.pixel_center
    # A point in our frame is the transposed axes times it in theirs.
    return Answers(
        stems.map(images).to_numpy(np.int64), marker_id.to_numpy(np.int64), pixels,
        rotation @ conventions.axes, position.to_numpy())


def _numbers(texts: pd.Series) -> pd.Series:
    """Return the numbers of texts; NaN for others, and for numbers that are too large."""
    found = texts.where(texts.str.fullmatch(NUMBER), "nan").astype(np.float64)
    return found.where(found.abs() <= MOST)
