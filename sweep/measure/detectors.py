"""Detectors: OpenCV's on a window and on the whole frame, boards', and those of plug-ins."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, NamedTuple, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.declaration import parameter
from sweep.errors import PluginError
from sweep.model.board import Board
from sweep.model.marker import opencv_dictionary
from sweep.model.polygon import side_lengths
from sweep.plugins.loading import DeclaredPlugin, call, real_numbers
from sweep.typing import Floats, Integers

# --------------------------------------------------------------------------------------------------
# Which corner of a detector is which of OpenCV's.

#: Largest distance of corners from the truth that has them in the same order, in sides.
FITS = 0.2


def fitting_order(found: Floats, truth: Floats) -> tuple[tuple[int, ...], float]:
    """Return the order in which found corners (n, 4, 2) are nearest to the true ones.

    Beside it their distance, in the truth's sides: the median of the markers' means.
    """
    side = side_lengths(truth).mean(axis=1)

    def away(order: tuple[int, ...]) -> float:
        distance = np.linalg.norm(found[:, order] - truth, axis=2).mean(axis=1)
        return float(np.median(distance / side))

    order = min(itertools.permutations(range(4)), key=away)
    return order, away(order)


# --------------------------------------------------------------------------------------------------
# OpenCV's ArUco detector, on a window as on the whole frame but for place-dependent rounding.

REFINEMENTS = {
    "none": cv2.aruco.CORNER_REFINE_NONE,
    "subpix": cv2.aruco.CORNER_REFINE_SUBPIX,
    "contour": cv2.aruco.CORNER_REFINE_CONTOUR,
    "apriltag": cv2.aruco.CORNER_REFINE_APRILTAG,
}


def _pixels(default: Any, meaning: str, low: float = 1, high: float = 9999) -> Any:
    """Return the declared field of a number of pixels."""
    return parameter(default, meaning, low, high, unit="px")


def _positive(default: Any, meaning: str, high: float = math.inf) -> Any:
    """Return the declared field of a number above 0."""
    return parameter(default, meaning, 0, high, open_low=True)


@dataclass(frozen=True, slots=True)
class DetectorSetting:
    """Every field of ``cv2.aruco.DetectorParameters``, by OpenCV's own name and default."""

    adaptiveThreshWinSizeMin: int = _pixels(3, "smallest window of the adaptive threshold", 3)
    adaptiveThreshWinSizeMax: int = _pixels(23, "largest window of the adaptive threshold", 3)
    adaptiveThreshWinSizeStep: int = _pixels(
        10, "step between the windows of the adaptive threshold"
    )
    adaptiveThreshConstant: float = parameter(
        7.0, "constant of the adaptive threshold", unit="grey level"
    )
    minMarkerPerimeterRate: float = _positive(
        0.03, "smallest perimeter of a candidate, relative to the image's larger side"
    )
    maxMarkerPerimeterRate: float = _positive(
        4.0, "largest perimeter of a candidate, relative to the image's larger side", 10_000
    )
    polygonalApproxAccuracyRate: float = _positive(
        0.03, "accuracy of the polygonal approximation, relative to the perimeter"
    )
    minCornerDistanceRate: float = parameter(
        0.05, "smallest distance between corners, relative to the perimeter", 0
    )
    minDistanceToBorder: int = _pixels(
        3, "smallest distance of a corner to the image's border", 0
    )
    minMarkerDistanceRate: float = parameter(
        0.125, "smallest distance between markers' corners, relative to the perimeter", 0
    )
    minGroupDistance: float = parameter(
        0.21, "smallest distance between corners in a group of candidates, relative to the "
        "perimeter", 0,
    )
    cornerRefinementMethod: str = parameter(
        "none", "refinement of the corners (apriltag also replaces the search for candidates)",
        choices=tuple(REFINEMENTS), prefix="CORNER_REFINE_",
    )
    cornerRefinementWinSize: int = _pixels(5, "largest half window of the sub-pixel refinement")
    relativeCornerRefinmentWinSize: float = _positive(
        0.3, "half window of the sub-pixel refinement, relative to the module"
    )
    cornerRefinementMaxIterations: int = parameter(
        30, "most iterations of the corner refinement", 1, 100_000
    )
    cornerRefinementMinAccuracy: float = parameter(
        0.1, "step at which the corner refinement stops", 0, unit="px", open_low=True
    )
    markerBorderBits: int = parameter(
        1, "width of the border that the detector expects", 1, 10, unit="module"
    )
    perspectiveRemovePixelPerCell: int = _pixels(4, "samples along a side of a module", 1, 1000)
    perspectiveRemoveIgnoredMarginPerCell: float = parameter(
        0.13, "margin of a module that is not sampled, relative to the module", 0, 0.499
    )
    maxErroneousBitsInBorderRate: float = parameter(
        0.35, "largest share of wrong bits in the border", 0, 1
    )
    minOtsuStdDev: float = parameter(
        5.0, "smallest standard deviation at which Otsu's threshold is taken", 0,
        unit="grey level",
    )
    errorCorrectionRate: float = parameter(
        0.6, "error correction, relative to the dictionary's maximum", 0, 1
    )
    aprilTagQuadDecimate: float = parameter(
        0.0, "apriltag: decimation of the image before the search", 0, 64
    )
    aprilTagQuadSigma: float = _pixels(
        0.0, "apriltag: Gaussian blur (negative: sharpening) before the search", -100, 100
    )
    aprilTagMinClusterPixels: int = _pixels(
        5, "apriltag: smallest cluster of edge pixels", 0, 10**6
    )
    aprilTagMaxNmaxima: int = parameter(
        10, "apriltag: most corner candidates of a cluster", 1, 1000
    )
    aprilTagCriticalRad: float = parameter(
        0.1745329201221466, "apriltag: edges closer than this to straight or to reversal make no "
        "corner", 0, 3.1416, unit="radian",
    )
    aprilTagMaxLineFitMse: float = parameter(
        10.0, "apriltag: largest mean squared error of a line fit", 0, unit="px²"
    )
    aprilTagMinWhiteBlackDiff: int = parameter(
        5, "apriltag: smallest contrast of a tile", 0, 255, unit="grey level"
    )
    aprilTagDeglitch: int = parameter(
        0, "apriltag: clean up the threshold; only 0: with 1 OpenCV's result depends on the "
        "images searched before (5-7 of 150 images, in 4.14 and 5.0)", 0, 0,
    )
    detectInvertedMarker: bool = parameter(False, "also search for white-on-black markers")
    useAruco3Detection: bool = parameter(
        False, "the faster search of ArUco 3 (always on the full frame)"
    )
    minSideLengthCanonicalImg: int = _pixels(
        32, "ArUco 3: smallest side of a candidate in the canonical image", 1, 10_000
    )
    minMarkerLengthRatioOriginalImg: float = parameter(
        0.0, "ArUco 3: smallest marker, relative to the image's larger side", 0, 1
    )
    validBitIdThreshold: float = parameter(
        0.49, "share of a module's pixels from which its bit is uncertain", 0, 1
    )


