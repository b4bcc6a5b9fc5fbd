"""Columns of rates and errors that several figures' tables share."""

from __future__ import annotations

Columns = dict[str, tuple[str, float]]
"""Heading -> variable of an analysis, and the factor that it is multiplied by."""

LOOKED_FOR: Columns = {"looked for": ("looked_for", 1.0)}
RATES: Columns = LOOKED_FOR | {"detected, %": ("detection_rate", 100.0)}
ERRORS: Columns = {
    "solved, %": ("solved_rate", 100.0),
    "rotation median, deg": ("rotation_median_deg", 1.0),
    "rotation p95, deg": ("rotation_p95_deg", 1.0),
    "rotation RMSE without flips, deg": ("rotation_rmse_unflipped_deg", 1.0),
    "range median, %": ("range_median_percent", 1.0),
    "range p95, %": ("range_p95_percent", 1.0),
    "range RMSE without flips, %": ("range_rmse_unflipped_percent", 1.0),
}
INFINITE_ERRORS = (
    "In median and p95 a pose that is not solved counts as an infinite error (drawn at the edge); "
    "an interval that reaches the edge ends beyond all draws."
)
"""Sentence of captions."""
