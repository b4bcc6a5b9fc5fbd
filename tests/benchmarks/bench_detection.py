"""Covariances of one detection on draws that were not fitted, beside those of others.

    python tests/benchmarks/bench_detection.py STORE.zarr

The store is a run of pipelines/diagnose/detection.toml: even trials are fitted, odd ones judged.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # many small matrices

import itertools
import sys

import numpy as np
from scipy.optimize import minimize

import sweep
from sweep.analysis.intervals import clopper_pearson
from sweep.analysis.poses import viewing_angle_of
from sweep.diagnosis.detection import error_model, estimated

ANGLES_DEG = (0, 15, 30, 45, 90)
FEWEST = 60
"""Poses of a cell from which on it is judged."""

PLANE = [0, 2, 4]
"""Errors of a robot's pose: x to the right, z ahead, rotation about the vertical."""


class Sample:
    """Estimated poses of one refinement that are not flipped, with errors in the camera's frame."""

    def __init__(self, path, refinement, half):
        self.results = sweep.open(path).sel(cornerRefinementMethod=refinement).isel(
            trial=slice(half, None, 2)).drop_vars("cornerRefinementMethod").load()
        errors, self.rvec, self.tvec, self.ratio, self.flipped = estimated(self.results)
        self.distance = np.linalg.norm(self.tvec, axis=1)
        self.angle = np.minimum(viewing_angle_of(self.rvec, self.tvec), 89.0)
        self.area = (900 * 0.165 / self.tvec[:, 2]) ** 2 * np.cos(np.radians(self.angle))
        self.errors = errors * np.repeat([self.distance, np.ones(len(errors))], 3, axis=0).T


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


def line(name, w, sample, used):
    """Print mean squared distance, and the divergence in all cells."""
    full = np.full((len(used), w.shape[1]), np.nan)
    full[used] = w
    each = [(divergence(full[cell]), sampling_divergence(full[cell]),
             (full[cell] ** 2).sum(axis=1).mean()) for cell in cells(sample, used)]
    kl, chance, squares = np.array(each).T
    print(f"  {name:34s} mean d2 {(w**2).sum(axis=1).mean():6.2f} of {w.shape[1]}, cells "
          f"{squares.min():5.2f} to {squares.max():6.2f}; KL {divergence(w):6.3f}, cells median "
          f"{np.median(kl):6.3f}, worst {kl.max():6.3f}, {np.mean(kl <= 0.1):.0%} of {len(kl)} "
          f"within 0.1; without that of sampling, median {np.median(chance):.3f}: median "
          f"{np.median(kl - chance):6.3f}, worst {(kl - chance).max():6.3f}, "
          f"{np.mean(kl - chance <= 0.1):.0%} within 0.1")


def loss(p, form, sample):
    """Return the mean of -2 log-likelihood of a form's numbers."""
    log = form(p, sample)[~sample.flipped]
    return float((log + sample.errors[~sample.flipped][:, PLANE] ** 2 * np.exp(-log)).mean())


FORMS = {
    "0.02 d2, fitted (2 numbers)": (
        lambda p, s: np.stack([p[0] + 4 * np.log(s.distance)] * 2
                              + [p[1] + 4 * np.log(s.distance)], axis=-1), [-10.0, -10.0]),
    "(4, 4, 8)(1 + d2/30), fitted (1)": (
        lambda p, s: p[0] + 2 * np.log(np.array([4, 4, 8]) * (
            1 + s.distance[:, None] ** 2 / 30)), [-12.0]),
    "Adamek, fitted (8)": (
        lambda p, s: np.stack([np.log(
            np.exp(p[0]) * s.area ** -np.exp(p[1]) / (90 - s.angle) + np.exp(p[2]))] * 2 + [np.log(
                np.exp(p[3]) * s.area ** -np.exp(p[4]) * np.exp(-s.angle / np.exp(p[5]))
                + np.exp(p[6]) / (90 - s.angle) + np.exp(p[7]))], axis=-1),
        [5.0, 0.7, -12.0, 5.0, 0.7, 3.0, -8.0, -10.0]),
}
"""Form -> ln(variance) of x, z and yaw of numbers and a sample, and where the fit begins."""


def main(path):
    for refinement in ("subpix", "apriltag"):
        a, b = (Sample(path, refinement, half) for half in (0, 1))
        model = error_model(a.results)
        found = model.at(b.rvec, b.tvec, b.ratio)
        known = found["known"].values
        print(f"{refinement}: {len(known):,} solved poses, {known.mean():.2%} known, "
              f"{b.flipped.mean():.2%} flipped")
        used = known & ~b.flipped
        left = (b.errors - found["bias"].values)[used]
        for name, some in (("ours, all six", list(range(6))), ("ours, x, z, yaw", PLANE)):
            root = np.linalg.cholesky(found["covariance"].values[used][:, some][:, :, some])
            line(name, np.linalg.solve(root, left[:, some, None])[..., 0], b, used)
        for name, (form, start) in FORMS.items():
            p = np.array(start)
            for _ in range(4):
                p = minimize(loss, p, (form, a), method="Nelder-Mead",
                             options={"maxiter": 400}).x
            line(name, b.errors[used][:, PLANE] * np.exp(-0.5 * form(p, b)[used]), b, used)
        chance, flipped = found["flip_probability"].values[known], b.flipped[known]
        for bins in (np.array_split(np.argsort(chance), 10), [
                np.flatnonzero((chance >= low) & (chance < high)) for low, high in zip(
                    [0, .01, .02, .05, .1, .15, .2, .3, .4, .5], [.01, .02, .05, .1, .15, .2, .3,
                     .4, .5, 1], strict=True)]):
            texts = []
            for part in bins:
                low, high = clopper_pearson(flipped[part].sum(), len(part))
                mean = chance[part].mean()
                texts.append(f"{mean:.4f} {'in' if low <= mean <= high else 'OUTSIDE'} "
                             f"[{low:.4f}, {high:.4f}]")
            print("  flips expected, interval seen: " + "; ".join(texts))


if __name__ == "__main__":
    main(*sys.argv[1:])
