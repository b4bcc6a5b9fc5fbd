"""Whether intervals hold the truth as often as they say: exactly for rates, by simulation else.

In simulations each repetition is a regime, a dimension that is kept: one call gives the intervals
of all. Statistical assertions fail with a probability below 1e-6 where the coverage is within its
limits; they print their figures.
"""

import math

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from support.comparisons import holm, with_detected
from support.lengths import first_of, lengths
from support.small_datasets import perfect
from sweep.analysis import compare, detection_limit, error_statistics, marker_ranking
from sweep.analysis.intervals import clopper_pearson, jeffreys, wilson
from sweep.measure.flags import EstimateStatus, Flipped

# Rates, exactly: Brown, Cai and DasGupta, Statistical Science 16(2), 2001 (BCD).

METHODS = pytest.mark.parametrize("interval", [wilson, jeffreys])


def exact_coverage(low, high, p, n):
    """Return the chance that the interval of a binomial number of n holds p.

    The ends grow with the number, so that those whose interval holds p are neighbours.
    """
    assert (np.diff(low) > 0).all()
    assert (np.diff(high) > 0).all()
    first = np.searchsorted(high, p, side="left")
    last = np.searchsorted(low, p, side="right") - 1
    return stats.binom.cdf(last, n, p) - stats.binom.cdf(first - 1, n, p)


def least_coverage(low, high, n, within=(0.0, 1.0)):
    """Return the greatest lower bound of the coverage over p: it lies just outside of an end."""
    p = np.concatenate([np.nextafter(low[1:], 0.0), np.nextafter(high[:-1], 1.0)])
    p = p[(p > within[0]) & (p < within[1])]
    return exact_coverage(low, high, p, n).min()


# n: least coverage of Wilson and Jeffreys, least for p in 0.1 ... 0.9 (computed, rounded down).
LEAST = {
    5: (0.831, 0.891, 0.892, 0.900), 10: (0.834, 0.915, 0.868, 0.868),
    20: (0.836, 0.926, 0.893, 0.893), 50: (0.837, 0.930, 0.883, 0.916),
    100: (0.837, 0.932, 0.880, 0.926), 1000: (0.838, 0.944, 0.897, 0.944),
    10**4: (0.838, 0.948, 0.897, 0.948), 10**5: (0.838, 0.949, 0.897, 0.949),
}


@pytest.mark.parametrize("n", [
    pytest.param(n, marks=pytest.mark.evidence) if n > 10**4 else n for n in LEAST])
@METHODS
def test_rates_are_covered_as_the_literature_says(interval, n):
    low, high = interval(np.arange(n + 1), n)
    p = (np.arange(20_000) + 0.5) / 20_000
    mean = exact_coverage(low, high, p, n).mean()
    least, inside = least_coverage(low, high, n), least_coverage(low, high, n, (0.1, 0.9))
    print(f"{interval.__name__} n = {n}: mean {mean:.4f}, least {least:.4f}, "
          f"for p in 0.1 ... 0.9 {inside:.4f}")
    # BCD section 4.1, figure 5: on average both are near the level, a little above for small n.
    assert mean == pytest.approx(0.95, abs=0.0015 if n >= 100 else 0.008)
    expected = LEAST[n][:2] if interval is wilson else LEAST[n][2:]
    assert expected[0] <= least < expected[0] + 0.002
    assert expected[1] <= inside < expected[1] + 0.002


def of_scipy(successes, n, method):
    """Return SciPy's intervals, low and high, of some numbers of n."""
    return np.transpose([
        stats.binomtest(k, n).proportion_ci(method=method) for k in successes.tolist()])


# By simulation.

def holds(table, name, truth):
    """Return how many intervals hold the truth."""
    return int(((table[f"{name}_low"] <= truth) & (truth <= table[f"{name}_high"])).sum())


def simulated(rng, sizes, vectors):
    """Return a dataset of regimes; rotation in 0.01 rad, z in percent of 1 m, x and y in cm."""
    results = perfect(rng, sizes, rotation=0.01 * vectors, position=0.01 * vectors)
    results["true_tvec_m"].values[...] = 1.0
    return results


