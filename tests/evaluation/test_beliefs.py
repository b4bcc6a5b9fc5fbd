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

from support.blocks import run_block
from support.lengths import lengths
from support.solving import estimate
from sweep.evaluation.block import assumed_cameras
from sweep.experiment.grid import Block
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


def whole(pipeline):
    shape = tuple(len(axis) for axis in pipeline.experiment.scene_axes)
    return Block((0,) * len(shape), shape)


def run(document, settings=()):
    """Return the values of a pipeline's whole grid."""
    pipeline = Pipeline.from_dict(document, settings)
    result = run_block(pipeline, whole(pipeline))
    assert not result.failures
    return result.values


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
        self.estimates = []
        for one in self.estimators:
            cameras, size_m = assumed_cameras(one, values, scenes)
            self.estimates.append(estimate(
                scenes.corners_px + noise * shifts, cameras, size_m, one.solver, one.guarded,
                one.reprojection_limit,
            ))

    def __iter__(self):
        return zip(self.estimators, self.estimates, strict=True)

    def assert_poses(self, estimator, found, translation):
        """Hold translations (N, 3) to a share of the distance, and rotations to the true ones."""
        assert (found.status == EstimateStatus.solved).all(), estimator
        miss = np.abs(found.translation - translation).max(axis=1) / translation[:, 2]
        assert miss.max() < TRANSLATION, estimator
        error = pose_error(
            found.rotation, found.translation, self.scenes.rotation, self.scenes.translation)
        assert error.rotation_angle_rad.max() < ROTATION_RAD, estimator


# 1. Size.

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
    trials = f"trial={count}"
    truths = Estimated(ANYWHERE, [trials], noise)
    wrong = Estimated(ANYWHERE, [trials, f"believed_size_m={sizes}"], noise)
    for (truth, right), at in zip(truths, range(len(GUARDED)), strict=True):
        assert (right.status == EstimateStatus.solved).all()
        for k, size in enumerate(sizes):
            estimator = wrong.estimators[at * len(sizes) + k]
            found = wrong.estimates[at * len(sizes) + k]
            assert (estimator.solver, estimator.believed_size_m) == (truth.solver, size)
            np.testing.assert_array_equal(found.status, right.status)
            # Solved in units of the side: the same bits.
            np.testing.assert_array_equal(found.rotation, right.rotation)
            np.testing.assert_array_equal(found.alternative_rotation, right.alternative_rotation)
            # One rounding in each product, two in the quotient.
            np.testing.assert_allclose(
                found.translation, right.translation * (size / 0.1), rtol=1e-15, atol=0
            )


# 2. Camera and size, of a marker parallel to the image plane.

PARALLEL = {
    "marker": {"size_m": 0.1}, "camera": {"fx_px": 600, "fy_px": 550}, "pose": {"azimuth_deg": 20},
    "axes": {"bearing_x_deg": [0, 12], "bearing_y_deg": [0, -9], "distance_m": [0.3, 2.0],
             "roll_deg": [0, 30, 45, 100, 180, 275], "solver": list(GUARDED)},
}


def parallel_law(scenes, fx, fy, cx, cy, size):
    """Return the translations (N, 3) of law 2 from what is believed, each a number or (N,)."""
    view = scenes.cameras.view
    np.testing.assert_allclose(fx / view[:, 0], fy / view[:, 1], rtol=1e-14)
    scale = size / scenes.size_m
    z = scenes.translation[:, 2] * (fx / view[:, 0]) * scale
    return np.stack([
        scenes.translation[:, 0] * scale + z * (view[:, 2] - cx) / fx,
        scenes.translation[:, 1] * scale + z * (view[:, 3] - cy) / fy,
        z,
    ], axis=1)


@pytest.mark.parametrize("beliefs", [
    *(f"believed_fx_px={600 * k!r} believed_fy_px={550 * k!r}" for k in (0.8, 1.01)),
    "believed_cx_px=119.5 believed_cy_px=639.5", "believed_cx_px=320 believed_cy_px=238.5",
    "believed_cx_px=[300.0,319.5,330.25] believed_size_m=[0.09,0.11]",
])
def test_a_wrong_camera_moves_a_parallel_marker_as_the_law_says_and_does_not_turn_it(beliefs):
    estimated = Estimated(PARALLEL, beliefs.split())
    assert len(estimated.estimators) == len(GUARDED) * (6 if "[" in beliefs else 1)
    for estimator, found in estimated:
        view = estimated.scenes.cameras.view.T
        believed = [
            truth if belief is None else belief
            for truth, belief in zip((*view, estimated.scenes.size_m), (
                estimator.believed_fx_px, estimator.believed_fy_px, estimator.believed_cx_px,
                estimator.believed_cy_px, estimator.believed_size_m,
            ), strict=True)
        ]
        estimated.assert_poses(estimator, found, parallel_law(estimated.scenes, *believed))


