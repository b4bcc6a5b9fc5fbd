"""What the accuracy bound and the solvers from pixels cost, in this thread's own time.

    python tests/benchmarks/bench_photometric.py

First `photometric`, then `photometric_real` on boards, with levels and blur alone and with all
nuisances. The first: black 40, white 220, background 120, noise 2, tilts 0 to 75°, 640 x 480;
medians over tilts.
"""

import dataclasses
import sys
import time
from pathlib import Path

import cv2
import numpy as np
from tables import header, row

sys.path.insert(0, str(Path(__file__).parents[1]))

from support.board_scenes import board_scene
from support.photographs import drawn_pose, photograph
from support.solving import of_markers
from sweep.evaluation.block import detections_for
from sweep.evaluation.opencv_threads import single_threaded
from sweep.evaluation.search import detections_of, scenes_at
from sweep.experiment.pipeline import Pipeline
from sweep.measure.bound import bound_of_scene
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.measure.likelihood import BACKGROUND_MARGIN_PX, marker_view, noise_variance, state_of
from sweep.measure.photometric import Photometric, PhotometricReal
from sweep.measure.surroundings import BoardMarker
from sweep.model.board import single_marker
from sweep.model.board_kinds import Charuco

SCENES = 120
SIDES = (20, 50, 100, 150)
TILTS = (0, 15, 30, 45, 60, 75)
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
    found, _ = detections_of(batch, np.ones((SCENES, 1), dtype=bool), [], keep=True)
    rows = np.flatnonzero(found[0].flags == DetectionStatus.detected)
    seen = detections_for(pipeline.experiment.estimators[0], batch, found[0], rows)
    return (
        best_ms(lambda: bound_of_scene(state, view, image, False), 1, 50),
        *(best_ms(lambda k=k: Photometric(k, spread_free=False)(seen), len(rows))
          for k in (False, True)),
    )


BOARD = Charuco(
    dictionary="DICT_4X4_50", squares_x=6, squares_y=6, square_m=0.04, marker_m=0.03,
).board()
EFFECTS = {"blur_px": 0.7, "noise_grey": 2.0}
WEBCAM = EFFECTS | {
    "sharpening": 0.8, "sharpening_px": 1.0, "tone_gamma": 0.9, "illumination_gradient": 0.2,
}
PHOTOGRAPHS = 6
REAL_SIDES = (20, 50, 100)


def detections(side, effects):
    """Return detections of all markers in some photographs, their corners wrong by 0.3 px."""
    width = round(side / 0.03 * 0.24 * 1.7)
    camera = {"width_px": width, "height_px": width, "fx_px": 1.6 * width}
    rng = np.random.default_rng(0)
    corners, images = [], []
    for number in range(PHOTOGRAPHS):
        taken = photograph(BOARD, camera, drawn_pose(rng, BOARD, camera, 0.6), effects, number)
        pose, f, c = taken.pose, 1.6 * width, (width - 1) / 2
        matrix = np.array([[f, 0, c], [0, f, c], [0, 0, 1]])
        for each in BOARD.corners_m:
            pixels = cv2.projectPoints(
                each, cv2.Rodrigues(pose.rotation)[0], pose.translation, matrix, None
            )[0].reshape(4, 2)
            corners.append(pixels + rng.normal(0, 0.3, (4, 2)))
            images.append(taken.image)
    count, markers = len(corners), len(BOARD)
    cameras = board_scene(BOARD, camera, pose).cameras.take(np.zeros(count, dtype=int))
    found = of_markers(
        np.array(corners), cameras, np.full(count, 0.03), np.full(count, 2.0),
        [single_marker(BOARD.dictionary, BOARD.marker_ids[k % markers], 1.0)
         for k in range(count)], images,
    )
    return dataclasses.replace(
        found, on_board=[BoardMarker(BOARD, k % markers) for k in range(count)])


def of_photographs(side):
    """Return a row of the table of boards in photographs."""
    spent, solved = [], []
    for every, effects in ((False, EFFECTS), (True, WEBCAM)):
        found = detections(side, effects)
        solver = PhotometricReal(refined=False, spread_free=True, tone=every)
        solved.append(np.mean(solver(found).status == EstimateStatus.solved))
        spent.append(best_ms(lambda s=solver, f=found: s(f), len(found.corners)))
    return side, *(f"{value:.3g}" for value in spent), f"{100 * min(solved):.0f}"


@single_threaded()
def main():
    """Print the tables."""
    header("side, px", "bound, ms", "photometric, two starts, ms", "four starts, ms")
    for side in SIDES:
        each = np.median([measured(side, tilt) for tilt in TILTS], axis=0)
        row(side, *(f"{value:.3g}" for value in each))
    print()
    header("side, px", "levels and blur, ms", "tone and other effects too, ms", "solved, %")
    for side in REAL_SIDES:
        row(*of_photographs(side))


if __name__ == "__main__":
    main()
