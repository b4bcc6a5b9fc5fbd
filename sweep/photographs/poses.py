"""Poses of markers in photographs, as they are gathered."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sweep.measure.flags import TruthSource
from sweep.typing import Floats, Masks


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Poses of M markers in P photographs: NaN where a marker is not there, or its pose unknown.

    Attributes
    ----------
    rotation, translation
        (P, M, 3, 3) and (P, M, 3) m, marker to camera.
    std
        (P, M, 6) standard deviations: rotation vector (rad) and position (m), camera frame.
    source
        (P, M) :class:`~sweep.measure.flags.TruthSource`.
    """

    rotation: Floats
    translation: Floats
    std: Floats
    source: NDArray[np.uint8]

    @staticmethod
    def none(photographs: int, markers: int) -> Poses:
        """Return no pose of any marker."""
        grid = (photographs, markers)
        return Poses(
            np.full((*grid, 3, 3), np.nan), np.full((*grid, 3), np.nan),
            np.full((*grid, 6), np.nan), np.zeros(grid, dtype=np.uint8),
        )

    def put(
        self, photograph: int, marker: int, rotation: Floats, translation: Floats, std: Floats,
        source: TruthSource,
    ) -> None:
        """Take a pose."""
        self.rotation[photograph, marker] = rotation
        self.translation[photograph, marker] = translation
        self.std[photograph, marker] = std
        self.source[photograph, marker] = source

    @property
    def known(self) -> Masks:
        """Which poses there are, (P, M)."""
        return np.asarray(np.isfinite(self.translation).all(axis=2))
