"""Bins of a variable of the scene, and the side of the black square in pixels."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.analysis.dataset import DRAWS, axes_of, parameter_value, without_fixed
from sweep.analysis.poses import INSIDE
from sweep.analysis.statistic import Arrays
from sweep.errors import ArgumentError, DatasetError
from sweep.experiment.schema import LABELS
from sweep.model.camera import VIEW_PARAMETERS, intrinsics
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# Bins of a variable of the scene, as a dimension of a table.

Bins = Mapping[str, Sequence[float]]
"""Edges of bins, by the name of the variable or coordinate that is binned."""

PREFIX = "bin "
"""What stands before the name of an array that is binned, among a block's arrays."""


@dataclass(frozen=True)
class Binning:
    """The edges (n + 1,) of the bins [low, high) of each name."""

    edges: Mapping[str, Floats]

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of bins of each name."""
        return tuple(len(edges) - 1 for edges in self.edges.values())

    def split(self, columns: Arrays) -> Iterator[Arrays]:
        """Yield the columns of each combination: its cells, with the mask of the poses inside."""
        if not self.edges:
            yield columns
            return
        # Of values at the last edge and beyond, and of NaN, it is the number of bins.
        numbers = [np.searchsorted(edges, columns.pop(f"{PREFIX}{name}"), side="right") - 1
                   for name, edges in self.edges.items()]
        for index in np.ndindex(*self.shape):
            inside = np.logical_and.reduce([a == b for a, b in zip(numbers, index, strict=True)])
            cells = inside.any(axis=(0, 2, 3))
            part = {**columns, INSIDE: inside}
            yield part if cells.all() else {name: each[:, cells] for name, each in part.items()}

    def coordinates(self, results: xr.Dataset) -> dict[str, Any]:
        """Return the coordinates of the bins: middles, lower and upper edges."""
        coordinates: dict[str, Any] = {}
        for name, edges in self.edges.items():
            attributes = dict(results[name].attrs)
            # Of a bin without an end the middle is its other end.
            finite = np.nan_to_num(edges, neginf=edges[1], posinf=edges[-2])
            for label, values in ((name, (finite[:-1] + finite[1:]) / 2),
                                  (f"{name}_low", edges[:-1]), (f"{name}_high", edges[1:])):
                coordinates[label] = (name, values, attributes)
        return coordinates


def read_bins(
    results: xr.Dataset, kept: Sequence[str], bins: Bins
) -> tuple[Binning, dict[str, xr.DataArray]]:
    """Return the binning, and the arrays that are binned by their names in a block.

    Raises
    ------
    ArgumentError
        For bins of a variable that does not exist or is not one number for each scene, and for
        edges that do not increase.
    """
    if not isinstance(bins, Mapping):
        raise ArgumentError("bins", bins, "expected names with edges, such as "
                            '{"marker_area_px": [0, 100, 1000]}')
    edges, arrays = {}, {}
    for name, given in bins.items():
        if name not in results.variables or name in kept:
            possible = [str(other) for other, variable in results.variables.items()
                        if variable.dtype.kind == "f" and other not in kept]
            raise ArgumentError("bins", name, f"no such variable; there are {', '.join(possible)}")
        array = results[name].reset_coords(drop=True)
        if name in results.dims:  # an index, which has no chunks
            array = xr.DataArray(array.to_numpy(), dims=name)
        scalar = name in results.coords and not array.dims
        if array.dtype.kind not in "fiu" or scalar or any(dim in LABELS for dim in array.dims):
            raise ArgumentError("bins", name, "expected a variable of one number for each scene")
        edges[name], arrays[f"{PREFIX}{name}"] = _increasing(name, given), array
    return Binning(edges), arrays


def _increasing(name: str, given: Any) -> NDArray[np.float64]:
    """Return the edges, if they are."""
    try:
        edges = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        edges = np.empty(0)
    if edges.ndim != 1 or len(edges) < 2 or not (edges[1:] > edges[:-1]).all():
        raise ArgumentError("bins", name, "expected at least two increasing edges")
    return edges


# --------------------------------------------------------------------------------------------------
# The side of the black square in pixels, over the axes that change it.

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
        return _checked(shell["side_px"])
    return sides_of(functools.partial(parameter_value, shell))


def sides_of(value: Callable[[str], Any]) -> xr.DataArray:
    """Return the sides in pixels from distance, size and camera.

    Parameters
    ----------
    value
        Returns the value of a parameter, or its values over the dimensions that it has.

    Raises
    ------
    DatasetError
        If they cannot be computed.
    """
    distance = value("distance_m")
    if distance is None:
        raise DatasetError(
            "distance_m: is no number of this store, whose poses are given in the world; a "
            "limit needs an axis distance_m or side_px (per= takes any axis for rates)")
    fx = xr.DataArray(intrinsics(*map(value, VIEW_PARAMETERS))[0])
    return _checked(fx * value("size_m") / distance)


def _checked(sides: xr.DataArray) -> xr.DataArray:
    """Return sides without coordinates of fixed parameters, if all can be."""
    sides = sides.astype(np.float64)
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
