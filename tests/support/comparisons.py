"""Comparisons of datasets, written without the code under test."""

import numpy as np
import xarray as xr

from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped


def with_detected(results, hits):
    """Return the dataset with poses detected where ``hits``, and solved where detected."""
    out = results.copy(deep=True)
    dims = results["detection"].dims
    detected = xr.DataArray(np.broadcast_to(hits, results["detection"].shape), dims=dims)
    out["detection"] = (
        dims,
        np.where(detected, DetectionStatus.detected, DetectionStatus.no_candidate).astype(np.uint8),
    )
    estimated = results["estimate"]
    seen = xr.broadcast(detected, estimated.drop_vars(estimated.coords))[0]
    seen = seen.transpose(*estimated.dims)
    for name, yes, no in (("estimate", EstimateStatus.solved, EstimateStatus.no_detection),
                          ("flipped", Flipped.not_flipped, Flipped.no_estimate)):
        out[name] = (seen.dims, np.where(seen, yes, no).astype(np.uint8))
    for name in ("rotation_error_rad", "translation_error_m", "rotation_error_deg"):
        out[name] = out[name].where(seen)
    return out


def holm(p_values):
    """Holm 1979: the smallest times m, the next times m - 1, ..., never falling."""
    adjusted, largest = {}, 0.0
    for k, index in enumerate(sorted(range(len(p_values)), key=lambda i: p_values[i])):
        largest = max(largest, (len(p_values) - k) * p_values[index])
        adjusted[index] = min(1.0, largest)
    return [adjusted[index] for index in range(len(p_values))]
