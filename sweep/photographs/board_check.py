"""Whether photographs, board and camera fit one another; and the camera from the photographs."""

from __future__ import annotations

import dataclasses
import itertools
import tomllib
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sweep.errors import ArgumentError, SweepError
from sweep.experiment.photographs import board_of
from sweep.measure import intrinsics
from sweep.measure.detectors import FindFunction
from sweep.measure.flags import CalibrationStatus
from sweep.messages import plain, shown
from sweep.model.board import Board
from sweep.model.marker import opencv_dictionary_names
from sweep.model.polygon import side_lengths
from sweep.model.pose import rotation_of_vector
from sweep.photographs.folder import FoundCorners, KnownCamera, Photograph, detect_markers, named
from sweep.photographs.pose_fit import Lens
from sweep.photographs.truth import fitted_board
from sweep.typing import Floats, Integers, Masks

# --------------------------------------------------------------------------------------------------
# Whether photographs show the board that was described; if not, which one fits better.

#: Share of the detected markers that lie where the board has them.
MIN_FITTING = 0.8

#: Share of fitting markers from which no other board is tried.
DOUBTFUL = 0.98

#: By how much more of the markers another board must fit.
CLEARLY = 0.02

#: Distance of a corner to its place by the board's homography, as a share of the marker's side.
FITTING_SHARE = 0.2

#: Relative difference of the markers' measured side to the board's that is refused; blur makes
#: detected markers up to 5 % smaller.
MAX_SIZE_ERROR = 0.08

#: Share of the markers of a single photograph that must lie there, and how many tell.
MIN_OWN, MIN_JUDGED = 0.6, 4

#: Photographs in which other dictionaries, and halves side by side, are searched for.
MAX_TRIED = 3

#: IDs (k,) and corners (k, 4, 2) px of each photograph.
Seen = Sequence[tuple[Integers, Floats]]


def check_board(
    path: Path, board: Board, seen: Seen, find: FindFunction, photographs: Sequence[Photograph]
) -> None:
    """Refuse a board that the photographs do not show.

    Raises
    ------
    ArgumentError
        One line: the fault, and which board fits.
    """
    _check_halves(board, find, photographs)
    if not any(len(ids) for ids, _ in seen):
        raise ArgumentError("board", plain(path), _no_marker(board, find, photographs))
    known = {each for ids, _ in seen for each in ids.tolist()} & set(board.marker_ids)
    if not known:
        ids = sorted({each for some, _ in seen for each in some.tolist()})
        raise ArgumentError(
            "board", plain(path),
            f"none of its markers is in the photographs, which show IDs {shown(ids)}; correct "
            "first_id or ids",
        )
    share = fitting_share(board, seen)
    own = [
        fitting_share(board, [each]) if len(each[0]) >= MIN_JUDGED else 1.0
        for each in seen[: len(photographs)]
    ]
    odd = [each.path.name for each, one in zip(photographs, own, strict=True) if one < MIN_OWN]
    if odd and len(odd) < len(own) / 2:
        raise ArgumentError(
            "folders", plain(photographs[0].path.parent, 300),
            f"{named(odd)}: less than {100 * MIN_OWN:.0f} % of the markers lie where the board "
            f"has them, unlike in {len(own) - len(odd)} other photographs; move those of another "
            "board elsewhere",
        )
    ratio = measured_side(board, seen)
    centres = board.corners_m.mean(axis=1, keepdims=True)
    scaled = dataclasses.replace(board, corners_m=centres + ratio * (board.corners_m - centres))
    if abs(ratio - 1.0) > MAX_SIZE_ERROR and fitting_share(scaled, seen) >= MIN_FITTING:
        side = float(np.linalg.norm(board.corners_m[0, 1] - board.corners_m[0, 0]))
        raise ArgumentError(
            "board", plain(path),
            f"markers of {side:g} m do not fit its other lengths, beside which the photographs "
            f"show about {side * ratio:.3g} m; correct marker_m, or the squares or gaps",
        )
    found, better = max(
        ((fitting_share(other, seen), words) for words, other in _others(path)), default=(0.0, ""),
        key=lambda each: each[0],  # of those that fit as well, the first
    ) if share <= DOUBTFUL else (0.0, "")
    better = better if found >= max(MIN_FITTING, share + CLEARLY) else ""
    if better or share < MIN_FITTING:
        raise ArgumentError(
            "board", plain(path),
            f"only {100 * share:.0f} % of the detected markers lie where it has them; "
            + (f"{better} fits" if better else "correct its kind, its rows and columns, or its "
               "IDs"),
        )


