"""The kernel against a user's good loop, and against the bare calls that it makes.

    python tests/benchmarks/bench_kernel.py

One core, medians of paired runs: ratios within one run, for machines are noisy.
"""

import statistics
import time
from unittest import mock

import cv2
import numpy as np

from sweep.evaluation.block import run_cells
from sweep.evaluation.opencv_threads import single_threaded
from sweep.evaluation.search import search_windows, visibility_flags, whole_frames
from sweep.measure.detectors import Detector
from sweep.measure.flags import DetectionStatus
from sweep.model import coverage as drawing
from sweep.model.extent import marker_boxes
from sweep.model.renderers import render_all
from sweep.model.scene import build_scenes
from sweep.plan.grid import detector_settings, scene_values
from sweep.plan.pipeline import Pipeline

SIZES = ((640, 480), (1920, 1080), (4000, 3000))
POSES = {640: 1000, 1920: 400, 4000: 150}
REPEATS = 5
BLOCK = 3000
"""Poses of a block: about a second's work."""

GRID = """
seed = 1
[camera]
width_px = {width}
height_px = {height}
fx_px = {focal}
[marker]
dictionary = "DICT_5X5_50"
size_m = 0.04
[pose]
distance_m = {{{{ uniform = [0.2, 2.0] }}}}
tilt_deg = {{{{ uniform = [0, 70] }}}}
azimuth_deg = {{{{ uniform = [0, 360] }}}}
roll_deg = {{{{ uniform = [0, 360] }}}}
bearing_x_deg = {{{{ uniform = [-15, 15] }}}}
bearing_y_deg = {{{{ uniform = [-15, 15] }}}}
[scene]
background = 255
[axes]
trial = {{poses}}
"""


def naive_loop(scenes, bitmaps, camera, frame):
    """A user's good loop: bitmaps cached, one detector, whole frames, plain calls."""
    detector = cv2.aruco.ArucoDetector(
        cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_50), cv2.aruco.DetectorParameters()
    )
    side = 0.04 / 2
    objects = np.array(
        [[-side, side, 0], [side, side, 0], [side, -side, 0], [-side, -side, 0]], np.float32
    )
    bitmap, source = bitmaps
    found = 0
    for rvec, tvec in scenes:
        corners = cv2.projectPoints(objects, rvec, tvec, camera, None)[0].reshape(4, 2)
        transform = cv2.getPerspectiveTransform(source, corners.astype(np.float32))
        image = cv2.warpPerspective(
            bitmap, transform, frame, flags=cv2.INTER_LINEAR, borderValue=(255,)
        )
        quads, ids, _ = detector.detectMarkers(image)
        if ids is not None:
            found += 1
            cv2.solvePnP(objects, quads[0], camera, None, flags=cv2.SOLVEPNP_IPPE_SQUARE)
    return found


def bare_calls(scenes, boxes, cut, rows, setting):
    """The coverage and detection calls that the kernel makes, and nothing else but their loop."""
    find = Detector(setting).find
    side = int(scenes.frame.max())
    for some in np.array_split(rows, max(len(rows) // 100, 1)):
        for image in render_all(scenes, some, boxes[some], cut[some]):
            find(image, "DICT_5X5_50", side)


def beside(text):
    """Seconds that a block of the kernel takes beside its calls, answered from a record.

    Drawing does nothing, searches and solutions are those of a run before; what giving the
    answers takes is measured too, and taken off.
    """
    pipeline, indices = Pipeline.from_text(text), [np.arange(BLOCK)]
    real, answers, solutions = cv2.aruco.ArucoDetector, [], []
    told = {"search": 0, "solve": 0}

    class Recorder:
        def __init__(self, *arguments):
            self.detector = real(*arguments)

        def detectMarkers(self, image):  # noqa: N802  (OpenCV's name)
            answers.append(self.detector.detectMarkers(image))
            return answers[-1]

    class Player:
        def __init__(self, *arguments):
            pass

        def detectMarkers(self, image):  # noqa: N802, ARG002  (OpenCV's name and argument)
            told["search"] += 1
            return answers[told["search"] - 1]

    solve = cv2.solvePnPGeneric

    def recorded(*arguments, **named):
        solutions.append(solve(*arguments, **named))
        return solutions[-1]

    def played(*arguments, **named):  # noqa: ARG001  (in place of OpenCV's)
        told["solve"] += 1
        return solutions[told["solve"] - 1]

    def answered():
        for name in told:
            told[name] = 0
        player = Player()
        for _ in answers:
            player.detectMarkers(None)
        for _ in solutions:
            played(None, None, None, None, flags=0)
        for name in told:
            told[name] = 0

    with mock.patch.object(cv2, "solvePnPGeneric", recorded), \
            mock.patch.object(cv2.aruco, "ArucoDetector", Recorder):
        run_cells(pipeline, indices)
    spent = []
    with mock.patch.object(cv2, "solvePnPGeneric", played), \
            mock.patch.object(cv2.aruco, "ArucoDetector", Player), \
            mock.patch.object(drawing, "draw_greys"):
        for _ in range(REPEATS):
            answering = clock(answered)
            spent.append(clock(run_cells, pipeline, indices) - answering)
    return statistics.median(spent)


def clock(function, *arguments):
    start = time.perf_counter()
    function(*arguments)
    return time.perf_counter() - start


@single_threaded()
def main():
    print("| frame | naive ms a pose | sweep ms a pose | naive / sweep | sweep / bare calls "
          "| µs a pose beside them |")
    print("| --- | --- | --- | --- | --- | --- |")
    for width, height in SIZES:
        poses = POSES[width]
        focal = 4 / 4.8 * width
        text = GRID.format(width=width, height=height, focal=focal)
        pipeline = Pipeline.from_text(text.format(poses=poses))
        indices = [np.arange(poses)]
        values = scene_values(pipeline, indices)
        scenes = build_scenes(values, poses)
        setting = detector_settings(pipeline)[0]
        boxes = marker_boxes(scenes)
        cut = search_windows(scenes, boxes, setting, whole_frames(values, poses))
        rows = np.flatnonzero(visibility_flags(scenes) == DetectionStatus.not_run)
        camera = scenes.cameras.matrix(0)
        marker = cv2.aruco.generateImageMarker(
            cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_50), 0, 70
        )
        bitmap = cv2.copyMakeBorder(marker, 10, 10, 10, 10, cv2.BORDER_CONSTANT, value=255)
        source = np.array([[9.5, 9.5], [79.5, 9.5], [79.5, 79.5], [9.5, 79.5]], np.float32)
        posed = [
            (cv2.Rodrigues(scenes.rotation[row])[0], scenes.translation[row]) for row in rows
        ]
        naive, ours, ratios, bare = [], [], [], []
        for repeat in range(REPEATS + 1):
            a = clock(naive_loop, posed, (bitmap, source), camera, (width, height))
            b = clock(run_cells, pipeline, indices)
            result_s = clock(bare_calls, scenes, boxes, cut, rows, setting)
            solve_s = sum(run_cells(pipeline, indices).seconds["estimation"])
            if repeat == 0:
                continue
            naive.append(1e3 * a / poses)
            ours.append(1e3 * b / poses)
            ratios.append(a / b)
            bare.append(b / (result_s + solve_s))
        median = statistics.median
        print(
            f"| {width} x {height} | {median(naive):.2f} | {median(ours):.3f} "
            f"| {median(ratios):.1f} | {median(bare):.2f} "
            f"| {1e6 * beside(text.format(poses=BLOCK)) / BLOCK:.1f} |", flush=True,
        )


if __name__ == "__main__":
    main()
