"""Solver ``photometric_real`` against OpenCV's boards, dense sampling, and images of known pose."""

import dataclasses

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.signal import lfilter
from scipy.stats import chi2

from support.blocks import run_cells
from support.board_scenes import BoardPose, board_scene, levels_of
from support.lengths import first_of
from support.solving import of_markers
from sweep.experiment.pipeline import Pipeline
from sweep.measure import photograph as real
from sweep.measure.flags import Ambiguous, EstimateStatus
from sweep.measure.likelihood import state_of
from sweep.measure.photograph import HELD, SIZE, _write_cell, draw, photograph_view, system
from sweep.measure.photometric import PhotometricReal
from sweep.measure.surroundings import BoardMarker, clear_modules, surroundings, with_neighbours
from sweep.model.board import single_marker
from sweep.model.board_kinds import Charuco, Grid
from sweep.model.camera import Cameras
from sweep.model.coverage import MarkerEdges
from sweep.model.lens import pack
from sweep.model.marker import WHITE, module_count
from sweep.model.polygon import Optics, Projection
from sweep.model.pose import rotation_of_angles

ALARM = 1e-7
CHARUCO = Charuco(
    dictionary="DICT_4X4_50", squares_x=5, squares_y=5, square_m=0.04, marker_m=0.03,
).board()
GRID = Grid(
    dictionary="DICT_APRILTAG_36h11", rows=3, columns=3, marker_m=0.03, gap_m=0.0075,
    corner_squares=True,
).board()
VIEW = np.array([600.0, 610.0, 159.5, 119.5])
LENS, WIDE_LENS = (-0.2, 0.05, 0.001, -0.001), (-0.25, 0.05, 0.0, 0.0)
TONED = PhotometricReal(refined=False, spread_free=True, tone=True)


def rotation(*angles_deg):
    """Return the rotation of a tilt, an azimuth and a roll."""
    return rotation_of_angles(*np.radians(angles_deg)[:, None])[0]


def camera_of(view, lens):
    """Return a camera's parameters."""
    names = ("fx_px", "fy_px", "cx_px", "cy_px")
    return {"width_px": 320, "height_px": 240, "distortion": lens,
            **dict(zip(names, view.tolist(), strict=True))}


def photograph(
    board, pose, rng, *, blur=0.8, noise=2.0, tone=0.0, correlation=0.0, lens=(), shift=None
):
    """Return an image of a board with what cameras do to levels, by plain NumPy and SciPy."""
    scenes = board_scene(board, camera_of(VIEW, lens), pose, blur_px=blur)
    share = levels_of(scenes, background=0.5, black=0.0, white=1.0)
    if shift is not None:
        share = cv2.remap(share.astype(np.float32), *shift, cv2.INTER_CUBIC).astype(np.float64)
    level = 40 + 150 * (share + tone * share * (1 - share))
    white = rng.normal(size=(240, 320 + 50))
    white = lfilter([np.sqrt(1 - correlation**2)], [1, -correlation], white)  # along rows
    return np.clip(np.rint(level + noise * white[:, 50:]), 0, 255).astype(np.uint8)


def pose_of(board, number, pose):
    """Return the pose of one marker of a board, and its corners' pixels without a lens."""
    corners = board.corners_m[number]
    return pose.rotation, pose.rotation @ corners.mean(axis=0) + pose.translation


def detections(board, numbers, image, pose, rng, *, lens=(), error_px=0.3, alone=False):
    """Return detections of a board's markers whose corners are wrong by some noise."""
    size = float(np.linalg.norm(board.corners_m[0, 1] - board.corners_m[0, 0]))
    matrix = np.array([[VIEW[0], 0, VIEW[2]], [0, VIEW[1], VIEW[3]], [0, 0, 1]])
    count = len(numbers)
    corners = np.array([
        cv2.projectPoints(
            board.corners_m[k], cv2.Rodrigues(pose.rotation)[0], pose.translation, matrix,
            np.array(lens or [0.0] * 4),
        )[0].reshape(4, 2)
        for k in numbers
    ])
    found = of_markers(
        corners + rng.normal(0, error_px, corners.shape),
        Cameras(
            np.repeat(VIEW[None], count, axis=0), np.repeat(pack(lens)[None], count, axis=0),
            np.full(count, bool(lens)),
        ),
        np.full(count, size), np.full(count, 2.0),
        [single_marker(board.dictionary, board.marker_ids[k], 1.0) for k in numbers],
        [image] * count,
    )
    on_board = None if alone else [BoardMarker(board, k) for k in numbers]
    return dataclasses.replace(found, on_board=on_board)


