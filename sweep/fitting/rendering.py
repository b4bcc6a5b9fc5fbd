"""The simulator's exact image of what is printed, drawn from the corners of a marker."""

from __future__ import annotations

import cv2
import numpy as np

from sweep.compilation import compiled
from sweep.model import coverage
from sweep.model.coverage import MarkerEdges
from sweep.model.lens import undistort
from sweep.model.projection import Optics, Projection
from sweep.typing import Floats


@compiled
def _rays(pixels: Floats, optics: Optics) -> Floats:
    """Return the undistorted directions x/z, y/z (n, 2) of pixels (n, 2)."""
    rays = np.empty_like(pixels)
    fx, fy, cx, cy = optics.intrinsics
    for k in range(len(pixels)):
        x, y = (pixels[k, 0] - cx) / fx, (pixels[k, 1] - cy) / fy
        if optics.distorted:
            x, y, _ = undistort(x, y, optics.lens)
        rays[k, 0], rays[k, 1] = x, y
    return rays


def module_plane(corners_px: Floats, modules: int, optics: Optics) -> Floats:
    """Return a plane (3, 3) that takes a square of modules to four corners (4, 2) in pixels."""
    rays = _rays(np.ascontiguousarray(corners_px), optics)
    square = modules * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    rows = []
    for (u, v), (x, y) in zip(square.tolist(), rays.tolist(), strict=True):
        rows.append([u, v, 1, 0, 0, 0, -x * u, -x * v])
        rows.append([0, 0, 0, u, v, 1, -y * u, -y * v])
    solution = np.linalg.solve(np.array(rows), rays.ravel())
    return np.append(solution, 1.0).reshape(3, 3)


def module_points(plane: Floats, optics: Optics, height: int, width: int) -> Floats:
    """Return the column and row in modules (2, height, width) of the pixels of a box."""
    columns, rows = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    rays = _rays(np.stack([columns.ravel(), rows.ravel()], axis=1), optics)
    flat = cv2.perspectiveTransform(rays[None], np.linalg.inv(plane))[0]
    return np.asarray(flat.T.reshape(2, height, width), dtype=np.float64)


def shares(
    edges: MarkerEdges, values: Floats, plane: Floats, optics: Optics, size: tuple[int, int],
    blur_px: float, shift: tuple[float, float] = (0.0, 0.0),
) -> Floats:
    """Return the image (height, width) of values (3,) of outside, black and white.

    ``shift`` moves it right and down, in px. Beyond the edges is the value of black.
    """
    height, width = size
    intrinsics = optics.intrinsics.copy()
    intrinsics[2:] += shift
    cover, image = np.zeros((height, width + 2)), np.empty(size)
    coverage.accumulate(
        cover, edges, values, Projection(plane, Optics(intrinsics, optics.lens, optics.distorted)),
        0, 0, blur_px,
    )
    coverage.sum_levels(cover, float(values[1]), image)
    return image
