"""Configurations, variables and numbers of a tradeoff as text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

WRONG = " (wrong)"
"""Behind the label of a configuration whose estimator believes what is not true."""

NO_SETTINGS = "as set"
"""Label of the only configuration of a pipeline without axes of settings."""


def configuration_label(settings: Mapping[str, Any]) -> str:
    """Return the label of a configuration; words stand alone, other values behind their setting.

    >>> configuration_label({"cornerRefinementMethod": "subpix", "guarded": True})
    'subpix · guarded True'
    """
    return " · ".join(
        value if isinstance(value, str) else f"{name} {value}"
        for name, value in settings.items()
    ) or NO_SETTINGS


def digits(value: float) -> str:
    """Return a number with three significant digits; ``-`` for NaN, ``inf`` for infinity.

    Examples
    --------
    >>> [digits(value) for value in (0.31, 12.345, 1234, 0, float("inf"))]
    ['0.310', '12.3', '1230', '0', 'inf']
    """
    if np.isnan(value):
        return "-"
    rounded = float(f"{value:.2e}")
    if rounded == 0 or 1e3 <= abs(rounded) < 1e6:
        return f"{rounded:.0f}"
    return f"{rounded:#.3g}".rstrip(".")


def unit_of(criterion: str) -> tuple[str, str]:
    """Return a criterion's name without its unit, and the unit: ``deg`` or ``%``."""
    name, _, unit = criterion.rpartition("_")
    return name, "%" if unit == "percent" else unit


def heading_of(name: str) -> str:
    """Return a variable's name in words, its unit behind a comma: ``range RMSE, %``."""
    words, unit = unit_of(name)
    return f"{words.replace('_', ' ').replace('rmse', 'RMSE')}, {unit}"
