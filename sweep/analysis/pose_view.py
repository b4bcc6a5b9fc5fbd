"""Poses of a block as statistics read them: which are counted, and their errors."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.analysis.board_markers import AXIS
from sweep.analysis.signed_errors import SignedErrors
from sweep.errors import DatasetError
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped, uncounted_values
from sweep.plan.schema import VARIABLES
from sweep.plan.variable import XYZ
from sweep.typing import Floats, Masks

NOT_LOOKED_FOR = tuple(uncounted_values(DetectionStatus))
"""Flags of detection of the poses that are in no denominator."""

INSIDE = "inside"
"""Name of the mask of the poses that count at all, if not all do."""

COMMON = "common"
"""Name of the mask of the trials that all pooled cells have, where sampling was stopped."""

DEPTH = "true_depth_m"
"""Name, beside those of the dataset's variables, of z of the true position."""

DETECTION_INPUTS = ("detection",)
ESTIMATE_INPUTS = (*DETECTION_INPUTS, "estimate", "flipped")
ERROR_INPUTS = (*ESTIMATE_INPUTS, "rotation_error_rad", "translation_error_m", DEPTH)
SIGNED_INPUTS = (*ERROR_INPUTS, "true_rvec", "true_tvec_m")
"""Names of the arrays that a statistic of detections, of estimates, of errors reads, and one of
errors along axes and about angles."""

REQUIRED_VARIABLES = tuple("true_tvec_m" if name == DEPTH else name for name in ERROR_INPUTS)
"""Variables that every dataset of results has."""


def pose_arrays(results: xr.Dataset, names: Iterable[str]) -> dict[str, xr.DataArray]:
    """Return arrays by the names that `Poses` gives them: variables' names, or `DEPTH`.

    Raises
    ------
    DatasetError
        If the dataset lacks a variable.
    """
    arrays = {}
    for name in dict.fromkeys(names):
        variable = "true_tvec_m" if name == DEPTH else name
        if variable not in results:
            if AXIS in results.dims:
                raise DatasetError(
                    f"no variable {variable}: a board's markers have detections alone; estimates "
                    "are the board's: give the dataset that per_marker was given")
            raise DatasetError(f"no variable {variable}; "
                               f"there are {', '.join(map(str, results.data_vars)) or 'none'}")
        array = results[variable]
        arrays[name] = array.isel(xyz=XYZ.index("z"), drop=True) if name == DEPTH else array
    return arrays


class Poses:
    """Poses of a block: arrays (groups, cells, draws, settings, ...), by name.

    Those outside the mask `INSIDE` count as not run, those outside `COMMON` as not needed. The
    masks and errors have the shape (groups, cells, draws, settings), but for axes of length 1 that
    broadcast.

    Parameters
    ----------
    arrays
        The arrays, by the names of `pose_arrays` with ``prefix`` in front, `INSIDE` and `COMMON`.
    prefix
        What stands before the names of these poses' arrays in ``arrays``, if it has others too.
    """

    def __init__(self, arrays: dict[str, NDArray[Any]], prefix: str = "") -> None:
        self._arrays = arrays
        self._prefix = prefix
        self.squares: dict[str, Floats] = {}
        """Squared absolute errors (..., 1) by the name of their `Quantity`, once computed."""

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return an array, of flags 0 (not run) for the poses that do not count."""
        array = self._arrays[self._prefix + name]
        if name in VARIABLES and VARIABLES[name].flags is not None:
            # A dataset that was cut or joined has NaN where nothing was run.
            array = np.where(self.inside, np.nan_to_num(array, nan=0.0), 0)
            if COMMON in self._arrays:
                array = np.where(
                    self._arrays[COMMON] | (array == 0), array, VARIABLES[name].not_needed)
        return array

    def __contains__(self, name: object) -> bool:
        """Return whether the poses have an array."""
        return f"{self._prefix}{name}" in self._arrays

    @property
    def inside(self) -> Masks:
        """Poses that count at all."""
        return self._arrays.get(INSIDE, np.ones((), dtype=bool))

    @cached_property
    def detection(self) -> NDArray[np.uint8]:
        """Flags of `DetectionStatus`."""
        return self["detection"]

    @cached_property
    def estimate(self) -> NDArray[np.uint8]:
        """Flags of `EstimateStatus`."""
        return self["estimate"]

    @cached_property
    def draws(self) -> Masks:
        """Which draws were run: (groups, cells, draws)."""
        return np.asarray(self.run.any(axis=3))

    @cached_property
    def run(self) -> Masks:
        """Poses that were run."""
        return ~np.isin(self.detection, (DetectionStatus.not_run, DetectionStatus.not_needed))

    @cached_property
    def looked_for(self) -> Masks:
        """Poses whose detection is counted: run, visible and modelled."""
        return ~np.isin(self.detection, NOT_LOOKED_FOR)

    @cached_property
    def detected(self) -> Masks:
        """Detected poses."""
        return np.asarray(self.detection == DetectionStatus.detected)

    @cached_property
    def solved(self) -> Masks:
        """Solved poses."""
        return np.asarray(self.estimate == EstimateStatus.solved)

    @cached_property
    def flipped(self) -> Masks:
        """Solved poses that are nearer to the mirror of the truth."""
        return np.asarray(self.solved & (self["flipped"] == Flipped.flipped))

    @cached_property
    def unflipped(self) -> Masks:
        """Solved poses that are not flipped."""
        return self.solved & ~self.flipped

    @cached_property
    def rotation_deg(self) -> Floats:
        """Rotation error vectors, (..., xyz), in degrees."""
        return np.asarray(np.degrees(self["rotation_error_rad"], dtype=np.float64))

    @cached_property
    def range_percent(self) -> Floats:
        """Depth error in percent of the true depth, (..., 1)."""
        error = self["translation_error_m"][..., XYZ.index("z")]
        return 100.0 * relative(error, self[DEPTH])[..., None]

    @cached_property
    def signed(self) -> SignedErrors:
        """Errors along axes and about angles."""
        return SignedErrors(self["true_rvec"], self["true_tvec_m"], self["rotation_error_rad"],
                            self["translation_error_m"])

    @cached_property
    def position_m(self) -> Floats:
        """Position error vectors, (..., xyz), in metres."""
        return np.asarray(self["translation_error_m"], dtype=np.float64)


def relative(length: NDArray[Any], depth: NDArray[Any]) -> Floats:
    """Return lengths over depths."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(length / depth, dtype=np.float64)


def norm_squared(vectors: NDArray[Any]) -> Floats:
    """Return the squared norms of (..., components)."""
    return component_sum(np.square(vectors, dtype=np.float64))


def component_sum(vectors: Floats) -> Floats:
    """Return the sums of the few components of (..., components), bit for bit as NumPy does.

    NumPy's loop along a short last axis takes three times as long.
    """
    components = (vectors[..., k] for k in range(vectors.shape[-1]))
    return np.asarray(functools.reduce(np.add, components, np.zeros(())))