def errors_of(board, numbers, estimates, pose):
    """Return errors (n, 6) in radians and metres."""
    rows = []
    for k, number in enumerate(numbers):
        turn, position = pose_of(board, number, pose)
        vector = cv2.Rodrigues(estimates.rotation[k] @ turn.T)[0].ravel()
        rows.append(np.concatenate([vector, estimates.translation[k] - position]))
    return np.array(rows)


def test_surroundings_are_what_opencv_draws_around_a_marker():
    """Sampled at random: the colour by counting crossings, against OpenCV's picture."""
    picture = cv2.aruco.CharucoBoard(
        (5, 5), 0.04, 0.03, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    ).generateImage((1200, 1200))
    rng = np.random.default_rng(1)
    for number in (3, 5, 8):
        ends, sides = surroundings(BoardMarker(CHARUCO, number), 1.75)
        points = rng.uniform(-1.75, 6 + 1.75, (400, 2))
        # Metres from the chessboard's top left corner, hence the picture's pixel.
        corner = CHARUCO.corners_m[number, 0]
        metres = np.array([corner[0] + 0.1, 0.1 - corner[1]]) + points * 0.005
        expected = picture[tuple((metres[:, ::-1] * 6000).astype(int).T)] > 127
        upright = ends[:, 0] == ends[:, 2]
        jump = (sides[upright] == WHITE) @ np.array([-1, 1])
        x, start, stop = ends[upright][:, [0, 1, 3]].T
        inside = (np.minimum(start, stop) < points[:, 1, None]) & (
            points[:, 1, None] < np.maximum(start, stop)
        )
        left = x < points[:, :1]
        white = (inside & left) @ (jump * np.sign(stop - start))
        np.testing.assert_array_equal(white, expected)


@pytest.mark.parametrize("board", [CHARUCO, GRID], ids=["charuco", "grid"])
def test_a_marker_with_its_neighbours_looks_as_on_its_board(board):
    pose, side = BoardPose(rotation(35, 20, 10), np.array([0.0, 0.0, 0.4])), 0.03
    turn, position = pose_of(board, 4, pose)
    alone = with_neighbours(BoardMarker(board, 4), 2.0)
    whole, part = (
        levels_of(board_scene(each, camera_of(VIEW, ()), at), 90.0, 20.0, 200.0)
        for each, at in ((board, pose), (alone, BoardPose(turn, position / side))))
    reach = 0.5 + 1.9 / module_count(board.dictionary)
    corners = side * reach * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    at = corners @ turn.T + position
    pixels = np.rint(at[:, :2] / at[:, 2:] * VIEW[:2] + VIEW[2:]).astype(np.int32)
    inside = cv2.erode(cv2.fillConvexPoly(np.zeros((240, 320), np.uint8), pixels, 1), None) > 0
    assert inside.sum() > 1000
    np.testing.assert_allclose(part[inside], whole[inside], atol=1e-6)


def test_the_ring_around_a_marker_that_is_clear():
    """A module, as (square - marker) / 2; a grid's gap; black squares touch their corners."""
    plain = Grid(dictionary="DICT_APRILTAG_36h11", rows=3, columns=3, marker_m=0.03, gap_m=0.0075)
    assert clear_modules(BoardMarker(CHARUCO, 5)) == pytest.approx(1.0, abs=1e-6)
    assert clear_modules(BoardMarker(plain.board(), 4)) == pytest.approx(2.0, abs=1e-6)
    assert clear_modules(BoardMarker(GRID, 4)) == pytest.approx(0.0, abs=1e-6)


def test_an_edge_is_drawn_as_its_pieces_are_however_long_a_lens_bends_it():
    optics, images = Optics(np.array([400.0, 400.0, 160.0, 60.0]), pack(WIDE_LENS), True), []
    plane = np.array([[0.1, 0.0, -0.35], [0.0, 0.1, -0.05], [0.0, 0.0, 1.0]])
    for count in (1, 16):
        ends = np.full((count, 4), 0.5)
        ends[:, 1], ends[:, 3] = np.linspace([0.0, 6.0 / count], [6.0 - 6.0 / count, 6.0], count).T
        out = system(300, 320)
        real.add_plane(out, MarkerEdges(ends, np.tile([1, 2], (count, 1))),
                       np.arange(-1.0, 2.0), Projection(plane, optics), 0.8)
        images.append(out.rates[:, :-4:4].cumsum(axis=1))
    assert np.abs(images[1]).max() == pytest.approx(1.0, abs=1e-2)
    assert np.abs(images[0] - images[1]).max() < 4e-3


