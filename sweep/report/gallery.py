"""Example scenes of a store, rendered and searched again, and compared with the stored values."""

from __future__ import annotations

import dataclasses
import math
import shlex
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from sweep.errors import SweepError
from sweep.evaluation.inspection import SceneInspection, inspect_scene
from sweep.measure.flags import DetectionStatus, EstimateStatus, uncounted_values
from sweep.plan.boards import target_word
from sweep.plan.cell_selection import cell, coordinates_text, selection_text
from sweep.plan.experiment import Pipeline
from sweep.report.formatting import degrees, number, plural
from sweep.report.report_data import ReportData, store_errors
from sweep.report.scene_drawing import cut_to_marker, draw_outlines
from sweep.report.scene_selection import Index, select_scenes
from sweep.report.stored_cell import difference_from_store, stored_cell


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
    size
        Width and height of the picture, px.
    problem
        Why there is no picture, or how it differs from the stored values; empty otherwise.
    chessboard
        Whether corners of a chessboard are drawn.
    """

    titles: tuple[str, ...]
    coordinates: str
    command: str
    result: str
    alt: str
    picture: bytes | None
    size: tuple[int, int] = (0, 0)
    problem: str = ""
    chessboard: bool = False


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
    at = selection_text(data.pipeline.cell_at(index))
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
        difference = difference_from_store(data, inspected.values, stored, index)
    except (SweepError, OSError, ValueError, cv2.error, np.linalg.LinAlgError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        return dataclasses.replace(scene, problem=f"Cannot be drawn on this machine: {reason}")
    _, encoded = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    result = _result_text(inspected)
    return dataclasses.replace(
        scene, result=result, picture=encoded.tobytes(),
        problem=f"Differs from the store: {difference}." if difference else "",
        size=(picture.shape[1], picture.shape[0]),
        alt=f"Rendered {target_word(data.pipeline)} with its true outline and the detections: "
            f"{result}",
        chessboard=bool(np.isfinite(inspected.chessboard).any()),
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


def _result_text(scene: SceneInspection) -> str:
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
            f"rotation error {degrees(rotation)}",
            f"position error {number(1000 * scene.errors['translation_error_m'])} mm",
            f"reprojection error {number(scene.errors['reprojection_error_px'])} px",
        ]
    return ", ".join(parts)
