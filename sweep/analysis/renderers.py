"""What a renderer changes against the exact one, paired scene by scene."""

from __future__ import annotations

import xarray as xr

from sweep.analysis.aggregate import aggregate
from sweep.analysis.counts import Rate
from sweep.analysis.described import describes
from sweep.analysis.dimensions import axes_of, require_dimension
from sweep.analysis.pose_pairs import Pair, paired_arrays
from sweep.analysis.pose_shifts import corner_shift, corners_of, pose_shifts
from sweep.analysis.pose_view import DETECTION_INPUTS, ERROR_INPUTS, pose_arrays
from sweep.errors import ArgumentError
from sweep.plan.parameters import Stage


@describes
def renderer_bias(results: xr.Dataset, reference: str = "exact") -> xr.Dataset:
    """Return what each renderer changes against ``reference``, paired scene by scene.

    Parameters
    ----------
    results
        The dataset of a run with a dimension ``renderer``.
    reference
        The renderer that the others are compared with.

    Returns
    -------
    xr.Dataset
        Dimensions: renderer and those of the detector's settings; for the pose variables also
        those of the estimator's. All others are pooled. Lazy if ``results`` is. The interval of
        ``x`` is in ``x_low`` and ``x_high``.

        - ``detection_disagreement``: share of the poses looked for with both (``compared``) that
          are detected with one of them only (``differing``).
        - ``corner_shift_rms_px``: RMS over poses detected with both, corners (of boards those found
          with both), x and y of the difference of the corners' errors.
        - ``range_bias_percent``: mean difference of the relative z errors, signed (above 0:
          farther than with the reference), poses solved with both.
        - ``rotation_shift_deg``: RMS norm of the difference of the rotation errors, poses solved
          and not flipped with both.

    Raises
    ------
    ArgumentError
        If ``reference`` is not a renderer of the dataset.
    DatasetError
        If the dataset has no dimension ``renderer``, lacks variables of results, or has no poses.

    Notes
    -----
    95 % intervals over the random draws, conditional on the grid, as in `sweep.analysis.compare`.

    Examples
    --------
    >>> both = xr.concat([results, results], dim="renderer").assign_coords(
    ...     renderer=["exact", "area"])
    >>> renderer_bias(both)["detection_disagreement"].values.tolist()
    [0.0, 0.0]
    """
    require_dimension(results, "renderer")
    renderers = [str(name) for name in results["renderer"].values]
    if reference not in renderers:
        raise ArgumentError("reference", reference, f"the renderers are {', '.join(renderers)}")
    others = results.isel(renderer=renderers.index(reference), drop=True)
    scene = axes_of(results, Stage.scene)

    def kept(name: str) -> list[str]:
        return ["renderer", *(str(dim) for dim in results[name].dims if dim not in scene)]

    def pairs(*names: str) -> dict[str, xr.DataArray]:
        return paired_arrays(pose_arrays(others, names), pose_arrays(results, names))

    corners = corners_of(results)
    detections = aggregate(
        results, pairs(*DETECTION_INPUTS, corners), kept("detection"),
        [
            Rate("detection_disagreement", "differing of compared",
                 lambda pair: pair.first.detected != pair.second.detected,
                 lambda pair: pair.compared,
                 counts=(("compared", "poses that were looked for with both renderers"),
                         ("differing", "poses detected with one of both renderers only"))),
            corner_shift("the reference's", corners),
        ],
        Pair,
    )
    poses = aggregate(
        results, pairs(*ERROR_INPUTS), kept("estimate"), pose_shifts("the reference's"), Pair)
    return detections.drop_vars("draws").assign(poses)
