"""Boards: the kernel against a user's good loop, against its own bare calls, and its images alone.

    python tests/benchmarks/bench_board.py

One core, medians of paired runs, seconds of the processor: ratios count.
"""

import itertools
import statistics
import time

import cv2
import numpy as np

from sweep.evaluation.block import run_cells
from sweep.evaluation.opencv_threads import single_threaded
from sweep.evaluation.search import search_windows, visibility_flags, whole_frames
from sweep.measure.detectors import Detector, charuco_board
from sweep.measure.flags import DetectionStatus
from sweep.model.extent import marker_boxes
from sweep.model.renderers import render_all
from sweep.model.scene import build_scenes
from sweep.plan.grid import detector_settings, scene_values
from sweep.plan.pipeline import Pipeline

SIZES = ((640, 480), (4000, 3000))
POSES = {640: 60, 4000: 15}
REPEATS = 3
DISTANCES = ((0.4, 0.8), (0.8, 1.6), (1.6, 3.2))
DICTIONARY = cv2.aruco.DICT_5X5_50
MARKER_M, SQUARE_M = 0.03, 0.0375
PX_PER_M = 10 * 7 / MARKER_M
"""Pixels of the naive loop's bitmap: ten a module."""

BOARDS = {
    "grid of 7 x 5": 'kind = "grid"\nrows = 5\ncolumns = 7\ngap_m = 0.0075',
    "ChArUco of 10 x 7": 'kind = "charuco"\nsquares_x = 10\nsquares_y = 7\nsquare_m = 0.0375',
}
"""Boards of 35 markers of 30 mm."""

GRID = """
seed = 1
[camera]
width_px = {width}
height_px = {height}
fx_px = {focal}
[marker]
dictionary = "DICT_5X5_50"
size_m = 0.03
[board]
{board}
[pose]
distance_m = {{ uniform = [{near}, {far}] }}
tilt_deg = {{ uniform = [0, 60] }}
azimuth_deg = {{ uniform = [0, 360] }}
roll_deg = {{ uniform = [0, 360] }}
jitter_px = 20
[scene]
background = 255
[estimator]
solver = "iterative"
[axes]
trial = {poses}
"""


def pipeline_of(board, width, height, near, far, poses):
    return Pipeline.from_text(GRID.format(
        width=width, height=height, focal=4 / 4.8 * width, board=board, near=near, far=far,
        poses=poses,
    ))


def naive_loop(posed, charuco, board, bitmap, to_board, camera, frame):
    """A user's good loop: bitmap cached, detectors built once, whole frames, plain calls."""
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(DICTIONARY))
    for rotation, rvec, tvec in posed:
        to_frame = camera @ np.column_stack([rotation[:, :2], tvec]) @ to_board
        image = cv2.warpPerspective(
            bitmap, to_frame, frame, flags=cv2.INTER_LINEAR, borderValue=(255,)
        )
        corners, ids, _ = detector.detectMarkers(image)
        if ids is None:
            continue
        if charuco is not None:
            charuco.detectBoard(image, markerCorners=corners, markerIds=ids)
        objects, pixels = board.matchImagePoints(corners, ids)
        cv2.solvePnP(objects, pixels, camera, None, rvec.copy(), tvec.copy())


def naive_board(ours):
    """Return the board as OpenCV has it, its ChArUco detector or None, its bitmap and the map."""
    dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARY)
    board = cv2.aruco.Board(
        ours.corners_m.astype(np.float32), dictionary, np.array(ours.marker_ids)
    )
    low = ours.corners_m.reshape(-1, 3).min(axis=0)[:2] - SQUARE_M
    high = ours.corners_m.reshape(-1, 3).max(axis=0)[:2] + SQUARE_M
    size = np.round((high - low) * PX_PER_M).astype(int)
    # Pixel (0, 0) is the middle of the bitmap's top left pixel; y is up on the board.
    to_board = np.array([
        [1 / PX_PER_M, 0, low[0] + 0.5 / PX_PER_M], [0, -1 / PX_PER_M, high[1] - 0.5 / PX_PER_M],
        [0, 0, 1],
    ])
    bitmap = np.full(size[::-1], 255, np.uint8)
    if ours.chessboard is not None:
        charuco = charuco_board(ours)
        squares = ours.chessboard
        drawn = charuco.generateImage((
            round(squares.squares_x * SQUARE_M * PX_PER_M),
            round(squares.squares_y * SQUARE_M * PX_PER_M),
        ))
        top, left = (size[1] - drawn.shape[0]) // 2, (size[0] - drawn.shape[1]) // 2
        bitmap[top:top + drawn.shape[0], left:left + drawn.shape[1]] = drawn
        return board, cv2.aruco.CharucoDetector(charuco), bitmap, to_board
    side = round(MARKER_M * PX_PER_M)
    for number, corners in zip(ours.marker_ids, ours.corners_m, strict=True):
        left, top = round((corners[0, 0] - low[0]) * PX_PER_M), round(
            (high[1] - corners[0, 1]) * PX_PER_M
        )
        bitmap[top:top + side, left:left + side] = cv2.aruco.generateImageMarker(
            dictionary, number, side
        )
    return board, None, bitmap, to_board


