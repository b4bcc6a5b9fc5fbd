"""Bins of a variable of the scene, as a dimension of a table."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.analysis.layout import Arrays
from sweep.analysis.pose_view import INSIDE
from sweep.errors import ArgumentError
from sweep.plan.variable import LABELS
from sweep.typing import Floats, Masks

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

    @property
    def count(self) -> int:
        """Number of combinations of bins."""
        return math.prod(self.shape)

    def split(self, arrays: Arrays) -> Iterator[tuple[Arrays, Masks | None]]:
        """Yield the arrays of each combination, and a mask of the cells that these have.

        Of cells that have no pose in the combination nothing is given; None stands for all cells.
        """
        if not self.edges:
            yield arrays, None
            return
        # Of values at the last edge and beyond, and of NaN, it is the number of bins.
        numbers = [np.searchsorted(edges, arrays[f"{PREFIX}{name}"], side="right") - 1
                   for name, edges in self.edges.items()]
        for index in np.ndindex(*self.shape):
            inside = np.logical_and.reduce([a == b for a, b in zip(numbers, index, strict=True)])
            cells = inside.any(axis=(0, 2, 3))
            yield ({name: array[:, cells]
                    for name, array in (arrays | {INSIDE: inside}).items()}, cells)

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
