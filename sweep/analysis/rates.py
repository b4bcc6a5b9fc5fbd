"""How often a marker is seen, what becomes of it, and how often its pose is the mirrored one."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.analysis.blocks import Bins, aggregate, kept_of
from sweep.analysis.pose_view import Poses, detections, estimates
from sweep.analysis.statistics import Rate
from sweep.measure.flags import DetectionStatus, EstimateStatus

DETECTION_RATE = Rate(
    "detection_rate", "detected of looked_for", lambda poses: poses.detected,
    lambda poses: poses.looked_for,
)
SOLVED_RATE = Rate(
    "solved_rate", "solved of looked_for", lambda poses: poses.solved,
    lambda poses: poses.looked_for,
)
FLIP_RATE = Rate(
    "flip_rate", "nearer to the mirror of the truth, of solved", lambda poses: poses.flipped,
    lambda poses: poses.solved,
)


def detection_rate(
    results: xr.Dataset, per: Sequence[str] = (), bins: Bins | None = None
) -> xr.Dataset:
    """Return how often the marker is detected, with dimensions (*per, *bins).

    ``per`` names the dimensions that are kept; all others are pooled. ``bins`` keeps bins of a
    variable or coordinate of the scene: ``{"marker_area_px": edges}`` gives a dimension of that
    name, the middle of each bin [low, high) as its coordinate and the edges in
    ``marker_area_px_low`` and ``marker_area_px_high``; what is outside of all is left out.

    ``detected`` of ``looked_for``: of the poses whose detection is none of not_run, not_visible
    and not_modelled. ``draws`` are the random draws that these are worth: pooled settings see the
    same ones (`sweep.analysis.statistics.draws_of`). ``detection_rate`` has Wilson's interval at
    95 %, and Jeffreys' in ``detection_rate_jeffreys_low`` and ``_high``: of the draws, on a fixed
    grid; NaN where nothing was drawn.

    Lazy where ``results`` is. Raises ``StoreError`` for a dimension that is not there.
    """
    return _rate(results, per, bins, DETECTION_RATE, (
        ("looked_for", "poses that were run, visible and modelled"),
        ("detected", "detected poses"),
    ))


def flip_rate(
    results: xr.Dataset, per: Sequence[str] = (), bins: Bins | None = None
) -> xr.Dataset:
    """Return how often a solution is nearer to the mirror of the truth: (*per, *bins).

    ``flipped`` of ``solved``, ``draws``, and ``flip_rate`` with intervals as in `detection_rate`,
    of which the parameters are, too. It means nothing for frontal markers, whose mirror is no
    other pose.
    """
    return _rate(results, per, bins, FLIP_RATE, (
        ("solved", "solved poses"),
        ("flipped", "solved poses that are nearer to the mirror of the truth"),
    ))


def _rate(
    results: xr.Dataset, per: Sequence[str], bins: Bins | None, rate: Rate,
    counts: Sequence[tuple[str, str]],
) -> xr.Dataset:
    kept = kept_of(results, per)
    needed = estimates(results) if rate is FLIP_RATE else detections(results)
    full = Rate(rate.name, rate.meaning, rate.successes, rate.used, counts=counts,
                with_jeffreys=True)
    return aggregate(results, needed, kept, [full], bins)


OUTCOMES = (
    "solved", "wrong_id", "rejected", "no_candidate", "solver_failed", "not_converged",
    "not_explained", "failed", "crashed", "not_visible", "not_modelled", "not_run",
)
"""What becomes of a pose: solved, or at which step it was lost."""
UNCOUNTED = ("not_visible", "not_modelled", "not_run")
"""Outcomes of poses that are not looked for."""


def outcome_of(outcome: str, poses: Poses) -> NDArray[np.bool_]:
    """Return which poses end so.

    The detection's flag tells where the marker was not detected, the estimate's where it was.
    """
    ends = np.zeros(poses.estimate.shape, dtype=bool)
    if outcome in DetectionStatus.__members__:
        ends |= poses.inside & (poses.detection == DetectionStatus[outcome])
    if outcome in EstimateStatus.__members__:
        ends |= poses.detected & (poses.estimate == EstimateStatus[outcome])
    return ends


def _of_which(outcome: str, poses: Poses) -> NDArray[np.bool_]:
    """Return the poses of which an outcome is a share."""
    return outcome_of(outcome, poses) if outcome in UNCOUNTED else poses.looked_for


def failure_composition(
    results: xr.Dataset, per: Sequence[str] = (), bins: Bins | None = None
) -> xr.Dataset:
    """Return what became of the poses, with dimensions (*per, *bins, outcome).

    ``outcome`` is solved, or at which step the pose was lost: wrong_id, rejected, no_candidate,
    solver_failed, not_converged, not_explained, failed, crashed. ``share`` is of those looked for,
    so that these shares add up to 1, with Wilson's interval as in `detection_rate`. The outcomes
    not_visible, not_modelled and not_run are counted, but no share of anything.
    """
    kept = kept_of(results, per)
    rates = [
        Rate(f"share {outcome}", f"{outcome} of looked_for",
             functools.partial(outcome_of, outcome), functools.partial(_of_which, outcome),
             counts=((f"of {outcome}", ""), (f"count {outcome}", "")))
        for outcome in OUTCOMES
    ]
    table = aggregate(results, estimates(results), kept, rates, bins)
    found = {}
    for name, begin, end, meaning in (
        ("count", "count ", "", "poses that ended so"),
        ("share", "share ", "", "share of the poses looked for"),
        ("share_low", "share ", "_low", "lower end of the 95 % interval: share"),
        ("share_high", "share ", "_high", "upper end of the 95 % interval: share"),
    ):
        parts = [table[f"{begin}{outcome}{end}"] for outcome in OUTCOMES]
        joined = xr.concat(parts, dim="outcome").transpose(..., "outcome")
        if name != "count":
            counted = xr.DataArray([outcome not in UNCOUNTED for outcome in OUTCOMES],
                                   dims="outcome")
            joined = joined.where(counted)
        found[name] = joined.assign_attrs(long_name=meaning, units="1")
    coordinates = {"outcome": ("outcome", list(OUTCOMES), {"long_name": "what became of the pose"})}
    return xr.Dataset(found, dict(table.coords)).assign_coords(coordinates)
