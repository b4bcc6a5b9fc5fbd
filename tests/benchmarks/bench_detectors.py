"""All detectors on the same exact images: corners, offsets, misses, time.

    pip install '.[detectors]'
    python -m tests.benchmarks detectors

Frames of 640 x 480 px with one 36h11 marker, sides of 60 to 150 px, tilts to 45°; the second half
of the scenes is the point reflection of the first. Whole frames, one thread. STag has markers of
its own (HD21), in the same poses. Offsets come with their standard error over pairs of scenes; RMS
(of a corner's distance beside the mean offset) and the share that is found with 95 % intervals,
by a bootstrap over pairs, and Wilson's; times are medians. Each detector has a process of its own.
"""

import time

import cv2
import numpy as np

from benchmarks.tables import header, row
from sweep.analysis.estimator import wilson
from sweep.conformance.check import trial_pipeline
from sweep.evaluation.search import scenes_at
from sweep.isolation.child_process import Child, ChildDiedError
from sweep.measure.detectors import make_detector
from sweep.model.renderers import render_all

TAG, STAG = "DICT_APRILTAG_36h11", "STAG_HD21"
METHODS = {
    **{f"opencv {name}": ("opencv", TAG, (f"cornerRefinementMethod={name}",))
       for name in ("none", "contour", "subpix", "apriltag")},
    **{f"{name}, quad_decimate {decimate}": (name, TAG, (f"quad_decimate={decimate}",))
       for name in ("pupil-apriltags", "robotpy-apriltag", "pyapriltags") for decimate in (1, 2)},
    **{f"locus-tag {name}": ("locus-tag", TAG, (f"locus_profile={name}",))
       for name in ("standard", "high_accuracy")},
    "stag-python": ("stag-python", STAG, ()),
}
SCENES, NOISE_GREY = 1000, (0.0, 3.0)
QUICK = {"SCENES": 8, "NOISE_GREY": (0.0,), "METHODS": dict(list(METHODS.items())[:1])}


def searched(name, scenes, noise):
    """Return errors (scenes, 4, 2) px, NaN if missed, and seconds (scenes,)."""
    cv2.setNumThreads(1)
    detector, dictionary, chosen = METHODS[name]
    pipeline = trial_pipeline(
        "detector", detector, dictionary, (*chosen, f"noise_grey={noise}"), ".", count=scenes)
    rows, frame = np.arange(scenes), np.tile([0, 0, 640, 480], (scenes, 1))
    batch = scenes_at(pipeline.experiment, [rows])
    shown, images = batch.scenes, render_all(batch.scenes, rows, batch.boxes, frame)
    find = make_detector(pipeline.experiment.detectors[0])
    find(images[0], dictionary, 640)  # what is made once is made
    errors, seconds = np.full((scenes, 4, 2), np.nan), np.full(scenes, np.nan)
    for k, image in enumerate(images):
        begun = time.perf_counter()
        corners, ids, _ = find(image, dictionary, 640)
        seconds[k] = time.perf_counter() - begun
        right = [] if ids is None else [
            np.reshape(quad, (4, 2)) - shown.corners_px[k]
            for quad, number in zip(corners, np.ravel(ids), strict=True)
            if number == shown.marker_id[k]
        ]
        if right:
            errors[k] = min(right, key=lambda error: (error**2).sum())
    return errors, seconds


def line(errors, seconds, rng):
    """Return the cells of a detector."""
    half = len(errors) // 2
    found = ~np.isnan(errors).any(axis=(1, 2))
    pairs = errors.reshape(2, half, 4, 2)[:, found.reshape(2, half).all(axis=0)]
    means = pairs.mean(axis=(0, 2))
    offset, spread = means.mean(axis=0), means.std(axis=0, ddof=1) / np.sqrt(len(means))
    squares = ((pairs - offset) ** 2).sum(axis=3).mean(axis=(0, 2))
    draws = rng.integers(len(squares), size=(2000, len(squares)))
    low, high = np.sqrt(np.quantile(squares[draws].mean(axis=1), [0.025, 0.975]))
    rate_low, rate_high = wilson(int(found.sum()), len(found))
    return (
        f"{np.sqrt(squares.mean()):.3f} ({low:.3f}-{high:.3f})",
        f"{offset[0]:+.3f} ± {spread[0]:.3f}, {offset[1]:+.3f} ± {spread[1]:.3f}",
        f"{found.mean():.3f} ({float(rate_low):.3f}-{float(rate_high):.3f})",
        f"{1e3 * np.median(seconds):.1f}",
    )


def main():
    for noise in NOISE_GREY:
        print(f"\n{SCENES} scenes, noise of {noise:g} grey levels\n")
        header("detector", "RMS, px", "mean offset x, y, px", "found", "ms")
        for name in METHODS:
            with Child(__name__) as child:
                try:
                    errors, seconds = child.call(searched, name, SCENES, noise, limit_s=3600)
                except ChildDiedError as death:
                    row(name, str(death))
                else:
                    row(name, *line(errors, seconds, np.random.default_rng(4)))
