"""Summaries of errors against plain loops, and their intervals against simulated coverage."""

import itertools
import math

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from support.lengths import lengths
from support.small_datasets import (
    degrees,
    is_solved,
    length,
    looked_for,
    percent,
    perfect,
    with_every_flag,
)
from sweep.analysis import covariance_trust, efficiency, error_statistics, renderer_bias
from sweep.errors import ArgumentError, DatasetError
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped

INNER = {"corner": 4, "xy": 2, "xyz": 3, "pose_parameter": 6}
SCENE = {"distance_m": 2, "marker_id": 3, "trial": 5}
SETTINGS = {"cornerRefinementMethod": 2, "solver": 2}
SIZES = SCENE | SETTINGS
RENDERED = {"renderer": 3, "marker_id": 8, "trial": 10} | SETTINGS
SETTINGS = {"cornerRefinementMethod": 2, "solver": 2}


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


def poses(results, **kept):
    """Yield each pose as a dictionary of its values and axes, by plain loops."""
    axes = {
        name: range(size) for name, size in results.sizes.items()
        if name not in INNER and name not in kept
    }
    arrays = {name: (array.dims, array.values) for name, array in results.data_vars.items()}
    for index in itertools.product(*axes.values()):
        at = dict(zip(axes, index, strict=True)) | kept
        yield at | {
            name: values[tuple(at[dim] for dim in dims if dim not in INNER)]
            for name, (dims, values) in arrays.items()
        }


def is_unflipped(pose):
    return is_solved(pose) and pose["flipped"] == Flipped.not_flipped


def rms(values):
    return math.sqrt(math.fsum(value**2 for value in values) / len(values))


@pytest.fixture(scope="module")
def mixed():
    rng = np.random.default_rng(1)
    return with_flags_of_every_kind(rng, measured(rng, SIZES))


# Values.


def test_every_value_lies_in_its_interval_and_is_described(mixed):
    tables = [
        error_statistics(mixed, ["distance_m", "solver"]), efficiency(mixed, ["solver"]),
        covariance_trust(mixed, ["solver"]),
        renderer_bias(mixed.rename(marker_id="renderer"), reference="7"),
    ]
    for table in tables:
        for name, array in table.data_vars.items():
            assert array.attrs["long_name"]
            assert array.attrs["description"]
            assert array.attrs.get("units") or "flag_values" in array.attrs
            if f"{name}_low" in table:
                assert not (table[f"{name}_low"] > array).any(), name
                assert not (table[f"{name}_high"] < array).any(), name
                assert table[f"{name}_low"].attrs["units"] == array.attrs["units"]
    assert tables[0]["distance_m"].values.tolist() == [0.2, 0.4]
    low = tables[0]["range_p95_percent_low"]
    assert low.attrs["description"].startswith("lower end of the 95 %")


@pytest.mark.parametrize("how", ["no trial", "one trial", "one pose a cell", "trial kept"])
def test_where_nothing_was_drawn_there_is_no_interval(mixed, how):
    kept = ["trial"] if how == "trial kept" else []
    if how == "no trial":
        results = mixed.isel(trial=0, drop=True)
    elif how == "one trial":
        results = mixed.isel(trial=[0])
    else:
        results = mixed.copy(deep=True)
    if how == "one pose a cell":
        results["detection"].values[:, :, 1:] = DetectionStatus.not_run
        results["estimate"].values[:, :, 1:] = EstimateStatus.not_run
    tables = (error_statistics(results, [*kept, "solver"]), efficiency(results, [*kept, "solver"]),
              covariance_trust(results, [*kept, "solver"]))
    for table in tables:
        ends = [name for name in table if name.endswith(("_low", "_high"))]
        assert ends
        assert all(table[name].isnull().all() for name in ends)


def test_settings_that_are_pooled_see_the_same_draws_and_add_no_certainty(mixed):
    rng = np.random.default_rng(7)
    one = with_flags_of_every_kind(rng, measured(rng, SCENE))
    many = xr.concat([one] * 3, dim="solver", data_vars=["estimate", "flipped", "nees",
                     "rotation_error_rad", "translation_error_m"]).transpose("distance_m", ...)
    for function in (error_statistics, covariance_trust, efficiency):
        alone, pooled = function(one, []), function(many, [])
        for name in alone:
            if alone[name].dtype == int:
                assert pooled[name] == 3 * alone[name]
            elif "_sd_" not in name:  # its n - 1 counts the settings
                np.testing.assert_allclose(pooled[name], alone[name], rtol=1e-12, err_msg=name)
    assert (error_statistics(mixed, [])["solved_rate_high"] < 1).all()


# Coverage: each replicate is a regime of its own.

def held(table, name, truth):
    return int(((table[f"{name}_low"] <= truth) & (truth <= table[f"{name}_high"])).sum())


