"""From a folder of photographs to a fitted scene and its file."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from sweep.errors import ArgumentError
from sweep.fitting.fit import MARKERS, SceneFit, fit_scene, scene_views
from sweep.fitting.held_out import MIN_HELD_OUT, held_out
from sweep.fitting.scene_file import scene_document, scene_text
from sweep.fitting.scenes import PhotographScenes, photograph_scenes
from sweep.fitting.views import FittedPhotograph
from sweep.model.board import Board
from sweep.photographs.prepare import prepare
from sweep.photographs.record_files import name_of, setting_name
from sweep.plan.alternatives import PHOTOGRAPHS
from sweep.plan.board_files import read_board
from sweep.plan.experiment import Pipeline
from sweep.plan.photographs import PhotographRecord, read_record

PathName = str | os.PathLike[str]

OF_MARKERS = ("dictionary", "size_m")
"""Settings that say what is in the photographs; others are of what is compared."""

COMPARED = 'cornerRefinementMethod=["none", "subpix"]'
"""What the check compares unless it is set."""

SWITCHES = (
    "sharpening", "bloom", "illumination_gradient", "noise_correlation", "geometry_px",
)
"""Effects that are kept where the errors of photographs that were not fitted say so."""

NOT_NEEDED = "brings the errors no nearer to those of photographs that were not fitted"


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
    gap
        Half of the photographs beside a simulation with the scene that the others gave
        (:func:`sweep.analysis.simulation_gap`); None without a check.
    """

    found: SceneFit
    pipeline: Pipeline
    text: str
    lines: tuple[str, ...]
    gap: xr.Dataset | None


def fit_folder(
    folders: Sequence[PathName], camera: PathName | None = None, *,
    board: PathName | None = None, poses: PathName | None = None,
    stereo: PathName | None = None, settings: Sequence[str] = (), markers: int = MARKERS,
    check: bool = True,
) -> FittedScene:
    """Return the scene of the camera that took the photographs of a folder.

    Parameters
    ----------
    folders, camera, board, poses, stereo, settings
        As for :func:`sweep.photographs.prepare.prepare`; detectors and estimators are those whose
        errors are compared.
    markers
        The most markers of a photograph that are fitted.
    check
        Whether half of the photographs are held out, to see which effects move their errors, and
        what gap is left.

    Raises
    ------
    ArgumentError, PipelineError, StoreError, RunError
        What has to be changed, in lines.
    """
    if not 1 <= markers <= 1000:
        raise ArgumentError("markers", markers, "expected a whole number from 1 to 1000")
    target = None if board is None else read_board(Path(board))
    if all(setting_name(each) in OF_MARKERS for each in settings):
        settings = [*settings, COMPARED]
    with tempfile.TemporaryDirectory() as written:
        home = Path(written).resolve()
        prepared = prepare(
            folders, camera, board=board, poses=poses, stereo=stereo, settings=settings, home=home,
        )
        pipeline = prepared.pipeline
        name = name_of(Path(folders[0]))
        record, _ = read_record(home / pipeline.values_of(PHOTOGRAPHS)[0])
        taken = photograph_scenes(pipeline, target)
        views, lines = scene_views(taken, target, markers)
        found, gap = fit_scene(views, taken, target), None
        if check:
            if len(views) >= 2 * MIN_HELD_OUT:
                found, gap = _checked(found, views, taken, target, pipeline, record, home)
            else:
                lines.append(
                    f"fewer than {2 * MIN_HELD_OUT} photographs: no half of them is held out, to "
                    "see which effects move errors"
                )
        document = scene_document(pipeline, taken, target, found)
    return FittedScene(
        found, Pipeline.from_dict(document, name=name, source="scene"),
        scene_text(document, found, record, name, lines), (*prepared.lines, *lines), gap,
    )


def _checked(
    found: SceneFit, views: Sequence[FittedPhotograph], taken: PhotographScenes,
    board: Board | None, pipeline: Pipeline, record: PhotographRecord, home: Path,
) -> tuple[SceneFit, xr.Dataset]:
    """Return the scene with what moves errors of held-out photographs, and the gap that is left.

    Every other photograph is held out, and the scene of the others simulated.
    """
    others, held = views[::2], np.array([each.number for each in views[1::2]])
    photographs = held_out(pipeline, taken, held, record, home)
    half = fit_scene(others, taken, board, known=found.tested_fits)
    gap = photographs.gap(half.scene, "whole")
    kept = {each.parameter for each in half.terms if each.kept}
    effects = {
        switch: [each.parameter for each in half.terms if switch in (each.parameter, each.of)]
        for switch in SWITCHES if switch in kept
    }
    worth = photographs.worth(gap, half.scene, effects)
    refused = {switch: NOT_NEEDED for switch, needed in worth.items() if not needed}
    if refused:
        known = found.tested_fits
        found = fit_scene(views, taken, board, refused, known)
        half = fit_scene(others, taken, board, refused, known)
        gap = photographs.gap(half.scene, "final")
    return found, gap
