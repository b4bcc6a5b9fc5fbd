"""The photographs of a folder, the markers in them, and the corners of their board."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from sweep.errors import ArgumentError, SweepError
from sweep.experiment.photographs import board_of
from sweep.measure.detectors import DetectorSetting, FindFunction, make_detector
from sweep.messages import nearest_file, plain, shown
from sweep.model.board import Board, unit_m
from sweep.model.image_file import IMAGE_SUFFIXES, Part, decode_grey, read_image
from sweep.model.marker import module_count, opencv_dictionary_names
from sweep.model.polygon import following, side_lengths
from sweep.typing import Floats, Integers

# --------------------------------------------------------------------------------------------------
# The photographs of a folder: which files they are, and lines on them for the user.

#: The most files that a line names.
MAX_NAMED = 3


class Photograph(NamedTuple):
    """A photograph: its file, the SHA-256 of the file, and grey levels (height, width)."""

    path: Path
    digest: str
    image: NDArray[np.uint8]


class Folder(NamedTuple):
    """Photographs of one size, by name, and lines on files left out or converted.

    ``part`` of each image is the photograph.
    """

    photographs: list[Photograph]
    lines: list[str]
    part: Part

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        height, width = self.photographs[0].image.shape
        return width, height


def fault_of(folder: Path, reason: str) -> ArgumentError:
    """Return the error that names a folder of photographs and what is wrong with it."""
    return ArgumentError("folders", plain(folder, 300), reason)


def read_folder(home: Path, part: Part = Part.whole) -> Folder:
    """Return the photographs of a folder, or the same half of each of its images.

    Raises
    ------
    ArgumentError
        If it has no photographs, or photographs of several sizes; in a line each.
    """
    try:
        files = sorted(path for path in home.iterdir() if not path.name.startswith("."))
    except OSError as error:
        raise fault_of(home, f"{error.strerror or 'unreadable'}{nearest_file(home)}") from None
    photographs: list[Photograph] = []
    left_out: dict[str, list[str]] = {}
    notes: Counter[str] = Counter()
    for path in files:
        try:
            if path.suffix.lower() not in IMAGE_SUFFIXES or path.is_dir():
                raise ValueError("no PNG, JPEG, BMP or PGM images")
            if any("\ud800" <= character <= "\udfff" for character in path.name):
                raise ValueError("its name is not UTF-8, as a store needs it")
            content, image = read_image(str(path)), decode_grey(str(path))
            digest = hashlib.sha256(content).hexdigest()
            if any(each.digest == digest for each in photographs):
                raise ValueError("the same photographs again")
        except ValueError as error:
            left_out.setdefault(str(error), []).append(path.name)
            continue
        notes.update(_conversions(content, image))
        photographs.append(Photograph(path, digest, image))
    name = plain(home.name, 300)
    lines = [f"{name}: left out {named(some)}: {why}" for why, some in left_out.items()]
    lines += [f"{name}: {count} of {len(photographs)} photographs {note}"
              for note, count in sorted(notes.items())]
    if not photographs:
        raise fault_of(home, "; ".join(["expected photographs (PNG, JPEG, BMP, PGM)", *lines]))
    ((height, width), _), *others = Counter(each.image.shape for each in photographs).most_common()
    if others:
        odd = [f"{path.name} ({image.shape[1]} x {image.shape[0]})"
               for path, _, image in photographs if image.shape != (height, width)]
        raise fault_of(
            home, f"expected photographs of one size: most are {width} x {height}, not "
            f"{named(odd)}; move those of another camera or size elsewhere",
        )
    if part is not Part.whole and width % 2:
        raise fault_of(home, f"expected images of two halves; they are {width} px wide")
    return Folder([each._replace(image=part.of(each.image)) for each in photographs], lines, part)


def named(names: Sequence[str]) -> str:
    """Return a few of some names, and how many they are."""
    rest = len(names) - MAX_NAMED
    listed = ", ".join(plain(name) for name in names[:MAX_NAMED])
    return f"{listed} and {rest} more" if rest > 0 else listed


def _conversions(content: bytes, upright: NDArray[np.uint8]) -> list[str]:
    """Return notes on the conversion of an encoded image to 8-bit grey, upright."""
    stored, straight = (
        np.asarray(cv2.imdecode(np.frombuffer(content, np.uint8), flags)) for flags in
        (cv2.IMREAD_UNCHANGED, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    )
    colours = stored.reshape(*stored.shape[:2], -1)[..., :3]
    return [note for holds, note in (
        ((colours != colours[..., :1]).any(), "are in colour; their grey levels are measured"),
        (stored.dtype != np.uint8, "have 16 bits; their upper 8 are measured"),
        (not np.array_equal(straight, upright),
         "are turned as their EXIF tag says; a calibration must be of images turned so"),
    ) if holds]


# --------------------------------------------------------------------------------------------------
# Markers that are detected in a photograph.

class SeenMarkers(NamedTuple):
    """Markers in a photograph: IDs (k,), each once, and corners (k, 4, 2) px.

    ``repeated`` IDs are there more than once, and left out.
    """

    ids: Integers
    quads: Floats
    repeated: int = 0

    def among(self, ids: Sequence[int] | Integers) -> tuple[Integers, Floats]:
        """Return the places (n,) in ``ids`` of those that are there, and their corners."""
        place = pd.Index(ids).get_indexer(self.ids)
        return place[place >= 0].astype(np.int64), self.quads[place >= 0]


#: Settings of a detector that finds markers of little contrast, and more that are none.
FAINT = {"adaptiveThreshConstant": 1.0, "minOtsuStdDev": 1.0}


def reference_detector(**settings: Any) -> FindFunction:
    """Return the detector that finds boards: whatever is under test, truth is the same."""
    return make_detector(DetectorSetting(cornerRefinementMethod="subpix", **settings))


def detect_markers(
    find: FindFunction, image: NDArray[np.uint8], dictionary: str, faint: FindFunction | None = None
) -> SeenMarkers:
    """Return the markers of a dictionary in an image; those of an ID that is there twice are not.

    ``find`` is a detector's search, and ``faint`` another's where the first finds nothing.
    """
    quads, ids, _ = find(image, dictionary, max(image.shape))
    if faint and not len(quads):
        quads, ids, _ = faint(image, dictionary, max(image.shape))
    numbers = np.array([] if ids is None else ids, dtype=np.int64).ravel()
    once = ~pd.Series(numbers).duplicated(keep=False).to_numpy()
    repeated = len(np.unique(numbers[~once]))
    corners = np.reshape(quads, (-1, 4, 2)).astype(np.float64)
    return SeenMarkers(numbers[once], corners[once], repeated)


# --------------------------------------------------------------------------------------------------
# Corners of a board in a photograph, without a model of the camera.
#
# Of a board with a chessboard they are the chessboard's inner corners: the neighbouring markers'
# homography says where they are about, and ``cv2.cornerSubPix`` measures them. So are the markers'
# corners of a board with black squares at them, whose outlines run together with the markers': a
# detector's corners may be off by pixels. Of other boards they are the markers' corners, as OpenCV
# refines them; all edges are shifted there, which `sweep.photographs.cameras.fit_pose` estimates.

#: Markers whose corners give the homography around a corner of the chessboard.
NEIGHBOURS = 4

#: Half window of the search, as a share of the distance to what else is printed.
WINDOW_SHARE = 0.8

#: A corner, and where something else may be printed around it.
CROSS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])

#: Half windows, in pixels.
MIN_WINDOW, MAX_WINDOW = 2, 11


class FoundCorners(NamedTuple):
    """The corners of a board that were found in a photograph.

    Attributes
    ----------
    points, pixels
        (n, 3) in the board's frame in m, and (n, 2) px.
    number
        (n,) numbers of the corners: of the chessboard's, or 4 · marker + corner.
    outward
        (n, 2) px by which they move if the edges of black squares move outwards by 1 px; None where
        two black squares meet, whose corner stays.
    """

    points: Floats
    pixels: Floats
    number: Integers
    outward: Floats | None = None


def find_corners(image: NDArray[np.uint8], board: Board, seen: SeenMarkers) -> FoundCorners:
    """Return the corners of a board in an image in which markers were detected."""
    marker, quads = seen.among(board.marker_ids)
    if board.chessboard is not None:
        points, step_m, clear_m = board.chessboard_m, board.chessboard.square_m, 0.0
        number = np.arange(len(points))
    else:
        points = board.corners_m.reshape(-1, 3)
        number = (4 * marker[:, None] + np.arange(4)).ravel()
        if not board.squares_m:
            along = following(quads) - quads
            along /= np.linalg.norm(along, axis=2, keepdims=True)
            before = np.roll(along, 1, axis=1)
            outward = (before - along) / np.linalg.det(np.stack([before, along], -1))[..., None]
            pixels, outward = quads.reshape(-1, 2), outward.reshape(-1, 2)
            return FoundCorners(points[number], pixels, number, outward)
        step_m = unit_m(board) * module_count(board.dictionary) + board.squares_m
        clear_m = min(unit_m(board), board.squares_m)  # up to the marker's bits
    flat = board.corners_m[marker][..., :2]
    found = {
        k: pixel for k in number.tolist()
        if (pixel := _saddle(image, points[k, :2], flat, quads, step_m, clear_m)) is not None
    }
    number = np.array(list(found), dtype=np.int64)
    return FoundCorners(points[number], np.array(list(found.values())).reshape(-1, 2), number)


def _saddle(
    image: NDArray[np.uint8], point: Floats, flat: Floats, quads: Floats, step_m: float,
    clear_m: float,
) -> Floats | None:
    """Return the pixel (2,) of a corner at which two black squares meet; None if it is not found.

    Parameters
    ----------
    image
        Grey levels.
    point, flat, quads
        The corner (2,) and the markers' corners (k, 4, 2) on the board, and the latter's pixels.
    step_m
        Side of the chessboard's squares, or from marker to marker of an AprilGrid.
    clear_m
        Distance within which nothing else is printed; 0: up to the nearest marker's corner.
    """
    distance = np.abs(flat.mean(axis=1) - point).max(axis=1)
    near = np.argsort(distance, kind="stable")[:NEIGHBOURS]
    near = near[distance[near] < 2.1 * step_m]
    if len(near) < 2 or distance[near[0]] > 1.01 * step_m:
        return None
    transform, _ = cv2.findHomography(flat[near].reshape(-1, 2), quads[near].reshape(-1, 2))
    start, *around = cv2.perspectiveTransform((point + clear_m * CROSS)[None], transform)[0]
    others = around if clear_m else quads[near]
    offset = np.abs(np.reshape(others, (-1, 2)) - start).max(axis=1).min()
    half = int(np.clip(WINDOW_SHARE * offset, MIN_WINDOW, MAX_WINDOW))
    border = half + 2
    if not ((border <= start) & (start < np.array(image.shape[::-1]) - border)).all():
        return None
    found = cv2.cornerSubPix(
        image, start.astype(np.float32).reshape(1, 1, 2), (half, half), (-1, -1),
        (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-3),
    ).reshape(2).astype(np.float64)
    return found if np.abs(found - start).max() < half else None


def own_corners(board: Board) -> list[Integers]:
    """Return the numbers of each marker's own corners: those that are left out of its truth.

    Of a chessboard they are the corners of the marker's square.
    """
    if board.chessboard is None:
        return list(np.arange(4 * len(board)).reshape(-1, 4))
    centres, reach = board.corners_m.mean(axis=1), 0.51 * board.chessboard.square_m * 1.2
    return [
        np.flatnonzero(np.abs(board.chessboard_m - centre).max(axis=1) < reach)
        for centre in centres
    ]


# --------------------------------------------------------------------------------------------------
# Whether photographs show the board that was described; if not, which one fits better.

#: Share of the detected markers that lie where the board has them.
MIN_FITTING = 0.8

#: By how much more of the markers another board must fit.
CLEARLY = 0.02

#: Distance of a corner to its place by the board's homography, as a share of the marker's side.
FITTING_SHARE = 0.2

#: Relative difference of the markers' measured side to the board's that is refused; blur makes
#: detected markers up to 5 % smaller.
MAX_SIZE_ERROR = 0.08

#: Share of the markers of a single photograph that must lie there, and how many tell.
MIN_OWN, MIN_JUDGED = 0.6, 4

#: Photographs in which other dictionaries are searched for.
MAX_TRIED = 3


def check_board(
    name: str, document: Mapping[str, Any], board: Board, seen: Sequence[SeenMarkers],
    find: FindFunction, photographs: Sequence[Photograph],
) -> None:
    """Refuse a board, of a file of that name and content, that the photographs do not show.

    Raises
    ------
    ArgumentError
        One line: the fault, and which board fits.
    """
    folder = photographs[0].path.parent
    ids = {each for one in seen for each in one.ids.tolist()}
    twice, once = sum(one.repeated for one in seen), sum(len(one.ids) for one in seen)
    odd = [
        photograph.path.name for photograph, one in zip(photographs, seen, strict=False)
        if len(one.ids) >= MIN_JUDGED and fitting_share(board, [one]) < MIN_OWN
    ]
    if twice + once >= MIN_JUDGED and twice > once:
        raise fault_of(folder, "most markers are in an image twice: of two cameras side by side "
                       "give the calibration (--stereo FILE), of two equal boards show one")
    if not ids:
        fault = _no_marker(board, find, photographs[:MAX_TRIED])
    elif ids.isdisjoint(board.marker_ids):
        fault = (f"none of its markers is in the photographs, which show IDs {shown(sorted(ids))}; "
                 "correct first_id or ids")
    elif odd and len(odd) < len(photographs) / 2:
        raise fault_of(folder, f"{named(odd)}: less than {100 * MIN_OWN:.0f} % of the markers lie "
                       f"where the board has them, unlike in {len(photographs) - len(odd)} other "
                       "photographs; move those of another board elsewhere")
    else:
        fault = _misfit(document, board, seen)
    if fault:
        raise ArgumentError("board", plain(name), fault)


def _no_marker(board: Board, find: FindFunction, tried: Sequence[Photograph]) -> str:
    """Return the fault of photographs without a marker of a board's dictionary."""
    def count(name: str, *axes: int) -> int:
        images = (np.ascontiguousarray(np.flip(each.image, axes)) for each in tried)
        return sum(len(detect_markers(find, image, name).ids) for image in images)

    counts = {name: count(name) for name in opencv_dictionary_names()}
    counts[f"{board.dictionary} in the mirror image"] = count(board.dictionary, 1)
    best = max(counts, key=lambda name: counts[name])
    return f"no photograph shows a marker of {board.dictionary}; " + (
        f"there are {counts[best]} of {best} in the first {len(tried)}"
        if counts[best] >= len(tried) else "check that the board is in focus and wholly lit"
    )


