"""How large the errors of estimates are: bias, spread, root mean squares and quantiles."""

from __future__ import annotations

from collections.abc import Sequence

import xarray as xr

from sweep.analysis import registry
from sweep.analysis.aggregate import aggregate
from sweep.analysis.binning import Bins
from sweep.analysis.described import describes
from sweep.analysis.dimensions import kept_dimensions
from sweep.analysis.pose_view import Poses, pose_arrays
from sweep.analysis.quantities import chosen_quantities


@describes
def error_statistics(
    results: xr.Dataset, per: Sequence[str] = (), bins: Bins | None = None,
    quantities: Sequence[str] | None = None,
) -> xr.Dataset:
    """Return rates, errors and their intervals.

    Parameters
    ----------
    results, per, bins
        As in `sweep.analysis.detection_rate`.
    quantities
        Kinds of error; by default ``rotation``, ``range`` and ``position``. Others have a sign,
        estimated minus true; of these bias and standard deviation are computed. By groups:

        - ``camera_frame``: ``x``, ``y``, ``z`` of the marker's position in the camera's frame
          (right, down, forward), in metres.
        - ``marker_frame``: the same error along the axes of the true marker (right, up, out):
          ``marker_frame_x``, ``marker_frame_y``, ``marker_frame_z``.
        - ``camera_in_marker``: of the camera's position in the marker's frame, as a robot has it
          that localises on the marker: ``camera_in_marker_x``, ``_y``, ``_z``. It has the error
          of the rotation times the distance in it.
        - ``yaw_pitch_roll``: ``yaw``, ``pitch``, ``roll``, the differences of the angles of
          R = Ry(yaw) · Rx(pitch) · Rz(roll) · Rx(180°), those of a pipeline's pose, in degrees.
        - ``angles``: ``tilt`` (to the image plane) and ``viewing_angle`` (to the line of sight),
          which are never negative, so that errors of frontal markers are above 0 on average; and
          ``in_plane``, the rotation error about the true normal (counter-clockwise seen from the
          camera is positive).

    Returns
    -------
    xr.Dataset
        Dimensions (*per, *bins); lazy if ``results`` is. The interval of ``x`` is in ``x_low`` and
        ``x_high``. The rotation error is in degrees, the range error is that of z in percent of
        the true z, the position error in metres.

        - ``looked_for``: poses (times pooled settings) whose detection is none of not_run,
          not_visible and not_modelled; ``solved`` of these. ``detection_rate`` and
          ``solved_rate`` are of ``looked_for``, ``flip_rate`` is of ``solved``.
        - ``*_median_*``, ``*_p95_*``, ``*_p99_*``: quantiles of the absolute error over the poses
          looked for. A pose that is not solved counts as infinite, so an infinite quantile says
          that more than 50, 5 or 1 % were not solved. ``median_interval``, ``p95_interval`` and
          ``p99_interval`` say why an end of the interval is missing
          (`sweep.analysis.quantiles.IntervalOf`).
        - ``*_rmse_*``: over the solved poses; ``*_rmse_unflipped_*`` without flipped ones.
        - ``*_bias_*``: of rotation and position the length of the mean vector, of the others the
          signed mean; solved and not flipped. A length is never negative, so it is above 0 by
          chance alone; then its low end is 0.
        - ``*_sd_*``: standard deviation of all components about that mean together (n - 1).

    Raises
    ------
    ArgumentError, DatasetError
        As in `sweep.analysis.detection_rate`; also for a kind of error that does not exist.

    Notes
    -----
    95 % intervals over the random draws, conditional on the grid; NaN if no cell has two draws
    that count. Those of rates are Wilson's, a little wide if the cells' rates differ. That of a
    mean is Student's, that of an RMSE or a standard deviation Student's of the logarithm of the
    mean square (`sweep.analysis.means`, `sweep.analysis.mean_intervals`): they need some 50 draws
    and tails not much heavier than normal, for no sample tells of what it has not seen; if a few
    cells have nearly all of the error, only their draws count. That of ``rotation_rmse_deg``
    counts the flips that the sample may have missed, with 180 degrees each
    (`sweep.analysis.flip_mixture`): it holds if flips are rare, and is wide (0.5 of 0.4 to 48
    without a flip in 50 draws). ``rotation_rmse_unflipped_deg`` with ``flip_rate``, and the
    quantiles, say more; Wilson's interval of 1 % in 50 covers 0.91.

    Quantiles are order statistics, the smallest value (in single precision) with at least that
    share at or below; so are their intervals' ends, NaN if n is too small.

    The statistics are the records of `sweep.analysis.registry`.

    Examples
    --------
    >>> table = error_statistics(results, per=["solver"])
    >>> table["rotation_rmse_unflipped_deg"].round(3).values.tolist()
    [0.365, 0.735]
    >>> table["rotation_median_deg"].round(3).values.tolist()
    [0.376, 0.752]
    >>> table["rotation_p95_deg"].values.tolist()  # 11 of 24 poses are not solved
    [inf, inf]
    >>> table = error_statistics(results, quantities=["camera_in_marker", "yaw"])
    >>> float(table["camera_in_marker_x_sd_m"].round(4)), float(table["yaw_sd_deg"].round(2))
    (0.0074, 0.32)
    """
    kept = kept_dimensions(results, per)
    records = registry.registered(chosen_quantities(quantities))
    inputs = pose_arrays(results, [name for record in records for name in record.inputs])
    return aggregate(
        results, inputs, kept, [record.statistic for record in records], Poses, bins)
