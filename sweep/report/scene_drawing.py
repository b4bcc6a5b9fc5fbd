"""One scene as a picture, with the truth and the detections drawn on it."""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.evaluation.inspection import SceneInspection
from sweep.plan.schema import VARIABLES

Colour = tuple[int, int, int]

# Blue, green, red; of the palette of Okabe and Ito, distinguishable by the colour-blind.
TRUTH: Colour = (115, 158, 0)
DETECTED: Colour = (0, 94, 213)
OTHER: Colour = (167, 121, 204)
REJECTED: Colour = (66, 228, 240)
CHESSBOARD: Colour = (178, 114, 0)
AXES: tuple[Colour, Colour, Colour] = ((0, 0, 230), (0, 170, 0), (230, 80, 0))
PAPER: Colour = (255, 255, 255)
INK: Colour = (40, 40, 40)
FAINT: Colour = (110, 110, 110)

LEGEND: tuple[tuple[str, Colour], ...] = (
    ("true outline", TRUTH), ("detected corners (dot: the first)", DETECTED),
    ("other detection", OTHER), ("rejected candidate", REJECTED),
    ("estimated x", AXES[0]), ("y", AXES[1]), ("z", AXES[2]),
)
"""The meaning of the colours."""

CHESSBOARD_LEGEND = ("corners of the chessboard", CHESSBOARD)

MAX_SIDE = 900
MIN_SIDE = 560
LINE_HEIGHT = 26
CAPTION_SIDE = 1200
"""Pixels of a picture's width from which on its caption grows with it."""

SHIFT = 4
"""Fractional bits of the drawn coordinates."""

MARGIN = 0.35
"""Of the marker's side, shown around it."""

MIN_CUT_PX = 4

SMALL = 0.08
"""Share of a picture's larger side below which a marker is shown enlarged in a corner, too."""

INSET = 0.36
"""Share of a picture's smaller side that this takes."""


def draw_scene(scene: SceneInspection, title: str) -> NDArray[np.uint8]:
    """Return a scene enlarged, (H, W, 3), blue-green-red, with a caption below it.

    A marker that is small in the picture is framed, and shown enlarged in the corner that is
    farthest from it.

    Parameters
    ----------
    scene
        Image, truth and detections.
    title
        First line of the caption: the pose on its grid. Then come what was drawn at random, flags
        and errors, and the legend.
    """
    return _captioned(_with_inset(draw_outlines(scene), scene), scene, title)


def cut_to_marker(scene: SceneInspection) -> SceneInspection:
    """Return a scene whose image is cut to the marker and its surroundings, where it is seen."""
    corners = scene.true_corners
    left, top, right, bottom = scene.window
    if not np.isfinite(corners).all():
        return scene
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = max(4.0, MARGIN * float((high - low).max()))
    x0, y0 = np.maximum(np.floor(low - margin), (left, top)).astype(int)
    x1, y1 = np.minimum(np.ceil(high + margin) + 1, (right, bottom)).astype(int)
    if x1 - x0 < MIN_CUT_PX or y1 - y0 < MIN_CUT_PX:
        return scene
    image = scene.image[y0 - top : y1 - top, x0 - left : x1 - left]
    return dataclasses.replace(
        scene, image=np.ascontiguousarray(image), window=(int(x0), int(y0), int(x1), int(y1)))


