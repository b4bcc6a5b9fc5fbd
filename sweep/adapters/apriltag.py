"""AprilTag's C library, in the packages that wrap it: pyapriltags, pupil-apriltags."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sweep.adapters import adapter
from sweep.plugins import DetectorPlugin, Markers, parameter

# --------------------------------------------------------------------------------------------------
# Common to the wrappers of AprilTag's C library: families, settings, the order of corners.

#: AprilTag's corners run counter-clockwise from the bottom left of its own bitmap, which OpenCV's
#: dictionaries have turned by 180°. Its coordinates have the image's top left corner at the origin.
CONVENTIONS: dict[str, Any] = {"corner_order": (1, 0, 3, 2), "pixel_center": 0.5}

#: Families that OpenCV lacks; they are drawn as AprilTag draws them.
OWN_FAMILIES = (
    "tagCircle21h7", "tagCircle49h12", "tagCustom48h12", "tagStandard41h12", "tagStandard52h13",
)

#: Dictionaries by AprilTag's names. (DICT_APRILTAG_36h10 no wrapper offers.)
FAMILIES = {
    "DICT_APRILTAG_16h5": "tag16h5", "DICT_APRILTAG_25h9": "tag25h9",
    "DICT_APRILTAG_36h11": "tag36h11", **{name: name for name in OWN_FAMILIES},
}


@dataclass(frozen=True)
class AprilTagSettings:
    """The settings of AprilTag's C library that all wrappers pass on, by its names and defaults.

    The wrappers' defaults are the same, ``quad_decimate`` included.
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

    Markers of AprilTag's own families are turned by 180°: there the order of corners
    belongs to bitmaps as AprilTag draws them.
    """
    corners = np.array([quad for _, quad in found], dtype=np.float64).reshape(-1, 4, 2)
    if family in OWN_FAMILIES:
        corners = np.roll(corners, 2, axis=1)
    return Markers(corners, np.array([number for number, _ in found], dtype=np.int64))


def wrapper(package: str, meaning: str) -> DetectorPlugin:
    """Return the plug-in of a package that wraps the C library by ctypes.

    Both have the same class ``Detector``: one is the other's descendant.
    """

    def make(settings: AprilTagSettings, family: str) -> Callable[[Any], Markers]:
        detector = importlib.import_module(package.replace("-", "_")).Detector(
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

    return adapter(package, meaning, make, AprilTagSettings, FAMILIES, **CONVENTIONS)


#: Before AprilTag's fix of edges, and with it.
PUPIL_APRILTAGS = wrapper("pupil-apriltags", "AprilTag's C library 3.1")
PYAPRILTAGS = wrapper("pyapriltags", "AprilTag's C library 3.4")


# --------------------------------------------------------------------------------------------------
# The detector of the package robotpy-apriltag: WPILib's, with more of the C library's settings.

@dataclass(frozen=True)
class WPILibSettings(AprilTagSettings):
    """Settings that only WPILib passes on, by the C library's names and with WPILib's defaults."""

    min_cluster_pixels: int = parameter(
        300, "WPILib: smallest cluster of edge pixels (the C library's own default: 5)", unit="px",
        low=0, high=10**6,
    )
    max_nmaxima: int = parameter(
        10, "WPILib: most corner candidates of a cluster", low=4, high=1000
    )
    critical_angle_deg: float = parameter(
        45.0, "WPILib: edges closer than this to straight or to reversal make no corner (the C "
        "library's own default: 10)", unit="degree", low=0, high=90,
    )
    max_line_fit_mse: float = parameter(
        10.0, "WPILib: largest mean squared error of a line fit", unit="px²", low=0, high=1e6
    )
    min_white_black_diff: int = parameter(
        5, "WPILib: smallest contrast of a tile", unit="grey level", low=0, high=255
    )
    deglitch: bool = parameter(False, "WPILib: clean up the threshold, for noisy images")


def make(settings: WPILibSettings, family: str) -> Callable[[Any], Markers]:
    """Return the search for markers of one family."""
    import robotpy_apriltag  # noqa: PLC0415  (optional)

    detector = robotpy_apriltag.AprilTagDetector()
    config = detector.getConfig()
    config.numThreads = 1
    config.quadDecimate = settings.quad_decimate
    config.quadSigma = settings.quad_sigma
    config.refineEdges = settings.refine_edges
    config.decodeSharpening = settings.decode_sharpening
    detector.setConfig(config)
    quads = detector.getQuadThresholdParameters()
    quads.minClusterPixels = settings.min_cluster_pixels
    quads.maxNumMaxima = settings.max_nmaxima
    quads.criticalAngle = math.radians(settings.critical_angle_deg)
    quads.maxLineFitMSE = settings.max_line_fit_mse
    quads.minWhiteBlackDiff = settings.min_white_black_diff
    quads.deglitch = settings.deglitch
    detector.setQuadThresholdParameters(quads)
    if not detector.addFamily(family, settings.max_hamming):
        raise ValueError(f"robotpy-apriltag has no family {family}")

    def search(image: Any) -> Markers:
        found = []
        for tag in detector.detect(image):
            if tag.getDecisionMargin() < settings.min_decision_margin:
                continue
            corners = [tag.getCorner(index) for index in range(4)]
            found.append((tag.getId(), [(corner.x, corner.y) for corner in corners]))
        return markers(family, found)

    return search


ROBOTPY_APRILTAG = adapter(
    "robotpy-apriltag", "WPILib's build of AprilTag's C library", make, WPILibSettings,
    {"DICT_APRILTAG_16h5": "tag16h5", "DICT_APRILTAG_36h11": "tag36h11"},
    "robotpy-native-apriltag", **CONVENTIONS,
)
