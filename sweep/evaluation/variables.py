"""How each variable of the dataset is computed from the results of its stage.

To add a variable, add its record to :data:`sweep.plan.schema.SCHEMA` and its function to the
table of its stage below; a variable with one but not the other is refused on import.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sweep.evaluation.board_search import BoardFindings, BoardScenes
from sweep.measure.accuracy import PoseError, rotation_difference
from sweep.measure.bound import Bounds
from sweep.measure.covariance import squared_deviations
from sweep.measure.estimation import Estimates
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped
from sweep.model.columns import Column
from sweep.model.extent import areas_px
from sweep.model.polygon import signed_areas
from sweep.model.pose import vector_of_rotation, viewing_angle
from sweep.model.scene import Scenes
from sweep.plan.parameters import Stage
from sweep.plan.schema import SCHEMA, VARIABLES
from sweep.typing import Floats, Masks


@dataclass(frozen=True, slots=True)
class SceneResults:
    """N scenes and their accuracy bounds."""

    scenes: Scenes
    bounds: Bounds


@dataclass(frozen=True, slots=True)
class DetectionResults:
    """Detections of N scenes with one detector setting: flags (N,), corners (N, 4, 2) px."""

    scenes: Scenes
    flags: NDArray[np.uint8]
    corners: Floats


@dataclass(frozen=True, slots=True)
class BoardResults:
    """Detections of N boards with one detector setting.

    Attributes
    ----------
    boards, found
        The boards, and what was found of each.
    flags
        (N,) those of the boards as a whole.
    """

    boards: BoardScenes
    found: BoardFindings
    flags: NDArray[np.uint8]

    @property
    def searched(self) -> Masks:
        """(N,) which scenes were searched without a fault."""
        return np.asarray(self.flags == self.found.flags)


@dataclass(frozen=True, slots=True)
class EstimationResults:
    """Estimates of one configuration for n scenes, those in which the marker was detected.

    Attributes
    ----------
    estimates, error
        What the estimator returned, and its errors: n of each.
    true_rotation, true_translation
        (n, 3, 3) and (n, 3) in metres, marker to camera.
    """

    estimates: Estimates
    error: PoseError
    true_rotation: Floats
    true_translation: Floats


def _of_geometry(
    function: Callable[[Scenes], NDArray[Any]]
) -> Callable[[SceneResults], NDArray[Any]]:
    return lambda results: function(results.scenes)


def _flipped(results: EstimationResults) -> NDArray[np.uint8]:
    solved = results.estimates.status == EstimateStatus.solved
    flipped = np.where(results.error.flipped, Flipped.flipped, Flipped.not_flipped)
    return np.where(solved, flipped, Flipped.no_estimate).astype(np.uint8)


def _alternative_angle_deg(results: EstimationResults) -> Floats:
    other = rotation_difference(results.estimates.alternative_rotation, results.true_rotation)
    return np.asarray(np.degrees(np.linalg.norm(other, axis=1)))


def _board_area_px(boards: BoardScenes) -> Floats:
    """Return the total area (N,) of the squares of a board's markers that are seen, px²."""
    on_board = boards.marker_id >= 0
    unseen = ~on_board | (boards.flags == DetectionStatus.not_visible)
    seen = np.where(unseen[..., None, None], 0.0, boards.corners_px)
    area = np.abs(signed_areas(seen.reshape(-1, 4, 2))).reshape(unseen.shape)
    sizes = on_board.sum(axis=1)
    total = np.full(len(area), np.nan)
    for size in np.unique(sizes):  # the order of a sum is that of its length: not of other boards'
        rows = sizes == size
        total[rows] = np.nansum(area[rows, :size], axis=1)
    return np.where(unseen.all(axis=1), np.nan, total)


def _marker_flags(results: BoardResults) -> NDArray[np.uint8]:
    """Return the flags of the markers (N, M): the board's where it was not searched."""
    known = results.searched[:, None] | (
        results.boards.flags == DetectionStatus.not_on_board
    )
    return np.where(known, results.found.marker_flags, results.flags[:, None])


def _marker_errors_px(results: BoardResults) -> Floats:
    errors = results.found.marker_corners - results.boards.corners_px
    errors[_marker_flags(results) != DetectionStatus.detected] = np.nan
    return errors


def _chessboard_errors_px(results: BoardResults) -> Floats:
    errors = results.found.chessboard_px - results.boards.chessboard_px
    errors[results.flags != DetectionStatus.detected] = np.nan
    return errors


GEOMETRY: dict[str, Callable[[Scenes], NDArray[Any]]] = {
    "true_rvec": lambda scenes: vector_of_rotation(scenes.rotation),
    "true_tvec_m": lambda scenes: scenes.translation,
    "marker_area_px": areas_px,
    "viewing_angle_deg": lambda scenes: np.degrees(
        viewing_angle(scenes.rotation, scenes.translation)
    ),
}
"""Variable that follows from camera, marker and pose -> its values (N, ...)."""

SCENE: dict[str, Callable[[SceneResults], NDArray[Any]]] = {
    **{name: _of_geometry(function) for name, function in GEOMETRY.items()},
    "bound": lambda results: results.bounds.status,
    "bound_std": lambda results: results.bounds.std,
    "bound_kappa": lambda results: results.bounds.kappa,
    "mirror_distance": lambda results: results.bounds.mirror_distance,
}
"""Variable of the scene -> its values (N, ...)."""


