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
from sweep.diagnosis.detection import judged

CHANCES = (0.0, 0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 1.0)


def mean_of(squares):
    """Return squared errors in words."""
    squares = squares[np.isfinite(squares)]
    return (f"mean d2 {squares.mean():.2f} of 6, median {np.median(squares):.2f} of 5.35, "
            f"{np.mean(squares > 16.81):.1%} above the 99 % quantile")


def main(path, scene, repeats="8"):
    """Print squared errors over variances, and flips expected and seen."""
    results = sweep.open(path).squeeze(drop=True).load()
    simulated = sweep.twins(path, scene, repeats=int(repeats)).squeeze(drop=True).load()
    found = judged(sweep.error_model(simulated), results)
    known, flipped = found["known"].values, found["flipped"].values
    print(f"{len(known)} solved poses in photographs, {known.sum()} known, {flipped.sum()} "
          f"flipped: {mean_of(found.squared_error.values)}")
    used = known & ~flipped
    variance = (found.covariance.values[:, range(6), range(6)] + found.truth_std.values**2)[used]
    for at, name in enumerate(("x", "y", "z", "about x", "about y", "about z")):
        ratio = found.error.values[used][:, at] ** 2 / variance[:, at]
        print(f"  {name}: mean squared error / variance {ratio.mean():.2f}, median "
              f"{np.median(ratio):.2f} of 0.45")
    for first in (0, 1):
        halves = [results.isel(trial=slice(k, None, 2)) for k in (first, 1 - first)]
        wider = sweep.error_model(simulated, photographs=halves[0])
        print(f"  times the factor of one half of the photographs, on the other: "
              f"{mean_of(judged(wider, halves[1]).squared_error.values)}")
    chance = found["flip_probability"].values
    for low, high in itertools.pairwise(CHANCES):
        part = known & (chance >= low) & (chance < high)
        if part.any():
            ends = clopper_pearson(flipped[part].sum(), part.sum())
            print(f"  flips of {part.sum()} expected {chance[part].mean():.3f}, seen "
                  f"{flipped[part].mean():.3f} ({ends[0]:.3f} to {ends[1]:.3f})")


if __name__ == "__main__":
    main(*sys.argv[1:])
