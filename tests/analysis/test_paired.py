"""Rankings, comparisons, limits against plain loops, exact distributions, published values."""

import math

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from support.small_datasets import (
    QUANTITIES,
    assert_agrees,
    freedom_in,
    holm,
    is_detected,
    is_run,
    is_solved,
    lengths_of,
    looked_for,
    mean_of,
    mixed,
    named,
    perfect,
    poses,
    rate,
    student,
    students,
    wilson,
    with_detected,
)
from sweep.analysis import compare, marker_ranking
from sweep.measure.flags import Flipped


def hypergeometric_parts(aimed, marker):
    """Return an ID's hits and, of each cell that it was in, (looked for, its, hits) of all IDs.

    ``aimed`` are the poses that were looked for, by ID.
    """
    own, parts = aimed[marker], []
    for cell in np.unique(own.cell):
        total = sum(int((each.cell == cell).sum()) for each in aimed)
        hits = sum(int(is_detected(each)[each.cell == cell].sum()) for each in aimed)
        parts.append((total, int((own.cell == cell).sum()), hits))
    return int(is_detected(own).sum()), parts


def cumulants(parts):
    """Return mean, variance and third central moment of the sum, from SciPy."""
    moments = [stats.hypergeom.stats(n, k, m, moments="mvs") for n, m, k in parts]
    mean, variance, skewness = np.nan_to_num(np.array(moments, float).T, posinf=0.0, neginf=0.0)
    return mean.sum(), variance.sum(), (skewness * variance**1.5).sum()


RANKED = {
    "kept": (mixed({"trial": 20, "marker_id": 4, "tilt_deg": 2, "side_px": 3}, 2), ("tilt_deg",)),
    "dictionaries": (mixed({"dictionary": 2, "marker_id": 3, "trial": 25}, 3), ()),
    "kept setting": (
        mixed({"noise_grey": 2, "marker_id": 3, "side_px": 2, "trial": 25}, 4), ("noise_grey",)),
}


def assert_is_pearsons_curve(p_value, hits, parts):
    """Compare with twice the smaller tail of Pearson's third curve."""
    mean, variance, third = cumulants(parts)
    curve = stats.pearson3(third / variance**1.5, mean, math.sqrt(variance))
    tails = curve.cdf(hits + 0.5), curve.sf(hits - 0.5)
    assert p_value == pytest.approx(min(1.0, 2 * min(tails)), rel=1e-9)


@pytest.mark.parametrize("case", RANKED)
def test_rates_and_p_values_of_ids_are_those_of_plain_loops(case):
    results, per = RANKED[case]
    answer = marker_ranking(results, per).compute()
    kept = (*per, "dictionary") if "dictionary" in results.dims else per
    assert set(answer["looked_for"].dims) == {*kept, "marker_id"}
    adjusted = holm(answer["p_value"].transpose(*kept, "marker_id").values.ravel().tolist())
    np.testing.assert_allclose(
        answer["p_adjusted"].transpose(*kept, "marker_id").values.ravel(), adjusted, rtol=1e-12)
    markers = range(results.sizes["marker_id"])
    found = poses(results, "detection", (*kept, "marker_id"))
    for index in {index[:-1] for index in found}:
        some = [found[*index, marker] for marker in markers]
        aimed = [each.where(looked_for(each)) for each in some]
        for marker, own in enumerate(aimed):
            hits, parts = hypergeometric_parts(aimed, marker)
            expected = {"looked_for": len(own), **rate("detection_rate", own, hits),
                        "expected_rate": cumulants(parts)[0] / len(own)}
            at = dict(zip((*kept, "marker_id"), (*index, marker), strict=True))
            assert_agrees(answer, at, expected)
            here = answer.isel(at)
            assert_is_pearsons_curve(here["p_value"].item(), hits, parts)
            below = here["detection_rate"] < here["expected_rate"]
            assert here["weak"].item() == bool(below and here["p_adjusted"] < 0.05)
        here = answer.isel(dict(zip(kept, index, strict=True)))
        assert here["weak"].dtype == bool


def newcombe(both, first, second, neither):
    """Return the difference of two paired rates, second minus first, and its interval.

    Newcombe, Statistics in Medicine 17, 1998, 2635-2650, method 10.
    """
    n = both + first + second + neither
    one, two = (both + first) / n, (both + second) / n
    (low1, high1), (low2, high2) = wilson(both + first, n), wilson(both + second, n)
    margins = (both + first) * (second + neither) * (both + second) * (first + neither)
    product = both * neither - first * second
    if product > 0:
        product = max(product - n / 2, 0)
    phi = product / math.sqrt(margins) if margins else 0.0
    difference = two - one
    below, above, over, under = two - low2, high2 - two, high1 - one, one - low1
    low = difference - math.sqrt(below**2 - 2 * phi * below * over + over**2)
    high = difference + math.sqrt(above**2 - 2 * phi * above * under + under**2)
    return difference, low, high


@pytest.mark.parametrize(("table", "low", "high"), [
    # Newcombe 1998, table III: 36 both, 12 and 2 one only, 0 neither.
    ((36, 2, 12, 0), 0.0569, 0.3404),
    # Fagerland, Lydersen and Laake, "Statistical Analysis of Contingency Tables", 2017, chapter 8
    # (their R package's test): complete response before and after a therapy.
    ((59, 16, 6, 80), -0.1186, -0.0046),
])
def test_the_difference_of_two_rates_is_the_published_one(table, low, high):
    results = perfect(np.random.default_rng(16), {"trial": sum(table)})
    seen = np.repeat([[1, 1], [1, 0], [0, 1], [0, 0]], table, axis=0).astype(bool)
    answer = compare(*(with_detected(results, seen[:, k]) for k in range(2))).compute()
    assert [answer[name].item() for name in (
        "both_detected", "only_first_detected", "only_second_detected", "neither_detected",
    )] == list(table)
    assert round(answer["detection_difference_low"].item(), 4) == low
    assert round(answer["detection_difference_high"].item(), 4) == high


