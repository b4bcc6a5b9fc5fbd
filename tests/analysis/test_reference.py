"""The analysis functions against plain NumPy on all poses of small datasets.

The references follow the definitions of the functions' descriptions, and SciPy's distributions. Of
`sweep.analysis` they use the intervals of a proportion, which have tests of their own.
"""

import functools
import math

import numpy as np
import pytest
import xarray as xr
from scipy import special, stats

from support.small_datasets import (
    ALL,
    GRIDS,
    INNER,
    QUANTITIES,
    SHARES,
    assert_values,
    draws_in,
    freedom_in,
    is_detected,
    is_run,
    is_solved,
    is_unflipped,
    lengths_of,
    looked_for,
    mean_of,
    mean_vector,
    named,
    perfect,
    poses,
    rate,
    root_mean_square,
    spread,
    student,
)
from sweep.analysis import detection_rate, error_statistics, failure_composition, flip_rate
from sweep.errors import ArgumentError, DatasetError
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped


def bias(used, vectors, run):
    """Return the length of the mean vector, or the signed mean of what has one component."""
    if not len(used):
        return math.nan, math.nan, math.nan
    centre = mean_vector(vectors)
    if len(centre) == 1:
        return student(*mean_of(used, vectors[:, 0], run))
    length = np.linalg.norm(centre)
    mean, error, freedom = mean_of(used, vectors @ (centre / length), run)
    if math.isnan(error):
        return length, math.nan, math.nan
    _, _, high = student(mean, error, freedom)
    if freedom <= 2:
        return length, 0.0, high
    scheffe = math.sqrt(3 * freedom / (freedom - 2) * special.fdtri(3, freedom - 2, 0.95))
    return length, max(0.0, mean - scheffe * error), high


@functools.cache
def ranks(n, p):
    """Return the ranks, from 1, between which the p-quantile lies but for 2.5 % at each end."""
    return stats.binom.ppf(0.025, n, p), stats.binom.ppf(0.975, n, p) + 1