def _scale(scene: SceneInspection, side: float = MAX_SIDE) -> int:
    """Return by which factor the image is enlarged so that it has at most that side."""
    return max(1, min(int(side) // int(max(scene.image.shape)), 24))


def _with_inset(canvas: NDArray[np.uint8], scene: SceneInspection) -> NDArray[np.uint8]:
    """Return the picture with a frame around a small marker, and the frame's content enlarged."""
    height, width = canvas.shape[:2]
    cut = cut_to_marker(scene)
    x0, y0, x1, y1 = cut.window
    scale = _scale(scene)
    if cut is scene or scale * max(x1 - x0, y1 - y0) > 2 * SMALL * max(height, width):
        return canvas
    inset = draw_outlines(cut, INSET * min(height, width))
    line = max(2, round(max(height, width) / 600))
    frame = scale * (np.array([x0, y0, x1, y1]) - np.tile(scene.window[:2], 2))
    centre = (frame[:2] + frame[2:]) / 2
    room = 3 * line
    size = np.array(inset.shape[1::-1])
    corner = np.where(centre < np.array([width, height]) / 2,
                      np.array([width, height]) - size - room, room)
    to = np.append(corner, corner + size)
    for colour, thickness in ((INK, 3 * line), (PAPER, line)):
        cv2.line(canvas, centre.astype(int).tolist(), (corner + size // 2).tolist(), colour,
                 thickness, cv2.LINE_AA)
    x, y = frame[:2].astype(int)
    u, v = frame[2:].astype(int)
    canvas[y:v, x:u] = draw_outlines(cut, scale=scale)
    canvas[to[1] : to[3], to[0] : to[2]] = inset
    for box in (frame + np.array([-1, -1, 1, 1]) * 2 * line, to):
        for colour, thickness in ((INK, 3 * line), (PAPER, line)):
            low, high = box.astype(int)[:2].tolist(), box.astype(int)[2:].tolist()
            cv2.rectangle(canvas, low, high, colour, thickness)
    return canvas


def draw_outlines(
    scene: SceneInspection, side: float = MAX_SIDE, *, scale: int | None = None
) -> NDArray[np.uint8]:
    """Return a scene enlarged to about a side, (H, W, 3), without a caption.

    Parameters
    ----------
    scene
        Image, truth and detections.
    side
        Pixels that the larger side has at most, unless the image has more.
    scale
        By which factor the image is enlarged; None follows from ``side``.
    """
    scale = scale or _scale(scene, side)
    enlarged = cv2.resize(
        scene.image, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST
    )
    canvas = np.asarray(cv2.cvtColor(enlarged, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    origin = np.array(scene.window[:2], dtype=np.float64)
    weight = max(2, round(max(canvas.shape[:2]) / 700))

    def at(points: NDArray[np.float64]) -> NDArray[np.int32]:
        """Return points (n, 2) px of the frame as fixed-point coordinates of the picture."""
        # The centre of pixel 0 lies half an enlarged pixel inside the picture.
        moved = (points - origin + 0.5) * scale - 0.5
        clipped = np.clip(moved, -1e6, 1e6)
        return np.asarray(np.round(clipped * 2**SHIFT), dtype=np.int32)

    def outline(points: NDArray[np.float64], colour: Colour, thickness: int) -> None:
        if np.isfinite(points).all():
            cv2.polylines(
                canvas, [at(points).reshape(-1, 1, 2)], isClosed=True, color=colour,
                thickness=thickness, lineType=cv2.LINE_AA, shift=SHIFT,
            )

    for quad in scene.rejected:
        outline(quad, REJECTED, 1)
    for quad in other_quadrilaterals(scene):
        outline(quad, OTHER, weight)
    several = len(scene.true_markers) > 1
    for quad in scene.true_markers:
        outline(quad, TRUTH, weight + (1 if several else 3))
    radius = 3 if several else 6
    for quad in scene.markers[np.isfinite(scene.markers).all(axis=(1, 2))]:
        outline(quad, DETECTED, 1 if several else weight)
        for k, corner in enumerate(at(quad).tolist()):
            filled = cv2.FILLED if k == 0 else 1 if several else weight
            cv2.circle(
                canvas, corner, radius << SHIFT, DETECTED, filled, cv2.LINE_AA, SHIFT
            )
    for corner in at(scene.chessboard[np.isfinite(scene.chessboard).all(axis=1)]).tolist():
        cv2.circle(canvas, corner, radius << SHIFT, CHESSBOARD, weight, cv2.LINE_AA, SHIFT)
    if np.isfinite(scene.axes_px).all():
        ends = at(scene.axes_px).tolist()
        for colour, end in zip(AXES, ends[1:], strict=True):
            cv2.line(canvas, ends[0], end, colour, weight + 1, cv2.LINE_AA, SHIFT)
    return canvas


def other_quadrilaterals(scene: SceneInspection) -> list[NDArray[np.float64]]:
    """Return the decoded quadrilaterals that are not the scene's markers."""
    return [
        quad for _, quad in scene.decoded
        if not np.isclose(quad, scene.markers, atol=0.01).all(axis=(1, 2)).any()
    ]


def _captioned(canvas: NDArray[np.uint8], scene: SceneInspection, title: str) -> NDArray[np.uint8]:
    """Return the picture with title, draws, result and legend below it."""
    legend = [LEGEND[0]]
    if np.isfinite(scene.markers).all(axis=(1, 2)).any():
        legend.append(LEGEND[1])
    if np.isfinite(scene.chessboard).any():
        legend.append(CHESSBOARD_LEGEND)
    if other_quadrilaterals(scene):
        legend.append(LEGEND[2])
    if scene.rejected:
        legend.append((f"rejected candidates: {len(scene.rejected)}", REJECTED))
    if np.isfinite(scene.axes_px).all():
        legend += LEGEND[-3:]
    width = max(canvas.shape[1], MIN_SIDE)
    size = max(1.0, width / CAPTION_SIDE)
    room = width / size - 32
    texts = [(line, colour) for text, colour in (
        (title, INK), (_drawn_text(scene), FAINT), (_result_text(scene), INK),
    ) for line in _wrapped(text, room, size)]
    rows = [[legend[0]]]
    for entry in legend[1:]:
        if sum(_entry_width(text, size) for text, _ in (*rows[-1], entry)) > room:
            rows.append([])
        rows[-1].append(entry)
    caption_height = round(size * (LINE_HEIGHT * (len(texts) + len(rows)) + 20))
    page = np.full((canvas.shape[0] + caption_height, width, 3), PAPER, dtype=np.uint8)
    left = (width - canvas.shape[1]) // 2
    page[: canvas.shape[0], left : left + canvas.shape[1]] = canvas
    y = canvas.shape[0] + size * LINE_HEIGHT
    for text, colour in texts:
        _text(page, text, 16 * size, y, colour, size)
        y += size * LINE_HEIGHT
    for row in rows:
        x = 16.0
        for text, colour in row:
            box = [round(size * x), round(y - 12 * size)], [round(size * (x + 14)), round(y + size)]
            cv2.rectangle(page, *box, colour, cv2.FILLED)
            cv2.rectangle(page, *box, FAINT, 1)
            _text(page, text, size * (x + 21), y, FAINT, size)
            x += _entry_width(text, size)
        y += size * LINE_HEIGHT
    return page


FONT, FONT_SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.52


def _text(
    page: NDArray[np.uint8], text: str, x: float, y: float, colour: Colour, size: float
) -> None:
    cv2.putText(page, text, (round(x), round(y)), FONT, size * FONT_SCALE, colour,
                max(1, round(size)), cv2.LINE_AA)


def _text_width(text: str, size: float) -> float:
    """Return the width of a text, in units of ``size`` pixels."""
    thickness = max(1, round(size))
    return float(cv2.getTextSize(text, FONT, size * FONT_SCALE, thickness)[0][0]) / size


def _entry_width(text: str, size: float) -> float:
    """Return the width of an entry of the legend, with its colour and the gap behind it."""
    return 21 + _text_width(text, size) + 20


def _wrapped(text: str, width: float, size: float) -> list[str]:
    """Return a text of parts behind commas as lines that are not wider, as far as parts are."""
    lines: list[str] = []
    for part in text.split(", ") if text else []:
        longer = f"{lines[-1]}, {part}" if lines else part
        if lines and _text_width(longer, size) <= width:
            lines[-1] = longer
        else:
            lines.append(part)
    return lines


def _drawn_text(scene: SceneInspection) -> str:
    """Return what was drawn at random for the scene; empty if nothing was."""
    drawn = ", ".join(
        f"{name} {float(value):.5g}" for name, value in scene.values.items()
        if name not in VARIABLES and value.ndim == 0)
    return f"drawn: {drawn}" if drawn else ""


def _result_text(scene: SceneInspection) -> str:
    """Return flags and errors in one line of ASCII, which is all that OpenCV's font has."""
    parts = [scene.detection.name.replace("_", " "), f"area {scene.area_px:.4g} px2"]
    if not math.isnan(scene.errors["rotation_error_deg"]):
        parts += [
            f"rotation error {scene.errors['rotation_error_deg']:.3g} deg",
            f"position error {1000 * scene.errors['translation_error_m']:.3g} mm",
            f"reprojection error {scene.errors['reprojection_error_px']:.2g} px",
        ]
    if scene.detection.name == "detected" and scene.estimate.name != "solved":
        parts.append(scene.estimate.name.replace("_", " "))
    return ", ".join(parts)


def css_colour(colour: Colour) -> str:
    """Return a colour as CSS has it.

    >>> css_colour((255, 128, 0))
    '#0080ff'
    """
    blue, green, red = colour
    return f"#{red:02x}{green:02x}{blue:02x}"