#: Windows begin and end at multiples of this: the tiles of the apriltag search are 4 px wide.
ALIGNMENT_PX = 4

MIN_WINDOW_PX = 8


#: Added to the margin if there is noise: its candidates around the marker affect one another.
#:
#: Of 3,600 searches with noise of 1 to 32 grey levels 102 flags differed from the full frame's
#: without it, 3 with 16 px, none from 32. Coarse noise (correlated, or through JPEG) needs twice as
#: much: of 300 searches with noise of 8 to 32, a correlation of 0.7 and quality 1, two flags
#: differed with 16 px, one with 32, none with 64.
NOISE_MARGIN_PX = 32


#: The adaptive threshold's constant below which uneven light (at gain 1) is searched on whole
#: frames: on a slope the replicated border of a window makes candidates of the background. With
#: gradients to 2 of frames from 96 px wide no flag differed at 7, of 400 up to 17 at 1.5.
UNEVEN_LIGHT_CONSTANT = 7.0


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


#: Corners (1, 4, 2) each of n decoded markers; their IDs, (n,) or as in OpenCV 4 (n, 1), None if n
#: is 0; and corners of the rejected candidates.
DetectorOutput = tuple[
    Sequence[NDArray[np.floating[Any]]], NDArray[np.integer[Any]] | None,
    Sequence[NDArray[np.floating[Any]]],
]


SearchFunction = Callable[[NDArray[np.uint8]], DetectorOutput]


