"""What a camera and its surroundings do to the ideal image: the parameters, in physical order.

Each effect is absent, at no cost, unless a value other than its neutral one is named.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from sweep.model.declaration import parameter


@dataclass(frozen=True, slots=True)
class Effects:
    """The faults of surroundings, lens, motion and sensor."""

    occlusion: float = parameter(
        0.0, "share of the black square's extent that a sheet with a straight edge hides; it lies "
        "on the marker and also hides the quiet zone on its side", low=0, high=1, drawable=True,
    )
    occlusion_deg: float = parameter(
        0.0, "side that the sheet comes from, in the marker's plane: 0 its right, 90 its top",
        unit="degree", low=-360, high=360, drawable=True,
    )
    occluder: float = parameter(
        128.0, "level of the sheet", unit="grey level", low=0, high=255, drawable=True
    )
    illumination_gradient: float = parameter(
        0.0, "change of the light across the frame's width, relative to its centre", low=-2,
        high=2, drawable=True,
    )
    illumination_deg: float = parameter(
        0.0, "direction in which the light grows: 0 right, 90 down", unit="degree", low=-360,
        high=360, drawable=True,
    )
    exposure_s: float = parameter(
        0.0, "exposure time: the image is the mean over it; the truth is the pose in its middle",
        unit="s", low=0, high=1e6, drawable=True,
    )
    row_time_s: float = parameter(
        0.0, "rolling shutter: time from one row's exposure to the next's; the truth is the pose "
        "at the middle row's", unit="s", low=0, high=1e6, drawable=True,
    )
    velocity_x_m_s: float = parameter(
        0.0, "velocity of the marker's centre, right", unit="m/s", low=-1e9, high=1e9,
        drawable=True,
    )
    velocity_y_m_s: float = parameter(
        0.0, "velocity of the marker's centre, down", unit="m/s", low=-1e9, high=1e9,
        drawable=True,
    )
    velocity_z_m_s: float = parameter(
        0.0, "velocity of the marker's centre, away from the camera", unit="m/s", low=-1e9,
        high=1e9, drawable=True,
    )
    rotation_x_deg_s: float = parameter(
        0.0, "angular velocity about the axis through the marker's centre that points right",
        unit="degree/s", low=-1e9, high=1e9, drawable=True,
    )
    rotation_y_deg_s: float = parameter(
        0.0, "angular velocity about the axis through the marker's centre that points down",
        unit="degree/s", low=-1e9, high=1e9, drawable=True,
    )
    rotation_z_deg_s: float = parameter(
        0.0, "angular velocity about the axis through the marker's centre that points forward",
        unit="degree/s", low=-1e9, high=1e9, drawable=True,
    )
    blur_px: float = parameter(
        0.0, "standard deviation of the lens' Gaussian point spread", unit="px", low=0, high=1000,
        drawable=True,
    )
    aperture_mm: float | None = parameter(
        None, "diameter of the lens' opening: defocus adds a quarter of the circle of confusion's "
        "diameter to the point spread, in quadrature, at each depth", unit="mm", low=0, high=1e6,
        open_low=True, drawable=True,
    )
    focus_distance_m: float | None = parameter(
        None, "depth at which the image is sharp", unit="m", low=0, open_low=True, drawable=True
    )
    vignetting: float = parameter(
        0.0, "power of the cosine of a pixel's angle to the optical axis that its light falls "
        "with; 4 is the natural law", low=0, high=100, drawable=True,
    )
    full_well_e: float | None = parameter(
        None, "electrons that a pixel holds, at level 255 and gain 1; shot noise is theirs",
        unit="e-", low=1, high=1e9, drawable=True,
    )
    read_noise_e: float = parameter(
        0.0, "standard deviation of the read noise", unit="e-", low=0, high=1e9, drawable=True
    )
    gain: float = parameter(
        1.0, "what the signal, with its noise, is multiplied by before it is quantised", low=0,
        high=1e6, open_low=True, drawable=True,
    )
    noise_grey: float = parameter(
        0.0, "standard deviation of plain Gaussian noise on the grey levels", unit="grey level",
        low=0, high=1e6, drawable=True,
    )
    bit_depth: int = parameter(
        8, "bits that the levels 0 to 255 are quantised to, clipped; OpenCV sees them rounded to 8",
        unit="bit", low=8, high=16,
    )


VELOCITIES = (
    "velocity_x_m_s", "velocity_y_m_s", "velocity_z_m_s",
    "rotation_x_deg_s", "rotation_y_deg_s", "rotation_z_deg_s",
)

NEUTRAL: dict[str, Any] = {field.name: field.default for field in dataclasses.fields(Effects)}
"""Every parameter of the effects at its default: none of them active."""

SWITCHES = {
    name: NEUTRAL[name]
    for name in (
        "occlusion", "illumination_gradient", "exposure_s", "row_time_s", "blur_px", "aperture_mm",
        "vignetting", "full_well_e", "gain", "noise_grey", "bit_depth",
    )
}
"""Parameters that switch an effect on -> the value at which it is absent."""

GEOMETRIC = ("occlusion", "exposure_s", "row_time_s", "blur_px", "aperture_mm")
"""Switches of the effects that act on edges, which only the ``exact`` renderer has."""

RANDOM = ("noise_grey", "full_well_e")
"""Switches of the effects that draw random numbers."""


def is_on(name: str, value: Any) -> bool:
    """Return whether a switch has another than its neutral value."""
    return bool(value != SWITCHES[name])
