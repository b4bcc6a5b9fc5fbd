"""A target: a marker, or a board of them, in one plane or in several; the edges of its prints."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sweep.model import marker
from sweep.model.camera import Cameras
from sweep.model.coverage import MarkerEdges, joined
from sweep.model.marker import BLACK, OCCLUDER, OUTSIDE, WHITE
from sweep.model.polygon import following, half_plane
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
    centre_m
        (3,) its centre in the board's frame.
    roll_rad
        Its turn in its plane, from x to y.
    turn
        The rotation (3, 3) of the plane of a print on a sheet of its own; None of one in the
        board's plane.
    """

    edges: MarkerEdges
    unit_m: float
    half_m: float
    centre_m: Sequence[float] = (0.0, 0.0, 0.0)
    roll_rad: float = 0.0
    turn: Floats | None = None

    def plane(self, rotation: Floats, translation: Floats) -> Floats:
        """Return the matrix (3, 3) from (column, row, 1) to the camera frame.

        For a board at ``rotation`` (3, 3) and ``translation`` (3,). The plane of a marker alone
        (:func:`sweep.model.scene.build_scenes`) is the same to the bit.
        """
        cosine, sine = math.cos(self.roll_rad), math.sin(self.roll_rad)
        centre = translation + rotation @ self.centre_m
        turned = rotation if self.turn is None else rotation @ self.turn
        right = turned[:, 0] * cosine + turned[:, 1] * sine
        up = turned[:, 1] * cosine - turned[:, 0] * sine
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
        The dictionary of all its markers.
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
    squares_m
        Side of the black squares at the markers' corners; 0 if there are none.
    """

    dictionary: str
    marker_ids: tuple[int, ...]
    corners_m: Floats
    prints: tuple[Print, ...]
    chessboard_m: Floats
    chessboard: Chessboard | None = None
    distractors: tuple[Print, ...] = ()
    margin: float | None = None
    squares_m: float = 0.0

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
        return self.is_flat and not any(only.centre_m) and only.roll_rad == 0.0


@lru_cache(maxsize=8192)
def single_marker(dictionary: str, marker_id: int, margin: float) -> Board:
    """Return a marker alone, the same for the same arguments; ``margin`` as :class:`Board` has it.

    Its edges are in modules, from the top left corner of its square.
    """
    module = 1 / marker.module_count(dictionary)
    printed = Print(marker.edges(dictionary, marker_id, margin), module, 0.5)
    return Board(
        dictionary, (marker_id,), marker.marker_corners(np.ones(1)), (printed,), np.empty((0, 3)),
        margin=margin,
    )


def edges_on_sheet(prints: Sequence[Print]) -> MarkerEdges:
    """Return the edges of prints in metres, right and *down* from the board's origin.

    Their plane is (rotation[:, 0], -rotation[:, 1], translation).
    """
    on_sheet = [each.plane(np.eye(3), np.array([0.0, 0.0, 1.0])) for each in prints]
    upwards = joined([
        MarkerEdges(
            (each.edges.ends.reshape(-1, 2) @ plane[:2, :2].T + plane[:2, 2]).reshape(-1, 4),
            each.edges.sides,
        )
        for each, plane in zip(prints, on_sheet, strict=True)
    ])
    return MarkerEdges(upwards.ends * [1.0, -1.0, 1.0, -1.0], upwards.sides)


def marker_print(
    dictionary: str, marker_id: int, size_m: float, quiet_zone_modules: float | None,
    centre_m: Sequence[float], roll_deg: float = 0.0, turn: Floats | None = None,
) -> tuple[Print, Floats]:
    """Return a marker's print, and its square's corners (4, 3) in the board's frame.

    Parameters
    ----------
    dictionary, marker_id, size_m
        The marker, and the side of its square.
    quiet_zone_modules
        Width of the white that surrounds it on its own sheet; None if it is printed on white that
        another print encloses.
    centre_m, roll_deg, turn
        As :class:`Print` has them.
    """
    around = marker.overhang(dictionary) + (quiet_zone_modules or 0.0)
    outline = marker.edges(dictionary, marker_id, around)
    if quiet_zone_modules is None:
        sides = np.where(outline.sides == OUTSIDE, WHITE, outline.sides)
        seen = sides[:, 0] != sides[:, 1]
        outline = MarkerEdges(outline.ends[seen], sides[seen])
    module_m, roll_rad = size_m / marker.module_count(dictionary), math.radians(roll_deg)
    cosine, sine = math.cos(roll_rad), math.sin(roll_rad)
    corners = marker.marker_corners(np.array([size_m]))[0] @ np.array([
        [cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]
    ])
    printed = Print(outline, module_m, size_m / 2, centre_m, roll_rad, turn)
    return printed, np.asarray((corners if turn is None else corners @ turn.T) + centre_m)


def cells_print(codes: Integers, side_m: float) -> Print:
    """Return square cells (h, w) of areas ``codes`` on white, their middle at the origin."""
    cells = marker.cell_edges(np.pad(codes, 1, constant_values=WHITE))
    height, width = codes.shape
    shifted = cells.ends - np.tile([width / 2, height / 2], 2)
    return Print(MarkerEdges(shifted, cells.sides), side_m, 0.0)


def rectangles_print(boxes_m: Floats, outside: int, inside: int) -> Print:
    """Return rectangles (n, 4) in metres, as :func:`sweep.model.marker.rectangle_edges`."""
    return Print(marker.rectangle_edges(boxes_m, outside, inside), 1.0, 0.0)


# --------------------------------------------------------------------------------------------------
# Whether squares in one plane overlap.

#: Share of a side by which squares may overlap and still count as touching: rounding.
TOUCHING = 1e-9


def first_overlap(sheets: Floats) -> tuple[int, int] | None:
    """Return the first two of n rectangles (n, 4, 3) that overlap in their plane, or None."""
    from scipy.spatial import cKDTree  # noqa: PLC0415  (slow to import, and boards alone need it)

    reach = float(np.linalg.norm(sheets[:, 2] - sheets[:, 0], axis=1).max())
    pairs = cKDTree(sheets.mean(axis=1)).query_pairs(reach, output_type="ndarray")
    if not len(pairs):
        return None
    pairs = pairs[np.lexsort(pairs.T[::-1])]
    overlapping = sheets_overlap(sheets[pairs[:, 0]], sheets[pairs[:, 1]])
    if not overlapping.any():
        return None
    i, j = pairs[np.argmax(overlapping)].tolist()
    return i, j


def sheets_overlap(one: Floats, other: Floats) -> Masks:
    """Return (n,) which of n pairs of rectangles (n, 4, 3) overlap; not those in other planes.

    Two convex shapes in a plane are disjoint if and only if a line parallel to a side of one of
    them separates them (separating axis theorem).
    """
    sides = [each[:, corner] - each[:, 0] for each in (one, other) for corner in (1, 3)]
    least = np.min([np.linalg.norm(side, axis=1) for side in sides], axis=0)
    normal = np.cross(sides[0], sides[1])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    height = np.abs(np.einsum("nki,ni->nk", other - one[:, :1], normal)).max(axis=1)
    separation = np.full(len(one), -np.inf)
    for side in sides:
        axis = side / np.linalg.norm(side, axis=1)[:, None]
        a, b = (np.einsum("nki,ni->nk", each, axis) for each in (one, other))
        gap = np.maximum(b.min(axis=1) - a.max(axis=1), a.min(axis=1) - b.max(axis=1))
        separation = np.maximum(separation, gap)
    return np.asarray((height <= TOUCHING * least) & (separation < -TOUCHING * least))


# --------------------------------------------------------------------------------------------------
# A target in one plane: a marker, or a board of several; its edges and its extent.
#
# Lengths are in units: modules of a marker, those of its first one for a board. Columns count to
# the right and rows downwards, from the top left corner of a marker's square or from a board's
# origin.

class Extent(NamedTuple):
    """Where a print's parts end, in units.

    Attributes
    ----------
    sheet
        Left, top, right, bottom of all that is printed, the white around it included.
    target
        The same without what stands beside a board.
    ink
        The same of a marker's black square, or of a board's markers and squares.
    origin, middle
        (2,) each: the pose's origin, and the middle of the target.
    modules
        Units along the black square's side.
    """

    sheet: Floats
    target: Floats
    ink: Floats
    origin: Floats
    middle: Floats
    modules: float


@lru_cache(maxsize=8192)
def extent_of(target: Board) -> Extent:
    """Return where the parts of a target end."""
    n = float(marker.module_count(target.dictionary))
    if target.margin is not None:
        margin, middle = target.margin, np.array([n / 2, n / 2])
        sheet = np.array([-margin, -margin, n + margin, n + margin])
        ink = np.array([0.0, 0.0, n, n])
        return Extent(sheet, sheet, ink, middle, middle, n)
    outline = target_edges(target)
    black = (outline.sides == BLACK).any(axis=1)
    own = _box(outline.ends)
    return Extent(
        _box(edges_of(target).ends), own, _box(outline.ends[black]), np.zeros(2),
        (own[:2] + own[2:]) / 2, n,
    )


def _box(ends: Floats) -> Floats:
    """Return left, top, right, bottom of edges with ends (E, 4)."""
    points = ends.reshape(-1, 2)
    return np.concatenate([points.min(axis=0), points.max(axis=0)])


def along_sides(corners: Floats, per_side: int) -> Floats:
    """Return points (n, 4 · per_side, D) along the sides of quadrilaterals (n, 4, D)."""
    if per_side == 1:
        return corners
    t = np.arange(per_side)[:, None] / per_side
    sides = (following(corners) - corners)[:, :, None]
    return (corners[:, :, None] + t * sides).reshape(len(corners), 4 * per_side, corners.shape[2])


def rectangles(boxes: Floats, per_side: int = 1) -> Floats:
    """Return points (n, 4 · per_side, 2) along boxes (n, 4), from the top left: right and down."""
    corners = boxes[:, [0, 1, 2, 1, 2, 3, 0, 3]].reshape(len(boxes), 4, 2)
    return along_sides(corners, per_side)


def in_space(boxes: Floats, planes: Floats, per_side: int = 1) -> Floats:
    """Return points (n, 4 · per_side, 3) along boxes (n, 4) of sheets in ``planes`` (n, 3, 3)."""
    points = rectangles(boxes, per_side)
    homogeneous = np.concatenate([points, np.ones_like(points[..., :1])], axis=2)
    return np.ascontiguousarray(homogeneous @ np.swapaxes(planes, 1, 2))


def box_corners(boxes: Floats) -> Floats:
    """Return the corners (n, 4, 3) of boxes (n, 4): TL, TR, BR, BL; x right, y up."""
    corners = rectangles(boxes) * [1.0, -1.0]
    return np.concatenate([corners, np.zeros((len(boxes), 4, 1))], axis=2)


def unit_m(target: Board) -> float:
    """Return the unit in metres: a module of the first marker; in sides of a marker alone."""
    side = float(np.linalg.norm(target.corners_m[0, 1] - target.corners_m[0, 0]))
    return side / marker.module_count(target.dictionary)


def side_m(target: Board, size_m: float) -> float:
    """Return the side of a target's first marker in metres: ``size_m`` unless it has its own."""
    if target.is_marker:
        return size_m
    side = unit_m(target) * marker.module_count(target.dictionary)
    return size_m if math.isclose(side, size_m, rel_tol=1e-9) else side


