"""Time a marker's image by each renderer, interleaved, and print medians and their ratios.

Run as ``python tests/benchmarks/bench_renderers.py``: one core, about two minutes.
"""

import dataclasses
import time

import cv2
import numpy as np
from tables import header, row

from sweep.model.camera import Camera
from sweep.model.exposure import marker_boxes
from sweep.model.marker import Marker
from sweep.model.pose import Pose
from sweep.model.renderers import render
from sweep.model.scene import Scene, build_scenes

SIDES = (8, 20, 50, 100, 200, 400, 600)
LENSES = ((), (-0.3, 0.1, 0.0, 0.0))
RENDERERS = ("exact", "warp", "supersample-8")
SCENES = 12
FOCAL_PX = 1000.0


def scenes_of(side_px, distortion, renderer):
    """Return front-facing poses of one size, wholly in the frame, the same for all renderers."""
    rng = np.random.default_rng(side_px)
    values = {
        field.name: field.default
        for section in (Camera, Marker, Pose, Scene)
        for field in dataclasses.fields(section)
    }
    return build_scenes(
        values | {
            "width_px": 1280, "height_px": 1280, "fx_px": FOCAL_PX, "distortion": distortion,
            "renderer": renderer, "distance_m": FOCAL_PX * values["size_m"] / side_px,
            "tilt_deg": rng.uniform(0, 60, SCENES), "azimuth_deg": rng.uniform(0, 360, SCENES),
            "roll_deg": rng.uniform(0, 360, SCENES), "shift_u_px": rng.uniform(-5, 5, SCENES),
            "shift_v_px": rng.uniform(-5, 5, SCENES), "marker_id": np.arange(SCENES),
        },
        SCENES,
    )


def repetitions(renderer, side_px, distortion):
    """Return how often each renderer draws all scenes, and how many of them."""
    if renderer != "supersample-8":
        return 60, SCENES
    if distortion:
        # A lens costs each of the 64 samples of a pixel an iteration: seconds at 200 px.
        return (3, SCENES) if side_px <= 20 else (1, 3 if side_px <= 100 else 1)
    return (5, SCENES) if side_px <= 100 else (1, 4)


def medians(side_px, distortion):
    """Return the median seconds an image of each renderer, all drawn in turn."""
    names = [name for name in RENDERERS
             if not (name == "supersample-8" and distortion and side_px > 200)]
    built = {name: scenes_of(side_px, distortion, name) for name in names}
    boxes = {name: marker_boxes(built[name]) for name in names}
    seconds = {name: [] for name in names}
    for turn in range(60):
        for k in range(SCENES):
            for name in names:
                turns, rows = repetitions(name, side_px, distortion)
                if turn >= turns or k >= rows:
                    continue
                box = boxes[name][k]
                window = tuple(box.tolist())
                start = time.perf_counter()
                render(built[name], k, box, window)
                seconds[name].append(time.perf_counter() - start)
    return {name: float(np.median(taken)) for name, taken in seconds.items()}


def main():
    """Print one table: milliseconds an image, and the ratios that the README quotes."""
    cv2.setNumThreads(1)
    for distortion in LENSES:
        medians(8, distortion)  # compile, and wake the processor
    print(f"OpenCV {cv2.__version__}, one thread; medians in ms an image")
    header("side, px", "lens", "exact", "warp", "supersample-8", "exact / warp",
           "supersample-8 / exact")
    for distortion in LENSES:
        for side_px in SIDES:
            taken = medians(side_px, distortion)
            exact, warp = 1e3 * taken["exact"], 1e3 * taken["warp"]
            sampled = 1e3 * taken.get("supersample-8", np.nan)
            row(side_px, "yes" if distortion else "no", f"{exact:.4f}", f"{warp:.4f}",
                f"{sampled:.3f}", f"{exact / warp:.2f}", f"{sampled / exact:.1f}")


if __name__ == "__main__":
    main()
