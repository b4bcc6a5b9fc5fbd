"""The accuracy bound of markers and boards: central differences of exact images, and its flags.

The images are compared with polygon clipping, rays and quadratures in tests/model; here their
central differences and NumPy's linear algebra give the bound.
"""

import dataclasses
import math

import numpy as np
import pytest
from scipy.ndimage import maximum_filter
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from support.blocks import run_cells
from support.blurred import finer, finer_box, through_gaussian
from support.exact_image import DICTIONARIES, LENSES, values, visible
from support.lengths import first_of, lengths
from sweep.evaluation.search import visibility_flags
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import BoundStatus, DetectionStatus
from sweep.measure.likelihood import (
    BACKGROUND_MARGIN_PX,
    MAX_MIRROR_DISTANCE,
    bounds,
    is_before_camera,
    marker_view,
    state_of,
)
from sweep.model.board import single_marker
from sweep.model.board_kinds import BoardMarker, Charuco, Markers, with_distractors
from sweep.model.effects import NEUTRAL
from sweep.model.exposure import marker_boxes, marker_exposure
from sweep.model.scene import build_scenes


class Reference:
    """A scene in the box of its bound, the shares of its pixels, and their differences."""

    def __init__(self, value, unknown_blur=False):
        self.value, self.scenes, self.unknown_blur = value, build_scenes(value, 1), unknown_blur
        self.boxes, self.frame = marker_boxes(self.scenes), self.scenes.frame[0]
        self.low = np.maximum(self.boxes[0, :2] - BACKGROUND_MARGIN_PX, 0)
        self.high = np.minimum(self.boxes[0, 2:] + BACKGROUND_MARGIN_PX, self.frame)
        self.rotation, self.translation = self.scenes.rotation[0], self.scenes.translation[0]
        self.levels = np.array([value[name] for name in ("background", "black", "white")])
        self.levels = self.levels * value["gain"]
        self.variance = value["noise_grey"] ** 2 + 1 / 12
        # The reference turns about the origin of the print, in steps of shares of the distance.
        self.unit = np.repeat([1.0, self.translation[2]], 3)

    def shares(self, turn=None, shift=(0.0, 0.0, 0.0), blur_px=0.0):
        """Shares (3, P) of what is outside, black and white, of a print that is moved."""
        turn = np.eye(3) if turn is None else turn
        sigma, value = self.value["blur_px"] + blur_px, self.value | {"blur_px": 0.0}
        box = (*self.low.tolist(), *self.high.tolist())
        if sigma:
            value, pad = finer(value), math.ceil(5 * sigma)
            box = finer_box(box[:2], box[2:], pad)
        scenes = build_scenes(value, 1)
        plane, centre = turn @ scenes.plane[0], self.translation + shift
        plane[:, 2] += centre - turn @ self.translation
        scenes = dataclasses.replace(
            scenes, rotation=(turn @ self.rotation)[None], translation=centre[None],
            plane=np.ascontiguousarray(plane)[None],
        )
        black, white = (
            marker_exposure(scenes, 0, box, np.array(levels))
            for levels in ([0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0])
        )
        if sigma:
            black, white = (through_gaussian(share, pad, sigma) for share in (black, white))
        return np.array([1 - black - white, black, white]).reshape(3, -1)

    def moved(self, step):
        """Shares of a step of the parameters: turns, shifts over the distance, and spread."""
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        return self.shares(turn, step[3:6] * self.unit[3:], step[6])

    def steps(self, moved_px):
        """Steps of the parameters that move the image by about so many pixels."""
        fx = self.scenes.cameras.view[0, 0]
        around = 2 * moved_px / (fx * self.value["size_m"] / self.translation[2])
        steps = [around] * 3 + [moved_px / fx] * 2 + [around, moved_px]
        return np.diag(steps)[: 7 if self.unknown_blur else 6]

    def covariance(self, moved_px, seen=slice(None)):
        """The bound's covariance (6, 6), radians and metres, of the pixels ``seen``."""
        slopes = [
            self.levels @ (self.moved(step) - self.moved(-step)) / (2 * step.max())
            for step in self.steps(moved_px)
        ]
        linear = self.shares()
        known = np.abs(linear).max(axis=1) > 1e-9
        design = np.concatenate([linear[known], slopes]).T[seen]
        norms = np.linalg.norm(design, axis=0)
        inverse = np.linalg.inv(np.linalg.qr(design / norms)[1])
        covariance = self.variance * (inverse @ inverse.T) / np.outer(norms, norms)
        first = known.sum()
        return covariance[first:, first:][:6, :6] * np.outer(self.unit, self.unit)

    def deviations(self, moved_px, **given):
        return np.sqrt(np.diag(self.covariance(moved_px, **given)))

    def found(self, boxes=None):
        asked = np.array(["unknown_blur" if self.unknown_blur else "known_blur"])
        boxes = self.boxes if boxes is None else boxes
        return bounds(self.scenes, boxes, asked, np.array([True]))