@lru_cache(maxsize=8192)
def target_edges(target: Board) -> MarkerEdges:
    """Return the edges of a target, without what stands beside it, in units."""
    return target.prints[0].edges if target.is_marker else _in_units(target, target.prints)


@lru_cache(maxsize=8192)
def edges_of(target: Board) -> MarkerEdges:
    """Return the edges of all that is printed, beside a board too, in units."""
    own = target_edges(target)
    return joined([own, beside_edges(target)]) if target.distractors else own


def beside_edges(target: Board) -> MarkerEdges:
    """Return the edges of what stands beside a target, in units."""
    return _in_units(target, target.distractors)


def _in_units(target: Board, prints: Sequence[Print]) -> MarkerEdges:
    """Return the edges of prints in a target's plane, in its units."""
    on_sheet = edges_on_sheet(prints)
    return MarkerEdges(on_sheet.ends / unit_m(target), on_sheet.sides)


@lru_cache(maxsize=64)
def edge_table(targets: tuple[Board, ...]) -> tuple[MarkerEdges, NDArray[np.int64]]:
    """Return the edges of K targets in one table, and (K, 2) first and last + 1 row of each."""
    each = [edges_of(target) for target in targets]
    stops = np.cumsum([len(outline.ends) for outline in each])
    starts = np.concatenate([[0], stops[:-1]])
    return joined(each), np.stack([starts, stops], axis=1).astype(np.int64)


