"""AprilTag's C library, in three packages: pyapriltags, pupil-apriltags, robotpy-apriltag."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sweep.adapters import adapter
from sweep.plugins import DetectorPlugin, Markers, parameter

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
    package: str, meaning: str, search_with: Callable[[Any, str], Search], **fields: Any
) -> DetectorPlugin:
    """Return a package's plug-in; ``search_with`` settings and a family returns its search.

    AprilTag's corners run counter-clockwise from the bottom left of its own bitmap, which OpenCV's
    dictionaries have turned by 180°. Its coordinates have the image's top left corner at the
    origin.
    """

    def make(settings: AprilTagSettings, family: str) -> Callable[[Any], Markers]:
        search = search_with(settings, family)

        def markers(image: Any) -> Markers:
            found = [(number, quad) for number, quad, contrast in search(image)
                     if contrast >= settings.min_decision_margin]
            corners = np.array([quad for _, quad in found], dtype=np.float64).reshape(-1, 4, 2)
            if family in OWN_FAMILIES:  # the order belongs to bitmaps as AprilTag draws them
                corners = np.roll(corners, 2, axis=1)
            return Markers(corners, np.array([number for number, _ in found], dtype=np.int64))

        return markers

    return adapter(DetectorPlugin, package, meaning, make, **{
        "settings": AprilTagSettings, "families": FAMILIES, "corner_order": (1, 0, 3, 2),
        "pixel_center": 0.5, **fields})


def by_ctypes(module: str) -> Callable[[Any, str], Search]:
    """Return the search with the class ``Detector`` of one of two modules, of one descent."""

    def search_with(settings: AprilTagSettings, family: str) -> Search:
        detector = importlib.import_module(module).Detector(
            families=family, nthreads=1, quad_decimate=settings.quad_decimate,
            quad_sigma=settings.quad_sigma, refine_edges=int(settings.refine_edges),
            decode_sharpening=settings.decode_sharpening)
        return lambda image: [(tag.tag_id, tag.corners, tag.decision_margin)
                              for tag in detector.detect(image)
                              if tag.hamming <= settings.max_hamming]

    return search_with


#: Before AprilTag's fix of edges, and with it.
PUPIL_APRILTAGS = apriltag(
    "pupil-apriltags", "AprilTag's C library 3.1", by_ctypes("pupil_apriltags"))
PYAPRILTAGS = apriltag("pyapriltags", "AprilTag's C library 3.4", by_ctypes("pyapriltags"))


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


def with_wpilib(settings: WPILibSettings, family: str) -> Search:
    """Return the search with WPILib's detector."""
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
    return lambda image: [
        (tag.getId(), [(point.x, point.y) for point in map(tag.getCorner, range(4))],
         tag.getDecisionMargin())
        for tag in detector.detect(image)]


ROBOTPY_APRILTAG = apriltag(
    "robotpy-apriltag", "WPILib's build of AprilTag's C library", with_wpilib,
    settings=WPILibSettings, distribution=("robotpy-apriltag", "robotpy-native-apriltag"),
    families={"DICT_APRILTAG_16h5": "tag16h5", "DICT_APRILTAG_36h11": "tag36h11"})
