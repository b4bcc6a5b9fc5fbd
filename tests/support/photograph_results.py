"""Results of photographs, of their twins and of other simulations, as datasets without a store."""

import numpy as np
import xarray as xr

from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped

PHOTOGRAPHS, MARKERS = 12, 9
REFINEMENTS = ["none", "subpix"]


def results_of(rng, trials=PHOTOGRAPHS, *, simulated=None, files=None, scale=1.0, spread=0.5):
    """Return results of photographs, of their twins, or of a simulation (``files`` is False)."""
    shape = (trials, MARKERS, len(REFINEMENTS))
    dims = ("trial", "marker_id", "cornerRefinementMethod")
    own = np.exp(rng.normal(0.0, spread, (trials, 1, 1)))
    angle = scale * own * rng.chisquare(3, shape) / 100
    depth = scale * (own - 0.5 + rng.normal(0.0, 1.0, shape)) / 100
    flags = np.where(rng.random(shape) < 0.15, DetectionStatus.no_candidate,
                     DetectionStatus.detected)
    flags[:, 0] = DetectionStatus.not_in_photograph
    detected = flags == DetectionStatus.detected
    solved = np.where(detected, EstimateStatus.solved, EstimateStatus.no_detection)
    flipped = np.where(rng.random(shape) < 0.2, Flipped.flipped, Flipped.not_flipped)
    zero = np.zeros(shape)
    position = np.zeros((trials, MARKERS, 3))
    position[..., 2] = 2.0
    sides = np.broadcast_to(20.0 + 5 * np.arange(MARKERS), shape[:2])
    found = xr.Dataset(
        {
            "detection": (dims, flags.astype(np.uint8)),
            "estimate": (dims, solved.astype(np.uint8)),
            "flipped": (dims, np.where(detected, flipped, Flipped.no_estimate).astype(np.uint8)),
            "rotation_error_rad": (
                (*dims, "xyz"),
                np.where(detected[..., None], np.stack([zero, angle, zero], axis=-1), np.nan),
            ),
            "translation_error_m": (
                (*dims, "xyz"),
                np.where(detected[..., None], np.stack([zero, zero, 2 * depth], axis=-1), np.nan),
            ),
            "true_tvec_m": (("trial", "marker_id", "xyz"), position),
            "true_rvec": (("trial", "marker_id", "xyz"), position),
            "side_px": (("trial", "marker_id"), sides),
        },
        {"trial": range(trials), "marker_id": range(MARKERS),
         "cornerRefinementMethod": REFINEMENTS},
    )
    if files is False:
        return found
    names = files or [f"{k}.png" for k in range(trials)]
    found = found.assign_coords(
        photographs="shots.photographs.npz", photograph=("trial", names),
        sha256=("trial", [f"digest of {name}" for name in names]),
    )
    return found if simulated is None else found.assign_coords(simulated=simulated)


def twins(rng, repeats=1, **options):
    names = [f"{k}.png" for k in range(PHOTOGRAPHS)] * repeats
    return results_of(rng, PHOTOGRAPHS * repeats, simulated=True, files=names, **options)