@lru_cache(maxsize=8192)
def occluded_edges(target: Board, occlusion: float, occlusion_deg: float) -> MarkerEdges:
    """Return the edges of a target under a sheet that hides everything beyond a straight line.

    The sheet ends where the target does.
    """
    extent = extent_of(target)
    angle = math.radians(occlusion_deg)
    towards = np.array([math.cos(angle), -math.sin(angle)])
    # Rows count downwards; the sheet's edge lies where towards · (column, row) = limit.
    beyond = marker.overhang(target.dictionary) if target.is_marker else 0
    hideable = extent.ink[2:] - extent.ink[:2] + 2 * beyond
    middle = (extent.ink[:2] + extent.ink[2:]) / 2
    width = float(hideable @ np.abs(towards))
    limit = float(towards @ middle) + width * (0.5 - occlusion)
    beside = np.array([*-towards, limit])
    sheet = marker.rectangle_edges(extent.sheet[None], OUTSIDE, OCCLUDER)
    return joined([within(edges_of(target), beside)[0], within(sheet, -beside)[0]])


# --------------------------------------------------------------------------------------------------
# Targets that are not in one plane: which markers are seen, and what of them others hide.
#
# Each marker has a convex sheet of its own, or all of them one; what stands beside them has its
# own. The image is the sum of the visible parts of all sheets that face the camera. What a sheet
# in front hides of another is subtracted: of the part of an area inside a half plane the edges
# are those inside, and those outside projected onto its line, which enclose the same area. Of
# several sheets in front, by inclusion and exclusion.

