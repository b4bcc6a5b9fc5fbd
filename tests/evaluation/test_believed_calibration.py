"""What is believed of the camera: a calibration with its errors, or a focal length that is off."""

import numpy as np
import pytest

import sweep
from support.blocks import run_cells
from sweep.execution.runner import execute
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import EstimateStatus
from tests.support.here import calls_here

VIEW = {"fx_px": 600.0, "fy_px": 601.0, "cx_px": 320.5, "cy_px": 238.25}
LENS = [-0.2, 0.05, 0.001, -0.0005, 0.01]
SD = [0.8, 0.9, 1.5, 1.2, 0.004, 0.02, 2e-4, 3e-4, 0.03]
NAMES = [*VIEW, "k1", "k2", "p1", "p2", "k3"]
DRAWS = 100_000
SIGMAS = 6.0
"""A normal number lies outside with probability 2e-9: 54 of them, one test, 1.1e-7."""


def covariance(sd, seed=7):
    """A covariance with these standard deviations; fx and fy are correlated by about 0.99."""
    rng = np.random.default_rng(seed)
    mixing = rng.normal(size=(len(sd), len(sd)))
    mixing[1] = mixing[0] + 0.1 * mixing[1]
    matrix = mixing @ mixing.T
    scale = np.sqrt(np.diagonal(matrix))
    return np.outer(sd, sd) * matrix / np.outer(scale, scale)


def pipeline(camera, estimator=None, trials=DRAWS, settings=(), **sections):
    return Pipeline.from_dict({
        "camera": {**VIEW, "distortion": LENS, **camera}, "marker": {"size_m": 0.1},
        "pose": {"distance_m": 0.5}, "estimator": estimator or {"believed": "calibration"},
        "axes": {"trial": trials}, **sections,
    }, settings)


def drawn(chosen, names=NAMES):
    count = chosen.size(Stage.scene)
    lengths = [len(axis) for axis in chosen.experiment.scene_axes]
    values = chosen.experiment.scene_values([index.ravel() for index in np.indices(lengths)])
    return np.stack([values[f"calibrated_{name}"].broadcast(count) for name in names])


@pytest.mark.parametrize("kind", ["sd", "covariance", "covariance of the view"])
def test_100_000_draws_have_the_calibration_s_covariance(kind):
    count = 4 if kind == "covariance of the view" else 9
    expected = np.diag(np.square(SD)) if kind == "sd" else covariance(SD[:count])
    camera = {"calibration_sd": SD} if kind == "sd" else {
        "calibration_covariance": expected.ravel().tolist()}
    beliefs = drawn(pipeline(camera), NAMES[:count])
    truth = np.array([*VIEW.values(), *LENS])[:count, None]
    # Independent standard normal numbers, if the covariance is as it should be.
    normal = np.linalg.solve(np.linalg.cholesky(expected), beliefs - truth)
    assert np.abs(normal.mean(axis=1)).max() < SIGMAS / np.sqrt(DRAWS)
    second = normal @ normal.T / DRAWS
    spread = np.where(np.eye(count, dtype=bool), np.sqrt(2), 1.0) / np.sqrt(DRAWS)
    assert (np.abs(second - np.eye(count)) < SIGMAS * spread).all()


def test_draws_of_a_calibration_change_no_other_draw_and_follow_the_cell():
    plain = Pipeline.from_dict({
        "camera": VIEW, "pose": {"distance_m": 0.5, "jitter_px": 0.5}, "axes": {"trial": 50},
    })
    believing = Pipeline.from_dict({
        "camera": {**VIEW, "calibration_sd": SD[:4]},
        "pose": {"distance_m": 0.5, "jitter_px": 0.5}, "axes": {"trial": 50},
        "estimator": {"believed": "calibration"},
    })
    index = [np.arange(50)]
    ours, theirs = believing.experiment.scene_values(index), plain.experiment.scene_values(index)
    np.testing.assert_array_equal(ours["shift_u_px"].values, theirs["shift_u_px"].values)
    # The same trial of a calibration twice as uncertain is twice as far off.
    wider = pipeline({"calibration_sd": [2 * d for d in SD]}, trials=50)
    off = [drawn(p) - np.array([*VIEW.values(), *LENS])[:, None]
           for p in (wider, pipeline({"calibration_sd": SD}, trials=50))]
    np.testing.assert_allclose(off[0], 2 * off[1], rtol=1e-9)


# Estimates.

FRONTAL = {
    "scene": {"background": 128}, "detector": {"cornerRefinementMethod": "subpix"},
}


@pytest.mark.long
def test_a_believed_calibration_is_what_each_trial_s_numbers_give_on_their_own(tmp_path):
    chosen = pipeline({"calibration_sd": SD}, trials=4, **FRONTAL, settings=[
        "tilt_deg=30", "jitter_px=0.5"])
    with calls_here():
        execute(chosen, tmp_path / "s.zarr")
    results = sweep.open(tmp_path / "s.zarr").load()
    assert (results["estimate"] == EstimateStatus.solved).all()
    assert set(results["believed_fx_px"].dims) == {"trial"}
    values = chosen.experiment.scene_values([np.arange(4)])
    for name in NAMES:
        np.testing.assert_array_equal(
            results[f"believed_{name}"], values[f"calibrated_{name}"].values
        )
    for trial in range(4):
        own = {f"believed_{name}": float(results[f"believed_{name}"][trial]) for name in VIEW}
        own["believed_distortion"] = [float(results[f"believed_{k}"][trial]) for k in NAMES[4:]]
        stated = pipeline({}, own, 4, ["tilt_deg=30", "jitter_px=0.5"], **FRONTAL)
        expected = run_cells(stated, [np.array([trial])]).columns["translation_error_m"][0][0]
        found = results["translation_error_m"].isel(trial=trial)
        np.testing.assert_array_equal(found, expected.astype(np.float32))


def test_a_believed_focal_scale_scales_the_distance_of_a_frontal_marker():
    scales = [0.99, 1.0, 1.01, 1.2]
    chosen = Pipeline.from_dict({
        "camera": {"fx_px": 600}, "marker": {"size_m": 0.1}, "pose": {"distance_m": 0.5},
        **FRONTAL, "axes": {"believed_focal_scale": scales},
    })
    columns = run_cells(chosen, []).columns["translation_error_m"]
    z = 0.5 + np.array([column[0, 2] for column in columns])
    np.testing.assert_allclose(z / z[1], scales, rtol=1e-6)  # errors are float32
