"""Labels of configurations: combinations of detector and estimator settings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

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