#: Sine of an angle, of rays from the camera, below which sheets only touch in the image.
_NEGLIGIBLE = 1e-12


class _Face(NamedTuple):
    """A sheet before the camera.

    Attributes
    ----------
    number
        Of :func:`sheets_of` the board.
    plane
        (3, 3) takes (column, row, 1) to the camera frame.
    corners
        (4, 3) of the sheet, in the camera frame.
    normals
        (4, 3) of the planes through the camera and the sheet's sides; inwards.
    """

    number: int
    plane: Floats
    corners: Floats
    normals: Floats


@lru_cache(maxsize=64)
def sheets_of(board: Board) -> tuple[Print, ...]:
    """Return the print of each sheet: a board's own, or its markers', then distractors'."""
    of_each = len(board.prints) == len(board)
    own = board.prints if of_each else (Print(edges_on_sheet(board.prints), 1.0, 0.0),)
    return own + board.distractors


def sheet_planes(board: Board, rotation: Floats, translation: Floats, scale: float) -> Floats:
    """Return the planes (P, 3, 3) of a board's sheets, printed ``scale`` times as large."""
    planes = np.array([each.plane(rotation, translation) for each in sheets_of(board)])
    planes[:, :, 2] = translation + scale * (planes[:, :, 2] - translation)
    planes[:, :, :2] *= scale
    return planes


@lru_cache(maxsize=64)
def sheet_boxes(board: Board) -> Floats:
    """Return left, top, right, bottom (P, 4) of each of a board's sheets in its own units."""
    return np.array([_box(each.edges.ends) for each in sheets_of(board)])


@lru_cache(maxsize=64)
def sheets_m(board: Board) -> Floats:
    """Return the corners (P, 4, 3) of all sheets in the board's frame."""
    return in_space(sheet_boxes(board), sheet_planes(board, np.eye(3), np.zeros(3), 1.0))


