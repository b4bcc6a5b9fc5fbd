"""Answers in a CSV file: a row a marker, the columns in any order."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from sweep.exchange.answer_reading import (
    ALIASES,
    CORNERS,
    MAX_TOLD_COLUMNS,
    NUMBER,
    POSITION,
    QUATERNION,
    VECTOR,
    Reading,
    finish,
)
from sweep.exchange.csv_rows import csv_rows
from sweep.messages import nearest, plain


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
    wanted = [*(CORNERS if has_corners else ()), *angles, *(POSITION if angles else ())]
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
        complete = _numbers(reading, line, row, answer, "corners", CORNERS) \
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
    has_corners = bool(columns & {*CORNERS})
    expected = ["image", "id"]
    if has_corners or not has_pose:
        expected += CORNERS
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
