"""Summaries of errors against plain loops, and their intervals against simulated coverage."""

import math

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from support.lengths import lengths
from support.small_datasets import (
    assert_agrees,
    degrees,
    is_detected,
    is_solved,
    is_unflipped,
    lengths_of,
    looked_for,
    percent,
    perfect,
    poses,
    with_every_flag,
)
from sweep.analysis import covariance_trust, efficiency, error_statistics, renderer_bias
from sweep.errors import DatasetError
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped

SCENE = {"distance_m": 2, "marker_id": 3, "trial": 5}
SETTINGS = {"cornerRefinementMethod": 2, "solver": 2}
SIZES = SCENE | SETTINGS
RENDERED = {"renderer": 3, "marker_id": 8, "trial": 10} | SETTINGS


def measured(rng, sizes, *, rotation=None, relative=None):
    """Return a dataset whose poses are all solved, of the given errors (..., xyz) and (...)."""
    shape = tuple(sizes.values())
    if rotation is None:
        rotation = rng.normal(0.001, 0.01, (*shape, 3))
    results = perfect(rng, sizes, rotation=rotation, position=np.zeros((*shape, 3)))
    scene, detected, estimated = (
        results[name].dims for name in ("marker_area_px", "detection", "estimate"))
    if relative is None:
        relative = rng.normal(0.001, 0.01, shape)
    depth = results["true_tvec_m"].sel(xyz="z", drop=True)
    relative = xr.DataArray(np.broadcast_to(relative, shape), dims=estimated)
    error = (depth * relative).transpose(*estimated)
    results["translation_error_m"] = results["translation_error_m"].astype(float)
    results["translation_error_m"].values[..., 2] = error
    results["rotation_error_rad"] = (*estimated, "xyz"), rotation
    labels = [f"{kind}_{axis}" for kind in ("rotation", "translation") for axis in "xyz"]
    return results.drop_attrs(deep=False).assign(
        corner_error_px=((*detected, "corner", "xy"), rng.normal(
            0, 0.1, (*results["detection"].shape, 4, 2)).astype("f4")),
        nees=(estimated, rng.chisquare(6, shape)),
        bound_std=((*scene, "pose_parameter"), rng.uniform(0.001, 0.01, (*depth.shape, 6))),
    ).assign_coords(pose_parameter=labels)


def with_flags_of_every_kind(rng, results):
    """Return the dataset with poses that went wrong in every way, mostly detected and solved."""
    out = with_every_flag(rng, results)
    out["corner_error_px"] = out["corner_error_px"].where(
        out["detection"] == DetectionStatus.detected
    )
    out["nees"] = out["nees"].where((out["estimate"] == EstimateStatus.solved) & (out["nees"] > 3))
    out["bound_std"] = out["bound_std"].where(out["bound_std"].isel(pose_parameter=0) > 0.003)
    return out


def rms(values):
    return math.sqrt((np.asarray(values) ** 2).mean())


@pytest.fixture(scope="module")
def mixed():
    rng = np.random.default_rng(1)
    return with_flags_of_every_kind(rng, measured(rng, SIZES))


def test_every_value_lies_in_its_interval_and_is_described(mixed):
    for table in (error_statistics(mixed, ["distance_m"]), efficiency(mixed, ["solver"]),
                  covariance_trust(mixed, ["solver"]),
                  renderer_bias(mixed.rename(marker_id="renderer"), reference="7")):
        for name, array in table.data_vars.items():
            assert {"long_name", "description"} <= set(array.attrs)
            assert array.attrs.get("units") or "flag_values" in array.attrs
            if f"{name}_low" in table:
                assert not (table[f"{name}_low"] > array).any(), name
                assert not (table[f"{name}_high"] < array).any(), name
                assert table[f"{name}_low"].attrs["units"] == array.attrs["units"]


@pytest.mark.parametrize("analysis", [efficiency, covariance_trust])
def test_where_nothing_was_drawn_there_is_no_interval(analysis, mixed):
    table = analysis(mixed, ["solver", "trial"])
    ends = [name for name in table if name.endswith(("_low", "_high"))]
    assert ends
    assert all(table[name].isnull().all() for name in ends)


# Coverage: each replicate is a regime of its own.


@lengths(60, 10_000)
def test_misses_at_random_widen_what_cells_of_other_means_leave_unsure(count, covered):
    # Chance of a false alarm below 1e-6, for a coverage of 0.93 to 0.97.
    rng = np.random.default_rng(10)
    shape = (count, 4, 25)
    offsets, chances = np.array([-2.0, 0.0, 0.0, 3.0]), np.array([0.3, 0.9, 0.5, 0.6])
    results = measured(
        rng, {"regime": count, "marker_id": 4, "trial": 25},
        relative=0.01 * (rng.normal(size=shape) + offsets[:, None]),
    )
    missed = rng.random(shape) > chances[:, None]
    results["detection"].values[missed] = DetectionStatus.no_candidate
    results["estimate"].values[missed] = EstimateStatus.no_detection
    summary = error_statistics(results, ["regime"])
    mean = (offsets * chances).sum() / chances.sum()
    rmse = math.sqrt(((offsets**2 + 1) * chances).sum() / chances.sum())
    for name, truth in (("range_bias_percent", mean), ("range_rmse_percent", rmse)):
        covered(summary, name, truth)
    covered(summary, "solved_rate", chances.mean(), 0.95, 0.99)


def test_a_column_that_cannot_be_sorted_at_once_is_told_how_to_divide(mixed, monkeypatch):
    monkeypatch.setattr("sweep.analysis.estimator.MAX_VALUES", 9)
    with pytest.raises(DatasetError, match="expected at most 9; divide them: keep an axis apart"):
        error_statistics(mixed)