def opencv_parameters(setting: DetectorSetting) -> cv2.aruco.DetectorParameters:
    """Return a setting as OpenCV's detectors take it."""
    parameters = cv2.aruco.DetectorParameters()
    defaults = DetectorSetting()
    for each in dataclasses.fields(setting):
        value = getattr(setting, each.name)
        if each.name == "cornerRefinementMethod":
            value = REFINEMENTS[value]
        elif value == getattr(defaults, each.name):
            continue
        setattr(parameters, each.name, value)
    return parameters


def opencv_search(
    setting: DetectorSetting, dictionary: str, side: int, frame_side: int
) -> SearchFunction:
    """Return OpenCV's search for images of larger side ``side``, windows of a frame.

    OpenCV takes the limits of the perimeter relative to the image that it is given and turns them
    into whole pixels: they are passed so that they give the same numbers as on the frame. OpenCV's
    objects cannot be pickled.
    """
    parameters = opencv_parameters(setting)
    if side != frame_side:
        for name in ("minMarkerPerimeterRate", "maxMarkerPerimeterRate"):
            pixels = int(getattr(setting, name) * frame_side)
            setattr(parameters, name, (pixels + 0.5) / side)
    detector = cv2.aruco.ArucoDetector(opencv_dictionary(dictionary), parameters)
    # OpenCV's stubs have neither the element types nor that the IDs may be None.
    return cast("SearchFunction", detector.detectMarkers)


# --------------------------------------------------------------------------------------------------
# OpenCV's finds on a board beside its markers: missed markers, and a chessboard's corners.

@dataclass(frozen=True, slots=True)
class BoardDetectorSetting:
    """How OpenCV uses what it knows of a board, by its own names and defaults."""

    refineDetectedMarkers: bool = parameter(
        False, "boards: cv2.aruco.ArucoDetector.refineDetectedMarkers takes rejected candidates "
        "for the markers that are expected where they lie",
    )
    minMarkers: int = parameter(
        2, "charuco: markers beside a corner of the chessboard that must be detected for it to be "
        "interpolated", low=0, high=2,
    )


class SearchOutput(NamedTuple):
    """The finds in one image: markers, and a chessboard's corners.

    Attributes
    ----------
    corners, ids, rejected
        The detector's output, with the markers that were found by means of the board.
    chessboard_ids, chessboard_px
        (C,) and (C, 2) indices and pixels of the chessboard's corners that were found.
    """

    corners: Sequence[NDArray[np.floating[Any]]]
    ids: NDArray[np.integer[Any]] | None
    rejected: Sequence[NDArray[np.floating[Any]]]
    chessboard_ids: Integers = np.zeros(0, dtype=np.int64)
    chessboard_px: Floats = np.zeros((0, 2))


def completed(
    image: NDArray[np.uint8], board: Board, markers: DetectorOutput,
    setting: BoardDetectorSetting, of_markers: DetectorSetting,
) -> SearchOutput:
    """Return the finds on a board in an image (h, w) in which ``markers`` were detected.

    ``cv2.aruco.ArucoDetector.refineDetectedMarkers`` and ``cv2.aruco.CharucoDetector.detectBoard``
    are called without a camera: their homographies are local. ``of_markers`` is the detector whose
    refinement of corners they take.
    """
    corners, ids, rejected = markers
    if ids is None or not len(ids):
        return SearchOutput(*markers)
    if setting.refineDetectedMarkers and rejected:
        refining = _refining(board.dictionary, of_markers)
        corners, ids, rejected, _ = refining.refineDetectedMarkers(
            image, opencv_board(board), list(corners), ids, list(rejected)
        )
        corners, rejected = list(corners), list(rejected)
    output = SearchOutput(corners, ids, rejected)
    if board.chessboard is None:
        return output
    pixels, found, _, _ = _interpolating(board, setting.minMarkers, of_markers).detectBoard(
        image, markerCorners=list(corners), markerIds=ids
    )
    if found is None or not len(found):
        return output
    return output._replace(
        chessboard_ids=np.asarray(found, dtype=np.int64).ravel(),
        chessboard_px=np.asarray(pixels, dtype=np.float64).reshape(-1, 2),
    )


@lru_cache(maxsize=64)
def _refining(dictionary: str, of_markers: DetectorSetting) -> Any:
    return cv2.aruco.ArucoDetector(opencv_dictionary(dictionary), opencv_parameters(of_markers))


