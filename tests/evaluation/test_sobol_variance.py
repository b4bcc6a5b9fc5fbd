"""How much evenly spread draws gain on real scenes: variances of means against independent ones."""

import numpy as np
import pytest
from scipy import stats

import sweep
from support.blocks import run_cells
from sweep.experiment.draws import REPLICATES

PIPELINE = {
    "camera": {"fx_px": 600},
    "marker": {"size_m": 0.05},
    "pose": {
        "side_px": {"uniform": [14, 40]}, "tilt_deg": {"uniform": [0, 70]},
        "azimuth_deg": {"uniform": [0, 360]}, "jitter_px": 0.5,
    },
    "scene": {"background": 120, "black": 40, "white": 220, "noise_grey": 2},
    "detector": {"cornerRefinementMethod": "subpix"},
}


def quantities(seed, points, sampling):
    """Return the means of five quantities over each group of points, (groups, 5)."""
    trials = points * REPLICATES
    pipeline = sweep.Pipeline.from_dict(
        PIPELINE | {"seed": seed, "sampling": sampling, "axes": {"trial": trials}})
    columns = run_cells(pipeline, [np.arange(trials)]).columns
    angle = np.minimum(columns["rotation_error_deg"][0].astype(float), 30)
    # Both samplings in groups of as many draws: replicates, or trials in a row.
    order = np.arange(trials)
    if sampling == "sobol":
        order = np.argsort(order % REPLICATES, kind="stable")
    values = np.stack([
        columns["detection"][0] == 1, angle, columns["translation_error_m"][0][:, 2], angle**2,
        np.linalg.norm(columns["corner_error_px"][0], axis=2).mean(axis=1),
    ], axis=1).astype(float)
    means = np.nanmean(values[order.reshape(-1, points)], axis=1)
    means[:, 3] = np.sqrt(means[:, 3])
    return means


NAMES = ("detection rate", "mean rotation error", "bias of z", "RMSE of rotation", "corner error")


@pytest.mark.evidence
def test_variances_of_means_are_no_larger():
    # The ratio of two sample variances of equal normal means is Fisher's F: with 159 and 159
    # degrees of freedom below 0.47 with a chance of 1e-6.
    seeds, points = 10, 64
    means = {
        sampling: np.concatenate([
            quantities(seed, points, sampling) for seed in range(seeds)
        ]) for sampling in ("sobol", "independent")
    }
    ratios = means["independent"].var(axis=0, ddof=1) / means["sobol"].var(axis=0, ddof=1)
    print({name: round(float(ratio), 2) for name, ratio in zip(NAMES, ratios, strict=True)})
    groups = seeds * REPLICATES - 1
    assert (ratios > stats.f.ppf(1e-6, groups, groups)).all()
    # The same is estimated.
    error = np.sqrt(sum(each.var(axis=0, ddof=1) / len(each) for each in means.values()))
    difference = means["sobol"].mean(axis=0) - means["independent"].mean(axis=0)
    assert (abs(difference) < 6 * error).all()
