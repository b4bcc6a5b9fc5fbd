"""The kernel against a user's good loop, and against the bare calls that it makes.

    python -m tests.benchmarks kernel [markers] [boards]

Single markers and boards of 35; both if none is named. One core, medians of paired runs, seconds of
the processor: ratios count.
"""

import itertools
import statistics
import time

import cv2
import numpy as np

from benchmarks.tables import header, row
from sweep.evaluation.block import run_cells
from sweep.evaluation.opencv_threads import single_threaded
from sweep.evaluation.search import scenes_at, searched_windows
from sweep.experiment.pipeline import Pipeline
from sweep.measure.detectors import make_detector, opencv_board
from sweep.model.renderers import render_all

DICTIONARY = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_50)
SIZES = ((640, 480), (1920, 1080), (4000, 3000))
POSES = {640: 1000, 1920: 400, 4000: 150}
BOARD_SIZES = ((640, 480), (4000, 3000))
BOARD_POSES = {640: 60, 4000: 15}
DISTANCES = ((0.4, 0.8), (0.8, 1.6), (1.6, 3.2))
BOARDS = {
    "grid of 7 x 5": 'kind = "grid"\nrows = 5\ncolumns = 7\ngap_m = 0.0075',
    "ChArUco of 10 x 7": 'kind = "charuco"\nsquares_x = 10\nsquares_y = 7\nsquare_m = 0.0375',
}
"""Boards of 35 markers of 30 mm."""

REPEATS = 5
QUICK = {
    "SIZES": SIZES[:1], "POSES": {640: 20}, "BOARD_SIZES": SIZES[:1], "BOARD_POSES": {640: 2},
    "DISTANCES": DISTANCES[:1], "BOARDS": dict(list(BOARDS.items())[:1]), "REPEATS": 1,
}

TEXT = """
seed = 1
[camera]
width_px = {width}
height_px = {height}
fx_px = {focal}
[marker]
dictionary = "DICT_5X5_50"
size_m = {size_m}
{board}
[pose]
distance_m = {{ uniform = [{near}, {far}] }}
tilt_deg = {{ uniform = [0, {tilt}] }}
azimuth_deg = {{ uniform = [0, 360] }}
roll_deg = {{ uniform = [0, 360] }}
{place}
[scene]
background = 255
[axes]
trial = {poses}
"""
MARKER = {
    "size_m": 0.04, "board": "", "near": 0.2, "far": 2.0, "tilt": 70,
    "place": "bearing_x_deg = {uniform = [-15, 15]}\nbearing_y_deg = {uniform = [-15, 15]}",
}
BOARD = {"size_m": 0.03, "tilt": 60, "place": 'jitter_px = 20\n[estimator]\nsolver = "iterative"'}


