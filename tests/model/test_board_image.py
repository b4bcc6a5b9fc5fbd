"""Images of boards, against clipped polygons and dense sampling written anew in these tests."""

import cv2
import numpy as np
import pytest

from support.bent_sheets import flat_points
from support.exact_image import LENSES, add_clipped, values
from sweep.model.board_image import BoardPose, Curvature, render_board
from sweep.model.board_kinds import Charuco, Grid
from sweep.model.effects import NEUTRAL
from sweep.model.extent import marker_boxes
from sweep.model.image_shift import shift_waves
from sweep.model.lens import pack
from sweep.model.marker_table import BoardMarker, Markers
from sweep.model.pose import rotation_of_angles
from sweep.model.projection import Optics
from sweep.model.renderers import quantise, render
from sweep.model.scene import build_scenes
from sweep.model.sheet import Shape

OPENCV = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)
LEVELS = {"black": 20.0, "white": 230.0, "background": 90.0}

CHARUCO = Charuco(
    dictionary="DICT_4X4_250", squares_x=4, squares_y=3, square_m=0.04, marker_m=0.024,
    margin_m=0.02,
)
APRIL = Grid(
    dictionary="DICT_4X4_250", rows=2, columns=3, marker_m=0.03, gap_m=0.01, corner_squares=True,
    margin_m=0.0,
)


def cells_of(kind):
    """White rectangles over black ones over white: (left, up, right, down, level) in metres, in
    the board's frame, painted in this order."""
    if kind is CHARUCO:
        yield -0.1, 0.08, 0.1, -0.08, "white"
        centres = []
        for row in range(3):
            for column in range(4):
                x, y = -0.08 + 0.04 * column, 0.06 - 0.04 * row
                if (row + column) % 2 == 0:
                    yield x, y, x + 0.04, y - 0.04, "black"
                else:
                    centres.append((x + 0.02, y - 0.02))
        half = 0.012
    else:
        half = 0.015
        yield -0.065, 0.045, 0.065, -0.045, "white"
        for row in range(3):
            for column in range(4):
                x, y = -0.065 + 0.04 * column, 0.045 - 0.04 * row
                yield x, y, x + 0.01, y - 0.01, "black"
        centres = [(x, y) for y in (0.02, -0.02) for x in (-0.04, 0.0, 0.04)]
    module = half / 3
    for marker_id, (x, y) in enumerate(centres):
        bits = cv2.aruco.generateImageMarker(OPENCV, marker_id, 6)
        for i, j in np.ndindex(6, 6):
            left, up = x - half + j * module, y + half - i * module
            yield left, up, left + module, up - module, "white" if bits[i, j] else "black"


def clipped(kind, optics, frame, pose):
    """The levels of a frame: each rectangle clipped to each pixel, its level less that below it."""
    shape = frame[1], frame[0]
    levels, share = np.zeros(shape), np.zeros(shape)
    levels += LEVELS["background"]
    below = LEVELS["background"]
    for left, up, right, down, name in cells_of(kind):
        corners = np.array([[left, up, 0], [right, up, 0], [right, down, 0], [left, down, 0]])
        points = corners @ pose.rotation.T + pose.translation
        flat = points[:, :2] / points[:, 2:]
        pixels = flat * optics.intrinsics[:2] + optics.intrinsics[2:]
        # Only the first lies on the background; all others on white.
        add_clipped(levels, share, pixels, LEVELS[name] - below)
        below = LEVELS["white"]
    return levels


def drawn_pose(rng, scale):
    rotation = rotation_of_angles(
        np.radians(rng.uniform(0, 75, 1)), rng.uniform(0, 7, 1), rng.uniform(0, 7, 1)
    )[0]
    distance = scale * rng.uniform(0.3, 2.0)
    return BoardPose(rotation, distance * np.array([*rng.uniform(-0.3, 0.3, 2), 1.0]))


@pytest.mark.parametrize("kind", [CHARUCO, APRIL])
def test_every_pixel_of_a_board_is_its_clipped_area(kind):
    rng = np.random.default_rng(1)
    frame = (96, 80)
    optics = Optics(np.array([110.0, 105.0, 47.0, 40.0]), pack(()), False)
    compared = 0
    while compared < 6:
        pose = drawn_pose(rng, 0.3)
        try:
            found = render_board(kind.board(), optics, frame, pose, **LEVELS)
        except ValueError:
            continue
        assert np.abs(found - clipped(kind, optics, frame, pose)).max() < 255e-9
        compared += 1


def before_lens(xd, yd, distortion):
    """Undistort normalised coordinates (h, w) to points (h * w, 2), by iterating OpenCV's
    published formula; what does not converge is NaN."""
    k1, k2, p1, p2, k3, k4, k5, k6 = [*distortion, 0, 0, 0, 0][:8]
    x, y = xd.ravel(), yd.ravel()
    for _ in range(40):
        r2, before = x * x + y * y, x
        radial = (1 + ((k6 * r2 + k5) * r2 + k4) * r2) / (1 + ((k3 * r2 + k2) * r2 + k1) * r2)
        x = (xd.ravel() - 2 * p1 * x * y - p2 * (r2 + 2 * x * x)) * radial
        y = (yd.ravel() - 2 * p2 * before * y - p1 * (r2 + 2 * y * y)) * radial
    return np.where(np.abs(x - before)[:, None] < 1e-9, np.column_stack([x, y]), np.nan)


