"""What the accuracy bound and the solver from pixels cost, in this thread's own time.

    python -m tests.benchmarks photometric

Black 40, white 220, background 120, noise 2, tilts 0 to 75°, 640 x 480; medians over tilts.
"""

import time

import numpy as np

from benchmarks.tables import header, row
from sweep.evaluation.block import detections_for
from sweep.evaluation.opencv_threads import single_threaded
from sweep.evaluation.search import detections_of, scenes_at
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import DetectionStatus
from sweep.measure.likelihood import (
    BACKGROUND_MARGIN_PX,
    bound_of_scene,
    marker_view,
    noise_variance,
    state_of,
)
from sweep.measure.photometric import Photometric

SCENES = 120
SIDES = (20, 50, 100, 150)
TILTS = (0, 15, 30, 45, 60, 75)
QUICK = {"SCENES": 3, "SIDES": (20,), "TILTS": (0,)}
TEXT = """
[marker]
size_m = 0.05
[pose]
jitter_px = 0.5
azimuth_deg = { uniform = [0, 360] }
roll_deg = { uniform = [0, 360] }
side_px = SIDE
tilt_deg = TILT
[scene]
black = 40
white = 220
background = 120
noise_grey = 2
[detector]
cornerRefinementMethod = "subpix"
[axes]
trial = SCENES
"""


def best_ms(call, count, repeats=5):
    """Return the least time of some calls, a count of things in each."""
    call()
    spent = []
    for _ in range(repeats):
        begun = time.thread_time()
        call()
        spent.append(1e3 * (time.thread_time() - begun) / count)
    return min(spent)


def measured(side, tilt):
    """Return ms of the bound, of two starts and of four, a scene."""
    pipeline = Pipeline.from_text(
        TEXT.replace("SIDE", str(side)).replace("TILT", str(tilt)).replace("SCENES", str(SCENES)))
    batch = scenes_at(pipeline.experiment, [np.arange(SCENES)])
    scenes = batch.scenes
    box = batch.boxes[0] + BACKGROUND_MARGIN_PX * np.array([-1, -1, 1, 1])
    view = marker_view(
        scenes.targets[0], scenes.size_m[0], scenes.cameras.optics(0), box[:2], noise_variance(2.0)
    )
    state = state_of(scenes.rotation[0], scenes.translation[0], 0.0, scenes.levels[0])
    width, height = (box[2:] - box[:2]).tolist()
    image = np.zeros((height, width))
    found = detections_of(batch, np.ones((SCENES, 1), dtype=bool), [], keep=True)
    rows = np.flatnonzero(found[0].flags == DetectionStatus.detected)
    seen = detections_for(pipeline.experiment.estimators[0], batch, found[0], rows)
    return (
        best_ms(lambda: bound_of_scene(state, view, image, False), 1, 50),
        *(best_ms(lambda k=k: Photometric(k, spread_free=False)(seen), len(rows))
          for k in (False, True)),
    )


@single_threaded()
def main():
    """Print the table."""
    header("side, px", "bound, ms", "photometric, two starts, ms", "four starts, ms")
    for side in SIDES:
        each = np.median([measured(side, tilt) for tilt in TILTS], axis=0)
        row(side, *(f"{value:.3g}" for value in each))
