"""Judge the covariance of one detection on photographs: errors that no simulation has made.

    python pipelines/diagnose/photographs.py PHOTOGRAPHS.zarr SCENE.toml [REPEATS]

PHOTOGRAPHS.zarr is a store of `sweep photos` with one refinement, SCENE.toml the scene that
`sweep fit` found for them. The photographs' markers are simulated at their poses, REPEATS times,
the model is made of these and judged on the photographs. Squared errors are divided by the
covariance of the detection and of the photographs' own truth (`truth_std`).
"""

import itertools
import sys

import numpy as np

import sweep
from sweep.analysis.intervals import clopper_pearson
from sweep.diagnosis.detection import error_model, estimated
from sweep.measure.flags import EstimateStatus

CHANCES = (0.0, 0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 1.0)


def truth_deviations(results):
    """Return the standard deviations (n, 6) of the true poses of solved ones, where known."""
    used = np.ravel(results.estimate == EstimateStatus.solved)
    if "truth_std" not in results:
        return np.zeros((used.sum(), 6))
    inner = [dim for dim in results.truth_std.dims if dim not in results.true_tvec_m.dims]
    outer = [dim for dim in results.true_tvec_m.dims if dim != "xyz"]
    values = results.truth_std.transpose(*outer, *inner).values.reshape(len(used), -1)
    return np.nan_to_num(values[used].astype(float))


def main(path, scene, repeats="8"):
    """Print squared errors over variances, and flips expected and seen."""
    results = sweep.open(path).squeeze(drop=True).load()
    simulated = sweep.twins(path, scene, repeats=int(repeats))
    model = error_model(simulated.squeeze(drop=True).load())
    errors, rvec, tvec, ratio, flipped = estimated(results)
    errors = errors * np.repeat([np.linalg.norm(tvec, axis=1), np.ones(len(tvec))], 3, axis=0).T
    found = model.at(rvec, tvec, ratio)
    known = found["known"].values
    used = known & ~flipped
    covariance = found["covariance"].values[used]
    # truth_std: rotation about x, y, z (rad), then position (m)
    deviations = truth_deviations(results)[used][:, [3, 4, 5, 0, 1, 2]]
    covariance = covariance + np.eye(6) * deviations[:, None, :] ** 2
    left = (errors - found["bias"].values)[used]
    squares = np.einsum("ni,nij,nj->n", left, np.linalg.inv(covariance), left)
    print(f"{len(known)} solved poses in photographs, {known.sum()} known, {flipped.sum()} "
          f"flipped: mean d2 {squares.mean():.2f} of 6, median {np.median(squares):.2f} of 5.35, "
          f"{np.mean(squares > 16.81):.1%} above the 99 % quantile")
    for name, at in (("x", 0), ("y", 1), ("z", 2), ("about x", 3), ("about y", 4), ("about z", 5)):
        ratio_of = left[:, at] ** 2 / covariance[:, at, at]
        print(f"  {name}: mean squared error / variance {ratio_of.mean():.2f}, median "
              f"{np.median(ratio_of):.2f} of 0.45")
    chance = found["flip_probability"].values
    for low, high in itertools.pairwise(CHANCES):
        part = known & (chance >= low) & (chance < high)
        if part.any():
            ends = clopper_pearson(flipped[part].sum(), part.sum())
            print(f"  flips of {part.sum()} expected {chance[part].mean():.3f}, seen "
                  f"{flipped[part].mean():.3f} ({ends[0]:.3f} to {ends[1]:.3f})")


if __name__ == "__main__":
    main(*sys.argv[1:])
