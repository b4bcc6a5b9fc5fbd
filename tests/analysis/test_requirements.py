"""Decisions on requirements are those of plain NumPy and SciPy, condition by condition."""

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from support.small_datasets import perfect, with_detected
from sweep.analysis.requirements import (
    Decision,
    Reach,
    check_requirements,
    combined_decision,
    parse_requirements,
    requirement_limits,
    verdicts,
)
from sweep.errors import ArgumentError
from sweep.measure.flags import DetectionStatus, EstimateStatus


def ends_of(variable, results, level):
    """Return the ends of the interval of a condition as SciPy has them."""
    errors = np.abs(np.float32(
        results["translation_error_m"][..., 0] if variable.startswith("x") else
        100.0 * results["translation_error_m"][..., 2] / results["true_tvec_m"][..., 2])).ravel()
    if variable == "detection_rate":
        hits = int((results["detection"] == DetectionStatus.detected).sum())
        return stats.binomtest(hits, len(errors)).proportion_ci(level, method="exact")
    if variable == "x_bias_m":
        signed = results["translation_error_m"].values[..., 0].astype(float).ravel()
        return np.abs(stats.ttest_1samp(signed, 0.0).confidence_interval(level))[::-1]
    share = {"range_median_percent": 0.5, "x_p95_m": 0.95}[variable]
    low, high = stats.binom.ppf([(1 - level) / 2, (1 + level) / 2], len(errors), share).astype(int)
    return np.sort(errors)[[low - 1, min(high, len(errors) - 1)]]


@pytest.mark.parametrize(("variable", "level"), [
    ("detection_rate", 0.95), ("range_median_percent", 0.95), ("x_p95_m", 0.95),
    ("x_bias_m", 0.99)])
@pytest.mark.parametrize("side", [0, 1])
def test_decisions_change_at_the_ends_of_scipys_intervals(variable, level, side):
    """Met at the level of one condition, not met at half the error probability, for one of two."""
    results = perfect(np.random.default_rng(3), {"side_px": 2, "trial": 200, "solver": 1},
                      position=-np.random.default_rng(4).normal(0.01, 0.01, (2, 200, 1, 3)))
    if variable == "detection_rate":
        results["detection"].values[:, :5] = DetectionStatus.no_candidate
    part = results.isel(side_px=side)
    low, high = ends_of(variable, part, level)
    lower, upper = ends_of(variable, part, (1.0 + level) / 2.0)
    for relation, end, factor, decision in (
            (">=", low, 0.9999, Decision.met), (">=", low, 1.0001, Decision.undecided),
            ("<=", high, 1.0001, Decision.met), ("<=", high, 0.9999, Decision.undecided),
            (">=", upper, 1.0001, Decision.not_met), (">=", upper, 0.9999, Decision.undecided),
            ("<=", lower, 0.9999, Decision.not_met), ("<=", lower, 1.0001, Decision.undecided)):
        text = f"{variable} {relation} {end * factor:.12g}"
        table = check_requirements(results, [text], per=["side_px"])
        assert table["decision"].values[0, side, 0] == decision, text


def detected_by_distance(shares, trials=100, tilts=None):
    """Return a dataset of which such shares of the draws are detected, at 1, 2, ... m."""
    sizes = {"distance_m": len(shares), **({"tilt_deg": len(tilts)} if tilts else {}),
             "trial": trials, "solver": 1}
    results = perfect(np.random.default_rng(4), sizes)
    results["distance_m"] = np.arange(1.0, len(shares) + 1.0)
    shares = np.array(shares, dtype=float)
    if tilts:
        shares = np.minimum(shares[:, None], np.array(tilts)[None])
    return with_detected(results, np.arange(trials) < np.rint(shares[..., None] * trials))


@pytest.mark.parametrize(("rates", "reach", "ends", "fails", "beyond"), [
    ([1.0, 1.0, 0.97, 0.85, 0.2], Reach.found, [1.0, 3.0, 3.0, 4.0], (4.0, 0.85), (0.0, None)),
    # A dip ends it.
    ([1.0, 0.6, 1.0, 1.0], Reach.found, [1.0, 1.0, 1.0, 1.0], (2.0, 0.6), (2.0, 4.0)),
    # It need not begin at the easiest value.
    ([0.6, 1.0, 0.6, 1.0, 1.0, 0.6], Reach.within, [4.0, 5.0, 5.0, 5.0], (6.0, 0.6), (0.0, None)),
])
def test_the_limit_along_distance_has_an_interval_and_a_cause(rates, reach, ends, fails, beyond):
    required = ["detection >= 0.9", "rotation_median_deg <= 90"]
    one = requirement_limits(detected_by_distance(rates), required, "distance_m").isel(solver=0)
    assert Reach(int(one["reach"])) is reach
    assert [float(one[name]) for name in ("start", "low", "value", "high")] == ends
    assert (float(one["fails_at"]), float(one["failing_value"])) == pytest.approx(fails)
    assert one["limited_by"].item() == "detection_rate >= 0.9"
    assert float(one["met_beyond"]) == beyond[0]
    assert beyond[1] in {None, float(one["farthest_beyond"])}
    assert one["keeps"].values.tolist() == [rate >= 0.9 for rate in rates]


def test_requirements_hold_at_all_tilts_together():
    results = detected_by_distance([1.0, 1.0, 1.0], tilts=[1.0, 0.5])
    apart = requirement_limits(results, ["detection >= 0.9"], "distance_m")
    assert [Reach(int(each)).name for each in apart["reach"].isel(solver=0)] == ["always", "never"]
    together = requirement_limits(results, ["detection >= 0.9"], "distance_m", at_all=["tilt_deg"])
    assert Reach(int(together["reach"].isel(solver=0))) is Reach.never
    assert together["fails_where"].item() == "tilt_deg = 30"


