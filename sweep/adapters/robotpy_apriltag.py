"""The detector of the package robotpy-apriltag: WPILib's, with more of the C library's settings."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sweep.adapters.apriltag import (
    CORNER_ORDER,
    OPENCV_FAMILIES,
    PIXEL_CENTER,
    AprilTagSettings,
    markers,
)
from sweep.plugins import DetectorPlugin, Markers, parameter


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


DETECTOR = DetectorPlugin(
    make=make, settings=WPILibSettings,
    meaning="WPILib's build of AprilTag's C library (robotpy-apriltag)",
    distribution=("robotpy-apriltag", "robotpy-native-apriltag"),
    install="pip install 'fiducial-sweep[robotpy-apriltag]'",
    families={
        name: family for name, family in OPENCV_FAMILIES.items()
        if family in ("tag16h5", "tag36h11")
    },
    corner_order=CORNER_ORDER, pixel_center=PIXEL_CENTER,
)
