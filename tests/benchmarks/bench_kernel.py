"""The kernel against a user's good loop, and against the bare calls that it makes.

    python tests/benchmarks/bench_kernel.py [markers] [boards]

Single markers and boards; both if none is named. One core, medians of
paired runs, seconds of the processor: ratios count.
"""

import itertools
import statistics
import sys
import time

import cv2
import numpy as np
from tables import header, row

from sweep.evaluation.block import run_cells
from sweep.evaluation.opencv_threads import single_threaded
from sweep.evaluation.search import scenes_at, searched_windows
from sweep.experiment.pipeline import Pipeline
from sweep.measure.detectors import Detector, charuco_board
from sweep.model.renderers import render_all

SIZES = ((640, 480), (1920, 1080), (4000, 3000))
POSES = {640: 1000, 1920: 400, 4000: 150}
REPEATS = 5
DICTIONARY = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_50)

MARKER = """
seed = 1
[camera]
width_px = {width}
height_px = {height}
fx_px = {focal}
[marker]
dictionary = "DICT_5X5_50"
size_m = 0.04
[pose]
distance_m = {{ uniform = [0.2, 2.0] }}
tilt_deg = {{ uniform = [0, 70] }}
azimuth_deg = {{ uniform = [0, 360] }}
roll_deg = {{ uniform = [0, 360] }}
bearing_x_deg = {{ uniform = [-15, 15] }}
bearing_y_deg = {{ uniform = [-15, 15] }}
[scene]
background = 255
[axes]
trial = {poses}
"""

BOARD_SIZES = ((640, 480), (4000, 3000))
BOARD_POSES = {640: 60, 4000: 15}
DISTANCES = ((0.4, 0.8), (0.8, 1.6), (1.6, 3.2))
MARKER_M, SQUARE_M = 0.03, 0.0375
PX_PER_M = 10 * 7 / MARKER_M
"""Pixels of the naive loop's bitmap: ten a module."""

BOARDS = {
    "grid of 7 x 5": 'kind = "grid"\nrows = 5\ncolumns = 7\ngap_m = 0.0075',
    "ChArUco of 10 x 7": 'kind = "charuco"\nsquares_x = 10\nsquares_y = 7\nsquare_m = 0.0375',
}
"""Boards of 35 markers of 30 mm."""

