"""The photographs of a folder, the corners of a board in them."""

from __future__ import annotations

import hashlib
import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.errors import ArgumentError, StoreError
from sweep.experiment.photographs import PHOTOGRAPH_RECORDS, SUFFIX, PhotographRecord
from sweep.experiment.pipeline import Pipeline
from sweep.measure.detectors import DetectorSetting, FindFunction, make_detector
from sweep.messages import nearest_file, plain
from sweep.model.board import Board
from sweep.model.image_file import IMAGE_SUFFIXES, Part, decode_grey, read_image
from sweep.photographs.pose_fit import Lens, Poses
from sweep.store.files import write_whole
from sweep.store.locations import translate_errors
from sweep.typing import Floats, Integers

# --------------------------------------------------------------------------------------------------
# The photographs of a folder: which files they are, and lines on them for the user.

#: The most files that a line names.
MAX_NAMED = 3


@dataclass(frozen=True, slots=True, eq=False)
class Photograph:
    """A photograph: its file, the SHA-256 of the file, and grey levels (height, width)."""

    path: Path
    digest: str
    image: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Folder:
    """Photographs of one size, by name, and lines on files left out or converted."""

    photographs: tuple[Photograph, ...]
    lines: tuple[str, ...]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        height, width = self.photographs[0].image.shape
        return width, height


def read_folder(folder: str | Path, part: Part = Part.whole) -> Folder:
    """Return the photographs of a folder, or the same half of each of its images.

    Raises
    ------
    ArgumentError
        If it has no photographs, or photographs of several sizes; in a line each.
    """
    home = Path(folder)
    try:
        files = sorted(path for path in home.iterdir() if not path.name.startswith("."))
    except OSError as error:
        reason = f"{error.strerror or 'unreadable'}{nearest_file(home)}"
        raise ArgumentError("folders", plain(home, 300), reason) from None
    photographs: list[Photograph] = []
    other = [
        path.name for path in files
        if path.suffix.lower() not in IMAGE_SUFFIXES or path.is_dir()
    ]
    unreadable: list[str] = []
    repeated: list[str] = []
    digests: dict[str, str] = {}
    notes: Counter[str] = Counter()
    for path in files:
        if path.name in other:
            continue
        if any("\ud800" <= character <= "\udfff" for character in path.name):
            unreadable.append(f"{plain(path.name)} (its name is not UTF-8, as a store needs it)")
            continue
        try:
            content = read_image(str(path))
            image = decode_grey(str(path))
        except ValueError as error:
            unreadable.append(f"{plain(path.name)} ({error})")
            continue
        digest = hashlib.sha256(content).hexdigest()
        if digest in digests:
            repeated.append(f"{plain(path.name)} (= {plain(digests[digest])})")
            continue
        digests[digest] = path.name
        notes.update(_conversions(content))
        photographs.append(Photograph(path, digest, part.of(image)))
    name = plain(home.name, 300)
    lines = [f"{name}: left out {named(other)}: no images"] if other else []
    if unreadable:
        lines.append(f"{name}: left out {named(unreadable)}")
    if repeated:
        lines.append(f"{name}: left out {named(repeated)}: the same photographs again")
    lines += [f"{name}: {count} of {len(photographs)} photographs {note}"
              for note, count in sorted(notes.items())]
    if not photographs:
        raise ArgumentError(
            "folders", plain(home, 300),
            f"expected photographs ({', '.join(each[1:].upper() for each in IMAGE_SUFFIXES)})"
            + (f"; {'; '.join(lines)}" if lines else ""),
        )
    _check_sizes(home, photographs)
    if part is not Part.whole and (width := decode_width(photographs[0])) % 2:
        raise ArgumentError(
            "folders", plain(home, 300), f"expected images of two halves; they are {width} px wide"
        )
    return Folder(tuple(photographs), tuple(lines))


def decode_width(photograph: Photograph) -> int:
    """Return the width of the whole image of a photograph."""
    return int(decode_grey(str(photograph.path)).shape[1])