TAILS = {
    "normal": (lambda rng, shape: rng.normal(size=shape), 1.0),
    "uniform": (lambda rng, shape: rng.uniform(-1, 1, shape), 1 / 3),
    "t4": (lambda rng, shape: rng.standard_t(4, shape), 2.0),
}
SCALES = {"rotation": ("deg", math.degrees(0.01)), "range": ("percent", 1.0),
          "position": ("m", 0.01)}


@lengths(300, 10_000)
@pytest.mark.parametrize(("cells", "trials"), [(1, 50), (5, 10), (25, 2)])
@pytest.mark.parametrize("tails", TAILS)
def test_bias_spread_and_rmse_are_covered(tails, cells, trials, count, covered):
    # Chance of a false alarm: below 1e-6 for each, for coverages of a mean within 0.93 ... 0.97, of
    # what is of squares within 0.94 ... 0.995 (the largest of a cell's two draws says much of it),
    # and of the length of a mean vector within 0.95 ... 0.995, which is wide by design.
    rng = np.random.default_rng([21, cells])
    draw, variance = TAILS[tails]
    offsets = np.zeros((cells, 1, 3))  # the cells differ, as on a grid
    offsets[:, 0] = [2.0, 0.0, 0.5]
    offsets[:, 0, 2] += np.linspace(-1, 1, cells) if cells > 1 else 0.0
    vectors = draw(rng, (count, cells, trials, 3)) + offsets
    results = simulated(rng, {"regime": count, "marker_id": cells, "trial": trials}, vectors)
    answer = error_statistics(results, ["regime"]).compute()
    mean, between = offsets.mean(axis=(0, 1)), offsets[..., 2].var()
    for name, (unit, scale) in SCALES.items():
        parts = slice(2, 3) if name == "range" else slice(None)
        components = 1 if name == "range" else 3
        square = components * variance + between
        truth = {
            "bias": mean[2] if name == "range" else np.linalg.norm(mean),
            "sd": math.sqrt(square), "rmse": math.sqrt(square + (mean[parts] ** 2).sum()),
        }
        truth["rmse_unflipped"] = truth["rmse"]
        for statistic, value in truth.items():
            limits = (0.93, 0.97) if statistic == "bias" else (0.94, 0.995)
            if statistic == "bias" and name != "range":
                limits = (0.95, 0.995)
            elif (statistic, name) == ("rmse", "rotation"):  # which counts flips that are not there
                limits = (0.95, 1.0)
            label = f"{name}_{statistic}_{unit}"
            covered(f"{tails} {cells} x {trials} {label}",
                    holds(answer, label, scale * value), count, *limits)


@pytest.mark.evidence
@pytest.mark.parametrize("alike", [0.1, 0.4, 0.7])
@pytest.mark.parametrize(("photographs", "markers"), [(13, 24), (54, 17)])
def test_errors_of_photographs_are_covered(photographs, markers, alike, covered):
    # Errors of a photograph's markers have the intraclass correlation `alike`. Chance of a false
    # alarm below 1e-6, for coverages within 0.93 ... 0.985.
    count, rng = 2000, np.random.default_rng([29, photographs])
    sizes = {"regime": count, "marker_id": markers, "trial": photographs}
    together, alone = (rng.normal(size=(count, some, photographs, 3)) for some in (1, markers))
    vectors = 0.5 + math.sqrt(alike) * together + math.sqrt(1 - alike) * alone
    results = simulated(rng, sizes, vectors).assign_coords(photographs="photographs.npz")
    answer = error_statistics(results, ["regime"]).compute()
    for label, truth in (("range_bias_percent", 0.5), ("range_sd_percent", 1.0),
                         ("range_rmse_percent", math.sqrt(1.25)), ("position_sd_m", 0.01 * 3**0.5),
                         ("position_rmse_m", 0.01 * math.sqrt(3.75))):
        covered(f"{photographs} photographs, {alike}: {label}", holds(answer, label, truth), count,
                0.93, 0.985)