@lru_cache(maxsize=64)
def _interpolating(board: Board, min_markers: int, of_markers: DetectorSetting) -> Any:
    parameters = cv2.aruco.CharucoParameters()
    parameters.minMarkers = min_markers
    charuco: Any = opencv_board(board)
    return cv2.aruco.CharucoDetector(charuco, parameters, opencv_parameters(of_markers))


@lru_cache(maxsize=64)
def opencv_board(board: Board) -> cv2.aruco.Board:
    """Return a board as OpenCV has it: a ``cv2.aruco.CharucoBoard`` if it has a chessboard."""
    dictionary, squares = opencv_dictionary(board.dictionary), board.chessboard
    ids = np.array(board.marker_ids, dtype=np.int32)
    if squares is None:
        corners: Any = board.corners_m.astype(np.float32)
        return cv2.aruco.Board(corners, dictionary, ids)
    charuco = cv2.aruco.CharucoBoard(
        (squares.squares_x, squares.squares_y), squares.square_m, squares.marker_m, dictionary, ids
    )
    charuco.setLegacyPattern(squares.legacy_pattern)
    return charuco


# --------------------------------------------------------------------------------------------------
# Plug-ins, as detectors and solvers are made from them.

@dataclass(frozen=True, slots=True)
class PluginSetting:
    """One setting of a plug-in, as a value: the plug-in itself is imported where it is used.

    Attributes
    ----------
    plugin
        The plug-in.
    values
        Name and value of each of its settings.
    folder
        Where its file is.
    """

    plugin: DeclaredPlugin
    values: tuple[tuple[str, Any], ...]
    folder: str

    def record(self) -> Any:
        """Return the plug-in's record; PluginError if it is not the one that was declared."""
        return self.plugin.record(self.folder)

    def instance(self) -> Any:
        """Return its settings as an instance of the plug-in's own dataclass; None without.

        PluginError if the dataclass refuses them.
        """
        settings = self.record().settings
        return settings and call(self.plugin.name, partial(settings, **dict(self.values)))

    def made(self, *arguments: Any) -> Callable[..., Any]:
        """Return the function that its ``make`` returns for these settings and arguments.

        PluginError if it raises, or returns none.
        """
        name = self.plugin.name
        function = call(name, self.record().make, self.instance(), *arguments)
        if not callable(function):
            raise PluginError(f"{name}: make returns a {type(function).__name__}, not a function")
        return cast("Callable[..., Any]", function)


# --------------------------------------------------------------------------------------------------
# A plug-in's detector: its conventions are turned into ours, and what it returns is checked.

#: Markers, or candidates, that are believed of an image with one marker.
MAX_MARKERS = 1000


def plugged(setting: PluginSetting) -> FindFunction:
    """Return the search of a plug-in's detector in this process; the frame's side does not matter.

    It raises PluginError, in one line, if the plug-in lacks the dictionary, cannot be made, raises,
    or returns what cannot be a detection.
    """
    name, record = setting.plugin.name, setting.record()

    @lru_cache(maxsize=64)
    def search_for(dictionary: str) -> Callable[[NDArray[np.uint8]], Any]:
        families = record.families
        if families is not None and dictionary not in families:
            raise PluginError(f"{name}: no dictionary {dictionary}; it has {', '.join(families)}")
        return setting.made(dictionary if families is None else families[dictionary])

    def quadrilaterals(what: str, returned: Any) -> Floats:
        """Return corners (n, 4, 2) in our order, with pixel centres at whole numbers."""
        quads = real_numbers(name, what, returned, (-1, 4, 2), finite=True)
        if len(quads) > MAX_MARKERS:
            raise PluginError(
                f"{name}: returned {len(quads):,} {what} for one image; expected at most "
                f"{MAX_MARKERS:,}"
            )
        return np.asarray(quads[:, record.corner_order] - record.pixel_center)

    def find(
        image: NDArray[np.uint8], dictionary: str, frame_side: int  # noqa: ARG001
    ) -> DetectorOutput:
        own = np.array(image, order="C")  # what it does to its image reaches nobody else
        returned = call(name, search_for(dictionary), own)
        if not np.array_equal(own, image):
            raise PluginError(f"{name}: changed the image that it was given; copy it first")
        if not isinstance(returned, tuple) or len(returned) not in (2, 3):
            raise PluginError(
                f"{name}: returned a {type(returned).__name__}; expected a tuple of "
                "two, (corners, ids), or of three, with rejected quadrilaterals"
            )
        corners, ids, *rest = returned
        quads = quadrilaterals("corners", corners)
        rejected = list(quadrilaterals("rejected", rest[0] if rest else ())[:, None])
        numbers = real_numbers(name, "ids", ids, (len(quads),), whole=True)
        if (numbers < 0).any():
            raise PluginError(f"{name}: returned the ID {numbers.min()}; expected at least 0")
        return list(quads[:, None]), numbers if len(quads) else None, rejected

    return find


