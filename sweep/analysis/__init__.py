"""Answers from a dataset: rates, errors, comparisons and limits, each with its uncertainty.

Every function takes a dataset as `sweep.open` returns it and returns a dataset, lazy if the first
one is. In their examples ``results`` is a small dataset of two solvers at three sides, eight draws
each.
"""

from __future__ import annotations

from sweep.analysis.ambiguities import ambiguity
from sweep.analysis.board_markers import per_marker
from sweep.analysis.bound_ratios import efficiency
from sweep.analysis.camera_calibration import calibration_summary, camera_calibrations
from sweep.analysis.comparisons import compare
from sweep.analysis.covariances import covariance_trust
from sweep.analysis.detection_limits import detection_limit
from sweep.analysis.environments import environment_differences
from sweep.analysis.error_model_values import model_covariance, model_errors
from sweep.analysis.error_models import error_models
from sweep.analysis.error_summaries import error_statistics
from sweep.analysis.farthest import farthest_met
from sweep.analysis.precision import precision_reached
from sweep.analysis.ranking import marker_ranking
from sweep.analysis.rates import detection_rate, failure_composition, flip_rate
from sweep.analysis.renderers import renderer_bias
from sweep.analysis.requirements import check_requirements
from sweep.analysis.searched_limits import requirement_limits
from sweep.analysis.simulation_gaps import simulation_gap

__all__ = [
    "ambiguity", "calibration_summary", "camera_calibrations", "check_requirements", "compare",
    "covariance_trust", "detection_limit", "detection_rate", "efficiency",
    "environment_differences", "error_models", "error_statistics",
    "failure_composition", "farthest_met", "flip_rate", "marker_ranking", "model_covariance",
    "model_errors", "per_marker", "precision_reached", "renderer_bias", "requirement_limits",
    "simulation_gap",
]
