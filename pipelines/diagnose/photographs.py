"""Judge the covariance of one detection on photographs: errors that no simulation has made.

    python pipelines/diagnose/photographs.py PHOTOGRAPHS.zarr SCENE.toml|TWINS.zarr [REPEATS]

PHOTOGRAPHS.zarr is a store of `sweep photos` with one refinement, SCENE.toml the scene that
`sweep fit` found for them, TWINS.zarr a store of `sweep.twins`. The photographs' markers are
simulated at their poses, REPEATS times, and the model is made of these. It judges the photographs
as it is, and each photograph widened by all others. Errors are divided by the covariance of the
detection and of the photographs' own truth (`truth_std`).
"""

import itertools
import sys

import numpy as np
import xarray as xr

import sweep
from sweep.analysis.dataset import viewing_angle_of
from sweep.analysis.estimator import clopper_pearson
from sweep.diagnosis.detection import judged, widened

CHANCES = (0.0, 0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 1.0)
LIMIT = 0.1
OFF = 1.276
"""Factor of all six variances of which the divergence is `LIMIT`: 3 (f - 1 - ln f)."""

DRAWS = 1000


def divergence(whitened):
    """Return the KL divergence of whitened errors (..., n, 6) from the expected distribution."""
    mean = whitened.mean(axis=-2)
    left = whitened - mean[..., None, :]
    s = left.swapaxes(-1, -2) @ left / (left.shape[-2] - 1)
    return 0.5 * (np.trace(s, axis1=-2, axis2=-1) - 6 - np.linalg.slogdet(s)[1]
                  + (mean**2).sum(axis=-1))


def shared_part(whitened, photograph):
    """Return the correlation of errors (n, 6) within a photograph."""
    sums, pairs = 0.0, 0
    for one in np.unique(photograph):
        own = whitened[photograph == one] / whitened.std(axis=0)
        sums += (own.sum(axis=0) ** 2 - (own**2).sum(axis=0)).sum()
        pairs += 6 * len(own) * (len(own) - 1)
    return max(sums / pairs, 0.0)


def by_chance(whitened, photograph, times=1, draws=DRAWS):
    """Return divergences (draws,) of a perfect covariance and of one that is `LIMIT` off.

    At ``times`` as many photographs as there are, with the same poses and correlation in each.
    """
    rng = np.random.default_rng(0)
    _, photograph = np.unique(photograph, return_inverse=True)
    part, count = shared_part(whitened, photograph), photograph.max() + 1
    photograph = np.concatenate([photograph + k * count for k in range(times)])
    shared = rng.normal(size=(draws, times * count, 6))[:, photograph]
    errors = np.sqrt(part) * shared + np.sqrt(1 - part) * rng.normal(size=shared.shape)
    return divergence(errors), divergence(np.sqrt(OFF) * errors)


def deciding(whitened, photograph):
    """Return in words how many photographs would decide, up to 16 times as many.

    There 95 % of a perfect covariance's divergences are below 95 % of one's that is `LIMIT` off.
    """
    for times in range(1, 17):
        perfect, off = by_chance(whitened, photograph, times, 200)
        if np.quantile(perfect, 0.95) < np.quantile(off, 0.05):
            return f"{times * len(np.unique(photograph))}"
    return f"more than {times * len(np.unique(photograph))}"


def print_divergences(found):
    """Print the divergence of all errors and of halves by distance and angle, and the verdict."""
    found = found.dropna("pose", subset=["whitened"])
    distance = np.linalg.norm(found["tvec_m"], axis=1)
    angle = viewing_angle_of(found["rvec"].values, found["tvec_m"].values)
    bins = {"all": np.ones(len(distance), bool)}
    for name, values, unit in (("distance", distance, "m"), ("angle", angle, "degrees")):
        middle = np.median(values)
        bins[f"{name} to {middle:.3g} {unit}"] = values <= middle
        bins[f"{name} beyond"] = values > middle
    for name, inside in bins.items():
        whitened, photograph = (found[each].values[inside] for each in ("whitened", "photograph"))
        kl, (perfect, off) = divergence(whitened), by_chance(whitened, photograph)
        low, high = np.quantile(off, [0.05, 0.95])
        verdict = "within" if kl < low else "beyond" if kl > high else (
            f"not decided, {deciding(whitened, photograph)} such photographs would: within")
        print(f"    {name}: {len(whitened)} poses in {len(np.unique(photograph))} photographs, "
              f"mean d2 {(whitened**2).sum(axis=1).mean():.2f}, KL {kl:.3f}; of a perfect "
              f"covariance {np.median(perfect):.3f} (95 %: to {np.quantile(perfect, 0.95):.3f}), "
              f"of one {LIMIT} off {low:.3f} to {high:.3f}: {verdict} {LIMIT}")


def main(path, scene, repeats="8"):
    """Print squared errors over variances, divergences, and flips expected and seen."""
    results = sweep.open(path).squeeze(drop=True).load()
    simulated = sweep.open(scene) if scene.endswith(".zarr") else sweep.twins(
        path, scene, repeats=int(repeats))
    model = sweep.error_model(simulated.squeeze(drop=True).load())
    count = results.sizes["trial"]
    parts = {"as simulated": [], "widened by the other photographs": []}
    for k in range(count):
        others = results.isel(trial=[j for j in range(count) if j != k])
        for of, each in zip((model, widened(model, others)), parts.values(), strict=True):
            said = judged(of, results.isel(trial=[k]))
            each.append(said.assign(photograph=("pose", np.full(said.sizes["pose"], k))))
    for name, part in parts.items():
        found = xr.concat(part, "pose")
        squares = found["whitened"].dropna("pose").values ** 2
        print(f"{name}: of {found.sizes['pose']} solved poses {found.known.values.sum()} known, "
              f"{found.flipped.values.sum()} flipped; mean squared errors along and about the tilt,"
              f" across and the line of sight {np.round(squares.mean(axis=0), 2)} of 1")
        print_divergences(found)
    chance, known, flipped = (
        found[name].values for name in ("flip_probability", "known", "flipped"))
    for low, high in itertools.pairwise(CHANCES):
        part = known & (chance >= low) & (chance < high)
        if part.any():
            ends = clopper_pearson(flipped[part].sum(), part.sum())
            print(f"  flips of {part.sum()} expected {chance[part].mean():.3f}, seen "
                  f"{flipped[part].mean():.3f} ({ends[0]:.3f} to {ends[1]:.3f})")


if __name__ == "__main__":
    main(*sys.argv[1:])