def own_sheets(board: Board) -> int:
    """Return how many of a board's sheets are its own."""
    return len(sheets_of(board)) - len(board.distractors)


def facing(board: Board, planes: Floats) -> Masks:
    """Return (P,) which sheets show their printed side to the camera, and are not behind it."""
    # Columns run right and rows down, so that their cross product points away from the viewer.
    away = np.cross(planes[:, :, 0], planes[:, :, 1])
    shown = np.einsum("pi,pi->p", away, planes[:, :, 2]) > 0
    return np.asarray(shown & (in_space(sheet_boxes(board), planes)[..., 2] > 0).any(axis=1))


def _faces(board: Board, planes: Floats) -> list[_Face]:
    """Return the sheets that face the camera."""
    numbers = np.flatnonzero(facing(board, planes))
    around = in_space(sheet_boxes(board)[numbers], planes[numbers])
    normals = np.cross(around, np.roll(around, -1, axis=1))
    normals /= np.linalg.norm(normals, axis=2)[..., None]
    normals *= np.sign(np.einsum("pkj,pj->pk", normals, around.mean(axis=1)))[..., None]
    return [
        _Face(k, planes[k], each, inwards)
        for k, each, inwards in zip(numbers.tolist(), around, normals, strict=True)
    ]


def _hides(front: _Face, behind: _Face) -> bool:
    """Return whether a sheet hides a part of another."""
    # The part of the one that the other's outline encloses, (n, 3).
    common = behind.corners
    for normal in front.normals:
        common = half_plane(common, common @ normal)
        if len(common) < 3:
            return False
    rays = common / np.linalg.norm(common, axis=1)[:, None]
    spread = np.cross(rays[1:] - rays[0], np.roll(rays, -1, axis=0)[1:] - rays[0])
    if not np.abs(spread).max() > _NEGLIGIBLE:
        return False
    ray = rays.mean(axis=0)
    distances = []
    for face in (front, behind):
        normal = np.cross(face.plane[:, 0], face.plane[:, 1])
        distances.append(float(normal @ face.plane[:, 2]) / float(normal @ ray))
    return distances[0] < distances[1]


def _occluders(faces: list[_Face]) -> list[list[_Face]]:
    """Return for each sheet those that hide a part of it."""
    if not faces:
        return []
    corners = np.array([face.corners for face in faces])
    before: Masks = np.asarray((corners[..., 2] > 0).all(axis=1))
    with np.errstate(divide="ignore", invalid="ignore"):
        flat = corners[..., :2] / corners[..., 2:]
    low, high = (np.where(before[:, None], end, sign * np.inf) for end, sign in (
        (flat.min(axis=1), -1), (flat.max(axis=1), 1)
    ))
    # Without this, sheets that lie far from each other in the image cost most of the time.
    near: Masks = np.asarray(((low[:, None] <= high) & (high[:, None] >= low)).all(axis=2))
    np.fill_diagonal(near, val=False)
    return [
        [faces[k] for k in np.flatnonzero(near[i]).tolist() if _hides(faces[k], behind)]
        for i, behind in enumerate(faces)
    ]


class VisiblePrint(NamedTuple):
    """The visible part of a sheet's print.

    Attributes
    ----------
    number
        Of :func:`sheets_of` the board.
    edges
        Its edges.
    mover
        (E,) the number of the sheet with which the image of each edge moves: of an edge at which
        another sheet hides this one, the other's.
    """

    number: int
    edges: MarkerEdges
    mover: Integers


def visible_prints(board: Board, planes: Floats, first: int = 0) -> list[VisiblePrint]:
    """Return the visible print of each sheet, from number ``first`` on."""
    seen = []
    sheets = sheets_of(board)
    faces = _faces(board, planes)
    for face, fronts in zip(faces, _occluders(faces), strict=True):
        if face.number < first:
            continue
        outline = sheets[face.number].edges
        own = np.full(len(outline.ends), face.number)
        parts, movers = [outline], [own]
        for count in range(1, len(fronts) + 1):
            for some in itertools.combinations(fronts, count):
                part, mover = outline, own
                for front in some:
                    for line in front.normals @ face.plane:
                        part, number = within(part, line)
                        mover = np.where(number < 0, front.number, mover[number])
                parts.append(
                    MarkerEdges(part.ends, part.sides[:, ::-1] if count % 2 else part.sides)
                )
                movers.append(mover)
        seen.append(VisiblePrint(face.number, joined(parts), np.concatenate(movers)))
    return seen


