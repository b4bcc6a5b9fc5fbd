"""Error models against the laws that made the errors, plain NumPy, SciPy and real stores."""

import json
import math

import numpy as np
import pytest
from scipy import optimize

from support.pose_errors import (
    FX,
    SIZE_M,
    minimal_turn,
    poses_with_law,
    power_law,
    reader_of_the_guide,
)
from sweep.analysis import error_models, model_covariance, model_errors
from sweep.analysis.dataset import focal_size_of, in_sight_frame, sight_rotation, viewing_angle_of
from sweep.analysis.error_models import Use
from sweep.errors import ArgumentError, DatasetError
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped
from sweep.report.findings import error_model_document
from sweep.report.table import to_json

SIX = ("x", "y", "z", "rotation_x", "rotation_y", "rotation_z")
GRID = {"distance_m": [1.0, 1.5, 2.2, 3.3, 5.0], "tilt_deg": [0.0, 20.0, 40.0, 60.0]}


def axes(trials, **others):
    return GRID | others | {"trial": list(range(trials))}


@pytest.fixture(scope="module")
def results():
    return poses_with_law(1, axes(150), power_law)


@pytest.fixture(scope="module")
def models(results):
    return error_models(results)


def in_sight(results):
    """Return the errors (distance, tilt, trial, 6) in the sight frame, by a rotation per pose."""
    position = results["true_tvec_m"].values
    turn = minimal_turn(position / np.linalg.norm(position, axis=-1, keepdims=True))
    return np.concatenate([
        np.einsum("...ji,...j->...i", turn, results[name].values.astype(float))
        for name in ("translation_error_m", "rotation_error_rad")], axis=-1)


def test_a_known_law_is_found_again(models):
    # 24 values of each of 6 errors: 4.9 standard errors, 1e-6 each.
    at = models.isel(side_px=0)
    distance, angle = np.meshgrid(at.distance_m, at.viewing_angle_deg, indexing="ij")
    bias, sigma = power_law(distance, None, angle)
    for k, name in enumerate(SIX):
        one = at.sel(quantity=name)
        error = np.log(one.sigma_high / one.sigma).values / 1.96
        assert (np.abs(np.log(one.sigma.values / sigma[..., k])) < 4.9 * error).all(), name
        error = (one.bias_high - one.bias).values / 1.96
        assert (np.abs(one.bias.values - bias[..., k]) < 4.9 * error).all(), name
    assert models.knots.sel(predictor="distance_m").values.tolist() == [2] * 6
    # 20 cells of 6 errors; one of 150 errors is outside 0.93 - 0.017 or 0.97 + 0.017 in 6 %.
    use = models.use.values
    assert (use == Use.holds).mean() > 0.8
    assert set(np.unique(use)) <= {Use.holds, Use.too_narrow, Use.too_wide}
    assert float(models.coverage.mean()) == pytest.approx(0.9545, abs=0.01)


def test_the_fit_is_the_maximum_of_the_likelihood(results, models):
    """SciPy's optimizer over the same four coefficients: a power law and two knots of the angle."""
    errors = in_sight(results)[..., 5].ravel()
    distance = results.true_tvec_m.values[..., 2].ravel()
    angle = np.broadcast_to(np.array(GRID["tilt_deg"])[None, :, None], (5, 4, 150)).ravel()
    assert models.knots.sel(quantity="rotation_z").values.tolist() == [2, 1, 2]
    u = np.log(distance) / np.log(5.0)
    v = angle / 60.0
    basis = np.stack([(1 - u) * (1 - v), (1 - u) * v, u * (1 - v), u * v], axis=-1)

    def loss(p):
        log_sigma = basis @ p[:4]
        return float((log_sigma + 0.5 * (errors - basis @ p[4:] * 1e-3)**2
                      * np.exp(-2 * log_sigma)).mean())

    start = np.concatenate([np.full(4, np.log(errors.std())), np.zeros(4)])
    best = optimize.minimize(loss, start, method="BFGS", options={"gtol": 1e-9}).x
    n = errors.size
    corners = models.sel(quantity="rotation_z").isel(
        side_px=0, distance_m=[0, -1], viewing_angle_deg=[0, -1])
    np.testing.assert_allclose(corners.sigma.values.ravel(),
                               np.exp(best[:4]) * math.sqrt(n / (n - 4)), rtol=5e-3)  # the ridge
    assert (np.abs(corners.bias.values.ravel() - best[4:] * 1e-3)
            < 0.01 * corners.sigma.values.ravel()).all()