def sampled(pose, distortion, blur_px, frame, focal_px, bent=None):
    """The levels of a frame by 16 x 16 samples a pixel, each at random in its cell."""
    rng = np.random.default_rng(2)
    pad, fine = 5, 16  # pixels around the frame, for the blur
    shape = (frame[1] + 2 * pad) * fine, (frame[0] + 2 * pad) * fine
    v, u = (np.indices(shape) + rng.random((2, *shape))) / fine - 0.5 - pad
    centre = (np.array(frame) - 1) / 2
    flat = before_lens((u - centre[0]) / focal_px, (v - centre[1]) / focal_px, distortion)
    rays = np.column_stack([flat, np.ones(len(flat))])
    plane = np.column_stack([pose.rotation[:, 0], pose.rotation[:, 1], pose.translation])
    on_board = rays @ np.linalg.inv(plane).T
    if bent is not None:
        on_sheet = flat_points(rays, pose.rotation, pose.translation, *bent)
        on_board = np.column_stack([on_sheet, np.ones(len(rays))])
    # All lines of the ChArUco board lie on a lattice of 4 mm.
    lattice = np.full((42, 52), LEVELS["background"])
    for cell in cells_of(CHARUCO):
        left, up, right, down = np.round(np.array(cell[:4]) / 0.004).astype(int)
        lattice[21 - up : 21 - down, 26 + left : 26 + right] = LEVELS[cell[4]]
    with np.errstate(invalid="ignore"):
        column = np.clip(np.nan_to_num(on_board[:, 0] / on_board[:, 2] / 0.004 + 26), 0, 51)
        row = np.clip(np.nan_to_num(21 - on_board[:, 1] / on_board[:, 2] / 0.004), 0, 41)
    level = lattice[row.astype(int), column.astype(int)].reshape(shape)
    if blur_px:
        level = cv2.GaussianBlur(level, (0, 0), blur_px * fine)
    mean = level.reshape(shape[0] // fine, fine, -1, fine).mean(axis=(1, 3))
    return mean[pad:-pad, pad:-pad]


@pytest.mark.parametrize(("distortion", "blur_px"), [
    (LENSES[1], 0.8),
    *(pytest.param(lens, blur, marks=pytest.mark.long)
      for lens, blur in ((LENSES[0], 0.0), (LENSES[0], 0.8), (LENSES[1], 0.0))),
])
def test_a_board_behind_a_lens_is_its_dense_samples(distortion, blur_px):
    frame, focal_px = (32, 26), 40.0
    optics = Optics(np.array([focal_px, focal_px, 15.5, 12.5]), pack(distortion), True)
    pose = BoardPose(
        rotation_of_angles(np.radians([35.0]), np.array([1.0]), np.array([0.3]))[0],
        np.array([0.02, -0.01, 0.24]),
    )
    found = render_board(CHARUCO.board(), optics, frame, pose, blur_px=blur_px, **LEVELS)
    expected = sampled(pose, distortion, blur_px, frame, focal_px)
    # An edge of 210 levels crosses 16 to 32 cells of a pixel, the sample of each on either side:
    # 210 sqrt(32 / 6) / 256 = 1.9 levels of standard deviation, of which 4.5 hold.
    assert np.abs(found - expected).max() < 8.5
    assert np.sqrt(np.mean((found - expected) ** 2)) < 1.2
    assert abs(np.mean(found - expected)) < 0.1


@pytest.mark.parametrize(("bend", "curvature"), [
    ("cylinder", 5.0), ("saddle", -4.0),
])
@pytest.mark.long
def test_a_bent_board_is_what_rays_meet(bend, curvature):
    frame, focal_px = (32, 26), 40.0
    optics = Optics(np.array([focal_px, focal_px, 15.5, 12.5]), pack(()), False)
    pose = BoardPose(
        rotation_of_angles(np.radians([25.0]), np.array([1.0]), np.array([0.3]))[0],
        np.array([0.02, -0.01, 0.27]),
    )
    curved = Curvature(Shape(curvature, 0.4, bend == "saddle"))
    found = render_board(CHARUCO.board(), optics, frame, pose, curvature=curved, **LEVELS)
    expected = sampled(pose, (0, 0, 0, 0), 0, frame, focal_px, (bend, curvature, 0.4))
    assert np.abs(found - expected).max() < 8.5  # as behind a lens
    assert np.sqrt(np.mean((found - expected) ** 2)) < 1.2
    assert abs(np.mean(found - expected)) < 0.1


def test_a_bent_and_shifted_board_of_one_marker_is_that_marker():
    value = values(**(NEUTRAL | {
        "width_px": 160, "height_px": 120, "fx_px": 200.0, "dictionary": "DICT_4X4_250",
        "size_m": 0.1, "side_px": 60.0, "tilt_deg": 30.0, "roll_deg": 200.0, "noise_key": 3,
        "curvature_per_m": 5.0, "bend_deg": 30.0, "geometry_px": 0.8, "geometry_length_px": 40.0,
    } | LEVELS))
    scenes = build_scenes(value, 1)
    reference = render(scenes, 0, marker_boxes(scenes)[0], (0, 0, 160, 120))
    # Turned in its board by 70°: the board's own pose and its bend are turned back.
    board = Markers(dictionary="DICT_4X4_250", markers=(
        BoardMarker(marker_id=0, x_m=0, y_m=0, size_m=0.1, roll_deg=70.0),
    )).board()
    turn = np.radians(-70.0)
    back = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    pose = BoardPose(scenes.rotation[0] @ back, scenes.translation[0])
    curved = Curvature(
        Shape(5.0, np.radians(30.0 + 70.0)), shift_waves(0.8, 40.0, np.uint64(3)), 40.0
    )
    found = render_board(
        board, scenes.cameras.optics(0), (160, 120), pose, curvature=curved, **LEVELS
    )
    # Rounding apart: levels at a half may round either way.
    differs = quantise(found) != reference
    assert (np.abs(found % 1 - 0.5)[differs] < 1e-6).all()


@pytest.mark.parametrize("distortion", [(), LENSES[1]])
@pytest.mark.parametrize("quiet", [0.0, 1.0, 1.5])
def test_a_board_of_one_marker_is_that_marker_to_the_bit(distortion, quiet):
    rng = np.random.default_rng(3)
    for _ in range(4):
        value = values(
            width_px=160, height_px=120, fx_px=200.0, dictionary="DICT_4X4_250",
            marker_id=int(rng.integers(250)), size_m=0.1, quiet_zone_modules=quiet,
            side_px=float(rng.uniform(20, 60)), tilt_deg=rng.uniform(0, 70),
            azimuth_deg=rng.uniform(0, 360), roll_deg=rng.uniform(0, 360),
            bearing_x_deg=rng.uniform(-20, 20), distortion=distortion, **LEVELS,
        )
        scenes = build_scenes(value, 1)
        reference = render(scenes, 0, marker_boxes(scenes)[0], (0, 0, 160, 120))
        board = Markers(
            dictionary="DICT_4X4_250", quiet_zone_modules=quiet,
            markers=(BoardMarker(marker_id=value["marker_id"], x_m=0, y_m=0, size_m=0.1),),
        ).board()
        pose = BoardPose(scenes.rotation[0], scenes.translation[0])
        found = render_board(board, scenes.cameras.optics(0), (160, 120), pose, **LEVELS)
        assert np.array_equal(quantise(found), reference)


def test_an_image_behind_the_board_shows_beside_it():
    board, frame = CHARUCO.board(), (64, 48)
    optics = Optics(np.array([80.0, 80.0, 31.5, 23.5]), pack(()), False)
    pose = BoardPose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.4]))
    plain = render_board(board, optics, frame, pose, background=90.0)
    even = render_board(board, optics, frame, pose, background=np.full((48, 64), 90.0))
    assert np.abs(plain - even).max() < 1e-9
    noise = np.random.default_rng(5).uniform(0, 255, (48, 64))
    over = render_board(board, optics, frame, pose, background=noise)
    assert np.array_equal(over[:5], noise[:5])
    assert np.array_equal(over[20, 25:39], plain[20, 25:39])