# Scenes.

def scene(**given):
    return values(**(NEUTRAL | {
        "black": 40.0, "white": 220.0, "background": 120.0, "noise_grey": 2.0, "fx_px": 800.0,
    } | given))


def drawn(count, seed, sides=(8, 150), max_tilt=80, **given):
    """Draw visible scenes off the axis, one in three cut by the frame, of many kinds."""
    rng = np.random.default_rng(seed)
    found = []
    while len(found) < count:
        kind = len(found)
        width, height, fx = 320, 240, float(rng.choice([200, 400, 1500]))
        side = float(np.exp(rng.uniform(*np.log(sides))))
        where = rng.uniform([0, 0], [width, height])
        if kind % 3 == 0:
            axis = int(rng.integers(2))
            where[axis] = rng.choice([0, (width, height)[axis]]) + rng.uniform(-0.2, 0.2) * side
        offset = (where - [(width - 1) / 2, (height - 1) / 2]) / fx
        bearing = np.degrees(np.arctan(offset)).tolist()
        background = float(rng.integers(20, 180))
        value = scene(**{
            "width_px": width, "height_px": height, "fx_px": fx, "size_m": 0.05, "side_px": side,
            "dictionary": str(rng.choice(DICTIONARIES)), "marker_id": int(rng.integers(50)),
            "quiet_zone_modules": float(rng.choice([0, 1, 1.5])),
            "tilt_deg": rng.uniform(0, max_tilt) if kind % 5 else 0.0,
            "azimuth_deg": rng.uniform(0, 360), "roll_deg": rng.uniform(0, 360),
            "bearing_x_deg": bearing[0], "bearing_y_deg": bearing[1],
            "background": 220.0 if kind % 4 == 1 else background,
            "noise_grey": float(rng.choice([0.5, 2, 8])),
        } | given)
        if not visible(value):
            continue
        scenes = build_scenes(value, 1)
        if visibility_flags(scenes, 0)[0] == DetectionStatus.not_run:
            found.append(value)
    return found


# The bound.

SHARP_TOLERANCE = 1e-6
"""Steps of some 1e-6 px leave 1e-7 of a slope. Where within a step a vertex crosses a pixel's side
or an edge nearly along one crosses it, differences are off in proportion to the step, and rounding
in inverse proportion: the nearest of several steps is compared. Measured 7.9e-7 over the long form,
in a sliver that is known to 0.3 rad; 1.6e-7 elsewhere."""
SHARP_STEPS_PX = (5e-6, 1e-6, 3e-7, 1e-7, 3e-5)
BLURRED_STEPS_PX = (1e-4,)
"""A blurred image is smooth, and its sums are rounded: steps of 1e-6 px are 3e-3 off."""
TOLERANCE = 2e-3
"""A marker under a lens is drawn with chords, up to 1e-4 px from its edges; a blurred one is seen
through 16 x 16 samples a pixel. Measured 1.2e-3 of markers of 8 px, 6e-4 of larger ones."""


def worst_difference(reference, steps_px, enough):
    """The bound's largest relative difference from differences over the best of some steps."""
    found = reference.found()
    assert found.status.tolist() == [BoundStatus.given], reference.value
    differences = []
    for moved_px in steps_px:
        differences.append(np.abs(found.std[0] / reference.deviations(moved_px) - 1).max())
        if differences[-1] < enough:
            break
    return min(differences)


def known(value, most=3):
    """Tell whether the pose is known to better than three radians: else digits are lost in it."""
    return Reference(value).found().std[0, :3].max() < most


