"""How often a marker is detected, where its poses are lost, and how often a pose is mirrored."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from sweep.analysis.aggregate import aggregate
from sweep.analysis.binning import Bins
from sweep.analysis.counts import Rate
from sweep.analysis.described import describes
from sweep.analysis.dimensions import kept_dimensions
from sweep.analysis.pose_view import DETECTION_INPUTS, ESTIMATE_INPUTS, Poses, pose_arrays
from sweep.measure.flags import DetectionStatus, EstimateStatus, outcomes
from sweep.typing import Masks


@dataclass(frozen=True)
class PoseRate:
    """A rate of poses.

    Attributes
    ----------
    rate
        The statistic, without its counts.
    counts
        Names and meanings of the number of poses used and of the successes.
    inputs
        Names of the arrays that it reads.
    """

    rate: Rate[Poses]
    counts: tuple[tuple[str, str], tuple[str, str]]
    inputs: tuple[str, ...]

    def table(self, results: xr.Dataset, per: Sequence[str], bins: Bins | None) -> xr.Dataset:
        """Return the rate with both intervals and its counts, (*per, *bins)."""
        kept = kept_dimensions(results, per)
        full = replace(self.rate, counts=self.counts, with_jeffreys=True)
        return aggregate(results, pose_arrays(results, self.inputs), kept, [full], Poses, bins)


LOOKED_FOR = ("looked_for", "poses that were run, visible and modelled")
SOLVED = ("solved", "solved poses")
FLIPPED = ("flipped", "solved poses that are nearer to the mirror of the truth")

DETECTION_RATE = PoseRate(
    Rate("detection_rate", "detected of looked_for", lambda poses: poses.detected,
         lambda poses: poses.looked_for),
    (LOOKED_FOR, ("detected", "detected poses")), DETECTION_INPUTS,
)
SOLVED_RATE = PoseRate(
    Rate("solved_rate", "solved of looked_for", lambda poses: poses.solved,
         lambda poses: poses.looked_for),
    (LOOKED_FOR, SOLVED), ESTIMATE_INPUTS,
)
FLIP_RATE = PoseRate(
    Rate("flip_rate", "nearer to the mirror of the truth, of solved",
         lambda poses: poses.flipped, lambda poses: poses.solved),
    (SOLVED, FLIPPED), ESTIMATE_INPUTS,
)


@describes
def detection_rate(
    results: xr.Dataset, per: Sequence[str] = (), bins: Bins | None = None
) -> xr.Dataset:
    """Return how often the marker is detected.

    Parameters
    ----------
    results
        The dataset of a run, as `sweep.open` and `sweep.run` return it.
    per
        Dimensions that are kept; all others are pooled.
    bins
        Edges (n + 1,) of bins [low, high) of variables or coordinates of the scene, by name:
        ``{"marker_area_px": [100, 1000, 10000]}``. Each gives a dimension of that name, with the
        middle of each bin as its coordinate and the edges in ``marker_area_px_low`` and
        ``marker_area_px_high``. Poses outside all bins are left out.

    Returns
    -------
    xr.Dataset
        Dimensions (*per, *bins); lazy if ``results`` is.

        - ``looked_for``: poses whose detection is none of not_run, not_visible, not_modelled, and
          ``detected`` of these.
        - ``draws``: the random draws that they are worth, since pooled settings see the same ones
          (`sweep.analysis.states.Sample.draws`).
        - ``detection_rate`` with Wilson's interval in ``detection_rate_low`` and
          ``detection_rate_high``, and Jeffreys' in ``detection_rate_jeffreys_low`` and
          ``detection_rate_jeffreys_high``.

    Raises
    ------
    ArgumentError
        For a dimension that does not exist, and for bins that cannot be.
    DatasetError
        If the dataset lacks variables of results, or has no poses.

    Notes
    -----
    95 % intervals over the random draws, conditional on the grid; NaN if no cell has two draws.
    See `sweep.analysis.intervals` for the formulas and their sources.

    Examples
    --------
    >>> table = detection_rate(results, per=["side_px"])
    >>> table["detected"].values.tolist(), table["looked_for"].values.tolist()
    ([0, 5, 8], [8, 8, 8])
    >>> table["detection_rate_low"].round(3).values.tolist()
    [0.0, 0.306, 0.676]
    """
    return DETECTION_RATE.table(results, per, bins)


@describes
def flip_rate(
    results: xr.Dataset, per: Sequence[str] = (), bins: Bins | None = None
) -> xr.Dataset:
    """Return how often a solution is nearer to the mirror of the truth than to the truth.

    Parameters
    ----------
    results, per, bins
        As in `detection_rate`.

    Returns
    -------
    xr.Dataset
        Dimensions (*per, *bins); lazy if ``results`` is. ``flipped`` of ``solved`` poses, the
        ``draws`` that these are worth, and ``flip_rate`` with intervals as in `detection_rate`.

    Raises
    ------
    ArgumentError, DatasetError
        As in `detection_rate`.

    Notes
    -----
    It means nothing for frontal markers, whose mirrored pose is the pose itself. The two minima of
    a planar pose: Schweighofer and Pinz, "Robust Pose Estimation from a Planar Target", IEEE TPAMI
    28(12), 2006.

    Examples
    --------
    >>> table = flip_rate(results, per=["solver"])
    >>> table["solver"].values.tolist(), table["flipped"].values.tolist()
    (['ippe', 'iterative'], [0, 3])
    >>> table["flip_rate"].round(3).values.tolist()
    [0.0, 0.231]
    """
    return FLIP_RATE.table(results, per, bins)


OUTCOMES = (*outcomes(counted=True), *outcomes(counted=False))
"""What a pose can end as: solved, or the step at which it was lost."""


def ends_as(outcome: str, poses: Poses) -> Masks:
    """Return which poses have an outcome.

    It is the flag of detection if the marker was not detected, that of the estimate if it was.
    """
    ends = np.zeros(poses.estimate.shape, dtype=bool)
    if outcome in DetectionStatus.__members__:
        ends |= poses.inside & (poses.detection == DetectionStatus[outcome])
    if outcome in EstimateStatus.__members__:
        ends |= poses.detected & (poses.estimate == EstimateStatus[outcome])
    return ends


def _share_of(outcome: str) -> Rate[Poses]:
    """Return the share of an outcome; of those that are not counted, only the number matters."""
    ends = functools.partial(ends_as, outcome)
    counted = outcome in outcomes(counted=True)
    return Rate(
        f"share {outcome}", f"{outcome} of looked_for", ends,
        (lambda poses: poses.looked_for) if counted else ends,
        counts=((f"of {outcome}", ""), (f"count {outcome}", "")))


@describes
def failure_composition(
    results: xr.Dataset, per: Sequence[str] = (), bins: Bins | None = None
) -> xr.Dataset:
    """Return how poses end: solved, or at which step they are lost.

    Parameters
    ----------
    results, per, bins
        As in `detection_rate`.

    Returns
    -------
    xr.Dataset
        Dimensions (*per, *bins, outcome); lazy if ``results`` is.

        - ``outcome``: solved, then the flags of detection and estimation with which a pose ends
          (`sweep.measure.flags.outcomes`).
        - ``count``: poses with that outcome.
        - ``share`` of the poses looked for, with Wilson's interval in ``share_low`` and
          ``share_high``; the shares add up to 1. NaN for not_visible, not_modelled and not_run,
          whose poses are not looked for.

    Raises
    ------
    ArgumentError, DatasetError
        As in `detection_rate`.

    Notes
    -----
    95 % intervals over the random draws, conditional on the grid, each for itself.

    Examples
    --------
    >>> table = failure_composition(results, per=["side_px"])
    >>> table["count"].sel(outcome=["solved", "no_candidate"]).values.tolist()
    [[0, 16], [10, 6], [16, 0]]
    >>> table["share"].sel(outcome="solved").values.tolist()
    [0.0, 0.625, 1.0]
    """
    kept = kept_dimensions(results, per)
    table = aggregate(results, pose_arrays(results, ESTIMATE_INPUTS), kept,
                      [_share_of(outcome) for outcome in OUTCOMES], Poses, bins)
    is_counted = xr.DataArray(
        [outcome in outcomes(counted=True) for outcome in OUTCOMES], dims="outcome")
    variables = {}
    for name, begin, end, meaning in (
        ("count", "count ", "", "poses that ended so"),
        ("share", "share ", "", "share of the poses looked for"),
        ("share_low", "share ", "_low", "lower end of the 95 % interval: share"),
        ("share_high", "share ", "_high", "upper end of the 95 % interval: share"),
    ):
        parts = [table[f"{begin}{outcome}{end}"] for outcome in OUTCOMES]
        values = xr.concat(parts, dim="outcome").transpose(..., "outcome")
        if name != "count":
            values = values.where(is_counted)
        variables[name] = values.assign_attrs(long_name=meaning, units="1")
    coordinates = {"outcome": ("outcome", list(OUTCOMES), {"long_name": "what became of the pose"})}
    return xr.Dataset(variables, dict(table.coords)).assign_coords(coordinates)
