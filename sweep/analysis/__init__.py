"""Answers from a dataset: rates, errors, comparisons and limits, each with its uncertainty.

Every function takes a dataset as `sweep.open` returns it and returns one that is computed: the
columns that it needs are read into memory. In their examples ``results`` is a small dataset of two
solvers at three sides, eight draws each.
"""

from __future__ import annotations

from sweep.analysis.camera_calibration import calibration_summary, camera_calibrations
from sweep.analysis.comparisons import compare, renderer_bias, simulation_gap, store_differences
from sweep.analysis.dataset import per_marker
from sweep.analysis.error_models import error_models, model_covariance, model_errors
from sweep.analysis.requirements import check_requirements, precision_reached, requirement_limits
from sweep.analysis.summaries import (
    ambiguity,
    covariance_trust,
    detection_rate,
    efficiency,
    error_statistics,
    failure_composition,
    flip_rate,
    marker_ranking,
)

__all__ = [
    "ambiguity", "calibration_summary", "camera_calibrations", "check_requirements", "compare",
    "covariance_trust", "detection_rate", "efficiency", "error_models", "error_statistics",
    "failure_composition", "flip_rate", "marker_ranking", "model_covariance", "model_errors",
    "per_marker", "precision_reached", "renderer_bias", "requirement_limits", "simulation_gap",
    "store_differences",
]
