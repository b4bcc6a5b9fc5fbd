"""What the wrappers of AprilTag's C library share: families, settings, the order of corners."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sweep.plugins import DetectorPlugin, Markers, parameter

CORNER_ORDER = (1, 0, 3, 2)
"""AprilTag's corners run counter-clockwise from the bottom left of its own bitmap, which OpenCV's
dictionaries have turned by 180°."""

PIXEL_CENTER = 0.5
"""AprilTag's coordinates have the image's top left corner at the origin."""

OPENCV_FAMILIES = {
    "DICT_APRILTAG_16h5": "tag16h5",
    "DICT_APRILTAG_25h9": "tag25h9",
    "DICT_APRILTAG_36h11": "tag36h11",
}
"""Dictionaries of OpenCV by AprilTag's names. (DICT_APRILTAG_36h10 no wrapper offers.)"""

OWN_FAMILIES = (
    "tagCircle21h7", "tagCircle49h12", "tagCustom48h12", "tagStandard41h12", "tagStandard52h13",
)
"""Families that OpenCV lacks; they are drawn as AprilTag draws them."""

FAMILIES = {**OPENCV_FAMILIES, **{name: name for name in OWN_FAMILIES}}


@dataclass(frozen=True)
class AprilTagSettings:
    """The settings of AprilTag's C library that all wrappers pass on, by its names and defaults.

    The wrappers' defaults are the same, also that of ``quad_decimate``.
    """

    quad_decimate: float = parameter(
        2.0, "AprilTag: decimation of the image before the search for quadrilaterals", low=1,
        high=64,
    )
    quad_sigma: float = parameter(
        0.0, "AprilTag: Gaussian blur (negative: sharpening) before the search", unit="px",
        low=-100, high=100,
    )
    refine_edges: bool = parameter(
        True, "AprilTag: move the edges of quadrilaterals to strong gradients near them"
    )
    decode_sharpening: float = parameter(
        0.25, "AprilTag: sharpening of the bits before they are read (pyapriltags and "
        "pupil-apriltags cut it to a whole number: 0.25 is 0)", low=0, high=100,
    )
    max_hamming: int = parameter(
        2, "AprilTag: most wrong bits of a marker that is taken", low=0, high=2
    )
    min_decision_margin: float = parameter(
        0.0, "AprilTag: smallest contrast between bits and their threshold of a marker that is "
        "taken", unit="grey level", low=0, high=255,
    )


def markers(family: str, found: list[tuple[int, Any]]) -> Markers:
    """Return ID and corners (4, 2) of each marker, in the order of corners of tag families.

    Those of AprilTag's own families are turned by 180°: there :data:`CORNER_ORDER` is of bitmaps
    that are as AprilTag draws them.
    """
    corners = np.array([quad for _, quad in found], dtype=np.float64).reshape(-1, 4, 2)
    if family in OWN_FAMILIES:
        corners = np.roll(corners, 2, axis=1)
    return Markers(corners, np.array([number for number, _ in found], dtype=np.int64))


def wrapper_plugin(package: str, distribution: str, meaning: str) -> DetectorPlugin:
    """Return the plug-in of a package that wraps the C library by ctypes.

    Both have the same class ``Detector``: one is the other's descendant.
    """

    def make(settings: AprilTagSettings, family: str) -> Callable[[Any], Markers]:
        detector = importlib.import_module(package).Detector(
            families=family, nthreads=1, quad_decimate=settings.quad_decimate,
            quad_sigma=settings.quad_sigma, refine_edges=int(settings.refine_edges),
            decode_sharpening=settings.decode_sharpening,
        )

        def search(image: Any) -> Markers:
            return markers(family, [
                (tag.tag_id, tag.corners) for tag in detector.detect(image)
                if tag.hamming <= settings.max_hamming
                and tag.decision_margin >= settings.min_decision_margin
            ])

        return search

    return DetectorPlugin(
        make=make, settings=AprilTagSettings, meaning=meaning, distribution=distribution,
        install=f"pip install 'fiducial-sweep[{distribution}]'", families=FAMILIES,
        corner_order=CORNER_ORDER, pixel_center=PIXEL_CENTER,
    )
