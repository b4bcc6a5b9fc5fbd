"""The file of a fitted scene: a whole pipeline of the camera, as TOML with its intervals."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from sweep.fitting.fit import SceneFit
from sweep.fitting.scenes import PhotographScenes
from sweep.fitting.terms import Term, shortened
from sweep.measure.surroundings import BoardMarker, clear_modules
from sweep.messages import plain
from sweep.model.board import Board
from sweep.plan.experiment import Pipeline
from sweep.plan.photographs import PhotographRecord
from sweep.plan.toml_text import document_text
from sweep.typing import Floats

CAMERA = ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px", "distortion")

MAX_BEARING = 0.8
"""Share of the photographs' bearings that the poses of the pipeline keep to, lest their markers be
cut by the frame."""

TRIALS = 200


def scene_document(
    pipeline: Pipeline, taken: PhotographScenes, board: Board | None, found: SceneFit
) -> dict[str, Any]:
    """Return a pipeline of the fitted camera, with poses as in the photographs."""
    scenes, shown = taken.scenes, taken.shown
    first = int(np.flatnonzero(shown)[0])
    marker: dict[str, Any] = {
        "dictionary": scenes.dictionary[first], "marker_id": scenes.marker_id[first],
        "size_m": float(scenes.size_m[first]),
    }
    if board is not None:
        clear = min(clear_modules(BoardMarker(board, k)) for k in range(len(board)))
        marker["quiet_zone_modules"] = shortened(min(clear, 10.0))
    distance = scenes.translation[shown, 2]
    tilt = np.degrees(np.arccos(np.clip(-scenes.rotation[shown, 2, 2], -1, 1)))
    bearing = np.abs(scenes.translation[shown, :2] / distance[:, None])
    wide = np.degrees(np.arctan(MAX_BEARING * np.quantile(bearing, 0.9, axis=0))).tolist()
    return {
        "title": f"The camera of {plain(pipeline.name)}",
        "camera": _camera(pipeline),
        "marker": marker,
        "pose": {
            "distance_m": _between(distance), "tilt_deg": _between(tilt),
            "azimuth_deg": {"uniform": [0.0, 360.0]}, "roll_deg": {"uniform": [0.0, 360.0]},
            **{
                name: {"uniform": [-shortened(each), shortened(each)]}
                for name, each in zip(("bearing_x_deg", "bearing_y_deg"), wide, strict=True)
                if each > 0
            },
        },
        "scene": found.scene,
        "axes": {"trial": TRIALS, "cornerRefinementMethod": ["none", "subpix"]},
    }


def _between(values: Floats) -> Any:
    """Return a uniform distribution between the quantiles 5 and 95 %."""
    low, high = (shortened(each) for each in np.quantile(values, [0.05, 0.95]).tolist())
    return {"uniform": [low, high]} if low < high else low


def _camera(pipeline: Pipeline) -> dict[str, Any]:
    """Return the camera's parameters; of two cameras the left one's."""
    along = {
        name: values[0] for axis in pipeline.axes for name, values in axis.columns.items()
        if name in CAMERA
    }
    values = {name: along.get(name, pipeline.fixed.get(name)) for name in CAMERA}
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in values.items() if value is not None
    }


def scene_text(
    document: dict[str, Any], found: SceneFit, record: PhotographRecord, name: str,
    lines: Sequence[str] = (),
) -> str:
    """Return the content of the file: what it follows from, the terms, and the pipeline."""
    digest = hashlib.sha256("".join(record.digests).encode()).hexdigest()
    head = [
        f"Fitted to {found.markers} markers in {found.photographs} photographs ({plain(name)}),",
        f"SHA-256 of their digests {digest[:16]}. A distribution is the spread from photograph to",
        "photograph. Value, 95 % interval by photograph, spread:",
        *(f"  {each.parameter}: {numbers_text(each)}" for each in found.terms if each.kept),
        *(f"  left out: {each.name}: {each.reason}" for each in found.terms if not each.kept),
        *lines, *found.lines,
    ]
    return "".join(f"# {plain(line, 200)}\n" for line in head) + "\n" + document_text(document)


def numbers_text(term: Term) -> str:
    """Return a term's estimate in words."""
    one = term.estimate
    if not math.isfinite(one.value):
        return "any" if term.kept else "not known"
    text = f"{one.value:.4g}"
    if math.isfinite(one.low):
        text += f" [{one.low:.4g}, {one.high:.4g}]"
    return text + (f", spread {one.spread:.2g}" if one.spread > 0 else "")
