"""Time of a pose by ``photometric_real`` on boards: levels and blur alone, and the tone curve.

python -m tests.benchmarks photograph
"""

import dataclasses
import sys
from pathlib import Path

import cv2
import numpy as np
from bench_photometric import best_ms

sys.path.insert(0, str(Path(__file__).parents[1]))

from support.board_scenes import board_scene
from support.photographs import drawn_pose, photograph
from sweep.evaluation.opencv_threads import single_threaded
from sweep.measure.estimation import Detections
from sweep.measure.flags import EstimateStatus
from sweep.measure.photometric import PhotometricReal
from sweep.measure.surroundings import BoardMarker
from sweep.model.board import single_marker
from sweep.model.board_kinds import Charuco

BOARD = Charuco(
    dictionary="DICT_4X4_50", squares_x=6, squares_y=6, square_m=0.04, marker_m=0.03,
).board()
EFFECTS = {"blur_px": 0.7, "noise_grey": 2.0}
WEBCAM = EFFECTS | {
    "sharpening": 0.8, "sharpening_px": 1.0, "tone_gamma": 0.9, "illumination_gradient": 0.2,
}
PHOTOGRAPHS = 6
SIDES = (20, 50, 100)


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
    found = Detections.of_markers(
        np.array(corners), cameras, np.full(count, 0.03), np.full(count, 2.0), np.zeros(count),
        [single_marker(BOARD.dictionary, BOARD.marker_ids[k % markers], 1.0)
         for k in range(count)], images,
        np.zeros((count, 2), dtype=np.int64),
    )
    on_board = [BoardMarker(BOARD, k % markers) for k in range(count)]
    return dataclasses.replace(found, on_board=on_board)


@single_threaded()
def main():
    """Print the table."""
    print("| side, px | levels and blur, ms | tone and other effects too, ms | solved, % |")
    print("| --- | --- | --- | --- |")
    for side in SIDES:
        row, solved = [], []
        for every, effects in ((False, EFFECTS), (True, WEBCAM)):
            found = detections(side, effects)
            solver = PhotometricReal(refined=False, spread_free=True, tone=every)
            solved.append(np.mean(solver(found).status == EstimateStatus.solved))
            row.append(best_ms(lambda s=solver, f=found: s(f), len(found.corners)))
        print(f"| {side} | {row[0]:.3g} | {row[1]:.3g} | {100 * min(solved):.0f} |", flush=True)


if __name__ == "__main__":
    main()