def _misfit(document: Mapping[str, Any], board: Board, seen: Sequence[SeenMarkers]) -> str:
    """Return the fault of a board whose markers have another size, or lie elsewhere."""
    # Markers that are larger or smaller beside the board's other lengths.
    ratio = measured_side(board, seen)
    centres = board.corners_m.mean(axis=1, keepdims=True)
    scaled = dataclasses.replace(board, corners_m=centres + ratio * (board.corners_m - centres))
    if abs(ratio - 1.0) > MAX_SIZE_ERROR and fitting_share(scaled, seen) >= MIN_FITTING:
        side = float(np.linalg.norm(board.corners_m[0, 1] - board.corners_m[0, 0]))
        return (f"markers of {side:g} m do not fit its other lengths, beside which the photographs "
                f"show about {side * ratio:.3g} m; correct marker_m, or the squares or gaps")
    # Another board fits better, if it can. Of those that fit as well, the first.
    share = fitting_share(board, seen)
    least = max(MIN_FITTING, share + CLEARLY)
    first = min(each for one in seen for each in one.ids.tolist())
    shares = {f"{words} fits": fitting_share(other, seen)
              for words, other in _others(document if least <= 1 else {}, first)}
    remedy = max(shares, key=lambda words: shares[words], default="")
    if shares.get(remedy, 0.0) < least:
        if share >= MIN_FITTING:
            return ""
        remedy = "correct its kind, its rows and columns, or its IDs"
    return f"only {100 * share:.0f} % of the detected markers lie where it has them; {remedy}"


