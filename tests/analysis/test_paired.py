"""Rankings, comparisons, limits against plain loops, exact distributions, published values."""

import itertools
import math

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from support.comparisons import holm, with_detected
from support.small_datasets import (
    QUANTITIES,
    assert_agrees,
    freedom_in,
    is_detected,
    is_run,
    is_solved,
    length,
    looked_for,
    mean_of,
    mixed,
    named,
    perfect,
    pipeline_text,
    poses,
    rate,
    student,
    students,
    wilson,
)
from sweep.analysis import compare, detection_limit, detection_rate, marker_ranking
from sweep.analysis.decisions import Reach
from sweep.errors import DatasetError
from sweep.measure.flags import DetectionStatus, Flipped

# Ranking of marker IDs.

def strata_of(chosen):
    """Return {cell: {marker: [hits, looked for]}} of poses of all IDs.

    ``chosen`` are (marker, cell, pose).
    """
    strata = {}
    for marker, cell, pose in chosen:
        if looked_for(pose):
            counts = strata.setdefault(cell, {}).setdefault(marker, [0, 0])
            counts[0] += is_detected(pose)
            counts[1] += 1
    return strata


def hypergeometric_parts(strata, marker):
    """Return an ID's hits and, of each cell that others were in, (looked for, its, hits)."""
    parts, hits = [], 0
    for counts in strata.values():
        if marker not in counts:
            continue
        own, total = counts[marker], sum(n for _, n in counts.values())
        detected = sum(k for k, _ in counts.values())
        hits += own[0]
        parts.append((total, own[1], detected))
    return hits, parts


def cumulants(parts):
    """Return mean, variance and third central moment of the sum, from SciPy."""
    moments = [stats.hypergeom.stats(n, k, m, moments="mvs") for n, m, k in parts]
    mean, variance, skewness = np.nan_to_num(np.array(moments, float).T, posinf=0.0, neginf=0.0)
    return mean.sum(), variance.sum(), (skewness * variance**1.5).sum()


def of_markers(results, per):
    """Return {kept indices without the marker: (marker, cell, pose)}; cells hold all IDs."""
    names = (*per, "marker_id")
    groups = {}
    for index, chosen in poses(results, "detection", names).items():
        groups.setdefault(index[:-1], []).extend(
            (index[-1], pose["cell"], pose) for pose in chosen)
    return groups


RANKED = {
    "kept": (mixed({"trial": 20, "marker_id": 4, "tilt_deg": 2, "side_px": 3}, 2), ("tilt_deg",)),
    "dictionaries": (mixed({"dictionary": 2, "marker_id": 3, "trial": 25}, 3), ()),
    "kept setting": (
        mixed({"noise_grey": 2, "marker_id": 3, "side_px": 2, "trial": 25}, 4), ("noise_grey",)),
}


def exact_tails(hits, parts):
    """Return P(S <= hits), P(S >= hits) of the sum of the cells' hypergeometric numbers."""
    chances = np.ones(1)
    for total, own, detected in parts:
        k = np.arange(min(own, detected) + 1)
        chances = np.convolve(chances, stats.hypergeom.pmf(k, total, detected, own))
    return chances[: hits + 1].sum(), chances[hits:].sum()


def assert_is_pearsons_curve(p_value, hits, parts):
    """Compare with Pearson's third curve, and with twice the smaller exact tail nearby."""
    mean, variance, third = cumulants(parts)
    curve = stats.pearson3(third / variance**1.5, mean, math.sqrt(variance))
    tails = curve.cdf(hits + 0.5), curve.sf(hits - 0.5)
    assert p_value == pytest.approx(min(1.0, 2 * min(tails)), rel=1e-9)
    exact = min(1.0, 2 * min(exact_tails(hits, parts)))
    assert p_value == pytest.approx(exact, rel=0.03, abs=0.002)


@pytest.mark.parametrize("case", RANKED)
def test_rates_and_p_values_of_ids_are_those_of_plain_loops(case):
    results, per = RANKED[case]
    answer = marker_ranking(results, per).compute()
    kept = (*per, "dictionary") if "dictionary" in results.dims else per
    assert set(answer["looked_for"].dims) == {*kept, "marker_id"}
    adjusted = holm(answer["p_value"].transpose(*kept, "marker_id").values.ravel().tolist())
    np.testing.assert_allclose(
        answer["p_adjusted"].transpose(*kept, "marker_id").values.ravel(), adjusted, rtol=1e-12)
    for index, chosen in of_markers(results, kept).items():
        strata = strata_of(chosen)
        markers = range(results.sizes["marker_id"])
        for marker in markers:
            aimed = [pose | {"cell": cell} for who, cell, pose in chosen
                     if who == marker and looked_for(pose)]
            hits, parts = hypergeometric_parts(strata, marker)
            expected = {"looked_for": len(aimed), **rate("detection_rate", aimed, hits),
                        "expected_rate": cumulants(parts)[0] / len(aimed)}
            at = dict(zip((*kept, "marker_id"), (*index, marker), strict=True))
            assert_agrees(answer, at, expected)
            here = answer.isel(at)
            assert_is_pearsons_curve(here["p_value"].item(), hits, parts)
            below = here["detection_rate"] < here["expected_rate"]
            assert here["weak"].item() == bool(below and here["p_adjusted"] < 0.05)
        here = answer.isel(dict(zip(kept, index, strict=True)))
        assert here["weak"].dtype == bool
        if kept == per:
            assert sorted(here["rank"].values.tolist()) == [m + 1 for m in markers]


