"""Files that describe a board, `BOARD.toml`: all faults of one are found at once."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sweep.declaration import check_table, declared_fields
from sweep.messages import nearest, plain, refusal, shown
from sweep.model.board import Board
from sweep.model.board_kinds import KINDS
from sweep.model.image_file import read_regular
from sweep.plan.toml_text import MAX_BYTES, read_document


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
    kind = document.get("kind")
    if not isinstance(kind, str) or kind not in KINDS:
        given = f"kind = {shown(kind)}" if "kind" in document else "kind"
        hint = nearest(kind, list(KINDS)) if isinstance(kind, str) else ""
        raise refusal([f"{source}: {given}: expected one of {', '.join(KINDS)}{hint}"])
    declaring = KINDS[kind]
    values, faults = check_table(
        declared_fields(declaring),
        {key: value for key, value in document.items() if key != "kind"},
        f"a board of kind {kind}",
    )
    if faults:
        raise refusal([f"{source}: {fault}" for fault in faults])
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