BOARD = """
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


class Block:
    """A pipeline's trials: their values and scenes, and where visible ones are searched."""

    def __init__(self, text, width, height, poses, **given):
        self.pipeline = Pipeline.from_text(text.format(
            width=width, height=height, focal=4 / 4.8 * width, poses=poses, **given))
        self.poses, self.indices = poses, [np.arange(poses)]
        batch = scenes_at(self.pipeline.experiment, self.indices)
        self.values, self.scenes, self.boxes = batch.values, batch.scenes, batch.boxes
        self.rows = np.flatnonzero(batch.visible)
        self.setting = self.pipeline.experiment.detectors[0]
        (self.cut,) = searched_windows(batch)
        self.camera = self.scenes.cameras.matrix(0)
        self.posed = [
            (cv2.Rodrigues(self.scenes.rotation[k])[0], self.scenes.translation[k])
            for k in self.rows
        ]

    def run(self):
        return run_cells(self.pipeline.experiment, self.indices)

    def images(self, windows, a_time=100):
        """Yield the images of the visible scenes."""
        for some in np.array_split(self.rows, max(len(self.rows) // a_time, 1)):
            yield from render_all(self.scenes, some, self.boxes[some], windows[some])

    def bare_calls(self, charuco=None):
        """The coverage and detection calls of the kernel, and their loop; markers decoded."""
        find, side = Detector(self.setting).find, int(self.scenes.frame.max())
        decoded = 0
        for image in self.images(self.cut):
            corners, ids, _ = find(image, "DICT_5X5_50", side)
            decoded += len(corners)
            if charuco is not None and ids is not None:
                charuco.detectBoard(image, markerCorners=list(corners), markerIds=ids)
        return decoded


def clock(function, *arguments):
    start = time.process_time()
    function(*arguments)
    return time.process_time() - start


def compared(block, bare, *loops):
    """Return cells: ms a pose of each loop and of the kernel, ratios to it, kernel over bare."""
    rows = []
    for _ in range(REPEATS + 1):  # the first wakes the processor
        times, ours, least = [clock(loop) for loop in loops], clock(block.run), clock(bare)
        rows.append((*(1e3 * each / block.poses for each in (*times, ours)),
                     *(each / ours for each in times), ours / least))
    medians = list(map(statistics.median, zip(*rows[1:], strict=True)))
    count = len(loops)
    return [*(f"{each:.2f}" for each in medians[:count]), f"{medians[count]:.3f}",
            *(f"{each:.1f}" for each in medians[count + 1:-1]), f"{medians[-1]:.2f}"]


def square_points(side):
    half = side / 2
    return np.array(
        [[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]], np.float32)


def marker_loop(block, margin_px=None):
    """Return a user's good loop: bitmap cached, one detector, plain calls.

    It draws and searches whole frames; with a margin, windows of that margin about the corners.
    """
    detector = cv2.aruco.ArucoDetector(DICTIONARY, cv2.aruco.DetectorParameters())
    objects, frame = square_points(0.04), tuple(block.scenes.frame[0].tolist())
    marker = cv2.aruco.generateImageMarker(DICTIONARY, 0, 70)
    bitmap = cv2.copyMakeBorder(marker, 10, 10, 10, 10, cv2.BORDER_CONSTANT, value=255)
    source = np.array([[9.5, 9.5], [79.5, 9.5], [79.5, 79.5], [9.5, 79.5]], np.float32)

    def loop():
        for rvec, tvec in block.posed:
            corners = cv2.projectPoints(objects, rvec, tvec, block.camera, None)[0].reshape(4, 2)
            first, size = np.zeros(2), frame
            if margin_px is not None:
                first = np.clip(np.floor(corners.min(axis=0)) - margin_px, 0, frame)
                last = np.clip(np.ceil(corners.max(axis=0)) + margin_px, 0, frame)
                size = tuple(map(int, last - first))
            transform = cv2.getPerspectiveTransform(source, (corners - first).astype(np.float32))
            image = cv2.warpPerspective(
                bitmap, transform, size, flags=cv2.INTER_LINEAR, borderValue=(255,))
            quads, ids, _ = detector.detectMarkers(image)
            if ids is not None:
                cv2.solvePnP(objects, quads[0] + first.astype(np.float32), block.camera, None,
                             flags=cv2.SOLVEPNP_IPPE_SQUARE)

    return loop


def markers_table():
    header("frame", "naive ms a pose", "cropping ms a pose", "sweep ms a pose", "naive / sweep",
           "cropping / sweep", "sweep / bare calls")
    for width, height in SIZES:
        block = Block(MARKER, width, height, POSES[width])

        def bare(block=block):
            for rvec, tvec in block.posed[:block.bare_calls()]:
                pixels = cv2.projectPoints(square_points(0.04), rvec, tvec, block.camera, None)[0]
                cv2.solvePnPGeneric(square_points(0.04), pixels, block.camera, None,
                                    flags=cv2.SOLVEPNP_IPPE_SQUARE)

        row(f"{width} x {height}", *compared(
            block, bare, marker_loop(block), marker_loop(block, margin_px=24)))


def naive_board(ours):
    """Return the board as OpenCV has it, its ChArUco detector or None, its bitmap and the map."""
    board = cv2.aruco.Board(
        ours.corners_m.astype(np.float32), DICTIONARY, np.array(ours.marker_ids))
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
        charuco, squares = charuco_board(ours), ours.chessboard
        drawn = charuco.generateImage((
            round(squares.squares_x * SQUARE_M * PX_PER_M),
            round(squares.squares_y * SQUARE_M * PX_PER_M),
        ))
        top, left = (size[1] - drawn.shape[0]) // 2, (size[0] - drawn.shape[1]) // 2
        bitmap[top:top + drawn.shape[0], left:left + drawn.shape[1]] = drawn
        return board, cv2.aruco.CharucoDetector(charuco), bitmap, to_board
    side = round(MARKER_M * PX_PER_M)
    for number, corners in zip(ours.marker_ids, ours.corners_m, strict=True):
        left = round((corners[0, 0] - low[0]) * PX_PER_M)
        top = round((high[1] - corners[0, 1]) * PX_PER_M)
        bitmap[top:top + side, left:left + side] = cv2.aruco.generateImageMarker(
            DICTIONARY, number, side)
    return board, None, bitmap, to_board


def board_loop(block, board, charuco, bitmap, to_board):
    """As :func:`marker_loop`, of a board."""
    detector = cv2.aruco.ArucoDetector(DICTIONARY)
    frame = tuple(block.scenes.frame[0].tolist())

    def loop():
        for k, (rvec, tvec) in zip(block.rows, block.posed, strict=True):
            rotation = block.scenes.rotation[k]
            to_frame = block.camera @ np.column_stack([rotation[:, :2], tvec]) @ to_board
            image = cv2.warpPerspective(
                bitmap, to_frame, frame, flags=cv2.INTER_LINEAR, borderValue=(255,))
            corners, ids, _ = detector.detectMarkers(image)
            if ids is None:
                continue
            if charuco is not None:
                charuco.detectBoard(image, markerCorners=corners, markerIds=ids)
            objects, pixels = board.matchImagePoints(corners, ids)
            cv2.solvePnP(objects, pixels, block.camera, None, rvec.copy(), tvec.copy())

    return loop


def boards_table():
    header("board", "frame", "window, share of the frame", "markers found", "naive ms a pose",
           "sweep ms a pose", "naive / sweep", "sweep / bare calls")
    for name, declared in BOARDS.items():
        for (width, height), (near, far) in itertools.product(BOARD_SIZES, DISTANCES):
            block = Block(BOARD, width, height, BOARD_POSES[width], board=declared, near=near,
                          far=far)
            windows = block.cut[block.rows]
            share = np.mean(np.prod(windows[:, 2:] - windows[:, :2], axis=1)) / (width * height)
            printed = block.values["board"].listed(1)[0]
            naive = naive_board(printed)
            decoded = block.bare_calls(naive[1]) / (35 * len(block.rows))
            points = printed.corners_m.reshape(-1, 3)

            def bare(block=block, charuco=naive[1], points=points):
                block.bare_calls(charuco)
                for rvec, tvec in block.posed:
                    pixels = cv2.projectPoints(points, rvec, tvec, block.camera, None)[0]
                    cv2.solvePnP(points, pixels, block.camera, None)

            row(f"{name}, {near}-{far} m", f"{width} x {height}", f"{share:.2f}", f"{decoded:.2f}",
                *compared(block, bare, board_loop(block, *naive)))


TABLES = {"markers": markers_table, "boards": boards_table}


@single_threaded()
def main():
    for name in sys.argv[1:] or TABLES:
        TABLES[name]()
        print()


if __name__ == "__main__":
    main()
