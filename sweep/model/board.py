"""A target: a marker, or a board of them; and the edges of all that is printed on it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sweep.model.coverage import MarkerEdges
from sweep.model.marker import (
    OUTSIDE,
    WHITE,
    cell_edges,
    edges,
    marker_corners,
    module_count,
    overhang,
)
from sweep.model.pose import rotation_of_vector
from sweep.typing import Floats, Integers, Masks

# --------------------------------------------------------------------------------------------------
# A planar target: markers, chessboard and sheet, and the edges of all that is printed on it.
#
# The board's frame is that of a marker: x right, y up, z out towards the viewer, in metres.
# Boards are made by the kinds of :mod:`sweep.model.board_kinds`.

class Print(NamedTuple):
    """One printed thing: a marker, a chessboard, the outline of the sheet.

    Attributes
    ----------
    edges
        Its edges, right and down in units, as :func:`sweep.model.coverage.accumulate` takes them.
    unit_m
        Metres in a unit: a marker's module.
    half_m
        How far left of and above its centre the edges' origin lies.
    x_m, y_m
        Its centre in the board's frame.
    roll_rad
        Its turn in its plane, from x to y.
    z_m, turn
        Of a print that is not in the board's plane: its centre's height, and the rotation (3, 3)
        of its plane; None of one in it.
    """

    edges: MarkerEdges
    unit_m: float
    half_m: float
    x_m: float = 0.0
    y_m: float = 0.0
    roll_rad: float = 0.0
    z_m: float = 0.0
    turn: Floats | None = None

    def plane(self, rotation: Floats, translation: Floats) -> Floats:
        """Return what takes (column, row, 1) to the camera frame, (3, 3).

        For a board at ``rotation`` (3, 3) and ``translation`` (3,). The plane of a marker alone
        (:func:`sweep.model.scene.build_scenes`) is the same to the bit.
        """
        cosine, sine = math.cos(self.roll_rad), math.sin(self.roll_rad)
        if self.turn is not None:
            translation = translation + rotation @ [self.x_m, self.y_m, self.z_m]
            flat = self._replace(x_m=0.0, y_m=0.0, turn=None)
            return flat.plane(rotation @ self.turn, translation)
        right = rotation[:, 0] * cosine + rotation[:, 1] * sine
        up = rotation[:, 1] * cosine - rotation[:, 0] * sine
        centre = translation + rotation[:, 0] * self.x_m + rotation[:, 1] * self.y_m
        return np.stack(
            [right * self.unit_m, -up * self.unit_m, centre - (right - up) * self.half_m], axis=1
        )


class Chessboard(NamedTuple):
    """The squares of a ChArUco board, as ``cv2.aruco.CharucoBoard`` takes them."""

    squares_x: int
    squares_y: int
    square_m: float
    marker_m: float
    legacy_pattern: bool


@dataclass(frozen=True, slots=True, eq=False)
class Board:
    """A target: flat, or of markers that each have a plane and a sheet of their own.

    A marker alone is a target of one square, whose side is 1 here: scenes say how large it is.

    Attributes
    ----------
    dictionary
        That of all its markers.
    marker_ids
        The ID of each of its n markers.
    corners_m
        (n, 4, 3) the corners of their black squares in the board's frame: TL, TR, BR, BL, as
        OpenCV's ArUco module finds them.
    prints
        All that is printed, the markers first and in their order.
    chessboard_m
        (m, 3) the inner corners of a ChArUco board's squares in the board's frame, by rows from
        the top left as ``cv2.aruco.CharucoBoard`` counts them; (0, 3) of other boards.
    chessboard
        A ChArUco board's squares; None of other boards.
    distractors
        What stands beside it and is no part of it, each on a sheet of its own.
    margin
        How far a marker alone extends beyond its square, its overhang and its quiet zone, in
        modules; None of a board.
    """

    dictionary: str
    marker_ids: tuple[int, ...]
    corners_m: Floats
    prints: tuple[Print, ...]
    chessboard_m: Floats
    chessboard: Chessboard | None = None
    distractors: tuple[Print, ...] = ()
    margin: float | None = None

    def __len__(self) -> int:
        return len(self.marker_ids)

    @property
    def is_marker(self) -> bool:
        """Whether it is a marker alone, as large as its scene says."""
        return self.margin is not None

    @property
    def is_flat(self) -> bool:
        """Whether all is printed in one plane, distractors included."""
        return self.is_planar and all(each.turn is None for each in self.distractors)

    @property
    def is_planar(self) -> bool:
        """Whether the board is in one plane, whatever stands beside it."""
        return all(each.turn is None for each in self.prints)

    @property
    def is_single(self) -> bool:
        """Whether it is one marker on its own sheet, upright at the origin, and nothing else."""
        if len(self.prints) > 1 or len(self) != 1 or self.distractors:
            return False
        only = self.prints[0]
        return self.is_flat and only.x_m == only.y_m == only.roll_rad == 0.0

    def edges(self, leave_out: Sequence[int] = ()) -> MarkerEdges:
        """Return the edges of the board's prints, as :func:`edges_on_sheet` does.

        ``leave_out``: indices of prints that are not wanted, such as a marker's.
        """
        return edges_on_sheet(
            [each for i, each in enumerate(self.prints) if i not in set(leave_out)]
        )


@lru_cache(maxsize=8192)
def single_marker(dictionary: str, marker_id: int, margin: float) -> Board:
    """Return a marker alone, the same for the same arguments; ``margin`` as :class:`Board` has it.

    Its edges are in modules, from the top left corner of its square.
    """
    printed = Print(edges(dictionary, marker_id, margin), 1 / module_count(dictionary), 0.5)
    return Board(
        dictionary, (marker_id,), marker_corners(np.ones(1)), (printed,), np.empty((0, 3)),
        margin=margin,
    )


def edges_on_sheet(prints: Sequence[Print]) -> MarkerEdges:
    """Return the edges of prints in metres, right and *down* from the board's origin.

    Their plane is (rotation[:, 0], -rotation[:, 1], translation).
    """
    on_sheet = [each.plane(np.eye(3), np.array([0.0, 0.0, 1.0])) for each in prints]
    ends = [
        (each.edges.ends.reshape(-1, 2) @ plane[:2, :2].T + plane[:2, 2]).reshape(-1, 4)
        for each, plane in zip(prints, on_sheet, strict=True)
    ]
    return MarkerEdges(
        np.concatenate([*ends, np.empty((0, 4))]) * [1.0, -1.0, 1.0, -1.0],
        np.concatenate([
            *(each.edges.sides for each in prints), np.empty((0, 2), dtype=np.int64)
        ]),
    )


def marker_print(
    dictionary: str, marker_id: int, size_m: float, quiet_zone_modules: float | None,
    x_m: float = 0.0, y_m: float = 0.0, roll_deg: float = 0.0,
) -> Print:
    """Return a marker with its centre at (x, y), on a sheet of its own or on a white one.

    ``quiet_zone_modules`` is the width of the white that surrounds it on its own sheet; None if
    it is printed on white that another print encloses.
    """
    outline = edges(dictionary, marker_id, overhang(dictionary) + (quiet_zone_modules or 0.0))
    if quiet_zone_modules is None:
        sides = np.where(outline.sides == OUTSIDE, WHITE, outline.sides)
        seen = sides[:, 0] != sides[:, 1]
        outline = MarkerEdges(outline.ends[seen], sides[seen])
    return Print(
        outline, size_m / module_count(dictionary), size_m / 2, x_m, y_m, math.radians(roll_deg)
    )


def solid_print(
    flat: Print, z_m: float, tilt_deg: float, azimuth_deg: float
) -> tuple[Print, Floats]:
    """Return a print with its centre at a height and its plane tilted, and its corners (4, 3).

    By ``tilt_deg`` about the axis (cos azimuth, sin azimuth, 0) of the board, after its roll; the
    corners are those of its marker's square: TL, TR, BR, BL.
    """
    turn = rotation_of_vector(
        math.radians(tilt_deg) * np.array([[
            math.cos(math.radians(azimuth_deg)), math.sin(math.radians(azimuth_deg)), 0.0
        ]])
    )[0]
    corners = corners_of(2 * flat.half_m, 0.0, 0.0, math.degrees(flat.roll_rad))
    return flat._replace(z_m=z_m, turn=turn), np.asarray(
        corners @ turn.T + [flat.x_m, flat.y_m, z_m]
    )


def corners_of(size_m: float, x_m: float, y_m: float, roll_deg: float = 0.0) -> Floats:
    """Return the corners (4, 3) of a marker's square in the board's frame: TL, TR, BR, BL."""
    corners = marker_corners(np.array([size_m]))[0]
    cosine, sine = math.cos(math.radians(roll_deg)), math.sin(math.radians(roll_deg))
    turn = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(corners @ turn + [x_m, y_m, 0.0])


def cells_print(codes: Integers, side_m: float) -> Print:
    """Return square cells (h, w) of areas ``codes`` on white, their middle at the origin."""
    ends, sides = cell_edges(np.pad(codes, 1, constant_values=WHITE))
    height, width = codes.shape
    shifted = np.array(ends, dtype=np.float64) - np.tile([width / 2, height / 2], 2)
    return Print(MarkerEdges(shifted, np.array(sides, dtype=np.int64)), side_m, 0.0)


def rectangles_print(boxes_m: Floats, outside: int, inside: int) -> Print:
    """Return rectangles (n, 4) of left, top, right, bottom in metres, right and down.

    ``outside`` and ``inside`` are the codes of the areas.
    """
    left, top, right, bottom = boxes_m.T
    ends = np.concatenate([
        np.stack([left, top, left, bottom], axis=1), np.stack([right, top, right, bottom], axis=1),
        np.stack([left, top, right, top], axis=1), np.stack([left, bottom, right, bottom], axis=1),
    ])
    codes = [(outside, inside), (inside, outside), (inside, outside), (outside, inside)]
    return Print(
        MarkerEdges(ends, np.repeat(np.array(codes, dtype=np.int64), len(boxes_m), axis=0)),
        1.0, 0.0,
    )


# --------------------------------------------------------------------------------------------------
# Whether squares in one plane overlap.

TOUCHING = 1e-9
"""Share of a side by which squares may overlap and still count as touching: rounding."""


def first_overlap(centres: Floats, sides: Floats, rolls_rad: Floats) -> tuple[int, int] | None:
    """Return the first two of n squares that overlap, or None.

    ``centres`` (n, 2), ``sides`` and ``rolls_rad`` (n,). Two convex shapes are disjoint if and only
    if a line parallel to a side of one of them separates them (separating axis theorem).
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415  (slow to import, and boards alone need it)

    pairs = cKDTree(centres).query_pairs(float(sides.max()) * np.sqrt(2), output_type="ndarray")
    if not len(pairs):
        return None
    pairs = pairs[np.lexsort(pairs.T[::-1])]
    first, other = pairs.T
    separation = np.full(len(pairs), -np.inf)
    between = centres[other] - centres[first]
    turn = rolls_rad[other] - rolls_rad[first]
    # Half the width of a square of side 1 across a direction at an angle to its sides.
    half_width = (np.abs(np.cos(turn)) + np.abs(np.sin(turn))) / 2
    for own, foreign in ((first, other), (other, first)):
        for quarter in (0.0, np.pi / 2):
            angle = rolls_rad[own] + quarter
            along = between[:, 0] * np.cos(angle) + between[:, 1] * np.sin(angle)
            reach = sides[own] / 2 + sides[foreign] * half_width
            separation = np.maximum(separation, np.abs(along) - reach)
    overlapping = separation < -TOUCHING * np.minimum(sides[first], sides[other])
    if not overlapping.any():
        return None
    i, j = pairs[np.argmax(overlapping)].tolist()
    return i, j