@lengths(16, 300)
def test_bound_is_that_of_differences_of_the_exact_image(count, claim):
    scenes = [value for value in drawn(count, 1) if known(value)]
    assert len(scenes) > 0.95 * count
    worst = max(
        worst_difference(Reference(value), SHARP_STEPS_PX, SHARP_TOLERANCE / 10)
        for value in scenes)
    claim("the accuracy bound, sides 8-150 px, cut by the frame",
          "central differences of the exact image at 1e-7 rad, 300 scenes", worst, "of itself")
    assert worst <= SHARP_TOLERANCE


@pytest.mark.parametrize(("unknown_blur", "given"), [
    (False, {"distortion": LENSES[1], "max_tilt": 70}),
    (False, {"blur_px": 0.5, "max_tilt": 75}),
    (True, {"blur_px": 1.0, "max_tilt": 75, "distortion": LENSES[2]}),
    pytest.param(False, {"distortion": LENSES[2], "max_tilt": 70}, marks=pytest.mark.long),
    pytest.param(
        True, {"blur_px": 2.0, "sides": (14, 30), "max_tilt": 70}, marks=pytest.mark.long),
], ids=str)
@lengths(1, 8)
def test_bound_under_a_lens_or_blurred_is_that_of_differences(count, unknown_blur, given, claim):
    blurred = "blur_px" in given
    scenes = drawn(count, 4, **({"sides": (8, 14)} if blurred else {}) | given)
    scenes = [value for value in scenes if known(value, 0.3 if blurred else 3)]
    assert scenes
    steps_px = BLURRED_STEPS_PX if blurred else SHARP_STEPS_PX
    worst = max(
        worst_difference(Reference(value, unknown_blur), steps_px, TOLERANCE / 2)
        for value in scenes
    )
    claim("the accuracy bound of blurred markers and through lenses",
          "central differences of the exact image", worst, "of itself")
    assert worst <= TOLERANCE


# Boards.

def marker(marker_id, x, y, z=0.0, tilt=0.0, azimuth=0.0, size=0.03):
    return BoardMarker(marker_id=marker_id, x_m=x, y_m=y, z_m=z, tilt_deg=tilt,
                       azimuth_deg=azimuth, size_m=size)


def listed(*markers):
    return Markers(dictionary="DICT_4X4_50", quiet_zone_modules=1.0, markers=markers).board()


FOLD = listed(marker(0, -0.022, 0, 0, -30, 90), marker(1, 0.022, 0, 0, 30, 90))
CUBE = listed(marker(0, 0, 0, 0.021), *(
    marker(1 + k, 0.021 * np.sin(np.radians(a)), -0.021 * np.cos(np.radians(a)), 0.0, 90, a)
    for k, a in enumerate((0.0, 90.0, 180.0, 270.0))
))
FIELD = listed(  # two sheets hide the same part of the first, one of them a part of the other
    marker(1, 0, 0, 0), marker(2, 0.02, 0.01, 0.03, 25, 40, 0.02),
    marker(3, -0.012, -0.012, 0.05, 10, 100, 0.015), marker(4, 0.006, 0.0, 0.06, 0, 0, 0.012),
)
TABLE = listed(marker(7, 0.2, 0.03, size=0.024), marker(3, 0.25, -0.02, size=0.024))
"""Its origin is far beside it."""
CHARUCO = Charuco(
    dictionary="DICT_4X4_50", squares_x=3, squares_y=2, square_m=0.04, marker_m=0.024,
    margin_m=0.01,
).board()
FLAT = {"distance_m": 0.22, "tilt_deg": 33.0, "azimuth_deg": 20.0, "roll_deg": 12.0}


def board_scene(board, **given):
    return scene(**{
        "size_m": 0.024, "width_px": 160, "height_px": 120, "fx_px": 150.0, "side_px": None,
        "white": 200.0, "dictionary": "DICT_4X4_50", "board": board, "distance_m": 0.2,
        "tilt_deg": 35.0, "azimuth_deg": 70.0, "roll_deg": 20.0,
    } | given)