@pytest.mark.parametrize("lens", first_of([LENS, ()], 1), ids=len)
def test_image_and_slopes_are_those_of_dense_sampling(lens):
    """Slopes against differences of images that are computed by the exact coverage."""
    pose = BoardPose(rotation(35, 20, 10), np.array([0.0, 0.0, 0.45]))
    rng = np.random.default_rng(2)
    image = photograph(CHARUCO, pose, rng, lens=lens)
    found = detections(CHARUCO, [5], image, pose, rng, lens=lens, error_px=0.0)
    view = photograph_view(
        found.targets[0], found.on_board[0], found.size_m[0], found.corners[0],
        found.cameras.optics(0), image, np.zeros(2, dtype=np.int64), toned=False,
    )
    turn, position = pose_of(CHARUCO, 5, pose)
    height, width = view.levels.shape
    work, (beyond, *_) = system(height, width), system(height + 1, width)
    state = state_of(turn, position, 0.8, np.array([0.0, 0.0, 1.0]))
    draw(view, state, work._replace(rates=beyond[:-1]))
    assert not beyond.any()  # nothing is written below the image
    shifts = found.cameras.view[0, 2:] - view.marker.optics.intrinsics[2:]
    left, top = np.rint(shifts).astype(int)
    used = np.zeros((height, width), dtype=bool)
    for row, (first, last) in zip(used, view.spans, strict=True):
        row[first:last] = True

    def exact(du=0.0, dv=0.0, blur=0.8):
        camera = camera_of(VIEW + np.array([0.0, 0.0, du, dv]), lens)
        scenes = board_scene(CHARUCO, camera, pose, blur_px=float(blur))
        whole = levels_of(scenes, background=0.0, black=0.0, white=1.0)
        return whole[top : top + height, left : left + width][used]

    # Panels of two standard deviations and a cut at four: 1e-3 of the contrast.
    assert np.abs(work.images[0][used] - exact()).max() < 1e-3
    # An image of another pose is drawn anew before the covariance is taken from it.
    covariances = np.zeros((2, 6, 6))
    for covariance, roll_deg in zip(covariances, (0, 6), strict=True):
        other = rotation(0, 0, roll_deg) @ turn
        draw(view, state_of(other, position, 0.8, np.array([0.0, 0.0, 1.0])), work)
        real.judge(view, state, work, covariance)
    assert covariances[0].any()
    np.testing.assert_array_equal(*covariances)
    step = 1e-3
    slopes = [
        (exact(-step) - exact(step)) / (2 * step), (exact(0, -step) - exact(0, step)) / (2 * step),
        (exact(blur=np.sqrt(0.64 + step)) - exact(blur=np.sqrt(0.64 - step))) / (2 * step),
    ]
    for image_slope, expected in zip(work.images[2:5], slopes, strict=True):
        # Slopes are for directions of steps, not for poses: 1e-2 of the contrast a pixel.
        assert np.abs(image_slope[used] - expected).max() < 1e-2
    # Those by the shifts of the four nodes around a pixel: products of hat functions.
    for i, j in np.argwhere(used)[::7]:
        columns = np.zeros((width, SIZE + 1 + HELD))
        cell, _ = _write_cell(view, state, work.images, i, j, columns)
        at = (view.at[::-1, i, j].clip(-1, 1) + 1) / 2 * 3  # of 3 x 3 cells
        hats = 1 - np.abs(at[:, None] - np.array(divmod(cell, 3))[:, None] - [0, 1])
        expected = np.multiply.outer(np.outer(*hats), -work.images[2:4, i, j])
        assert columns[0, SIZE + 1 :] == pytest.approx(expected.ravel(), abs=1e-12)


@pytest.mark.parametrize("seen", first_of([
    (CHARUCO, [3, 5, 6, 8], LENS, {"tone": 0.3, "correlation": 0.5}),
    (GRID, [1, 4, 5], (), {"tone": -0.2}),
], 1))
def test_poses_on_boards_have_the_errors_that_they_expect(seen):
    """NEES against chi-square: 3 or 4 markers, six degrees of freedom each, 1e-7 a side."""
    board, numbers, lens, effects = seen
    rng = np.random.default_rng(3)
    pose = BoardPose(rotation(35, 70, 25), np.array([0.003, -0.002, 0.42]))
    image = photograph(board, pose, rng, lens=lens, **effects)
    found = detections(board, numbers, image, pose, rng, lens=lens)
    estimates = TONED(found)
    assert (estimates.status == EstimateStatus.solved).all()
    errors = errors_of(board, numbers, estimates, pose)
    squared = sum(
        error @ np.linalg.solve(covariance, error)
        for error, covariance in zip(errors, estimates.covariance, strict=True)
    )
    assert squared < chi2.isf(ALARM, 6 * len(numbers))
    assert np.abs(estimates.covariance / estimates.covariance.swapaxes(1, 2) - 1).max() < 1e-6
    assert np.degrees(np.abs(errors[:, :3])).max() < 1.0
    assert (estimates.misfit_px < 0.05).all()


