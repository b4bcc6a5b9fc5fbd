"""Attributes of variables for readers: a short name for axes of charts, and the whole meaning.

xarray labels the axes of its charts by ``long_name [units]``: a sentence there would be cut off.
So ``long_name`` is the variable's name in words, and ``description`` says what it means.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import xarray as xr

UNIT = re.compile(r"_(m_s|deg_s|deg|rad|percent|px|mm|um|ms|m|s|e|grey|modules)$")
"""The unit at the end of a name."""

WORDS = {
    "true_rvec": "true rotation vector", "true_tvec": "true position", "bound": "accuracy bound",
    "bound_std": "bound of the standard deviation", "bound_kappa": "bound's bias of the depth",
    "predicted_std": "predicted standard deviation", "nees": "NEES", "marker_id": "marker ID",
    "alternative_rotation_error": "alternative rotation",
    "alternative_reprojection_error": "alternative reprojection",
    "side_px_per_module": "side per module", "xy": "image axis", "xyz": "axis",
}
"""Names whose words are not their own."""

CAPITALS = {"rmse": "RMSE", "hfov": "HFOV", "vfov": "VFOV", "dfov": "DFOV", "sd": "SD"}


def short_name(name: str, units: str = "") -> str:
    """Return a variable's name in words, without its unit if it has one.

    Examples
    --------
    >>> short_name("rotation_p95_deg_low", "degree"), short_name("marker_id")
    ('rotation p95, low end', 'marker ID')
    >>> short_name("adaptiveThreshWinSizeMin", "px")
    'adaptiveThreshWinSizeMin'
    """
    name, end = next(((name.removesuffix(f"_{end}"), f", {end} end") for end in ("low", "high")
                      if name.endswith(f"_{end}")), (name, ""))
    if units not in ("", "1"):
        name = UNIT.sub("", name)
    words = (CAPITALS.get(word, word) for word in name.split("_"))
    return WORDS.get(name, " ".join(words)) + end


def with_description(name: str, attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return attributes with the ``long_name`` as ``description``, and a short one in its place.

    Those without a ``long_name``, or with both, stay as they are.

    Examples
    --------
    >>> with_description("tilt_deg", {"long_name": "angle to the image plane", "units": "degree"})
    {'long_name': 'tilt', 'description': 'angle to the image plane', 'units': 'degree'}
    """
    if "long_name" not in attributes or "description" in attributes:
        return dict(attributes)
    short = short_name(name, str(attributes.get("units", "")))
    return {"long_name": short, "description": attributes["long_name"],
            **{key: value for key, value in attributes.items() if key != "long_name"}}


def with_descriptions(dataset: xr.Dataset) -> xr.Dataset:
    """Return a dataset whose variables and coordinates have short names; it shares the values."""
    described = dataset.copy(deep=False)
    for name, variable in described.variables.items():
        variable.attrs = with_description(str(name), variable.attrs)
    return described
