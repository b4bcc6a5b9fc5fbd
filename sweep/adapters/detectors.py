"""The detectors of other packages: AprilTag's C library in three of them, Locus, STag.

A package is imported only when its detector is made.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from sweep.plugins import DetectorPlugin, Markers, parameter


def adapter(
    package: str, meaning: str, make: Callable[..., Any], settings: type[Any], **fields: Any
) -> DetectorPlugin:
    """Return the detector of a package that is an extra of ours, with other ``fields`` of it."""
    return DetectorPlugin(**{
        "make": make, "settings": settings, "meaning": f"{meaning} ({package})",
        "distribution": package, "install": f"pip install 'fiducial-sweep[{package}]'", **fields,
    })


# --------------------------------------------------------------------------------------------------
# AprilTag's C library, in three packages: pyapriltags, pupil-apriltags, robotpy-apriltag.

#: Families that OpenCV lacks; they are drawn as AprilTag draws them.
OWN_FAMILIES = (
    "tagCircle21h7", "tagCircle49h12", "tagCustom48h12", "tagStandard41h12", "tagStandard52h13",
)

#: Dictionaries by AprilTag's names. (DICT_APRILTAG_36h10 no package offers.)
FAMILIES = {
    "DICT_APRILTAG_16h5": "tag16h5", "DICT_APRILTAG_25h9": "tag25h9",
    "DICT_APRILTAG_36h11": "tag36h11", **{name: name for name in OWN_FAMILIES},
}


@dataclass(frozen=True)
class AprilTagSettings:
    """The settings of AprilTag's C library that all packages pass on, by its names and defaults.

    The packages' defaults are the same, ``quad_decimate`` included.
    """

    quad_decimate: float = parameter(
        2.0, "AprilTag: decimation of the image before the search for quadrilaterals", 1, 64)
    quad_sigma: float = parameter(
        0.0, "AprilTag: Gaussian blur (negative: sharpening) before the search", -100, 100,
        unit="px")
    refine_edges: bool = parameter(
        True, "AprilTag: move the edges of quadrilaterals to strong gradients near them")
    decode_sharpening: float = parameter(
        0.25, "AprilTag: sharpening of the bits before they are read (pyapriltags and "
        "pupil-apriltags cut it to a whole number: 0.25 is 0)", 0, 100)
    max_hamming: int = parameter(2, "AprilTag: most wrong bits of a marker that is taken", 0, 2)
    min_decision_margin: float = parameter(
        0.0, "AprilTag: smallest contrast between bits and their threshold of a marker that is "
        "taken", 0, 255, unit="grey level")


#: A search of an image for markers, each with its ID, corners (4, 2) and contrast of bits.
Search = Callable[[Any], Iterable[tuple[int, Any, float]]]


def apriltag(
    package: str, meaning: str, search_with: Callable[[ModuleType, Any, str], Search], **fields: Any
) -> DetectorPlugin:
    """Return a package's plug-in; ``search_with`` it, settings and a family returns its search.

    AprilTag's corners run counter-clockwise from the bottom left of its own bitmap, which OpenCV's
    dictionaries have turned by 180°. Its coordinates have the image's top left corner at the
    origin.
    """

    def make(settings: AprilTagSettings, family: str) -> Callable[[Any], Markers]:
        search = search_with(importlib.import_module(package.replace("-", "_")), settings, family)

        def markers(image: Any) -> Markers:
            found = [(number, quad) for number, quad, contrast in search(image)
                     if contrast >= settings.min_decision_margin]
            corners = np.array([quad for _, quad in found], dtype=np.float64).reshape(-1, 4, 2)
            if family in OWN_FAMILIES:  # the order belongs to bitmaps as AprilTag draws them
                corners = np.roll(corners, 2, axis=1)
            return Markers(corners, np.array([number for number, _ in found], dtype=np.int64))

        return markers

    return adapter(package, meaning, make, **{
        "settings": AprilTagSettings, "families": FAMILIES, "corner_order": (1, 0, 3, 2),
        "pixel_center": 0.5, **fields})


def by_ctypes(package: ModuleType, settings: AprilTagSettings, family: str) -> Search:
    """Return the search with the class ``Detector`` of one of two packages, of one descent."""
    detector = package.Detector(
        families=family, nthreads=1, quad_decimate=settings.quad_decimate,
        quad_sigma=settings.quad_sigma, refine_edges=int(settings.refine_edges),
        decode_sharpening=settings.decode_sharpening)
    return lambda image: [(tag.tag_id, tag.corners, tag.decision_margin)
                          for tag in detector.detect(image)
                          if tag.hamming <= settings.max_hamming]


#: Before AprilTag's fix of edges, and with it.
PUPIL_APRILTAGS = apriltag("pupil-apriltags", "AprilTag's C library 3.1", by_ctypes)
PYAPRILTAGS = apriltag("pyapriltags", "AprilTag's C library 3.4", by_ctypes)


@dataclass(frozen=True)
class WPILibSettings(AprilTagSettings):
    """Settings that only WPILib passes on, by the C library's names and with WPILib's defaults."""

    min_cluster_pixels: int = parameter(
        300, "WPILib: smallest cluster of edge pixels (the C library's own default: 5)", 0, 10**6,
        unit="px")
    max_nmaxima: int = parameter(10, "WPILib: most corner candidates of a cluster", 4, 1000)
    critical_angle_deg: float = parameter(
        45.0, "WPILib: edges closer than this to straight or to reversal make no corner (the C "
        "library's own default: 10)", 0, 90, unit="degree")
    max_line_fit_mse: float = parameter(
        10.0, "WPILib: largest mean squared error of a line fit", 0, 1e6, unit="px²")
    min_white_black_diff: int = parameter(
        5, "WPILib: smallest contrast of a tile", 0, 255, unit="grey level")
    deglitch: bool = parameter(False, "WPILib: clean up the threshold, for noisy images")


def with_wpilib(package: ModuleType, settings: WPILibSettings, family: str) -> Search:
    """Return the search with WPILib's detector."""
    detector = package.AprilTagDetector()
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
    return lambda image: [
        (tag.getId(), [(point.x, point.y) for point in map(tag.getCorner, range(4))],
         tag.getDecisionMargin())
        for tag in detector.detect(image)]