def _check_sizes(home: Path, photographs: Sequence[Photograph]) -> None:
    """Raise ArgumentError if photographs have several sizes."""
    sizes = Counter(each.image.shape for each in photographs)
    if len(sizes) == 1:
        return
    (height, width), _ = sizes.most_common(1)[0]
    odd = [
        f"{plain(each.path.name)} ({each.image.shape[1]} x {each.image.shape[0]})"
        for each in photographs if each.image.shape != (height, width)
    ]
    raise ArgumentError(
        "folders", plain(home, 300),
        f"expected photographs of one size: most are {width} x {height}, not {named(odd)}; move "
        "those of another camera or size elsewhere",
    )


def named(names: Sequence[str]) -> str:
    """Return a few of some names, and how many they are."""
    rest = len(names) - MAX_NAMED
    listed = ", ".join(plain(name) for name in names[:MAX_NAMED])
    return f"{listed} and {rest} more" if rest > 0 else listed


def _conversions(content: bytes) -> list[str]:
    """Return notes on the conversion of an encoded image to 8-bit grey, upright."""
    encoded = np.frombuffer(content, np.uint8)
    stored = cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED)
    notes: list[str] = []
    if stored is None:
        return notes
    if stored.ndim == 3:
        levels = stored[..., :3]
        if (levels != levels[..., :1]).any():
            notes.append("are in colour; their grey levels are measured")
    if stored.dtype != np.uint8:
        notes.append("have 16 bits; their upper 8 are measured")
    if b"Exif" in content[:4096] or b"eXIf" in content[:4096]:
        straight = cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        turned = cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE)
        if straight is None or turned is None:
            return notes
        if straight.shape != turned.shape or not np.array_equal(straight, turned):
            notes.append(
                "are turned as their EXIF tag says; a calibration must be of images turned so"
            )
    return notes


# --------------------------------------------------------------------------------------------------
# Corners of a board in a photograph, without a model of the camera.
#
# Of a board with a chessboard they are the chessboard's inner corners: the neighbouring markers'
# homography says where they are about, and ``cv2.cornerSubPix`` measures them. Of other boards
# they are the markers' corners, as OpenCV refines them.

#: Markers whose corners give the homography around a corner of the chessboard.
NEIGHBOURS = 4

#: Half window of the search, as a share of the distance to the nearest corner of a marker.
WINDOW_SHARE = 0.8

#: Half windows, in pixels.
MIN_WINDOW, MAX_WINDOW = 2, 11

#: The detector that finds the corners of boards: whatever is under test, truth is the same.
REFERENCE = DetectorSetting(cornerRefinementMethod="subpix")


@dataclass(frozen=True, slots=True, eq=False)
class FoundCorners:
    """The corners of a board that were found in a photograph.

    Attributes
    ----------
    points, pixels
        (n, 3) in the board's frame in m, and (n, 2) px.
    number
        (n,) numbers of the corners: of the chessboard's, or 4 · marker + corner.
    """

    points: Floats
    pixels: Floats
    number: Integers


def reference_detector() -> FindFunction:
    """Return the detector that finds the corners of boards."""
    return make_detector(REFERENCE)


def detect_markers(
    find: FindFunction, image: NDArray[np.uint8], dictionary: str
) -> tuple[Integers, Floats]:
    """Return IDs (k,) and corners (k, 4, 2) of the markers in an image, each ID once."""
    quads, ids, _ = find(image, dictionary, max(image.shape))
    if ids is None:
        return np.empty(0, dtype=np.int64), np.empty((0, 4, 2))
    numbers = np.asarray(ids).ravel().astype(np.int64)
    corners = np.concatenate(list(quads)).astype(np.float64).reshape(-1, 4, 2)
    once = np.array([np.count_nonzero(numbers == each) == 1 for each in numbers.tolist()])
    return numbers[once], corners[once]


def find_corners(
    image: NDArray[np.uint8], board: Board, ids: Integers, quads: Floats
) -> FoundCorners:
    """Return the corners of a board in an image in which markers (k,), (k, 4, 2) were detected."""
    index = {marker_id: k for k, marker_id in enumerate(board.marker_ids)}
    known = np.array([each in index for each in ids.tolist()], dtype=bool)
    marker = np.array([index[each] for each in ids[known].tolist()], dtype=np.int64)
    if len(board.chessboard_m):
        number, pixels = _chessboard(image, board, marker, quads[known])
        return FoundCorners(board.chessboard_m[number], pixels, number)
    return FoundCorners(
        board.corners_m[marker].reshape(-1, 3), quads[known].reshape(-1, 2),
        (4 * marker[:, None] + np.arange(4)).ravel(),
    )


