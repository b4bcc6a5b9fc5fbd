"""From an estimator's setting to what runs it."""

from __future__ import annotations

from sweep.measure.estimation import PoseEstimator
from sweep.measure.photometric import Photometric
from sweep.measure.solver import CornerSolver, EstimatorSetting


def build(setting: EstimatorSetting) -> PoseEstimator:
    """Return the estimator that a setting describes: the place to add others of either kind."""
    if setting.solver == "photometric":
        return Photometric(setting.refined_starts, setting.estimate_blur)
    return CornerSolver(setting)
