"""Example scenes: chosen, rendered and searched again, drawn, compared with the stored values."""

from __future__ import annotations

import dataclasses
import io
import math
import shlex
import textwrap
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import xarray as xr
from matplotlib.figure import Figure as Canvas
from matplotlib.patches import Patch
from numpy.typing import NDArray

from sweep.errors import SweepError
from sweep.evaluation.inspection import SceneInspection, inspect_scene
from sweep.experiment.pipeline import Pipeline, cell, coordinates_text, selection_text
from sweep.experiment.schema import VARIABLES, Variable
from sweep.integrity.reproduction import StoredValues, compare
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flag, Flipped, uncounted_values
from sweep.report.report_data import AREA, ReportData, store_errors
from sweep.report.table import Table, coordinate, number, plural

# --------------------------------------------------------------------------------------------------
# One scene as a picture, with the truth and the detections drawn on it.

Colour = tuple[int, int, int]

# Blue, green, red; of the palette of Okabe and Ito, distinguishable by the colour-blind.
TRUTH: Colour = (115, 158, 0)
DETECTED: Colour = (0, 94, 213)
OTHER: Colour = (167, 121, 204)
REJECTED: Colour = (66, 228, 240)
CHESSBOARD: Colour = (178, 114, 0)
AXES: tuple[Colour, Colour, Colour] = ((0, 0, 230), (0, 170, 0), (230, 80, 0))
PAPER: Colour = (255, 255, 255)
INK: Colour = (40, 40, 40)

LEGEND: tuple[tuple[str, Colour], ...] = (
    ("true outline", TRUTH), ("detected corners (dot: the first)", DETECTED),
    ("other detection", OTHER), ("rejected candidate", REJECTED),
    ("estimated x", AXES[0]), ("y", AXES[1]), ("z", AXES[2]),
    ("corners of a chessboard", CHESSBOARD),
)
"""The meaning of the colours."""

MAX_SIDE = 900
MIN_SIDE = 560

SHIFT = 4
"""Fractional bits of the drawn coordinates."""

MARGIN = 0.35
"""Of the marker's side, shown around it."""

MIN_CUT_PX = 4

SMALL = 0.08
"""Share of a picture's larger side below which a marker is shown enlarged in a corner, too."""

INSET = 0.36
"""Share of a picture's smaller side that this takes."""

CAPTION_DPI = 100
"""Dots an inch of the caption, which grows with pictures wider than `CAPTION_PX`."""

CAPTION_PX, CAPTION_CHARS, CAPTION_COLUMNS = 1000, 90, 4
"""Pixels, characters, and entries of the legend across a caption."""


def draw_scene(scene: SceneInspection, title: str) -> NDArray[np.uint8]:
    """Return a scene enlarged, (H, W, 3), blue-green-red, with a caption below it.

    A marker that is small in the picture is framed, and shown enlarged in the corner that is
    farthest from it.

    Parameters
    ----------
    scene
        Image, truth and detections.
    title
        First line of the caption: the pose on its grid. Then come what was drawn at random, flags
        and errors, and the legend.
    """
    picture = _with_inset(draw_outlines(scene), scene)
    texts = [title, _drawn_text(scene), result_text(scene)]
    caption = _caption("\n".join(filter(None, texts)), _legend(scene),
                       max(picture.shape[1], MIN_SIDE))
    width = max(picture.shape[1], caption.shape[1])
    return np.vstack([
        cv2.copyMakeBorder(
            part, 0, 0, spare := (width - part.shape[1]) // 2, width - part.shape[1] - spare,
            cv2.BORDER_CONSTANT, value=PAPER) for part in (picture, caption)])


def cut_to_marker(scene: SceneInspection) -> SceneInspection:
    """Return a scene whose image is cut to the marker and its surroundings, where it is seen."""
    corners = scene.true_corners
    left, top, right, bottom = scene.window
    if not np.isfinite(corners).all():
        return scene
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = max(4.0, MARGIN * float((high - low).max()))
    x0, y0 = np.maximum(np.floor(low - margin), (left, top)).astype(int)
    x1, y1 = np.minimum(np.ceil(high + margin) + 1, (right, bottom)).astype(int)
    if x1 - x0 < MIN_CUT_PX or y1 - y0 < MIN_CUT_PX:
        return scene
    image = scene.image[y0 - top : y1 - top, x0 - left : x1 - left]
    return dataclasses.replace(
        scene, image=np.ascontiguousarray(image), window=(int(x0), int(y0), int(x1), int(y1)))


