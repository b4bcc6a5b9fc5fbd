"""One scene as a picture, with what was found drawn on it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.evaluation.inspection import SceneInspection

Colour = tuple[int, int, int]

# Blue, green, red. Okabe and Ito's palette, told apart by the colour-blind.
TRUTH: Colour = (115, 158, 0)
FOUND: Colour = (0, 94, 213)
OTHER: Colour = (167, 121, 204)
REJECTED: Colour = (66, 228, 240)
AXES: tuple[Colour, Colour, Colour] = ((0, 0, 230), (0, 170, 0), (230, 80, 0))
PAPER: Colour = (255, 255, 255)
INK: Colour = (40, 40, 40)
FAINT: Colour = (110, 110, 110)

MAX_SIDE = 900
MIN_SIDE = 560
LINE_HEIGHT = 26
SHIFT = 4
"""Fractional bits of the drawn coordinates."""


def draw_scene(look: SceneInspection, title: str) -> NDArray[np.uint8]:
    """Return a scene's picture (H, W, 3), blue-green-red, enlarged, with a caption below it."""
    height, width = look.image.shape
    scale = max(1, min(MAX_SIDE // max(height, width), 24))
    enlarged = cv2.resize(
        look.image, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST
    )
    canvas = np.asarray(cv2.cvtColor(enlarged, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    origin = np.array(look.window[:2], dtype=np.float64)
    weight = 2 if max(canvas.shape[:2]) < 1400 else 3

    def at(points: NDArray[np.float64]) -> NDArray[np.int32]:
        """Return pixels of the frame as fixed-point coordinates of the picture."""
        # The middle of pixel 0 lies half an enlarged pixel inside the picture.
        moved = (points - origin + 0.5) * scale - 0.5
        clipped = np.clip(moved, -1e6, 1e6)
        return np.asarray(np.round(clipped * 2**SHIFT), dtype=np.int32)

    def outline(points: NDArray[np.float64], colour: Colour, thickness: int) -> None:
        if np.isfinite(points).all():
            cv2.polylines(
                canvas, [at(points).reshape(-1, 1, 2)], isClosed=True, color=colour,
                thickness=thickness, lineType=cv2.LINE_AA, shift=SHIFT,
            )

    for quad in look.rejected:
        outline(quad, REJECTED, 1)
    for _, quad in look.decoded:
        if not np.allclose(quad, look.corners, atol=0.01):
            outline(quad, OTHER, weight)
    outline(look.true_corners, TRUTH, weight + 3)
    outline(look.corners, FOUND, weight)
    if np.isfinite(look.corners).all():
        for k, corner in enumerate(at(look.corners).tolist()):
            filled = cv2.FILLED if k == 0 else weight
            cv2.circle(
                canvas, corner, 6 << SHIFT, FOUND, filled, cv2.LINE_AA, SHIFT
            )
    if np.isfinite(look.axes_px).all():
        ends = at(look.axes_px).tolist()
        for colour, end in zip(AXES, ends[1:], strict=True):
            cv2.line(canvas, ends[0], end, colour, weight + 1, cv2.LINE_AA, SHIFT)
    return _captioned(canvas, look, title)


def _captioned(canvas: NDArray[np.uint8], look: SceneInspection, title: str) -> NDArray[np.uint8]:
    """Return the picture with its legend and figures below it."""
    lines = [(title, INK), (_figures(look), INK)]
    legend = [("truth", TRUTH)]
    if np.isfinite(look.corners).all():
        legend.append(("found (dot: first corner)", FOUND))
    if len(look.decoded) > int(np.isfinite(look.corners).all()):
        legend.append(("other ID or place", OTHER))
    if look.rejected:
        legend.append((f"rejected: {len(look.rejected)}", REJECTED))
    if np.isfinite(look.axes_px).all():
        legend += [("x", AXES[0]), ("y", AXES[1]), ("z", AXES[2])]
    widest = max(_text_width(text) for text, _ in lines) + 32
    width = max(canvas.shape[1], MIN_SIDE, widest)
    height = canvas.shape[0] + LINE_HEIGHT * 3 + 20
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


def _figures(look: SceneInspection) -> str:
    """Return what was found, and how far off it is, in one line."""
    parts = [look.detection.name.replace("_", " "), f"area {look.area_px:.4g} px2"]
    if look.errors["rotation_error_deg"] == look.errors["rotation_error_deg"]:
        parts += [
            f"rotation off by {look.errors['rotation_error_deg']:.3g} deg",
            f"position by {1000 * look.errors['translation_error_m']:.3g} mm",
            f"reprojection {look.errors['reprojection_error_px']:.2g} px",
        ]
    if look.detection.name == "detected" and look.estimate.name != "solved":
        parts.append(look.estimate.name.replace("_", " "))
    return ", ".join(parts)