@pytest.mark.parametrize("case", first_of([
    (FOLD, {}), (FIELD, {}), (CHARUCO, FLAT), (CUBE, {}),
    (FIELD, {"blur_px": 0.6}), (FIELD, {"distortion": (-0.2, 0.05, 0, 0)}),
    (CHARUCO,  # cut by the frame
     {"distance_m": 0.15, "tilt_deg": 55.0, "azimuth_deg": 200.0, "roll_deg": 80.0}),
    (TABLE, {"distance_m": 0.3, "tilt_deg": 25.0, "roll_deg": 5.0, "shift_u_px": -110.0}),
], 3))
def test_bound_of_a_board_is_that_of_differences_of_its_images(case, claim):
    """Edges at which a sheet is hidden move with the sheet in front."""
    board, given = case
    reference = Reference(board_scene(board, **given))
    worst = worst_difference(reference, SHARP_STEPS_PX, TOLERANCE if "blur_px" in given else 1e-5)
    claim("the accuracy bound of boards, hidden and in several planes",
          "central differences of the exact image", worst, "of itself")
    # Edges near pixels' corners cross them within a step.
    assert worst < (TOLERANCE if "blur_px" in given else 1e-4)


def test_pixels_of_a_distractor_tell_nothing_of_the_board():
    """It touches the board's sheet, so that neighbours of its pixels see the board's edge."""
    side = 0.03 * 8 / 6
    at = 0.07 + side / 2
    beside = with_distractors(CHARUCO, [(None, at, 0.0, 0.03, 0, 0, 0, 0, None)], 1, 1)
    both = Reference(board_scene(beside, **FLAT))
    alone, board = (
        Reference(board_scene(print_, **FLAT)) for print_ in (listed(marker(0, at, 0.0)), CHARUCO)
    )
    for each in (alone, board):
        each.low, each.high = both.low, both.high
    hidden = 1 - alone.shares()[0].reshape((both.high - both.low)[::-1])
    seen = maximum_filter(hidden, 3).ravel() < 1e-9
    expected = board.deviations(1e-6, seen=seen)
    np.testing.assert_allclose(both.found().std[0], expected, rtol=2e-5)
    assert (both.found().std > 1.002 * Reference(board_scene(CHARUCO, **FLAT)).found().std).any()


@pytest.mark.parametrize("unknown_blur", [False, True])
def test_bound_of_a_board_of_one_marker_is_the_marker_s(unknown_blur):
    alone, beside = (listed(marker(3, *at, size=0.024)) for at in ((0.0, 0.0), (0.02, 0.01)))
    lone, board, moved = (
        Reference(board_scene(
            print_, distance_m=0.1, tilt_deg=40.0, azimuth_deg=20.0, roll_deg=12.0, marker_id=3,
            quiet_zone_modules=1.0, blur_px=0.4,
        ), unknown_blur) for print_ in (None, alone, beside)
    )
    single, found = lone.found(), board.found()
    for name in ("std", "kappa", "mirror_distance"):
        np.testing.assert_array_equal(getattr(found, name), getattr(single, name))
    # The same marker, its board's origin elsewhere: turns are known as well, the mirror is as far.
    away = lone.rotation @ [0.02, 0.01, 0.0]
    moved.scenes.translation[0] -= away
    moved.scenes.plane[0, :, 2] -= away
    shifted = moved.found(lone.boxes)
    np.testing.assert_allclose(shifted.std[0, :3], single.std[0, :3], rtol=1e-8)
    np.testing.assert_allclose(shifted.kappa, single.kappa, rtol=1e-8)
    np.testing.assert_allclose(shifted.mirror_distance, single.mirror_distance, rtol=1e-5)


# The regimes where it does not tell.

@lengths(8, 60)
def test_kappa_is_its_formula_of_the_references_covariance(count):
    for value in drawn(count, 6):
        if not known(value):
            continue
        reference = Reference(value)
        covariance, axis = reference.covariance(3e-6), reference.rotation[:, 2]
        tilting = np.trace(covariance[:3, :3]) - axis @ covariance[:3, :3] @ axis
        expected = reference.translation[2] * tilting / (4 * math.sqrt(covariance[5, 5]))
        assert reference.found().kappa[0] == pytest.approx(expected, rel=1e-4)