ROBOTPY_APRILTAG = apriltag(
    "robotpy-apriltag", "WPILib's build of AprilTag's C library", with_wpilib,
    settings=WPILibSettings, distribution=("robotpy-apriltag", "robotpy-native-apriltag"),
    families={"DICT_APRILTAG_16h5": "tag16h5", "DICT_APRILTAG_36h11": "tag36h11"})


# --------------------------------------------------------------------------------------------------
# Locus.

#: Of AprilTag's and ArUco's dictionaries.
LOCUS_FAMILIES = {
    "DICT_4X4_50": "ArUco4x4_50",
    "DICT_4X4_100": "ArUco4x4_100",
    "DICT_6X6_250": "ArUco6x6_250",
    "DICT_APRILTAG_16h5": "AprilTag16h5",
    "DICT_APRILTAG_36h11": "AprilTag36h11",
    "DICT_ARUCO_MIP_36h12": "ArUcoMip36h12",
}

LOCUS_PROFILES = ("standard", "grid", "high_accuracy")


@dataclass(frozen=True)
class LocusSettings:
    """The profile, and choices beside it."""

    locus_profile: str = parameter(
        "standard", "Locus: the shipped profile of settings", choices=LOCUS_PROFILES)
    locus_decimation: int = parameter(
        1, "Locus: decimation of the image before the search", 1, 64)


def locus_search(settings: LocusSettings, family: str) -> Callable[[Any], Markers]:
    """Return the search for markers of one family."""
    import locus  # noqa: PLC0415  (optional)

    detector = locus.Detector(
        profile=settings.locus_profile, decimation=settings.locus_decimation, threads=1,
        families=[getattr(locus.TagFamily, family)])

    def search(image: Any) -> Markers:
        found = detector.detect(image)
        return Markers(found.corners, found.ids, found.rejected_corners)

    return search


LOCUS = adapter(
    "locus-tag", "Locus", locus_search, LocusSettings, families=LOCUS_FAMILIES, pixel_center=0.5)


# --------------------------------------------------------------------------------------------------
# STag, for markers of its own.

LIBRARIES = {f"STAG_HD{distance}": str(distance) for distance in range(11, 25, 2)}


@dataclass(frozen=True)
class StagSettings:
    """What STag lets choose."""

    error_correction: int = parameter(
        -1, "STag: most wrong bits of a marker that is taken; -1: half of the library's distance",
        -1, 11)


def stag_search(settings: StagSettings, library: str) -> Callable[[Any], Markers]:
    """Return the search for markers of one library."""
    import stag  # noqa: PLC0415  (optional)

    def search(image: Any) -> Markers:
        corners, ids, rejected = stag.detectMarkers(
            image, int(library), settings.error_correction)
        return Markers(
            np.reshape(corners, (-1, 4, 2)), np.ravel(ids), np.reshape(rejected, (-1, 4, 2)))

    return search


STAG = adapter("stag-python", "STag", stag_search, StagSettings, families=LIBRARIES)
