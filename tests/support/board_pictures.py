"""Boards as lists of convex parts, laid out by OpenCV, and their images by polygon clipping."""

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from support.exact_image import add_part, kept

NAME = "DICT_5X5_100"
DICTIONARY = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
MODULES = 7
SIZE_M = 0.021
MODULE_M = SIZE_M / MODULES

CHARUCO: Mapping[str, Any] = {
    "kind": "charuco", "squares_x": 4, "squares_y": 4, "square_m": 0.03,
}
TABLE = ((5, -0.04, 0.0, SIZE_M, 30.0), (9, 0.03, 0.01, 0.035, -70.0), (2, 0.0, -0.05, 0.028, 0.0))
KINDS: dict[str, Mapping[str, Any]] = {
    "grid": {"kind": "grid", "rows": 2, "columns": 3, "gap_m": 0.006},
    "april": {"kind": "grid", "rows": 2, "columns": 2, "gap_m": 0.006, "corner_squares": True},
    "charuco": CHARUCO,
    "legacy": {**CHARUCO, "legacy_pattern": True},
    "diamond": {"kind": "diamond", "square_m": 0.03},
    "markers": {"kind": "markers", "markers": [
        dict(zip(("marker_id", "x_m", "y_m", "size_m", "roll_deg"), row, strict=True))
        for row in TABLE
    ]},
    "beside": {"kind": "grid", "rows": 2, "columns": 2, "gap_m": 0.006, "distractors": [
        {"marker_id": 40, "x_m": 0.055, "y_m": 0.01, "size_m": 0.028, "roll_deg": 30.0},
        {"x_m": -0.05, "y_m": 0.005, "size_m": 0.02, "roll_deg": -50.0},
        {"marker_id": 7, "x_m": 0.0, "y_m": -0.045, "dictionary": "DICT_4X4_50"},
    ]},
}
"""Name -> what a pipeline has under [board]; markers of 5 x 5 bits from ID 0 on."""


def square_corners(x, y, size, roll):
    """Return the corners (4, 2) of a square, right and up in m."""
    square = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * size / 2
    c, s = np.cos(np.radians(roll)), np.sin(np.radians(roll))
    return square @ np.array([[c, s], [-s, c]]) + [x, y]


def table_corners():
    """Return the corners (3, 4, 2) of the table's markers, right and up in m."""
    return np.array([square_corners(*row[1:]) for row in TABLE])


def opencv_board(name):
    """Return OpenCV's board and what takes its points (right, down, z in) to ours."""
    kind = KINDS[name]
    if kind["kind"] == "grid":
        gap, shape = kind["gap_m"], (kind["columns"], kind["rows"])
        board = cv2.aruco.GridBoard(shape, SIZE_M, gap, DICTIONARY)
        middle = (np.array(shape) * (SIZE_M + gap) - gap) / 2
    elif kind["kind"] == "markers":
        points = np.pad(table_corners() * [1, -1], ((0, 0), (0, 0), (0, 1)))
        board = cv2.aruco.Board(
            points.astype(np.float32), DICTIONARY, np.array([row[0] for row in TABLE])
        )
        middle = np.zeros(2)
    else:
        shape = (3, 3) if name == "diamond" else (kind["squares_x"], kind["squares_y"])
        board = cv2.aruco.CharucoBoard(shape, kind["square_m"], SIZE_M, DICTIONARY)
        board.setLegacyPattern(name == "legacy")
        middle = np.array(shape) * kind["square_m"] / 2
    return board, lambda points: (np.asarray(points) - [*middle, 0]) * [1, -1, -1]


def rectangle(left, up, right, down):
    return np.array([[left, up], [right, up], [right, down], [left, down]])