def _scale(scene: SceneInspection, side: float = MAX_SIDE) -> int:
    """Return by which factor the image is enlarged so that it has at most that side."""
    return max(1, min(int(side) // int(max(scene.image.shape)), 24))


def _with_inset(canvas: NDArray[np.uint8], scene: SceneInspection) -> NDArray[np.uint8]:
    """Return the picture with a frame around a small marker, and the frame's content enlarged."""
    height, width = canvas.shape[:2]
    cut = cut_to_marker(scene)
    x0, y0, x1, y1 = cut.window
    scale = _scale(scene)
    if cut is scene or scale * max(x1 - x0, y1 - y0) > 2 * SMALL * max(height, width):
        return canvas
    inset = draw_outlines(cut, INSET * min(height, width))
    line = max(2, round(max(height, width) / 600))
    frame = scale * (np.array([x0, y0, x1, y1]) - np.tile(scene.window[:2], 2))
    size, room = np.array(inset.shape[1::-1]), np.array([width, height])
    corner = np.where((frame[:2] + frame[2:]) < room, room - size - 3 * line, 3 * line)
    x, y = corner
    canvas[y : y + size[1], x : x + size[0]] = inset
    for box in (frame + np.array([-1, -1, 1, 1]) * 2 * line, np.append(corner, corner + size)):
        for colour, thickness in ((INK, 3 * line), (PAPER, line)):
            cv2.rectangle(canvas, box[:2].tolist(), box[2:].tolist(), colour, thickness)
    return canvas


def draw_outlines(scene: SceneInspection, side: float = MAX_SIDE) -> NDArray[np.uint8]:
    """Return a scene enlarged to about a side, (H, W, 3), without a caption.

    Parameters
    ----------
    scene
        Image, truth and detections.
    side
        Pixels that the larger side has at most, unless the image has more.
    """
    scale = _scale(scene, side)
    enlarged = cv2.resize(
        scene.image, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST
    )
    canvas = np.asarray(cv2.cvtColor(enlarged, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    origin = np.array(scene.window[:2], dtype=np.float64)
    weight = max(2, round(max(canvas.shape[:2]) / 700))

    def at(points: NDArray[np.float64]) -> NDArray[np.int32]:
        """Return points (n, 2) px of the frame as fixed-point coordinates of the picture."""
        # The centre of pixel 0 lies half an enlarged pixel inside the picture.
        moved = (points - origin + 0.5) * scale - 0.5
        clipped = np.clip(moved, -1e6, 1e6)
        return np.asarray(np.round(clipped * 2**SHIFT), dtype=np.int32)

    def outline(points: NDArray[np.float64], colour: Colour, thickness: int) -> None:
        if np.isfinite(points).all():
            cv2.polylines(
                canvas, [at(points).reshape(-1, 1, 2)], isClosed=True, color=colour,
                thickness=thickness, lineType=cv2.LINE_AA, shift=SHIFT,
            )

    for quad in scene.rejected:
        outline(quad, REJECTED, 1)
    for quad in other_quadrilaterals(scene):
        outline(quad, OTHER, weight)
    several = len(scene.true_markers) > 1
    for quad in scene.true_markers:
        outline(quad, TRUTH, weight + (1 if several else 3))
    radius = 3 if several else 6
    for quad in scene.markers[np.isfinite(scene.markers).all(axis=(1, 2))]:
        outline(quad, DETECTED, 1 if several else weight)
        for k, corner in enumerate(at(quad).tolist()):
            filled = cv2.FILLED if k == 0 else 1 if several else weight
            cv2.circle(
                canvas, corner, radius << SHIFT, DETECTED, filled, cv2.LINE_AA, SHIFT
            )
    for corner in at(scene.chessboard[np.isfinite(scene.chessboard).all(axis=1)]).tolist():
        cv2.circle(canvas, corner, radius << SHIFT, CHESSBOARD, weight, cv2.LINE_AA, SHIFT)
    if np.isfinite(scene.axes_px).all():
        ends = at(scene.axes_px).tolist()
        for colour, end in zip(AXES, ends[1:], strict=True):
            cv2.line(canvas, ends[0], end, colour, weight + 1, cv2.LINE_AA, SHIFT)
    return canvas


def other_quadrilaterals(scene: SceneInspection) -> list[NDArray[np.float64]]:
    """Return the decoded quadrilaterals that are not the scene's markers."""
    return [
        quad for _, quad in scene.decoded
        if not np.isclose(quad, scene.markers, atol=0.01).all(axis=(1, 2)).any()
    ]


def _legend(scene: SceneInspection) -> list[tuple[str, Colour]]:
    """Return the entries of the legend that a scene needs."""
    present = (
        True, np.isfinite(scene.markers).all(axis=(1, 2)).any(), other_quadrilaterals(scene),
        scene.rejected, *[np.isfinite(scene.axes_px).all()] * 3,
        np.isfinite(scene.chessboard).any())
    return [entry for entry, shown in zip(LEGEND, present, strict=True) if shown]


def _caption(
    text: str, legend: Sequence[tuple[str, Colour]], width: int
) -> NDArray[np.uint8]:
    """Return a legend below lines of text as a picture (h, w, 3) of about a width in px."""
    scale = max(1.0, width / CAPTION_PX)
    chars = round(CAPTION_CHARS * width / scale / CAPTION_PX)
    lines = [part for line in text.split("\n") for part in textwrap.wrap(line, chars)]
    canvas = Canvas((width / scale / CAPTION_DPI, 1), dpi=CAPTION_DPI * scale)
    canvas.legend(
        handles=[Patch(facecolor=css_colour(colour), label=entry) for entry, colour in legend],
        title="\n".join(lines), alignment="left", frameon=False,
        ncols=max(1, round(CAPTION_COLUMNS * width / scale / CAPTION_PX)))
    encoded = io.BytesIO()
    canvas.savefig(encoded, format="png", bbox_inches="tight", dpi=canvas.dpi)
    return np.asarray(cv2.imdecode(np.frombuffer(encoded.getvalue(), np.uint8), cv2.IMREAD_COLOR),
                      dtype=np.uint8)


def _drawn_text(scene: SceneInspection) -> str:
    """Return what was drawn at random for the scene; empty if nothing was."""
    drawn = ", ".join(
        f"{name} {float(value):.5g}" for name, value in scene.values.items()
        if name not in VARIABLES and value.ndim == 0)
    return f"drawn: {drawn}" if drawn else ""


def css_colour(colour: Colour) -> str:
    """Return a colour as CSS has it.

    >>> css_colour((255, 128, 0))
    '#0080ff'
    """
    blue, green, red = colour
    return f"#{red:02x}{green:02x}{blue:02x}"


# --------------------------------------------------------------------------------------------------
# Values of one cell as lines of text, with the stored values beside them.

def value_table(
    variables: Sequence[Variable], recomputed: Mapping[str, NDArray[Any]],
    stored: Mapping[str, NDArray[Any]] | None,
) -> Table:
    """Return a row for each variable: the recomputed value, and the stored one if it differs."""
    rows = []
    for variable in variables:
        value = recomputed[variable.name]
        text, beside = _text_scene_values(variable, value), ""
        if stored is not None and variable.name in stored:
            other = stored[variable.name]
            beside = _text_scene_values(variable, other)
            if beside == text:
                same = np.array_equal(value, other, equal_nan=variable.flags is None)
                beside = "" if same else "other last digits"
        rows.append([variable.name, text, variable.units, beside])
    return Table.of("Values of the cell", ["variable", "value", "unit", "stored"], rows, words=True)


MAX_NUMBERS = 12
"""Numbers of a variable that are written out; of more, as of boards' corners, a summary is."""


def _text_scene_values(variable: Variable, value: NDArray[Any]) -> str:
    if variable.flags is not None:
        names = Counter(variable.flags(int(flag)).name for flag in np.ravel(value))
        return next(iter(names)) if np.ndim(value) == 0 else ", ".join(
            f"{count} {name}" for name, count in names.items())
    if value.size > MAX_NUMBERS:
        known = value[np.isfinite(value)]
        if not known.size:
            return f"{value.size} x nan"
        return (f"RMS {coordinate(float(np.sqrt(np.mean(known**2))))}, largest "
                f"{coordinate(float(np.abs(known).max()))} of {known.size} numbers")
    return " ".join(coordinate(float(number)) for number in value.ravel())


# --------------------------------------------------------------------------------------------------
# One cell of a report's store.

def stored_cell(data: ReportData, index: Mapping[str, int]) -> StoredValues:
    """Return the stored values of the cell at an index along each axis, by variable.

    Raises
    ------
    StoreError
        If the store cannot be read.
    """
    variables = data.pipeline.experiment.variables
    names = [variable.name for variable in variables if variable.name in data.results.variables]
    with store_errors(data.store):
        cell = data.results[names].isel(index).load()
    return {name: np.asarray(cell[name].values) for name in names}


# --------------------------------------------------------------------------------------------------
# Example scenes of a store: the best, the median, the worst, a flip, and one of each failure.

MIN_FLIP_DEG = 5.0
"""The rotation error of a flip that is shown exceeds this: others are hardly visible."""

Index = dict[str, int]


def _failures() -> Iterator[Flag]:
    """Yield the flags of poses that are counted but not solved; those of both stages last."""
    for flags, other in ((DetectionStatus, EstimateStatus), (EstimateStatus, DetectionStatus)):
        ending = [flag for flag in flags if flag.counted and flag.ends]
        ending.sort(key=lambda flag: flag.name in other.__members__)
        yield from (flag for flag in ending if flag is not EstimateStatus.solved)


FAILURES: tuple[Flag, ...] = tuple(_failures())


def select_scenes(results: xr.Dataset) -> Iterator[tuple[str, Index]]:
    """Yield a title and the index along each axis, for each kind of scene that occurs.

    Of failures, and of flips, it is the pose with the largest marker: the more surprising.
    """
    dims = tuple(str(dim) for dim in results["estimate"].dims)

    def values(name: str) -> NDArray[Any]:
        column = results[name].reset_coords(drop=True)
        return np.ravel(column.broadcast_like(results["estimate"]).transpose(*dims).values)

    estimate, detection, area = values("estimate"), values("detection"), values(AREA)
    error = values("rotation_error_deg").astype(np.float64)
    area = np.nan_to_num(area, nan=-1.0, posinf=-1.0)
    solved = (estimate == EstimateStatus.solved) & np.isfinite(error)
    flipped = values("flipped") == Flipped.flipped

    def first(order: NDArray[np.intp]) -> Index:
        at = np.unravel_index(order[0], [results.sizes[dim] for dim in dims])
        return dict(zip(dims, map(int, at), strict=True))

    def largest(mask: NDArray[np.bool_], merit: NDArray[Any]) -> NDArray[np.intp]:
        """Return the cell of a mask with the largest merit; none without cells."""
        rows = np.flatnonzero(mask)
        return rows[[np.argmax(merit[rows])]] if rows.size else rows

    by_error = np.flatnonzero(solved)
    middle = (by_error.size - 1) // 2
    by_error = by_error[np.argpartition(error[by_error], middle)] if by_error.size else by_error
    kinds = {
        "best: the smallest rotation error": largest(solved, -error),
        "median rotation error of the solved": by_error[middle : middle + 1],
        "worst: the largest rotation error": largest(solved, error),
        "worst without a flip": largest(solved & ~flipped, error),
        "flipped to the mirrored pose": largest(
            solved & flipped & (error > MIN_FLIP_DEG), area),
    }
    shown = set[str]()
    for flag in FAILURES:
        # A failure of the detection is flagged in the estimate, too: it is shown once.
        flags = detection if isinstance(flag, DetectionStatus) else estimate
        if flag.name not in shown and (rows := largest(flags == flag, area)).size:
            shown.add(flag.name)
            meaning = f"{flag.meaning[:1].lower()}{flag.meaning[1:]}".removesuffix(".")
            kinds[f"{flag.name.replace('_', ' ')}: {meaning}"] = rows
    for title, rows in kinds.items():
        if rows.size:
            yield title, first(rows)


# --------------------------------------------------------------------------------------------------
# Example scenes of a store, rendered and searched again, and compared with the stored values.

@dataclass(frozen=True, slots=True)
class Scene:
    """One scene of the gallery.

    Attributes
    ----------
    titles
        The kinds of scenes that it is an example of.
    coordinates
        Its coordinates, as text.
    command
        Command line that draws it.
    result
        Flags and errors, as text.
    alt
        The picture in words.
    picture
        A PNG; None if ``problem`` says why there is none.
    problem
        Why there is no picture, or how it differs from the stored values; empty otherwise.
    """

    titles: tuple[str, ...]
    coordinates: str
    command: str
    result: str
    alt: str
    picture: bytes | None
    problem: str = ""


def scenes_of(data: ReportData) -> Iterator[Scene]:
    """Yield the scenes of a store's gallery; kinds with the same scene share it."""
    chosen: dict[tuple[tuple[str, int], ...], list[str]] = {}
    with store_errors(data.store):
        selected = list(select_scenes(data.results))
    for title, index in selected:
        chosen.setdefault(tuple(sorted(index.items())), []).append(title)
    for key, titles in chosen.items():
        yield _scene(data, dict(key), tuple(titles))


def _scene(data: ReportData, index: Index, titles: tuple[str, ...]) -> Scene:
    stored = stored_cell(data, index)
    at = selection_text(data.pipeline, index)
    command = f"sweep show {pipeline_file(data.pipeline)}"
    command += f" --at {shlex.quote(at)}" if at else ""
    detection = DetectionStatus(int(stored["detection"]))
    estimate = EstimateStatus(int(stored["estimate"]))
    scene = Scene(
        titles, at.replace(",", ", "), command, _flags_text(detection, estimate), "", None)
    if DetectionStatus.crashed is detection or EstimateStatus.crashed is estimate:
        return dataclasses.replace(
            scene, problem="Not drawn: its process died; `sweep repro` computes it in a process "
            "of its own.")
    try:
        single = cell(data.pipeline, at)
        inspected = inspect_scene(single)
        scene = dataclasses.replace(scene, coordinates=coordinates_text(data.pipeline, single))
        picture = draw_outlines(cut_to_marker(inspected))  # the page has a caption of its own
        # The store may be another machine's: as `sweep verify`, within the tolerances for those.
        difference = compare(inspected.values, stored, data.pipeline.experiment.variables,
                             same_processor=False)
    except (SweepError, OSError, ValueError, cv2.error, np.linalg.LinAlgError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        return dataclasses.replace(scene, problem=f"Cannot be drawn on this machine: {reason}")
    _, encoded = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    result = result_text(inspected)
    return dataclasses.replace(
        scene, result=result, picture=encoded.tobytes(),
        problem=f"Differs from the store: {difference}." if difference else "",
        alt=f"Rendered {data.pipeline.target_word} with its true outline and the detections: "
            f"{result}",
    )


def pipeline_file(pipeline: Pipeline) -> str:
    """Return the name of the file with a pipeline's text, quoted for a shell."""
    return shlex.quote(f"{pipeline.name}.toml")


def _flags_text(detection: DetectionStatus, estimate: EstimateStatus) -> str:
    """Return the flags in words, without an estimate that follows from the detection."""
    names = [detection.name]
    if estimate.counted and estimate.ends and estimate is not EstimateStatus.solved:
        names.append(estimate.name)
    return ", ".join(name.replace("_", " ") for name in dict.fromkeys(names))


def result_text(scene: SceneInspection) -> str:
    """Return the flags and the errors of the pose, in words."""
    parts = [scene.detection.name.replace("_", " "), f"area {number(scene.area_px)} px\u00b2"]
    if "marker_detection" in scene.values:
        flags = scene.values["marker_detection"]
        counted = flags[~np.isin(flags, uncounted_values(DetectionStatus))]
        found = int((counted == DetectionStatus.detected).sum())
        parts.insert(1, f"{found} of {plural(len(counted), 'visible marker')}")
    if scene.detection is DetectionStatus.detected and scene.estimate is not EstimateStatus.solved:
        parts.append(scene.estimate.name.replace("_", " "))
    rotation = scene.errors["rotation_error_deg"]
    if math.isfinite(rotation):
        parts += [
            f"rotation error {number(rotation)}\u00b0",
            f"position error {number(1000 * scene.errors['translation_error_m'])} mm",
            f"reprojection error {number(scene.errors['reprojection_error_px'])} px",
        ]
    return ", ".join(parts)