def tally(compared, mask, names):
    """Return how many pairs both, the first, the second and neither are of a mask."""
    one, two = map(mask, compared)
    return dict(zip(names, (int(each.sum()) for each in (
        one & two, one & ~two, ~one & two, ~one & ~two)), strict=True))


def expected_seen(first, second):
    """Of the estimates' poses: a detection counts with each of its estimators."""
    both_looked = looked_for(first) & looked_for(second)
    compared = [each.where(both_looked) for each in (first, second)]
    out = {"compared": len(compared[0])} | tally(compared, is_detected, (
        "both_detected", "only_first_detected", "only_second_detected", "neither_detected"))
    unknown = named("detection_difference", [math.nan] * 3) | {"detection_p_value": math.nan}
    if not len(compared[0]):
        return out | unknown
    _, *counts = out.values()
    difference, low, high = newcombe(*counts)
    if freedom_in(compared[0]) == 0:
        return out | unknown | {"detection_difference": difference}
    _, one, two, _ = counts
    return out | named("detection_difference", (difference, low, high)) | {
        "detection_p_value": stats.binomtest(one, one + two).pvalue if one + two else 1.0}


def expected_solved(first, second):
    both_looked = looked_for(first) & looked_for(second)
    compared = [each.where(both_looked) for each in (first, second)]
    run = first.where(is_run(first) & is_run(second))
    out = tally(compared, is_solved, (
        "both_solved", "only_first_solved", "only_second_solved", "neither_solved"))
    both = is_solved(compared[0]) & is_solved(compared[1])
    solved = [each.where(both) for each in compared]
    flips = [each["flipped"] == Flipped.flipped for each in solved]
    out |= {"only_first_flipped": int((flips[0] & ~flips[1]).sum()),
            "only_second_flipped": int((flips[1] & ~flips[0]).sum())}
    for name, (unit, error) in QUANTITIES.items():
        one, two = (lengths_of(error(each)) for each in solved)
        out |= named(f"{name}_difference_{unit}", student(*mean_of(solved[0], two - one, run)))
        out |= named(f"{name}_rmse_ratio", ratio_of(solved[0], one, two, run))
        if name == "rotation":
            right = ~flips[0] & ~flips[1]
            out |= named(f"{name}_rmse_unflipped_ratio", ratio_of(
                solved[0].where(right), one[right], two[right], run))
    return out


def ratio_of(used, first, second, run):
    """Return the ratio of two RMS and its interval: of the logarithm, by the delta method."""
    if not len(used):
        return math.nan, math.nan, math.nan
    squares = [(sizes**2).mean() for sizes in (first, second)]
    ratio = math.sqrt(squares[1] / squares[0])
    relative = second**2 / squares[1] - first**2 / squares[0]
    _, deviation, freedom = mean_of(used, relative, run)
    half = deviation / 2 * students(freedom)
    return ratio, ratio * math.exp(-half), ratio * math.exp(half)


PAIRED = {"trial": 40, "tilt_deg": 2, "marker_id": 2}


SOLVERS = mixed({**PAIRED, "solver": 2}, 10)
DETECTORS = mixed({**PAIRED, "cornerRefinementMethod": 2, "solver": 1}, 11)
FEW_LOST = mixed({**PAIRED, "solver": 2}, 10, good=0.97)
AREAS = {"marker_area_px": [100.0, 300.0, 600.0, 1001.0]}


@pytest.mark.parametrize(("results", "name", "per", "bins"), [
    (SOLVERS, "solver", ("trial",), {}),
    (SOLVERS, "solver", ("tilt_deg",), AREAS),
    (DETECTORS, "cornerRefinementMethod", ("marker_id", "tilt_deg"), {}),
    (FEW_LOST, "solver", ("tilt_deg",), {}),
], ids=["trials", "bins", "detectors", "few lost"])
def test_comparisons_are_those_of_plain_loops(results, name, per, bins):
    first, second = (results.isel({name: k}) for k in range(2))
    answer = compare(first, second, per, bins=bins).compute()
    names = (*per, *bins)
    assert tuple(answer["compared"].dims) == names
    ones, others = (poses(side, "estimate", per, bins) for side in (first, second))
    for index, one in ones.items():
        assert_agrees(answer, dict(zip(names, index, strict=True)),
                      expected_seen(one, others[index]) | expected_solved(one, others[index]))


@pytest.mark.parametrize("analysis", [
    marker_ranking, lambda results: compare(results.isel(solver=0), results.isel(solver=1)),
], ids=["ranking", "comparison"])
def test_settings_that_see_the_same_draws_make_nothing_surer(analysis):
    one = FEW_LOST.expand_dims(noise_grey=[1.0])
    many = xr.concat([one.assign_coords(noise_grey=[level]) for level in (1.0, 2.0, 4.0)],
                     dim="noise_grey")
    alone, pooled = analysis(one).compute(), analysis(many).compute()
    for name, array in alone.data_vars.items():
        if array.dtype.kind == "f":
            np.testing.assert_allclose(pooled[name], array, rtol=1e-9, err_msg=name)
