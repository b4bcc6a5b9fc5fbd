"""Rules of pipelines that show boards."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Any

from sweep.environments.interpreters import INSTALLED
from sweep.measure.estimators import SOLVERS
from sweep.messages import shown
from sweep.model.board_values import (
    ARRANGING,
    NEEDED,
    SINGLE,
    arranged_board,
    arrangement_faults,
    is_solid,
    used_by,
)
from sweep.model.effects import GEOMETRIC
from sweep.model.renderer_names import RENDERERS, is_renderer
from sweep.model.renderers import MAX_BITMAP_PX, MAX_BITMAP_SIDE, bitmap_shape
from sweep.plan.alternatives import PHOTOGRAPHS
from sweep.plan.axes import combinations
from sweep.plan.parameters import PARAMETERS
from sweep.plan.reader import Reading
from sweep.plugins.recording import is_recording

WARP = "warp"

MAX_BOARDS = 10_000
"""The most boards of a grid: all are checked before anything is computed."""


def boards_can_be_printed(reading: Reading) -> None:
    """Demand what each kind of board needs, and boards whose parts do not overlap."""
    kinds = reading.values("kind")
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
            reading.fault(
                f"board.{name}", reading.written(name),
                f"kind = {users}, which uses it; kind = {' or '.join(dict.fromkeys(kinds))} "
                "does not: delete it",
            )
    if not _shows_boards(reading):
        return
    if needed or not all(reading.values(name) for name in ARRANGING):
        return
    for name in ("markers", "distractors"):
        if reading.axis_of(name) is not None:
            reading.fault(f"axes.{name}", "...", f"{name} under [board]: they cannot be an axis")
            return
    seen = set()
    for values in _arrangements(reading):
        for name, value, expected in arrangement_faults(values):
            if (name, expected) not in seen:
                seen.add((name, expected))
                section = reading.parameters[name.partition("[")[0]].section
                reading.fault(f"{section}.{name}", value, expected)
        if len(seen) > MAX_FAULTS:
            return
    if not seen and WARP in reading.values("renderer"):
        _bitmaps_fit(reading)


def _bitmaps_fit(reading: Reading) -> None:
    """Demand boards of which ``warp`` can draw bitmaps."""
    for values in _arrangements(reading):
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


def _shows_boards(reading: Reading) -> bool:
    """Return whether scenes show a board, or a marker with something beside it."""
    beside = any(reading.values("distractors"))
    return beside or any(kind != SINGLE for kind in reading.values("kind"))


def _arrangements(reading: Reading) -> Iterator[tuple[Any, ...]]:
    """Yield the values of every board of the grid; note a fault if there are too many."""
    axes = [axis for axis in reading.axes.values() if not set(axis.columns).isdisjoint(ARRANGING)]
    count = math.prod(len(axis) for axis in axes)
    if count > MAX_BOARDS:
        reading.faults.append(
            f"{reading.source}: axes: {count:,} different boards: expected at most {MAX_BOARDS:,}"
        )
        return
    fixed = {name: reading.fixed.get(name) for name in ARRANGING}
    for chosen in combinations(axes):
        values = fixed | chosen
        yield tuple(values[name] for name in ARRANGING)


def boards_are_searched_and_solved(reading: Reading) -> None:
    """Demand detectors, solvers and renderers that can do boards."""
    kinds = reading.values("kind")
    on_boards = ("points", "refine", "refineDetectedMarkers", "minMarkers")
    plugged = [each.name for each in reading.plugins if each.of_boards]
    if not _shows_boards(reading):
        for name in reading.values("solver"):
            if name in plugged:
                reading.fault(
                    "estimator.solver", name, "a solver of single markers, or a board: give kind "
                    "under [board]",
                )
        for name in on_boards:
            if name in reading.given:
                reading.fault(
                    f"{reading.parameters[name].section}.{name}", reading.written(name),
                    "a board: give kind under [board]",
                )
        return
    if PHOTOGRAPHS in reading.given:
        reading.fault("board.kind", reading.written("kind"), "no board beside photographs, whose "
                      "board `sweep photos` knows; delete it")
    for name in reading.values("environment"):
        if name != INSTALLED:
            reading.fault("detector.environment", name, f"{INSTALLED}, for boards")
    for name in reading.values("renderer"):
        if not is_renderer(name):
            reading.fault("scene.renderer", name, f"{RENDERERS}, for boards")
    for name in reading.values("detector"):
        if is_recording(name):
            reading.fault("detector.detector", name, "a detector that searches images, for boards")
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
    if any(map(is_solid, (*reading.values("markers"), *reading.values("distractors")))):
        _several_planes(reading)
    if "chessboard" in reading.values("points") and not {"charuco", "diamond"} & set(kinds):
        reading.fault(
            "estimator.points", "chessboard", "kind = charuco or diamond, which have a chessboard"
        )


IN_ONE_PLANE = tuple(
    name for name in GEOMETRIC if name not in ("blur_px", "marker_scale", "sharpening")
)
"""Switches of effects that boards in several planes cannot have."""


def _several_planes(reading: Reading) -> None:
    """Refuse what sheets in several planes cannot have: solvers for a plane, and effects."""
    target = any(map(is_solid, reading.values("markers")))
    why = f"for {'markers' if target else 'distractors'} with z_m or tilt_deg"
    for name in reading.values("solver") if target else ():
        known = SOLVERS.get(name)
        if known is not None and known.planar_only and any(
            points in ("markers", "chessboard") for points in reading.values("points")
        ):
            reading.fault("estimator.solver", name, f"one of iterative, sqpnp, epnp, {why}")
    for name in IN_ONE_PLANE:
        if any(value != PARAMETERS[name].default for value in reading.values(name)) or (
            name in reading.distributions
        ):
            reading.fault(f"scene.{name}", reading.written(name), f"it absent, {why}")
    for value in reading.values("renderer"):
        if value != "exact":
            reading.fault("scene.renderer", value, f"exact, {why}")
    if target and any(reading.values("refineDetectedMarkers")):
        reading.fault("detector.refineDetectedMarkers", True, f"false, {why}")
