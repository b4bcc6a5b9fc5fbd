"""Answers of other programs: files of detections and poses, read with all their faults told."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sweep.errors import StoreError
from sweep.exchange.answer_reading import NUMBER, Reading
from sweep.exchange.conventions import Conventions
from sweep.exchange.csv_answers import csv_answers
from sweep.exchange.json_answers import json_answers
from sweep.messages import plain
from sweep.plugins.recording import REJECTED
from sweep.typing import Floats, Integers

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
    """Return the answers of a CSV or JSON Lines file, in our conventions.

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
    rows = json_answers(text, reading) if _is_json(path, text) else csv_answers(text, reading)
    image: list[int] = []
    ids: list[int] = []
    corners: list[Any] = []
    rotation: list[Any] = []
    translation: list[Any] = []
    lines: list[int] = []
    named: set[int] = set()
    first: dict[tuple[int, int], int] = {}
    no_corners, no_rotation = np.full((4, 2), np.nan), np.full((3, 3), np.nan)
    for line, row in rows:
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
        reason = getattr(error, "strerror", None) or error
        raise StoreError(f"{reading.source}: cannot be read: {plain(reason)}") from None
    encoding = "utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError as error:
        reading.fault(
            content[: error.start].count(b"\n") + 1, "not UTF-8 text; expected CSV or JSON Lines"
        )
        return ""
    if "\0" in text:
        reading.fault(text[: text.index("\0")].count("\n") + 1, "not text: a zero byte")
    return text


def _is_json(path: Path, text: str) -> bool:
    start = text.lstrip()[:1]
    return start in ("{", "[") or (not start and path.suffix in (".json", ".jsonl", ".ndjson"))


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