def sheets_overlap(one: Floats, others: Floats) -> Masks:
    """Return (n,) which of n rectangles (n, 4, 3) overlap another (4, 3) in its plane.

    By the separating axis theorem, as :func:`first_overlap`; those in other planes do not.
    """
    sides = np.stack([one[1] - one[0], one[3] - one[0]])
    other_sides = np.stack([others[:, 1] - others[:, 0], others[:, 3] - others[:, 0]], axis=1)
    side = np.linalg.norm(sides, axis=1).min()
    normal = np.cross(*sides) / np.linalg.norm(np.cross(*sides))
    coplanar = (np.abs((others - one[0]) @ normal) <= TOUCHING * side).all(axis=1)
    separation = np.full(len(others), -np.inf)
    for along in (*(np.broadcast_to(each, (len(others), 3)) for each in sides),
                  other_sides[:, 0], other_sides[:, 1]):
        axis = along / np.linalg.norm(along, axis=1)[:, None]
        a = axis @ one.T
        b = np.einsum("ni,nki->nk", axis, others)
        gap = np.maximum(b.min(axis=1) - a.max(axis=1), a.min(axis=1) - b.max(axis=1))
        separation = np.maximum(separation, gap)
    return np.asarray(coplanar & (separation < -TOUCHING * side))