def fitting_share(board: Board, seen: Seen) -> float:
    """Return the share of all detected markers that lie where a board has them."""
    fitting = total = 0
    for ids, quads in seen:
        total += len(ids)
        known, flat = _on_board(board, ids)
        if len(flat) < 2:
            continue
        transform, _ = cv2.findHomography(
            flat.reshape(-1, 2), quads[known].reshape(-1, 2), cv2.RANSAC,
            FITTING_SHARE * float(side_lengths(quads).mean()) / 2,
        )
        if transform is None:
            continue
        mapped = cv2.perspectiveTransform(flat.reshape(1, -1, 2), transform).reshape(-1, 4, 2)
        side = side_lengths(quads[known]).mean(axis=1)
        distance = np.linalg.norm(mapped - quads[known], axis=2).max(axis=1)
        fitting += int((distance < FITTING_SHARE * side).sum())
    return fitting / total if total else 0.0


def measured_side(board: Board, seen: Seen) -> float:
    """Return the side of the markers over the board's, by the distances of their centres."""
    ratios: list[float] = []
    for ids, quads in seen:
        known, flat = _on_board(board, ids)
        if len(flat) < 4:
            continue
        tolerance = float(np.ptp(flat[0], axis=0).max()) / 4
        transform, _ = cv2.findHomography(
            quads[known].mean(axis=1), flat.mean(axis=1), cv2.RANSAC, tolerance
        )
        if transform is None:
            continue
        back = cv2.perspectiveTransform(
            quads[known].reshape(1, -1, 2), np.asarray(transform)
        ).reshape(-1, 4, 2)
        ratios += (side_lengths(back).mean(axis=1) / side_lengths(flat).mean(axis=1)).tolist()
    return float(np.median(ratios)) if ratios else 1.0


def _on_board(board: Board, ids: Integers) -> tuple[Masks, Floats]:
    """Return which markers a board has, and the corners (k, 4, 2) of these in its plane, in m."""
    index = {marker_id: k for k, marker_id in enumerate(board.marker_ids)}
    known = np.array([each in index for each in ids.tolist()], dtype=bool)
    return known, board.corners_m[[index[each] for each in ids[known].tolist()], :, :2]


#: Kind of a board -> keys of how many squares or markers it has across and down.
COUNTS = {
    "charuco": ("squares_x", "squares_y"), "grid": ("columns", "rows"),
    "aprilgrid": ("tagCols", "tagRows"),
}


def _others(path: Path) -> Iterator[tuple[str, Board]]:
    """Yield boards that differ from a file's in an often mistaken key, each in words."""
    document = tomllib.loads(path.read_text())
    kind = document.get("kind")
    if kind not in COUNTS:
        return
    across, down = COUNTS[kind]
    width, height = document[across], document[down]
    sizes: list[dict[str, Any]] = [{}, {across: height, down: width}, *(
        {across: width + x, down: height + y}
        for x, y in itertools.product((-1, 0, 1), repeat=2) if (x, y) != (0, 0)
    )]
    pattern = {"legacy_pattern": not document.get("legacy_pattern", False)}
    changes = [
        {**size, **also} for size in sizes for also in ({}, pattern if kind == "charuco" else {})
    ]
    ids = list(document.get("ids", range(width * height)))
    if kind == "grid" and len(ids) == width * height:
        lines = np.array(ids).reshape(height, width)
        changes += [
            {"ids": each.ravel().tolist(), "first_id": None}
            for each in (lines[::-1, ::-1], lines[::-1])
        ]
    for change in filter(None, changes):
        changed = {key: value for key, value in {**document, **change}.items() if value is not None}
        try:
            other = board_of(changed, "board")
        except SweepError:
            continue
        words = ", ".join(
            f"{key} = {shown(value)}" for key, value in change.items() if value is not None
        )
        yield words, other