# --------------------------------------------------------------------------------------------------
# The detectors: OpenCV's and those of plug-ins, each made from its setting.

#: The detector that is no plug-in, ``cv2.aruco.ArucoDetector``.
OPENCV = "opencv"


@dataclass(frozen=True, slots=True)
class DetectorChoice:
    """Which detector searches the images."""

    detector: str = parameter(
        OPENCV, "opencv: cv2.aruco.ArucoDetector, which has the settings below; or a plug-in: the "
        "name of an installed one, or file:name beside the pipeline; or the .npz file of "
        "detections that `sweep score` recorded", choices=(OPENCV,),
        plugin="detector",
    )


#: A setting of any detector.
AnyDetectorSetting = DetectorSetting | PluginSetting

#: A search of an image (h, w): a window of a frame whose larger side is the last argument, for
#: markers of a dictionary.
FindFunction = Callable[[NDArray[np.uint8], str, int], DetectorOutput]


@lru_cache(maxsize=256)
def make_detector(setting: AnyDetectorSetting) -> FindFunction:
    """Return the search that a setting describes; kept by the process.

    Raises
    ------
    PluginError
        If a plug-in cannot be used.
    """
    if isinstance(setting, PluginSetting):
        return plugged(setting)
    search_for = lru_cache(maxsize=4096)(partial(opencv_search, setting))
    return lambda image, dictionary, frame_side: (
        search_for(dictionary, max(image.shape), frame_side)(image))


def full_frame_reason(setting: AnyDetectorSetting) -> str | None:
    """Return why a setting must search the whole frame; None if it can search a window."""
    if isinstance(setting, PluginSetting):
        none = _margin_px(setting) is None
        return f"{setting.plugin.name} declares no margin_px" if none else None
    if setting.useAruco3Detection:
        return "useAruco3Detection scales the image by the frame's size"
    if setting.cornerRefinementMethod == "apriltag" and setting.aprilTagQuadDecimate > 1:
        return "aprilTagQuadDecimate resamples the frame"
    if setting.adaptiveThreshConstant < 1:
        return "adaptiveThreshConstant below 1 turns the plain background into candidates"
    return None


def margin_px(setting: AnyDetectorSetting) -> int:
    """Return the width of the border around the marker whose pixels can change the detection.

    Of OpenCV's detector half the largest threshold window and the border in which no corner may
    lie, plus the contour's own pixel and one to spare; at least the reach of the sub-pixel
    refinement and of the apriltag search's tiles and blur, if they are used (measured: 2 of 1,500
    searches differed at 24 px, none from 32). With OpenCV's defaults: 16.
    """
    if isinstance(setting, PluginSetting):
        return _margin_px(setting) or 0
    margin = setting.adaptiveThreshWinSizeMax // 2 + setting.minDistanceToBorder + 2
    if setting.cornerRefinementMethod == "subpix":
        margin = max(margin, 2 * setting.cornerRefinementWinSize + 3)
    if setting.cornerRefinementMethod == "apriltag":
        margin = max(margin, 36 + int(4 * abs(setting.aprilTagQuadSigma)))
    return margin


def uneven_light_needs_frame(setting: AnyDetectorSetting, gain: Any) -> Any:
    """Return whether uneven light, amplified by ``gain`` (...; 0: even), needs whole frames."""
    if isinstance(setting, DetectorSetting):
        return setting.adaptiveThreshConstant < UNEVEN_LIGHT_CONSTANT * gain
    return np.zeros(np.shape(gain), dtype=bool)


@lru_cache(maxsize=1024)
def _margin_px(setting: PluginSetting) -> int | None:
    margin = setting.record().margin_px
    if callable(margin):
        margin = call(f"{setting.plugin.name}: margin_px", margin, setting.instance())
    if margin is None:
        return None
    if not isinstance(margin, int) or not 0 <= margin < 1 << 31:
        raise PluginError(
            f"{setting.plugin.name}: margin_px = {margin!r}: expected a whole number, at least 0"
        )
    return margin
