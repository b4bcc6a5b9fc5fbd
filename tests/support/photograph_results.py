"""Results of photographs, of their twins and of other simulations, as datasets without a store."""

import numpy as np
import xarray as xr

from support.small_datasets import perfect, with_detected
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped

PHOTOGRAPHS, MARKERS = 12, 9
REFINEMENTS = ["none", "subpix"]


def results_of(rng, trials=PHOTOGRAPHS, *, simulated=None, files=None, scale=1.0, spread=0.5):
    """Return results of photographs, of their twins, or of a simulation (``files`` is False)."""
    sizes = {"trial": trials, "marker_id": MARKERS, "cornerRefinementMethod": len(REFINEMENTS)}
    shape = tuple(sizes.values())
    own = np.exp(rng.normal(0.0, spread, (trials, 1, 1)))
    rotation, position = np.zeros((2, *shape, 3))
    rotation[..., 1] = scale * own * rng.chisquare(3, shape) / 100
    position[..., 2] = 2 * scale * (own - 0.5 + rng.normal(0.0, 1.0, shape)) / 100
    found = with_detected(
        perfect(rng, sizes, rotation=rotation, position=position), rng.random(shape) >= 0.15)
    found["detection"][:, 0] = DetectionStatus.not_in_photograph
    hidden = found["detection"] != DetectionStatus.detected
    turned = xr.DataArray(rng.random(shape) < 0.2, dims=found["flipped"].dims)
    found = found.assign(
        estimate=found["estimate"].where(~hidden, np.uint8(EstimateStatus.no_detection)),
        flipped=xr.where(hidden, Flipped.no_estimate, xr.where(
            turned, Flipped.flipped, Flipped.not_flipped)).astype(np.uint8),
        rotation_error_rad=found["rotation_error_rad"].where(~hidden),
        translation_error_m=found["translation_error_m"].where(~hidden),
        true_tvec_m=found["true_tvec_m"].copy(data=np.broadcast_to(
            [0.0, 0.0, 2.0], (*shape[:2], 3))),
        side_px=20.0 + 5 * xr.DataArray(np.indices(shape[:2])[1], dims=("trial", "marker_id")),
    ).assign_coords(marker_id=range(MARKERS), cornerRefinementMethod=REFINEMENTS).drop_attrs()
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