def _chessboard(
    image: NDArray[np.uint8], board: Board, marker: Integers, quads: Floats
) -> tuple[Integers, Floats]:
    """Return numbers (n,) and pixels (n, 2) of the chessboard's corners between markers."""
    if len(marker) < 2:
        return np.empty(0, dtype=np.int64), np.empty((0, 2))
    flat = board.corners_m[marker][..., :2]
    centres = flat.mean(axis=1)
    pitch = _pitch(board)
    height, width = image.shape
    numbers, pixels = [], []
    for number, point in enumerate(board.chessboard_m[:, :2]):
        distance = np.abs(centres - point).max(axis=1)
        near = np.argsort(distance, kind="stable")[:NEIGHBOURS]
        near = near[distance[near] < 2.1 * pitch]
        if len(near) < 2 or distance[near[0]] > 1.01 * pitch:
            continue
        transform, _ = cv2.findHomography(flat[near].reshape(-1, 2), quads[near].reshape(-1, 2))
        if transform is None:
            continue
        mapped = np.asarray(transform) @ [*point, 1.0]
        start = mapped[:2] / mapped[2]
        offset = np.abs(quads[near].reshape(-1, 2) - start).max(axis=1).min()
        half = int(np.clip(WINDOW_SHARE * offset, MIN_WINDOW, MAX_WINDOW))
        border = half + 2
        if not (border <= start[0] < width - border and border <= start[1] < height - border):
            continue
        found = cv2.cornerSubPix(
            image, start.astype(np.float32).reshape(1, 1, 2), (half, half), (-1, -1),
            (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-3),
        ).reshape(2).astype(np.float64)
        if np.abs(found - start).max() < half:
            numbers.append(number)
            pixels.append(found)
    return np.array(numbers, dtype=np.int64), np.array(pixels).reshape(-1, 2)


def _pitch(board: Board) -> float:
    """Return the side of a chessboard's square in m."""
    points = board.chessboard_m[:, :2]
    if len(points) < 2:
        return float(np.abs(board.corners_m[..., :2]).max())
    return float(np.linalg.norm(points[1:] - points[0], axis=1).min())


def own_corners(board: Board) -> list[set[int]]:
    """Return the numbers of each marker's own corners: those that are left out of its truth.

    Of a chessboard they are the corners of the marker's square.
    """
    if not len(board.chessboard_m):
        return [{4 * k + corner for corner in range(4)} for k in range(len(board))]
    own = []
    for corners in board.corners_m:
        distance = np.abs(board.chessboard_m - corners.mean(axis=0)).max(axis=1)
        own.append(set(np.flatnonzero(distance < 0.51 * _pitch(board) * 1.2).tolist()))
    return own


# --------------------------------------------------------------------------------------------------
# The record of photographs beside their store, and the pipeline that names it.

@dataclass(frozen=True, slots=True)
class Prepared:
    """Photographs that are ready to be measured.

    Attributes
    ----------
    pipeline
        The experiment.
    lines
        Photographs found, left out and converted, a line each.
    photographs, markers
        How many there are: markers whose pose is known.
    """

    pipeline: Pipeline
    lines: tuple[str, ...]
    photographs: int
    markers: int


def record_home(store: str | os.PathLike[str] | None) -> tuple[str, str]:
    """Return the folder and the name of the record of a store: beside it, if that is a path.

    >>> record_home("results/desk.zarr"), record_home("s3://bucket/desk.zarr"), record_home(None)
    (('results', 'desk'), ('runs', 'desk'), ('runs', ''))
    """
    if store is None:
        return "runs", ""
    url = os.fspath(store).rstrip("/")
    folder, _, last = url.rpartition("/")
    return ("runs" if "://" in url else folder or "."), last.removesuffix(".zarr")


@dataclass(frozen=True, slots=True)
class WantedMarkers:
    """The markers that are looked for: dictionary, IDs (M,) and sides (M,) in m.

    ``board`` is the document of the board's file as JSON; empty without one.
    """

    dictionary: str
    ids: tuple[int, ...]
    sizes_m: Floats
    board: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class KnownCamera:
    """A camera: its lens, the errors of its numbers as far as known, and a line on it.

    ``sd`` are their standard deviations, ``covariance`` (c, c) is None if it is not known.
    """

    lens: Lens
    sd: tuple[float, ...] = ()
    line: str = ""
    covariance: Floats | None = None


