"""Example scenes: chosen, rendered and searched again, drawn, compared with the stored values."""

from __future__ import annotations

import io
import math
import textwrap
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.patches import Polygon
from numpy.typing import NDArray

from sweep.errors import SweepError
from sweep.evaluation.inspection import SceneInspection, inspect_scene
from sweep.experiment.pipeline import cell, coordinates_text, selection_text
from sweep.experiment.schema import VARIABLES, Variable
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped, uncounted_values
from sweep.messages import exception_line, quoted
from sweep.report.report_data import AREA, ReportData
from sweep.report.table import Table, coordinate, number, plural

# --------------------------------------------------------------------------------------------------
# One scene as a picture, with the truth and the detections drawn on it.

# Of the palette of Okabe and Ito, distinguishable by the colour-blind.
TRUTH, DETECTED, OTHER, REJECTED, CHESSBOARD = "#009e73", "#d55e00", "#cc79a7", "#f0e442", "#0072b2"
AXES = {"estimated x": "#e60000", "y": "#00aa00", "z": "#0050e6"}

#: Labels and their colours.
LEGEND = {
    "true outline": TRUTH, "detected corners (dot: the first)": DETECTED,
    "other detection": OTHER, "rejected candidate": REJECTED, **AXES,
    "corners of a chessboard": CHESSBOARD,
}

#: Pixels that the larger side of a picture has at most, unless the image has more.
MAX_SIDE = 900

#: Width of a picture, in whose proportion lines and letters are drawn, and dots an inch.
MAX_INCHES, MIN_DPI = 10, 100

MAX_ENLARGEMENT = 24

#: Part of the marker's side that is shown around it, and pixels that a part of an image has.
MARGIN, MIN_SIDE = 0.35, 4

#: Characters of a caption's line, and entries of its legend side by side.
CHARS_AN_INCH, MIN_CHARS, COLUMNS = 11, 60, 4


