"""OpenCV's ArUco detector, with equal results on a window and on the whole frame."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.declaration import parameter
from sweep.model.marker import opencv_dictionary

REFINEMENTS = {
    "none": cv2.aruco.CORNER_REFINE_NONE,
    "subpix": cv2.aruco.CORNER_REFINE_SUBPIX,
    "contour": cv2.aruco.CORNER_REFINE_CONTOUR,
    "apriltag": cv2.aruco.CORNER_REFINE_APRILTAG,
}


@dataclass(frozen=True, slots=True)
class DetectorSetting:
    """Every field of ``cv2.aruco.DetectorParameters``, by OpenCV's own name and default."""

    adaptiveThreshWinSizeMin: int = parameter(
        3, "smallest window of the adaptive threshold", unit="px", low=3, high=9999
    )
    adaptiveThreshWinSizeMax: int = parameter(
        23, "largest window of the adaptive threshold", unit="px", low=3, high=9999
    )
    adaptiveThreshWinSizeStep: int = parameter(
        10, "step between the windows of the adaptive threshold", unit="px", low=1, high=9999
    )
    adaptiveThreshConstant: float = parameter(
        7.0, "constant of the adaptive threshold", unit="grey level"
    )
    minMarkerPerimeterRate: float = parameter(
        0.03, "smallest perimeter of a candidate, relative to the image's larger side", low=0,
        open_low=True,
    )
    maxMarkerPerimeterRate: float = parameter(
        4.0, "largest perimeter of a candidate, relative to the image's larger side", low=0,
        high=10_000, open_low=True,
    )
    polygonalApproxAccuracyRate: float = parameter(
        0.03, "accuracy of the polygonal approximation, relative to the perimeter", low=0,
        open_low=True,
    )
    minCornerDistanceRate: float = parameter(
        0.05, "smallest distance between corners, relative to the perimeter", low=0
    )
    minDistanceToBorder: int = parameter(
        3, "smallest distance of a corner to the image's border", unit="px", low=0, high=9999
    )
    minMarkerDistanceRate: float = parameter(
        0.125, "smallest distance between markers' corners, relative to the perimeter", low=0
    )
    minGroupDistance: float = parameter(
        0.21, "smallest distance between corners in a group of candidates, relative to the "
        "perimeter", low=0,
    )
    cornerRefinementMethod: str = parameter(
        "none", "refinement of the corners (apriltag also replaces the search for candidates)",
        choices=tuple(REFINEMENTS), prefix="CORNER_REFINE_", numbers=tuple(REFINEMENTS.items()),
    )
    cornerRefinementWinSize: int = parameter(
        5, "largest half window of the sub-pixel refinement", unit="px", low=1, high=9999
    )
    relativeCornerRefinmentWinSize: float = parameter(
        0.3, "half window of the sub-pixel refinement, relative to the module", low=0,
        open_low=True,
    )
    cornerRefinementMaxIterations: int = parameter(
        30, "most iterations of the corner refinement", low=1, high=100_000
    )
    cornerRefinementMinAccuracy: float = parameter(
        0.1, "step at which the corner refinement stops", unit="px", low=0, open_low=True
    )
    markerBorderBits: int = parameter(
        1, "width of the border that the detector expects", unit="module", low=1, high=10
    )
    perspectiveRemovePixelPerCell: int = parameter(
        4, "samples along a side of a module", unit="px", low=1, high=1000
    )
    perspectiveRemoveIgnoredMarginPerCell: float = parameter(
        0.13, "margin of a module that is not sampled, relative to the module", low=0, high=0.499
    )
    maxErroneousBitsInBorderRate: float = parameter(
        0.35, "largest share of wrong bits in the border", low=0, high=1
    )
    minOtsuStdDev: float = parameter(
        5.0, "smallest standard deviation at which Otsu's threshold is taken",
        unit="grey level", low=0,
    )
    errorCorrectionRate: float = parameter(
        0.6, "error correction, relative to the dictionary's maximum", low=0, high=1
    )
    aprilTagQuadDecimate: float = parameter(
        0.0, "apriltag: decimation of the image before the search", low=0, high=64
    )
    aprilTagQuadSigma: float = parameter(
        0.0, "apriltag: Gaussian blur (negative: sharpening) before the search", unit="px",
        low=-100, high=100,
    )
    aprilTagMinClusterPixels: int = parameter(
        5, "apriltag: smallest cluster of edge pixels", unit="px", low=0, high=10**6
    )
    aprilTagMaxNmaxima: int = parameter(
        10, "apriltag: most corner candidates of a cluster", low=1, high=1000
    )
    aprilTagCriticalRad: float = parameter(
        0.1745329201221466, "apriltag: edges closer than this to straight or to reversal make no "
        "corner", unit="radian", low=0, high=3.1416,
    )
    aprilTagMaxLineFitMse: float = parameter(
        10.0, "apriltag: largest mean squared error of a line fit", unit="px²", low=0
    )
    aprilTagMinWhiteBlackDiff: int = parameter(
        5, "apriltag: smallest contrast of a tile", unit="grey level", low=0, high=255
    )
    aprilTagDeglitch: int = parameter(
        0, "apriltag: clean up the threshold; only 0: with 1 OpenCV's result depends on the "
        "images searched before (5-7 of 150 images, in 4.14 and 5.0)", low=0, high=0,
    )
    detectInvertedMarker: bool = parameter(False, "also search for white-on-black markers")
    useAruco3Detection: bool = parameter(
        False, "the faster search of ArUco 3 (always on the full frame)"
    )
    minSideLengthCanonicalImg: int = parameter(
        32, "ArUco 3: smallest side of a candidate in the canonical image", unit="px", low=1,
        high=10_000,
    )
    minMarkerLengthRatioOriginalImg: float = parameter(
        0.0, "ArUco 3: smallest marker, relative to the image's larger side", low=0, high=1
    )
    validBitIdThreshold: float = parameter(
        0.49, "share of a module's pixels from which its bit is uncertain", low=0, high=1
    )

    @classmethod
    def missing_fields(cls) -> set[str]:
        """Return the fields that the installed OpenCV does not have."""
        parameters = cv2.aruco.DetectorParameters()
        return {f.name for f in dataclasses.fields(cls) if not hasattr(parameters, f.name)}