def mirror_reference(reference):
    """Chi-square of the minimum that SciPy finds from the mirrored pose, and its turn from truth.

    The mirrored tilt is reflected at the line of sight; levels are solved for.
    """
    truth, start = reference.levels @ reference.shares(), reference.rotation
    sight = reference.translation / np.linalg.norm(reference.translation)
    mirror = (np.eye(3) - 2 * np.outer(sight, sight)) @ start @ np.diag([1, 1, -1])
    steps = reference.steps(1e-4)

    def residual(step):
        turned = Rotation.from_rotvec(step[:3]).as_matrix() @ mirror
        shares = reference.shares(turned @ start.T, step[3:] * reference.unit[3:])
        basis = np.linalg.qr(shares.T)[0]
        return (truth - basis @ (basis.T @ truth)) / math.sqrt(reference.variance)

    def slopes(step):
        return np.column_stack([
            (residual(step + small[:6]) - residual(step - small[:6])) / (2 * small.max())
            for small in steps
        ])

    end = least_squares(
        residual, np.zeros(6), slopes, method="lm", xtol=1e-12, ftol=1e-12)
    turned = Rotation.from_rotvec(end.x[:3]).as_matrix() @ mirror
    return 2 * end.cost, Rotation.from_matrix(start.T @ turned).magnitude()


@pytest.mark.parametrize("given", [
    {"side_px": 15.0, "tilt_deg": 30.0}, {"side_px": 40.0, "tilt_deg": 60.0},
    {"side_px": 25.0, "tilt_deg": 50.0, "distortion": LENSES[0]},
], ids=str)
def test_mirror_distance_is_that_of_an_independent_optimum(given):
    reference = Reference(scene(**{
        "width_px": 160, "height_px": 120, "azimuth_deg": 35.0, "roll_deg": 17.0,
        "bearing_x_deg": 1.0, "bearing_y_deg": -0.7, "noise_grey": 12.0,
    } | given))
    chi_square, turn = mirror_reference(reference)
    assert turn > 0.1
    found = reference.found().mirror_distance[0]
    if math.sqrt(chi_square) > MAX_MIRROR_DISTANCE:
        assert math.isnan(found)
        return
    # Left where what remains is 1e-2 of chi-square at most, and 1e-4 where steps are whole.
    tolerance = 1e-3 if "distortion" in given else 1e-5
    assert found == pytest.approx(math.sqrt(chi_square), rel=tolerance, abs=1e-2)


@pytest.mark.parametrize("tilt_deg", [0.0, 0.5])
def test_mirror_distance_is_nan_where_the_optimum_is_the_pose_itself(tilt_deg):
    reference = Reference(scene(side_px=30.0, roll_deg=17.0, azimuth_deg=35.0, tilt_deg=tilt_deg))
    chi_square, turn = mirror_reference(reference)
    assert chi_square < 1e-6
    assert turn < 1e-3
    assert math.isnan(reference.found().mirror_distance[0])


# What became of it: a number stands beside ``given`` only, NaN beside all others.

TOLD = {
    "seed": 5, "pose": {"side_px": 50, "tilt_deg": 30},
    "scene": {"black": 40, "white": 220, "background": 120, "bound": "known_blur"},
}
FLAGS = {
    BoundStatus.given: [
        [], ["noise_grey=0.5"], ["noise_grey=17.5"], ["gain=0.5"], ["blur_px=1"],
        ["black=4", "white=251", "background=251"], ["renderer=warp"], ["gain=1.14"],
    ],
    BoundStatus.no_noise: [["noise_grey=0"], ["noise_grey=0.49"]],
    BoundStatus.no_contrast: [
        ["black=120", "white=120"], ["side_px=0.001"],
        ["side_px=4000", "tilt_deg=0", "quiet_zone_modules=0"],
    ],
    BoundStatus.clipped: [
        ["black=3.9"], ["white=251.1"], ["background=3"], ["noise_grey=17.6"], ["gain=1.15"],
        ["gain=0.05"], ["gain=1e6"],
    ],
    BoundStatus.not_in_model: [
        ["exposure_s=0.01", "velocity_x_m_s=0.1"], ["full_well_e=10000"], ["occlusion=0.1"],
        ["bit_depth=12"], ["aperture_mm=2", "focus_distance_m=0.5"],
        ["vignetting=4", "noise_grey=0"], ["illumination_gradient=0.3", "black=0"],
    ],
    BoundStatus.not_visible: [
        ["bearing_x_deg=40"], ["tilt_deg=120", "noise_grey=0", "vignetting=4"], ["tilt_deg=90"],
        ["side_px=900", "tilt_deg=89", "bearing_y_deg=40"],
        ["distortion=[-0.5, 0, 0, 0]", "bearing_x_deg=36", "side_px=120"],
    ],
}


