"""One scene as a picture, with the truth and the detections drawn on it."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.evaluation.inspection import SceneInspection

Colour = tuple[int, int, int]

# Blue, green, red; of the palette of Okabe and Ito, distinguishable by the colour-blind.
TRUTH: Colour = (115, 158, 0)
DETECTED: Colour = (0, 94, 213)
OTHER: Colour = (167, 121, 204)
REJECTED: Colour = (66, 228, 240)
AXES: tuple[Colour, Colour, Colour] = ((0, 0, 230), (0, 170, 0), (230, 80, 0))
PAPER: Colour = (255, 255, 255)
INK: Colour = (40, 40, 40)
FAINT: Colour = (110, 110, 110)

LEGEND: tuple[tuple[str, Colour], ...] = (
    ("truth", TRUTH), ("detected (dot: first corner)", DETECTED), ("other detection", OTHER),
    ("rejected candidate", REJECTED), ("x", AXES[0]), ("y", AXES[1]), ("z", AXES[2]),
)
"""The meaning of the colours."""

MAX_SIDE = 900
MIN_SIDE = 560
LINE_HEIGHT = 26
CAPTION_HEIGHT = 3 * LINE_HEIGHT + 20
SHIFT = 4
"""Fractional bits of the drawn coordinates."""


def draw_scene(scene: SceneInspection, title: str) -> NDArray[np.uint8]:
    """Return a scene enlarged, (H, W, 3), blue-green-red, with a caption below it.

    Parameters
    ----------
    scene
        Image, truth and detections.
    title
        First line of the caption; the second holds flags and errors, the third the legend.
    """
    height, width = scene.image.shape
    scale = max(1, min(MAX_SIDE // max(height, width), 24))
    enlarged = cv2.resize(
        scene.image, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST
    )
    canvas = np.asarray(cv2.cvtColor(enlarged, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    origin = np.array(scene.window[:2], dtype=np.float64)
    weight = 2 if max(canvas.shape[:2]) < 1400 else 3

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
    for _, quad in scene.decoded:
        if not np.allclose(quad, scene.corners, atol=0.01):
            outline(quad, OTHER, weight)
    outline(scene.true_corners, TRUTH, weight + 3)
    outline(scene.corners, DETECTED, weight)
    if np.isfinite(scene.corners).all():
        for k, corner in enumerate(at(scene.corners).tolist()):
            filled = cv2.FILLED if k == 0 else weight
            cv2.circle(
                canvas, corner, 6 << SHIFT, DETECTED, filled, cv2.LINE_AA, SHIFT
            )
    if np.isfinite(scene.axes_px).all():
        ends = at(scene.axes_px).tolist()
        for colour, end in zip(AXES, ends[1:], strict=True):
            cv2.line(canvas, ends[0], end, colour, weight + 1, cv2.LINE_AA, SHIFT)
    return _captioned(canvas, scene, title)


def _captioned(canvas: NDArray[np.uint8], scene: SceneInspection, title: str) -> NDArray[np.uint8]:
    """Return the picture with title, result and legend below it."""
    lines = [(title, INK), (_result_text(scene), INK)]
    legend = [LEGEND[0]]
    if np.isfinite(scene.corners).all():
        legend.append(LEGEND[1])
    if len(scene.decoded) > int(np.isfinite(scene.corners).all()):
        legend.append(LEGEND[2])
    if scene.rejected:
        legend.append((f"rejected: {len(scene.rejected)}", REJECTED))
    if np.isfinite(scene.axes_px).all():
        legend += LEGEND[-3:]
    widest = max(_text_width(text) for text, _ in lines) + 32
    width = max(canvas.shape[1], MIN_SIDE, widest)
    height = canvas.shape[0] + CAPTION_HEIGHT
    page = np.full((height, width, 3), PAPER, dtype=np.uint8)
    left = (width - canvas.shape[1]) // 2
    page[: canvas.shape[0], left : left + canvas.shape[1]] = canvas
    y = canvas.shape[0] + LINE_HEIGHT
    for text, colour in lines:
        _text(page, text, 16, y, colour)
        y += LINE_HEIGHT
    x = 16
    for text, colour in legend:
        cv2.rectangle(page, (x, y - 12), (x + 14, y + 1), colour, cv2.FILLED)
        cv2.rectangle(page, (x, y - 12), (x + 14, y + 1), FAINT, 1)
        _text(page, text, x + 21, y, FAINT)
        x += 21 + _text_width(text) + 20
    return page


FONT, FONT_SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.52


def _text(page: NDArray[np.uint8], text: str, x: int, y: int, colour: Colour) -> None:
    cv2.putText(page, text, (x, y), FONT, FONT_SCALE, colour, 1, cv2.LINE_AA)


def _text_width(text: str) -> int:
    return int(cv2.getTextSize(text, FONT, FONT_SCALE, 1)[0][0])


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