def setting_name(setting: str) -> str:
    """Return the parameter that a setting "section.key=value" or "key=value" is of."""
    return setting.partition("=")[0].strip().rpartition(".")[2]


def name_of(folder: Path) -> str:
    """Return the name that a folder gives its store."""
    return re.sub(r"[^A-Za-z0-9._+-]", "-", folder.resolve().name).strip("-._") or "photographs"


def write_record(
    found: Sequence[Folder], parts: Sequence[Part], cameras: Sequence[KnownCamera],
    markers: WantedMarkers, truth: Sequence[Poses], settings: Sequence[str], home: Path,
    name: str, lines: Sequence[str], *, overwrite: bool,
) -> Prepared:
    """Write the records, and return the experiment."""
    names = [f"{name}{SUFFIX}"] if len(found) == 1 else [
        f"{name}-{side}{SUFFIX}" for side in ("left", "right")
    ]
    contents = [
        PHOTOGRAPH_RECORDS.content(_content(folder, part, markers, poses, home))
        for folder, part, poses in zip(found, parts, truth, strict=True)
    ]
    with translate_errors(plain(home, 300), "written"):
        home.mkdir(parents=True, exist_ok=True)
        for record, content in zip(names, contents, strict=True):
            path = home / record
            used = (home / f"{name}.zarr").exists() and path.exists()
            if used and path.read_bytes() != content and not overwrite:
                raise StoreError(
                    f"{plain(path, 300)}: holds other photographs or poses, which a store may "
                    "refer to; choose another store, or overwrite it"
                )
            write_whole(path, content)
    photographs = len(found[0].photographs)
    document = _document(found, cameras, markers, names, photographs)
    pipeline = Pipeline.from_dict(
        document, [each for each in settings if setting_name(each) not in ("dictionary", "size_m")],
        name=name, source="photographs", folder=home,
    )
    known = sum(int(each.known.sum()) for each in truth)
    return Prepared(pipeline, tuple(lines), photographs, known)


def _content(
    folder: Folder, part: Part, markers: WantedMarkers, poses: Poses, home: Path
) -> PhotographRecord:
    width, height = folder.size
    start = home.resolve()
    return PhotographRecord(
        tuple(os.path.relpath(each.path.resolve(), start) for each in folder.photographs),
        tuple(each.digest for each in folder.photographs), part, width, height,
        np.array(markers.ids, dtype=np.int64), poses.rotation, poses.translation, poses.std,
        poses.source, markers.board,
    )


def _document(
    found: Sequence[Folder], cameras: Sequence[KnownCamera], markers: WantedMarkers,
    names: Sequence[str], photographs: int,
) -> dict[str, Any]:
    """Return the pipeline's document."""
    width, height = found[0].size
    numbers = [_numbers(each) for each in cameras]
    document: dict[str, Any] = {
        "title": f"Photographs of {plain(found[0].photographs[0].path.parent.name, 150)}",
        "camera": {"width_px": width, "height_px": height},
        "marker": {"dictionary": markers.dictionary},
        "scene": {},
        "axes": {"trial": photographs},
    }
    if len(names) == 1:
        document["camera"] |= numbers[0]
        if cameras[0].sd:
            document["camera"]["calibration_sd"] = list(cameras[0].sd)
        document["scene"]["photographs"] = names[0]
    else:
        columns = {key: [each[key] for each in numbers] for key in numbers[0]}
        document["axes"]["stereo_camera"] = {"zip": {"photographs": list(names), **columns}}
    if len(set(markers.sizes_m.tolist())) == 1:
        document["marker"]["size_m"] = float(markers.sizes_m[0])
        document["axes"]["marker_id"] = list(markers.ids)
    else:
        document["axes"]["marker"] = {
            "zip": {"marker_id": list(markers.ids), "size_m": markers.sizes_m.tolist()}
        }
    return document


def _numbers(camera: KnownCamera) -> dict[str, Any]:
    """Return a camera's parameters."""
    matrix = camera.lens.matrix
    return {
        "fx_px": float(matrix[0, 0]), "fy_px": float(matrix[1, 1]), "cx_px": float(matrix[0, 2]),
        "cy_px": float(matrix[1, 2]), "distortion": camera.lens.distortion.tolist(),
    }
