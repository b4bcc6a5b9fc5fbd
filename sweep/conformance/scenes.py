"""The scenes on which a detector is tried: free of noise, and each with its point reflection."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sweep.errors import PipelineError
from sweep.evaluation.opencv_threads import single_threaded
from sweep.measure.detectors import AnyDetectorSetting
from sweep.model.extent import marker_boxes
from sweep.model.marker import dictionary_names, marker_count
from sweep.model.renderers import render_all
from sweep.model.scene import build_scenes
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import detector_settings, scene_values
from sweep.plan.parameters import Stage
from sweep.typing import Floats, Grey, Integers

SCENES = 32
WIDTH_PX, HEIGHT_PX, FOCAL_PX = 640, 480, 600.0
SIDES_PX = (60.0, 150.0)
MAX_TILT_DEG = 45.0
MAX_BEARING_DEG = 8.0


@dataclass(frozen=True)
class TrialScenes:
    """N scenes, and the detector's setting.

    Attributes
    ----------
    setting
        The one setting of the detector.
    dictionary
        Of all markers.
    marker_id, corners_px
        (N,) and (N, 4, 2): the truth. Scene i + N/2 is scene i turned by 180° about the image's
        centre, exactly: errors that belong to the marker cancel in the mean, offsets do not.
    images
        (480, 640) each.
    """

    setting: AnyDetectorSetting
    dictionary: str
    marker_id: Integers
    corners_px: Floats
    images: list[Grey]


def trial_pipeline(
    detector: str, dictionary: str, settings: Sequence[str], folder: str, count: int = SCENES
) -> Pipeline:
    """Return the pipeline of ``count`` scenes and one setting of a detector.

    Raises
    ------
    PipelineError
        If there is no such detector, or a setting is not valid.
    """
    rng = np.random.default_rng(20)
    half = count // 2
    reflected = {
        "azimuth_deg": rng.uniform(0, 180, half), "roll_deg": rng.uniform(0, 180, half),
    }
    drawn = {
        "tilt_deg": rng.uniform(0, MAX_TILT_DEG, half),
        "side_px": np.geomspace(*SIDES_PX, half).round(2),
    }
    negated = {
        name: rng.uniform(-MAX_BEARING_DEG, MAX_BEARING_DEG, half)
        for name in ("bearing_x_deg", "bearing_y_deg")
    }
    columns = {name: [*values, *values] for name, values in drawn.items()}
    columns |= {name: [*values, *(values + 180)] for name, values in reflected.items()}
    columns |= {name: [*values, *(-values)] for name, values in negated.items()}
    written = {name: [round(float(value), 6) for value in values] for name, values in
               columns.items()}
    known = dictionary in dictionary_names()  # others are refused below
    ids = rng.integers(marker_count(dictionary) if known else 1, size=half).tolist()
    written["marker_id"] = [*ids, *ids]
    zipped = ", ".join(f"{name} = {json.dumps(values)}" for name, values in written.items())
    text = f"""
        title = "Conformance"
        [camera]
        width_px = {WIDTH_PX}
        height_px = {HEIGHT_PX}
        fx_px = {FOCAL_PX}
        fy_px = {FOCAL_PX}
        [marker]
        dictionary = {json.dumps(dictionary)}
        [detector]
        detector = {json.dumps(detector)}
        [axes]
        trial_scene = {{ zip = {{ {zipped} }} }}
    """
    pipeline = Pipeline.from_text(text, settings, source="check-detector", folder=folder)
    if len(pipeline.axes) > 1 or len(detector_settings(pipeline)) != 1:
        raise PipelineError(["check-detector: a detector is tried with one setting: no axes"])
    return pipeline


@single_threaded()
def trial_scenes(pipeline: Pipeline) -> TrialScenes:
    """Return the scenes of :func:`trial_pipeline`, rendered as whole frames."""
    (axis,) = pipeline.axes_of(Stage.scene)
    values = scene_values(pipeline, [np.arange(len(axis))])
    scenes = build_scenes(values, len(axis))
    rows = np.arange(len(scenes))
    frames = np.concatenate([np.zeros_like(scenes.frame), scenes.frame], axis=1)
    images = render_all(scenes, rows, marker_boxes(scenes), frames)
    return TrialScenes(
        detector_settings(pipeline)[0], scenes.dictionary[0], np.array(scenes.marker_id),
        scenes.corners_px, [np.ascontiguousarray(image) for image in images],
    )
