"""The covariance of one detection describes the errors of others, and knows where it ends."""

import numpy as np
import pytest
import xarray as xr

from sweep.diagnosis.detection import DetectionModel, error_model, judged, widened
from sweep.errors import ArgumentError, DatasetError
from sweep.measure.flags import EstimateStatus, Flipped
from sweep.model.pose import mirrored, rotation_of_angles, rotation_of_vector, vector_of_rotation


def drawn(seed, count=6000, noise=None):
    """Return a dataset of poses whose errors are normal, grow with 1 / side, and flip when far."""
    rng = np.random.default_rng(seed)
    z = np.exp(rng.uniform(0, np.log(4), count))
    tvec = z[:, None] * np.column_stack([rng.uniform(-0.3, 0.3, (count, 2)), np.ones(count)])
    rotation = rotation_of_angles(*np.radians([
        rng.uniform(0, 60, count), rng.uniform(0, 360, count), rng.uniform(0, 360, count)]))
    sd = np.array([2e-4, 2e-4, 1e-3, 2e-3, 2e-3, 1e-3]) * z[:, None]
    error = (rng.normal(0, 1, (count, 6)) if noise is None else noise) * sd
    error[:, 2] += 0.002
    error[:, 0] += 2.0 * error[:, 3] / 20
    ratio = rng.uniform(0.02, 1.0, count)
    flipped = rng.random(count) < 0.5 * ratio**4
    other = mirrored(rotation, tvec) @ rotation.transpose(0, 2, 1)
    turn = np.where(flipped[:, None, None], other, rotation_of_vector(error[:, 3:]))
    dims = ("trial", "xyz")
    return xr.Dataset({
        "true_rvec": (dims, vector_of_rotation(rotation)), "true_tvec_m": (dims, tvec),
        "rotation_error_rad": (dims, vector_of_rotation(turn)),
        "translation_error_m": (dims, error[:, :3] * np.linalg.norm(tvec, axis=1)[:, None]),
        "reprojection_error_px": ("trial", ratio),
        "alternative_reprojection_error_px": ("trial", np.ones(count)),
        "flipped": ("trial", np.where(flipped, Flipped.flipped, Flipped.not_flipped)),
        "estimate": ("trial", np.full(count, EstimateStatus.solved, np.uint8)),
    }, {"side_px": ("trial", 90.0 / z)})


def photographed(seed, correlation, count=1600):
    """Return photographs of 20 markers, with twice the errors, of which 30 % are common to each."""
    rng = np.random.default_rng([seed, 1])
    noise = rng.normal(0, 1.7, (count, 6)) + rng.normal(0, 1.1, (count // 20, 6)).repeat(20, axis=0)
    noise[:, 5] = correlation * noise[:, 2] + np.sqrt(1 - correlation**2) * noise[:, 5]
    found = drawn(seed, count, noise).assign(truth_std=(("trial", "component"), 1e-4 + 0 * noise))
    return found.coarsen(trial=20).construct(trial=("trial", "marker"))


@pytest.fixture(scope="module")
def model():
    return error_model(drawn(1))


def test_errors_of_other_draws_are_as_large_as_the_covariance_says(model):
    found = judged(model, drawn(2))
    chance, flipped = (
        found[name].values[found["known"]] for name in ("flip_probability", "flipped"))
    assert 5.8 < (found["whitened"].dropna("pose") ** 2).sum("row").mean() < 6.2
    for bin_ in np.array_split(np.argsort(chance), 5):
        expected, spread = chance[bin_].sum(), np.sqrt((chance * (1 - chance))[bin_].sum())
        assert abs(flipped[bin_].sum() - expected) < 4 * spread + 3


@pytest.mark.parametrize(("correlation", "gain", "error"), [(0.0, 0.0, 0.03), (0.5, 0.08, 0.05)])
def test_photographs_widen_the_covariance_and_show_correlations(model, correlation, gain, error):
    """20 gain 0.000 (sd of 40 sets 0.002) and 0.080 (0.008) over one; squares are 5.8 (0.35)."""
    seen, others, left = photographed(2, correlation, 400), photographed(3, correlation), []
    for photographs in (seen.stack(all=("trial", "marker"), create_index=False), seen):
        whitened = judged(widened(model, photographs), others)["whitened"].dropna("pose")
        assert 3.5 < (whitened**2).sum("row").mean() < 8.5
        left.append((np.trace(s := np.cov(whitened.T)) - 6 - np.linalg.slogdet(s)[1]) / 2)
    assert left[0] - left[1] == pytest.approx(gain, abs=error)
    with pytest.raises(DatasetError, match="take more photographs"):
        error_model(drawn(1), seen.isel(trial=slice(2)))


@pytest.mark.parametrize(("change", "words"), [
    (lambda drawn: drawn.isel(trial=np.zeros(6000, int)), "which 1 are"),
    (lambda drawn: drawn.assign(flipped=drawn["flipped"] * 0 + Flipped.flipped), "which 0 are"),
    (lambda drawn: drawn.assign_coords(side_px=drawn["side_px"] * drawn["trial"]), "several f")])
def test_a_store_that_shows_no_errors_or_several_cameras_is_refused(change, words):
    with pytest.raises(DatasetError, match=words):
        error_model(change(drawn(1)))


def test_outside_what_was_simulated_nothing_is_known_also_from_json(model):
    away = [[0, 0, 2.0], [0, 0, 9.0], [3.0, 0, 2.0], [0, 0, -2.0], [np.nan, 0, 2.0], [0, 0, 2.0]]
    found = model.at([[np.pi, 0.0, 0.0]] * 6, away, [0.1, 0.1, 0.1, 0.1, 0.1, np.nan])
    assert found["known"].values.tolist() == [True] + [False] * 5
    assert np.isnan(found.drop_vars("known").isel(pose=slice(1, None)).to_array()).all()
    pose, text = ([[3.0, 0.2, 0.0]], [[0.1, 0.0, 2.0]], 0.3), model.to_json()
    assert model.at(*pose).equals(DetectionModel.from_json(text).at(*pose))
    for name, wrong in (
            ("rvec", "abc"), ("rvec", [1.0]), ("tvec_m", [[1.0, 2.0]]), ("ambiguity", [0.1, 0.2])):
        poses = {"rvec": [[3.0, 0.2, 0.0]] * 3, "tvec_m": [[0.1, 0.0, 2.0]] * 3, name: wrong}
        with pytest.raises(ArgumentError, match=rf"^{name}( =|:) .*: expected [^\n]*$"):
            model.at(**poses)
    for part, edited in (
            ("flips", "flip"), ('"poses": [', '"poses": [0, '), (" 0.0,", "99,"), ('m": ', 'm": -'),
            ("0.0\n  ]", "NaN\n  ]"), ("{", "[" * 100_000)):
        with pytest.raises(DatasetError, match="make it again with `sweep"):
            DetectionModel.from_json(text.replace(part, edited, 1))
