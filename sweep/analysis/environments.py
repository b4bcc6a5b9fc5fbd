"""What changes from one environment's OpenCV to another's, paired pose by pose."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import xarray as xr

from sweep.analysis.aggregate import aggregate
from sweep.analysis.counts import Count, Rate
from sweep.analysis.described import describes
from sweep.analysis.dimensions import axes_of, require_dimension
from sweep.analysis.pose_pairs import Pair, paired_arrays
from sweep.analysis.pose_shifts import corner_shift, corners_moved, corners_of, pose_shifts
from sweep.analysis.pose_view import DETECTION_INPUTS, ERROR_INPUTS, pose_arrays
from sweep.errors import ArgumentError
from sweep.measure.flags import DetectionStatus
from sweep.plan.parameters import Stage
from sweep.typing import Masks

ENVIRONMENT = "environment"


@describes
def environment_differences(results: xr.Dataset, reference: str | None = None) -> xr.Dataset:
    """Return what each environment changes against another one, paired pose by pose.

    Parameters
    ----------
    results
        The dataset of a run with a dimension ``environment``.
    reference
        The environment that the others are compared with; default: each with the one before it in
        the order of the axis, so that a change stands where it came.

    Returns
    -------
    xr.Dataset
        Dimensions: environment and those of the detector's other settings; for the pose variables
        also those of the estimator's. All others are pooled. Lazy if ``results`` is. The interval
        of ``x`` is in ``x_low`` and ``x_high``.

        - ``flag_changes``: share of the poses looked for in both (``compared``) whose flag of
          detection differs (``changed``); of them ``gained`` and ``lost`` detections, and
          ``other_id`` that are decoded as another marker in just one of both.
        - ``corners_moved``: share of the poses detected in both (``detected_in_both``) of which
          any corner has another value, however little, or is found in one only, as a board's can
          be (``moved``). ``corner_shift_rms_px``: RMS over these poses, the corners found in both,
          x and y of the difference.
        - ``range_bias_percent``: mean difference of the relative z errors, signed (above 0:
          farther than in the other), poses solved in both.
        - ``rotation_shift_deg``: RMS norm of the difference of the rotation errors, poses solved
          and not flipped in both.

    Raises
    ------
    ArgumentError
        If ``reference`` is not an environment of the dataset.
    DatasetError
        If the dataset has no dimension ``environment``, lacks variables of results, or has no
        poses.

    Notes
    -----
    95 % intervals over the random draws, conditional on the grid, as in `sweep.analysis.compare`.

    Examples
    --------
    >>> both = xr.concat([results, results], dim="environment").assign_coords(
    ...     environment=["opencv-4.8", "installed"])
    >>> environment_differences(both)["flag_changes"].values.tolist()
    [0.0, 0.0]
    """
    others = results.isel({ENVIRONMENT: _compared_with(results, reference)})
    others = others.assign_coords({ENVIRONMENT: results[ENVIRONMENT]})
    scene = axes_of(results, Stage.scene)

    def kept(name: str) -> list[str]:
        own = (str(dim) for dim in results[name].dims if dim not in scene)
        return [ENVIRONMENT, *(dim for dim in own if dim != ENVIRONMENT)]

    def pairs(*names: str) -> dict[str, xr.DataArray]:
        return paired_arrays(pose_arrays(others, names), pose_arrays(results, names))

    corners = corners_of(results)

    def moved(pair: Pair) -> Masks:
        return np.asarray(corners_moved(pair, corners) & detected_in_both(pair))

    detections = aggregate(
        results, pairs(*DETECTION_INPUTS, corners), kept("detection"),
        [
            Rate("flag_changes", "changed of compared", flag_changed, lambda pair: pair.compared,
                 counts=(("compared", "poses that were looked for in both environments"),
                         ("changed", "poses whose flag of detection differs"))),
            Count("gained", "poses detected here and not in the other environment",
                  lambda pair: pair.compared & pair.second.detected & ~pair.first.detected),
            Count("lost", "poses detected in the other environment and not here",
                  lambda pair: pair.compared & pair.first.detected & ~pair.second.detected),
            Count("other_id", "poses decoded as another marker in one environment only",
                  _other_id),
            Rate("corners_moved", "moved of detected_in_both", moved, detected_in_both,
                 counts=(("detected_in_both", "poses detected in both environments"),
                         ("moved", "of them, poses of which a corner has another value"))),
            corner_shift("the other's", corners),
        ],
        Pair,
    )
    poses = aggregate(
        results, pairs(*ERROR_INPUTS), kept("estimate"), pose_shifts("the other's"), Pair)
    table = detections.drop_vars("draws").assign(poses)
    names = results[ENVIRONMENT].values[_compared_with(results, reference)]
    return table.assign_coords(compared_with=(ENVIRONMENT, names))


def changed_poses(results: xr.Dataset, most: int = 20) -> Iterator[dict[str, str]]:
    """Yield poses whose flag of detection is not that of the environment before.

    Parameters
    ----------
    results
        The dataset of a run with a dimension ``environment``.
    most
        How many are yielded of each environment; the first in the order of the grid.

    Yields
    ------
    dict
        Dimension -> value as text; ``environment`` is the first that has the new flag. ``before``
        and ``since``: the flags.
    """
    require_dimension(results, ENVIRONMENT)
    flags = results["detection"]
    order = [ENVIRONMENT, *(str(dim) for dim in flags.dims if dim != ENVIRONMENT)]
    flags = flags.transpose(*order)
    first = order[1] if len(order) > 1 else None
    for k in range(1, flags.sizes[ENVIRONMENT]):
        left = most
        # A part at a time: all flags of a large grid need not be in memory.
        for part in range(flags.sizes[first]) if first else (0,):
            pair = flags.isel({ENVIRONMENT: [k - 1, k], **({first: [part]} if first else {})})
            before, since = np.asarray(pair)
            run = (before != DetectionStatus.not_run) & (since != DetectionStatus.not_run)
            for index in itertools.islice(zip(*np.nonzero((before != since) & run), strict=True),
                                          left):
                left -= 1
                at = pair.isel(dict(zip(order[1:], index, strict=True)))
                yield {
                    **{dim: str(at[dim].item()) for dim in order[1:]},
                    ENVIRONMENT: str(pair[ENVIRONMENT].values[1]),
                    "before": DetectionStatus(int(before[index])).name,
                    "since": DetectionStatus(int(since[index])).name,
                }
            if not left:
                break


def detected_in_both(pair: Pair) -> Masks:
    """Return which poses both environments detect."""
    return np.asarray(pair.compared & pair.first.detected & pair.second.detected)


def flag_changed(pair: Pair) -> Masks:
    """Return which poses have another flag of detection."""
    return np.asarray(pair.compared & (pair.first["detection"] != pair.second["detection"]))


def _other_id(pair: Pair) -> Masks:
    wrong = [side["detection"] == DetectionStatus.wrong_id for side in (pair.first, pair.second)]
    return np.asarray(pair.compared & (wrong[0] != wrong[1]))


def _compared_with(results: xr.Dataset, reference: str | None) -> list[int]:
    """Return for each environment the position of the one that it is compared with."""
    require_dimension(results, ENVIRONMENT)
    names = [str(name) for name in results[ENVIRONMENT].values]
    if reference is None:
        return [max(k - 1, 0) for k in range(len(names))]
    if reference not in names:
        raise ArgumentError("reference", reference, f"the environments are {', '.join(names)}")
    return [names.index(reference)] * len(names)