def test_flips_missing_poses_and_tails_are_flagged():
    grid = {"distance_m": [1.0, 2.0, 3.0, 4.0, 5.0], "tilt_deg": [30.0],
            "trial": list(range(400))}

    def law(rng, size):
        unit = rng.normal(size=size)
        # At 4 m: few large errors, most of them small; at 5 m: of one size.
        unit[3] = np.where(rng.random(size[1:]) < 0.08, 3.5 * unit[3], 0.02 * unit[3])
        unit[4] = np.sign(unit[4])
        return unit

    results = poses_with_law(4, grid, power_law, normal=law)
    results["flipped"].values[0, 0, :20] = Flipped.flipped
    results["rotation_error_rad"].values[0, 0, :20] = 1.0
    for name, lost in (("estimate", EstimateStatus.no_detection),
                       ("detection", DetectionStatus.no_candidate),
                       ("translation_error_m", np.nan), ("rotation_error_rad", np.nan)):
        results[name].values[1, 0, :60] = lost
    models = error_models(results)
    use = models.use.isel(cell_side_px=0, cell_viewing_angle_deg=0)
    for cell, flag in ((0, Use.flips), (1, Use.rarely_solved), (4, Use.too_wide)):
        assert (use.isel(cell_distance_m=cell) == flag).all()
    assert (use.isel(cell_distance_m=2) == Use.holds).sum() >= 3
    assert models.flip_rate.values.ravel()[0] == pytest.approx(0.05)
    assert models.solved_rate.values.ravel()[1] == pytest.approx(0.85)
    # A single error of 50 m: each half is judged by the model of the other.
    results["translation_error_m"].values[2, 0, 3] = 50.0
    use = error_models(results).use.sel(quantity="z").isel(cell_distance_m=2)
    assert (use == Use.too_wide).all()
    first = models.isel(distance_m=0).sigma.sel(quantity="rotation_x")
    assert float(first.max()) < 0.01  # the flips of 1 rad are not in it


def test_off_the_axis_the_covariance_is_turned_with_the_line_of_sight():
    results = poses_with_law(5, axes(100), power_law, bearing_deg=25.0)
    models = error_models(results)
    true, rvec, moved, turned = (results[name].values.reshape(-1, 3) for name in (
        "true_tvec_m", "true_rvec", "translation_error_m", "rotation_error_rad"))
    own = model_covariance(models, true, viewing_angle_of(rvec, true))
    deviations = np.sqrt(np.diagonal(own.covariance, axis1=1, axis2=2))
    within = np.abs(np.hstack([moved, turned]) - own.bias) <= 2.0 * deviations
    assert within.mean() == pytest.approx(0.9545, abs=0.03)
    position = np.array([0.8, -0.6, 2.0])
    pose, one = model_covariance(models, position, 30.0), model_errors(models, 2.0, 30.0)
    turn = minimal_turn(position / np.linalg.norm(position))
    for part in (slice(0, 3), slice(3, 6)):
        expected = turn @ np.diag(one.sigma.values[0, part]**2) @ turn.T
        np.testing.assert_allclose(pose.covariance[0, part, part], expected, rtol=1e-9, atol=1e-20)
        np.testing.assert_allclose(pose.bias[0, part], turn @ one.bias.values[0, part], atol=1e-15)
    np.testing.assert_allclose(sight_rotation(position), turn, atol=1e-14)
    np.testing.assert_allclose(in_sight_frame(turn[:, 2], position), [0, 0, 1], atol=1e-14)


def test_size_and_distance_are_told_apart_where_both_vary():
    def of_side(distance, side, angle):
        bias, sigma = power_law(np.ones_like(distance), side, 0 * angle)
        return bias, sigma * distance[..., None] * (100.0 / side[..., None]) ** 1.5

    results = poses_with_law(6, {"size_m": [0.1, 0.2], "distance_m": [1.0, 2.0, 4.0],
                                 "tilt_deg": [10.0, 40.0], "trial": list(range(120))}, of_side)
    models = error_models(results)
    assert models.attrs["focal_size_varies"]
    with pytest.raises(ArgumentError, match="side_px = None"):
        model_errors(models, 2.0, 20.0)
    distance, side = np.array([1.0, 2.0, 2.0, 4.0]), FX * np.array([0.1, 0.1, 0.2, 0.2])
    found = model_errors(models, distance, 20.0, side / distance)
    expected = 1e-3 * distance * (100.0 / (side / distance)) ** 1.5
    np.testing.assert_allclose(found.sigma.sel(quantity="z"), expected, rtol=0.15)
    assert np.isnan(model_errors(models, 1.0, 20.0, 23.0).sigma).all()  # not in the store


def test_configurations_are_not_pooled():
    axes = {"distance_m": [1.0, 3.0], "tilt_deg": [10.0, 40.0], "solver": ["a", "b"]}
    results = poses_with_law(7, axes | {"trial": list(range(120))}, power_law)
    results["translation_error_m"].values[..., 1, :] *= 3.0
    models = error_models(results)
    alone = error_models(results.isel(solver=[1]))
    for name in ("coverage", "use", "judged", "knots", "region_low", "region_high"):
        np.testing.assert_allclose(
            alone[name].isel(solver=0), models[name].isel(solver=1), rtol=1e-7)


def seen_in(results, mask):
    """Return the poses of a mask over the scene; no others were looked for."""
    return results.assign(detection=results["detection"].where(mask, DetectionStatus.not_run))


