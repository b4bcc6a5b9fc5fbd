"""Covariances of one detection on draws that were not fitted, beside those of simpler forms.

    python -m tests.benchmarks detection

It runs pipelines/diagnose/detection.toml: even trials are fitted, odd ones judged. Half an hour.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # many small matrices

import itertools
from pathlib import Path

import numpy as np

import sweep
from benchmarks.tables import header, row
from sweep.analysis.dataset import viewing_angle_of
from sweep.analysis.estimator import clopper_pearson
from sweep.diagnosis.detection import error_model, estimated
from sweep.experiment.pipeline import Pipeline

DOCUMENT = Path(__file__).parents[2] / "pipelines" / "diagnose" / "detection.toml"
# Sampling adds at most 0.02 to a cell's divergence: apriltag's errors have heavy tails.
TRIALS = {"subpix": 2800, "apriltag": 16800}
SETTINGS = ()
ANGLES_DEG = (0, 15, 30, 45, 90)
FEWEST = 60
"""Poses of a cell from which on it is judged."""

PLANE = [0, 2, 4]
"""Errors of a robot's pose: x to the right, z ahead, rotation about the vertical."""

QUICK = {"TRIALS": {"subpix": 2100}, "SETTINGS": ("distance_m=[3, 5]", 'window="auto"')}


def divergence(w):
    """Return the divergence of the normal distribution of whitened errors from the expected one."""
    s = np.cov(w.T)
    return 0.5 * (np.trace(s) - len(s) - np.linalg.slogdet(s)[1] + (w.mean(axis=0) ** 2).sum())


def sampling_divergence(w, repeats=50):
    """Return the part of a cell's divergence that its few, heavy-tailed errors make by themselves.

    The mean divergence of bootstrap samples from the sample that they are drawn from, about
    m (m + 3) / 4 n of m normal errors and n poses (Efron and Tibshirani, "An introduction to the
    bootstrap", 1993, section 10.2, on estimates of bias).
    """
    rng = np.random.default_rng(0)
    root = np.linalg.cholesky(np.cov(w.T))
    whitened = np.linalg.solve(root, (w - w.mean(axis=0)).T).T
    return np.mean([divergence(whitened[rng.integers(0, len(w), len(w))])
                    for _ in range(repeats)])


def cells(found):
    """Yield the poses of each cell of distance (quarters) and viewing angle."""
    distance = np.linalg.norm(found["tvec_m"], axis=1)
    angle = np.minimum(viewing_angle_of(found["rvec"].values, found["tvec_m"].values), 89.0)
    ends = np.quantile(distance, np.linspace(0, 1, 5))
    for low, high in itertools.pairwise(ends):
        for first, last in itertools.pairwise(ANGLES_DEG):
            inside = (distance >= low) & (distance <= high) & (angle >= first) & (angle < last)
            if inside.sum() >= FEWEST:
                yield inside


def print_row(name, whitened, found):
    """Print the mean squared distance of whitened errors, and the divergence in all cells."""
    divergences, chance = np.array([
        (divergence(whitened[cell]), sampling_divergence(whitened[cell]))
        for cell in cells(found)]).T
    row(name, f"{(whitened**2).sum(axis=1).mean():.2f} ({whitened.shape[1]})", *(
        f"{np.median(kl):.3f}, {kl.max():.3f}, {np.mean(kl <= 0.1):.0%} of {len(kl)}"
        for kl in (divergences, divergences - chance)))


FORMS = {
    "0.02 d2, fitted (2 numbers)": (lambda d: d**2 * np.ones(3), ([0, 1], [2])),
    "(4, 4, 8)(1 + d2/30), fitted (1)": (
        lambda d: np.array([4, 4, 8]) * (1 + d**2 / 30), ([0, 1, 2],)),
}
"""Form -> deviations (N, 3) of x, z and yaw at distances (N, 1), and which of them share a factor.

The likeliest factor is the root mean square of the errors in units of the form.
"""


def flip_bins(chance, flipped):
    """Yield whether the expected share of flips lies in the exact interval of a bin's poses.

    Ten bins have equally many poses, ten more equal expectations.
    """
    edges = [0, .01, .02, .05, .1, .15, .2, .3, .4, .5, 1]
    even = np.array_split(np.argsort(chance), 10)
    for part in [*even, *(np.flatnonzero((chance >= low) & (chance < high))
                          for low, high in itertools.pairwise(edges))]:
        if len(part):
            low, high = clopper_pearson(flipped[part].sum(), len(part))
            yield low <= chance[part].mean() <= high


def main():
    for refinement, trials in TRIALS.items():
        pipeline = Pipeline.from_toml(DOCUMENT, (
            *SETTINGS, f'cornerRefinementMethod=["{refinement}"]', f"trial={trials}"))
        results = sweep.run(pipeline, store=f"runs/detection_{refinement}.zarr")
        even, odd = (results.isel(cornerRefinementMethod=0, trial=slice(half, None, 2), drop=True)
                     .load() for half in (0, 1))
        fitted, found = estimated(even), estimated(odd)
        found = found.assign(error_model(even).at(found.rvec, found.tvec_m, found.ambiguity))
        known, flipped, chance = (
            found[name].values for name in ("known", "flipped", "flip_probability"))
        used = found.isel(pose=known & ~flipped)
        left = (used["error"] - used["bias"]).values
        print(f"\n{refinement}: {len(known):,} solved poses, {known.mean():.2%} known, "
              f"{flipped.mean():.2%} flipped\n")
        header("form", "mean squared error", "KL divergence of cells: median, worst, share within "
               "0.1", "without the part of sampling")
        for name, some in (("ours, all six", list(range(6))), ("ours, x, z, yaw", PLANE)):
            root = np.linalg.cholesky(used["covariance"].values[:, some][:, :, some])
            whitened = np.linalg.solve(root, left[:, some, None])[..., 0]
            print_row(name, whitened, used)
        for name, (form, factors) in FORMS.items():
            fit, judged = (
                each["error"].values[:, PLANE]
                / form(np.linalg.norm(each["tvec_m"], axis=1, keepdims=True))
                for each in (fitted.isel(pose=~fitted["flipped"].values), used))
            for each in factors:
                judged[:, each] /= np.sqrt((fit[:, each] ** 2).mean())
            print_row(name, judged, used)
        inside = list(flip_bins(chance[known], flipped[known]))
        print(f"\nflips within the interval in {sum(inside)} of {len(inside)} bins")