@pytest.mark.parametrize(("expected", "settings"), [
    pytest.param(flag, settings, id=f"{flag.name} {' '.join(settings)}")
    for flag, each in FLAGS.items() for settings in each
])
def test_every_flag_stands_beside_its_scenes_and_a_number_beside_given_only(expected, settings):
    if not any(setting.startswith("noise_grey") for setting in settings):
        settings = [*settings, "noise_grey=2"]
    columns = run_cells(Pipeline.from_dict(TOLD, settings), []).columns
    assert BoundStatus(columns["bound"][0][0]) == expected
    for name in ("bound_std", "bound_kappa"):
        assert (np.isfinite(columns[name][0]) == (expected == BoundStatus.given)).all()
    assert expected == BoundStatus.given or np.isnan(columns["mirror_distance"][0]).all()


def checked(found):
    """The flag of one scene whose numbers fit it."""
    numbers = np.concatenate([found.std[0], found.kappa])
    if found.status[0] == BoundStatus.given:
        assert (numbers >= 0).all()
        assert not (found.mirror_distance <= 0).any()
        assert not np.isinf([*numbers, *found.mirror_distance]).any()
    else:
        assert np.isnan([*numbers, *found.mirror_distance]).all()
    return BoundStatus(found.status[0])


EXTREMES = [
    {"side_px": 0.01}, {"side_px": 1000.0}, {"side_px": 100.0, "tilt_deg": 89.999999},
    {"size_m": 1e3}, {"shift_u_px": -349.9999}, {"shift_u_px": -350 + 1e-9},  # hardly in the frame
    {"side_px": 100.0, "fx_px": 1e9}, {"side_px": 100.0, "fx_px": 1.0},
    {"black": 120.000001, "white": 119.99999}, {"black": 120.0, "quiet_zone_modules": 0.0},
    {"quiet_zone_modules": 1e-9}, {"width_px": 1, "height_px": 1}, {"blur_px": 1e-9},
    {"side_px": 10.0, "blur_px": 8.0},
]


@pytest.mark.parametrize("unknown_blur", [False, True])
@pytest.mark.parametrize("given", EXTREMES, ids=str)
def test_extremes_are_given_or_flagged_without_a_warning(given, unknown_blur):
    value = scene(**({"side_px": 60.0, "roll_deg": 13.0, "azimuth_deg": 20.0} | given))
    checked(Reference(value, unknown_blur).found())


def test_a_marker_is_before_the_camera_where_its_whole_outline_is_and_faces_it():
    rng, found = np.random.default_rng(9), []
    optics, corner = build_scenes(scene(), 1).cameras.optics(0), np.zeros(2, dtype=np.int64)
    view = marker_view(single_marker("DICT_4X4_50", 3, 1.0), 0.1, optics, corner, 1.0)
    # Of 6 modules, with a quiet zone of one.
    outline = 0.05 * 8 / 6 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    for turn in Rotation.random(300, rng):
        position = rng.uniform([-0.03, -0.03, 0.02], [0.03, 0.03, 0.08])
        facing = turn.as_matrix()[:, 2] @ position < 0
        found.append(facing and (turn.apply(outline) + position)[:, 2].min() > 0)
        state = state_of(turn.as_matrix(), position, 0.0, np.zeros(3))
        assert is_before_camera(state, view) == found[-1]
    assert 0.1 < np.mean(found) < 0.9


def test_pose_that_hangs_on_a_level_seen_in_two_pixels_has_no_bound():
    """One black corner, and two pixels of a white cell whose level is unknown: five equations.

    The reference's smallest singular value is 6e-11 of the others, what differences leave of 0.
    """
    reference = Reference(scene(
        width_px=320, height_px=240, fx_px=300.0, noise_grey=0.5, quiet_zone_modules=0.0,
        side_px=17.866823984444196, roll_deg=252.6423136192278, tilt_deg=49.796367477940976,
        azimuth_deg=127.14356530369909, shift_u_px=166.4954431135993,
        shift_v_px=-14.317569667549655,
    ))
    assert reference.deviations(5e-6)[:3].min() > 1000
    assert checked(reference.found()) == BoundStatus.no_contrast