def test_efficiency_is_that_of_plain_loops(mixed):
    per = ["distance_m", "solver"]
    assert efficiency(mixed.drop_vars("bound_std")).isnull().to_array().all()
    answer = efficiency(mixed, per)
    for index, found in poses(mixed, "estimate", per).items():
        chosen = found.where(is_unflipped(found) & ~np.isnan(found["bound_std"]).any(axis=1))
        std = chosen["bound_std"]
        rotation = rms(std[:, :3]) * math.sqrt(3) / rms(np.radians(lengths_of(degrees(chosen))))
        depth = rms(std[:, 5] / chosen["true_tvec_m"][:, 2]) / rms(percent(chosen) / 100)
        assert_agrees(answer, dict(zip(per, index, strict=True)),
                      {"rotation_efficiency": rotation, "range_efficiency": depth})


def test_true_covariances_are_trusted_and_others_are_not():
    rng = np.random.default_rng(14)
    results = measured(rng, {"marker_id": 5, "trial": 400, "solver": 3})
    results["nees"].values[..., 1] *= 1.5
    results["nees"].values[..., 2] *= 0.6
    answer = covariance_trust(results, ["solver"])
    assert answer["covariance_trusted"].values.tolist() == [True, False, False]
    assert answer["nees_count"].values.tolist() == [2000] * 3
    assert answer["nees_mean_low"][0] < 6 < answer["nees_mean_high"][0]
    assert answer["nees_mean_low"][1] > 6 > answer["nees_mean_high"][2]
    for k, level in enumerate((0.5, 0.9, 0.99)):
        hits = int((results["nees"].values[..., 1] <= stats.chi2.ppf(level, 6)).sum())
        ends = stats.binomtest(hits, 2000).proportion_ci(method="wilson")
        coverage = answer["covariance_coverage"].values[1, k]
        assert coverage == pytest.approx(hits / 2000)
        assert answer["covariance_coverage_low"].values[1, k] == pytest.approx(ends.low)
    scale = xr.DataArray([1.0, 1 / 1.5, 1 / 0.6], {"solver": results["solver"]}, "solver")
    mended = covariance_trust(results.assign(nees=results["nees"] * scale), ["solver"])
    assert mended["covariance_trusted"].all()


@pytest.mark.parametrize("n", [49, 50, 200])
def test_trust_is_an_interval_for_all_levels_together_within_the_tolerance(n):
    levels, results = (0.5, 0.9, 0.99), measured(np.random.default_rng(17), {"trial": n})
    trusted = []
    for within in range(n // 2, n, 1 + n // 30):
        counts = (n // 2, within, max(within, n - 1))
        edges = np.searchsorted(counts, np.arange(n), side="right")
        results["nees"].values[:] = np.array([1.0, 7.0, 12.0, 100.0])[edges]
        ends = [stats.binomtest(k, n).proportion_ci(1 - 0.05 / 3, "wilson") for k in counts]
        expected = n >= 50 and all(end.low - 0.02 <= level <= end.high + 0.02
                                   for end, level in zip(ends, levels, strict=True))
        assert covariance_trust(results, [])["covariance_trusted"] == expected
        trusted.append(expected)
    assert any(trusted) == (n >= 50)
    assert not all(trusted)


def test_flips_cost_the_trust_and_too_few_draws_give_none():
    rng = np.random.default_rng(15)
    results = measured(rng, {"marker_id": 5, "trial": 100})
    flipped = results.copy(deep=True)
    flipped["flipped"].values[:, :10] = Flipped.flipped
    flipped["nees"].values[:, :10] = 1e4
    infinite = results.copy(deep=True)
    infinite["nees"].values[0, 0] = np.inf
    for given, count, trusted in (
            (results, 500, True), (flipped, 500, False), (results.isel(trial=slice(9)), 45, False),
            (results.assign(nees=np.nan * results["nees"]), 0, False), (infinite, 500, True)):
        answer = covariance_trust(given, [])
        assert (answer["nees_count"], answer["covariance_trusted"]) == (count, trusted)
    assert answer["nees_mean"] == np.inf


def test_renderers_are_compared_pose_by_pose():
    rng = np.random.default_rng(16)
    plain = measured(rng, RENDERED)
    results = with_flags_of_every_kind(rng, plain)
    results["true_tvec_m"].values[...] = plain["true_tvec_m"].values[:1]
    names = ["warp", "exact", "supersample-4"]
    answer = renderer_bias(results.assign_coords(renderer=names))
    assert (answer.sel(renderer="exact")["rotation_shift_deg_high"] == 0).all()
    per = ["renderer", "cornerRefinementMethod", "solver"]
    groups = poses(results, "estimate", per)
    for index, found in groups.items():
        pair = found, groups[1, *index[1:]]
        aimed = looked_for(pair[0]) & looked_for(pair[1])
        pair = [each.where(aimed) for each in pair]
        seen, solved, right = (
            [mask(each) for each in pair] for mask in (is_detected, is_solved, is_unflipped))

        def apart(error, mask, pair=pair):
            one, two = (error(each.where(mask[0] & mask[1])) for each in pair)
            return one - two

        differing = int((seen[0] != seen[1]).sum())
        assert_agrees(answer, dict(zip(per, index, strict=True)), {
            "compared": len(pair[0]), "differing": differing,
            "detection_disagreement": differing / len(pair[0]),
            "corner_shift_rms_px": rms(apart(lambda p: p["corner_error_px"].astype(float), seen)),
            "range_bias_percent": apart(percent, solved).mean(),
            "rotation_shift_deg": rms(lengths_of(apart(
                lambda p: np.degrees(p["rotation_error_rad"]), right)))})