def moving_edges(seen: VisiblePrint, planes: Floats) -> list[tuple[MarkerEdges, Floats]]:
    """Return the edges of a print, each in the plane of the sheet that it moves with, and these.

    The image is the same: an edge at which a sheet in front ends lies on the sheet's outline.
    """
    groups = []
    for number in np.unique(seen.mover).tolist():
        ends, sides = (each[seen.mover == number] for each in seen.edges)
        if number != seen.number:
            points = np.column_stack([ends.reshape(-1, 2), np.ones(2 * len(ends))])
            moved = points @ np.linalg.solve(planes[number], planes[seen.number]).T
            ends = np.ascontiguousarray((moved[:, :2] / moved[:, 2:]).reshape(-1, 4))
        groups.append((MarkerEdges(ends, sides), planes[number]))
    return groups


def within(outline: MarkerEdges, line: Floats) -> tuple[MarkerEdges, Integers]:
    """Return the edges of the part of all areas where line · (column, row, 1) is not negative.

    And the number (E,) of the edge that each of them is a part of, -1 if it lies on the line: parts
    beyond it are projected onto it, where they enclose the same area.
    """
    length, number = float(line[:2] @ line[:2]), np.arange(len(outline.ends))
    if length == 0.0:
        kept = slice(None) if line[2] >= 0 else slice(0)
        return MarkerEdges(outline.ends[kept], outline.sides[kept]), number[kept]
    start, stop = outline.ends[:, :2], outline.ends[:, 2:]
    a, b = start @ line[:2] + line[2], stop @ line[:2] + line[2]
    crossing = (a < 0) != (b < 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        cut = np.where(crossing[:, None], start + (a / (a - b))[:, None] * (stop - start), stop)

    def projected(points: Floats, value: Floats) -> Floats:
        return points - np.minimum(value, 0.0)[:, None] / length * line[:2]

    first = np.hstack([projected(start, a), np.where(
        crossing[:, None], cut, projected(stop, b)
    )])
    second = np.hstack([cut, projected(stop, b)])[crossing]
    number = np.concatenate([np.where(a < 0, -1, number), np.where(b < 0, -1, number)[crossing]])
    return MarkerEdges(
        np.concatenate([first, second]),
        np.concatenate([outline.sides, outline.sides[crossing]]),
    ), number


def unseen_markers(board: Board, planes: Floats, corners: Floats) -> Masks:
    """Return (M,) which markers show their back, or are wholly behind another's sheet.

    ``corners`` (M, 4, 3) are those of their squares in the camera frame.
    """
    unseen = np.ones(len(board), dtype=bool)
    faces, one_sheet = _faces(board, planes), own_sheets(board) == 1
    for face, fronts in zip(faces, _occluders(faces), strict=True):
        if face.number < own_sheets(board):
            for number in range(len(board)) if one_sheet else [face.number]:
                inside = [(corners[number] @ front.normals.T >= 0).all() for front in fronts]
                unseen[number] = any(inside)
    return unseen


def boxes_px(
    board: Board, camera: Cameras, rotation: Floats, translation: Floats, scale: float
) -> Floats:
    """Return rectangles (2, 4, 2) in px about the images of a solid board's sheets, and of all.

    Of those that face the camera, if any does; NaN if a part of one is not before it.
    """
    planes = sheet_planes(board, rotation, translation, scale)
    facing_it, around = facing(board, planes), in_space(sheet_boxes(board), planes)
    boxes = []
    for count in (own_sheets(board), len(planes)):
        seen, corners = facing_it[:count], around[:count]
        corners = corners[seen if seen.any() else slice(None)]
        pixels = camera.project(np.ascontiguousarray(corners.reshape(1, -1, 3)))[0]
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        boxes.append([low, [high[0], low[1]], high, [low[0], high[1]]])
    return np.array(boxes)
