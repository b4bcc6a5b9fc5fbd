"""Time a marker's image by each renderer, interleaved, and print medians and their ratios.

    python -m tests.benchmarks renderers

One core, about two minutes.
"""

import time

import cv2
import numpy as np

from benchmarks.tables import header, row
from support.exact_image import values
from sweep.model.exposure import marker_boxes
from sweep.model.renderers import render
from sweep.model.scene import build_scenes

SIDES = (8, 20, 50, 100, 200, 400, 600)
LENSES = ((), (-0.3, 0.1, 0.0, 0.0))
RENDERERS = ("exact", "warp", "supersample-8")
SCENES = 12
REPEATS = 60
BUDGET_S = 2.0
"""A renderer that took so long at a size is left out of further turns: supersampling by a lens."""

QUICK = {"SIDES": (8,), "LENSES": ((),), "SCENES": 2, "REPEATS": 2}


def scenes_of(side_px, distortion, renderer):
    """Return front-facing poses of one size, wholly in the frame, the same for all renderers."""
    rng = np.random.default_rng(side_px)
    return build_scenes(values(
        width_px=1280, height_px=1280, fx_px=1000.0, distortion=distortion, renderer=renderer,
        side_px=side_px, tilt_deg=rng.uniform(0, 60, SCENES),
        azimuth_deg=rng.uniform(0, 360, SCENES), roll_deg=rng.uniform(0, 360, SCENES),
        shift_u_px=rng.uniform(-5, 5, SCENES), shift_v_px=rng.uniform(-5, 5, SCENES),
        marker_id=np.arange(SCENES),
    ), SCENES)


def medians(side_px, distortion):
    """Return the median ms an image of each renderer, all drawn in turn."""
    built = {name: scenes_of(side_px, distortion, name) for name in RENDERERS}
    boxes = {name: marker_boxes(scenes) for name, scenes in built.items()}
    seconds = {name: [] for name in RENDERERS}
    for turn in range(REPEATS * SCENES):
        k = turn % SCENES
        for name, spent in seconds.items():
            if sum(spent) < BUDGET_S:
                box = boxes[name][k]
                start = time.perf_counter()
                render(built[name], k, box, tuple(box.tolist()))
                spent.append(time.perf_counter() - start)
    return [1e3 * float(np.median(spent)) for spent in seconds.values()]


def main():
    """Print one table: milliseconds an image, and the ratios that the README quotes."""
    cv2.setNumThreads(1)
    for distortion in LENSES:
        medians(SIDES[0], distortion)  # compile, and wake the processor
    print(f"OpenCV {cv2.__version__}, one thread; medians in ms an image")
    header("side, px", "lens", *RENDERERS, "exact / warp", "supersample-8 / exact")
    for distortion in LENSES:
        for side_px in SIDES:
            exact, warp, sampled = medians(side_px, distortion)
            row(side_px, "yes" if distortion else "no", f"{exact:.4f}", f"{warp:.4f}",
                f"{sampled:.3f}", f"{exact / warp:.2f}", f"{sampled / exact:.1f}")
