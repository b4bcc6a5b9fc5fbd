"""Poses of the same markers in both images of a stereo camera: how far they agree."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis.dimensions import DRAWS, configuration_axes, require_dimension
from sweep.analysis.photograph_quantiles import quantile_ends, quantile_of
from sweep.errors import DatasetError
from sweep.measure.accuracy import pose_error
from sweep.measure.flags import EstimateStatus
from sweep.model.pose import rotation_of_vector
from sweep.photographs.cameras import stereo_of_file
from sweep.plan.variable import XYZ, cf_attributes
from sweep.typing import Floats

CAMERA = "stereo_camera"

QUANTILES = {
    "rotation_median_deg": ("rotation", 0.5, "degree"),
    "rotation_p90_deg": ("rotation", 0.9, "degree"),
    "range_median_percent": ("range", 0.5, "percent"),
    "range_p90_percent": ("range", 0.9, "percent"),
}
"""Variable -> what it is of, the share at or below it, and its unit."""


def stereo_differences(results: xr.Dataset, stereo: str | os.PathLike[str]) -> xr.Dataset:
    """Return how far poses in the left images differ from those in the right ones, without truth.

    The pose in the right image is taken to the left camera's frame by the calibration; an error of
    its rotation or of its translation counts as a difference.

    Parameters
    ----------
    results
        The dataset of a stereo camera's photographs, as `sweep.photos` returns it.
    stereo
        The file of the stereo calibration.

    Returns
    -------
    xr.Dataset
        Dimensions: the settings of detector and estimator. ``compared``: markers that both images
        have a pose of; ``flipped``: those of which one pose is nearer to the mirror of the other.
        Of all compared markers the median and the 90 % quantile of the rotation between both poses
        (degrees) and of the absolute difference of their depths (percent), with 95 % intervals in
        which a pair of photographs is the draw (``x_low``, ``x_high``).

    Raises
    ------
    ArgumentError
        If the file is no stereo calibration, or of another resolution.
    DatasetError
        If the dataset is not of a stereo camera.
    """
    require_dimension(results, CAMERA)
    if results.sizes[CAMERA] != 2:
        raise DatasetError(f"{CAMERA}: expected both cameras")
    size = tuple(int(results[name]) for name in ("width_px", "height_px"))
    rig, _ = stereo_of_file(str(stereo), (size[0], size[1]))
    names = configuration_axes(results)
    rows = [name for name in results["true_tvec_m"].dims if name not in (DRAWS, CAMERA, "xyz")]
    dims = (CAMERA, *names, DRAWS, *rows)
    shape = tuple(results.sizes[name] for name in names)

    def laid_out(name: str) -> Any:
        """Return an array (cameras, configurations, photographs, markers, ...)."""
        array = results[name]
        missing = {dim: results.sizes[dim] for dim in dims if dim not in array.dims}
        inner = [dim for dim in array.dims if dim not in dims]
        array = array.drop_vars(list(array.coords)).expand_dims(missing).transpose(*dims, *inner)
        photographs = results.sizes[DRAWS]
        return np.asarray(array).reshape(
            2, -1, photographs, int(np.prod([results.sizes[row] for row in rows])),
            *(array.sizes[dim] for dim in inner),
        )

    solved = (laid_out("estimate") == EstimateStatus.solved).all(axis=0)
    turns = [rotation_of_vector(laid_out(name)[:, solved].reshape(-1, 3)).reshape(2, -1, 3, 3)
             for name in ("rotation_error_rad", "true_rvec")]
    rotation: Floats = turns[0] @ turns[1]
    translation = (laid_out("true_tvec_m") + laid_out("translation_error_m"))[:, solved]
    back = rig.rotation.T
    error = pose_error(
        rotation[0], translation[0], back @ rotation[1],
        (translation[1] - rig.translation) @ rig.rotation,
    )
    values = {
        "rotation": np.degrees(error.rotation_angle_rad),
        "range": 100.0 * np.abs(error.translation_m[:, XYZ.index("z")]) / translation[0, :, 2],
    }
    configuration, photograph, _ = np.nonzero(solved)
    count = len(solved)
    table: dict[str, Any] = {
        "compared": (np.bincount(configuration, minlength=count), "markers in both images", "1"),
        "flipped": (np.bincount(configuration[error.flipped], minlength=count),
                    "of them, one nearer to the mirror of the other", "1"),
    }
    for name, (source, share, units) in QUANTILES.items():
        found = np.array([
            (quantile_of(np.sort(values[source][own]), share),
             *quantile_ends(values[source][own], photograph[own], share))
            for own in (configuration == k for k in range(count))
        ])
        meaning = f"{share * 100:.0f} % quantile of the {source} difference"
        for end, column in zip(("", "_low", "_high"), found.T, strict=True):
            table[f"{name}{end}"] = (column, meaning, units)
    return xr.Dataset(
        {name: (tuple(names), array.reshape(shape), cf_attributes(meaning, units))
         for name, (array, meaning, units) in table.items()},
        {name: results[name].variable for name in names},
    )
