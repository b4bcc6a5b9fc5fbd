"""The side of the black square in pixels, over the axes that change it."""

from __future__ import annotations

import numpy as np
import xarray as xr

from sweep.analysis.binning import Bins
from sweep.analysis.dimensions import DRAWS, axes_of, without_fixed
from sweep.analysis.stored_parameters import parameter_value
from sweep.errors import DatasetError
from sweep.model.camera import VIEW_PARAMETERS, intrinsics

SIZE_PARAMETERS = ("side_px", "distance_m", "size_m", *VIEW_PARAMETERS)
"""What the side depends on: itself, or distance, size and camera."""


def image_sides(results: xr.Dataset, bins: Bins) -> xr.DataArray:
    """Return the sides as if the square were parallel to the image plane: fx · size / distance.

    Parameters
    ----------
    results
        The dataset of a run.
    bins
        Edges of drawn parameters, whose bins' middles take the place of the draws.

    Returns
    -------
    xr.DataArray
        Sides in pixels over the dimensions that change them, bins' names among these.

    Raises
    ------
    DatasetError
        If they cannot be computed, or are drawn and not in bins.
    """
    middles = {name: (name, (np.asarray(edges)[:-1] + np.asarray(edges)[1:]) / 2.0)
               for name, edges in bins.items()}
    given = {name: array for name, array in results.coords.items() if name not in bins}
    shell = xr.Dataset(coords=given, attrs=results.attrs).assign_coords(middles)
    for name in SIZE_PARAMETERS:
        derived = name == "distance_m" and "side_px" in shell.coords
        if name in shell.coords and DRAWS in shell[name].dims and not derived:
            raise DatasetError(f"{name}: is drawn, so that the side is no number of the grid; "
                               f'give bins, such as bins={{"{name}": [...edges...]}}')
    if "side_px" in shell.coords:
        sides = shell["side_px"].astype(np.float64)
    else:
        distance = parameter_value(shell, "distance_m")
        if distance is None:
            raise DatasetError(
                "distance_m: is no number of this store, whose poses are given in the world; a "
                "limit needs an axis distance_m or side_px (per= takes any axis for rates)")
        values = {name: parameter_value(shell, name) for name in (*VIEW_PARAMETERS, "size_m")}
        fx = xr.DataArray(intrinsics(*(values[name] for name in VIEW_PARAMETERS))[0])
        sides = (fx * values["size_m"] / distance).astype(np.float64)
    if not (np.isfinite(sides) & (sides > 0)).all():
        raise DatasetError("sides must be finite and above 0 px: see the coordinates of the size, "
                           "the distance and the camera")
    return without_fixed(sides)


def require_size_axes(results: xr.Dataset, sides: xr.DataArray) -> None:
    """Raise unless the sides differ along an axis."""
    if not sides.dims:
        raise DatasetError(
            "side_px or distance_m: no axis changes the size in the image; there are "
            f"{', '.join(axes_of(results)) or 'none'}")


def parameters_along(results: xr.Dataset, axis: str, bins: Bins) -> list[str]:
    """Return the names of the numbers along an axis that the sides depend on."""
    if axis in bins:
        return [axis]
    return [name for name in SIZE_PARAMETERS if name in results.coords
            and results[name].dims == (axis,) and results[name].dtype.kind in "fiu"]
