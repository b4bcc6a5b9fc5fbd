"""The conditions at which requirements must hold, where none are named."""

from __future__ import annotations

from collections.abc import Sequence

import xarray as xr

from sweep.analysis.detection_limits import SIZE_AXES
from sweep.analysis.dimensions import DRAWS, axes_of
from sweep.plan.parameters import Stage

ANGLE_AXES = ("tilt_deg", "view_angle_deg")
"""Axes along which the marker is turned away."""

SIZES_BESIDE = ("size_m", "hfov_deg", "focal_length_mm", "fx_px", "width_px")
"""Axes along which the size in the image changes, too."""

IDS = "marker_id"

BOARDS = "kind"
"""The parameter by which boards differ, on an axis of its own or with others."""


def conditions(
    results: xr.Dataset, per: Sequence[str] | None, required_per: Sequence[str] = ()
) -> tuple[str, ...]:
    """Return the dimensions at each of whose values requirements must hold.

    Parameters
    ----------
    results
        The dataset of a run.
    per
        Those that were asked for, none among them; None if nothing was said.
    required_per
        Those that the pipeline names; one with a single value is none.

    Returns
    -------
    tuple
        ``per``, else those of the pipeline, else `usual_conditions`.
    """
    if per is not None:
        return tuple(per)
    return tuple(
        name for name in required_per if name in results.dims) or usual_conditions(results)


def usual_conditions(results: xr.Dataset) -> tuple[str, ...]:
    """Return the axis of the size in the image, or the first other one with numbers, and of angles.

    And that of boards, if there are several: what holds of them together holds of none that someone
    puts up. IDs of markers are no conditions.
    """
    axes = [name for name in axes_of(results, Stage.scene)
            if name != DRAWS and results.sizes[name] > 1]
    others = [name for name in axes if name in results.coords and name not in (IDS, *ANGLE_AXES)
              and results[name].dtype.kind in "fiu"]
    size = next((name for name in (*SIZE_AXES, *SIZES_BESIDE, *others) if name in axes), None)
    angle = next((name for name in ANGLE_AXES if name in axes), None)
    boards = next((name for name in axes if BOARDS in results.coords
                   and results[BOARDS].dims == (name,)), None)
    return tuple(dict.fromkeys(name for name in (size, angle, boards) if name))