def photograph_variables(scenes: Scenes, values: Mapping[str, Column]) -> dict[str, NDArray[Any]]:
    """Return the variables (N, ...) that photographs have besides, by name."""
    distance = scenes.translation[:, 2]
    centre = scenes.cameras.project(scenes.translation[:, None])[:, 0]
    return {
        "side_px": scenes.cameras.view[:, 0] * scenes.size_m / distance,
        "distance_m": distance,
        "tilt_deg": values["resolved_tilt_deg"].values,
        "image_x_px": centre[:, 0], "image_y_px": centre[:, 1],
        "truth": values["truth"].values, "truth_std": values["truth_std"].values,
    }


DETECTION: dict[str, Callable[[DetectionResults], NDArray[Any]]] = {
    "detection": lambda results: results.flags,
    "corner_error_px": lambda results: results.corners - results.scenes.corners_px,
}
"""Variable of the detection -> its values (N, ...)."""

BOARD_SCENE: dict[str, Callable[[BoardScenes], NDArray[Any]]] = {
    "marker_area_px": _board_area_px,
    "board_marker_id": lambda boards: np.where(boards.marker_id < 0, np.nan, boards.marker_id),
}
"""Variable of the scene that boards have, or have otherwise -> its values (N, ...)."""

BOARD_DETECTION: dict[str, Callable[[BoardResults], NDArray[Any]]] = {
    "detection": lambda results: results.flags,
    "marker_detection": _marker_flags,
    "marker_corner_error_px": _marker_errors_px,
    "chessboard_corner_error_px": _chessboard_errors_px,
}
"""Variable of the detection of boards -> its values (N, ...)."""

ESTIMATION: dict[str, Callable[[EstimationResults], NDArray[Any]]] = {
    "estimate": lambda results: results.estimates.status,
    "translation_error_m": lambda results: results.error.translation_m,
    "rotation_error_rad": lambda results: results.error.rotation_rad,
    "rotation_error_deg": lambda results: np.degrees(results.error.rotation_angle_rad),
    "normal_error_deg": lambda results: np.degrees(results.error.normal_angle_rad),
    "reprojection_error_px": lambda results: results.estimates.reprojection_px,
    "alternative_rotation_error_deg": _alternative_angle_deg,
    "alternative_reprojection_error_px": (
        lambda results: results.estimates.alternative_reprojection_px
    ),
    "predicted_std": lambda results: np.sqrt(
        np.diagonal(results.estimates.covariance, axis1=1, axis2=2)
    ),
    "nees": lambda results: squared_deviations(
        results.error.rotation_rad, results.error.translation_m, results.estimates.covariance
    ),
    "residual_variance_ratio": lambda results: results.estimates.residual_ratio,
    "misfit_px": lambda results: results.estimates.misfit_px,
    "flipped": _flipped,
}
"""Variable of the estimation -> its values (n, ...) for the scenes with a detection."""

BOARD_ESTIMATION: dict[str, Callable[[EstimationResults], NDArray[Any]]] = {
    "point_count": lambda results: results.estimates.point_count,
}
"""Variable of the estimation that boards alone have -> its values (n, ...)."""

WITHOUT_DETECTION: dict[str, int] = {
    "estimate": EstimateStatus.no_detection, "flipped": Flipped.no_estimate,
}
"""Flag variable of the estimation -> its flag for scenes without a detection."""


def check_complete(tables: Mapping[Stage, Mapping[str, Any]]) -> None:
    """Raise TypeError unless each table has exactly the schema's variables of its stage."""
    for stage, table in tables.items():
        declared = {variable.name for variable in SCHEMA if variable.stage is stage}
        for name in sorted(declared ^ table.keys()):
            missing = "no function computes it" if name in declared else "the schema lacks it"
            raise TypeError(f"variable {name} of stage {stage.name}: {missing}")


check_complete({Stage.scene: SCENE, Stage.detection: DETECTION, Stage.estimation: ESTIMATION})

Results = TypeVar("Results")


def compute(
    table: Mapping[str, Callable[[Results], NDArray[Any]]], results: Results
) -> dict[str, NDArray[Any]]:
    """Return every variable of a table."""
    return {name: function(results) for name, function in table.items()}


def compute_estimation(
    results: EstimationResults, rows: NDArray[np.intp], needed: Masks, *, on_boards: bool = False
) -> dict[str, NDArray[Any]]:
    """Return the estimation variables (N, ...) over all scenes.

    Parameters
    ----------
    results
        Those of the n scenes with a detection.
    rows
        (n,) their numbers among the N scenes.
    needed
        (N,) scenes whose estimate was asked for; the flags of the others are ``not_run``.
    on_boards
        Whether the variables of boards belong to it.
    """
    columns = {}
    table = ESTIMATION | BOARD_ESTIMATION if on_boards else ESTIMATION
    for name, values in compute(table, results).items():
        variable = VARIABLES[name]
        fill = WITHOUT_DETECTION.get(name, variable.fill)
        column = np.full((len(needed), *values.shape[1:]), fill, dtype=values.dtype)
        column[rows] = values
        if variable.flags is not None:
            column[~needed] = variable.fill
        columns[name] = column
    return columns
