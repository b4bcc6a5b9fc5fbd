"""The variables of the dataset: how each follows from the results of its stage.

To add a variable, add its record to :data:`sweep.experiment.schema.SCHEMA` and its function to
the table of its stage below; a variable with one but not the other is refused on import.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sweep.evaluation.search import SceneBatch, SearchResult
from sweep.experiment.parameters import Stage
from sweep.experiment.schema import BOARD_SCHEMA, PHOTOGRAPH_SCHEMA, SCHEMA
from sweep.measure import estimation
from sweep.measure.classify import TargetScenes
from sweep.measure.flags import Ambiguous, DetectionStatus, EstimateStatus, Flipped
from sweep.measure.likelihood import Bounds
from sweep.model.exposure import areas_px
from sweep.model.polygon import signed_areas
from sweep.model.pose import vector_of_rotation, viewing_angle
from sweep.model.scene import Scenes
from sweep.typing import Floats


@dataclass(frozen=True, slots=True)
class SceneResults:
    """N scenes with their parameters and targets, and their accuracy bounds."""

    batch: SceneBatch
    bounds: Bounds


@dataclass(frozen=True, slots=True)
class EstimationResults:
    """Estimates of one configuration for n scenes, those in which the target was detected.

    Attributes
    ----------
    estimates, error
        The estimator's poses, and their errors: n of each.
    true_rotation
        (n, 3, 3) target to camera.
    covariance
        (n, 6, 6) expected of the errors: the estimates', plus that of a photograph's truth.
    """

    estimates: estimation.Estimates
    error: estimation.PoseError
    true_rotation: Floats
    covariance: Floats


def compared(
    estimates: estimation.Estimates, batch: SceneBatch, rows: NDArray[np.intp]
) -> EstimationResults:
    """Return the estimates (n,) of the scenes ``rows`` beside the truth and their errors."""
    rotation, translation = batch.scenes.rotation[rows], batch.scenes.translation[rows]
    error = estimation.pose_error(estimates.rotation, estimates.translation, rotation, translation)
    covariance = estimates.covariance
    if "truth_std" in batch.values and "neighbourhood" not in batch.values:  # twins are exact
        std = np.nan_to_num(batch.values["truth_std"].values[rows]).astype(np.float64)
        covariance = covariance + std[:, None] ** 2 * np.eye(std.shape[1])
    return EstimationResults(estimates, error, rotation, covariance)


def target_areas_px(scenes: Scenes, targets: TargetScenes) -> Floats:
    """Return the total area (N,) of the squares of each target that are seen, px².

    Of a marker alone the area of its square, seen or not.
    """
    if targets.targets.are_markers:
        return areas_px(scenes)
    on_board = targets.marker_id >= 0
    unseen = ~on_board | (targets.flags == DetectionStatus.not_visible)
    seen = np.where(unseen[..., None, None], 0.0, targets.corners_px)
    area = np.abs(signed_areas(seen.reshape(-1, 4, 2))).reshape(unseen.shape)
    sizes = on_board.sum(axis=1)
    total = np.full(len(area), np.nan)
    for size in np.unique(sizes):  # the order of a sum is that of its length: not of other boards'
        rows = sizes == size
        total[rows] = np.nansum(area[rows, :size], axis=1)
    return np.where(unseen.all(axis=1), np.nan, total)


def _flipped(results: EstimationResults) -> NDArray[np.uint8]:
    solved = results.estimates.status == EstimateStatus.solved
    flipped = np.where(results.error.flipped, Flipped.flipped, Flipped.not_flipped)
    return np.where(solved, flipped, Flipped.no_estimate).astype(np.uint8)


def _alternative_angle_deg(results: EstimationResults) -> Floats:
    second = results.estimates.alternative_rotation
    turn = estimation.rotation_difference(second, results.true_rotation)
    return np.asarray(np.degrees(np.linalg.norm(turn, axis=1)))


def _marker_flags(results: SearchResult) -> NDArray[np.uint8]:
    """Return the flags of the markers (N, M): the target's where it was not searched."""
    searched = results.flags == results.found.flags
    known = searched[:, None] | (results.targets.flags == DetectionStatus.not_on_board)
    return np.where(known, results.found.marker_flags, results.flags[:, None])


def _marker_errors_px(results: SearchResult) -> Floats:
    return results.found.marker_corners - results.targets.corners_px


def _chessboard_errors_px(results: SearchResult) -> Floats:
    errors = results.found.chessboard_px - results.targets.chessboard_px
    errors[results.flags != DetectionStatus.detected] = np.nan
    return errors


