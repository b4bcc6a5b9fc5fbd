"""Whether a block's flags and numbers agree: what a flag says is there is, and nothing else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.measure.flags import BoundStatus, DetectionStatus, EstimateStatus, Flipped
from sweep.plan.experiment import Pipeline
from sweep.plan.schema import SCHEMA
from sweep.store.receipt import Receipt

POSED = (EstimateStatus.solved, EstimateStatus.not_explained)
"""Estimates that have a pose."""

LOST = (DetectionStatus.failed, DetectionStatus.crashed)
"""Detections whose scene may not even have a pose."""

ALWAYS = {
    "bound": ("bound_std", "bound_kappa"),
    "detection": ("corner_error_px",),
    "estimate": (
        "translation_error_m", "rotation_error_rad", "rotation_error_deg", "normal_error_deg",
        "reprojection_error_px",
    ),
}
"""Flag -> what is finite wherever the flag says that there is something."""

ONLY = {
    "bound": ("mirror_distance",),
    "estimate": (
        "alternative_rotation_error_deg", "alternative_reprojection_error_px", "predicted_std",
        "nees", "residual_variance_ratio",
    ),
}
"""Flag -> what may be there only where the flag says so."""


def contradiction(
    pipeline: Pipeline, values: Mapping[str, NDArray[Any]], receipt: Receipt
) -> str:
    """Return the first thing in which a block contradicts itself; empty where there is none.

    ``values`` are a block's, by variable; ``receipt`` has the counts of its flags.
    """
    for variable in SCHEMA:
        if variable.flags is not None:
            unknown = ~np.isin(values[variable.name], [int(flag) for flag in variable.flags])
            if unknown.any():
                return f"{variable.name}: unknown flag {values[variable.name][unknown][0]}"
    for name, counts in (("detection", receipt.detection), ("estimate", receipt.estimate)):
        if np.bincount(values[name].ravel()).tolist() != list(counts):
            return f"{name}: flags other than were counted when it was written"
    present = {
        "bound": values["bound"] == BoundStatus.given,
        "detection": values["detection"] == DetectionStatus.detected,
        "estimate": np.isin(values["estimate"], POSED),
    }
    for flag, there in present.items():
        for name in ALWAYS[flag]:
            finite = _inner(np.isfinite(values[name]), there, np.all)
            if not finite[there].all():
                return f"{name}: no number where {flag} says that there is one"
        for name in (*ALWAYS[flag], *ONLY.get(flag, ())):
            number = _inner(~np.isnan(values[name]), there, np.any)
            if number[~there].any():
                return f"{name}: a number where {flag} says that there is none"
    solved = present["estimate"]
    no_pose = values["flipped"] == Flipped.no_estimate
    if (no_pose == (values["estimate"] == EstimateStatus.solved)).any():
        return "flipped: contradicts estimate"
    names = {v.name: v.dimensions(pipeline) for v in SCHEMA}
    detection = _spread(values["detection"], names["detection"], names["estimate"])
    if (solved & (detection != DetectionStatus.detected)).any():
        return "estimate: a pose where nothing was detected"
    if (
        (values["estimate"] == EstimateStatus.no_detection)
        == (detection == DetectionStatus.detected)
    ).any():
        return "estimate: contradicts detection"
    if (values["detection"] == DetectionStatus.not_run).any():
        return "detection: not run"
    scene = names["marker_area_px"]
    away = tuple(k for k, name in enumerate(names["detection"]) if name not in scene)
    known = np.asarray(np.any(~np.isin(values["detection"], LOST), axis=away))
    asked = pipeline.fixed.get("bound", "none") != "none"
    if asked and ((values["bound"] == BoundStatus.not_run) & known).any():
        return "bound: not run"
    for name in ("true_rvec", "true_tvec_m", "marker_area_px"):
        if not _inner(np.isfinite(values[name]), known, np.all)[known].all():
            return f"{name}: no number"
    return ""


def _inner(truth: NDArray[np.bool_], like: NDArray[Any], join: Any) -> NDArray[np.bool_]:
    """Return ``truth`` with its dimensions beyond those of ``like`` joined."""
    away = tuple(range(like.ndim, truth.ndim))
    return np.asarray(join(truth, axis=away)) if away else truth


def _spread(
    values: NDArray[Any], dimensions: Sequence[str], wanted: Sequence[str]
) -> NDArray[Any]:
    """Return values over more dimensions, in the same order."""
    shape = [
        values.shape[dimensions.index(name)] if name in dimensions else 1 for name in wanted
    ]
    return values.reshape(shape)
