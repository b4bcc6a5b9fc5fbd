"""Twins of photographs: images of their markers, simulated at the same poses."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sweep.errors import ArgumentError, PluginError
from sweep.experiment.document import MAX_BYTES, read_document
from sweep.experiment.grid import TRIAL, parse_distribution
from sweep.experiment.parameters import PARAMETERS, PHOTOGRAPHS, SIMULATED
from sweep.experiment.photographs import PhotographRecord
from sweep.experiment.pipeline import Pipeline
from sweep.messages import notice, plain
from sweep.model.image_file import read_regular

#: Name of the twins of photographs of a name.
NAME = "{}-twins"


def twin_pipeline(pipeline: Pipeline, scene: Mapping[str, Any], repeats: int = 1) -> Pipeline:
    """Return the pipeline that simulates the markers of photographs at their true poses.

    Each image has one marker on a plain ground, with what its board has printed around it. Camera,
    detectors, estimators, rows and flags are the photographs' own, so that results pair: trial
    k has the poses of photograph k modulo their number. What is drawn of the scene is drawn for
    each photograph and repeat, and is the same for all its markers; noise and shifts are each
    marker's own.

    Parameters
    ----------
    pipeline
        The pipeline of a store of photographs.
    scene
        Parameters of the section [scene] by name, as a document has them: values, or
        distributions such as ``{"normal": [0.8, 0.1]}``. The ``background`` has the median level of
        ``black`` unless it is given.
    repeats
        How often each photograph is simulated.

    Raises
    ------
    ArgumentError, PipelineError
        If the pipeline is not one of photographs, or the scene is not valid.
    """
    if not pipeline.shows_photographs:
        raise ArgumentError(
            "photographs", plain(pipeline.name),
            "expected a store of photographs, as `sweep photos` makes it",
        )
    if repeats < 1:
        raise ArgumentError("repeats", repeats, "expected at least 1")
    axis = pipeline.axis(TRIAL)
    trials = 1 if axis is None else len(axis)
    photographs = len(record_of(pipeline).paths)
    if repeats > 1 and trials != photographs:
        raise ArgumentError(
            "repeats", repeats, f"expected 1, for the {trials} first of {photographs} photographs"
        )
    document = read_document(pipeline.to_toml())
    document["title"] = plain(f"Twins of {pipeline.heading}", 200)
    document["scene"] = {
        **document.get("scene", {}), SIMULATED: True, **_ground(scene.get("black")), **scene,
    }
    document.setdefault("axes", {})[TRIAL] = trials * repeats
    return Pipeline.from_dict(
        document, name=NAME.format(pipeline.name), source="scene", folder=pipeline.folder
    )


def _ground(black: Any) -> dict[str, float]:
    """Return the background of the median level of black; nothing if black is not given."""
    try:
        if isinstance(black, dict):
            drawn = parse_distribution(PARAMETERS["black"], black)
            return {"background": float(drawn.at(np.array([0.5]))[0])}
        return {} if black is None else {"background": float(black)}
    except (TypeError, ValueError):
        return {}  # the pipeline's check names its fault


def record_of(pipeline: Pipeline) -> PhotographRecord:
    """Return the record of photographs of a pipeline; of two cameras the left one's.

    Raises
    ------
    ArgumentError
        If it cannot be read.
    """
    name = str(pipeline.values_of(PHOTOGRAPHS)[0])
    try:
        return PhotographRecord.read(Path(pipeline.folder) / name)[0]
    except PluginError as error:
        raise ArgumentError(PHOTOGRAPHS, plain(name), f"expected {error}") from None


def twin_store(photographs: str | os.PathLike[str], scene: str | os.PathLike[str]) -> str:
    """Return the store of the twins of a store of photographs with a file's scene.

    >>> twin_store("runs/shots.zarr", "fitted/webcam.toml")
    'runs/shots-webcam.zarr'
    """
    return f"{os.fspath(photographs).rstrip('/').removesuffix('.zarr')}-{Path(scene).stem}.zarr"


def read_scene(path: str | os.PathLike[str], like: Pipeline | None = None) -> dict[str, Any]:
    """Return the section [scene] of a TOML file, such as `sweep fit` writes.

    Warns if its camera has other pixels than the camera of ``like``, whose twins get the scene.

    Raises
    ------
    ArgumentError
        If it cannot be read, or has no such section.
    """
    try:
        document = read_document(read_regular(os.fspath(path), MAX_BYTES).decode())
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ArgumentError("scene", plain(path, 300), f"cannot be read: {reason}") from None
    scene, camera = document.get("scene"), document.get("camera")
    if not isinstance(scene, dict):
        raise ArgumentError("scene", plain(path, 300), "expected a section [scene]")
    sizes = [
        tuple(known.get(name) for name in ("width_px", "height_px"))
        for known in (camera if isinstance(camera, dict) else {}, like.fixed if like else {})
    ]
    if None not in sizes[0] + sizes[1] and sizes[0] != sizes[1]:
        notice(
            f"{plain(path, 300)}: fitted to images of {sizes[0][0]} x {sizes[0][1]}, not of "
            f"{sizes[1][0]} x {sizes[1][1]}: its blur, noise and shifts in px are of those"
        )
    return scene
