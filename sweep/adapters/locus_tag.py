"""The detector of the package locus-tag, for AprilTag's and ArUco's dictionaries."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sweep.plugins import DetectorPlugin, Markers, parameter

FAMILIES = {
    "DICT_4X4_50": "ArUco4x4_50",
    "DICT_4X4_100": "ArUco4x4_100",
    "DICT_6X6_250": "ArUco6x6_250",
    "DICT_APRILTAG_16h5": "AprilTag16h5",
    "DICT_APRILTAG_36h11": "AprilTag36h11",
    "DICT_ARUCO_MIP_36h12": "ArUcoMip36h12",
}


@dataclass(frozen=True)
class LocusSettings:
    """The profile, and what is chosen beside it."""

    locus_profile: str = parameter(
        "standard", "Locus: the shipped profile of settings",
        choices=("standard", "grid", "high_accuracy"),
    )
    locus_decimation: int = parameter(
        1, "Locus: decimation of the image before the search", low=1, high=64
    )


def make(settings: LocusSettings, family: str) -> Callable[[Any], Markers]:
    """Return the search for markers of one family."""
    import locus  # noqa: PLC0415  (optional)

    detector = locus.Detector(
        profile=settings.locus_profile, decimation=settings.locus_decimation, threads=1,
        families=[getattr(locus.TagFamily, family)],
    )

    def search(image: Any) -> Markers:
        found = detector.detect(image)
        return Markers(found.corners, found.ids, found.rejected_corners)

    return search


DETECTOR = DetectorPlugin(
    make=make, settings=LocusSettings, meaning="Locus (locus-tag)", distribution="locus-tag",
    install="pip install 'fiducial-sweep[locus-tag]'", families=FAMILIES, pixel_center=0.5,
)