def _check_halves(
    board: Board, find: FindFunction, photographs: Sequence[Photograph]
) -> None:
    """Refuse images of two cameras side by side: most of their markers are in both halves."""
    both = whole = 0
    for each in photographs[:MAX_TRIED]:
        height, width = each.image.shape
        if width < 2 * height:
            continue
        halves = [
            set(detect_markers(find, half, board.dictionary)[0].tolist())
            for half in (each.image[:, : width // 2], each.image[:, width // 2 :])
        ]
        both += len(halves[0] & halves[1])
        whole += len(halves[0] | halves[1])
    if whole >= MIN_JUDGED and both > whole / 2:
        raise ArgumentError(
            "folders", plain(photographs[0].path.parent, 300),
            "most markers are in both halves of the images: of two cameras side by side give the "
            "calibration (--stereo FILE)",
        )


def _no_marker(
    board: Board, find: FindFunction, photographs: Sequence[Photograph]
) -> str:
    """Return the line for photographs without a marker of a board's dictionary."""
    best, count = "", 1
    for name in opencv_dictionary_names():
        found = sum(
            len(detect_markers(find, each.image, name)[0]) for each in photographs[:MAX_TRIED]
        )
        if found > count:
            best, count = name, found
    return (
        f"no photograph shows a marker of {board.dictionary}"
        + (f"; there are {count} of {best} in the first {min(MAX_TRIED, len(photographs))}"
           if best else "; check that the board is in focus and wholly lit")
    )


# --------------------------------------------------------------------------------------------------
# Whether a camera's file is of the photographs' resolution, where it does not say.

#: RMS of a board's corners, in the median photograph, from which other resolutions are tried.
DOUBTFUL_PX = 0.5

#: Share of that RMS below which another resolution fits.
CLEARLY_BETTER = 0.5

#: Photographs with the most corners in which they are tried.
MAX_TRIED_VIEWS = 5

#: Resolutions of photographs over the resolution of a calibration.
SCALES = tuple(map(Fraction, ("1/4", "1/3", "1/2", "2/3", "3/4", "4/3", "3/2", "2", "3", "4")))


def check_resolution(
    written: str, lens: Lens, size: tuple[int, int], found: Sequence[FoundCorners], rms_px: float
) -> None:
    """Refuse a camera of a file that fits the board far better in another resolution.

    Parameters
    ----------
    written
        The file.
    lens, size
        The camera, and the photographs' width and height in px.
    found
        The board's corners in each photograph.
    rms_px
        Their RMS in the median photograph with this camera.

    Raises
    ------
    ArgumentError
        One line.
    """
    if rms_px < DOUBTFUL_PX:
        return
    best = sorted(found, key=lambda each: -len(each.points))[:MAX_TRIED_VIEWS]
    own = _median_rms(lens, best)
    fitting = {scale: _median_rms(scaled(lens, float(scale)), best) for scale in SCALES}
    scale = min(fitting, key=lambda each: fitting[each])
    if fitting[scale] < CLEARLY_BETTER * own:
        raise ArgumentError(
            "camera", plain(written),
            f"the board's corners are {own:.2g} px RMS beside it, and {fitting[scale]:.2g} px if "
            f"its numbers are times {scale}: it is of another resolution; give the calibration of "
            f"{size[0]} x {size[1]}",
        )


def scaled(lens: Lens, scale: float) -> Lens:
    """Return the camera of images that are ``scale`` times as large; pixels' edges lie at halves.

    >>> scaled(Lens.of(100.0, 100.0, 9.5, 7.5, ()), 2.0).matrix[0].tolist()
    [200.0, 0.0, 19.5]
    """
    matrix = lens.matrix.copy()
    matrix[:2] *= scale
    matrix[:2, 2] += (scale - 1.0) / 2.0
    return Lens(matrix, lens.distortion)


def _median_rms(lens: Lens, found: Sequence[FoundCorners]) -> float:
    fits = [fitted_board(lens, each) for each in found]
    return float(np.median([np.inf if fit is None else fit.rms_px for fit in fits]))


# --------------------------------------------------------------------------------------------------
# The camera from the photographs themselves.

#: Photographs with a board from which a camera is calibrated.
MIN_PHOTOGRAPHS = 4

#: Corners of a board in a photograph that is used.
MIN_CORNERS = 12

#: RMS of the corners beside the calibrated camera that is refused, in images of 800 px or less; in
#: larger ones it grows with the width.
MAX_RMS_PX = 2.0


def calibrate(size: tuple[int, int], found: Sequence[FoundCorners]) -> KnownCamera:
    """Calibrate a camera with five coefficients (:func:`sweep.measure.intrinsics.calibrate`).

    Parameters
    ----------
    size
        Width and height in pixels.
    found
        The board's corners in each photograph.

    Raises
    ------
    ArgumentError
        If too few photographs show enough of the board.
    """
    used = [each for each in found if len(each.points) >= MIN_CORNERS]
    if len(used) < MIN_PHOTOGRAPHS:
        raise ArgumentError(
            "camera", "calibrate",
            f"expected {MIN_PHOTOGRAPHS} photographs with at least {MIN_CORNERS} corners of the "
            f"board, from different sides; there are {len(used)}; take more, or give the file of a "
            "calibration",
        )
    made = intrinsics.calibrate(
        [each.points for each in used], [each.pixels for each in used], size
    )
    if made.status != CalibrationStatus.calibrated:
        raise ArgumentError(
            "camera", "calibrate",
            "OpenCV cannot calibrate from these photographs; take others, from different sides, or "
            "give the file of a calibration",
        )
    limit = MAX_RMS_PX * max(1.0, size[0] / 800)
    if made.rms_px > limit:
        raise ArgumentError(
            "camera", "calibrate",
            f"corners are {made.rms_px:.2g} px RMS beside the calibrated camera; expected at most "
            f"{limit:.2g} px: check the board's kind, that the print is flat, and that all "
            "photographs are of one camera at one focus",
        )
    fx, fy, cx, cy, *distortion = made.values.tolist()
    lens = Lens.of(fx, fy, cx, cy, tuple(distortion))
    numbers = ", ".join(
        f"{name} {value:.1f} ± {sd:.1f}"
        for name, value, sd in zip(("fx", "fy", "cx", "cy"), made.values, made.std, strict=False)
    )
    line = (
        f"camera: calibrated from {made.views} photographs, {made.rms_px:.2f} px RMS: {numbers} px "
        "(standard deviations; truth_std has of them what truth and estimates do not share)"
    )
    covariance = _covariance(lens, [used[i] for i in made.used], made)
    return KnownCamera(lens, tuple(made.std.tolist()), line, covariance)


def _covariance(lens: Lens, used: Sequence[FoundCorners], made: intrinsics.Intrinsics) -> Floats:
    """Return the covariance (9, 9) of the camera's numbers beside the photographs' poses.

    By least squares with the residuals' variance: the inverse of the Schur complement of the
    poses in the normal equations, as of a bundle adjustment (Triggs et al., 2000, section 6.1).
    """
    numbers = len(intrinsics.INTRINSICS)
    information = np.zeros((numbers, numbers))
    squares, count = 0.0, 0
    rotations = rotation_of_vector(made.turns)
    for found, rotation, shift in zip(used, rotations, made.shifts, strict=True):
        at = (found.points * [1.0, -1.0, -1.0], rotation, shift)
        image, by_pose = lens.derivatives(*at)
        pose, camera = by_pose.reshape(-1, 6), lens.camera_derivatives(*at)
        cross = pose.T @ camera
        information += camera.T @ camera - cross.T @ np.linalg.solve(pose.T @ pose, cross)
        squares += float(((image - found.pixels) ** 2).sum())
        count += 2 * len(found.points) - 6
    scale = np.sqrt(np.diag(information))  # the numbers' units differ by many powers of ten
    scaled = np.linalg.pinv(information / np.outer(scale, scale), hermitian=True)
    return np.asarray(squares / max(count - numbers, 1) * scaled / np.outer(scale, scale))
