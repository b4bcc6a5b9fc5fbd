"""Conventions of other programs, and their detections and poses in those of OpenCV."""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sweep.errors import ArgumentError
from sweep.typing import Floats

CORNERS = ("TL", "TR", "BR", "BL")

DIRECTIONS = {
    "right": (1, 0, 0), "left": (-1, 0, 0), "up": (0, 1, 0), "down": (0, -1, 0), "out": (0, 0, 1),
    "in": (0, 0, -1),
}
"""Directions of the marker as a viewer sees it upright -> in the marker frame of OpenCV's ArUco."""


@dataclass(frozen=True, slots=True)
class Conventions:
    """How a program writes what it found.

    Attributes
    ----------
    pixel_center
        The coordinate of the centre of the first pixel in x and y.
    corner_order
        Which corner comes at each of the four places.
    frame
        The directions of the marker's x, y and z, as a viewer sees the upright marker.

    Examples
    --------
    >>> Conventions.of("0.5", "TR TL BL BR", "right,down,in").corner_order
    ('TR', 'TL', 'BL', 'BR')
    """

    pixel_center: float = 0.0
    corner_order: tuple[str, ...] = CORNERS
    frame: tuple[str, ...] = ("right", "up", "out")

    @staticmethod
    def of(pixel_center: str | float, corner_order: str, frame: str) -> Conventions:
        """Return the conventions of words as the command line has them.

        Raises
        ------
        ArgumentError
            If one of them cannot be.
        """
        try:
            center = float(pixel_center)
        except ValueError:
            center = np.nan
        if not -1 <= center <= 1:
            raise ArgumentError("pixel_center", pixel_center, "expected 0 or 0.5")
        corners = tuple(_words(corner_order.upper()))
        if sorted(corners) != sorted(CORNERS):
            raise ArgumentError(
                "corner_order", repr(corner_order),
                "expected TL, TR, BR and BL, each once, in the program's order, as in "
                '"TR TL BL BR"',
            )
        directions = tuple(_words(frame.lower()))
        matrix = np.array([DIRECTIONS.get(word, (0, 0, 0)) for word in directions])
        if matrix.shape != (3, 3) or round(float(np.linalg.det(matrix))) != 1:
            raise ArgumentError(
                "frame", repr(frame), "expected the directions of x, y and z among right, left, "
                'up, down, out, in, of a right-handed frame, as in "right down in"',
            )
        return Conventions(center, corners, directions)

    def corners(self, theirs: Floats) -> Floats:
        """Return corners (N, 4, 2) in our order and pixels."""
        order = [self.corner_order.index(name) for name in CORNERS]
        return np.asarray(theirs[:, order] - self.pixel_center)

    def rotations(self, theirs: Floats) -> Floats:
        """Return rotations (N, 3, 3) of our marker frame, of those of theirs."""
        return np.asarray(theirs @ frame_axes(self.frame))


def frame_axes(frame: tuple[str, ...]) -> NDArray[np.float64]:
    """Return the rotation (3, 3) from our marker frame to one of given directions.

    Its rows are the frame's axes in ours: a point is ours = axesᵀ · theirs.
    """
    return np.array([DIRECTIONS[word] for word in frame], dtype=np.float64)


def right_handed_frames() -> list[tuple[str, ...]]:
    """Return the 24 right-handed frames along the marker's sides and normal."""
    return [
        words for words in itertools.permutations(DIRECTIONS, 3)
        if round(float(np.linalg.det(frame_axes(words)))) == 1
    ]


def _words(text: str) -> list[str]:
    return [word for word in re.split(r"[\s,;]+", text) if word]
