"""Truth by a file of poses, which is checked against the markers that are detected."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sweep.errors import PipelineError
from sweep.exchange.answers import read_answers
from sweep.exchange.conventions import Conventions
from sweep.measure.flags import TruthSource
from sweep.messages import plain, refusal
from sweep.model.marker import marker_corners
from sweep.photographs.folder import Folder
from sweep.photographs.pose_fit import Lens
from sweep.photographs.poses import Poses
from sweep.photographs.record_files import WantedMarkers
from sweep.photographs.reference_pose import SeenMarkers, is_within, own_poses
from sweep.typing import Floats

NEAR_SHARE = 0.5
"""Distance of a detected corner to that of the file's pose, as a share of the marker's side."""

OTHER_UNIT = 1.5
"""Ratio of distances from which positions are taken for those in another unit."""


def poses_of_file(
    path: Path, folder: Folder, markers: WantedMarkers, lens: Lens, seen: Sequence[SeenMarkers]
) -> tuple[Poses, list[str]]:
    """Return the poses that a file gives of markers wholly in their photographs, and lines.

    Raises
    ------
    PipelineError, StoreError
        If it cannot be read, is of other images or markers, or if most detected markers are not
        where its poses have them; in lines.
    """
    names = {each.path.stem: k for k, each in enumerate(folder.photographs)}
    if len(names) < len(folder.photographs):
        raise refusal([f"{plain(path)}: expected photographs of different names without suffixes"])
    try:
        answers = read_answers(path, names, Conventions())
    except PipelineError as error:
        raise PipelineError([_of_photographs(line) for line in error.faults]) from None
    index = {each: k for k, each in enumerate(markers.ids)}
    unknown = sorted(set(answers.marker_id.tolist()) - index.keys())
    if unknown:
        raise refusal([
            f"{plain(path)}: marker {unknown[0]}: expected one of the board or the photographs"
        ])
    if not np.isfinite(answers.translation).all() or not np.isfinite(answers.rotation).all():
        raise refusal([f"{plain(path)}: expected a pose in each row: rx, ry, rz, tx, ty, tz"])
    poses, cut = Poses.none(len(names), len(markers.ids)), 0
    for photograph, marker_id, rotation, translation in zip(
        answers.image.tolist(), answers.marker_id.tolist(), answers.rotation, answers.translation,
        strict=True,
    ):
        marker = index[marker_id]
        poses.put(photograph, marker, rotation, translation, np.full(6, np.nan),
                  TruthSource.poses_file)
    if fault := _fault(poses, markers.sizes_m, lens, seen):
        raise refusal([f"{plain(path)}: {fault}"])
    for photograph, marker in np.argwhere(poses.known).tolist():
        pose = poses.rotation[photograph, marker], poses.translation[photograph, marker]
        if not is_within(lens, folder.size, markers.sizes_m[marker], *pose):
            poses.translation[photograph, marker] = np.nan
            cut += 1
    lines = [f"{cut:,} poses of markers that are not wholly in the frame: not counted"]
    return poses, lines if cut else []


def _of_photographs(line: str) -> str:
    """Return the line of a fault of answers to an export as one of photographs."""
    line = line.partition("; delete one, or pass")[0]
    if "is not among those that were exported" in line:
        line, _, hint = line.partition("; expected a name such as ")
        line = line.replace("is not among those that were exported", "is none of the photographs")
        line += f"; expected a name such as {hint.removesuffix('.png')}" if hint else ""
    return line


def _fault(
    poses: Poses, sizes_m: Floats, lens: Lens, seen: Sequence[SeenMarkers]
) -> str:
    """Return what is wrong with poses that are not where markers are detected; empty if nothing."""
    own = own_poses(lens, sizes_m, seen)
    distances, ratios = [], []
    for photograph, each in enumerate(seen):
        for marker, quad in zip(each.marker.tolist(), each.quads, strict=True):
            rotation = poses.rotation[photograph, marker]
            translation = poses.translation[photograph, marker]
            if np.isnan(translation).any() or np.isnan(own.translation[photograph, marker]).any():
                continue
            points = marker_corners(sizes_m[marker : marker + 1])[0]
            ratios.append(float(
                np.linalg.norm(translation) / np.linalg.norm(own.translation[photograph, marker])
            ))
            side = float(np.linalg.norm(np.roll(quad, -1, axis=0) - quad, axis=1).mean())
            behind = ((points @ rotation.T + translation)[:, 2] <= 0).any()
            away = np.linalg.norm(lens.project(points, rotation, translation) - quad, axis=1).max()
            distances.append(np.inf if behind else float(away) / side)
    if not distances or np.median(distances) < NEAR_SHARE:
        return ""
    ratio = float(np.median(ratios))
    if not 1 / OTHER_UNIT < ratio < OTHER_UNIT:
        return (
            f"its positions are {ratio:.3g} times those of the detected markers; expected metres, "
            "and the marker's true size"
        )
    return (
        "most markers are not where its poses have them; expected rotation vectors and positions "
        "from the marker's frame (x right, y up) to the camera's (x right, y down, z forward)"
    )
