"""Files that describe a board, and rules of pipelines that show boards."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sweep.declaration import check_table, declared_fields
from sweep.experiment.experiment import shows_boards
from sweep.experiment.parameters import PHOTOGRAPHS
from sweep.experiment.reader import Reading
from sweep.experiment.toml_text import MAX_BYTES, read_document
from sweep.measure.estimators import SOLVERS
from sweep.messages import nearest, plain, refusal, shown
from sweep.model.board import Board
from sweep.model.board_kinds import (
    ARRANGING,
    KINDS,
    NEEDED,
    arranged_board,
    arrangement_faults,
    is_solid,
    used_by,
)
from sweep.model.image_file import read_regular
from sweep.model.renderers import MAX_BITMAP_PX, MAX_BITMAP_SIDE, bitmap_shape
from sweep.model.scene import RENDERERS, is_renderer
from sweep.plugins.recording import is_recording

# --------------------------------------------------------------------------------------------------
# Files that describe a board, `BOARD.toml`: all faults of one are found at once.

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


# --------------------------------------------------------------------------------------------------
# Rules of pipelines that show boards.

WARP = "warp"

MAX_BOARDS = 10_000
"""The most boards of a grid: all are checked before anything is computed."""


def boards_can_be_printed(reading: Reading) -> None:
    """Demand what each kind of board needs, and boards whose parts do not overlap."""
    kinds = reading.values_of("kind")
    given = [name for name, parameter in reading.parameters.items()
             if parameter.section == "board" and name in reading.given and name != "kind"]
    needed = [name for kind in kinds for name in NEEDED[kind] if name not in reading.given]
    for name in dict.fromkeys(needed):
        kind = next(kind for kind in kinds if name in NEEDED[kind])
        reading.faults.append(
            f"{reading.source}: board.{name}: missing; kind = {shown(kind)} needs it: "
            f"{reading.parameters[name].declaration.meaning}"
        )
    used = {name for kind in kinds for name in used_by(kind)}
    for name in given if kinds else ():
        if name not in used:
            users = " or ".join(kind for kind in NEEDED if name in used_by(kind))
            reading.refuse(name, f"kind = {users}, which uses it; kind = "
                           f"{' or '.join(dict.fromkeys(kinds))} does not: delete it")
    if not shows_boards(reading):
        return
    if needed or not all(reading.values_of(name) for name in ARRANGING):
        return
    if "marker_id" in reading.given and any(reading.values_of("ids")):
        reading.refuse("ids", "ids, or marker_id of the first; not both")
        return
    for name in ("ids", "markers", "distractors"):
        if reading.axis_of(name) is not None:
            reading.fault(f"axes.{name}", "...", f"{name} under [board]: they cannot be an axis")
            return
    count = math.prod(
        len(axis) for axis in reading.axes.values() if not set(axis.columns).isdisjoint(ARRANGING))
    if count > MAX_BOARDS:
        reading.note("axes", f"{count:,} different boards: expected at most {MAX_BOARDS:,}")
        return
    seen = set()
    for values in reading.arrangements():
        for name, value, expected in arrangement_faults(values):
            if (name, expected) not in seen:
                seen.add((name, expected))
                section = reading.parameters[name.partition("[")[0]].section
                reading.fault(f"{section}.{name}", value, expected)
        if len(seen) > MAX_FAULTS:
            return
    if not seen and WARP in reading.values_of("renderer"):
        _bitmaps_fit(reading)


def _bitmaps_fit(reading: Reading) -> None:
    """Demand boards of which ``warp`` can draw bitmaps."""
    for values in reading.arrangements():
        height, width = bitmap_shape(arranged_board(*values))
        if max(height, width) > MAX_BITMAP_SIDE or height * width > MAX_BITMAP_PX:
            reading.fault(
                "scene.renderer", WARP,
                f"another renderer: warp draws bitmaps of at most {MAX_BITMAP_PX:,} pixels, and a "
                f"side of {MAX_BITMAP_SIDE:,}; this board and what is beside it would take "
                f"{width:,} x {height:,}",
            )
            return


MAX_FAULTS = 10
"""Faults of boards after which no other board is checked."""


def boards_are_searched_and_solved(reading: Reading) -> None:
    """Demand detectors, solvers and renderers that can do boards."""
    kinds = reading.values_of("kind")
    on_boards = ("points", "refine", "refineDetectedMarkers", "minMarkers")
    plugged = [each.name for each in reading.plugins if each.of_boards]
    if not shows_boards(reading):
        reading.refuse_values("solver", "a solver of single markers, or a board: give kind under "
                              "[board]", lambda name: name in plugged)
        for name in reading.given.intersection(on_boards):
            reading.refuse(name, "a board: give kind under [board]")
        return
    if PHOTOGRAPHS in reading.given:
        reading.refuse("kind", "no board beside photographs, whose board `sweep photos` knows; "
                       "delete it")
    reading.refuse_values(
        "renderer", f"{RENDERERS}, for boards", lambda name: not is_renderer(name))
    if any(map(is_recording, reading.values_of("detector"))):
        for name, value, expected in (
            ("points", "chessboard",
             "markers beside recorded detections, which have no corners of chessboards"),
            ("refineDetectedMarkers", True,
             "false beside recorded detections: no image is searched"),
        ):
            reading.refuse_values(name, expected, lambda given, value=value: given == value)
    if "solver" not in reading.given:
        reading.faults.append(
            f"{reading.source}: estimator.solver: missing; a board needs one of "
            f"{', '.join(name for name, each in SOLVERS.items() if each.of_boards)}"
        )
        return
    for name, all_pixels in (("points", "markers"), ("refine", "none")):
        for chosen, solvers in reading.together(name, "solver"):
            others = [each for each in chosen if each != all_pixels]
            own = next((each for each in solvers if each in ("photometric", *plugged)), None)
            if others and own is not None:
                reading.fault(
                    f"estimator.{name}", others[0],
                    f"{all_pixels} beside solver = {own}, which chooses by itself"
                    if own in plugged else
                    f"{all_pixels} beside solver = photometric, which takes all pixels",
                )
                break
    wrong = set()
    for all_points, solvers in reading.together("points", "solver"):
        for points, solver in itertools.product(all_points, solvers):
            one = points == "largest_marker"
            known = SOLVERS.get(solver)
            if solver not in plugged and (
                known is None or not (known.of_boards or (one and known.corners_alone))
            ):
                wrong.add(solver)
    for solver in sorted(wrong):
        reading.fault(
            "estimator.solver", solver, "one of "
            f"{', '.join(name for name, each in SOLVERS.items() if each.of_boards)} for boards"
            + (", or a plug-in with of_boards=True" if solver not in SOLVERS
               else "; others with points = largest_marker" if SOLVERS[solver].corners_alone
               else ""),
        )
    if any(map(is_solid, (*reading.values_of("markers"), *reading.values_of("distractors")))):
        _several_planes(reading)
    if "chessboard" in reading.values_of("points") and not {"charuco", "diamond"} & set(kinds):
        reading.fault(
            "estimator.points", "chessboard", "kind = charuco or diamond, which have a chessboard"
        )


IN_ONE_PLANE = {
    "curvature_per_m": "a bend is that of one sheet",
    "occlusion": "the sheet that hides lies in the target's plane",
}
"""Switches of effects that targets in several planes cannot have, and why."""


def _several_planes(reading: Reading) -> None:
    """Refuse what sheets in several planes cannot have: solvers for a plane, and effects."""
    target = any(map(is_solid, reading.values_of("markers")))
    why = f"for {'markers' if target else 'distractors'} with z_m or tilt_deg"
    if target and {"markers", "chessboard"}.intersection(reading.values_of("points")):
        reading.refuse_values("solver", f"one of iterative, sqpnp, epnp, {why}",
                              lambda name: name in SOLVERS and SOLVERS[name].planar_only)
    for name, reason in IN_ONE_PLANE.items():
        if reading.is_active(name):
            reading.refuse(name, f"it absent, {why}: {reason}")
    reading.refuse_values("renderer", f"exact, {why}", lambda name: name != "exact")
    if target and any(reading.values_of("refineDetectedMarkers")):
        reading.fault("detector.refineDetectedMarkers", True, f"false, {why}")