@lengths(60, 10_000)
@pytest.mark.parametrize("bias", [0.0, 0.1, 0.4])
def test_a_rotation_bias_is_covered_be_it_nothing_or_small(bias, count, covered):
    # Chance of a false alarm below 1e-6, for a coverage of 0.94 to 1.
    rng = np.random.default_rng(9)
    rotation = rng.normal(size=(count, 5, 10, 3)) * [1.0, 0.3, 2.0] + [0.6 * bias, 0.0, 0.8 * bias]
    results = measured(
        rng, {"regime": count, "marker_id": 5, "trial": 10}, rotation=0.01 * rotation
    )
    summary = error_statistics(results, ["regime"])
    hit = held(summary, "rotation_bias_deg", math.degrees(0.01 * bias) - 1e-12)
    hit = hit if bias else int((summary["rotation_bias_deg_low"] == 0).sum())
    covered("rotation bias", hit, count, 0.94, 1.0)


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
    mean_square = ((offsets**2 + 1) * chances).sum() / chances.sum()
    covered("range_bias_percent", held(summary, "range_bias_percent", mean), count)
    rmse = math.sqrt(mean_square)
    covered("range_rmse_percent", held(summary, "range_rmse_percent", rmse), count)
    covered("solved_rate", held(summary, "solved_rate", chances.mean()), count, 0.95, 0.99)


# Efficiency.

def test_efficiency_is_that_of_plain_loops(mixed):
    answer = efficiency(mixed, ["distance_m", "solver"])
    for i, j in itertools.product(range(2), range(2)):
        chosen = [pose for pose in poses(mixed, distance_m=i, solver=j)
                 if is_unflipped(pose) and not np.isnan(pose["bound_std"]).any()]
        rotation = rms([rms(p["bound_std"][:3].tolist()) * math.sqrt(3) for p in chosen]) / rms(
            [math.radians(length(degrees(p))) for p in chosen])
        depth = rms([p["bound_std"][5] / p["true_tvec_m"][2] for p in chosen]) / rms(
            [percent(p)[0] / 100 for p in chosen])
        told_here = answer.isel(distance_m=i, solver=j)
        assert told_here["rotation_efficiency"].item() == pytest.approx(rotation, rel=1e-12)
        assert told_here["range_efficiency"].item() == pytest.approx(depth, rel=1e-12)


@lengths(60, 10_000)
def test_on_the_bound_the_interval_holds_one(count, covered):
    # Chance of a false alarm below 1e-6, for a coverage of 0.93 to 0.97.
    rng = np.random.default_rng(12)
    scene = {"regime": count, "marker_id": 5, "trial": 60}  # one cell can make most of the error
    results = measured(rng, scene)
    results["bound_std"].values[...] = results["bound_std"].values[:1, :, :1]
    bound = results["bound_std"].values
    results["rotation_error_rad"].values[...] = rng.normal(size=(*bound.shape[:3], 3)) * (
        bound[..., :3])
    results["translation_error_m"].values[..., 2] = rng.normal(size=bound.shape[:3]) * (
        bound[..., 5])
    results["true_tvec_m"].values[...] = 1.0 + np.arange(5)[:, None, None]
    answer = efficiency(results, ["regime"])
    covered("rotation_efficiency", held(answer, "rotation_efficiency", 1.0), count)
    covered("range_efficiency", held(answer, "range_efficiency", 1.0), count)


def test_without_a_bound_there_is_no_efficiency(mixed):
    nothing = mixed.assign(bound_std=mixed["bound_std"] * np.nan)
    for results in (mixed.drop_vars(["bound_std", "pose_parameter"]), nothing):
        answer = efficiency(results, ["solver"])
        assert answer["rotation_efficiency"].dims == ("solver",)
        assert all(array.isnull().all() for array in answer.values())


# Covariances.

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
    assert answer["covariance_coverage"].dims == ("solver", "level")
    assert answer["level"].values.tolist() == [0.5, 0.9, 0.99]
    for k, level in enumerate((0.5, 0.9, 0.99)):
        hits = int((results["nees"].values[..., 1] <= stats.chi2.ppf(level, 6)).sum())
        ends = stats.binomtest(hits, 2000).proportion_ci(method="wilson")
        coverage = answer["covariance_coverage"].values[1, k]
        assert coverage == pytest.approx(hits / 2000)
        assert answer["covariance_coverage_low"].values[1, k] == pytest.approx(ends.low)
    scale = xr.DataArray([1.0, 1 / 1.5, 1 / 0.6], {"solver": results["solver"]}, "solver")
    mended = covariance_trust(results, ["solver"], scale=scale)
    assert mended["covariance_trusted"].all()
    kept = covariance_trust(results, ["solver"], scale=scale[::-1].sortby("solver"))
    xr.testing.assert_identical(kept, mended)
    with pytest.raises(ArgumentError, match="scale = array over solver: expected the dataset"):
        covariance_trust(results, ["solver"], scale=scale[:2])
    with pytest.raises(ArgumentError, match="scale = array over lens: no such dimension"):
        covariance_trust(results, [], scale=xr.DataArray([1.0], dims="lens"))


