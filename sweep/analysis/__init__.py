"""Answers from a dataset: rates, errors, comparisons and limits, each with what is sure of it."""

from __future__ import annotations

from sweep.analysis.comparisons import compare, renderer_bias
from sweep.analysis.detection_limits import detection_limit
from sweep.analysis.error_summaries import covariance_trust, efficiency, error_statistics
from sweep.analysis.ranking import marker_ranking
from sweep.analysis.rates import detection_rate, failure_composition, flip_rate

__all__ = [
    "compare", "covariance_trust", "detection_limit", "detection_rate", "efficiency",
    "error_statistics", "failure_composition", "flip_rate", "marker_ranking", "renderer_bias",
]
