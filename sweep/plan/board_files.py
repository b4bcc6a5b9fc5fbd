"""Files that describe a board, `BOARD.toml`: all faults of one are found at once."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sweep.declaration import plain_types
from sweep.messages import nearest, plain, refusal, shown
from sweep.model.board import Board
from sweep.model.board_kinds import KINDS
from sweep.model.image_file import read_regular
from sweep.model.marker_table import BoardMarker
from sweep.plan.parameters import Parameter, Stage
from sweep.plan.toml_text import MAX_BYTES, read_document

LISTS = {"ids": "a list of whole numbers from 0 on", "markers": "tables [[markers]]"}
"""Keys that hold lists, and what is expected of them."""


def read_board(path: str | Path) -> Board:
    """Return the board that a TOML file describes.

    Raises
    ------
    PipelineError
        One line for each fault: the file, the key, its value, and what was expected.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "board.toml"
    ...     _ = path.write_text('''kind = "grid"
    ... dictionary = "DICT_4X4_50"
    ... rows = 2
    ... columns = 3
    ... marker_m = 0.04
    ... gap_m = 0.01''')
    ...     read_board(path).marker_ids
    (0, 1, 2, 3, 4, 5)
    """
    return board_of(board_document(path), plain(path))


def board_document(path: str | Path) -> dict[str, Any]:
    """Return the tables and values of a board's file, unchecked; as :func:`read_board`."""
    source = plain(path)
    try:
        content = read_regular(Path(path), MAX_BYTES)
        return read_document(content.decode())
    except OSError as error:
        raise refusal([f"{source}: cannot be read: {error.strerror}"]) from None
    except UnicodeDecodeError:
        raise refusal([f"{source}: expected a TOML file: not UTF-8"]) from None
    except ValueError as error:
        raise refusal([f"{source}: {error}"]) from None


def board_of(document: Mapping[str, Any], source: str) -> Board:
    """Return the board of a document; as :func:`read_board`, lines beginning with ``source``."""
    faults: list[str] = []
    kind = document.get("kind")
    if not isinstance(kind, str) or kind not in KINDS:
        given = f"kind = {shown(kind)}" if "kind" in document else "kind"
        hint = nearest(kind, list(KINDS)) if isinstance(kind, str) else ""
        raise refusal([f"{source}: {given}: expected one of {', '.join(KINDS)}{hint}"])
    declaring = KINDS[kind]
    values = _checked(
        declaring, {key: value for key, value in document.items() if key != "kind"},
        source, "", faults, f"a board of kind {kind}",
    )
    if faults:
        raise refusal(faults)
    made = declaring(**values)
    broken = made.faults()
    if broken:
        raise refusal([
            f"{source}: {key} = {shown(value)}: expected {expected}"
            for key, value, expected in broken
        ])
    board = made.board()
    if not board.is_flat:
        raise refusal([
            f"{source}: markers: expected one plane, for photographs: no z_m, no tilt_deg"
        ])
    return board


def _checked(
    declaring: type, table: Mapping[str, Any], source: str, path: str, faults: list[str],
    owner: str,
) -> dict[str, Any]:
    """Return the values of a table's keys that a dataclass declares; note the faults."""
    declared = {
        field.name: _parameter(declaring, field) for field in dataclasses.fields(declaring)
    }
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key not in declared:
            faults.append(
                f"{source}: {plain(path + key)}: unknown; expected a key of {owner}: "
                f"{', '.join(declared)}{nearest(key, list(declared))}"
            )
            continue
        try:
            if key == "markers":
                values[key] = _table_of_markers(value, source, faults)
            elif key == "ids":
                values[key] = _whole_numbers(value)
            else:
                values[key] = declared[key].check(value)
        except ValueError as error:
            faults.append(f"{source}: {path}{key} = {shown(value)}: expected {error}")
    for key, each in declared.items():
        if each.default is dataclasses.MISSING and key not in table:
            faults.append(
                f"{source}: {path}{key}: missing; expected {LISTS.get(key) or each.expected()}: "
                f"{each.declaration.meaning}"
            )
    return values


def _parameter(declaring: type, field: dataclasses.Field[Any]) -> Parameter:
    hint = typing.get_type_hints(declaring)[field.name]
    return Parameter(
        field.name, "board", Stage.scene, plain_types(hint), field.default,
        field.metadata["declaration"],
    )


def _whole_numbers(value: Any) -> tuple[int, ...]:
    if not isinstance(value, list) or not all(
        isinstance(item, int) and not isinstance(item, bool) and 0 <= item <= 10**6
        for item in value
    ):
        raise ValueError(LISTS["ids"])
    return tuple(value)


def _table_of_markers(
    value: Any, source: str, faults: list[str]
) -> tuple[BoardMarker, ...]:
    if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
        raise ValueError(LISTS["markers"])
    markers = []
    for number, table in enumerate(value):
        before = len(faults)
        values = _checked(
            BoardMarker, table, source, f"markers[{number}].", faults, "a marker"
        )
        if len(faults) == before:
            markers.append(BoardMarker(**values))
    return tuple(markers)