ALIGNMENT_PX = 4
"""Windows begin and end at multiples of this: the tiles of the apriltag search are 4 px wide."""

MIN_WINDOW_PX = 8


def full_frame_reason(setting: DetectorSetting) -> str | None:
    """Return why a setting must search the whole frame; None if it can search a window."""
    if setting.useAruco3Detection:
        return "useAruco3Detection scales the image by the frame's size"
    if setting.cornerRefinementMethod == "apriltag" and setting.aprilTagQuadDecimate > 1:
        return "aprilTagQuadDecimate resamples the frame"
    if setting.adaptiveThreshConstant < 1:
        return "adaptiveThreshConstant below 1 turns the plain background into candidates"
    return None


def margin_px(setting: DetectorSetting) -> int:
    """Return the width of the border around the marker whose pixels can change the detection.

    Half the largest threshold window and the border in which no corner may lie, plus the
    contour's own pixel and one to spare; at least the reach of the sub-pixel refinement and of the
    apriltag search's tiles and blur, if they are used (measured: 2 of 1,500 searches differed at
    24 px, none from 32). With OpenCV's defaults: 16.
    """
    margin = setting.adaptiveThreshWinSizeMax // 2 + setting.minDistanceToBorder + 2
    if setting.cornerRefinementMethod == "subpix":
        margin = max(margin, 2 * setting.cornerRefinementWinSize + 3)
    if setting.cornerRefinementMethod == "apriltag":
        margin = max(margin, 36 + int(4 * abs(setting.aprilTagQuadSigma)))
    return margin


NOISE_MARGIN_PX = 32
"""Added to the margin if there is noise: its candidates around the marker affect one another.

Of 3,600 searches with noise of 1 to 32 grey levels 102 flags differed from the full frame's
without it, 3 with 16 px, none from 32. Coarse noise (correlated, or through JPEG) needs twice as
much: of 300 searches with noise of 8 to 32, a correlation of 0.7 and quality 1, two flags differed
with 16 px, one with 32, none with 64.
"""