#: Variable that follows from camera and pose -> its values (N, ...).
GEOMETRY: dict[str, Callable[[Scenes], NDArray[Any]]] = {
    "true_rvec": lambda scenes: vector_of_rotation(scenes.rotation),
    "true_tvec_m": lambda scenes: scenes.translation,
    "viewing_angle_deg": lambda scenes: np.degrees(
        viewing_angle(scenes.rotation, scenes.translation)),
}


def _centre_px(scenes: Scenes) -> Floats:
    return np.asarray(scenes.cameras.project(scenes.translation[:, None])[:, 0])


#: Variable of photographs, whose poses are not drawn but found -> its values (N,).
OF_PHOTOGRAPHS: dict[str, Callable[[Scenes], NDArray[Any]]] = {
    "side_px": lambda scenes: scenes.cameras.view[:, 0] * scenes.size_m / scenes.translation[:, 2],
    "distance_m": lambda scenes: scenes.translation[:, 2],
    "image_x_px": lambda scenes: _centre_px(scenes)[:, 0],
    "image_y_px": lambda scenes: _centre_px(scenes)[:, 1],
}

#: Variable of the scene -> its values (N, ...).
SCENE: dict[str, Callable[[SceneResults], NDArray[Any]]] = {
    **{
        name: lambda results, function=function: function(results.batch.scenes)  # type: ignore[misc]
        for name, function in (GEOMETRY | OF_PHOTOGRAPHS).items()
    },
    "marker_area_px": lambda results: target_areas_px(
        results.batch.scenes, results.batch.targets
    ),
    "board_marker_id": lambda results: np.where(
        results.batch.targets.marker_id < 0, np.nan, results.batch.targets.marker_id
    ),
    "bound": lambda results: results.bounds.status,
    "bound_std": lambda results: results.bounds.std,
    "bound_kappa": lambda results: results.bounds.kappa,
    "mirror_distance": lambda results: results.bounds.mirror_distance,
    "tilt_deg": lambda results: results.batch.values["resolved_tilt_deg"].values,
    "truth": lambda results: results.batch.values["truth"].values,
    "truth_std": lambda results: results.batch.values["truth_std"].values,
}

#: Variable of the detection -> its values (N, ...).
DETECTION: dict[str, Callable[[SearchResult], NDArray[Any]]] = {
    "detection": lambda results: results.flags,
    "corner_error_px": lambda results: _marker_errors_px(results)[:, 0],
    "marker_detection": _marker_flags,
    "marker_corner_error_px": _marker_errors_px,
    "chessboard_corner_error_px": _chessboard_errors_px,
}

#: Variable of the estimation -> its values (n, ...) for the scenes with a detection.
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
    "nees": lambda results: estimation.squared_deviations(
        results.error.rotation_rad, results.error.translation_m, results.covariance),
    "residual_variance_ratio": lambda results: results.estimates.residual_ratio,
    "misfit_px": lambda results: results.estimates.misfit_px,
    "flipped": _flipped,
    "ambiguous": lambda results: results.estimates.ambiguous,
    "point_count": lambda results: results.estimates.point_count,
}

#: All scenes.
ALL = slice(None)

#: Flag variable of the estimation -> its flag for scenes without a detection.
WITHOUT_DETECTION: dict[str, int] = {
    "estimate": EstimateStatus.no_detection, "flipped": Flipped.no_estimate,
    "ambiguous": Ambiguous.not_judged,
}


def check_complete(tables: Mapping[Stage, Mapping[str, Any]]) -> None:
    """Raise TypeError unless each table has exactly the schema's variables of its stage."""
    for stage, table in tables.items():
        declared = {
            variable.name for variable in (*SCHEMA, *BOARD_SCHEMA, *PHOTOGRAPH_SCHEMA)
            if variable.stage is stage
        }
        for name in sorted(declared ^ table.keys()):
            missing = "no function computes it" if name in declared else "the schema lacks it"
            raise TypeError(f"variable {name} of stage {stage.name}: {missing}")


check_complete({Stage.scene: SCENE, Stage.detection: DETECTION, Stage.estimation: ESTIMATION})

Results = TypeVar("Results")


def write(
    columns: Mapping[str, NDArray[Any]], table: Mapping[str, Callable[[Results], NDArray[Any]]],
    results: Results, configuration: int, rows: NDArray[np.intp] | slice = ALL,
) -> None:
    """Write the variables of a table to those columns (configurations, N, ...) that exist.

    ``rows`` (n,) are the scenes whose ``results`` they are computed from.
    """
    for name in table.keys() & columns.keys():
        columns[name][configuration, rows] = table[name](results)
