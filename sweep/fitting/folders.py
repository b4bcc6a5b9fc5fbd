"""From a folder of photographs to a fitted scene and its file."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sweep.errors import ArgumentError
from sweep.fitting.fit import MARKERS, SceneFit, fit_scene
from sweep.fitting.scene_file import scene_document, scene_text
from sweep.fitting.scenes import photograph_scenes
from sweep.photographs.prepare import prepare
from sweep.photographs.record_files import name_of, setting_name
from sweep.plan.alternatives import PHOTOGRAPHS
from sweep.plan.board_files import read_board
from sweep.plan.experiment import Pipeline
from sweep.plan.photographs import read_record

PathName = str | os.PathLike[str]

KNOWN_SETTINGS = ("dictionary", "size_m")


@dataclass(frozen=True, slots=True, eq=False)
class FittedScene:
    """A camera's scene from photographs.

    Attributes
    ----------
    found
        Its terms.
    pipeline
        A pipeline of this camera, with poses as in the photographs.
    text
        The pipeline's file, with intervals and what was left out in its comments.
    lines
        What is to be said of the photographs.
    """

    found: SceneFit
    pipeline: Pipeline
    text: str
    lines: tuple[str, ...]


def fit_folder(
    folders: Sequence[PathName], camera: PathName | None = None, *,
    board: PathName | None = None, poses: PathName | None = None,
    stereo: PathName | None = None, settings: Sequence[str] = (), markers: int = MARKERS,
) -> FittedScene:
    """Return the scene of the camera that took the photographs of a folder.

    Parameters
    ----------
    folders, camera, board, poses, stereo, settings
        As for :func:`sweep.photographs.prepare.prepare`.
    markers
        The most markers of a photograph that are fitted.

    Raises
    ------
    ArgumentError, PipelineError, StoreError
        What has to be changed, in lines.
    """
    if not 1 <= markers <= 1000:
        raise ArgumentError("markers", markers, "expected a whole number from 1 to 1000")
    other = [each for each in map(setting_name, settings) if each not in KNOWN_SETTINGS]
    if other:
        raise ArgumentError(
            "settings", other[0], "expected dictionary or size_m of single markers alone; the "
            "scene is fitted to pixels, not to detections"
        )
    target = None if board is None else read_board(Path(board))
    with tempfile.TemporaryDirectory() as home:
        prepared = prepare(
            folders, camera, board=board, poses=poses, stereo=stereo, settings=settings, home=home,
        )
        pipeline = prepared.pipeline
        name = name_of(Path(folders[0]))
        record, _ = read_record(Path(home) / pipeline.values_of(PHOTOGRAPHS)[0])
        taken = photograph_scenes(pipeline, target)
        found = fit_scene(taken, target, markers)
        document = scene_document(pipeline, taken, target, found)
    return FittedScene(
        found, Pipeline.from_dict(document, name=name, source="scene"),
        scene_text(document, found, record, name), prepared.lines,
    )
