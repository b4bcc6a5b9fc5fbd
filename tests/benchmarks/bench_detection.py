"""Covariances of one detection on draws that were not fitted, beside those of simpler forms.

    python -m tests.benchmarks detection

It runs pipelines/diagnose/detection.toml: even trials are fitted, odd ones judged.
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
REFINEMENTS = ("subpix", "apriltag")
SETTINGS = ()
ANGLES_DEG = (0, 15, 30, 45, 90)
FEWEST = 60
"""Poses of a cell from which on it is judged."""

PLANE = [0, 2, 4]
"""Errors of a robot's pose: x to the right, z ahead, rotation about the vertical."""

QUICK = {
    "REFINEMENTS": ("subpix",), "SETTINGS": (
        'cornerRefinementMethod=["subpix"]', "distance_m=[3, 5]", "trial=2100", 'window="auto"'),
}


class Sample:
    """Estimated poses of half of the trials, with errors in the camera's frame."""

    def __init__(self, results, half):
        self.results = results.isel(trial=slice(half, None, 2)).load()
        self.errors, self.rvec, self.tvec, self.ratio, self.flipped, _ = estimated(self.results)
        self.distance = np.linalg.norm(self.tvec, axis=1)
        self.angle = np.minimum(viewing_angle_of(self.rvec, self.tvec), 89.0)


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


def cells(sample, used):
    """Yield the poses of each cell of distance (quarters) and viewing angle."""
    ends = np.quantile(sample.distance[used], np.linspace(0, 1, 5))
    for low, high in itertools.pairwise(ends):
        for first, last in itertools.pairwise(ANGLES_DEG):
            inside = used & (sample.distance >= low) & (sample.distance <= high) & (
                sample.angle >= first) & (sample.angle < last)
            if inside.sum() >= FEWEST:
                yield inside


def print_row(name, whitened, sample, used):
    """Print the mean squared distance of whitened errors, and the divergence in all cells."""
    full = np.full((len(used), whitened.shape[1]), np.nan)
    full[used] = whitened
    divergences, chance = np.array([
        (divergence(full[cell]), sampling_divergence(full[cell]))
        for cell in cells(sample, used)]).T
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
    results = sweep.run(Pipeline.from_toml(DOCUMENT, SETTINGS), store="runs/detection.zarr")
    for refinement in REFINEMENTS:
        chosen = results.sel(cornerRefinementMethod=refinement)
        a, b = (Sample(chosen.drop_vars("cornerRefinementMethod"), half) for half in (0, 1))
        found = error_model(a.results).at(b.rvec, b.tvec, b.ratio)
        known = found["known"].values
        used = known & ~b.flipped
        left = (b.errors - found["bias"].values)[used]
        print(f"\n{refinement}: {len(known):,} solved poses, {known.mean():.2%} known, "
              f"{b.flipped.mean():.2%} flipped\n")
        header("form", "mean squared error", "KL divergence of cells: median, worst, share within "
               "0.1", "without the part of sampling")
        for name, some in (("ours, all six", list(range(6))), ("ours, x, z, yaw", PLANE)):
            root = np.linalg.cholesky(found["covariance"].values[used][:, some][:, :, some])
            whitened = np.linalg.solve(root, left[:, some, None])[..., 0]
            print_row(name, whitened, b, used)
        for name, (form, factors) in FORMS.items():
            fitted, judged = (
                sample.errors[rows][:, PLANE] / form(sample.distance[rows, None])
                for sample, rows in ((a, ~a.flipped), (b, used)))
            for each in factors:
                judged[:, each] /= np.sqrt((fitted[:, each] ** 2).mean())
            print_row(name, judged, b, used)
        inside = list(flip_bins(found["flip_probability"].values[known], b.flipped[known]))
        print(f"\nflips within the interval in {sum(inside)} of {len(inside)} bins")
