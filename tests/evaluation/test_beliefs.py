"""What the estimator believes: a calibration error moves the pose as the closed forms say.

Of the true camera K (f, c), size s and pose the corners are x = K·p; an estimator that believes K'
and s' solves for K'⁻¹·x. What it then finds:

1. *Size.* Scaling the square and the translation by the same number changes no image, so s' gives
   t' = t·s'/s, R' = R: exactly, for any pose and any corners.
2. *Marker parallel to the image plane, fx'/fx = fy'/fy.* As seen by K' its image is scaled by f/f'
   and shifted by (c - c')/f', still a square parallel to the plane. So exactly R' = R,
   z' = z·(f'/f)(s'/s), x' = x·s'/s + z'·(c - c')/f'.
3. *Radial lens, same marker, centred on the axis, none believed.* All corners lie at one radius
   r = s/(z·√2), which the lens turns into r·L(r²): z' = z/L(r²).
"""

import numpy as np
import pytest

from support.blocks import run_block, run_cells, whole
from support.lengths import lengths
from support.solving import estimate
from sweep.evaluation.block import assumed_cameras
from sweep.experiment.experiment import wrong_beliefs
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import SCHEMA
from sweep.measure.estimation import pose_error
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.measure.solver import OPENCV_SOLVERS
from sweep.model.scene import build_scenes

GUARDED = tuple(name for name in OPENCV_SOLVERS if name != "epnp")  # epnp cannot be guarded

TRANSLATION = 1e-5
ROTATION_RAD = 2e-5
"""What solvers leave of exact corners, translations relative to the distance: ITERATIVE stops when
its steps are small (measured 1e-7 and 1e-6 rad, far from the axis 3e-6 and 5e-6 rad), the others
leave 1e-9 and 5e-8 rad, but where they fail the guard takes ITERATIVE's solution. What is tested
below are effects of 1e-2 and more."""


class Estimated:
    """Estimates from *exact* corners (plus ``noise`` px), one after the other by estimator.

    By the kernel's own stages but for image and detection.
    """

    def __init__(self, document, settings=(), noise=0.0):
        pipeline = Pipeline.from_dict(document, settings)
        block = whole(pipeline)
        values = pipeline.experiment.scene_values(block.indices())
        self.scenes = scenes = build_scenes(values, len(block))
        self.estimators = pipeline.experiment.estimators
        shifts = np.random.default_rng(6).normal(size=scenes.corners_px.shape)
        self.beliefs, self.estimates = [], []
        for one in self.estimators:
            cameras, size_m = assumed_cameras(one, values, scenes)
            self.beliefs.append((*cameras.view.T, size_m))
            self.estimates.append(estimate(
                scenes.corners_px + noise * shifts, cameras, size_m, one.solver, one.guarded,
                one.reprojection_limit,
            ))

    def assert_poses(self, law):
        """Hold translations (N, 3) to a law of beliefs, and rotations to the true ones."""
        for estimator, beliefs, found in zip(
            self.estimators, self.beliefs, self.estimates, strict=True
        ):
            assert (found.status == EstimateStatus.solved).all(), estimator
            expected = law(self.scenes, *beliefs)
            miss = np.abs(found.translation - expected).max(axis=1) / expected[:, 2]
            assert miss.max() < TRANSLATION, estimator
            error = pose_error(
                found.rotation, found.translation, self.scenes.rotation, self.scenes.translation)
            assert error.rotation_angle_rad.max() < ROTATION_RAD, estimator


ANYWHERE = {
    "seed": 1, "marker": {"size_m": 0.1},
    "camera": {"fx_px": 600, "fy_px": 550, "distortion": [-0.2, 0.05, 0.001, -0.002]},
    "pose": {
        "distance_m": {"uniform": [0.3, 3]}, "tilt_deg": {"uniform": [0, 70]},
        "azimuth_deg": {"uniform": [0, 360]}, "roll_deg": {"uniform": [0, 360]},
        "bearing_x_deg": {"uniform": [-15, 15]}, "bearing_y_deg": {"uniform": [-15, 15]},
    },
    "axes": {"trial": 20, "solver": list(GUARDED)},
}