@lengths(1000, 10_000)
@pytest.mark.parametrize("trials", first_of([50, 200], 1))
@pytest.mark.parametrize("share", [0.01, 0.02, 0.05])
def test_rmse_of_rare_flips_is_covered(share, trials, count, covered):
    # Flips of 60 degrees about any axis among errors of half a degree. Chance of a false alarm
    # below 1e-6, for coverages above 0.93; 50 of 2 % are covered with 0.64 if what is not in the
    # sample does not count.
    rng = np.random.default_rng([27, trials])
    sizes = {"regime": count, "marker_id": 1, "trial": trials}
    directions = rng.normal(size=(*sizes.values(), 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    flipped = rng.random(tuple(sizes.values())) < share
    errors = rng.normal(size=(*sizes.values(), 3)) * 0.5 / math.sqrt(3)
    degrees = np.where(flipped[..., None], 60 * directions, errors)
    results = perfect(rng, sizes, rotation=np.radians(degrees), position=0.01 * errors)
    results["flipped"] = results["flipped"].copy(data=np.where(
        flipped, Flipped.flipped, Flipped.not_flipped).reshape(results["flipped"].shape))
    answer = error_statistics(results, ["regime"]).compute()
    truth = math.sqrt((1 - share) * 0.25 + share * 3600)
    words = f"{share:.0%} flips, n = {trials}"
    covered(f"{words}: RMSE", holds(answer, "rotation_rmse_deg", truth), count, 0.93, 1.0)
    # What flips do not touch.
    for name, value in (("rotation_rmse_unflipped_deg", 0.5), ("rotation_sd_deg", 0.5)):
        covered(f"{words}: {name}", holds(answer, name, value), count, 0.93, 0.99)
    squares = stats.chi2(3)
    median = math.sqrt(squares.ppf(0.5 / (1 - share)) / 12)
    covered(f"{words}: median", holds(answer, "rotation_median_deg", median), count,
            0.93, 0.99)


@pytest.mark.parametrize("n", [1, 5, 20, 50, 1000])
def test_clopper_and_pearsons_interval_covers_every_rate(n):
    low, high = clopper_pearson(np.arange(n + 1), n)
    some = np.unique(np.linspace(0, n, 51).astype(int))
    theirs = of_scipy(some, n, "exact")
    np.testing.assert_allclose(low[some], theirs[0], rtol=1e-9)
    np.testing.assert_allclose(high[some], theirs[1], rtol=1e-9)
    assert exact_coverage(low, high, (np.arange(2000) + 0.5) / 2000, n).min() >= 0.95


@lengths(300, 10_000)
@pytest.mark.parametrize("lost", [0.0, 0.03])
def test_quantiles_are_covered_at_least_as_often_as_they_say(lost, count, covered):
    # Chance of a false alarm below 1e-6, for coverages within 0.95 ... 1.
    rng = np.random.default_rng(22)
    trials = 200
    sizes = {"regime": count, "marker_id": 2, "trial": trials}  # p99 needs 368 draws
    widths = np.array([0.5, 1.0])[:, None]
    vectors = np.zeros((*sizes.values(), 3))
    vectors[..., 2] = rng.random(tuple(sizes.values())) * widths * rng.choice([-1, 1])
    results = simulated(rng, sizes, vectors)
    missed = rng.random(tuple(sizes.values())) < lost
    results["estimate"].values[missed] = EstimateStatus.solver_failed
    results["flipped"].values[missed] = Flipped.no_estimate
    answer = error_statistics(results, ["regime"]).compute()
    for name, share in (("median", 0.5), ("p95", 0.95), ("p99", 0.99)):
        # Half of the values are uniform on [0, 1/2], half on [0, 1]; `lost` are infinite.
        of_solved = share / (1 - lost)
        truth = (math.inf if of_solved > 1 else of_solved / 1.5 if of_solved <= 0.75
                 else 2 * of_solved - 1)
        assert (answer[f"{name}_interval"] == 1).all()
        for quantity, unit in (("range", "percent"), ("position", "m")):
            label = f"{quantity}_{name}_{unit}"
            scaled = truth * SCALES[quantity][1]
            covered(f"lost {lost} {label}", holds(answer, label, scaled), count, 0.95, 1.0)


@lengths(300, 10_000)
@pytest.mark.parametrize(("first", "second"), [(0.5, 0.5), (0.8, 0.9), (0.9, 0.6), (0.97, 0.9)])
@pytest.mark.parametrize(("cells", "trials"), [(1, 50), (5, 20)])
def test_differences_of_paired_rates_are_covered(cells, trials, first, second, count, covered):
    # Chance of a false alarm below 1e-6, for coverages within 0.93 ... 0.975; method 10 covers more
    # where 50 draws have rates near 1: exactly (by the reference, over all tables) 0.983.
    rng = np.random.default_rng([23, cells, int(100 * first)])
    sizes = {"regime": count, "marker_id": cells, "trial": trials}
    shape = tuple(sizes.values())
    common = rng.random(shape)
    own = np.where(rng.random(shape) < 0.5, common, rng.random(shape))  # half of them alike
    results = perfect(rng, sizes)
    answer = compare(with_detected(results, common < first), with_detected(results, own < second),
                   ["regime"]).compute()
    covered(f"{first} and {second}, {cells} x {trials}",
            holds(answer, "detection_difference", second - first), count, 0.93,
            0.99 if (cells, first) == (1, 0.97) else 0.975)
    if first == second:
        false_alarms = int((answer["detection_p_value"] < 0.05).sum())
        print(f"McNemar: {false_alarms / count:.4f} below 0.05")
        assert stats.binom.sf(false_alarms - 1, count, 0.05) > 1e-6


@lengths(300, 10_000)
@pytest.mark.parametrize(("cells", "trials"), [(1, 50), (5, 10), (25, 2)])
def test_differences_and_ratios_of_paired_errors_are_covered(cells, trials, count, covered):
    # Chance of a false alarm below 1e-6, for coverages within 0.93 ... 0.97.
    rng = np.random.default_rng([24, cells])
    sizes = {"regime": count, "marker_id": cells, "trial": trials}
    shared, *own = rng.normal(size=(3, *sizes.values()))
    widths = np.linspace(1, 1.5, cells)[:, None]
    deviations = {"first": 1.0, "second": 0.7}
    sides = []
    for scale, alone in zip(deviations.values(), own, strict=True):
        vectors = np.zeros((*sizes.values(), 3))
        vectors[..., 2] = scale * widths * (0.8 * shared + 0.6 * alone)  # correlated by 0.64
        sides.append(simulated(rng, sizes, vectors))
    answer = compare(*sides, ["regime"]).compute()
    mean_size = math.sqrt(2 / math.pi) * widths.mean()
    for name, (unit, scale) in SCALES.items():
        words = f"{cells} x {trials} {name}"
        label = f"{name}_difference_{unit}"
        covered(f"{words} difference",
                holds(answer, label, scale * (0.7 - 1.0) * mean_size), count)
        covered(f"{words} ratio", holds(answer, f"{name}_rmse_ratio", 0.7), count)


LADDERS = {
    "steep": [0.1, 0.6, 0.97, 1.0, 1.0, 1.0], "at the rate": [0.3, 0.7, 0.9, 0.93, 0.96, 0.99],
    "just below": [0.5, 0.8, 0.89, 0.92, 0.95, 0.97], "dip": [0.2, 0.95, 0.85, 0.95, 0.99, 1.0],
    "never": [0.1, 0.2, 0.4, 0.6, 0.8, 0.85], "always": [0.92, 0.95, 0.97, 0.99, 1.0, 1.0],
}


@lengths(300, 5000)
@pytest.mark.parametrize(("cells", "trials"), [(1, 50), (4, 25)])
@pytest.mark.parametrize("ladder", LADDERS)
def test_limits_of_detection_are_covered_at_least_as_often_as_they_say(
    ladder, cells, trials, count, covered
):
    # Chance of a false alarm below 1e-6, for coverages within 0.95 ... 1.
    rng = np.random.default_rng([25, cells])
    sizes = {"regime": count, "marker_id": cells, "side_px": 6, "trial": trials}
    rates = np.array(LADDERS[ladder])
    results = perfect(rng, sizes)
    sides = results["side_px"].values
    results = with_detected(results, rng.random(tuple(sizes.values())) < rates[:, None])
    answer = detection_limit(results, 0.9, per=["regime"]).compute()
    good = np.minimum.accumulate((rates >= 0.9)[::-1])[::-1]
    truth = sides[good][0] if good.any() else math.inf  # beyond the grid
    hits = holds(answer, "side_px", truth)
    found = {int(flag): int((answer["limit"] == flag).sum()) for flag in (1, 2, 3)}
    print(f"{ladder}: found {found[1]}, never {found[2]}, always {found[3]}")
    covered(f"{ladder}, {cells} x {trials}", hits, count, 0.95, 1.0)


# Rankings.

NULL = pytest.mark.parametrize(("ids", "rate"), [
    (ids, rate) for ids in (10, 50) for rate in (0.5, 0.95, 0.999)
])


def ranked(rng, count, ids, rates, trials=20):
    """Return the table of ``count`` regimes; ``rates`` (ids, cells)."""
    cells = rates.shape[-1]
    sizes = {"regime": count, "marker_id": ids, "tilt_deg": cells, "trial": trials}
    results = perfect(rng, sizes)[["detection", "estimate", "flipped", "true_tvec_m",
                                   "rotation_error_rad", "translation_error_m",
                                   "rotation_error_deg"]]
    results = with_detected(results, rng.random(tuple(sizes.values())) < rates[..., None])
    return results, marker_ranking(results, ["regime"]).compute()


def cell_rates(rate):
    """Return rates of three cells that differ, the mean of their logits that of ``rate``."""
    odds = rate / (1 - rate) * np.array([2.0, 1.0, 0.5])
    return odds / (1 + odds)


@NULL
@lengths(60, 2000)
def test_alike_ids_are_called_weak_in_five_per_cent_of_the_tables_at_most(ids, rate, count):
    # Chance of a false alarm below 1e-6: a table has a weak ID with a chance of 5 % at most.
    rng = np.random.default_rng([26, ids, int(1000 * rate)])
    _, answer = ranked(rng, count, ids, np.broadcast_to(cell_rates(rate), (ids, 3)))
    p_values = answer["p_value"].transpose("regime", "marker_id").fillna(1.0).values
    below = (answer["detection_rate"] < answer["expected_rate"]).transpose("regime", "marker_id")
    adjusted = np.array([holm(row.tolist()) for row in p_values])
    any_odd = int((adjusted < 0.05).any(axis=1).sum())
    any_weak = int(((adjusted < 0.05) & below.values).any(axis=1).sum())
    each = float((p_values < 0.05).mean())
    print(f"{ids} IDs, rate {rate}: {any_weak / count:.4f} of {count} tables with a weak ID, "
          f"{any_odd / count:.4f} with an odd one, {each:.4f} of the p-values below 0.05")
    assert stats.binom.sf(any_weak - 1, count, 0.05) > 1e-6
    assert stats.binom.sf(any_odd - 1, count, 0.05) > 1e-6


@lengths(60, 1000)
@pytest.mark.parametrize(("ids", "fallen"), [(10, 0.7), (50, 0.6), (50, 0.8)])
def test_a_planted_weak_id_is_found(ids, fallen, count):
    # Others are found in 95 %, of 60 poses each; the power that was measured less 0.2 is passed
    # with a chance above 1 - 1e-6.
    rng = np.random.default_rng([28, ids, int(100 * fallen)])
    rates = np.full((ids, 3), 0.95)
    rates[4] = fallen
    results, answer = ranked(rng, count, ids, rates)
    p_values = answer["p_value"].transpose("regime", "marker_id").values
    adjusted = np.array([holm(row.tolist()) for row in p_values])
    power = float((adjusted[:, 4] < 0.05).mean())
    first = float((answer["rank"].isel(marker_id=4) == 1).mean())
    print(f"{ids} IDs, one found in {fallen}: weak in {power:.3f}, weakest in {first:.3f}")
    least = {(10, 0.7): 0.75, (50, 0.6): 0.75, (50, 0.8): 0.1}[ids, fallen]
    assert power > least
    one = marker_ranking(results.isel(regime=0)).compute()
    assert one["weak"].values.sum() <= 2
    xr.testing.assert_allclose(one["p_value"], answer["p_value"].isel(regime=0))