def scene_png(scene: SceneInspection, title: str = "", *, close: bool = False) -> bytes:
    """Return a scene enlarged as a PNG.

    Parameters
    ----------
    scene
        Image, truth and detections.
    close
        Whether the part of the image around the marker is shown, where it is seen.
    title
        First line of a caption below it: the pose on its grid. Then come what was drawn at random,
        flags and errors, and the legend.
    """
    left, top, right, bottom = around_marker(scene) if close else scene.window
    height, width = bottom - top, right - left
    scale = max(1, min(MAX_SIDE // max(height, width), MAX_ENLARGEMENT))
    dpi = max(MIN_DPI, scale * width / MAX_INCHES)
    canvas = Canvas((scale * width / dpi, scale * height / dpi), dpi=dpi)
    axes = canvas.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    _draw(axes, scene)
    axes.set(xlim=(left - 0.5, right - 0.5), ylim=(bottom - 0.5, top - 0.5))
    if title:
        drawn = ", ".join(
            f"{name} {float(value):.5g}" for name, value in scene.values.items()
            if name not in VARIABLES and value.ndim == 0)
        inches = scale * width / dpi
        chars = max(MIN_CHARS, round(CHARS_AN_INCH * inches))
        axes.legend(
            title="\n".join(
                part for line in (title, f"drawn: {drawn}" if drawn else "", result_text(scene))
                for part in textwrap.wrap(line, chars)),
            alignment="left", frameon=False, loc="upper left", bbox_to_anchor=(0, 0),
            ncols=max(2, round(COLUMNS * inches / MAX_INCHES)))
    encoded = io.BytesIO()
    canvas.savefig(encoded, format="png", dpi=dpi, bbox_inches="tight", pad_inches=0)
    return encoded.getvalue()


def _draw(axes: Axes, scene: SceneInspection) -> None:
    """Draw image, truth and detections on axes whose coordinates are pixels of the frame."""
    left, top, right, bottom = scene.window
    # The centre of pixel 0 is 0: the image begins half a pixel before it.
    extent = (left - 0.5, right - 0.5, bottom - 0.5, top - 0.5)
    axes.imshow(scene.image, cmap="gray", vmin=0, vmax=255, interpolation="nearest", extent=extent)
    several = len(scene.true_markers) > 1
    other = [quad for _, quad in scene.decoded
             if not np.isclose(quad, scene.markers, atol=0.01).all(axis=(1, 2)).any()]
    found = scene.markers[np.isfinite(scene.markers).all(axis=(1, 2))]
    for label, quads, thickness in (
        ("rejected candidate", scene.rejected, 1.0),
        ("other detection", other, 1.5),
        ("true outline", scene.true_markers, 2.0 if several else 3.5),
        ("detected corners (dot: the first)", found, 1.0 if several else 1.5),
    ):
        for k, quad in enumerate(quads):
            if np.isfinite(quad).all():
                axes.add_patch(Polygon(quad, fill=False, edgecolor=LEGEND[label],
                                       linewidth=thickness, label="" if k else label))
    size = 4.0 if several else 8.0
    circles: dict[str, Any] = {"linestyle": "", "marker": "o", "markersize": size}
    axes.plot(*found.reshape(-1, 2).T, color=DETECTED, markerfacecolor="none", **circles)
    axes.plot(*found[:, 0].T, color=DETECTED, **circles)
    chessboard = scene.chessboard[np.isfinite(scene.chessboard).all(axis=1)]
    if len(chessboard):
        axes.plot(*chessboard.T, color=CHESSBOARD, markerfacecolor="none",
                  label="corners of a chessboard", **circles)
    if np.isfinite(scene.axes_px).all():
        for (label, colour), end in zip(AXES.items(), scene.axes_px[1:], strict=True):
            axes.plot(*np.stack([scene.axes_px[0], end]).T, color=colour, linewidth=2, label=label)


def around_marker(scene: SceneInspection) -> tuple[int, ...]:
    """Return the part of a scene's window around the marker; all of it if too little is seen."""
    low, high = scene.true_corners.min(axis=0), scene.true_corners.max(axis=0)
    margin = max(MIN_SIDE, MARGIN * (high - low).max())
    left_top = np.maximum(low - margin, scene.window[:2])
    right_bottom = np.minimum(high + margin, scene.window[2:])
    if not (right_bottom - left_top >= MIN_SIDE).all():  # nor if a corner is NaN
        return scene.window
    return tuple(np.round([*left_top, *right_bottom]).astype(int).tolist())


# --------------------------------------------------------------------------------------------------
# Values of one cell as lines of text, with the stored values beside them.

def value_table(
    variables: Sequence[Variable], recomputed: Mapping[str, NDArray[Any]],
    stored: Mapping[str, NDArray[Any]] | None,
) -> Table:
    """Return a row for each variable: the recomputed value, and the stored one if it differs."""
    rows = []
    for variable in variables:
        value, beside = recomputed[variable.name], ""
        text, other = _value_text(variable, value), (stored or {}).get(variable.name)
        if other is not None and not np.array_equal(value, other, equal_nan=variable.flags is None):
            beside = _value_text(variable, other)
            beside = "other last digits" if beside == text else beside
        rows.append([variable.name, text, variable.units, beside])
    return Table.of("Values of the cell", ["variable", "value", "unit", "stored"], rows, words=True)


#: Numbers of a variable that are written out; more, as of boards' corners, are counted.
MAX_NUMBERS = 12


def _value_text(variable: Variable, value: NDArray[Any]) -> str:
    if variable.flags is not None:
        names = Counter(variable.flags(int(flag)).name for flag in np.ravel(value))
        return ", ".join(f"{count} {name}" if np.ndim(value) else str(name)
                         for name, count in names.items())
    if value.size <= MAX_NUMBERS:
        return " ".join(coordinate(float(number)) for number in value.ravel())
    return f"{np.isfinite(value).sum()} of {value.size} numbers"


# --------------------------------------------------------------------------------------------------
# Example scenes of a store: the best, the worst, a flip, and one of each failure.

#: The rotation error of a flip that is shown exceeds this: others are hardly visible.
MIN_FLIP_DEG = 5.0

Index = dict[str, int]


def select_scenes(results: xr.Dataset) -> Iterator[tuple[str, Index]]:
    """Yield a title and the index along each axis, for each kind of scene that occurs.

    Of failures, and of flips, it is the pose with the largest marker: the more surprising.
    """
    dims = tuple(str(dim) for dim in results["estimate"].dims)

    def values(name: str) -> NDArray[Any]:
        column = results[name].reset_coords(drop=True)
        return np.ravel(column.broadcast_like(results["estimate"]).transpose(*dims).values)

    estimate, detection = values("estimate"), values("detection")
    error, area = values("rotation_error_deg").astype(np.float64), np.nan_to_num(values(AREA))
    solved = (estimate == EstimateStatus.solved) & np.isfinite(error)
    flipped = values("flipped") == Flipped.flipped
    kinds = {
        "best: the smallest rotation error": (solved, -error),
        "worst: the largest rotation error": (solved, error),
        "worst without a flip": (solved & ~flipped, error),
        "flipped to the mirrored pose": (solved & flipped & (error > MIN_FLIP_DEG), area),
    }
    # A failure of the detection is flagged in the estimate, too: it is shown once.
    failures = {flag.name: (flag, column == flag) for column, flags in (
        (estimate, EstimateStatus), (detection, DetectionStatus)) for flag in flags
        if flag.counted and flag.ends and flag is not EstimateStatus.solved}
    for name, (flag, mask) in failures.items():
        meaning = f"{flag.meaning[:1].lower()}{flag.meaning[1:]}".removesuffix(".")
        kinds[f"{name.replace('_', ' ')}: {meaning}"] = mask, area
    shape = [results.sizes[dim] for dim in dims]
    for title, (mask, merit) in kinds.items():
        rows = np.flatnonzero(mask)
        if rows.size:
            at = np.unravel_index(rows[np.argmax(merit[rows])], shape)
            yield title, dict(zip(dims, map(int, at), strict=True))


# --------------------------------------------------------------------------------------------------
# Example scenes of a store, rendered and searched again.

class Scene(NamedTuple):
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
    picture
        A PNG; None if ``result`` says why there is none.
    """

    titles: Sequence[str]
    coordinates: str
    command: str
    result: str
    picture: bytes | None


def scenes_of(data: ReportData) -> list[Scene]:
    """Return the scenes of a store's gallery; kinds with the same scene share it."""
    chosen: dict[tuple[tuple[str, int], ...], list[str]] = {}
    for title, index in select_scenes(data.results):
        chosen.setdefault(tuple(index.items()), []).append(title)
    return [_scene(data, dict(key), titles) for key, titles in chosen.items()]


def _scene(data: ReportData, index: Index, titles: Sequence[str]) -> Scene:
    flags = data.results.isel(index)
    at = selection_text(data.pipeline, index)
    command = quoted("sweep", "show", data.store, *(["--at", at] if at else []))
    shown = Scene(titles, at.replace(",", ", "), command, "", None)
    if flags["detection"] == DetectionStatus.crashed or flags["estimate"] == EstimateStatus.crashed:
        return shown._replace(result="crashed: not drawn, its process died; `sweep repro` computes "
                              "it in a process of its own.")
    try:
        single = cell(data.pipeline, at)
        inspected = inspect_scene(single)
        picture = scene_png(inspected, close=True)  # the page has a caption of its own
    except (SweepError, OSError, ValueError, cv2.error, np.linalg.LinAlgError) as error:
        return shown._replace(result=f"Cannot be drawn on this machine: {exception_line(error)}")
    return shown._replace(coordinates=coordinates_text(data.pipeline, single), picture=picture,
                          result=result_text(inspected))


def result_text(scene: SceneInspection) -> str:
    """Return the flags and the errors of the pose, in words."""
    names = [scene.detection.name]
    # An estimate that follows from the detection has no words of its own.
    if scene.estimate.counted and scene.estimate.ends and (
            scene.estimate is not EstimateStatus.solved):
        names.append(scene.estimate.name)
    parts = [", ".join(name.replace("_", " ") for name in dict.fromkeys(names)),
             f"area {number(scene.area_px)} px\u00b2"]
    if "marker_detection" in scene.values:
        flags = scene.values["marker_detection"]
        counted = flags[~np.isin(flags, uncounted_values(DetectionStatus))]
        found = int((counted == DetectionStatus.detected).sum())
        parts.insert(1, f"{found} of {plural(len(counted), 'visible marker')}")
    rotation = scene.errors["rotation_error_deg"]
    if math.isfinite(rotation):
        parts += [
            f"rotation error {number(rotation)}\u00b0",
            f"position error {number(1000 * scene.errors['translation_error_m'])} mm",
            f"reprojection error {number(scene.errors['reprojection_error_px'])} px",
        ]
    return ", ".join(parts)
