"""A plug-in's solver: what it returns is checked as our own solvers' poses are."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import PluginError
from sweep.measure.covariance import corner_covariance
from sweep.measure.estimation import Estimates
from sweep.measure.flags import EstimateStatus
from sweep.measure.solver import reprojection_errors_px
from sweep.plugins import EstimatorPlugin, Poses
from sweep.plugins.calls import call, real_numbers
from sweep.typing import Floats

ROTATION_ATOL = 1e-6
"""How far a rotation matrix times its transpose may be from the unit matrix."""


class PluggedEstimator:
    """One setting of a plug-in's solver of single markers in this process.

    Parameters
    ----------
    name
        The plug-in's, for messages.
    record
        Its declaration.
    settings
        An instance of its settings; None without.
    reprojection_limit, corner_noise_px
        As :class:`sweep.measure.solver.CornerSolver` has them.
    """

    def __init__(
        self, name: str, record: EstimatorPlugin, settings: Any, reprojection_limit: float,
        corner_noise_px: float | None,
    ) -> None:
        self._name = name
        self._limit = reprojection_limit
        self._noise_px = corner_noise_px
        self.needs_images = record.needs_images
        self._solve = call(name, record.make, settings)
        if not callable(self._solve):
            raise PluginError(
                f"{name}: make returns a {type(self._solve).__name__}, not a function"
            )

    def __call__(self, detections: Any) -> Estimates:
        """Return the poses that the plug-in finds, those that are credible.

        NaN, a corner behind the camera, and a reprojection error above the limit are no solution.

        Raises
        ------
        PluginError
            If the plug-in raises, or returns what cannot be poses; in one line.
        """
        count = len(detections.origins)
        if count == 0:
            return Estimates.none(0, EstimateStatus.solver_failed)
        poses = self._checked(call(self._name, self._solve, self._copied(detections)), count)
        rotation, translation = poses.rotation, poses.translation
        reprojection = self._reprojection_px(rotation, translation, detections)
        solved = self._is_credible(reprojection, detections)
        rotation[~solved], translation[~solved], reprojection[~solved] = np.nan, np.nan, np.nan
        alternative = np.full((count, 3, 3), np.nan)
        alternative_px = np.full(count, np.nan)
        if poses.alternative_rotation is not None:
            alternative = poses.alternative_rotation
            alternative_px = self._reprojection_px(
                alternative, poses.alternative_translation, detections
            )
            missing = ~(solved & self._is_credible(alternative_px, detections))
            alternative[missing], alternative_px[missing] = np.nan, np.nan
        covariance = poses.covariance
        if covariance is None and self._noise_px is not None:
            covariance = self._covariance(rotation, translation, detections, self._noise_px)
        if covariance is None:
            covariance = np.full((count, 6, 6), np.nan)
        covariance[~solved] = np.nan
        status = np.where(solved, EstimateStatus.solved, EstimateStatus.solver_failed)
        return dataclasses.replace(
            Estimates.none(count, EstimateStatus.solver_failed),
            status=status.astype(np.uint8), rotation=rotation, translation=translation,
            reprojection_px=reprojection, alternative_rotation=alternative,
            alternative_reprojection_px=alternative_px, covariance=covariance,
            point_count=np.where(solved, self._point_counts(detections), np.nan),
        )

    def _checked(self, returned: Any, count: int) -> Poses:
        """Return poses whose arrays have the right shapes, and rotations that are rotations."""
        if not isinstance(returned, tuple) or not 2 <= len(returned) <= 5:
            raise PluginError(
                f"{self._name}: returned a {type(returned).__name__}; expected a tuple "
                "(rotation, translation)"
            )
        given = Poses(*returned)
        if (given.alternative_rotation is None) != (given.alternative_translation is None):
            raise PluginError(
                f"{self._name}: returned half an alternative; expected its rotation and translation"
            )
        arrays = {
            name: None if value is None else self._array(name, value, (count, *shape))
            for (name, value), shape in zip(
                given._asdict().items(), ((3, 3), (3,), (6, 6), (3, 3), (3,)), strict=True
            )
        }
        for name in ("rotation", "alternative_rotation"):
            if (matrices := arrays[name]) is not None:
                self._check_rotations(name, matrices)
        return Poses(**arrays)

    def _array(self, name: str, value: Any, shape: tuple[int, ...]) -> Floats:
        array = real_numbers(self._name, f"values of {name}", value)
        if array.shape != shape:
            raise PluginError(
                f"{self._name}: returned a {name} of shape {array.shape}; expected {shape}"
            )
        array[~np.isfinite(array).reshape(len(array), -1).all(axis=1)] = np.nan
        return array

    def _check_rotations(self, name: str, matrices: Floats) -> None:
        known = matrices[~np.isnan(matrices[:, 0, 0])]
        gram = np.swapaxes(known, 1, 2) @ known
        off = np.abs(gram - np.eye(3)).max(initial=0.0)
        if off > ROTATION_ATOL or (np.linalg.det(known) < 0).any():
            raise PluginError(
                f"{self._name}: returned a {name} that is no rotation matrix ({off:.2g} off)"
            )

    def _copied(self, detections: Any) -> Any:
        """Return a copy: what a plug-in does to it reaches nobody else."""
        copied = detections.take(np.arange(len(detections.origins)))
        return dataclasses.replace(copied, images=[np.array(image) for image in copied.images])

    def _point_counts(self, detections: Any) -> Floats:
        """Return (N,) points of boards; NaN for single markers."""
        return np.full(len(detections.origins), np.nan)

    def _covariance(
        self, rotation: Floats, translation: Floats, detections: Any, noise_px: float
    ) -> Floats:
        return corner_covariance(
            rotation, translation, detections.cameras, detections.size_m, noise_px
        )

    def _reprojection_px(
        self, rotation: Floats, translation: Floats, detections: Any
    ) -> Floats:
        with np.errstate(invalid="ignore", over="ignore"):
            return reprojection_errors_px(
                rotation, translation, detections.size_m, detections.corners, detections.cameras
            )

    def _is_credible(self, reprojection_px: Floats, detections: Any) -> NDArray[np.bool_]:
        sides = np.roll(detections.corners, -1, axis=1) - detections.corners
        side_px = np.linalg.norm(sides, axis=2).mean(axis=1)
        with np.errstate(invalid="ignore"):
            return np.asarray(reprojection_px <= self._limit * side_px)