def stores_of_regions():
    """Yield names, results, conditions seen and not: distance, angle, side (or none), bearing."""
    trials = {"trial": list(range(300))}
    grid = {"distance_m": [1.0, 2.0, 4.0], "tilt_deg": [0.0, 30.0, 60.0]} | trials
    on_axis = poses_with_law(11, grid, power_law)
    yield ("grid", on_axis, [(1, 0, None, 0), (1.4, 45, None, 0), (4, 60, FX * SIZE_M / 4, 0)],
           [(1, 30, 50, 0), (4, 30, 100, 0), (2, 30, None, 20), (2, 30, None, 63)])
    zipped = 30 * np.log2(on_axis["distance_m"]) == on_axis["tilt_deg"]
    yield ("zipped", seen_in(on_axis, zipped), [(1, 0, None, 0), (2, 30, None, 0),
           (4, 60, None, 0), (1.5, 17.5, None, 0)],
           [(1, 60, None, 0), (4, 0, None, 0), (1, 30, None, 0), (2, 0, None, 0),
            (2.5, 60, None, 0)])

    yield ("corner", seen_in(on_axis, (on_axis["distance_m"] == 1) | (on_axis["tilt_deg"] == 0)),
           [(1, 60, None, 0), (4, 0, None, 0)], [(4, 60, None, 0), (2, 45, None, 0)])
    bearings = poses_with_law(12, grid, power_law, bearing_deg=15.0)
    yield ("bearings", bearings, [(2, 30, None, 0), (2, 30, None, 14), (1, 0, None, 10)],
           [(2, 30, None, 30), (2, 30, None, 63), (2, 30, None, 120), (1, 30, 50, 5)])

    def correlated(rng, shape):
        side = np.exp(rng.uniform(np.log(40), np.log(160), shape))
        size = rng.uniform(0.1, 0.2, shape)
        return {"size_m": size, "distance_m": FX * size / side,
                "tilt_deg": rng.uniform(0, 60, shape)}

    yield ("drawn", poses_with_law(14, {"trial": list(range(2000))}, power_law, drawn=correlated),
           [(1, 30, 130, 0), (3.5, 30, 45, 0), (1.5, 50, 100, 0), (1.5, 5, 80, 0)],
           [(1, 30, 60, 0), (3, 30, 110, 0), (1, 30, 230, 0), (1.5, 75, 100, 0),
            (1.5, 30, 100, 20)])


@pytest.fixture(scope="module")
def regions():
    return {name: rest for name, *rest in stores_of_regions()}


@pytest.mark.parametrize("name", ["grid", "zipped", "corner", "bearings", "drawn"])
def test_a_model_answers_only_in_the_joint_region_that_was_seen(name, regions):
    results, seen, unseen = regions[name]
    models = error_models(results)
    position = results["true_tvec_m"].values.reshape(-1, 3)
    angles = viewing_angle_of(results["true_rvec"].values.reshape(-1, 3), position)
    focal = focal_size_of(results).broadcast_like(results["detection"]).transpose(
        *results["detection"].dims).values.ravel()
    own = model_covariance(models, position, angles, focal / position[:, 2])
    looked_for = (results["detection"] == DetectionStatus.detected).values.ravel()
    assert np.isfinite(own.covariance.values[looked_for, 0, 0]).all()
    document = json.loads(to_json(error_model_document(models, {})))
    read_errors = reader_of_the_guide()
    for conditions, expected in ((seen, True), (unseen, False)):
        for distance, angle, side, bearing in conditions:
            x = distance * math.tan(math.radians(bearing))
            position = (0.6 * x, -0.8 * x, distance) if bearing < 90 else (0.0, distance, -0.1)
            pose = model_covariance(models, position, angle, side)
            where = (distance, angle, side, bearing)
            assert bool(np.isfinite(pose.covariance.values[0, 2, 2])) is expected, where
            assert bool((pose.use != Use.no_poses).all()) is expected, where
            if bearing in (0, 20):
                errors = model_errors(models, distance, angle, side, bearing)
                assert bool(np.isfinite(errors.sigma).all()) is expected, where
            read = read_errors(document["models"][0], *position, angle, side)
            assert all(math.isfinite(each["sigma"]) is expected for each in read.values()), where
            assert all(each["use"] != "no_poses" for each in read.values()) is expected, where


@pytest.mark.parametrize(("change", "words"), [
    (lambda d: d.isel(trial=[0]), "trial: this store has a single draw of each pose"),
    (lambda d: d.isel(trial=slice(0, None, 2)), "0 solved poses that are not flipped"),
    (lambda d: d.isel(trial=slice(0, 4)), "80 solved poses that are not flipped; an error model"),
    (lambda d: d.assign(detection=0 * d.detection), "no pose was looked for"),
    (lambda d: d.assign_attrs(pipeline="").drop_attrs(), "not a coordinate, and the attributes"),
])
def test_what_cannot_be_modelled_says_so_in_a_line(results, change, words):
    with pytest.raises(DatasetError, match=words) as caught:
        error_models(change(results))
    assert "\n" not in str(caught.value)