def parts(name, levels, *, beside=True):
    """Yield convex corners (4, 2), right and up in m, the level there, and the level below it.

    In the order of painting; ``beside``: with the distractors.
    """
    kind = KINDS[name]
    black, white, behind = levels["black"], levels["white"], levels["background"]
    board, ours = opencv_board(name)
    if name == "markers":
        squares = [(corners, 1.0) for corners in table_corners()]
    else:
        # OpenCV's points are float32: what lies on one lattice is put there.
        squares = [(np.round(corners / 0.0005) * 0.0005, None)
                   for corners in ours(board.getObjPoints())]
        if kind["kind"] == "grid":
            step, shape = SIZE_M + kind["gap_m"], np.array([kind["columns"], kind["rows"]])
            half = (shape * step - kind["gap_m"]) / 2 + (kind["gap_m"] if name == "april" else 0)
        else:
            step = kind["square_m"]
            shape = np.array([kind.get("squares_x", 3), kind.get("squares_y", 3)])
            half = shape * step / 2
        yield rectangle(*(-half - MODULE_M) * [1, -1], *(half + MODULE_M) * [1, -1]), white, behind
        if name == "april":
            for i, j in np.ndindex(shape[1] + 1, shape[0] + 1):
                x, y = -half[0] + j * step, half[1] - i * step
                yield rectangle(x, y, x + kind["gap_m"], y - kind["gap_m"]), black, white
        elif kind["kind"] != "grid":
            white_first = name == "legacy" and shape[1] % 2 == 0
            for i, j in np.ndindex(shape[1], shape[0]):
                if (i + j + white_first) % 2 == 0:
                    x, y = -half[0] + j * step, half[1] - i * step
                    yield rectangle(x, y, x + step, y - step), black, white
    for marker_id, (corners, quiet) in zip(board.getIds().ravel().tolist(), squares, strict=True):
        bits = cv2.aruco.generateImageMarker(DICTIONARY, marker_id, MODULES)
        yield from marker_parts(corners, bits, quiet, levels)
    for row in kind.get("distractors", []) if beside else []:
        used = getattr(cv2.aruco, row.get("dictionary", NAME))
        dictionary = cv2.aruco.getPredefinedDictionary(used)
        modules = dictionary.markerSize + 2
        bits = np.zeros((modules, modules)) if "marker_id" not in row else (
            cv2.aruco.generateImageMarker(dictionary, row["marker_id"], modules)
        )
        corners = square_corners(
            row["x_m"], row["y_m"], row.get("size_m", SIZE_M), row.get("roll_deg", 0.0)
        )
        yield from marker_parts(corners, bits, 1.0, levels)


def marker_parts(corners, bits, quiet, levels):
    """As :func:`parts`, of a marker with its square's corners; ``quiet``: on its own sheet."""
    black, white, behind = levels["black"], levels["white"], levels["background"]
    top_left, right, down = corners[[0, 1, 3], :2]
    modules = len(bits)
    across, along = (right - top_left) / modules, (down - top_left) / modules

    def cell(x0, y0, x1, y1):
        return np.array([
            top_left + x * across + y * along for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))
        ])

    if quiet is not None:
        yield cell(-quiet, -quiet, modules + quiet, modules + quiet), white, behind
    for i, j in np.ndindex(modules, modules):
        if not bits[i, j]:
            yield cell(j, i, j + 1, i + 1), black, white


def clipped_frame(name, levels, view, rotation, translation, size, hides=None):
    """Return the levels (height, width) of a frame: each part clipped to each pixel.

    ``view``: fx, fy, cx, cy. ``hides``: (normal (2,), limit, level) of a sheet over what lies
    beyond ``normal · point = limit`` on the board, which ends where all that is printed does.
    """
    shape = size[1], size[0]
    image, share = np.full(shape, float(levels["background"])), np.zeros(shape)
    matrix = np.array([[view[0], 0, view[2]], [0, view[1], view[3]], [0, 0, 1]])
    plane = matrix @ np.column_stack([rotation[:, :2], translation])

    def paint(corners, jump):
        add_part(image, share, [plane @ [*point, 1.0] for point in corners], jump)

    listed = list(parts(name, levels))
    if hides is None:
        for corners, level, below in listed:
            paint(corners, level - below)
        return image
    normal, limit, cover = hides

    def beyond(corners, sign):
        flat = np.column_stack([corners, np.ones(4)])
        return [p[:2] for p in kept(list(flat), sign * np.array([*normal, -limit]))]

    for corners, level, below in listed:
        paint(beyond(corners, -1), level - below)
    points = np.concatenate([corners for corners, *_ in listed])
    (left, down), (right, up) = points.min(axis=0), points.max(axis=0)
    paint(beyond(rectangle(left, up, right, down), 1), cover - levels["background"])
    return image