UNEVEN_LIGHT_CONSTANT = 7.0
"""The adaptive threshold's constant below which uneven light (at gain 1) is searched on whole
frames: on a slope the replicated border of a window makes candidates of the background. With
gradients to 2 of frames from 96 px wide no flag differed at 7, of 400 up to 17 at 1.5."""


def windows(
    boxes: NDArray[np.int64], frame: NDArray[np.int64], margin: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return the windows (N, 4) to search: boxes (N, 4) widened, aligned, clipped at the frame.

    ``margin`` (N, 1) in pixels.

    A side is at least 8 px if the frame allows it. A window reaches the frame's edge exactly if
    the margin does, since nothing lies beyond.
    """
    start = (boxes[:, :2] - margin) // ALIGNMENT_PX * ALIGNMENT_PX
    stop = -((-boxes[:, 2:] - margin) // ALIGNMENT_PX) * ALIGNMENT_PX
    start = np.maximum(start, 0)
    stop = np.maximum(stop, start + MIN_WINDOW_PX)
    over = stop - np.minimum(stop, frame)
    start = np.where(
        (over > 0) & (stop - over - start < MIN_WINDOW_PX),
        np.maximum(frame - MIN_WINDOW_PX, 0) // ALIGNMENT_PX * ALIGNMENT_PX,
        start,
    )
    return np.concatenate([start, stop - over], axis=1)


DetectorOutput = tuple[
    Sequence[NDArray[np.floating[Any]]], NDArray[np.integer[Any]] | None,
    Sequence[NDArray[np.floating[Any]]],
]
"""Corners (1, 4, 2) each of n decoded markers; their IDs, (n,) or as in OpenCV 4 (n, 1), None if n
is 0; and corners of the rejected candidates."""


SearchFunction = Callable[[NDArray[np.uint8]], DetectorOutput]


def perimeter_rates(setting: DetectorSetting, side: int, frame_side: int) -> tuple[float, float]:
    """Return the perimeter limits for an image of larger side ``side``, a window of a frame.

    OpenCV takes them relative to the image that it is given and turns them into whole pixels: they
    are passed so that they give the same numbers as on the frame.
    """
    low, high = setting.minMarkerPerimeterRate, setting.maxMarkerPerimeterRate
    if side == frame_side:
        return low, high
    return (int(low * frame_side) + 0.5) / side, (int(high * frame_side) + 0.5) / side


def opencv_parameters(setting: DetectorSetting) -> cv2.aruco.DetectorParameters:
    """Return a setting as OpenCV's detectors take it."""
    parameters = cv2.aruco.DetectorParameters()
    defaults = DetectorSetting()
    for field in dataclasses.fields(setting):
        value = getattr(setting, field.name)
        if field.name == "cornerRefinementMethod":
            value = REFINEMENTS[value]
        elif value == getattr(defaults, field.name):
            continue
        setattr(parameters, field.name, value)
    return parameters


class Detector:
    """One setting of OpenCV's detector in this process; OpenCV's objects cannot be pickled."""

    def __init__(self, setting: DetectorSetting) -> None:
        self._setting = setting
        self._parameters = opencv_parameters(setting)
        self._searches: dict[tuple[str, int, int], SearchFunction] = {}

    def find(self, image: NDArray[np.uint8], dictionary: str, frame_side: int) -> DetectorOutput:
        """Search an image (h, w): a window of a frame whose larger side is ``frame_side``."""
        key = dictionary, max(image.shape), frame_side
        return (self._searches.get(key) or self._search(*key))(image)

    def _search(self, dictionary: str, side: int, frame_side: int) -> SearchFunction:
        """Return OpenCV's search for images of larger side ``side``; one for each size is kept."""
        low, high = perimeter_rates(self._setting, side, frame_side)
        parameters = self._parameters
        parameters.minMarkerPerimeterRate, parameters.maxMarkerPerimeterRate = low, high
        detector = cv2.aruco.ArucoDetector(opencv_dictionary(dictionary), parameters)
        # OpenCV's stubs have neither the element types nor that the IDs may be None.
        search = cast("SearchFunction", detector.detectMarkers)
        self._searches[dictionary, side, frame_side] = search
        return search