# Comparison of two configurations.

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


def pairs_of(first, second, per, bins=None):
    """Return {kept indices: pairs of poses of the same scene}."""
    ones, others = (poses(side, "estimate", per, bins) for side in (first, second))
    groups = {}
    for index, chosen in ones.items():
        at = {pose["at"]: pose for pose in others[index]}
        groups[index] = [(pose, at[pose["at"]]) for pose in chosen]
    return groups


def expected_seen(pairs):
    """Of the estimates' poses: a detection counts with each of its estimators."""
    compared = [pair for pair in pairs if all(map(looked_for, pair))]
    tally = dict.fromkeys(itertools.product((True, False), repeat=2), 0)
    for pair in compared:
        tally[tuple(map(is_detected, pair))] += 1
    both, first = tally[True, True], tally[True, False]
    second, neither = tally[False, True], tally[False, False]
    out = {"compared": len(compared), "both_detected": both, "only_first_detected": first,
           "only_second_detected": second, "neither_detected": neither}
    unknown = named("detection_difference", [math.nan] * 3) | {"detection_p_value": math.nan}
    if not compared:
        return out | unknown
    difference, low, high = newcombe(both, first, second, neither)
    if freedom_in([pose for pose, _ in compared]) == 0:
        return out | unknown | {"detection_difference": difference}
    odd = first + second
    return out | named("detection_difference", (difference, low, high)) | {
        "detection_p_value": stats.binomtest(first, odd).pvalue if odd else 1.0}


def expected_solved(pairs):
    compared = [pair for pair in pairs if all(map(looked_for, pair))]
    run = [pose for pose, other in pairs if is_run(pose) and is_run(other)]
    tally = dict.fromkeys(itertools.product((True, False), repeat=2), 0)
    for pair in compared:
        tally[tuple(map(is_solved, pair))] += 1
    out = {"both_solved": tally[True, True], "only_first_solved": tally[True, False],
           "only_second_solved": tally[False, True], "neither_solved": tally[False, False]}
    solved = [pair for pair in compared if all(map(is_solved, pair))]
    flips = [tuple(pose["flipped"] == Flipped.flipped for pose in pair) for pair in solved]
    out |= {"only_first_flipped": flips.count((True, False)),
            "only_second_flipped": flips.count((False, True))}
    for name, (unit, error) in QUANTITIES.items():
        sizes = [(pose, length(error(pose)), length(error(other))) for pose, other in solved]
        differences = [(pose, second - first) for pose, first, second in sizes]
        out |= named(f"{name}_difference_{unit}", student(*mean_of(differences, run)))
        out |= named(f"{name}_rmse_ratio", ratio_of(sizes, run))
        if name == "rotation":
            unflipped = [size for size, flip in zip(sizes, flips, strict=True) if not any(flip)]
            out |= named(f"{name}_rmse_unflipped_ratio", ratio_of(unflipped, run))
    return out


def ratio_of(sizes, run):
    """Return the ratio of two RMS and its interval: of the logarithm, by the delta method."""
    if not sizes:
        return math.nan, math.nan, math.nan
    squares = [math.fsum(pair[k] ** 2 for pair in sizes) / len(sizes) for k in (1, 2)]
    ratio = math.sqrt(squares[1] / squares[0])
    relative = [(pose, second**2 / squares[1] - first**2 / squares[0])
                for pose, first, second in sizes]
    _, deviation, freedom = mean_of(relative, run)
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
    for index, pairs in pairs_of(first, second, per, bins).items():
        assert_agrees(answer, dict(zip(names, index, strict=True)),
                      expected_seen(pairs) | expected_solved(pairs))


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


def test_other_scenes_and_other_draws_are_not_compared():
    sizes = {"marker_id": 2, "trial": 10}
    first = mixed(sizes, 12)
    other_seed = first.assign_attrs(
        pipeline=pipeline_text(sizes, seed=2), sweep={"fingerprint": {"seed": 2}})
    first = first.assign_attrs(sweep={"fingerprint": {"seed": 1}})
    compare(first, first)
    for second, words in ((first.assign_coords(marker_id=[3, 8]), "marker_id"),
                          (first.isel(trial=slice(5)), "trial"), (other_seed, "seed")):
        with pytest.raises(DatasetError, match=words):
            compare(first, second)


# Limit of detection.


@pytest.mark.parametrize("settings", [2, 3])
def test_all_that_is_looked_for_may_be_found_with_pooled_settings(settings):
    # Some of a draw's settings were not run: a draw is no whole number of poses.
    trials = 60
    results = perfect(np.random.default_rng(18), {
        "regime": trials, "side_px": 2, "trial": trials, "cornerRefinementMethod": settings})
    for missing in range(trials):
        results["detection"].values[missing, :, :missing, 0] = DetectionStatus.not_run
    assert (detection_rate(results, ["regime"])["detection_rate_high"] == 1).all()
    alike = compare(results, results, ["regime"])
    assert (alike["detection_difference"] == 0).all()
    assert (alike["detection_difference_high"] > 0).all()
    assert (detection_limit(results, per=["regime"])["reach"] == Reach.always).all()