def bare_calls(scenes, boxes, cut, rows, setting, charuco):
    """The calls of coverage and of OpenCV's detectors that the kernel makes, and their loop."""
    find = Detector(setting).find
    side = int(scenes.frame.max())
    decoded = 0
    for some in np.array_split(rows, max(len(rows) // 10, 1)):
        for image in render_all(scenes, some, boxes[some], cut[some]):
            corners, ids, _ = find(image, "DICT_5X5_50", side)
            decoded += len(corners)
            if charuco is not None and ids is not None:
                charuco.detectBoard(image, markerCorners=list(corners), markerIds=ids)
    return decoded / (35 * len(rows))


def solver_calls(scenes, printed, rows, camera):
    """Plain calls of the solver on all corners."""
    points = printed.corners_m.reshape(-1, 3)
    for row in rows:
        rvec = cv2.Rodrigues(scenes.rotation[row])[0]
        pixels = cv2.projectPoints(points, rvec, scenes.translation[row], camera, None)[0]
        cv2.solvePnP(points, pixels, camera, None)


def clock(function, *arguments):
    start = time.process_time()
    function(*arguments)
    return time.process_time() - start


def poses_table():
    print("| board | frame | window, share of the frame | markers found | naive ms a pose "
          "| sweep ms a pose | naive / sweep | sweep / bare calls |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for name, declared in BOARDS.items():
        for (width, height), (near, far) in itertools.product(SIZES, DISTANCES):
            poses = POSES[width]
            pipeline = pipeline_of(declared, width, height, near, far, poses)
            indices = [np.arange(poses)]
            values = scene_values(pipeline, indices)
            scenes = build_scenes(values, poses)
            setting = detector_settings(pipeline)[0]
            boxes = marker_boxes(scenes)
            cut = search_windows(scenes, boxes, setting, whole_frames(values, poses))
            rows = np.flatnonzero(visibility_flags(scenes) == DetectionStatus.not_run)
            share = np.mean(np.prod(cut[rows, 2:] - cut[rows, :2], axis=1)) / (width * height)
            camera, printed = scenes.cameras.matrix(0), values["board"].listed(1)[0]
            board, charuco, bitmap, to_board = naive_board(printed)
            posed = [
                (scenes.rotation[row], cv2.Rodrigues(scenes.rotation[row])[0],
                 scenes.translation[row]) for row in rows
            ]
            frame = width, height
            decoded = bare_calls(scenes, boxes, cut, rows, setting, charuco)
            naive, ours, ratios, bare = [], [], [], []
            for repeat in range(REPEATS + 1):
                a = clock(naive_loop, posed, charuco, board, bitmap, to_board, camera, frame)
                b = clock(run_cells, pipeline, indices)
                c = clock(bare_calls, scenes, boxes, cut, rows, setting, charuco)
                c += clock(solver_calls, scenes, printed, rows, camera)
                if repeat == 0:
                    continue
                naive.append(1e3 * a / poses)
                ours.append(1e3 * b / poses)
                ratios.append(a / b)
                bare.append(b / c)
            median = statistics.median
            print(f"| {name}, {near}-{far} m | {width} x {height} | {share:.2f} | {decoded:.2f} "
                  f"| {median(naive):.2f} | {median(ours):.2f} | {median(ratios):.1f} "
                  f"| {median(bare):.2f} |", flush=True)


def images_table():
    """One image of 35 markers against 35 images of a marker each, at the same poses."""
    print("\n| frame | distance | image / images of its markers one by one "
          "| 34 markers outside the frame / one |")
    print("| --- | --- | --- | --- |")
    for (width, height), (near, far) in itertools.product(SIZES, DISTANCES):
        poses = POSES[width]
        whole = pipeline_of(BOARDS["grid of 7 x 5"], width, height, near, far, poses)
        corners = scene_values(whole, [np.arange(1)])["board"].listed(1)[0].corners_m
        parts = []
        for k, each in enumerate(corners):
            x, y, _ = each.mean(axis=0)
            table = f'kind = "markers"\n[[board.markers]]\nmarker_id = {k}\nx_m = {x}\ny_m = {y}'
            parts.append(pipeline_of(table, width, height, near, far, poses))
        far_off = [
            f"[[board.markers]]\nmarker_id = {k}\nx_m = {100 * k}\ny_m = 0\n" for k in range(35)
        ]
        two, many = (
            pipeline_of(f'kind = "markers"\n{"".join(some)}', width, height, near, far, poses)
            for some in (far_off[:2], far_off)
        )
        indices = [np.arange(poses)]
        drawn = [_scenes(each, poses) for each in (whole, *parts)]
        ratios, outside = [], []
        for repeat in range(REPEATS + 1):
            whole_s, *part_s = (clock(_render, *each) for each in drawn)
            two_s, many_s = (clock(run_cells, each, indices) for each in (two, many))
            if repeat:
                ratios.append(whole_s / sum(part_s))
                outside.append(many_s / two_s)
        print(f"| {width} x {height} | {near}-{far} m | {statistics.median(ratios):.2f} "
              f"| {statistics.median(outside):.2f} |", flush=True)


def _scenes(pipeline, poses):
    """Return what :func:`_render` takes."""
    values = scene_values(pipeline, [np.arange(poses)])
    scenes = build_scenes(values, poses)
    boxes = marker_boxes(scenes)
    rows = np.flatnonzero(visibility_flags(scenes) == DetectionStatus.not_run)
    windows = np.column_stack([
        np.maximum(boxes[:, :2], 0), np.minimum(boxes[:, 2:], scenes.frame)
    ])
    return scenes, rows, boxes[rows], windows[rows]


def _render(scenes, rows, boxes, windows):
    for some in np.array_split(np.arange(len(rows)), max(len(rows) // 20, 1)):
        render_all(scenes, rows[some], boxes[some], windows[some])


@single_threaded()
def main():
    poses_table()
    images_table()


if __name__ == "__main__":
    main()