def _flat_markers(
    board: Board, seen: Sequence[SeenMarkers], least: int
) -> Iterator[tuple[Floats, Floats, float]]:
    """Yield corners (n, 4, 2) of a board's markers in m and px, where ``least`` of them are seen.

    And the mean side in px of all markers there.
    """
    for one in seen:
        marker, quads = one.among(board.marker_ids)
        if len(marker) >= least:
            yield board.corners_m[marker, :, :2], quads, float(side_lengths(one.quads).mean())


def fitting_share(board: Board, seen: Sequence[SeenMarkers]) -> float:
    """Return the share of all detected markers that lie where a board has them."""
    fitting = 0
    for flat, quads, side_px in _flat_markers(board, seen, 2):
        transform, _ = cv2.findHomography(
            flat.reshape(-1, 2), quads.reshape(-1, 2), cv2.RANSAC, FITTING_SHARE * side_px / 2)
        if transform is None:
            continue
        mapped = cv2.perspectiveTransform(flat.reshape(1, -1, 2), transform).reshape(-1, 4, 2)
        distance = np.linalg.norm(mapped - quads, axis=2).max(axis=1)
        fitting += int((distance < FITTING_SHARE * side_lengths(quads).mean(axis=1)).sum())
    return fitting / max(sum(len(one.ids) for one in seen), 1)