def order_statistics(values, of, share):
    """Return a quantile and its interval: David and Nagaraja 2003, section 7.1."""
    n, draws, p = len(values), draws_in(of), share / 100
    if n == 0:
        return math.nan, math.nan, math.nan
    ordered = sorted(values)
    value = next(v for k, v in enumerate(ordered) if 100 * (k + 1) >= share * n)
    if freedom_in(of) == 0:
        return value, math.nan, math.nan
    first, last = ranks(draws, p)
    low = ordered[int(first) * n // draws - 1] if first >= 1 else math.nan
    high = ordered[math.ceil(int(last) * n / draws) - 1] if last <= draws else math.nan
    return value, low, high


def expected_detection(found):
    aimed = found.where(looked_for(found))
    hits = int(is_detected(aimed).sum())
    return {"looked_for": len(aimed), "detected": hits, "draws": draws_in(aimed),
            **rate("detection_rate", aimed, hits)}


def expected_flips(found):
    solved = found.where(is_solved(found))
    hits = int((solved["flipped"] == Flipped.flipped).sum())
    return {"solved": len(solved), "flipped": hits, "draws": draws_in(solved),
            **rate("flip_rate", solved, hits)}


OF_LOOKED_FOR = ("solved", "wrong_id", "rejected", "no_candidate", "no_board", "solver_failed",
                 "not_converged", "not_explained", "too_few_points", "failed", "crashed")
OUTCOMES = (*OF_LOOKED_FOR, "not_visible", "not_modelled", "not_in_photograph", "not_on_board",
            "not_run", "not_needed")


def expected_composition(found):
    """Return {"count solved": ..., "share solved": ..., ...}."""
    aimed, out = found.where(looked_for(found)), {}
    outcome = [EstimateStatus(estimate).name if detection == DetectionStatus.detected else
               DetectionStatus(detection).name for detection, estimate in zip(
                   found["detection"].tolist(), found["estimate"].tolist(), strict=True)]
    for name in OUTCOMES:
        count = outcome.count(name)
        values = dict.fromkeys(("share", "share_low", "share_high"), math.nan)
        if name in OF_LOOKED_FOR:
            values = rate("share", aimed, count)
        out |= {f"{key} {name}": value for key, value in ({"count": count} | values).items()}
    return out


def by_outcome(answer):
    """Return the table with a variable for each outcome."""
    assert tuple(answer["outcome"].values) == OUTCOMES
    return xr.Dataset({f"{key} {name}": array.isel(outcome=k, drop=True)
                       for key, array in answer.data_vars.items()
                       for k, name in enumerate(OUTCOMES)})


def expected_errors(found):
    aimed, run = found.where(looked_for(found)), found.where(is_run(found))
    solved = aimed.where(is_solved(aimed))
    unflipped, flips = (solved.where(is_unflipped(solved) == right) for right in (True, False))
    out = {"looked_for": len(aimed), "solved": len(solved),
           **rate("solved_rate", aimed, len(solved))}
    for name, (unit, error) in QUANTITIES.items():
        right = unflipped, error(unflipped), run
        out |= named(f"{name}_bias_{unit}", bias(*right))
        out |= named(f"{name}_sd_{unit}", spread(*right))
        out |= named(f"{name}_rmse_unflipped_{unit}", root_mean_square(*right))
        rmse = root_mean_square(solved, error(solved), run)
        if name == "rotation":
            parts = [root_mean_square(*right), root_mean_square(flips, error(flips), run)]
            rmse = rmse[0], *ends_with_flips(rmse[0], solved, len(flips), parts)
        out |= named(f"{name}_rmse_{unit}", rmse)
        sizes = np.where(is_solved(aimed), lengths_of(error(aimed)), math.inf).tolist()
        for label, share in SHARES.items():
            out |= named(f"{name}_{label}_{unit}", order_statistics(sizes, aimed, share))
    return out


def ends_with_flips(value, solved, flips, parts, bound=180.0):
    """Return the least and the largest RMS over the ends of the share of flips and of both RMS.

    ``parts`` are the RMS with their ends of the right poses and of the flips.
    """
    if freedom_in(solved) == 0:
        return math.nan, math.nan
    n, draws = len(solved), draws_in(solved)
    few, many = flips * draws // n, -(-flips * draws // n)
    shares = [0.0 if few == 0 else stats.beta.ppf(0.025, few, draws - few + 1),
              1.0 if many == draws else stats.beta.ppf(0.975, many + 1, draws - many)]
    (_, *u), (_, *v) = parts
    lows = [next((low for low in (own, other) if not math.isnan(low)), 0.0)
            for own, other in ((u[0], v[0]), (v[0], u[0]))]
    highs = [bound if math.isnan(high) else min(high, bound) for high in (u[1], v[1])]
    low, high = ([math.sqrt((1 - p) * parts[0]**2 + p * parts[1]**2) for p in shares]
                 for parts in (lows, highs))
    return min(value, *low), max(value, *high)


def assert_all_agree(answer, groups, names, expected):
    """Compare every kept combination; ``names`` are the kept dimensions."""
    arrays = {name: array.transpose(*names).values for name, array in answer.data_vars.items()}
    assert not set(next(iter(arrays.values())).shape) - {answer.sizes[name] for name in names}
    for index, found in groups.items():
        here = {name: array[index] for name, array in arrays.items()}
        assert_values(here, expected(found), dict(zip(names, index, strict=True)))


def compositions(results, per=(), **options):
    """Return the composition of failures with a variable for each outcome."""
    return by_outcome(failure_composition(results, per, **options).compute())


FUNCTIONS = pytest.mark.parametrize(("function", "of", "expected"), [
    (detection_rate, "detection", expected_detection), (flip_rate, "estimate", expected_flips),
    (compositions, "estimate", expected_composition),
    (error_statistics, "estimate", expected_errors),
])


@functools.cache
def poses_of(grid, of, per):
    return poses(GRIDS[grid], of, per)


@FUNCTIONS
@pytest.mark.parametrize(("grid", "per"), [
    ("all", ()), ("all", ("noise_grey", "cornerRefinementMethod")), ("all", ("trial", "marker_id")),
    ("small", tuple(n for n in ALL if n != "solver")), ("plain", ("marker_id", "distance_m")),
    ("plain", ("trial",)), ("draws", ("marker_id",)), ("no trial", ("cornerRefinementMethod",)),
    ("one trial", ("tilt_deg",)), ("only trial", ()), ("small", tuple(ALL)),
    ("settings first", ("cornerRefinementMethod", "solver")),
])
def test_values_and_intervals_are_those_of_plain_loops(function, of, expected, grid, per):
    results = GRIDS[grid]
    per = tuple(name for name in per if name in results[of].dims)
    assert_all_agree(function(results, per), poses_of(grid, of, per), per, expected)
    turned = results.transpose("xyz", *[n for n in results.dims if n not in INNER][::-1], ...)
    assert_all_agree(function(turned, per), poses_of(grid, of, per), per, expected)


EDGES = [100.0, 200.0, 450.0, 451.0, 2000.0]


@FUNCTIONS
@pytest.mark.parametrize(("grid", "per", "bins"), [
    ("all", (), {"marker_area_px": EDGES}), ("all", ("tilt_deg",), {"marker_area_px": EDGES}),
    ("only trial", ("trial",), {"marker_area_px": EDGES}),
    ("plain", ("marker_id",), {"distance_m": [0.3, 0.8, 1.0]}),
    ("all", (), {"side_px": [12.0, 20.0]}),
])
def test_bins_are_those_of_plain_loops(function, of, expected, grid, per, bins):
    results = GRIDS[grid]
    answer = function(results, per, bins=bins)
    names = (*per, *bins)
    assert tuple(next(iter(answer.values())).dims) == names
    assert_all_agree(answer, poses(results, of, per, bins), names, expected)
    for name, edges in bins.items():
        np.testing.assert_allclose(answer[name], (np.array(edges[1:]) + edges[:-1]) / 2)
        np.testing.assert_array_equal(answer[f"{name}_low"], edges[:-1])
        np.testing.assert_array_equal(answer[f"{name}_high"], edges[1:])


def test_a_small_spread_about_a_large_bias_keeps_its_digits():
    rng = np.random.default_rng(11)
    sizes = {"marker_id": 3, "trial": 40}
    vectors = 1.0 + 1e-5 * rng.normal(size=(*sizes.values(), 3)) + 1e-4 * np.arange(3)[
        :, None, None]
    results = perfect(rng, sizes, rotation=vectors, position=1e3 * vectors)
    assert_all_agree(
        error_statistics(results), poses(results, "estimate"), (), expected_errors)


def test_what_was_cut_away_was_not_run():
    whole = GRIDS["draws"]
    cut = whole.where(whole["marker_area_px"] > float(whole["marker_area_px"].median()))
    kept = {"marker_area_px": [float(np.nextafter(whole["marker_area_px"].median(), np.inf)), 1e9]}
    expected = detection_rate(whole, bins=kept).isel(marker_area_px=0)
    for name in ("looked_for", "detected", "detection_rate"):
        assert detection_rate(cut)[name] == expected[name], name


def test_a_solved_pose_without_a_number_counts_in_no_mean():
    results = perfect(np.random.default_rng(2), {"trial": 60})
    results["rotation_error_rad"].values[:3] = np.nan
    answer = error_statistics(results)
    without = error_statistics(results.isel(trial=slice(3, None)))
    for name in ("rotation_rmse_deg", "rotation_sd_deg", "rotation_bias_deg"):
        assert answer[name].item() == pytest.approx(without[name].item(), rel=1e-12), name
    assert answer["rotation_p99_deg"] == np.inf


@pytest.mark.parametrize(("change", "arguments", "error", "message"), [
    (None, {"per": ("speed",)}, ArgumentError, r"^per = speed: no .*; there.*tilt_deg.*trial"),
    (lambda r: r.assign_coords(size_m=("tilt_deg", [0.1, 0.2])), {"per": ["size_m"]}, ArgumentError,
     "size_m: goes with the axis tilt_deg: name that"),
    (None, {"per": None}, ArgumentError, "names of dimensions"),
    (None, {"bins": {"speed": [0.0, 1.0]}}, ArgumentError, "bins = speed: no such variable"),
    (None, {"bins": ["marker_area_px"]}, ArgumentError, "names with edges"),
    (None, {"bins": {"marker_area_px": [1, np.nan]}}, ArgumentError, "increasing edges"),
    (lambda r: r.drop_vars("estimate"), {}, DatasetError, "no variable estimate; there are"),
    (lambda _: xr.Dataset(), {}, DatasetError, "no variable detection, estimate"),
    (lambda r: r.isel(trial=slice(0)), {}, DatasetError, "trial has no values"),
])
def test_arguments_that_cannot_be_are_refused_in_one_line(change, arguments, error, message):
    results = GRIDS["draws"] if change is None else change(GRIDS["draws"])
    with pytest.raises(error, match=message) as refused:
        detection_rate(results, **arguments)
    assert "\n" not in str(refused.value)
