"""The names of the built-in renderers."""

from __future__ import annotations

import re
from typing import Any

SUPERSAMPLE = re.compile(r"supersample-([1-9][0-9]{0,2})(-jittered)?")

RENDERERS = "exact, warp, supersample-N or supersample-N-jittered with N from 1 to 999"
"""The names in words."""


def is_renderer(name: str) -> bool:
    """Return whether a built-in renderer has the name."""
    return name in ("exact", "warp") or SUPERSAMPLE.fullmatch(name) is not None


def renderer_name(value: Any) -> str:
    """Return the name of a built-in renderer as it is declared; ValueError if there is none."""
    name = value.strip().lower() if isinstance(value, str) else ""
    if not is_renderer(name):
        raise ValueError(RENDERERS)
    return name
