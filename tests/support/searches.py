"""Searches for limits on curves of known rates: the rule of sampling, fed with binomial draws."""

import numpy as np

from sweep.analysis.requirements import requirement_limits
from sweep.experiment.grid import Block
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped
from sweep.sampling.searches import group_dataset, search_rule

DOCUMENT = {
    "pose": {"distance_m": 1.0, "jitter_px": 0.5},
    "axes": {"size_m": [0.02, 0.08, 0.04], "tilt_deg": [0, 60],
             "dictionary": ["DICT_4X4_50", "DICT_6X6_50"], "solver": ["ippe", "iterative"]},
    "require": {"all": ["detection >= 0.9"]},
    "search": {"smallest": "size_m", "among": ["dictionary"], "max_trials": 400},
}
"""A search for the smallest choice."""


def changed(**sections):
    """Return `DOCUMENT` with keys of sections replaced; None takes one away."""
    document = {name: dict(table) for name, table in DOCUMENT.items()}
    for section, keys in sections.items():
        if isinstance(keys, dict):
            keys = document.get(section, {}) | keys  # noqa: PLW2901
            keys = {key: value for key, value in keys.items() if value is not None}  # noqa: PLW2901
        document[section] = keys
    return {name: table for name, table in document.items() if table is not None}


def pipeline_of(curves, values, text, most):
    """Return a pipeline whose tilts stand for the conditions of curves (conditions, values)."""
    return Pipeline.from_dict({
        "pose": {"jitter_px": 0.5},
        "axes": {"tilt_deg": np.linspace(0, 80, len(curves)).tolist(), "side_px": list(values)},
        "require": {"all": [text]},
        "search": {"along": "side_px", "per": ["tilt_deg"], "max_trials": most},
    })


def flags_of(detection, solvers=None):
    """Return the values of a group with flags of detection (..., trial), for some solvers."""
    detected = detection == DetectionStatus.detected
    unneeded = detection == DetectionStatus.not_needed
    if solvers is not None:
        detected, unneeded = (
            np.repeat(each[..., None, :], solvers, axis=-2) for each in (detected, unneeded))
    return {
        "detection": detection.astype(np.uint8),
        "estimate": np.select([detected, unneeded],
                              [EstimateStatus.solved, EstimateStatus.not_needed],
                              EstimateStatus.no_detection).astype(np.uint8),
        "flipped": np.select([detected, unneeded], [Flipped.not_flipped, Flipped.not_needed],
                             Flipped.no_estimate).astype(np.uint8),
    }


def block_of(values):
    """Return the group of all scenes of some values, whose last axis is ``trial``."""
    return Block((0,) * values["detection"].ndim, values["detection"].shape)


def needed_by(rule, values):
    """Return which cells (axes of the scene but ``trial``) a rule needs more trials of."""
    return rule.needed(block_of(values), values)[..., 0]


def searched(curves, values, text, most, seed):
    """Return the limits that a search finds on curves (conditions, values) of rates."""
    pipeline = pipeline_of(curves, values, text, most)
    rule = search_rule(pipeline, pipeline.stopping)
    rng = np.random.default_rng(seed)
    shape = curves.shape
    detection = np.full((*shape, most), DetectionStatus.not_needed, dtype=np.uint8)
    needed, first = np.ones(shape, dtype=bool), 0
    for end in rule.ends:
        hits = rng.random((*shape, end - first)) < curves[..., None]
        found = np.where(hits, DetectionStatus.detected, DetectionStatus.no_candidate)
        detection[..., first:end] = np.where(
            needed[..., None], found, DetectionStatus.not_needed)
        first = end
        if end < most:
            needed = needed_by(rule, flags_of(detection[..., :end].copy()))
        if not needed.any():
            break
    values = flags_of(detection)
    results = group_dataset(pipeline, block_of(values), values)
    results.attrs["pipeline"] = pipeline.text
    return requirement_limits(results)


def true_limits(curves, values, rate):
    """Return the limits (conditions,) of curves along falling sides; infinite for none."""
    order = np.argsort(values)[::-1]
    reached = np.logical_and.accumulate(curves[:, order] >= rate, axis=1).sum(axis=1)
    return np.concatenate([[np.inf], np.asarray(values)[order]])[reached]
