"""The detector of the package stag-python, for STag's own markers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sweep.adapters import adapter
from sweep.plugins import DetectorPlugin, Markers, parameter

LIBRARIES = {f"STAG_HD{distance}": str(distance) for distance in range(11, 25, 2)}


@dataclass(frozen=True)
class StagSettings:
    """What STag lets choose."""

    error_correction: int = parameter(
        -1, "STag: most wrong bits of a marker that is taken; -1: half of the library's distance",
        -1, 11)


def make(settings: StagSettings, library: str) -> Callable[[Any], Markers]:
    """Return the search for markers of one library."""
    import stag  # noqa: PLC0415  (optional)

    most = (int(library) - 1) // 2
    if settings.error_correction > most:
        raise ValueError(
            f"error_correction = {settings.error_correction}: HD{library} allows at most {most}")

    def search(image: Any) -> Markers:
        corners, ids, rejected = stag.detectMarkers(
            image, int(library), settings.error_correction)
        return Markers(
            np.reshape(corners, (-1, 4, 2)), np.ravel(np.asarray(ids, dtype=np.int64)),
            np.reshape(rejected, (-1, 4, 2)))

    return search


DETECTOR = adapter(
    DetectorPlugin, "stag-python", "STag", make, StagSettings, families=LIBRARIES)