@pytest.mark.parametrize(("axis", "met", "ends"), [
    ("distance_m", True, (0.8, np.inf)), ("distance_m", False, (-np.inf, -np.inf)),
    ("side_px", True, (-np.inf, 12.0)), ("side_px", False, (np.inf, np.inf)),
])
def test_a_limit_beyond_the_grid_has_an_infinite_end(axis, met, ends):
    results = perfect(np.random.default_rng(1), {axis: 3, "trial": 100})
    if not met:
        results["detection"][:] = DetectionStatus.no_candidate
    one = requirement_limits(results, ["detection >= 0.9"], axis)
    assert (float(one["low"]), float(one["high"])) == ends
    assert Reach(int(one["reach"])) is (Reach.always if met else Reach.never)


@pytest.mark.parametrize(("axis", "harder"), [
    ("side_px", "downwards"), ("size_m", "downwards"), ("fx_px", "downwards"),
    ("focal_length_mm", "downwards"), ("hfov_deg", "upwards"), ("pixel_size_um", "upwards")])
def test_a_limit_is_read_towards_smaller_markers(axis, harder):
    rates = [0.5, 0.5, 1.0, 1.0][::-1 if harder == "upwards" else 1]
    results = detected_by_distance(rates).rename(distance_m=axis)
    one = requirement_limits(results, ["detection >= 0.9"], axis).isel(solver=0)
    assert one.attrs["harder"] == harder
    assert float(one["value"]) == (2.0 if harder == "upwards" else 3.0)
    assert Reach(int(one["reach"])) is Reach.found
    assert float(one["low"]) <= float(one["value"]) <= float(one["high"])


@pytest.mark.parametrize("parts", [2, 0])
def test_an_axis_with_repeated_values_or_without_any_has_no_limit(parts):
    results = detected_by_distance([1.0, 1.0])
    results = xr.concat([results] * 2, "distance_m") if parts else results.isel(distance_m=[])
    with pytest.raises(ArgumentError, match=r"distance_m: expected an axis .* each once"):
        requirement_limits(results, ["detection >= 0.9"], "distance_m")


def test_verdicts_are_of_the_worst_condition():
    table = check_requirements(detected_by_distance([1.0, 0.97, 0.2]), ["detection >= 0.9"],
                               per=["distance_m"])
    (verdict,) = verdicts(table)
    assert verdict.decision is Decision.not_met is Decision(
        int(combined_decision(table["decision"].to_numpy())))
    assert verdict.condition == {"distance_m": 3.0}
    assert verdict.value == pytest.approx(0.2)
    assert verdict.counts == {Decision.met: 2, Decision.not_met: 1}


def test_about_as_many_draws_as_are_said_decide():
    few = check_requirements(detected_by_distance([0.97], trials=100), ["detection >= 0.95"])
    assert Decision(int(few["decision"].item())) is Decision.undecided
    needed = int(few["draws_needed"].item())
    assert needed > 100
    many = check_requirements(detected_by_distance([0.97], trials=needed), ["detection >= 0.95"])
    assert Decision(int(many["decision"].item())) is Decision.met


@pytest.mark.parametrize(("trials", "limit"), [(2, 100.0), (40, 100.0), (60, 1.1)])
def test_draws_that_a_spread_needs_follow_from_its_interval_on_the_scale_of_logarithms(
    trials, limit
):
    results = detected_by_distance([1.0], trials=trials)
    errors = results["translation_error_m"].values[..., 0]
    errors[...] = np.random.default_rng(8).normal(0.0, 1e-4, errors.shape)
    limit *= np.std(errors, ddof=1)
    table = check_requirements(results, [f"x_sd_m <= {limit:.9g}"])
    assert Decision(int(table["decision"].item())) is Decision.undecided
    reach = np.log(table["high"].item() / table["value"].item()) / np.log(
        limit / table["value"].item())
    expected = 50 if trials < 50 else trials * reach**2
    assert table["draws_needed"].item() == pytest.approx(expected, rel=0.05)


def test_poses_that_cannot_be_seen_are_no_condition():
    results = detected_by_distance([1.0, 1.0])
    results["detection"].values[1] = DetectionStatus.not_visible
    results["estimate"].values[1] = EstimateStatus.no_detection
    table = check_requirements(results, ["detection >= 0.9"], per=["distance_m"])
    assert [Decision(each).name for each in table["decision"].values.ravel()] == [
        "met", "not_applicable"]
    assert verdicts(table)[0].decision is Decision.met


@pytest.mark.parametrize(("texts", "problem"), [
    (["detection"], "expected NAME >= NUMBER"),
    (["detection >= 99 %"], "write 0.99"),
    (["detection >= 1"], "expected a limit above 0 and below 1"),
    (["detektion >= 0.9"], "did you mean detection_rate?"),
    (["rotation_p95_rad <= 1"], "its unit is degrees: write rotation_p95_deg"),
    (["rotation_error <= 5"], "which statistic of it? There are rotation_median_deg, "),
    (["yaw_bias_deg >= -1"], "the absolute value is required"),
    (["rotation_p95_deg >= 200"], "above 0 and below 180"),
    (["detection >= 0.99", "detection <= 0.5"], "contradicts detection_rate <= 0.5"),
    (["detection >= 0.9", "detection >= 0.8"], "another such limit"),
    (["looked_for >= 100", "foo_deg >= 1"], "foo_deg"),  # every fault is told
], ids=str)
def test_a_requirement_that_cannot_be_is_refused(texts, problem):
    with pytest.raises(ArgumentError, match=problem.replace("?", r"\?")) as error:
        parse_requirements(texts)
    assert len(str(error.value).splitlines()) == 1 + ("foo_deg" in problem)