@pytest.mark.long
def test_the_bound_is_attained_with_levels_and_blur(claim):
    """300 images: a root mean square of 1 leaves [0.8, 1.2] with error probability below 1e-5."""
    pipeline = Pipeline.from_dict({
        "camera": {"width_px": 320, "height_px": 240},
        "pose": {"side_px": 50, "azimuth_deg": {"uniform": [0, 360]},
                 "tilt_deg": {"uniform": [20, 60]}, "jitter_px": 0.5},
        "scene": {"bound": "unknown_blur", "noise_grey": 2, "blur_px": 0.7, "black": 40,
                  "white": 200, "background": 200},
        "detector": {"cornerRefinementMethod": "subpix"},
        "estimator": {"solver": "photometric_real", "estimate_tone": False},
        "axes": {"trial": 300},
    })
    cells = run_cells(pipeline, [np.arange(300)])
    solved = cells.columns["estimate"][0] == EstimateStatus.solved
    assert solved.mean() > 0.95
    errors = np.concatenate([
        cells.columns[name][0] for name in ("rotation_error_rad", "translation_error_m")
    ], axis=1)
    ratio = np.sqrt(((errors / cells.columns["bound_std"][0])[solved] ** 2).mean(axis=0))
    claim("RMSE of solver photometric_real over the accuracy bound, less 1",
          "the bound of the exact image's derivatives", np.abs(ratio - 1).max())
    assert np.abs(ratio - 1).max() < 0.2


def test_a_pose_is_ambiguous_where_noise_may_bring_the_mirror_about():
    """A flip with odds of 1e5 has a probability below 1e-6, as a mirror at 15 deviations has."""
    pipeline = Pipeline.from_dict({
        "camera": {"width_px": 160, "height_px": 120, "fx_px": 600},
        "pose": {"side_px": {"uniform": [14, 26]}, "tilt_deg": {"uniform": [6, 30]}},
        "scene": {"bound": "unknown_blur", "blur_px": 0.7, "black": 60, "white": 180,
                  "background": 180},
        "estimator": {"solver": "photometric_real"}, "axes": {"noise_grey": [2, 10], "trial": 200},
    })
    columns = run_cells(pipeline, list(np.divmod(np.arange(400), 200))).columns
    wrong, far = columns["rotation_error_deg"][0] > 10, columns["mirror_distance"][0] > 15
    ambiguous = columns["ambiguous"][0]
    assert wrong.sum() > 1
    assert far.sum() > 50
    assert (ambiguous[wrong] == Ambiguous.ambiguous).all()
    assert (ambiguous[far] == Ambiguous.ambiguous).mean() < 0.02


@pytest.mark.long
def test_misfit_is_the_shift_of_the_markers_parts():
    """Shifts that vary over a third of the marker: a quarter to twice their standard deviation.

    Part of a field of shifts is a shift, a turn or a tilt of the whole, which nothing tells.
    """
    rng = np.random.default_rng(5)
    pose = BoardPose(rotation(30, 70, 25), np.array([0.003, -0.002, 0.25]))
    columns, rows = np.meshgrid(np.arange(320.0), np.arange(240.0))
    for std in (0.15, 1.0):
        fields = rng.normal(size=(2, 240, 320))
        fields = np.array([gaussian_filter(field, 12, mode="wrap") for field in fields])
        fields *= std / fields.std(axis=(1, 2), keepdims=True)
        moved = ((columns + fields[0]).astype(np.float32), (rows + fields[1]).astype(np.float32))
        image = photograph(CHARUCO, pose, rng, shift=moved)
        estimates = TONED(detections(CHARUCO, [5, 6], image, pose, rng))
        assert (estimates.misfit_px > 0.25 * std).all()
        assert (estimates.misfit_px < 2 * std).all()
    assert (estimates.status == EstimateStatus.not_explained).any()