@pytest.mark.parametrize("n", [49, 50, 200])
def test_trust_is_an_interval_for_all_levels_together_within_the_tolerance(n):
    levels, results = (0.5, 0.9, 0.99), measured(np.random.default_rng(17), {"trial": n})
    trusted = []
    for within in range(n // 2, n, 1 + n // 100):
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
    assert covariance_trust(results, [])["covariance_trusted"]
    flipped = results.copy(deep=True)
    flipped["flipped"].values[:, :10] = Flipped.flipped
    flipped["nees"].values[:, :10] = 1e4
    assert not covariance_trust(flipped, [])["covariance_trusted"]
    few = covariance_trust(results.isel(trial=slice(9)), [])
    assert few["nees_count"] == 45
    assert not few["covariance_trusted"]
    assert covariance_trust(results.isel(trial=slice(10)), [])["nees_count"] == 50
    none = covariance_trust(results.drop_vars("nees"), ["marker_id"])
    assert not none["covariance_trusted"].any()
    assert (none["nees_count"] == 0).all()
    assert none["nees_mean"].isnull().all()
    infinite = results.copy(deep=True)
    infinite["nees"].values[0, 0] = np.inf
    assert covariance_trust(infinite, [])["nees_mean"] == np.inf


# Renderers.

def test_renderers_are_compared_pose_by_pose():
    rng = np.random.default_rng(16)
    plain = measured(rng, RENDERED)
    results = with_flags_of_every_kind(rng, plain)
    results["true_tvec_m"].values[...] = plain["true_tvec_m"].values[:1]
    names = ["warp", "exact", "supersample-4"]
    answer = renderer_bias(results.assign_coords(renderer=names))
    assert answer["corner_shift_rms_px"].dims == ("renderer", "cornerRefinementMethod")
    assert answer["range_bias_percent"].dims == ("renderer", "cornerRefinementMethod", "solver")
    exact = answer.sel(renderer="exact")
    assert (exact["differing"] == 0).all()
    assert (exact["rotation_shift_deg_high"] == 0).all()
    for r, d, s in itertools.product(range(3), range(2), range(2)):
        kept = {"cornerRefinementMethod": d, "solver": s}
        pairs = list(zip(poses(results, renderer=r, **kept), poses(results, renderer=1, **kept),
                         strict=True))
        aimed = [(a, b) for a, b in pairs if looked_for(a) and looked_for(b)]
        seen = [[p["detection"] == DetectionStatus.detected for p in pair] for pair in aimed]
        shifts = [a["corner_error_px"].astype(float) - b["corner_error_px"]
                  for (a, b), both in zip(aimed, seen, strict=True) if all(both)]
        ranges = [(percent(a) - percent(b))[0] for a, b in aimed if is_solved(a) and is_solved(b)]
        turns = [np.degrees(a["rotation_error_rad"] - b["rotation_error_rad"])
                 for a, b in aimed if is_unflipped(a) and is_unflipped(b)]
        here = answer.isel(renderer=r, **kept)
        assert here["compared"] == len(aimed)
        assert here["differing"] == sum(a != b for a, b in seen)
        assert here["detection_disagreement"] == sum(a != b for a, b in seen) / len(aimed)
        assert here["corner_shift_rms_px"].item() == pytest.approx(
            rms(np.ravel(shifts).tolist()), rel=1e-12)
        assert here["range_bias_percent"].item() == pytest.approx(
            math.fsum(ranges) / len(ranges), rel=1e-9, abs=1e-12)
        assert here["rotation_shift_deg"].item() == pytest.approx(
            rms([math.hypot(*turn) for turn in turns]), rel=1e-12)


def test_what_one_renderer_has_not_run_is_no_draw():
    sizes = {"renderer": 2, "marker_id": 3, "trial": 9} | SETTINGS
    results = measured(np.random.default_rng(19), sizes)
    results["estimate"].values[:, :, ::3] = (
        EstimateStatus.no_detection
    )  # so that draws without count
    results["detection"].values[:, :, ::3] = DetectionStatus.rejected
    short = renderer_bias(results.isel(trial=slice(5)), reference="0")
    results["detection"].values[0, :, 5:] = DetectionStatus.not_run
    results["estimate"].values[0, :, 5:] = EstimateStatus.not_run
    results["detection"].values[1, :, 8:] = DetectionStatus.not_run
    results["estimate"].values[1, :, 8:] = EstimateStatus.not_run
    xr.testing.assert_allclose(renderer_bias(results, reference="0"), short, rtol=1e-12)
    flipped = results.assign_coords(renderer=["b", "a"])
    assert (renderer_bias(flipped, "a")["range_bias_percent_low"].sel(renderer="b").values
            == -renderer_bias(flipped, "b")["range_bias_percent_high"].sel(renderer="a")).all()


def test_a_renderer_that_is_not_there_is_refused(mixed):
    with pytest.raises(DatasetError, match=r"^renderer: no such dimension; there are distance_m"):
        renderer_bias(mixed)
    renamed = mixed.isel(marker_id=[0, 1]).assign_coords(marker_id=["warp", "fine"])
    with pytest.raises(ArgumentError, match="reference = exact: the renderers are warp, fine"):
        renderer_bias(renamed.rename(marker_id="renderer"))
