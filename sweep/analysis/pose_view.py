"""What is counted of poses, and which errors they have: the words that all statistics share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped
from sweep.plan.schema import XYZ
from sweep.typing import Floats

Masks = NDArray[np.bool_]

NOT_LOOKED_FOR = (
    DetectionStatus.not_run,
    DetectionStatus.not_visible,
    DetectionStatus.not_modelled,
)
INSIDE = "inside"
"""Name of the mask of the poses that count at all, where not all do."""


class Poses:
    """Poses of a block, arrays (groups, cells, draws, settings, ...), by name.

    Those outside the mask `INSIDE` count as not run.
    """

    def __init__(self, arrays: dict[str, NDArray[Any]], prefix: str = "") -> None:
        self._arrays = arrays
        self._prefix = prefix

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return an array, of flags only where the poses count."""
        array = self._arrays[self._prefix + name]
        if name in {"detection", "estimate", "flipped"}:
            # A dataset that was cut or joined has NaN where nothing was run.
            return np.where(self.inside, np.nan_to_num(array, nan=0.0), 0)
        return array

    def __contains__(self, name: object) -> bool:
        """Tell whether there is such an array."""
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
        return np.asarray((self.detection != DetectionStatus.not_run).any(axis=3))

    @cached_property
    def looked_for(self) -> Masks:
        """Poses that were run, visible and modelled."""
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
        """Rotation error vectors, (..., xyz)."""
        return np.asarray(np.degrees(self["rotation"], dtype=np.float64))

    @cached_property
    def range_percent(self) -> Floats:
        """Depth error of the true depth, (..., 1)."""
        return 100.0 * relative(self["position"][..., XYZ.index("z")], self["depth"])[..., None]

    @cached_property
    def position_m(self) -> Floats:
        """Position error vectors, (..., xyz)."""
        return np.asarray(self["position"], dtype=np.float64)


@dataclass(frozen=True)
class Quantity:
    """An error of poses, and its words."""

    name: str
    unit: str
    """As in names."""
    units: str
    """As in attributes."""
    words: str
    vector: Callable[[Poses], Floats]
    """(..., components), of these poses."""

    def norm(self, poses: Poses) -> Floats:
        """Return the absolute error."""
        return np.sqrt(norm_squared(self.vector(poses)))

    def named(self, statistic: str) -> str:
        """Return a variable's name, such as ``rotation_p95_deg``."""
        return f"{self.name}_{statistic}_{self.unit}"


QUANTITIES = (
    Quantity("rotation", "deg", "degree", "rotation error", lambda poses: poses.rotation_deg),
    Quantity("range", "percent", "percent", "depth error of the true depth",
             lambda poses: poses.range_percent),
    Quantity("position", "m", "m", "position error", lambda poses: poses.position_m),
)


def detections(results: xr.Dataset) -> dict[str, xr.DataArray]:
    """Return what tells what became of the markers."""
    return {"detection": results["detection"]}


def estimates(results: xr.Dataset) -> dict[str, xr.DataArray]:
    """Return what tells what became of the estimates."""
    return detections(results) | {
        "estimate": results["estimate"], "flipped": results["flipped"],
    }


def errors(results: xr.Dataset) -> dict[str, xr.DataArray]:
    """Return what tells the errors of the estimates."""
    return estimates(results) | {
        "rotation": results["rotation_error_rad"],
        "position": results["translation_error_m"],
        "depth": results["true_tvec_m"].isel(xyz=XYZ.index("z"), drop=True),
    }


def relative(length: NDArray[Any], depth: NDArray[Any]) -> Floats:
    """Return lengths over depths."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(length / depth, dtype=np.float64)


def norm_squared(vectors: NDArray[Any]) -> Floats:
    """Return the squared norms of (..., components)."""
    return np.asarray(np.square(vectors, dtype=np.float64).sum(axis=-1))
