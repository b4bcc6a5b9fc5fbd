"""The scenes of photographs: their images, and where their markers are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sweep.measure.flags import TruthSource
from sweep.model.board import Board
from sweep.model.columns import Column
from sweep.model.photograph import photograph_image
from sweep.model.rotations import angles_of_rotation
from sweep.model.scene import Scenes, build_scenes
from sweep.photographs.board_truth import board_poses
from sweep.photographs.corners import find_corners, reference_detector
from sweep.photographs.pose_fit import Lens
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import scene_axes, scene_values
from sweep.typing import Floats, Integers, Masks


@dataclass(frozen=True, slots=True, eq=False)
class PhotographScenes:
    """The scenes of photographs: all markers in all of them, photograph by photograph.

    Attributes
    ----------
    scenes
        The N scenes.
    trial, source
        (N,) numbers of the photographs, and where the poses come from
        (:class:`~sweep.measure.flags.TruthSource`).
    """

    scenes: Scenes
    trial: Integers
    source: NDArray[np.uint8]

    @property
    def shown(self) -> Masks:
        """Which scenes have a true pose, (N,)."""
        return np.asarray(np.isfinite(self.scenes.corners_px).all(axis=(1, 2)))

    @property
    def frame(self) -> Floats:
        """Width and height of the photographs in px, (2,)."""
        return np.asarray(self.scenes.frame[0], dtype=np.float64)

    def lens(self, row: int) -> Lens:
        """Return the camera of a scene."""
        cameras = self.scenes.cameras
        return Lens(cameras.matrix(row), cameras.lenses[row, :14])


def photograph_scenes(pipeline: Pipeline, board: Board | None) -> PhotographScenes:
    """Return the scenes of the pipeline of photographs; of a stereo camera the left one's.

    A board that is in them says better where its markers are than the other camera, whose poses
    have the error of a single marker.
    """
    axes = scene_axes(pipeline)
    lengths = [1 if axis.name == "stereo_camera" else len(axis) for axis in axes]
    indices = [each.ravel() for each in np.indices(lengths)]
    count = len(indices[0])
    trial = next(
        (index for axis, index in zip(axes, indices, strict=True) if axis.name == "trial"),
        np.zeros(count, dtype=np.int64),
    )
    values = scene_values(pipeline, indices)
    taken = PhotographScenes(
        build_scenes(values, count), trial, values["truth"].broadcast(count, np.uint8)
    )
    stereo = (taken.source == TruthSource.stereo_partner).any()
    return _by_board(taken, values, board) if stereo and board is not None else taken


def _by_board(
    taken: PhotographScenes, values: Mapping[str, Column], board: Board
) -> PhotographScenes:
    """Return the scenes with the poses of the board's markers, by its other corners."""
    find, scenes, count = reference_detector(), taken.scenes, len(taken.trial)
    rotation, translation = np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan)
    for number in np.unique(taken.trial).tolist():
        rows = np.flatnonzero(taken.trial == number)
        image = photograph_image(str(scenes.background[rows[0]]))
        poses = board_poses(
            board, taken.lens(rows[0]), image.shape[::-1], [find_corners(find, image, board)]
        ).poses
        for row in rows.tolist():
            marker = board.marker_ids.index(scenes.marker_id[row])
            rotation[row] = poses.rotation[0, marker]
            translation[row] = poses.translation[0, marker]
    with np.errstate(invalid="ignore"):
        angles = [np.degrees(each) for each in angles_of_rotation(rotation)]
    names = "resolved_tilt_deg", "resolved_azimuth_deg", "resolved_roll_deg"
    known = np.isfinite(translation[:, 2])
    source = np.where(known, TruthSource.board_without_this_marker, TruthSource.none)
    posed = {**values, **{
        name: Column.of(each) for name, each in zip(
            (*names, "x_m", "y_m", "distance_m"), (*angles, *translation.T), strict=True
        )
    }}
    return PhotographScenes(build_scenes(posed, count), taken.trial, source.astype(np.uint8))