# 3. Lenses.

CENTRED = {
    "marker": {"size_m": 0.1}, "camera": {"fx_px": 600},
    "axes": {"roll_deg": [20, 30, 45, 100], "solver": list(GUARDED)},
}


def radial(lens, r):
    """Return L(r²) of OpenCV's radial terms k1, k2, p1, p2, k3, k4, k5, k6."""
    k = [*lens, *[0.0] * (8 - len(lens))]
    s = r * r
    return (1 + s * (k[0] + s * (k[1] + s * k[4]))) / (1 + s * (k[5] + s * (k[6] + s * k[7])))


RADIAL = {
    "k1": [-0.25, 0.0, 0.0, 0.0],
    "k1 to k3": [-0.3, 0.1, 0.0, 0.0, 0.05],
    "k1 to k6": [0.2, 0.02, 0.0, 0.0, 0.01, 0.1, -0.03, 0.004],
}


@pytest.mark.parametrize("lens", RADIAL.values(), ids=RADIAL)
def test_lens_that_is_not_believed_scales_the_distance_of_a_centred_marker(lens):
    radius = 0.1 / np.sqrt(2) / 0.2
    estimated = Estimated(
        CENTRED, ["distance_m=0.2", f"distortion={lens}", "believed_distortion=[]"]
    )
    for estimator, found in estimated:
        expected = np.tile([0, 0, 0.2 / radial(lens, radius)], (4, 1))
        assert abs(expected[0, 2] / 0.2 - 1) > 0.01
        estimated.assert_poses(estimator, found, expected)


# What beliefs must not touch.

EVERYTHING = {
    "seed": 13, "marker": {"size_m": 0.0731}, "scene": {"background": 90},
    "camera": {"fx_px": 610.1, "fy_px": 598.7, "cx_px": 333.3,
               "distortion": [-0.11, 0.02, 0.001, -0.0007]},
    "pose": {"side_px": 45, "jitter_px": 0.5, "tilt_deg": {"uniform": [0, 60]},
             "azimuth_deg": {"normal": [0, 40]}},
    "axes": {
        "bearing_x_deg": [0, 21], "trial": 8, "cornerRefinementMethod": ["none", "subpix"],
        "solver": list(OPENCV_SOLVERS), "guarded": [True, False],
    },
}
TRUTH = {
    "believed_fx_px": "610.1", "believed_fy_px": "598.7", "believed_cx_px": "333.3",
    "believed_cy_px": "239.5", "believed_size_m": "0.0731",
    "believed_distortion": "[-0.11, 0.02, 0.001, -0.0007, 0.0]",
}


@pytest.fixture(scope="module")
def unset():
    return run(EVERYTHING)


@pytest.mark.parametrize("names", [["believed_fx_px"], list(TRUTH)], ids=["one", "all"])
def test_believing_the_truth_gives_the_bits_of_believing_nothing(names, unset):
    believing = run(EVERYTHING, [f"{name}={TRUTH[name]}" for name in names])
    assert (unset["estimate"] == EstimateStatus.solved).any()
    for name, expected in unset.items():
        np.testing.assert_array_equal(believing[name], expected, err_msg=name)


@pytest.mark.parametrize("settings", [
    ["believed_fx_px=700", "believed_cy_px=250", "believed_distortion=[]"],
    ["believed_size_m={geom=[0.01, 1, 2]}", "believed_distortion=[[], [-0.3, 0.1, 0, 0]]"],
    ["believed_fx_px={normal=[610, 3]}", "believed_fy_px={uniform=[500, 700]}",
     "believed_size_m={normal=[0.07, 0.001]}"],
], ids=["values", "axes", "distributions"])
def test_beliefs_change_no_draw_no_image_and_no_detection(settings, unset):
    believing = run(EVERYTHING, settings)
    seen = [variable.name for variable in SCHEMA if variable.stage < Stage.estimation]
    assert set(seen) >= {"true_rvec", "true_tvec_m", "detection", "corner_error_px"}
    assert (unset["detection"] == DetectionStatus.detected).any()
    for name in seen:
        np.testing.assert_array_equal(believing[name], unset[name], err_msg=name)
    different = believing["translation_error_m"]
    assert different.shape != unset["translation_error_m"].shape or not np.array_equal(
        different, unset["translation_error_m"], equal_nan=True
    )
