"""Twins of photographs: images of their markers, simulated at the same poses."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sweep.errors import ArgumentError, PluginError
from sweep.experiment.document import file_text, read_document, refusing
from sweep.experiment.grid import TRIAL
from sweep.experiment.parameters import PHOTOGRAPHS, SIMULATED
from sweep.experiment.photographs import PhotographRecord
from sweep.experiment.pipeline import Pipeline
from sweep.messages import notice, plain

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
        distributions such as ``{"normal": [0.8, 0.1]}``. The ``background`` is as ``black`` unless
        it is given.
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
    axis, photographs = pipeline.axis(TRIAL), len(record_of(pipeline).paths)
    trials = 1 if axis is None else len(axis)
    if repeats != 1 and (repeats < 1 or trials != photographs):
        raise ArgumentError(
            "repeats", repeats, f"expected at least 1; 1 of the first of {photographs} photographs"
        )
    document = read_document(pipeline.to_toml())
    document["title"] = plain(f"Twins of {pipeline.heading}", 200)
    ground = {"background": scene["black"]} if "black" in scene else {}
    document["scene"] = {**document.get("scene", {}), SIMULATED: True, **ground, **scene}
    document.setdefault("axes", {})[TRIAL] = trials * repeats
    return Pipeline.from_dict(
        document, name=NAME.format(pipeline.name), source="scene", folder=pipeline.folder
    )


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
    ArgumentError, PipelineError
        If it cannot be read, or has no such section.
    """
    name = plain(path, 300)
    with refusing(name):
        document = read_document(file_text(os.fspath(path)))
    scene, camera = document.get("scene"), document.get("camera")
    if not isinstance(scene, dict):
        raise ArgumentError("scene", name, "expected a section [scene]")
    own, other = (
        "{width_px} x {height_px}".format_map({"width_px": None, "height_px": None, **known})
        for known in (camera if isinstance(camera, dict) else {}, like.fixed if like else {})
    )
    if own != other and "None" not in own + other:
        notice(f"{name}: fitted to images of {own}, not of {other}: its blur, noise and shifts in "
               "px are of those")
    return scene