@lengths(20, 200)
@pytest.mark.parametrize("noise", [0.0, 0.3], ids=["exact corners", "noisy corners"])
def test_wrong_size_scales_the_translation_and_leaves_the_rotation_alone(count, noise):
    sizes = [0.001, 0.05, 0.0999, 0.101, 7.0]
    truth = Estimated(ANYWHERE, [f"trial={count}"], noise)
    wrong = Estimated(ANYWHERE, [f"trial={count}", f"believed_size_m={sizes}"], noise)
    for k, (estimator, found) in enumerate(zip(wrong.estimators, wrong.estimates, strict=True)):
        right, size = truth.estimates[k // len(sizes)], sizes[k % len(sizes)]
        assert (right.status == EstimateStatus.solved).all()
        assert (estimator.solver, estimator.believed_size_m) == (GUARDED[k // len(sizes)], size)
        # Solved in units of the side: the same bits.
        for name in ("status", "rotation", "alternative_rotation"):
            np.testing.assert_array_equal(getattr(found, name), getattr(right, name))
        # One rounding in each product, two in the quotient.
        np.testing.assert_allclose(
            found.translation, right.translation * (size / 0.1), rtol=1e-15, atol=0)


PARALLEL = {
    "marker": {"size_m": 0.1}, "camera": {"fx_px": 600, "fy_px": 550}, "pose": {"azimuth_deg": 20},
    "axes": {"bearing_x_deg": [0, 12], "bearing_y_deg": [0, -9], "distance_m": [0.3, 2.0],
             "roll_deg": [0, 30, 45, 100, 180, 275], "solver": list(GUARDED)},
}


def parallel_law(scenes, fx, fy, cx, cy, size):
    """Return the translations (N, 3) of law 2 from what is believed, each (N,)."""
    view = scenes.cameras.view
    np.testing.assert_allclose(fx / view[:, 0], fy / view[:, 1], rtol=1e-14)
    scale = size / scenes.size_m
    z = scenes.translation[:, 2] * (fx / view[:, 0]) * scale
    return np.stack([
        scenes.translation[:, 0] * scale + z * (view[:, 2] - cx) / fx,
        scenes.translation[:, 1] * scale + z * (view[:, 3] - cy) / fy,
        z,
    ], axis=1)


@pytest.mark.parametrize(("believed", "fx", "cx", "size_m"), [
    ("believed_fx_px=480 believed_fy_px=440", [480], [319.5], [0.1]),
    ("believed_focal_scale=1.01", [606], [319.5], [0.1]),
    ("believed_cx_px=119.5 believed_cy_px=639.5", [600], [119.5], [0.1]),
    ("believed_cx_px=[300.0,319.5] believed_size_m=[0.09,0.11]", [600], [300.0, 319.5],
     [0.09, 0.11]),
])
def test_a_wrong_camera_moves_a_parallel_marker_as_the_law_says_and_does_not_turn_it(
    believed, fx, cx, size_m
):
    estimated = Estimated(PARALLEL, believed.split())
    assert len(estimated.estimators) == len(GUARDED) * len(fx) * len(cx) * len(size_m)
    for place, expected in ((0, fx), (2, cx), (4, size_m)):
        found = {float(each) for beliefs in estimated.beliefs for each in beliefs[place]}
        assert sorted(found) == pytest.approx(expected, rel=1e-14)
    estimated.assert_poses(parallel_law)


@pytest.mark.parametrize("lens", [
    [-0.25, 0.0, 0.0, 0.0], [-0.3, 0.1, 0.0, 0.0, 0.05],
    [0.2, 0.02, 0.0, 0.0, 0.01, 0.1, -0.03, 0.004],
], ids=len)
def test_lens_that_is_not_believed_scales_the_distance_of_a_centred_marker(lens):
    k1, k2, _, _, k3, k4, k5, k6 = [*lens, *[0.0] * (8 - len(lens))]
    s = (0.1 / 0.2) ** 2 / 2
    radial = (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)))
    assert abs(1 / radial - 1) > 0.01
    Estimated({
        "marker": {"size_m": 0.1}, "camera": {"fx_px": 600, "distortion": lens},
        "pose": {"distance_m": 0.2}, "estimator": {"believed_distortion": []},
        "axes": {"roll_deg": [20, 30, 45, 100], "solver": list(GUARDED)},
    }).assert_poses(lambda *_: np.tile([0, 0, 0.2 / radial], (4, 1)))


EVERYTHING = {
    "seed": 13, "marker": {"size_m": 0.0731}, "scene": {"background": 90},
    "camera": {"fx_px": 610.1, "fy_px": 598.7, "cx_px": 333.3,
               "distortion": [-0.11, 0.02, 0.001, -0.0007]},
    "pose": {"side_px": 45, "jitter_px": 0.5, "tilt_deg": {"uniform": [0, 60]},
             "azimuth_deg": {"normal": [0, 40]}},
    "axes": {
        "bearing_x_deg": [0, 21], "trial": 4, "cornerRefinementMethod": ["none", "subpix"],
        "solver": list(OPENCV_SOLVERS), "guarded": [True, False],
    },
}
TRUTH = [
    "believed_fx_px=610.1", "believed_fy_px=598.7", "believed_cx_px=333.3", "believed_cy_px=239.5",
    "believed_size_m=0.0731", "believed_distortion=[-0.11, 0.02, 0.001, -0.0007, 0.0]",
]


def run(settings=()):
    pipeline = Pipeline.from_dict(EVERYTHING, settings)
    result = run_block(pipeline, whole(pipeline))
    assert not result.failures
    return result.values


@pytest.fixture(scope="module")
def unset():
    return run()


@pytest.mark.parametrize("settings", [TRUTH[:1], TRUTH], ids=["one", "all"])
def test_believing_the_truth_gives_the_bits_of_believing_nothing(settings, unset):
    believing = run(settings)
    assert (unset["estimate"] == EstimateStatus.solved).any()
    for name, expected in unset.items():
        np.testing.assert_array_equal(believing[name], expected, err_msg=name)


@pytest.mark.parametrize("settings", [
    ["believed_fx_px=700", "believed_cy_px=250", "believed_distortion=[]"],
    ["believed_size_m={geom=[0.01, 1, 2]}", "believed_distortion=[[], [-0.3, 0.1, 0, 0]]"],
    ["believed_fx_px={normal=[610, 3]}", "believed_fy_px={uniform=[500, 700]}",
     "believed_size_m={normal=[0.07, 0.001]}"],
    ["believed=calibration", "calibration_sd=[1, 1, 1, 1]"],
], ids=["values", "axes", "distributions", "calibration"])
def test_beliefs_change_no_draw_no_image_and_no_detection(settings, unset):
    believing = run(settings)
    seen = [variable.name for variable in SCHEMA if variable.stage < Stage.estimation]
    assert set(seen) >= {"true_rvec", "true_tvec_m", "detection", "corner_error_px"}
    assert (unset["detection"] == DetectionStatus.detected).any()
    for name in seen:
        np.testing.assert_array_equal(believing[name], unset[name], err_msg=name)
    different = believing["translation_error_m"]
    assert different.shape != unset["translation_error_m"].shape or not np.array_equal(
        different, unset["translation_error_m"], equal_nan=True
    )


VIEW = {"fx_px": 600.0, "fy_px": 601.0, "cx_px": 320.5, "cy_px": 238.25}
LENS = [-0.2, 0.05, 0.001, -0.0005, 0.01]
SD = [0.8, 0.9, 1.5, 1.2, 0.004, 0.02, 2e-4, 3e-4, 0.03]
NAMES = [*VIEW, "k1", "k2", "p1", "p2", "k3"]
DRAWS = 100_000
SIGMAS = 6.0
"""A normal number lies outside with probability 2e-9: 54 of them, one test, 1.1e-7."""


def calibrated(camera, trials=DRAWS, estimator=None, settings=()):
    return Pipeline.from_dict({
        "camera": {**VIEW, "distortion": LENS, **camera}, "marker": {"size_m": 0.1},
        "pose": {"distance_m": 0.5}, "scene": {"background": 128},
        "detector": {"cornerRefinementMethod": "subpix"},
        "estimator": estimator or {"believed": "calibration"}, "axes": {"trial": trials},
    }, settings)


def drawn(pipeline, names=NAMES):
    count = pipeline.size(Stage.scene)
    values = pipeline.experiment.scene_values([np.arange(count)])
    return np.stack([values[f"calibrated_{name}"].broadcast(count) for name in names])


def covariance(sd):
    """A covariance with these standard deviations; fx and fy are correlated by about 0.99."""
    mixing = np.random.default_rng(7).normal(size=(len(sd), len(sd)))
    mixing[1] = mixing[0] + 0.1 * mixing[1]
    matrix = mixing @ mixing.T
    scale = np.sqrt(np.diagonal(matrix))
    return np.outer(sd, sd) * matrix / np.outer(scale, scale)


@pytest.mark.parametrize(("name", "expected"), [
    ("calibration_sd", np.diag(np.square(SD))), ("calibration_covariance", covariance(SD)),
    ("calibration_covariance", covariance(SD[:4])),
], ids=["sd", "covariance", "covariance of the view"])
def test_100_000_draws_have_the_calibration_s_covariance(name, expected):
    count = len(expected)
    given = SD if name == "calibration_sd" else expected.ravel().tolist()
    beliefs = drawn(calibrated({name: given}), NAMES[:count])
    truth = np.array([*VIEW.values(), *LENS])[:count, None]
    # Independent standard normal numbers, if the covariance is as it should be.
    normal = np.linalg.solve(np.linalg.cholesky(expected), beliefs - truth)
    assert np.abs(normal.mean(axis=1)).max() < SIGMAS / np.sqrt(DRAWS)
    second = normal @ normal.T / DRAWS
    spread = np.where(np.eye(count, dtype=bool), np.sqrt(2), 1.0) / np.sqrt(DRAWS)
    assert (np.abs(second - np.eye(count)) < SIGMAS * spread).all()
    # The same trial of a calibration twice as uncertain is twice as far off.
    if name == "calibration_sd":
        wider = drawn(calibrated({name: [2 * d for d in SD]}, trials=50))
        np.testing.assert_allclose(wider - truth, 2 * (beliefs[:, :50] - truth), rtol=1e-9)


def test_a_believed_calibration_is_what_each_trial_s_numbers_give_on_their_own():
    settings, trials = ["tilt_deg=30", "jitter_px=0.5"], 3
    chosen = calibrated({"calibration_sd": SD}, trials, settings=settings)
    found = run_cells(chosen, [np.arange(trials)]).columns
    assert (found["estimate"][0] == EstimateStatus.solved).all()
    for trial, numbers in enumerate(drawn(chosen).T.tolist()):
        own = {f"believed_{name}": number for name, number in zip(VIEW, numbers, strict=False)}
        stated = calibrated({}, trials, own | {"believed_distortion": numbers[4:]}, settings)
        alone = run_cells(stated, [np.array([trial])]).columns
        np.testing.assert_array_equal(
            found["translation_error_m"][0][trial], alone["translation_error_m"][0][0])


@pytest.mark.parametrize(("axis", "wrong"), [
    ("believed_focal_scale = [0.99, 1, 1.01]", [True, False, True]),
    ("believed_fx_px = [500, 510]", [False, True]),
    ('believed = ["truth", "calibration"]', [False, True]),
    ("believed_distortion = [[], [0.1, 0, 0, 0], [0, 0, 0, 0]]", [False, True, False]),
    ('solver = ["ippe", "iterative"]', [False, False]),
    ('pair = { zip = { believed_focal_scale = [1.0, 1.1], solver = ["ippe", "ap3p"] } }',
     [False, True]),
])
def test_a_belief_is_wrong_where_it_differs_from_the_truth(axis, wrong):
    calibrated = "calibration_sd = [1, 1, 1, 1]" if "calibration" in axis else ""
    pipeline = Pipeline.from_text(
        f"seed = 1\n[camera]\nfx_px = 500\n{calibrated}\n[pose]\nside_px = 40\n[axes]\n{axis}")
    assert list(wrong_beliefs(pipeline, pipeline.axes[0])) == wrong