def measured_side(board: Board, seen: Sequence[SeenMarkers]) -> float:
    """Return the side of the markers over the board's, by the distances of their centres."""
    ratios: list[float] = []
    for flat, quads, _ in _flat_markers(board, seen, 4):
        transform, _ = cv2.findHomography(
            quads.mean(axis=1), flat.mean(axis=1), cv2.RANSAC, np.ptp(flat[0], axis=0).max() / 4)
        if transform is None:
            continue
        back = cv2.perspectiveTransform(quads.reshape(1, -1, 2), np.asarray(transform))
        ratios += (side_lengths(back.reshape(-1, 4, 2)) / side_lengths(flat)).mean(axis=1).tolist()
    return float(np.median(ratios)) if ratios else 1.0


#: Kind of a board -> keys of how many squares or markers it has across and down.
COUNTS = {
    "charuco": ("squares_x", "squares_y"), "grid": ("columns", "rows"),
    "aprilgrid": ("tagCols", "tagRows"),
}


def _others(document: Mapping[str, Any], first: int) -> Iterator[tuple[str, Board]]:
    """Yield boards that differ from a file's in an often mistaken key, each in words.

    ``first`` is the least ID that is seen.
    """
    kind = document.get("kind")
    if kind not in COUNTS:
        return
    (across, down), legacy = COUNTS[kind], bool(document.get("legacy_pattern"))
    width, height = document[across], document[down]
    sizes = dict.fromkeys([(width, height), (height, width), *itertools.product(
        (width, width - 1, width + 1), (height, height - 1, height + 1))])
    patterns = (legacy, not legacy) if kind == "charuco" else (legacy,)
    own = (width, height, legacy, document.get("first_id", 0))
    firsts = dict.fromkeys((own[3], first))
    for size, *others in itertools.product(sizes, patterns, firsts):
        change = {key: value for key, value, before in zip(
            (across, down, "legacy_pattern", "first_id"), (*size, *others), own, strict=True
        ) if value != before}
        try:
            other = board_of({**document, **change}, "board")
        except SweepError:
            continue
        if change:
            yield ", ".join(f"{key} = {shown(value)}" for key, value in change.items()), other