class Block:
    """A pipeline's trials: their values and scenes, and where visible ones are searched."""

    def __init__(self, width, height, poses, **given):
        self.pipeline = Pipeline.from_text(TEXT.format(
            width=width, height=height, focal=4 / 4.8 * width, poses=poses, **given))
        self.poses, self.indices = poses, [np.arange(poses)]
        batch = scenes_at(self.pipeline.experiment, self.indices)
        self.scenes, self.boxes, self.target = batch.scenes, batch.boxes, batch.scenes.targets[0]
        unit = given["size_m"] if self.target.is_marker else 1.0
        self.corners_m = self.target.corners_m * unit  # (markers, 4, 3)
        self.rows = np.flatnonzero(batch.visible)
        self.setting = self.pipeline.experiment.detectors[0]
        (self.cut,) = searched_windows(batch)
        self.camera = self.scenes.cameras.matrix(0)
        self.posed = [
            (cv2.Rodrigues(rotation)[0], tvec, np.column_stack([rotation[:, :2], tvec]))
            for rotation, tvec in zip(
                self.scenes.rotation[self.rows], self.scenes.translation[self.rows], strict=True)
        ]

    def run(self):
        return run_cells(self.pipeline.experiment, self.indices)

    def images(self, windows, a_time=100):
        """Yield the images of the visible scenes."""
        for some in np.array_split(self.rows, max(len(self.rows) // a_time, 1)):
            yield from render_all(self.scenes, some, self.boxes[some], windows[some])

    def bare_calls(self, charuco=None):
        """The coverage and detection calls of the kernel, and their loop; markers decoded."""
        find, side = make_detector(self.setting), int(self.scenes.frame.max())
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


def drawn(target, corners_m):
    """Return a target's bitmap, ten pixels a module, and what takes its pixels to metres."""
    side = float(np.linalg.norm(corners_m[0, 1] - corners_m[0, 0]))
    px_per_m = 10 * 7 / side
    points = corners_m.reshape(-1, 3)
    low, high = points.min(axis=0)[:2] - side / 7, points.max(axis=0)[:2] + side / 7
    size = np.round((high - low) * px_per_m).astype(int)
    # Pixel (0, 0) is the middle of the bitmap's top left pixel; y is up on the target.
    to_target = np.array([
        [1 / px_per_m, 0, low[0] + 0.5 / px_per_m], [0, -1 / px_per_m, high[1] - 0.5 / px_per_m],
        [0, 0, 1],
    ])
    bitmap = np.full(size[::-1], 255, np.uint8)
    if target.chessboard is not None:
        squares = target.chessboard
        charuco = opencv_board(target).generateImage(
            tuple(round(count * squares.square_m * px_per_m)
                  for count in (squares.squares_x, squares.squares_y)))
        top, left = (np.array(bitmap.shape) - charuco.shape) // 2
        bitmap[top:top + charuco.shape[0], left:left + charuco.shape[1]] = charuco
        return bitmap, to_target
    for number, corners in zip(target.marker_ids, corners_m, strict=True):
        left = round((corners[0, 0] - low[0]) * px_per_m)
        top = round((high[1] - corners[0, 1]) * px_per_m)
        bitmap[top:top + 70, left:left + 70] = cv2.aruco.generateImageMarker(
            DICTIONARY, number, 70)
    return bitmap, to_target


def charuco_detector(target):
    """Return the detector of a board's chessboard corners, or None."""
    return None if target.chessboard is None else cv2.aruco.CharucoDetector(opencv_board(target))


def user_loop(block, margin_px=None):
    """Return a user's good loop: bitmap cached, one detector, plain calls.

    It draws and searches whole frames; with a margin, windows of that margin about the corners.
    """
    detector = cv2.aruco.ArucoDetector(DICTIONARY, cv2.aruco.DetectorParameters())
    charuco, frame = charuco_detector(block.target), tuple(block.scenes.frame[0].tolist())
    bitmap, to_target = drawn(block.target, block.corners_m)
    objects = block.corners_m.reshape(-1, 3).astype(np.float32)
    board = cv2.aruco.Board(
        block.corners_m.astype(np.float32), DICTIONARY, np.array(block.target.marker_ids))

    def loop():
        for rvec, tvec, plane in block.posed:
            first, size, to_frame = np.zeros(2), frame, block.camera @ plane @ to_target
            if margin_px is not None:
                corners = cv2.projectPoints(objects, rvec, tvec, block.camera, None)[0][:, 0]
                first = np.clip(np.floor(corners.min(axis=0)) - margin_px, 0, frame)
                last = np.clip(np.ceil(corners.max(axis=0)) + margin_px, 0, frame)
                size = tuple(map(int, last - first))
                to_frame = np.array([[1, 0, -first[0]], [0, 1, -first[1]], [0, 0, 1]]) @ to_frame
            image = cv2.warpPerspective(
                bitmap, to_frame, size, flags=cv2.INTER_LINEAR, borderValue=(255,))
            quads, ids, _ = detector.detectMarkers(image)
            if ids is None:
                continue
            if block.target.is_marker:
                cv2.solvePnP(objects, quads[0] + first.astype(np.float32), block.camera, None,
                             flags=cv2.SOLVEPNP_IPPE_SQUARE)
                continue
            if charuco is not None:
                charuco.detectBoard(image, markerCorners=quads, markerIds=ids)
            points, pixels = board.matchImagePoints(quads, ids)
            cv2.solvePnP(points, pixels, block.camera, None, rvec.copy(), tvec.copy())

    return loop


def bare_loop(block):
    """Return the kernel's calls of the renderer and of OpenCV alone."""
    charuco = charuco_detector(block.target)
    points, marker = block.corners_m.reshape(-1, 3), block.target.is_marker

    def loop():
        count = block.bare_calls(charuco)
        for rvec, tvec, _ in block.posed[: count if marker else None]:
            pixels = cv2.projectPoints(points, rvec, tvec, block.camera, None)[0]
            if marker:
                cv2.solvePnPGeneric(points, pixels, block.camera, None,
                                    flags=cv2.SOLVEPNP_IPPE_SQUARE)
            else:
                cv2.solvePnP(points, pixels, block.camera, None)

    return loop


def markers_table():
    header("frame", "naive ms a pose", "cropping ms a pose", "sweep ms a pose", "naive / sweep",
           "cropping / sweep", "sweep / bare calls")
    for width, height in SIZES:
        block = Block(width, height, POSES[width], **MARKER)
        row(f"{width} x {height}", *compared(
            block, bare_loop(block), user_loop(block), user_loop(block, margin_px=24)))


def boards_table():
    header("board", "frame", "window, share of the frame", "markers found", "naive ms a pose",
           "sweep ms a pose", "naive / sweep", "sweep / bare calls")
    for name, declared in BOARDS.items():
        for (width, height), (near, far) in itertools.product(BOARD_SIZES, DISTANCES):
            block = Block(width, height, BOARD_POSES[width], board=f"[board]\n{declared}",
                          near=near, far=far, **BOARD)
            windows = block.cut[block.rows]
            share = np.mean(np.prod(windows[:, 2:] - windows[:, :2], axis=1)) / (width * height)
            decoded = block.bare_calls() / (35 * len(block.rows))
            row(f"{name}, {near}-{far} m", f"{width} x {height}", f"{share:.2f}", f"{decoded:.2f}",
                *compared(block, bare_loop(block), user_loop(block)))


TABLES = {"markers": markers_table, "boards": boards_table}


@single_threaded()
def main(*names):
    for name in names or TABLES:
        TABLES[name]()
        print()