def test_a_board_out_of_the_frame_is_its_background_and_one_without_image_is_refused():
    board, frame = CHARUCO.board(), (64, 48)
    optics = Optics(np.array([80.0, 80.0, 31.5, 23.5]), pack(()), False)
    facing = np.diag([1.0, -1.0, -1.0])
    beside = BoardPose(facing, np.array([1.0, 0.0, 0.4]))
    assert (render_board(board, optics, frame, beside, background=7.0) == 7.0).all()
    for pose, problem in (
        (BoardPose(facing, np.array([0.0, 0.0, -0.4])), "behind the camera"),
        (BoardPose(np.eye(3), np.array([0.0, 0.0, 0.4])), "shows its back"),
    ):
        with pytest.raises(ValueError, match=problem):
            render_board(board, optics, frame, pose)
    ahead = BoardPose(facing, np.array([0.0, 0.0, 0.4]))
    for curved in (
        Curvature(Shape(30.0)),
        Curvature(Shape(), shift_waves(50.0, 5.0, np.uint64(1)), 5.0),
    ):
        with pytest.raises(ValueError, match="hides a part of itself, or shifts fold"):
            render_board(board, optics, frame, ahead, curvature=curved)
    folding = Optics(optics.intrinsics, pack((-2.0, 0.0, 0.0, 0.0)), True)
    with pytest.raises(ValueError, match="folds"):
        render_board(board, folding, frame, BoardPose(facing, np.array([0.0, 0.0, 0.15])))
